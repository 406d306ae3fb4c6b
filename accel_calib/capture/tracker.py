# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

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

from .rule import HORIZON, Judged, Rule
from .run import DWELL_ROW, LEVEL, Run, WINDOWS
from .settings import CaptureSettings
from .sums import CHUNKS_PER_WINDOW
from ..table import Floats

_SAMPLES = 16   # of a dwell, at least
KNOCK = CHUNKS_PER_WINDOW + 3
"""Windows that may be disturbed within a dwell: a knock of some 4 chunks."""

_LEAD = CHUNKS_PER_WINDOW - 2   # chunks before the first still window that belong to the dwell


# Rows of a table of judged chunks, after those of a dwell.
_BEGIN = DWELL_ROW
_END = _BEGIN + 1
_LIMIT = slice(_END + 1, _END + 7)
_STILL = _LIMIT.stop
_TRENDING = _STILL + 1


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
        self._waiting = _NO_ROWS
        self._lead = _NO_ROWS
        self._held = _NO_ROWS
        self._run: Run | None = None
        self._pause = 0
        self._beside_slope = False
        self.number = number

    def feed(self, judged: Judged) -> list[Run]:
        """Give the dwells that end with these chunks."""
        self._waiting = self._waiting.then(_Rows.of(judged))
        return self._decide(last=False)

    def close(self) -> list[Run]:
        """Give the dwell that ends because no chunk follows."""
        done = self._decide(last=True)
        done += self._end()
        return done

    def current(self) -> Run | None:
        """Give the running dwell as it would be if it ended now."""
        if not len(self._waiting) or not self._waiting.still[-1]:
            return None
        twin = copy.copy(self)
        twin._run = copy.copy(self._run)
        ended = twin._decide(last=True)
        del ended
        return twin._finished()

    def _decide(self, last: bool) -> list[Run]:
        rows = self._waiting
        verdict = rows.verdict(last)
        done: list[Run] = []
        edges = np.flatnonzero(np.diff(verdict)) + 1
        for start, stop in zip([0, *edges], [*edges, len(verdict)]):
            if stop > start:
                part = rows.part(start, stop)
                done += self._extend(part) if verdict[start] else self._skip(part)
        self._waiting = rows.part(len(verdict), len(rows))
        return done

    def _skip(self, rows: _Rows) -> list[Run]:
        self._pause += len(rows)
        self._lead = self._lead.then(rows.tail(_LEAD)).tail(_LEAD)
        self._held = _NO_ROWS
        sloping = rows.sloping
        self._beside_slope |= sloping
        done = self._end() if self._pause > KNOCK or sloping else []
        self._beside_slope = sloping or (self._beside_slope and self._run is not None)
        return done

    def _extend(self, rows: _Rows) -> list[Run]:
        done: list[Run] = []
        before = self._held
        if self._pause or self._run is None:
            before = self._lead.without_windows()
            if self._run is None or not self._goes_on(before.then(rows.part(0, 1))):
                done = self._end()
                self._run = Run(self._chunks, self.number)
            self._pause = 0
        rows = before.then(rows)
        self._lead = _NO_ROWS
        self._held = rows.tail(1)
        return done + self._add(rows.part(0, len(rows) - 1))

    def _goes_on(self, first: _Rows) -> bool:
        return (self._run is not None and self._run.chunks > 0
                and self._run.continued_by(first.sums, self._rule.scale))

    def _add(self, rows: _Rows) -> list[Run]:
        assert self._run is not None
        done: list[Run] = []
        while self._longest and self._run.chunks + len(rows) >= self._longest:
            room = self._longest - self._run.chunks
            self._append(rows.part(0, room))
            done.append(self._run)
            self._run = Run(self._chunks, self.number)
            rows = rows.part(room, len(rows))
        self._append(rows)
        return done

    def _append(self, rows: _Rows) -> None:
        assert self._run is not None
        self._run.add(rows.sums, rows.table[_BEGIN], rows.table[_END])

    def _end(self) -> list[Run]:
        found = self._finished()
        if self._run is not None:
            self.number += 1
        self._run = None
        self._held = _NO_ROWS
        return [] if found is None else [found]

    def _finished(self) -> Run | None:
        if self._run is None or self._run.chunks < self._shortest:
            return None
        self._run.beside_slope = self._beside_slope
        return self._run


class _Rows:
    """Judged chunks, one column each, the windows' variance among the sums."""

    def __init__(self, table: Floats) -> None:
        self.table = table

    @classmethod
    def of(cls, judged: Judged) -> _Rows:
        """Give the rows of judged chunks."""
        chunks = judged.chunks
        one = np.ones(len(judged.still))
        return cls(np.vstack([chunks.sums, judged.level, one, chunks.begin, chunks.end,
                              judged.limit, judged.still, judged.trending]))

    def __len__(self) -> int:
        return self.table.shape[1]

    @property
    def sums(self) -> Floats:
        """(DWELL_ROW, n) array."""
        return self.table[:DWELL_ROW]

    @property
    def still(self) -> NDArray[np.bool_]:
        """(n,) array."""
        return self.table[_STILL] > 0.0

    @property
    def sloping(self) -> bool:
        """Whether a slope was seen over any of them."""
        return bool((self.table[_TRENDING] > 0.0).any())

    def part(self, start: int, stop: int) -> _Rows:
        """Give the chunks from start to before stop."""
        return _Rows(self.table[:, start:stop])

    def tail(self, size: int) -> _Rows:
        """Give the last chunks."""
        return self.part(max(len(self) - size, 0), len(self))

    def then(self, other: _Rows) -> _Rows:
        """Give these chunks and the others after them."""
        if not self.table.size:
            return other
        return _Rows(np.concatenate([self.table, other.table], axis=1))

    def without_windows(self) -> _Rows:
        """Give the chunks with their windows left out of the sums."""
        table = self.table.copy()
        table[LEVEL.start:WINDOWS + 1] = 0.0
        return _Rows(table)

    def verdict(self, last: bool) -> NDArray[np.bool_]:
        """Give the final verdict on those of the first chunks for which it is due."""
        size, still = len(self), self.still
        index = np.arange(size)
        nearest = np.where(still, 2 * size + HORIZON, index)
        ended = np.minimum.accumulate(nearest[::-1])[::-1]
        due = np.minimum(index + HORIZON, ended)
        if last:
            due = np.minimum(due, size - 1)
        count = int(np.searchsorted(due, size))
        due, ended = due[:count], ended[:count]
        limit = self.table[_LIMIT]
        verdict = still[:count].copy()
        for level, most in zip(self.table[LEVEL], limit):
            verdict &= ~(level[:count] > most[due])
        over = np.append(self.table[_TRENDING], 0.0)[np.minimum(ended, size)]
        return np.asarray(verdict & ~(ended - index[:count] < over))


_NO_ROWS = _Rows(np.empty((_TRENDING + 1, 0)))
