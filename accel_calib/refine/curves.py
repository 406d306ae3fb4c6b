# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Empirical curves: where the gap lies, if no known effect has its form.

A curve changes a carrier (offset, gain, cross-axis, |force|, or one axis of them) with a variable
(time, temperature, its rate, supply, vibration, or the force along the axis). It is a sum of a few
cosines over the range of the variable (`accel_calib.effects.empirical_name`). For each carrier and
variable, the cosines are added in the order of their gain while the score of `.linear` rises; each
costs its values and 2 log k for the choice of the k-th. The best curve is accepted if it is
significant, and if poses held out agree.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from .linear import Block, held_out, LEVEL, Linear, linearised, Set
from .sets import with_outliers
from .state import State
from ..effects import (
    CARRIERS,
    effect_named,
    EMPIRICAL,
    empirical_name,
    empirical_parts,
    Model,
    MODES,
    VARIABLES,
)
from ..estimate.fit import Fit, judge
from ..table import Floats, Poses

_MOST_MODES = 10
_LARGEST_SHARE = 0.35
"""Largest number of cosines, and largest share of the degrees of freedom, of a curve."""

_LEAST_DOF = 30
"""Degrees of freedom below which no curve is looked for; a few poses fit many curves."""

_PATIENCE = 2
"""Cosines without a better score after which no more are added; a wave needs several."""

_CLEARLY = 10.0
"""Smallest score of a curve."""

_HELD_OUT = 0.9
"""Largest ratio of the held-out sum of squares with and without a curve."""


class Curve(NamedTuple):
    """
    A curve beside a model.

    Parameters
    ----------
    name : str
        Its name.
    values : (p,) array
        Its values, with the range of the variable.
    score : float
        Its score, relative to no curve.
    out : tuple of int
        Indices of the outliers beside it.
    p_value : float
        Probability that noise alone makes one of all curves this good.

    """

    name: str
    values: Floats
    score: float
    out: tuple[int, ...]
    p_value: float


def best_curve(state: State, poses_g: Poses, out: tuple[int, ...]) -> Curve | None:
    """
    Return the best curve beside a model, or None if none is significant.

    Parameters
    ----------
    state : State
        The model.
    poses_g : Poses
        All poses, in g.
    out : tuple of int
        Indices of the outliers.

    """
    fit = judge(state.model, poses_g)
    plain = linearised(fit, state.model.effects, ())
    if plain.dof < _LEAST_DOF:
        return None
    best, tried = None, 0
    for carrier, variable in _pairs(poses_g):
        for problem in _problems(plain, fit, carrier, variable):
            chosen, tried = _grown(_compressed(problem, out)), tried + 1
            if chosen.blocks and (best is None or chosen.score > best[0]):
                best = chosen.score, problem, chosen
    if best is None:
        return None
    score, problem, chosen = best
    return _accepted(score - 2.0 * math.log(tried), problem, problem.made(chosen.blocks, out),
                     tried)


def _pairs(poses_g: Poses) -> Iterator[tuple[str, str]]:
    """Yield the carriers and variables that the poses can show."""
    for variable in VARIABLES:
        for carrier in CARRIERS:
            if (variable in poses_g or variable == 'force') and (
                    variable != 'force' or carrier == 'offset'):
                yield carrier, variable


def _problems(plain: Linear, fit: Fit, carrier: str, variable: str) -> Iterator[Linear]:
    """Yield the problem with the cosines of a carrier as candidates, and of each of its parts."""
    name = empirical_name(carrier, variable, range(1, MODES + 1))
    effect = effect_named(name)
    shapes = [np.zeros(0)] if effect.shapes is None else list(effect.shapes(fit.poses_g.columns))
    if not shapes:
        return
    count = len(effect.parameters)
    model = Model({name: np.concatenate([np.zeros(count), shapes[0]])})
    columns = fit.equations.columns(model)[:, :count]
    sizes = np.linalg.norm(columns, axis=0)
    sizes[sizes == 0.0] = 1.0
    columns = columns / sizes
    columns = columns - plain.onto @ (plain.onto.T @ columns)
    parts = CARRIERS[carrier]
    width = len(parts)
    yield replace(plain, columns=columns, sizes=sizes, choice=0.0, blocks=tuple(
        Block(empirical_name(carrier, variable, (mode,)), shapes[0],
              slice(width * (mode - 1), width * mode), 0, float(mode))
        for mode in range(1, MODES + 1)))
    for k, part in enumerate(parts if width > 1 else ()):
        yield replace(plain, columns=columns[:, k::width], sizes=sizes[k::width], choice=0.0,
                      blocks=tuple(
                          Block(empirical_name(f'{carrier}.{part}', variable, (mode,)), shapes[0],
                                slice(mode - 1, mode), 0, float(mode))
                          for mode in range(1, MODES + 1)))


def _compressed(problem: Linear, out: tuple[int, ...]) -> Linear:
    """Return a problem with the same products of its columns, but with few rows."""
    nothing = problem.made((), out)
    columns = problem.columns - nothing.onto @ (nothing.onto.T @ problem.columns)
    rows = np.linalg.qr(np.column_stack([columns, nothing.residual]))[1]
    count = len(rows)
    return replace(problem, onto=np.zeros((count, 0)), residual=rows[:, -1],
                   pose=np.arange(count), columns=rows[:, :-1], base_rss=nothing.rss,
                   dof=problem.dof - int(nothing.parameters))


def _grown(problem: Linear) -> Set:
    """Return the cosines with the best score."""
    best = now = problem.made()
    for _ in range(_MOST_MODES):
        gain, rank = problem.gains(now)
        scores = [problem.score_with(now, k, gain[k], rank[k])
                  if rank[k] and k not in now.blocks else -np.inf
                  for k in range(len(problem.blocks))]
        now = problem.made((*now.blocks, int(np.argmax(scores))))
        if now.parameters > _LARGEST_SHARE * problem.dof:
            break
        if now.score > best.score:
            best = now
        elif len(now.blocks) >= len(best.blocks) + _PATIENCE:
            break
    return best


def _accepted(score: float, problem: Linear, chosen: Set, tried: int) -> Curve | None:
    """Return a curve, or None if it is not significant or poses held out do not agree."""
    # The outliers are found again: without the curve, good poses may have looked like outliers.
    chosen = max(with_outliers(problem, chosen), key=lambda each: each.score)
    nothing = problem.made((), chosen.out)
    choices = tried * math.prod(problem.blocks[block].tried for block in chosen.blocks)
    p_value = min(1.0, problem.chance(nothing, chosen) * choices)
    if p_value > LEVEL or score < _CLEARLY:
        return None
    before, after = _held_out(problem, nothing), _held_out(problem, chosen)
    if after > _HELD_OUT * before:
        return None
    carrier, variable, _ = empirical_parts(problem.blocks[0].effect)
    values = problem.values_of(chosen)
    blocks = sorted(chosen.blocks)
    modes = [empirical_parts(problem.blocks[block].effect)[2][0] for block in blocks]
    return Curve(empirical_name(carrier, variable, modes), np.concatenate(
        [*(values[block] for block in blocks), problem.blocks[0].shape]), score, chosen.out,
        p_value)


def _held_out(problem: Linear, chosen: Set) -> float:
    """Return the sum of squares of the residuals, each predicted from the other equations."""
    own = 1.0 - np.sum(problem.onto ** 2, axis=1) - np.sum(chosen.onto ** 2, axis=1)
    kept = own > 1e-6  # not the outliers
    return float(np.sum(held_out(chosen.residual[kept], own[kept]) ** 2))


def is_curve(name: str) -> bool:
    """Return whether an effect is an empirical curve."""
    return name.startswith(f'{EMPIRICAL}-')
