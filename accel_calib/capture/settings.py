# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Settings of the capture of still poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
import math
from typing import Any, get_args, Literal

import numpy as np

from ..errors import InputError
from ..units import Units

Repeated = Literal['keep', 'merge', 'refuse']
REPEATED: tuple[str, ...] = get_args(Repeated)


@dataclass(frozen=True)
class CaptureSettings:
    """
    Settings of the stillness detector and of the poses made from its dwells.

    Parameters
    ----------
    still_window : float
        Length of the sliding window [s]. At low sample rates it is extended to ten samples.
    still_std_max : float
        Largest standard deviation of the samples of a still sensor, by axis; in g if the unit of
        the readings is known, otherwise in native units. 0: adapt to the noise of the sensor.
    still_gyro_max : float
        Largest magnitude of the mean angular rate [rad/s]. 0: not checked, because gyros have
        biases and may be in counts.
    still_norm_tolerance : float
        Largest difference of |mean| from 1 g [g]; not used for native units. The default is wide
        because the sensor is not calibrated yet.
    min_dwell : float
        Shortest dwell that becomes a pose [s], without its edges. At low sample rates it is
        extended to sixteen samples.
    max_dwell : float
        A longer dwell is split into poses of this length [s] with the same ``orientation``, for
        example if the temperature changes during a dwell. Infinite: one pose per dwell.
    min_pose_angle : float
        Poses of different dwells within this angle count as repeated [rad].
    repeated : {'keep', 'merge', 'refuse'}
        Keep a repeated pose, average it with the earlier pose, or leave it out. By default it is
        kept: the fit weights poses by their noise, and only repeated orientations show effects of
        temperature and time.

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


def settings_from(given: Mapping[str, Any], units: Units) -> CaptureSettings:
    """
    Return settings with these values, and the defaults for all others.

    Parameters
    ----------
    given : mapping of str to object
        Values by the names of `CaptureSettings`; ``still_std_max`` is in the unit of the readings.
    units : Units
        Unit of the readings.

    Raises
    ------
    InputError
        If a name is not known, or a value is out of range.

    """
    names = [each.name for each in fields(CaptureSettings)]
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise InputError(f'{unknown[0]} is not a setting of the capture',
                         f'use one of {", ".join(names)}')
    known = dict(given)
    if 'still_std_max' in known:
        known['still_std_max'] = float(units.to_g(np.asarray(known['still_std_max'])))
    try:
        return CaptureSettings(**known)
    except ValueError as err:
        raise InputError(str(err), 'change that setting') from err
