# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The steps of a refinement from what a search found, and remarks for advice.

Places and remarks are kinds with figures; `accel_calib.findings` has their words.

**One model.** A step has the residuals without and with its effect. All else that is stated of it
is of the final model: values, deviations, rivals, probabilities, and where it acts, which is an
instant, the ends of the range of a column, or directions of the force.

**Not testable.** Effects that the poses cannot show, and the data to record for them.

"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from itertools import pairwise
import math
from typing import Any, Literal

import numpy as np

from .curves import nearest_effects
from .linear import is_seen, Set
from .search import Found
from .settle import ladder_set, LEAST, probabilities
from .state import (
    amplitudes_of, candidates, fitted_state, is_noise, linearised, State, with_effect)
from ..calibration import ENOUGH
from ..effects import (
    CATALOGUE, CHANGES, Effect, EffectKey, EFFECTS, EMPIRICAL, EmpiricalCurve, entry_of,
    formula_of, included, kind_of, Model, OwnEffect, parameter_names, PROCESSES, shown_name,
    unchanged, variable_of, WANDER)
from ..estimate import Fit, kinds
from ..geometry import ATTITUDES
from ..statistics import rms
from ..table import column_of, Floats, Poses
from ..units import MG

MOST_RIVALS = 3
"""Largest number of rivals of an effect that is called the explanation."""

_LEAST_VISIBLE = 0.1
"""Smallest visible change of the residuals by an effect of typical size, relative to the noise."""

_NEAR = np.cos(np.radians(30.0))
"""Poses within 30° of a direction count as poses of this direction."""

_FAR = 10.0
"""Ratio to the typical size above which there is a remark."""

_FEW = 10
"""Degrees of freedom below which most effects cannot be detected."""

Verdict = Literal['no_gap', 'explained', 'described', 'drifts', 'unexplained']


@dataclass(frozen=True)
class Remark:
    """Something to say: its kind, and the figures of the sentence by name."""

    kind: str
    figures: Mapping[str, Any]


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
        Probability of the effect and of each effect in its place, by name. An effect that is far
        larger than in common sensors is less probable.
    data_probabilities : dict
        The same by the data alone, whatever is usual.
    parameters : dict
        Values by name. For a change of a stored calibration: the changes of the values.
    parameters_sd : dict
        Their standard deviations, of those that are fitted; empty in a refused refinement, in
        which they do not hold.
    gap_before_mg, gap_after_mg : float
        Residual without and with the effect [mg].
    held_out_before_mg, held_out_after_mg : float
        Held-out residual without and with the effect [mg].
    p_value : float
        Probability that noise alone makes one of all candidates this good.
    place : Remark
        Directions, range or poses of the disagreement; `where` in words.
    name : EffectKey
        The effect in the model: its name in the catalogue, or its record.
    variable : str
        Quantity that a covariate or a curve is a function of; empty for other effects.
    formula : str
        Formula of an empirical curve, in C and Python; empty for other effects.

    """

    effect: str = field(init=False)
    rivals: tuple[str, ...]
    probabilities: dict[str, float]
    data_probabilities: dict[str, float]
    parameters: dict[str, float]
    parameters_sd: dict[str, float]
    gap_before_mg: float
    gap_after_mg: float
    held_out_before_mg: float
    held_out_after_mg: float
    p_value: float
    place: Remark
    name: EffectKey
    formula: str = ''
    variable: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, 'effect', kind_of(self.name))
        object.__setattr__(self, 'variable', variable_of(self.name))

    @property
    def where(self) -> str:
        """Return the place of the disagreement in words."""
        return str(import_module('accel_calib.findings').place_words(self))

    def odds(self, rival: str) -> tuple[float, float]:
        """Return the probability of a rival, and that by the data alone."""
        least = LEAST / 10.0  # those left out are small
        return self.probabilities.get(rival, least), self.data_probabilities.get(rival, least)

    @property
    def times_typical(self) -> float:
        """Return the largest value relative to that of typical parts; 0: not known."""
        if self.effect == EMPIRICAL:
            return 0.0
        effect = entry_of(self.name)
        return max((abs(self.parameters.get(name, 0.0)) for name in effect.parameters),
                   default=0.0) / effect.typical


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


def verdict_of(found: Found, steps: Sequence[Step], *, refused: bool) -> tuple[Verdict, bool]:
    """Return the verdict on a search, and whether it is undecided what explains the gap."""
    residual, _ = found.left
    if found.final.fit.noise_known and not is_noise(float(residual @ residual), found.final.dof):
        return 'unexplained', False
    if steps and (refused or any(len(step.rivals) > MOST_RIVALS for step in steps)
                  or found.one_curve):
        return 'unexplained', True
    if found.walk is not None:
        return 'drifts', False
    if found.curve is not None:
        return 'described', False
    return 'explained' if steps else 'no_gap', False


def steps_of(found: Found, start: State, date: str
             ) -> tuple[tuple[Step, ...], tuple[Stage, ...]]:
    """
    Return the steps of a search, and the residuals at each stage.

    The base `start` is as fitted, or as stored at a date.

    """
    states, values = [start], dict(found.base.model.values)
    names = [name for name in found.added if name != WANDER]
    for name in names[:-1]:
        nothing = np.zeros(len(entry_of(name).values))
        values = with_effect(values, name, found.final.model.values.get(name, nothing))
        states.append(fitted_state(Model(values), found.final.poses_g) or states[-1])
    states += [found.final] if names else []
    states += states[-1:] if WANDER in found.added[-1:] else []  # it changes no value
    of_output = _output_steps(found)
    steps = (*of_output, *(_step(name, *pair, found, date) for name, pair in zip(
        found.added, pairwise(states), strict=False)))
    titles = ('base', *(step.effect for step in steps))
    at = (*states[:1] * len(of_output), *states)  # limit and grid leave the residuals
    return steps, tuple(
        Stage(name, state.mg_of_poses(found.left[1] if name == WANDER else state.fit.residual))
        for name, state in zip(titles, at, strict=True))


def _step(name: EffectKey, before: State, after: State, found: Found, date: str) -> Step:
    """Return the record of one step."""
    chances, by_data = (_chances(name, found, usual=usual) for usual in (True, False))
    rivals = tuple(other for other, part in {**by_data, **chances}.items()
                   if other != kind_of(unchanged(name))
                   and max(part, by_data.get(other, 0.0)) > LEAST)
    first, last, held_out = before.fit.residual, after.fit.residual, after.held_out
    is_stored = name == found.added[0] and 'new' in before.poses_g
    first_held_out = first if is_stored else before.held_out  # the stored model has not seen them
    if name == WANDER:
        first, first_held_out = before.residual, before.held_out
        last = held_out = found.left[1]  # it follows the poses: what it predicts counts
    effect, place = entry_of(name), _place(name, before, found)
    values = found.final.model.values.get(name, np.zeros(len(effect.values)))
    spread = dict(zip(parameter_names(found.final.model.effects),
                      np.sqrt(np.diag(found.final.fit.covariance)).tolist(), strict=True))
    deviations = {part: spread.get(f'{name}.{part}', 0.0) for part in effect.values}
    if name in CHANGES:
        change = zip(values.tolist(), deviations.values(), strict=True)
        place = replace(place, figures={**place.figures, 'change': [*change], 'date': date})
    shown = effect.shown(values)
    return Step(
        name=unchanged(name), rivals=rivals, probabilities=chances, data_probabilities=by_data,
        parameters=shown,
        parameters_sd={part: deviations[part] for part in shown if deviations[part]},
        gap_before_mg=before.gap_mg(first), gap_after_mg=after.gap_mg(last),
        held_out_before_mg=before.gap_mg(first_held_out),
        held_out_after_mg=after.gap_mg(held_out), p_value=_p_value(name, found), place=place,
        formula=formula_of(name, values, spread))


def _chances(name: EffectKey, found: Found, *, usual: bool) -> dict[str, float]:
    """Return the probabilities of an effect and of those in its place, by the names shown."""
    own, chances = shown_name(name), dict[str, float]()
    for other, part in probabilities(name, found.near, usual=usual).items():
        shown = kind_of(unchanged(name)) if shown_name(other) == own else shown_name(other)
        chances[shown] = chances.get(shown, 0.0) + part
    return chances


def _p_value(name: EffectKey, found: Found) -> float:
    near, final = found.near, found.final
    if name == WANDER:
        return math.exp(-found.walk.likelihood_ratio / 2.0) if found.walk else 1.0
    if found.curve is not None and name == found.curve.name:
        return found.curve.p_value
    if name in near.names:
        return near.chosen.probability(name)
    return ladder_set(final, name).probability(name)


def _output_steps(found: Found) -> list[Step]:
    after, causes = found.base, list[tuple[str, str, float, State, Remark]]()
    if found.clipped is not None and found.with_clipped is not None:
        whole, limit_g = found.with_clipped, found.clipped.limit_g
        rows = whole.poses_g.row[found.clipped.poses].tolist()
        causes.append(('saturation', 'limit', limit_g, whole,
                       Remark('limit', {'rows': rows, 'limit_g': limit_g})))
    if found.grid_g is not None:
        causes.append(('quantisation', 'step', found.grid_g, after,
                       Remark('grid', {'step_mg': found.grid_g * MG})))
    return [Step(
        name=name, rivals=(), probabilities={name: 1.0}, data_probabilities={name: 1.0},
        parameters={value_name: value}, parameters_sd={}, p_value=0.0, place=place,
        gap_before_mg=before.gap_mg(before.residual), gap_after_mg=after.gap_mg(after.residual),
        held_out_before_mg=before.gap_mg(before.held_out),
        held_out_after_mg=after.gap_mg(after.held_out))
        for name, value_name, value, before, place in causes]


def _place(name: EffectKey, before: State, found: Found) -> Remark:
    """Return where an effect acts, by its values in the final model."""
    final, effect = found.final, entry_of(name)
    poses_g = final.poses_g
    if name in final.model.values:
        alone = Model({name: final.model.values[name]})
        share = final.fit.equations.columns(alone) @ amplitudes_of(alone)
    else:
        share = final.residual - found.left[0]
    share_mg = final.mg_of_poses(share)
    if isinstance(name, EmpiricalCurve):
        return _place_of_curve(name, before, poses_g, share_mg)
    if 'instant' in effect.shape:
        time, row = poses_g['time'], poses_g.row
        instant = final.model.values[name][effect.values.index('instant')]
        last, first = (int(np.nanargmin(np.where(part, np.abs(time - instant), np.nan)))
                       for part in (time < instant, time >= instant))
        return Remark('instant', {'times': (float(time[last]), float(time[first])),
                                  'rows': (int(row[last]), int(row[first]))})
    column = next((key for key in effect.needs
                   if key in poses_g and key not in ('new', 'previous')), None)
    if column is None:
        return _largest_directions(final.fit.equations.force, share_mg)
    values = poses_g[column]
    known = np.isfinite(values.reshape(len(share_mg), -1)).all(axis=1)
    values, share_mg = values[known], share_mg[known]
    if values.ndim > 1:
        values = np.linalg.norm(values, axis=1)
    order = np.argsort(values, kind='stable')
    ends = max(1, len(order) // 5)
    return Remark('range', {
        'column': column, 'range': (float(values[order[0]]), float(values[order[-1]])),
        'ends_mg': (rms(share_mg[order[:ends]]), rms(share_mg[order[-ends:]]))})


def _place_of_curve(curve: EmpiricalCurve, before: State, poses_g: Poses, share_mg: Floats
                    ) -> Remark:
    """Return what a curve changes in these poses, and the known effects that are most similar."""
    variable, between = curve.variable, None
    if variable not in ('force', 'direction', 'std'):  # a variable of one number
        values = poses_g[variable]
        parts = np.array_split(np.argsort(values, kind='stable'), 5)
        middle = [float(np.mean(values[part])) for part in parts]
        size = [rms(share_mg[part]) for part in parts]
        at = int(np.argmax(np.abs(np.diff(size))))
        between = middle[at], middle[at + 1]
    return Remark('curve', {
        'carrier': curve.carrier, 'part': curve.part, 'variable': variable, 'between': between,
        'most_mg': float(np.max(np.abs(share_mg))), 'nearest': nearest_effects(before)})


def _largest_directions(force: Floats, share_mg: Floats) -> Remark:
    """Return the three directions with the largest disagreement, by the signs of their axes."""
    signs, near = np.sign(ATTITUDES), ATTITUDES @ force.T >= _NEAR
    counts = np.sum(near, axis=1)
    means = np.where(counts > 0, near @ share_mg / np.maximum(counts, 1), 0.0)
    sizes = np.round(np.abs(means) / max(float(np.max(np.abs(means))), 1e-300), 6)
    # The first of equals, which a sum in another order does not change.
    largest = [k for k in np.argsort(-sizes, kind='stable')[:3] if counts[k]]
    return Remark('directions', {'poses': len(share_mg), 'directions': [
        (signs[k].tolist(), float(means[k]), int(counts[k])) for k in largest]})


def untestable(found: Found, steps: Sequence[Step]) -> tuple[tuple[str, str], ...]:
    """Return the effects that the poses of a search cannot show, with the data to record."""
    linear, testable = found.near.plain, dict[str, float]()
    # What effects of typical size add to the residual, if they are seen at all.
    for numbers, index, left in found.near.beside.beside(linear.by_width):
        sizes = linear.sizes[index]
        squares = np.linalg.eigvalsh(left * sizes[:, np.newaxis] * sizes[:, :, np.newaxis])
        seen = is_seen(np.linalg.eigvalsh(left)).any(axis=1)
        for number, square in zip(numbers[seen].tolist(), squares[seen, -1].tolist()):
            block = linear.blocks[number]
            name = str(block.effect)
            testable[name] = max(math.sqrt(square) * block.entry.typical, testable.get(name, 0.0))
    present = (*found.final.model.effects, *(rival for step in steps for rival in step.rivals))
    return not_testable(found.final.poses_g, testable, present, found.also)


def not_testable(poses_g: Poses, testable: Mapping[str, float], present: tuple[EffectKey, ...],
                 also: tuple[OwnEffect, ...] = ()) -> tuple[tuple[str, str], ...]:
    """
    Return the effects that these poses cannot show, with the data to record.

    `testable` are the effects that the poses distinguish from the model, and how visible they
    are; `present` are the effects of the model and their rivals, `also` own effects.

    """
    missing = []
    unknown = not len(kinds(poses_g)[0])
    passed = {*map(str, present), *included(each for each in present if each in CATALOGUE)}
    for name, effect in named_entries(also).items():
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


def named_entries(also: tuple[OwnEffect, ...]) -> dict[str, Effect]:
    """Return the effects that poses can show, by name, with own ones."""
    return {**EFFECTS, **PROCESSES, **{own.name: own.entry for own in also}}


def remarks_on(found: Found, steps: tuple[Step, ...], untestable: tuple[tuple[str, str], ...],
               left_out: int, *, unexplained: bool = False, cause: str = '') -> tuple[Remark, ...]:
    """
    Return remarks for advice.

    `untestable` are the effects that the data cannot show, and the data to record for them;
    `left_out` is the number of poses that were left out; `unexplained`: a gap remains, and `cause`
    is the advice on a probable one, if any.

    """
    poses_g, remarks = found.base.poses_g, list[Remark]()
    changes = {name: float(np.max(np.abs(values)))
               for name, values in found.final.model.values.items() if name in CHANGES}
    worst = max(changes, key=lambda name: changes[name] / entry_of(name).repeatable_g, default='')
    if worst and changes[worst] > entry_of(worst).repeatable_g:  # too large for one sensor
        remarks.append(Remark('other_sensor', {'effect': worst, 'change': changes[worst]}))
    if 'new' in poses_g and 'reference' not in poses_g:
        remarks.append(Remark('mount_not_seen', {}))
    remarks += _remarks_on_effects(found, steps)
    if left_out:
        remarks.append(Remark('left_out', {'poses': left_out}))
    if found.base.dof < _FEW:
        remarks.append(Remark('few', {'poses': len(poses_g), 'dof': found.base.dof}))
    if unexplained and cause:
        remarks.append(Remark('cause', {'advice': cause}))
    elif unexplained and not (found.taken_back or found.curve or WANDER in found.added):
        ratio = float(np.sqrt(found.final.rss / found.final.dof))
        remarks.append(Remark('scatter', {'ratio': ratio}))
    elif unexplained:
        remarks.append(Remark('gap', {'taken_back': [*map(str, found.taken_back)]}))
        entries = named_entries(found.also)
        columns = sorted({needs for effect, needs in untestable if entries[effect].needs})
        remarks += [Remark('record', {'columns': columns})] if columns else []
    return tuple(remarks)


def _remarks_on_effects(found: Found, steps: tuple[Step, ...]) -> Iterator[Remark]:
    for step in (step for step in steps if step.rivals):
        families = {entry_of(step.name).family, *(
            CATALOGUE[name].family if name in CATALOGUE else '' for name in step.rivals)}
        yield Remark('rivals', {'effect': step.effect, 'rivals': step.rivals,
                                'family': families.pop() if len(families) == 1 else ''})
    for own in found.also:
        if own not in found.final.model.values:
            for constant, value in _constants_at_bounds(own, found).items():
                yield Remark('at_bound', {'effect': own.name, 'constant': constant,
                                          'value': value})
    for step in steps:
        effect = entry_of(step.name)
        if step.times_typical > _FAR:
            yield Remark('unusual', {
                'effect': step.effect, 'size': step.times_typical * effect.typical,
                'unit': effect.unit, 'typical': effect.typical})
    if found.one_curve:
        yield Remark('one_curve', {'effects': found.one_curve})


def _constants_at_bounds(own: OwnEffect, found: Found) -> dict[str, float]:
    """Return the constants at their bounds of an own effect that would help."""
    effect, final, curve = own.entry, found.final, found.curve
    before = final if curve is None else final.refit_without((curve.name,))
    tried = () if before is None else tuple(candidates((own,), final.poses_g))
    if before is None or not tried or not effect.bounds:
        return {}
    alone = Set.of(linearised(before.fit, before.model.effects, tried))
    grown = alone.extended(alone.best_of(own))
    after = None if grown.score <= 0.0 else fitted_state(Model(with_effect(
        before.model.values, own, grown.values[own])), final.poses_g)
    shape = () if after is None else effect.split(after.model.values[own])[1].tolist()
    return {constant: value for constant, value, bounds in zip(
        effect.shape, shape, effect.bounds) if value in bounds}


def find_rivals(found: Found) -> list[dict[EffectKey, tuple[float, Fit]]]:
    """
    Return probability and fit of each effect and its rivals, if the data do not decide.

    What is usual does not replace a pose that would show it. A random walk of the offset cannot be
    predicted, so there are no rivals beside it.

    """
    rivalries, near, final = [], found.near, found.final
    for name in () if near.walk is not None else near.names:
        fits, others = {name: final.fit}, near.chosen.without(name)
        kept = {key: part for key, part in final.model.values.items() if key != name}
        weights = probabilities(name, near, usual=False)
        for rival, weight in weights.items():
            if rival == WANDER or shown_name(rival) == shown_name(name) or weight <= LEAST:
                continue
            beside = others.extended(others.best_of(rival))
            model = Model(with_effect(kept, rival, beside.values[rival]))
            state = fitted_state(model, final.poses_g)
            if state is not None:
                fits[rival] = state.fit
        total = sum(weights[each] for each in fits)
        if len(fits) > 1 and max(weights[each] for each in fits) < ENOUGH * total:
            rivalries.append({each: (weights[each] / total, fit) for each, fit in fits.items()})
    return rivalries
