# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
"""
Which pose helps the fit most, and when more of them no longer pay.

Asked for is one of the 26 attitudes that a person can find by eye: the 6 faces, 12 edges and 8
corners of the sensor. It is the one that adds most to det M (D-optimal design, Fedorov 1972), with
M the information of the poses so far (see `accel_calib.calibrate.geometry`) and, as if it were to
follow, that of one pose spread over the whole sphere: without it the first poses would be chosen
as if there were none to come. `benchmarks/next_pose.py` compares it with other orders.

n poses spread well leave |force| uncertain by the noise of a pose times √(p / n), RMS over the
sphere. A pose more takes 1 / 2n of that away: more poses no longer pay when the next one would
take less than `_LEAST_GAIN`, and the dilution is below `_GOOD_DILUTION`.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from .geometry import (
    information_of,
    over_the_sphere,
    poses_needed,
    relative_weights,
    rows_of,
)
from ..sphere import unit
from ..table import Floats
from ..units import MG

_LEAST_GAIN = 0.03
"""Share of the expected error that a pose must take away to pay: 17 poses spread well."""

_GOOD_DILUTION = 3.0
"""Poses are asked for until the dilution has come down to this."""

_TAKEN = np.cos(np.radians(17.0))
"""An attitude this near to a pose has been taken: the next one is 35° away."""

_SIDES = (('front', 'back'), ('left', 'right'), ('top', 'bottom'))


@dataclass(frozen=True)
class NextPose:
    """
    The pose that would help the fit most, or that none does.

    Parameters
    ----------
    direction : (3,) array or None
        What is to point up, a unit vector in the axes of the sensor; None: more poses no longer
        pay.
    words : str
        The same for a person.
    error : float
        Expected error of |force| after a fit to the poses so far, RMS over the sphere, over the
        noise of a pose; infinite where they leave a parameter open.

    """

    direction: Floats | None
    words: str
    error: float


@lru_cache(maxsize=8)
def _mean_information(name: str) -> Floats:
    """Give the information of one pose spread over the sphere, (p, p)."""
    rows = over_the_sphere(name)
    mean: Floats = np.einsum('nip,niq->pq', rows, rows) / len(rows)
    return mean


@lru_cache(maxsize=1)
def _attitudes() -> Floats:
    """Give the signs of the axes that are to point up, (26, 3), the faces first."""
    signs = np.array([s for s in product((0, 1, -1), repeat=3) if any(s)], float)
    return signs[np.argsort(np.sum(np.abs(signs), axis=1), kind='stable')]


def next_pose(directions: Floats, name: str = '10', noise: Floats | None = None, *,
              noise_g: float | None = None) -> NextPose:
    """
    Find the pose that would help the fit most.

    Parameters
    ----------
    directions : (n, 3) array
        Unit vectors of force so far, in the axes of the sensor; n may be 0.
    name : {'4', '7', '9', '10', '12'}
        The model that is to be fitted; for 12 the six faces are asked for.
    noise : (n,) array, optional
        Noise of each pose in any unit; equal where it is not given.
    noise_g : float, optional
        Median noise of the poses [g], for the words.

    Returns
    -------
    NextPose
        One of the 6 faces, 12 edges and 8 corners of the sensor, none of them twice; or none.

    """
    information = information_of(name, directions, relative_weights(noise, len(directions)))
    error = _error(name, information, len(directions))
    best = _best(name, directions, information)
    if best is None:
        return NextPose(None, _enough(len(directions), error, noise_g), error)
    signs = _attitudes()[best]
    up = unit(signs[np.newaxis])
    after = _error(name, information + information_of(name, up, np.ones(1)), len(directions) + 1)
    if after > (1.0 - _LEAST_GAIN) * error and not _stretched(name, information):
        return NextPose(None, _enough(len(directions), error, noise_g), error)
    return NextPose(up[0], f'turn the sensor so that {words_of(signs)} points up '
                    f'({_axes(signs)})', error)


def missing_poses(name: str, directions: Floats, noise: Floats | None = None) -> list[str]:
    """
    Name the poses to add so that a model is carried well, one after another.

    Parameters
    ----------
    name, directions, noise
        As `next_pose`.

    Returns
    -------
    list of str
        Sides, edges and corners that are to point up, such as ``the left side (+y)``.

    """
    weights = relative_weights(noise, len(directions))
    named = []
    while len(directions) < poses_needed(name) or _stretched(
            name, information_of(name, directions, weights)):
        best = _best(name, directions, information_of(name, directions, weights))
        if best is None:
            break
        signs = _attitudes()[best]
        directions = np.vstack([directions, unit(signs[np.newaxis])])
        weights = np.append(weights, 1.0)
        named.append(f'{words_of(signs)} ({_axes(signs)})')
    return named


def _stretched(name: str, information: Floats) -> bool:
    """Tell whether a fit of poses with this information would be poor somewhere."""
    if np.linalg.matrix_rank(information, hermitian=True) < len(information):
        return True
    rows = over_the_sphere(name)
    errors = np.einsum('nip,pq,niq->n', rows, np.linalg.inv(information), rows)
    return bool(np.max(errors) > _GOOD_DILUTION ** 2)


def _best(name: str, directions: Floats, information: Floats) -> int | None:
    """Give the attitude that adds most to det M, among those that have not been taken."""
    attitudes = _attitudes()[:6] if name == '12' else _attitudes()
    up = unit(attitudes)
    free = np.max(up @ directions.T, axis=1, initial=-1.0) < _TAKEN
    if not np.any(free):
        return None
    rows = rows_of(name, up)
    to_come = np.linalg.inv(information + _mean_information(name))
    gains = np.linalg.slogdet(np.eye(rows.shape[1]) + rows @ to_come @ np.swapaxes(rows, 1, 2))[1]
    return int(np.argmax(np.where(free, np.round(gains, 6), -1.0)))  # the first of equals


def _error(name: str, information: Floats, count: int) -> float:
    """Give the RMS over the sphere of the error of |force|, over the noise of a pose."""
    if count < poses_needed(name) or (
            np.linalg.matrix_rank(information, hermitian=True) < len(information)):
        return np.inf
    return float(np.sqrt(np.trace(np.linalg.solve(information, _mean_information(name)))))


def _enough(count: int, error: float, noise_g: float | None) -> str:
    """Say that more poses no longer pay."""
    certain = (f'{error * noise_g * MG:.2g} mg' if noise_g is not None
               else f'{error:.2g} times the noise of a pose')
    return f'more poses no longer pay: {count} poses determine |a| to {certain}'


def words_of(signs: Floats) -> str:
    """Say for a person which side, edge or corner these signs of the axes are."""
    sides = [pair[0 if sign > 0 else 1] for pair, sign in zip(_SIDES, signs, strict=True) if sign]
    what = {1: 'the {} side', 2: 'the edge between {} and {}',
            3: 'the corner of {}, {} and {}'}[len(sides)]
    return what.format(*sides)


def _axes(signs: Floats) -> str:
    """Name the axes of these signs, such as ``+x -y``."""
    return ' '.join(f'{"+" if sign > 0 else "-"}{axis}'
                    for axis, sign in zip('xyz', signs, strict=True) if sign)
