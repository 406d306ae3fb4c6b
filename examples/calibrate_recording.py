# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrate a sensor from a recording, check the calibration, store it and use it.

The recording is simulated, so that the example needs no file. For a recording of your own, begin
with ``poses = ac.capture('recording.mcap')``.

    python3 examples/calibrate_recording.py

"""

from pathlib import Path
from tempfile import TemporaryDirectory

import accel_calib as ac
import numpy as np

SENSOR = {
    'offset': [0.020, -0.010, 0.030],          # g
    'axis_gain': [0.010, -0.020, 0.005],       # g/g
    'cross_axis': [0.004, 0.002, -0.003],      # g/g
}
MOUNTING = (2.0, -4.0, 0.0)                    # roll, pitch, yaw [°]
GRAVITY = 9.80665                              # m/s²


def main() -> None:
    """Capture, fit, verify, store, load and apply."""
    recording = ac.simulate(SENSOR, recording=True, poses=18, mounting=MOUNTING, seed=1)
    other_poses = ac.simulate(SENSOR, poses=10, mounting=MOUNTING, seed=2)

    poses = ac.capture(recording)
    calibration = ac.fit(poses, flat=1)        # the robot is level in the first pose
    print(calibration)
    print('offset [m/s²]:', np.round(calibration.offset, 3))

    check = ac.verify(other_poses, calibration)
    print(f'On other poses: residual {check.rms_before_mg:.1f} -> {check.rms_after_mg:.2f} mg, '
          f'noise floor {check.noise_floor_mg:.2f} mg.')

    with TemporaryDirectory() as folder:
        path = Path(folder) / 'calibration.yaml'
        calibration.save(path)
        stored = ac.load(path)

    force = stored.apply(recording.reading)
    flat = force[:300].mean(axis=0) / GRAVITY  # the first rest, 3 s at 100 Hz
    print('Corrected force in the flat pose [g]:', np.round(flat, 3) + 0.0)


if __name__ == '__main__':
    main()
