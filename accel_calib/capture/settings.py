# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What the capture of still poses can be told, with its defaults."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import get_args, Literal

Repeated = Literal['keep', 'merge', 'refuse']
REPEATED: tuple[str, ...] = get_args(Repeated)


@dataclass(frozen=True)
class CaptureSettings:
    """
    Settings of the stillness detector and of the poses made from its dwells.

    Parameters
    ----------
    still_window : float
        Length of the sliding window [s]. At low rates it grows until it holds ten samples.
    still_std_max : float
        Largest standard deviation of a still sensor's samples, by axis; in g where the unit of
        the readings is known, otherwise in native units. 0: adapt to the sensor's own noise.
    still_gyro_max : float
        Largest magnitude of the mean angular rate [rad/s]; 0: the mean is not looked at, for
        gyros have biases and may be in counts.
    still_norm_tolerance : float
        Largest distance of |mean| from 1 g [g]; not used for native units. Wide, for the
        sensor is not calibrated yet.
    min_dwell : float
        Shortest dwell that makes a pose [s], edges trimmed. At low rates it grows until it
        holds sixteen samples.
    max_dwell : float
        A longer dwell is cut into poses of this length [s] that share their ``orientation``;
        use it where temperature moves during a dwell. Infinite: one pose a dwell.
    min_pose_angle : float
        Poses of different dwells within this angle count as repeated [rad].
    repeated : {'keep', 'merge', 'refuse'}
        What becomes of a repeated pose: kept as it is, averaged with the earlier one, or left
        out. Kept by default: the fit weighs poses by their noise, and effects of temperature
        and of time show only in orientations that were visited again.

    """

    still_window: float = 0.5
    still_std_max: float = 0.0
    still_gyro_max: float = 0.0
    still_norm_tolerance: float = 0.3
    min_dwell: float = 1.0
    max_dwell: float = math.inf
    min_pose_angle: float = 0.1
    repeated: Repeated = 'keep'

    def __post_init__(self) -> None:
        self._check('still_window', 0.0 < self.still_window < math.inf, 'a positive number [s]')
        self._check('min_dwell', 0.0 < self.min_dwell < math.inf, 'a positive number [s]')
        self._check('max_dwell', self.max_dwell >= 2.0 * self.min_dwell,
                    'at least twice min_dwell [s]')
        self._check('min_pose_angle', 0.0 <= self.min_pose_angle <= math.pi, '0 to π [rad]')
        self._check('repeated', self.repeated in REPEATED, f'one of {REPEATED}')
        self._check('still_norm_tolerance', self.still_norm_tolerance > 0.0, 'positive [g]')
        for name in ('still_std_max', 'still_gyro_max'):
            self._check(name, 0.0 <= getattr(self, name) < math.inf, 'zero or positive')

    def _check(self, name: str, good: bool, expected: str) -> None:
        if not good:
            raise ValueError(f'{name} is {getattr(self, name)!r}, expected {expected}')
