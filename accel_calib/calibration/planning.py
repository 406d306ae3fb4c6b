# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Which pose to take next: for a fit, for a session that leads a person, and for a refinement.

Poses that do not determine a model (`.directions`) are refused. The error contains the reason, the
parameters that are undetermined by themselves, the poses to add, and the largest of the smaller
models that the poses determine.

**Next pose.** It is one of the 26 orientations that a person can set by eye: the 6 faces, 12 edges
and 8 corners of the sensor. It is the orientation that increases the determinant of M plus the
information of one pose spread over the whole sphere most (D-optimal design, Fedorov 1972). The
latter represents the poses to come; without it the first poses would be chosen as if they were the
last. `benchmarks/poses.py` compares this order with others.

With n well spread poses, the error of |force| is the noise of a pose times √(p / n), RMS over the
sphere. Another pose reduces it by the factor 1 / 2n. More poses no longer help if the next pose
reduces the error by less than `_LEAST_HELP` and the dilution is below `_GOOD_DILUTION`.

**Plan of a refinement.** A contest is a named effect with the rivals that the poses leave a
probability. The model with each of them is fitted to the poses. A candidate is a direction at a
temperature, time or supply. There, model k predicts the equation of the pose with the mean m_k and
the variance λ (1 + x_k C_k x_kᵀ): x_k is the derivative by the values, C_k their covariance from
the poses so far, and λ the variance of a pose in units of its noise. If model j is right, the
candidate is expected to change the logarithm of the odds of j to k by

    (m_j - m_k)² / (2 λ (1 + x_k C_k x_kᵀ))

The next pose is the candidate with the largest mean of this over all pairs, weighted by their
probabilities (Box and Hill 1967). Means and covariances are then updated as if the pose had been
taken, and the next one is chosen, until the expected probability of the right effect is large.

The expected probability is the mean over readings that the models predict, drawn at random. The
values of the models are uncertain in them, too, so it is what `refine` will report on average.

"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
import math

import numpy as np

from .calibration import ORIENTED
from .directions import (
    determines, dilution, dilution_of, directions_of, error_left_in, ideal_of, identifiability,
    information_of, NORM_MODELS, poses_needed, rows_of, shape_words, WEAK_DILUTION)
from ..effects import EffectKey, entry_of, Model
from ..errors import RefusedFitError
from ..estimate import Fit, fit_sphere, judge, kinds, pose_noise
from ..finding import Finding
from ..geometry import (
    ATTITUDES, axes_of_signs, coverage, OVER_THE_SPHERE, spread_directions, TAKEN, words_of)
from ..statistics import over_axes
from ..table import Floats, is_quantity, Poses
from ..text import enumerated
from ..units import MG, Units

_LEAST_HELP = 0.03
"""Smallest useful reduction of the error by a pose; 17 well spread poses reach it."""

_GOOD_DILUTION = 3.0
"""More poses are requested while the dilution is larger."""

_SPARE = 3
"""Poses beyond the fewest that determine a model, so that the fit can be checked."""

_FEWEST_NATIVE = 4
"""Smallest number of poses to estimate the centre of native readings."""

VARIED = ('temperature', 'supply_voltage', 'time', 'std')
"""Context that a plan can vary, by column; it can vary quantities, too."""

MOST_POSES = 6
"""Largest number of poses of a plan."""

_LEAST_GAIN = 0.02
"""Smallest useful change of the logarithm of the odds."""

_MOST_GAIN = 6.0
"""Larger changes of the logarithm of the odds count as this one: the effect is then certain."""

_AS_GOOD = 0.95
"""Of candidates whose gain is this part of the best one, the easiest is taken."""

_COLDEST, _WARMEST = -20.0, 70.0
"""Range of the temperatures that are asked for [°C], unless the poses were outside of it."""

_BEYOND = 0.5
"""Part of the range of the poses by which temperatures exceed it on each side."""

_WAITS = (0.5, 1.0, 2.0)
"""Times after the last pose, in durations of the session."""

ENOUGH = 0.95
"""Expected probability of the right effect at which a plan ends."""


@dataclass(frozen=True)
class PlannedPose:
    """
    One pose of the plan of a refinement.

    Parameters
    ----------
    up : tuple of float
        Direction to point up, a unit vector in the sensor axes.
    context : mapping of str to float
        What else to set, by column of `accel_calib.table.COLUMNS`: ``temperature`` [°C],
        ``supply_voltage`` [V], ``std`` [g], and ``time`` as the wait after the last pose [s].
    separates : tuple of EffectKey
        The named effect and its rivals.
    expected : float
        Expected probability of the right one of them after this pose and those before it.

    """

    up: tuple[float, ...]
    context: Mapping[str, float]
    separates: tuple[EffectKey, ...]
    expected: float


@dataclass(frozen=True)
class NextPose:
    """
    The pose to take next, or none.

    Parameters
    ----------
    direction : (3,) array or None
        Direction to point up, a unit vector in the sensor axes; None: more poses no longer help.
    error : float
        Expected error of |force| after a fit to the poses so far, RMS over the sphere, relative
        to the noise of a pose; infinite if the poses do not determine a parameter.
    total : int
        Number of poses that determine the model well, if each is the one that is asked for.
    fits : bool
        Whether the poses so far determine the model, so that a fit is not refused.
    noise_g : float or None
        Median noise of the poses [g]; None if it is not known.
    planned : PlannedPose or None
        The pose of the plan of a refinement that this one is; None: it is for a fit.

    """

    direction: Floats | None
    error: float
    total: int
    fits: bool
    noise_g: float | None = None
    planned: PlannedPose | None = None


@cache
def _attitudes(name: str) -> tuple[Floats, Floats, Floats]:
    """
    Return what a person can set by eye for a model, and what a pose determines on average.

    The former are (n, 3) directions of up and their rows, and the latter is the (p, p) information
    of one pose spread over the sphere.

    """
    up = ATTITUDES[:6] if name == ORIENTED else ATTITUDES
    return up, rows_of(name, up), information_of(name, OVER_THE_SPHERE) / len(OVER_THE_SPHERE)


def next_pose(directions: Floats, name: str = '10', noise: Floats | None = None, *,
              noise_g: float | None = None) -> NextPose:
    """
    Return the pose that improves the fit most: a face, edge or corner not taken yet, or none.

    Parameters
    ----------
    directions : (n, 3) array
        Unit vectors of force so far, in the sensor axes; n can be 0.
    name : {'4', '7', '9', '10', '12'}
        The model to fit; for model 12 the poses are the six faces.
    noise : (n,) array, optional
        Noise of each pose in any unit; by default equal for all poses.
    noise_g : float, optional
        Median noise of the poses [g], which is stated.

    """
    count = len(directions)
    information = information_of(name, directions, noise)
    error, fits = _error(name, information, count), determines(name, directions, noise)
    up = _choose_attitude(name, directions, information)
    helps = up is not None and (  # reduces the error visibly
        dilution_of(name, information) > _GOOD_DILUTION
        or _error(name, information + information_of(name, up[np.newaxis]), count + 1)
        <= (1.0 - _LEAST_HELP) * error)
    if up is None or not helps:
        return NextPose(None, error, count, fits, noise_g)
    total = count + len(list(_add_attitudes(name, directions, information, _SPARE)))
    return NextPose(up, error, total, fits, noise_g)


def _error(name: str, information: Floats, count: int) -> float:
    """Return the error of |force|, RMS over the sphere, relative to the noise of a pose."""
    if count < poses_needed(name) or (
            np.linalg.matrix_rank(information, hermitian=True) < len(information)):
        return np.inf
    return float(np.sqrt(np.trace(np.linalg.solve(information, _attitudes(name)[2]))))


def _add_attitudes(name: str, directions: Floats, information: Floats, spare: int
                   ) -> Iterator[Floats]:
    """Yield the attitudes to add until the poses determine a model well."""
    while (len(directions) < poses_needed(name) + spare
           or dilution_of(name, information) > _GOOD_DILUTION):
        up = _choose_attitude(name, directions, information)
        if up is None:
            return
        yield up
        directions = np.vstack([directions, up])
        information = information + information_of(name, up[np.newaxis])


def _choose_attitude(name: str, directions: Floats, information: Floats) -> Floats | None:
    """Return the untaken attitude that increases det M most, or None if all are taken."""
    up, rows, mean_information = _attitudes(name)
    free = np.max(up @ directions.T, axis=1, initial=-1.0) < TAKEN
    if not np.any(free):
        return None
    to_come = np.linalg.inv(information + mean_information)
    gains = np.linalg.slogdet(np.eye(rows.shape[1]) + rows @ to_come @ np.swapaxes(rows, 1, 2))[1]
    return up[np.argmax(np.where(free, np.round(gains, 6), -1.0))]  # the first of equals


@dataclass(frozen=True)
class SessionPlan:
    """
    The next pose of a session, and the poses for which it was chosen.

    `up` are the (n, 3) approximate directions of up in the sensor axes, unit vectors; n = 0 if
    they are not known. `noise_g` is the median noise of the poses [g], NaN if not known.
    `coverage` is the share of the sphere within 45° of a pose. `zero` is the approximate zero of
    native readings before a fit; empty if it is not known.

    """

    asked: NextPose
    poses: int
    up: Floats
    noise_g: float
    coverage: float
    zero: tuple[float, ...] = ()


def plan_session(poses: Poses, units: Units, model: str, skipped: Sequence[Floats] = ()
                 ) -> SessionPlan:
    """
    Return the next pose for a fit of this model, or that more poses no longer help.

    As long as the directions of native readings are not known, the poses are taken for those that
    were asked for. Otherwise the same pose would be asked for again. The directions `skipped` are
    not asked for, unless no others are left.

    """
    up: Floats = np.zeros((0, 3))
    if not units.is_native or len(poses) >= _FEWEST_NATIVE:
        with suppress(RefusedFitError):
            up = directions_of(poses, units)
    noise, noise_g = pose_noise(poses.noise, up), None
    if noise is not None and len(noise) and not units.is_native:
        noise_g = float(np.median(units.to_g(noise)))
    fitted_model = '10' if model == 'auto' else model
    asked = next_pose(up, fitted_model, noise, noise_g=noise_g)
    supposed = up
    while len(supposed) < len(poses) and asked.direction is not None:
        supposed = np.vstack([supposed, asked.direction])
        asked = next_pose(supposed, fitted_model)
    if asked.direction is not None and len(skipped):
        other = next_pose(np.vstack([supposed, *skipped]), fitted_model)
        if other.direction is not None:
            asked = replace(asked, direction=other.direction)
    # The zero of readings in other units than native ones is known.
    zero = fit_sphere(poses.reading)[1].tolist() if units.is_native and len(up) else ()
    return SessionPlan(asked, len(poses), up, math.nan if noise_g is None else noise_g,
                       coverage(up) if len(up) else 0.0, zero=tuple(zero))


# ----------------------------------------------------------------------------- refusals

def refuse_if_unfit(name: str, directions: Floats, noise: Floats | None = None) -> None:
    """Raise RefusedFitError if poses do not determine a model; parameters as in `next_pose`."""
    if determines(name, directions, noise):
        return
    smaller = [other for other in NORM_MODELS if poses_needed(other) < poses_needed(name)
               and len(directions) >= poses_needed(other)
               and dilution(other, directions, noise) <= WEAK_DILUTION]
    offer = (f', or use model {smaller[-1]}, which these poses determine: '
             f'{_omitted_words(smaller[-1], name, directions, noise)}') if smaller else ''
    few = len(directions) < poses_needed(NORM_MODELS[0])
    # Several that are open together say less than the poses that are missing.
    alone = [] if few else [next(iter(each.main)) for each in identifiability(
        name, directions, noise).undetermined if len(each.main) == 1]
    error = RefusedFitError(
        f'{shape_words(name, directions)}, expected at least {poses_needed(name)} poses spread '
        f'over the sphere for model {name}'
        f'{f"; not determined: {enumerated(alone)}" if alone else ""}',
        f'{turn_words(missing_poses(name, directions, noise))}, hold it still and continue{offer}')
    error.offer = offer
    raise error


def find_undetermined(chosen: str, directions: Floats, noise: Floats | None = None
                      ) -> Iterator[Finding]:
    """Yield a finding if the poses determine only `chosen`, and not the largest model."""
    largest = NORM_MODELS[-1]
    if chosen in NORM_MODELS[:-1]:
        yield Finding(
            'undetermined', f'model {chosen} is the largest that these poses determine: '
            f'{_omitted_words(chosen, largest, directions, noise)}',
            f'to fit model {largest}, {turn_words(missing_poses(largest, directions, noise))}')


def _omitted_words(smaller: str, larger: str, directions: Floats, noise: Floats | None) -> str:
    """Return a text about the effects that a smaller model omits, and the typical error."""
    kept = ideal_of(smaller).effects
    omitted = [str(each) for each in ideal_of(larger).effects if each not in kept]
    words = f'it omits {enumerated(omitted)}'
    if larger == ORIENTED:
        return words
    error = error_left_in(smaller, larger, directions, noise) * MG
    return f'{words}, which causes an error of |a| of {error:.0f} mg in a common sensor'


def missing_poses(name: str, directions: Floats, noise: Floats | None = None) -> list[str]:
    """Return the sides, edges and corners to point up next, until a model is determined well."""
    information = information_of(name, directions, noise)
    return [f'{words_of(up)} ({axes_of_signs(up)})'
            for up in _add_attitudes(name, directions, information, 0)]


def turn_words(missing: Sequence[str]) -> str:
    """Return how to turn the sensor for the missing poses."""
    if len(missing) <= 1:
        return f'turn the sensor so that {"".join(missing) or "another side"} points up'
    return f'turn the sensor so that in turn {enumerated(missing)} point up'


# ----------------------------------------------------------------------------- refinement

@dataclass(frozen=True)
class Rivalry:
    """
    A named effect and its rivals, their probabilities, and what a plan does about them.

    `expected` is the expected probability of the right one after all poses of the plan.

    """

    names: tuple[EffectKey, ...]
    probabilities: tuple[float, ...]
    expected: float


@dataclass(frozen=True)
class PosePlan:
    """
    Poses that separate named effects from their rivals soonest.

    `poses` are in the order to take them; empty if there are no rivals, or no pose separates them.

    """

    poses: tuple[PlannedPose, ...] = ()
    rivalries: tuple[Rivalry, ...] = ()


def plan_refinement(rivals: Sequence[Mapping[EffectKey, tuple[float, Fit]]], model: Model,
                    poses_g: Poses, variance: float) -> PosePlan:
    """
    Return at most `MOST_POSES` poses that separate named effects from their rivals soonest.

    Parameters
    ----------
    rivals : sequence of mappings
        Probability and fit of each named effect, which is first, and of its rivals.
    model : Model
        The model whose readings the candidates have.
    poses_g : Poses
        The poses so far [g].
    variance : float
        λ, the variance of a pose in units of its noise.

    """
    if not rivals:
        return PosePlan()
    up, shown, candidates = _candidates(rivals, model, poses_g)
    contests = []
    for each in rivals:
        judged = [judge(fit.model, candidates) for _, fit in each.values()]
        contests.append(_Contest(
            names=tuple(each), weights=np.array([weight for weight, _ in each.values()]),
            means=np.array([-fit.residual.reshape(len(up), -1) for fit in judged])
            / math.sqrt(max(variance, 1e-12)),
            rows=[fit.columns.reshape(len(up), -1, fit.columns.shape[1]) for fit in judged],
            spreads=[fit.by_pose.spread for _, fit in each.values()]))
    chosen: list[tuple[int, _Contest]] = []  # candidates, each with the contest that it is for
    left = list(contests)
    while len(chosen) < MOST_POSES:
        taken = [index for index, _ in chosen]
        expected = {each: each.expected(taken) for each in left}
        left = [each for each in left if expected[each] < ENOUGH]
        if not left:
            break
        worst = min(left, key=expected.__getitem__)
        gains = worst.gains(taken)
        if np.max(gains) < _LEAST_GAIN:
            left.remove(worst)
        else:
            chosen.append((int(np.argmax(gains >= _AS_GOOD * np.max(gains))), worst))
    chosen.sort(key=lambda each: [  # by time, and then by what must be set
        shown[each[0]].get(key, 0.0) for key in ('time', *VARIED, *sorted(shown[each[0]]))])
    taken = [index for index, _ in chosen]
    return PosePlan(
        tuple(PlannedPose(tuple(up[index].tolist()), shown[index], contest.names,
                          contest.expected(taken[:number]))
              for number, (index, contest) in enumerate(chosen, 1)),
        tuple(Rivalry(each.names, tuple(each.weights.tolist()), each.expected(taken))
              for each in contests))


@dataclass(frozen=True, eq=False)
class _Contest:
    """
    What a named effect and its rivals, k models, predict for c candidates of r equations each.

    `weights` (k,) are the probabilities of the models. The predictions `means` (k, c, r) are in
    units of √λ. For each model, `rows` (c, r, q) is the derivative by its values, and `spreads`
    (q, q) their covariance.

    """

    names: tuple[EffectKey, ...]
    weights: Floats
    means: Floats
    rows: Sequence[Floats]
    spreads: Sequence[Floats]

    def gains(self, taken: list[int]) -> Floats:
        """Return the (c,) expected change of the log odds by each candidate, after others."""
        total = np.zeros(self.means.shape[1])
        for k, (rows, spread) in enumerate(zip(self.rows, self.spreads, strict=True)):
            left = self.means - self.means[k]
            if taken:  # what the model leaves, and its covariance, after a fit to these
                own = rows[taken].reshape(-1, rows.shape[2])
                gain = spread @ own.T @ np.linalg.inv(np.eye(len(own)) + own @ spread @ own.T)
                learned = left[:, taken].reshape(len(left), -1) @ gain.T
                left = left - np.einsum('crq,jq->jcr', rows, learned)
                spread = spread - gain @ own @ spread
            sizes = np.eye(rows.shape[1]) + rows @ spread @ np.swapaxes(rows, 1, 2)
            for j, weight in enumerate(self.weights):
                if j != k:
                    solved = np.linalg.solve(sizes, left[j][:, :, np.newaxis])[:, :, 0]
                    change = np.minimum(np.sum(left[j] * solved, axis=1) / 2.0, _MOST_GAIN)
                    total += weight * self.weights[k] * change
        return total

    def expected(self, taken: list[int]) -> float:
        """Return the expected probability of the right model after some candidates."""
        if not taken:
            return float(np.sum(self.weights ** 2))
        means = self.means[:, taken].reshape(len(self.means), -1)
        roots = []
        for rows, spread in zip(self.rows, self.spreads, strict=True):
            own = rows[taken].reshape(means.shape[1], -1)
            roots.append(np.linalg.cholesky(np.eye(len(own)) + own @ spread @ own.T))
        # The same random readings for each plan.
        noise = np.random.default_rng(1).normal(size=(1000, means.shape[1]))
        expected = 0.0
        for right, probability in enumerate(self.weights.tolist()):
            drawn = means[right] + noise @ roots[right].T
            logs = np.array([np.log(weight) - np.sum(
                np.linalg.solve(root, (drawn - mean).T) ** 2, axis=0) / 2.0
                for weight, mean, root in zip(self.weights, means, roots, strict=True)])
            parts = np.exp(logs - np.max(logs, axis=0))
            expected += probability * float(np.mean(parts[right] / np.sum(parts, axis=0)))
        return expected


def choose_levels(key: str, poses_g: Poses) -> list[float]:
    """Return the values of a column to choose from; for the time, waits after the last pose."""
    values = over_axes(poses_g[key])
    values = values[np.isfinite(values)]
    low, high = float(np.min(values)), float(np.max(values))
    if key == 'time':
        return [0.0, *(share * (high - low) for share in _WAITS)]
    middle = (low + high) / 2.0
    if key == 'temperature':
        room = _BEYOND * (high - low)
        ends = (max(low - room, min(low, _COLDEST)), min(high + room, max(high, _WARMEST)))
        return [round(level, 1) for level in (middle, low, high, *ends)]
    return [float(np.median(values)), high] if key == 'std' else [middle, low, high]


def _candidates(rivals: Sequence[Mapping[EffectKey, tuple[float, Fit]]], model: Model,
                poses_g: Poses) -> tuple[Floats, list[dict[str, float]], Poses]:
    """Return the (c, 3) directions of up of all candidates, what else is set, and their poses."""
    needs = {key for each in rivals for name in each for key in entry_of(name).needs}
    varied = [key for key in (*VARIED, *sorted(filter(is_quantity, needs))) if key in needs]
    directions = np.vstack([ATTITUDES, spread_directions(200)])
    settings = [dict(zip(varied, each, strict=True))  # those that are easier to set come first
                for each in product(*(choose_levels(key, poses_g) for key in varied))]
    up = np.tile(directions, (len(settings), 1))
    shown = [setting for setting in settings for _ in directions]
    count, found = len(up), {'previous': -up}  # turned from the opposite attitude
    for key in ('std', 'count', 'temperature', 'supply_voltage', 'rate', 'duration', 'since_turn',
                *poses_g.quantities):
        if key in poses_g:
            usual = np.nanmedian(poses_g[key], axis=0)
            found[key] = np.full((count, *usual.shape), usual)
            if key in shown[0]:
                found[key].T[:] = [each[key] for each in shown]
    if 'time' in poses_g:
        time = np.sort(poses_g['time'][np.isfinite(poses_g['time'])])
        step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        wait = np.array([each.get('time', 0.0) for each in shown])
        found['time'] = time[-1] + np.maximum(wait, step)
    if 'temperature' in found:  # it has settled
        found.update(temperature_rate=np.zeros(count), temperature_of_offset=found['temperature'],
                     temperature_of_gain=found['temperature'])
    if len(kinds(poses_g)[0]):
        found['reference'] = up
    if 'new' in poses_g:
        found['new'] = np.ones(count)
    found['reading'] = model.at(found).reading(up)
    return up, shown, Poses(found, np.arange(1, count + 1))
