# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Fits without gross outliers, and mistakes in poses that the other poses do not locate or show.

**Gross outliers.** A single wrong row, such as zeros or a reading in another unit, can distort the
closed form and the fit of all poses so far that the residuals do not show which row is wrong. If
that fit is suspicious, subsets are fitted in closed form. The subset with the smallest trimmed
squares (least trimmed squares, Rousseeuw 1984) starts a fit, which then includes every pose that
agrees with it.

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
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .closed_form import closed_form
from .equations import believable
from .fit import estimate, Fit, judge, NotConvergedError
from .outliers import (
    belief_beside, belief_in, beyond, LARGEST_SHARE, LEVEL, Outliers, outliers_among)
from ..effects import linear_values, Model, MODELS, parameter_names
from ..table import Floats, Poses

_ROUNDS = 6
"""Largest number of fits after which poses are left out or included."""

_SUSPICIOUS = 4.0
"""chi² per degree of freedom above which the fit of all poses is suspicious."""

_CLEARLY = 10.0
"""Ratio of the variances above which a pose that the robust fit leaves out is an outlier. The
choice among subsets makes small differences look significant, so a smaller ratio is ignored;
`.outliers` decides about the other poses."""

_MOST_SUBSETS = 400
"""Largest number of subsets that are fitted."""

_SPARE = 3
"""Number of poses in a random subset beyond the free parameters."""

_CONCENTRATIONS = 3
"""Number of closed forms after each of which the nearest poses are selected again."""

_EXPLAINED = 0.25
"""Smallest part of the residuals by the mistake of one row that a mistake of another row explains
to first order; other rows are no rivals."""

_LEAST_OWN = 1e-9
"""1 - leverage below this: the pose alone determines a parameter."""

_LARGEST_LOG = 100.0
"""Largest logarithm of odds, against overflow."""

_HARDLY = 0.1
"""1 - leverage below this: the other poses hardly check the pose."""


def fit_norm(name: str, poses_g: Poses) -> tuple[Fit, NDArray[np.intp]]:
    """
    Fit model 4, 7 or 10 to poses in g of unknown orientation, without the outliers.

    Return the fit and the (k,) indices of the poses used. Raise `NotConvergedError` if the poses
    are not on an ellipsoid. The poses are at least as many as free parameters.

    """
    everyone = np.arange(len(poses_g))
    direct = _without_outliers(name, poses_g, everyone)
    if direct is not None and direct[0].chi2 <= _SUSPICIOUS * max(direct[0].dof, 1):
        return direct
    robust = _from_those_that_agree(name, poses_g)
    if robust is None:
        if direct is None:
            raise NotConvergedError
        return direct
    found, gross = direct, _grossest_first(*robust, poses_g)
    for count in range(len(gross) + 1):
        if found is not None and found[0].variance <= _CLEARLY * robust[0].variance:
            return found
        found = _without_outliers(name, poses_g, np.setdiff1d(everyone, gross[:count + 1]))
    return robust


def start_of(name: str, reading: Floats) -> Model:
    """Return start values by the closed form; a sphere if the poses are not on an ellipsoid."""
    mat_w, vec_v = closed_form(name, reading)
    if not np.all(np.isfinite(mat_w)):
        mat_w, vec_v = closed_form('4', reading)
    values = linear_values(mat_w, vec_v)
    return Model({effect: values[effect] for effect in MODELS[name].effects})


def outliers(fit: Fit, total: int) -> Outliers:
    """
    Return the outliers among the poses of a fit; `total` includes the poses left out before.

    They are at most `LARGEST_SHARE` of all poses, and at most so many that the other equations
    identify them.

    """
    return outliers_among(fit.by_pose, fit.chi2, fit.dof, total, noise_known=fit.noise_known)


def _grossest_first(fit: Fit, kept: NDArray[np.intp], poses_g: Poses) -> NDArray[np.intp]:
    """Return the poses that a fit leaves out, in decreasing order of the residual."""
    out = np.setdiff1d(np.arange(len(poses_g)), kept)
    away = np.abs(judge(fit.model, poses_g).residual[out])
    return out[np.argsort(-away, kind='stable')]


def _without_outliers(name: str, poses_g: Poses, kept: NDArray[np.intp]
                      ) -> tuple[Fit, NDArray[np.intp]] | None:
    """Fit poses and leave out outliers until there are none; None if a fit does not converge."""
    fit = _fit(name, poses_g, kept)
    for _ in range(_ROUNDS):
        out = () if fit is None else outliers(fit, len(poses_g)).poses
        if not len(out):
            break
        kept = np.delete(kept, out)
        fit = _fit(name, poses_g, kept)
    if fit is None:
        return None
    if len(kept) < len(poses_g):
        return _with_those_that_agree(name, poses_g, kept) or (fit, kept)
    return fit, kept


def _from_those_that_agree(name: str, poses_g: Poses) -> tuple[Fit, NDArray[np.intp]] | None:
    """Fit the poses that agree best, and include those that agree with them."""
    most = _most(name, len(poses_g))
    if most < 1:
        return None
    return _with_those_that_agree(name, poses_g, _agreeing(name, poses_g, most))


def _with_those_that_agree(name: str, poses_g: Poses, kept: NDArray[np.intp]
                           ) -> tuple[Fit, NDArray[np.intp]] | None:
    """Include the poses that agree with a fit, leave out the others; None if too few agree."""
    tried: set[bytes] = set()
    while (fit := _fit(name, poses_g, kept)) is not None:
        tried.add(kept.tobytes())
        agreeing = np.flatnonzero(_agrees(fit, kept, poses_g))
        if len(poses_g) - len(agreeing) > _most(name, len(poses_g)):
            return None
        if agreeing.tobytes() in tried or len(tried) == _ROUNDS:
            return fit, kept
        kept = agreeing
    return None


def _fit(name: str, poses_g: Poses, kept: NDArray[np.intp]) -> Fit | None:
    now = poses_g.take(kept)
    try:
        return estimate(start_of(name, now.reading), now)
    except NotConvergedError:
        return None


def _most(name: str, count: int) -> int:
    """Return the largest number of poses that can be left out."""
    return min(int(LARGEST_SHARE * count), (count - _free(name)) // 2)


def _free(name: str) -> int:
    return len(parameter_names(MODELS[name].effects))


def _agrees(fit: Fit, kept: NDArray[np.intp], poses_g: Poses) -> NDArray[np.bool_]:
    """Return which poses agree with a fit to the poses kept."""
    data = judge(fit.model, poses_g).by_pose
    leverage = np.einsum('nkp,pq,nkq->n', data.columns, fit.by_pose.spread, data.columns)
    inside = np.isin(np.arange(len(poses_g)), kept)
    spare = np.where(inside, np.maximum(1.0 - leverage, 1e-6), 1.0 + leverage)
    belief = belief_beside(fit.dof, fit.chi2, fit.noise_known)
    size = data.residual[:, 0] ** 2 / spare / ((belief + fit.chi2) / (belief + fit.dof))
    agrees: NDArray[np.bool_] = beyond(size, data.rows, belief + fit.dof) >= LEVEL / len(poses_g)
    return agrees


def _agreeing(name: str, poses_g: Poses, most: int) -> NDArray[np.intp]:
    """Return the indices of all poses but `most`, selected so that they agree best."""
    count = len(poses_g)
    reading = poses_g.reading
    noise = believable(poses_g.noise)
    noise = np.ones_like(reading) if noise is None else noise
    nearest = _subsets(count, most, _free(name))
    for _ in range(_CONCENTRATIONS):
        squared = _squared_distances(name, reading, nearest, noise)
        nearest = np.argsort(squared, axis=1)[:, :count - most]
        trimmed = np.take_along_axis(squared, nearest, axis=1).sum(axis=1)
        nearest = nearest[np.argsort(trimmed)[:10]]
    return np.sort(nearest[0])


def _subsets(count: int, most: int, free: int) -> NDArray[np.intp]:
    """Return all subsets of count - most poses, or `_MOST_SUBSETS` random subsets."""
    if comb(count, most) <= _MOST_SUBSETS:
        out = np.array(list(combinations(range(count), most)))
        inside = np.ones((len(out), count), bool)
        np.put_along_axis(inside, out, False, axis=1)
        return np.nonzero(inside)[1].reshape(len(out), -1)
    size = min(free + _SPARE, count - most)
    rng = np.random.default_rng(count)
    return np.argsort(rng.random((_MOST_SUBSETS, count)), axis=1)[:, :size]


def _squared_distances(name: str, reading: Floats, subsets: NDArray[np.intp], noise: Floats
                       ) -> Floats:
    """Return the (s, n) squared distances of all poses from the closed form of each subset."""
    with np.errstate(all='ignore'):  # some subsets are not on an ellipsoid, or are in a plane
        mat_w, vec_v = closed_form(name, reading[subsets])
        sound = np.isfinite(mat_w).all(axis=(1, 2)) & (np.abs(np.linalg.det(mat_w)) > 0.0)
        inverse = np.linalg.inv(np.where(sound[:, np.newaxis, np.newaxis], mat_w, np.eye(3)))
        u = (reading - vec_v[:, np.newaxis]) @ np.swapaxes(inverse, 1, 2)
        length = np.linalg.norm(u, axis=2)
        along = (u / length[:, :, np.newaxis]) @ inverse
        squared = (length - 1.0) ** 2 / np.sum((along * noise) ** 2, axis=2)
    return np.where(sound[:, np.newaxis] & np.isfinite(squared), squared, np.inf)


class Rival(NamedTuple):
    """
    A pose that may be wrong instead of a pose that was left out.

    `left_out` and `instead` are the indices of the pose left out and of its rival, `fit` the fit
    without the rival, and `odds` the probability that the rival is wrong over that of the other
    pose.

    """

    left_out: int
    instead: int
    fit: Fit
    odds: float


def rivals(fit: Fit, kept: NDArray[np.intp], poses_g: Poses,
           refit: Callable[[Poses], Fit]) -> tuple[Rival, ...]:
    """
    Return the poses that may be wrong instead of those that were left out.

    `kept` are the (k,) indices of the poses of the fit among `poses_g`, all poses without copies.
    `refit` fits the same model to other poses, and may raise `NotConvergedError`.

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
    Return the (n,) part of the residuals by a mistake of one pose that each other pose explains.

    The mistake is `shift` (k,) per noise, `own` (k, q) and `others` (n, k, q) are the derivatives
    at the poses, and `spread` is (JᵀJ)⁻¹ of the others.

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
    Return the (n,) largest mistakes of poses along the force that the test does not find [g].

    0 for poses that the others check well, infinite for poses that alone determine a parameter.

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
