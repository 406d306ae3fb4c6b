# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Directions: unit vectors on the sphere."""

from __future__ import annotations

import numpy as np

from .table import Floats

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def spread_directions(count: int) -> Floats:
    """
    Return directions that are spread evenly over the sphere (Fibonacci lattice).

    Returns
    -------
    (count, 3) array
        Unit vectors.

    """
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    radius, angle = np.sqrt(1.0 - z ** 2), _GOLDEN_ANGLE * np.arange(count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


OVER_THE_SPHERE = spread_directions(300)
"""Directions over which figures are averaged, (300, 3); not to be changed in place."""


def unit(vectors: Floats) -> Floats:
    """Return (n, 3) vectors scaled to length 1; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def random_directions(count: int, rng: np.random.Generator) -> Floats:
    """
    Return random directions, uniformly distributed over the sphere.

    Returns
    -------
    (count, 3) array
        Unit vectors.

    """
    return unit(rng.normal(size=(count, 3)))
