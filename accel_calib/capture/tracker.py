# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Dwells out of the chunks' verdicts.

A chunk's window is judged at once, and again when `HORIZON` more chunks have shown what the noise
is: only then does it join the dwell for good. So a dwell that began before the noise was known
begins where the sensor came to rest, and a slope takes all the chunks out that it was seen over.
A window that is not still ends the dwell at once, and what was waiting is judged by what is
known then.

A stretch next to a slope may be one where the slope went on but did not stand out; there a
weaker sign of it is enough to refuse the dwell.

A still window vouches for all its chunks. The first and the last chunk of a dwell are trimmed.
When the sensor is still again after a knock, in the same orientation as before, the dwell goes
on; so a dwell is given once `KNOCK` chunks have passed since its end.

"""

from __future__ import annotations

import copy
import math

import numpy as np
from numpy.typing import NDArray

from .dwell import Candidate
from .rule import HORIZON, Judged, Rule
from .run import DWELL_ROW, LEVEL, Run, WINDOWS
from .settings import CaptureSettings
from .sums import CHUNKS_PER_WINDOW
from ..table import Floats

_SAMPLES = 16   # of a dwell, at least
KNOCK = CHUNKS_PER_WINDOW + 3
"""Windows that may be disturbed within a dwell: a knock of some 4 chunks."""

_LEAD = CHUNKS_PER_WINDOW - 2   # chunks before the first still window that belong to the dwell


class Tracker:
    """Join still chunks to dwells, for one segment."""

    def __init__(self, settings: CaptureSettings, rule: Rule, judged: Judged, number: int
                 ) -> None:
        chunks = judged.chunks
        self._rule = rule
        self._chunks = chunks
        shortest = max(settings.min_dwell, _SAMPLES * chunks.period)
        self._shortest = math.ceil(shortest / chunks.length - 1e-9)
        longest = settings.max_dwell / chunks.length
        self._longest = max(int(longest), self._shortest) if math.isfinite(longest) else 0
        self._waiting = _Rows.none()
        self._lead = _Rows.none()
        self._held = _Rows.none()
        self._run: Run | None = None
        self._pause = 0
        self._beside_slope = False
        self.number = number

    def feed(self, judged: Judged) -> list[Candidate]:
        """Give the dwells that end with these chunks."""
        self._waiting = self._waiting.then(_Rows.of(judged))
        return self._decide(last=False)

    def close(self) -> list[Candidate]:
        """Give the dwell that ends because no chunk follows."""
        done = self._decide(last=True)
        done += self._end()
        return done

    def current(self) -> Candidate | None:
        """Give the running dwell as it would be if it ended now."""
        if not len(self._waiting.still) or not self._waiting.still[-1]:
            return None
        twin = copy.copy(self)
        twin._run = copy.copy(self._run)
        ended = twin._decide(last=True)
        del ended
        return twin._finished()

    def _decide(self, last: bool) -> list[Candidate]:
        rows = self._waiting
        verdict = rows.verdict(last)
        done: list[Candidate] = []
        edges = np.flatnonzero(np.diff(verdict)) + 1
        for start, stop in zip([0, *edges], [*edges, len(verdict)]):
            if stop > start:
                part = rows.part(start, stop)
                done += self._extend(part) if verdict[start] else self._skip(part)
        self._waiting = rows.part(len(verdict), len(rows.still))
        return done

    def _skip(self, rows: _Rows) -> list[Candidate]:
        self._pause += len(rows.still)
        self._lead = self._lead.then(rows).tail(_LEAD)
        self._held = _Rows.none()
        sloping = bool(np.any(rows.trending))
        self._beside_slope |= sloping
        done = self._end() if self._pause > KNOCK or sloping else []
        self._beside_slope = sloping or (self._beside_slope and self._run is not None)
        return done

    def _extend(self, rows: _Rows) -> list[Candidate]:
        done: list[Candidate] = []
        if self._pause or self._run is None:
            first = self._lead.without_windows().then(rows.part(0, 1))
            if self._run is None or not self._goes_on(first):
                done = self._end()
                self._run = Run(self._chunks, self.number)
            rows = first.then(rows.part(1, len(rows.still)))
            self._pause = 0
        rows = self._held.then(rows)
        self._lead = _Rows.none()
        self._held = rows.tail(1)
        return done + self._add(rows.part(0, len(rows.still) - 1))

    def _goes_on(self, first: _Rows) -> bool:
        return (self._run is not None and self._run.chunks > 0
                and self._run.continued_by(first.sums, self._rule.scale))

    def _add(self, rows: _Rows) -> list[Candidate]:
        assert self._run is not None
        done: list[Candidate] = []
        while self._longest and self._run.chunks + len(rows.still) >= self._longest:
            room = self._longest - self._run.chunks
            self._run.add(rows.sums[:room], rows.begin[:room], rows.end[:room])
            done.append(self._run.candidate())
            self._run = Run(self._chunks, self.number)
            rows = rows.part(room, len(rows.still))
        self._run.add(rows.sums, rows.begin, rows.end)
        return done

    def _end(self) -> list[Candidate]:
        found = self._finished()
        if self._run is not None:
            self.number += 1
        self._run = None
        self._held = _Rows.none()
        return [] if found is None else [found]

    def _finished(self) -> Candidate | None:
        if self._run is None or self._run.chunks < self._shortest:
            return None
        return self._run.candidate(self._beside_slope)


class _Rows:
    """Judged chunks, with the windows' variance among the sums."""

    def __init__(self, sums: Floats, begin: Floats, end: Floats, limit: Floats,
                 still: NDArray[np.bool_], trending: NDArray[np.intp]) -> None:
        self.sums = sums
        self.begin = begin
        self.end = end
        self.limit = limit
        self.still = still
        self.trending = trending

    @classmethod
    def none(cls) -> _Rows:
        """Give no rows."""
        empty = np.empty(0, dtype=bool)
        return cls(np.empty((0, DWELL_ROW)), np.empty(0), np.empty(0), np.empty((0, 6)),
                   empty, np.empty(0, dtype=np.intp))

    @classmethod
    def of(cls, judged: Judged) -> _Rows:
        """Give the rows of judged chunks."""
        chunks = judged.chunks
        one = np.ones((len(chunks.sums), 1))
        return cls(np.hstack([chunks.sums, judged.level, one]), chunks.begin, chunks.end,
                   judged.limit, judged.still, judged.trending)

    def _each(self) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.bool_],
                             NDArray[np.intp]]:
        return self.sums, self.begin, self.end, self.limit, self.still, self.trending

    def part(self, start: int, stop: int) -> _Rows:
        """Give the rows from start to before stop."""
        sums, begin, end, limit, still, trending = self._each()
        which = slice(start, stop)
        return _Rows(sums[which], begin[which], end[which], limit[which], still[which],
                     trending[which])

    def tail(self, size: int) -> _Rows:
        """Give the last rows."""
        return self.part(max(len(self.still) - size, 0), len(self.still))

    def then(self, other: _Rows) -> _Rows:
        """Give these rows and the others after them."""
        return _Rows(*(np.concatenate(pair) for pair in zip(self._each(), other._each())))

    def without_windows(self) -> _Rows:
        """Give the rows with their windows left out of the sums."""
        sums = self.sums.copy()
        sums[:, LEVEL] = 0.0
        sums[:, WINDOWS] = 0.0
        return _Rows(sums, self.begin, self.end, self.limit, self.still, self.trending)

    def verdict(self, last: bool) -> NDArray[np.bool_]:
        """Give the final verdict on those of the first rows for which it is due."""
        size = len(self.still)
        index = np.arange(size)
        bad = np.flatnonzero(~self.still)
        place = np.searchsorted(bad, index)
        ended = np.append(bad, 2 * size + HORIZON)[place]
        due = np.minimum(index + HORIZON, ended)
        if last:
            due = np.minimum(due, size - 1)
        due = due[due < size]
        count = len(due)
        level = self.sums[:count, LEVEL]
        verdict = self.still[:count] & ~np.any(level > self.limit[due], axis=1)
        over = np.append(self.trending, 0)[np.minimum(ended[:count], size)]
        return np.asarray(verdict & ~(ended[:count] - index[:count] < over))
