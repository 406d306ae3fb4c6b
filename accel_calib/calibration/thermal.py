# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The effects of temperature on a still board, from ramps.

A still board does not show offset, gain or tilt, but only what changes. With effects that add to
the offset, it reads by axis

    reading = level + Σ_k c_k f_k(temperature, its rate, time)

with one level for each ramp and the factors f of the catalogue: powers of T - 25 °C up to
`DEGREE`, the rate of the temperature or a lag, and a step. A gain that changes with the
temperature looks the same along gravity. The curve is zero at 25 °C, or at the end of the range
that is nearest to it.

**Choice.** With the usual tests, a polynomial follows the wander of the offset. Here each of
`_BLOCKS` contiguous parts of the log is predicted from a fit of the others. What predicts best is
added, until nothing does so by `_BETTER`, in all and in `_MOST_BLOCKS` of the parts. Then each
effect is dropped without which the prediction is as good, or whose values do not differ from 0 at
`_LEVEL` (χ², for a step times the number of instants). A rate or a lag is tried only if the
temperature does not replace it: if it only rises to that of the room, its rate is a straight line
in the temperature.

**Deviations.** A slow wander of the offset looks like a change with the temperature. The noise of
a stretch of mean size is therefore white noise of variance σ² plus a random walk, which grows by
ρ σ² a second. The part of the readings outside of the fit has the covariance

    σ² (A + ρ B),   A of the white noise, B of the walk

The generalised eigenvectors of B and A make it diagonal for each ρ. The restricted likelihood [1]_
of an axis weights a grid of ρ, each with its σ². The covariance of the values is that of
least squares with this noise, averaged over the grid.

.. [1] D. A. Harville, Maximum likelihood approaches to variance component estimation, Journal of
   the American Statistical Association 72 (1977) 320.

"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from .calibration import Calibration, PRIOR, Quality
from .quality import finished, gated, in_g, record_of
from ..effects import (
    add_history, Context, EffectKey, EFFECTS, entry_of, factors_of, Model, OFFSET_POWERS,
    parameter_names, REFERENCE_TEMPERATURE, sensor_force, with_vector)
from ..errors import InputError
from ..estimate import judge
from ..finding import Finding
from ..geometry import coverage, unit
from ..statistics import rms
from ..stillness import Ramp
from ..table import concatenated, Floats, numbered, Poses, range_of
from ..units import MG, Units

_POWERS = OFFSET_POWERS[1:]
_LINEAR, _RATE, _STEP = _POWERS[0], 'temperature_rate', 'offset_step'

DEGREE = len(_POWERS)
"""Largest degree; the autopilots store no more."""

_WALKS = np.array([0.0, *np.geomspace(1e-4, 1e5, 64)])
"""ρ, relative to the one with which the walk between two stretches equals the white noise."""

_WHITE = 0.2
"""Prior probability that there is no walk: most sensors wander. All other ρ are equal."""

_LEVEL = 0.001
"""Probability that a value that is zero is taken for one that is not."""

_BLOCKS = 10
_BETTER, _MOST_BLOCKS = 0.05, 0.6
"""Share by which the error of held-out parts falls, without the noise, and share of the parts in
which it falls."""

_APART = 0.3
"""Smallest part of a rate or lag that the other columns do not replace, as a size."""

_BESIDE, _LEAST_G = 4, 0.001
"""Number of stretches on each side of a step that show it, and smallest step [g]; smaller ones are
as likely a bend that the effects lack."""

_ROWS, _ROWS_OF_RATE = 24, 72
"""Number of rows that stand for a ramp among the poses of a calibration; if the rate acts."""

_UNCHANGED: dict[EffectKey, Floats] = {_LINEAR: np.zeros(3)}
"""What is stored if the offset does not change."""

Form = Mapping[str, Floats]
"""Effects by name, with their shape."""


@dataclass(frozen=True)
class Curve:
    """
    The effects of temperature on the offset.

    Parameters
    ----------
    reference_c, range_c : float, tuple of float
        Temperature at which the curve is zero, and the lowest and highest temperature [°C].
    model : Model
        The effects, zero at 25 °C.
    covariance : (p, p) array
        Covariance of ``model.vector`` [g²].
    held_out_mg : mapping of str to float
        Error of held-out parts, RMS of the vector [mg], with the effects in the order of the
        search: without any, and with each sum of effects.
    both : bool
        Whether the temperature both rises and falls.
    stretches : Poses
        Stretches of all ramps [g]; rows of one ramp share their ``orientation``.
    change, left : (n, 3) array
        Change of the reading of each stretch since the reference, and what the effects leave [g].

    """

    reference_c: float
    range_c: tuple[float, float]
    model: Model
    covariance: Floats
    held_out_mg: Mapping[str, float]
    both: bool
    stretches: Poses
    change: Floats
    left: Floats

    @property
    def degree(self) -> int:
        """Return the degree of the polynomial in the temperature."""
        return sum(name in self.model.effects for name in _POWERS)

    def at(self, temperature: Floats) -> Floats:
        """Return the (n, 3) offset at steady temperatures, relative to the reference [g]."""
        return self._moved(temperature) @ self.model.vector

    def deviation_at(self, temperature: Floats) -> Floats:
        """Return the (n, 3) standard deviation of `at` [g]."""
        moved = self._moved(temperature)
        return np.sqrt(np.maximum(np.sum(moved @ self.covariance * moved, axis=2), 0.0))

    def _moved(self, temperature: Floats) -> Floats:
        """Return the (n, 3, p) derivative of `at` by the values of the model."""
        found = self.steady_basis(self.model, np.append(temperature, self.reference_c))
        return found[:-1] - found[-1]

    def steady_basis(self, model: Model, temperature: Floats) -> Floats:
        """Return the (n, 3, p) basis at temperatures that do not change, after the ramps."""
        time = np.full(len(temperature), np.max(self.stretches['time']))
        return _basis(model, [{
            'temperature': temperature, 'time': time, _RATE: np.zeros_like(temperature),
            entry_of(_LINEAR).lagged: temperature}])

    @property
    def band_mg(self) -> float:
        """Return the largest standard deviation over the range, of the vector [mg]."""
        spread = self.deviation_at(np.linspace(*self.range_c, 50))
        return float(np.max(np.linalg.norm(spread, axis=1))) * MG

    @property
    def change_mg(self) -> float:
        """Return the change of the reading with the temperature, RMS of the vector [mg]."""
        return rms(np.linalg.norm(self.change, axis=1)) * MG

    @property
    def residual_mg(self) -> float:
        """Return what the effects leave of it, RMS of the vector [mg]."""
        return rms(np.linalg.norm(self.left, axis=1)) * MG

    def stored(self, *left_out: str) -> tuple[Model, Floats]:
        """Return the effects that a calibration stores, without some, and their covariance."""
        model = Model({name: values for name, values in self.model.values.items()
                       if name not in left_out} or _UNCHANGED)
        names, own = parameter_names(model.effects), parameter_names(self.model.effects)
        place, kept = np.isin(names, own), np.isin(own, names)
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(place, place)] = self.covariance[np.ix_(kept, kept)]
        return model, covariance


@dataclass(frozen=True)
class _Board:
    """
    Stretches of all ramps.

    The (n, r) `levels` are 1 where a stretch belongs to a ramp and 0 elsewhere, and `contexts` are
    columns by ramp.

    """

    stretches: Poses
    levels: Floats
    contexts: Sequence[Context]

    def columns(self, form: Form) -> Floats:
        """Return the (n, k) factors of effects."""
        found = [np.concatenate([factors_of(name, [shape], each)[0, 0] for each in self.contexts])
                 for name, shape in form.items()]
        return np.reshape(found, (len(form), len(self.levels))).T

    def span(self, form: Form) -> Floats:
        """Return the (n, r + k) orthonormal basis of levels and factors."""
        return np.linalg.qr(np.column_stack([self.levels, self.columns(form)]))[0]

    def errors(self, form: Form) -> Floats:
        """
        Return the mean squared error of each part, predicted from a fit of the others [g²].

        The parts have equal shares of time and way of the temperature. With the orthonormal
        columns Q of the fit of all, the errors r of a part become r + Q_b (I - Q_bᵀ Q_b)⁻¹ Q_bᵀ r.

        """
        warm = self.stretches['temperature']
        way = np.abs(np.diff(warm, prepend=warm[0]))
        share = np.cumsum(way / max(float(way.sum()), 1e-9) + 1.0 / len(warm)) / 2.0
        parts = np.minimum((share * _BLOCKS).astype(np.intp), _BLOCKS - 1)
        basis = self.span(form)
        left = self.stretches.reading - basis @ (basis.T @ self.stretches.reading)
        found = []
        for part in np.unique(parts):
            own = basis[parts == part]
            rest = np.linalg.pinv(np.eye(basis.shape[1]) - own.T @ own, hermitian=True)
            away = left[parts == part]
            away = away + own @ (rest @ (own.T @ away))
            found.append(np.mean(np.sum(away ** 2, axis=1)))
        return np.array(found)

    def is_better(self, one: Floats, other: Floats) -> bool:
        """Return whether the first errors of held-out parts are clearly smaller."""
        noise = np.mean(np.sum(self.stretches['std'] ** 2, axis=1) / self.stretches['count'])
        ours, theirs = (max(np.mean(each) - noise, 0.0) for each in (one, other))
        return bool(ours < (1.0 - _BETTER) ** 2 * theirs and np.mean(one < other) >= _MOST_BLOCKS)

    def shapes(self, name: str) -> list[Floats]:
        """Return the shapes of an effect that can be tried, apart from the usual one."""
        effect = EFFECTS[name]
        if name == _STEP and len(self.contexts) > 1:
            return []
        found = [np.zeros(0)] if effect.shapes is None else effect.shapes(self.contexts[0])
        return [shape for shape in found if effect.is_lagged(shape) or not effect.lagged]

    def further(self, form: Form) -> Iterator[Form]:
        """Yield what can be tried in place of a form."""
        degree = sum(name in form for name in _POWERS)
        for more in range(degree + 1, DEGREE + 1):
            yield {**form, **{name: np.array(EFFECTS[name].usual)
                              for name in _POWERS[degree:more]}}
        steady = {name: shape for name, shape in form.items() if name != _RATE}
        powers = {_LINEAR: np.array(EFFECTS[_LINEAR].usual),
                  **{name: shape for name, shape in form.items() if name in _POWERS}}
        bases = [self.span({}), self.span(powers)]
        for name in (*([] if _RATE in form or _lagged(form) else [_RATE]),
                     *([_LINEAR] if degree else [])):
            for shape in self.shapes(name):
                column = self.columns({name: shape})
                moved, apart = (np.linalg.norm(column - basis @ (basis.T @ column))
                                for basis in bases)
                if apart > _APART * moved > 0.0:  # levels and temperature do not replace it
                    yield {**steady, name: shape}
        if _STEP not in form:
            for shape in self.shapes(_STEP):
                yield {**form, _STEP: shape}

    def fit(self, form: Form) -> tuple[Model, Floats]:
        """Return effects fitted by least squares, and the covariance of their values."""
        reading, count = self.stretches.reading, len(self.levels)
        model = Model({name: np.concatenate([np.zeros(3), shape]) for name, shape in form.items()})
        levels = np.kron(np.eye(3), self.levels).reshape(3, count, -1)
        for _ in range(11 if _lagged(form) else 1):  # a lag, from the best one of the catalogue
            own = np.moveaxis(_basis(model, self.contexts)[..., model.fitted], 1, 0)
            design = np.concatenate([levels, own], axis=2).reshape(3 * count, -1)
            onto = np.linalg.pinv(design)[levels.shape[2]:]
            vector = model.vector.copy()
            vector[model.fitted] += onto @ (reading - self.predicted(model)).T.ravel()
            if model.lags:  # stay positive
                lag = model.terms.parts[model.effects.index(_LINEAR)].start + 3
                vector[lag] = np.clip(vector[lag], *(model.vector[lag] * np.array([0.5, 2.0])))
            model = with_vector(model.effects, vector)
        covariance = np.zeros((len(model.vector),) * 2)
        covariance[np.ix_(model.fitted, model.fitted)] = self._covariance(
            np.column_stack([self.levels, self.columns({
                str(name): entry_of(name).split(values)[1]
                for name, values in model.values.items()})]), onto.reshape(-1, 3, count))
        return model, covariance

    def is_seen(self, form: Form, name: str) -> bool:
        """Return whether an effect of a form differs from 0; a step also shows as a jump."""
        model, covariance = self.fit(form)
        part, values = model.terms.parts[model.effects.index(name)], model.values[name]
        size, own = values[:3], slice(part.start, part.start + 3)
        chance = scipy.special.chdtrc(3, size @ np.linalg.solve(covariance[own, own], size))
        if name != _STEP:
            return bool(chance < _LEVEL)
        left = self.stretches.reading - self.predicted(model)
        first = int(np.argmax(self.stretches['time'] >= values[3]))
        jump = size + np.mean(left[first:first + _BESIDE], axis=0) - np.mean(
            left[max(first - _BESIDE, 0):first], axis=0)
        return bool(len(self.shapes(_STEP)) * chance < _LEVEL and np.linalg.norm(size) > _LEAST_G
                    and jump @ size > 0.5 * size @ size)

    def predicted(self, model: Model) -> Floats:
        """Return the (n, 3) offset of each stretch [g]."""
        return np.concatenate([np.zeros_like(each['reading']) + model.at(each).vec_v
                               for each in self.contexts])

    def _covariance(self, design: Floats, onto: Floats) -> Floats:
        """Return the covariance of values that are `onto`, (q, 3, n), times the readings."""
        time = self.stretches['time']
        white = np.diag(np.mean(self.stretches['count']) / self.stretches['count'])
        walk = np.zeros((len(time), len(time)))
        for own in self.levels.T > 0.0:
            since = time[own] - time[own][0]
            walk[np.ix_(own, own)] = np.minimum.outer(since, since)
        outside = np.linalg.qr(design, mode='complete')[0][:, design.shape[1]:]
        ratio, axes = scipy.linalg.eigh(*(outside.T @ each @ outside for each in (walk, white)))
        squares = (axes.T @ (outside.T @ self.stretches.reading)) ** 2
        walks = _WALKS / np.median(np.diff(time))
        spread = 1.0 + np.outer(walks, ratio)
        variance = (1.0 / spread) @ squares / len(ratio)
        likelihood = -0.5 * np.sum(np.log(spread), axis=1)[:, np.newaxis] - (
            len(ratio) / 2.0 * np.log(variance + 1e-300))
        share = np.exp(likelihood - np.max(likelihood, axis=0))
        share *= np.where(walks == 0.0, _WHITE, (1.0 - _WHITE) / (len(walks) - 1))[:, np.newaxis]
        sizes = share / np.sum(share, axis=0) * variance
        found = np.zeros((len(onto), len(onto)))
        for row, by_walk, own in zip(np.sum(sizes, axis=0), walks @ sizes, np.moveaxis(onto, 1, 0),
                                     strict=True):
            found += own @ (row * white + by_walk * walk) @ own.T
        return found


def _lagged(form: Form) -> bool:
    return _LINEAR in form and EFFECTS[_LINEAR].is_lagged(form[_LINEAR])


def _basis(model: Model, contexts: Sequence[Context]) -> Floats:
    """Return the (n, 3, p) derivative of the offset by all values."""
    return np.concatenate([model.basis(np.zeros((len(each['time']), 3)), each).full
                           for each in contexts])


def curve_of(ramps: Sequence[Ramp]) -> Curve:
    """Return the effects of temperature from the ramps of one board, of any orientation."""
    tables, end = [], -np.inf
    for k, each in enumerate(ramp.stretches for ramp in ramps):  # one after the other in time
        time = each['time']
        if time[0] <= end:  # another clock
            time = time - time[0] + end + np.ptp(time)
        orientation = np.full(len(time), -1.0 - k)  # no number of a pose
        tables.append(each.with_columns(time=time, orientation=orientation))
        end = float(time[-1])
    stretches = concatenated(tables)
    levels = np.eye(len(tables))[-1 - stretches['orientation'].astype(np.intp)]
    board = _Board(stretches, levels, [each.columns for each in tables])
    form: Form = {}
    errors = board.errors(form)
    held_out = {'': errors}
    while better := [(each, own) for each in board.further(form)
                     if board.is_better(own := board.errors(each), errors)]:
        form, errors = min(better, key=lambda each: float(np.mean(each[1])))
        held_out[' + '.join(form)] = errors
    form, errors = _without_idle(board, form, errors)
    held_out.pop(' + '.join(form), None)
    held_out[' + '.join(form)] = errors  # the last one
    model, covariance = board.fit(form)
    low, high = range_of(stretches, 'temperature')
    offset = board.predicted(model)
    left = stretches.reading - offset
    left = left - levels @ (levels.T @ left / levels.sum(axis=0)[:, np.newaxis])
    curve = Curve(
        reference_c=float(np.clip(REFERENCE_TEMPERATURE, low, high)), range_c=(low, high),
        model=model, covariance=covariance, both=any(each.both for each in ramps),
        held_out_mg={name: float(np.sqrt(np.mean(each))) * MG for name, each in held_out.items()},
        stretches=stretches, change=np.zeros(3), left=left)
    at_25 = curve.at(np.array([REFERENCE_TEMPERATURE]))
    return replace(curve, change=left + offset + at_25)


def _without_idle(board: _Board, form: Form, errors: Floats) -> tuple[Form, Floats]:
    """Return a form without what predicts nothing, or does not differ from 0."""
    highest = sum(name in form for name in _POWERS)
    tried = [name for name in (_RATE, _STEP, *_POWERS[max(highest - 1, 0):highest])
             if name in form or (name == _RATE and _lagged(form))]
    for name in tried:
        fewer = {each: shape for each, shape in form.items() if each != name}
        seen = form
        if name == _RATE and _lagged(form):
            fewer[_LINEAR] = np.array(EFFECTS[_LINEAR].usual)
            seen = {**fewer, _RATE: np.zeros(0)}  # a lag acts as a rate does
        own = board.errors(fewer)
        if not (board.is_better(errors, own) and board.is_seen(seen, name)):
            return _without_idle(board, fewer, own)
    return form, errors


def findings_of_curve(curve: Curve) -> tuple[Finding, ...]:
    """Return what ramps of a still board leave open, and a step."""
    found = [Finding('open', 'a still board does not show a gain that changes with the '
                     'temperature: along gravity it counts as offset', 'to determine it, take '
                     'poses on all sides while cold and while warm, and run refine')]
    if not curve.both:
        found.append(Finding('open', 'a lag of the thermometer is not known, because the '
                             'temperature only rises or only falls', 'let the board cool again '
                             'while recording'))
    if _STEP in curve.model.effects:
        *size, instant = curve.model.values[_STEP]
        since = instant - float(curve.stretches['time'][0])
        found.append(Finding(
            'thermal_step', f'the readings jump by {np.linalg.norm(size) * MG:.1f} mg '
            f'{since:.0f} s after the start', 'record again, with the board fixed; if the jump '
            'comes again at the same temperature, calibrate on each side of it', 'USABLE'))
    return tuple(found)


def ramp_rows(curve: Curve, units: Units) -> Poses:
    """
    Return means of successive stretches that stand for the ramps, in the unit of the readings.

    Their noise is the RMS of what the effects leave, which includes the slow wander.

    """
    stretches = curve.stretches
    rows = _ROWS_OF_RATE if {_RATE, 'time'} & {*curve.model.over, *curve.model.needs} else _ROWS
    share = np.arange(len(stretches)) * rows // len(stretches)
    warm = stretches['temperature']
    share[[np.argmin(warm), np.argmax(warm)]] = rows + np.arange(2)  # they state the range
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
    Return a calibration with the effects of temperature alone, zero at the reference.

    Its residuals are the changes of the reading with the temperature, before and after.

    """
    (model, covariance), rows = curve.stored(), ramp_rows(curve, units)
    if curve.reference_c != REFERENCE_TEMPERATURE:
        here = curve.steady_basis(model, np.array([curve.reference_c]))[0]
        to = np.vstack([-here, np.eye(len(model.vector))])
        model = Model({'offset': to[:3] @ model.vector, **model.values})
        covariance = to @ covariance @ to.T
    before, after = (np.linalg.norm(each, axis=1) for each in (curve.change, curve.left))
    noise = np.sqrt(np.sum(curve.stretches['std'] ** 2, axis=1) / curve.stretches['count'])
    quality = Quality(
        rms_before_mg=curve.change_mg, rms_after_mg=curve.residual_mg,
        max_before_percent=float(before.max()) * 100.0,
        max_after_percent=float(after.max()) * 100.0,
        held_out_rms_mg=[*curve.held_out_mg.values()][-1], chi2_per_dof=None,
        noise_floor_mg=rms(noise) * MG,
        coverage=coverage(unit(rows.reading)))
    return finished(Calibration(
        name='ideal', method=PRIOR, model=model, units=units, sensor=rows.sensor, frame='ros',
        date='', covariance=covariance, quality=quality, poses=rows, rejected=(),
        reason=f'{_words(curve)} alone, relative to {curve.reference_c:.1f} °C',
        noted=findings_of_curve(curve)), sensor, date)


def _words(curve: Curve) -> str:
    """Return what a calibration has of a curve."""
    others = [str(name) for name in curve.model.effects if name not in _POWERS]
    return ' and '.join([f'offset over temperature of degree {curve.degree}', *others])


def without_curve(curve: Curve, poses: Poses, units: Units) -> Poses:
    """
    Return poses with the readings that they would have at 25 °C, and without orientations.

    Raises
    ------
    InputError
        If the poses have no temperature, or no time while its rate acts.

    """
    if 'temperature' not in poses or not np.all(np.isfinite(poses['temperature'])):
        raise InputError('the poses have no temperature, expected one for each', 'record the '
                         'temperature with the poses, too, or name its column with --columns '
                         'temperature=NAME')
    model = curve.stored(_STEP)[0]  # the time of another log is another one
    moved = poses.reading - units.from_g(model.at(add_history(poses, model).columns).vec_v)
    return poses.without_columns('reference', 'orientation').with_columns(reading=moved)


def with_curve(fitted: Calibration, curve: Curve, poses: Poses) -> Calibration:
    """
    Return a calibration of poses with the effects of temperature, and the ramps among its poses.

    `fitted` is that of `without_curve`. The uncertainty of the curve moves the values of the fit:
    by least squares, d values = -(J⁺ K) d curve, with J and K the derivatives of the equations of
    the poses.

    """
    (thermal, of_curve), own = curve.stored(_STEP), len(fitted.model.vector)
    model, units = Model({**fitted.model.values, **thermal.values}), fitted.units
    used_g = in_g(poses.take(np.isin(poses.row, fitted.used_poses.row)), units)
    judged = judge(model, add_history(used_g.without_columns('reference', 'orientation'), model))
    columns = judged.columns @ judged.ties.T
    move = -np.linalg.pinv(columns[:, :own]) @ columns[:, own:]
    covariance = np.block([[fitted.covariance + move @ of_curve @ move.T, move @ of_curve],
                           [of_curve @ move.T, of_curve]])
    rows = ramp_rows(curve, units)
    every = concatenated([
        poses.with_columns(orientation=np.arange(1.0, len(poses) + 1.0)),
        replace(rows, row=int(poses.row.max()) + rows.row)])
    rejected = [each.row for each in fitted.rejected]
    kept_g = add_history(in_g(every.take(~np.isin(every.row, rejected)), units), model)
    made = record_of(
        judge(model, kept_g), every, units, unit(sensor_force(
            model, kept_g.reading, kept_g.columns)), name=fitted.name, method=fitted.method,
        covariance=covariance, rejected=fitted.rejected,
        reason=f'{fitted.reason}; {_words(curve)}',
        noted=(*fitted.noted, *findings_of_curve(curve)))
    return gated(replace(made, gyro=fitted.gyro, noise=fitted.noise, sensor=fitted.sensor,
                         date=fitted.date))
