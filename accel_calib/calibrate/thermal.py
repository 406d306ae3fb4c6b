# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The offset as a polynomial in the temperature, from ramps of a still board.

A still board reads, by axis and with g = W ΔR force + V at the reference temperature R,

    reading(T) = g + Σ_k c_k (T - R)^k,   k = 1 to degree.

One orientation does not show offset, gain or tilt, but only the change with the temperature. It is
attributed to the offset; a gain that changes with the temperature looks the same along gravity.
R is 25 °C, or the end of the range that is nearest to it.

**Fit.** Least squares by axis, with one g for each ramp. If the temperature rises and falls, a
term in its rate is fitted, too, and then left out: a thermometer that lags differs between warming
and cooling, which must not bend the polynomial. `hysteresis_mg` is the mean difference between the
two directions at equal temperatures, and `lag_s` the lag that explains it best.

**Deviations.** A slow wander of the offset looks like a change with the temperature. The noise of
a stretch of mean size is therefore white noise of variance σ² plus a random walk, which grows by
ρ σ² a second. The part of the readings outside of the fit has the covariance

    σ² (A + ρ B),   A of the white noise, B of the walk

The generalised eigenvectors of B and A make it diagonal for each ρ. The restricted likelihood [1]_
of all three axes weights a grid of ρ, each with its σ². The covariance of the values is that of
least squares with this noise, averaged over the grid.

**Degree.** With the usual tests, the degree would grow with the wander. Here each of `_BLOCKS`
contiguous parts of the log is predicted from a fit of the others. The lowest degree is taken at
which no higher one predicts better by `_BETTER`, in all and in `_MOST_BLOCKS` of the parts, with
last coefficients that differ from 0 at `_LEVEL` (χ² over the axes).

.. [1] D. A. Harville, Maximum likelihood approaches to variance component estimation, Journal of
   the American Statistical Association 72 (1977) 320.

"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray
import scipy

from .calibration import Calibration, PRIOR, Quality
from .fit import only_norm
from .quality import finished, gated, in_g, record_of
from ..capture import Ramp
from ..effects import effect_named, Model, OFFSET_POWERS, REFERENCE_TEMPERATURE, sensor_force
from ..errors import InputError
from ..estimate import judge
from ..finding import Finding
from ..geometry import coverage, rms, unit
from ..table import Floats, numbered, Poses, range_of
from ..units import MG, Units

DEGREE = 3
"""Largest degree; the autopilots store no more."""

_WALKS = np.array([0.0, *np.geomspace(1e-4, 1e5, 64)])
"""ρ, relative to the one with which the walk between two stretches equals the white noise."""

_WHITE = 0.2
"""Prior probability that there is no walk: most sensors wander. All other ρ are equal."""

_LEVEL = 0.001
"""Probability that a coefficient that is zero is taken for one that is not."""

_BLOCKS = 10
_BETTER, _MOST_BLOCKS = 0.05, 0.6
"""Share by which the error of held-out parts falls, and share of the parts in which it falls."""

_ROWS = 24
"""Number of rows that stand for a ramp among the poses of a calibration."""

_MOVING, _OVERLAP = 0.1, 0.3
"""Part of the largest rate above which the temperature changes; part of the range that warming and
cooling must share for a hysteresis."""

_LEVELS = 10
_MATTERS_MG = 1.0
"""Hysteresis that is worth a finding [mg]."""


@dataclass(frozen=True)
class Curve:
    """
    The offset over the temperature, relative to that at a reference.

    Parameters
    ----------
    reference_c, range_c : float, tuple of float
        Temperature at which the curve is zero, and the lowest and highest temperature [°C].
    values, covariance : (degree, 3) array, (3, degree, degree) array
        c_1, c_2, … by axis [g/°C^k], and the covariance of those of each axis.
    held_out_mg : tuple of float
        Error of held-out parts for degree 0 to 3, RMS of the vector [mg].
    hysteresis_mg, lag_s : float or None
        Difference between warming and cooling [mg], and the lag of the thermometer that explains
        it best [s]; None if the temperature only rises or only falls.
    stretches : Poses
        Stretches of all ramps [g]; rows of one ramp share their ``orientation``.
    change, left : (n, 3) array
        Change of the reading of each stretch since the reference, and what the curve leaves [g].
    warming : (n,) array of bool
        Whether the temperature rises.

    """

    reference_c: float
    range_c: tuple[float, float]
    values: Floats
    covariance: Floats
    held_out_mg: tuple[float, ...]
    hysteresis_mg: float | None
    lag_s: float | None
    stretches: Poses
    change: Floats
    left: Floats
    warming: NDArray[np.bool_]

    @property
    def degree(self) -> int:
        """Return the degree of the polynomial."""
        return len(self.values)

    @property
    def deviations(self) -> Floats:
        """Return the standard deviations of `values`, (degree, 3)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)).T

    def at(self, temperature: Floats) -> Floats:
        """Return the (n, 3) offset at temperatures, relative to the reference [g]."""
        return _powers(temperature - self.reference_c, self.degree) @ self.values

    def deviation_at(self, temperature: Floats) -> Floats:
        """Return the (n, 3) standard deviation of `at` [g]."""
        rows = _powers(temperature - self.reference_c, self.degree)
        return np.sqrt(np.maximum(np.einsum('np,apq,nq->na', rows, self.covariance, rows), 0.0))

    @property
    def band_mg(self) -> float:
        """Return the largest standard deviation over the range, of the vector [mg]."""
        spread = self.deviation_at(np.linspace(*self.range_c, 50))
        return float(np.max(np.linalg.norm(spread, axis=1))) * MG

    @property
    def change_mg(self) -> float:
        """Return the change of the reading with the temperature, RMS of the vector [mg]."""
        return _rms_mg(self.change)

    @property
    def residual_mg(self) -> float:
        """Return what the curve leaves of it, RMS of the vector [mg]."""
        return _rms_mg(self.left)

    @property
    def effects(self) -> tuple[dict[str, Floats], Floats]:
        """Return the effects with their values, and the covariance of these [g²]."""
        shift = REFERENCE_TEMPERATURE - self.reference_c
        degree = max(self.degree, 1)  # degree 0 is stored as a slope of zero
        values, covariance = np.zeros((degree, 3)), np.zeros((3, degree, degree))
        values[:self.degree], covariance[:, :self.degree, :self.degree] = (
            self.values, self.covariance)
        to = np.array([[comb(j, k) * shift ** (j - k) if j >= k else 0.0
                        for j in range(1, degree + 1)] for k in range(degree + 1)])
        first = 0 if shift else 1  # without a shift, the constant is zero
        names = OFFSET_POWERS[first:degree + 1]
        found = dict(zip(names, (to @ values)[first:]))
        spread = np.einsum('kp,apq,lq->kla', to, covariance, to)[first:, first:]
        full = np.zeros((len(names), 3, len(names), 3))
        full[:, range(3), :, range(3)] = np.moveaxis(spread, 2, 0)
        model = {name: effect_named(name).filled(each) for name, each in found.items()}
        return model, full.reshape(3 * len(names), -1)


def curve_of(ramps: Sequence[Ramp]) -> Curve:
    """Return the offset over the temperature from the ramps of one board, of any orientation."""
    stretches, group = _joined(ramps)
    warm, rate = stretches['temperature'], np.concatenate([each.rate for each in ramps])
    low, high = range_of(stretches, 'temperature')
    reference = float(np.clip(REFERENCE_TEMPERATURE, low, high))
    limit = _MOVING * float(np.quantile(np.abs(rate), 0.95))
    rising, falling = rate > limit, rate < -limit
    both = bool(np.any(rising & _shared(warm, falling)))
    powers = _powers(warm - reference, DEGREE)
    beside = np.eye(len(ramps))[group]
    if both:
        beside = np.column_stack([beside, rate])
    designs = [np.column_stack([beside, powers[:, :k]]) for k in range(DEGREE + 1)]
    parts = _parts(stretches['time'], warm)
    errors = [_held_out(stretches.reading, each, parts) for each in designs]
    fits = [(_solved(each, stretches.reading), _covariance(stretches, group, each))
            for each in designs]
    degree, first = _lowest(errors, fits), beside.shape[1]
    values, covariance = fits[degree][0][first:], fits[degree][1][:, first:, first:]
    curve_g = powers[:, :degree] @ values
    rest = np.array([np.mean((stretches.reading - curve_g)[group == k], axis=0)
                     for k in range(len(ramps))])
    change = stretches.reading - rest[group]
    left = change - curve_g
    hysteresis, lag = (_hysteresis(warm, rate, left, values, rising, falling) if both
                       else (None, None))
    return Curve(reference, (low, high), values, covariance,
                 tuple(float(np.sqrt(np.mean(each))) * MG for each in errors), hysteresis, lag,
                 stretches, change, left, rate >= 0.0)


def _joined(ramps: Sequence[Ramp]) -> tuple[Poses, NDArray[np.intp]]:
    """Return the stretches of all ramps, and the ramp of each."""
    group = np.repeat(np.arange(len(ramps)), [len(each.stretches) for each in ramps])
    columns = {key: np.concatenate([each.stretches[key] for each in ramps])
               for key in ramps[0].stretches.columns}
    columns['orientation'] = -1.0 - group  # no number of a pose
    first = ramps[0].stretches
    return Poses(columns, numbered(columns), 'g', first.sensor, first.autopilot), group


def _powers(warm: Floats, degree: int) -> Floats:
    """Return the (n, degree) powers from 1 on."""
    return np.asarray(warm[:, np.newaxis] ** np.arange(1, degree + 1))


def _parts(time: Floats, warm: Floats) -> NDArray[np.intp]:
    """Return the part of each stretch, with equal shares of time and way of the temperature."""
    way = np.abs(np.diff(warm, prepend=warm[0]))
    share = np.cumsum(way / max(float(way.sum()), 1e-9) + 1.0 / len(time)) / 2.0
    return np.minimum((share * _BLOCKS).astype(np.intp), _BLOCKS - 1)


def _held_out(reading: Floats, design: Floats, parts: NDArray[np.intp]) -> Floats:
    """Return the mean squared error of each part, predicted from a fit of the others [g²]."""
    errors = []
    for part in np.unique(parts):
        out = parts == part
        left = (reading - design @ _solved(design[~out], reading[~out]))[out]
        errors.append(np.mean(np.sum(left ** 2, axis=1)))
    return np.array(errors)


def _covariance(stretches: Poses, group: NDArray[np.intp], design: Floats) -> Floats:
    """Return the covariance of the values of least squares by axis, (3, p, p)."""
    count, time = stretches['count'], stretches['time']
    white, walk = np.diag(np.mean(count) / count), np.zeros((len(time), len(time)))
    for own in (group == k for k in np.unique(group)):
        since = time[own] - time[own][0]
        walk[np.ix_(own, own)] = np.minimum.outer(since, since)
    outside = np.linalg.qr(design, mode='complete')[0][:, design.shape[1]:]
    ratio, axes = scipy.linalg.eigh(*(outside.T @ each @ outside for each in (walk, white)))
    squares = (axes.T @ (outside.T @ stretches.reading)) ** 2
    walks = _WALKS / np.median(np.diff(time))
    spread = 1.0 + np.outer(walks, ratio)
    variance = (1.0 / spread) @ squares / len(ratio)
    likelihood = -1.5 * np.sum(np.log(spread), axis=1) - len(ratio) / 2.0 * np.sum(
        np.log(variance + 1e-300), axis=1)
    share = np.exp(likelihood - np.max(likelihood))
    share *= np.where(walks == 0.0, _WHITE, (1.0 - _WHITE) / (len(walks) - 1))
    sizes = (share / np.sum(share))[:, np.newaxis] * variance
    onto = np.linalg.pinv(design)
    white, walk = (onto @ each @ onto.T for each in (white, walk))
    return np.asarray(np.multiply.outer(np.sum(sizes, axis=0), white)
                      + np.multiply.outer(walks @ sizes, walk))


def _lowest(errors: Sequence[Floats], fits: Sequence[tuple[Floats, Floats]]) -> int:
    """Return the lowest degree at which no higher one is seen and predicts better."""
    degree = 0
    for higher in range(1, len(errors)):
        one, other = errors[degree], errors[higher]
        falls = np.sqrt(np.mean(other)) < (1.0 - _BETTER) * np.sqrt(np.mean(one))
        values, covariance = fits[higher]
        chi2 = np.sum(values[-1] ** 2 / covariance[:, -1, -1])
        if (falls and np.mean(other < one) >= _MOST_BLOCKS
                and scipy.special.chdtrc(len(covariance), chi2) < _LEVEL):
            degree = higher
    return degree


def _solved(design: Floats, reading: Floats) -> Floats:
    return np.asarray(np.linalg.lstsq(design, reading, rcond=None)[0])


def _shared(warm: Floats, other: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which temperatures lie in the range of the other rows, if that is wide enough."""
    if np.sum(other) < 2 or np.ptp(warm[other]) < _OVERLAP * np.ptp(warm):
        return np.zeros(len(warm), bool)
    return np.asarray((warm >= warm[other].min()) & (warm <= warm[other].max()))


def _hysteresis(warm: Floats, rate: Floats, left: Floats, values: Floats,
                rising: NDArray[np.bool_], falling: NDArray[np.bool_]
                ) -> tuple[float, float | None]:
    """Return the difference between warming and cooling [mg], and the lag that explains it [s]."""
    level = np.digitize(warm, np.linspace(warm.min(), warm.max(), _LEVELS + 1)[1:-1])
    apart = [left[rising & (level == k)].mean(axis=0) - left[falling & (level == k)].mean(axis=0)
             for k in range(_LEVELS) if np.any(rising & (level == k))
             and np.any(falling & (level == k))]
    if not apart:
        return 0.0, None
    by_rate = _solved(rate[:, np.newaxis], left)[0]
    slope = values[0] if len(values) else np.zeros(3)
    lag = float(by_rate @ slope / (slope @ slope)) if np.any(slope) else None
    return float(np.linalg.norm(np.mean(apart, axis=0))) * MG, lag


def findings_of_curve(curve: Curve) -> tuple[Finding, ...]:
    """Return what ramps of a still board leave open, and a hysteresis that matters."""
    found = [Finding('open', 'a still board does not show a gain that changes with the '
                     'temperature: along gravity it counts as offset', 'to determine it, take '
                     'poses on all sides while cold and while warm, and run refine')]
    if curve.hysteresis_mg is not None and curve.hysteresis_mg > _MATTERS_MG:
        lag = '' if curve.lag_s is None else f', as if the thermometer lags by {curve.lag_s:.0f} s'
        found.append(Finding(
            'thermal_hysteresis', f'between warming and cooling the readings differ by '
            f'{curve.hysteresis_mg:.1f} mg at the same temperature{lag}',
            'warm and cool the board more slowly, in a closed box', 'USABLE'))
    return tuple(found)


def ramp_rows(curve: Curve, units: Units) -> Poses:
    """
    Return means of successive stretches that stand for the ramps, in the unit of the readings.

    Their noise is the RMS of what the curve leaves, which includes the slow wander.

    """
    stretches = curve.stretches
    share = np.arange(len(stretches)) * _ROWS // len(stretches)
    warm = stretches['temperature']
    share[[np.argmin(warm), np.argmax(warm)]] = _ROWS + np.arange(2)  # they state the range
    _, place = np.unique(np.column_stack([stretches['orientation'], share]), axis=0,
                         return_inverse=True)
    members = (place.ravel() == np.arange(place.max() + 1)[:, np.newaxis]).astype(float)
    members = members[np.argsort(members @ stretches['time'] / members.sum(axis=1), kind='stable')]
    size, count = members.sum(axis=1), members @ stretches['count']
    left, reading = (members @ values / size[:, np.newaxis]
                     for values in (curve.left, stretches.reading))
    noise = np.sqrt(np.mean(left ** 2, axis=0))
    columns = {'reading': units.from_g(reading), 'count': count,
               'std': units.from_g(noise * np.sqrt(count)[:, np.newaxis]),
               **{key: members @ stretches[key] / size
                  for key in ('time', 'temperature', 'orientation')}}
    return Poses(columns, numbered(columns), units.name, stretches.sensor, stretches.autopilot)


def thermal_alone(curve: Curve, units: Units, *, sensor: str = '', date: str = '') -> Calibration:
    """
    Return a calibration with the offset over the temperature alone, zero at the reference.

    Its residuals are the changes of the reading with the temperature, before and after.

    """
    values, covariance = curve.effects
    rows = ramp_rows(curve, units)
    noise = curve.stretches.noise
    floor = None if noise is None else _rms_mg(noise)
    before, after = (np.linalg.norm(each, axis=1) for each in (curve.change, curve.left))
    quality = Quality(
        curve.change_mg, curve.residual_mg, float(before.max()) * 100.0,
        float(after.max()) * 100.0, curve.held_out_mg[curve.degree], floor, None,
        coverage(unit(rows.reading)))
    return finished(Calibration(
        'ideal', PRIOR, Model(values), units, rows.sensor, 'ros', '', covariance,
        quality, rows, (), f'offset over temperature alone, of degree {curve.degree}, relative to '
        f'{curve.reference_c:.1f} °C', findings_of_curve(curve)), sensor, date)


def _rms_mg(vectors: Floats) -> float:
    return rms(np.linalg.norm(vectors, axis=1)) * MG


def without_curve(curve: Curve, poses: Poses, units: Units) -> Poses:
    """
    Return poses with the readings that they would have at 25 °C, and without orientations.

    Raises
    ------
    InputError
        If the poses have no temperature.

    """
    if 'temperature' not in poses or not np.all(np.isfinite(poses['temperature'])):
        raise InputError('the poses have no temperature, expected one for each', 'record the '
                         'temperature with the poses, too, or name its column with --columns '
                         'temperature=NAME')
    moved = poses.reading - units.from_g(_added(curve, poses))
    return poses.without_columns('reference', 'orientation').with_columns(reading=moved)


def _added(curve: Curve, poses: Poses) -> Floats:
    """Return what the temperature adds to each pose, relative to 25 °C [g]."""
    at_25 = curve.at(np.array([REFERENCE_TEMPERATURE]))
    return np.asarray(curve.at(poses['temperature']) - at_25)


def with_curve(fitted: Calibration, curve: Curve, poses: Poses) -> Calibration:
    """
    Return a calibration of poses with the curve, and with the ramps among its poses.

    `fitted` is that of `without_curve`. The uncertainty of the curve moves the values of the fit:
    by least squares, d values = -(J⁺ K) d curve, with J and K the derivatives of the equations of
    the poses.

    """
    thermal, spread = curve.effects
    powers = {name: values for name, values in thermal.items() if name in OFFSET_POWERS[1:]}
    model, own = Model({**fitted.model.values, **powers}), len(fitted.model.vector)
    used_g = in_g(fitted.used_poses, fitted.units)
    moved = only_norm(used_g.with_columns(reading=used_g.reading + _added(curve, used_g)))
    columns = judge(model, moved.with_columns(temperature=used_g['temperature'])).columns
    move = -np.linalg.pinv(columns[:, :own]) @ columns[:, own:]
    of_curve = spread[-3 * len(powers):, -3 * len(powers):]
    covariance = np.block([[fitted.covariance + move @ of_curve @ move.T, move @ of_curve],
                           [of_curve @ move.T, of_curve]])
    every = _together(poses, ramp_rows(curve, fitted.units))
    rejected = [each.row for each in fitted.rejected]
    kept_g = in_g(every.take(~np.isin(every.row, rejected)), fitted.units)
    made = record_of(
        judge(model, kept_g), every, fitted.units, unit(sensor_force(
            model, kept_g.reading, kept_g.columns)), fitted.name, fitted.method,
        covariance=covariance, rejected=fitted.rejected,
        reason=f'{fitted.reason}; offset over temperature of degree {curve.degree}',
        noted=(*fitted.noted, *findings_of_curve(curve)))
    return gated(replace(made, gyro=fitted.gyro, noise=fitted.noise, sensor=fitted.sensor,
                         date=fitted.date))


def _together(poses: Poses, rows: Poses) -> Poses:
    """Return poses followed by the rows of ramps, with the columns that both have."""
    own = poses.with_columns(orientation=np.arange(1.0, len(poses) + 1.0))
    row = np.concatenate([poses.row, int(poses.row.max()) + rows.row])
    return replace(poses, row=row, columns={
        key: np.concatenate([own[key], values]) for key, values in rows.columns.items()
        if key in own})
