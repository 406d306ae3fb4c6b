# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The records of a refinement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from html import escape
from typing import Literal

from .plan_words import percent, PosePlan
from ..calibrate import Calibration
from ..effects import EMPIRICAL
from ..table import Floats, Poses
from ..text import table

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
