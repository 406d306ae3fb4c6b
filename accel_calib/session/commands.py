# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The commands of a session: what the services of the node do.

A command is a generator. It yields what is to be computed or stored, and returns its answer, or
raises an error that says what to do. If the parameter ``confirm`` is set, or a command is called
with `offered`, a new calibration is only offered: it is published on ~/preview, until ~/save
stores it or ~/undo discards it.

"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from .guidance import is_partial, next_action
from .sensor import Sensor
from .store import Store, writing_advice
from .stream import thermometer_words
from .work import at_rest, change_words, fit, Fitted, plan_for, refined
from .worker import Calibrations, Compute, Files, Found, Part, Task
from ..calibrate import angle_words, Calibration, level, mounting_only, mounting_words, set_heading
from ..capture import Dwell, poses_from
from ..errors import AccelCalibError, InputError, RefusedFitError, StoredCalibrationError
from ..text import counted, now

if TYPE_CHECKING:
    from .session import Session
    from ..findings import Rating
    from ..refine import Refinement

_OLD = 0.5
"""Largest age of the last message for a capture [s]."""

_AUTO_FIT_EVERY = 60.0
"""Shortest time between two automatic fits [s]."""

_NEXT_LATER = 'the next pose is on ~/poses after the computation that is running'
"""Advice while a fit or a refinement occupies the worker process."""


class ChangedError(AccelCalibError):
    """The calibration changed during a fit or a refinement."""


class Commands:
    """The commands of a session, which is the only argument."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._refused, self._auto_fit_at = '', -math.inf

    # Poses

    def capture_pose(self) -> Task:
        """Capture the ongoing rest as a pose."""
        session = self._session
        self._check_fresh()
        session.files.usable()
        dwell = session.sensor.live.capture_now()
        if dwell is None:
            raise self._not_still()
        session.sensor.guide.is_new_rest(dwell.start)  # the answer is the line about this pose
        session.poses_changed(ended=False)
        poses = session.sensor.live.book.poses()
        words = (f'{counted(len(poses), "pose")}: the sensor has been still for '
                 f'{dwell.end - dwell.start:.1f} s')
        if session.computing:
            yield Files()
            return f'{words}; {_NEXT_LATER}'
        sensor = session.sensor
        plan = yield Compute(plan_for, poses, session.units, session.settings.model)
        if session.sensor is sensor:
            sensor.guide.plan = plan
        return f'{words}{self._next()}'

    def _next(self) -> str:
        """Return the end of an answer: the next step."""
        action = next_action(self._session)
        return '' if action is None else f'; next: {action.words}'

    def undo_pose(self) -> Task:
        """Remove the last pose."""
        session = self._session
        if session.files.store is not None:
            session.files.usable()
        if not session.sensor.live.undo():
            raise InputError('there are no poses to remove', 'capture a pose first')
        session.poses_changed(ended=False)
        count = len(session.sensor.live.book.poses())
        yield Files()  # until the poses are stored
        return f'the last pose is removed; remaining: {counted(count, "pose")}'

    # Calibrations

    def fit(self, *, offered: bool = False) -> Task:
        """Fit the poses; use and store the calibration, or only offer it."""
        fitted = yield from self._fitted()
        return (yield from self._use_fit(fitted, offered=offered))

    def _use_fit(self, fitted: Fitted, *, offered: bool = False) -> Part[str]:
        """Store and use, or offer, a fit or a refinement; return the answer."""
        return (yield from self._use(fitted.calibration, fitted.words, fitted.details,
                                     fitted.refinement, fitted.rating, offered=offered))

    def due(self) -> list[Task]:
        """Return an automatic fit if one is due."""
        session, now = self._session, self._session.clock()
        sensor, settings = session.sensor, session.settings
        if (settings.auto_fit and sensor.auto_fit_waits
                and now - self._auto_fit_at >= _AUTO_FIT_EVERY and session.files.locked
                and len(sensor.live.book.poses()) >= settings.auto_fit_poses):
            sensor.auto_fit_waits, self._auto_fit_at = False, now
            return [self._auto_fit(sensor)]
        return []

    def _auto_fit(self, sensor: Sensor) -> Task:
        """Fit the poses of a sensor; use the result if it differs by more than its uncertainty."""
        if self._session.sensor is not sensor:
            return ''
        try:
            fitted = yield from self._fitted()
        except ChangedError:
            sensor.auto_fit_waits = True
            return ''
        except RefusedFitError as error:
            before, self._refused = self._refused, str(error)
            if self._refused == before:
                return ''
            raise
        self._refused = ''
        return (yield from self._use_fit(fitted)) if fitted.differs else ''

    def _fitted(self) -> Part[Fitted]:
        """Return a fit to the poses; the values of a refined calibration are fitted anew."""
        session = self._session
        return (yield from self._sound('fit', fit, session.units, session.settings, session.name,
                                       session.sensor.present))

    def _sound(self, name: str, function: Callable[..., Fitted], *given: Any) -> Part[Fitted]:
        """Return what a function makes of the poses, if it is fit for use."""
        session, sensor = self._session, self._session.sensor
        session.files.usable()
        sensor.live.refresh()
        poses = sensor.live.book.poses()
        try:
            fitted = yield from self._unless_changed(name, function, poses, *given)
            if fitted.refusal:
                session.rate(fitted.refinement)
                raise RefusedFitError(f'{fitted.words}; not used: {fitted.refusal[0]}',
                                      fitted.refusal[1])
            if fitted.rating.name == 'BAD':
                raise RefusedFitError(f'{fitted.words}; not used: {fitted.rating.reason}',
                                      fitted.rating.next.text)
        except RefusedFitError as error:
            sensor.guide.refuse(len(poses), error.advice)
            raise
        sensor.fitted_poses = len(poses)
        return fitted

    def refine(self, *, offered: bool = False) -> Task:
        """Refine the calibration; use and store the refined calibration, or only offer it."""
        session = self._session
        fitted = yield from self._sound('refine', refined, session.units, session.name,
                                        session.sensor.present, thermometer_words(session),
                                        session.own)
        session.sensor.guide.follow(fitted.planned)
        return (yield from self._use_fit(fitted, offered=offered))

    def _unless_changed(self, name: str, function: Callable[..., Found], *given: Any
                        ) -> Part[Found]:
        """Compute; fail if another command changes the calibration meanwhile."""
        session = self._session
        sensor, changes = session.sensor, session.sensor.changes
        session.computing += 1
        try:
            found: Found = yield Compute(function, *given)
        finally:
            session.computing -= 1
        if session.sensor is not sensor or sensor.changes != changes:
            raise ChangedError(f'another command changed the calibration during ~/{name}; '
                               'the result is discarded', f'call ~/{name} again')
        return found

    def set_level(self, *, offered: bool = False) -> Task:
        """Level the mounting from the ongoing rest; without a calibration, the mounting alone."""
        session, rest = self._session, self._rest()
        calibration = session.sensor.present
        if calibration is None:
            calibration = session.with_given(mounting_only(
                poses_from([rest]), session.units, sensor=session.name, date=now()))
        return (yield from self._use_mounting(
            self._levelled(calibration, rest), 'the mounting is levelled by this pose',
            offered=offered))

    def set_heading(self, *, offered: bool = False) -> Task:
        """Set the heading of the mounting from the ongoing rest, with the nose down."""
        calibration = self._session.sensor.present
        if calibration is None or not calibration.is_levelled:
            raise InputError('the mounting is not levelled', 'place the robot flat and call '
                             '~/set_level first, then tilt its nose down')
        rest = self._rest()
        headed = set_heading(calibration, rest.mean,
                             self._session.sensor.context_of(rest, calibration))
        words = 'the heading is set by this pose'
        if headed.rotation[:, 0] @ calibration.rotation[:, 0] < 0.0:
            words += ('; the front of the robot is now on the other side of the sensor: if the '
                      'nose was up, tilt it down and call ~/set_heading again')
        return (yield from self._use_mounting(headed, words, offered=offered))

    def calibrate_at_rest(self, *, offered: bool = False) -> Task:
        """Take mounting, gyro bias and the offset along gravity from the ongoing level rest."""
        session, rest = self._session, self._rest()
        before = session.sensor.present
        calibration = session.with_given(at_rest(rest, session.units, session.name, before))
        words = (calibration.reason if before is None or is_partial(before)
                 else 'offset and gain of the fit are kept')
        if calibration.gyro is not None:
            bias = ', '.join(f'{np.degrees(part):+.3f}' for part in calibration.gyro.bias)
            words += f', gyro bias ({bias}) °/s'
        return (yield from self._use_mounting(self._levelled(calibration, rest), words,
                                              offered=offered))

    def _levelled(self, calibration: Calibration, rest: Dwell) -> Calibration:
        """Return a calibration levelled by a rest; check it against the given mounting."""
        session = self._session
        levelled = level(calibration, rest.mean, session.frame,
                         session.sensor.context_of(rest, calibration))
        if not np.allclose(session.with_given(levelled).rotation[:, 2], levelled.rotation[:, 2]):
            raise InputError('this pose differs by more than 10° of tilt from the mounting in '
                             'mounting_rpy or base_frame', 'place the robot level, or correct the '
                             'given mounting and restart the node')
        return levelled

    def _use_mounting(self, calibration: Calibration, words: str, *, offered: bool) -> Part[str]:
        """Store and use, or offer, a calibration with a new mounting; return the answer."""
        details = [change_words(self._session.sensor.present, calibration), *(
            each.words for each in calibration.noted if each.kind in ('flat_pose', 'heading'))]
        return (yield from self._use(
            calibration, f'{words}; {angle_words(calibration.rotation)}', details,
            self._session.sensor.refinement, offered=offered))

    def _use(self, calibration: Calibration, words: str, details: list[str],
             refinement: Refinement | None = None, rating: Rating | None = None, *,
             offered: bool = False) -> Part[str]:
        """Store and use, or offer, a calibration; log the details, and return the answer."""
        session, store = self._session, self._session.files.usable()
        offered = offered or session.settings.confirm
        not_stored = yield from self._with_files(_stored, store, None if offered else calibration)
        mounting = [] if not calibration.is_levelled else [mounting_words(
            calibration.rotation, session.frame_id or '', session.settings.base_frame)]
        if offered:
            session.offer(calibration, refinement, rating)
            session.log('info', '; '.join(filter(None, [*details, *mounting])))
            return (f'{words}; published on ~/preview only: call ~/save to use and store it, or '
                    '~/undo to discard it')
        session.adopt(calibration, refinement, rating)
        if not_stored is not None:
            session.sensor.unsaved = True
            raise InputError(f'the calibration is in use but could not be stored: {not_stored}',
                             f'{writing_advice(not_stored)}, and call ~/save')
        stored = f'stored in {store.calibration}'
        session.log('info', '; '.join(filter(None, [*details, stored, *mounting])))
        return f'{words}{self._next()}'

    def _with_files(self, function: Callable[..., Found], *given: Any) -> Part[Found]:
        """Use files; fail if another sensor replaces this one meanwhile."""
        session, sensor, name = self._session, self._session.sensor, self._session.name
        found: Found = yield Calibrations(function, *given)
        if session.sensor is not sensor:
            raise InputError(f'the sensor {session.name!r} has replaced {name!r} meanwhile, '
                             'expected one sensor: the result is not used',
                             'call the service again')
        return found

    # Files

    def save(self) -> Task:
        """Use the offered calibration if there is one; store calibration and poses."""
        session, store = self._session, self._session.files.usable()
        calibration = session.sensor.present
        if calibration is None:
            raise InputError('there is no calibration', 'capture poses and call ~/fit first')
        yield Calibrations(store.save, calibration, session.sensor.live.book.poses())
        session.sensor.unsaved = False
        if session.sensor.offered is calibration:
            session.adopt(calibration, session.sensor.refinement, session.sensor.rating)
        return f'stored in {store.calibration} and {store.poses}'

    def load(self) -> Task:
        """Read the stored calibration again; if it is refused, the calibration in use is kept."""
        store = self._session.files.usable()
        calibration = yield from self._with_files(store.load_calibration)
        if calibration is None:
            raise StoredCalibrationError(f'{store.calibration} does not exist',
                                         'call ~/fit, or copy a calibration there')
        self._session.adopt(calibration)
        return f'read {store.calibration}'

    def undo(self) -> Task:
        """Discard the offered calibration, or return to the one before the last stored one."""
        session = self._session
        if session.sensor.offered is not None:
            session.sensor.fitted_poses = 0
            session.offer(None)
            return 'the calibration on ~/preview is discarded; the one in use is unchanged'
        calibration = yield from self._with_files(session.files.usable().step_back)
        before = session.sensor.calibration
        session.adopt(calibration)
        session.sensor.fitted_poses = 0
        if calibration is None:
            return 'there is no calibration any more, as before the first fit'
        changes = '' if before is None else f'; {change_words(before, calibration)}'
        return f'the calibration of {calibration.date or "unknown date"} is in use{changes}'

    def reset(self) -> Task:
        """Remove poses and calibration; the stored files are renamed."""
        session = self._session
        kept = yield from self._with_files(session.files.usable().set_aside)
        session.sensor.live.clear()
        session.adopt(None)
        session.sensor.fitted_poses = 0
        session.poses_changed(ended=False)
        return 'poses and calibration are removed' + ''.join(
            f'; the stored file is kept as {path.name}' for path in kept)

    def enable(self, on: bool) -> str:
        """Switch the correction on or off."""
        session = self._session
        session.enabled = on
        if not on:
            return 'the correction is off: raw messages are published unchanged'
        if session.sensor.calibration is None:
            published = 'raw messages are' if session.settings.passthrough else 'nothing is'
            return (f'the correction is on, but there is no calibration yet: {published} '
                    'published; capture poses and call ~/fit')
        return 'the correction is on: corrected messages are published'

    # Checks

    def _rest(self) -> Dwell:
        self._check_fresh()
        rest = self._session.sensor.live.detector.current()
        if rest is None:
            raise self._not_still()
        return rest

    def _check_fresh(self) -> None:
        """Check that the last message is recent, and that its stamp is."""
        statistics = self._session.statistics
        if not statistics.messages:
            raise InputError('there is no Imu message yet', 'start the driver')
        if statistics.age > _OLD:
            raise InputError(f'the last Imu message arrived {statistics.age:.1f} s ago, expected '
                             f'one within {_OLD:g} s', 'check the driver and try again')
        if statistics.stopped > _OLD:
            raise InputError(f'the stamps have not changed for {statistics.stopped:.1f} s '
                             f'({statistics.stamp:.3f} s), expected the time of each reading',
                             'set header.stamp in the driver')

    def _not_still(self) -> InputError:
        session = self._session
        least, length = session.settings.min_dwell, session.statistics.length_g(session.units)
        if abs(length - 1.0) > session.settings.still_norm_tolerance:
            return InputError(f'|a| is {length:.3g} g, expected about 1 g at rest',
                              'hold the sensor still; if it is still, restart the node with the '
                              'right units')
        if not session.sensor.live.still:
            return InputError('the sensor is not still', f'hold it still for {least:g} s, and '
                              'check ~/still')
        return InputError(f'the sensor has been still for less than {least:g} s',
                          'hold it still for longer')


def _stored(store: Store, calibration: Calibration | None, call: Callable[..., Any]
            ) -> OSError | None:
    """Store a calibration if there is one; return the error if it cannot be stored."""
    try:
        if calibration is not None:
            store.save_calibration(calibration, call)
    except OSError as error:
        return error
    return None
