# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The entry point, from poses to a calibration, and the gate.

The gate checks every calibration before it is stored, loaded or used. A fit has already converged
(`accel_calib.estimate.fit`), and its poses determine the model (`.pose_planning`). The gate checks
the calibration itself: finite values, a proper rotation, a valid covariance, plausible offset,
gain and effects, and a useful uncertainty. The limits are far beyond the values of working
sensors; only useless calibrations exceed them.

Each limit is written as `not value <= limit`, so that NaN does not pass it. Absurd values may
overflow on the way; infinity does not pass either.

A calibration without effects, such as a mounting alone, has no residual of a fit to check. The
uncertainty of a partial fit (`.partial`) is limited by that of common sensors, and its warning
states it. It has no other limit.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .calibration import Calibration, Method, METHODS, MODEL_NAMES, ORIENTED, PRIOR, Rejected
from .known_orientation import fit_known, wiring
from .rest_noise import with_rest_noise
from .unknown_orientation import fit_unknown
from ..effects import LADDER, Model, times
from ..errors import RefusedFitError, TAKE_ALL_SIDES
from ..finding import Finding, without
from ..geometry import OVER_THE_SPHERE, unit
from ..table import check_units, Floats, Poses
from ..text import listed
from ..units import MG, Units

LARGEST_OFFSET_G = 1.0
"""Largest zero-g offset of a working accelerometer [g]; not checked for native units."""

GAINS = (0.5, 2.0)
"""Smallest and largest gain of a working accelerometer, relative to the scale of its units."""

LARGEST_RESIDUAL_G = 0.05
"""Largest residual of poses on one ellipsoid [g]."""

LARGEST_UNCERTAINTY_G = 0.1
"""Largest uncertainty of |force| of a useful calibration [g]."""

_WARN_UNCERTAINTY_G = 0.005
_ROTATION_TOLERANCE = 1e-6
_COVARIANCE_TOLERANCE = 1e-6

_LARGEST_REST_G = 3.0
_NATIVE_SPREADS = 20.0
"""Largest reading of an accelerometer at rest: |reading| [g]; for native units the distance from
the median, relative to the median of these distances."""

_CHECK_POSES = 'check the poses for mistakes, take new poses, and fit again'


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
    calibration, rejected = _without_doubtful(sound, rejected, units, model, method)
    left_out = sorted((*rejected, *calibration.rejected), key=lambda pose: pose.row)
    # The fitted table has references that the input may lack.
    every = calibration.poses if len(calibration.poses) == len(poses) else poses
    return finished(replace(
        calibration, sensor=sensor or poses.sensor, date=date, poses=every,
        rejected=tuple(left_out), noted=(*wiring(calibration), *calibration.noted)), poses)


def _without_doubtful(poses: Poses, rejected: tuple[Rejected, ...], units: Units, model: str,
                      method: Method) -> tuple[Calibration, tuple[Rejected, ...]]:
    """Fit without the doubtful poses, if the other poses determine the same model."""
    sure, doubts = sure_rows(poses)
    if not doubts or method == 'algebraic':
        return _fitted(poses, units, model, method), rejected
    every = _fitted(poses, units, model, method)
    try:
        without = _fitted(sure, units, model, method)
    except RefusedFitError:
        without = every
    if without is not every and (model != 'auto' or without.name == every.name):
        return without, (*rejected, *doubts)
    rows = tuple(pose.row for pose in doubts)
    return replace(every, noted=(*every.noted, Finding(
        'doubtful', f'the sensor may have moved during the poses of {listed("row", rows)}, and '
        'the fit needs them', 'capture them again', 'USABLE', rows))), rejected


def _fitted(poses: Poses, units: Units, model: str, method: Method) -> Calibration:
    if model == ORIENTED or (model == 'auto' and 'reference' in poses):
        return fit_known(poses, units, method)
    return fit_unknown(poses, units, model, method)


def finished(calibration: Calibration, poses: Poses) -> Calibration:
    """Return a calibration that has passed the gate, with the figures of its rests."""
    return with_rest_noise(gated(calibration), poses)


@np.errstate(over='ignore', invalid='ignore')
def gated(calibration: Calibration) -> Calibration:
    """
    Check a calibration, and return it with a finding if its uncertainty is large.

    Raises
    ------
    RefusedFitError
        If the calibration is not plausible.

    """
    _check_numbers(calibration)
    _check_rotation(calibration.model.rotation)
    _check_covariance(calibration.covariance)
    _check_gain(calibration)
    _check_effects(calibration)
    residual = calibration.quality.rms_after_mg / MG
    if calibration.model.effects and not residual <= LARGEST_RESIDUAL_G:
        raise RefusedFitError(
            f'the residual is {residual * MG:.3g} mg (RMS) after the fit, expected less than '
            f'{LARGEST_RESIDUAL_G * MG:.0f} mg: the poses are not on an ellipsoid', _CHECK_POSES)
    return _with_uncertainty(calibration)


def _check_numbers(calibration: Calibration) -> None:
    model = calibration.model
    for what, values in (('value', model.vector), ('gain', model.linear_part[0]),
                         ('rotation', model.rotation), ('covariance', calibration.covariance)):
        if not np.all(np.isfinite(values)):
            raise RefusedFitError(f'the calibration has a {what} that is not finite, expected '
                                  'finite numbers', _CHECK_POSES)


def _check_rotation(rotation: Floats) -> None:
    proper = (rotation.shape == (3, 3) and np.linalg.det(rotation) > 0.0
              and np.allclose(rotation @ rotation.T, np.eye(3), atol=_ROTATION_TOLERANCE))
    if not proper:
        raise RefusedFitError('the mounting ΔR is not orthonormal, or it is a mirror image; '
                              'expected a rotation', 'level the mounting again')


def _check_covariance(covariance: Floats) -> None:
    """Refuse a covariance that is not symmetric and positive semidefinite."""
    root = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    with np.errstate(over='ignore', invalid='ignore'):
        scaled = covariance / root / root[:, np.newaxis]
    sound = (np.all(np.diag(covariance) >= 0.0) and np.all(np.isfinite(scaled))
             and np.allclose(scaled, scaled.T, atol=_COVARIANCE_TOLERANCE)
             and (not len(root)
                  or np.min(np.linalg.eigvalsh(scaled)) >= -_COVARIANCE_TOLERANCE * len(root)))
    if not sound:
        raise RefusedFitError('the covariance is not valid, expected a symmetric and positive '
                              'semidefinite matrix', 'fit again')


def _check_gain(calibration: Calibration) -> None:
    mat_w, vec_v = calibration.model.linear_part
    gains = np.linalg.svd(mat_w, compute_uv=False)
    if not np.linalg.det(mat_w) > 0.0 and not calibration.form.known_orientation:
        raise RefusedFitError('the gain W is singular or a mirror image, expected det W > 0',
                              _CHECK_POSES)
    if not GAINS[0] <= gains[-1] <= gains[0] <= GAINS[1]:
        raise RefusedFitError('the poses are not on an ellipsoid of an accelerometer: the gains '
                              f'are {gains[-1]:.3g} to {gains[0]:.3g}, expected {GAINS[0]:g} to '
                              f'{GAINS[1]:g}', f'check the units, or {_CHECK_POSES}')
    offset = float(np.linalg.norm(vec_v))
    if not calibration.units.is_native and not offset <= LARGEST_OFFSET_G:
        raise RefusedFitError(f'the zero-g offset is {offset:.3g} g, expected less than '
                              f'{LARGEST_OFFSET_G:g} g', _CHECK_POSES)


def _check_effects(calibration: Calibration) -> None:
    """Refuse effects whose contribution to a pose of the calibration is not plausible."""
    used = calibration.used_poses
    for name, values in calibration.model.values.items():
        model = Model({name: values})
        effect = model.terms.effects[0]
        if name in LADDER or effect.output is not None or not len(used):
            continue
        if any(key not in used for key in model.needs if key != 'previous'):
            continue
        added = _contribution(model, used, calibration.units)
        if not added <= effect.plausible_g:
            raise RefusedFitError(f'{name} adds up to {added:.3g} g to a reading, expected less '
                                  f'than {effect.plausible_g:g} g', _CHECK_POSES)


def _contribution(model: Model, used: Poses, units: Units) -> float:
    """Return the largest contribution of an effect at poses [g]."""
    context = {**used.columns}
    if 'std' in used:
        context['std'] = units.to_g(used['std'])
    context.setdefault('previous', unit(used.reading))
    directions = unit(used.reading)
    added = model.at(context).reading(directions) - directions
    return float(np.max(np.linalg.norm(added, axis=1)))


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
    across = times(model.at(known).inverse_slope(up).swapaxes(-1, -2), up)
    rows = model.basis(up, known).along(across)
    return np.sqrt(np.maximum(np.sum(rows @ calibration.covariance * rows, axis=1), 0.0))


def _with_uncertainty(calibration: Calibration) -> Calibration:
    if calibration.method == PRIOR:
        return calibration
    uncertain = uncertainty_g(calibration)
    if not uncertain <= LARGEST_UNCERTAINTY_G:
        raise RefusedFitError(
            f'the poses do not determine the calibration: the uncertainty of |a| is up to '
            f'{uncertain * MG:.3g} mg, expected less than {LARGEST_UNCERTAINTY_G * MG:.0f} mg',
            next((noted.words for noted in calibration.noted
                  if noted.kind == 'outlier_not_certain'), TAKE_ALL_SIDES))
    others = without(calibration.noted, 'uncertainty')
    if uncertain < _WARN_UNCERTAINTY_G:
        return replace(calibration, noted=others)
    return replace(calibration, noted=(*others, Finding(
        'uncertainty', f'the uncertainty of |a| is up to {uncertain * MG:.2g} mg',
        'take more poses, spread over the sphere')))


def sound_rows(poses: Poses, units: Units) -> tuple[Poses, tuple[Rejected, ...]]:
    """Separate plausible poses from rows that are no readings of an accelerometer at rest."""
    if not len(poses):
        return poses, ()
    with np.errstate(over='ignore'):
        length = np.linalg.norm(poses.reading, axis=1)
        centre = np.median(poses.reading, axis=0)
        away = np.linalg.norm(poses.reading - centre, axis=1)
    scale = units.per_g
    if units.is_native:
        scale = float(np.median(away)) * _NATIVE_SPREADS / _LARGEST_REST_G
        length = away
    wild = ~(length <= _LARGEST_REST_G * scale)
    noisy = np.zeros(len(poses), bool)
    if poses.noise is not None and scale > 0.0:
        noisy = ~(np.max(poses.noise, axis=1) <= LARGEST_OFFSET_G * scale)
    rejected = [Rejected(int(poses.row[k]), _why(poses, int(k), bool(wild[k])))
                for k in np.flatnonzero(wild | noisy)]
    return (poses.take(~(wild | noisy)), tuple(rejected)) if rejected else (poses, ())


def sure_rows(poses: Poses) -> tuple[Poses, tuple[Rejected, ...]]:
    """Separate poses from those that the capture marked as doubtful."""
    if 'doubtful' not in poses or not np.any(poses['doubtful']):
        return poses, ()
    doubtful = poses['doubtful'] > 0.0
    return poses.take(~doubtful), tuple(
        Rejected(int(row), 'doubtful: the sensor may have moved', 'doubtful')
        for row in poses.row[doubtful])


def _why(poses: Poses, index: int, wild: bool) -> str:
    if wild:
        reading = ', '.join(f'{value:.4g}' for value in poses.reading[index])
        return f'the reading ({reading}) is not plausible for an accelerometer at rest'
    noise = float(np.max(poses.noise[index])) if poses.noise is not None else np.nan
    return f'the uncertainty of the mean is {noise:.3g}, so the sensor was not at rest'
