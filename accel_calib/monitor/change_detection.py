# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Detection of a lasting change of a sensor since its calibration, by a likelihood ratio.

The errors e = |force| - 1 of the last n rests are jointly normal with covariance S. S contains the
noise of each rest, and the uncertainty of the calibration, which is common to rests in similar
orientations. Each rest can be disturbed by a knock, with probability `_KNOCKED` and a size of
about `_KNOCK` [g]. The likelihood is therefore the sum over all 2ⁿ combinations of knocks. The
alternative is a lasting change that began at the third last rest or earlier:

    offset   e changes by up · b    b normal with a standard deviation of `_SIZES`, three axes
    gain     e changes by b         the same in every orientation

The likelihood of the alternative is averaged over instants, kinds and sizes. The change may
continue to vary by `_WANDER` of its size, for example with temperature. By Markov's inequality the
ratio exceeds `SURE` by chance in at most one of `SURE` rests. One or two knocks are not a lasting
change; three rests that agree are.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from ..table import Floats

MEMORY = 6
"""Number of rests that are used."""

_FEWEST = 3
"""Smallest number of rests that a lasting change has."""

SURE = float(np.exp(13.0))
"""Likelihood ratio above which a change is reported: 440,000."""

_KNOCKED, _KNOCK = 0.003, 0.05   # probability and size [g] of a knock
_SIZES = (0.005, 0.05)           # sizes of a change [g]
_WANDER = 0.1                    # variation of a change from rest to rest, relative to its size
_CLEAR = 20.0                    # likelihood ratio above which one kind is clearly distinguished

KINDS: dict[str, Callable[[Floats], Floats]] = {
    'offset': lambda up: up, 'gain': lambda up: np.ones((len(up), 1))}
"""Kinds of change: (n, 3) up -> (n, q) derivative of the errors by the change."""


@dataclass(frozen=True)
class Change:
    """
    A lasting change.

    Parameters
    ----------
    rests : int
        Number of rests since the change.
    kind : str
        More likely kind of `KINDS`.
    clear : bool
        Whether the orientations of the rests clearly distinguish this kind from the other.
    shift : (q,) array
        The change [g].
    covariance : (q, q) array
        Covariance of the shift [g²].
    error : float
        Effect on |a| at these rests, RMS [g]; signed if the sign is the same for all.

    """

    rests: int
    kind: str
    clear: bool
    shift: Floats
    covariance: Floats
    error: float


def change(error: Floats, covariance: Floats, up: Floats) -> Change | None:
    """
    Return a lasting change, or None.

    Parameters
    ----------
    error : (n,) array
        |force| - 1 of the last rests, in order of time [g].
    covariance : (n, n) array
        Covariance of these errors without a change [g²].
    up : (n, 3) array
        Direction of up in each rest, unit vectors in the sensor axes.

    Returns
    -------
    Change or None
        None if the stated uncertainty or knocks explain the errors.

    """
    most = 0.5 * float(error @ np.linalg.solve(covariance, error))
    if len(error) < _FEWEST or most - len(error) * np.log1p(-_KNOCKED) < np.log(SURE):
        return None   # the ratio cannot be larger
    found = {(kind, rests): np.logaddexp.reduce([
        _likelihood(error, covariance + _added(_derivative(kind, rests, up), size))
        for size in _SIZES]) for kind in KINDS for rests in range(_FEWEST, len(error) + 1)}
    same = _likelihood(error, covariance) + np.log(len(found) * len(_SIZES))
    if np.logaddexp.reduce(list(found.values())) - same < np.log(SURE):
        return None
    kind, rests = max(found, key=lambda key: found[key])
    each = [np.logaddexp.reduce([found[key] for key in found if key[0] == other])
            for other in KINDS]
    return _described(kind, rests, bool(np.ptp(each) > np.log(_CLEAR)), error, covariance, up)


def is_over(known: Change, error: Floats, covariance: Floats, up: Floats) -> bool:
    """Return whether this change is clearly absent now; parameters as in `change`."""
    slope = KINDS[known.kind](up)
    stays = _likelihood(error - slope @ known.shift,
                        covariance + slope @ known.covariance @ slope.T)
    return bool(_likelihood(error, covariance) - stays > np.log(SURE))


def _derivative(kind: str, rests: int, up: Floats) -> Floats:
    """Return the (n, q) derivative of the errors by a change before the last `rests` rests."""
    slope = KINDS[kind](up).copy()
    slope[:len(up) - rests] = 0.0
    return slope


def _added(slope: Floats, size: float) -> Floats:
    """Return the (n, n) covariance of the errors that a change of this size causes."""
    common: Floats = size ** 2 * slope @ slope.T
    return common + _WANDER ** 2 * np.diag(np.diag(common))


def _likelihood(error: Floats, covariance: Floats) -> float:
    """Return the logarithm of the likelihood, summed over all combinations of knocks."""
    return float(np.logaddexp.reduce(_knocks(error, covariance)[1]))


def _knocks(error: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return the (k, n) combinations of knocks as 0 and 1, and their (k,) log likelihoods."""
    knocked = np.array(list(product((0.0, 1.0), repeat=len(error))))
    spread = covariance + _KNOCK ** 2 * knocked[:, :, np.newaxis] * np.eye(len(error))
    count = knocked.sum(axis=1)
    weight = count * np.log(_KNOCKED) + (len(error) - count) * np.log1p(-_KNOCKED)
    solved = np.linalg.solve(spread, np.broadcast_to(error, knocked.shape)[:, :, np.newaxis])
    fit = solved[:, :, 0] @ error + np.linalg.slogdet(spread)[1]
    return knocked, weight - 0.5 * fit


def _described(kind: str, rests: int, clear: bool, error: Floats, covariance: Floats,
               up: Floats) -> Change:
    """Return the estimate of a change, without the rests that were most likely knocked."""
    slope = _derivative(kind, rests, up)
    prior = max(_SIZES) ** 2
    knocked, likely = _knocks(error, covariance + _added(slope, max(_SIZES)))
    spread = covariance + np.diag(_KNOCK ** 2 * knocked[np.argmax(likely)])
    weighted = slope.T @ np.linalg.inv(spread)
    found = np.linalg.inv(weighted @ slope + np.eye(slope.shape[1]) / prior)
    shift = found @ weighted @ error
    moved = slope[len(up) - rests:] @ shift
    sign = float(np.sign(moved[0])) if np.ptp(np.sign(moved)) == 0.0 else 1.0
    return Change(rests, kind, clear, shift, found,
                  sign * float(np.sqrt(np.mean(moved ** 2))))
