# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
"""
What the directions of the poses determine: how well, and what they leave open.

A pose with force u sees the values of a model through the rows Φ(u): of unknown orientation the
one row û · basis(u) (see `accel_calib.calibrate.likelihood`, with A near I), of known orientation
the three rows basis(u). With s_i the noise of a pose over that of the median pose, the poses have
the information

    M = Σ Φ_iᵀ Φ_i / s_i²

and the corrected |force| (of known orientation: the force) in a direction d is uncertain by

    √(Φ(d) M⁻¹ Φ(d)ᵀ)

times the noise of a pose. The largest such root over the sphere, the dilution, says how far the
poses are stretched: about 1 for 12 poses spread evenly. What they leave open is in
`accel_calib.calibrate.identifiability`.

"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from .norm_fit import form_of
from .uncertainty import believable, LEAST_NOISE
from ..effects import EFFECTS
from ..model import MODELS, parameter_names
from ..sphere import spread_directions
from ..table import Floats

LARGEST_DILUTION = 25.0
"""Beyond this a fit is refused. 12 poses in a 45° cone have 400, in five directions and 2° about
them 100, the worst 1 % of 12 poses in random directions 25. At 0.3 mg a pose it is an error of
8 mg somewhere; fits that are wrong by 10 mg all over the sphere lie beyond it, with a limit of 40
some of them do not (`benchmarks/geometry.py`)."""

WEAK_DILUTION = 10.0
"""Beyond this a fit warns: somewhere the error of |force| is ten times that of a pose."""

NORM_MODELS = ('4', '7', '10')
"""Models that poses of unknown orientation can carry, the smallest first."""

_NEAR = np.cos(np.radians(45.0))
_SAME = np.cos(np.radians(5.0))
_SINGULAR, _NOTHING = 1e-6, 1e-14


def effects_of(name: str) -> tuple[str, ...]:
    """Name the effects of a model; 9 is 10 in other axes."""
    return MODELS['10' if name == '9' else name]


def parameters_of(name: str) -> tuple[str, ...]:
    """Name the parameters of a model."""
    return parameter_names(effects_of(name))


def rows_of(name: str, directions: Floats) -> Floats:
    """Give Φ for each of these (n, 3) unit vectors: (n, 1, p), or (n, 3, p) for model 12."""
    if name == '12':
        parts = [EFFECTS[effect].basis(directions, {}, np.zeros(0)) for effect in effects_of(name)]
        return np.concatenate(parts, axis=2)
    products = (directions[:, :, np.newaxis] * directions[:, np.newaxis]).reshape(-1, 9)
    by_entry = np.concatenate([directions, products], axis=1)
    return (by_entry @ form_of('10' if name == '9' else name).linear)[:, np.newaxis]


def pose_noise(noise: Floats | None, directions: Floats) -> Floats | None:
    """Give the (n,) noise of |reading| from that of (n, 3) pose means; None if it is unknown."""
    believed = believable(noise) if len(directions) else None
    if believed is None:
        return None
    along = np.linalg.norm(directions * believed, axis=1)
    median = np.median(along)
    return np.maximum(along, LEAST_NOISE * median) if median > 0.0 else None


def relative_weights(noise: Floats | None, count: int) -> Floats:
    """Give 1 / s², (count,), from the noise of each pose in any unit; ones where it is unknown."""
    if noise is None or count == 0:
        return np.ones(count)
    weights: Floats = (np.median(noise) / noise) ** 2
    return weights


@lru_cache(maxsize=8)
def over_the_sphere(name: str) -> Floats:
    """Give Φ of directions spread evenly over the sphere, (m, 1 or 3, p)."""
    return rows_of(name, spread_directions(300))


def information_of(name: str, directions: Floats, weights: Floats) -> Floats:
    """Give M, (p, p)."""
    rows = rows_of(name, directions)
    information: Floats = np.einsum('n,nip,niq->pq', weights, rows, rows)
    return information


def free_parameters(name: str) -> int:
    """Count the free parameters of a model: 4, 6 (g is known), 9, 9 or 12."""
    return len(parameters_of(name))


def poses_needed(name: str) -> int:
    """Give the fewest poses that can determine a model."""
    return 4 if name == '12' else free_parameters(name)


def spectrum(name: str, directions: Floats, noise: Floats | None = None
             ) -> tuple[Floats, Floats, Floats]:
    """
    Part a model into combinations of parameters, in the order in which poses determine them.

    Parameters
    ----------
    name : {'4', '7', '9', '10', '12'}
        The model.
    directions : (n, 3) array
        Unit vectors of force in the axes of the sensor; n may be 0.
    noise : (n,) array, optional
        Noise of each pose, in any unit; equal where it is not given.

    Returns
    -------
    (p,) array
        Standard deviation of each combination over the noise of a pose, the smallest first;
        infinite where nothing tells it.
    (p, p) array
        The combinations, rows of length 1.
    (p, m) array
        Error of |force| in m directions over that of a pose, squared, that the combinations up to
        this one make.

    """
    weights = relative_weights(noise, len(directions))
    rows = rows_of(name, directions) * np.sqrt(weights)[:, np.newaxis, np.newaxis]
    triangle = np.linalg.qr(rows.reshape(-1, rows.shape[2]), mode='r')
    square = np.zeros((rows.shape[2], rows.shape[2]))
    square[:len(triangle)] = triangle
    _, scales, axes = np.linalg.svd(square)
    told = scales > _SINGULAR * max(scales[0], 1.0)
    deviations = np.where(told, 1.0 / np.where(told, scales, 1.0), np.inf)
    seen = np.sum((over_the_sphere(name) @ axes.T) ** 2, axis=1)
    return deviations, axes, np.cumsum(times(seen, deviations ** 2), axis=1).T


def times(share: Floats, deviations: Floats) -> Floats:
    """Give the product, 0 where the share is 0 of what is infinite."""
    none = np.abs(share) < _NOTHING
    return np.where(none, 0.0, share) * np.where(none, 0.0, deviations)


def dilution(name: str, directions: Floats, noise: Floats | None = None) -> float:
    """
    Say how far the poses are stretched by a model; arguments as `spectrum`.

    Returns
    -------
    float
        Largest error of |force| over the sphere, over that of a pose; infinite where the poses
        leave a parameter open.

    """
    weights = relative_weights(noise, len(directions))
    rows = rows_of(name, directions) * np.sqrt(weights)[:, np.newaxis, np.newaxis]
    return float(dilution_of(name, rows.reshape(-1, rows.shape[2])))


def dilution_of(name: str, rows: Floats) -> Floats:
    """Give the dilution, (...), of poses with these (..., n, p) weighted Φ; as `dilution`."""
    information = np.swapaxes(rows, -1, -2) @ rows
    size = rows.shape[-1]
    trace = np.trace(information, axis1=-2, axis2=-1)
    ridge = (_NOTHING * trace + 1e-300)[..., np.newaxis, np.newaxis]
    inverse = np.linalg.inv(information + ridge * np.eye(size))
    squared = inverse.reshape(*trace.shape, size * size) @ _pairs_over_the_sphere(name)
    found = np.sqrt(np.max(squared, axis=-1))
    return np.where(found < 1.0 / _SINGULAR, found, np.inf)


@lru_cache(maxsize=8)
def _pairs_over_the_sphere(name: str) -> Floats:
    """Give the products of the entries of Φ in each direction, (p², m)."""
    around = over_the_sphere(name)
    pairs = np.einsum('mkp,mkq->mpq', around, around)
    return np.ascontiguousarray(pairs.reshape(len(pairs), -1).T)


def coverage(directions: Floats) -> float:
    """Give the share of the sphere that lies within 45° of a pose; (n, 3) unit vectors."""
    near = np.max(spread_directions(500) @ directions.T, axis=1)
    return float(np.mean(near >= _NEAR))


def distinct(directions: Floats) -> int:
    """Count directions that are more than 5° apart; (n, 3) unit vectors."""
    kept: list[Floats] = []
    for direction in directions:
        if all(direction @ other < _SAME for other in kept):
            kept.append(direction)
    return len(kept)
