# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Fits without outliers or beside a scatter, and mistakes that the other poses do not locate or show.

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

**Scatter.** Poses that repeat worse than their samples are no outliers: they have a variance in
common. The noise of a mean falls with the number of samples, but what differs from pose to pose
does not: the sensor settles, warms up, is pressed against the table. With σ the noise of the mean,
the variance of a reading is then σ² + τ² with one τ for all poses, and not λ σ² as in
`.equations`. If the noise of the poses differs, the quiet ones would have far too much weight.
Both hypotheses are judged by the restricted likelihood (Patterson and Thompson 1971). With e the
residuals, B the derivatives by the values [g], and W the inverse of the variances, twice its
negative logarithm is

    log |W⁻¹| + log |BᵀWB| + min_k (e - B k)ᵀW (e - B k)

λ is at least 1. τ relative to the median noise, and √(λ - 1), have the prior of Cauchy (Gelman
2006): a scatter of more than a few times the noise is less probable.

Few poses hardly tell a mistake of one from a scatter of all, but a test with the measured noise
finds a mistake in both cases. With each outlier a mistake of up to 0.1 g of 2 % of the poses,
outliers are only left out if the likelihood of a scatter of all poses, or of a factor on their
noise, is not far larger.

**Unchecked rows.** A pose with a leverage near 1 pulls the fit towards itself, so that its mistake
does not show. The largest mistake that the test for outliers does not find is
δ s / √(1 - leverage) (internal reliability, Baarda 1968), with δ the limit of the test in standard
deviations.

"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
import scipy

from .closed_form import agreeing, start_of
from .equations import belief_in
from .fit import estimate, Fit, judge, NotConvergedError
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

_POSITIVE = 2.0
"""Smallest evidence for a scatter (Kass and Raftery 1995: positive)."""

_USUAL = 3.0
"""Scale of the prior of τ, relative to the median noise, and of √(λ - 1)."""

_TRIED = np.arange(-7.0, 7.1, 0.25)
"""Logarithms of τ relative to the median noise, and of √(λ - 1), that are tried. Between them, the
deviance is nearly a parabola."""

_NO_SIZE = 1e-12
"""Relative singular value below which columns have no direction of their own."""

_ENOUGH = 1000
"""Number of poses from which τ is estimated; more are not needed."""

_LARGEST_LOG = 100.0
"""Largest logarithm of odds, against overflow."""

_HARDLY = 0.1
"""1 - leverage below this: the other poses hardly check the pose."""

_ALONE = 1e-9
"""1 - leverage below this: the pose alone determines a parameter."""


class Scatter(NamedTuple):
    """
    The size of a scatter τ [g], 0 if there is none, and how well it explains the residuals.

    `deviance` is twice the negative logarithm of its likelihood, and `without` that of λ.

    """

    size_g: float
    deviance: float
    without: float

    @property
    def evidence(self) -> float:
        """Return twice the logarithm of the ratio of the likelihoods of τ and λ."""
        return self.without - self.deviance

    @property
    def shows(self) -> bool:
        return self.evidence > _POSITIVE


def beside_scatter(poses_g: Poses, size_g: float) -> Poses:
    """Return poses with a scatter [g] in addition to their noise."""
    return poses_g.with_columns(own_scatter=np.full(poses_g.reading.shape, size_g))


def with_scatter_of(fit: Fit, poses_g: Poses) -> Poses:
    """Return poses with the scatter that those of a fit state; unchanged if they state none."""
    if 'own_scatter' not in fit.poses_g:
        return poses_g
    return beside_scatter(poses_g, float(fit.poses_g['own_scatter'][0, 0]))


def enough(count: int) -> NDArray[np.bool_]:
    """Return which of `count` poses suffice for a scatter."""
    return np.arange(count) % max(-(-count // _ENOUGH), 1) == 0


def scatter_of(fit: Fit, among: NDArray[np.bool_] | None = None) -> Scatter:
    """
    Return the scatter of the poses of a fit; none if their noise is not known.

    It is estimated from the poses `among` them, (n,); fits are only compared by the same poses.

    """
    among = enough(len(fit.poses_g)) if among is None else among
    few = among[fit.equations.pose]
    sigma = fit.equations.scale[fit.equations.pose[few]]
    basis, sizes, _ = np.linalg.svd(fit.columns[few] * sigma[:, np.newaxis], full_matrices=False)
    onto = basis[:, sizes > _NO_SIZE * np.max(sizes, initial=0.0)]
    count = len(sigma) - onto.shape[1]
    if not fit.noise_known or count < 1:
        return Scatter(0.0, 0.0, 0.0)
    middle = float(np.median(sigma))
    more = np.append(0.0, (middle * np.exp(_TRIED)) ** 2)
    # The (r,) logarithms of the determinants, and weighted squares, of the module: from the (m,)
    # residual and an orthonormal basis (m, q) of the derivatives [g], and (r, m) variances.
    residual = fit.residual[few] * sigma
    variance = sigma ** 2 + more[:, np.newaxis]
    weight, width = 1.0 / variance, onto.shape[1]
    products = (onto[:, :, np.newaxis] * onto[:, np.newaxis]).reshape(len(onto), width ** 2)
    normal = (weight @ products).reshape(len(weight), width, width)
    side = (residual * weight) @ onto
    explained = np.sum(side * np.linalg.solve(normal, side[..., np.newaxis])[..., 0], axis=1)
    size = np.sum(np.log(variance), axis=1) + np.linalg.slogdet(normal)[1]
    squares = weight @ residual ** 2 - explained
    nothing = float(size[0] + squares[0])
    if squares[0] <= count:
        return Scatter(0.0, nothing, nothing)
    prior = 2.0 * np.log1p((np.exp(_TRIED) / _USUAL) ** 2)
    factor = 1.0 + np.exp(2.0 * _TRIED)
    without = _find_lowest(size[0] + count * np.log(factor) + squares[0] / factor + prior)[1]
    log, least = _find_lowest(size[1:] + squares[1:] + prior)
    return Scatter(middle * float(np.exp(log)), least, min(nothing, without))


def _find_lowest(deviance: Floats) -> tuple[float, float]:
    """Return where in `_TRIED` a deviance is lowest, and its value there."""
    at = int(np.clip(np.argmin(deviance), 1, len(deviance) - 2))
    before, here, after = deviance[at - 1:at + 2]
    slope, bend = (after - before) / 2.0, max(before - 2.0 * here + after, 1e-12)
    shift = float(np.clip(-slope / bend, -1.0, 1.0))
    step = float(_TRIED[1] - _TRIED[0])
    return (float(_TRIED[at]) + shift * step,
            float(here + slope * shift + bend * shift ** 2 / 2.0))


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
    limits = [max(min(int(LARGEST_SHARE * total), (each + most * out) // (2 * most)) - out, 0)
              for each in dof]
    if max(limits) == 0:
        return [np.zeros(0, np.intp)] * len(dof)
    own, found = np.eye(residual.shape[2]) - basis @ basis.swapaxes(2, 3), []
    if len(rows) > _MANY:  # all at once, relative to the median
        belief = belief_in(noise_known)
        usual = scipy.special.chdtri(rows, 0.5) / rows  # the median of chi²
        for k, limit in enumerate(limits):
            squared = _squared(residual[k], own[k]) / rows
            scale = float(np.median(squared / usual))
            ratio = squared * (belief + dof[k]) / (belief + scale * dof[k])
            least = scipy.special.fdtri(np.arange(1, most + 1), max(belief + dof[k], 1.0),
                                        1.0 - LEVEL / len(rows))
            extreme = np.flatnonzero(ratio > least[rows - 1])
            largest = np.argsort(-ratio[extreme], kind='stable')[:limit]
            found.append(np.sort(extreme[largest]))
        return found
    flat = basis.reshape(len(basis), residual[0].size, -1)
    beside = residual.reshape(len(flat), -1, 1)
    residual = (beside - flat @ (flat.swapaxes(1, 2) @ beside)).reshape(residual.shape)
    poses, sizes = _remove_in_turn(residual, basis, own, rows, max(limits))
    whole = np.sum(residual ** 2, axis=(1, 2))
    for k, limit in enumerate(limits):
        pose, size, count, belief = poses[k, :limit], sizes[k, :limit], 0, belief_in(noise_known)
        removed = np.cumsum(rows[pose])
        rss = np.maximum(whole[k] - np.cumsum([0.0, *size]), 0.0)  # before each, and at the end
        for _ in range(2):
            left = np.maximum(belief + dof[k] - removed, 1e-9)
            others = np.maximum(belief + rss[:-1] - size, 1e-300) / left
            chance = scipy.special.fdtrc(rows[pose], np.maximum(left, 1.0),
                                         size / rows[pose] / others)
            rare = np.flatnonzero(chance < LEVEL / (len(rows) - np.arange(limit)))
            count = int(rare[-1]) + 1 if len(rare) else 0
            if not count:
                break
            # Again, with the belief that the poses left support.
            belief = belief_in(noise_known, dof[k] - int(removed[count - 1]), rss[count])
        found.append(np.sort(pose[:count]))
    return found


def _remove_in_turn(residual: Floats, basis: Floats, own: Floats, rows: Indices, most: int
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


def fit_robust(name: str, poses_g: Poses, determined: Callable[[Poses], bool] = lambda left: True
               ) -> tuple[Fit, Indices]:
    """
    Fit a model to poses in g without the outliers, or beside a scatter that all of them have.

    Parameters
    ----------
    name : {'4', '7', '10', '12'}
        The model; 12 is for known orientations, and the others for unknown ones.
    poses_g : Poses
        All poses, at least as many as determine the model.
    determined : callable
        Whether poses that are left determine the model; others are not left out.

    Returns
    -------
    Fit and (k,) array of int
        The fit, and the indices of the poses used. If they scatter beyond their noise, those of
        the fit state it (``own_scatter``).

    Raises
    ------
    NotConvergedError
        If the poses are not on an ellipsoid.

    """
    found = _without_outliers(name, poses_g, determined)
    if not found[0].noise_known:
        return found
    best, least = _with_scatter(name, poses_g, determined, found)
    if len(found[1]) == len(poses_g) or (whole := _fit(name, poses_g)) is None:
        return best
    everyone = np.arange(len(poses_g))
    of_all, deviance = _with_scatter(name, poses_g, determined, (whole, everyone))
    return of_all if deviance < least - _STRONG else best


def _with_scatter(name: str, poses_g: Poses, determined: Callable[[Poses], bool],
                  best: tuple[Fit, Indices]) -> tuple[tuple[Fit, Indices], float]:
    """Return a fit, or that beside the scatter of its poses if it is better, and its deviance."""
    (fit, kept), few = best, enough(len(poses_g))
    of_outlier = -2.0 * (math.log(_KNOCKED) + int(fit.by_pose.rows[0]) * math.log(
        math.sqrt(2.0 * math.pi) / _LARGEST_G))
    scatter = scatter_of(fit, few[kept])
    least = scatter.without + of_outlier * np.count_nonzero(np.delete(few, kept))
    for _ in range(_ROUNDS):
        if not scatter.shows:
            return best, least
        size = scatter.size_g
        try:
            fit, kept = _without_outliers(name, beside_scatter(poses_g, size), determined)
        except NotConvergedError:
            return best, least
        scatter = scatter_of(judge(fit.model, poses_g.take(kept)), few[kept])
        if abs(scatter.size_g - size) <= _ALIKE * size:
            break
    deviance = scatter.deviance + of_outlier * np.count_nonzero(np.delete(few, kept))
    return ((fit, kept), deviance) if scatter.shows and deviance < least else (best, least)


def _without_outliers(name: str, poses_g: Poses, determined: Callable[[Poses], bool]
                      ) -> tuple[Fit, Indices]:
    """Fit a model without the outliers, even if they distort the fit of all poses."""
    everyone, form = np.arange(len(poses_g)), MODELS[name]
    spare = len(poses_g) - len(parameter_names(form.effects))
    most = min(int(LARGEST_SHARE * len(poses_g)), spare // 2)
    direct, robust = _leave_out(name, poses_g, everyone, most, determined), None
    suspicious = direct is None or direct[0].chi2 > _SUSPICIOUS * max(direct[0].dof, 1)
    if suspicious and most > 0 and not form.known_orientation:
        robust = _with_those_that_agree(name, poses_g, agreeing(name, poses_g, most), most)
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
        left = np.setdiff1d(everyone, gross[:count + 1])
        found = _leave_out(name, poses_g, left, most, determined)
    return robust


def _leave_out(name: str, poses_g: Poses, kept: Indices, most: int,
               determined: Callable[[Poses], bool]) -> tuple[Fit, Indices] | None:
    """Fit poses and leave out outliers until there are none; None if a fit does not converge."""
    fit = _fit(name, poses_g.take(kept))
    for _ in range(_ROUNDS):
        if fit is None or not len(out := outliers(fit, len(poses_g))):
            break
        left = np.delete(kept, out)
        if not determined(poses_g.take(left)):
            break
        fit, kept = _fit(name, poses_g.take(left)), left
    if fit is None:
        return None
    if len(kept) == len(poses_g) or MODELS[name].known_orientation:
        return fit, kept
    return _with_those_that_agree(name, poses_g, kept, most) or (fit, kept)


def outliers(fit: Fit, total: int) -> Indices:
    """Return the outliers among the poses of a fit; `total` as in `outliers_among`."""
    data = fit.by_pose
    return outliers_among(data.residual[np.newaxis], data.basis[np.newaxis], data.rows, [fit.dof],
                          total, noise_known=fit.noise_known)[0]


def _with_those_that_agree(name: str, poses_g: Poses, kept: Indices, most: int
                           ) -> tuple[Fit, Indices] | None:
    """Include the poses that agree with a fit; None if more than `most` do not."""
    tried: set[bytes] = set()
    while (fit := _fit(name, poses_g.take(kept))) is not None:
        tried.add(kept.tobytes())
        data = judge(fit.model, poses_g).by_pose
        leverage = np.einsum('nkp,pq,nkq->n', data.columns, fit.by_pose.spread, data.columns)
        inside = np.isin(np.arange(len(poses_g)), kept)
        spare = np.where(inside, np.maximum(1.0 - leverage, 1e-6), 1.0 + leverage)
        belief = belief_in(fit.noise_known, fit.dof, fit.chi2)
        size = data.residual[:, 0] ** 2 / spare / ((belief + fit.chi2) / (belief + fit.dof))
        chance = scipy.special.fdtrc(data.rows, max(belief + fit.dof, 1.0), size)
        agree = np.flatnonzero(chance >= LEVEL / len(poses_g))
        if len(poses_g) - len(agree) > most:
            return None
        if agree.tobytes() in tried or len(tried) == _ROUNDS:
            return fit, kept
        kept = agree
    return None


def _fit(name: str, poses_g: Poses) -> Fit | None:
    """Fit a model to all of these poses; None if the fit does not converge."""
    try:
        return estimate(start_of(name, poses_g.reading), poses_g)
    except NotConvergedError:
        return None


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
    found: list[Rival] = []
    belief = belief_in(fit.noise_known, fit.dof, fit.chi2)
    probable = _log_probability(fit, belief)
    for wrong, instead in _look_alikes(fit, kept, out, poses_g):
        others = np.union1d(np.setdiff1d(kept, [instead]), [wrong])
        with suppress(NotConvergedError):
            rival = refit(poses_g.take(others))
            difference = _log_probability(rival, belief) - probable
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
