# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Which pose to take next, and when more poses no longer help.

The next pose is one of the 26 orientations that a person can set by eye: the 6 faces, 12 edges and
8 corners of the sensor. It is the orientation that increases det M most (D-optimal design, Fedorov
1972). M is the information of the poses so far (see `accel_calib.estimate.geometry`) plus that of
one pose spread over the whole sphere, which represents the poses to come. Without this term the
first poses would be chosen as if they were the last. `benchmarks/next_pose.py` compares this order
with others.

With n well spread poses, the error of |force| is the noise of a pose times √(p / n), RMS over the
sphere. Another pose reduces it by the factor 1 / 2n. More poses no longer help if the next pose
reduces the error by less than `_LEAST_GAIN` and the dilution is below `_GOOD_DILUTION`.

Poses that do not determine a model are refused. The error contains the reason, the undetermined
parameters, the poses to add, and the largest of the smaller models that the poses determine.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .calibration import Calibration, ORIENTED, PRIOR
from ..errors import RefusedFitError
from ..estimate import (
    Combination, dilution, error_left_in, Identifiability, identifiability, information_of,
    LARGEST_DILUTION, largest_error, left_out, NORM_MODELS, pose_noise, poses_needed, rows_of,
    WEAK_DILUTION)
from ..finding import Finding
from ..geometry import ATTITUDES, axes_of_signs, cone_of, distinct, OVER_THE_SPHERE, words_of
from ..table import Floats
from ..text import counted
from ..units import MG

_LEAST_GAIN = 0.03
"""Smallest useful reduction of the error by a pose; 17 well spread poses reach it."""

_GOOD_DILUTION = 3.0
"""More poses are requested while the dilution is larger."""

_SPARE = 3
"""Poses beyond the fewest that determine a model, so that the fit can be checked."""

_TAKEN = np.cos(np.radians(17.0))
"""An orientation within 17° of a pose counts as taken; its neighbours are 35° away."""


@dataclass(frozen=True)
class NextPose:
    """
    The pose that improves the fit most, or none.

    Parameters
    ----------
    direction : (3,) array or None
        Direction to point up, a unit vector in the sensor axes; None: more poses no longer help.
    words : str
        The same as a sentence.
    error : float
        Expected error of |force| after a fit to the poses so far, RMS over the sphere, relative
        to the noise of a pose; infinite if the poses do not determine a parameter.
    total : int
        Number of poses that determine the model well, if each is the one that is asked for.
    fits : bool
        Whether the poses so far determine the model, so that a fit is not refused.

    """

    direction: Floats | None
    words: str
    error: float
    total: int
    fits: bool


@lru_cache(maxsize=8)
def _mean_information(name: str) -> Floats:
    """Return the (p, p) information of one pose spread over the sphere."""
    return information_of(name, OVER_THE_SPHERE) / len(OVER_THE_SPHERE)


def next_pose(directions: Floats, name: str = '10', noise: Floats | None = None, *,
              noise_g: float | None = None) -> NextPose:
    """
    Return the pose that improves the fit most: a face, edge or corner not taken yet, or none.

    Parameters
    ----------
    directions : (n, 3) array
        Unit vectors of force so far, in the sensor axes; n can be 0.
    name : {'4', '7', '9', '10', '12'}
        The model to fit; for model 12 the poses are the six faces.
    noise : (n,) array, optional
        Noise of each pose in any unit; by default equal for all poses.
    noise_g : float, optional
        Median noise of the poses [g], for the sentence.

    """
    count = len(directions)
    information = information_of(name, directions, noise)
    error, fits = _error(name, information, count), determines(name, directions, noise)
    up = _best(name, directions, information)
    if up is None or not _helps(name, up, information, count):
        return NextPose(None, _enough(count, error, noise_g), error, count, fits)
    total = count + len(list(_planned(name, directions, information, _SPARE)))
    words = f'turn the sensor so that {words_of(up)} points up ({axes_of_signs(up)})'
    return NextPose(up, words, error, total, fits)


def _helps(name: str, up: Floats, information: Floats, count: int) -> bool:
    """Return whether a pose in this direction improves a fit visibly."""
    now, after = (_error(name, information, count),
                  _error(name, information + information_of(name, up[np.newaxis]), count + 1))
    return after <= (1.0 - _LEAST_GAIN) * now or largest_error(name, information) > _GOOD_DILUTION


def _planned(name: str, directions: Floats, information: Floats, spare: int) -> Iterator[Floats]:
    """Yield the attitudes to add until the poses determine a model well."""
    while (len(directions) < poses_needed(name) + spare
           or largest_error(name, information) > _GOOD_DILUTION):
        up = _best(name, directions, information)
        if up is None:
            return
        yield up
        directions = np.vstack([directions, up])
        information = information + information_of(name, up[np.newaxis])


def missing_poses(name: str, directions: Floats, noise: Floats | None = None) -> list[str]:
    """Return the sides, edges and corners to point up next, until a model is determined well."""
    information = information_of(name, directions, noise)
    return [f'{words_of(up)} ({axes_of_signs(up)})'
            for up in _planned(name, directions, information, 0)]


def _best(name: str, directions: Floats, information: Floats) -> Floats | None:
    """Return the untaken attitude that increases det M most, or None if all are taken."""
    up = _attitudes(name)
    free = np.max(up @ directions.T, axis=1, initial=-1.0) < _TAKEN
    if not np.any(free):
        return None
    rows = _attitude_rows(name)
    to_come = np.linalg.inv(information + _mean_information(name))
    gains = np.linalg.slogdet(np.eye(rows.shape[1]) + rows @ to_come @ np.swapaxes(rows, 1, 2))[1]
    found: Floats = up[np.argmax(np.where(free, np.round(gains, 6), -1.0))]  # the first of equals
    return found


def _attitudes(name: str) -> Floats:
    """Return the attitudes that a person can set by eye for a model, (n, 3) unit vectors."""
    return ATTITUDES[:6] if name == ORIENTED else ATTITUDES


@lru_cache(maxsize=8)
def _attitude_rows(name: str) -> Floats:
    """Return the rows of a pose in each of the attitudes."""
    return rows_of(name, _attitudes(name))


def _error(name: str, information: Floats, count: int) -> float:
    """Return the error of |force|, RMS over the sphere, relative to the noise of a pose."""
    if count < poses_needed(name) or (
            np.linalg.matrix_rank(information, hermitian=True) < len(information)):
        return np.inf
    return float(np.sqrt(np.trace(np.linalg.solve(information, _mean_information(name)))))


def _enough(count: int, error: float, noise_g: float | None) -> str:
    """Return the sentence for the case that more poses no longer help."""
    certain = (f'{error * noise_g * MG:.2g} mg' if noise_g is not None
               else f'{error:.2g} times the noise of a pose')
    return f'more poses no longer help: {count} poses determine |a| to within {certain}'


@dataclass(frozen=True)
class Outlook:
    """
    What the poses of a calibration determine, and the pose that improves it most.

    `identifiability` and `next_pose` are for the requested model; for the largest model if the
    choice was ``auto``. `uncertainty_mg` is the stated one of the corrected |force| (model 12: of
    the force), RMS over the sphere [mg]; None if it is not known.

    """

    identifiability: Identifiability
    next_pose: NextPose
    uncertainty_mg: float | None


def outlook(calibration: Calibration, asked: str = 'auto') -> Outlook:
    """
    Return what the poses of a calibration determine, and the next pose for the model asked for.

    Effects are taken in the middle of their range. The uncertainty of a mounting alone, and of an
    offset over temperature alone, is not known.

    """
    poses = calibration.used_poses
    mat_w, vec_v = calibration.model.linear_part
    force = np.linalg.solve(mat_w, (calibration.units.to_g(poses.reading) - vec_v).T).T
    directions = force / np.linalg.norm(force, axis=1, keepdims=True)
    noise = pose_noise(poses.noise, directions)
    alone = calibration.method == PRIOR and not calibration.form.effects
    uncertainty = np.nan if alone or not calibration.model.effects else _uncertainty(calibration)
    planned = asked
    if asked in ('auto', ORIENTED):  # with wrong orientations model 12 became 10
        planned = ORIENTED if calibration.form.known_orientation else NORM_MODELS[-1]
    known, noise_g = np.isfinite(uncertainty), None
    if known and calibration.form.effects and determines(calibration.name, directions, noise):
        noise_g = uncertainty / identifiability(calibration.name, directions, noise).mean_dilution
    return Outlook(identifiability(planned, directions, noise),
                   next_pose(directions, planned, noise, noise_g=noise_g),
                   uncertainty * MG if known else None)


def _uncertainty(calibration: Calibration) -> float:
    """Return the stated uncertainty of the corrected force, RMS over the sphere [g]."""
    up = OVER_THE_SPHERE
    per_g, known = calibration.force_per_g, calibration.typical_context(len(up))
    if any(key not in known for key in calibration.model.needs):
        return np.nan
    covariance = calibration.force_covariance(up * per_g, known) / per_g ** 2
    errors = (np.trace(covariance, axis1=1, axis2=2) if calibration.form.known_orientation
              else np.einsum('ni,nij,nj->n', up, covariance, up))
    return float(np.sqrt(np.mean(errors)))


CONE = 30.0
"""
Largest angle between poses and their mean direction of a robot that cannot be turned over [°].

Robots with wheels or tracks tilt by 10° to 25°. No number of poses within 30° determines model 10:
the dilution is above 300 for 60 poses. Poses further apart, such as those in a ring, in a plane or
at right angles, come from a sensor that can be turned.

"""

_WIDE = 75.0
"""Angle above which poses are no longer described as near one direction [°]."""

_MOST_NAMED = 3
"""Largest number of undetermined combinations in a message."""


def lies_in_cone(directions: Floats) -> bool:
    """Return whether (n, 3) unit vectors are those of a robot that cannot be turned over."""
    return bool(len(directions) and cone_of(directions).degrees <= CONE)


def determines(name: str, directions: Floats, noise: Floats | None = None) -> bool:
    """Return whether poses determine a model; parameters as in `refuse_if_unfit`."""
    return (len(directions) >= poses_needed(name)
            and dilution(name, directions, noise) <= LARGEST_DILUTION)


def refuse_if_unfit(name: str, directions: Floats, noise: Floats | None = None) -> None:
    """Raise RefusedFitError if poses do not determine a model; parameters as in `next_pose`."""
    if determines(name, directions, noise):
        return
    smaller = [other for other in NORM_MODELS if poses_needed(other) < poses_needed(name)
               and len(directions) >= poses_needed(other)
               and dilution(other, directions, noise) <= WEAK_DILUTION]
    offer = _offer(name, smaller[-1], directions, noise) if smaller else ''
    few = len(directions) < poses_needed(NORM_MODELS[0])
    open_ = () if few else identifiability(name, directions, noise).undetermined
    raise RefusedFitError(
        f'{shape_words(name, directions)}, expected at least {poses_needed(name)} poses spread '
        f'over the sphere for model {name}'
        f'{f"; not determined: {combination_words(open_)}" if open_ else ""}',
        f'{turn_words(missing_poses(name, directions, noise))}, hold it still and continue{offer}')


def unseen(chosen: str, directions: Floats, noise: Floats | None = None) -> Iterator[Finding]:
    """Yield a finding if the poses determine only `chosen`, and not the largest model."""
    largest = NORM_MODELS[-1]
    if chosen in NORM_MODELS[:-1]:
        open_ = identifiability(largest, directions, noise).undetermined
        yield Finding(
            'undetermined', f'the poses do not determine {combination_words(open_)}, so model '
            f'{chosen} is the largest possible: it omits {enumerated(left_out(chosen, largest))}, '
            f'{_commonly(chosen, largest, directions, noise)}',
            f'to determine them, {turn_words(missing_poses(largest, directions, noise))}')


def _offer(name: str, smaller: str, directions: Floats, noise: Floats | None) -> str:
    """Return a text that offers a smaller model, with the effects that it omits."""
    offer = (f', or use model {smaller}, which these poses determine: it omits '
             f'{enumerated(left_out(smaller, name))}')
    if name == ORIENTED:
        return offer
    return f'{offer}, {_commonly(smaller, name, directions, noise)}'


def _commonly(smaller: str, larger: str, directions: Floats, noise: Floats | None) -> str:
    """Return a text about the typical error if the effects are omitted."""
    error = error_left_in(smaller, larger, directions, noise) * MG
    return f'which causes an error of |a| of {error:.0f} mg in a common sensor'


def combination_words(open_: Sequence[Combination]) -> str:
    """Return the names of undetermined combinations."""
    words = [each.words for each in open_[:_MOST_NAMED]]
    if len(open_) > _MOST_NAMED:
        words.append(f'{len(open_) - _MOST_NAMED} more')
    return enumerated(words)


def turn_words(missing: Sequence[str]) -> str:
    """Return how to turn the sensor for the missing poses."""
    if len(missing) <= 1:
        return f'turn the sensor so that {"".join(missing) or "another side"} points up'
    return f'turn the sensor so that in turn {enumerated(missing)} point up'


def enumerated(words: Sequence[str]) -> str:
    """Join words by commas and 'and'."""
    return ' and '.join(filter(None, [', '.join(words[:-1]), words[-1]]))


def shape_words(name: str, directions: Floats) -> str:
    """Return a text about what is wrong with these directions."""
    count = len(directions)
    if count < 2:
        return counted(count, 'pose')
    if distinct(directions) == 1:
        return f'the {count} poses all have the same orientation'
    if count < poses_needed(name):
        return f'{count} poses'
    if determines(name, directions):
        return f'some of the {count} poses are too noisy'
    cone = cone_of(directions)
    if cone.degrees < _WIDE:
        return f'the {count} poses lie within {cone.degrees:.0f}° of one direction'
    centred = directions - directions.mean(axis=0)
    if np.linalg.svd(centred, compute_uv=False)[-1] < 0.1 * np.sqrt(count):
        return f'the {count} poses lie in a plane'
    return (f'the {count} poses have {distinct(directions)} directions that leave a region of '
            'the sphere uncovered')
