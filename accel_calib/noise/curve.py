# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The longest rest of a recording, its Allan deviation, and the covariance of the estimates.

**Rest.** The detector of `accel_calib.stillness` finds the rests, which end at an interruption of
the stamps. A few missing samples are replaced by the sample before, because a recording that loses
one sample in a thousand would otherwise have no long rest. Stamps with jitter are not used one by
one: samples come from a regular clock, and their order is right.

**Deviation.** For the averaging time τ = m τ0, the Allan variance is half the mean square of the
difference between successive averages of m samples. The overlapping estimate uses each start
(IEEE Std 952-1997, annex C [1]_; NIST SP 1065 [2]_, eq. 11). With x the integral of the samples,
the difference is the second difference of x::

    d(k) = (x(k + 2m) - 2 x(k + m) + x(k)) / (m √2),    variance = mean of d(k)²

**Components.** A sum of independent components is fitted to the variance:

| component | variance at τ | slope of the deviation | c(t) |
|---|---|---|---|
| quantisation Q | 3 Q²/τ² | -1 | Q² at t = 0 |
| white noise N | N²/τ | -1/2 | -N² abs(t)/2 |
| bias instability B | B² 2 ln2/π | 0 | B² t² ln(abs(t))/(2π) |
| random walk K | K² τ/3 | +1/2 | K² abs(t)³/12 |
| drift R | R² τ²/2 | +1 | none: it is not random |

√(2 ln2/π) = 0.664 is the factor between the flat part of the curve and B.

**Covariance.** c(t) is the generalised covariance of x: second differences do not depend on the
polynomials that it leaves open. It gives the covariance γ of any two differences d in closed form,
for different m, too. For Gaussian noise, the covariance of two estimates is::

    cov = 2 / (n_i n_j) · sum over all pairs of γ²

This includes the overlap, the few averages at long τ, and mixed components. For one component it
agrees with the equivalent degrees of freedom, edf = 2 variance² / cov, of Greenhall and Riley
[3]_. A drift adds its product with the mean of d, whose covariance is a sum of γ.
The sum over the lags uses points that are dense near the kinks of γ.

The deviation is that of allantools. It has no covariance between two τ, which the fit needs: in
300 simulated rests with a plain B or K, 95 % intervals from the variances alone hold the true N, B
and K in 84 to 90 %, and those with the covariance in 95 to 99 %. Its intervals for the deviations
agree with ours in width (within 5 %) and in coverage, but it has none for the last two or three
octaves, since it must identify the noise first, and that needs 30 averages.

References
----------
.. [1] IEEE Std 952-1997, annex C; IEEE Std 1293-2018, annex on noise of accelerometers.
.. [2] W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065, 2008.
.. [3] C. A. Greenhall, W. J. Riley, Uncertainty of stability variances based on finite
   differences, PTTI 2003.

"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..stillness import CaptureSettings, StillDetector
from ..table import concatenated, Floats, numbered, Recording
from ..text import counted
from ..units import Units

FLAT = 2.0 * np.log(2.0) / np.pi
"""Allan variance of flicker noise in units of B²."""

LEAST_AVERAGES = 4
"""Smallest number of averages of length τ in the record, at the longest τ."""

_GROWTH = 1.15
"""Ratio of successive distances of the lags from a kink."""

_RANDOM = 4
"""Number of components that are random."""

LEAST_SAMPLES = 64
"""Smallest number of samples of a rest: five octaves of τ."""

_LONG = 1.5
"""Interval between stamps that indicates a missing sample, in units of the usual interval."""

_INTERRUPTED = 10
"""Number of missing samples in a row that interrupts a rest."""

_MOST_MISSING = 0.02
"""Largest part of missing samples; with more long intervals, the stamps have jitter."""

_UNEVEN = 0.1
"""Standard deviation of the intervals that is worth a note, in units of the mean interval."""

_COARSE = 1.0
"""Noise in units of the step of the output below which rounding changes the noise."""

_BLOCK_S = 1.0
"""Length of the averages in which a coarse record is searched for a rest [s]."""

_NEAR_STEP = 2.0
"""Noise in units of the step below which steps can look like motions."""

_AROUND, _MOVED = 5, 3.0
"""Number of blocks before and after a motion, and its least size in steps."""

_DISTURBED = 12.0
"""Variance of the samples of a disturbed block, in units of the usual one or of a step."""

_SECOND = np.array([1.0, -2.0, 1.0])
_FLICKER = np.array([[0.0], [0.0], [1.0], [0.0]])
_FAR = 16
"""Lag in units of m_i + m_j from which γ of flicker noise is its fourth derivative."""

Counts = NDArray[np.int64]


def octaves(samples: int) -> Counts:
    """Return the numbers of samples per average: powers of 2."""
    most = samples // LEAST_AVERAGES
    return 2 ** np.arange(most.bit_length(), dtype=np.int64)


def shares(lengths: Counts) -> Floats:
    """Return the (k, 5) variance of each component of size 1 at each length, for τ0 = 1."""
    m = lengths.astype(float)
    return np.column_stack([3.0 / m**2, 1.0 / m, np.full(len(m), FLAT), m / 3.0, 0.5 * m**2])


def allan_variances(values: Floats, lengths: Counts) -> Floats:
    """Return the overlapping Allan variances of (n,) samples at (k,) lengths of at most n/2."""
    found = import_module('allantools').oadev(values - np.mean(values), rate=1.0,
                                              data_type='freq', taus=lengths.astype(float))
    return np.asarray(found[1], dtype=float) ** 2


def check_allantools() -> None:
    """Raise InputError if allantools is not installed."""
    if find_spec('allantools') is None:
        raise InputError('allantools is not installed, but the Allan deviation needs it',
                         'run pip install allantools')


@dataclass(frozen=True)
class Spread:
    """
    Covariances of the estimates at all k lengths, for any sizes of the components.

    For `pairs` (p, 2) of lengths i <= j, `gamma` (p, 4, g) is the covariance of the differences at
    each lag, for each component of size 1, and `weight` (p, g) is the weight of the square at each
    lag. `of_mean` (4, k, k) is the covariance of the mean differences times m_i m_j, for each
    component of size 1.

    """

    pairs: NDArray[np.intp]
    gamma: Floats
    weight: Floats
    of_mean: Floats

    def covariance(self, sizes: Floats) -> Floats:
        """Return the (k, k) covariance of the variances for (5,) squared components, τ0 = 1."""
        used = np.flatnonzero(sizes[:_RANDOM])
        gamma = np.einsum('c,pcg->pg', sizes[used], self.gamma[:, used])
        found = np.einsum('pg,pg->p', self.weight, gamma**2)
        matrix = np.zeros(self.of_mean.shape[1:])
        matrix[self.pairs[:, 0], self.pairs[:, 1]] = found
        matrix[self.pairs[:, 1], self.pairs[:, 0]] = found
        if sizes[_RANDOM] > 0.0:
            # Without the negative eigenvalues of rounded sums.
            values, vectors = np.linalg.eigh(np.einsum('c,cij->ij', sizes[:_RANDOM], self.of_mean))
            matrix += 2.0 * sizes[_RANDOM] * (vectors * np.maximum(values, 0.0) @ vectors.T)
        return matrix


def spread_of(lengths: Counts, samples: int) -> Spread:
    """Return the covariances for these lengths and this number of samples."""
    first, second = np.triu_indices(len(lengths))
    lags = []  # between the centres of two differences, dense near each kink of γ
    for one, two in zip(lengths[first], lengths[second], strict=True):
        last = samples + 1 - one - two
        growth = np.arange(1.0, np.log(max(last, 2)) / np.log(_GROWTH) + 1.0)
        distance = np.concatenate([np.arange(9), np.round(_GROWTH**growth).astype(np.int64)])
        kinks = np.array([0, one, two, two - one, two + one])
        around = kinks[:, np.newaxis] + np.concatenate([-distance, distance])
        lags.append(np.unique(np.append(around[(around >= 0) & (around <= last)], [0, last])))
    most = max(map(len, lags))
    gamma, weight = np.zeros((len(lags), 4, most)), np.zeros((len(lags), most))
    for p, (i, j, lag) in enumerate(zip(first, second, lags, strict=True)):
        gamma[p, :, :len(lag)] = _between(lag, lengths[i], lengths[j])
        # The weight of γ² is 2/(n_i n_j) times the number of pairs.
        counts = [float(samples + 1 - 2 * lengths[k]) for k in (i, j)]
        pairs = np.minimum(min(counts), samples + 1.0 - lengths[i] - lengths[j] - lag)
        width = np.convolve(np.diff(lag), [0.5, 0.5])  # of the trapezoidal rule
        weight[p, :len(lag)] = 4.0 / (counts[0] * counts[1]) * width * np.maximum(pairs, 0.0)
    of_mean = np.zeros((_RANDOM, len(lengths), len(lengths)))
    of_mean[:, first, second] = 0.5 * np.einsum('pg,pcg->cp', weight, gamma) * (
        lengths[first] * lengths[second])
    of_mean[:, second, first] = of_mean[:, first, second]
    return Spread(np.column_stack([first, second]), gamma, weight, of_mean)


def _between(lag: Counts, one: int, two: int) -> Floats:
    """Return the (4, g) covariance of two differences for components of size 1."""
    total = np.zeros((4, len(lag)))
    for a, weight_a in zip((-1, 0, 1), _SECOND, strict=True):
        for b, weight_b in zip((-1, 0, 1), _SECOND, strict=True):
            # c(t), the generalised covariance of the integral.
            t = np.abs(lag + a * one - b * two).astype(float)
            log = np.log(np.maximum(t, 1.0))
            total += weight_a * weight_b * np.array([
                (t == 0.0).astype(float), -0.5 * t, t**2 * log / (2.0 * np.pi), t**3 / 12.0])
    # Rounding would exceed the small differences at long lags: all but flicker noise is 0 there.
    total[:, lag > one + two] *= _FLICKER
    far = lag > _FAR * (one + two)
    total[2, far] = -(float(one) * float(two) / lag[far])**2 / np.pi
    return total / (2.0 * float(one) * float(two))


@dataclass(frozen=True)
class LongRest:
    """
    The longest rest of a recording.

    `start` is the first stamp [s], and `rate` the samples per second [Hz]. `values` (c, n) are
    readings [g], and angular rates [rad/s] if the recording has them; `temperature` (n,) is in °C.
    `notes` state what is not regular.

    """

    start: float
    rate: float
    values: Floats
    temperature: Floats | None
    notes: tuple[str, ...]

    @property
    def samples(self) -> int:
        """Return the number of samples."""
        return int(self.values.shape[1])

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.samples / self.rate


def longest_rest(recording: Recording, units: Units) -> LongRest:
    """Return the longest rest without an interruption; raise InputError if it is too short."""
    best, seconds = recording.take(slice(0)), 0.0
    for samples, seen in ((recording, recording), *_averaged(recording)):
        detector = StillDetector(CaptureSettings(), units, keep=None)
        detector.add_recording(seen)
        detector.close()
        for dwell in sorted(detector.dwells(), key=lambda dwell: dwell.start - dwell.end):
            if dwell.end - dwell.start <= seconds:
                break
            for part in _uninterrupted(samples['time'], dwell.start, dwell.end):
                length = float(samples['time'][part[1] - 1] - samples['time'][part[0]])
                if length > seconds:
                    best, seconds = samples.take(slice(*part)), length
    count, time = len(best), recording['time']
    if count < LEAST_SAMPLES:
        recorded = float(np.ptp(time)) if len(time) else 0.0
        found = counted(count, 'sample') if count else 'no sample'
        raise InputError(f'the longest rest in {recorded:.3g} s has {found}, expected at least '
                         f'{LEAST_SAMPLES}', 'record the sensor for some minutes to hours while '
                         'nothing touches it')
    return _regular(best, units)


def _averaged(recording: Recording) -> Iterator[tuple[Recording, Recording]]:
    """
    Yield the samples of a coarse record without disturbed blocks, and the means of the blocks.

    Where the noise is small beside the step of the output, single steps look like motions. Means
    over a block with an added noise of one step do not show them. They would not show a knock
    or a small turn either, but the scatter in a block and the change between blocks do.

    """
    if not len(recording):
        return
    block = np.floor((recording['time'] - recording['time'][:1]) / _BLOCK_S)
    starts = np.flatnonzero(np.diff(block, prepend=np.nan))
    count = np.diff(starts, append=len(block))[:, np.newaxis]

    def means(values: Floats) -> Floats:
        sums: Floats = np.add.reduceat(values.reshape(len(block), -1), starts) / count
        return sums.reshape(len(starts), *values.shape[1:])

    reading = recording.reading - recording.reading[:1]
    variance = np.maximum(means(reading ** 2) - means(reading) ** 2, 0.0)
    usual = np.median(variance, axis=0)
    step = min(filter(None, map(coarse_step, reading.T, np.sqrt(usual) / _NEAR_STEP)), default=0.0)
    if step == 0.0:
        return
    calm = np.all(variance <= _DISTURBED * np.maximum(usual, step ** 2 / 4.0), axis=1)
    sums = np.cumsum(means(reading), axis=0)
    change = sums[2 * _AROUND:] - 2.0 * sums[_AROUND:-_AROUND] + sums[:-2 * _AROUND]
    calm[1 + _AROUND:1 + _AROUND + len(change)] &= np.all(
        np.abs(change) <= _AROUND * _MOVED * step, axis=1)
    known = {key: means(recording[key])[calm] for key in ('time', 'reading', 'rate')
             if key in recording}
    known['reading'] += np.random.default_rng(0).normal(size=known['reading'].shape) * step
    yield recording.take(np.repeat(calm, count[:, 0])), Recording(known, numbered(known))


def coarse_step(values: Floats, noise: float) -> float:
    """Return the step of the output if the noise of a sample is smaller, otherwise 0."""
    levels = np.unique(values[:1_000_000])
    if len(levels) > 4096:
        return 0.0
    gaps = np.diff(levels)
    # Rounding of a computation leaves gaps that are not steps.
    gaps = gaps[gaps > 1e-9 * max(float(np.max(np.abs(levels))), noise)]
    step = float(np.min(gaps)) if len(gaps) else 0.0
    return step if noise < _COARSE * step else 0.0


def _uninterrupted(time: Floats, start: float, end: float) -> Iterator[tuple[int, int]]:
    """Yield first index and end of the parts of a rest without interruptions."""
    inside = np.flatnonzero((time >= start) & (time <= end))
    step = np.diff(time[inside])
    if not len(step):
        return
    # With the mean, because stamps that come in groups have a median near 0.
    usual = float(np.median(step)) + float(np.mean(np.maximum(step, 0.0)))
    cuts = (np.diff(inside) > 1) | (step < 0.0) | (step > _INTERRUPTED * usual)
    for part in np.split(inside, np.flatnonzero(cuts) + 1):
        yield int(part[0]), int(part[-1]) + 1


def _regular(rest: Recording, units: Units) -> LongRest:
    """Return the samples of a rest with equal spacing."""
    time = rest['time']
    step = np.diff(time)
    usual = float(np.median(step))
    notes = []
    late = step > _LONG * usual
    missing = np.maximum(np.round(step[late] / usual) - 1.0, 0.0).sum() if usual > 0.0 else np.inf
    if not 0.0 < missing <= _MOST_MISSING * len(time):
        rate = (len(time) - 1) / float(time[-1] - time[0])
        mean = float(np.mean(step))
        if float(np.std(step)) > _UNEVEN * mean:
            notes.append(
                f'the stamps are uneven ({np.min(step) * 1e3:.3g} to {np.max(step) * 1e3:.3g} ms '
                f'apart): the samples are taken as regular, one each {mean * 1e3:.4g} ms')
    else:
        steps = np.where(late, np.maximum(np.round(step / usual), 1.0), 1.0)
        place = np.append(0.0, np.cumsum(steps)).astype(np.int64)
        rate = place[-1] / float(time[-1] - time[0])
        rest = rest.take(np.searchsorted(place, np.arange(place[-1] + 1), side='right') - 1)
        notes.append(f'{counted(int(missing), "sample")} of {len(rest)} are missing in the rest, '
                     'and are replaced by the sample before')
    values = units.to_g(rest.reading.T)
    if 'rate' in rest:
        values = np.concatenate([values, rest['rate'].T])
    return LongRest(float(time[0]), rate, values, rest.columns.get('temperature'), tuple(notes))


def whole(blocks: Iterable[Recording]) -> Recording:
    """Return blocks of a recording as one, with the columns that all have."""
    parts = [block for block in blocks if len(block)]
    if not parts:
        raise InputError('the recording has no samples, expected a long rest',
                         'check that this is the intended file')
    return concatenated(parts)
