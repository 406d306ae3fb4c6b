# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the directions of the poses determine: how well, and what they leave open.

A pose with force u sees the values of a model through the rows Φ(u): of unknown orientation the
one row û · basis(u) (see `accel_calib.estimate.equations`, with A near I), of known orientation
the three rows basis(u). With s_i the noise of a pose over that of the median pose, the poses have
the information

    M = Σ Φ_iᵀ Φ_i / s_i²

and the corrected |force| (of known orientation: the force) in a direction d is uncertain by

    √(Φ(d) M⁻¹ Φ(d)ᵀ)

times the noise of a pose. The largest such root over the sphere is the dilution: how much worse
than a pose the fit is somewhere. It is about 1 for 12 poses spread evenly. What the poses leave
open is in `accel_calib.estimate.identifiability`.

"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from .noise import believable, LEAST_NOISE
from ..model import MODELS, parameter_names, with_vector
from ..sphere import spread_directions
from ..table import Floats

LARGEST_DILUTION = 25.0
"""Beyond this a fit is refused. 12 poses in a 45° cone have 400, in five directions and 2° about
them 100, the worst 1 % of 12 poses in random directions 25. At 0.3 mg per pose it is an error of
8 mg somewhere; fits that are wrong by 10 mg all over the sphere lie beyond it, with a limit of 40
some of them do not (`benchmarks/geometry.py`)."""

WEAK_DILUTION = 10.0
"""Beyond this a fit warns: somewhere the error of |force| is ten times that of a pose."""

NORM_MODELS = ('4', '7', '10')
"""Models for poses of unknown orientation, the smallest first."""

_NEAR = np.cos(np.radians(45.0))
_SAME = np.cos(np.radians(5.0))
_SINGULAR, _NOTHING = 1e-6, 1e-14


def effects_of(name: str) -> tuple[str, ...]:
    """Return the effects of a model; 9 is 10 in other axes."""
    return MODELS['10' if name == '9' else name]


def parameters_of(name: str) -> tuple[str, ...]:
    """Return the names of the parameters of a model."""
    return parameter_names(effects_of(name))


def rows_of(name: str, directions: Floats) -> Floats:
    """Return Φ for each of these (n, 3) unit vectors: (n, 1, p), or (n, 3, p) for model 12."""
    basis = with_vector(effects_of(name), np.zeros(free_parameters(name))).basis(directions, {})
    return basis.full if name == '12' else basis.along(directions)[:, np.newaxis]


def pose_noise(noise: Floats | None, directions: Floats) -> Floats | None:
    """Return the (n,) noise of |reading| from that of (n, 3) pose means; None if it is unknown."""
    believed = believable(noise) if len(directions) else None
    if believed is None:
        return None
    along = np.linalg.norm(directions * believed, axis=1)
    median = np.median(along)
    return np.maximum(along, LEAST_NOISE * median) if median > 0.0 else None


def relative_weights(noise: Floats | None, count: int) -> Floats:
    """Return 1 / s², (count,), from the noise of each pose in any unit; ones if it is unknown."""
    if noise is None or count == 0:
        return np.ones(count)
    weights: Floats = (np.median(noise) / noise) ** 2
    return weights


@lru_cache(maxsize=8)
def over_the_sphere(name: str) -> Floats:
    """Return Φ of directions spread evenly over the sphere, (m, 1 or 3, p)."""
    return rows_of(name, spread_directions(300))


def information_of(name: str, directions: Floats, weights: Floats) -> Floats:
    """Return M, (p, p)."""
    rows = rows_of(name, directions)
    information: Floats = np.einsum('n,nip,niq->pq', weights, rows, rows)
    return information


def free_parameters(name: str) -> int:
    """Return the number of free parameters of a model: 4, 6 (g is known), 9, 9 or 12."""
    return len(parameters_of(name))


def poses_needed(name: str) -> int:
    """Return the fewest poses that can determine a model."""
    return 4 if name == '12' else free_parameters(name)


def _weighted_rows(name: str, directions: Floats, noise: Floats | None) -> Floats:
    """Return Φ / s of all poses, (m, p)."""
    root = np.sqrt(relative_weights(noise, len(directions)))
    rows = rows_of(name, directions) * root[:, np.newaxis, np.newaxis]
    return rows.reshape(-1, rows.shape[2])


def spectrum(name: str, directions: Floats, noise: Floats | None = None
             ) -> tuple[Floats, Floats, Floats]:
    """
    Split a model into combinations of parameters, in the order in which poses determine them.

    Parameters
    ----------
    name : {'4', '7', '9', '10', '12'}
        The model.
    directions : (n, 3) array
        Unit vectors of force in the sensor axes; n may be 0.
    noise : (n,) array, optional
        Noise of each pose, in any unit; equal if it is not given.

    Returns
    -------
    (p,) array
        Standard deviation of each combination over the noise of a pose, the smallest first;
        infinite if nothing determines it.
    (p, p) array
        The combinations, rows of length 1.
    (p, m) array
        Error of |force| in m directions over that of a pose, squared, from the combinations up
        to this one.

    """
    triangle = np.linalg.qr(_weighted_rows(name, directions, noise), mode='r')
    square = np.zeros((free_parameters(name),) * 2)
    square[:len(triangle)] = triangle
    _, scales, axes = np.linalg.svd(square)
    told = scales > _SINGULAR * max(scales[0], 1.0)
    deviations = np.where(told, 1.0 / np.where(told, scales, 1.0), np.inf)
    seen = np.sum((over_the_sphere(name) @ axes.T) ** 2, axis=1)
    return deviations, axes, np.cumsum(times(seen, deviations ** 2), axis=1).T


def times(share: Floats, deviations: Floats) -> Floats:
    """Return the product, 0 where the share is 0 of an infinite deviation."""
    none = np.abs(share) < _NOTHING
    return np.where(none, 0.0, share) * np.where(none, 0.0, deviations)


def dilution(name: str, directions: Floats, noise: Floats | None = None) -> float:
    """
    Return the dilution of poses under a model; arguments as `spectrum`.

    Returns
    -------
    float
        Largest error of |force| over the sphere, over that of a pose; infinite if the poses leave
        a parameter open.

    """
    rows = _weighted_rows(name, directions, noise)
    information = rows.T @ rows
    size = len(information)
    ridge = _NOTHING * np.trace(information) + 1e-300
    inverse = np.linalg.inv(information + ridge * np.eye(size))
    found = float(np.sqrt(np.max(inverse.ravel() @ _pairs_over_the_sphere(name))))
    return found if found < 1.0 / _SINGULAR else np.inf


@lru_cache(maxsize=8)
def _pairs_over_the_sphere(name: str) -> Floats:
    """Return the products of the entries of Φ in each direction, (p², m)."""
    around = over_the_sphere(name)
    pairs = np.einsum('mkp,mkq->mpq', around, around)
    return np.ascontiguousarray(pairs.reshape(len(pairs), -1).T)


def coverage(directions: Floats) -> float:
    """Return the share of the sphere that lies within 45° of a pose; (n, 3) unit vectors."""
    near = np.max(spread_directions(500) @ directions.T, axis=1)
    return float(np.mean(near >= _NEAR))


def distinct(directions: Floats) -> int:
    """Return the number of directions that are more than 5° apart; (n, 3) unit vectors."""
    kept: list[Floats] = []
    for direction in directions:
        if all(direction @ other < _SAME for other in kept):
            kept.append(direction)
    return len(kept)
