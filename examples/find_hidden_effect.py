# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Hide an effect in simulated poses, and let `refine` find it.

The simulated sensor has the usual errors and an offset that changes with temperature. The
temperature varies while the poses are taken. An ordinary calibration lacks the temperature effect.
`refine` names it, and the residual falls to the noise floor.

    python3 examples/find_hidden_effect.py

"""

import accel_calib as ac
import numpy as np

SENSOR = {
    'offset': [0.020, -0.010, 0.030],          # g
    'axis_gain': [0.010, -0.020, 0.005],       # g/g
    'cross_axis': [0.004, 0.002, -0.003],      # g/g
}
HIDDEN = {'offset_temperature': [0.00020, -0.00010, 0.00015]}  # g/°C
POSES = 60


def main() -> None:
    """Simulate the poses, refine, and print the result."""
    rng = np.random.default_rng(1)
    up = rng.normal(size=(POSES, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    time = np.arange(POSES) * 20.0
    poses = ac.simulate({**SENSOR, **HIDDEN}, directions=up, noise=0.002, time=time,
                        temperature=30.0 + 10.0 * np.sin(time / 190.0))

    result = ac.refine(poses, base='10')

    print(f'An ordinary calibration leaves a residual of {result.gap_mg:.2f} mg. '
          f'Noise alone would leave {result.noise_floor_mg:.2f} mg.')
    for step in result.steps:
        print(f'Missing effect: {step.effect}, seen {step.where}.')
        print(f'Residual with it: {step.gap_after_mg:.2f} mg; on poses held out: '
              f'{step.held_out_before_mg:.2f} -> {step.held_out_after_mg:.2f} mg.')
        for axis, value in step.parameters.items():
            print(f'  {axis}: {value * 1e3:+.3f} mg/°C')
    print(f'Verdict: {result.verdict}.')


if __name__ == '__main__':
    main()
