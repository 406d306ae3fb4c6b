# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The refinement of a calibration: the entry point and the record of the result.

See `accel_calib.refine.search` for the method, and `.stored` for a stored calibration as the base.

**Base.** The base: the model that a refinement starts from.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math

import numpy as np

from .curves import is_curve
from .linear import linearised
from .plan import plan_poses
from .records import Refinement, Stage, Step, Verdict
from .rivals import LEAST, probabilities
from .search import Found, search
from .state import fitted_state, is_noise, sample_words, sampled, State
from .stored import beside_stored, with_changes, with_stored
from .words import advice_for, change_words, curve_words, not_testable, where
from ..calibrate import (
    BASES,
    Calibration,
    check_sensor,
    fit_findings,
    fit_poses,
    gated,
    in_g,
    OF_A_FIT,
    quality_of,
    record_of,
    refuse_if_unfit,
    Rejected,
    sound_rows,
    sure_rows,
    uncertainty_g,
    with_history,
    with_rest_noise,
)
from ..effects import CHANGES, effect_named, EFFECTS, EMPIRICAL, LADDER, Model, WANDER
from ..errors import RefusedFitError, TAKE_ALL_SIDES
from ..estimate import fit_sphere, judge, LARGEST_DILUTION, NotConvergedError, variance_factor
from ..finding import Finding, without
from ..geometry import unit
from ..table import check_units, Floats, Poses
from ..text import counted, listed
from ..units import MG, Units


def base_of(poses: Poses, units: Units, name: str) -> Calibration:
    """Return the base as a calibration; errors as in `fit_poses`."""
    if name not in BASES:
        raise ValueError(f'base is {name!r}, expected one of {BASES}')
    if name == 'ideal':
        return ideal(poses, units)
    try:
        return fit_poses(poses, units, model=name)
    except RefusedFitError:
        if name == 'auto' and 'orientation' in poses:
            return ideal(poses, units)
        raise


def ideal(poses: Poses, units: Units) -> Calibration:
    """Return the ideal sensor; for native readings with a fitted offset and scale."""
    values: dict[str, Floats] = {}
    if units.is_native:
        mat_w, vec_v = fit_sphere(poses.reading)
        units = Units('native', float(mat_w[0, 0]))
        values = {'offset': vec_v / units.per_g}
    poses_g = in_g(poses, units)
    fit = judge(Model(values), poses_g)
    return record_of(fit, poses, units, unit(poses_g.reading), 'ideal', 'ml', reason='ideal')


_LEAST_POSES = 4
_NAMED = 4


def refine(poses: Poses, units: Units, *, base: str | Calibration = 'auto', sensor: str = '',
           date: str = '') -> Refinement:
    """
    Find effects that a model lacks, and add them to it.

    Parameters
    ----------
    poses : Poses
        Poses of known, shared or unknown orientation, in the unit of the readings.
    units : Units
        Unit of the readings.
    base : Calibration or {'auto', 'ideal', '4', '7', '10', '12'}
        The model to start from. A Calibration is compared as it is stored; the search first finds
        changes of the sensor since then, and then further effects.
    sensor, date : str
        Name of the sensor and date for the refined calibration.

    Returns
    -------
    Refinement
        The verdict, the added effects and the refined calibration.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the base, or are too few to find an effect.
    InputError
        If the readings are clearly in another unit.
    StoredCalibrationError
        If the calibration belongs to another sensor.

    """
    check_units(poses, units)
    if isinstance(base, Calibration):
        check_sensor(base, poses.sensor)
        check_sensor(base, sensor)
    sure, doubts = sure_rows(poses)
    if doubts:
        try:
            return _refine(poses, sure, doubts, units, base, sensor, date)
        except RefusedFitError:
            pass  # the fit needs the doubtful poses
    return _refine(poses, poses, (), units, base, sensor, date)


def _refine(poses: Poses, used: Poses, rejected: tuple[Rejected, ...], units: Units,
            base: str | Calibration, sensor: str, date: str) -> Refinement:
    """Return the refinement with some of the poses; the others are already rejected."""
    sound, unsound = sound_rows(used, units)
    if len(sound) < _LEAST_POSES:
        raise RefusedFitError(f'found {counted(len(sound), "sound pose")}, expected at least '
                              f'{_LEAST_POSES} to find an effect', 'take 24 poses or more')
    stored = base if isinstance(base, Calibration) else None
    calibration = stored or base_of(sound, units, str(base))
    poses_g = with_history(in_g(sound, calibration.units), calibration.model)
    if stored is not None:
        poses_g = beside_stored(poses_g, stored)
    total, poses_g = len(poses_g), sampled(poses_g)
    model = Model(calibration.model.values)
    try:
        found = search(poses_g, model)
    except NotConvergedError:
        raise RefusedFitError(f'the base {calibration.name} cannot be fitted to these poses, '
                              'expected a fit that converges', 'check the poses for mistakes, or '
                              'use another base') from None
    if found.base.dof < 1:
        raise RefusedFitError(
            f'found {counted(len(sound), "pose")} for '
            f'{counted(found.base.linear.onto.shape[1], "parameter")} of the base, expected more '
            'poses to find an effect', 'take 24 poses or more')
    note = (Finding('note', sample_words(len(poses_g), total)),) if len(poses_g) < total else ()
    given = _Given(poses, poses_g, stored is not None, (*rejected, *unsound), note)
    return _record(calibration, found, given, sensor or poses.sensor, date)


@dataclass(frozen=True)
class _Given:
    """The input poses, those used [g], whether the base is stored, rejected rows, and notes."""

    poses: Poses
    poses_g: Poses
    stored: bool
    rejected: tuple[Rejected, ...]
    notes: tuple[Finding, ...]

    @property
    def joint(self) -> bool:
        """Whether the poses of the stored calibration are used, too."""
        return 'new' in self.poses_g


def _record(calibration: Calibration, found: Found, given: _Given, sensor: str, date: str
            ) -> Refinement:
    """Return the record of a search."""
    start = _as_stored(calibration, found) if given.stored else found.base
    states = _sequence(found, start)
    steps = (*_output_steps(found), *(
        _step(name, pair, found, calibration.date, unseen=given.joint and k == 0)
        for k, (name, pair) in enumerate(zip(found.added, pairwise(states), strict=False))))
    remaining, noise = _remaining(found)
    verdict = _verdict(found, bool(steps), noise)
    rejected = _rejected(found, given)
    clipped = () if found.clipped is None else given.poses_g.row[found.clipped.poses]
    outliers = tuple(each.row for each in rejected if each.row not in clipped)
    refined, refusal = _refined(calibration, found, given, rejected)
    if sensor or date:
        refined = replace(refined, sensor=sensor or refined.sensor, date=date or refined.date)
    untestable = _untestable(found, steps)
    plan = plan_poses(found)
    return Refinement(
        verdict, found.final.floor_mg, start.gap_mg(start.fit.residual), remaining, steps,
        outliers, untestable, (
            *advice_for(verdict, found, steps, untestable, len(outliers)), *plan.advice),
        refined, refusal, found.final.poses_g, found.final.fit.equations.force,
        _stages(found, states, steps), plan)


def _verdict(found: Found, named: bool, noise: bool) -> Verdict:
    if not noise:
        return 'unexplained'
    if found.curve is not None:
        return 'described'
    return 'explained' if named else 'no_gap'


def _as_stored(calibration: Calibration, found: Found) -> State:
    """Return the state of a stored calibration at the poses kept, without a fit."""
    kept = calibration.held(found.base.poses_g)
    return State(judge(Model(calibration.model.values), kept))


def _rejected(found: Found, given: _Given) -> tuple[Rejected, ...]:
    """Return the rows of the table that were left out, with the reason."""
    out = given.poses_g.take(found.outliers)
    force = found.final.model.at(out.columns).force(out.reading)
    away = np.linalg.norm(force, axis=1) - 1.0
    rejected = [Rejected(int(row), f'outlier: |force| differs by {error * MG:+.2f} mg from 1 g in '
                         'the fit of the others', 'outlier')
                for row, error in zip(out.row, away, strict=True)]
    if found.clipped is not None:
        rejected += [Rejected(int(row), 'the reading is clipped at the limit of the sensor',
                              'clipped')
                     for row in given.poses_g.row[found.clipped.poses]]
    return tuple(sorted((*given.rejected, *(each for each in rejected
                                            if each.row in given.poses.row)),
                        key=lambda each: each.row))


def _sequence(found: Found, start: State) -> list[State]:
    """Return the initial state and the state after each added effect."""
    states, values = [start], dict(found.base.model.values)
    for name in found.added:
        if name != WANDER:
            if name == 'axis_gain':
                values.pop('gain', None)
            own = found.final.model.values.get(name)
            values[name] = np.zeros(len(effect_named(name).values)) if own is None else own
            states.append(fitted_state(Model(dict(values)), found.base.poses_g) or states[-1])
    if len(states) > 1:
        states[-1] = State(judge(found.final.model, states[-1].poses_g))
    return states if found.added[-1:] != (WANDER,) else [*states, states[-1]]


def _step(name: str, states: tuple[State, State], found: Found, date: str, *, unseen: bool
          ) -> Step:
    """Return the record of one step; `unseen`: the earlier model was not fitted to the poses."""
    before, after = states
    if name == WANDER:
        return _wander_step(before, found)
    values = after.model.values.get(name, np.zeros(len(effect_named(name).values)))
    seen = where(name, before, after.fit.residual)
    if is_curve(name):
        seen = curve_words(name, before, after)
    if name in CHANGES:
        seen = f'{change_words(name, after, date)}; {seen}'
    held_out = before.fit.residual if unseen else before.held_out
    own, chances = _shown(name), _probabilities(name, found)
    return Step(own, _rivals(own, chances), chances, effect_named(name).shown(values),
                before.gap_mg(before.fit.residual), after.gap_mg(after.fit.residual),
                before.gap_mg(held_out), after.gap_mg(after.held_out),
                _p_value(name, before, found), seen)


def _probabilities(name: str, found: Found) -> dict[str, float]:
    """Return the probability of an effect and of each effect in its place, by its name."""
    parts: dict[str, float] = {}
    for each, part in probabilities(name, found.near).items():
        parts[_shown(each)] = parts.get(_shown(each), 0.0) + part
    return parts


def _rivals(name: str, chances: Mapping[str, float]) -> tuple[str, ...]:
    """Return the other effects whose probability is not small."""
    return tuple(other for other, part in chances.items() if other != name and part > LEAST)


def _shown(name: str) -> str:
    """Return the name of an effect in the record."""
    return EMPIRICAL if is_curve(name) else name.removesuffix('_change')


def _p_value(name: str, before: State, found: Found) -> float:
    """Return the probability that noise alone makes an effect this good."""
    near = found.near
    if found.curve is not None and name == found.curve.name:
        return found.curve.p_value
    if name in near.names:
        return near.linear.probability(near.chosen, near.chosen.blocks[near.names.index(name)])
    linear = linearised(before.fit, before.model.effects, LADDER)
    own = [number for number, block in enumerate(linear.blocks) if block.effect == name]
    return linear.probability(linear.made(own), own[0]) if own else 1.0


def _output_steps(found: Found) -> tuple[Step, ...]:
    """Return the steps for readings clipped at a limit or on a grid."""
    steps = []
    base = found.base
    gap, held_out = base.gap_mg(base.residual), base.gap_mg(base.held_out)
    if found.clipped is not None and found.with_clipped is not None:
        whole = found.with_clipped
        rows = listed('row', whole.poses_g.row[found.clipped.poses].tolist())
        steps.append(Step('saturation', (), {'saturation': 1.0}, {'limit': found.clipped.limit_g},
                          whole.gap_mg(whole.residual), gap,
                          whole.gap_mg(whole.held_out), held_out, 0.0,
                          f'in {rows}: an axis reads {found.clipped.limit_g:.4g} g and its '
                          'samples hardly scatter'))
    if found.grid_g is not None:
        steps.append(Step('quantisation', (), {'quantisation': 1.0}, {'step': found.grid_g},
                          gap, gap, held_out, held_out, 0.0,
                          f'pose means are multiples of {found.grid_g * MG:.3g} mg, which '
                          f'causes {found.grid_g * MG / np.sqrt(12.0):.2g} mg RMS per axis'))
    return tuple(steps)


def _wander_step(before: State, found: Found) -> Step:
    residual, held_out = _beside_walk(found)
    p_value = math.exp(-found.walk.likelihood_ratio / 2.0) if found.walk else 1.0
    chances = _probabilities(WANDER, found)
    return Step(WANDER, _rivals(WANDER, chances), chances, {},
                before.gap_mg(before.residual), before.gap_mg(residual),
                before.gap_mg(before.held_out),
                before.gap_mg(held_out), p_value, where(WANDER, before, residual))


def _beside_walk(found: Found) -> tuple[Floats, Floats]:
    """Return the final residual without the walk, and the same held out."""
    final = found.final
    if found.walk is None:
        return final.residual, final.held_out
    return found.walk.residuals(final.linear, final.nothing)


def _remaining(found: Found) -> tuple[float, bool]:
    """Return the remaining residual, and whether noise explains it."""
    final, (residual, _) = found.final, _beside_walk(found)
    noise = not final.fit.noise_known or is_noise(float(residual @ residual), final.dof)
    return final.gap_mg(residual), noise


def _untestable(found: Found, steps: Sequence[Step]) -> tuple[tuple[str, str], ...]:
    final = found.final
    names = tuple(name for name in EFFECTS if name not in final.model.effects)
    linear = linearised(final.fit, final.model.effects, names)
    others = tuple(rival for step in steps for rival in step.rivals)
    return tuple(not_testable(final.poses_g, linear.visible(), (*final.model.effects, *others)))


def _stages(found: Found, states: list[State], steps: Sequence[Step]) -> tuple[Stage, ...]:
    """Return the residuals of the base and after each step; limit and grid leave those kept."""
    of_output = len(steps) + 1 - len(states)
    stages = []
    for name, state in zip(('base', *(step.effect for step in steps)),
                           (*states[:1] * of_output, *states), strict=True):
        residual = state.fit.residual
        if name == WANDER:
            residual = _beside_walk(found)[0]
        stages.append(Stage(name, state.fit.equations.of_poses(residual) * MG))
    return tuple(stages)


def _refined(base: Calibration, found: Found, given: _Given, rejected: tuple[Rejected, ...]
             ) -> tuple[Calibration, tuple[str, ...]]:
    """Return the refined calibration, and the refusal if it must not be used."""
    final = found.final
    model, matrix = with_changes(final.model)
    kept, poses = final.poses_g, given.poses
    unchanged = final.model.effects == model.effects
    if given.joint and unchanged and all(key in base.poses for key in model.needs):
        poses = with_stored(given.poses, base)
    elif given.joint:
        kept = kept.take(kept['new'] > 0.0)
    if not base.form.known_orientation:
        kept = Poses({key: values for key, values in kept.columns.items()
                      if key not in ('reference', 'orientation')}, kept.row)
    at_poses = judge(model, kept)
    names = ', '.join(name.removesuffix('_change') for name in found.added)
    others = without(base.noted, *OF_A_FIT)
    kept_findings = [each for each in others if not given.stored or each.kind == 'flat_pose']
    refined = replace(
        base, model=Model(model.values, base.model.rotation),
        covariance=matrix @ final.fit.covariance @ matrix.T,
        quality=quality_of(at_poses, base.units, unit(at_poses.equations.force)), poses=poses,
        rejected=rejected, noted=(*given.notes, *kept_findings), method='ml',
        reason=f'{base.reason}; refined: {names or "nothing added"}')
    try:
        return _determined(gated(with_rest_noise(refined, given.poses)), final)
    except RefusedFitError as refused:
        return refined, (refused.message, refused.advice)


def _determined(refined: Calibration, final: State) -> tuple[Calibration, tuple[str, ...]]:
    """Return a calibration with findings, or a refusal if the poses do not determine it."""
    fit = final.fit
    if refined.name == 'ideal':  # an offset that was not fitted is not zero
        refuse_if_unfit('4', unit(fit.equations.force))
    if fit.undetermined:
        return refined, (f'the poses do not determine {", ".join(fit.undetermined[:_NAMED])}'
                         f'{", …" if len(fit.undetermined) > _NAMED else ""}',
                         TAKE_ALL_SIDES)
    factor = variance_factor(fit.chi2, fit.dof, fit.noise_known)
    dilution = uncertainty_g(refined) / float(np.median(fit.equations.scale) * np.sqrt(factor))
    if dilution > LARGEST_DILUTION:
        return refined, ('the poses do not determine the refined calibration: the error of |a| '
                         f'is up to {dilution:.3g} times that of a pose, expected less than '
                         f'{LARGEST_DILUTION:.0f} times',
                         TAKE_ALL_SIDES)
    return replace(refined, noted=(*refined.noted, *fit_findings(fit, dilution))), ()
