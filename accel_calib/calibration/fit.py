# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The fit: from poses to a calibration.

The method ``ml``, the default, weights poses by their noise and leaves out outliers. The method
``algebraic`` minimises the cost functions of AN5286 and the ESGI'95 report, unweighted and with
every row.

**Unknown orientation.** Model 4, 7, 9 or 10 is fitted by |force| = 1 g. ``auto`` goes from the
smallest model to larger models. It selects each model that explains significantly more than noise,
by an F test at `_LEVEL_OF_MODELS` with the moderated variance of `accel_calib.estimate.fit.Fit`.

**Known orientation.** Model 12 is fitted, or model 10 if the sensor was placed badly.
An orientation is known only as accurately as the sensor was placed. A placement error of 2° turns
the force by 35 mg but does not change its length, so a fit by |force| = 1 g is not affected. If
the poses determine model 10, its forces are rotated onto the known forces (orthogonal Procrustes
problem, Schönemann 1966, with Huber's weights so that one misplaced pose has little influence).
The remaining differences are tangential. If an F test shows that they are larger than the noise
and the uncertainty of the fit explain, the fit uses only |force| = 1 g. The known orientations
then determine only the rotation of the axes, ΔR.

"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import scipy

from .calibration import Calibration, ORIENTED, Rejected
from .directions import (
    determines, dilution, directions_of, free_parameters, LARGEST_DILUTION, NORM_MODELS,
    poses_needed)
from .mounting import wiring
from .planning import find_undetermined, refuse_if_unfit
from .quality import finished, fit_findings, in_g, LARGEST_OFFSET_G, record_of, rival_findings
from ..effects import EFFECTS, length_rows, linear_model, Model, MODELS, sensor_force, with_vector
from ..errors import RefusedFitError, TAKE_ALL_SIDES
from ..estimate import (
    closed_form, covariance_with, estimate, faces, Fit, fit_12, fit_robust, fit_sphere, judge,
    NotConvergedError, originals, Point, pose_noise, rivals, solve, start_of, stated, TIES,
    with_scatter_of)
from ..finding import explained_by, Finding
from ..geometry import unit
from ..statistics import rms
from ..stillness import check_axes
from ..table import check_units, Poses
from ..text import listed, short
from ..units import Floats, Indices, Method, METHODS, MG, MODEL_NAMES, Units

_LARGEST_REST_G = 3.0
_NATIVE_SPREADS = 20.0
"""Largest reading of an accelerometer at rest: |reading| [g]; for native units the distance from
the median, relative to the median of these distances."""

_LEVEL_OF_MODELS = 0.03

_MOST_NAMED = 3
"""Largest number of groups of equal rows in a warning."""

_LEVEL_OF_PLACEMENT = 1e-4
"""Level of the F test for placement errors."""

_LEAST_RATIO = 4.0
"""Smallest ratio of variances that counts: placement errors about as large as the noise."""

_WARN_DEGREES = 0.2
_WARN_CHI2 = 4.0
"""Residuals above both limits cause a finding about the placement."""

CLIPPED = 'the reading is clipped at the limit of the sensor'


def fit_poses(poses: Poses, units: Units, *, model: str = 'auto', method: Method = 'ml',
              sensor: str = '', date: str = '') -> Calibration:
    """
    Fit a calibration with ΔR = I; for known orientations with the ΔR that they determine.

    Parameters
    ----------
    poses : Poses
        Still poses, in the unit of the readings.
    units : Units
        Unit of the readings. The fit estimates the sensitivity of native units.
    model : {'auto', '4', '7', '9', '10', '12'}
        ``auto`` selects 12 if the orientations are known, and otherwise the smallest of 4, 7 and
        10 that the data support. Model 12 is replaced by 10 if |force| = 1 g contradicts the known
        orientations.
    method : {'ml', 'algebraic'}
        Maximum likelihood, or the cost functions of AN5286 and the ESGI'95 report.
    sensor, date : str
        Stored in the record. By default the name in the poses.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model, or the result is not plausible.
    InputError
        If the readings are clearly in another unit.

    """
    if model not in MODEL_NAMES or method not in METHODS:
        raise ValueError(f'model is {model!r} and method {method!r}, expected one of '
                         f'{MODEL_NAMES} and one of {METHODS}')
    check_units(poses, units)
    sound, rejected = sound_rows(poses, units)
    if rejected and method == 'algebraic':
        raise RefusedFitError(f'row {rejected[0].row}: {rejected[0].reason}, but the method '
                              'algebraic uses every row', 'remove the row, or use the method ml')
    limited: tuple[Finding, ...] = ()
    if method == 'ml' and 'at_limit' in sound and np.any(ended := sound['at_limit'] > 0.0):
        rows = tuple(sound.row[ended].tolist())
        limit = float(np.max(np.abs(sound.reading[ended])))
        limited = (Finding(
            'limited', f'{len(rows)} of {len(sound)} poses are left out, because the readings end '
            f'at {short(limit)} {units.name}, the limit of the sensor', 'choose a larger range of '
            'the sensor, and record again', 'USABLE', rows, step='record'),)
        sound = sound.take(~ended)
        rejected += tuple(Rejected(row, CLIPPED, 'clipped') for row in rows)
    with explained_by(limited):
        calibration, doubts = _without_doubtful(sound, units, model, method)
        left_out = sorted((*rejected, *doubts, *calibration.rejected), key=lambda pose: pose.row)
        # The fitted table has references that the input may lack.
        every = calibration.poses if len(calibration.poses) == len(poses) else poses
        return finished(replace(
            calibration, poses=every, rejected=tuple(left_out),
            noted=(*wiring(calibration), *limited, *calibration.noted)), sensor, date)


def _without_doubtful(poses: Poses, units: Units, model: str, method: Method
                      ) -> tuple[Calibration, tuple[Rejected, ...]]:
    """Fit without the doubtful poses if the others determine the same model; return these, too."""
    every = _fitted(poses, units, model, method)
    sure, doubts = sure_rows(poses)
    if not doubts or method == 'algebraic':
        return every, ()
    try:
        without = _fitted(sure, units, model, method)
    except RefusedFitError:
        without = every
    if without is not every and (model != 'auto' or without.name == every.name):
        return without, doubts
    rows = tuple(pose.row for pose in doubts)
    return replace(every, noted=(*every.noted, Finding(
        'doubtful', f'the sensor may have moved during the poses of {listed("row", rows)}, and '
        'the fit needs them', 'capture them again', 'USABLE', rows))), ()


def _fitted(poses: Poses, units: Units, model: str, method: Method) -> Calibration:
    if model == ORIENTED or (model == 'auto' and 'reference' in poses.columns):
        return fit_known(poses, units, method)
    return fit_unknown(poses, units, model, method)[0]


def sound_rows(poses: Poses, units: Units) -> tuple[Poses, tuple[Rejected, ...]]:
    """
    Separate plausible poses from rows that are no readings of an accelerometer at rest.

    RefusedFitError if an axis does not measure.

    """
    if not len(poses):
        return poses, ()
    reading, noise = poses.reading, poses.noise
    with np.errstate(over='ignore'):
        length = np.linalg.norm(reading, axis=1)
        away = np.linalg.norm(reading - np.median(reading, axis=0), axis=1)
    scale = units.per_g
    if units.is_native:
        scale = float(np.median(away)) * _NATIVE_SPREADS / _LARGEST_REST_G
        length = away
    wild = ~(length <= _LARGEST_REST_G * scale)
    largest = np.zeros(len(poses)) if noise is None else np.max(noise, axis=1)
    bad = wild | ~(largest <= LARGEST_OFFSET_G * scale) & (scale > 0.0)
    rejected = []
    for k in np.flatnonzero(bad):
        shown = ', '.join(f'{value:.4g}' for value in reading[k])
        rejected.append(Rejected(int(poses.row[k]), (
            f'the reading ({shown}) is not plausible for an accelerometer at rest' if wild[k] else
            f'the uncertainty of the mean is {largest[k]:.3g}, so the sensor was not at rest')))
    sound = poses.take(~bad) if rejected else poses
    check_axes(sound.reading, units)
    return sound, tuple(rejected)


def sure_rows(poses: Poses) -> tuple[Poses, tuple[Rejected, ...]]:
    """Separate poses from those that the capture marked as doubtful."""
    if 'doubtful' not in poses or not np.any(poses['doubtful']):
        return poses, ()
    doubtful = poses['doubtful'] > 0.0
    return poses.take(~doubtful), tuple(
        Rejected(int(row), 'doubtful: the sensor may have moved', 'doubtful')
        for row in poses.row[doubtful])


def own_scale(poses: Poses, units: Units) -> Units:
    """Return native units with the scale estimated from the poses; other units unchanged."""
    if not units.is_native:
        return units
    if len(poses) < free_parameters('4'):
        refuse_if_unfit('4', np.zeros((len(poses), 3)))
    return Units('native', float(fit_sphere(poses.reading)[0][0, 0]))


def fit_unknown(poses: Poses, units: Units, model: str, method: Method
                ) -> tuple[Calibration, Fit]:
    """Fit model 4, 7, 9, 10 or ``auto`` by |force| = 1 g; errors as in `fit_poses`."""
    units = own_scale(poses, units)
    poses_g, directions = only_norm(in_g(poses, units)), directions_of(poses, units)
    dilutions = _dilutions(model, directions, pose_noise(poses_g.noise, directions))
    original = originals(poses_g) if method == 'ml' else np.arange(len(poses_g))
    first = kept = np.flatnonzero(np.bincount(original))
    fits: dict[str, Fit] = {}
    if method == 'ml':
        largest = list(dilutions)[-1]
        try:
            robust, among = fit_robust(MODELS[largest].norm, poses_g.take(kept))
        except NotConvergedError:
            raise RefusedFitError(
                f'the {len(kept)} poses are not on an ellipsoid, but model {largest} needs one',
                f'{TAKE_ALL_SIDES}, and hold it still in each') from None
        fits[largest], kept = _in_own_axes(largest, robust), kept[among]
        poses_g = with_scatter_of(fits[largest], poses_g)
    left, used = poses_g.take(kept), directions[kept]
    noise = pose_noise(left.noise, used)
    if len(kept) < len(poses_g):
        dilutions = _dilutions(model, used, noise)
    fits = {name: fits.get(name) or _fit_rows(left, name, method) for name in dilutions}
    name, reason = (model, f'model {model} was requested') if model != 'auto' else _choose(fits)
    fit, out = fits[name], np.setdiff1d(first, kept)
    unlike = rivals(fit, kept, out, poses_g, lambda others: _fit_rows(others, name, method))
    fit = stated(fit)
    noted = [*copies(original, poses_g), *rival_findings(unlike, poses_g.row),
             *fit_findings(fit, dilutions[name])]
    if model == 'auto':
        noted += find_undetermined(list(dilutions)[-1], used, noise)
    return record_of(
        fit, poses, units, used, name=name, method=method, covariance=covariance_with(fit, unlike),
        rejected=tuple(rejected_by(fit.model, poses_g.take(~np.isin(original, kept)))),
        reason=reason, noted=tuple(noted)), fit


def copies(original: Indices, poses: Poses) -> Iterator[Finding]:
    """Yield a finding about the rows that count as one pose, from the result of `originals`."""
    groups = [poses.row[original == each].tolist()
              for each in np.flatnonzero(np.bincount(original) > 1)]
    if groups:
        shown = '; '.join(listed('row', rows) for rows in groups[:_MOST_NAMED])
        more = len(groups) - _MOST_NAMED
        yield Finding('copies', f'equal rows count as one pose: {shown}'
                      f'{f"; and {more} more" if more > 0 else ""}',
                      rows=tuple(row for rows in groups for row in rows))


def only_norm(poses_g: Poses) -> Poses:
    """Return the poses with the columns that a fit by |force| = 1 g uses."""
    return Poses({key: poses_g[key] for key in ('reading', 'std', 'count') if key in poses_g},
                 poses_g.row)


def _dilutions(model: str, directions: Floats, noise: Floats | None) -> dict[str, float]:
    """Return the dilution of each candidate model that the poses determine, smallest first."""
    names = NORM_MODELS if model == 'auto' else (model,)
    found = {name: dilution(name, directions, noise) for name in names
             if len(directions) >= poses_needed(name)}
    if found.get(names[0], np.inf) > LARGEST_DILUTION:
        refuse_if_unfit(names[0], directions, noise)
    return {name: each for name, each in found.items() if each <= LARGEST_DILUTION}


def _in_own_axes(name: str, fit: Fit) -> Fit:
    """Return a fit in the axes of its model: those of model 9 are fixed to the sensing axes."""
    if not MODELS[name].sensing_axes:
        return fit
    mat_w, vec_v = fit.model.linear_part
    lower_triangular = np.linalg.cholesky(mat_w @ mat_w.T)
    return judge(linear_model('9', lower_triangular, vec_v), fit.poses_g, TIES)


def _fit_rows(poses_g: Poses, name: str, method: Method) -> Fit:
    if method == 'ml':
        return _in_own_axes(name, estimate(start_of(MODELS[name].norm, poses_g.reading), poses_g))
    mat_w, vec_v = closed_form(name, poses_g.reading)
    if not np.all(np.isfinite(mat_w)):
        raise RefusedFitError(f'the poses are not on an ellipsoid, but model {name} needs one',
                              TAKE_ALL_SIDES)
    model = linear_model(MODELS[name].norm, mat_w, vec_v)
    if MODELS[name].sensing_axes:  # the least sum of (|a| - g)², eq. 17 of the ESGI'95 report
        start = model

        def point_at(values: Floats) -> Point:
            tried = with_vector(start.effects, values)
            u = sensor_force(tried, poses_g.reading, {})
            rows = length_rows(tried, u, {})
            return Point(np.linalg.norm(u, axis=1) - 1.0, tried.basis(u, {}).along(rows))

        free = np.full(len(start.vector), np.inf)
        model = with_vector(start.effects, solve(point_at, start.vector, -free, free)[0])
    return _in_own_axes(name, judge(model, poses_g))


def _choose(fits: Mapping[str, Fit]) -> tuple[str, str]:
    """Return the smallest model that the data support, and the reason."""
    chosen, *larger = fits
    reasons: list[str] = []
    for name in larger:
        small, large = fits[chosen], fits[name]
        added = small.dof - large.dof
        gained = max(small.chi2 - large.chi2, 0.0) / added
        chance = float(scipy.special.fdtrc(added, large.variance_dof, gained / large.variance))
        before, after = (rms(fit.equations.of_poses(fit.residual)) * MG if fit.dof else 0.0
                         for fit in (small, large))
        added_words = EFFECTS[MODELS[name].effects[-1]].words
        change = f'the poses agree to {after:.3g} mg instead of {before:.3g} mg'
        if chance < _LEVEL_OF_MODELS:
            reasons.append(f'model {name} adds the {added_words}: {change}, which noise alone '
                           f'hardly does (p = {chance:.1g})')
            chosen = name
        else:
            reasons.append(f'model {name} would add the {added_words}: {change}, as noise alone '
                           f'may do (p = {chance:.2g})')
    return chosen, '; '.join(reasons) or f'the poses determine only model {chosen}'


def rejected_by(model: Model, poses_g: Poses, out: Indices | None = None
                ) -> Iterator[Rejected]:
    """Yield outliers with what differs under a model: the indices `out` of poses, or all."""
    force = model.at(poses_g.columns).force(poses_g.reading)  # NaN far outside of its effects
    for k in range(len(poses_g)) if out is None else out:
        words = (f'|force| differs by {(np.linalg.norm(force[k]) - 1.0) * MG:+.2f} mg from 1 g in '
                 'the fit of the others')
        if out is not None and 'orientation' in poses_g:
            alike = poses_g['orientation'] == poses_g['orientation'][k]
            alike[k] = False
            if np.any(alike):
                away = np.linalg.norm(force[k] - np.median(force[alike], axis=0)) * MG
                words = f'the force differs by {away:.2f} mg from the others of its orientation'
        yield Rejected(int(poses_g.row[k]), f'outlier: {words}', 'outlier')


def fit_known(poses: Poses, units: Units, method: Method) -> Calibration:
    """Fit poses of known orientation; parameters and errors as in `fit_poses`."""
    poses, reason = _with_reference(poses, units)
    if method == 'ml':
        by_norm = _unless_placed_well(poses, units)
        if by_norm is not None:
            return by_norm
    if units.is_native:
        mat_x = fit_12(poses.reading, poses['reference'])[0]
        units = Units('native', float(np.cbrt(abs(np.linalg.det(mat_x)))))
    refuse_if_unfit(ORIENTED, unit(poses['reference']))
    poses_g, everyone = in_g(poses, units), np.arange(len(poses))
    if method == 'algebraic':
        plain = Poses({key: poses_g[key] for key in ('reading', 'reference')}, poses_g.row)
        fit, kept = estimate(start_of(ORIENTED, plain.reading), plain), everyone
    else:
        fit, kept = fit_robust(ORIENTED, poses_g, lambda left: determines(
            ORIENTED, unit(left['reference'])))
    poses_g = with_scatter_of(fit, poses_g)
    out = np.delete(everyone, kept)
    unlike = rivals(fit, kept, out, poses_g, lambda others: estimate(fit.model, others))
    fit = stated(fit)
    judged = judge(fit.model, poses_g.take(out)) if len(out) else fit
    away = judged.equations.of_poses(judged.residual) * MG
    rejected = tuple(
        Rejected(int(row), f'outlier: the reading differs by {error:.2f} mg from the fit of the '
                 'other poses', 'outlier') for row, error in zip(poses_g.row[out], away))
    noted = [*rival_findings(unlike, poses.row), *fit_findings(fit, 0.0)]
    off = fit.equations.of_poses(fit.residual)
    angle = np.degrees(np.sqrt(3.0 * np.sum(off ** 2) / max(fit.dof, 1)))
    if fit.dof > 0 and angle >= _WARN_DEGREES and fit.chi2 >= _WARN_CHI2 * fit.dof:
        noted.append(Finding(
            'placement', f'the readings differ by {angle:.2g}° from the known orientations: if '
            'the placement of the sensor is not more accurate, the result has this error',
            'take 12 or more poses in other orientations, too, and fit model 10'))
    return record_of(
        fit, poses, units, unit(fit.poses_g['reference']), name=ORIENTED, method=method,
        covariance=covariance_with(fit, unlike), rejected=rejected, reason=reason,
        noted=tuple(noted))


def _with_reference(poses: Poses, units: Units) -> tuple[Poses, str]:
    """Return poses with their known forces, and why these are known."""
    if 'reference' in poses:
        return poses, 'the orientations are known'
    up = faces(poses.reading)
    if up is None:
        raise RefusedFitError('the poses have no ref_x,ref_y,ref_z and are not the six faces, but '
                              'model 12 needs known orientations', 'add these columns, use only '
                              'the six faces (--rows), or use model 10')
    return poses.with_columns(reference=up * units.force_per_g), 'the poses are the six faces'


def _unless_placed_well(poses: Poses, units: Units) -> Calibration | None:
    """Fit by |force| = 1 g alone if it contradicts the known orientations; otherwise None."""
    units, directions = own_scale(poses, units), directions_of(poses, units)
    if not determines('10', directions):
        return None
    try:
        by_norm, fit = fit_unknown(poses, units, '10', 'ml')
    except RefusedFitError:  # without the outliers the poses do not determine the model
        return None
    seen = in_g(poses.take(np.isin(poses.row, fit.poses_g.row)), units)
    u = sensor_force(fit.model, seen.reading, {})
    up, known = unit(u), unit(seen['reference'])
    away = np.ones_like(up)
    for _ in range(20):  # the first time with equal weights
        size = np.linalg.norm(away, axis=1, keepdims=True)
        weight = 1.0 / np.maximum(size, max(float(np.median(size)), 1e-6))
        left, _, right = np.linalg.svd((up * weight).T @ known)
        rotation = left @ right
        away = up - known @ rotation.T
    if np.linalg.det(rotation) < 0.0:  # mirrored axes: only W can show them
        return None
    # The variance across the force, from the noise and from the uncertainty of the fit [g²].
    moved = np.linalg.solve(fit.model.at({}).slope(u), fit.model.basis(u, {}).full)
    spread = moved @ by_norm.covariance @ np.swapaxes(moved, 1, 2)
    along = np.einsum('ni,nij,nj->n', up, spread, up)
    own = 2.0 * fit.equations.scale ** 2 * fit.variance
    variance = own + np.trace(spread, axis1=1, axis2=2) - along
    dof = 2.0 * len(away) - 3.0
    ratio = float(np.sum(away ** 2) / np.sum(variance)) * 2.0 * len(away) / dof
    chance = float(scipy.special.fdtrc(dof, fit.variance_dof, ratio))
    if not (ratio > _LEAST_RATIO and chance < _LEVEL_OF_PLACEMENT):  # the noise explains them
        return None
    angle = np.degrees(np.linalg.norm(away, axis=1))
    words = (f'the known orientations differ by {rms(angle):.2g}° (RMS) from a '
             f'fit by |force| = 1 g, most in row {seen.row[np.argmax(angle)]} '
             f'({np.max(angle):.2g}°): the fit uses only |force| = 1 g, and the orientations '
             'determine only the rotation of the axes')
    return replace(by_norm, model=replace(by_norm.model, rotation=rotation), reason=words,
                   noted=(Finding('placement', words), *by_norm.noted))
