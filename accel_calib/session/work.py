# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The computations of a session, with their texts, and the tasks that it starts itself.

The computations are functions of poses and calibrations; most run in the worker process.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
import json
from typing import Any, cast, TYPE_CHECKING

import numpy as np

from .guidance import next_action, plan_for
from .sensor import gyro_bias_of_rest, Sensor
from .settings import CalibratorSettings
from .store import Store, tidied, unusable, writing_advice
from .stream import AGAIN
from .worker import Compute, Files, Parse, Part, Result, ShowPoses, Task
from .. import pipeline
from ..calibrate import Calibration, fit_partial, mounting_figures, outlook
from ..capture import Dwell, poses_from
from ..effects import Model
from ..findings import (
    calibration_json, rate, rate_refinement, Rating, rating_json, refinement_json)
from ..geometry import angle_of, spread_directions
from ..pipeline import is_partial, is_refined
from ..refine import refine, Refinement, residual_words, shown_name, times_typical, verdict_words
from ..table import Poses
from ..text import counted, listed, now, plain
from ..units import MG, Units

if TYPE_CHECKING:
    from .session import Session

_DIRECTIONS = 100
"""Number of directions over which two calibrations are compared."""

_BEYOND = 100.0
"""Ratio to the typical size above which an effect is not caused by the sensor."""


@dataclass(frozen=True)
class Fitted:
    """
    A new calibration: a fit, a refinement or another mounting.

    `words` are the answer, one sentence, and `details` are for the log. `rating` is None if it is
    not known yet. `differs`: an automatic fit replaces the calibration before it. `refusal` is why
    it must not be used, and what to do instead; empty if it can be used.

    """

    calibration: Calibration
    words: str
    details: list[str]
    rating: Rating | None = None
    refinement: Refinement | None = None
    differs: bool = True
    refusal: tuple[str, ...] = ()


def _refusal(rating: Rating, refinement: Refinement | None = None) -> tuple[str, ...]:
    """Return why a calibration must not be used, and what to do instead; empty if it can be."""
    if refinement is not None and refinement.refusal:
        return refinement.refusal
    return (rating.reason, rating.next.text) if rating.name == 'BAD' else ()


def fit(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
        before: Calibration | None) -> Fitted:
    """
    Return a fit of all poses with its rating, in the levelled frame of the calibration before.

    Errors are as in `pipeline.calibrated`; the advice is how to turn the sensor next.

    """
    found = pipeline.calibrated(poses, units, pipeline.Plan(
        settings.model, settings.method, refined=False, sensor=sensor, before=before,
        in_cone=True))
    calibration, rating, quality = found.calibration, found.rating, found.calibration.quality
    about = calibration.reason if is_partial(calibration) else (
        f'model {calibration.name} from {len(calibration.used_poses)} of '
        f'{counted(len(calibration.poses), "pose")}')
    floor = quality.noise_floor_mg
    details = [*([] if floor is None else [f'noise floor {floor:.3f} mg']),
               *(f'pose {each.row} left out: {each.reason}' for each in calibration.rejected),
               *calibration.warnings, change_words(before, calibration)]
    return Fitted(
        calibration, f'{rating.name}: {about}, residual {quality.rms_before_mg:.2f} mg before, '
        f'{quality.rms_after_mg:.3f} mg after', details, rating,
        differs=replaces(before, calibration),
        refusal=_refusal(rating))


def refined(poses: Poses, units: Units, sensor: str, before: Calibration | None, hint: str = '',
            own: tuple[str, ...] = ()) -> Fitted:
    """
    Return the refinement of a calibration (None: of a fit).

    An effect far beyond those of parts is refused; `hint` says which quantity may be missing. The
    own effects of these names are tried beside the catalogue.
    RefusedFitError if there are too few poses; InputError if the readings are clearly in another
    unit.

    """
    refinement = refine(poses, units, base='auto' if before is None else before, sensor=sensor,
                        date=now(), also=own)
    beyond = [step for step in refinement.steps if times_typical(step) > _BEYOND]
    if beyond and not refinement.refusal:
        refinement = replace(refinement, refusal=(
            f'{beyond[0].effect} is {times_typical(beyond[0]):.0f} times that of typical parts',
            f'find what else changed with it; {hint}' if hint else 'find what else changed with '
            'it: check the mounting and the setup, and take the poses again'))
    rating, calibration = rate_refinement(refinement), refinement.calibration
    details = [verdict_words(refinement).rstrip('.'), *(
        f'{shown_name(step.name)} {step.gap_before_mg:.3f} to {step.gap_after_mg:.3f} mg, '
        f'{step.where}' for step in refinement.steps)]
    if refinement.disturbed_poses:
        details.append(f'left out: {listed("pose", refinement.disturbed_poses)}')
    details += [*calibration.warnings, *refinement.advice]
    if not refinement.refusal:
        details.append(change_words(before, calibration))
    return Fitted(calibration, f'{rating.name}: {_verdict(refinement)}, '
                  f'{residual_words(refinement)}', details, rating, refinement,
                  refusal=_refusal(rating, refinement))


def _verdict(refinement: Refinement) -> str:
    names = [shown_name(step.name) + (f' (or {", ".join(step.likely_rivals)})' if step.rivals
                                      else '') for step in refinement.steps]
    found, verb = ' and '.join(names), 's' if len(names) == 1 else ''
    return {'no_gap': 'no gap beyond the noise', 'explained': f'{found} explain{verb} the gap',
            'described': f'{found} describe{verb} the gap'}.get(
        refinement.verdict, f'a gap remains beyond {found}' if names else 'a gap remains that no '
        'effect explains')


def at_rest(rest: Dwell, units: Units, sensor: str, before: Calibration | None) -> Calibration:
    """
    Return a calibration from one rest: the offset along gravity, and the bias of the gyro.

    The offset and gain of a full fit before are kept.

    """
    if before is None or is_partial(before):
        rotation = np.eye(3) if before is None else before.rotation
        found = fit_partial(poses_from([rest]), units, sensor=sensor, date=now())
        before = replace(found, model=Model(found.model.values, rotation))
    return replace(before, gyro=gyro_bias_of_rest(rest) or before.gyro)


def change_words(before: Calibration | None, after: Calibration) -> str:
    """Return what changes with a new calibration, as one line; empty without an earlier one."""
    if before is None:
        return ''
    offset = after.units.to_g(after.offset - before.offset) * MG
    gain = 100.0 * (np.linalg.solve(before.gain, after.gain) - np.eye(3))
    angle = angle_of(before.rotation.T @ after.rotation)
    effects = sorted(set(before.model.effects) ^ set(after.model.effects))
    words = [f'offset by ({", ".join(f"{part:+.2f}" for part in offset)}) mg',
             f'gain by up to {np.max(np.abs(gain)):.3f} %', f'mounting by {angle:.2f}°']
    words += [f'{"with" if name in after.model.effects else "without"} {name}' for name in effects]
    return f'changes {", ".join(words)}'


def replaces(before: Calibration | None, after: Calibration) -> bool:
    """
    Return whether an automatic fit replaces a calibration.

    It does if it differs by more than its own uncertainty, and the other has only offset and gain.

    """
    if before is None or is_refined(before) or is_partial(before):
        return before is None or not is_refined(before)
    up = spread_directions(_DIRECTIONS)
    (gain, offset), (gain_before, offset_before) = (
        each.model.linear_part for each in (after, before))
    change = up @ (gain - gain_before).T + offset - offset_before
    covariance = after.force_covariance(up * after.force_per_g) / after.force_per_g ** 2
    return bool(np.sum(change ** 2) > np.sum(np.trace(covariance, axis1=1, axis2=2)))


def rated(calibration: Calibration, refinement: Refinement | None, rating: Rating | None,
          model: str) -> tuple[Rating, dict[str, Any]]:
    """Return the rating of a calibration, if it is not known, and its JSON as of commands."""
    found = {} if refinement is None else refinement_json(refinement)
    whole = {**calibration_json(calibration, outlook(calibration, model)), **found}
    return (rate(calibration, refinement=refinement) if rating is None else rating,
            cast('dict[str, Any]', plain(whole)))


# ----------------------------------------------------------------------------- tasks of a session

@dataclass(frozen=True)
class Loaded:
    """What is usable of a store, notes, and `problem`: why the calibration cannot be used."""

    calibration: Calibration | None
    poses: Poses | None
    problem: str
    notes: tuple[str, ...]


def load(store: Store) -> Part[Loaded]:
    """Read a store; damaged files are renamed, and no file keeps the node from starting."""
    calibration, poses, problem = None, None, ''
    notes: list[str] = yield Files(tidied, store)
    try:
        calibration = yield Parse(store.load_calibration)
    except Exception as error:  # the node starts in any case
        problem = yield Files(unusable, store.calibration, error)
    if calibration is not None and calibration.stream not in ('', store.identity.topic):
        notes.append(f'{store.calibration} was made for {calibration.stream}, but it is used for '
                     f'{store.identity.topic}')
    try:
        poses = yield Files(store.load_poses)
    except Exception as error:
        notes.append((yield Files(unusable, store.poses, error, True)))
    return Loaded(calibration, poses, problem, tuple(notes))


def load_files(session: Session, store: Store, sensor: Sensor) -> Task:
    """Read the files of a sensor, and use them unless another one has replaced it."""
    loaded = yield from load(store)
    if session.sensor is not sensor:
        return ''
    sensor.owners = {each.sensor for each in (loaded.calibration, loaded.poses)
                     if each is not None and each.sensor}
    if loaded.poses is not None:
        sensor.live.book.add_stored(loaded.poses)
        session.log('info', f'read {counted(len(loaded.poses), "pose")} from the store')
    if loaded.calibration is not None:
        session.adopt(loaded.calibration)
        sensor.fitted_poses = len(loaded.calibration.poses)
    session.problem = loaded.problem
    for line in filter(None, (loaded.problem, *loaded.notes)):
        session.log('error', line)
    session.show_poses(store=False)
    return ''


def draw_poses(session: Session, sensor: Sensor, poses: Poses, added: int, new_rest: bool,
               store: Store | None) -> Task:
    """Store and draw poses, this number more than before; return the line about a new rest."""
    guide, given = sensor.guide, (poses, session.units, session.settings.model)
    due = added != 0 or guide.plan is None
    try:
        yield Files() if store is None else Files(store.save_poses, poses)
    except OSError as error:
        session.log('error', f'the poses could not be stored: {error}; {writing_advice(error)}',
                    'not_stored', AGAIN)
    # Computed even where only an average has changed, so that the lines keep their order.
    plan = yield Compute(plan_for, *given) if due and len(poses) else Compute()
    if due and not len(poses):  # without the start of the worker process
        plan = plan_for(*given)
    if plan is not None and sensor is session.sensor:
        guide.plan = plan
        session.report(ShowPoses(plan.up, plan.asked, session.frame_id or ''))
    if not new_rest or sensor is not session.sensor:
        return ''
    return guide.line(poses, session.units, next_action(session), added=added > 0)


def report_rating(session: Session, sensor: Sensor, calibration: Calibration,
                  rating: Rating | None) -> Task:
    """Rate a calibration, and report it, unless another one has replaced it."""
    rating, found = yield Compute(rated, calibration, sensor.refinement, rating,
                                  session.settings.model)
    if sensor.present is not calibration:
        return ''
    sensor.rating = rating
    action = next_action(session)
    if action is not None:
        mounting = {'mounting': mounting_figures(
            calibration.rotation, session.frame_id or '', session.settings.base_frame)}
        session.report(Result(json.dumps({
            **found, 'in_use': sensor.offered is not calibration,
            **(mounting if calibration.is_levelled else {}), **rating_json(
                rating, action.kind, action.words, action.command and f'~/{action.command}')})))
    return ''
