# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether a sensor has left its calibration for good: a likelihood ratio.

The errors e = |force| - 1 of the last n rests are jointly normal with covariance S: the noise of
each rest, and the calibration's own uncertainty, which rests in similar attitudes share. Each rest
may have been knocked, with probability `_KNOCKED`, by some `_KNOCK` [g]: the likelihood is the sum
over all 2ⁿ combinations of knocks. The alternative is a lasting change that began at the third
last rest or before:

    offset   e changes by up · b    b normal, of each size of `_SIZES`, in three directions
    gain     e changes by b         the same in every attitude

averaged over instants, kinds and sizes; it may continue to change by `_WANDER` of its size, as
with temperature. By Markov's inequality such a ratio exceeds `SURE` by chance in at most one of
that many rests. One or two knocks are no lasting change; three rests that agree are.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from ..table import Floats

MEMORY = 6
"""Rests that are used."""

_FEWEST = 3
"""Rests that a change must have lasted."""

SURE = float(np.exp(13.0))
"""Ratio of the likelihoods from which a change is believed: one in 440,000."""

_KNOCKED, _KNOCK = 0.003, 0.05
_SIZES = (0.005, 0.05)   # [g]
_WANDER = 0.1            # part of a change by which it continues from rest to rest
_CLEAR = 20.0              # ratio from which one kind is distinguished from the other

KINDS: dict[str, Callable[[Floats], Floats]] = {
    'offset': lambda up: up, 'gain': lambda up: np.ones((len(up), 1))}
"""For each kind of change the (n, q) array by which the rests show it."""


@dataclass(frozen=True)
class Change:
    """
    A lasting change.

    Parameters
    ----------
    rests : int
        Number of last rests that show it.
    kind : str
        Of `KINDS`, the likelier one.
    clear : bool
        Whether the attitudes distinguish this kind from the other.
    shift : (q,) array
        The change [g].
    covariance : (q, q) array
        Of the shift [g²].
    error : float
        Its effect on |a| at these rests, RMS, with a sign if all have the same [g].

    """

    rests: int
    kind: str
    clear: bool
    shift: Floats
    covariance: Floats
    error: float


def change(error: Floats, covariance: Floats, up: Floats) -> Change | None:
    """
    Return a lasting change, if there is one.

    Parameters
    ----------
    error : (n,) array
        |force| - 1 of the last rests, the latest last [g].
    covariance : (n, n) array
        Of these errors, if nothing changed [g²].
    up : (n, 3) array
        Where up is in each rest, unit vectors in the sensor axes.

    Returns
    -------
    Change or None
        None: the stated uncertainty explains the errors, or knocks do.

    """
    most = 0.5 * float(error @ np.linalg.solve(covariance, error))
    if len(error) < _FEWEST or most - len(error) * np.log1p(-_KNOCKED) < np.log(SURE):
        return None   # the ratio cannot be larger
    found = {(kind, rests): np.logaddexp.reduce([
        _likelihood(error, covariance + _moved(_shown(kind, rests, up), size)) for size in _SIZES])
        for kind in KINDS for rests in range(_FEWEST, len(error) + 1)}
    same = _likelihood(error, covariance) + np.log(len(found) * len(_SIZES))
    if np.logaddexp.reduce(list(found.values())) - same < np.log(SURE):
        return None
    kind, rests = max(found, key=lambda key: found[key])
    each = [np.logaddexp.reduce([found[key] for key in found if key[0] == other])
            for other in KINDS]
    return _described(kind, rests, bool(np.ptp(each) > np.log(_CLEAR)), error, covariance, up)


def is_over(known: Change, error: Floats, covariance: Floats, up: Floats) -> bool:
    """Return whether the last rests are clearly without this change; arguments as `change`."""
    shown = KINDS[known.kind](up)
    stays = _likelihood(error - shown @ known.shift,
                        covariance + shown @ known.covariance @ shown.T)
    return bool(_likelihood(error, covariance) - stays > np.log(SURE))


def _shown(kind: str, rests: int, up: Floats) -> Floats:
    """Return how the rests show a change that came before the last `rests` of them."""
    shown = KINDS[kind](up).copy()
    shown[:len(up) - rests] = 0.0
    return shown


def _moved(shown: Floats, size: float) -> Floats:
    """Return the (n, n) covariance that a change of this size adds to the errors."""
    common: Floats = size ** 2 * shown @ shown.T
    return common + _WANDER ** 2 * np.diag(np.diag(common))


def _likelihood(error: Floats, covariance: Floats) -> float:
    """Return the logarithm of the likelihood, with any of the rests knocked."""
    return float(np.logaddexp.reduce(_knocks(error, covariance)[1]))


def _knocks(error: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return the (k, n) combinations of knocks, as ones and zeros, and log likelihoods (k,)."""
    knocked = np.array(list(product((0.0, 1.0), repeat=len(error))))
    spread = covariance + _KNOCK ** 2 * knocked[:, :, np.newaxis] * np.eye(len(error))
    count = knocked.sum(axis=1)
    weight = count * np.log(_KNOCKED) + (len(error) - count) * np.log1p(-_KNOCKED)
    solved = np.linalg.solve(spread, np.broadcast_to(error, knocked.shape)[:, :, np.newaxis])
    fit = solved[:, :, 0] @ error + np.linalg.slogdet(spread)[1]
    return knocked, weight - 0.5 * fit


def _described(kind: str, rests: int, clear: bool, error: Floats, covariance: Floats,
               up: Floats) -> Change:
    """Estimate a change, without the rests that were most likely knocked."""
    shown = _shown(kind, rests, up)
    prior = max(_SIZES) ** 2
    knocked, likely = _knocks(error, covariance + _moved(shown, max(_SIZES)))
    spread = covariance + np.diag(_KNOCK ** 2 * knocked[np.argmax(likely)])
    told = shown.T @ np.linalg.inv(spread)
    found = np.linalg.inv(told @ shown + np.eye(shown.shape[1]) / prior)
    shift = found @ told @ error
    moved = shown[len(up) - rests:] @ shift
    sign = float(np.sign(moved[0])) if np.ptp(np.sign(moved)) == 0.0 else 1.0
    return Change(rests, kind, clear, shift, found,
                  sign * float(np.sqrt(np.mean(moved ** 2))))
