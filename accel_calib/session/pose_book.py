# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The poses captured so far, as dwells, so that repeated poses can be merged and the last one undone.

An ongoing rest is held as it is known so far, and replaced by its final average: the dwell that
overlaps it in time. No pose is ever removed but by the user. If it turns out later that the sensor
may have moved in a pose, the pose is marked as doubtful, and the fit leaves it out if it can.

"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import replace

import numpy as np

from ..capture import CaptureSettings, Dwell, poses_from, select
from ..table import Poses
from ..units import Units

_SEPARATE = 64
"""Dwells that can be undone one by one; older ones are merged for good."""

_SAME_TEMPERATURE = 120.0
"""Rests within this time have the same temperature [s]."""

_BAND = 5.0
"""Poses that differ more in temperature are not repeated [°C]: ~/refine needs both."""

_CONTEXT = ('temperature', 'supply_voltage', 'rate')


class PoseBook:
    """
    Poses in the order of their capture.

    Parameters
    ----------
    settings : CaptureSettings
        Whether repeated poses are kept, merged or refused.
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
        """Return the pose table, with repeated poses merged or left out."""
        dwells = [*self._earlier, *self._dwells, *self._held]
        return poses_from(self._selected(dwells), self._settings)

    def _selected(self, dwells: list[Dwell]) -> list[Dwell]:
        """Keep, merge or refuse repeated poses, separately at each temperature."""
        bands: dict[float, list[Dwell]] = {}
        for dwell in with_temperature(dwells):
            temperature = float(np.asarray(dwell.context.get('temperature', 0.0)))
            bands.setdefault(round(temperature / _BAND), []).append(dwell)
        return [dwell for band in bands.values()
                for dwell in select(band, self._settings, self._units)]

    def add_stored(self, poses: Poses) -> None:
        """Put stored poses in front of the others."""
        self._earlier = [*dwells_of(poses), *self._earlier]

    @property
    def holding(self) -> bool:
        """Whether an ongoing rest is held."""
        return bool(self._held)

    def holds(self, dwell: Dwell) -> bool:
        """Return whether this rest is held."""
        return any(overlap(dwell, each) for each in self._held)

    def hold(self, dwell: Dwell) -> None:
        """Hold an ongoing rest as it is known so far."""
        self._held = [*(each for each in self._held if not overlap(dwell, each)), dwell]

    def end(self, dwell: Dwell) -> None:
        """Add a rest that ended, in place of the one held."""
        self._held = [each for each in self._held if not overlap(dwell, each)]
        self._add(dwell)

    def _add(self, dwell: Dwell) -> None:
        self._dwells.append(dwell)
        if len(self._dwells) > _SEPARATE:
            self._earlier = self._selected([*self._earlier, self._dwells.pop(0)])

    def doubt_held(self, is_over: Callable[[Dwell], bool]) -> int:
        """Mark held rests that are over without an average; return their number."""
        over = [each for each in self._held if is_over(each)]
        self._held = [each for each in self._held if not is_over(each)]
        for dwell in over:
            self._add(replace(dwell, doubtful=True))
        return len(over)

    def doubt(self, starts: Container[float]) -> int:
        """Mark the dwells that began at these times; return the number of new marks."""
        new = [dwell for dwell in self._dwells if dwell.start in starts and not dwell.doubtful]
        self._dwells = [replace(dwell, doubtful=True) if dwell.start in starts else dwell
                        for dwell in self._dwells]
        return len(new)

    def undo(self) -> bool:
        """Remove the last pose; return whether there was one."""
        entries = self._held or self._dwells or self._earlier
        return bool(entries and entries.pop())

    def clear(self) -> None:
        """Remove all poses."""
        self._earlier, self._dwells, self._held = [], [], []


def with_temperature(dwells: list[Dwell]) -> list[Dwell]:
    """
    Return dwells, those before the first temperature message with that of the nearest dwell.

    One pose without a temperature would leave the whole table without it.

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
    """Return whether two dwells overlap in time, and so are the same rest."""
    return one.start <= other.end and other.start <= one.end


def dwells_of(poses: Poses) -> list[Dwell]:
    """Return the poses of a table as dwells, each of its own orientation."""
    return [_dwell_of(poses, k) for k in range(len(poses))]


def _dwell_of(poses: Poses, k: int) -> Dwell:
    time = float(poses['time'][k]) if 'time' in poses else 0.0
    count = float(poses['count'][k]) if 'count' in poses else 1.0
    std = poses['std'][k] if 'std' in poses else poses.reading[k] * 0.0
    context = {key: poses[key][k] for key in _CONTEXT if key in poses}
    doubtful = 'doubtful' in poses and bool(poses['doubtful'][k])
    return Dwell(time, time, time, poses.reading[k], std, count, max(1, round(count)), context,
                 -1 - k, doubtful)
