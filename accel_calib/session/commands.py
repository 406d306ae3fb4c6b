# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The commands of a session: what the services of the node do.

A command returns its answer, or a new calibration (`Fitted`), or raises an error that says what to
do. If something is to be computed or stored for it, it is a generator, which yields that (`Step`).
`run` uses a new calibration. If the parameter ``confirm`` is set, or the commands are of a page,
it only offers it: it is published on ~/preview, until ~/save stores it or ~/undo discards it.

"""

from collections.abc import Callable, Generator
from dataclasses import replace
from functools import partial
import math
from typing import Any

import numpy as np

from . import use
from .conditions import next_words, step_of, way_of, words_of_state
from .poses import Guide
from .state import Sensor, State
from .store import writing_advice
from .use import adopt, Fitted, Holder, rate, show_poses
from .worker import Compute, Files, nothing, Parse, Part, Task
from ..calibration import (
    Calibration, fit_partial, gyro_bias_of_rest, level, mounting_only, set_heading as with_heading)
from ..effects import Model
from ..errors import AccelCalibError, InputError, RefusedFitError, StoredCalibrationError
from ..findings import angle_words, difference_words
from ..pipeline import is_partial, is_refined
from ..stillness import Dwell, poses_from
from ..text import counted, now

_OLD = 0.5
"""Largest age of the last message for a capture [s]."""

_AUTO_FIT_EVERY = 60.0
"""Shortest time between two automatic fits [s]."""


class ChangedError(AccelCalibError):
    """The sensor or the calibration changed during a command, which may work the next time."""


class NoRestError(InputError):
    """The sensor does not rest at this moment, so that the next step is the same."""


def run(session: Holder, name: str, *, offers: bool = False) -> Task:
    """Run one of `BUTTONS`, and note why it is refused; `offers`: only offer what is new."""
    try:
        found = BUTTONS[name](session)
        if isinstance(found, Generator):
            found = yield from found
        if isinstance(found, Fitted):
            found = yield from _use(session, found, offers=offers)
    except AccelCalibError as error:
        if not isinstance(error, NoRestError | ChangedError):
            session.refuse(name, str(error))
        raise
    return found


# ----------------------------------------------------------------------------- poses

def capture_pose(session: Holder) -> Task:
    """Capture the ongoing rest as a pose."""
    sensor, dwell = session.sensor, _rest(session.state)
    session.state.files.usable()
    sensor.live.capture(dwell)
    session.change_sensor(guide=replace(sensor.guide, rest=dwell.start))  # the answer is its line
    poses_changed(session, ended=False)
    poses = sensor.live.poses()
    words = (f'{counted(len(poses), "pose")}: the sensor has been still for '
             f'{dwell.end - dwell.start:.1f} s')
    if session.state.computing:
        yield Files(nothing)
        return f'{words}; the next pose is on ~/poses after the computation that is running'
    yield Compute(nothing)  # until the next pose is chosen
    return f'{words}{next_words(session.state)}'


def undo_pose(session: Holder) -> Task:
    """Remove the last pose."""
    if session.state.files.store is not None:
        session.state.files.usable()
    if not session.sensor.live.undo():
        raise InputError('there are no poses to remove', 'capture a pose first')
    poses_changed(session, ended=False)
    count = len(session.sensor.live.poses())
    yield Files(nothing)  # until the poses are stored
    return f'the last pose is removed; remaining: {counted(count, "pose")}'


def poses_changed(session: Holder, *, ended: bool, new_rest: Dwell | None = None) -> None:
    """Draw and store the poses, and fit if auto_fit is set; `ended`: a rest has ended."""
    sensor = session.sensor
    show_poses(session, store=session.state.files.lock is not None, new_rest=new_rest)
    if ended or len(sensor.live.poses()) > sensor.fitted_poses:
        session.change_sensor(auto_fit_waits=True)
    fit_if_due(session)


def fit_if_due(session: Holder) -> None:
    """Add an automatic fit to the events if one is due."""
    sensor, settings = session.sensor, session.state.settings
    if (settings.auto_fit and sensor.auto_fit_waits and session.state.files.lock is not None
            and len(sensor.live.poses()) >= settings.auto_fit_poses
            and session.throttle.passes('auto_fit', _AUTO_FIT_EVERY)):
        session.change_sensor(auto_fit_waits=False)
        session.events.append(_auto_fit(session, sensor))


def _auto_fit(session: Holder, sensor: Sensor) -> Task:
    """Fit the poses of a sensor; use the result if it differs by more than its uncertainty."""
    if session.sensor.live is not sensor.live:
        return ''
    before = session.sensor.present
    try:
        fitted = yield from fit(session)
    except ChangedError:
        session.change_sensor(auto_fit_waits=True)
        return ''
    except RefusedFitError as error:
        session.log('warning', str(error), str(error), math.inf)
        return ''
    if not use.differs(before, fitted.calibration):
        return ''
    return (yield from _use(session, fitted, offers=False))


# ----------------------------------------------------------------------------- calibrations

def fit(session: Holder) -> Part[Fitted]:
    """Fit the poses; the values of a refined calibration are fitted anew."""
    return (yield from _compute(session, use.fit, settings=session.state.settings))


def refine(session: Holder) -> Part[Fitted]:
    """Refine the calibration."""
    state = session.state
    hint = '' if 'temperature' in state.around.values else way_of('temperature', state)
    fitted = yield from _compute(session, use.refine, hint=hint, own=state.own)
    guide, planned = session.sensor.guide, fitted.refinement.plan.poses
    session.change_sensor(guide=replace(guide, planned=planned or None, begun=guide.poses))
    return fitted


def _compute(session: Holder, function: Callable[..., Fitted], **given: Any) -> Part[Any]:
    """Return what a function makes of the poses; fail if it is not fit for use, or outdated."""
    session.state.files.usable()
    state, sensor, name = session.state, session.sensor, function.__name__
    session.change(computing=state.computing + 1)
    try:
        poses = sensor.live.poses_for_fit(
            state.found, () if sensor.present is None else sensor.present.model.needs)
        count = len(sensor.live.poses())
        found = yield Compute(function, poses, units=state.units, sensor=state.name,
                              before=sensor.present, **given)
    except RefusedFitError as error:
        session.refuse('poses', error.advice if error.offer is None else error.message)
        if error.offer is not None and (asked := _asked(session)):
            error = RefusedFitError(error.message, f'{asked}{error.offer}')
        raise error from None
    finally:
        session.change(computing=session.state.computing - 1)
    if session.sensor.live is not sensor.live or session.sensor.changes != sensor.changes:
        raise ChangedError(f'another command changed the calibration during ~/{name}; '
                           'the result is discarded', f'call ~/{name} again')
    rating, refinement = found.rating, found.refinement
    if rating.name == 'BAD':
        why, advice = rating.reason, rating.next.text
        is_asked = refinement is None and rating.next.kind == 'poses'  # the step names the pose
        session.refuse('poses', why if is_asked else advice)
        advice = (_asked(session) if is_asked else '') or advice
        if refinement is not None:
            rate(session, refinement)
        raise RefusedFitError(f'{found.words}; not used: {why}', advice)
    session.change_sensor(fitted_poses=count)
    return found


def _asked(session: Holder) -> str:
    """Return the pose that the next step asks for; empty if it asks for none."""
    step = step_of(session.sensor.guide, may_fit=False)
    return step.text if step.direction else ''


def _use(session: Holder, fitted: Fitted, *, offers: bool) -> Part[str]:
    """Store and use, or offer, a new calibration; log the details, and return the answer."""
    calibration, words = fitted.calibration, fitted.words
    store, mounting = session.state.files.usable(), session.state.mounting_words(calibration)
    if offers or session.state.settings.confirm:
        session.change(sensor=session.sensor.offer(calibration))
        rate(session, fitted.refinement, fitted.rating)
        session.log('info', '; '.join(filter(None, [*fitted.details, mounting])))
        return (f'{words}; published on ~/preview only: call ~/save to use and store it, or '
                '~/undo to discard it')
    try:
        yield from _alone(session, Files(store.write, Parse(store.prepared, calibration)))
    except OSError as error:
        adopt(session, calibration, fitted.refinement, fitted.rating)
        session.change_sensor(unsaved=True)
        raise InputError(f'the calibration is in use but could not be stored: {error}',
                         f'{writing_advice(error)}, and call ~/save') from error
    adopt(session, calibration, fitted.refinement, fitted.rating)
    session.log('info', '; '.join(filter(None, [
        *fitted.details, f'stored in {store.calibration}', mounting])))
    return f'{words}{next_words(session.state)}'


# ----------------------------------------------------------------------------- the mounting

def set_level(session: Holder) -> Fitted:
    """Level the mounting from the ongoing rest; without a calibration, the mounting alone."""
    state, rest = session.state, _rest(session.state)
    calibration = state.sensor.present or state.with_given(mounting_only(
        poses_from([rest]), state.units, sensor=state.name, date=now()))
    return _mount(state, calibration, 'the mounting is levelled by this pose', rest)


def set_heading(session: Holder) -> Fitted:
    """Set the heading of the mounting from the ongoing rest, with the nose down."""
    calibration = session.sensor.present
    if calibration is None or not calibration.is_levelled:
        raise InputError('the mounting is not levelled', 'place the robot flat and call '
                         '~/set_level first, then tilt its nose down')
    rest = _rest(session.state)
    headed = with_heading(calibration, rest.mean, session.sensor.context_of(rest, calibration))
    words = 'the heading is set by this pose'
    if headed.rotation[:, 0] @ calibration.rotation[:, 0] < 0.0:
        words += ('; the front of the robot is now on the other side of the sensor: if the '
                  'nose was up, tilt it down and call ~/set_heading again')
    return _mount(session.state, headed, words)


def calibrate_at_rest(session: Holder) -> Fitted:
    """Take mounting, gyro bias and the offset along gravity from the ongoing level rest."""
    state, rest = session.state, _rest(session.state)
    before = state.sensor.present
    if before is not None and (is_refined(before) or not is_partial(before)):
        found, words = before, (
            'the offset over temperature is kept, so that this rest corrects no offset'
            if is_partial(before) else 'offset and gain of the fit are kept')
    else:
        found = fit_partial(poses_from([rest]), state.units, sensor=state.name, date=now())
        rotation = np.eye(3) if before is None else before.rotation
        found = replace(found, model=Model(found.model.values, rotation))
        words = found.reason
    gyro = gyro_bias_of_rest(rest) or found.gyro
    if gyro is not None:
        bias = ', '.join(f'{np.degrees(part):+.3f}' for part in gyro.bias)
        words += f', gyro bias ({bias}) °/s'
    return _mount(state, state.with_given(replace(found, gyro=gyro)), words, rest)


def _mount(state: State, calibration: Calibration, words: str, rest: Dwell | None = None
           ) -> Fitted:
    """Return a calibration with a new mounting, levelled by a rest if there is one."""
    if rest is not None:
        calibration = level(calibration, rest.mean, state.frame,
                            state.sensor.context_of(rest, calibration))
        up = calibration.rotation[:, 2]
        if not np.allclose(state.with_given(calibration).rotation[:, 2], up):
            raise InputError('this pose differs by more than 10° of tilt from the mounting in '
                             'mounting_rpy or base_frame', 'place the robot level, or correct the '
                             'given mounting and restart the node')
    details = [difference_words(state.sensor.present, calibration), *(
        each.words for each in calibration.noted if each.kind in ('flat_pose', 'heading'))]
    return Fitted(calibration, f'{words}; {angle_words(calibration.rotation)}', details,
                  refinement=state.sensor.refinement)


def _rest(state: State) -> Dwell:
    """Return the ongoing rest; NoRestError if there is none, or no recent message."""
    statistics, settings, live = state.statistics, state.settings, state.sensor.live
    old = max(_OLD, 2.0 / statistics.rate if statistics.rate else 0.0)
    if state.surroundings.ended:
        raise NoRestError('the samples have ended', 'a rest can be used while they arrive')
    if not statistics.messages:
        raise NoRestError('there is no Imu message yet', 'start the driver')
    if statistics.age > old:
        raise NoRestError(f'the last Imu message arrived {statistics.age:.1f} s ago, expected '
                          f'one within {old:g} s', 'check the driver and try again')
    if statistics.stopped > old:
        raise NoRestError(f'the stamps have not changed for {statistics.stopped:.1f} s '
                          f'({statistics.stamp:.3f} s), expected the time of each reading',
                          'set header.stamp in the driver')
    rest = live.detector.current()
    if rest is not None:
        return rest
    length = math.nan if state.units.is_native else statistics.length / state.units.per_g
    if abs(length - 1.0) > settings.still_norm_tolerance:
        raise NoRestError(f'|a| is {length:.3g} g, expected about 1 g at rest', 'hold the sensor '
                          'still; if it is still, start again with the right units')
    if not live.still:
        raise NoRestError('the sensor is not still', f'hold it still for {settings.min_dwell:g} '
                          's, and check ~/still')
    raise NoRestError(f'the sensor has been still for less than {settings.min_dwell:g} s',
                      'hold it still for longer')


# ----------------------------------------------------------------------------- files

def save(session: Holder) -> Task:
    """Use the offered calibration if there is one; store calibration and poses."""
    sensor, store = session.sensor, session.state.files.usable()
    calibration = sensor.present
    if calibration is None:
        raise InputError('there is no calibration', 'capture poses and call ~/fit first')
    yield Files(store.write, Parse(store.prepared, calibration))
    yield Files(store.save_poses, sensor.live.poses())
    if session.sensor.live is sensor.live:
        session.change(not_stored='')
        session.change_sensor(unsaved=False)
        if session.sensor.offered is calibration:
            adopt(session, calibration, session.sensor.refinement, session.sensor.rating)
    return f'stored in {store.calibration} and {store.poses}'


def load(session: Holder) -> Task:
    """Read the stored calibration again; if it is refused, the calibration in use is kept."""
    store = session.state.files.usable()
    calibration = yield from _alone(session, Parse(store.load_calibration))
    if calibration is None:
        raise StoredCalibrationError(f'{store.calibration} does not exist',
                                     'capture poses and call ~/fit, or copy a calibration '
                                     'there')
    adopt(session, calibration)
    return f'read {store.calibration}'


def undo(session: Holder) -> Task:
    """Discard the offered calibration, or return to the one before the last stored one."""
    if session.sensor.offered is not None:
        session.change(sensor=session.sensor.offer(None))
        session.change_sensor(fitted_poses=0)
        rate(session, None)
        kept = 'there is no other one' if session.sensor.calibration is None else (
            'the one in use is unchanged')
        return f'the calibration on ~/preview is discarded; {kept}'
    calibration = yield from _alone(session, Files(session.state.files.usable().step_back))
    before = session.sensor.calibration
    adopt(session, calibration)
    session.change_sensor(fitted_poses=0)
    if calibration is None:
        return 'there is no calibration any more, as before the first fit'
    changes = '' if before is None else f'; {difference_words(before, calibration)}'
    return f'the calibration of {calibration.date or "unknown date"} is in use{changes}'


def reset(session: Holder) -> Task:
    """Remove poses and calibration; the stored files are renamed."""
    store = session.state.files.usable()
    kept = yield from _alone(session, Files(store.set_aside, Parse(store.is_good)))
    session.sensor.live.clear()
    adopt(session, None)
    session.change_sensor(fitted_poses=0, guide=Guide())
    poses_changed(session, ended=False)
    return 'poses and calibration are removed' + ''.join(
        f'; the stored file is kept as {path.name}' for path in kept)


def _alone(session: Holder, step: Parse) -> Part[Any]:
    """Use files; fail if another sensor replaces this one meanwhile."""
    sensor, name = session.sensor, session.state.name
    found = yield step
    if session.sensor.live is not sensor.live:
        raise ChangedError(f'the sensor {session.state.name!r} has replaced {name!r} meanwhile, '
                           'expected one sensor: the result is not used',
                           'call the service again')
    return found


COMMANDS: dict[str, Callable[[Holder], Any]] = {each.__name__: each for each in (
    capture_pose, undo_pose, fit, refine, set_level, set_heading, calibrate_at_rest, save, undo,
    load, reset)}
"""The commands without an argument, which are services of the node."""


def enable(session: Holder, on: bool) -> str:
    """Switch the correction on or off."""
    session.change(enabled=on)
    words = words_of_state(session.state)
    if on and session.sensor.calibration is None:
        words += next_words(session.state)
    return f'correction on: {words}' if on else words


BUTTONS: dict[str, Callable[[Holder], Any]] = {
    **COMMANDS, 'enable': partial(enable, on=True), 'disable': partial(enable, on=False)}
"""The commands of the page."""
