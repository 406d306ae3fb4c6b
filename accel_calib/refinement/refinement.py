# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The refinement of a calibration: from poses and a base to the record of the result.

See `.search` for the method, and for a stored calibration as the base.

**Typical values of a fleet.** The search for effects is that without a fleet, because a fleet says
nothing about effects beyond offset, gain and cross-axis. It needs more poses than model 10 has
values. If it names effects, the fitted values are combined with the fleet
(`accel_calib.calibration.partial`): offset, gain and cross-axis move towards the fleet, and the
effects with them as far as the poses cannot distinguish them. Otherwise the result is the fit with
the fleet. If the poses do not carry a search, the first advice states the reason, and all effects
are listed as not testable.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from importlib import import_module

import numpy as np

from .search import beside_stored, Found, join, sampled, search, with_changes
from .state import fitted_state, is_noise, slope_of_temperature, State, without
from .steps import (
    find_rivals, not_testable, Remark, remarks_on, Stage, Step, steps_of, untestable, Verdict,
    verdict_of)
from ..calibration import (
    Calibration, check_sensor, CLIPPED, fit_findings, fit_poses, fit_with_fleet, FLEET, FleetPrior,
    gated, in_g, LARGEST_DILUTION, OF_A_FIT, only_norm, plan_refinement, PosePlan, posterior,
    quality_of, record_of, refuse_if_unfit, refused, Rejected, rejected_by, sound_rows, sure_rows,
    uncertainty_g, with_rest_noise)
from ..effects import (
    add_history, covariance_of_steps, EffectKey, Model, MODELS, OwnEffect, PROCESSES, step_of,
    unchanged, with_vector)
from ..errors import RefusedFitError, TAKE_ALL_SIDES
from ..estimate import fit_sphere, judge, NotConvergedError, originals, outliers, variance_factor
from ..finding import CAUSES, explained_by, Finding, has, without as without_kinds
from ..geometry import unit
from ..statistics import rms
from ..table import check_units, Floats, Poses, Record
from ..text import counted, table
from ..units import BASES, MG, Units

_LEAST_POSES = 4
"""Smallest number of poses in which an effect can be found."""

_ROUNDS = 6
"""Largest number of fits after which outliers are left out."""

_SEARCHES = 3
"""Largest number of further searches along ways between poses that the one before corrects."""

_NAMED = 4
"""Largest number of undetermined values that are named."""

_LEAST_CHECKS = 4
"""Smallest number of equations beyond values with which a refinement is used. With fewer, of 12
simulated poses, a wrong effect explains as much as the true one, and new poses read worse."""

_OF_GAP = 0.5
"""Smallest part of the squares of a gap that the steps of a thermometer leave if they cause it."""

_BASE = '10'
_ORIENTATION = ('reference', 'orientation')


@dataclass(frozen=True, repr=False, eq=False)
class Refinement(Record):
    """
    The result of a refinement.

    Parameters
    ----------
    verdict : {'no_gap', 'explained', 'described', 'drifts', 'unexplained'}
        No gap beyond the noise; the effects are named and the rest is noise; the rest is noise
        only with an empirical curve, or only beside a slow change of the offset; or a gap
        remains, or it is not known what explains it (`undecided`).
    noise_floor_mg : float or None
        Expected residual of a correct model [mg]; None if the noise is not known.
    gap_mg, remaining_gap_mg : float
        Residual of the base and of the refined model [mg], without a walk, which the calibration
        does not contain.
    steps : tuple of Step
        The added effects, in order.
    disturbed_poses : tuple of int
        Rows of the poses left out.
    not_testable : tuple of (str, str)
        Effects that these data cannot show, and the data to record for them.
    remarks : tuple of Remark
        What there is to say for advice; `advice` in words.
    calibration : Calibration
        The refined calibration; with the finding ``refused`` if it must not be stored or used.
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
        more than `MOST_RIVALS` rivals, two may be `one_curve`, or the poses do not determine the
        refined calibration.
    one_curve : tuple of str
        Two nonlinearities in the same proportion on each axis, as parts of one curve; or empty.
        The second one may not be named, and only show beside the first.
    also : tuple of OwnEffect
        Own effects of the user that were tried.

    """

    verdict: Verdict
    noise_floor_mg: float | None
    gap_mg: float
    remaining_gap_mg: float
    disturbed_poses: tuple[int, ...]
    not_testable: tuple[tuple[str, str], ...]
    remarks: tuple[Remark, ...]
    calibration: Calibration
    poses_g: Poses
    force: Floats
    stages: tuple[Stage, ...]
    steps: tuple[Step, ...] = ()
    plan: PosePlan = PosePlan()
    undecided: bool = False
    one_curve: tuple[str, ...] = ()
    also: tuple[OwnEffect, ...] = ()

    def __repr__(self) -> str:
        names = ' + '.join([self.calibration.name, *(step.effect for step in self.steps)])
        return (f'Refinement({self.verdict}: {names}; residual {self.gap_mg:.3g} -> '
                f'{self.remaining_gap_mg:.3g} mg)')

    @property
    def refusal(self) -> tuple[str, ...]:
        """Return why the calibration must not be used, and advice; empty if it is usable."""
        return next(((each.text, each.advice) for each in self.calibration.noted
                     if each.kind == 'refused'), ())

    @cached_property
    def advice(self) -> tuple[str, ...]:
        """Return advice for the user, one line each."""
        return tuple(import_module('accel_calib.findings').advice_lines(self))

    def _repr_html_(self) -> str:
        """Return the steps as a table, for notebooks."""
        rival_words = import_module('accel_calib.findings').rival_words
        rows = [[step.effect, f'{step.gap_before_mg:.3g} → {step.gap_after_mg:.3g}',
                 f'{step.held_out_before_mg:.3g} → {step.held_out_after_mg:.3g}',
                 f'{step.p_value:.1g}', ', '.join(rival_words(step)), step.where]
                for step in self.steps]
        head = ['effect', 'residual [mg]', 'held out [mg]', 'p', 'rivals', 'where']
        lines = ''.join(f'<p>{escape(line)}</p>\n' for line in (repr(self), *self.advice))
        return (table(head, rows) if rows else '') + lines


def refine(poses: Poses, units: Units, *, base: str | Calibration | FleetPrior = 'auto',
           sensor: str = '', date: str = '', also: tuple[OwnEffect, ...] = ()) -> Refinement:
    """
    Find effects that a model lacks, and add them to it.

    Parameters
    ----------
    poses : Poses
        Poses of known, shared or unknown orientation, in the unit of the readings.
    units : Units
        Unit of the readings.
    base : Calibration, FleetPrior or {'auto', 'ideal', '4', '7', '10', '12'}
        The model to start from. A Calibration is compared as it is stored; the search first finds
        changes of the sensor since then, and then further effects. The typical values of sensors
        of the same model are combined with model 10 of these poses.
    sensor, date : str
        Name of the sensor and date for the refined calibration.
    also : tuple of OwnEffect
        Own effects of the user, which are tried beside the catalogue.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the base, or are too few to find an effect.
    InputError
        If the readings are clearly in another unit, or in native units with a FleetPrior.
    StoredCalibrationError
        If the calibration belongs to another sensor.

    """
    if isinstance(base, FleetPrior):
        found = _refine_with_fleet(poses, units, base, also)
    else:
        check_units(poses, units)
        if isinstance(base, Calibration):
            check_sensor(base, poses.sensor)
            check_sensor(base, sensor)
        sure, doubts = sure_rows(poses)
        with explained_by(poses.findings):
            try:
                found = _refine(poses, sure, doubts, units, base=base, also=also)
            except RefusedFitError:
                if not doubts:
                    raise
                # With the doubtful poses.
                found = _refine(poses, poses, (), units, base=base, also=also)
    made = found.calibration
    return replace(found, calibration=replace(
        made, sensor=sensor or poses.sensor or made.sensor, date=date or made.date))


def _refine(poses: Poses, used: Poses, rejected: tuple[Rejected, ...], units: Units, *,
            base: str | Calibration, also: tuple[OwnEffect, ...]) -> Refinement:
    """Return the refinement with some of the poses; the others are already rejected."""
    sound, unsound = sound_rows(used, units)
    if len(sound) < _LEAST_POSES:
        raise RefusedFitError(f'found {counted(len(sound), "sound pose")}, expected at least '
                              f'{_LEAST_POSES} to find an effect', 'take 24 poses or more')
    stored = base if isinstance(base, Calibration) else None
    calibration = stored or base_of(poses, units, str(base))
    # Copies would count as further evidence, and leave nothing unseen that is held out.
    sound = sound.take(np.unique(originals(in_g(sound, calibration.units))))

    def at(model: Model) -> Poses:
        known = add_history(in_g(sound, calibration.units), model)
        return known if stored is None else beside_stored(known, stored, model)

    every, model = at(calibration.model), Model(calibration.model.values)
    total, poses_g, step = len(every), sampled(every), step_of(sound.columns)
    try:
        found = search(poses_g, model, also, step)
        for _ in range(_SEARCHES if 'previous' in found.final.model.needs else 0):
            before, poses_g = poses_g, _along_ways(found.final, at)
            if _is_same_way(found.final.model, before, poses_g):
                break
            found = search(poses_g, model, also, step)
    except NotConvergedError:
        raise RefusedFitError(f'the base {calibration.name} cannot be fitted to these poses, '
                              'expected a fit that converges', 'check the poses for mistakes, or '
                              'use another base') from None
    if found.base.dof < 1:
        raise RefusedFitError(
            f'found {counted(len(sound), "pose")} for '
            f'{counted(found.base.linear.onto.shape[1], "parameter")} of the base, expected more '
            'poses to find an effect', 'take 24 poses or more')
    sample = Finding('note', f'the refinement uses {len(poses_g)} of {total} poses, spread evenly '
                     'over the table, to bound its time and memory; it does not look for '
                     'disturbed poses among the others; choose rows to use others')
    note = (*(poses.findings if stored else ()), *((sample,) if len(poses_g) < total else ()))
    given = Given(poses, poses_g, stored=stored is not None, rejected=(*rejected, *unsound),
                  notes=(*note, *_coarse(found.final, step)))
    return _conclude(calibration, found, given)


def _along_ways(final: State, at: Callable[[Model], Poses]) -> Poses:
    """
    Return the poses at a model that is fitted in turn with the ways from its corrected poses.

    A large hysteresis distorts the directions from which the ways between poses are computed.

    """
    state, poses_g = final, sampled(at(with_changes(final.model)[0]))
    for _ in range(_ROUNDS):
        kept = poses_g['previous'][np.isin(poses_g.row, final.poses_g.row)]
        fitted = fitted_state(state.model, final.poses_g.with_columns(previous=kept))
        state, before = fitted or state, poses_g
        poses_g = sampled(at(with_changes(state.model)[0]))
        if fitted is None or _is_same_way(state.model, before, poses_g):
            break
    return poses_g


def _is_same_way(model: Model, *ways: Poses) -> bool:
    """Return whether the readings of a model along two ways differ by less than 1e-5 g."""
    one, other = (model.at(poses_g.columns).vec_v for poses_g in ways)
    return bool(np.max(np.abs(one - other), initial=0.0) < 1e-5)


def _with_steps(final: State, poses: Poses) -> State:
    """
    Return a state with what a thermometer with steps adds to its covariance.

    To first order, the errors dT of the temperatures at the poses move the values by
    -J⁺ (∂reading/∂T dT), with J the derivative of the equations. Of poses that share an
    orientation, this is without the part that a turn of all of them explains.

    """
    fit = final.fit.beside or final.fit
    if not {'time', 'temperature'} <= {*poses.columns} or 'temperature' not in final.model.over:
        return final
    near, slope = fit.equations, slope_of_temperature(fit)
    rows = np.sum(near.columns(Model({'offset': np.zeros(3)})) * slope[near.pose], axis=1)
    onto, order = np.zeros((len(poses), fit.columns.shape[1])), np.argsort(poses.row)
    place = np.searchsorted(poses.row, fit.poses_g.row[near.pose], sorter=order)
    own = place < len(poses)  # not the poses of a stored calibration
    np.add.at(onto, order[place[own]],
              (fit.columns @ fit.by_pose.spread * rows[:, np.newaxis])[own])
    spread = covariance_of_steps(poses['time'], poses['temperature'], onto.T)
    return State(replace(final.fit, of_context=fit.ties @ spread @ fit.ties.T))


def _coarse(final: State, step: float) -> Iterator[Finding]:
    """Yield a finding if the steps of the thermometer [°C] may be the cause of a gap."""
    change = np.sum(slope_of_temperature(final.fit) * final.fit.equations.force, axis=1)
    left_mg = rms(change) * step / np.sqrt(12.0) * MG
    gap_mg, floor_mg = final.gap_mg(final.residual), final.floor_mg or 0.0
    if not final.is_noise and left_mg ** 2 > _OF_GAP * (gap_mg ** 2 - floor_mg ** 2):
        yield Finding('coarse', f'the temperature is stated in steps of {step:.2g} °C, in which '
                      f'the readings change by {left_mg:.2g} mg (RMS)',
                      'record the temperature in finer steps')


def _conclude(calibration: Calibration, found: Found, given: Given) -> Refinement:
    """Return the refinement of a calibration by what a search has found."""
    start, final = found.base, _with_steps(found.final, given.poses)
    found = replace(found, final=final)
    if given.stored:  # as stored, without a fit
        kept = calibration.held(start.poses_g)
        start = State(judge(Model(calibration.model.values), kept))
    steps, stages = steps_of(found, start, calibration.date)
    missing, plan = untestable(found, steps), plan_refinement(
        find_rivals(found), final.model, final.poses_g, found.near.chosen.variance)
    verdict, _ = verdict_of(found, steps, refused=False)
    if verdict == 'no_gap' and calibration.reason != 'ideal' and not given.stored:
        alone = given.poses_g.take(np.isin(given.poses_g.row, calibration.used_poses.row))
        remarks = remarks_on(found, steps, missing, len(calibration.rejected))
        state = State(judge(Model(calibration.model.values), alone))
        return _record_of(calibration, state, missing, remarks)
    of_search = [*rejected_by(found.final.model, given.poses_g, found.outliers)]
    if found.clipped is not None:
        of_search += [Rejected(int(row), CLIPPED, 'clipped')
                      for row in given.poses_g.row[found.clipped.poses]]
    given = replace(given, rejected=(
        *given.rejected, *(each for each in of_search if each.row in given.poses.row)))
    refined = refined_calibration(calibration, final, found.added, given)
    is_refused = has(refined.noted, 'refused')
    outliers = tuple(each.row for each in refined.rejected if each.kind != 'clipped')
    if is_refused:
        steps = tuple(replace(step, parameters_sd={}) for step in steps)
    verdict, undecided = verdict_of(found, steps, refused=is_refused)
    cause = next((each.advice for each in (*given.poses.findings, *given.notes)
                  if each.kind in CAUSES), '')
    remarks = remarks_on(found, steps, missing, len(outliers), cause=cause,
                         unexplained=verdict == 'unexplained' and not undecided)
    fitted = _record_of(refined, final, missing, remarks)
    return replace(
        fitted, verdict=verdict, undecided=undecided, steps=steps, stages=stages, plan=plan,
        gap_mg=start.gap_mg(start.fit.residual), remaining_gap_mg=final.gap_mg(final.residual),
        disturbed_poses=outliers, one_curve=found.one_curve, also=found.also)


def _refine_with_fleet(poses: Poses, units: Units, fleet: FleetPrior, also: tuple[OwnEffect, ...]
                       ) -> Refinement:
    """
    Find effects beyond model 10, with the typical values of a fleet for model 10.

    The refined calibration has the method ``fleet``, and its covariance includes the prior. The
    steps have the residuals of the search, which does not use the fleet.

    """
    fitted = fit_with_fleet(poses, units, fleet)
    try:
        found = refine(poses, units, base=_BASE, also=also)
        refined = gated(found.calibration)
    except RefusedFitError as err:
        return _without_search(fitted, err.message, err.advice)
    if refined.model.effects == MODELS[_BASE].effects:
        return _with(found, fitted)
    values, covariance, findings = posterior(refined.model.vector, refined.covariance, fleet)
    model = with_vector(refined.model.effects, values)
    fit = judge(model, found.poses_g.without_columns(*_ORIENTATION))
    return _with(found, with_rest_noise(gated(replace(
        refined, model=Model(model.values, refined.model.rotation), covariance=covariance,
        method=FLEET, noted=(*findings, *refined.noted),
        quality=quality_of(fit, refined.units, unit(fit.equations.force)),
        reason=f'{refined.reason}; with {fleet.words}')), refined.poses))


def _with(found: Refinement, calibration: Calibration) -> Refinement:
    """Return a refinement with another calibration of the same effects."""
    if any(step.effect in PROCESSES for step in found.steps):  # not in the calibration
        return replace(found, calibration=calibration)
    state = State(judge(Model(calibration.model.values), found.poses_g))
    last = Stage(found.stages[-1].name, state.mg_of_poses(state.fit.residual))
    return replace(found, calibration=calibration, stages=(*found.stages[:-1], last),
                   remaining_gap_mg=state.gap_mg(state.fit.residual))


def _without_search(fitted: Calibration, message: str, advice: str) -> Refinement:
    """Return the fit with the fleet as a refinement, with the reason why nothing was searched."""
    poses_g = in_g(fitted.used_poses, fitted.units)
    fit = judge(Model(fitted.model.values), add_history(only_norm(poses_g), fitted.model))
    found = _record_of(
        fitted, State(fit), not_testable(poses_g, {}, fitted.model.effects),
        (Remark('not_searched', {'message': message}), Remark('refusal', {'advice': advice})))
    ratio = fitted.quality.chi2_per_dof
    quiet = not ratio or is_noise(fit.chi2, fit.chi2 / ratio)
    return replace(found, verdict='no_gap' if quiet else 'unexplained',
                   noise_floor_mg=fitted.quality.noise_floor_mg)


def _record_of(calibration: Calibration, state: State, missing: tuple[tuple[str, str], ...],
               remarks: tuple[Remark, ...]) -> Refinement:
    """Return the record of a calibration, by the state of its poses, without a step."""
    residual = state.fit.residual
    return Refinement(
        verdict='no_gap', noise_floor_mg=state.floor_mg, gap_mg=state.gap_mg(residual),
        remaining_gap_mg=state.gap_mg(residual), not_testable=missing, remarks=remarks,
        disturbed_poses=tuple(each.row for each in calibration.rejected), calibration=calibration,
        poses_g=state.poses_g, force=state.fit.equations.force,
        stages=(Stage('base', state.mg_of_poses(residual)),))


def base_of(poses: Poses, units: Units, name: str) -> Calibration:
    """
    Return the base as a calibration; errors as in `fit_poses`.

    The ideal sensor has a fitted offset and scale for native readings.

    """
    if name not in BASES:
        raise ValueError(f'base is {name!r}, expected one of {BASES}')
    if name != 'ideal':
        try:
            return fit_poses(poses, units, model=name)
        except RefusedFitError:
            if name != 'auto' or 'orientation' not in poses:
                raise
    values: dict[EffectKey, Floats] = {}
    if units.is_native:
        mat_w, vec_v = fit_sphere(poses.reading)
        units = Units('native', float(mat_w[0, 0]))
        values = {'offset': vec_v / units.per_g}
    poses_g = in_g(poses, units)
    fit = judge(Model(values), poses_g)
    return record_of(fit, poses, units, unit(poses_g.reading), name='ideal', method='ml',
                     reason='ideal')


@dataclass(frozen=True)
class Given:
    """The input poses, those used [g], whether the base is stored, rejected rows, and notes."""

    poses: Poses
    poses_g: Poses
    stored: bool
    rejected: tuple[Rejected, ...]
    notes: tuple[Finding, ...]


def refitted(before: Calibration, poses: Poses, *, sensor: str = '', date: str = ''
             ) -> Calibration:
    """
    Fit the values of a calibration anew to other poses, with the same effects.

    Parameters
    ----------
    before : Calibration
        The calibration; its unit is that of the readings.
    poses : Poses
        Poses with the columns that the effects need.
    sensor, date : str
        Name of the sensor and date for the result.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the values, or the result is not plausible.
    InputError
        If the readings are clearly in another unit.

    """
    check_units(poses, before.units)
    sure, doubts = sure_rows(poses)
    sound, unsound = sound_rows(sure, before.units)
    poses_g = add_history(in_g(sound, before.units), before.model)
    lacking = [key for key in before.model.needs if key not in poses_g]
    if lacking:
        raise RefusedFitError(f'the poses have no {" or ".join(lacking)}, which the calibration '
                              'in use corrects for', 'record it, or call ~/reset')
    final = fitted_state(Model(before.model.values), poses_g)
    for _ in range(_ROUNDS):
        if final is None or not len(outlying := outliers(final.fit, len(poses_g))):
            break
        final = fitted_state(Model(before.model.values), without(final.poses_g, outlying))
    else:
        final = None
    if final is None:
        raise RefusedFitError('the effects of the calibration cannot be fitted to these poses, '
                              'expected a fit that converges', TAKE_ALL_SIDES)
    out = [Rejected(int(row), 'outlier', 'outlier') for row in poses_g.row
           if row not in final.poses_g.row]
    given = Given(poses, poses_g, stored=True, rejected=(*doubts, *unsound, *out), notes=())
    calibration = gated(refined_calibration(before, _with_steps(final, poses), (), given))
    return replace(calibration, reason=before.reason, sensor=sensor or before.sensor, date=date)


def refined_calibration(base: Calibration, final: State, added: tuple[EffectKey, ...], given: Given
                        ) -> Calibration:
    """Return the refined calibration, with the finding ``refused`` if it must not be used."""
    model, matrix = with_changes(final.model)
    kept, poses = final.poses_g, given.poses
    if 'new' in kept:  # beside the poses of the stored calibration
        if final.model.effects == model.effects and all(key in base.poses for key in model.needs):
            poses = join(poses, base.used_poses)
        else:
            kept = kept.take(kept['new'] > 0.0)
    at_poses = judge(model, kept if base.form.known_orientation
                     else kept.without_columns(*_ORIENTATION))
    names = ', '.join(str(unchanged(name)) for name in added)
    others = without_kinds(base.noted, *OF_A_FIT)
    findings = [each for each in others if not given.stored or each.kind == 'flat_pose']
    refined = replace(
        base, model=Model(model.values, base.model.rotation),
        covariance=matrix @ final.fit.covariance @ matrix.T,
        quality=quality_of(at_poses, base.units, unit(at_poses.equations.force)), poses=poses,
        rejected=tuple(sorted(given.rejected, key=lambda each: each.row)),
        noted=(*given.notes, *findings), method='ml',
        reason=f'{base.reason}; refined: {names or "nothing added"}')
    try:
        if len(model.vector) > len(base.model.vector) and (
                final.dof < _LEAST_CHECKS or refined.quality.held_out_rms_mg is None):
            raise RefusedFitError(
                f'{counted(len(final.poses_g), "pose")} check '
                f'{counted(len(model.vector), "value")} too little to add effects, expected at '
                f'least {_LEAST_CHECKS} more than values',
                'take 24 poses or more, or use the result of fit')
        return _determined(gated(with_rest_noise(refined, given.poses)), final)
    except RefusedFitError as err:
        return refused(refined, err.message, err.advice)


def _determined(refined: Calibration, final: State) -> Calibration:
    """Return a calibration with findings; RefusedFitError if the poses do not determine it."""
    fit = final.fit
    if refined.name == 'ideal':  # an offset that was not fitted is not zero
        refuse_if_unfit('4', unit(fit.equations.force))
    if fit.undetermined:
        raise RefusedFitError(
            f'the poses do not determine {", ".join(fit.undetermined[:_NAMED])}'
            f'{", …" if len(fit.undetermined) > _NAMED else ""}', TAKE_ALL_SIDES)
    factor = variance_factor(fit.chi2, fit.dof, fit.noise_known)
    dilution = uncertainty_g(refined) / float(np.median(fit.equations.scale) * np.sqrt(factor))
    if dilution > LARGEST_DILUTION:
        raise RefusedFitError(
            'the poses do not determine the refined calibration: the error of |a| is up to '
            f'{dilution:.3g} times that of a pose, expected less than {LARGEST_DILUTION:.0f} '
            'times', TAKE_ALL_SIDES)
    own = without_kinds(fit_findings(fit, dilution), 'beyond_noise')  # the verdict states it
    return replace(refined, noted=(*refined.noted, *own))
