# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The steps of a refinement from what a search found, and advice.

**One model.** A step has the residuals without and with its effect. All else that is stated of it
is of the final model: values, deviations, rivals, probabilities, and where it acts, which is an
instant, the ends of the range of a column, or directions of the force.

**Not testable.** Effects that the poses cannot show, and the data to record for them.

"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
import math
from typing import Literal

import numpy as np

from .curves import LEAST, nearest_effects, probabilities
from .linear import is_seen, Set
from .search import Found
from .settle import ladder_set
from .state import candidates, fitted_state, is_noise, linearised, State, with_effect
from ..effects import (
    CATALOGUE, CHANGES, Covariate, Effect, EffectKey, EFFECTS, EMPIRICAL, EmpiricalCurve, entry_of,
    formula_of, included, kind_of, Model, OwnEffect, parameter_names, PROCESSES, TO_SEPARATE,
    unit_of, value_unit, variable_of, variable_words, WANDER)
from ..estimate import kinds
from ..geometry import ATTITUDES, axes_of_signs
from ..statistics import rms
from ..table import column_of, Floats, Poses
from ..text import counted, listed, with_minus, with_sd
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

_APART = 0.05
"""Difference of two probabilities above which both are stated."""

_LEAST_P = 1e-16

Verdict = Literal['no_gap', 'explained', 'described', 'drifts', 'unexplained']


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
    where : str
        Directions, range or poses of the disagreement.
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
    where: str
    name: EffectKey
    formula: str = ''
    variable: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, 'effect', kind_of(self.name))
        object.__setattr__(self, 'variable', variable_of(self.name))

    @property
    def likely_rivals(self) -> tuple[str, ...]:
        """Return the rivals with their probabilities, such as ``quadratic (11 %)``."""
        return tuple(f'{name} ({self.odds(name)})' for name in self.rivals)

    def odds(self, rival: str) -> str:
        """Return the probability of a rival, and that by the data alone if it differs much."""
        whole, alone = (each.get(rival, LEAST / 10.0) for each in (  # those left out are small
            self.probabilities, self.data_probabilities))
        by_data = f', by the data alone {percent(alone)}' if abs(alone - whole) > _APART else ''
        return f'{percent(whole)}{by_data}'


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


def chance(p_value: float) -> str:
    """Return the probability that noise alone explains a step."""
    return f'p < {_LEAST_P:.0e}' if p_value < _LEAST_P else f'p = {p_value:.1g}'


def percent(probability: float) -> str:
    """Return a probability as text; only certainty is 0 or 100 %."""
    if 0.0 < probability < 0.005:
        return '< 1 %'
    return '> 99 %' if 0.995 <= probability < 1.0 else f'{100.0 * probability:.0f} %'


def values_of(step: Step) -> list[tuple[str, str]]:
    """
    Return name and text of each value of a step, ± its deviation; values in g are in mg.

    A curve that has a formula is stated by that.

    """
    if step.formula:
        return [('', step.formula)]
    parameters, values = entry_of(step.name).parameters, []
    for name, value in step.parameters.items():
        unit_name, scale = value_unit(step.name, name)
        sd = step.parameters_sd.get(name, 0.0)
        words = with_sd(value * scale, sd * scale) if sd else f'{value * scale:.5g}'
        sign = '+' if name in parameters and value >= 0.0 else ''
        values.append((name, with_minus(f'{sign}{words} {unit_name}'.rstrip())))
    return values


def unchanged(effect: EffectKey) -> EffectKey:
    """Return an effect, for a change the effect that has changed."""
    return entry_of(effect).base or effect


def shown_name(effect: EffectKey) -> str:
    """Return the name of an effect among rivals; a covariate keeps its quantity."""
    if isinstance(effect, Covariate):
        return str(replace(effect, power=1))
    return kind_of(unchanged(effect))


def verdict_of(found: Found, steps: Sequence[Step], *, refused: bool) -> tuple[Verdict, bool]:
    """Return the verdict on a search, and whether it is undecided what explains the gap."""
    residual, _ = beside_walk(found)
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
        Stage(name, state.mg_of_poses(beside_walk(found)[1] if name == WANDER
                                      else state.fit.residual))
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
        last = held_out = beside_walk(found)[1]  # it follows the poses: what it predicts counts
    effect, words = entry_of(name), _where(name, before, found)
    values = found.final.model.values.get(name, np.zeros(len(effect.values)))
    spread = dict(zip(parameter_names(found.final.model.effects),
                      np.sqrt(np.diag(found.final.fit.covariance)).tolist(), strict=True))
    deviations = {part: spread.get(f'{name}.{part}', 0.0) for part in effect.values}
    if name in CHANGES:
        words = f'{_change(name, values, [*deviations.values()], date)}; {words}'
    shown = effect.shown(values)
    return Step(
        name=unchanged(name), rivals=rivals, probabilities=chances, data_probabilities=by_data,
        parameters=shown,
        parameters_sd={part: deviations[part] for part in shown if deviations[part]},
        gap_before_mg=before.gap_mg(first), gap_after_mg=after.gap_mg(last),
        held_out_before_mg=before.gap_mg(first_held_out),
        held_out_after_mg=after.gap_mg(held_out), p_value=_p_value(name, found), where=words,
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
        return near.chosen.probability(near.block_of(name))
    chosen, block = ladder_set(final, name)
    return chosen.probability(block)


def _output_steps(found: Found) -> list[Step]:
    after, causes = found.base, list[tuple[str, str, float, State, str]]()
    if found.clipped is not None and found.with_clipped is not None:
        whole, limit_g = found.with_clipped, found.clipped.limit_g
        rows = listed('row', whole.poses_g.row[found.clipped.poses].tolist())
        causes.append(('saturation', 'limit', limit_g, whole, f'in {rows}: an axis reads '
                       f'{limit_g:.4g} g and its samples hardly scatter'))
    if found.grid_g is not None:
        step_mg = found.grid_g * MG
        causes.append(('quantisation', 'step', found.grid_g, after, 'pose means are multiples of '
                       f'{step_mg:.3g} mg, which causes {step_mg / np.sqrt(12.0):.2g} mg RMS per '
                       'axis'))
    return [Step(
        name=name, rivals=(), probabilities={name: 1.0}, data_probabilities={name: 1.0},
        parameters={value_name: value}, parameters_sd={}, p_value=0.0, where=where,
        gap_before_mg=before.gap_mg(before.residual), gap_after_mg=after.gap_mg(after.residual),
        held_out_before_mg=before.gap_mg(before.held_out),
        held_out_after_mg=after.gap_mg(after.held_out))
        for name, value_name, value, before, where in causes]


def beside_walk(found: Found) -> tuple[Floats, Floats]:
    """Return the final residual without the walk, and the same held out."""
    final = found.final
    if found.walk is None:
        return final.residual, final.held_out
    return found.walk.residuals(Set.of(final.linear), final.fit.equations.force)


def _curve(curve: EmpiricalCurve, before: State, share_mg: Floats) -> str:
    """Return what an empirical curve changes, and the known effects that are most similar."""
    variable = curve.variable
    what = 'size of the force' if curve.carrier == 'force' else curve.carrier.replace('_', '-')
    words = (f'the {what}{f" of {curve.part}" if curve.part else ""} changes with '
             f'{variable_words(variable)} by up to {np.max(np.abs(share_mg)):.2g} mg')
    if variable not in ('force', 'direction', 'std'):  # a variable of one number
        values = before.poses_g[variable]
        parts = np.array_split(np.argsort(values, kind='stable'), 5)
        middle = [float(np.mean(values[part])) for part in parts]
        size = [rms(share_mg[part]) for part in parts]
        at = int(np.argmax(np.abs(np.diff(size))))
        words += (f', most between {middle[at]:.4g} and {middle[at + 1]:.4g} '
                  f'{unit_of(variable)}').rstrip()
    nearest = [f'{effect} (leaves {left:.2g} mg)'
               for effect, left in nearest_effects(before).items()]
    return words + (f'; no known effect has this form, the nearest are {", ".join(nearest)}'
                    if nearest else '')


def _where(name: EffectKey, before: State, found: Found) -> str:
    """Return where an effect acts, by its values in the final model."""
    final, effect = found.final, entry_of(name)
    poses_g = final.poses_g
    share_mg = (final.contribution_mg(name) if name in final.model.values else
                final.mg_of_poses(final.residual - beside_walk(found)[0]))
    if isinstance(name, EmpiricalCurve):
        return _curve(name, before, share_mg)
    if 'instant' in effect.shape:
        time, row = poses_g['time'], poses_g.row
        instant = final.model.values[name][effect.values.index('instant')]
        last, first = (int(np.nanargmin(np.where(part, np.abs(time - instant), np.nan)))
                       for part in (time < instant, time >= instant))
        return (f'between {time[last]:.6g} and {time[first]:.6g} s (rows {row[last]} and '
                f'{row[first]})')
    column = next((key for key in effect.needs
                   if key in poses_g and key not in ('new', 'previous')), None)
    if column is None:
        return _directions(final.fit.equations.force, share_mg)
    return _range(column, poses_g[column], share_mg)


def _range(column: str, values: Floats, share_mg: Floats) -> str:
    """Return a text about the range of a quantity and the disagreement at both ends."""
    known = np.isfinite(values.reshape(len(share_mg), -1)).all(axis=1)
    values, share_mg = values[known], share_mg[known]
    if values.ndim > 1:
        values = np.linalg.norm(values, axis=1)
    order = np.argsort(values, kind='stable')
    ends = max(1, len(order) // 5)
    low, high = rms(share_mg[order[:ends]]), rms(share_mg[order[-ends:]])
    span = f'{values[order[0]]:.4g} to {values[order[-1]]:.4g} {unit_of(column)}'.rstrip()
    return (f'over {column.replace("_", " ")} {span}: {low:.2g} mg RMS in the lowest fifth of the '
            f'poses, {high:.2g} mg in the highest')


def _directions(force: Floats, share_mg: Floats) -> str:
    """Return a text about the three directions with the largest disagreement."""
    signs, near = np.sign(ATTITUDES), ATTITUDES @ force.T >= _NEAR
    counts = np.sum(near, axis=1)
    means = np.where(counts > 0, near @ share_mg / np.maximum(counts, 1), 0.0)
    sizes = np.round(np.abs(means) / max(float(np.max(np.abs(means))), 1e-300), 6)
    # The first of equals, which a sum in another order does not change.
    largest = [k for k in np.argsort(-sizes, kind='stable')[:3] if counts[k]]
    return 'with ' + ', '.join(
        f'{axes_of_signs(signs[k])} up ({means[k]:+.2g} mg over {counts[k]} of {len(share_mg)} '
        'poses)' for k in largest)


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


def _change(name: EffectKey, values: Floats, deviations: Sequence[float], date: str) -> str:
    """Return the change of values since a stored calibration of a date, with uncertainties."""
    effect = entry_of(unchanged(name))
    scale, unit_name = (1e3, 'mg') if effect.is_offset else (100.0, '%')
    shown = ', '.join(f'{"+" if value > 0.0 else ""}{with_sd(value * scale, sd * scale)}'
                      for value, sd in zip(values.tolist(), deviations, strict=True))
    since = f' since {date[:10]}' if date else ''
    return f'the {effect.words} has changed by ({shown}) {unit_name}{since}'


def advice_for(found: Found, steps: tuple[Step, ...], untestable: tuple[tuple[str, str], ...],
               left_out: int, *, unexplained: bool = False) -> tuple[str, ...]:
    """
    Return advice for the user, one line each.

    `untestable` are the effects that the data cannot show, and the data to record for them;
    `left_out` is the number of poses that were left out; `unexplained`: a gap remains.

    """
    lines, poses_g = _other_sensor(found), found.base.poses_g
    if 'new' in poses_g and 'reference' not in poses_g:
        lines.append('a mount that has turned since the calibration cannot show: only |force| = '
                     '1 g is known; take poses of known orientation (ref_x, ref_y, ref_z) with '
                     'both')
    for step in (step for step in steps if step.rivals):
        families = {entry_of(step.name).family, *(
            CATALOGUE[name].family if name in CATALOGUE else '' for name in step.rivals)}
        family = families.pop() if len(families) == 1 else ''
        lines.append(f'{step.effect} cannot be distinguished from {", ".join(step.rivals)} here: '
                     f'{TO_SEPARATE[family]}')
    lines += [line for own in found.also if own not in found.final.model.values
              for line in _at_bounds(own, found)]
    for step in steps:
        times, effect = times_typical(step), entry_of(step.name)
        if times > _FAR:
            lines.append(f'{step.effect} is {times * effect.typical:.2g} {effect.unit}, typical '
                         f'parts have about {effect.typical:.2g}: check that the sensor causes '
                         'it, and not the setup')
    if found.one_curve:
        lines.append(f'{" and ".join(found.one_curve)} may be parts of one curve: take '
                     'more poses in all directions, which show its form')
    if left_out:
        were, them = ('was', 'it') if left_out == 1 else ('were', 'them')
        lines.append(f'{counted(left_out, "pose")} {were} left out; take {them} again')
    if found.base.dof < _FEW:
        lines.append(f'{counted(len(poses_g), "pose")} leave '
                     f'{counted(found.base.dof, "degree")} of freedom, which is too few to detect '
                     'most effects: take 24 poses or more')
    if unexplained:
        lines += _unexplained(found, untestable)
    return tuple(lines)


def _at_bounds(own: OwnEffect, found: Found) -> list[str]:
    """Return a line for each constant of an own effect that would help, but ends at a bound."""
    effect, final, curve = own.entry, found.final, found.curve
    before = final if curve is None else fitted_state(Model({
        each: part for each, part in final.model.values.items() if each != curve.name}),
        final.poses_g)
    tried = () if before is None else tuple(candidates((own,), final.poses_g))
    if before is None or not tried or not effect.bounds:
        return []
    alone = Set.of(linearised(before.fit, before.model.effects, tried))
    grown = alone.extended(best := alone.best_of(own))
    after = None if grown.score <= 0.0 else fitted_state(Model(with_effect(
        before.model.values, own, np.concatenate(
            [grown.values[best], alone.linear.blocks[best].shape]))), final.poses_g)
    shape = () if after is None else effect.split(after.model.values[own])[1].tolist()
    return [f'{own} is not used, because its constant {constant} ends at its bound {value:.4g}: '
            'widen the bounds in its definition, or use another function'
            for constant, value, bounds in zip(effect.shape, shape, effect.bounds)
            if value in bounds]


def _unexplained(found: Found, untestable: tuple[tuple[str, str], ...]) -> list[str]:
    final, nearest = found.final, ''
    if not found.taken_back and found.curve is None and WANDER not in found.added:
        return [f'poses repeat {np.sqrt(final.rss / final.dof):.1f} times worse than their '
                'samples, and the scatter has no structure: clamp the sensor, let it settle '
                'longer']
    if found.taken_back:
        nearest = f'; {", ".join(map(str, found.taken_back))} would explain only a part'
    lines = [f'a gap remains that no effect testable with these data explains{nearest}: check '
             'what differs between the poses, and repeat some of them']
    entries = named_entries(found.also)
    columns = sorted({needs for effect, needs in untestable if entries[effect].needs})
    if columns:
        lines.append(f'record {"; ".join(columns)}: their effects cannot be tested yet')
    return lines


def _other_sensor(found: Found) -> list[str]:
    """Return a line if the changes are too large for one sensor."""
    changes = {name: float(np.max(np.abs(values)))
               for name, values in found.final.model.values.items() if name in CHANGES}
    by_limit = {name: change / CHANGES[name].repeatable_g for name, change in changes.items()}
    name = max(by_limit, key=by_limit.__getitem__, default='')
    if not name or by_limit[name] <= 1.0:
        return []
    return [f'this is probably another sensor: its {CHANGES[name].base} differs from the stored '
            f'one by {changes[name]:.2g} {CHANGES[name].unit}, which is too much for one sensor; '
            'fit a new calibration from its own poses']


def times_typical(step: Step) -> float:
    """Return the largest value of an effect relative to that of typical parts; 0: not known."""
    if step.effect == EMPIRICAL:
        return 0.0
    effect = entry_of(step.name)
    return max((abs(step.parameters.get(name, 0.0)) for name in effect.parameters),
               default=0.0) / effect.typical
