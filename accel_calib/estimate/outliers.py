# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Fits without outliers, and mistakes in poses that the other poses do not locate or show.

The pose with the largest residual against a fit of the other poses (externally studentised, with
the moderated variance of `accel_calib.estimate.fit.Fit`) is removed, and so on, several times. The
generalised extreme studentised deviate test (Rosner 1983) at `LEVEL` then decides how many of them
are outliers. In this test several outliers do not mask each other. Between the removals the fit is
updated to first order. Above `_MANY` poses, outliers no longer mask each other, and all poses that
are extreme relative to the median are removed at once.

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

**Scatter.** Poses that repeat worse than their samples are no outliers. Few poses hardly tell a
mistake of one from a scatter of all, but a test with the measured noise finds a mistake in both
cases. With each outlier a mistake of up to 0.1 g of 2 % of the poses, outliers are only left out
if the likelihood of a scatter of all poses (`.scatter`), or of a factor on their noise, is not far
larger.

**Unchecked rows.** A pose with a leverage near 1 pulls the fit towards itself, so that its mistake
does not show. The largest mistake that the test for outliers does not find is
δ s / √(1 - leverage) (internal reliability, Baarda 1968), with δ the limit of the test in standard
deviations.

"""

from collections.abc import Callable, Iterator, Sequence
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
import scipy

from .closed_form import agreeing, start_of
from .equations import belief_beside, belief_in
from .fit import estimate, Fit, judge, NotConvergedError
from .scatter import beside_scatter, enough, scatter_of
from ..effects import MODELS, parameter_names
from ..table import Poses
from ..units import Floats, Indices

LEVEL = 0.007
"""Probability that a pose of a set without outliers is removed."""

LARGEST_SHARE = 0.25
"""Largest share of the poses that can be left out."""

_LEAST_OWN = 1e-6
"""1 - leverage below this: this pose alone determines a parameter, and cannot be tested."""

_LEAST_RELATIVE = 1e-15
"""Smallest variance of a residual relative to the largest one of a pose, against division by 0."""

_MANY = 200

_MEDIAN_OF_CHI2 = {1: 0.454936, 3: 2.365974}
"""Median of chi² by degrees of freedom."""

_ROUNDS = 6
"""Largest number of fits after which poses are left out or included."""

_SUSPICIOUS = 4.0
"""chi² per degree of freedom above which the fit of all poses is suspicious."""

_CLEARLY = 10.0
"""Ratio of the variances above which a pose that the robust fit leaves out is an outlier. The
choice among subsets makes small differences look significant, so a smaller ratio is ignored;
`.outliers` decides about the other poses."""

_EXPLAINED = 0.25
"""Smallest part of the residuals by the mistake of one row that a mistake of another row explains
to first order; other rows are no rivals."""

_KNOCKED = 0.02
"""Part of the poses that are outliers."""

_LARGEST_G = 0.1
"""Size of the mistake of an outlier in each of its equations [g]."""

_STRONG = 6.0
"""Smallest evidence for a scatter of all poses, against outliers (Kass and Raftery 1995:
strong)."""

_ALIKE = 0.02
"""Relative change of a scatter after which it is found."""

_LARGEST_LOG = 100.0
"""Largest logarithm of odds, against overflow."""

_HARDLY = 0.1
"""1 - leverage below this: the other poses hardly check the pose."""

_ALONE = 1e-9
"""1 - leverage below this: the pose alone determines a parameter."""


def outliers_among(residual: Floats, basis: Floats, rows: Indices, dof: Sequence[int], total: int,
                   *, noise_known: bool) -> list[Indices]:
    """
    Return the indices of the outliers among poses beside each of several fits.

    `residual` (f, n, k) are the residuals of each fit by pose, as in `ByPose`, and `basis`
    (f, n, k, q) orthonormal columns that span its derivative. Outliers are at most
    `LARGEST_SHARE` of all poses, and at most so many that the other equations identify them. `dof`
    (f,) are as in `variance_factor`; `total` includes the poses left out before.

    """
    most, out = int(rows.max()), total - len(rows)
    limits = [_limit(each + most * out, total, most) - out for each in dof]
    if max(limits) <= 0:
        return [np.zeros(0, np.intp)] * len(dof)
    own = np.eye(residual.shape[2]) - basis @ basis.swapaxes(2, 3)
    if len(rows) > _MANY:  # all at once, relative to the median
        found, belief = [], belief_in(noise_known)
        usual = np.where(rows == 1, _MEDIAN_OF_CHI2[1], _MEDIAN_OF_CHI2[3]) / rows
        for k, limit in enumerate(limits):
            squared = _squared(residual[k], own[k]) / rows
            scale = float(np.median(squared / usual))
            ratio = squared * (belief + dof[k]) / (belief + scale * dof[k])
            least = scipy.special.fdtri(np.arange(1, most + 1), max(belief + dof[k], 1.0),
                                        1.0 - LEVEL / len(rows))
            extreme = np.flatnonzero(ratio > least[rows - 1])
            largest = np.argsort(-ratio[extreme], kind='stable')[:max(limit, 0)]
            found.append(np.sort(extreme[largest]))
        return found
    flat = basis.reshape(len(basis), residual[0].size, -1)
    beside = residual.reshape(len(flat), -1, 1)
    residual = (beside - flat @ (flat.swapaxes(1, 2) @ beside)).reshape(residual.shape)
    pose, size = _removed_in_turn(residual, basis, own, rows, max(limits))
    whole = np.sum(residual ** 2, axis=(1, 2))
    return [_extreme(pose[k, :limit], size[k, :limit], rows, float(whole[k]), dof[k],
                     noise_known=noise_known) for k, limit in enumerate(limits)]


def _limit(spare: int, total: int, rows: int) -> int:
    """Return the largest number of poses to leave out, each with `rows` equations."""
    return max(min(int(LARGEST_SHARE * total), spare // (2 * rows)), 0)


def _extreme(pose: Indices, size: Floats, rows: Indices, whole: float, dof: int, *,
             noise_known: bool) -> Indices:
    """
    Return the outliers among the (k,) indices of poses that were removed in turn.

    `size` (k,) is the squared residual of each against the others, in units of its variance.
    `rows` (n,) are the numbers of equations of all poses, `whole` the sum of squared residuals and
    `dof` those of the start.

    """
    removed = np.cumsum(rows[pose])
    rss = np.maximum(whole - np.cumsum([0.0, *size]), 0.0)  # before each removal, and at the end

    def count(belief: float) -> int:
        left = np.maximum(belief + dof - removed, 1e-9)
        others = np.maximum(belief + rss[:-1] - size, 1e-300) / left
        chance = beyond(size / rows[pose] / others, rows[pose], left)
        found = np.flatnonzero(chance < LEVEL / (len(rows) - np.arange(len(pose))))
        return int(found[-1]) + 1 if len(found) else 0

    extreme = count(belief_in(noise_known))
    if extreme:
        left = dof - int(removed[extreme - 1])
        extreme = count(belief_beside(left, rss[extreme], noise_known))
    return np.sort(pose[:extreme])


def beyond(ratio: Floats, rows: Indices, dof: Floats | float) -> Floats:
    """Return the probability of a larger ratio of variances by chance (F distribution)."""
    return scipy.special.fdtrc(rows, np.maximum(dof, 1.0), ratio)


def _removed_in_turn(residual: Floats, basis: Floats, own: Floats, rows: Indices, most: int
                     ) -> tuple[Indices, Floats]:
    """
    Remove the most extreme pose repeatedly, and update each fit to first order.

    `own` (f, n, k, k) is I - leverage of each pose. Return the (f, most) indices of the poses, and
    their squared residuals against the others.

    """
    (fits, count, width), now = residual.shape, basis.shape[-1]
    each, one = np.arange(fits), np.eye(width)
    taken = np.empty((fits, now + most * width, count, width))  # orthonormal directions
    taken[:, :now] = np.moveaxis(basis, -1, 1)
    weight = np.repeat(1.0 / rows[np.newaxis], fits, axis=0)  # 0 for the poses removed
    pose, size = np.empty((fits, most), np.intp), np.empty((fits, most))
    for k in range(most):
        squared = _squared(residual, own)
        at = (squared * weight).argmax(axis=1)
        pose[:, k], size[:, k], weight[each, at] = at, squared[each, at], 0.0
        before = taken[:, :now]
        new = -(before[each, :, at].swapaxes(1, 2) @ before.reshape(fits, now, count * width))
        new.reshape(fits, width, count, width)[each, :, at] += one
        if width == 1:  # the root, whose square, transposed by itself, is the inverse
            root = 1.0 / np.sqrt(np.where(own[each, at] > 0.0, own[each, at], np.inf))
        else:
            scale, axes = np.linalg.eigh(own[each, at])
            scale = np.sqrt(np.where(scale > _LEAST_RELATIVE * scale[:, -1:], scale, np.inf))
            root = (axes / scale[:, np.newaxis]).swapaxes(-1, -2)
        new = root @ new
        towards = root @ residual[each, at][..., np.newaxis]
        residual = residual - (towards.swapaxes(1, 2) @ new).reshape(residual.shape)
        parts = new.reshape(fits, width, count, width)
        own = own - np.einsum('frnk,frnl->fnkl', parts, parts)
        taken[:, now:now + width] = parts
        now += width
    return pose, size


def _squared(residual: Floats, own: Floats) -> Floats:
    """Return the squared residual of each pose against the others; 0 if it cannot be tested."""
    if own.shape[-1] == 1:
        size, along = own[..., 0], residual
    else:
        size, axes = np.linalg.eigh(own)
        along = np.sum(axes * residual[..., np.newaxis], axis=-2)
    return np.sum(along ** 2 / np.where(size > _LEAST_OWN, size, np.inf), axis=-1)


def fit_norm(name: str, poses_g: Poses) -> tuple[Fit, Indices]:
    """
    Fit model 4, 7 or 10 to poses in g of unknown orientation, without the outliers.

    Return as `outliers_or_scatter`. The poses are at least as many as free parameters. Raise
    `NotConvergedError` if they are not on an ellipsoid.

    """
    return outliers_or_scatter(
        poses_g, lambda poses: _fit_norm(name, poses),
        lambda poses: estimate(start_of(name, poses.reading), poses))


def outliers_or_scatter(poses_g: Poses, without: Callable[[Poses], tuple[Fit, Indices]],
                        whole: Callable[[Poses], Fit]) -> tuple[Fit, Indices]:
    """
    Fit poses in g without the outliers, or beside a scatter that all of them have.

    Parameters
    ----------
    poses_g : Poses
        All poses, with the same number of equations each.
    without : callable
        Fits poses without the outliers; returns the fit and the indices of the poses used.
    whole : callable
        Fits all poses. Both may raise `NotConvergedError`.

    Returns
    -------
    Fit and (k,) array of int
        The fit, and the indices of the poses used. If they scatter beyond their noise, those of
        the fit state it (``own_scatter``).

    """
    found, everyone = without(poses_g), np.arange(len(poses_g))
    if not found[0].noise_known:
        return found
    best, least = _with_scatter(poses_g, without, *found)
    if len(found[1]) == len(poses_g):
        return best
    try:
        fit = whole(poses_g)
    except NotConvergedError:
        return best
    of_all, deviance = _with_scatter(poses_g, without, fit, everyone)
    return of_all if deviance < least - _STRONG else best


def _with_scatter(poses_g: Poses, without: Callable[[Poses], tuple[Fit, Indices]], fit: Fit,
                  kept: Indices) -> tuple[tuple[Fit, Indices], float]:
    """Return a fit, or that beside the scatter of its poses if it is better, and its deviance."""
    few = enough(len(poses_g))
    scatter = scatter_of(fit, few[kept])
    best, least = (fit, kept), scatter.without + _of_outliers(fit, kept, few)
    for _ in range(_ROUNDS):
        if not scatter.shows:
            return best, least
        size = scatter.size_g
        try:
            fit, kept = without(beside_scatter(poses_g, size))
        except NotConvergedError:
            return best, least
        scatter = scatter_of(judge(fit.model, poses_g.take(kept)), few[kept])
        if abs(scatter.size_g - size) <= _ALIKE * size:
            break
    deviance = scatter.deviance + _of_outliers(fit, kept, few)
    return ((fit, kept), deviance) if scatter.shows and deviance < least else (best, least)


def _of_outliers(fit: Fit, kept: Indices, few: NDArray[np.bool_]) -> float:
    """Return the deviance of the outliers among few poses: those that a fit does not keep."""
    each = math.log(_KNOCKED) + int(fit.by_pose.rows[0]) * math.log(
        math.sqrt(2.0 * math.pi) / _LARGEST_G)
    return -2.0 * each * (np.count_nonzero(few) - np.count_nonzero(few[kept]))


def _fit_norm(name: str, poses_g: Poses) -> tuple[Fit, Indices]:
    everyone = np.arange(len(poses_g))
    direct = _without_outliers(name, poses_g, everyone)
    if direct is not None and direct[0].chi2 <= _SUSPICIOUS * max(direct[0].dof, 1):
        return direct
    most = _most(name, len(poses_g))
    robust = None if most < 1 else _with_those_that_agree(
        name, poses_g, agreeing(name, poses_g, most))
    if robust is None:
        if direct is None:
            raise NotConvergedError
        return direct
    out = np.setdiff1d(everyone, robust[1])  # sorted by the residual below, the largest first
    away = np.abs(judge(robust[0].model, poses_g).residual[out])
    found, gross = direct, out[np.argsort(-away, kind='stable')]
    for count in range(len(gross) + 1):
        if found is not None and found[0].variance <= _CLEARLY * robust[0].variance:
            return found
        found = _without_outliers(name, poses_g, np.setdiff1d(everyone, gross[:count + 1]))
    return robust


def outliers(fit: Fit, total: int) -> Indices:
    """Return the outliers among the poses of a fit; `total` as in `outliers_among`."""
    data = fit.by_pose
    return outliers_among(data.residual[np.newaxis], data.basis[np.newaxis], data.rows, [fit.dof],
                          total, noise_known=fit.noise_known)[0]


def _without_outliers(name: str, poses_g: Poses, kept: Indices
                      ) -> tuple[Fit, Indices] | None:
    """Fit poses and leave out outliers until there are none; None if a fit does not converge."""
    fit = _fit(name, poses_g, kept)
    for _ in range(_ROUNDS):
        if fit is None or not len(out := outliers(fit, len(poses_g))):
            break
        kept = np.delete(kept, out)
        fit = _fit(name, poses_g, kept)
    if fit is None:
        return None
    if len(kept) < len(poses_g):
        return _with_those_that_agree(name, poses_g, kept) or (fit, kept)
    return fit, kept


def _with_those_that_agree(name: str, poses_g: Poses, kept: Indices
                           ) -> tuple[Fit, Indices] | None:
    """Include the poses that agree with a fit, leave out the others; None if too few agree."""
    tried: set[bytes] = set()
    while (fit := _fit(name, poses_g, kept)) is not None:
        tried.add(kept.tobytes())
        data = judge(fit.model, poses_g).by_pose
        leverage = np.einsum('nkp,pq,nkq->n', data.columns, fit.by_pose.spread, data.columns)
        inside = np.isin(np.arange(len(poses_g)), kept)
        spare = np.where(inside, np.maximum(1.0 - leverage, 1e-6), 1.0 + leverage)
        belief = belief_beside(fit.dof, fit.chi2, fit.noise_known)
        size = data.residual[:, 0] ** 2 / spare / ((belief + fit.chi2) / (belief + fit.dof))
        agreeing = np.flatnonzero(
            beyond(size, data.rows, belief + fit.dof) >= LEVEL / len(poses_g))
        if len(poses_g) - len(agreeing) > _most(name, len(poses_g)):
            return None
        if agreeing.tobytes() in tried or len(tried) == _ROUNDS:
            return fit, kept
        kept = agreeing
    return None


def _fit(name: str, poses_g: Poses, kept: Indices) -> Fit | None:
    now = poses_g.take(kept)
    try:
        return estimate(start_of(name, now.reading), now)
    except NotConvergedError:
        return None


def _most(name: str, count: int) -> int:
    """Return the largest number of poses that can be left out."""
    free = len(parameter_names(MODELS[name].effects))
    return _limit(count - free, count, 1)


class Rival(NamedTuple):
    """
    A pose that may be wrong `instead` of one that was `left_out`; both are indices.

    `fit` is without the rival, and `odds` its probability over that of the other hypothesis.

    """

    left_out: int
    instead: int
    fit: Fit
    odds: float


def rivals(fit: Fit, kept: Indices, out: Indices, poses_g: Poses,
           refit: Callable[[Poses], Fit]) -> tuple[Rival, ...]:
    """
    Return the poses that may be wrong instead of those that were left out.

    `kept` and `out` are indices among `poses_g`, without copies: of the poses of the fit, and of
    those left out. `refit` fits the same model to other poses, and may raise `NotConvergedError`.

    """
    found = []
    belief = belief_beside(fit.dof, fit.chi2, fit.noise_known)
    for wrong, instead in _look_alikes(fit, kept, out, poses_g):
        others = np.union1d(np.setdiff1d(kept, [instead]), [wrong])
        try:
            rival = refit(poses_g.take(others))
        except NotConvergedError:
            continue
        difference = _log_probability(rival, belief) - _log_probability(fit, belief)
        odds = float(np.exp(min(difference, _LARGEST_LOG)))
        if odds >= LEVEL:
            found.append(Rival(wrong, instead, rival, odds))
    return tuple(found)


def covariance_with(fit: Fit, found: tuple[Rival, ...]) -> Floats:
    """Return the (p, p) covariance of a fit with the difference to each rival, by its odds."""
    spread = fit.covariance
    for rival in found:
        away = rival.fit.model.vector - fit.model.vector
        spread = spread + min(rival.odds, 1.0) * np.outer(away, away)
    return spread


def _look_alikes(fit: Fit, kept: Indices, out: Indices, poses_g: Poses
                 ) -> Iterator[tuple[int, int]]:
    """Yield the poses left out, each with a pose kept whose mistake would look like its own."""
    if not len(out):
        return
    data = judge(fit.model, poses_g.take(np.concatenate([kept, out])), fit.ties).by_pose
    spread, columns = fit.by_pose.spread, data.columns
    pull = np.linalg.eigvalsh(columns @ spread @ np.swapaxes(columns, 1, 2))[:, -1]
    inside = pull[:len(kept)] / np.maximum(1.0 - pull[:len(kept)], _ALONE)
    for place in len(kept) + np.flatnonzero(pull[len(kept):] * np.max(inside) >= _EXPLAINED):
        # By Cauchy's inequality, the mistakes of the other poses have no look-alike. Of each pose
        # kept, the part of the residuals by the mistake of this pose that its own explains:
        own, others = columns[place], columns[:len(kept)]
        onto = spread @ own.T
        inverse = np.linalg.inv(np.eye(len(own)) + own @ onto)
        beside = spread - onto @ inverse @ onto.T
        left = np.eye(len(own)) - others @ beside @ np.swapaxes(others, 1, 2)
        moved = others @ (beside @ (own.T @ data.residual[place]))
        solved = np.linalg.pinv(left, _ALONE, hermitian=True) @ moved[:, :, np.newaxis]
        part = np.sum(moved * solved[:, :, 0], axis=1) / max(
            data.residual[place] @ inverse @ data.residual[place], 1e-300)
        for index in kept[part >= _EXPLAINED]:
            yield int(out[place - len(kept)]), int(index)


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
    own = fit.by_pose.own
    least = own[:, 0, 0] if own.shape[1] == 1 else np.linalg.eigvalsh(own)[:, 0]
    size = np.zeros(len(least))
    weak = np.flatnonzero(least < _HARDLY)
    if len(weak):
        dof = max(belief_in(fit.noise_known) + fit.dof - 1.0, 1.0)
        limit = np.sqrt(fit.variance) * float(
            scipy.special.stdtrit(dof, 1.0 - LEVEL / len(least) / 2.0))
        with np.errstate(divide='ignore'):
            size[weak] = limit * fit.equations.scale[weak] / np.sqrt(
                np.where(least[weak] > _ALONE, least[weak], 0.0))
    return size
