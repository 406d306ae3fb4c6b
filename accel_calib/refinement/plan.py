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

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .curves import LEAST, Near, probabilities
from .search import Found
from .state import fitted_state, with_effect
from .steps import percent, shown_name
from ..effects import EffectKey, entry_of, Model, WANDER
from ..estimate import Fit, judge, kinds
from ..geometry import attitude_words, ATTITUDES, spread_directions
from ..statistics import over_axes
from ..table import Floats, is_quantity, Poses

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

NOTHING = (f'there is nothing to separate: no named effect has a rival that leaves it a '
           f'probability below {100.0 * ENOUGH:.0f} %')
"""The line of an empty plan."""


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
    separates : tuple of EffectKey
        The named effect and its rivals.
    expected : float
        Expected probability of the right one of them after this pose and those before it.

    """

    up: tuple[float, ...]
    words: str
    context: Mapping[str, float]
    separates: tuple[EffectKey, ...]
    expected: float

    @property
    def purpose(self) -> str:
        """Return what the pose is for."""
        return f'to separate {versus(self.separates)}'

    @property
    def conditions(self) -> str:
        """Return the context in words; empty if the pose can be taken at once."""
        context, parts = self.context, list[str]()
        if 'temperature' in context:
            parts.append(f'at {context["temperature"]:.0f} °C')
        if 'supply_voltage' in context:
            parts.append(f'at {context["supply_voltage"]:.2f} V')
        if 'std' in context:
            parts.append(f'with {1e3 * context["std"]:.2g} mg of vibration')
        parts += [f'at {key} {value:.4g}' for key, value in context.items() if is_quantity(key)]
        if context.get('time', 0.0) > 0.0:
            parts.append(f'{_duration(context["time"])} after the last pose')
        return ' '.join(parts)


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
    names = () if found.near.walk is not None else found.near.names
    rivalries = [fits for name in names if (fits := _fits(name, found))]
    if not rivalries:
        return PosePlan()
    needs = {key for each in rivalries for name in each for key in entry_of(name).needs}
    varied = [key for key in (*VARIED, *sorted(filter(is_quantity, needs))) if key in needs]
    so_far = found.final.poses_g
    directions = np.vstack([ATTITUDES, spread_directions(200)])
    settings = [dict(zip(varied, each, strict=True))  # those that are easier to set come first
                for each in product(*(_levels(key, so_far) for key in varied))]
    up = np.tile(directions, (len(settings), 1))
    shown = [setting for setting in settings for _ in directions]
    columns = _columns(so_far, up, shown)
    columns['reading'] = found.final.model.at(columns).reading(up)
    candidates = Poses(columns, np.arange(1, len(up) + 1))
    contests = [_Contest.of(each, found.near, candidates) for each in rivalries]
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
    return _in_words(contests, up, shown, chosen)


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
    rows: tuple[Floats, ...]
    spreads: tuple[Floats, ...]

    @classmethod
    def of(cls, fits: Mapping[EffectKey, tuple[float, Fit]], near: Near, candidates: Poses
           ) -> _Contest:
        """Return a contest from the probability of each model, and its fit to the poses so far."""
        weights = np.array([weight for weight, _ in fits.values()])
        each = [judge(fit.model, candidates) for _, fit in fits.values()]
        count, scale = len(candidates), math.sqrt(max(near.chosen.variance, 1e-12))
        means = np.array([-fit.residual.reshape(count, -1) for fit in each]) / scale
        rows = tuple(fit.columns.reshape(count, -1, fit.columns.shape[1]) for fit in each)
        return cls(tuple(fits), weights, means, rows,
                   tuple(fit.by_pose.spread for _, fit in fits.values()))

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


def _fits(name: EffectKey, found: Found) -> dict[EffectKey, tuple[float, Fit]]:
    """
    Return probability and fit of an effect and its rivals; empty if the data are certain enough.

    What is usual does not replace a pose that would show it.

    """
    fits, others = {name: found.final.fit}, found.near.without(name)
    unchanged = {key: part for key, part in found.final.model.values.items() if key != name}
    weights = probabilities(name, found.near, usual=False)
    for rival, weight in weights.items():
        if rival == WANDER or shown_name(rival) == shown_name(name) or weight <= LEAST:
            continue
        best = others.best_of(rival)
        values = [others.extended(best).values[best], others.linear.blocks[best].shape]
        model = Model(with_effect(unchanged, rival, np.concatenate(values)))
        state = fitted_state(model, found.final.poses_g)
        if state is not None:
            fits[rival] = state.fit
    total = sum(weights[each] for each in fits)
    if len(fits) < 2 or max(weights[each] for each in fits) >= ENOUGH * total:
        return {}
    return {each: (weights[each] / total, fit) for each, fit in fits.items()}


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
    sizes = over_axes(values)
    return np.asarray(sizes[np.isfinite(sizes)], float)


def _columns(poses_g: Poses, force: Floats, shown: Sequence[Mapping[str, float]]
             ) -> dict[str, NDArray[Any]]:
    """Return the columns of candidates, without their readings."""
    count, found = len(force), {}
    for key in ('std', 'count', 'temperature', 'supply_voltage', 'rate', 'duration', 'since_turn',
                *poses_g.quantities):
        if key in poses_g:
            usual = np.nanmedian(poses_g[key], axis=0)
            found[key] = np.tile(usual, (count, 1)) if usual.ndim else np.full(count, usual)
            if key in shown[0]:
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


def _in_words(contests: Sequence[_Contest], up: Floats, shown: Sequence[Mapping[str, float]],
              chosen: Sequence[tuple[int, _Contest]]) -> PosePlan:
    """Return the plan of the chosen candidates, in the order to take them."""
    ordered = sorted(chosen, key=lambda each: [  # by time, and then by what must be set
        shown[each[0]].get(key, 0.0) for key in ('time', *VARIED, *sorted(shown[each[0]]))])
    taken = [index for index, _ in ordered]
    poses = tuple(
        PlannedPose(tuple(up[index].tolist()), attitude_words(up[index]), shown[index],
                    contest.names, contest.expected(taken[:number]))
        for number, (index, contest) in enumerate(ordered, 1))
    lines: list[str] = []
    for contest in contests:
        own = [pose for pose, (_, why) in zip(poses, ordered, strict=True) if why is contest]
        odds, after = ', '.join(map(percent, contest.weights.tolist())), contest.expected(taken)
        what = f'to separate {versus(contest.names)} ({odds})'
        end = f'the expected probability of the right one is then {percent(after)}'
        if own:
            lines += f'{what}, take these poses:', *_held(own), end
        elif after >= ENOUGH:
            lines.append(f'{what}, the same poses are enough: {end}')
        else:
            lines.append(f'{what}, poses at 1 g do not help; apply other forces (a centrifuge)')
    return PosePlan(poses, tuple(lines))


def _held(poses: Sequence[PlannedPose]) -> Iterator[str]:
    """Yield one line for each condition; conditions with the same directions share a line."""
    directions: dict[str, list[str]] = {}
    for pose in poses:
        directions.setdefault(pose.conditions, []).append(pose.words)
    shared: dict[tuple[str, ...], list[str]] = {}
    for where, held in directions.items():
        texts = tuple(text if count == 1 else f'{text} ({count} poses)'
                      for text, count in Counter(held).items())
        shared.setdefault(texts, []).append(where)
    for texts, places in shared.items():
        where = ' and '.join(filter(None, places))
        yield f'{where + ": " if where else ""}hold {"; ".join(texts)}'


def versus(names: Sequence[EffectKey]) -> str:
    first, *others = (shown_name(name) for name in names)
    return f'{first} from {", ".join(others)}'


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f'{seconds:.0f} s'
    return f'{seconds / 60.0:.0f} min' if seconds < 7200.0 else f'{seconds / 3600.0:.1f} h'
