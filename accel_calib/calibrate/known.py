# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses of known orientation: model 12, unless |force| = 1 g shows that they were placed badly.

An orientation is known only as well as the sensor was placed. A placement error of 2° turns the
force by 35 mg but does not change its length, so that the norm alone does not see it. Where the
poses carry model 10, its forces are turned onto the known ones (orthogonal Procrustes problem,
Schönemann 1966, with Huber's weights, so that one misplaced pose does not turn the others); what
is left is all tangential. If an F test says that it is more than the noise and the uncertainty of
the fit leave, the fit rests on |force| = 1 g alone and the known orientations give only the
rotation of the axes, ΔR.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from . import closed_form
from .calibration import Calibration
from .likelihood import Fit, fit_reference
from .quality import in_g, quality_of
from .refusal import carries, refuse_if_unfit
from .unknown import (
    calibration_of,
    directions_of,
    Method,
    own_scale,
    solve_unknown,
    warnings_of,
)
from ..errors import RefusedFitError
from ..model import force_slope, MODELS, parameter_basis, sensor_force
from ..sphere import unit
from ..table import Floats, Poses
from ..units import Units

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
        mat_x = closed_form.fit_12(poses.reading, poses['reference'])[0]
        units = Units('native', float(np.cbrt(abs(np.linalg.det(mat_x)))))
    directions = unit(poses['reference'])
    refuse_if_unfit('12', directions)
    poses_g = in_g(poses, units)
    noise = poses_g.noise if method == 'ml' else None
    fit = fit_reference(MODELS['12'], poses_g.reading, poses_g['reference'], poses_g.columns,
                        noise)
    quality = quality_of(fit, poses_g, units, directions)
    return Calibration('12', method, fit.model, units, '', 'ros', '', fit.covariance, quality,
                       poses, (), reason, (*warnings_of(fit, 0.0), *_placement_warning(fit)))


def _with_reference(poses: Poses, units: Units) -> tuple[Poses, str]:
    """Give the poses with their known forces, and say from where these are."""
    if 'reference' in poses:
        return poses, 'the orientations are given'
    faces_up = closed_form.faces(poses.reading)
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
    except RefusedFitError:  # without the disturbed poses they do not carry it
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
             f'({np.max(angle):.2g}°): the fit rests on |force| = 1 g alone, and they give only '
             'the rotation of the axes')
    by_norm = calibration_of(found, poses, units, 'ml')
    return replace(by_norm, model=replace(by_norm.model, rotation=rotation), reason=words,
                   warnings=(words, *by_norm.warnings))


def _placement_warning(fit: Fit) -> tuple[str, ...]:
    """Warn of placement errors that the norm of these poses cannot tell from noise."""
    if fit.dof == 0:
        return ()
    angle = np.degrees(np.sqrt(3.0 * np.sum(fit.residual ** 2) / fit.dof))
    if angle < _PLAIN_DEGREES or fit.chi2 < _PLAIN_CHI2 * fit.dof:
        return ()
    return (f'the readings are {angle:.2g}° off the given orientations: if the sensor was not '
            'placed that well, this goes into the result; take poses in other orientations too, '
            '12 or more, and |force| = 1 g corrects without a jig',)


def _turned_onto(unit: Floats, known: Floats) -> Floats:
    """Give the orthogonal (3, 3) matrix R with unit = R known, for most of the (n, 3) rows."""
    weight = np.ones(len(unit))
    for _ in range(_ROUNDS):
        left, _, right = np.linalg.svd((unit * weight[:, np.newaxis]).T @ known)
        rotation: Floats = left @ right
        away = np.linalg.norm(unit - known @ rotation.T, axis=1)
        weight = 1.0 / np.maximum(away, max(float(np.median(away)), _SMALL_ANGLE))
    return rotation


def _tangential_variance(fit: Fit, u: Floats) -> Floats:
    """Give the (n,) variance across the force u that noise and the fit itself leave [g²]."""
    moved = np.linalg.solve(force_slope(fit.model, u, {}), parameter_basis(fit.model, u, {}))
    spread = moved @ fit.covariance @ np.swapaxes(moved, 1, 2)
    along = np.einsum('ni,nij,nj->n', unit(u), spread, unit(u))
    return 2.0 * fit.sigma ** 2 * fit.variance + np.trace(spread, axis1=1, axis2=2) - along


def _is_placement(away: Floats, variance: Floats, variance_dof: float) -> bool:
    """Say whether the poses are further away than noise leaves them."""
    from scipy.special import fdtrc

    dof = 2.0 * len(away) - 3.0
    ratio = float(np.sum(away ** 2) / np.sum(variance)) * 2.0 * len(away) / dof
    return bool(ratio > _LEAST_RATIO and fdtrc(dof, variance_dof, ratio) < _LEVEL)
