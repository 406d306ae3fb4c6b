# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Outliers: poses that were knocked or not still.

The pose with the largest residual against a fit of the other poses (externally studentised, with
the moderated variance of `accel_calib.estimate.fit.Fit`) is removed, and so on, several times. The
generalised extreme studentised deviate test (Rosner 1983) at `LEVEL` then decides how many of them
are outliers. In this test several outliers do not mask each other. Between the removals the fit is
updated to first order. Above `_MANY` poses, outliers no longer mask each other, and all poses that
are extreme relative to the median are removed at once.

A gross outlier can distort the first fit. `fit_norm` then starts from poses that agree.

**Gross outliers.** Fits that are robust against gross outliers.

A single wrong row, such as zeros or a reading in another unit, can distort the closed form and the
fit of all poses so far that the residuals do not show which row is wrong. If the fit of all poses
is suspicious, subsets are therefore fitted in closed form. The subset with the smallest trimmed
squares (least trimmed squares, Rousseeuw 1984) starts a fit, which then includes every pose that
agrees with it.

**Copies.** Rows of a table that are one measurement, entered several times.

Copies agree with each other far better than their noise allows. Counted as separate poses, they
would make the noise seem smaller than it is, and the other poses would look like outliers. They
count as one pose. Two rests in the same orientation are no copies: by chance, only one pair in
5000 differs by less than `_ALIKE` of the noise on all axes.

"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product
from math import comb

import numpy as np
from numpy.typing import NDArray

from .closed_form import closed_form
from .equations import belief_in, noise_of
from .fit import ByPose, estimate, Fit, judge
from .least_squares import NotConvergedError
from ..effects import linear_values, Model, MODELS, parameter_names
from ..table import Floats, Poses

LEVEL = 0.007
"""Probability that a pose of a set without outliers is removed."""

LARGEST_SHARE = 0.25
"""Largest share of the poses that can be left out."""

_LEAST_OWN = 1e-6
"""1 - leverage below this: this pose alone determines a parameter, and cannot be tested."""

_ALIKE = 0.1
"""Largest difference between the readings of copies, relative to the noise of a pose. Differences
up to half of it always count as none."""

_EQUAL_G = 1e-7
"""The same if the noise is not known [g]."""

_DECIMALS = 7
"""Number of decimals in which the context of copies is equal."""

_OF_READING = ('reading', 'std', 'count', 'label')
"""Columns that are not context."""

_MANY = 200

_MEDIAN_OF_CHI2 = {1: 0.454936, 3: 2.365974}
"""Median of chi² by degrees of freedom."""

_DOUBT_BELOW = 0.01
"""Probability of the chi² of the poses left below which they contradict the measured noise."""

_DOUBTED = 1.0
"""Degrees of freedom that contradicted noise counts as."""


def originals(poses_g: Poses) -> NDArray[np.intp]:
    """
    Find the copies among poses.

    Parameters
    ----------
    poses_g : Poses
        Poses in g. Context, such as the temperature, is compared, too.

    Returns
    -------
    (n,) array of int
        Index of the first pose that each pose is equal to; its own index if it is not a copy.

    """
    found, noise = np.arange(len(poses_g)), noise_of(poses_g)
    cell = max(_EQUAL_G, 0.0 if noise is None else _ALIKE * float(np.median(noise)))
    place = poses_g.reading / cell
    if np.all(np.diff(np.sort(place[:, 0])) > 1.0):
        return found
    context = [values.round(_DECIMALS) for key, values in poses_g.columns.items()
               if key not in _OF_READING]
    # Two readings half a cell apart are in the same cell of at least one of these grids.
    for shift in product((0.0, 0.5), repeat=3):
        rows = np.column_stack([np.floor(place + shift), *context])
        _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        found = np.minimum(found, first[which.ravel()])
    return found[found]


@dataclass(frozen=True)
class Outliers:
    """Poses to leave out, as (d,) indices among the poses of a fit, and the chi² of the others."""

    poses: NDArray[np.intp]
    chi2: float


def outliers(fit: Fit, total: int) -> Outliers:
    """
    Find the outliers among the poses of a fit.

    Parameters
    ----------
    fit : Fit
        Fit to the poses that are kept so far.
    total : int
        Number of poses before any was left out.

    Returns
    -------
    Outliers
        At most `LARGEST_SHARE` of all poses, and at most so many that the other equations identify
        them.

    """
    return outliers_among(fit.by_pose, fit.chi2, fit.dof, total, noise_known=fit.noise_known)


def outliers_among(data: ByPose, chi2: float, dof: int, total: int, *, noise_known: bool
                   ) -> Outliers:
    """
    Find the outliers among poses, given their equations at a fit.

    Parameters
    ----------
    data : ByPose
        The equations.
    chi2 : float
        Sum of the squared residuals.
    dof : int
        Number of equations minus number of fitted values.
    total : int
        Number of poses before any was left out.
    noise_known : bool
        Whether the noise was measured.

    """
    rows = int(data.rows.max())
    out = total - len(data.rows)
    limit = _limit(dof + rows * out, total, rows) - out
    if limit <= 0:
        return Outliers(np.zeros(0, np.intp), chi2)
    if len(data.rows) > _MANY:
        return _far_out(data, chi2, dof, limit, noise_known=noise_known)
    order = _removed_in_turn(data, dof, limit)
    count = order.extreme(belief_in(noise_known))
    if count:
        left = dof - int(np.sum(order.rows[:count]))
        count = order.extreme(belief_beside(left, order.rss[count], noise_known))
    return Outliers(np.sort(order.pose[:count]), float(order.rss[count]))


def belief_beside(dof: int, chi2: float, noise_known: bool) -> float:
    """Return the degrees of freedom that the noise counts as, given the chi² of the poses kept."""
    from scipy.special import chdtrc

    if noise_known and chdtrc(max(dof, 1), chi2) < _DOUBT_BELOW:
        return _DOUBTED
    return belief_in(noise_known)


def _limit(spare: int, total: int, rows: int) -> int:
    """Return the largest number of poses to leave out, each with `rows` equations."""
    return max(min(int(LARGEST_SHARE * total), spare // (2 * rows)), 0)


@dataclass(frozen=True)
class _Removed:
    """
    Poses removed in turn.

    Parameters
    ----------
    pose, rows : (k,) array of int
        Index of the removed pose, and its number of equations.
    size : (k,) array
        Squared residual of this pose against the others, in units of its variance.
    rss : (k + 1,) array
        Sum of squared residuals before each removal, and at the end.
    dof, count : int
        Degrees of freedom and number of poses at the start.

    """

    pose: NDArray[np.intp]
    rows: NDArray[np.int64]
    size: Floats
    rss: Floats
    dof: int
    count: int

    def extreme(self, belief: float) -> int:
        """Return how many of the removed poses are outliers."""
        removed = np.concatenate([[0], np.cumsum(self.rows)])
        dof = np.maximum(belief + self.dof - removed[1:], 1e-9)
        others = np.maximum(belief + self.rss[:-1] - self.size, 1e-300) / dof
        chance = beyond(self.size / self.rows / others, self.rows, dof)
        found = np.flatnonzero(chance < LEVEL / (self.count - np.arange(len(self.pose))))
        return int(found[-1]) + 1 if len(found) else 0


def beyond(ratio: Floats, rows: NDArray[np.int64], dof: Floats | float) -> Floats:
    """Return the probability of a larger ratio of variances by chance (F distribution)."""
    from scipy.special import fdtrc

    chance: Floats = fdtrc(rows, np.maximum(dof, 1.0), ratio)
    return chance


def _removed_in_turn(data: ByPose, dof: int, most: int) -> _Removed:
    """Remove the most extreme pose repeatedly, and update the fit to first order."""
    spread, flat = data.spread, data.flat
    count, rows = data.residual.shape
    residual = data.residual - (flat @ (spread @ data.downhill)).reshape(count, rows)
    own, left = data.own(spread), np.ones(count, bool)
    poses, sizes = [], []
    rss = [float(np.sum(residual ** 2))]
    for _ in range(most):
        size = _squared(own, residual) * left
        at = int(np.argmax(size / data.rows))
        poses.append(at)
        sizes.append(float(size[at]))
        rss.append(max(rss[-1] - sizes[-1], 0.0))
        inverse = 1.0 / own[at] if rows == 1 else np.linalg.pinv(own[at])
        onto = spread @ data.columns[at].T
        along = flat @ onto
        residual = residual + (along @ (inverse @ residual[at])).reshape(count, rows)
        spread = spread + onto @ inverse @ onto.T
        along = along.reshape(count, rows, rows)
        own = own - (along ** 2 * inverse if rows == 1
                     else along @ inverse @ np.swapaxes(along, 1, 2))
        left[at] = False
    return _Removed(np.array(poses, np.intp), data.rows[poses], np.array(sizes), np.array(rss),
                    dof, len(left))


def _squared(own: Floats, residual: Floats) -> Floats:
    """Return the squared residual of each pose against the others; 0 if it cannot be tested."""
    if residual.shape[1] == 1:
        alone = own[:, 0, 0]
        return np.where(alone > _LEAST_OWN,
                        residual[:, 0] ** 2 / np.maximum(alone, _LEAST_OWN), 0.0)
    size, axes = np.linalg.eigh(own)
    along = (np.swapaxes(axes, 1, 2) @ residual[:, :, np.newaxis])[:, :, 0]
    testable = size > _LEAST_OWN
    squares = np.where(testable, along ** 2 / np.where(testable, size, 1.0), 0.0)
    return np.sum(squares, axis=1)


def _far_out(data: ByPose, chi2: float, dof: int, limit: int, *, noise_known: bool
             ) -> Outliers:
    """Find outliers among many poses, all at once, relative to the median."""
    alone = _squared(data.own(data.spread), data.residual)
    size = alone / data.rows
    usual = np.array([_MEDIAN_OF_CHI2[int(rows)] / rows for rows in data.rows])
    belief = belief_in(noise_known)
    scale = float(np.median(size / usual))
    size = size * (belief + dof) / (belief + scale * dof)
    extreme = beyond(size, data.rows, belief + dof) < LEVEL / len(size)
    largest = np.argsort(-size, kind='stable')[:limit]
    found = np.sort(largest[extreme[largest]])
    return Outliers(found, max(chi2 - float(np.sum(alone[found])), 0.0))


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


def fit_norm(name: str, poses_g: Poses) -> tuple[Fit, NDArray[np.intp]]:
    """
    Fit a model to poses of unknown orientation, without the outliers.

    Parameters
    ----------
    name : {'4', '7', '10'}
        The model.
    poses_g : Poses
        Poses in g, at least as many as free parameters.

    Returns
    -------
    Fit, (k,) array of int
        The fit, and the indices of the poses used.

    Raises
    ------
    NotConvergedError
        If the poses are not on an ellipsoid.

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
    noise = noise_of(poses_g)
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
