# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator without ROS: it takes samples and commands, and returns answers and events.

Only one thread may use a session. Long work (fits, files) is returned as a `Job`: its `run` can be
called in any thread, and its `finish` must be called in the thread of the session. All durations
of the measurement use header stamps, so that a bag or a simulation can run at any speed. Only the
age of the last message uses a steady clock.

"""

from __future__ import annotations

from collections.abc import Callable
import math
from pathlib import Path
from time import monotonic

import numpy as np

from .active_calibration import ActiveCalibration, context_of_rest
from .events import Compute, Event, Job, Log, Severity, ShowPoses, Still
from .health import Health, StreamStatistics
from .live_capture import Change, LiveCapture
from .settings import CalibratorSettings, capture_settings
from .store import load, Loaded, SensorFiles, Store
from .work import (
    asked_for,
    fitted,
    next_action,
    poses_up,
    refined,
    story,
    summary,
    title,
)
from ..calibrate import Calibration, FLAT, level, NextPose, set_heading
from ..capture import Dwell
from ..effects import Context
from ..errors import (
    AccelCalibError,
    counted,
    InputError,
    RefusedFitError,
    StoredCalibrationError,
)
from ..monitor import status
from ..refine import Refinement
from ..table import Floats, Poses
from ..units import units_of

_OLD = 0.5
"""Largest age of the last message for a capture [s]."""

_SILENT = 2.0
"""Time without messages after which messages of another sensor are accepted [s]."""

_AGAIN = 10.0
"""Shortest time between two equal log lines about single messages [s]."""

_NO_CALIBRATION = InputError('there is no calibration', 'capture poses and call ~/fit first')


class Session:
    """
    The calibrator of one sensor.

    Parameters
    ----------
    settings : CalibratorSettings
        The parameters; they can be replaced later.
    topic : str
        Topic of the messages, with namespace.
    clock : callable
        Steady clock [s].

    Raises
    ------
    InputError
        If the settings contradict each other.

    """

    def __init__(self, settings: CalibratorSettings, topic: str,
                 clock: Callable[[], float] = monotonic) -> None:
        self.settings = settings
        self.units = units_of(settings.units, settings.gravity)
        self.live = LiveCapture(capture_settings(settings), self.units)
        self.active = ActiveCalibration(settings.gravity)
        self.statistics = StreamStatistics()
        self.files = SensorFiles(settings, topic)
        self.frame_id: str | None = None
        self.problem = ''
        self.next_pose = ''
        self._clock = clock
        self._loaded: set[str] = set()
        self._still = False
        self._fitted_poses = 0
        self._events: list[Event] = []
        if settings.sensor or settings.calibration_file:
            store = self.files.take(settings.sensor)
            self._check_lock()
            if store is not None:
                self._adopt_loaded(load(store))
        self._show_poses(store=False)

    @property
    def sensor(self) -> str:
        """Name of the sensor; empty if not known yet."""
        return self.settings.sensor or self.frame_id or ''

    @property
    def publishes(self) -> bool:
        """Whether messages may be published: not while another node uses the files."""
        return self.files.store is None or self.files.locked

    def events(self) -> list[Event]:
        """Return the events since the last call, in order."""
        found, self._events = self._events, []
        return found

    # Samples

    def accepts(self, frame_id: str) -> bool:
        """
        Return whether messages with this frame_id belong to the sensor.

        The first message defines the sensor. A message of another sensor ends the ongoing rest.
        After a time without messages of the sensor, the session switches to the other sensor.

        """
        if frame_id == self.frame_id:
            return True
        if self.frame_id is None:
            self._bind(frame_id)
            return True
        if self._clock() - self.statistics.arrived > _SILENT:
            self._log('warning', f'the messages now have frame_id {frame_id!r} instead of '
                                 f'{self.frame_id!r}: switching to this sensor')
            self._switch_to(frame_id)
            return True
        self.statistics.drop('foreign')
        self._change(self.live.interrupt(self.settings.auto_capture))
        self._log('error', f'an Imu message has frame_id {frame_id!r}, expected '
                  f'{self.frame_id!r}; it is dropped: use a separate topic for each sensor',
                  once_in=_AGAIN)
        return False

    def push(self, samples: Floats, arrived: float) -> None:
        """
        Add samples of the sensor.

        Parameters
        ----------
        samples : (n, 9) array
            As in `accel_calib.capture.StillDetector.push`.
        arrived : float
            Arrival time of the last sample, by the steady clock [s].

        """
        good = np.isfinite(samples[:, 1:4]).all(axis=1)
        if not np.all(good):
            reading = tuple(samples[~good][0, 1:4].tolist())
            self.statistics.drop('not_finite', int(np.sum(~good)))
            self._log('warning', f'an Imu message has the linear_acceleration {reading}, expected '
                      'three finite numbers; it is dropped: check the driver', once_in=_AGAIN)
            samples = samples[good]
        if len(samples):
            self.statistics.add(samples, arrived)
            self._change(self.live.push(samples, self.settings.auto_capture))

    def drop_unreadable(self, size: int) -> None:
        """Count an unreadable message of this size [bytes]."""
        self.statistics.drop('not_finite')
        self._log('warning', f'an Imu message of {size} bytes cannot be read; it is dropped: '
                  'check the driver', once_in=_AGAIN)

    def drop_corrected(self, error: AccelCalibError) -> None:
        """Count a corrected message that is not published because of an error."""
        self.statistics.drop('implausible')
        self._log('error', f'messages are not corrected: {error}', once_in=_AGAIN)

    def set_temperature(self, temperature: float) -> None:
        """Set the temperature of the following messages [°C]."""
        self.statistics.temperature = temperature

    def _change(self, changes: list[Change]) -> None:
        """Process the changes that samples caused."""
        if self.live.detector.still is not self._still:
            self._still = not self._still
            self._events.append(Still(self._still))
        least = self.settings.drift_warn / self.settings.gravity
        for change in changes:
            before = self.active.has_changed
            if change.rest is not None:
                self.active.update(change.rest, least)
            for dwell in change.ended:
                self.active.end(dwell, least)
            if self.active.drift is not None and self.active.has_changed is not before:
                self._log('warning', status(self.active.drift))
            if change.doubted:
                self._log('warning', f'the sensor may have moved during '
                          f'{counted(change.doubted, "pose")}, according to later rests; a fit '
                          'leaves out such poses if the others are sufficient')
            if change.poses:
                self._poses_changed(ended=bool(change.ended))

    # The sensor and its files

    def _bind(self, frame_id: str) -> None:
        """Set the sensor from the first message."""
        self.frame_id = frame_id
        if self.files.store is None or self._loaded - {self.sensor}:
            self._begin_again()
        elif not self.settings.sensor:
            self.files.take(self.sensor)

    def _switch_to(self, frame_id: str) -> None:
        """Switch to another sensor."""
        self._change(self.live.interrupt(self.settings.auto_capture))
        self.frame_id = frame_id
        if not self.settings.sensor:  # otherwise the user has set the sensor
            self._begin_again()

    def _begin_again(self) -> None:
        """Discard poses and calibration of another sensor, and load those of this sensor."""
        self.live = LiveCapture(capture_settings(self.settings), self.units)
        self.active = ActiveCalibration(self.settings.gravity)
        self._fitted_poses = 0
        store = self.files.take(self.sensor)
        self._check_lock()
        if store is not None:
            self._events.append(Job(lambda compute: load(store), self._adopt_loaded))

    def _check_lock(self) -> None:
        """Report it if another node uses the files."""
        if self.files.problem:
            self.problem = self.files.problem
            self._log('error', self.problem)

    def _adopt_loaded(self, loaded: Loaded) -> str:
        """Use the stored poses and calibration."""
        self._loaded = {each.sensor for each in (loaded.calibration, loaded.poses)
                        if each is not None and each.sensor}
        if loaded.poses is not None:
            self.live.book.add_stored(loaded.poses)
            self._log('info', f'read {counted(len(loaded.poses), "pose")} from the store')
        if loaded.calibration is not None:
            self._adopt(loaded.calibration)
        self.problem = loaded.problem
        for line in filter(None, (loaded.problem, *loaded.notes)):
            self._log('error', line)
        self._show_poses(store=False)
        return ''

    def _adopt(self, calibration: Calibration | None) -> None:
        """Use this calibration for the correction."""
        self.active.adopt(calibration)
        self.problem = ''
        if calibration is not None:
            self._log('info', f'correcting with {title(calibration)}')
            for line in calibration.warnings:
                self._log('warning', line)

    def tick(self) -> None:
        """Update rates and try to lock the files; to be called about once per second."""
        self.statistics.tick()
        store = self.files.try_again()
        if store is not None:
            self._events.append(Job(lambda compute: load(store), self._adopt_loaded))

    def close(self) -> None:
        """Unlock the files."""
        self.files.release()

    # Commands

    def capture_pose(self) -> str:
        """Capture the ongoing rest as a pose."""
        self._check_fresh()
        dwell = self.live.capture_now()
        if dwell is None:
            raise self._not_still()
        self._poses_changed(ended=False)
        poses = self.live.book.poses()
        asked = asked_for(poses, self.units, self.settings.model)
        return (f'{counted(len(poses), "pose")}: the sensor has been still for '
                f'{dwell.end - dwell.start:.1f} s; {next_action(asked)}')

    def undo_pose(self) -> str:
        """Remove the last pose."""
        if not self.live.undo():
            raise InputError('there are no poses to remove', 'capture a pose first')
        self._poses_changed(ended=False)
        count = len(self.live.book.poses())
        return f'the last pose is removed; remaining: {counted(count, "pose")}'

    def fit(self) -> Job:
        """Fit the poses; use and store the calibration."""
        store, before = self.files.usable(), self.active.calibration
        self.live.refresh()
        given = (self.live.book.poses(), self.units, self.settings, self.sensor, before,
                 self._present_context())

        def run(compute: Compute) -> tuple[Calibration, OSError | None]:
            calibration = compute(fitted, *given)
            return calibration, compute(_stored, store, calibration)

        def finish(found: tuple[Calibration, OSError | None]) -> str:
            self._use(*found)
            return f'{summary(found[0])}; stored in {store.calibration}'

        return Job(run, finish)

    def refine(self) -> Job:
        """Refine the calibration; use and store the refined calibration."""
        store, before = self.files.usable(), self.active.calibration
        self.live.refresh()
        given = self.live.book.poses(), self.units, self.sensor, before

        def run(compute: Compute) -> tuple[Refinement, OSError | None]:
            refinement = compute(refined, *given)
            if refinement.refusal:
                return refinement, None
            return refinement, compute(_stored, store, refinement.calibration)

        def finish(found: tuple[Refinement, OSError | None]) -> str:
            refinement, not_stored = found
            if refinement.refusal:
                raise RefusedFitError(f'{story(refinement)}; not used: {refinement.refusal[0]}',
                                      refinement.refusal[1])
            self._use(refinement.calibration, not_stored)
            return f'{story(refinement)}; stored in {store.calibration}'

        return Job(run, finish)

    def set_level(self) -> Job:
        """Level the mounting from the ongoing rest."""
        calibration, rest = self._calibration_and_rest()
        levelled = level(calibration, rest.mean, self.settings.frame,
                         context_of_rest(rest, self.units))
        return self._job_to_use(levelled, 'the mounting is levelled by this pose')

    def set_heading(self) -> Job:
        """Set the heading of the mounting from the ongoing rest, with the nose down."""
        calibration, rest = self._calibration_and_rest()
        if not calibration.is_levelled:
            raise InputError('the mounting is not levelled', 'place the robot flat and call '
                             '~/set_level first, then tilt its nose down')
        headed = set_heading(calibration, rest.mean, context_of_rest(rest, self.units))
        return self._job_to_use(headed, 'the heading is set by this pose')

    def _calibration_and_rest(self) -> tuple[Calibration, Dwell]:
        """Return the calibration in use and the ongoing rest."""
        if self.active.calibration is None:
            raise _NO_CALIBRATION
        self._check_fresh()
        rest = self.live.detector.current()
        if rest is None:
            raise self._not_still()
        return self.active.calibration, rest

    def _job_to_use(self, calibration: Calibration, words: str) -> Job:
        """Return the job that stores and uses a calibration with a new mounting."""
        store = self.files.usable()

        def finish(not_stored: OSError | None) -> str:
            self._use(calibration, not_stored)
            warnings = [each for each in calibration.warnings if each.startswith(FLAT)]
            return '; '.join([f'{words}; stored in {store.calibration}', *warnings])

        return Job(lambda compute: _stored(store, calibration), finish)

    def save(self) -> Job:
        """Store calibration and poses."""
        store, calibration = self.files.usable(), self.active.calibration
        if calibration is None:
            raise _NO_CALIBRATION
        poses = self.live.book.poses()

        def run(compute: Compute) -> None:
            store.save_calibration(calibration)
            store.save_poses(poses)

        return Job(run, lambda none: f'stored in {store.calibration} and {store.poses}')

    def load(self) -> Job:
        """Read the stored calibration again; if it is refused, the calibration in use is kept."""
        store = self.files.usable()

        def finish(calibration: Calibration | None) -> str:
            if calibration is None:
                raise StoredCalibrationError(f'{store.calibration} does not exist',
                                             'call ~/fit, or copy a calibration there')
            self._adopt(calibration)
            return f'read {store.calibration}'

        return Job(lambda compute: store.load_calibration(), finish)

    def reset(self) -> Job:
        """Remove poses and calibration; the stored files are renamed."""
        store = self.files.usable()

        def finish(kept: list[Path]) -> str:
            self.live.clear()
            self._adopt(None)
            self._fitted_poses = 0
            self._poses_changed(ended=False)
            return 'poses and calibration are removed' + ''.join(
                f'; the stored file is kept as {path.name}' for path in kept)

        return Job(lambda compute: store.set_aside(), finish)

    def enable(self, on: bool) -> str:
        """Switch the correction on or off."""
        self.active.enabled = on
        return 'messages are corrected' if on else 'raw messages are published unchanged'

    def _use(self, calibration: Calibration, not_stored: OSError | None) -> None:
        """Use a calibration, and report it if it could not be stored."""
        self._adopt(calibration)
        if not_stored is not None:
            raise InputError(f'the calibration is in use but could not be stored: {not_stored}',
                             'correct the permissions and call ~/save, or set calibration_file')

    def _present_context(self) -> Context:
        """Return the temperature as one row of context, if known."""
        temperature = self.statistics.temperature
        return {} if math.isnan(temperature) else {'temperature': np.array([temperature])}

    def _check_fresh(self) -> None:
        """Check that the last message is recent."""
        age = self._clock() - self.statistics.arrived
        if not self.statistics.messages:
            raise InputError('there is no Imu message yet', 'start the driver')
        if age > _OLD:
            raise InputError(f'the last Imu message arrived {age:.1f} s ago, expected one within '
                             f'{_OLD:g} s', 'check the driver and try again')

    def _not_still(self) -> InputError:
        """Return the error for a sensor that is not at rest."""
        least, length = self.settings.min_dwell, self._length_g()
        if abs(length - 1.0) > self.settings.still_norm_tolerance:
            return InputError(f'|a| is {length:.3g} g, expected about 1 g at rest',
                              'hold the sensor still; if it is still, set the parameter units')
        if not self.live.detector.still:
            return InputError('the sensor is not still', f'hold it still for {least:g} s, and '
                              'check ~/still')
        return InputError(f'the sensor has been still for less than {least:g} s',
                          'hold it still for longer')

    # Poses and state

    def _poses_changed(self, *, ended: bool) -> None:
        """Draw and store the poses, and fit if auto_fit is set."""
        self._show_poses(store=self.files.locked)
        count = len(self.live.book.poses())
        enough = self.settings.auto_fit and count >= self.settings.auto_fit_poses
        if enough and self.files.locked and (ended or count > self._fitted_poses):
            self._fitted_poses = count
            self._events.append(self.fit())

    def _show_poses(self, *, store: bool) -> None:
        """Add a job that draws the poses with the next pose, and stores them."""
        poses, units, model = self.live.book.poses(), self.units, self.settings.model
        where = self.files.store if store else None

        def run(compute: Compute) -> tuple[OSError | None, NextPose]:
            not_stored = None
            try:
                if where is not None:
                    where.save_poses(poses)
            except OSError as error:
                not_stored = error
            here = asked_for(poses, units, model) if not len(poses) else None
            return not_stored, here or compute(asked_for, poses, units, model)

        def finish(found: tuple[OSError | None, NextPose]) -> str:
            not_stored, asked = found
            if not_stored is not None:
                self._log('error', f'the poses could not be stored: {not_stored}; correct the '
                          'permissions, or set calibration_file', once_in=_AGAIN)
            before, self.next_pose = self.next_pose, next_action(asked)
            if len(poses) and self.next_pose != before:
                self._log('info', f'{counted(len(poses), "pose")}; {self.next_pose}')
            self._events.append(ShowPoses(poses_up(poses, units), asked, self.frame_id or ''))
            return ''

        self._events.append(Job(run, finish))

    def _log(self, severity: Severity, words: str, *, once_in: float = 0.0) -> None:
        self._events.append(Log(severity, words, once_in))

    def _length_g(self) -> float:
        """Return |a| of the last message [g]; NaN if not known."""
        reading = self.statistics.reading
        if reading is None or self.units.name == 'native':
            return math.nan
        return float(np.linalg.norm(reading)) / self.units.per_g

    def health(self) -> Health:
        """Return the current state."""
        active, detector, poses = self.active, self.live.detector, self.live.book.poses()
        store = self.files.store
        breaks = detector.interruptions
        rest_ago = math.nan
        if active.rest is not None:
            rest_ago = 0.0 if detector.still else max(
                0.0, self.statistics.stamp - active.rest.end)
        return Health(
            sensor=self.sensor, state=self._state(), problem=self.problem,
            calibration='' if active.calibration is None else title(active.calibration),
            outside='' if active.calibration is None else _outside(
                active.calibration, {'temperature': self.statistics.temperature,
                                     'time': self.statistics.stamp}),
            file='' if store is None else str(store.calibration),
            writable=store is None or store.is_writable(),
            statistics=self.statistics, length=self._length_g(), rest_ago=rest_ago,
            residual=active.residual, drift=active.drift, poses=len(poses),
            doubtful=_doubtful(poses), interruptions=len(breaks),
            last_interruption=f'{breaks[-1].kind}, {breaks[-1].seconds:.2f} s' if breaks else '',
            threshold=detector.threshold, next_pose=self.next_pose)

    def _state(self) -> str:
        if not self.publishes:
            return 'another node uses the files, nothing is published'
        if not self.active.enabled:
            return 'correction switched off, raw messages are published'
        if self.active.calibration is not None:
            return 'correcting'
        if not self.statistics.messages:
            return 'waiting for the first message'
        return ('no calibration, raw messages are published' if self.settings.passthrough
                else 'no calibration, nothing is published')


def _stored(store: Store, calibration: Calibration) -> OSError | None:
    """Store a calibration; return the error if it cannot be stored."""
    try:
        store.save_calibration(calibration)
    except OSError as error:
        return error
    return None


def _doubtful(poses: Poses) -> int:
    return int(np.sum(poses['doubtful'])) if 'doubtful' in poses else 0


def _outside(calibration: Calibration, now: dict[str, float]) -> str:
    """Return a text about context outside of the ranges of the calibration; empty if none."""
    found = []
    for key, (low, high) in calibration.ranges.items():
        if key in now and not low <= now[key] <= high and math.isfinite(now[key]):
            found.append(f'{key} is {now[key]:.4g}, but the range of the calibration is {low:.4g} '
                         f'to {high:.4g}')
    return '; '.join(found)
