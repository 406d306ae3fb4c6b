# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a refinement came to, as records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..calibrate import Calibration
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
        Effects that these data cannot tell from it.
    parameters : dict
        Its values, by name.
    gap_before_mg, gap_after_mg : float
        Gap without and with it [mg].
    held_out_before_mg, held_out_after_mg : float
        The same over poses held out [mg].
    p_value : float
        Probability that noise alone makes one of all candidates this good.
    where : str
        Where the disagreement sat.

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


@dataclass(frozen=True)
class Refinement:
    """
    What a refinement came to.

    Parameters
    ----------
    verdict : {'no_gap', 'explained', 'unexplained'}
        Nothing beyond the noise; named, and the rest is noise; or a gap remains.
    noise_floor_mg : float or None
        What the gap would be were the model right [mg]; None where the noise is not known.
    gap_mg, remaining_gap_mg : float
        Gap of the base and of the refined model [mg].
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
    poses_g : Poses
        The poses kept, in g.
    force : (n, 3) array
        Unit force of each, in the axes of the sensor.
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
    poses_g: Poses
    force: Floats
    stages: tuple[Stage, ...]
