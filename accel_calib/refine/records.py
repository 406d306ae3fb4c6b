# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The result of a refinement, as records."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Literal

from ..calibrate import Calibration
from ..html_table import table
from ..table import Floats, Poses

Verdict = Literal['no_gap', 'explained', 'unexplained']


@dataclass(frozen=True)
class Step:
    """
    One effect that was added.

    Parameters
    ----------
    effect : str
        Its name in the catalogue.
    rivals : tuple of str
        Effects that these data cannot distinguish from it.
    parameters : dict
        Its values, by name; for a change of a stored calibration, by how much they changed.
    gap_before_mg, gap_after_mg : float
        Residual without and with it [mg].
    held_out_before_mg, held_out_after_mg : float
        The same over poses held out [mg].
    p_value : float
        Probability that noise alone makes one of all candidates this good.
    where : str
        Where the disagreement was.

    """

    effect: str
    rivals: tuple[str, ...]
    parameters: dict[str, float]
    gap_before_mg: float
    gap_after_mg: float
    held_out_before_mg: float
    held_out_after_mg: float
    p_value: float
    where: str


@dataclass(frozen=True)
class Stage:
    """
    What was left at one stage, for figures.

    Parameters
    ----------
    name : str
        ``base`` or the effect added.
    residual_mg : (n,) array
        Of each pose kept, signed where only |force| is known.

    """

    name: str
    residual_mg: Floats


@dataclass(frozen=True, repr=False)
class Refinement:
    """
    The result of a refinement.

    Parameters
    ----------
    verdict : {'no_gap', 'explained', 'unexplained'}
        Nothing beyond the noise; named, and the rest is noise; or a gap remains.
    noise_floor_mg : float or None
        What the gap would be if the model were right [mg]; None if the noise is not known.
    gap_mg, remaining_gap_mg : float
        Residual of the base and of the refined model [mg].
    steps : tuple of Step
        What was added, in order.
    disturbed_poses : tuple of int
        Rows of the poses left out.
    not_testable : tuple of (str, str)
        Effects that these data cannot show, and what to record.
    advice : tuple of str
        What to do.
    calibration : Calibration
        The refined calibration.
    refusal : tuple of str
        Why the calibration must not be stored or used, and what to do; empty if it may.
    poses_g : Poses
        The poses kept, in g.
    force : (n, 3) array
        Unit force of each, in the sensor axes.
    stages : tuple of Stage
        Residuals of the base and after each step.

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

    def __repr__(self) -> str:
        names = ' + '.join([self.calibration.name, *(step.effect for step in self.steps)])
        return (f'Refinement({self.verdict}: {names}; residual {self.gap_mg:.3g} -> '
                f'{self.remaining_gap_mg:.3g} mg)')

    def _repr_html_(self) -> str:
        """Return the steps as a table, for notebooks."""
        rows = [[step.effect, f'{step.gap_before_mg:.3g} → {step.gap_after_mg:.3g}',
                 f'{step.held_out_before_mg:.3g} → {step.held_out_after_mg:.3g}',
                 f'{step.p_value:.1g}', ', '.join(step.rivals), step.where] for step in self.steps]
        head = ['effect', 'residual [mg]', 'held out [mg]', 'p', 'rivals', 'where']
        lines = ''.join(f'<p>{escape(line)}</p>\n' for line in (repr(self), *self.advice))
        return (table(head, rows) if rows else '') + lines
