# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The account of every rest of a recording: whether it became a pose, or why not."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .chunks import CaptureSettings
from ..finding import Finding
from ..text import counted

REASONS: Mapping[str, tuple[str, str]] = {
    'zeros': ('samples are missing: they are 0 on all axes', 'check the driver and the cable'),
    'frozen': ('samples are missing: the last reading is repeated, though no other rest repeats '
               'it', 'check the driver and the cable'),
    'quiet': ('samples are missing: they vary far less than at all rests', 'check the driver: a '
              'filter that starts looks so'),
    'short': ('shorter than min_dwell', 'hold the sensor still for longer in each pose, or '
              'capture shorter rests with --min-dwell {seconds:.2g}'),
    'shaking': ('more variation than the noise of the sensor', 'put the sensor on something that '
                'does not shake, or accept it with --still-std-max'),
    'slope': ('a change of the reading', 'let go of the sensor, and wait until it has '
              'settled'),
    'turning': ('a turn, by the gyro', 'let go of the sensor in each pose'),
    'noisy': ('noise that does not exclude a slow turn', 'hold the sensor still three times as '
              'long in each pose'),
    'length': ('a length that is not that of gravity', 'check the unit, or accept them with a '
               'wider --still-norm-tolerance'),
    'repeated': ('an earlier orientation', '')}
"""Why a rest is no pose, and what to do about it."""

MISSING = ('', 'zeros', 'frozen', 'quiet')
"""What stands in a log where samples are missing: zeros, the last reading again and again, or what
is far quieter than the rests of the sensor."""


class Rest(NamedTuple):
    """A rest from its first to its last stamp [s]; `reason` is one of `REASONS`, '' for a pose."""

    start: float
    end: float
    reason: str = ''

    @property
    def words(self) -> str:
        """Return why it is no pose; empty for a pose."""
        return REASONS[self.reason][0] if self.reason else ''


def account_of(rests: Sequence[Rest], settings: CaptureSettings) -> tuple[Finding, ...]:
    """Return what was left out of a recording, and why most rests are no poses, if so."""
    seconds: dict[str, list[float]] = {}
    for each in rests:
        seconds.setdefault(each.reason, []).append(each.end - each.start)
    found = [Finding('missing', f'{sum(seconds[kind]):.3g} s are left out: {REASONS[kind][0]}',
                     REASONS[kind][1]) for kind in MISSING[1:] if kind in seconds]
    dropped = {reason: lengths for reason, lengths in seconds.items()
               if reason not in (*MISSING, 'repeated')}
    count, taken = sum(map(len, dropped.values())), len(seconds.get('', ()))
    if count > taken:
        most = max(dropped, key=lambda reason: len(dropped[reason]))
        words, remedy = REASONS[most]
        enough = min(0.9 * float(np.median(dropped[most])), 0.8 * settings.min_dwell)
        found.append(Finding(
            'not_taken', f'{len(dropped[most])} of {counted(count + taken, "rest")} gave no pose: '
            f'{words}', remedy.format(seconds=enough), 'USABLE', step='record'))
    return tuple(found)
