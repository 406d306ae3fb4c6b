# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The stillness detector of one sensor, and from recordings to poses.

**Repeated poses.** Two poses whose readings have the distance c differ in direction by
2 asin(c/2r), where r is the reading of 1 g. Offsets cancel in the difference. In native units r is
half the largest range of the readings over the axes. Until the sensor has been turned over, this r
is too small and the angle too large. Then too few poses count as repeated, not too many.

**Merging.** The mean of two readings on a sphere lies inside the sphere: for weights w and 1 - w,
the inverse variances, by w (1 - w) c²/2r², which is 1.25 mg for 0.1 rad. If 1 g is known, the mean
is moved outwards by this distance.

"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .chunks import (
    CaptureSettings, chained, Chunker, Chunks, CHUNKS_PER_WINDOW, Interruption, MOTION, Records)
from .dwell import Dwell, figures, judged, MISSING, OngoingDwell, Rest, Tracker
from .rule import Known, Rule
from .sensor import Lengths
from ..errors import InputError
from ..table import ABOUT, CONTEXT, Floats, numbered, Poses, Recording
from ..units import Units

_SAME_TEMPERATURE = 120.0
"""Longest time to a rest with a temperature, by which a missing one is interpolated [s]."""

_BLOCK = 1 << 14     # samples summed at a time; they fit in the cache
_AT_ONCE = 1 << 17   # samples passed to the detector at a time
_BESIDE = 100        # earlier dwells together with which a new one is judged


class StillDetector:
    """
    Find the dwells of one sensor, in blocks of samples of any size.

    `keep` is the number of finished dwells to keep; None: all. `context` are the keys of the
    further columns of the samples: temperature, supply voltage, and quantities. `still` is whether
    the sensor is still now. `refused` are the rests that ended in the last `push` or `close`, and
    are no poses, and `missing` the most recent times at which samples are missing, at most 10,000.
    `known` is what another detector of these samples found, and `rule` has what this one learned.

    """

    def __init__(self, settings: CaptureSettings, units: Units, keep: int | None = 1000,
                 context: Sequence[str] = CONTEXT, known: Known = Known()) -> None:
        self._context = context
        self._chunker = Chunker(settings, len(context))
        self.rule = Rule(settings, units, known)
        self._tracker = Tracker(settings, self.rule)
        self._most = keep
        self._kept: Records = np.empty(0)  # the figures of finished dwells
        self.still = False
        self._least, self._largest = np.full(4, np.inf), np.full(4, -np.inf)  # x, y, z, |reading|²
        self.refused: tuple[Rest, ...] = ()
        self._mean = np.full(6, np.nan)
        self.missing: deque[Rest] = deque(maxlen=10_000)

    def push(self, samples: Floats) -> list[Dwell]:
        """
        Add samples, and return the dwells that ended and are still.

        Parameters
        ----------
        samples : (n, 7 + k) array
            Columns time, reading (3), rate (3), and the k of the context. Times and readings must
            be finite; NaN marks other missing values.

        """
        known = np.any(~np.isnan(samples), axis=0)
        rows = len(known) if known[MOTION:].any() else MOTION if known[4:MOTION].any() else 4
        found = self._ended(self._feed([np.ascontiguousarray(samples[:, :rows].T)], last=False))
        self.rule.least = self.rule.levels.least
        return found

    def add_recording(self, recording: Recording) -> None:
        """Add the samples of a recording; raise InputError if one is not finite."""
        for start in range(0, len(recording), _AT_ONCE):
            stop = min(start + _AT_ONCE, len(recording))
            self._keep(self._feed((
                samples_of(recording, begin, min(begin + _BLOCK, stop), self._context)
                for begin in range(start, stop, _BLOCK)), last=False))

    def close(self) -> list[Dwell]:
        """End the ongoing dwell, because the stream is interrupted; return it if it is still."""
        found = [*self._feed([np.empty((4, 0))], last=True), *self._tracker.close()]
        self._chunker.restart()
        self.still = False
        return self._ended(found)

    def ongoing(self) -> OngoingDwell | None:
        """Return the ongoing dwell as if it ended now, not yet judged; None: it is too short."""
        return self._tracker.current()

    def current(self, ongoing: OngoingDwell | None = None) -> Dwell | None:
        """Return the `ongoing` dwell so far, or None if it is too short or not still."""
        dwell = ongoing or self.ongoing()
        if dwell is None:
            return None
        now = figures(dwell, known_units=self.rule.known)
        found, = judged(chained(self._kept[-_BESIDE:], now), self.rule, self._context)[-1:]
        return None if found.reason else found

    def dwells(self) -> list[Dwell]:
        """Return the kept dwells that are still according to the noise known now."""
        return [each for each in self.judged() if not each.reason]

    def judged(self) -> list[Dwell]:
        """Return the kept dwells with the reason why they are no poses with the noise now."""
        return judged(self._kept, self.rule, self._context) if len(self._kept) else []

    @property
    def lengths(self) -> Lengths:
        """Return the range of |reading| and that of the axis with the largest one."""
        shortest, longest = np.sqrt([self._least[3], max(self._largest[3], 0.0)]).tolist()
        return Lengths(shortest, longest, float(np.max(self._largest[:3] - self._least[:3])))

    @property
    def threshold(self) -> float:
        """
        Return the largest standard deviation of a still window now [unit of the readings].

        It is infinite before the first samples of a sensor in native units.

        """
        mean = np.nan_to_num(self._mean)[:, np.newaxis]
        limit = self.rule.limit_of(self.rule.noise_of(mean))
        return float(np.sqrt(np.max(limit[:3])))

    @property
    def interruptions(self) -> tuple[Interruption, ...]:
        """Return the most recent interruptions of the stamps, at most 10,000."""
        return tuple(self._chunker.interruptions)

    def _feed(self, blocks: Iterable[Floats], last: bool) -> Iterator[OngoingDwell]:
        """Yield the dwells that end with these samples."""
        whole = list[Chunks]()
        for block in blocks:
            whole += self._chunker.feed(block, last)
            x, y, z = reading = block[1:4]
            square = x * x + y * y + z * z
            if not np.all(square):  # zeros are missing samples
                reading, square = reading[:, square > 0.0], square[square > 0.0]
            if len(square):
                self._least = np.minimum(self._least, np.append(reading.min(axis=1), square.min()))
                self._largest = np.maximum(
                    self._largest, np.append(reading.max(axis=1), square.max()))
        starts = [k for k, each in enumerate(whole) if each.fresh or k == 0]
        for start, stop in pairwise([*starts, len(whole)]):  # the chunks of one segment
            chunks = replace(whole[start],
                             records=chained(*(each.records for each in whole[start:stop])))
            if chunks.fresh:
                yield from self._tracker.close()
                self._tracker.start(chunks)
            verdict = self.rule.feed(chunks)
            self._miss(verdict, chunks.length)
            yield from self._tracker.feed(verdict)
            self.still = bool(verdict['still'][-1])
            self._mean = chunks.origin
        if self._chunker.fresh:  # the stamps were interrupted: what is known of the rest is over
            self.still = False
            yield from self._tracker.close()

    def _keep(self, ended: Iterable[OngoingDwell]) -> int:
        """Store the figures of these dwells, and return their number."""
        found = list(ended)
        self.refused = tuple(Rest(each.begin, each.end, 'short') for each in found if each.short)
        if self._most is not None:  # only the account of a recording has the short ones
            found = [each for each in found if not each.short]
        every = chained(self._kept, *(
            figures(each, known_units=self.rule.known) for each in found))
        self._kept = every if self._most is None else every[-self._most:]
        return len(found)

    def _ended(self, found: Iterable[OngoingDwell]) -> list[Dwell]:
        """Store these dwells; return those that are still, tested together with earlier ones."""
        count = min(self._keep(found), len(self._kept))
        if not count:
            return []
        every = judged(self._kept[-count - _BESIDE:], self.rule, self._context)[-count:]
        self.refused += tuple(each.rest for each in every if each.reason)
        return [each for each in every if not each.reason]

    def _miss(self, verdict: Records, length: float) -> None:
        """Note the chunks of zeros, and the windows in which samples are missing otherwise."""
        for each in verdict[verdict['missing'] > 0]:
            kind, begin = MISSING[each['missing']], float(each['begin'])
            if kind != 'zeros':
                begin -= (CHUNKS_PER_WINDOW - 1) * length
            elif not each['sums']['zeros']:
                continue
            last = self.missing[-1] if self.missing else None
            if last is not None and last.reason == kind and begin <= last.end + length:
                begin = self.missing.pop().start
            self.missing.append(Rest(begin, float(each['end']), kind))


@dataclass(frozen=True)
class Captured:
    """
    The result of a capture.

    `samples` and `recorded` are the numbers of samples in the poses, and in the recording.
    `threshold` is the standard deviation below which a window is still, at the end, and `quietest`
    that of the quietest window, each of the axis with the largest one [unit of the readings].
    `seconds` is the duration of the recording without interruptions [s]. `rests` is the account of
    every rest, in order of time, and `lengths` the ranges of the readings. `known` is what the
    samples show about the sensor: if one of its variances is not 0, and it was not given, the
    samples are to be captured again with it.

    """

    poses: Poses
    samples: int
    threshold: float
    seconds: float
    interruptions: tuple[Interruption, ...]
    recorded: int
    quietest: float
    rests: tuple[Rest, ...]
    lengths: Lengths
    known: Known


def capture(recording: Recording | Iterable[Recording], units: Units,
            settings: CaptureSettings = CaptureSettings(), known: Known = Known()) -> Captured:
    """
    Find the still poses of a recording, in order of time.

    Parameters
    ----------
    recording : Recording, or an iterable of them
        The samples, as a whole or in blocks. ``rate``, ``temperature``, ``supply_voltage`` and the
        quantities of the first block are used if present.
    units : Units
        Unit of the readings.
    settings : CaptureSettings
        Settings of the detector and of the poses.
    known : Known
        What an earlier capture of these samples found (`Captured.known`).

    Raises
    ------
    InputError
        If a time or a reading is not finite.

    """
    parts = iter([recording] if isinstance(recording, Recording) else recording)
    first = next(parts, None)
    context = CONTEXT if first is None else (*CONTEXT, *first.quantities)
    detector = StillDetector(settings, units, keep=None, context=context, known=known)
    times, recorded = list[float](), 0
    about: dict[str, Any] = {}
    for part in parts if first is None else chain((first,), parts):
        detector.add_recording(part)
        if len(part):
            times = [*times[:1], float(part['time'][0]), float(part['time'][-1])]
            recorded += len(part)
            about = {name: getattr(part, name) for name in ABOUT}
    detector.close()
    every = detector.judged()
    dwells = select([each for each in every if not each.reason], settings, units)
    taken = {each.start for each in dwells}
    rests = [each.rest if each.reason or each.start in taken else each.rest._replace(
        reason='repeated') for each in every]
    interruptions = detector.interruptions
    seconds = times[-1] - times[0] if times else 0.0
    return Captured(
        poses=replace(poses_from(dwells, settings), **about),
        samples=sum(each.samples for each in dwells), threshold=detector.threshold,
        seconds=seconds - sum(each.seconds for each in interruptions),
        interruptions=interruptions, recorded=recorded, quietest=math.sqrt(detector.rule.quietest),
        rests=tuple(sorted((*rests, *detector.missing))), lengths=detector.lengths,
        known=Known(detector.rule.levels.least, detector.rule.repeats))


def samples_of(recording: Recording, start: int, stop: int, context: Sequence[str] = CONTEXT
               ) -> Floats:
    """
    Return samples start to stop as (k, n), one row per column of `StillDetector.push`.

    InputError if a time or a reading is not finite.

    """
    which = slice(start, stop)
    time = recording['time'][which]
    width = MOTION if 'rate' in recording else 4
    if any(name in recording for name in context):
        width = MOTION + len(context)
    samples = np.full((width, len(time)), np.nan)
    samples[0] = time
    samples[1:4] = recording.reading[which].T
    if 'rate' in recording:
        samples[4:7] = recording['rate'][which].T
    for row, name in enumerate(context, start=MOTION):
        if name in recording:
            samples[row] = recording[name][which]
    check_finite(samples[:4], recording.row[which])
    return samples


def check_finite(given: Floats, row: NDArray[np.int64]) -> None:
    """Raise InputError if a time or a reading, (k, n), is not finite."""
    bad = np.flatnonzero(~np.isfinite(given).all(axis=0))
    if len(bad):
        raise InputError(f'row {row[bad[0]]} holds a time or reading that is not finite, expected '
                         'finite numbers', 'remove that row, or repair the recording')


def poses_from(dwells: Sequence[Dwell], settings: CaptureSettings = CaptureSettings(), *,
               partial: bool = False) -> Poses:
    """
    Return the pose table of these dwells.

    It has the columns that all dwells have, ``orientation`` if ``max_dwell`` is finite, and
    ``doubtful`` and ``at_limit`` if a dwell is. `partial`: it also has the numbers beside them
    that some dwells have, with NaN for the others.

    """
    def of(name: str) -> Floats:
        return np.array([getattr(each, name) for each in dwells], dtype=float)

    columns: dict[str, NDArray[Any]] = {
        'time': of('time'), 'reading': of('mean').reshape(-1, 3), 'std': of('std').reshape(-1, 3),
        'count': of('count')}
    for name in dict.fromkeys(name for each in dwells for name in each.context):
        if all(name in each.context for each in dwells) or (partial and name != 'rate'):
            columns[name] = np.array([each.context.get(name, np.nan) for each in dwells])
    if 'rate' in columns and np.isfinite(of('rate_std')).all():
        columns['rate_std'] = of('rate_std')
    if np.isfinite(settings.max_dwell):
        columns['orientation'] = of('orientation').astype(np.int64)
    for name in ('doubtful', 'at_limit'):
        if any(getattr(each, name) for each in dwells):
            columns[name] = of(name)
    return Poses(columns, numbered(columns))


def dwells_of(poses: Poses) -> list[Dwell]:
    """Return the dwells of the rows of a pose table, each with an orientation of its own."""
    dwells, unknown = [], np.full(3, np.nan)
    for k in range(len(poses)):
        row = {key: poses[key][k] for key in poses.columns}
        time, count = float(row.get('time', 0.0)), float(row.get('count', 1.0))
        dwells.append(Dwell(
            start=time, end=time, time=time, mean=row['reading'],
            std=row.get('std', np.zeros(3)), count=count, samples=max(1, round(count)),
            context={key: row[key] for key in (*CONTEXT, 'rate', *poses.quantities)
                     if key in row and np.all(np.isfinite(row[key]))},
            orientation=-1 - k, doubtful=bool(row.get('doubtful', False)),
            rate_std=row.get('rate_std', unknown), at_limit=bool(row.get('at_limit', False))))
    return dwells


def select(dwells: Sequence[Dwell], settings: CaptureSettings, units: Units) -> list[Dwell]:
    """Keep, merge or refuse repeated dwells, as set; doubtful dwells are kept."""
    if settings.repeated == 'keep':
        return list(dwells)
    radius, kept = units.per_g, list[Dwell]()
    if units.is_native and dwells:
        radius = 0.5 * float(np.ptp([each.mean for each in dwells], axis=0).max())
    reach = 2.0 * radius * np.sin(0.5 * settings.min_pose_angle)
    for dwell in dwells:
        far = [float(np.linalg.norm(dwell.mean - each.mean))
               if each.orientation != dwell.orientation and not each.doubtful else np.inf
               for each in kept]
        if dwell.doubtful or min(far, default=np.inf) >= reach:
            kept.append(dwell)
        elif settings.repeated == 'merge':
            near = int(np.argmin(far))
            kept[near] = merged(kept[near], dwell, units)
    return kept


def merged(first: Dwell, second: Dwell, units: Units) -> Dwell:
    """Return the mean of two dwells in nearly one direction, with the orientation of the first."""
    samples = first.samples + second.samples
    share = first.samples / samples
    one, two = (float(np.sum(each.std**2)) / each.count for each in (first, second))
    weight = two / (one + two) if one + two > 0.0 else share
    mean = weight * first.mean + (1.0 - weight) * second.mean
    if not units.is_native:
        chord = float(np.linalg.norm(first.mean - second.mean)) / units.per_g
        mean = mean * (1.0 + 0.5 * weight * (1.0 - weight) * chord**2)
    noise = np.sqrt(weight**2 * first.std**2 / first.count
                    + (1.0 - weight)**2 * second.std**2 / second.count)
    count = first.count + second.count
    rate_std = np.sqrt(share * first.rate_std**2 + (1.0 - share) * second.rate_std**2)
    context = {name: share * first.context[name] + (1.0 - share) * second.context[name]
               for name in first.context if name in second.context}
    return replace(first, end=second.end, mean=mean, std=noise * np.sqrt(count), count=count,
                   time=share * first.time + (1.0 - share) * second.time,
                   samples=samples, context=context, rate_std=rate_std)


def rest_after(part: Dwell, whole: Dwell) -> Dwell:
    """Return the remainder of a rest after a part of it, with the noise of the part."""
    samples = whole.samples - part.samples
    share = samples / whole.samples

    def mean(before: Any, all_of_it: Any) -> Any:
        return (all_of_it - (1.0 - share) * before) / share

    context = {key: mean(part.context.get(key, value), value)
               for key, value in whole.context.items()}
    return replace(whole, start=part.end, time=mean(part.time, whole.time), samples=samples,
                   mean=mean(part.mean, whole.mean), context=context, std=part.std,
                   count=part.count / part.samples * samples)


def with_temperature(dwells: list[Dwell]) -> list[Dwell]:
    """Return dwells with missing temperatures interpolated; tables need all."""
    known = sorted((dwell.time, float(np.asarray(dwell.context['temperature'])))
                   for dwell in dwells if 'temperature' in dwell.context)
    times, warm = np.reshape(known, (-1, 2)).T
    return [replace(each, context={
        **each.context, 'temperature': float(np.interp(each.time, times, warm))})
        if 'temperature' not in each.context and np.any(
            np.abs(times - each.time) <= _SAME_TEMPERATURE) else each for each in dwells]


def overlap(one: Dwell | Rest, other: Dwell) -> bool:
    """Return whether two dwells overlap in time; they are then the same rest."""
    return one.start <= other.end and other.start <= one.end
