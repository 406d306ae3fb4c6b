# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrations and the poses of a session: their computation, and what follows when they change.

The computations are functions of the poses, which run in the worker process. Ratings, plans and
files take time, so they are tasks, which are added to the events.

"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
import json
import math
from pathlib import Path
from typing import Any, cast

import numpy as np

from .conditions import next_step
from .settings import CalibratorSettings
from .state import new_sensor, Sensor, State, title
from .store import Store, tidied, unusable, writing_advice
from .stream import AGAIN, Around, StreamStatistics
from .worker import (
    Compute, Event, Files, Log, Mounting, nothing, Parse, Result, Severity, ShowPoses, Task,
    Throttle)
from ..calibration import Calibration, in_frame, on_topics, plan_session, refused
from ..effects import effects_of_file, OwnEffect, shown_name
from ..errors import DamagedCalibrationError, InputError, StoredCalibrationError
from ..findings import (
    calibration_json, difference_words, mounting_figures, outlook, rate as rating_of, Rating,
    rating_json, refinement_json, short_verdict, verdict_words)
from ..geometry import rotation_from_rpy, spread_directions
from ..messages import output_frame
from ..pipeline import calibrated, is_partial, is_refined, Plan
from ..refinement import refine as refine_poses, Refinement
from ..stillness import Dwell
from ..table import CONTEXT, is_quantity, Poses
from ..text import counted, listed, now, plain
from ..units import Units, units_of

_DIRECTIONS = 100
"""Number of directions over which two calibrations are compared."""

_BEYOND = 100.0
"""Ratio to the typical size above which an effect is not caused by the sensor."""

_NOTHING_IN_USE = json.dumps({'in_use': False, 'error': 'there is no calibration',
                              'advice': 'capture poses and call ~/fit'})
"""What ~/result has after ~/undo or ~/reset, so that nobody takes the last result for it."""

_SEVERITY: dict[str, Severity] = {'GOOD': 'info', 'USABLE': 'warning', 'BAD': 'error'}
"""Severity of the log line about a finding, by its level."""


# ----------------------------------------------------------------------------- computations

@dataclass(frozen=True)
class Fitted:
    """
    A new calibration: a fit, a refinement or another mounting.

    `words` are the answer, one sentence, and `details` are for the log. `rating` is None if it is
    not known yet.

    """

    calibration: Calibration
    words: str
    details: list[str]
    rating: Rating | None = None
    refinement: Refinement | None = None


def fit(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
        before: Calibration | None) -> Fitted:
    """
    Return a fit of all poses with its rating, in the levelled frame of the calibration before.

    Errors are as in `pipeline.calibrated`; the advice is how to turn the sensor next.

    """
    found = calibrated(poses, units, Plan(
        settings.model, settings.method, refined=False, sensor=sensor, before=before,
        partial=True))
    calibration, rating, quality = found.calibration, found.rating, found.calibration.quality
    about = calibration.reason if is_partial(calibration) else (
        f'model {calibration.name} from {len(calibration.used_poses)} of '
        f'{counted(len(calibration.poses), "pose")}')
    floor = quality.noise_floor_mg
    details = [*([] if floor is None else [f'noise floor {floor:.3f} mg']),
               *(f'pose {each.row} left out: {each.reason}' for each in calibration.rejected),
               *calibration.warnings, difference_words(before, calibration)]
    return Fitted(
        calibration, f'{rating.name}: {about}, residual {quality.rms_before_mg:.2f} mg before, '
        f'{quality.rms_after_mg:.3f} mg after', details, rating)


def refine(poses: Poses, units: Units, sensor: str, before: Calibration | None, hint: str,
           own: tuple[OwnEffect, ...]) -> Fitted:
    """
    Return the refinement of a calibration (None: of a fit).

    An effect far beyond those of parts is refused; `hint` says which quantity may be missing. The
    own effects are tried beside the catalogue.
    RefusedFitError if there are too few poses; InputError if the readings are clearly in another
    unit.

    """
    refinement = refine_poses(poses, units, base='auto' if before is None else before,
                              sensor=sensor, date=now(), also=own)
    beyond = [step for step in refinement.steps if step.times_typical > _BEYOND]
    if beyond and not refinement.refusal:
        refinement = replace(refinement, calibration=refused(
            refinement.calibration,
            f'{beyond[0].effect} is {beyond[0].times_typical:.0f} times that of typical parts',
            f'find what else changed with it; {hint}' if hint else 'find what else changed with '
            'it: check the mounting and the setup, and take the poses again'))
    calibration = refinement.calibration
    rating = rating_of(calibration, refinement=refinement)
    details = [verdict_words(refinement).rstrip('.'), *(
        f'{shown_name(step.name)} {step.gap_before_mg:.3f} to {step.gap_after_mg:.3f} mg, '
        f'{step.where}' for step in refinement.steps)]
    if refinement.disturbed_poses:
        details.append(f'left out: {listed("pose", refinement.disturbed_poses)}')
    details += [*calibration.warnings, *refinement.advice]
    if not refinement.refusal:
        details.append(difference_words(before, calibration))
    return Fitted(calibration, f'{rating.name}: {short_verdict(refinement)}, {rating.figures}',
                  details, rating, refinement)


def rated(calibration: Calibration, refinement: Refinement | None, rating: Rating | None,
          model: str) -> tuple[Rating, dict[str, Any]]:
    """Return the rating of a calibration, if it is not known, and its JSON as of commands."""
    found = {} if refinement is None else refinement_json(refinement)
    whole = {**calibration_json(calibration, outlook(calibration, model)), **found}
    return (rating_of(calibration, refinement=refinement) if rating is None else rating,
            cast('dict[str, Any]', plain(whole)))


def differs(before: Calibration | None, after: Calibration) -> bool:
    """Return whether an automatic fit differs from a calibration by more than its uncertainty."""
    if before is None or is_refined(before) or is_partial(before):
        return before is None or not is_refined(before)  # a refined one is kept
    up = spread_directions(_DIRECTIONS)
    (gain, offset), (gain_before, offset_before) = (
        each.model.linear_part for each in (after, before))
    change = up @ (gain - gain_before).T + offset - offset_before
    covariance = after.force_covariance(up * after.force_per_g) / after.force_per_g ** 2
    return bool(np.sum(change ** 2) > np.sum(np.trace(covariance, axis1=1, axis2=2)))


# ----------------------------------------------------------------------------- use

class Holder:
    """
    The present state of a session, and what it reports; parameters and errors as `Session`.

    Attributes
    ----------
    state : State
        The present state; another one after each change.
    events : deque of Event
        What the session reports, in order; whoever shows it removes it.
    throttle : Throttle
        When log lines and automatic fits are due again.

    """

    def __init__(self, settings: CalibratorSettings, topic: str, clock: Callable[[], float],
                 **known: Any) -> None:
        try:
            own = effects_of_file(Path(settings.also).expanduser()) if settings.also else ()
        except (OSError, RuntimeError) as error:
            raise InputError(f'also is {settings.also}, which cannot be read: {error}',
                             'correct the parameter') from error
        units, rpy = units_of(settings.units, settings.gravity), settings.mounting_rpy
        self.state = replace(State(
            settings, topic, units, sensor=new_sensor(settings, units),
            statistics=StreamStatistics(clock), around=Around(clock), own=own,
            given=rotation_from_rpy(*rpy).T if any(rpy) else None), **known)
        self.events, self.throttle = deque[Event](), Throttle(clock)

    @property
    def sensor(self) -> Sensor:
        """Return the present sensor."""
        return self.state.sensor

    def change(self, **changes: Any) -> None:
        """Go on with a state in which these fields are changed."""
        self.state = replace(self.state, **changes)

    def change_sensor(self, **changes: Any) -> None:
        """Go on with a sensor in which these fields are changed."""
        self.change(sensor=replace(self.sensor, **changes))

    def refuse(self, command: str, words: str) -> None:
        """Note that a command is refused, or ``poses`` for a fit, and what to do."""
        refused = words, self.state.situation_of(command)
        self.change(refusals={**self.state.refusals, command: refused})

    def drop(self, kind: str, severity: Severity, words: str, count: int = 1) -> None:
        """Count dropped messages of a kind, and log why, at most once in `AGAIN`."""
        self.state.statistics.drop(kind, count)
        self.log(severity, words, kind, AGAIN)

    def log(self, severity: Severity, words: str, kind: str = '', once_in: float = 0.0) -> None:
        """Add a log line to the events; of a kind, if it has one, at most one in `once_in` [s]."""
        if words and (not kind or self.throttle.passes(kind, once_in)):
            self.events.append(Log(severity, words))


def adopt(session: Holder, calibration: Calibration | None, refinement: Refinement | None = None,
          rating: Rating | None = None) -> None:
    """Correct with this calibration, and with the given mounting if there is one."""
    session.change(problem='', is_refused=False)
    state, settings, before = session.state, session.state.settings, session.sensor.calibration
    if calibration is None:
        session.change(sensor=session.sensor.adopt(None))
        state.around.assume({})
        rate(session, None)
        show_mounting(session, before)
        return
    levelled = calibration.is_levelled
    if levelled and calibration.frame != state.frame:
        session.log('warning', f'the stored mounting is for the frame {calibration.frame}, but '
                    f'frame is {settings.frame}: it is turned, and a measured heading is kept')
        calibration = in_frame(calibration, state.frame)
    stored, calibration = calibration, state.with_given(calibration)
    if levelled and not np.allclose(stored.rotation[:, 2], calibration.rotation[:, 2]):
        session.log('warning', 'the stored mounting differs from the given one by more than 10° '
                    'of tilt: the given mounting is used; call ~/set_level with the robot level')
    session.change(sensor=session.sensor.adopt(calibration))
    state.around.assume({key: value for key, value in calibration.typical.items()
                         if key in CONTEXT or is_quantity(key)})
    rate(session, refinement, rating)
    turned = calibration.is_levelled and settings.rotate
    session.log('info', f'correcting with {title(calibration)}; messages are in the frame '
                f'{settings.frame if turned else "of the sensor"}')
    for finding in calibration.noted:
        session.log(_SEVERITY[finding.level], finding.words)
    show_mounting(session, before)


def show_mounting(session: Holder, before: Calibration | None = None) -> None:
    """
    Show the mounting of the calibration in use, if it is levelled.

    A static transform cannot be removed: that of a levelled calibration `before` becomes identity.

    """
    used, frame_id, settings = session.sensor.calibration, session.state.frame_id, (
        session.state.settings)
    shown = next((each for each in (used, before) if each is not None and each.is_levelled), None)
    if frame_id and shown is not None:
        turned = on_topics(shown, settings.frame)
        session.events.append(Mounting(
            turned.rotation if shown is used else np.eye(3), frame_id,
            output_frame(turned, frame_id, settings.output_frame_id)))


def rate(session: Holder, refinement: Refinement | None, rating: Rating | None = None) -> None:
    """Add a task that rates the present calibration, if need be, and reports it as JSON."""
    calibration = session.sensor.present
    session.change_sensor(refinement=refinement)
    if rating is not None or calibration is None:
        session.change_sensor(rating=rating)
    session.events.append(Result(_NOTHING_IN_USE) if calibration is None else _report_rating(
        session, calibration, refinement, rating))


def _report_rating(session: Holder, calibration: Calibration, refinement: Refinement | None,
                   rating: Rating | None) -> Task:
    """Rate a calibration, and report it, unless another one has replaced it."""
    rating, found = yield Compute(rated, calibration, refinement, rating,
                                  session.state.settings.model)
    if session.sensor.present is not calibration:
        return ''
    session.change_sensor(rating=rating)
    action = next_step(session.state)
    if action.kind:
        found['in_use'] = session.sensor.offered is not calibration
        if calibration.is_levelled:
            found['mounting'] = mounting_figures(
                calibration.rotation, session.state.frame_id or '',
                session.state.settings.base_frame)
        command = action.command and f'~/{action.command}'
        session.events.append(Result(json.dumps({
            **found, **rating_json(rating, action, command)})))
    return ''


def show_poses(session: Holder, *, store: bool, new_rest: Dwell | None = None) -> None:
    """Add a task that stores the poses, and draws them with the next pose."""
    sensor, guide = session.sensor, session.sensor.guide
    poses = sensor.live.poses()
    if len(poses) != guide.count:
        session.change_sensor(guide=replace(
            guide, count=len(poses), new_at=session.state.statistics.stamp))
    session.events.append(_draw_poses(
        session, sensor, poses, added=len(poses) - guide.count, new_rest=new_rest,
        store=session.state.files.store if store else None))


def _draw_poses(session: Holder, sensor: Sensor, poses: Poses, *, added: int,
                new_rest: Dwell | None, store: Store | None) -> Task:
    """Store and draw poses, this number more than before; return the line of a new rest."""
    state, guide, missed = session.state, session.sensor.guide, ''
    if new_rest is not None and state.sensor.live is sensor.live and next_step(state).direction:
        guide, missed = guide.answer(new_rest.mean, state.units)
        session.change_sensor(guide=guide)
    due = added != 0 or guide.chosen is None or guide.is_stale
    given = poses, state.units, state.settings.model, guide.skipped
    try:
        yield Files(nothing) if store is None else Files(store.save_poses, poses)
        if store is not None:
            session.change(not_stored='')
    except OSError as error:
        session.change(not_stored=f'the poses could not be stored: {error}; '
                                  f'{writing_advice(error)}')
    # Computed even where only an average has changed, so that the lines keep their order.
    plan = yield Compute(plan_session, *given) if due and len(poses) else Compute(nothing)
    if due and not len(poses):  # without the start of the worker process
        plan = plan_session(*given)
    if session.sensor.live is not sensor.live:
        return ''
    if plan is not None:
        session.change_sensor(guide=session.sensor.guide.choose(plan))
        session.events.append(ShowPoses(plan.up))
    if new_rest is None:
        return ''
    guide, step = session.sensor.guide, next_step(session.state)
    session.log('warning', guide.axes_words, f'axes {guide.axes.tolist()}', math.inf)
    line = '' if not step.kind else guide.line(
        poses, session.state.units, '' if step.kind == 'done' else step.text,
        asks=step.kind == 'poses', added=added > 0)
    return '; '.join(filter(None, (missed, line)))


def open_files(session: Holder, store: Store, sensor: Sensor) -> Task:
    """Read the files of a sensor, and use them unless another one has replaced it."""
    calibration: Calibration | None = None
    poses: Poses | None = None
    problem = ''
    notes: list[str] = yield Files(tidied, store)
    try:
        calibration = yield Parse(store.load_calibration)
    except Exception as error:  # the node starts in any case
        session.change(is_refused=isinstance(error, StoredCalibrationError) and not isinstance(
            error, DamagedCalibrationError))
        problem = yield Files(unusable, store.calibration, error)
    if calibration is not None and calibration.stream not in ('', store.topic):
        notes.append(f'{store.calibration} was made for {calibration.stream}, but it is used '
                     f'for {store.topic}')
    try:
        poses = yield Files(store.load_poses)
    except Exception as error:
        notes.append((yield Files(unusable, store.poses, error, True)))
    if session.sensor.live is not sensor.live:
        return ''
    session.change_sensor(owners=frozenset(
        each.sensor for each in (calibration, poses) if each is not None and each.sensor))
    if poses is not None:
        sensor.live.add_stored(poses)
        session.log('info', f'read {counted(len(poses), "pose")} from the store')
    if calibration is not None:
        adopt(session, calibration)
        session.change_sensor(fitted_poses=len(calibration.poses))
    session.change(problem=problem)
    for line in filter(None, (problem, *notes)):
        session.log('error', line)
    show_poses(session, store=False)
    return ''
