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
What the directions of the poses determine, and which pose would help most.

A pose of unknown orientation with force u sees the values of a model through the row
φ(u) = û · basis(u) (see `accel_calib.calibrate.likelihood`, with A near I). For n poses of equal
noise s the corrected |force| in a direction d is then uncertain by

    s √(φ(d)ᵀ (ΦᵀΦ)⁻¹ φ(d))

and the largest such root over the sphere, the dilution, says how far the poses are stretched:
about 1 for 12 poses spread evenly. The pose that adds most to det(ΦᵀΦ) (D-optimal design, Fedorov
1972) is the one in the direction where that root is largest.

"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from ..effects import EFFECTS
from ..errors import RefusedFitError
from ..model import MODELS
from ..sphere import spread_directions
from ..table import Floats

LARGEST_DILUTION = 40.0
"""Beyond this a fit is refused: 12 poses in a 45° cone have 400, the worst 5 % of 12 poses in
random directions 13."""

WEAK_DILUTION = 10.0
"""Beyond this a fit warns: somewhere the error of |force| is ten times that of a pose."""

NORM_MODELS = ('4', '7', '10')
"""Models that poses of unknown orientation can carry, the smallest first."""

_NEAR = np.cos(np.radians(45.0))
_SAME = np.cos(np.radians(5.0))
_SINGULAR = 1e-7
_SIDES = (('front', 'back'), ('left', 'right'), ('top', 'bottom'))


@dataclass(frozen=True)
class NextPose:
    """
    The pose that would help the fit most.

    Parameters
    ----------
    direction : (3,) array
        What is to point up, a unit vector in the axes of the sensor.
    words : str
        The same for a person.

    """

    direction: Floats
    words: str


def _rows(name: str, directions: Floats) -> Floats:
    """Give φ for each direction, (n, p), in the effects of a model that the norm can carry."""
    effects = MODELS['10' if name == '9' else name]
    parts = [EFFECTS[effect].basis(directions, {}, np.zeros(0)) for effect in effects]
    return np.einsum('ni,nip->np', directions, np.concatenate(parts, axis=2))


def free_parameters(name: str) -> int:
    """Count the free parameters of a model: 4, 6 (g is known), 9, 9 or 12."""
    return {'4': 4, '7': 6, '9': 9, '10': 9, '12': 12}[name]


def dilution(name: str, directions: Floats) -> float:
    """
    Say how far the poses are stretched by a model.

    Parameters
    ----------
    name : {'4', '7', '9', '10'}
        The model.
    directions : (n, 3) array
        Unit vectors of force in the axes of the sensor.

    Returns
    -------
    float
        Largest error of |force| over the sphere, over that of a pose; infinite where the poses
        leave a parameter open.

    """
    left, scales, right = np.linalg.svd(_rows(name, directions), full_matrices=False)
    del left
    if len(scales) < free_parameters(name) or scales[-1] < _SINGULAR * scales[0]:
        return np.inf
    spread = _rows(name, spread_directions(300)) @ (right.T / scales)
    return float(np.sqrt(np.max(np.sum(spread ** 2, axis=1))))


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


def next_pose(directions: Floats, name: str = '10') -> NextPose:
    """
    Find the pose that would help the fit most.

    Parameters
    ----------
    directions : (n, 3) array
        Unit vectors of force so far, in the axes of the sensor; n may be 0.
    name : {'4', '7', '9', '10'}
        The model that is to be fitted.

    Returns
    -------
    NextPose
        One of the 6 faces, 12 edges and 8 corners of the sensor.

    """
    signs = np.array([s for s in product((0, 1, -1), repeat=3) if any(s)], float)
    signs = signs[np.argsort(np.sum(np.abs(signs), axis=1), kind='stable')]  # faces first
    candidates = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    phi, so_far = _rows(name, candidates), _rows(name, directions)
    information = so_far.T @ so_far + 1e-3 * np.eye(phi.shape[1])
    gain = np.einsum('np,np->n', phi, np.linalg.solve(information, phi.T).T)
    best = int(np.argmax(np.round(gain, 6)))
    return NextPose(candidates[best], _words(signs[best]))


def _words(signs: Floats) -> str:
    """Say for a person which face, edge or corner is to point up."""
    sides = [pair[0 if sign > 0 else 1] for pair, sign in zip(_SIDES, signs, strict=True) if sign]
    axes = ''.join(f' {"+" if sign > 0 else "-"}{axis}'
                   for axis, sign in zip('xyz', signs, strict=True) if sign)
    what = {1: 'the {} side', 2: 'the edge between {} and {}',
            3: 'the corner of {}, {} and {}'}[len(sides)]
    return f'turn the sensor so that {what.format(*sides)} points up ({axes.strip()})'


def refuse_if_unfit(name: str, directions: Floats) -> None:
    """
    Make sure that the poses can carry a model.

    Parameters
    ----------
    name : {'4', '7', '9', '10'}
        The model.
    directions : (n, 3) array
        Unit vectors of force in the axes of the sensor.

    Raises
    ------
    RefusedFitError
        With what is wrong with the poses, the larger model that they do carry and the next pose.

    """
    needed = free_parameters(name)
    if len(directions) >= needed and dilution(name, directions) <= LARGEST_DILUTION:
        return
    smaller = [other for other in NORM_MODELS if free_parameters(other) < needed
               and len(directions) >= free_parameters(other)
               and dilution(other, directions) <= LARGEST_DILUTION]
    offer = f', or use model {smaller[-1]}, which these poses carry' if smaller else ''
    raise RefusedFitError(f'{_shape(directions, needed)}, model {name} needs at least {needed} '
                          'poses spread over the sphere',
                          f'{next_pose(directions, name).words}, hold it still and go on{offer}')


def _shape(directions: Floats, needed: int) -> str:
    """Say in words what is wrong with these directions."""
    count = len(directions)
    if count < 2:
        return f'{count} pose{"" if count else "s"}'
    mean = directions.mean(axis=0)
    unit = mean / max(float(np.linalg.norm(mean)), 1e-9)
    cone = np.degrees(np.arccos(np.clip(np.min(directions @ unit), -1.0, 1.0)))
    if distinct(directions) == 1:
        return f'the {count} poses all have the same orientation'
    if count < needed:
        return f'{count} poses'
    if cone < 75.0:
        return f'the {count} poses lie within {cone:.0f}° of one direction'
    if np.linalg.svd(directions - mean, compute_uv=False)[-1] < 0.1 * np.sqrt(count):
        return f'the {count} poses lie in a plane'
    return f'the {count} poses point in {distinct(directions)} directions that leave a gap'
