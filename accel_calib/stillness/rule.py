# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The stillness rule, over chunks.

A window is the last `CHUNKS_PER_WINDOW` chunks. It is still if

1. the variance of each axis is below `VARIANCE_RATIO` times the noise of the sensor;
2. the variance of the angular rate, if known, is below `RATE_RATIO` times its noise. The mean rate
   is not used, because gyros have biases, unless the user sets a limit;
3. |mean reading| is near 1 g, if the unit of the readings is known;
4. the reading has no slope over the last `SLOPE_CHUNKS` that is both significant and larger than
   the drift of a sensor during warm-up. Turning at 0.5 °/s changes a reading by up to 8.7 mg/s
   and is not visible in any variance;
5. the chunk means do not oscillate with one frequency. Otherwise, shaking from the first second on
   would pass for noise of the sensor. White noise and vibration average out over a chunk, and
   noise behind a slow low-pass filter has no single frequency. A limit of the user
   (`still_std_max`) replaces this condition.

**The noise of the sensor** is the lower envelope of the variances so far. The mean variance v of
the windows in `LONG` chunks has a standard error of about v √(2/dof), with dof = 2 n / (1 +
excess) for n samples. Excess is the variance of their mean over that of independent samples (exact
for white noise and close for AR(1) noise). The upper end of this range, v exp(2 √(2/dof)), is an
upper bound of the noise if the sensor is still, and far above it if the sensor moves; so its
minimum so far is used. The noise is at least the variance that the resolution causes: a reading
that alternates between two steps of height q has a variance of up to q²/4, and q is the smallest
step so far. Nothing is learned from an axis at the limit of the sensor, whose samples scatter
less, nor from a gyro that does not vary.

**Levels.** The smallest variance so far is that of a rest, unless something else than the sensor
was quieter once: a filter of the driver that started, or a gyro that was not on yet. It was then
short, and in one orientation, while the rests of a sensor that is turned have one variance in many
orientations. How often the samples of each axis had which variance is therefore counted: what is
far quieter than all rests is none.

**Rounding.** Samples x = μ + n with noise n of the standard deviation σ are rounded to multiples
of q. The error of the mean of many samples depends on μ. Over all μ its variance is

    e² = q² Σ_k exp(-4π² k² σ²/q²) / (2π² k²)                                 (1)

and the mean variance v of the rounded samples is σ² + q²/12 - e² [1]_. So v determines σ and e².
For σ < 0.2 q the samples take two values at most, and v = q σ/√π. For a larger σ the first term of
(1) is enough, and e² is found by iteration.

References
----------
.. [1] B. Widrow, I. Kollár, Quantization Noise, Cambridge 2008, chapter 4.

"""

from collections.abc import Mapping
import math
from typing import NamedTuple

import numpy as np

from .chunks import CaptureSettings, chained, Chunks, CHUNKS_PER_WINDOW, Records
from .trend import oscillation, sliding, Stretch, stretch, window_figures
from ..statistics import rms
from ..units import Bools, Floats, Indices, Units

LONG = 12
"""Number of chunks from which the noise is estimated."""

SLOPE_CHUNKS = (LONG, 3 * LONG)
"""Numbers of chunks over which slopes and oscillations are tested; a longer stretch reveals
smaller slopes and slower oscillations."""

OSCILLATION = {LONG: 0.9, 3 * LONG: 0.7}
"""Largest share of one frequency in the chunk means of a still stretch, by the number of chunks.
Noise exceeds it with p ≈ 1e-4, even on one axis alone or with a correlation time of two chunks."""

OSCILLATION_G = 5e-3
"""Largest oscillation of a still sensor [g], as standard deviation: a soft base that sways."""

HORIZON = max(SLOPE_CHUNKS)
"""Number of chunks after which the verdict on a chunk is final."""

VARIANCE_RATIO = 12.0
"""Largest ratio of the variance of a window to the noise; windows are short, so it scatters."""

RATE_RATIO = 900.0
"""The same for the rate: a gyro measures shaking that does not change the mean of a dwell."""

STD_CAP_G = 0.15
"""Largest adaptive threshold [g], as standard deviation."""

SHAKING_G = 0.06
"""Largest shaking in addition to the noise of a noisy sensor [g], as standard deviation."""

SLOPE_G = 4e-3
"""Largest slope within a dwell [g/s]: a sensor that settles on a soft base."""

DWELL_SLOPE_G = 2e-3
"""Largest slope of a whole dwell [g/s]: 0.11 °/s; warming up causes some 1e-5 g/s."""

TURN_G = 8.7e-3
"""A dwell must exclude this slope [g/s]: turning at 0.5 °/s."""

SURE = 2.33
"""Required margin to `TURN_G` in standard errors; 1 % of the turned dwells pass."""

TURNED, TURNED_NOISE = 3e-3, 3.0
"""Smallest half of the range of native readings at rest that is a turn: in lengths of the reading,
which can be 100 g of counts without sign, and in standard deviations."""

SLOPE_NOISE = 0.1
"""Largest slope in standard deviations of the samples per second, while 1 g is not known."""

STRENGTH = 40.0
"""A slope is significant if the sum of its squared scores over 3 axes is larger: p ≈ 1e-6."""

WEAK_STRENGTH = 8.0
"""The same for a stretch next to a significant slope, which may continue there: p ≈ 0.05."""


RELATIVE = 1e-6
"""Smallest ratio of standard deviation to reading, for data without noise."""

STD_FLOOR_G = 3.3e-4
"""Smallest noise of a sensor [g]; smaller shaking is harmless."""

AT_LIMIT = 0.1
"""Share of samples at a limit above which a variance is too small by a sixth or more."""

QUIETER = 8.0
"""Ratio of the variance at rest to that of what is no rest of this sensor."""

VARIED_STEPS, VARIED_SHARE, MOST_REPEATED = 0.7, 0.1, 600.0
"""Standard deviation of a rest [steps] above which no noise repeats a reading for a window. The
sensor has such rests if they are a tenth of those with a repeated reading, of which at most this
number counts, so that a driver that was frozen for an hour is found soon after."""

BY_CHANCE = 1e-5
"""Largest chance of a window of one reading, from the largest share of repeated samples."""

PLAUSIBLE_G = (0.25, 3.0)
"""Range of |a| of a rest of a sensor that is not calibrated [g]."""

FEWEST_IN_COMMON, LEAST_IN_COMMON, LEAST_SPREAD = 9, 0.7, 0.03
"""Fewest rests, smallest share of them, and smallest ratio of the singular values that determine
what rests have in common."""

AGREE_G = 0.03
"""Largest RMS difference of the lengths of rests that have an ellipsoid in common [g]."""

LARGEST_OFFSET_G = 1.5

WHITE = 4.0
"""Largest excess of a stretch whose scatter is noise rather than a motion."""

_BINS, _ZERO = 128, 64
"""Number of bins, by powers of 2 of the variance, and bin of a variance of 1."""

_NEAR, _BELOW = 2, 4
"""Bins on each side of the most frequent one that are of rests of the sensor, and number of bins
below it from which on a variance is that of no rest."""

_RARE = 5
"""Ratio of the numbers of stretches at rest and of quieter ones above which these are no rests. An
axis that does not vary at all is not measured, unless most rests are so, as of a coarse sensor."""

_TURNED = 0.3
"""Smallest range of the mean readings at rest of a sensor that was turned, relative to them."""

_ONE_WAY = 0.2
"""Largest range of the mean readings of what is quieter, relative to that at rest."""


class Known(NamedTuple):
    """
    What all samples of a sensor show about it.

    `least` are the (6,) variances of readings and rates below which nothing is a rest, 0 if they
    are not known, and `repeats` is whether a rest can repeat one reading.

    """

    least: Floats = np.zeros(6)
    repeats: bool = True


class Levels:
    """Counts of stretches by their variance, for each of 6 axes, with the range of readings."""

    def __init__(self) -> None:
        self._counts = np.zeros((6, _BINS), np.int64)
        self._lowest = np.full((6, _BINS, 3), np.inf)
        self._highest = np.full((6, _BINS, 3), -np.inf)
        self._found: Floats | None = np.zeros(6)

    def add(self, variance: Floats, reading: Floats) -> None:
        """Count (axes, n) variances of stretches, NaN if unknown, with (3, n) mean readings."""
        axis, which = np.nonzero(np.isfinite(variance))
        if not len(axis):
            return
        self._found = None
        with np.errstate(divide='ignore'):
            level = np.floor(np.log2(variance[axis, which])) + _ZERO
        found = axis, np.clip(level, 0, _BINS - 1).astype(np.intp)
        np.add.at(self._counts, found, 1)
        np.minimum.at(self._lowest, found, reading.T[which])
        np.maximum.at(self._highest, found, reading.T[which])

    @property
    def least(self) -> Floats:
        """Return the (6,) variances at rest where something was far quieter; 0 elsewhere."""
        if self._found is None:
            self._found = np.zeros(6)
            for axis, counts in enumerate(self._counts):
                lowest, highest = self._lowest[axis], self._highest[axis]
                near = np.convolve(counts, np.ones(2 * _NEAR + 1), 'same')
                most = int(np.argmax(near))
                rests = slice(max(most - _NEAR, 0), most + _NEAR + 1)
                peak = rests.start + int(np.argmax(counts[rests]))
                quieter = slice(1, max(peak - _BELOW, 1))
                count = int(np.sum(counts[quieter]))
                if not (count + counts[0] and max(count * _RARE, counts[0]) < near[most]):
                    continue
                low, high = lowest[rests].min(axis=0), highest[rests].max(axis=0)
                turned = np.max(high - low)
                way = np.max(highest[quieter].max(axis=0, initial=-np.inf)
                             - lowest[quieter].min(axis=0, initial=np.inf))
                size = np.linalg.norm(np.maximum(np.abs(low), np.abs(high)))
                if turned > _TURNED * size and way < _ONE_WAY * turned:
                    self._found[axis] = 2.0**(peak - _ZERO)
        return self._found


class Rule:
    """
    The rule with its state: the last chunks, and noise and resolution so far.

    `steps` (2,) are the smallest steps between successive readings, and rates; at first infinite.
    `quietest` is the variance of the axis with the largest one, in the quietest window so far, and
    `repeats` whether a rest can repeat one reading, as that of a coarse sensor does. `least` are
    the (6,) variances below which nothing is a rest of this sensor, 0 if they are not known. Only
    what is `known` from the start marks samples as missing.

    """

    def __init__(self, settings: CaptureSettings, units: Units, known: Known = Known()) -> None:
        self._settings, self._given, self.least = settings, known, known.least
        self.levels = Levels()
        self.known = not units.is_native
        self._per_g = units.per_g
        self._lowest = np.full(3, np.inf)
        self._highest = np.full(3, -np.inf)
        self._axes = 3
        self._before: Records = np.empty(0)  # the first chunks are fresh
        self._floors = np.full((2, 6), np.inf)  # of stretches without equal samples, of all
        self._counts = np.zeros(2)  # stretches that varied, and that did not
        self._same, self._seen = 0.0, 0
        self.repeats = True
        self.steps = np.full(2, np.inf)
        self.quietest = math.inf

    @property
    def scale(self) -> float:
        """Return the reading of 1 g; for native units half the range at rest, 0 if not known."""
        return self._per_g if self.known else float(_half_range(
            self._lowest, self._highest, self._floors[int(self.repeats), :3]))

    def noise_of(self, mean: Floats) -> Floats:
        """Return the variance of the noise of the sensor as known now, for (6, n) means."""
        axes = len(mean)
        noise = at_least(self._floors[int(self.repeats), :axes, np.newaxis],
                         self.steps[:, np.newaxis], mean)
        noise = np.fmax(noise, self.least[:axes, np.newaxis])
        noise[:3] = np.fmax(noise[:3], (STD_FLOOR_G * self.scale)**2)
        return noise

    def limit_of(self, noise: Floats, ratio: float = VARIANCE_RATIO,
                 rate_ratio: float = RATE_RATIO) -> Floats:
        """Return the (3 or 6, n) largest variances of a still window, for this noise."""
        limit = noise * ratio
        limit[3:] = noise[3:] * rate_ratio
        if self.known:
            most = np.minimum(noise[:3] + (SHAKING_G * self._per_g)**2,
                              (STD_CAP_G * self._per_g)**2)
            np.minimum(limit[:3], most, out=limit[:3])
        if self._settings.still_std_max > 0.0:
            limit[:3] = (self._settings.still_std_max * self._per_g)**2
        return np.asarray(limit)

    def feed(self, chunks: Chunks) -> Records:
        """Return consecutive chunks with the verdict on their windows."""
        judged = chunks.records.copy()
        own = judged['sums'].copy()
        if chunks.fresh:
            self._before = np.full((HORIZON - 1) * (own.itemsize // 8), np.nan).view(own.dtype)
        sums = chained(self._before, own)
        self._before = sums[len(sums) - HORIZON + 1:].copy()
        if self._axes == 3 and np.isfinite(sums['first'][:, 3]).any():
            self._axes = 6
        axes, size = self._axes, len(judged)
        means, level = window_figures(sums, chunks.origin[:axes])
        mean, recent = means[:, -size:], level[:, -size:]
        seen = {length: stretch(sums, level, length, size, chunks.length)
                for length in SLOPE_CHUNKS}
        # Windows that have samples of zeros, and those of one reading, as 1.
        zero = sliding(np.maximum, (sums['zeros'] > 0.0).astype(float), CHUNKS_PER_WINDOW)
        constant = (sums['repeats'] == sums['count'] - 1.0).astype(float)
        equal = ((sliding(np.add, constant, CHUNKS_PER_WINDOW) == CHUNKS_PER_WINDOW)
                 & np.all(level[:3] <= _tiny(means[:3]), axis=0)).astype(float)
        gaps = (zero, zero + equal, np.where(level[3:] == 0.0, 1.0, 0.0))
        noise, varied = self._learn(seen[LONG], mean, judged['step'].T, *(
            sliding(np.maximum, each, LONG - CHUNKS_PER_WINDOW + 1)[..., -size:] > 0.0
            for each in gaps))
        quiet = np.all(QUIETER * recent[:3] < self._given.least[:3, np.newaxis], axis=0)
        missing = np.select([zero[-size:] > 0.0, (equal[-size:] > 0.0) & varied,
                             (equal[-size:] == 0.0) & quiet], [1, 2, 3])
        measured = missing == 0
        self.quietest = float(np.fmin.reduce(
            recent[:3].max(axis=0)[measured], initial=self.quietest))
        scale = np.asarray(self._per_g)
        if not self.known:
            calm = measured & np.all(recent <= self.limit_of(noise), axis=0)
            scale = self._widen(np.where(calm, mean[:3], np.nan), noise[:3])
        noise[:3] = np.fmax(noise[:3], (STD_FLOOR_G * scale)**2)
        limit = self.limit_of(noise)
        judged['sums']['level'][:, :axes], judged['limit'][:, :axes] = recent.T, limit.T
        judged['sums']['off'] = np.all(recent[3:] == 0.0, axis=0)
        judged['missing'], judged['trending'] = missing, self._trending(seen, mean, limit, scale)
        still = measured & (judged['trending'] == 0) & np.all(recent[:3] <= limit[:3], axis=0)
        still &= ~np.any(recent[3:] > limit[3:], axis=0)  # a rate can be NaN
        fastest = self._settings.still_gyro_max or math.inf
        judged['still'] = still & ~(np.sum(mean[3:]**2, axis=0) > fastest**2)
        return judged

    def _widen(self, at_rest: Floats, noise: Floats) -> Floats:
        """Return half the range at each chunk, with (3, n) native readings at rest, or NaN."""
        low = np.fmin.accumulate(np.column_stack([self._lowest, at_rest]), axis=1)[:, 1:]
        high = np.fmax.accumulate(np.column_stack([self._highest, at_rest]), axis=1)[:, 1:]
        self._lowest, self._highest = low[:, -1], high[:, -1]
        return _half_range(low, high, noise)

    def is_steep(self, slope: Floats, scale: Floats, variance: Floats, drift_g: float = SLOPE_G
                 ) -> Bools:
        """
        Return whether (3, ...) slopes [per s] are larger than a drift of `drift_g` [g/s].

        `scale` (...) is the reading of 1 g, and `variance` (3, ...) that of the samples.

        """
        drift = drift_g * scale
        if not self.known:
            drift = np.maximum(drift, SLOPE_NOISE * np.sqrt(variance.mean(axis=0)))
        return np.asarray(np.sum(slope**2, axis=0) > drift**2)

    def reads_gravity(self, means: Floats) -> Bools:
        """
        Return whether the (n, 3) means of rests are of 1 g within the tolerance.

        An offset and the gains by axis are common to all rests: once these determine them, they do
        not count as a difference. Before, the differences that a sensor can have are allowed.
        The ellipsoid of the rests has its axes along those of the sensor: Σ a x² + b x = 1. Rests
        are left out, that which decreases the sum of squares most first, until the others agree.

        """
        if not self.known:
            return np.ones(len(means), bool)
        means_g = means / self._per_g
        columns, kept = np.hstack([means_g**2, means_g]), np.arange(len(means_g))
        while len(kept) >= max(FEWEST_IN_COMMON, LEAST_IN_COMMON * len(means_g)):
            onto, sizes, turn = np.linalg.svd(columns[kept], full_matrices=False)
            values = (onto.sum(axis=0) / np.maximum(sizes, 1e-300)) @ turn
            if sizes[-1] < LEAST_SPREAD * sizes[0] or np.any(values[:3] <= 0.0):
                break
            centre = -values[3:] / (2.0 * values[:3])
            radius = np.sqrt((1.0 + np.sum(values[:3] * centre**2)) / values[:3])
            lengths = np.linalg.norm((means_g - centre) / radius, axis=1)
            if rms(lengths[kept] - 1.0) < AGREE_G:
                if np.any(np.abs(centre) >= LARGEST_OFFSET_G):
                    break
                return np.asarray(np.abs(lengths - 1.0) <= self._settings.still_norm_tolerance)
            left = columns[kept] @ values - 1.0
            own = np.maximum(1.0 - np.sum(onto**2, axis=1), 1e-9)
            kept = np.delete(kept, np.argmax(left**2 / own))
        length = np.linalg.norm(means_g, axis=1)
        return np.asarray((length > PLAUSIBLE_G[0]) & (length < PLAUSIBLE_G[1]))

    def _trending(self, seen: Mapping[int, Stretch], mean: Floats, limit: Floats, scale: Floats
                  ) -> Indices:
        trending = np.zeros(mean.shape[1], dtype=np.intp)
        one_g = scale
        if not self.known:  # the scale is too small before several orientations are seen
            one_g = np.maximum(scale, np.sqrt(np.sum(mean[:3]**2, axis=0)))
        for length, each in seen.items():
            calm = np.all(each.highest <= limit[:3], axis=0)
            moved = self.is_steep(each.slope, scale, each.variance[:3])
            moved &= each.strength > STRENGTH
            suspect = each.scatter > np.maximum((OSCILLATION_G * one_g)**2, each.white)
            suspect &= calm & (self._settings.still_std_max == 0.0)
            index = np.flatnonzero(suspect)
            share = oscillation(each.means, length, index)
            moved[index] |= share > OSCILLATION[length]
            trending[calm & moved] = length
        return trending

    def _learn(self, seen: Stretch, mean: Floats, step: Floats, zero: Bools,
               repeated: Bools, off: Bools) -> tuple[Floats, Bools]:
        """
        Return the variance of the noise at each chunk, and whether rests vary beyond rounding.

        `zero` and `repeated` are stretches with samples of zeros, and these or equal ones, and
        `off` those in which an axis of the gyro does not vary for a window: it is not on yet.

        """
        axes = len(mean)
        dof = np.maximum(2.0 * seen.samples / (1.0 + seen.excess), 1.0)
        average = seen.variance * np.repeat(np.exp(2.0 * np.sqrt(2.0 / dof)), 3, axis=0)
        steps = np.minimum.accumulate(np.column_stack([self.steps, step]), axis=1)[:, 1:]
        # Axes that end at a limit while another axis varies by more than rounding.
        least = at_least(np.zeros_like(mean[:3]), steps, mean[:3])
        ends = (average[:3] <= _tiny(mean[:3])) | (seen.at_limit > AT_LIMIT)
        average[:3][ends & np.any(average[:3] > 2.0 * least, axis=0)] = np.nan
        average[3:][off] = np.nan
        floors = np.where([repeated[np.newaxis], zero[np.newaxis]], np.nan, average)
        floors[:, :, 0] = np.fmin(floors[:, :, 0], self._floors[:, :axes])
        floors = np.fmin.accumulate(floors, axis=2)
        deviation = np.sqrt(np.max(seen.variance[:3], axis=0))
        calm = (seen.excess[0] < WHITE) & ~zero
        calm &= ~((seen.strength > STRENGTH) & self.is_steep(
            seen.slope, np.asarray(self.scale), seen.variance[:3]))
        if self.known:
            calm &= deviation < STD_CAP_G * self._per_g
        varies = calm & ~repeated & (deviation > VARIED_STEPS * steps[0])
        apart = slice(-self._seen % LONG, None, LONG)
        self.levels.add(np.where(~zero & (calm | (average == 0.0)), average, np.nan)[:, apart],
                        mean[:3, apart])
        self._seen += len(calm)
        counts = self._counts[:, np.newaxis] + np.cumsum([varies, repeated & ~zero], axis=1)
        same = np.maximum.accumulate(np.append(
            self._same, np.where(seen.excess[0] < WHITE, seen.same, 0.0) * ~repeated))[1:]
        chance = same ** (seen.samples * CHUNKS_PER_WINDOW / LONG - 1.0)
        share = VARIED_SHARE * np.minimum(counts[1], MOST_REPEATED)
        varied = (counts[0] >= np.maximum(share, CHUNKS_PER_WINDOW)) & (chance < BY_CHANCE)
        varied |= not self._given.repeats
        self._floors[:, :axes], self.steps = floors[:, :, -1], steps[:, -1]
        self._counts, self._same, self.repeats = counts[:, -1], float(same[-1]), not varied[-1]
        noise = np.fmax(np.where(varied, floors[0], floors[1]), self.least[:axes, np.newaxis])
        return at_least(noise, steps, mean), varied


def _half_range(low: Floats, high: Floats, noise: Floats) -> Floats:
    """Return half the largest range of (3, ...) readings at rest; 0 before a turn."""
    with np.errstate(invalid='ignore'):  # before the first rest
        half = 0.5 * np.max(high - low, axis=0)
        turned = half >= np.maximum(TURNED * 0.5 * np.linalg.norm(low + high, axis=0),
                                    TURNED_NOISE * np.sqrt(np.max(noise, axis=0)))
    return np.where(turned, half, 0.0)


def at_least(floor: Floats, step: Floats, mean: Floats) -> Floats:
    """
    Return (axes, n) variances raised to the smallest ones that resolution and mean allow.

    `step` are the (2, n) smallest steps so far, and `mean` the (axes, n) mean readings and rates.

    """
    groups = len(floor) // 3
    known = np.where(np.isfinite(step[:groups]), step[:groups], 0.0)
    least = np.fmax(0.25 * known**2, _tiny(mean))
    return np.asarray(np.fmax(floor, np.repeat(least, 3, axis=0)))


def _tiny(mean: Floats) -> Floats:
    """Return the (groups, n) smallest variances, for data without noise."""
    square = (mean * mean).reshape((-1, 3, *mean.shape[1:]))
    return RELATIVE**2 * (square[:, 0] + square[:, 1] + square[:, 2])


_TWO_VALUES = 0.1128
"""Variance of rounded samples [steps²] below which they alternate between two values."""


def rounding_left(variance: Floats) -> Floats:
    """
    Return the variance that rounding leaves in the mean of many samples [steps²].

    `variance` is that of the rounded samples, as an average over many true values [steps²].

    """
    small = np.pi * variance**2 + 1.0 / 12.0 - variance
    left = np.zeros_like(variance)
    for _ in range(30):  # each step divides the error by 2.4 or more
        left = np.exp(-4.0 * np.pi**2 * (variance - 1.0 / 12.0 + left)) / (2.0 * np.pi**2)
    return np.where(variance < _TWO_VALUES, small, left)
