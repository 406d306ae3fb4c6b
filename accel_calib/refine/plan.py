# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Which poses to take next, to separate a named effect from its rivals.

A contest is a named effect with the rivals that the poses leave a probability. The model with each
of them is fitted to the poses. A candidate is a direction at a temperature, time or supply. There,
model k predicts the equation of the pose with the mean m_k and the variance λ (1 + x_k C_k x_kᵀ):
x_k is the derivative by the values, C_k their covariance from the poses so far, and λ the variance
of a pose in units of its noise. If model j is right, the candidate is expected to change the
logarithm of the odds of j to k by

    (m_j - m_k)² / (2 λ (1 + x_k C_k x_kᵀ))

The next pose is the candidate with the largest mean of this over all pairs, weighted by their
probabilities (Box and Hill 1967). Means and covariances are then updated as if the pose had been
taken, and the next one is chosen, until the expected probability of the right effect is large.

The expected probability is the mean over readings that the models predict, drawn at random. The
values of the models are uncertain in them, too, so it is what `refine` will report on average.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
import math
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .base import fitted_state, with_effect
from .sets import LEAST, Near, probabilities
from .words import condition_words, percent, plan_lines, shown_name, versus
from ..effects import effect_named, Model, WANDER
from ..estimate import Fit, judge, kinds
from ..geometry import attitude_words, ATTITUDES, spread_directions
from ..table import Floats, is_quantity, Poses

if TYPE_CHECKING:
    from .search import Found

ENOUGH = 0.95
"""Expected probability of the right effect at which a plan ends."""

NOTHING = (f'there is nothing to separate: no named effect has a rival that leaves it a '
           f'probability below {100.0 * ENOUGH:.0f} %')
"""The line of an empty plan."""

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

_DIRECTIONS = 200
"""Number of directions beside faces, edges and corners."""

_COLDEST, _WARMEST = -20.0, 70.0
"""Range of the temperatures that are asked for [°C], unless the poses were outside of it."""

_BEYOND = 0.5
"""Part of the range of the poses by which temperatures exceed it on each side."""

_WAITS = (0.5, 1.0, 2.0)
"""Times after the last pose, in durations of the session."""

_DRAWS, _SEED = 1000, 1
"""Random readings for the expected probability; the same for each plan."""


@dataclass(frozen=True)
class PlannedPose:
    """
    One pose of a plan.

    Parameters
    ----------
    up : tuple of float
        Direction to point up, a unit vector in the sensor axes.
    words : str
        The same in words.
    context : mapping of str to float
        What else to set, by column of `accel_calib.table.COLUMNS`: ``temperature`` [°C],
        ``supply_voltage`` [V], ``std`` [g], and ``time`` as the wait after the last pose [s].
    separates : tuple of str
        The named effect and its rivals.
    expected : float
        Expected probability of the right one of them after this pose and those before it.

    """

    up: tuple[float, float, float]
    words: str
    context: Mapping[str, float]
    separates: tuple[str, ...]
    expected: float

    @property
    def purpose(self) -> str:
        """Return what the pose is for."""
        return f'to separate {versus(self.separates)}'

    @property
    def conditions(self) -> str:
        """Return the context in words; empty if the pose can be taken at once."""
        return condition_words(self.context)


@dataclass(frozen=True)
class PosePlan:
    """
    Poses that separate named effects from their rivals soonest.

    Parameters
    ----------
    poses : tuple of PlannedPose
        The poses in the order to take them; empty if there are no rivals, or no pose separates
        them.
    lines : tuple of str
        The plan in words.

    """

    poses: tuple[PlannedPose, ...] = ()
    lines: tuple[str, ...] = (NOTHING,)

    @property
    def advice(self) -> tuple[str, ...]:
        """Return a line about the first pose; empty without poses."""
        if not self.poses:
            return ()
        first, last = self.poses[0], self.poses[-1]
        where = f', {first.conditions}' if first.conditions else ''
        return (f'next pose to separate {versus(first.separates)}: {first.words}{where} (1 of '
                f'{len(self.poses)} poses, with which the expected probability of the right one '
                f'is {percent(last.expected)})',)


def plan_poses(found: Found) -> PosePlan:
    """
    Return at most `MOST_POSES` poses that separate named effects from their rivals soonest.

    A random walk of the offset cannot be predicted, so it is not planned for.

    """
    near = found.near
    if near.walk is not None:
        return PosePlan()
    contests = [each for each in (_contest(name, found) for name in near.names) if each]
    if not contests:
        return PosePlan()
    grid = _Candidates.of(found.final.fit, _varied(contests))
    return _in_words(contests, grid, _chosen([each.at(grid.poses_g) for each in contests]))


def variance_of(near: Near) -> float:
    """Return the variance of a pose in units of its noise, moderated as in the search."""
    linear, chosen = near.linear, near.chosen
    left = max(linear.worth + linear.dof - chosen.parameters, 1.0)
    return max((linear.worth + chosen.rss) / left, 1e-12)


@dataclass(frozen=True)
class _Contest:
    """A named effect and its rivals: names, (k,) probabilities, a fit with each, and λ."""

    names: tuple[str, ...]
    weights: Floats
    fits: tuple[Fit, ...]
    variance: float

    def at(self, candidates: Poses) -> _Predictions:
        """Return what each model predicts for candidates."""
        each = [judge(fit.model, candidates) for fit in self.fits]
        count, scale = len(candidates), math.sqrt(self.variance)
        means = np.array([-fit.residual.reshape(count, -1) for fit in each]) / scale
        rows = [fit.columns.reshape(count, -1, fit.columns.shape[1]) for fit in each]
        spreads = tuple(fit.by_pose.spread for fit in self.fits)
        return _Predictions(means, tuple(rows), spreads, self.weights)


@dataclass(frozen=True)
class _Predictions:
    """
    The predictions of k models for c candidates of r equations each, in units of √λ.

    `means` is (k, c, r), and `weights` (k,) the probabilities of the models. For each model,
    `rows` (c, r, q) is the derivative by its values, and `spreads` (q, q) their covariance.

    """

    means: Floats
    rows: tuple[Floats, ...]
    spreads: tuple[Floats, ...]
    weights: Floats

    def gains(self, taken: Sequence[int]) -> Floats:
        """Return the (c,) expected change of the log odds by each candidate, after others."""
        total = np.zeros(self.means.shape[1])
        for k, (rows, spread) in enumerate(zip(self.rows, self.spreads, strict=True)):
            left = self.means - self.means[k]
            if taken:
                left, spread = _after(left, rows, spread, list(taken))
            sizes = np.eye(rows.shape[1]) + rows @ spread @ np.swapaxes(rows, 1, 2)
            for j, weight in enumerate(self.weights):
                if j != k:
                    solved = np.linalg.solve(sizes, left[j][:, :, np.newaxis])[:, :, 0]
                    gain = np.minimum(np.sum(left[j] * solved, axis=1) / 2.0, _MOST_GAIN)
                    total += weight * self.weights[k] * gain
        return total

    def expected(self, taken: Sequence[int]) -> float:
        """Return the expected probability of the right model after some candidates."""
        if not taken:
            return float(np.sum(self.weights ** 2))
        means = self.means[:, list(taken)].reshape(len(self.means), -1)
        roots = []
        for rows, spread in zip(self.rows, self.spreads, strict=True):
            own = rows[list(taken)].reshape(means.shape[1], -1)
            roots.append(np.linalg.cholesky(np.eye(len(own)) + own @ spread @ own.T))
        noise = np.random.default_rng(_SEED).normal(size=(_DRAWS, means.shape[1]))
        return sum(float(weight) * self._right(j, means, roots, noise)
                   for j, weight in enumerate(self.weights))

    def _right(self, right: int, means: Floats, roots: list[Floats], noise: Floats) -> float:
        """Return the expected probability of one model if it is right."""
        drawn = means[right] + noise @ roots[right].T
        logs = np.array([np.log(weight) - np.sum(
            np.linalg.solve(root, (drawn - mean).T) ** 2, axis=0) / 2.0
            for weight, mean, root in zip(self.weights, means, roots, strict=True)])
        parts = np.exp(logs - np.max(logs, axis=0))
        return float(np.mean(parts[right] / np.sum(parts, axis=0)))


def _after(left: Floats, rows: Floats, spread: Floats, taken: list[int]
           ) -> tuple[Floats, Floats]:
    """Return what a model leaves of means, and its covariance, after a fit to candidates."""
    own = rows[taken].reshape(-1, rows.shape[2])
    gain = spread @ own.T @ np.linalg.inv(np.eye(len(own)) + own @ spread @ own.T)
    learned = left[:, taken].reshape(len(left), -1) @ gain.T
    return left - np.einsum('crq,jq->jcr', rows, learned), spread - gain @ own @ spread


def _contest(name: str, found: Found) -> _Contest | None:
    """Return a named effect with its rivals, or None if it is certain enough."""
    fits: dict[str, Fit] = {name: found.final.fit}
    weights = probabilities(name, found.near)
    for rival, weight in weights.items():
        if rival != WANDER and shown_name(rival) != shown_name(name) and weight > LEAST:
            fit = _fit_of(rival, name, found)
            if fit is not None:
                fits[rival] = fit
    parts = np.array([weights[each] for each in fits])
    parts /= np.sum(parts)
    if len(fits) < 2 or np.max(parts) >= ENOUGH:
        return None
    return _Contest(tuple(fits), parts, tuple(fits.values()), variance_of(found.near))


def _fit_of(rival: str, name: str, found: Found) -> Fit | None:
    """Return the fit with a rival in the place of an effect, or None without a sound fit."""
    near = found.near
    own = near.chosen.blocks[near.names.index(name)]
    others = near.linear.without(near.chosen, own)
    best = near.linear.best_of(rival, others)
    chosen = near.linear.extended(others, best)
    unchanged = {key: part for key, part in found.final.model.values.items() if key != name}
    block = near.linear.blocks[best]
    values = with_effect(unchanged, rival, np.concatenate(
        [near.linear.values_of(chosen)[best], block.shape]))
    state = fitted_state(Model(values), found.final.poses_g)
    return None if state is None else state.fit


def _varied(contests: Sequence[_Contest]) -> tuple[str, ...]:
    """Return the columns that the effects in contest are functions of."""
    needs = {key for contest in contests for name in contest.names
             for key in effect_named(name).needs}
    return tuple(key for key in (*VARIED, *sorted(filter(is_quantity, needs))) if key in needs)


@dataclass(frozen=True)
class _Candidates:
    """
    Poses that can be taken, with the readings that the final model predicts [g].

    `up` is the (c, 3) direction that points up, and `shown` the varied context of each; the time
    is the wait after the last pose.

    """

    poses_g: Poses
    up: Floats
    shown: tuple[Mapping[str, float], ...]

    @classmethod
    def of(cls, fit: Fit, varied: tuple[str, ...]) -> _Candidates:
        """Return the candidates near a model; those that are easier to set come first."""
        up = np.vstack([ATTITUDES, spread_directions(_DIRECTIONS)])
        levels = [_levels(key, fit.poses_g) for key in varied]
        shown = [dict(zip(varied, each, strict=True)) for each in product(*levels)]
        force = np.tile(up, (len(shown), 1))
        each = tuple(level for level in shown for _ in up)
        columns = _columns(fit.poses_g, force, each)
        columns['reading'] = fit.model.at(columns).reading(force)
        return cls(Poses(columns, np.arange(1, len(force) + 1)), force, each)


def _levels(key: str, poses_g: Poses) -> list[float]:
    """Return the values of a column to choose from; for the time, waits after the last pose."""
    values = _sizes(poses_g[key])
    low, high = float(np.min(values)), float(np.max(values))
    if key == 'time':
        return [0.0, *(share * (high - low) for share in _WAITS)]
    middle = (low + high) / 2.0
    if key == 'temperature':
        room = _BEYOND * (high - low)
        ends = (max(low - room, min(low, _COLDEST)), min(high + room, max(high, _WARMEST)))
        return [round(level, 1) for level in (middle, low, high, *ends)]
    return [float(np.median(values)), high] if key == 'std' else [middle, low, high]


def _sizes(values: NDArray[Any]) -> Floats:
    """Return the finite (n,) values of a column, of a vector its RMS over the axes."""
    sizes = np.sqrt(np.mean(values ** 2, axis=1)) if values.ndim > 1 else values
    return np.asarray(sizes[np.isfinite(sizes)], float)


def _columns(poses_g: Poses, force: Floats, shown: Sequence[Mapping[str, float]]
             ) -> dict[str, NDArray[Any]]:
    """Return the columns of candidates, without their readings."""
    count, found = len(force), {}
    for key in ('std', 'count', 'temperature', 'supply_voltage', 'rate', *poses_g.quantities):
        if key in poses_g:
            usual = np.nanmedian(poses_g[key], axis=0)
            found[key] = np.tile(usual, (count, 1)) if usual.ndim else np.full(count, usual)
            if shown and key in shown[0]:
                level = np.array([each[key] for each in shown])
                found[key] = np.repeat(level[:, np.newaxis], 3, axis=1) if usual.ndim else level
    if 'time' in poses_g:
        time = np.sort(_sizes(poses_g['time']))
        step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        wait = np.array([each.get('time', 0.0) for each in shown])
        found['time'] = time[-1] + np.maximum(wait, step)
    if 'temperature' in found:  # it has settled
        found.update(temperature_rate=np.zeros(count), temperature_of_offset=found['temperature'],
                     temperature_of_gain=found['temperature'])
    if len(kinds(poses_g)[0]):
        found['reference'] = force
    if 'new' in poses_g:
        found['new'] = np.ones(count)
    return {**found, 'previous': -force}  # turned from the opposite attitude


def _chosen(contests: Sequence[_Predictions]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the chosen candidates, and the contest for which each was chosen."""
    taken: list[int] = []
    reasons: list[int] = []
    open_ = set(range(len(contests)))
    while len(taken) < MOST_POSES:
        expected = {k: contests[k].expected(taken) for k in open_}
        open_ = {k for k in open_ if expected[k] < ENOUGH}
        if not open_:
            break
        worst = min(open_, key=lambda k: expected[k])
        gains = contests[worst].gains(taken)
        if np.max(gains) < _LEAST_GAIN:
            open_.remove(worst)
            continue
        taken.append(int(np.argmax(gains >= _AS_GOOD * np.max(gains))))
        reasons.append(worst)
    return tuple(taken), tuple(reasons)


def _in_words(contests: Sequence[_Contest], grid: _Candidates,
              chosen: tuple[tuple[int, ...], tuple[int, ...]]) -> PosePlan:
    """Return the plan of the chosen candidates, in the order to take them."""
    taken, reasons = chosen
    order = sorted(range(len(taken)), key=lambda k: _effort(grid.shown[taken[k]]))
    taken = tuple(taken[k] for k in order)
    reasons = tuple(reasons[k] for k in order)
    own = [each.at(grid.poses_g.take(np.array(taken, np.intp))) for each in contests] if (
        taken) else []
    poses = tuple(
        PlannedPose(_triple(grid.up[index]), attitude_words(grid.up[index]), grid.shown[index],
                    contests[reason].names, own[reason].expected(range(number)))
        for number, (index, reason) in enumerate(zip(taken, reasons, strict=True), 1))
    lines = []
    for reason, contest in enumerate(contests):
        expected = own[reason].expected(range(len(taken))) if own else 0.0
        lines += plan_lines(dict(zip(contest.names, contest.weights.tolist(), strict=True)), [
            (pose.words, pose.conditions) for pose, why in zip(poses, reasons, strict=True)
            if why == reason], expected, enough=expected >= ENOUGH)
    return PosePlan(poses, tuple(lines))


def _effort(shown: Mapping[str, float]) -> tuple[float, ...]:
    """Return the key that sorts poses by time, and then by what must be set."""
    return (shown.get('time', 0.0), *(shown.get(key, 0.0) for key in VARIED if key != 'time'),
            *(value for key, value in sorted(shown.items()) if is_quantity(key)))


def _triple(vector: Floats) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
