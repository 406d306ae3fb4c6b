# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
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
poses are stretched: about 1 for 12 poses spread evenly. From the singular values of the rows come
the combinations of parameters in the order in which the poses determine them; those that would
push the dilution beyond a limit are left open.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .likelihood import believable
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
_SINGULAR, _SMALL = 1e-7, 1e-3
_OPEN_PART = 0.1
"""Part of a parameter in what is left open from which it is not determined."""

_SAID_PART = 0.3
"""Part of the largest weight in a combination that is told in words."""


@dataclass(frozen=True)
class Combination:
    """
    A combination of parameters that poses leave open.

    Parameters
    ----------
    weights : mapping of str to float
        By name of the parameter, the largest first; their squares add up to 1.
    deviation : float
        Its standard deviation over the noise of a pose; infinite where nothing tells it.

    """

    weights: Mapping[str, float]
    deviation: float

    @property
    def words(self) -> str:
        """Say it for a person, such as ``0.71 offset.z - 0.70 axis_gain.z``."""
        least = _SAID_PART * max(map(abs, self.weights.values()))
        said = [(name, weight) for name, weight in self.weights.items() if abs(weight) > least]
        if len(said) == 1:
            return said[0][0]
        first, *others = (f'{"-" if weight < 0 else "+"} {abs(weight):.2f} {name}'
                          for name, weight in said)
        return ' '.join([first.removeprefix('+ '), *others])


@dataclass(frozen=True)
class Identifiability:
    """
    What poses determine of a model.

    Parameters
    ----------
    model : str
        The model.
    deviations : mapping of str to float
        Of each parameter, standard deviation over the noise of a pose; infinite where nothing
        tells it.
    undetermined : tuple of Combination
        What the poses leave open, so that without it they would carry the model.
    dilution, mean_dilution : float
        Error of |force| over that of a pose: the largest and the RMS over the sphere.

    """

    model: str
    deviations: Mapping[str, float]
    undetermined: tuple[Combination, ...]
    dilution: float
    mean_dilution: float

    @property
    def open_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that the poses do not determine."""
        part = {name: sum(open_.weights.get(name, 0.0) ** 2 for open_ in self.undetermined)
                for name in self.deviations}
        return tuple(name for name in self.deviations if part[name] > _OPEN_PART ** 2)


def parameters_of(name: str) -> tuple[str, ...]:
    """Name the parameters of a model; 9 is 10 in other axes."""
    return parameter_names(MODELS['10' if name == '9' else name])


def rows_of(name: str, directions: Floats) -> Floats:
    """Give Φ for each of these (n, 3) unit vectors: (n, 1, p), or (n, 3, p) for model 12."""
    parts = [EFFECTS[effect].basis(directions, {}, np.zeros(0))
             for effect in MODELS['10' if name == '9' else name]]
    basis = np.concatenate(parts, axis=2)
    return basis if name == '12' else np.einsum('ni,nip->np', directions, basis)[:, np.newaxis]


def noise_along(noise: Floats | None, directions: Floats) -> Floats:
    """Give the (n,) noise of |reading| from that of (n, 3) pose means; ones if it is unknown."""
    believed = None if noise is None or not len(noise) else believable(noise)
    if believed is None:
        return np.ones(len(directions))
    along: Floats = np.linalg.norm(directions * believed, axis=1)
    return along


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


def _spectrum(name: str, directions: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Give the p singular values of the weighted rows, descending, and their (p, p) rows."""
    rows = rows_of(name, directions) * np.sqrt(weights)[:, np.newaxis, np.newaxis]
    triangle = np.linalg.qr(rows.reshape(-1, rows.shape[2]), mode='r')
    square = np.zeros((rows.shape[2], rows.shape[2]))
    square[:len(triangle)] = triangle
    _, scales, axes = np.linalg.svd(square)
    return np.where(scales > _SINGULAR * max(scales[0], 1.0), scales, 0.0), axes


def identifiability(name: str, directions: Floats, noise: Floats | None = None
                    ) -> Identifiability:
    """
    Work out what poses determine.

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
    Identifiability
        From the directions alone, before any fit.

    """
    scales, axes = _spectrum(name, directions, relative_weights(noise, len(directions)))
    with np.errstate(divide='ignore', invalid='ignore'):
        spread = (over_the_sphere(name) @ axes.T / scales) ** 2
        parts = (axes.T / scales) ** 2
    errors = np.cumsum(np.nan_to_num(np.sum(spread, axis=1), nan=0.0, posinf=np.inf), axis=1)
    deviations = np.sqrt(np.sum(np.where(np.abs(axes.T) < _SINGULAR, 0.0, parts), axis=1))
    worst = np.where(scales > 0.0, np.sqrt(np.max(errors, axis=0)), np.inf)
    mean = float(np.sqrt(np.mean(errors[:, -1]))) if scales[-1] > 0.0 else np.inf
    names = parameters_of(name)
    open_ = _combinations(names, axes[worst > LARGEST_DILUTION], scales[worst > LARGEST_DILUTION])
    return Identifiability(name, dict(zip(names, map(float, deviations), strict=True)), open_,
                           float(worst[-1]), mean)


def _combinations(names: tuple[str, ...], axes: Floats, scales: Floats
                  ) -> tuple[Combination, ...]:
    """Say by few parameters each what the space of these (k, p) combinations is."""
    from scipy.linalg import qr

    if not len(axes):
        return ()
    pivots = qr(axes, mode='r', pivoting=True)[1][:len(axes)]
    mixed = np.linalg.inv(axes[:, pivots])  # each combination has one pivot of its own
    mixed = mixed / np.linalg.norm(mixed @ axes, axis=1, keepdims=True)
    weights = mixed @ axes
    with np.errstate(divide='ignore', invalid='ignore'):
        shares = np.where(np.abs(mixed) < _SINGULAR, 0.0, np.abs(mixed) / scales)
    found = []
    for row, deviation in zip(weights, np.linalg.norm(shares, axis=1), strict=True):
        order = [k for k in np.argsort(-np.abs(row), kind='stable') if abs(row[k]) > _SMALL]
        sign = np.sign(row[order[0]])
        found.append(Combination({names[k]: float(sign * row[k]) for k in order},
                                 float(deviation)))
    return tuple(sorted(found, key=lambda each: names.index(next(iter(each.weights)))))


def dilution(name: str, directions: Floats, noise: Floats | None = None) -> float:
    """
    Say how far the poses are stretched by a model; arguments as `identifiability`.

    Returns
    -------
    float
        Largest error of |force| over the sphere, over that of a pose; infinite where the poses
        leave a parameter open.

    """
    return identifiability(name, directions, noise).dilution


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
