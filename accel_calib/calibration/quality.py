# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures and findings of a fit, its record, the range of its poses, and the gate.

The error of a pose is |force| - 1 g. For model 12 and poses of known orientation it is the length
of the vector error. The residual of a calibration is the RMS of the errors over the poses.

The gate checks every calibration before it is stored, loaded or used. A fit has already converged
(`accel_calib.estimate.fit`), and its poses determine the model (`.directions`). The gate checks
the calibration itself: finite values, a proper rotation, a valid covariance, plausible offset,
gain and effects, and a useful uncertainty. The limits are far beyond the values of working
sensors; only useless calibrations exceed them.

Each limit is written as `not value <= limit`, so that NaN does not pass it. Absurd values may
overflow on the way; infinity does not pass either. A calibration without effects, such as a
mounting alone, has no residual to check. The uncertainty of a partial fit (`.partial`) has no
limit but that of common sensors, and its warning states it.

"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
import scipy

from .calibration import Calibration, check_sensor, PRIOR, Quality, Rejected
from .directions import WEAK_DILUTION
from .rest_noise import gyro_bias_of, sample_noise_of
from ..effects import (
    add_history, Context, correct, LADDER, length_rows, Model, sensor_force, variable_of)
from ..errors import RefusedFitError, TAKE_ALL_SIDES
from ..estimate import believable, Fit, judge, left_out, Rival, unseen_mistakes
from ..finding import Finding, without
from ..geometry import coverage, OVER_THE_SPHERE, unit
from ..statistics import over_axes, rms
from ..table import Floats, in_unit, Poses
from ..text import listed
from ..units import MG, Units

_LEAST_OWN = 1e-4
"""Below this part that other orientations check, one alone determines a parameter, and its error
under a fit of the others is only their noise, enlarged ten thousand times."""

LARGEST_OFFSET_G = 1.0
"""Largest zero-g offset of a working accelerometer [g]; not checked for native units."""

GAINS = (0.4, 2.5)
"""Smallest and largest gain of a working accelerometer, relative to the scale of its units."""

_MOST_UNUSUAL = 1e5
"""Largest value of an effect, relative to that of common sensors."""

LARGEST_RESIDUAL_G = 0.05
"""Largest residual of poses on one ellipsoid [g]."""

LARGEST_UNCERTAINTY_G = 0.1
"""Largest uncertainty of |force| of a useful calibration [g]."""

_WARN_UNCERTAINTY_G = 0.005
_ROTATION_TOLERANCE = 1e-6
_COVARIANCE_TOLERANCE = 1e-6

_CHECK_POSES = 'check the poses for mistakes, take new poses, and fit again'


@dataclass(frozen=True)
class Verification:
    """
    Residuals of a calibration on poses that it was not fitted to.

    Parameters
    ----------
    rms_before_mg, rms_after_mg : float
        Residual without and with the calibration [mg].
    max_before_percent, max_after_percent : float
        Largest error without and with the calibration [% of 1 g].
    noise_floor_mg : float or None
        Residual that the noise of the pose means alone causes [mg]; None if it is not known.

    """

    rms_before_mg: float
    rms_after_mg: float
    max_before_percent: float
    max_after_percent: float
    noise_floor_mg: float | None


@dataclass(frozen=True)
class Outside:
    """
    A column of the context, compared with the range of a calibration.

    `count` of all `samples` are outside of the range `low` to `high` of the poses. All samples
    range from `least` to `most`.

    """

    key: str
    count: int
    samples: int
    low: float
    high: float
    least: float
    most: float


def outside(calibration: Calibration, known: Context) -> dict[str, Outside]:
    """Return the comparison of each column that has a range; ``count`` is 0 if all are inside."""
    found, ranges = {}, dict(calibration.ranges)
    ends = [values[-2:] for name, values in calibration.model.values.items()
            if variable_of(name) == 'std']
    if ends:  # empirical curves over the vibration
        ranges['std'] = float(np.max(ends, axis=0)[0]), float(np.min(ends, axis=0)[1])
    for key, (low, high) in ranges.items():
        values = over_axes(known[key]) if key in known else np.zeros(0)
        values = values[np.isfinite(values)]
        if len(values):
            count = int(np.sum((values < low) | (values > high)))
            found[key] = Outside(key, count, len(values), low=low, high=high,
                                 least=float(np.min(values)), most=float(np.max(values)))
    return found


def in_g(poses: Poses, units: Units) -> Poses:
    """Return the poses with readings, std and reference in g; native references are in g."""
    return in_unit(poses, units.to_g, native=units.is_native)


def verify(calibration: Calibration, poses: Poses) -> Verification:
    """
    Compute the residuals of a calibration on poses, in the unit of the calibration.

    Raises
    ------
    StoredCalibrationError
        If the calibration belongs to another sensor.

    """
    model, units = calibration.model, calibration.units
    check_sensor(calibration, poses.sensor)
    poses_g = calibration.held(add_history(in_g(poses, units), model))
    vectors = calibration.form.known_orientation and 'reference' in poses
    floor = None
    if believable(poses_g.noise) is not None:
        known = poses_g if vectors else poses_g.without_columns('reference', 'orientation')
        scale = judge(Model(model.values), known).equations.scale
        floor = rms(scale) * MG * float(np.sqrt(3.0 if vectors else 1.0))
    return Verification(*_residuals(model, poses_g, units, vectors), floor)


def _residuals(model: Model, poses_g: Poses, units: Units, vectors: bool
               ) -> tuple[float, float, float, float]:
    """Return the first four figures of `Quality` and of `Verification`."""
    errors = (errors_before(poses_g, units, vectors=vectors),
              errors_after(model, poses_g, vectors=vectors))
    before, after = (float(np.max(np.abs(each))) * 100.0 for each in errors)
    return rms(errors[0]) * MG, rms(errors[1]) * MG, before, after


def quality_of(fit: Fit, units: Units, directions: Floats) -> Quality:
    """Return figures of a fit; `directions` are up in each of its poses, (n, 3) unit vectors."""
    vectors, data = 'reference' in fit.poses_g, fit.by_pose
    count, rows = data.residual.shape
    # The errors of poses under a fit of other orientations, unless the fit needs one of them.
    errors, checked = left_out(data.residual.ravel(), data.basis.reshape(count * rows, -1),
                               np.repeat(np.arange(count), rows), fit.equations.force, _LEAST_OWN)
    errors = errors.reshape(count, rows)
    if vectors:  # differences of readings; W⁻¹ converts them to forces
        noise = believable(fit.poses_g.noise)
        errors = errors * (fit.equations.scale[:, np.newaxis] if noise is None else noise)
        errors = errors @ np.linalg.inv(fit.model.linear_part[0]).T
    else:
        errors = errors * fit.equations.scale[:, np.newaxis]
    return Quality(*_residuals(fit.model, fit.poses_g, units, vectors),
                   None if checked < _LEAST_OWN else rms(np.linalg.norm(errors, axis=1)) * MG,
                   rms(fit.noise_g) * MG if fit.noise_known else None,
                   fit.chi2 / fit.dof if fit.noise_known and fit.dof > 0 else None,
                   coverage(directions))


def record_of(fit: Fit, poses: Poses, units: Units, directions: Floats, *, name: str,
              method: str, covariance: Floats | None = None, rejected: tuple[Rejected, ...] = (),
              reason: str = '', noted: tuple[Finding, ...] = ()) -> Calibration:
    """
    Return a fit to the poses that are not rejected as a calibration, with the ΔR of its model.

    `directions` are (n, 3) unit vectors, up in each pose of the fit. The (p, p) covariance is by
    default that of the fit. The other arguments are as in `Calibration`; `rejected` in any order.
    The gate has not checked the calibration yet: `finished` does. A fit is also compared with
    another fit to fewer poses, or of a larger model, which need not be useful.

    """
    return Calibration(
        name=name, method=method, model=fit.model, units=units, sensor=poses.sensor, frame='ros',
        date='', covariance=fit.covariance if covariance is None else covariance,
        quality=quality_of(fit, units, directions), poses=poses,
        rejected=tuple(sorted(rejected, key=lambda pose: pose.row)), reason=reason, noted=noted)


def with_rest_noise(calibration: Calibration, poses: Poses) -> Calibration:
    """
    Return a calibration with gyro bias and noise from the rests that it does not reject.

    Figures that the rests do not determine are kept.

    """
    used = poses.take(~np.isin(poses.row, [pose.row for pose in calibration.rejected]))
    return replace(calibration, gyro=gyro_bias_of(used) or calibration.gyro,
                   noise=sample_noise_of(used) or calibration.noise)


def errors_before(poses_g: Poses, units: Units, *, vectors: bool) -> Floats:
    """Return the (n,) errors without a calibration [g]; native: from the middle of the range."""
    reading = poses_g.reading
    if units.is_native:
        reading = reading - (reading.max(axis=0) + reading.min(axis=0)) / 2.0
    if vectors:
        return np.linalg.norm(reading - poses_g['reference'], axis=1)
    return np.linalg.norm(reading, axis=1) - 1.0


def errors_after(model: Model, poses_g: Poses, *, vectors: bool) -> Floats:
    """Return the (n,) errors of corrected poses [g]."""
    if vectors:
        force = correct(model, poses_g.reading, poses_g.columns)
        return np.linalg.norm(force - poses_g['reference'], axis=1)
    return np.linalg.norm(sensor_force(model, poses_g.reading, poses_g.columns), axis=1) - 1.0


_UNSEEN_G = 0.01
"""Mistakes of such poses that do not show are reported above this size [g]."""

_WHOLE_G = 1.0
"""Mistakes above this size are all called large [g]."""

_MOST_NAMED = 5
"""Largest number of rows in a warning."""

_LARGE_CHI2 = 4.0
"""chi² per degree of freedom above which a fit warns."""

_SMALL_CHI2 = 1e-9
"""Probability of a chi² as small, below which the noise is overstated."""


OF_A_FIT = ('no_check', 'not_covered', 'noise_not_known', 'beyond_noise', 'below_noise',
            'hardly_checked', 'outlier_not_certain', 'coarse')
"""Kinds of findings about one fit, which do not hold for another fit."""


def fit_findings(fit: Fit, dilution: float) -> tuple[Finding, ...]:
    """Return findings about a fit with this dilution."""
    found = []
    if fit.dof == 0:
        found.append(Finding('no_check', 'there are only as many poses as free parameters: the '
                             'fit cannot be checked', 'take more poses'))
    if dilution > WEAK_DILUTION:
        found.append(Finding('not_covered', 'the poses leave a region of the sphere uncovered: '
                             f'there the error is up to {dilution:.0f} times that of a pose',
                             'take the next pose that is suggested'))
    if not fit.noise_known:
        known = ('the residuals alone' if fit.dof > 0 else
                 'the noise of a common sensor, 0.5 mg, which may be wrong for this one')
        found.append(Finding('noise_not_known', 'the poses have no std and count: the '
                             f'uncertainty comes from {known}'))
    elif fit.dof > 0 and fit.chi2 / fit.dof > _LARGE_CHI2:
        found.append(Finding(
            'beyond_noise', f'the residuals are {np.sqrt(fit.chi2 / fit.dof):.1f} times the noise '
            'of the pose means: poses repeat worse than the noise of their samples predicts, or '
            'the model lacks an effect', 'run refine to find the missing effect', step='refine'))
    elif fit.dof > 0 and scipy.special.chdtr(fit.dof, fit.chi2) < _SMALL_CHI2:
        found.append(Finding(
            'below_noise', f'the residuals are {np.sqrt(fit.chi2 / fit.dof):.2g} times the noise '
            'of the pose means: it is overstated, and effects smaller than it are not found',
            'check the unit of std, and count; a vibration during the poses can be the cause, '
            'too'))
    unseen = unseen_mistakes(fit) if fit.dof != 0 and fit.prior is None else np.zeros(0)
    rows = fit.poses_g.row[:len(unseen)][unseen > _UNSEEN_G].tolist()
    if rows:
        largest = float(np.max(unseen))
        size = f'a mistake of {largest * MG:.0f} mg' if largest < _WHOLE_G else 'any mistake'
        found.append(Finding(
            'hardly_checked', f'the other poses hardly check {listed("row", rows, _MOST_NAMED)}: '
            f'{size} would move the result and not show',
            'take one more pose in about the same orientation', 'USABLE', tuple(rows)))
    return tuple(found)


def rival_findings(found: tuple[Rival, ...], row: NDArray[np.int64]) -> Iterator[Finding]:
    """Yield a finding about poses that may be wrong instead of those left out."""
    if not found:
        return
    out, instead = (sorted({int(row[index]) for index in indices}) for indices in
                    ([each.left_out for each in found], [each.instead for each in found]))
    yield Finding(
        'outlier_not_certain', f'which row is the outlier is not certain: {listed("row", out)} is '
        f'left out, but the poses agree about as well without '
        f'{"one of " if len(instead) > 1 else ""}{listed("row", instead, _MOST_NAMED)} instead; '
        'the uncertainty includes both cases',
        'take these poses again, or take more poses', 'USABLE', (*out, *instead))


def finished(calibration: Calibration, sensor: str, date: str) -> Calibration:
    """Return a calibration that has passed the gate, with what is known of its rests."""
    named = replace(calibration, sensor=sensor or calibration.sensor, date=date,
                    noted=(*calibration.noted, *calibration.poses.findings))
    return with_rest_noise(gated(named), named.poses)


def refused(calibration: Calibration, message: str, advice: str) -> Calibration:
    """Return a calibration that the gate refuses, with this finding, and that is rated BAD."""
    found = Finding('refused', message, advice, 'BAD')
    return replace(calibration, noted=(found, *calibration.noted))


@np.errstate(over='ignore', invalid='ignore')
def gated(calibration: Calibration) -> Calibration:
    """
    Check a calibration, and return it with a finding if its uncertainty is large.

    Raise RefusedFitError if it is not plausible, or was refused before.

    """
    for each in calibration.noted:
        if each.kind == 'refused':
            raise RefusedFitError(each.text, each.advice)
    _check_numbers(calibration)
    _check_plausible(calibration)
    if calibration.method == PRIOR:
        return calibration
    uncertain = uncertainty_g(calibration)
    if not uncertain <= LARGEST_UNCERTAINTY_G:
        raise RefusedFitError(
            f'the poses do not determine the calibration: the uncertainty of |a| is up to '
            f'{uncertain * MG:.3g} mg, expected less than {LARGEST_UNCERTAINTY_G * MG:.0f} mg',
            next((noted.words for noted in calibration.noted
                  if noted.kind == 'outlier_not_certain'), TAKE_ALL_SIDES))
    noted = without(calibration.noted, 'uncertainty')
    if uncertain >= _WARN_UNCERTAINTY_G:
        noted = (*noted, Finding(
            'uncertainty', f'the uncertainty of |a| is up to {uncertain * MG:.2g} mg',
            'take more poses, spread over the sphere'))
    return calibration if noted == calibration.noted else replace(calibration, noted=noted)


def _check_numbers(calibration: Calibration) -> None:
    """Refuse numbers that no calibration has, a ΔR that is no rotation, and a bad covariance."""
    model, covariance = calibration.model, calibration.covariance
    for what, values in (('value', model.vector), ('gain', model.linear_part[0]),
                         ('rotation', model.rotation), ('covariance', covariance)):
        if not np.all(np.isfinite(values)):
            raise RefusedFitError(f'the calibration has a {what} that is not finite, expected '
                                  'finite numbers', _CHECK_POSES)
    if not (model.rotation.shape == (3, 3) and np.linalg.det(model.rotation) > 0.0
            and np.allclose(model.rotation @ model.rotation.T, np.eye(3),
                            atol=_ROTATION_TOLERANCE)):
        raise RefusedFitError('the mounting ΔR is not orthonormal, or it is a mirror image; '
                              'expected a rotation', 'level the mounting again')
    root = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    scaled = covariance / root / root[:, np.newaxis]
    if not (np.all(np.diag(covariance) >= 0.0) and np.all(np.isfinite(scaled))
            and np.allclose(scaled, scaled.T, atol=_COVARIANCE_TOLERANCE)
            and (not len(root) or np.min(np.linalg.eigvalsh(scaled))
                 >= -_COVARIANCE_TOLERANCE * len(root))):
        raise RefusedFitError('the covariance is not valid, expected a symmetric and positive '
                              'semidefinite matrix', 'fit again')


def _check_plausible(calibration: Calibration) -> None:
    """Refuse gains, an offset, effects or a residual that no working sensor has."""
    mat_w, vec_v = calibration.model.linear_part
    if not has_usual_gains(calibration.model):
        gains = np.linalg.svd(mat_w, compute_uv=False)
        raise RefusedFitError('the poses are not on an ellipsoid of an accelerometer: the gains '
                              f'are {gains[-1]:.3g} to {gains[0]:.3g}, expected {GAINS[0]:g} to '
                              f'{GAINS[1]:g}', f'check the units, or {_CHECK_POSES}')
    if not np.linalg.det(mat_w) > 0.0 and not calibration.form.known_orientation:
        raise RefusedFitError('the gain W is a mirror image, expected det W > 0', _CHECK_POSES)
    offset = float(np.linalg.norm(vec_v))
    if not (offset <= LARGEST_OFFSET_G or calibration.units.is_native):
        raise RefusedFitError(f'the zero-g offset is {offset:.3g} g, expected less than '
                              f'{LARGEST_OFFSET_G:g} g', _CHECK_POSES)
    for name, values in calibration.model.values.items():
        if name in LADDER:
            continue
        used_g, model = in_g(calibration.used_poses, calibration.units), Model({name: values})
        up, effect = unit(used_g.reading), model.terms.effects[0]
        if effect.output is not None or not len(used_g) or any(
                key not in used_g for key in model.needs if key != 'previous'):
            continue
        along = model.at({'previous': up, **used_g.columns}).reading(up)
        added = float(np.max(np.linalg.norm(along - up, axis=1)))
        size = float(np.max(np.abs(effect.split(values)[0]))) / effect.typical
        if not size < _MOST_UNUSUAL:
            raise RefusedFitError(f'{name} is {size:.1g} times as large as in common sensors, '
                                  f'expected less than {_MOST_UNUSUAL:.0e} times', _CHECK_POSES)
        if not added <= effect.plausible_g:
            raise RefusedFitError(f'{name} adds up to {added:.3g} g to a reading, expected less '
                                  f'than {effect.plausible_g:g} g', _CHECK_POSES)
    residual = calibration.quality.rms_after_mg / MG
    if calibration.model.effects and not residual <= LARGEST_RESIDUAL_G:
        raise RefusedFitError(
            f'the residual is {residual * MG:.3g} mg (RMS) after the fit, expected less than '
            f'{LARGEST_RESIDUAL_G * MG:.0f} mg: the poses are not on an ellipsoid',
            'check the poses for mistakes, take new poses at one temperature, and fit again')


def has_usual_gains(model: Model) -> bool:
    """Return whether the gains of a model are those of an accelerometer, in any direction."""
    gains = np.linalg.svd(model.linear_part[0], compute_uv=False)
    return bool(GAINS[0] <= gains[-1] <= gains[0] <= GAINS[1])


def uncertainty_g(calibration: Calibration) -> float:
    """Return the largest standard deviation of |force| over the sphere [g]."""
    return float(np.max(deviations_g(calibration, OVER_THE_SPHERE)))


def deviations_g(calibration: Calibration, up: Floats) -> Floats:
    """
    Return the (n,) standard deviations of |force| that the calibration causes [g].

    They are 0 if the effects need context that the calibration does not have. `up` is (n, 3), unit
    vectors in the sensor axes.

    """
    model = calibration.model
    known = calibration.typical_context(len(up))
    if any(key not in known for key in model.needs):
        return np.zeros(len(up))
    rows = model.basis(up, known).along(length_rows(model, up, known))
    return np.sqrt(np.maximum(np.sum(rows @ calibration.covariance * rows, axis=1), 0.0))


def stated_uncertainty(calibration: Calibration) -> float | None:
    """Return the stated uncertainty of the corrected force, RMS over the sphere [g]."""
    up, alone = OVER_THE_SPHERE, calibration.method == PRIOR and not calibration.form.effects
    per_g, known = calibration.force_per_g, calibration.typical_context(len(up))
    if alone or not calibration.model.effects or not known.keys() >= {*calibration.model.needs}:
        return None
    covariance = calibration.force_covariance(up * per_g, known) / per_g ** 2
    errors = (np.trace(covariance, axis1=1, axis2=2) if calibration.form.known_orientation
              else np.einsum('ni,nij,nj->n', up, covariance, up))
    return float(np.sqrt(np.mean(errors)))
