# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit of poses of known orientation: model 12, or model 10 if the sensor was placed badly.

An orientation is known only as accurately as the sensor was placed. A placement error of 2° turns
the force by 35 mg but does not change its length, so a fit by |force| = 1 g is not affected. If
the poses determine model 10, its forces are rotated onto the known forces (orthogonal Procrustes
problem, Schönemann 1966, with Huber's weights so that one misplaced pose has little influence).
The remaining differences are tangential. If an F test shows that they are larger than the noise
and the uncertainty of the fit explain, the fit uses only |force| = 1 g. The known orientations
then determine only the rotation of the axes, ΔR.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from .calibration import Calibration, Rejected
from .pose_planning import determines, refuse_if_unfit
from .quality import fit_findings, in_g, quality_of, rival_findings
from .unknown_orientation import (
    calibration_of,
    directions_of,
    Method,
    own_scale,
    solve_unknown,
)
from ..effects import force_slope, MODELS, parameter_basis, sensor_force, with_vector
from ..errors import RefusedFitError
from ..estimate import covariance_with, estimate, faces, Fit, fit_12, outliers, rivals
from ..finding import Finding
from ..geometry import unit
from ..table import Floats, Poses
from ..units import MG, Units

_LEVEL = 1e-4
"""Level of the F test for placement errors."""

_LEAST_RATIO = 4.0
"""Smallest ratio of variances that counts: placement errors about as large as the noise."""

_WARN_DEGREES = 0.2
_WARN_CHI2 = 4.0
"""Residuals above both limits cause a finding about the placement."""

_ROUNDS = 20
_SMALL_ANGLE = 1e-6


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
    refuse_if_unfit('12', unit(poses['reference']))
    fit, rejected = _fit(in_g(poses, units), method)
    quality = quality_of(fit, units, unit(fit.poses_g['reference']))
    kept = np.flatnonzero(~np.isin(poses.row, [each.row for each in rejected]))
    unlike = rivals(fit, kept, in_g(poses, units), lambda others: estimate(fit.model, others))
    return Calibration('12', method, fit.model, units, '', 'ros', '', covariance_with(fit, unlike),
                       quality, poses, rejected, reason,
                       (*rival_findings(unlike, poses.row), *fit_findings(fit, 0.0),
                        *_placement(fit)))


def _fit(poses_g: Poses, method: Method) -> tuple[Fit, tuple[Rejected, ...]]:
    """Fit model 12, without outliers if the other poses determine the model."""
    kept = ('reading', 'reference') if method == 'algebraic' else tuple(poses_g.columns)
    poses_g = Poses({key: poses_g[key] for key in kept if key in poses_g}, poses_g.row)
    start = with_vector(MODELS['12'].effects, np.zeros(12))
    rejected: tuple[Rejected, ...] = ()
    fit = estimate(start, poses_g)
    while method == 'ml':
        out = outliers(fit, len(poses_g)).poses
        left = fit.poses_g.take(np.delete(np.arange(len(fit.poses_g)), out))
        if not len(out) or not determines('12', unit(left['reference'])):
            break
        off = fit.equations.of_poses(fit.residual)[out] * MG
        rejected = (*rejected, *(
            Rejected(int(row), f'outlier: the reading differs by {error:.2f} mg from the fit of '
                     'the other poses', 'outlier')
            for row, error in zip(fit.poses_g.row[out], off, strict=True)))
        fit = estimate(fit.model, left)
    return fit, rejected


def _with_reference(poses: Poses, units: Units) -> tuple[Poses, str]:
    """Return the poses with their known forces, and a text about the source of the forces."""
    if 'reference' in poses:
        return poses, 'the orientations are known'
    faces_up = faces(poses.reading)
    if faces_up is None:
        raise RefusedFitError('the poses have no ref_x,ref_y,ref_z and are not the six faces, '
                              'but model 12 needs known orientations', 'add these columns, use '
                              'only the six faces (--rows), or use model 10')
    force = faces_up * (1.0 if units.is_native else units.per_g)
    return poses.with_columns(reference=force), 'the poses are the six faces'


def _unless_placed_well(poses: Poses, units: Units) -> Calibration | None:
    """Fit by |force| = 1 g alone if it contradicts the known orientations; otherwise None."""
    units, directions = own_scale(poses, units), directions_of(poses, units)
    if not determines('10', directions):
        return None
    poses_g = in_g(poses, units)
    try:
        found = solve_unknown(poses_g, directions, '10', 'ml')
    except RefusedFitError:  # without the outliers the poses do not determine the model
        return None
    seen = poses_g.take(found.kept)
    u, known = sensor_force(found.fit.model, seen.reading, {}), unit(seen['reference'])
    rotation = _rotation_onto(unit(u), known)
    if np.linalg.det(rotation) < 0.0:  # mirrored axes: only W can show them
        return None
    away = unit(u) - known @ rotation.T
    variance = _tangential_variance(found.fit, found.covariance, u)
    if not _is_placement(away, variance, found.fit.variance_dof):
        return None
    angle = np.degrees(np.linalg.norm(away, axis=1))
    words = (f'the known orientations differ by {np.sqrt(np.mean(angle ** 2)):.2g}° (RMS) from a '
             f'fit by |force| = 1 g, most in row {seen.row[np.argmax(angle)]} '
             f'({np.max(angle):.2g}°): the fit uses only |force| = 1 g, and the orientations '
             'determine only the rotation of the axes')
    by_norm = calibration_of(found, poses, units, 'ml')
    return replace(by_norm, model=replace(by_norm.model, rotation=rotation), reason=words,
                   noted=(Finding('placement', words), *by_norm.noted))


def _placement(fit: Fit) -> Iterator[Finding]:
    """Yield a finding about placement errors that |force| = 1 g cannot detect in these poses."""
    if fit.dof == 0:
        return
    off = fit.equations.of_poses(fit.residual)
    angle = np.degrees(np.sqrt(3.0 * np.sum(off ** 2) / fit.dof))
    if angle >= _WARN_DEGREES and fit.chi2 >= _WARN_CHI2 * fit.dof:
        yield Finding('placement', f'the readings differ by {angle:.2g}° from the known '
                      'orientations: if the placement of the sensor is not more accurate, the '
                      'result has this error', 'take 12 or more poses in other orientations, too, '
                      'and fit model 10')


def _rotation_onto(directions: Floats, known: Floats) -> Floats:
    """Return the orthogonal (3, 3) matrix R with directions = R known; robust to outliers."""
    weight = np.ones(len(directions))
    for _ in range(_ROUNDS):
        left, _, right = np.linalg.svd((directions * weight[:, np.newaxis]).T @ known)
        rotation: Floats = left @ right
        away = np.linalg.norm(directions - known @ rotation.T, axis=1)
        weight = 1.0 / np.maximum(away, max(float(np.median(away)), _SMALL_ANGLE))
    return rotation


def _tangential_variance(fit: Fit, covariance: Floats, u: Floats) -> Floats:
    """Return the (n,) variance across the force u from noise and uncertainty of the fit [g²]."""
    moved = np.linalg.solve(force_slope(fit.model, u, {}), parameter_basis(fit.model, u, {}))
    spread = moved @ covariance @ np.swapaxes(moved, 1, 2)
    along = np.einsum('ni,nij,nj->n', unit(u), spread, unit(u))
    own = 2.0 * fit.equations.scale ** 2 * fit.variance
    return own + np.trace(spread, axis1=1, axis2=2) - along


def _is_placement(away: Floats, variance: Floats, variance_dof: float) -> bool:
    """Return whether the differences are larger than the noise explains."""
    from scipy.special import fdtrc

    dof = 2.0 * len(away) - 3.0
    ratio = float(np.sum(away ** 2) / np.sum(variance)) * 2.0 * len(away) / dof
    return bool(ratio > _LEAST_RATIO and fdtrc(dof, variance_dof, ratio) < _LEVEL)
