# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Hide an effect in simulated poses, find it, and see the gap shrink.

A sensor with the usual errors gets an offset that moves with temperature as well. Poses are
taken while the temperature swings; the time and the noise of each are recorded too. Which of all
effects is it that an ordinary calibration of this sensor lacks?

    python3 examples/find_hidden_effect.py

"""

from accel_calib.refine import refine
from accel_calib.simulate import model_with, simulate_poses
from accel_calib.sphere import random_directions
from accel_calib.units import Units
import numpy as np

SENSOR = {
    'offset': np.array([0.020, -0.010, 0.030]),          # g
    'axis_gain': np.array([0.010, -0.020, 0.005]),       # g/g
    'cross_axis': np.array([0.004, 0.002, -0.003]),      # g/g
}
HIDDEN = {'offset_temperature': np.array([0.00020, -0.00010, 0.00015])}  # g/°C
POSES = 60


def main() -> None:
    """Tell the story."""
    rng = np.random.default_rng(1)
    time = np.arange(POSES) * 20.0
    context = {'time': time, 'temperature': 30.0 + 10.0 * np.sin(time / 190.0)}
    poses = simulate_poses(model_with({**SENSOR, **HIDDEN}), random_directions(POSES, rng), rng,
                           noise_g=0.002, context=context)

    result = refine(poses, Units('g', 1.0), base='10')

    print(f'An ordinary calibration leaves a gap of {result.gap_mg:.2f} mg; '
          f'noise alone would leave {result.noise_floor_mg:.2f} mg.')
    for step in result.steps:
        print(f'Missing: {step.effect}, {step.where}.')
        print(f'With it: {step.gap_before_mg:.2f} -> {step.gap_after_mg:.2f} mg; on poses held '
              f'out {step.held_out_before_mg:.2f} -> {step.held_out_after_mg:.2f} mg.')
        for name, value in step.parameters.items():
            print(f'  {name}: {value * 1e3:+.3f} mg/°C')
    print(f'Verdict: {result.verdict}.')


if __name__ == '__main__':
    main()
