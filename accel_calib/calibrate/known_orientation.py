# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses of known orientation: model 12, unless |force| = 1 g shows that they were placed badly.

An orientation is known only as well as the sensor was placed. A placement error of 2° turns the
force by 35 mg but does not change its length, so the norm alone is not affected by it. If the
poses determine model 10, its forces are turned onto the known ones (orthogonal Procrustes problem,
Schönemann 1966, with Huber's weights, so that one misplaced pose does not turn the others). What
is left is tangential. If an F test shows that it is more than the noise and the uncertainty of the
fit explain, the fit uses |force| = 1 g alone, and the known orientations give only the rotation of
the axes, ΔR.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .calibration import Calibration, Rejected
from .quality import fit_warnings, in_g, quality_of
from .refusal import carries, refuse_if_unfit
from .unknown_orientation import (
    calibration_of,
    directions_of,
    Method,
    own_scale,
    solve_unknown,
)
from ..errors import RefusedFitError
from ..estimate.closed_form import faces, fit_12
from ..estimate.fit import estimate, Fit
from ..estimate.outliers import outliers
from ..model import force_slope, MODELS, parameter_basis, sensor_force, with_vector
from ..sphere import unit
from ..table import Floats, Poses
from ..units import MG, Units

_LEVEL = 1e-4
_LEAST_RATIO = 4.0
"""Placement errors must be about as large as the noise to matter."""

_PLAIN_DEGREES = 0.2
_PLAIN_CHI2 = 4.0
"""Residuals of known orientations that are worth a warning."""

_ROUNDS = 20
_SMALL_ANGLE = 1e-6


def fit_known(poses: Poses, units: Units, method: Method) -> Calibration:
    """Fit poses of known orientation; arguments and errors as `fit_poses`."""
    poses, reason = _with_reference(poses, units)
    if method == 'ml':
        by_norm = _unless_placed_well(poses, units)
        if by_norm is not None:
            return by_norm
    if units.name == 'native':
        mat_x = fit_12(poses.reading, poses['reference'])[0]
        units = Units('native', float(np.cbrt(abs(np.linalg.det(mat_x)))))
    refuse_if_unfit('12', unit(poses['reference']))
    fit, rejected = _fit(in_g(poses, units), method)
    quality = quality_of(fit, units, unit(fit.poses_g['reference']))
    return Calibration('12', method, fit.model, units, '', 'ros', '', fit.covariance, quality,
                       poses, rejected, reason,
                       (*fit_warnings(fit, 0.0), *_placement_warning(fit)))


def _fit(poses_g: Poses, method: Method) -> tuple[Fit, tuple[Rejected, ...]]:
    """Fit model 12, without outliers as long as the other poses determine it."""
    kept = ('reading', 'reference') if method == 'algebraic' else tuple(poses_g.columns)
    poses_g = Poses({key: poses_g[key] for key in kept if key in poses_g}, poses_g.row)
    start = with_vector(MODELS['12'], np.zeros(12))
    rejected: tuple[Rejected, ...] = ()
    fit = estimate(start, poses_g)
    while method == 'ml':
        out = outliers(fit, len(poses_g)).poses
        left = fit.poses_g.take(np.delete(np.arange(len(fit.poses_g)), out))
        if not len(out) or not carries('12', unit(left['reference'])):
            break
        off = fit.equations.of_poses(fit.residual)[out] * MG
        rejected = (*rejected, *(
            Rejected(int(row), f'outlier: the reading is {error:.2f} mg off what the other '
                     'orientations say')
            for row, error in zip(fit.poses_g.row[out], off, strict=True)))
        fit = estimate(fit.model, left)
    return fit, rejected


def _with_reference(poses: Poses, units: Units) -> tuple[Poses, str]:
    """Return the poses with their known forces, and where these come from."""
    if 'reference' in poses:
        return poses, 'the orientations are given'
    faces_up = faces(poses.reading)
    if faces_up is None:
        raise RefusedFitError('model 12 needs known orientations, the poses have no '
                              'ref_x,ref_y,ref_z and are not the six faces',
                              'add the columns, give the six faces alone (--rows), or use '
                              'model 10')
    force = faces_up * (1.0 if units.name == 'native' else units.per_g)
    return poses.with_columns(reference=force), 'the poses are the six faces'


def _unless_placed_well(poses: Poses, units: Units) -> Calibration | None:
    """Fit by |force| = 1 g alone, if that shows that the poses were not placed as they say."""
    units, directions = own_scale(poses, units), directions_of(poses, units)
    if not carries('10', directions):
        return None
    poses_g = in_g(poses, units)
    try:
        found = solve_unknown(poses_g, directions, '10', 'ml')
    except RefusedFitError:  # without the outliers the poses do not carry it
        return None
    seen = poses_g.take(found.kept)
    u, known = sensor_force(found.fit.model, seen.reading, {}), unit(seen['reference'])
    rotation = _turned_onto(unit(u), known)
    if np.linalg.det(rotation) < 0.0:  # mirrored axes: W alone can tell
        return None
    away = unit(u) - known @ rotation.T
    if not _is_placement(away, _tangential_variance(found.fit, u), found.fit.variance_dof):
        return None
    angle = np.degrees(np.linalg.norm(away, axis=1))
    words = (f'the given orientations are {np.sqrt(np.mean(angle ** 2)):.2g}° (RMS) off what '
             f'|force| = 1 g shows, the most in row {seen.row[np.argmax(angle)]} '
             f'({np.max(angle):.2g}°): the fit uses |force| = 1 g alone, and the orientations '
             'give only the rotation of the axes')
    by_norm = calibration_of(found, poses, units, 'ml')
    return replace(by_norm, model=replace(by_norm.model, rotation=rotation), reason=words,
                   warnings=(words, *by_norm.warnings))


def _placement_warning(fit: Fit) -> tuple[str, ...]:
    """Warn of placement errors that the norm of these poses cannot tell from noise."""
    if fit.dof == 0:
        return ()
    off = fit.equations.of_poses(fit.residual)
    angle = np.degrees(np.sqrt(3.0 * np.sum(off ** 2) / fit.dof))
    if angle < _PLAIN_DEGREES or fit.chi2 < _PLAIN_CHI2 * fit.dof:
        return ()
    return (f'the readings are {angle:.2g}° off the given orientations: if the sensor was not '
            'placed that well, this error is in the result; take 12 or more poses in other '
            'orientations too, and |force| = 1 g corrects without a jig',)


def _turned_onto(directions: Floats, known: Floats) -> Floats:
    """Return the orthogonal (3, 3) matrix R with directions = R known, for most of the rows."""
    weight = np.ones(len(directions))
    for _ in range(_ROUNDS):
        left, _, right = np.linalg.svd((directions * weight[:, np.newaxis]).T @ known)
        rotation: Floats = left @ right
        away = np.linalg.norm(directions - known @ rotation.T, axis=1)
        weight = 1.0 / np.maximum(away, max(float(np.median(away)), _SMALL_ANGLE))
    return rotation


def _tangential_variance(fit: Fit, u: Floats) -> Floats:
    """Return the (n,) variance across the force u that noise and the fit itself leave [g²]."""
    moved = np.linalg.solve(force_slope(fit.model, u, {}), parameter_basis(fit.model, u, {}))
    spread = moved @ fit.covariance @ np.swapaxes(moved, 1, 2)
    along = np.einsum('ni,nij,nj->n', unit(u), spread, unit(u))
    own = 2.0 * fit.equations.scale ** 2 * fit.variance
    return own + np.trace(spread, axis1=1, axis2=2) - along


def _is_placement(away: Floats, variance: Floats, variance_dof: float) -> bool:
    """Return whether the poses are further away than noise leaves them."""
    from scipy.special import fdtrc

    dof = 2.0 * len(away) - 3.0
    ratio = float(np.sum(away ** 2) / np.sum(variance)) * 2.0 * len(away) / dof
    return bool(ratio > _LEAST_RATIO and fdtrc(dof, variance_dof, ratio) < _LEVEL)
