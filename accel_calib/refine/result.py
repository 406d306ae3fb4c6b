# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The record of a refinement, and its sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Literal

import numpy as np

from ..calibrate import Calibration
from ..effects import CHANGES, COVARIATES, effect_named, kind_of, value_unit, variable_of, WANDER
from ..table import Floats, is_quantity, Poses, Record
from ..text import counted, short, table

Verdict = Literal['no_gap', 'explained', 'described', 'unexplained']


ENOUGH = 0.95
"""Expected probability of the right effect at which a plan ends."""

NOTHING = (f'there is nothing to separate: no named effect has a rival that leaves it a '
           f'probability below {100.0 * ENOUGH:.0f} %')
"""The line of an empty plan."""

_LEAST_P = 1e-16

_VERDICTS = {
    'no_gap': 'No gap beyond the noise: these poses support no further effect.',
    'explained': 'The gap is explained: only noise remains beyond the named effects.',
    'described': 'The gap is described, not explained: only noise remains beyond {}, but its '
                 'cause is not known.',
    'unexplained': 'A gap remains that no effect of the catalogue explains.',
}


_APART = 0.05
"""Difference of two probabilities above which both are stated."""


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
    data_probabilities: dict[str, float]
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
        return tuple(f'{name} ({self.odds(name)})' for name in self.rivals)

    def odds(self, rival: str) -> str:
        """Return the probability of a rival, and that by the data alone if it differs much."""
        whole, alone = (each.get(rival, 0.0) for each in (
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


def verdict_words(result: Refinement) -> str:
    """Return the verdict as a sentence."""
    walks = any(step.effect == WANDER for step in result.steps)
    words = _VERDICTS[result.verdict].format(
        'a slow change of the offset' if walks else 'an empirical curve')
    if result.undecided:
        words = _undecided(result)
    elif result.verdict == 'unexplained' and result.steps:
        words = ('A gap remains beyond the named effects, and no effect of the catalogue explains '
                 'it.')
    if result.noise_floor_mg is None:
        words += (' The noise of the poses is not known (no std and count), so their scatter is '
                  'taken as the noise.')
    return words


def _undecided(result: Refinement) -> str:
    """Return why it is not known what explains a gap."""
    if result.refusal:
        why = result.refusal[0]
    else:
        most = max(result.steps, key=lambda step: len(step.rivals))
        why = f'{len(most.rivals)} others explain it about as well as {most.effect}'
    return f'Not enough poses: they cannot tell what explains the gap, because {why}.'


def residual_words(result: Refinement) -> str:
    """Return the residual of the base and of the refined model, and the noise floor."""
    floor = ('not known' if result.noise_floor_mg is None
             else f'{short(result.noise_floor_mg)} mg')
    residual = f'{short(result.gap_mg)} mg'
    if result.steps:
        residual = f'{short(result.gap_mg)} -> {short(result.remaining_gap_mg)} mg'
    poses = result.poses_g
    count = int(np.sum(poses['new'] > 0.0)) if 'new' in poses else len(poses)
    return f'residual {residual} over {counted(count, "pose")}, noise floor {floor}'


def base_words(result: Refinement) -> str:
    """Return the name of the base model."""
    name = result.calibration.name
    return 'ideal sensor' if name == 'ideal' else f'model {name}'


def chance(p_value: float) -> str:
    """Return the probability that noise alone explains a step."""
    return f'p < {_LEAST_P:.0e}' if p_value < _LEAST_P else f'p = {p_value:.1g}'


def percent(probability: float) -> str:
    """Return a probability as text; only certainty is 0 or 100 %."""
    if 0.0 < probability < 0.005:
        return '< 1 %'
    return '> 99 %' if 0.995 <= probability < 1.0 else f'{100.0 * probability:.0f} %'


def values_of(step: Step) -> list[tuple[str, str]]:
    """Return name and text of each value of a step; values in g are given in mg."""
    effect = effect_named(step.name)
    values = []
    for name, value in step.parameters.items():
        unit_name, scale = value_unit(step.name, name)
        words = (f'{value * scale:+.3g} {unit_name}'.replace('-', '−')
                 if name in effect.parameters else f'{value:.5g} {unit_name}'.rstrip())
        values.append((name, words))
    return values


def plain_name(name: str) -> str:
    """Return the name of an effect, for a change that of the effect that has changed."""
    return CHANGES[name].base if name in CHANGES else name


def shown_name(name: str) -> str:
    """Return the name of an effect among rivals; a covariate keeps its quantity."""
    if kind_of(name) in COVARIATES:
        return f'{kind_of(name)}-{variable_of(name)}'
    return plain_name(kind_of(name))


def versus(names: Sequence[str]) -> str:
    """Return the words of an effect and its rivals."""
    first, *others = (shown_name(name) for name in names)
    return f'{first} from {", ".join(others)}'


def condition_words(context: Mapping[str, float]) -> str:
    """Return the context of a planned pose in words; empty if the pose can be taken at once."""
    parts = []
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


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f'{seconds:.0f} s'
    return f'{seconds / 60.0:.0f} min' if seconds < 7200.0 else f'{seconds / 3600.0:.1f} h'
