# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The refinement: a calibration in, a larger one and the story of how it grew out.

See `accel_calib.refine.search` for the method.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .advice import advice_for
from .base import base_of
from .candidates import LADDER, not_testable
from .exact import covariance_of
from .noise import is_noise, is_noise_of
from .records import Refinement, Stage, Step, Verdict
from .score import fall_of, probability
from .search import Found, search, WANDER
from .state import plus, State
from .where import where
from ..calibrate import Calibration
from ..calibrate.geometry import coverage
from ..calibrate.likelihood import judge
from ..calibrate.quality import in_g, quality_of
from ..calibrate.unit_check import check_units
from ..effects import EFFECTS
from ..errors import RefusedFitError
from ..model import Model
from ..table import Poses
from ..units import MG, Units

_RIVAL = 9.0
"""Effects whose criterion is within this of the named one's are its rivals: odds of 1 to 90."""


def refine(poses: Poses, units: Units, *, base: str | Calibration = 'auto', sensor: str = '',
           date: str = '') -> Refinement:
    """
    Find what a model lacks, name it, add it, and show how the gap shrinks.

    Parameters
    ----------
    poses : Poses
        In the unit of the readings; of known, shared or unknown orientation.
    units : Units
        That unit.
    base : Calibration or {'auto', 'ideal', '4', '7', '10', '12'}
        The model to begin with.
    sensor, date : str
        Kept in the refined calibration.

    Returns
    -------
    Refinement
        The verdict, the steps and the refined calibration.

    Raises
    ------
    RefusedFitError
        If the poses cannot carry the base.
    InputError
        If the readings are plainly not in that unit.

    """
    check_units(poses, units)
    if len(poses) < 4:
        raise RefusedFitError(f'{len(poses)} poses are too few to find an effect',
                              'take at least 4, better 24')
    calibration = base if isinstance(base, Calibration) else base_of(poses, units, base)
    poses_g = in_g(poses, calibration.units)
    found = search(poses_g, Model(calibration.model.values))
    states = _sequence(found)
    steps = tuple(_step(name, before, after, found)
                  for name, before, after in zip(found.added, states[:-1], states[1:],
                                                 strict=False))
    steps = (*_output_steps(found), *steps)
    remaining, noise = _remaining(found)
    verdict: Verdict = ('unexplained' if not noise else 'explained' if steps else 'no_gap')
    left_out = tuple(int(row) for row in poses.row[found.knocked])
    alike = tuple(rival for step in steps for rival in step.rivals)
    testable = {**found.final.found, **found.final.candidates_among(LADDER)}
    untestable = tuple(not_testable(found.final.poses_g, testable,
                                    (*found.final.model.effects, *alike)))
    kept = found.final.poses_g
    return Refinement(
        verdict, found.final.floor_mg, found.base.gap_mg(found.base.fitted.residual), remaining,
        steps, left_out, untestable, advice_for(verdict, found, steps, untestable),
        _refined(calibration, found, poses, sensor, date), kept, found.final.near.force,
        _stages(states, found))


def _sequence(found: Found) -> list[State]:
    """Give the states from the base on, one for each effect added."""
    states = [found.base]
    for name in found.added:
        if name == WANDER:
            break
        among = states[-1].candidates_among((name,))
        states.append(plus(states[-1], among[name]) if name in among else states[-1])
    if len(states) > 1 and found.added[-1] != WANDER:
        states[-1] = State(found.final.model, states[-1].poses_g)
    return states if found.added[-1:] != (WANDER,) else [*states, states[-1]]


def _step(name: str, before: State, after: State, found: Found) -> Step:
    """Tell the story of one step."""
    if name == WANDER:
        return _wander_step(before)
    among = {**before.found, **before.candidates_among((name,))}
    values = after.model.values.get(name, np.zeros(0))
    p_value = (probability(among[name], before.fitted, before.dof, len(among))
               if name in among else 1.0)
    return Step(name, _rivals(name, found), dict(zip(EFFECTS[name].values, values.tolist(),
                                                     strict=False)),
                before.gap_mg(before.fitted.residual), after.gap_mg(after.fitted.residual),
                before.gap_mg(before.fitted.left_out), after.gap_mg(after.fitted.left_out),
                p_value, where(name, before, after.near.residual))


def _output_steps(found: Found) -> tuple[Step, ...]:
    """Tell of readings that end at a limit or lie on a grid."""
    steps = []
    base = found.base
    gap, held_out = base.gap_mg(base.fitted.residual), base.gap_mg(base.fitted.left_out)
    if found.clipped is not None and found.with_clipped is not None:
        whole = found.with_clipped
        rows = ', '.join(str(row) for row in whole.poses_g.row[found.clipped.poses])
        steps.append(Step('saturation', (), {'limit': found.clipped.limit_g},
                          whole.gap_mg(whole.fitted.residual), gap,
                          whole.gap_mg(whole.fitted.left_out), held_out, 0.0,
                          f'rows {rows}: an axis reads {found.clipped.limit_g:.4g} g and its '
                          'samples hardly scatter'))
    if found.grid_g is not None:
        steps.append(Step('quantisation', (), {'step': found.grid_g}, gap, gap, held_out, held_out,
                          0.0, f'pose means are multiples of {found.grid_g * MG:.3g} mg: that '
                          f'alone is {found.grid_g * MG / np.sqrt(12.0):.2g} mg RMS an axis'))
    return tuple(steps)


def _wander_step(before: State) -> Step:
    walk = before.wander
    if walk is None:
        raise ValueError('a walk was named without one')
    p_value = float(np.exp(-walk.likelihood_ratio / 2.0))
    return Step(WANDER, (), {}, before.gap_mg(before.fitted.residual),
                before.gap_mg(walk.residual), before.gap_mg(before.fitted.left_out),
                before.gap_mg(walk.left_out), p_value, where(WANDER, before, walk.residual))


def _rivals(name: str, found: Found) -> tuple[str, ...]:
    """Name the effects that would do about as well in the place of this one."""
    final = found.final
    if name not in final.model.values or name in found.base.model.values:
        return ()
    without = final.with_effects({key: part for key, part in final.model.values.items()
                                  if key != name})
    among = {**without.found, **without.candidates_among((name,))}
    if name not in among:
        return ()
    falls = {key: fall_of(c, without.fitted, without.dof) for key, c in among.items()}
    rivals = [key for key, falls_by in falls.items()
              if key != name and (key in LADDER or name not in LADDER)
              and falls_by > max(falls[name] - _RIVAL, 0.0)]
    walk = without.wander
    if walk is not None and walk.fall > falls[name] - _RIVAL:
        rivals.append(WANDER)
    return tuple(rivals)


def _remaining(found: Found) -> tuple[float, bool]:
    """Give the gap that remains, and whether it is no more than noise."""
    final = found.final
    if found.added[-1:] != (WANDER,) or final.wander is None:
        return final.gap_mg(final.fitted.residual), is_noise(final)
    residual = final.wander.residual
    noise = final.noise is None or is_noise_of(float(residual @ residual), final.dof)
    return final.gap_mg(residual), noise


def _stages(states: Sequence[State], found: Found) -> tuple[Stage, ...]:
    names = ('base', *found.added)
    stages = []
    for name, state in zip(names, states, strict=False):
        residual = state.fitted.residual
        if name == WANDER and state.wander is not None:
            residual = state.wander.residual
        stages.append(Stage(name, state.near.residual_of_pose(residual) * 1e3))
    return tuple(stages)


def _refined(base: Calibration, found: Found, poses: Poses, sensor: str, date: str
             ) -> Calibration:
    """Make the refined calibration: an ordinary one."""
    final = found.final
    rotation = base.model.rotation
    fit = judge(final.model, final.poses_g.reading, final.poses_g.columns, final.poses_g.noise)
    quality = quality_of(fit, final.poses_g, base.units, final.near.force)
    reason = f'{base.reason}; refined: {", ".join(found.added) or "nothing added"}'
    return replace(base, model=Model(final.model.values, rotation),
                   covariance=covariance_of(final.model, final.poses_g, final.noise),
                   quality=replace(quality, coverage=coverage(final.near.force)), poses=poses,
                   sensor=sensor or base.sensor, date=date or base.date, reason=reason)
