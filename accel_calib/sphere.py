# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Directions: unit vectors on the sphere."""

from __future__ import annotations

import numpy as np

from .table import Floats

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def spread_directions(count: int) -> Floats:
    """
    Spread directions evenly over the sphere (Fibonacci lattice).

    Returns
    -------
    (count, 3) array
        Unit vectors.

    """
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    radius, angle = np.sqrt(1.0 - z ** 2), _GOLDEN_ANGLE * np.arange(count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def unit(vectors: Floats) -> Floats:
    """Give (n, 3) vectors at length 1; zeros stay zeros."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def random_directions(count: int, rng: np.random.Generator) -> Floats:
    """
    Draw directions evenly over the sphere.

    Returns
    -------
    (count, 3) array
        Unit vectors.

    """
    return unit(rng.normal(size=(count, 3)))


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Floats:
    """
    Give the rotation of fixed-axis roll, pitch and yaw [rad], as in URDF.

    Returns
    -------
    (3, 3) array
        From the axes of the turned body to those it is turned in.

    """
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array([[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                     [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                     [-sp, cp * sr, cp * cr]])
