# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From samples to chunks: sums over short intervals of header time; and the settings of the capture.

Windows and dwells are sums of chunks of a fifth of the still window, so that the cost per sample
is a few additions for any window length. The first sample of the stream is subtracted before
squaring, which preserves the digits of a small noise on a large offset.

The sample period is estimated from the first samples of a segment and then kept, so that a stream
and a recording are divided at the same places. A segment is a part of the stream without an
interruption of the stamps.

**Limits.** A sensor that reaches the end of its range repeats its largest or smallest reading. The
samples that repeat the extreme of their axis so far are therefore counted. A new extreme is not
counted, because noise also reaches new extremes.

"""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
import math
from typing import Any, get_args, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..units import Floats, Indices, Units

Repeated = Literal['keep', 'merge', 'refuse']
REPEATED: tuple[str, ...] = get_args(Repeated)


_LARGEST = 1e12
"""Limit of the settings: more than any recording [s] and any count."""


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
        Largest difference of |a| of a rest from 1 g [g], beside the offset and the gains by axis
        that all rests have in common; not used for native units. While the rests are too few to
        show these, 0.25 to 3 g are accepted.
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
        most = f'0 to {_LARGEST:g}'
        for name, good, expected in (
                ('still_window', 0.0 < self.still_window < _LARGEST, f'{most} [s]'),
                ('min_dwell', 0.0 < self.min_dwell < _LARGEST, f'{most} [s]'),
                ('max_dwell', self.max_dwell >= 2.0 * self.min_dwell,
                 'at least twice min_dwell [s]'),
                ('min_pose_angle', 0.0 <= self.min_pose_angle <= math.pi, '0 to π [rad]'),
                ('repeated', self.repeated in REPEATED, f'one of {REPEATED}'),
                ('still_norm_tolerance', self.still_norm_tolerance > 0.0, 'positive [g]'),
                ('still_std_max', 0.0 <= self.still_std_max < _LARGEST, most),
                ('still_gyro_max', 0.0 <= self.still_gyro_max < _LARGEST, most)):
            if not good:
                raise ValueError(f'{name} is {getattr(self, name)!r}, expected {expected}')


def settings_from(given: Mapping[str, Any], units: Units) -> CaptureSettings:
    """
    Return settings with these values by name, and the defaults for all others.

    ``still_std_max`` is in the unit of the readings. Raise InputError if a name is not known, or a
    value is out of range.

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


Records = NDArray[Any]
"""One-dimensional structured array."""

MOTION = 7
"""Numbers of a sample before its context: time, reading, rate (NaN: none)."""

CHUNKS_PER_WINDOW = 5


@cache
def chunk_type(columns: int) -> np.dtype[Any]:
    """Return the type of a chunk, with this number of columns of context."""
    sums = np.dtype([
        ('count', float),                   # samples
        ('time', float),                    # of the stamps, relative to the epoch [s]
        ('first', float, 6),                # of reading and rate, relative to the origin
        ('second', float, 6),               # of their squares
        ('at_limit', float, 3),             # samples that repeat the extreme of the axis so far
        ('repeats', float),                 # samples that repeat the one before in the chunk
        ('zeros', float),                   # samples that are zero on all axes
        ('off', float),                     # windows in which the gyro does not vary
        ('context_count', float, (columns,)),  # samples that have the context
        ('context_sum', float, (columns,)),
        ('level', float, 6),                # variance of the window at each chunk; NaN: no rate
        ('windows', float)])                # number of windows in that sum
    return np.dtype([
        ('sums', sums),
        ('begin', float), ('end', float),   # first and last stamp [s]
        ('step', float, 2),                 # smallest nonzero step of reading and rate, see Chunks
        # The verdict of `rule` on the window that ends with the chunk:
        ('limit', float, 6),                # largest level of a still window; infinite: no rate
        ('still', bool),
        ('missing', np.intp),               # place in `MISSING` of what stands for readings; 0
        ('trending', np.intp)])             # chunks over which it has a slope or oscillates; 0


def chained(*parts: Records) -> Records:
    """Concatenate records; `numpy.concatenate` alone would copy them field by field."""
    filled = [part for part in parts if len(part)] or list(parts[:1])
    if len(filled) == 1:
        return filled[0]
    kind = filled[0].dtype
    return np.concatenate([part.view(f'V{kind.itemsize}') for part in filled]).view(kind)


def summed(records: Records, size: int) -> Records:
    """Return the sums over groups of `size` consecutive records of floats."""
    numbers = np.ascontiguousarray(records).view(float).reshape(-1, size,
                                                                records.dtype.itemsize // 8)
    return numbers.sum(axis=1).view(records.dtype)[:, 0]


def repeated_extremes(reading: Floats, starts: Indices, highest: Floats) -> tuple[Floats, Floats]:
    """
    Return the (m, 3) samples of each chunk that repeat the extreme of their axis so far.

    `highest` (6,) are the largest readings before, and the smallest ones with the other sign.
    Those after the chunks are returned, too.

    """
    found, sizes = np.zeros((len(starts), 3)), np.diff(starts, append=reading.shape[1])
    extreme = np.concatenate([reading.max(axis=1), -reading.min(axis=1)])
    # Most blocks reach no extreme; they need no more than the maximum and the minimum.
    for k in np.flatnonzero(extreme >= highest):
        values = reading[k] if k < 3 else -reading[k - 3]
        here = np.maximum.reduceat(values, starts)
        so_far = np.maximum.accumulate(np.append(highest[k], here))
        equal = (values == np.repeat(so_far[1:], sizes)).astype(float)
        found[:, k % 3] += np.add.reduceat(equal, starts) - (here > so_far[:-1])
    return found, np.maximum(highest, extreme)


_LEARN = 16  # intervals from which the period is estimated
_MISSING_SECONDS = 0.5  # a longer interval, also longer than _MISSING_PERIODS, is an interruption
_MISSING_PERIODS = 5.0
_BACK_SECONDS = 0.01  # a step back by less, or by less than _BACK_PERIODS, is jitter
_BACK_PERIODS = 2.0
_PENDING_MAX = 200_000  # largest number of samples in a chunk; with more, the clock has stopped


class Interruption(NamedTuple):
    """
    An interruption of the stamps [s], which ends a dwell.

    Samples are missing (gap), time jumped back, or the stamps did not change while samples arrived
    (stopped). `seconds` is the next stamp minus the last one.

    """

    time: float
    kind: Literal['gap', 'jump_back', 'stopped']
    seconds: float


@dataclass(frozen=True)
class Chunks:
    """
    m consecutive chunks of one segment.

    `records` (m,) are of a `chunk_type`, with the time relative to `epoch`, the start of the
    segment, and readings and rates relative to `origin` (6,), the first ones of the stream. Steps
    are between successive readings, and rates; infinite if no step is smaller than before.
    `length` and `period` are those of a chunk and of the samples; times are in s. `fresh` is
    whether these are the first chunks of the segment.

    """

    records: Records
    epoch: float
    origin: Floats
    length: float
    period: float
    fresh: bool


class Chunker:
    """Convert samples in any blocks, with this number of columns of context, to chunks."""

    def __init__(self, settings: CaptureSettings, columns: int) -> None:
        self._kind = chunk_type(columns)
        self._shortest = settings.still_window / CHUNKS_PER_WINDOW
        self._least = [np.inf, np.inf]
        self._highest = np.full(6, -np.inf)
        self._origin: Floats = np.empty(0)
        self._length = self._epoch = self._latest = self._period = 0.0
        self._pending: Floats
        self.interruptions: deque[Interruption] = deque(maxlen=10_000)
        self.fresh = True  # the present segment has no chunk yet
        self.restart()

    def feed(self, samples: Floats, last: bool) -> Iterator[Chunks]:
        """
        Yield the chunks that samples complete: time [s], reading, rate and context as rows.

        If they are the last ones, the period is estimated from few samples, too.

        """
        parts = [self._pending, samples]
        if len(parts[0]) != len(parts[1]):  # columns that one of both lacks are NaN there
            rows = max(map(len, parts))
            parts = [np.pad(each, ((0, rows - len(each)), (0, 0)), constant_values=np.nan)
                     for each in parts]
        pending = np.concatenate(parts, axis=1)
        if not self._origin.size and pending.size:
            first = np.nan_to_num(pending[1:7, 0])
            self._origin = np.pad(first, (0, 6 - len(first)))
        while self._period >= 0.0 or pending.shape[1] > (1 if last else _LEARN):
            if self._period < 0.0:  # of a new segment, it is not known yet
                steps = np.diff(pending[0, :_LEARN + 1])
                median = float(np.median(steps))
                self._period = median if median > 0.0 else max(float(np.mean(steps)), 0.0)
                self._length = max(self._shortest, 2.0 * self._period)  # two samples
                self._epoch = self._latest = float(pending[0, 0])
            time = self._before_break(pending[0])
            index = np.floor((time - self._epoch) / self._length)
            starts = np.append(0, np.flatnonzero(index[1:] != index[:-1]) + 1)
            if stop := int(starts[-1]):  # where the last chunk starts, which is not complete
                self._latest = float(time[stop - 1])
                yield Chunks(records=self._sum(pending[:, :stop], starts[:-1]), epoch=self._epoch,
                             origin=self._origin, length=self._length, period=self._period,
                             fresh=self.fresh)
                self.fresh = False
            if len(time) == pending.shape[1]:
                pending = pending[:, stop:]
                break
            pending = pending[:, len(time):]
            self.restart()
        self._pending = pending
        if pending.shape[1] > _PENDING_MAX and self._period >= 0.0:
            self.interruptions.append(Interruption(self._latest, 'stopped', 0.0))
            self.restart()

    def restart(self) -> None:
        """Start a new segment with the next sample."""
        self._pending = np.empty((4, 0))
        self._period = -1.0  # not known yet
        self.fresh = True

    def _sum(self, samples: Floats, starts: Indices) -> Records:
        """
        Return the (m,) chunks of a `chunk_type` with the samples from each start to the next.

        `samples` are (k, n): time and reading (k = 4), with rate (7), with the columns of the
        context (more). Sums of a missing rate are NaN. A step is infinite unless it is smaller
        than all before. What `rule` adds is not known yet: no level, one window, and no limit.

        """
        found = np.zeros(len(starts), self._kind)
        found['begin'] = samples[0, starts]
        found['end'] = samples[0, np.append(starts[1:], samples.shape[1]) - 1]
        found['step'] = found['limit'] = np.inf
        sums = found['sums']
        sums['first'] = sums['second'] = sums['level'] = np.nan
        sums['windows'] = 1.0
        reading = samples[1:4]
        same = np.append(False, np.all(reading[:, 1:] == reading[:, :-1], axis=0))
        same[starts] = False
        sums['repeats'] = np.add.reduceat(same.astype(float), starts)
        sums['zeros'] = np.add.reduceat((~reading.any(axis=0)).astype(float), starts)
        sums['at_limit'], self._highest = repeated_extremes(reading, starts, self._highest)
        sums['count'] = np.diff(starts, append=samples.shape[1])
        sums['time'] = np.add.reduceat(samples[0] - self._epoch, starts)
        values = min(len(samples), MOTION) - 1
        centred = samples[1:1 + values] - self._origin[:values, np.newaxis]
        sums['first'][:, :values] = np.add.reduceat(centred, starts, axis=1).T
        np.multiply(centred, centred, out=centred)
        sums['second'][:, :values] = np.add.reduceat(centred, starts, axis=1).T
        around = samples[MOTION:]
        if len(around):
            known = np.isfinite(around)
            sums['context_count'] = np.add.reduceat(known.astype(float), starts, axis=1).T
            sums['context_sum'] = np.add.reduceat(np.where(known, around, 0.0), starts, axis=1).T
        for which, least in enumerate(self._least[:values // 3]):
            axes = samples[1 + 3 * which:4 + 3 * which]
            step = np.abs(axes[:, 1:] - axes[:, :-1])
            if np.count_nonzero(step < least) > np.count_nonzero(step == 0.0):
                step[~(step > 0.0)] = np.inf
                lowest = np.append(np.inf, step.min(axis=0))
                lowest[starts] = np.inf
                smallest = np.minimum.reduceat(lowest, starts)
                found['step'][:, which] = np.where(smallest < least, smallest, np.inf)
                self._least[which] = min(least, float(smallest.min()))
        return found

    def _before_break(self, time: Floats) -> Floats:
        """Return the stamps before the first interruption; one that steps back is the latest."""
        missing = max(_MISSING_SECONDS, _MISSING_PERIODS * self._period)
        step: Floats = time[1:] - time[:-1]
        first = time[0] - self._latest
        if step.min(initial=first) >= 0.0 and step.max(initial=first) <= missing:
            return time
        ordered = np.maximum.accumulate(np.append(self._latest, time))
        step = time - ordered[:-1]
        back = max(_BACK_SECONDS, _BACK_PERIODS * self._period)
        breaks = np.flatnonzero((step > missing) | (step < -back))
        if not len(breaks):
            return ordered[1:]
        cut = int(breaks[0])
        self.interruptions.append(Interruption(
            float(ordered[cut]), 'gap' if step[cut] > 0.0 else 'jump_back', float(step[cut])))
        return ordered[1:cut + 1]
