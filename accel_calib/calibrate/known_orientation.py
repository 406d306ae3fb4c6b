# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses of known orientation: the fit of model 12, and faults of the wiring.

**Fit.** Model 12 is fitted, or model 10 if the sensor was placed badly.
An orientation is known only as accurately as the sensor was placed. A placement error of 2° turns
the force by 35 mg but does not change its length, so a fit by |force| = 1 g is not affected. If
the poses determine model 10, its forces are rotated onto the known forces (orthogonal Procrustes
problem, Schönemann 1966, with Huber's weights so that one misplaced pose has little influence).
The remaining differences are tangential. If an F test shows that they are larger than the noise
and the uncertainty of the fit explain, the fit uses only |force| = 1 g. The known orientations
then determine only the rotation of the axes, ΔR.

**Wiring.** |force| = 1 g does not reveal a wrong sign, swapped axes or a rotated sensor, because
the sphere of poses is the same. Known orientations reveal them. A least squares fit
reading = X force + y is valid for large errors, too, and the orthogonal part Q of X = S Q (polar
decomposition) contains the axes. Q is near the identity if each axis reads its own force.
Otherwise it is near one of the 24 rotations and 24 mirror images that permute the axes, or it is a
rotation by another angle. A rotation can be intended, a mirror image cannot.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from .calibration import Calibration, Method, ORIENTED, Rejected
from .pose_planning import determines, refuse_if_unfit
from .quality import fit_findings, in_g, record_of, rival_findings
from .unknown_orientation import calibration_of, directions_of, own_scale, solve_unknown
from ..effects import AXES, force_slope, MODELS, parameter_basis, sensor_force, with_vector
from ..errors import RefusedFitError
from ..estimate import covariance_with, estimate, faces, Fit, fit_12, outliers, rivals
from ..finding import Finding, Level
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

_NEAR = 25.0
"""Largest angle between axes and a permutation that they match [°]."""

_LEAST_SPREAD = 0.1
"""Smallest ratio of the singular values of the centred known forces to determine the axes."""

_ADVICE = 'check the wiring, the driver and the signs of ref_x,ref_y,ref_z'

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
    refuse_if_unfit(ORIENTED, unit(poses['reference']))
    poses_g = in_g(poses, units)
    fit, rejected = _without_outliers(poses_g, method)
    kept = np.flatnonzero(~np.isin(poses.row, [pose.row for pose in rejected]))
    unlike = rivals(fit, kept, poses_g, lambda others: estimate(fit.model, others))
    return record_of(
        fit, poses, units, unit(fit.poses_g['reference']), ORIENTED, method,
        covariance=covariance_with(fit, unlike), rejected=rejected, reason=reason,
        noted=(*rival_findings(unlike, poses.row), *fit_findings(fit, 0.0), *_placement(fit)))


def _without_outliers(poses_g: Poses, method: Method
                      ) -> tuple[Fit, tuple[Rejected, ...]]:
    """Fit model 12, without outliers if the other poses determine the model."""
    kept = ('reading', 'reference') if method == 'algebraic' else tuple(poses_g.columns)
    poses_g = Poses({key: poses_g[key] for key in kept if key in poses_g}, poses_g.row)
    effects = MODELS[ORIENTED].effects
    rejected: tuple[Rejected, ...] = ()
    fit = estimate(with_vector(effects, np.zeros(12)), poses_g)
    while method == 'ml':
        out = outliers(fit, len(poses_g)).poses
        left = fit.poses_g.take(np.delete(np.arange(len(fit.poses_g)), out))
        if not len(out) or not determines(ORIENTED, unit(left['reference'])):
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


def wiring(calibration: Calibration) -> Iterator[Finding]:
    """Yield a finding if the known orientations of the poses reveal a wiring fault."""
    poses, name = calibration.poses, calibration.name
    if 'reference' not in poses:
        return
    mat_q = axes_of(poses.reading, poses['reference'])
    found = None if mat_q is None else fault_of(mat_q)
    if mat_q is None or found is None:
        return
    level: Level = 'USABLE'
    mirrored = np.linalg.det(mat_q) < 0.0
    if calibration.form.known_orientation:
        level, effect = 'USABLE' if mirrored else 'GOOD', f'model {name} corrects it'
    elif mirrored:
        level = 'BAD'
        effect = f'model {name} does not correct it, because |force| = 1 g does not reveal it'
    elif not calibration.is_levelled:
        effect = f'model {name} does not correct it'
    else:
        level, effect = 'GOOD', 'the mounting corrects it'
    advice = _ADVICE if mirrored else f'if it is not mounted this way, {_ADVICE}'
    yield Finding('wiring', f'according to the known orientations, {found}; {effect}', advice,
                  level)


def axes_of(reading: Floats, reference: Floats) -> Floats | None:
    """
    Return the orientation of the axes of the readings relative to those of the known forces.

    It is the orthogonal (3, 3) matrix from the (n, 3) known forces to the axes of the (n, 3)
    readings, both in any units, with determinant ±1. It is None if the forces do not determine it.

    """
    scales = np.linalg.svd(reference - reference.mean(axis=0), compute_uv=False)
    if len(scales) < 3 or scales[2] < _LEAST_SPREAD * scales[0]:
        return None
    try:
        left, _, right = np.linalg.svd(fit_12(reading, reference)[0])
    except RefusedFitError:
        return None
    mat_q: Floats = left @ right
    return mat_q


def fault_of(mat_q: Floats) -> str | None:
    """Return the wiring fault of a matrix as from `axes_of`; None if there is none."""
    if _angle(mat_q) <= _NEAR:
        return None
    nearest = max(_PERMUTATIONS, key=lambda one: float(np.sum(one * mat_q)))
    if _angle(mat_q @ nearest.T) <= _NEAR:
        return _words(nearest)
    if np.linalg.det(mat_q) > 0.0:
        return f'the sensor is rotated by {_turn(mat_q.T)}'
    return ('the readings are a mirror image: an axis has the wrong sign or two axes are swapped, '
            'and the sensor is also rotated')


def _signed_permutations() -> list[Floats]:
    return [np.diag(signs) @ np.eye(3)[list(order)]
            for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]


_PERMUTATIONS = _signed_permutations()
"""The 48 signed permutations of the axes, including mirror images."""


def _angle(mat_q: Floats) -> float:
    """Return the angle of a rotation [°]; 180 for a mirror image."""
    if np.linalg.det(mat_q) < 0.0:
        return 180.0
    return float(np.degrees(np.arccos(np.clip((np.trace(mat_q) - 1.0) / 2.0, -1.0, 1.0))))


def _words(permutation: Floats) -> str:
    """Return a description of a signed permutation that is not the identity."""
    reads = _mapping(permutation)
    if np.linalg.det(permutation) > 0.0:
        return f'the sensor is rotated by {_turn(permutation.T)} ({reads})'
    diagonal = np.diag(permutation)
    if np.all(diagonal == -1.0):
        return ('all three axes have the wrong sign: the sensor reports gravity, which points '
                'down, instead of specific force, which points up')
    if np.count_nonzero(diagonal) == 3:
        return f'the {AXES[int(np.argmin(diagonal))]} axis has the wrong sign ({reads})'
    if np.all(permutation >= 0.0):
        swapped = [axis for axis, own in zip(AXES, diagonal, strict=True) if own == 0.0]
        return f'{" and ".join(swapped)} are swapped'
    return f'the axes are permuted to a mirror image: {reads}'


def _mapping(permutation: Floats) -> str:
    """Return the force that each axis reads, for axes that do not read their own force."""
    parts = []
    for axis, row in zip(AXES, permutation, strict=True):
        other = int(np.argmax(np.abs(row)))
        sign = '-' if row[other] < 0.0 else '+'
        if f'{sign}{AXES[other]}' != f'+{axis}':
            parts.append(f'{axis} reads {sign}{AXES[other]}')
    return ', '.join(parts)


def _turn(rotation: Floats) -> str:
    """Return a rotation of the sensor as an angle about an axis."""
    from scipy.spatial.transform import Rotation

    vector = Rotation.from_matrix(rotation).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    axis = vector / angle
    axis = axis if axis[np.argmax(np.abs(axis))] > 0.0 or angle < 179.0 else -axis
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > np.cos(np.radians(_NEAR)):
        signed = angle if axis[largest] > 0.0 else -angle
        return f'{signed:.0f}° about {AXES[largest]}'
    return f'{angle:.0f}° about ({", ".join(f"{part:.2g}" for part in axis)})'
