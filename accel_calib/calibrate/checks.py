# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Checks of the input for wiring faults.

|force| = 1 g does not reveal a wrong sign, swapped axes or a rotated sensor, because the sphere of
poses is the same. Known orientations reveal them. A least squares fit reading = X force + y is
valid for large errors, too, and the orthogonal part Q of X = S Q (polar decomposition) contains
the axes. Q is near the identity if each axis reads its own force. Otherwise it is near one of the
24 rotations and 24 mirror images that permute the axes, or it is a rotation by another angle. A
rotation can be intended, a mirror image cannot.

One flat pose determines only the direction of up: an upside-down sensor and a wrong sign have the
same reading.

"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np

from .mounting import flat_direction
from ..errors import RefusedFitError
from ..estimate import fit_12
from ..finding import Finding, Level
from ..table import Floats

if TYPE_CHECKING:
    from .calibration import Calibration

_AXES = 'xyz'
_NEAR = 25.0
"""Largest angle between axes and a permutation that they match [°]."""

_ON_ITS_SIDE = 45.0
"""Angle between a flat pose and the expected axis above which there is a warning [°]."""

_LEAST_SPREAD = 0.1
"""Smallest ratio of the singular values of the centred known forces to determine the axes."""

_ADVICE = 'check the wiring, the driver and the signs of ref_x,ref_y,ref_z'


def wiring(calibration: Calibration) -> Iterator[Finding]:
    """
    Yield a finding if known orientations reveal a wiring fault.

    Parameters
    ----------
    calibration : Calibration
        The calibration, with its poses.

    """
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
        level, effect = 'USABLE' if mirrored else 'GOOD', 'model 12 corrects it'
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

    Parameters
    ----------
    reading, reference : (n, 3) array
        Readings and known forces, in any units.

    Returns
    -------
    (3, 3) array or None
        Orthogonal matrix from the known forces to the axes of the readings, with determinant ±1;
        None if the known forces do not determine it.

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
    """
    Return a description of the wiring fault, if there is one.

    Parameters
    ----------
    mat_q : (3, 3) array
        Orthogonal matrix from true forces to the axes of the readings, with determinant ±1.

    Returns
    -------
    str or None
        The fault; None if each axis reads its own force.

    """
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
        return f'the {_AXES[int(np.argmin(diagonal))]} axis has the wrong sign ({reads})'
    if np.all(permutation >= 0.0):
        swapped = [axis for axis, own in zip(_AXES, diagonal, strict=True) if own == 0.0]
        return f'{" and ".join(swapped)} are swapped'
    return f'the axes are permuted to a mirror image: {reads}'


def _mapping(permutation: Floats) -> str:
    """Return the force that each axis reads, for axes that do not read their own force."""
    parts = []
    for axis, row in zip(_AXES, permutation, strict=True):
        other = int(np.argmax(np.abs(row)))
        sign = '-' if row[other] < 0.0 else '+'
        if f'{sign}{_AXES[other]}' != f'+{axis}':
            parts.append(f'{axis} reads {sign}{_AXES[other]}')
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
        return f'{signed:.0f}° about {_AXES[largest]}'
    return f'{angle:.0f}° about ({", ".join(f"{part:.2g}" for part in axis)})'


def doubts_about_flat(rotation: Floats, frame: str) -> Iterator[Finding]:
    """
    Yield a finding if a flat pose indicates a wiring fault.

    Parameters
    ----------
    rotation : (3, 3) array
        ΔR of the flat pose.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.

    """
    expected = flat_direction(frame)
    force = rotation @ expected
    off = np.degrees(np.arccos(np.clip(force @ expected, -1.0, 1.0)))
    if off <= _ON_ITS_SIDE:
        return
    face = int(np.argmax(np.abs(force)))
    seen = f'{"-" if force[face] < 0.0 else "+"}{_AXES[face]}'
    own = f'{"-" if expected[2] < 0.0 else "+"}z'
    if face == 2:
        causes = 'it is mounted upside down, or z (or every axis) has the wrong sign'
        advice = 'if it is not upside down, correct the sign, because a rotation does not'
    else:
        causes = f'it is mounted with {seen} up, or {_AXES[face]} and z are swapped'
        advice = 'if it lies flat, correct the wiring or the driver'
    yield Finding('flat_pose', f'the flat pose reads {force[face]:+.2f} g on {_AXES[face]}, where '
                  f'a sensor that lies flat reads 1 g on {own}: {causes}; one flat pose cannot '
                  'distinguish them', advice, 'USABLE')
