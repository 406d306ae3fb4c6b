# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The captured poses, stored as dwells, so that poses can be merged and the last pose undone.

The pose of an ongoing rest is provisional. The final average replaces it: the dwell that overlaps
it in time. Only the user removes poses. If later rests show that the sensor may have moved during
a pose, the pose is marked as doubtful, and the fit leaves it out if possible.

"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import replace

import numpy as np

from ..capture import CaptureSettings, Dwell, poses_from, select
from ..table import Poses
from ..units import Units

_SEPARATE = 64
"""Number of dwells that can be undone one by one; older dwells are merged permanently."""

_SAME_TEMPERATURE = 120.0
"""Rests within this time are assumed to have the same temperature [s]."""

_BAND = 5.0
"""Poses with a larger difference of temperature are not merged [°C]; ~/refine needs both."""

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
        """Insert stored poses before the others."""
        self._earlier = [*dwells_of(poses), *self._earlier]

    @property
    def holding(self) -> bool:
        """Whether there is a provisional pose."""
        return bool(self._held)

    def holds(self, dwell: Dwell) -> bool:
        """Return whether this rest is a provisional pose."""
        return any(overlap(dwell, each) for each in self._held)

    def hold(self, dwell: Dwell) -> None:
        """Add or update the provisional pose of an ongoing rest."""
        self._held = [*(each for each in self._held if not overlap(dwell, each)), dwell]

    def end(self, dwell: Dwell) -> None:
        """Add a rest that ended, in place of its provisional pose."""
        self._held = [each for each in self._held if not overlap(dwell, each)]
        self._add(dwell)

    def _add(self, dwell: Dwell) -> None:
        self._dwells.append(dwell)
        if len(self._dwells) > _SEPARATE:
            self._earlier = self._selected([*self._earlier, self._dwells.pop(0)])

    def doubt_held(self, is_over: Callable[[Dwell], bool]) -> int:
        """Mark provisional poses without a final average as doubtful; return their number."""
        over = [each for each in self._held if is_over(each)]
        self._held = [each for each in self._held if not is_over(each)]
        for dwell in over:
            self._add(replace(dwell, doubtful=True))
        return len(over)

    def doubt(self, starts: Container[float]) -> int:
        """Mark the dwells with these start times as doubtful; return the number of new marks."""
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
    Return dwells with missing temperatures set to that of the nearest dwell.

    The pose table has temperatures only if all its poses have one.

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
    """Return whether two dwells overlap in time; they are then the same rest."""
    return one.start <= other.end and other.start <= one.end


def dwells_of(poses: Poses) -> list[Dwell]:
    """Return the poses of a table as dwells with different orientations."""
    return [_dwell_of(poses, k) for k in range(len(poses))]


def _dwell_of(poses: Poses, k: int) -> Dwell:
    time = float(poses['time'][k]) if 'time' in poses else 0.0
    count = float(poses['count'][k]) if 'count' in poses else 1.0
    std = poses['std'][k] if 'std' in poses else poses.reading[k] * 0.0
    context = {key: poses[key][k] for key in _CONTEXT if key in poses}
    doubtful = 'doubtful' in poses and bool(poses['doubtful'][k])
    return Dwell(time, time, time, poses.reading[k], std, count, max(1, round(count)), context,
                 -1 - k, doubtful)
