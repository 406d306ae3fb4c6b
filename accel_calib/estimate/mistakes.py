# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Mistakes in poses that the other poses do not locate, or do not show.

**Rivals.** The search for outliers leaves out the rows that agree least with the others. If there
are few poses more than values, the poses may agree nearly as well without another row instead. A
mean shift of each of the two rows is a hypothesis. Its probability, with a uniform prior on the
shift and the moderated variance of the tests, is (Abraham and Box 1978)

    |JᵀJ|^(-1/2) (f + χ²)^(-(f + dof)/2) / Π s

over the poses that are kept, with their noise s. The noise counts as f degrees of freedom. A rival
is a row whose hypothesis is at least `LEVEL` times as probable as that of the row left out. The
covariance of a fit with rivals includes the difference to the fit of each rival.

**Unchecked rows.** A pose with a leverage near 1 pulls the fit towards itself, so that its mistake
does not show. The largest mistake that the test for outliers does not find is
δ s / √(1 - leverage) (internal reliability, Baarda 1968), with δ the limit of the test in standard
deviations.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .equations import belief_in
from .fit import Fit, judge
from .least_squares import NotConvergedError
from .outliers import belief_beside, LEVEL
from ..table import Floats, Poses

_EXPLAINED = 0.25
"""Smallest part of the residuals by the mistake of one row that a mistake of another row explains
to first order; other rows are no rivals."""

_LEAST_OWN = 1e-9
"""1 - leverage below this: the pose alone determines a parameter."""

_LARGEST_LOG = 100.0
"""Largest logarithm of odds, against overflow."""

_HARDLY = 0.1
"""1 - leverage below this: the other poses hardly check the pose."""


class Rival(NamedTuple):
    """
    A pose that may be wrong instead of a pose that was left out.

    Parameters
    ----------
    left_out, instead : int
        Indices of the pose left out and of its rival.
    fit : Fit
        Fit without the rival.
    odds : float
        Ratio of the probabilities: that the rival is wrong, over that the other pose is.

    """

    left_out: int
    instead: int
    fit: Fit
    odds: float


def rivals(fit: Fit, kept: NDArray[np.intp], poses_g: Poses,
           refit: Callable[[Poses], Fit]) -> tuple[Rival, ...]:
    """
    Return the poses that may be wrong instead of those that were left out.

    Parameters
    ----------
    fit : Fit
        Fit to the poses kept.
    kept : (k,) array of int
        Indices of these poses.
    poses_g : Poses
        All poses without copies, in g.
    refit : callable
        Fit of the same model to other poses; may raise `NotConvergedError`.

    """
    found = []
    for out, instead in _look_alikes(fit, kept, poses_g):
        others = np.union1d(np.setdiff1d(kept, [instead]), [out])
        try:
            rival = refit(poses_g.take(others))
        except NotConvergedError:
            continue
        odds = _odds(rival, fit)
        if odds >= LEVEL:
            found.append(Rival(out, instead, rival, odds))
    return tuple(found)


def covariance_with(fit: Fit, found: tuple[Rival, ...]) -> Floats:
    """
    Return the (p, p) covariance of a fit with its rivals.

    It includes the square of the difference to the fit of each rival, times the odds, at most 1.

    """
    spread = fit.covariance
    for rival in found:
        away = rival.fit.model.vector - fit.model.vector
        spread = spread + min(rival.odds, 1.0) * np.outer(away, away)
    return spread


def _look_alikes(fit: Fit, kept: NDArray[np.intp], poses_g: Poses) -> Iterator[tuple[int, int]]:
    """Yield the poses left out, each with a pose kept whose mistake would look like its own."""
    out = np.setdiff1d(np.arange(len(poses_g)), kept)
    if not len(out):
        return
    data = judge(fit.model, poses_g.take(np.concatenate([kept, out])), fit.ties).by_pose
    spread, columns = fit.by_pose.spread, data.columns
    pull = np.linalg.eigvalsh(columns @ spread @ np.swapaxes(columns, 1, 2))[:, -1]
    inside = pull[:len(kept)] / np.maximum(1.0 - pull[:len(kept)], _LEAST_OWN)
    for place in len(kept) + np.flatnonzero(pull[len(kept):] * np.max(inside) >= _EXPLAINED):
        # By Cauchy's inequality, the mistakes of the other poses have no look-alike.
        part = _explained(data.residual[place], columns[place], columns[:len(kept)], spread)
        for index in kept[part >= _EXPLAINED]:
            yield int(out[place - len(kept)]), int(index)


def _explained(shift: Floats, own: Floats, others: Floats, spread: Floats) -> Floats:
    """
    Return the part of the residuals by a mistake of one pose that the other poses explain.

    Parameters
    ----------
    shift : (k,) array
        The mistake, in units of the noise.
    own, others : (k, q), (n, k, q) array
        Derivative of the prediction at the pose and at the others.
    spread : (q, q) array
        (JᵀJ)⁻¹ of the others.

    Returns
    -------
    (n,) array
        Part that a mistake of each other pose explains, if all poses are fitted.

    """
    onto = spread @ own.T
    inverse = np.linalg.inv(np.eye(len(own)) + own @ onto)
    spread = spread - onto @ inverse @ onto.T
    left = np.eye(len(own)) - others @ spread @ np.swapaxes(others, 1, 2)
    moved = others @ (spread @ (own.T @ shift))
    solved = np.linalg.pinv(left, _LEAST_OWN, hermitian=True) @ moved[:, :, np.newaxis]
    part: Floats = np.sum(moved * solved[:, :, 0], axis=1) / max(shift @ inverse @ shift, 1e-300)
    return part


def _odds(rival: Fit, fit: Fit) -> float:
    """Return the ratio of the probabilities of two hypotheses."""
    belief = belief_beside(fit.dof, fit.chi2, fit.noise_known)
    difference = _log_probability(rival, belief) - _log_probability(fit, belief)
    return float(np.exp(min(difference, _LARGEST_LOG)))


def _log_probability(fit: Fit, belief: float) -> float:
    """Return the logarithm of the probability of a hypothesis, up to a constant."""
    volume = np.linalg.slogdet(fit.by_pose.spread)[1] / 2.0
    noise = float(fit.by_pose.rows @ np.log(fit.equations.scale))
    return float(volume - noise - (belief + fit.dof) / 2.0 * np.log(belief + fit.chi2))


def unseen_mistakes(fit: Fit) -> Floats:
    """
    Return the largest mistakes of poses that the test for outliers does not find.

    Returns
    -------
    (n,) array
        Mistakes along the force [g]; 0 for poses that the others check well, and infinite for
        poses that alone determine a parameter.

    """
    from scipy.special import stdtrit

    data = fit.by_pose
    own = data.own(data.spread)
    least = own[:, 0, 0] if own.shape[1] == 1 else np.linalg.eigvalsh(own)[:, 0]
    size = np.zeros(len(least))
    weak = np.flatnonzero(least < _HARDLY)
    if len(weak):
        dof = max(belief_in(fit.noise_known) + fit.dof - 1.0, 1.0)
        limit = float(stdtrit(dof, 1.0 - LEVEL / len(least) / 2.0)) * np.sqrt(fit.variance)
        with np.errstate(divide='ignore'):
            size[weak] = limit * fit.equations.scale[weak] / np.sqrt(
                np.where(least[weak] > _LEAST_OWN, least[weak], 0.0))
    return size
