# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The longest rest of a recording, as samples with equal spacing.

The detector of `accel_calib.capture` finds the rests. A rest ends at an interruption of the
stamps. Single samples that are missing are replaced by the sample before, if they are few, because
a recording that loses one sample in a thousand would otherwise have no long rest. Stamps with
jitter are not used one by one: samples come from a regular clock, and their order is right.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from ..capture import CaptureSettings, samples_of, StillDetector
from ..errors import InputError
from ..table import Floats, numbered, Recording
from ..text import counted
from ..units import Units

LEAST_SAMPLES = 64
"""Smallest number of samples of a rest: five octaves of τ."""

_BLOCK = 1 << 16
_LONG = 1.5
"""Interval between stamps that indicates a missing sample, in units of the usual interval."""

_INTERRUPTED = 10
"""Number of missing samples in a row that interrupts a rest."""

_MOST_MISSING = 0.02
"""Largest part of missing samples; with more long intervals, the stamps have jitter."""

_UNEVEN = 0.1
"""Standard deviation of the intervals that is worth a note, in units of the mean interval."""


@dataclass(frozen=True)
class Rest:
    """
    The longest rest of a recording.

    Parameters
    ----------
    start : float
        Stamp of the first sample [s].
    rate : float
        Samples per second [Hz].
    values : (c, n) array
        Readings [g], and angular rates [rad/s] if the recording has them.
    temperature : (n,) array or None
        Temperature [°C], if the recording has it.
    recorded : float
        Duration of the recording [s].
    notes : tuple of str
        What is not regular.

    """

    start: float
    rate: float
    values: Floats
    temperature: Floats | None
    recorded: float
    notes: tuple[str, ...]

    @property
    def samples(self) -> int:
        """Return the number of samples."""
        return int(self.values.shape[1])

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.samples / self.rate


def longest_rest(recording: Recording, units: Units) -> Rest:
    """
    Return the longest rest of a recording without an interruption.

    Raises
    ------
    InputError
        If there is no rest, or the longest is too short.

    """
    time = recording['time']
    best, seconds = (0, 0), 0.0
    for start, end in sorted(_still(recording, units), key=lambda each: each[0] - each[1]):
        if end - start <= seconds:
            break
        for part in _uninterrupted(time, start, end):
            length = float(time[part[1] - 1] - time[part[0]])
            best, seconds = (part, length) if length > seconds else (best, seconds)
    count = best[1] - best[0]
    recorded = float(np.ptp(time)) if len(time) else 0.0
    if count < LEAST_SAMPLES:
        found = f'{counted(count, "sample")}' if count else 'no sample'
        raise InputError(f'the longest rest in {recorded:.3g} s has {found}, expected at least '
                         f'{LEAST_SAMPLES}', 'record the sensor for some minutes to hours while '
                         'nothing touches it')
    return _regular(recording.take(slice(*best)), units, recorded)


def _uninterrupted(time: Floats, start: float, end: float) -> Iterator[tuple[int, int]]:
    """Yield first index and end of the parts of a rest without interruptions."""
    inside = np.flatnonzero((time >= start) & (time <= end))
    step = np.diff(time[inside])
    if not len(step):
        return
    cuts = (np.diff(inside) > 1) | (step < 0.0) | (
        step > _INTERRUPTED * float(np.median(step)) + _least(step))
    for part in np.split(inside, np.flatnonzero(cuts) + 1):
        yield int(part[0]), int(part[-1]) + 1


def _least(step: Floats) -> float:
    """Return ten mean intervals: stamps that come in groups have a median near 0."""
    return _INTERRUPTED * float(np.mean(np.maximum(step, 0.0)))


def _still(recording: Recording, units: Units) -> list[tuple[float, float]]:
    """Return first and last stamp of each rest."""
    detector = StillDetector(CaptureSettings(), units, keep=None)
    count = len(recording)
    detector.add(samples_of(recording, first, min(first + _BLOCK, count))
                 for first in range(0, count, _BLOCK))
    detector.close()
    return [(dwell.start, dwell.end) for dwell in detector.dwells()]


def _regular(rest: Recording, units: Units, recorded: float) -> Rest:
    """Return the samples of a rest with equal spacing."""
    time = rest['time']
    step = np.diff(time)
    usual = float(np.median(step))
    late = step > _LONG * usual
    missing = np.maximum(np.round(step[late] / usual) - 1.0, 0.0).sum() if usual > 0.0 else np.inf
    if not 0.0 < missing <= _MOST_MISSING * len(time):
        rate = (len(time) - 1) / float(time[-1] - time[0])
        notes = _jitter(step)
    else:
        steps = np.where(late, np.maximum(np.round(step / usual), 1.0), 1.0)
        place = np.append(0.0, np.cumsum(steps)).astype(np.int64)
        rate = place[-1] / float(time[-1] - time[0])
        rest = rest.take(np.searchsorted(place, np.arange(place[-1] + 1), side='right') - 1)
        notes = [f'{counted(int(missing), "sample")} of {len(rest)} are missing in the rest, '
                 'and are replaced by the sample before']
    values = units.to_g(rest.reading.T)
    if 'rate' in rest:
        values = np.concatenate([values, rest['rate'].T])
    return Rest(float(time[0]), rate, values, rest.columns.get('temperature'), recorded,
                tuple(notes))


def _jitter(step: Floats) -> list[str]:
    mean = float(np.mean(step))
    if float(np.std(step)) <= _UNEVEN * mean:
        return []
    return [f'the stamps are uneven ({np.min(step) * 1e3:.3g} to {np.max(step) * 1e3:.3g} ms '
            f'apart): the samples are taken as regular, one each {mean * 1e3:.4g} ms']


def joined(blocks: Iterable[Recording]) -> Recording:
    """Return blocks of a recording as one, with the columns that all have."""
    parts = [block for block in blocks if len(block)]
    if not parts:
        raise InputError('the recording has no samples, expected a long rest',
                         'check that this is the intended file')
    names = [name for name in parts[0].columns if all(name in part for part in parts)]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in names}
    return Recording(columns, numbered(columns), parts[0].units, parts[0].sensor)
