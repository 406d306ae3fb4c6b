# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Which parameters poses determine, how well, and which combinations they leave open.

The singular vectors of the rows of `accel_calib.estimate.geometry` are the combinations of
parameters in the order in which the poses determine them. Those that would raise the dilution
beyond the limit for a fit are left open; they are described by as few parameters as possible.

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
"""Part of a parameter in the open combinations from which it is not determined."""

_SAID_PART = 0.3
"""Part of the largest weight in a combination that is put into words."""

_SMALL = 1e-3
"""Weights in a combination that are left out."""


@dataclass(frozen=True)
class Combination:
    """
    A combination of parameters that poses leave open.

    Parameters
    ----------
    weights : mapping of str to float
        By name of the parameter, the largest first; their squares add up to 1.
    deviation : float
        Its standard deviation over the noise of a pose; infinite if nothing determines it.

    """

    weights: Mapping[str, float]
    deviation: float

    @property
    def words(self) -> str:
        """Return the combination in words, such as ``0.71 offset.z - 0.70 axis_gain.z``."""
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
        Of each parameter, standard deviation over the noise of a pose; infinite if nothing
        determines it.
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


def identifiability(name: str, directions: Floats, noise: Floats | None = None
                    ) -> Identifiability:
    """
    Compute what poses determine; arguments as `accel_calib.estimate.geometry.spectrum`.

    Returns
    -------
    Identifiability
        From the directions alone, before any fit.

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
    """Return combinations of few parameters each that span these (k, p) combinations."""
    from scipy.linalg import qr

    if not len(axes):
        return ()
    pivots = qr(axes, mode='r', pivoting=True)[1][:len(axes)]
    mixed = np.linalg.inv(axes[:, pivots])  # each combination has one pivot of its own
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
    Return how wrong |force| commonly is when a model leaves out effects of a larger one.

    What is left out, of the size that is common (`accel_calib.effects`), goes into the parameters
    that are fitted as these poses let it, and from there to the whole sphere.

    Parameters
    ----------
    smaller, larger : {'4', '7', '9', '10'}
        The models.
    directions : (n, 3) array
        Unit vectors of force in the sensor axes.
    noise : (n,) array, optional
        Noise of each pose, in any unit; equal if it is not given.

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
    """Return the effects that a smaller model leaves out."""
    return [effect for effect in effects_of(larger) if effect not in effects_of(smaller)]
