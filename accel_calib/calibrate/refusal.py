# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The refusal of poses that do not determine a model.

The error contains the reason, the undetermined parameters, the poses to add, and the largest of
the smaller models that the poses determine.

"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .pose_planning import missing_poses
from ..errors import counted, RefusedFitError
from ..estimate.geometry import (
    dilution,
    distinct,
    LARGEST_DILUTION,
    NORM_MODELS,
    poses_needed,
    WEAK_DILUTION,
)
from ..estimate.identifiability import Combination, error_left_in, identifiability, left_out
from ..table import Floats
from ..units import MG

_MOST_NAMED = 3
"""Largest number of undetermined combinations in a message."""


def determines(name: str, directions: Floats, noise: Floats | None = None) -> bool:
    """Return whether poses determine a model; parameters as in `refuse_if_unfit`."""
    return (len(directions) >= poses_needed(name)
            and dilution(name, directions, noise) <= LARGEST_DILUTION)


def refuse_if_unfit(name: str, directions: Floats, noise: Floats | None = None) -> None:
    """
    Check that poses determine a model.

    Parameters
    ----------
    name : {'4', '7', '9', '10', '12'}
        The model.
    directions : (n, 3) array
        Unit vectors of force in the sensor axes.
    noise : (n,) array, optional
        Noise of each pose, in any unit; by default equal for all poses.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model.

    """
    if determines(name, directions, noise):
        return
    smaller = [other for other in NORM_MODELS if poses_needed(other) < poses_needed(name)
               and len(directions) >= poses_needed(other)
               and dilution(other, directions, noise) <= WEAK_DILUTION]
    offer = _offer(name, smaller[-1], directions, noise) if smaller else ''
    few = len(directions) < poses_needed(NORM_MODELS[0])
    open_ = () if few else identifiability(name, directions, noise).undetermined
    raise RefusedFitError(
        f'{_shape(name, directions)}, expected at least {poses_needed(name)} poses spread over '
        f'the sphere for model {name}{f"; not determined: {words_of(open_)}" if open_ else ""}',
        f'{_add(missing_poses(name, directions, noise))}, hold it still and continue{offer}')


def unseen(chosen: str, directions: Floats, noise: Floats | None = None) -> tuple[str, ...]:
    """
    Return a warning if the poses do not determine the largest model.

    Parameters
    ----------
    chosen : str
        The largest model that was considered.
    directions, noise
        As in `refuse_if_unfit`.

    Returns
    -------
    tuple of str
        One warning, or none.

    """
    largest = NORM_MODELS[-1]
    if chosen not in NORM_MODELS[:-1]:
        return ()
    open_ = identifiability(largest, directions, noise).undetermined
    return (f'the poses do not determine {words_of(open_)}, so model {chosen} is the largest '
            f'possible: it omits {_and(left_out(chosen, largest))}, '
            f'{_commonly(chosen, largest, directions, noise)}; to determine them, '
            f'{_add(missing_poses(largest, directions, noise))}',)


def _offer(name: str, smaller: str, directions: Floats, noise: Floats | None) -> str:
    """Return a text that offers a smaller model, with the effects that it omits."""
    offer = (f', or use model {smaller}, which these poses determine: it omits '
             f'{_and(left_out(smaller, name))}')
    if name == '12':
        return offer
    return f'{offer}, {_commonly(smaller, name, directions, noise)}'


def _commonly(smaller: str, larger: str, directions: Floats, noise: Floats | None) -> str:
    """Return a text about the typical error if the effects are omitted."""
    error = error_left_in(smaller, larger, directions, noise) * MG
    return f'which causes an error of |a| of {error:.0f} mg in a common sensor'


def words_of(open_: Sequence[Combination]) -> str:
    """Return the names of undetermined combinations."""
    words = [each.words for each in open_[:_MOST_NAMED]]
    if len(open_) > _MOST_NAMED:
        words.append(f'{len(open_) - _MOST_NAMED} more')
    return _and(words)


def _add(missing: Sequence[str]) -> str:
    """Return how to turn the sensor for the missing poses."""
    if len(missing) <= 1:
        return f'turn the sensor so that {"".join(missing) or "another side"} points up'
    return f'turn the sensor so that in turn {_and(missing)} point up'


def _and(words: Sequence[str]) -> str:
    """Join words by commas and 'and'."""
    return ' and '.join(filter(None, [', '.join(words[:-1]), words[-1]]))


def _shape(name: str, directions: Floats) -> str:
    """Return a text about what is wrong with these directions."""
    count = len(directions)
    if count < 2:
        return counted(count, 'pose')
    mean = directions.mean(axis=0)
    unit = mean / max(float(np.linalg.norm(mean)), 1e-9)
    cone = np.degrees(np.arccos(np.clip(np.min(directions @ unit), -1.0, 1.0)))
    if distinct(directions) == 1:
        return f'the {count} poses all have the same orientation'
    if count < poses_needed(name):
        return f'{count} poses'
    if determines(name, directions):
        return f'some of the {count} poses are too noisy'
    if cone < 75.0:
        return f'the {count} poses lie within {cone:.0f}° of one direction'
    if np.linalg.svd(directions - mean, compute_uv=False)[-1] < 0.1 * np.sqrt(count):
        return f'the {count} poses lie in a plane'
    return (f'the {count} poses have {distinct(directions)} directions that leave a region of '
            'the sphere uncovered')
