# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Faults of the wiring, in words: a wrong sign, axes swapped, a turned or mirrored sensor.

|force| = 1 g cannot see any of them: the sphere of poses is the same. Known orientations can. A
least squares fit reading = X force + y needs no small errors, and the orthogonal part Q of
X = S Q (polar decomposition) says how the axes lie: near the identity where each reads its own
force, otherwise near one of the 24 rotations and 24 mirrored ones that permute the axes, or a
turn by any angle. A rotation may well be meant, a mirror image never is.

One flat pose shows which way is up for the sensor, and no more: upside down and a wrong sign look
the same.

"""

from __future__ import annotations

from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np

from .closed_form import fit_12
from .mounting import flat_direction
from ..errors import RefusedFitError
from ..table import Floats

if TYPE_CHECKING:
    from .calibration import Calibration

FLAT = 'the flat pose'
"""What the warning about a flat pose begins with."""

_AXES = 'xyz'
_NEAR = 25.0
"""Axes within this of a permutation are called that; within it of their own they are right [°]."""

_ON_ITS_SIDE = 45.0
"""A flat pose further from the expected axis than this is worth a word [°]."""

_LEAST_SPREAD = 0.1
"""Least singular value of the centred known forces over the largest, to tell the axes."""

_ADVICE = 'check the wiring, the driver and the signs of ref_x,ref_y,ref_z'


def wiring_warnings(calibration: Calibration) -> tuple[str, ...]:
    """
    Say what known orientations show of the wiring.

    Parameters
    ----------
    calibration : Calibration
        With its poses; where their orientations are not known, nothing is said.

    Returns
    -------
    tuple of str
        One warning, or none.

    """
    poses, name = calibration.poses, calibration.name
    if 'reference' not in poses:
        return ()
    mat_q = axes_of(poses.reading, poses['reference'])
    found = None if mat_q is None else fault_of(mat_q)
    if mat_q is None or found is None:
        return ()
    mirrored = np.linalg.det(mat_q) < 0.0
    if name == '12':
        effect = 'model 12 corrects for it'
    elif mirrored:
        effect = f'model {name} does not correct for it: |force| = 1 g cannot see it'
    elif np.array_equal(calibration.model.rotation, np.eye(3)):
        effect = f'model {name} leaves it as it is'
    else:
        effect = 'the mounting takes it out'
    advice = _ADVICE if mirrored else f'if that is not how it is mounted, {_ADVICE}'
    return (f'against the known orientations {found}; {effect}; {advice}',)


def axes_of(reading: Floats, reference: Floats) -> Floats | None:
    """
    Find how the axes of the readings lie in those of the known forces.

    Parameters
    ----------
    reading, reference : (n, 3) array
        In any units.

    Returns
    -------
    (3, 3) array or None
        The orthogonal matrix from the known forces to the axes of the readings, det ±1; None
        where the known forces do not tell it.

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
    Name what is wrong with axes that lie like this.

    Parameters
    ----------
    mat_q : (3, 3) array
        Orthogonal, det ±1, from true forces to the axes of the readings.

    Returns
    -------
    str or None
        None where each axis reads its own force.

    """
    if _angle(mat_q) <= _NEAR:
        return None
    nearest = max(_PERMUTATIONS, key=lambda one: float(np.sum(one * mat_q)))
    if _angle(mat_q @ nearest.T) <= _NEAR:
        return _words(nearest)
    if np.linalg.det(mat_q) > 0.0:
        return f'the sensor is turned by {_turn(mat_q.T)}: a rotation'
    return ('the readings are a mirror image: an axis has the wrong sign, or two are swapped, and '
            'the sensor is turned besides')


def _signed_permutations() -> list[Floats]:
    return [np.diag(signs) @ np.eye(3)[list(order)]
            for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]


_PERMUTATIONS = _signed_permutations()
"""The 48 ways in which axes may be taken for one another."""


def _angle(mat_q: Floats) -> float:
    """Give the angle of a rotation [°]; 180 for a mirror image."""
    if np.linalg.det(mat_q) < 0.0:
        return 180.0
    return float(np.degrees(np.arccos(np.clip((np.trace(mat_q) - 1.0) / 2.0, -1.0, 1.0))))


def _words(permutation: Floats) -> str:
    """Name a signed permutation that is not the identity."""
    reads = _mapping(permutation)
    if np.linalg.det(permutation) > 0.0:
        return (f'the sensor is turned by {_turn(permutation.T)} ({reads}): a rotation')
    diagonal = np.diag(permutation)
    if np.all(diagonal == -1.0):
        return ('all three axes have the wrong sign: the sensor gives gravity, which points '
                'down, and not the force that holds it up')
    if np.count_nonzero(diagonal) == 3:
        return f'the {_AXES[int(np.argmin(diagonal))]} axis has the wrong sign ({reads})'
    if np.all(permutation >= 0.0):
        swapped = [axis for axis, own in zip(_AXES, diagonal, strict=True) if own == 0.0]
        return f'{" and ".join(swapped)} are swapped'
    return f'the axes are mixed up: {reads}, a mirror image'


def _mapping(permutation: Floats) -> str:
    """Say what each axis reads, where that is not its own force."""
    parts = []
    for axis, row in zip(_AXES, permutation, strict=True):
        other = int(np.argmax(np.abs(row)))
        sign = '-' if row[other] < 0.0 else '+'
        if f'{sign}{_AXES[other]}' != f'+{axis}':
            parts.append(f'{axis} reads {sign}{_AXES[other]}')
    return ', '.join(parts)


def _turn(rotation: Floats) -> str:
    """Give a rotation of the sensor as an angle about an axis."""
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


def flat_warnings(rotation: Floats, frame: str) -> tuple[str, ...]:
    """
    Say what a flat pose may show of the wiring.

    Parameters
    ----------
    rotation : (3, 3) array
        ΔR of that pose.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.

    Returns
    -------
    tuple of str
        One warning, or none where the axis that is expected to reads about 1 g.

    """
    expected = flat_direction(frame)
    force = rotation @ expected
    off = np.degrees(np.arccos(np.clip(force @ expected, -1.0, 1.0)))
    if off <= _ON_ITS_SIDE:
        return ()
    face = int(np.argmax(np.abs(force)))
    seen = f'{"-" if force[face] < 0.0 else "+"}{_AXES[face]}'
    own = f'{"-" if expected[2] < 0.0 else "+"}z'
    begin = (f'{FLAT} reads {force[face]:+.2f} g on {_AXES[face]}, where a sensor that lies flat '
             f'reads 1 g on {own}: ')
    if face == 2:
        return (f'{begin}it is mounted upside down, or z (or every axis) has the wrong sign: '
                'one flat pose cannot tell which; if it is not upside down, mend the sign: a '
                'rotation cannot put it right',)
    return (f'{begin}it is mounted with {seen} up, or {_AXES[face]} and z are swapped, which one '
            'flat pose cannot tell apart; if it lies flat, mend the wiring or the driver',)
