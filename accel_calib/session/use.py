# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibration in use and the poses of a session: what follows when they change.

Ratings, plans and files take time, so they are tasks, which are added to the events.

"""

from dataclasses import replace
import json
import math

import numpy as np

from .conditions import next_step
from .core import Holder
from .fitting import rated
from .sensor import Sensor, title
from .store import Store, tidied, unusable, writing_advice
from .stream import AGAIN
from .worker import Compute, Files, Mounting, nothing, Parse, Result, Severity, ShowPoses, Task
from ..calibration import Calibration, in_frame, on_topics, plan_session
from ..errors import DamagedCalibrationError, StoredCalibrationError
from ..findings import mounting_figures, Rating, rating_json
from ..refinement import Refinement
from ..stillness import Dwell
from ..table import CONTEXT, is_quantity, Poses
from ..text import counted

_SEVERITY: dict[str, Severity] = {'GOOD': 'info', 'USABLE': 'warning', 'BAD': 'error'}
"""Severity of the log line about a finding, by its level."""


def adopt(session: Holder, calibration: Calibration | None, refinement: Refinement | None = None,
          rating: Rating | None = None) -> None:
    """Correct with this calibration, and with the given mounting if there is one."""
    session.change(problem='', is_refused=False)
    state, settings = session.state, session.state.settings
    if calibration is None:
        session.change(sensor=session.sensor.adopt(None, settings))
        state.around.assume({})
        rate(session, None)
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
    session.change(sensor=session.sensor.adopt(calibration, settings))
    state.around.assume({key: value for key, value in calibration.typical.items()
                         if key in CONTEXT or is_quantity(key)})
    rate(session, refinement, rating)
    turned = calibration.is_levelled and settings.rotate
    session.log('info', f'correcting with {title(calibration)}; messages are in the frame '
                f'{settings.frame if turned else "of the sensor"}')
    for finding in calibration.noted:
        session.log(_SEVERITY[finding.level], finding.words)
    show_mounting(session)


def show_mounting(session: Holder) -> None:
    """Show the mounting of the calibration in use, if it is levelled."""
    calibration = session.sensor.calibration
    if session.state.frame_id and calibration is not None and calibration.is_levelled:
        levelled = on_topics(calibration, session.state.settings.frame)
        session.events.append(Mounting(levelled.rotation, session.state.frame_id))


def rate(session: Holder, refinement: Refinement | None, rating: Rating | None = None) -> None:
    """Add a task that rates the present calibration, if need be, and reports it as JSON."""
    calibration = session.sensor.present
    session.change_sensor(refinement=refinement)
    if rating is not None or calibration is None:
        session.change_sensor(rating=rating)
    if calibration is not None:
        session.events.append(_report_rating(session, calibration, refinement, rating))


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
    if new_rest is not None and state.sensor.live is sensor.live:
        guide, missed = guide.answer(new_rest.mean, state.units)
        session.change_sensor(guide=guide)
    due = added != 0 or guide.chosen is None or guide.is_stale
    given = poses, state.units, state.settings.model, guide.skipped
    try:
        yield Files(nothing) if store is None else Files(store.save_poses, poses)
    except OSError as error:
        session.log('error', f'the poses could not be stored: {error}; {writing_advice(error)}',
                    'not_stored', AGAIN)
    # Computed even where only an average has changed, so that the lines keep their order.
    plan = yield Compute(plan_session, *given) if due and len(poses) else Compute(nothing)
    if due and not len(poses):  # without the start of the worker process
        plan = plan_session(*given)
    if session.sensor.live is not sensor.live:
        return ''
    if plan is not None:
        session.change_sensor(guide=session.sensor.guide.choose(plan))
        asked = session.sensor.guide.plan or plan  # as the next step asks
        session.events.append(ShowPoses(plan.up, asked.asked, session.state.frame_id or ''))
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
