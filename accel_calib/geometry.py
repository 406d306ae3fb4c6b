# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Rotations as matrices, quaternions, roll, pitch and yaw; directions, and attitudes by name.

Rotations are converted here, because the import of `scipy.spatial` takes 0.2 s and 25 MB: a node
would load it between two messages. Static transforms need only the rotations between their frames.

"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import permutations, product
import math

import numpy as np

from .errors import InputError
from .statistics import rms
from .units import Floats, Indices


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Floats:
    """
    Return the (3, 3) rotation of fixed-axis roll, pitch and yaw [rad], as in URDF.

    It transforms from the axes of the rotated body to the fixed axes.

    """
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array([[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                     [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                     [-sp, cp * sr, cp * cr]])


def rpy_of(rotation: Floats) -> tuple[float, float, float]:
    """
    Return fixed-axis roll, pitch and yaw [rad]; the inverse of `rotation_from_rpy`.

    At a pitch of ±90° only the sum or the difference of roll and yaw is defined; roll is then 0.

    """
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    if math.hypot(rotation[2, 1], rotation[2, 2]) < 1e-9:
        return 0.0, pitch, math.atan2(-rotation[0, 1], rotation[1, 1])
    return (math.atan2(rotation[2, 1], rotation[2, 2]), pitch,
            math.atan2(rotation[1, 0], rotation[0, 0]))


def quaternion_of(rotation: Floats) -> tuple[float, float, float, float]:
    """
    Return the unit quaternion (x, y, z, w) of a rotation matrix, with w >= 0.

    q qᵀ, which is linear in the matrix, is formed, and its largest column is normalised.

    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    outer = np.array([[1 + a - e - i, b + d, c + g, h - f],
                      [b + d, 1 - a + e - i, f + h, c - g],
                      [c + g, f + h, 1 - a - e + i, d - b],
                      [h - f, c - g, d - b, 1 + a + e + i]])
    column = outer[:, int(np.argmax(np.diag(outer)))]
    x, y, z, w = (column / np.linalg.norm(column) * (-1.0 if column[3] < 0.0 else 1.0)).tolist()
    return x, y, z, w


def angle_of(rotation: Floats) -> float:
    """Return the angle of an orthogonal matrix [°], 0 to 180; that of a mirror is 90 or more."""
    cosine = (float(np.trace(rotation)) - 1.0) / 2.0
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))


def spread_directions(count: int) -> Floats:
    """Return (count, 3) unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    golden_angle = np.pi * (3.0 - np.sqrt(5.0))
    radius, angle = np.sqrt(1.0 - z ** 2), golden_angle * np.arange(count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


OVER_THE_SPHERE = spread_directions(300)
"""Directions over which figures are averaged, (300, 3); not to be changed in place."""


def sphere_through(points: Floats) -> tuple[float, float]:
    """
    Return the radius of the sphere, or the circle, nearest to (n, k) points, and the RMS distance.

    |m|² = 2 c·m + (r² - |c|²) is linear in the centre c.

    """
    columns = np.column_stack([2.0 * points, np.ones(len(points))])
    values = np.linalg.lstsq(columns, np.sum(points**2, axis=1), rcond=None)[0]
    radius = math.sqrt(max(float(values[-1] + values[:-1] @ values[:-1]), 0.0))
    return radius, rms(np.linalg.norm(points - values[:-1], axis=1) - radius)


def unit(vectors: Floats) -> Floats:
    """Return (…, 3) vectors scaled to length 1; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


TAKEN = np.cos(np.radians(17.0))
"""A pose within 17° of one of `ATTITUDES` has taken it; its neighbours are 35° away."""

ATTITUDES = unit(np.array(sorted((signs for signs in product((0.0, 1.0, -1.0), repeat=3)
                                  if any(signs)), key=np.count_nonzero)))
"""The 6 faces, 12 edges and 8 corners of a sensor that can point up, in this order: (26, 3) unit
vectors, whose signs are those of the axes."""

SIGNED_AXES = [np.eye(3)[list(order)] * signs for order in permutations(range(3))
               for signs in product((1.0, -1.0), repeat=3)]
"""The 48 ways in which axes can be swapped and inverted, (3, 3) each, including mirror images."""

_NEAR = np.cos(np.radians(45.0))
_COVERAGE_DIRECTIONS = 500
_BLOCK = 1000
_SAME = np.cos(np.radians(5.0))
_NAMED = np.cos(np.radians(8.0))
"""A direction within 8° of a face, edge or corner has its name."""

_SIDES = (('front', 'back'), ('left', 'right'), ('top', 'bottom'))


def uncovered(directions: Floats) -> Floats:
    """Return the directions of an even grid that are not within 45° of a pose, (m, 3)."""
    left = spread_directions(_COVERAGE_DIRECTIONS)
    for start in range(0, len(directions), _BLOCK):
        left = left[np.max(left @ directions[start:start + _BLOCK].T, axis=1) < _NEAR]
    return left


def coverage(directions: Floats) -> float:
    """Return the share of the sphere within 45° of a pose, for (n, 3) unit vectors."""
    return 1.0 - len(uncovered(directions)) / _COVERAGE_DIRECTIONS


def orientations_of(directions: Floats) -> Indices:
    """Return the (n,) number of the orientation of (n, 3) unit vectors; others are 5° apart."""
    first, found, count = np.zeros_like(directions), np.zeros(len(directions), np.intp), 0
    for start in range(0, len(directions), _BLOCK):
        block = directions[start:start + _BLOCK]
        near, before = block @ first[:count].T >= _SAME, count
        place = np.argmax(np.column_stack([near, np.ones(len(block), bool)]), axis=1)
        found[start:start + _BLOCK] = place
        for k in (start + np.flatnonzero(place == before)).tolist():
            own = (first[before:count] @ directions[k] >= _SAME).nonzero()[0]
            if len(own):
                found[k] = before + own[0]
            else:
                first[count], found[k], count = directions[k], count, count + 1
    return found


def distinct(directions: Floats) -> int:
    """Return the number of directions at least 5° apart, for (n, 3) unit vectors."""
    return len(np.unique(orientations_of(directions)))


def cone_of(directions: Floats) -> tuple[Floats, float]:
    """Return the mean of (n, 3) unit vectors, n >= 1, and their largest angle from it [°]."""
    axis = unit(directions.mean(axis=0)[np.newaxis])[0]
    cosine = float(np.clip(np.min(directions @ axis), -1.0, 1.0))
    return axis, float(np.degrees(np.arccos(cosine)))


def words_of(signs: Floats) -> str:
    """Return the name of the side, edge or corner with these signs of the axes."""
    sides = [pair[0 if sign > 0 else 1] for pair, sign in zip(_SIDES, signs, strict=True) if sign]
    what = {1: 'the {} side', 2: 'the {} {} edge', 3: 'the {} {} {} corner'}[len(sides)]
    return what.format(*sides)


def axes_of_signs(signs: Floats) -> str:
    """Return the axes of these signs, such as ``+x -y``."""
    return ' '.join(f'{"+" if sign > 0 else "-"}{axis}'
                    for axis, sign in zip('xyz', signs, strict=True) if sign)


def attitude_words(up: Floats) -> str:
    """Return a direction that points up in words: a face, edge or corner, or a tilted face."""
    near = int(np.argmax(ATTITUDES @ up))
    if ATTITUDES[near] @ up >= _NAMED:
        return f'{words_of(np.sign(ATTITUDES[near]))} up ({axes_of_signs(ATTITUDES[near])})'
    axis = int(np.argmax(np.abs(up)))
    face = np.sign(up) * (np.arange(3) == axis)
    flat = unit((up - up[axis] * np.eye(3)[axis])[np.newaxis])[0]
    edges = ATTITUDES[ATTITUDES[:, axis] == 0.0]
    raised = edges[int(np.argmax(edges @ flat))]
    tilt = math.degrees(math.acos(min(abs(float(up[axis])), 1.0)))
    return (f'{words_of(face)} up ({axes_of_signs(face)}), tilted by {tilt:.0f}° so that '
            f'{words_of(np.sign(raised))} ({axes_of_signs(raised)}) rises')


_LENGTH_TOLERANCE = 0.01
"""Largest error of the squared length of a quaternion, as in tf2 of ROS."""


@dataclass(frozen=True)
class StaticTransforms:
    """A tree of frames: the parent of each frame, and the rotation of vectors to the parent."""

    parents: dict[str, tuple[str, Floats]] = field(default_factory=dict)

    def add(self, parent: str, child: str, quaternion: Sequence[float]) -> bool:
        """
        Add a transform, or replace the previous one of this child; return whether it is new.

        The quaternion (x, y, z, w) is that of the rotation of vectors from `child` to `parent`.
        InputError if a name is empty, the quaternion is not a rotation, or the frames form a loop:
        the tree is then unchanged.

        """
        parent, child = parent.removeprefix('/'), child.removeprefix('/')
        if not (parent and child):
            raise InputError(f'a static transform from {parent!r} to {child!r} has an empty frame '
                             'name, expected two names', 'correct the node that publishes it')
        if child in self._rotations_above(parent):
            raise InputError(f'the static transform from {parent} to {child} makes a loop, '
                             f'expected that {child} is not above {parent}',
                             'correct the node that publishes it, or restart this node if the '
                             'frames were rearranged')
        squared = sum(part * part for part in quaternion)
        if not abs(squared - 1.0) < _LENGTH_TOLERANCE:  # NaN too
            words = ', '.join(f'{part:g}' for part in quaternion)
            raise InputError(
                f'the static transform from {parent} to {child} has the quaternion ({words}) of '
                f'length {math.sqrt(squared):.3g}, expected length 1',
                'correct the node that publishes it')
        x, y, z, w = quaternion
        rotation = np.eye(3) + 2.0 / squared * np.array(
            [[-y * y - z * z, x * y - w * z, x * z + w * y],
             [x * y + w * z, -x * x - z * z, y * z - w * x],
             [x * z - w * y, y * z + w * x, -x * x - y * y]])
        before = self.parents.get(child)
        self.parents[child] = (parent, rotation)
        return before is None or before[0] != parent or not np.array_equal(before[1], rotation)

    def rotation(self, base: str, frame: str) -> Floats | None:
        """Return the (3, 3) rotation of vectors from `frame` to `base`; None: not connected."""
        above_base, above = (
            self._rotations_above(each.removeprefix('/')) for each in (base, frame))
        for common, mat_common_frame in above.items():
            if common in above_base:
                return above_base[common].T @ mat_common_frame
        return None

    def _rotations_above(self, frame: str) -> dict[str, Floats]:
        """Return the rotation from a frame to itself and to each frame above it, nearest first."""
        found: dict[str, Floats] = {frame: np.eye(3)}
        while frame in self.parents:
            parent, mat_parent_frame = self.parents[frame]
            found[parent] = mat_parent_frame @ found[frame]
            frame = parent
        return found
