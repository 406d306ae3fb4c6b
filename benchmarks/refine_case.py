# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
One case of the refinement benchmark: a set of poses with something hidden, refined and judged.

A name is right where it is the hidden effect, and right as a rival where it is another and names
the hidden effect among its rivals. The steps of the base (offset, gains) are no names.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import time
import traceback
from typing import Any

from accel_calib.calibrate import verify
from accel_calib.refine import refine
from accel_calib.table import COLUMNS, Poses
from accel_calib.units import units_of
from generator import again, basis_of, Setup, simulate, Simulated
import numpy as np
from refine_truth import true_form_gap_mg, WITHOUT_FORM

BASE = ('offset', 'gain', 'axis_gain', 'cross_axis', 'misalignment')

SHOWS = 5.0
"""A knock shows that is so many times the noise of a pose mean in |a|."""


@dataclass(frozen=True)
class Case:
    """
    What to hide, and how to take the poses.

    Parameters
    ----------
    row : str
        Row of the table.
    hidden : mapping of str to float
        Sizes by name.
    setup : Setup
        Poses.
    seed : tuple of int
        Of the random numbers.
    against_truth : bool
        Whether to fit the true form too.

    """

    row: str
    hidden: Mapping[str, float]
    setup: Setup
    seed: tuple[int, ...]
    against_truth: bool = False


@dataclass(frozen=True)
class Outcome:
    """
    What came of a case.

    Parameters
    ----------
    case : Case
        The case.
    verdict : str
        ``error`` where the refinement raised something.
    named : tuple of (str, tuple of str)
        Each effect that was named with its rivals.
    disturbed : frozenset of int
        Rows that were left out.
    knocked : mapping of int to float
        Rows that were knocked, and the knock in |a| over the noise.
    deviations : tuple of float
        Values of the hidden effects less the truth, over their standard deviations.
    held_out : tuple of float or None
        Gap in fresh poses: with the refined calibration, with the true form [mg].
    seconds : float
        Time of the refinement.
    error : str
        The traceback.

    """

    case: Case
    verdict: str
    named: tuple[tuple[str, tuple[str, ...]], ...]
    disturbed: frozenset[int]
    knocked: Mapping[int, float]
    deviations: tuple[float, ...]
    held_out: tuple[float, float] | None
    seconds: float
    error: str = ''

    @property
    def names(self) -> tuple[str, ...]:
        """Give the effects that were named."""
        return tuple(name for name, _ in self.named)

    @property
    def judgement(self) -> str:
        """Say ``exact``, ``rival``, ``wrong``, ``missed`` or ``error``."""
        if self.verdict == 'error':
            return 'error'
        found, wrong = set(), False
        for name, rivals in sorted(self.named, key=lambda step: step[0] not in self.case.hidden):
            meant = [truth for truth in self.case.hidden
                     if truth not in found and truth in (name, *rivals)]
            found |= set(meant[:1]) if name not in meant else {name}
            wrong = wrong or not meant
        if wrong:
            return 'wrong'
        if found != set(self.case.hidden):
            return 'missed'
        return 'exact' if set(self.names) == found else 'rival'


def run(case: Case) -> Outcome:
    """Make the set of a case, refine and judge."""
    made = simulate(np.random.default_rng(case.seed), case.hidden, case.setup)
    knocked = {row: abs(shown) / made.noise[row - 1] for row, shown in made.knocked.items()}
    poses, started = poses_of(made), time.perf_counter()
    try:
        refined = refine(poses, units_of('m/s2'), base='10')
        seconds = time.perf_counter() - started
        named = tuple((step.effect, tuple(step.rivals)) for step in refined.steps
                      if step.effect not in BASE)
        return Outcome(case, refined.verdict, named, frozenset(refined.disturbed_poses), knocked,
                       _deviations(refined.calibration, made), _held_out(case, refined, made),
                       seconds)
    except Exception:
        return Outcome(case, 'error', (), frozenset(), knocked, (), None,
                       time.perf_counter() - started, traceback.format_exc())


def poses_of(made: Simulated) -> Poses:
    """Give the columns as the reader of pose tables does."""
    columns = {}
    for key, column in COLUMNS.items():
        parts = [made.columns[name] for name in column.names if name in made.columns]
        if len(parts) == len(column.names):
            columns[key] = np.column_stack(parts) if len(parts) > 1 else parts[0]
    return Poses(columns, np.arange(1, made.setup.poses + 1))


def _deviations(calibration: Any, made: Simulated) -> tuple[float, ...]:
    """Compare what was fitted with the truth, by name."""
    fitted = dict(zip(calibration.parameters,
                      zip(calibration.model.vector, np.sqrt(np.diag(calibration.covariance))),
                      strict=True))
    found = []
    for effect, values in made.truth.items():
        for part, value in values.items():
            estimate, deviation = fitted.get(f'{effect}.{part}', (0.0, 0.0))
            if deviation > 0.0 and part not in ('instant', 'limit', 'step'):
                found.append(float((estimate - value) / deviation))
    return tuple(found)


def _held_out(case: Case, refined: Any, made: Simulated) -> tuple[float, float] | None:
    """Give the gaps in fresh poses, of the refined calibration and of the true form [mg]."""
    if not case.against_truth or any(name in WITHOUT_FORM for name in case.hidden):
        return None
    fresh = again(np.random.default_rng((*case.seed, 1)), made)
    poses = poses_of(fresh)
    if 'previous' in refined.calibration.model.needs:
        basis = basis_of('hysteresis', fresh.around, fresh.traits)
        poses = poses.with_columns(previous=np.einsum('nii->ni', basis))
    reference = true_form_gap_mg(made, fresh)
    if reference is None:
        return None
    return verify(refined.calibration, poses).rms_after_mg, reference
