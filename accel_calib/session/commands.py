# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The commands of a session: what the services of the node do, and their computations.

A command is a generator. It yields what is to be computed or stored, and returns its answer, or
raises an error that says what to do. If the parameter ``confirm`` is set, or the commands are of a
page, a new calibration is only offered: it is published on ~/preview, until ~/save stores it or
~/undo discards it. Most computations run in the worker process.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .conditions import next_words, thermometer_words
from .core import Holder, State
from .sensor import gyro_bias_of_rest, Sensor
from .settings import CalibratorSettings
from .store import writing_advice
from .use import adopt, rate, show_poses
from .worker import Compute, Files, nothing, Parse, Part, Task
from ..calibration import Calibration, fit_partial, level, mounting_only, plan_session, set_heading
from ..effects import Model, OwnEffect, shown_name
from ..errors import AccelCalibError, InputError, RefusedFitError, StoredCalibrationError
from ..findings import angle_words, rate_refinement, Rating, rival_words, verdict_words
from ..geometry import angle_of, spread_directions
from ..pipeline import calibrated, is_partial, is_refined, Plan
from ..refinement import refine, Refinement
from ..stillness import Dwell, poses_from
from ..table import Poses
from ..text import counted, listed, now
from ..units import MG, Units

_OLD = 0.5
"""Largest age of the last message for a capture [s]."""

_AUTO_FIT_EVERY = 60.0
"""Shortest time between two automatic fits [s]."""

_DIRECTIONS = 100
"""Number of directions over which two calibrations are compared."""

_BEYOND = 100.0
"""Ratio to the typical size above which an effect is not caused by the sensor."""


COMMANDS = ('capture_pose', 'undo_pose', 'fit', 'refine', 'set_level', 'set_heading',
            'calibrate_at_rest', 'save', 'undo', 'load', 'reset')
"""The commands without an argument, which are services of the node and buttons of the page."""


class ChangedError(AccelCalibError):
    """The calibration changed during a fit or a refinement."""


@dataclass(frozen=True)
class Commands:
    """The commands of a session; those with `offers` only offer a new calibration."""

    session: Holder
    offers: bool = False

    def run(self, name: str, **options: bool) -> Task:
        """Run one of `COMMANDS`, and note why it is refused."""
        try:
            return (yield from getattr(self, name)(**options))
        except AccelCalibError as error:
            self.session.refuse(name, str(error))
            raise

    # Poses

    def capture_pose(self) -> Task:
        """Capture the ongoing rest as a pose."""
        session, sensor, dwell = self.session, self.session.sensor, _rest(self.session.state)
        session.state.files.usable()
        sensor.live.capture(dwell)
        sensor.guide.is_new_rest(dwell.start)  # the answer is the line about this pose
        poses_changed(session, ended=False)
        poses = sensor.live.book.poses()
        words = (f'{counted(len(poses), "pose")}: the sensor has been still for '
                 f'{dwell.end - dwell.start:.1f} s')
        if session.state.computing:
            yield Files(nothing)
            return f'{words}; the next pose is on ~/poses after the computation that is running'
        plan = yield Compute(plan_session, poses, session.state.units,
                             session.state.settings.model)
        if session.sensor.live is sensor.live:
            sensor.guide.plan = plan
        return f'{words}{next_words(session.state)}'

    def undo_pose(self) -> Task:
        """Remove the last pose."""
        session = self.session
        if session.state.files.store is not None:
            session.state.files.usable()
        if not session.sensor.live.undo():
            raise InputError('there are no poses to remove', 'capture a pose first')
        poses_changed(session, ended=False)
        count = len(session.sensor.live.book.poses())
        yield Files(nothing)  # until the poses are stored
        return f'the last pose is removed; remaining: {counted(count, "pose")}'

    # Calibrations

    def fit(self) -> Task:
        """Fit the poses; use and store the calibration, or only offer it."""
        return (yield from self._use((yield from _fit(self.session))))

    def refine(self) -> Task:
        """Refine the calibration; use and store the refined calibration, or only offer it."""
        session = self.session
        state = session.state
        hint = '' if 'temperature' in state.around.values else thermometer_words(state)
        fitted = yield from _sound(session, 'refine', refined, state.units, state.name,
                                   state.sensor.present, hint, state.own)
        if fitted.refinement is not None:
            session.sensor.guide.follow(fitted.refinement.plan.poses)
        return (yield from self._use(fitted))

    # The mounting

    def set_level(self) -> Task:
        """Level the mounting from the ongoing rest; without a calibration, the mounting alone."""
        session, rest = self.session, _rest(self.session.state)
        calibration = session.sensor.present
        if calibration is None:
            calibration = session.state.with_given(mounting_only(
                poses_from([rest]), session.state.units, sensor=session.state.name, date=now()))
        return (yield from self._use_mounting(_levelled(session.state, calibration, rest),
                                              'the mounting is levelled by this pose'))

    def set_heading(self) -> Task:
        """Set the heading of the mounting from the ongoing rest, with the nose down."""
        session, calibration = self.session, self.session.sensor.present
        if calibration is None or not calibration.is_levelled:
            raise InputError('the mounting is not levelled', 'place the robot flat and call '
                             '~/set_level first, then tilt its nose down')
        rest = _rest(session.state)
        headed = set_heading(calibration, rest.mean, session.sensor.context_of(rest, calibration))
        words = 'the heading is set by this pose'
        if headed.rotation[:, 0] @ calibration.rotation[:, 0] < 0.0:
            words += ('; the front of the robot is now on the other side of the sensor: if the '
                      'nose was up, tilt it down and call ~/set_heading again')
        return (yield from self._use_mounting(headed, words))

    def calibrate_at_rest(self) -> Task:
        """Take mounting, gyro bias and the offset along gravity from the ongoing level rest."""
        session, rest = self.session, _rest(self.session.state)
        before = session.sensor.present
        if before is not None and not is_partial(before):
            found, words = before, 'offset and gain of the fit are kept'
        else:
            found = fit_partial(poses_from([rest]), session.state.units,
                                sensor=session.state.name, date=now())
            rotation = np.eye(3) if before is None else before.rotation
            found = replace(found, model=Model(found.model.values, rotation))
            words = found.reason
        calibration = session.state.with_given(replace(
            found, gyro=gyro_bias_of_rest(rest) or found.gyro))
        if calibration.gyro is not None:
            bias = ', '.join(f'{np.degrees(part):+.3f}' for part in calibration.gyro.bias)
            words += f', gyro bias ({bias}) °/s'
        return (yield from self._use_mounting(_levelled(session.state, calibration, rest), words))

    def _use_mounting(self, calibration: Calibration, words: str) -> Part[str]:
        """Use or offer a calibration with a new mounting; return the answer."""
        sensor = self.session.sensor
        details = [change_words(sensor.present, calibration), *(
            each.words for each in calibration.noted if each.kind in ('flat_pose', 'heading'))]
        return (yield from self._use(Fitted(
            calibration, f'{words}; {angle_words(calibration.rotation)}', details,
            refinement=sensor.refinement)))

    def _use(self, fitted: Fitted) -> Part[str]:
        return _use(self.session, fitted, offers=self.offers)

    # Files

    def save(self) -> Task:
        """Use the offered calibration if there is one; store calibration and poses."""
        session, sensor = self.session, self.session.sensor
        store = session.state.files.usable()
        calibration = sensor.present
        if calibration is None:
            raise InputError('there is no calibration', 'capture poses and call ~/fit first')
        yield Files(store.write, Parse(store.prepared, calibration))
        yield Files(store.save_poses, sensor.live.book.poses())
        if session.sensor.live is sensor.live:
            session.change_sensor(unsaved=False)
            if session.sensor.offered is calibration:
                adopt(session, calibration, session.sensor.refinement, session.sensor.rating)
        return f'stored in {store.calibration} and {store.poses}'

    def load(self) -> Task:
        """Read the stored calibration again; if it is refused, the calibration in use is kept."""
        session, store = self.session, self.session.state.files.usable()
        calibration = yield from _alone(session, Parse(store.load_calibration))
        if calibration is None:
            raise StoredCalibrationError(f'{store.calibration} does not exist',
                                         'call ~/fit, or copy a calibration there')
        adopt(session, calibration)
        return f'read {store.calibration}'

    def undo(self) -> Task:
        """Discard the offered calibration, or return to the one before the last stored one."""
        session = self.session
        if session.sensor.offered is not None:
            session.change(sensor=session.sensor.offer(None, session.state.settings))
            session.change_sensor(fitted_poses=0)
            rate(session, None)
            return 'the calibration on ~/preview is discarded; the one in use is unchanged'
        calibration = yield from _alone(session, Files(session.state.files.usable().step_back))
        before = session.sensor.calibration
        adopt(session, calibration)
        session.change_sensor(fitted_poses=0)
        if calibration is None:
            return 'there is no calibration any more, as before the first fit'
        changes = '' if before is None else f'; {change_words(before, calibration)}'
        return f'the calibration of {calibration.date or "unknown date"} is in use{changes}'

    def reset(self) -> Task:
        """Remove poses and calibration; the stored files are renamed."""
        session, store = self.session, self.session.state.files.usable()
        kept = yield from _alone(session, Files(store.set_aside, Parse(store.is_good)))
        session.sensor.live.clear()
        adopt(session, None)
        session.change_sensor(fitted_poses=0)
        poses_changed(session, ended=False)
        return 'poses and calibration are removed' + ''.join(
            f'; the stored file is kept as {path.name}' for path in kept)

    def enable(self, on: bool) -> str:
        """Switch the correction on or off."""
        session = self.session
        session.change(enabled=on)
        if not on:
            return 'the correction is off: raw messages are published unchanged'
        if session.sensor.calibration is None:
            published = 'raw messages are' if session.state.settings.passthrough else 'nothing is'
            return (f'the correction is on, but there is no calibration yet: {published} '
                    'published; capture poses and call ~/fit')
        return 'the correction is on: corrected messages are published'


# ----------------------------------------------------------------------------- parts of commands

def poses_changed(session: Holder, *, ended: bool, new_rest: Dwell | None = None) -> None:
    """Draw and store the poses, and fit if auto_fit is set; `ended`: a rest has ended."""
    sensor = session.sensor
    show_poses(session, store=session.state.files.locked, new_rest=new_rest)
    if ended or len(sensor.live.book.poses()) > sensor.fitted_poses:
        session.change_sensor(auto_fit_waits=True)
    session.events += due(session)


def due(session: Holder) -> list[Task]:
    """Return an automatic fit if one is due."""
    sensor, settings = session.sensor, session.state.settings
    if (settings.auto_fit and sensor.auto_fit_waits and session.state.files.locked
            and len(sensor.live.book.poses()) >= settings.auto_fit_poses
            and session.throttle.passes('auto_fit', _AUTO_FIT_EVERY)):
        session.change_sensor(auto_fit_waits=False)
        return [_auto_fit(session, sensor)]
    return []


def _auto_fit(session: Holder, sensor: Sensor) -> Task:
    """Fit the poses of a sensor; use the result if it differs by more than its uncertainty."""
    if session.sensor.live is not sensor.live:
        return ''
    try:
        fitted = yield from _fit(session)
    except ChangedError:
        session.change_sensor(auto_fit_waits=True)
        return ''
    except RefusedFitError as error:
        if session.sensor.refusal == str(error):
            return ''
        session.change_sensor(refusal=str(error))
        raise
    session.change_sensor(refusal='')
    return (yield from _use(session, fitted, offers=False)) if fitted.differs else ''


def _use(session: Holder, fitted: Fitted, *, offers: bool) -> Part[str]:
    """Store and use, or offer, a new calibration; log the details, and return the answer."""
    calibration, words = fitted.calibration, fitted.words
    store, mounting = session.state.files.usable(), session.state.mounting_words(calibration)
    if offers or session.state.settings.confirm:
        session.change(sensor=session.sensor.offer(calibration, session.state.settings))
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


def _fit(session: Holder) -> Part[Fitted]:
    """Return a fit to the poses; the values of a refined calibration are fitted anew."""
    return (yield from _sound(session, 'fit', fit, session.state.units, session.state.settings,
                              session.state.name, session.sensor.present))


def _sound(session: Holder, name: str, function: Callable[..., Fitted], *given: Any
           ) -> Part[Fitted]:
    """Return what a function makes of the poses; fail if it is not fit for use, or outdated."""
    session.state.files.usable()
    sensor = session.sensor
    sensor.live.refresh()
    count = len(sensor.live.book.poses())
    session.change(computing=session.state.computing + 1)
    try:
        poses = sensor.live.poses(session.state.found)
        found: Fitted = yield Compute(function, poses, *given)
    except RefusedFitError as error:
        session.refuse('poses', error.advice)
        raise
    finally:
        session.change(computing=session.state.computing - 1)
    if session.sensor.live is not sensor.live or session.sensor.changes != sensor.changes:
        raise ChangedError(f'another command changed the calibration during ~/{name}; '
                           'the result is discarded', f'call ~/{name} again')
    if found.refusal:
        why, advice = found.refusal
        session.refuse('poses', advice)
        if found.refinement is not None:
            rate(session, found.refinement)
        raise RefusedFitError(f'{found.words}; not used: {why}', advice)
    session.change_sensor(fitted_poses=count)
    return found


def _levelled(state: State, calibration: Calibration, rest: Dwell) -> Calibration:
    """Return a calibration levelled by a rest; check it against the given mounting."""
    levelled = level(calibration, rest.mean, state.frame,
                     state.sensor.context_of(rest, calibration))
    if not np.allclose(state.with_given(levelled).rotation[:, 2], levelled.rotation[:, 2]):
        raise InputError('this pose differs by more than 10° of tilt from the mounting in '
                         'mounting_rpy or base_frame', 'place the robot level, or correct the '
                         'given mounting and restart the node')
    return levelled


def _alone(session: Holder, step: Parse) -> Part[Any]:
    """Use files; fail if another sensor replaces this one meanwhile."""
    sensor, name = session.sensor, session.state.name
    found = yield step
    if session.sensor.live is not sensor.live:
        raise InputError(f'the sensor {session.state.name!r} has replaced {name!r} meanwhile, '
                         'expected one sensor: the result is not used',
                         'call the service again')
    return found


def _rest(state: State) -> Dwell:
    """Return the ongoing rest; InputError if there is none, or no recent message."""
    statistics, settings, live = state.statistics, state.settings, state.sensor.live
    if not statistics.messages:
        raise InputError('there is no Imu message yet', 'start the driver')
    if statistics.age > _OLD:
        raise InputError(f'the last Imu message arrived {statistics.age:.1f} s ago, expected '
                         f'one within {_OLD:g} s', 'check the driver and try again')
    if statistics.stopped > _OLD:
        raise InputError(f'the stamps have not changed for {statistics.stopped:.1f} s '
                         f'({statistics.stamp:.3f} s), expected the time of each reading',
                         'set header.stamp in the driver')
    rest = live.detector.current()
    if rest is not None:
        return rest
    length = statistics.length_g(state.units)
    if abs(length - 1.0) > settings.still_norm_tolerance:
        raise InputError(f'|a| is {length:.3g} g, expected about 1 g at rest',
                         'hold the sensor still; if it is still, restart the node with the '
                         'right units')
    if not live.still:
        raise InputError('the sensor is not still', f'hold it still for {settings.min_dwell:g} s, '
                         'and check ~/still')
    raise InputError(f'the sensor has been still for less than {settings.min_dwell:g} s',
                     'hold it still for longer')


# ----------------------------------------------------------------------------- computations

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


def _refusal(rating: Rating) -> tuple[str, ...]:
    return (rating.reason, rating.next.text) if rating.name == 'BAD' else ()


def fit(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
        before: Calibration | None) -> Fitted:
    """
    Return a fit of all poses with its rating, in the levelled frame of the calibration before.

    Errors are as in `pipeline.calibrated`; the advice is how to turn the sensor next.

    """
    found = calibrated(poses, units, Plan(
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
        differs=_replaces(before, calibration), refusal=_refusal(rating))


def refined(poses: Poses, units: Units, sensor: str, before: Calibration | None, hint: str,
            own: tuple[OwnEffect, ...]) -> Fitted:
    """
    Return the refinement of a calibration (None: of a fit).

    An effect far beyond those of parts is refused; `hint` says which quantity may be missing. The
    own effects are tried beside the catalogue.
    RefusedFitError if there are too few poses; InputError if the readings are clearly in another
    unit.

    """
    refinement = refine(poses, units, base='auto' if before is None else before, sensor=sensor,
                        date=now(), also=own)
    beyond = [step for step in refinement.steps if step.times_typical > _BEYOND]
    if beyond and not refinement.refusal:
        refinement = replace(refinement, refusal=(
            f'{beyond[0].effect} is {beyond[0].times_typical:.0f} times that of typical parts',
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
    names = [shown_name(step.name) + (f' (or {", ".join(rival_words(step))})' if step.rivals
                                      else '') for step in refinement.steps]
    found, verb = ' and '.join(names), 's' if len(names) == 1 else ''
    verdict = {'no_gap': 'no gap beyond the noise', 'explained': f'{found} explain{verb} the gap',
               'described': f'{found} describe{verb} the gap', 'drifts': 'the offset drifts',
               'unexplained': f'a gap remains beyond {found}' if names else
               'a gap remains that no effect explains'}[refinement.verdict]
    return Fitted(calibration, f'{rating.name}: {verdict}, {rating.figures}', details, rating,
                  refinement, refusal=refinement.refusal or _refusal(rating))


def change_words(before: Calibration | None, after: Calibration) -> str:
    """Return what changes with a new calibration, as one line; empty without an earlier one."""
    if before is None:
        return ''
    offset = after.units.to_g(after.offset - before.offset) * MG
    gain = 100.0 * (np.linalg.solve(before.gain, after.gain) - np.eye(3))
    angle = angle_of(before.rotation.T @ after.rotation)
    effects = set(before.model.effects) ^ set(after.model.effects)
    words = [f'offset by ({", ".join(f"{part:+.2f}" for part in offset)}) mg',
             f'gain by up to {np.max(np.abs(gain)):.3f} %', f'mounting by {angle:.2f}°']
    words += [f'{"with" if name in after.model.effects else "without"} {name}'
              for name in sorted(effects, key=str)]
    return f'changes {", ".join(words)}'


def _replaces(before: Calibration | None, after: Calibration) -> bool:
    """
    Return whether an automatic fit replaces a calibration.

    It does if it differs by more than its own uncertainty, unless the other one is refined.

    """
    if before is None or is_refined(before) or is_partial(before):
        return before is None or not is_refined(before)
    up = spread_directions(_DIRECTIONS)
    (gain, offset), (gain_before, offset_before) = (
        each.model.linear_part for each in (after, before))
    change = up @ (gain - gain_before).T + offset - offset_before
    covariance = after.force_covariance(up * after.force_per_g) / after.force_per_g ** 2
    return bool(np.sum(change ** 2) > np.sum(np.trace(covariance, axis1=1, axis2=2)))
