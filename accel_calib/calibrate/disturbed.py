# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Disturbed poses: knocked, or not still. A fault of the data, found and left out.

The pose whose residual is the largest against what the other poses say (externally studentised,
with the moderated variance of `accel_calib.calibrate.likelihood.Fit`) is taken out, and so on,
several times over; as many are then called disturbed as the generalised extreme studentised
deviate test (Rosner 1983) finds at the level `_LEVEL`, which is not masked when several poses are
disturbed. Between the poses taken out the fit is followed to first order, by updates of rank one;
it is then made anew without them, and the search goes on until it finds no more. Of many poses all
that are extreme are taken out at once, against the median of the absolute residuals, which up to a
quarter of disturbed poses hardly moves.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .uncertainty import belief_in
from ..table import Floats

ROUNDS = 4
"""Most fits made anew."""

_LEVEL = 0.007
_LARGEST_SHARE = 0.25
_TOLD_BY_OTHERS = 1e-6
_NEVER_EXTREME = 2.0
_MANY = 200
"""Of more poses than these the disturbed ones hide one another no more."""

_MEDIAN_OF_CHI2 = 0.454936
"""Of a squared normal value."""

_DOUBTED = 1.0
_DOUBT_BELOW = 0.01
"""What measured noise counts as where the poses left contradict it, by the probability of chi²."""


@dataclass(frozen=True)
class _Order:
    """
    Poses taken out one after another.

    Parameters
    ----------
    pose : (m, k) array of int
        The most extreme of those left.
    squared : (m, k) array
        Its squared residual when the others are fitted, in units of its variance.
    rss : (m, k + 1) array
        Squared residuals before each is taken out, and at the end.
    dof : (m, 1) array of int
        Degrees of freedom at the beginning.
    count : (m, 1) array of int
        Poses at the beginning.

    """

    pose: NDArray[np.intp]
    squared: Floats
    rss: Floats
    dof: NDArray[np.int64]
    count: NDArray[np.int64]

    def extreme(self, belief: float, limit: NDArray[np.int64]) -> NDArray[np.int64]:
        """Say how many of them are extreme, (m,), at most so many."""
        number = np.arange(self.pose.shape[1])
        dof = np.maximum(belief + self.dof - number - 1.0, 1e-9)
        others = np.maximum(belief + self.rss[:, :-1] - self.squared, 1e-300) / dof
        size = np.sqrt(self.squared / others)
        is_extreme = size > _critical(size, dof, self.count - number)
        is_extreme &= number < limit[:, np.newaxis]
        return np.max(np.where(is_extreme, number + 1, 0), axis=1, initial=0)


def extreme(weighted: Floats, jacobian: Floats, kept: NDArray[np.bool_], noise_known: bool,
            total: int) -> NDArray[np.bool_]:
    """
    Find the poses whose residuals are extreme, for many sensors at once.

    Parameters
    ----------
    weighted : (m, n) array
        Residuals over their noise, of the m sensors' fits to the poses that are kept.
    jacobian : (m, n, q) array
        Their derivative by the free values.
    kept : (m, n) array of bool
        Poses fitted.
    noise_known : bool
        Whether the noise was measured. Even so it is believed only as far as the poses left
        agree with it: noise that is stated too small must not make clean poses look disturbed.
    total : int
        Poses of each sensor before any was left out.

    Returns
    -------
    (m, n) array of bool
        Poses to leave out now: in all no more than a quarter, and no more than are left to
        tell which they are.

    """
    from scipy.special import chdtrc

    count, free = np.sum(kept, axis=1), jacobian.shape[2]
    most = np.minimum(int(_LARGEST_SHARE * total), (total - free) // 2)
    limit = np.maximum(most - (total - count), 0)
    if kept.shape[1] > _MANY:
        return _far_out(weighted * kept, jacobian * kept[..., np.newaxis], kept, noise_known,
                        limit)
    order = _one_after_another(weighted * kept, jacobian * kept[..., np.newaxis], kept,
                               int(np.max(limit)))
    found = order.extreme(belief_in(noise_known), limit)
    if noise_known and np.any(found):
        left = np.take_along_axis(order.rss, found[:, np.newaxis], axis=1)[:, 0]
        doubted = chdtrc(np.maximum(count - free - found, 1), left) < _DOUBT_BELOW
        found = np.where(doubted, order.extreme(_DOUBTED, limit), found)
    out = np.zeros_like(kept)
    sensor, place = np.nonzero(np.arange(order.pose.shape[1]) < found[:, np.newaxis])
    out[sensor, order.pose[sensor, place]] = True
    return out


def _fitted_to(residual: Floats, rows: Floats) -> tuple[Floats, Floats, Floats]:
    """Give what the (m, n, q) rows leave of the residual, their leverage, and (JᵀJ)⁻¹."""
    transposed = np.swapaxes(rows, 1, 2)
    spread = np.linalg.pinv(transposed @ rows, hermitian=True)
    onto = rows @ spread
    left = residual - (onto @ (transposed @ residual[..., np.newaxis]))[..., 0]
    return left, np.sum(onto * rows, axis=2), spread


def _far_out(residual: Floats, rows: Floats, kept: NDArray[np.bool_], noise_known: bool,
             limit: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Find extreme poses among many: all at once, against the median of the absolute residuals."""
    residual, own, _ = _fitted_to(residual, rows)
    squared = np.where(kept, residual ** 2 / np.maximum(1.0 - own, _TOLD_BY_OTHERS), np.nan)
    dof = np.sum(kept, axis=1, keepdims=True) - float(rows.shape[2])
    belief = belief_in(noise_known)
    scale = np.nanmedian(squared, axis=1, keepdims=True) / _MEDIAN_OF_CHI2
    size = np.sqrt(np.nan_to_num(squared) * (belief + dof) / (belief + scale * dof))
    first_left = np.take_along_axis(np.sort(size, axis=1)[:, ::-1], limit[:, np.newaxis], axis=1)
    count = np.sum(kept, axis=1, keepdims=True)
    out: NDArray[np.bool_] = (size > _critical(size, belief + dof, count)) & (size > first_left)
    return out


def _one_after_another(residual: Floats, rows: Floats, left: NDArray[np.bool_], most: int
                       ) -> _Order:
    """Take out the most extreme pose time after time; following the fit to first order."""
    sensor, count = np.arange(len(left)), np.sum(left, axis=1, keepdims=True)
    residual, own, spread = _fitted_to(residual, rows)
    poses: list[NDArray[np.intp]] = []
    sizes: list[Floats] = []
    rss = [np.sum(residual ** 2, axis=1)]
    dof = count - rows.shape[2]
    for _ in range(most):
        told = left & (1.0 - own > _TOLD_BY_OTHERS)
        squared = np.where(told, residual ** 2 / np.where(told, 1.0 - own, 1.0), 0.0)
        at = np.argmax(squared, axis=1)
        largest, alone = squared[sensor, at], np.maximum(1.0 - own[sensor, at], _TOLD_BY_OTHERS)
        poses, sizes, rss = [*poses, at], [*sizes, largest], [*rss, rss[-1] - largest]
        root = np.sqrt(alone)[:, np.newaxis]
        moved = (spread @ rows[sensor, at][..., np.newaxis])[..., 0] / root
        along = (rows @ moved[..., np.newaxis])[..., 0]
        residual = residual + along * residual[sensor, at][:, np.newaxis] / root
        own = own + along ** 2
        spread = spread + moved[:, :, np.newaxis] * moved[:, np.newaxis]
        left = left & (np.arange(left.shape[1]) != at[:, np.newaxis])
    empty = np.zeros((len(left), 0))
    return _Order(np.column_stack([empty, *poses]).astype(np.intp),
                  np.column_stack([empty, *sizes]), np.column_stack(rss), dof, count)


def _critical(size: Floats, dof: Floats, count: NDArray[np.int64]) -> Floats:
    """Give Student's t that one of `count` clean poses exceeds with probability `_LEVEL`."""
    from scipy.special import stdtrit

    critical, near = np.full(size.shape, np.inf), size > _NEVER_EXTREME
    dof, count = np.broadcast_to(dof, size.shape), np.broadcast_to(count, size.shape)
    critical[near] = stdtrit(np.maximum(dof[near], 1.0), 1.0 - _LEVEL / (2.0 * count[near]))
    return critical
