# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
When poses cannot determine a model: what is wrong, what is left open, and what to do.

That is the poses to add, or the largest of the smaller models that the poses do determine.

"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .pose_planning import missing_poses
from ..errors import RefusedFitError
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

_SAID = 3
"""Combinations left open that are named one by one."""


def carries(name: str, directions: Floats, noise: Floats | None = None) -> bool:
    """Return whether poses determine a model; arguments as `refuse_if_unfit`."""
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
        Noise of each pose, in any unit; equal if it is not given.

    Raises
    ------
    RefusedFitError
        If they do not: with what is wrong, what they leave open, the poses to add and the largest
        of the smaller models that they do determine.

    """
    if carries(name, directions, noise):
        return
    smaller = [other for other in NORM_MODELS if poses_needed(other) < poses_needed(name)
               and len(directions) >= poses_needed(other)
               and dilution(other, directions, noise) <= WEAK_DILUTION]
    offer = _offer(name, smaller[-1], directions, noise) if smaller else ''
    few = len(directions) < poses_needed(NORM_MODELS[0])
    open_ = () if few else identifiability(name, directions, noise).undetermined
    raise RefusedFitError(
        f'{_shape(name, directions)}, model {name} needs at least {poses_needed(name)} '
        f'poses spread over the sphere{f"; left open: {words_of(open_)}" if open_ else ""}',
        f'{_add(missing_poses(name, directions, noise))}, hold it still and go on{offer}')


def unseen(chosen: str, directions: Floats, noise: Floats | None = None) -> tuple[str, ...]:
    """
    Return what the largest model would show if the poses determined it.

    Parameters
    ----------
    chosen : str
        The largest model that was looked at.
    directions, noise
        As `refuse_if_unfit`.

    Returns
    -------
    tuple of str
        A warning, or none if the poses determine the largest model.

    """
    largest = NORM_MODELS[-1]
    if chosen not in NORM_MODELS[:-1]:
        return ()
    open_ = identifiability(largest, directions, noise).undetermined
    return (f'the poses do not determine {words_of(open_)}, so that model {chosen} was the '
            f'largest to choose: it leaves out {_and(left_out(chosen, largest))}, '
            f'{_commonly(chosen, largest, directions, noise)}; to see them, '
            f'{_add(missing_poses(largest, directions, noise))}',)


def _offer(name: str, smaller: str, directions: Floats, noise: Floats | None) -> str:
    """Return the offer of a smaller model, with what it leaves out."""
    offer = (f', or use model {smaller}, which these poses determine: it leaves out '
             f'{_and(left_out(smaller, name))}')
    if name == '12':
        return offer
    return f'{offer}, {_commonly(smaller, name, directions, noise)}'


def _commonly(smaller: str, larger: str, directions: Floats, noise: Floats | None) -> str:
    """Return the error that leaving out effects commonly makes."""
    error = error_left_in(smaller, larger, directions, noise) * MG
    return f'which in a common sensor makes |a| wrong by {error:.0f} mg'


def words_of(open_: Sequence[Combination]) -> str:
    """Return the words for what is left open."""
    words = [each.words for each in open_[:_SAID]]
    if len(open_) > _SAID:
        words.append(f'{len(open_) - _SAID} more')
    return _and(words)


def _add(missing: Sequence[str]) -> str:
    """Return which way to turn the sensor."""
    if len(missing) <= 1:
        return f'turn the sensor so that {"".join(missing) or "another side"} points up'
    return f'turn the sensor so that in turn {_and(missing)} point up'


def _and(words: Sequence[str]) -> str:
    """Return words joined by commas and 'and'."""
    return ' and '.join(filter(None, [', '.join(words[:-1]), words[-1]]))


def _shape(name: str, directions: Floats) -> str:
    """Return what is wrong with these directions."""
    count = len(directions)
    if count < 2:
        return f'{count} pose{"" if count else "s"}'
    mean = directions.mean(axis=0)
    unit = mean / max(float(np.linalg.norm(mean)), 1e-9)
    cone = np.degrees(np.arccos(np.clip(np.min(directions @ unit), -1.0, 1.0)))
    if distinct(directions) == 1:
        return f'the {count} poses all have the same orientation'
    if count < poses_needed(name):
        return f'{count} poses'
    if carries(name, directions):
        return f'some of the {count} poses are noisy, and without them'
    if cone < 75.0:
        return f'the {count} poses lie within {cone:.0f}° of one direction'
    if np.linalg.svd(directions - mean, compute_uv=False)[-1] < 0.1 * np.sqrt(count):
        return f'the {count} poses lie in a plane'
    return (f'the {count} poses point in {distinct(directions)} directions that leave a part of '
            'the sphere uncovered')
