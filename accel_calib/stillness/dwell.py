# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Dwells: still stretches, joined, averaged and tested.

**Joining.** The window of a chunk is tested at once, and again after `HORIZON` more chunks, when
the noise is better known. Only then does the chunk join the dwell. A dwell that began before the
noise was known therefore starts where the sensor came to rest, and a slope or an oscillation
excludes all its chunks. A window that is not still ends the dwell at once; the waiting chunks are
then decided with the noise known so far. Next to a significant slope, a weaker slope is enough to
reject the dwell, because the slope may continue below significance.

All chunks of a still window belong to the dwell, but its first and last chunk are trimmed. If the
sensor is still again after a knock, in the same orientation, the dwell continues. A dwell is
therefore returned `KNOCK` chunks after its end. The chunks of an ongoing dwell are combined into
at most `2 · CELLS` cells of 2ᵏ chunks, so that its memory is bounded.

**Mean.** Mean and standard deviation are those of all samples. The number of samples is divided by
the excess of the noise of the mean (see `trend`), so that std/√count is the noise of the mean
along the force. A short dwell is not enough to estimate the excess, which is a property of the
sensor. The median over all dwells is therefore used, unless a dwell has a clearly larger excess.
The noise is that along the mean reading if this is known to be the vertical: a sensor that settles
tilts slightly, which changes its reading across the vertical, and the fit uses only the noise
along the force.

Samples that are rounded to steps cause an error of the mean, which averaging does not remove if
their noise is less than a step. Its variance follows from the mean variance of the samples of each
axis over all dwells (see `rule`). One dwell without any variance is added to this mean, because a
few dwells that alternate between two steps look like more noise. The white noise of the rate is
the mean variance of the windows, which does not include slow drift.

**Tests.** The noise may become known after a dwell ended, so each query tests all dwells again. A
dwell is rejected in three cases:

- Its windows vary on average more than `DWELL_RATIO` times the noise of the sensor, significantly.
  This detects a tremor below the threshold of a single window.
- The reading has a slope through the dwell or through half of it.
- Its noise does not exclude a slow turn (see `rule.TURN_G`). A noisier sensor needs a longer
  dwell. Once five dwells determine the bias of the gyro, the gyro decides instead. It alone shows
  a turn at 0.3 °/s, or one that begins late in a dwell.

**Account.** Every rest of a recording became a pose, or has one of `REASONS` why not.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import copy
from dataclasses import dataclass, field
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .chunks import (
    CaptureSettings, chained, chunk_type, Chunks, CHUNKS_PER_WINDOW, Records, summed)
from .rule import (
    DWELL_SLOPE_G, HORIZON, RELATIVE, rounding_left, Rule, STRENGTH, SURE, TURN_G, WEAK_STRENGTH)
from .trend import excess_of_means, trend_of
from ..finding import Finding
from ..statistics import SIGMA_OF_MAD
from ..table import Floats
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


_FIGURES = [
    ('lowest', float, 6),     # lower confidence limit of the mean variance of the windows
    ('average', float, 6),    # mean variance of the windows
    ('mean', float, 6),       # reading and rate
    ('std', float, 3),        # of the samples
    ('slope', float, 3), ('strength', float), ('error', float),  # see `trend.Trend`
    ('begin', float), ('end', float), ('time', float),  # first, last and mean stamp [s]
    ('samples', float),
    ('excess', float),        # variance of the mean over that of independent samples
    ('along', float),         # the same along the mean reading, if that is the vertical
    ('beside_slope', bool),   # the reading has a slope directly before or after
    ('short', bool),          # shorter than `min_dwell`
    ('off', bool),            # the gyro does not vary in a window
    ('at_limit', float, 3),   # share of samples that repeat the extreme of an axis so far
    ('orientation', np.intp),
    ('part_slope', float, 3), ('part_strength', float, 3)]  # first, middle and last half
"""Means and variances in the unit of the readings, slopes per second."""


def figures(dwell: OngoingDwell, *, known_units: bool) -> Records:
    """Return the record of figures of a dwell; with known units its mean is nearly vertical."""
    total = dwell.total()[0]
    known = total['context_count']
    found = np.empty(1, np.dtype([*_FIGURES, ('around', float, known.shape)]))
    count = total['count']
    shift = total['first'] / count
    square = np.maximum(total['second'] - total['first'] * shift, 0.0)
    variance = square[:3] / max(count - 1.0, 1.0)
    level = total['level'] / max(total['windows'], 1.0)
    mean = shift + dwell.origin
    found['mean'], found['std'], found['average'] = mean, np.sqrt(variance), level
    for name in ('begin', 'end', 'orientation', 'beside_slope', 'short'):
        found[name] = getattr(dwell, name)
    found['time'] = dwell.epoch + total['time'] / count
    found['samples'], found['at_limit'] = count, total['at_limit'] / count
    found['off'] = total['off'] > 0.0
    found['around'] = np.where(known > 0.0, total['context_sum'], np.nan) / np.maximum(known, 1.0)

    cells, spacing = dwell.cells, dwell.size * dwell.length
    size, per_cell = len(cells), cells['count'].sum() / len(cells)
    centred = cells['first'][:, :3].T / cells['count']
    centred -= centred.sum(axis=1, keepdims=True) / size
    white = level[:3] / per_cell
    trend = trend_of(centred, size, spacing, white[:, np.newaxis])
    found['slope'], found['strength'], found['error'] = (
        trend.slope.T, trend.strength, trend.error)
    half = size // 2
    parts = np.stack([centred[:, start:start + half]
                      for start in (0, (size - half) // 2, size - half)], axis=1)
    parts -= parts.sum(axis=2, keepdims=True) / half
    trend = trend_of(parts, half, spacing, white[:, np.newaxis, np.newaxis])
    found['part_slope'], found['part_strength'] = (
        np.sqrt(np.sum(trend.slope ** 2, axis=0)).T, trend.strength.T)
    white = variance / per_cell
    excess = along = excess_of_means(centred, white)
    if known_units:
        up = mean[:3] / max(float(np.linalg.norm(mean[:3])), 1e-300)
        along = excess_of_means((up @ centred)[np.newaxis], np.sum(up ** 2 * white, keepdims=True))
    found['excess'], found['along'] = excess, along
    found['lowest'] = level * math.exp(-2.0 * math.sqrt((1.0 + max(excess, 1.0)) / count))
    return found


DWELL_RATIO = 3.2
"""Largest ratio of the mean variance of the windows of a dwell to the noise."""

DWELL_RATE_RATIO = 1600.0
"""The same for the rate: shaking that the accelerometer does not measure is harmless."""

PART_SLOPE_G = 5e-3
"""Largest slope through half of a dwell [g/s]."""

PART_STRENGTH = 20.0
"""This slope is significant if the sum of its squared scores is larger: p ≈ 2e-4."""

_AT_LIMIT, _QUIETER = 0.2, 0.25
"""Share of samples that repeat the extreme of an axis, and standard deviation relative to that of
other rests, above and below which a rest is at a limit."""

_STUCK = 1e-3
"""Range of an axis, relative to the largest reading, below which it is stuck."""

_OWN_EXCESS = 1.5   # factor of uncertainty of the excess of one dwell
_BIAS_DWELLS = 5    # fewest dwells that determine the bias of the gyro
_GYRO_RATE = np.radians(0.25)
"""Mean rate minus the bias that indicates turning [rad/s]."""
_SPREADS = 3.0      # standard deviations of the bias over the dwells that must be below this rate


@dataclass(frozen=True)
class Dwell:
    """
    An averaged still stretch.

    Parameters
    ----------
    start, end, time : float
        First, last and mean stamp of the averaged samples [s].
    mean, std : (3,) array
        Mean and standard deviation of the samples [unit of the readings].
    count : float
        Independent samples: std/√count is the noise of the mean.
    samples : int
        Number of samples averaged.
    context : mapping of str to float or (3,) array
        Means of ``temperature``, ``supply_voltage``, ``rate`` and quantities, if known.
    orientation : int
        Dwells with the same number are parts of one dwell (see ``max_dwell``).
    doubtful : bool
        Whether the sensor may have moved, according to later dwells.
    rate_std : (3,) array
        White noise of one sample of the angular rate [rad/s]; NaN without a rate.
    reason : str
        Why it is no pose, one of `REASONS`; empty for a pose.
    at_limit : bool
        Whether the samples of an axis end at the limit of the sensor.

    """

    start: float
    end: float
    time: float
    mean: Floats
    std: Floats
    count: float
    samples: int
    context: Mapping[str, float | Floats]
    orientation: int
    doubtful: bool = False
    rate_std: Floats = field(default_factory=lambda: np.full(3, np.nan))
    reason: str = ''
    at_limit: bool = False

    @property
    def rest(self) -> Rest:
        return Rest(self.start, self.end, self.reason)


def judged(table: Records, rule: Rule, context: Sequence[str]) -> list[Dwell]:
    """
    Return the dwells of a table of `figures`, with the reason why one is no pose, if so.

    They are tested with the noise known now. `context` names the columns of context.

    """
    means, std = table['mean'][:, :3], table['std']
    step, rate_step = np.where(np.isfinite(rule.steps), rule.steps, 0.0).tolist()
    tiny = RELATIVE * np.sqrt(np.sum(means.T**2, axis=0))
    quiet, excess, reason = _reasons(table, rule, tiny)
    turned = np.ptp(means, axis=0) > _STUCK * np.max(np.abs(means))  # else an axis is stuck
    usual = np.median(std, axis=0)
    ends = np.any((table['at_limit'] > _AT_LIMIT) & turned
                  & (std < _QUIETER * usual) & (usual > step), axis=1)
    # The noise of samples and means with rounding; see `rule`.
    level = table['average'][quiet, :3].sum(axis=0) / (1.0 + quiet.sum())
    left = step**2 * rounding_left(level / step**2) if step > 0.0 else np.zeros(3)
    rounded = np.maximum(std.T, np.maximum(step / math.sqrt(12.0), tiny))
    variance = (rounded**2 * excess / table['samples']
                + np.maximum(left[:, np.newaxis], 1e-2 * tiny**2))
    count = np.sum(rounded**2, axis=0) / np.sum(variance, axis=0)
    rate_std = np.maximum(np.sqrt(table['average'][:, 3:]), rate_step / math.sqrt(12.0))
    found = []
    for each, own, n, own_rate, why, at_limit in zip(
            table, rounded.T.copy(), count, rate_std, reason, ends, strict=True):
        around: dict[str, float | Floats] = {
            name: value for name, value in zip(context, each['around'].tolist(), strict=True)
            if math.isfinite(value)}
        mean = each['mean'].copy()
        if np.isfinite(mean).all():
            around['rate'] = mean[3:]
        found.append(Dwell(
            start=float(each['begin']), end=float(each['end']), time=float(each['time']),
            mean=mean[:3], std=own, count=float(n), samples=int(each['samples']), context=around,
            orientation=int(each['orientation']), rate_std=own_rate, reason=str(why),
            at_limit=bool(at_limit)))
    return found


def _reasons(table: Records, rule: Rule, tiny: Floats
             ) -> tuple[NDArray[np.bool_], Floats, NDArray[np.str_]]:
    """
    Return which dwells are quiet, the excess of their noise, and why they are no poses.

    `tiny` is the standard deviation of each below which it repeats one reading. The bias of the
    gyro is the median over the quiet dwells. A rate about the vertical does not change a pose and
    is ignored. Not used are a gyro that was off during a dwell, and one beside native readings,
    which may be in counts.

    """
    mean, slope, average, scale = table['mean'].T, table['slope'].T, table['average'].T, rule.scale
    limit = rule.limit_of(rule.noise_of(mean), DWELL_RATIO, DWELL_RATE_RATIO)
    sloping = rule.is_steep(slope, np.asarray(scale), average[:3], DWELL_SLOPE_G)
    sloping &= table['strength'] > np.where(table['beside_slope'], WEAK_STRENGTH, STRENGTH)
    sloping |= (scale > 0.0) & np.any((table['part_slope'] > PART_SLOPE_G * scale)
                                      & (table['part_strength'] > PART_STRENGTH), axis=1)
    found = {'short': table['short'],
             'frozen': np.all(tiny >= table['std'].T, axis=0) & (not rule.repeats),
             'shaking': np.any(limit < table['lowest'].T, axis=0), 'slope': sloping}
    quiet = ~np.any(list(found.values()), axis=0)
    # The excess of the noise of each mean, estimated from all dwells.
    own = np.stack([table['excess'], table['along']])
    common = np.median(own[:, quiet], axis=1, keepdims=True) if quiet.any() else 1.0
    across, along = np.maximum(np.maximum(common, 1.0), own / _OWN_EXCESS)
    up, rates = mean[:3], mean[3:]
    known = quiet & np.isfinite(rates).all(axis=0) & ~table['off']
    found['turning'] = sure = np.zeros_like(quiet)
    if rule.known and known.sum() >= _BIAS_DWELLS:
        off = rates - np.median(rates[:, known], axis=1, keepdims=True)
        spread = SIGMA_OF_MAD * float(np.max(np.median(np.abs(off[:, known]), axis=1)))
        tilting = (np.linalg.norm(np.cross(off, up, axis=0), axis=0)
                   / np.maximum(np.linalg.norm(up, axis=0), 1e-300))
        found['turning'] = known & (tilting > max(_GYRO_RATE, 2.0 * _SPREADS * spread))
        sure = known & (tilting < _GYRO_RATE) & (_SPREADS * spread < _GYRO_RATE)
        sure &= np.all(average[3:] > 0.0, axis=0)  # else an axis is off
    turn = np.sqrt(np.sum(slope**2, axis=0)) + SURE * table['error'] * np.sqrt(across)
    found['noisy'] = ~sure & ~((turn < TURN_G * scale) | (scale == 0.0))
    good = ~np.any(list(found.values()), axis=0)
    found['length'] = np.zeros(len(table), bool)
    found['length'][good] = ~rule.reads_gravity(table['mean'][:, :3][good])
    return quiet, np.minimum(across, along), np.select(list(found.values()), list(found), '')


CELLS = 256

_AGREE_G = 2e-3
"""Largest change of the mean by a knock [g], in addition to the noise, at equal orientation."""


class OngoingDwell:
    """
    The accumulated chunks of a dwell.

    `begin` and `end` are the first and last stamp [s], and `cells` the sums over `size` chunks
    each. `beside_slope`: the reading has a slope directly before or after the dwell. `short`: it
    is shorter than `min_dwell`.

    """

    def __init__(self, chunks: Chunks, orientation: int) -> None:
        self.epoch = chunks.epoch
        self.origin = chunks.origin
        self.length = chunks.length
        self.cells = self._partial = np.empty(0, chunks.records.dtype['sums'])
        self.size = 1
        self.begin = self.end = 0.0
        self.chunks = 0
        self.beside_slope = self.short = False
        self.orientation = orientation

    def add(self, chunks: Records) -> None:
        """Add consecutive chunks, of a `chunk_type`."""
        if not len(chunks):
            return
        self.begin = self.begin if self.chunks else float(chunks['begin'][0])
        self.end = float(chunks['end'][-1])
        self.chunks += len(chunks)
        left = chunks['sums'].copy()
        while len(left):
            room = (2 * CELLS - len(self.cells)) * self.size - len(self._partial)
            sums, left = left[:room], left[room:]
            sums = chained(self._partial, sums)
            whole = len(sums) // self.size * self.size
            self._partial = sums[whole:]
            self.cells = chained(self.cells, summed(sums[:whole], self.size))
            if len(self.cells) == 2 * CELLS:
                self.cells = summed(self.cells, 2)
                self.size *= 2

    def total(self) -> Records:
        """Return the sum of all chunks, one record."""
        every = chained(self.cells, self._partial)
        return summed(every, len(every))


_SAMPLES = 16
"""Smallest number of samples in a dwell."""

_LEAST_REST = 0.5
"""Length of a rest that is no pose but counts as one, relative to the shortest dwell."""

KNOCK = CHUNKS_PER_WINDOW + 3
"""Largest number of disturbed windows within a dwell: a knock of about 4 chunks."""

_LEAD = CHUNKS_PER_WINDOW - 2
"""Chunks before the first still window that belong to the dwell."""


_NONE = np.empty(0, chunk_type(0))
"""No chunks, of any type."""


class Tracker:
    """Join still chunks to dwells, one segment after the other."""

    def __init__(self, settings: CaptureSettings, rule: Rule) -> None:
        self._settings, self._rule = settings, rule
        self._chunks: Chunks
        self._shortest = self._longest = self._number = 0
        self._waiting = _NONE
        self._dwell: OngoingDwell | None = None

    def start(self, chunks: Chunks) -> None:
        """Start the segment of these chunks; the one before is closed."""
        self._chunks = chunks
        self._waiting = self._lead = self._held = _NONE
        self._pause, self._beside_slope = 0, False
        shortest = max(self._settings.min_dwell, _SAMPLES * chunks.period)
        self._shortest = math.ceil(shortest / chunks.length - 1e-9)
        longest = self._settings.max_dwell / chunks.length
        self._longest = max(int(longest), self._shortest) if math.isfinite(longest) else 0

    def feed(self, chunks: Records = _NONE, *, last: bool = False) -> Iterator[OngoingDwell]:
        """
        Yield the dwells that end with these chunks, of a `chunk_type`, or with those before.

        A chunk is decided once its verdict is final; each is, if these are the last ones.

        """
        waiting = chained(self._waiting, chunks)
        size, still = len(waiting), waiting['still']
        index = np.arange(size)
        nearest = np.where(still, 2 * size + HORIZON, index)
        ended = np.minimum.accumulate(nearest[::-1])[::-1]
        due = np.minimum(index + HORIZON, ended)
        if last:
            due = np.minimum(due, size - 1)
        count = int(np.searchsorted(due, size))
        due, ended, self._waiting = due[:count], ended[:count], waiting[count:]
        missing = np.append(waiting['missing'] > 0, np.zeros(CHUNKS_PER_WINDOW, bool))
        beside = np.lib.stride_tricks.sliding_window_view(missing, CHUNKS_PER_WINDOW)[:count]
        over = np.any(waiting['sums']['level'][:count] > waiting['limit'][due], axis=1)
        slope = np.append(waiting['trending'], 0)[np.minimum(ended, size)]
        verdict = still[:count] & ~over & (ended - index[:count] >= slope) & ~beside.any(axis=1)
        edges = np.flatnonzero(np.diff(verdict)) + 1
        for start, stop in zip([0, *edges] if count else [], [*edges, count]):
            part = waiting[start:stop]
            if verdict[start]:
                yield from self._extend(part)
                continue
            self._pause += len(part)
            self._lead = chained(self._lead, part[-_LEAD:])[-_LEAD:]
            self._held = _NONE
            sloping = bool((part['trending'] > 0).any())
            self._beside_slope |= sloping
            if self._pause > KNOCK or sloping:
                yield from self._end()
            self._beside_slope = sloping or (self._beside_slope and self._dwell is not None)

    def close(self) -> list[OngoingDwell]:
        """End the ongoing dwell because no chunk follows, and return all dwells that end."""
        return [*self.feed(last=True), *self._end()]

    def current(self) -> OngoingDwell | None:
        """Return the ongoing dwell as if it ended now, or None if it is too short."""
        if not len(self._waiting) or not self._waiting['still'][-1]:
            return None
        twin = copy.copy(self)
        twin._dwell = copy.copy(self._dwell)
        list(twin.feed(last=True))
        return next((each for each in twin._end() if not each.short), None)

    def _extend(self, chunks: Records) -> Iterator[OngoingDwell]:
        before = self._held
        if self._pause or self._dwell is None:
            before = self._lead.copy()  # without its windows, which are not still
            before['sums']['level'] = before['sums']['windows'] = 0.0
            is_same = False  # the mean reading before and after the pause
            if self._dwell is not None and self._dwell.chunks:
                old, after = self._dwell.total()[0], chained(before, chunks[:1])['sums']
                new = summed(after, len(after))[0]
                level = np.maximum(old['level'] / max(old['windows'], 1.0),
                                   new['level'] / new['windows'])[:3]
                apart = np.abs(old['first'] / old['count'] - new['first'] / new['count'])[:3]
                is_same = bool(np.all(apart <= np.sqrt(level) + _AGREE_G * self._rule.scale))
            if not is_same:
                yield from self._end()
                self._dwell = OngoingDwell(self._chunks, self._number)
            self._pause = 0
        chunks = chained(before, chunks)
        self._lead = _NONE
        chunks, self._held = chunks[:-1], chunks[-1:]
        assert self._dwell is not None
        while self._longest and self._dwell.chunks + len(chunks) >= self._longest:
            room = self._longest - self._dwell.chunks
            self._dwell.add(chunks[:room])
            yield self._dwell
            self._dwell = OngoingDwell(self._chunks, self._number)
            chunks = chunks[room:]
        self._dwell.add(chunks)

    def _end(self) -> Iterator[OngoingDwell]:
        found, self._dwell, self._held = self._dwell, None, _NONE
        if found is not None:
            self._number += 1
            found.beside_slope = self._beside_slope
            found.short = found.chunks < self._shortest
            # The end of a rest that was split is no rest.
            least = self._shortest if self._longest else min(
                max(_LEAST_REST * self._shortest, CHUNKS_PER_WINDOW), self._shortest)
            if found.chunks >= least:
                yield found


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
