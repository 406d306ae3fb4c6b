# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The commands of a session: what the services of the node do.

A command returns an answer, or a `Job` for long work, or raises an error that says what to do. If
the parameter ``confirm`` is set, or a command is called with `offered`, a new calibration is only
offered: it is published on ~/preview, until ~/save stores it or ~/undo discards it.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from .guidance import next_action, Plan
from .store import Store, writing_advice
from .work import (
    at_rest,
    change_words,
    Compute,
    fitted,
    has_changed,
    is_partial,
    Job,
    plan_for,
    refined,
    story,
    summary,
)
from ..calibrate import (
    Calibration,
    carried_words,
    level,
    mounting_only,
    set_heading,
)
from ..calibrate.mounting import mounting_words
from ..capture import Dwell, poses_from
from ..effects import LADDER
from ..errors import AccelCalibError, InputError, RefusedFitError, StoredCalibrationError
from ..refine import Refinement
from ..text import counted, now

if TYPE_CHECKING:
    from .session import Session

_OLD = 0.5
"""Largest age of the last message for a capture [s]."""

_NEXT_LATER = 'the next pose is on ~/poses after the computation that is running'
"""Advice while a fit or a refinement occupies the worker process."""

Found = TypeVar('Found')

_NO_CALIBRATION = InputError('there is no calibration', 'capture poses and call ~/fit first')


class ChangedError(AccelCalibError):
    """The calibration changed during a fit or a refinement."""


class Commands:
    """The commands of a session, which is the only argument."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._refused = ''

    # Poses

    def capture_pose(self) -> Job:
        """Capture the ongoing rest as a pose."""
        session = self._session
        self._check_fresh()
        session.files.usable()
        dwell = session.live.capture_now()
        if dwell is None:
            raise self._not_still()
        session.guide.is_new_rest(dwell.start)  # the answer is the line about this pose
        session.poses_changed(ended=False)
        given = session.live.book.poses(), session.units, session.settings.model
        words = (f'{counted(len(given[0]), "pose")}: the sensor has been still for '
                 f'{dwell.end - dwell.start:.1f} s')

        def finish(plan: Plan | None) -> str:
            return f'{words}; {_NEXT_LATER if plan is None else next_action(plan.asked)}'

        if session.computing:
            return Job(lambda compute: None, finish)
        return Job(lambda compute: compute(plan_for, *given), finish, computes=True)

    def undo_pose(self) -> Job:
        """Remove the last pose."""
        if self._session.files.store is not None:
            self._session.files.usable()
        if not self._session.live.undo():
            raise InputError('there are no poses to remove', 'capture a pose first')
        self._session.poses_changed(ended=False)
        count = len(self._session.live.book.poses())
        words = f'the last pose is removed; remaining: {counted(count, "pose")}'
        return Job(lambda compute: None, lambda none: words)  # waits until the poses are stored

    # Calibrations

    def fit(self, *, offered: bool = False) -> Job:
        """Fit the poses; use and store the calibration, or only offer it."""
        return self._fit(lambda before, found: True, offered=offered)

    def auto_fit(self) -> Job:
        """Fit the poses; use the result if it differs by more than its uncertainty."""
        session = self._session
        job = self._fit(lambda before, found: _is_linear(before) and has_changed(before, found))

        def finish(found: object) -> str | Job:
            try:
                after, self._refused = job.finish(found), ''
            except ChangedError:
                session.auto_fit_later()
                return ''
            except RefusedFitError as error:
                before, self._refused = self._refused, str(error)
                if self._refused == before:
                    return ''
                raise
            return after

        return replace(job, finish=finish)

    def _fit(self, is_used: Callable[[Calibration | None, Calibration], bool], *,
             offered: bool = False) -> Job:
        session, store = self._session, self._session.files.usable()
        before = self.present
        session.live.refresh()
        poses = session.live.book.poses()
        given = (poses, session.units, session.settings, session.sensor, before,
                 session.present_context())
        offered = offered or session.settings.confirm

        def run(compute: Compute) -> tuple[Calibration, str]:
            calibration = compute(fitted, *given)
            used = is_used(before, calibration)
            return calibration, compute(summary, calibration) if used else ''

        def finish(found: tuple[Calibration, str]) -> str | Job:
            calibration, story_of_fit = found
            session.fitted_poses = len(poses)
            if not story_of_fit:
                return ''
            words = [story_of_fit, change_words(before, calibration)]
            return self._job_to_store(store, calibration, words, offered=offered)

        return self._unless_changed('fit', run, finish)

    def refine(self, *, offered: bool = False) -> Job:
        """Refine the calibration; use and store the refined calibration, or only offer it."""
        session, store = self._session, self._session.files.usable()
        before = self.present
        session.live.refresh()
        given = session.live.book.poses(), session.units, session.sensor, before
        offered = offered or session.settings.confirm

        def run(compute: Compute) -> tuple[Refinement, str]:
            refinement = compute(refined, *given)
            return refinement, compute(story, refinement)

        def finish(found: tuple[Refinement, str]) -> str | Job:
            refinement, story_of_search = found
            if refinement.refusal:
                raise RefusedFitError(f'{story_of_search}; not used: {refinement.refusal[0]}',
                                      refinement.refusal[1])
            words = [story_of_search, change_words(before, refinement.calibration)]
            session.guide.follow(refinement.plan.poses)
            if refinement.plan.poses:
                session.fitted_poses = 0  # more poses are asked for
            return self._job_to_store(store, refinement.calibration, words, offered=offered)

        return self._unless_changed('refine', run, finish)

    def _unless_changed(self, name: str, run: Callable[[Compute], Found],
                        finish: Callable[[Found], str | Job]) -> Job:
        """Return a job that computes, and fails if another command changes the calibration."""
        session = self._session
        changes = session.changes
        session.computing += 1

        def computed(compute: Compute) -> Found | AccelCalibError:
            try:
                return run(compute)
            except AccelCalibError as error:  # raised in `checked`, which counts
                return error

        def checked(found: Found | AccelCalibError) -> str | Job:
            session.computing -= 1
            if isinstance(found, AccelCalibError):
                raise found
            if session.changes != changes:
                raise ChangedError(f'another command changed the calibration during ~/{name}; '
                                   'the result is discarded', f'call ~/{name} again')
            return finish(found)

        return Job(computed, checked, computes=True)

    def set_level(self, *, offered: bool = False) -> Job:
        """Level the mounting from the ongoing rest; without a calibration, the mounting alone."""
        session, rest = self._session, self._rest()
        calibration = self.present
        if calibration is None:
            calibration = session.with_given(mounting_only(
                poses_from([rest]), session.units, sensor=session.sensor, date=now()))
        return self._job_to_use(self._levelled(calibration, rest),
                                ['the mounting is levelled by this pose'], offered=offered)

    def set_heading(self, *, offered: bool = False) -> Job:
        """Set the heading of the mounting from the ongoing rest, with the nose down."""
        calibration = self.present
        if calibration is None or not calibration.is_levelled:
            raise InputError('the mounting is not levelled', 'place the robot flat and call '
                             '~/set_level first, then tilt its nose down')
        rest = self._rest()
        headed = set_heading(calibration, rest.mean,
                             self._session.active.context_of(rest, calibration))
        return self._job_to_use(headed, ['the heading is set by this pose'], offered=offered)

    def calibrate_at_rest(self, *, offered: bool = False) -> Job:
        """Take mounting, gyro bias and the offset along gravity from the ongoing level rest."""
        session, rest = self._session, self._rest()
        before = self.present
        calibration = session.with_given(at_rest(rest, session.units, session.sensor, before))
        words = [carried_words(calibration) if before is None or is_partial(before)
                 else 'offset and gain of the fit are kept']
        if calibration.gyro is not None:
            bias = ', '.join(f'{np.degrees(part):+.3f}' for part in calibration.gyro.bias)
            words.append(f'gyro bias ({bias}) °/s')
        return self._job_to_use(self._levelled(calibration, rest), words, offered=offered)

    def _levelled(self, calibration: Calibration, rest: Dwell) -> Calibration:
        """Return a calibration levelled by a rest; check it against the given mounting."""
        session = self._session
        levelled = level(calibration, rest.mean, session.settings.frame,
                         session.active.context_of(rest, calibration))
        if not np.allclose(session.with_given(levelled).rotation[:, 2], levelled.rotation[:, 2]):
            raise InputError('this pose differs by more than 10° of tilt from the mounting in '
                             'mounting_rpy or base_frame', 'place the robot level, or correct the '
                             'given mounting and restart the node')
        return levelled

    @property
    def present(self) -> Calibration | None:
        """Return the calibration that a command starts from: the offered one, or that in use."""
        return self._session.preview or self._session.active.calibration

    def _job_to_use(self, calibration: Calibration, words: list[str], *, offered: bool) -> Job:
        """Return the job that stores and uses, or offers, a calibration with a new mounting."""
        offered = offered or self._session.settings.confirm
        words = [*words, change_words(self.present, calibration), *(
            each.words for each in calibration.noted
            if each.kind in ('flat_pose', 'heading'))]
        return self._job_to_store(self._session.files.usable(), calibration, words,
                                  offered=offered)

    def _job_to_store(self, store: Store, calibration: Calibration, words: list[str], *,
                      offered: bool) -> Job:
        """Return the job that stores and uses, or offers, a calibration."""
        def finish(not_stored: OSError | None) -> str:
            return self._use(calibration, not_stored, words, offered=offered)

        return self._session.job(
            lambda compute: None if offered else _stored(store, calibration), finish)

    def _use(self, calibration: Calibration, not_stored: OSError | None, words: list[str], *,
             offered: bool) -> str:
        """Use or offer a calibration, and return the answer."""
        session = self._session
        mounting = [] if not calibration.is_levelled else [mounting_words(
            calibration.rotation, session.frame_id or '', session.settings.base_frame)]
        if offered:
            session.offer(calibration)
            end = ('published on ~/preview only: call ~/save to use and store it, or ~/undo to '
                   'discard it')
            return '; '.join(filter(None, [*words, end, *mounting]))
        session.adopt(calibration)
        if not_stored is not None:
            raise InputError(f'the calibration is in use but could not be stored: {not_stored}',
                             f'{writing_advice(not_stored)}, and call ~/save')
        stored = f'stored in {session.files.usable().calibration}'
        return '; '.join(filter(None, [*words, stored, *mounting]))

    # Files

    def save(self) -> Job:
        """Use the offered calibration if there is one; store calibration and poses."""
        session, store = self._session, self._session.files.usable()
        calibration = self.present
        if calibration is None:
            raise _NO_CALIBRATION
        poses = session.live.book.poses()

        def run(compute: Compute) -> None:
            store.save_calibration(calibration)
            store.save_poses(poses)

        def finish(none: None) -> str:
            if session.preview is calibration:
                session.adopt(calibration)
            return f'stored in {store.calibration} and {store.poses}'

        return Job(run, finish)

    def load(self) -> Job:
        """Read the stored calibration again; if it is refused, the calibration in use is kept."""
        session, store = self._session, self._session.files.usable()

        def finish(calibration: Calibration | None) -> str:
            if calibration is None:
                raise StoredCalibrationError(f'{store.calibration} does not exist',
                                             'call ~/fit, or copy a calibration there')
            session.adopt(calibration)
            return f'read {store.calibration}'

        return session.job(lambda compute: store.load_calibration(), finish)

    def undo(self) -> Job | str:
        """Discard the offered calibration, or return to the one before the last stored one."""
        session = self._session
        if session.preview is not None:
            session.offer(None)
            return 'the calibration on ~/preview is discarded; the one in use is unchanged'
        store = session.files.usable()

        def finish(calibration: Calibration | None) -> str:
            before = session.active.calibration
            session.adopt(calibration)
            session.fitted_poses = 0
            if calibration is None:
                return 'there is no calibration any more, as before the first fit'
            changes = '' if before is None else f'; {change_words(before, calibration)}'
            return f'the calibration of {calibration.date or "unknown date"} is in use{changes}'

        return session.job(lambda compute: store.step_back(), finish)

    def reset(self) -> Job:
        """Remove poses and calibration; the stored files are renamed."""
        session, store = self._session, self._session.files.usable()

        def finish(kept: list[Path]) -> str:
            session.live.clear()
            session.adopt(None)
            session.fitted_poses = 0
            session.poses_changed(ended=False)
            return 'poses and calibration are removed' + ''.join(
                f'; the stored file is kept as {path.name}' for path in kept)

        return session.job(lambda compute: store.set_aside(), finish)

    def enable(self, on: bool) -> str:
        """Switch the correction on or off."""
        session = self._session
        session.active.enabled = on
        if not on:
            return 'the correction is off: raw messages are published unchanged'
        if session.active.calibration is None:
            published = 'raw messages are' if session.settings.passthrough else 'nothing is'
            return (f'the correction is on, but there is no calibration yet: {published} '
                    'published; capture poses and call ~/fit')
        return 'the correction is on: corrected messages are published'

    # Checks

    def _rest(self) -> Dwell:
        """Return the ongoing rest."""
        self._check_fresh()
        rest = self._session.live.detector.current()
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
        """Return the error for a sensor that is not at rest."""
        session = self._session
        least, length = session.settings.min_dwell, session.length_g()
        if abs(length - 1.0) > session.settings.still_norm_tolerance:
            return InputError(f'|a| is {length:.3g} g, expected about 1 g at rest',
                              'hold the sensor still; if it is still, restart the node with the '
                              'right units')
        if not session.live.still:
            return InputError('the sensor is not still', f'hold it still for {least:g} s, and '
                              'check ~/still')
        return InputError(f'the sensor has been still for less than {least:g} s',
                          'hold it still for longer')


def _is_linear(calibration: Calibration | None) -> bool:
    """Return whether an automatic fit can replace a calibration: it has only offset and gain."""
    return calibration is None or all(name in LADDER for name in calibration.model.effects)


def _stored(store: Store, calibration: Calibration) -> OSError | None:
    """Store a calibration; return the error if it cannot be stored."""
    try:
        store.save_calibration(calibration)
    except OSError as error:
        return error
    return None
