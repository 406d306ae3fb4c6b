# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The records of a refinement and of a plan of poses, and the words of the plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
import math
from typing import Literal

import numpy as np

from ..calibrate import Calibration, words_of
from ..effects import EMPIRICAL
from ..geometry import ATTITUDES, unit
from ..table import Floats, Poses
from ..text import table

ENOUGH = 0.95
"""Expected probability of the right effect at which a plan ends."""

_NEAR = math.cos(math.radians(8.0))
"""A direction within 8° of a face, edge or corner has its name."""

VARIED = ('temperature', 'supply_voltage', 'time', 'std')
"""Context that a plan can vary, by column."""

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
        return f'to separate {_versus(self.separates)}'

    @property
    def conditions(self) -> str:
        """Return the context in words; empty if the pose can be taken at once."""
        parts = []
        if 'temperature' in self.context:
            parts.append(f'at {self.context["temperature"]:.0f} °C')
        if 'supply_voltage' in self.context:
            parts.append(f'at {self.context["supply_voltage"]:.2f} V')
        if 'std' in self.context:
            parts.append(f'with {1e3 * self.context["std"]:.2g} mg of vibration')
        if self.context.get('time', 0.0) > 0.0:
            parts.append(f'{_duration(self.context["time"])} after the last pose')
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
        return (f'next pose to separate {_versus(first.separates)}: {first.words}{where} (1 of '
                f'{len(self.poses)} poses, with which the expected probability of the right one '
                f'is {percent(last.expected)})',)


def percent(probability: float) -> str:
    """Return a probability as text; only certainty is 0 or 100 %."""
    if 0.0 < probability < 0.005:
        return '< 1 %'
    return '> 99 %' if 0.995 <= probability < 1.0 else f'{100.0 * probability:.0f} %'


def plan_lines(weights: Mapping[str, float], poses: Sequence[PlannedPose], expected: float
               ) -> Iterator[str]:
    """
    Yield the lines about one contest.

    Parameters
    ----------
    weights : mapping of str to float
        Probability of the named effect, then of its rivals.
    poses : sequence of PlannedPose
        The poses that separate them.
    expected : float
        Expected probability of the right one after all poses of the plan.

    """
    odds = ', '.join(percent(weight) for weight in weights.values())
    names = tuple(weights)
    end = f'the expected probability of the right one is then {percent(expected)}'
    if not poses and expected >= ENOUGH:
        yield f'to separate {_versus(names)} ({odds}), the same poses are enough: {end}'
    elif not poses:
        yield (f'to separate {_versus(names)} ({odds}), poses at 1 g do not help; apply '
               'other forces (a centrifuge)')
    else:
        yield f'to separate {_versus(names)} ({odds}), take these poses:'
        yield from _held(poses)
        yield end


def _held(poses: Sequence[PlannedPose]) -> Iterator[str]:
    """Yield one line for each condition; conditions with the same directions share a line."""
    directions: dict[str, list[str]] = {}
    for pose in poses:
        directions.setdefault(pose.conditions, []).append(pose.words)
    shared: dict[tuple[str, ...], list[str]] = {}
    for where, held in directions.items():
        shared.setdefault(tuple(_counted(held)), []).append(where)
    for texts, places in shared.items():
        where = ' and '.join(filter(None, places))
        yield f'{where + ": " if where else ""}hold {"; ".join(texts)}'


def _counted(words: Sequence[str]) -> Iterator[str]:
    """Yield each text once, with the number of times if there are several."""
    for each in dict.fromkeys(words):
        times = list(words).count(each)
        yield each if times == 1 else f'{each} ({times} poses)'


def _versus(names: Sequence[str]) -> str:
    """Return the words of an effect and its rivals."""
    first, *others = (name.removesuffix('_change') for name in names)
    return f'{first} from {", ".join(others)}'


def _duration(seconds: float) -> str:
    """Return a duration as text."""
    if seconds < 120.0:
        return f'{seconds:.0f} s'
    return f'{seconds / 60.0:.0f} min' if seconds < 7200.0 else f'{seconds / 3600.0:.1f} h'


def attitude_words(up: Floats) -> str:
    """Return a direction that points up in words: a face, edge or corner, or a tilted face."""
    known = ATTITUDES
    near = int(np.argmax(known @ up))
    if known[near] @ up >= _NEAR:
        return f'{words_of(np.sign(known[near]))} up ({_axes(known[near])})'
    axis = int(np.argmax(np.abs(up)))
    face = np.sign(up) * (np.arange(3) == axis)
    flat = unit((up - up[axis] * np.eye(3)[axis])[np.newaxis])[0]
    edges = known[known[:, axis] == 0.0]
    raised = edges[int(np.argmax(edges @ flat))]
    tilt = math.degrees(math.acos(min(abs(float(up[axis])), 1.0)))
    return (f'{words_of(face)} up ({_axes(face)}), tilted by {tilt:.0f}° so that '
            f'{words_of(np.sign(raised))} ({_axes(raised)}) rises')


def _axes(signs: Floats) -> str:
    """Return the axes of these signs, such as ``+x -y``."""
    return ' '.join(f'{"+" if sign > 0 else "-"}{axis}'
                    for axis, sign in zip('xyz', signs, strict=True) if sign)


Verdict = Literal['no_gap', 'explained', 'described', 'unexplained']


@dataclass(frozen=True)
class Step:
    """
    One added effect.

    Parameters
    ----------
    effect : str
        Name in the catalogue.
    rivals : tuple of str
        Effects that these data cannot distinguish from it.
    probabilities : dict
        Probability of the effect and of each effect in its place, by name.
    parameters : dict
        Values by name. For a change of a stored calibration: the changes of the values.
    gap_before_mg, gap_after_mg : float
        Residual without and with the effect [mg].
    held_out_before_mg, held_out_after_mg : float
        Held-out residual without and with the effect [mg].
    p_value : float
        Probability that noise alone makes one of all candidates this good.
    where : str
        Directions, range or poses of the disagreement.
    curve : str
        Name of an empirical curve in the model, with carrier, variable and modes; empty for other
        effects.

    """

    effect: str
    rivals: tuple[str, ...]
    probabilities: dict[str, float]
    parameters: dict[str, float]
    gap_before_mg: float
    gap_after_mg: float
    held_out_before_mg: float
    held_out_after_mg: float
    p_value: float
    where: str
    curve: str = ''

    @property
    def name(self) -> str:
        """Return the name by which `accel_calib.effects.effect_named` finds the effect."""
        return self.curve or self.effect

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


@dataclass(frozen=True, repr=False)
class Refinement:
    """
    The result of a refinement.

    Parameters
    ----------
    verdict : {'no_gap', 'explained', 'described', 'unexplained'}
        No gap beyond the noise; the effects are named and the rest is noise; the rest is noise
        only with an empirical curve; or a gap remains.
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

    def __post_init__(self) -> None:
        model = self.calibration.model
        curves = [name for name in model.effects if name.startswith(f'{EMPIRICAL}-')]
        steps = []
        for step in reversed(self.steps):  # earlier curves belong to the base
            steps.append(replace(step, curve=curves.pop()) if step.effect == EMPIRICAL and curves
                         else step)
        object.__setattr__(self, 'steps', tuple(reversed(steps)))

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
