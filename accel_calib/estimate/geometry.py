# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How well the directions of poses determine a model, before any fit.

A pose with force u depends on the values of a model through the rows Φ(u). For a pose of unknown
orientation this is the one row û · basis(u) (see `accel_calib.estimate.equations`, with A near I).
For a pose of known orientation these are the three rows basis(u). With s_i the noise of a pose
relative to that of the median pose, the information of the poses is

    M = Σ Φ_iᵀ Φ_i / s_i²

The standard deviation of the corrected |force| (known orientation: of the force) in a direction d,
relative to the noise of a pose, is

    √(Φ(d) M⁻¹ Φ(d)ᵀ)

The largest value over the sphere is the dilution. It is about 1 for 12 poses that are spread
evenly. The singular vectors of the rows are combinations of parameters, ordered by how well the
poses determine them. The combinations that raise the dilution above the limit for a fit are not
determined. They are described by as few parameters as possible.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
import scipy

from .equations import believable, LEAST_NOISE
from ..effects import EFFECTS, Model, MODELS, parameter_names, with_vector
from ..geometry import OVER_THE_SPHERE
from ..table import Floats

LARGEST_DILUTION = 25.0
"""
Above this dilution a fit is refused.

The dilution is 400 for 12 poses in a 45° cone, 100 for poses in five directions with a spread of
2°, and 25 for the worst 1 % of 12 poses in random directions. With a noise of 0.3 mg per pose, 25
corresponds to an error of 8 mg in some direction. All fits that are wrong by 10 mg over the whole
sphere have a larger dilution; with a limit of 40, some of them would pass
(`benchmarks/geometry.py`).

"""

WEAK_DILUTION = 10.0
"""Above this dilution a fit warns: the error of |force| is up to ten times that of a pose."""

NORM_MODELS = tuple(name for name, form in MODELS.items() if form.norm == name and form.gains)
"""Models for poses of unknown orientation; the smallest model is first."""

_SINGULAR, _NOTHING = 1e-6, 1e-14


def effects_of(name: str) -> tuple[str, ...]:
    """Return the effects of a model; model 9 is model 10 in other axes."""
    form = MODELS[name]
    return MODELS[form.norm].effects if form.sensing_axes else form.effects


def parameters_of(name: str) -> tuple[str, ...]:
    """Return the names of the parameters of a model."""
    return parameter_names(effects_of(name))


@cache
def _no_errors(name: str) -> Model:
    return with_vector(effects_of(name), np.zeros(free_parameters(name)))


def rows_of(name: str, directions: Floats) -> Floats:
    """Return Φ at (n, 3) unit vectors: (n, 1, p), or (n, 3, p) for model 12."""
    basis = _no_errors(name).basis(directions, {})
    return basis.full if MODELS[name].known_orientation else basis.along(directions)[:, np.newaxis]


def pose_noise(noise: Floats | None, directions: Floats) -> Floats | None:
    """Return the (n,) noise of |reading| from the (n, 3) noise of means; None if unknown."""
    believed = believable(noise) if len(directions) else None
    if believed is None:
        return None
    along = np.linalg.norm(directions * believed, axis=1)
    median = np.median(along)
    return np.maximum(along, LEAST_NOISE * median) if median > 0.0 else None


def relative_weights(noise: Floats | None, count: int) -> Floats:
    """Return (count,) weights 1 / s² from the noise of each pose in any unit; ones if unknown."""
    if noise is None or count == 0:
        return np.ones(count)
    weights: Floats = (np.median(noise) / noise) ** 2
    return weights


@lru_cache(maxsize=8)
def over_the_sphere(name: str) -> Floats:
    """Return the (m, 1 or 3, p) rows Φ at directions spread evenly over the sphere."""
    return rows_of(name, OVER_THE_SPHERE)


def information_of(name: str, directions: Floats, noise: Floats | None = None) -> Floats:
    """Return the (p, p) information M; arguments as in `identifiability`."""
    rows = _weighted_rows(name, directions, noise)
    return rows.T @ rows


def free_parameters(name: str) -> int:
    """Return the number of free parameters of a model: 4, 6 (g is known), 9, 9 or 12."""
    return len(parameters_of(name))


def poses_needed(name: str) -> int:
    """Return the smallest number of poses that can determine a model."""
    rows = 3 if MODELS[name].known_orientation else 1
    return free_parameters(name) // rows


def _weighted_rows(name: str, directions: Floats, noise: Floats | None) -> Floats:
    """Return the (m, p) rows Φ / s of all poses."""
    root = np.sqrt(relative_weights(noise, len(directions)))
    rows = rows_of(name, directions) * root[:, np.newaxis, np.newaxis]
    return rows.reshape(-1, rows.shape[2])


def spectrum(name: str, directions: Floats, noise: Floats | None = None
             ) -> tuple[Floats, Floats, Floats]:
    """
    Return the combinations of parameters of a model, ordered by how well poses determine them.

    Arguments as in `identifiability`; n can be 0. Returns the (p,) standard deviation of each
    combination, relative to the noise of a pose, in increasing order (infinite: not determined);
    the (p, p) combinations as rows of length 1; and the (p, m) squared error of |force| in m
    directions, relative to that of a pose, from all combinations up to this one.

    """
    triangle = np.linalg.qr(_weighted_rows(name, directions, noise), mode='r')
    square = np.zeros((free_parameters(name),) * 2)
    square[:len(triangle)] = triangle
    _, scales, axes = np.linalg.svd(square)
    determined = scales > _SINGULAR * max(scales[0], 1.0)
    deviations = np.where(determined, 1.0 / np.where(determined, scales, 1.0), np.inf)
    seen = np.sum((over_the_sphere(name) @ axes.T) ** 2, axis=1)
    return deviations, axes, np.cumsum(times(seen, deviations ** 2), axis=1).T


def times(share: Floats, deviations: Floats) -> Floats:
    """Return the product; 0 times an infinite deviation is 0."""
    none = np.abs(share) < _NOTHING
    return np.where(none, 0.0, share) * np.where(none, 0.0, deviations)


def dilution(name: str, directions: Floats, noise: Floats | None = None) -> float:
    """
    Return the largest error of |force| over the sphere, relative to that of a pose.

    Infinite if the poses do not determine a parameter. Arguments as in `identifiability`.

    """
    return largest_error(name, information_of(name, directions, noise))


def largest_error(name: str, information: Floats) -> float:
    """Return the dilution for the (p, p) information of poses."""
    ridge = _NOTHING * np.trace(information) + 1e-300
    inverse = np.linalg.inv(information + ridge * np.eye(len(information)))
    found = float(np.sqrt(np.max(inverse.ravel() @ _pairs_over_the_sphere(name))))
    return found if found < 1.0 / _SINGULAR else np.inf


@lru_cache(maxsize=8)
def _pairs_over_the_sphere(name: str) -> Floats:
    """Return the (p², m) products of the entries of Φ in each direction."""
    around = over_the_sphere(name)
    pairs = np.einsum('mkp,mkq->mpq', around, around)
    return np.ascontiguousarray(pairs.reshape(len(pairs), -1).T)


_OPEN_PART = 0.1
"""Part of a parameter in the open combinations above which it is not determined."""

_MAIN_PART = 0.3
"""Weights above this part of the largest weight are included in the words."""

_SMALL = 1e-3
"""Weights below this are omitted from a combination."""


@dataclass(frozen=True)
class Combination:
    """
    A combination of parameters that the poses do not determine.

    `weights` has the weight of each parameter, the largest first; the sum of the squares is 1.
    `deviation` is relative to the noise of a pose; infinite if not determined at all.

    """

    weights: Mapping[str, float]
    deviation: float

    @property
    def words(self) -> str:
        """Return the combination in words, such as ``0.71 offset.z - 0.70 axis_gain.z``."""
        least = _MAIN_PART * max(map(abs, self.weights.values()))
        main = [(name, weight) for name, weight in self.weights.items() if abs(weight) > least]
        if len(main) == 1:
            return main[0][0]
        first, *others = (f'{"-" if weight < 0 else "+"} {abs(weight):.2f} {name}'
                          for name, weight in main)
        return ' '.join([first.removeprefix('+ '), *others])


@dataclass(frozen=True)
class Identifiability:
    """
    What poses determine of a model.

    Parameters
    ----------
    deviations : mapping of str to float
        Standard deviation of each parameter, relative to the noise of a pose; infinite if not
        determined at all.
    undetermined : tuple of Combination
        Combinations that the poses do not determine. They determine the rest of the model.
    dilution, mean_dilution : float
        Error of |force| relative to that of a pose: largest and RMS over the sphere.

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


def identifiability(name: str, directions: Floats, noise: Floats | None = None
                    ) -> Identifiability:
    """
    Return what poses determine of a model; it depends only on directions and noise.

    `name` is 4, 7, 9, 10 or 12. `directions` are (n, 3) unit vectors of force in the sensor axes.
    `noise` is (n,), of each pose, in any unit; by default it is equal for all poses.

    """
    deviations, axes, errors = spectrum(name, directions, noise)
    names = parameters_of(name)
    each = np.sqrt(np.sum(times(axes.T ** 2, deviations ** 2), axis=1))
    open_ = np.sqrt(np.max(errors, axis=1)) > LARGEST_DILUTION
    return Identifiability(name, dict(zip(names, map(float, each), strict=True)),
                           _combinations(names, axes[open_], deviations[open_]),
                           float(np.sqrt(np.max(errors[-1]))), float(np.sqrt(np.mean(errors[-1]))))


def _combinations(names: tuple[str, ...], axes: Floats, deviations: Floats
                  ) -> tuple[Combination, ...]:
    """Return sparse combinations that span these (k, p) combinations."""
    if not len(axes):
        return ()
    pivots = scipy.linalg.qr(axes, mode='r', pivoting=True)[1][:len(axes)]
    mixed = np.linalg.inv(axes[:, pivots])  # each combination has its own pivot
    mixed = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
    uncertain = np.sqrt(np.sum(times(mixed ** 2, deviations ** 2), axis=1))
    found = []
    for row, deviation in zip(mixed @ axes, uncertain, strict=True):
        order = [k for k in np.argsort(-np.abs(row), kind='stable') if abs(row[k]) > _SMALL]
        sign = np.sign(row[order[0]])
        found.append(Combination({names[k]: float(sign * row[k]) for k in order},
                                 float(deviation)))
    return tuple(sorted(found, key=lambda each: names.index(next(iter(each.weights)))))


def error_left_in(smaller: str, larger: str, directions: Floats, noise: Floats | None = None
                  ) -> float:
    """
    Return the typical error of |force| if a model omits effects of a larger model [g].

    The omitted effects have their typical size. The fit partly absorbs them, which changes the
    correction over the whole sphere; the error is RMS over it. Both models are for poses of
    unknown orientation; directions and noise as in `identifiability`.

    """
    effects = [effect for effect in left_out(smaller, larger) for _ in EFFECTS[effect].values]
    more = [effect in effects for effect, _, _ in (
        name.partition('.') for name in parameters_of(larger))]
    root = np.sqrt(relative_weights(noise, len(directions)))[:, np.newaxis]
    added = np.linalg.lstsq(root * rows_of(smaller, directions)[:, 0],
                            root * rows_of(larger, directions)[:, 0, more], rcond=None)[0]
    wrong = over_the_sphere(larger)[:, 0, more] - over_the_sphere(smaller)[:, 0] @ added
    sizes = np.array([EFFECTS[effect].typical for effect in effects])
    return float(np.sqrt(np.sum(np.mean(wrong ** 2, axis=0) * sizes ** 2)))


def left_out(smaller: str, larger: str) -> list[str]:
    """Return the effects that a smaller model omits."""
    return [effect for effect in effects_of(larger) if effect not in effects_of(smaller)]
