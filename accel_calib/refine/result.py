# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The record of a refinement, and its steps from what a search found.

**Where.** Each step states where simulation and measurement disagree without the effect: an
instant, the ends of the range of a column, or directions of the force.

**Not testable.** Effects that the poses cannot show, and the data to record for them.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise
import math
from typing import Literal

import numpy as np

from .base import fitted_state, is_noise, State, with_effect
from .curves import is_curve, nearest_effects, steepest
from .linear import candidates, linearised, visible
from .plan import PosePlan
from .search import Found
from .sets import LEAST, probabilities
from .words import (
    change_words, curve_words, direction_words, grid_words, instant_words, limit_words, percent,
    plain_name, range_words, shown_name)
from ..calibrate import Calibration
from ..effects import (
    CHANGES, effect_named, EFFECTS, included, kind_of, LADDER, Model, parameter_names, PROCESSES,
    variable_of, WANDER)
from ..estimate import judge, kinds
from ..geometry import ATTITUDES
from ..table import column_of, Floats, Poses, Record
from ..text import listed, table
from ..units import MG

MOST_RIVALS = 3
"""Largest number of rivals of an effect that is called the explanation."""

Verdict = Literal['no_gap', 'explained', 'described', 'unexplained']

_LEAST_VISIBLE = 0.1
"""Smallest visible change of the residuals by an effect of typical size, relative to the noise."""

_LARGEST = 3
"""Number of directions that are stated."""

_NEAR = np.cos(np.radians(30.0))
"""Poses within 30° of a direction count as poses of this direction."""


@dataclass(frozen=True)
class Step:
    """
    One added effect.

    Parameters
    ----------
    effect : str
        What the effect is: its name in the catalogue, ``empirical`` or a covariate.
    rivals : tuple of str
        Effects that these data cannot distinguish from it.
    probabilities : dict
        Probability of the effect and of each effect in its place, by name.
    parameters : dict
        Values by name. For a change of a stored calibration: the changes of the values.
    parameters_sd : dict
        Their standard deviations, of those that are fitted.
    gap_before_mg, gap_after_mg : float
        Residual without and with the effect [mg].
    held_out_before_mg, held_out_after_mg : float
        Held-out residual without and with the effect [mg].
    p_value : float
        Probability that noise alone makes one of all candidates this good.
    where : str
        Directions, range or poses of the disagreement.
    name : str
        Name in the model, by which `accel_calib.effects.effect_named` finds the effect.
    variable : str
        Quantity that a covariate or a curve is a function of; empty for other effects.

    """

    effect: str
    rivals: tuple[str, ...]
    probabilities: dict[str, float]
    parameters: dict[str, float]
    parameters_sd: dict[str, float]
    gap_before_mg: float
    gap_after_mg: float
    held_out_before_mg: float
    held_out_after_mg: float
    p_value: float
    where: str
    name: str
    variable: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, 'variable', variable_of(self.name))

    @property
    def likely_rivals(self) -> tuple[str, ...]:
        """Return the rivals with their probabilities, such as ``quadratic (11 %)``."""
        return tuple(f'{name} ({percent(self.probabilities[name])})' for name in self.rivals)


@dataclass(frozen=True)
class Stage:
    """
    The residuals at one stage, for figures.

    Parameters
    ----------
    name : str
        ``base``, or the effect that was added.
    residual_mg : (n,) array
        Residual of each pose kept, signed if only |force| is known.

    """

    name: str
    residual_mg: Floats


@dataclass(frozen=True, repr=False, eq=False)
class Refinement(Record):
    """
    The result of a refinement.

    Parameters
    ----------
    verdict : {'no_gap', 'explained', 'described', 'unexplained'}
        No gap beyond the noise; the effects are named and the rest is noise; the rest is noise
        only with an empirical curve or a slow change of the offset; or a gap remains, or it is
        not known what explains it (`undecided`).
    noise_floor_mg : float or None
        Expected residual of a correct model [mg]; None if the noise is not known.
    gap_mg, remaining_gap_mg : float
        Residual of the base and of the refined model [mg].
    steps : tuple of Step
        The added effects, in order.
    disturbed_poses : tuple of int
        Rows of the poses left out.
    not_testable : tuple of (str, str)
        Effects that these data cannot show, and the data to record for them.
    advice : tuple of str
        Advice for the user.
    calibration : Calibration
        The refined calibration.
    refusal : tuple of str
        Reason why the calibration must not be stored or used, and advice; empty if it is usable.
    poses_g : Poses
        The poses kept, in g.
    force : (n, 3) array
        Unit force of each pose kept, in the sensor axes.
    stages : tuple of Stage
        Residuals of the base and after each step.
    plan : PosePlan
        Poses that separate the effects from their rivals soonest.
    undecided : bool
        Whether the rest is noise, but the poses do not show which effects explain the gap: one has
        more than `MOST_RIVALS` rivals, or the poses do not determine the refined calibration.

    """

    verdict: Verdict
    noise_floor_mg: float | None
    gap_mg: float
    remaining_gap_mg: float
    steps: tuple[Step, ...]
    disturbed_poses: tuple[int, ...]
    not_testable: tuple[tuple[str, str], ...]
    advice: tuple[str, ...]
    calibration: Calibration
    refusal: tuple[str, ...]
    poses_g: Poses
    force: Floats
    stages: tuple[Stage, ...]
    plan: PosePlan
    undecided: bool = False

    def __repr__(self) -> str:
        names = ' + '.join([self.calibration.name, *(step.effect for step in self.steps)])
        return (f'Refinement({self.verdict}: {names}; residual {self.gap_mg:.3g} -> '
                f'{self.remaining_gap_mg:.3g} mg)')

    def _repr_html_(self) -> str:
        """Return the steps as a table, for notebooks."""
        rows = [[step.effect, f'{step.gap_before_mg:.3g} → {step.gap_after_mg:.3g}',
                 f'{step.held_out_before_mg:.3g} → {step.held_out_after_mg:.3g}',
                 f'{step.p_value:.1g}', ', '.join(step.likely_rivals), step.where]
                for step in self.steps]
        head = ['effect', 'residual [mg]', 'held out [mg]', 'p', 'rivals', 'where']
        lines = ''.join(f'<p>{escape(line)}</p>\n' for line in (repr(self), *self.advice))
        return (table(head, rows) if rows else '') + lines


def verdict_of(found: Found, steps: Sequence[Step], *, refused: bool) -> tuple[Verdict, bool]:
    """Return the verdict on a search, and whether it is undecided what explains the gap."""
    residual, _ = beside_walk(found)
    if found.final.fit.noise_known and not is_noise(float(residual @ residual), found.final.dof):
        return 'unexplained', False
    if steps and (refused or any(len(step.rivals) > MOST_RIVALS for step in steps)):
        return 'unexplained', True
    if found.curve is not None or found.walk is not None:
        return 'described', False
    return 'explained' if steps else 'no_gap', False


def steps_of(found: Found, start: State, date: str, *, joint: bool
             ) -> tuple[tuple[Step, ...], tuple[Stage, ...]]:
    """
    Return the steps of a search, and the residuals at each stage.

    The base `start` is as fitted, or as stored at a date; `joint`: its poses are used, too.

    """
    states = _sequence(found, start)
    of_output = _output_steps(found)
    added = [_step(name, pair, found, date, unseen=joint and k == 0)
             for k, (name, pair) in enumerate(zip(found.added, pairwise(states), strict=False))]
    steps = (*of_output, *added)
    names = ('base', *(step.effect for step in steps))
    at = (*states[:1] * len(of_output), *states)  # limit and grid leave the residuals
    return steps, tuple(
        Stage(name, state.mg_of_poses(beside_walk(found)[0] if name == WANDER
                                      else state.fit.residual))
        for name, state in zip(names, at, strict=True))


def _sequence(found: Found, start: State) -> list[State]:
    """Return the initial state and the state after each added effect."""
    states, values = [start], dict(found.base.model.values)
    for name in found.added:
        if name != WANDER:
            own = found.final.model.values.get(name)
            values = with_effect(values, name, np.zeros(len(effect_named(name).values))
                                 if own is None else own)
            states.append(fitted_state(Model(values), found.base.poses_g) or states[-1])
    if len(states) > 1:
        states[-1] = State(judge(found.final.model, states[-1].poses_g))
    return states if found.added[-1:] != (WANDER,) else [*states, states[-1]]


def _step(name: str, states: tuple[State, State], found: Found, date: str, *, unseen: bool
          ) -> Step:
    """Return the record of one step; `unseen`: the earlier model was not fitted to the poses."""
    before, after = states
    rivals, chances = _rivals(name, found)
    if name == WANDER:
        residual, held_out = beside_walk(found)
        return Step(name, rivals, chances, {}, {}, before.gap_mg(before.residual),
                    before.gap_mg(residual), before.gap_mg(before.held_out),
                    before.gap_mg(held_out), _p_value(name, before, found),
                    _where(name, before, residual), name)
    effect, first, last = effect_named(name), before.fit.residual, after.fit.residual
    values = after.model.values.get(name, np.zeros(len(effect.values)))
    words = _curve(name, before, last) if is_curve(name) else _where(name, before, last)
    deviations = _deviations(name, after)
    if name in CHANGES:
        words = f'{change_words(name, values, [*deviations.values()], date)}; {words}'
    shown = effect.shown(values)
    return Step(kind_of(shown_name(name)), rivals, chances, shown,
                {part: deviations[part] for part in shown if deviations.get(part)},
                before.gap_mg(first), after.gap_mg(last),
                before.gap_mg(first if unseen else before.held_out),
                after.gap_mg(after.held_out), _p_value(name, before, found), words,
                plain_name(name))


def _rivals(name: str, found: Found) -> tuple[tuple[str, ...], dict[str, float]]:
    """Return the rivals of an effect, and the probabilities of it and of those in its place."""
    own, chances = shown_name(name), dict[str, float]()
    for other, part in probabilities(name, found.near).items():
        shown = kind_of(own) if shown_name(other) == own else shown_name(other)
        chances[shown] = chances.get(shown, 0.0) + part
    return tuple(other for other, part in chances.items()
                 if other != kind_of(own) and part > LEAST), chances


def _p_value(name: str, before: State, found: Found) -> float:
    near = found.near
    if name == WANDER:
        return math.exp(-found.walk.likelihood_ratio / 2.0) if found.walk else 1.0
    if found.curve is not None and name == found.curve.name:
        return found.curve.p_value
    if name in near.names:
        return near.linear.probability(near.chosen, near.chosen.blocks[near.names.index(name)])
    linear = linearised(before.fit, before.model.effects, candidates(LADDER, before.poses_g))
    own = [number for number, block in enumerate(linear.blocks) if block.effect == name]
    return linear.probability(linear.set_of(own), own[0]) if own else 1.0


def _output_steps(found: Found) -> list[Step]:
    """Return the steps for readings clipped at a limit or on a grid."""
    steps = []
    gap, held_out = found.base.gap_mg(found.base.residual), found.base.gap_mg(found.base.held_out)
    if found.clipped is not None and found.with_clipped is not None:
        whole, limit_g = found.with_clipped, found.clipped.limit_g
        rows = listed('row', whole.poses_g.row[found.clipped.poses].tolist())
        steps.append(Step('saturation', (), {'saturation': 1.0}, {'limit': limit_g},
                          {}, whole.gap_mg(whole.residual), gap,
                          whole.gap_mg(whole.held_out), held_out, 0.0,
                          limit_words(rows, limit_g), 'saturation'))
    if found.grid_g is not None:
        steps.append(Step('quantisation', (), {'quantisation': 1.0}, {'step': found.grid_g}, {},
                          gap, gap, held_out, held_out, 0.0, grid_words(found.grid_g * MG),
                          'quantisation'))
    return steps


def beside_walk(found: Found) -> tuple[Floats, Floats]:
    """Return the final residual without the walk, and the same held out."""
    final = found.final
    if found.walk is None:
        return final.residual, final.held_out
    return found.walk.residuals(final.linear, final.nothing)


def _curve(name: str, before: State, after: Floats) -> str:
    """Return a description of an empirical curve, given the residuals with it."""
    share_mg = before.mg_of_poses(before.fit.residual - after)
    return curve_words(name, float(np.max(np.abs(share_mg))),
                       steepest(variable_of(name), before.poses_g, share_mg),
                       nearest_effects(before))


def _deviations(name: str, state: State) -> dict[str, float]:
    """Return the standard deviations of the values of an effect of a model; empty without it."""
    names = parameter_names(state.model.effects)
    spread = np.sqrt(np.diag(state.fit.covariance)).tolist()
    return {part: spread[names.index(f'{name}.{part}')] for part in effect_named(name).values
            if name in state.model.values}


def _where(name: str, before: State, after: Floats) -> str:
    """Return where an effect explains the disagreement, given the residuals with it."""
    share_mg = before.mg_of_poses(before.fit.residual - after)
    effect = effect_named(name)
    if name == 'offset_step':
        return _instant(before.poses_g, share_mg)
    column = next((key for key in effect.needs if key in before.poses_g and key != 'new'), None)
    if column is None:
        return _directions(before.fit.equations.force, share_mg)
    return _range(column, before.poses_g[column], share_mg)


def _instant(poses_g: Poses, share_mg: Floats) -> str:
    """Return a text about the instant of the largest change between successive poses."""
    order = np.argsort(poses_g['time'], kind='stable')
    order = order[:int(np.sum(np.isfinite(poses_g['time'])))]
    time, rows, moved = poses_g['time'][order], poses_g.row[order], share_mg[order]
    count = np.arange(1, len(moved))
    sums = np.cumsum(moved ** 2)[:-1]
    at = int(np.argmax(np.abs(sums / count - (np.sum(moved ** 2) - sums) / (len(moved) - count))))
    return instant_words((time[at], time[at + 1]), (rows[at], rows[at + 1]))


def _range(column: str, values: Floats, share_mg: Floats) -> str:
    """Return a text about the range of a quantity and the disagreement at both ends."""
    known = np.isfinite(values.reshape(len(share_mg), -1)).all(axis=1)
    values, share_mg = values[known], share_mg[known]
    if values.ndim > 1:
        values = np.linalg.norm(values, axis=1)
    order = np.argsort(values, kind='stable')
    ends = max(1, len(order) // 5)
    low, high = (float(np.sqrt(np.mean(share_mg[part] ** 2)))
                 for part in (order[:ends], order[-ends:]))
    return range_words(column, (values[order[0]], values[order[-1]]), (low, high))


def _directions(force: Floats, share_mg: Floats) -> str:
    """Return a text about the directions with the largest disagreement."""
    signs, near = np.sign(ATTITUDES), ATTITUDES @ force.T >= _NEAR
    counts = np.sum(near, axis=1)
    means = np.where(counts > 0, near @ share_mg / np.maximum(counts, 1), 0.0)
    return direction_words([(signs[k], means[k], counts[k])
                            for k in np.argsort(-np.abs(means))[:_LARGEST] if counts[k]],
                           len(share_mg))


def untestable(found: Found, steps: Sequence[Step]) -> tuple[tuple[str, str], ...]:
    """Return the effects that the poses of a search cannot show, with the data to record."""
    final = found.final
    names = tuple(name for name in EFFECTS if name not in final.model.effects)
    rivals = tuple(rival for step in steps for rival in step.rivals)
    return not_testable(final.poses_g, visible(final.fit, candidates(names, final.poses_g)),
                        (*final.model.effects, *rivals))


def not_testable(poses_g: Poses, testable: Mapping[str, float], present: tuple[str, ...]
                 ) -> tuple[tuple[str, str], ...]:
    """
    Return the effects that these poses cannot show, with the data to record.

    `testable` are the effects that the poses distinguish from the model, and how visible they
    are; `present` are the effects of the model and their rivals.

    """
    missing = []
    unknown = not len(kinds(poses_g)[0])
    passed = {*present, *included(present)}
    for name, effect in {**EFFECTS, **PROCESSES}.items():
        if name in passed or effect.output is not None or passed & {*effect.includes}:
            continue
        if name in testable and (effect.needs or testable[name] > _LEAST_VISIBLE):
            continue
        lacking = [', '.join(column_of(key).names) for key in effect.needs if key not in poses_g]
        if lacking:
            missing.append((name, ' and '.join(lacking)))
        elif effect.known_orientation and unknown:
            missing.append((name, 'ref_x, ref_y, ref_z (known orientation)'))
        elif name in PROCESSES:
            continue
        elif effect.needs:
            missing.append((name, 'poses with a larger change of this quantity: '
                            f'{column_of(effect.needs[0]).meaning}'))
        else:
            missing.append((name, 'more poses in more directions'))
    return tuple(missing)
