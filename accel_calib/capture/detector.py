# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The stillness detector of one sensor: it joins still chunks to dwells.

The window of a chunk is tested at once, and again after `HORIZON` more chunks, when the noise is
better known. Only then does the chunk join the dwell. A dwell that began before the noise was
known therefore starts where the sensor came to rest, and a slope or an oscillation excludes all
its chunks. A window that is not still ends the dwell at once; the waiting chunks are then decided
with the noise known so far.

Next to a significant slope, the slope may continue below significance. There a weaker slope is
enough to reject the dwell.

All chunks of a still window belong to the dwell. The first and the last chunk of a dwell are
trimmed. If the sensor is still again after a knock, in the same orientation, the dwell continues.
A dwell is therefore returned `KNOCK` chunks after its end.

"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import copy
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .chunks import (
    CaptureSettings, chained, Chunker, CHUNKS_PER_WINDOW, CONTEXT, Interruption, MOTION, Records,
    sums_type, together)
from .dwell import Dwell, dwell_type, figures, figures_type, judged, OngoingDwell
from .rule import HORIZON, Judged, Rule
from ..table import Floats
from ..units import Units

_SAMPLES = 16
"""Smallest number of samples in a dwell."""

KNOCK = CHUNKS_PER_WINDOW + 3
"""Largest number of disturbed windows within a dwell: a knock of about 4 chunks."""

_LEAD = CHUNKS_PER_WINDOW - 2
"""Chunks before the first still window that belong to the dwell."""


def _judged_type(sums: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of a chunk with its verdict; see `rule.Judged`."""
    return np.dtype([
        ('sums', dwell_type(sums)), ('begin', float), ('end', float), ('limit', float, 6),
        ('still', bool), ('trending', np.intp)])


_NONE = np.empty(0, _judged_type(sums_type(0)))
"""No chunks, of any type."""


class Tracker:
    """Join still chunks to dwells, in one segment."""

    def __init__(self, settings: CaptureSettings, rule: Rule, judged: Judged, number: int
                 ) -> None:
        chunks = judged.chunks
        self._rule = rule
        self._chunks = chunks
        shortest = max(settings.min_dwell, _SAMPLES * chunks.period)
        self._shortest = math.ceil(shortest / chunks.length - 1e-9)
        longest = settings.max_dwell / chunks.length
        self._longest = max(int(longest), self._shortest) if math.isfinite(longest) else 0
        self._waiting = self._lead = self._held = _NONE
        self._dwell: OngoingDwell | None = None
        self._pause = 0
        self._beside_slope = False
        self.number = number

    def feed(self, judged: Judged) -> list[OngoingDwell]:
        """Return the dwells that end with these chunks."""
        self._waiting = chained(self._waiting, _records(judged))
        return self._decide(last=False)

    def close(self) -> list[OngoingDwell]:
        """End the ongoing dwell because no chunk follows, and return all dwells that end."""
        done = self._decide(last=True)
        return done + self._end()

    def current(self) -> OngoingDwell | None:
        """Return the ongoing dwell as if it ended now, or None if it is too short."""
        if not len(self._waiting) or not self._waiting['still'][-1]:
            return None
        twin = copy.copy(self)
        twin._dwell = copy.copy(self._dwell)
        ended = twin._decide(last=True)
        del ended
        return twin._finished()

    def _decide(self, last: bool) -> list[OngoingDwell]:
        waiting = self._waiting
        verdict = _verdict(waiting, last)
        done: list[OngoingDwell] = []
        edges = np.flatnonzero(np.diff(verdict)) + 1
        for start, stop in zip([0, *edges], [*edges, len(verdict)]):
            if stop > start:
                part = waiting[start:stop]
                done += self._extend(part) if verdict[start] else self._skip(part)
        self._waiting = waiting[len(verdict):]
        return done

    def _skip(self, chunks: Records) -> list[OngoingDwell]:
        self._pause += len(chunks)
        self._lead = _tail(chained(self._lead, _tail(chunks, _LEAD)), _LEAD)
        self._held = _NONE
        sloping = bool((chunks['trending'] > 0).any())
        self._beside_slope |= sloping
        done = self._end() if self._pause > KNOCK or sloping else []
        self._beside_slope = sloping or (self._beside_slope and self._dwell is not None)
        return done

    def _extend(self, chunks: Records) -> list[OngoingDwell]:
        done: list[OngoingDwell] = []
        before = self._held
        if self._pause or self._dwell is None:
            before = _without_windows(self._lead)
            if self._dwell is None or not self._continues(chained(before, chunks[:1])):
                done = self._end()
                self._dwell = OngoingDwell(self._chunks, self.number)
            self._pause = 0
        chunks = chained(before, chunks)
        self._lead = _NONE
        self._held = _tail(chunks, 1)
        return done + self._add(chunks[:-1])

    def _continues(self, first: Records) -> bool:
        return (self._dwell is not None and self._dwell.chunks > 0
                and self._dwell.continued_by(first['sums'], self._rule.scale))

    def _add(self, chunks: Records) -> list[OngoingDwell]:
        assert self._dwell is not None
        done: list[OngoingDwell] = []
        while self._longest and self._dwell.chunks + len(chunks) >= self._longest:
            room = self._longest - self._dwell.chunks
            self._append(chunks[:room])
            done.append(self._dwell)
            self._dwell = OngoingDwell(self._chunks, self.number)
            chunks = chunks[room:]
        self._append(chunks)
        return done

    def _append(self, chunks: Records) -> None:
        assert self._dwell is not None
        self._dwell.add(chunks['sums'].copy(), chunks['begin'], chunks['end'])

    def _end(self) -> list[OngoingDwell]:
        found = self._finished()
        if self._dwell is not None:
            self.number += 1
        self._dwell = None
        self._held = _NONE
        return [] if found is None else [found]

    def _finished(self) -> OngoingDwell | None:
        if self._dwell is None or self._dwell.chunks < self._shortest:
            return None
        self._dwell.beside_slope = self._beside_slope
        return self._dwell


def _records(judged: Judged) -> Records:
    chunks = judged.chunks
    found = np.empty(len(judged.still), _judged_type(chunks.sums.dtype))
    for name in chunks.sums.dtype.names or ():
        found['sums'][name] = chunks.sums[name]
    found['sums']['level'], found['sums']['windows'] = judged.level.T, 1.0
    found['begin'], found['end'] = chunks.begin, chunks.end
    found['limit'], found['still'] = judged.limit.T, judged.still
    found['trending'] = judged.trending
    return found


def _tail(chunks: Records, size: int) -> Records:
    return chunks[max(len(chunks) - size, 0):]


def _without_windows(chunks: Records) -> Records:
    found = chunks.copy()
    found['sums']['level'] = found['sums']['windows'] = 0.0
    return found


def _verdict(chunks: Records, last: bool) -> NDArray[np.bool_]:
    """Return the final verdict on the first chunks, as many as can be decided now."""
    size, still = len(chunks), chunks['still']
    index = np.arange(size)
    nearest = np.where(still, 2 * size + HORIZON, index)
    ended = np.minimum.accumulate(nearest[::-1])[::-1]
    due = np.minimum(index + HORIZON, ended)
    if last:
        due = np.minimum(due, size - 1)
    count = int(np.searchsorted(due, size))
    due, ended = due[:count], ended[:count]
    over = np.any(chunks['sums']['level'][:count] > chunks['limit'][due], axis=1)
    slope = np.append(chunks['trending'], 0)[np.minimum(ended, size)]
    return np.asarray(still[:count] & ~over & ~(ended - index[:count] < slope))


_EARLIER = 100
"""Number of earlier dwells that are used in the test of a new dwell."""


class StillDetector:
    """
    Find the dwells of one sensor, block by block.

    The dwells do not depend on the division into blocks; a stream and a recording have the same
    dwells. `keep` is the number of finished dwells to keep; None: all. `context` are the keys of
    the further columns of the samples: temperature, supply voltage, and quantities.

    """

    def __init__(self, settings: CaptureSettings, units: Units, keep: int | None = 1000,
                 context: Sequence[str] = CONTEXT) -> None:
        self._settings, self._context = settings, context
        self._chunker = Chunker(settings, len(context))
        self._rule = Rule(settings, units)
        self._tracker: Tracker | None = None
        self._most = keep
        self._kept = np.empty(0, figures_type(len(context)))
        self._still = False
        self._mean = np.full(6, np.nan)
        self._number = 0

    def push(self, samples: Floats) -> list[Dwell]:
        """
        Add samples, and return the dwells that ended and are still.

        Parameters
        ----------
        samples : (n, 7 + k) array
            Columns time, reading (3), rate (3), and the k of the context. Times and readings must
            be finite; NaN marks other missing values.

        """
        return self._last(self.add([_columns(samples)]))

    def add(self, blocks: Iterable[Floats]) -> int:
        """
        Add samples as (k, n) arrays, and return how many dwells ended.

        The rows are the columns of `push`. Those of the context can be omitted, and those of the
        rate before them. `dwells` returns the still ones.

        """
        return self._keep(self._feed(blocks, last=False))

    def close(self) -> list[Dwell]:
        """End the ongoing dwell, because the stream is interrupted; return it if it is still."""
        count = self._keep(self._feed([np.empty((4, 0))], last=True) + self._leave())
        self._chunker.restart()
        return self._last(count)

    @property
    def still(self) -> bool:
        """Whether the sensor is still now."""
        return self._still

    def current(self) -> Dwell | None:
        """Return the ongoing dwell so far, or None if it is too short or not still."""
        dwell = None if self._tracker is None else self._tracker.current()
        if dwell is None:
            return None
        found = self._beside(figures([dwell], known_units=self._rule.known), self._kept)
        return found[0] if found else None

    def dwells(self) -> list[Dwell]:
        """Return the kept dwells that are still according to the noise known now."""
        return [each for each in self._judged() if each is not None]

    def doubtful(self) -> set[float]:
        """Return the starts of the kept dwells that are not still with the noise known now."""
        return {float(start) for start, each in zip(self._kept['begin'], self._judged())
                if each is None}

    @property
    def threshold(self) -> float:
        """
        Return the largest standard deviation of a still window now [unit of the readings].

        It is the largest over the axes, and infinite before the first samples of a sensor in
        native units.

        """
        mean = np.nan_to_num(self._mean)[:, np.newaxis]
        limit = self._rule.limit_of(self._rule.noise_of(mean))
        return float(np.sqrt(np.max(limit[:3])))

    @property
    def quietest(self) -> float:
        """Return the standard deviation in the quietest window [unit of the readings]."""
        return math.sqrt(self._rule.quietest)

    @property
    def interruptions(self) -> tuple[Interruption, ...]:
        """Return the most recent interruptions of the stamps, at most 10,000."""
        return tuple(self._chunker.interruptions)

    def _feed(self, blocks: Iterable[Floats], last: bool) -> list[OngoingDwell]:
        found: list[OngoingDwell] = []
        whole = [chunks for block in blocks for chunks in self._chunker.feed(block, last)]
        for chunks in together(whole):
            if chunks.fresh:
                found += self._leave()
            verdict = self._rule.feed(chunks)
            if self._tracker is None:
                self._tracker = Tracker(self._settings, self._rule, verdict, self._number)
            found += self._tracker.feed(verdict)
            self._still = bool(verdict.still[-1])
            self._mean = chunks.origin
        if self._chunker.fresh:  # the stamps were interrupted: what is known of the rest is over
            found += self._leave()
        return found

    def _leave(self) -> list[OngoingDwell]:
        if self._tracker is None:
            return []
        found = self._tracker.close()
        self._number = self._tracker.number
        self._tracker = None
        self._still = False
        return found

    def _keep(self, found: list[OngoingDwell]) -> int:
        """Store the figures of these dwells, and return their number."""
        if found:
            new = figures(found, known_units=self._rule.known)
            every = chained(self._kept, new)
            self._kept = every if self._most is None else every[-self._most:]
        return len(found)

    def _judged(self) -> list[Dwell | None]:
        return judged(self._kept, self._rule, self._context) if len(self._kept) else []

    def _last(self, count: int) -> list[Dwell]:
        """Return the last dwells that are still, tested together with earlier dwells."""
        if not count:
            return []
        count = min(count, len(self._kept))
        return self._beside(self._kept[-count:], self._kept[:-count])

    def _beside(self, found: Records, earlier: Records) -> list[Dwell]:
        earlier = earlier[-_EARLIER:]
        table = chained(earlier, found)
        return [each for each in judged(table, self._rule, self._context, len(earlier))
                if each is not None]


def _columns(samples: Floats) -> Floats:
    """Return (n, 7 + k) samples as rows, without missing columns at the end."""
    known: NDArray[np.bool_] = np.any(~np.isnan(samples), axis=0)
    rows = len(known) if known[MOTION:].any() else MOTION if known[4:MOTION].any() else 4
    return np.ascontiguousarray(samples[:, :rows].T)
