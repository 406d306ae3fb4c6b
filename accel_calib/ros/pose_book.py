# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The poses captured so far, as dwells, so that repeated ones can be merged and taken back.

A rest that has not come to its end yet is held in the book as it is known so far, and is replaced
by what it comes to in the end: the one that overlaps it in time. Poses that were stored before
are taken up as dwells of their own.

"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..capture import Dwell, poses_from, select

if TYPE_CHECKING:
    from collections.abc import Callable, Container

    from ..capture import CaptureSettings
    from ..table import Poses
    from ..units import Units

_SEPARATE = 64
"""Dwells of this run that can be taken back one by one; older ones are merged for good."""

_SAME_TEMPERATURE = 120.0
"""Rests this near in time have the same temperature [s]."""

_BAND = 5.0
"""Poses that differ more in temperature are not repeated ones: ~/refine lives on them [°C]."""

_CONTEXT = ('temperature', 'supply_voltage', 'rate')


class PoseBook:
    """
    Poses in the order in which they were captured.

    Parameters
    ----------
    settings : CaptureSettings
        What becomes of repeated poses.
    units : Units
        Unit of the readings.

    """

    def __init__(self, settings: CaptureSettings, units: Units) -> None:
        self._settings = settings
        self._units = units
        self._earlier: list[Dwell] = []
        self._dwells: list[Dwell] = []
        self._held: list[Dwell] = []

    def poses(self) -> Poses:
        """Give the pose table, repeated poses merged or left out."""
        dwells = [*self._earlier, *self._dwells, *self._held]
        return poses_from(self._selected(dwells), self._settings)

    def _selected(self, dwells: list[Dwell]) -> list[Dwell]:
        """Keep, merge or refuse repeated poses, those of each temperature for themselves."""
        bands: dict[float, list[Dwell]] = {}
        for dwell in with_temperature(dwells):
            temperature = float(np.asarray(dwell.context.get('temperature', 0.0)))
            bands.setdefault(round(temperature / _BAND), []).append(dwell)
        return [dwell for band in bands.values()
                for dwell in select(band, self._settings, self._units)]

    def take_up(self, poses: Poses) -> None:
        """Put poses that were stored before in front."""
        self._earlier = [*dwells_of(poses), *self._earlier]

    @property
    def holding(self) -> bool:
        """Whether a rest is held that may be going on."""
        return bool(self._held)

    def holds(self, dwell: Dwell) -> bool:
        """Say whether this rest is held."""
        return any(overlap(dwell, each) for each in self._held)

    def hold(self, dwell: Dwell) -> None:
        """Hold what a rest comes to so far."""
        self._held = [*(each for each in self._held if not overlap(dwell, each)), dwell]

    def end(self, dwell: Dwell) -> None:
        """Put in a rest that ended, in place of the one held."""
        self._held = [each for each in self._held if not overlap(dwell, each)]
        self._dwells.append(dwell)
        if len(self._dwells) > _SEPARATE:
            old = [*self._earlier, self._dwells.pop(0)]
            self._earlier = self._selected(old)

    def give_up(self, is_over: Callable[[Dwell], bool]) -> int:
        """Take back held rests that are over and came to nothing; give how many they were."""
        kept = [each for each in self._held if not is_over(each)]
        count = len(self._held) - len(kept)
        self._held = kept
        return count

    def undo(self) -> bool:
        """Take back the last one; say whether there was one."""
        entries = self._held or self._dwells or self._earlier
        return bool(entries and entries.pop())

    def take_back(self, starts: Container[float]) -> int:
        """Take back those that began at these times; give how many they were."""
        kept = [dwell for dwell in self._dwells if dwell.start not in starts]
        count = len(self._dwells) - len(kept)
        self._dwells = kept
        return count

    def clear(self) -> None:
        """Forget all."""
        self._earlier, self._dwells, self._held = [], [], []


def with_temperature(dwells: list[Dwell]) -> list[Dwell]:
    """
    Give rests from before the first temperature message the temperature of the nearest rest.

    One pose without it would leave the whole table without it.

    """
    known = [dwell for dwell in dwells if 'temperature' in dwell.context]
    if not known:
        return dwells

    def completed(dwell: Dwell) -> Dwell:
        if 'temperature' in dwell.context:
            return dwell
        near = min(known, key=lambda other: abs(other.time - dwell.time))
        if abs(near.time - dwell.time) > _SAME_TEMPERATURE:
            return dwell
        return replace(dwell, context={**dwell.context,
                                       'temperature': near.context['temperature']})

    return [completed(dwell) for dwell in dwells]


def overlap(one: Dwell, other: Dwell) -> bool:
    """Say whether two dwells have time in common: then they are the same rest."""
    return one.start <= other.end and other.start <= one.end


def dwells_of(poses: Poses) -> list[Dwell]:
    """Give the poses of a table as dwells, each of its own orientation."""
    return [_dwell_of(poses, k) for k in range(len(poses))]


def _dwell_of(poses: Poses, k: int) -> Dwell:
    time = float(poses['time'][k]) if 'time' in poses else 0.0
    count = float(poses['count'][k]) if 'count' in poses else 1.0
    std = poses['std'][k] if 'std' in poses else poses.reading[k] * 0.0
    context = {key: poses[key][k] for key in _CONTEXT if key in poses}
    return Dwell(time, time, time, poses.reading[k], std, count, max(1, round(count)), context,
                 -1 - k)
