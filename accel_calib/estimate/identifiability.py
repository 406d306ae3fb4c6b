# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Which parameters poses determine, how well, and which combinations they do not determine.

The singular vectors of the rows of `accel_calib.estimate.geometry` are combinations of parameters,
ordered by how well the poses determine them. The combinations that raise the dilution above the
limit for a fit are not determined. They are described by as few parameters as possible.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .geometry import (
    effects_of,
    LARGEST_DILUTION,
    over_the_sphere,
    parameters_of,
    relative_weights,
    rows_of,
    spectrum,
    times,
)
from ..effects import EFFECTS
from ..table import Floats

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

    Parameters
    ----------
    weights : mapping of str to float
        Weight of each parameter, the largest first; the sum of the squares is 1.
    deviation : float
        Standard deviation relative to the noise of a pose; infinite if not determined at all.

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
    model : str
        The model.
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
    Compute what poses determine; parameters as in `accel_calib.estimate.geometry.spectrum`.

    Returns
    -------
    Identifiability
        The result, which depends only on directions and noise.

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
    from scipy.linalg import qr

    if not len(axes):
        return ()
    pivots = qr(axes, mode='r', pivoting=True)[1][:len(axes)]
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
    Return the typical error of |force| if a model omits effects of a larger model.

    The omitted effects have their typical size (`accel_calib.effects`). The fit to these poses
    partly absorbs them in its parameters, which changes the correction over the whole sphere.

    Parameters
    ----------
    smaller, larger : {'4', '7', '9', '10'}
        The models.
    directions : (n, 3) array
        Unit vectors of force in the sensor axes.
    noise : (n,) array, optional
        Noise of each pose, in any unit; by default equal for all poses.

    Returns
    -------
    float
        RMS over the sphere [g].

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
