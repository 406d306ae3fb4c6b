# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator without ROS: it takes samples and commands, and returns answers and events.

Only one thread may use a session. Long work (fits, files) is a `Task`, which runs in this thread
and yields `Step`s; their `run` can be called in any thread. All durations of the measurement use
header stamps, so that a bag or a simulation can run at any speed. Only the age of the last message
uses a steady clock.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import math
import re
from time import monotonic

import numpy as np

from .active_calibration import ActiveCalibration
from .commands import Commands
from .guidance import Guide, Plan, Progress
from .health import Health, stream_fault
from .live_capture import Change, LiveCapture
from .sensor_files import SensorFiles
from .settings import CalibratorSettings, capture_settings
from .store import load, Loaded, Store, writing_advice
from .stream import Newest, NewestReading, SILENT, StreamStatistics
from .work import (
    Compute,
    Event,
    Files,
    is_partial,
    Log,
    Mounting,
    plan_for,
    Severity,
    ShowPoses,
    Still,
    Task,
    title,
)
from ..calibrate import Calibration, Outside, outside, USES_LIMIT, with_given_mounting
from ..calibrate.mounting import mounting_of, mounting_words
from ..compare import status
from ..effects import Context
from ..errors import AccelCalibError, InputError
from ..messages.one_reading import Triple
from ..table import Floats, Poses
from ..text import counted
from ..units import units_of

BATCH = 0.3
"""
Interval at which messages are passed to a session [s].

A batch takes several ms on a slow machine, and messages that arrive in this time wait. At 1 kHz
and 3 batches per second, these are less than 1 % of the messages.

"""

_AGAIN = 10.0
"""Shortest time between two equal log lines about single messages or a silent stream [s]."""

_FAULT_AGAIN = 60.0
"""Shortest time between two equal log lines about another fault of the stream [s]."""

_NUMBER = re.compile(r'[\d.]+')

_LARGEST_G, _LARGEST_NATIVE = 1e4, 2.0 ** 32
"""Larger readings are not of a sensor, and would cost the detector its digits [g, native]."""

_AUTO_FIT_EVERY = 60.0
"""Shortest time between two automatic fits [s]."""


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

    Attributes
    ----------
    commands : Commands
        What the user can ask for.
    preview : Calibration or None
        A calibration that waits for ~/save or ~/undo.
    publishers : tuple of str or None
        Names of the nodes that publish the messages; None: the samples come from a board.
    mismatches : tuple of str
        Publishers and subscribers with another QoS, which exchange no messages with this node.
    changes : int
        Number of changes of the calibration in use or offered.
    computing : int
        Number of fits and refinements that are running.

    Raises
    ------
    InputError
        If the settings contradict each other.

    """

    def __init__(self, settings: CalibratorSettings, topic: str,
                 clock: Callable[[], float] = monotonic) -> None:
        self.settings, self.topic, self.clock = settings, topic, clock
        self.units = units_of(settings.units, settings.gravity)
        self.live = LiveCapture(capture_settings(settings), self.units)
        self.active = ActiveCalibration(settings.gravity, rotates=settings.rotate)
        self.statistics = StreamStatistics(clock)
        self.files = SensorFiles(settings, topic)
        self.guide = Guide()
        self._newest = NewestReading(self.units)
        self._spread = math.nan, math.nan
        self.commands = Commands(self)
        self.frame_id: str | None = None
        self.problem = ''
        self.publishers: tuple[str, ...] | None = ()
        self.mismatches: tuple[str, ...] = ()
        self.preview: Calibration | None = None
        self.fitted_poses = self.changes = self.computing = 0
        _check_frames(settings)
        self._given = mounting_of(settings.mounting_rpy) if any(settings.mounting_rpy) else None
        self._loaded: set[str] = set()
        self._still = self._auto_fit_waits = False
        self._still_since = math.nan
        self._reported, self._reported_at = '', -math.inf
        self._auto_fit_at = -math.inf
        self._left: frozenset[str] = frozenset()
        self._largest = (_LARGEST_NATIVE if self.units.name == 'native'
                         else _LARGEST_G * self.units.per_g)
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

    def set_settings(self, settings: CalibratorSettings) -> None:
        """Replace the settings that can change while the node runs."""
        before, self.settings = self.settings, settings
        if settings.rotate != before.rotate:
            self.active.set_rotates(settings.rotate)
        if settings.model != before.model:
            self.guide.plan = None
            self._show_poses(store=False)

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
        if self.clock() - self.statistics.arrived > SILENT:
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
        good = (np.abs(samples[:, 1:4]) <= self._largest).all(axis=1)  # and no NaN
        if not np.all(good):
            reading = tuple(samples[~good][0, 1:4].tolist())
            self.statistics.drop('not_finite', int(np.sum(~good)))
            self._log('warning', f'an Imu message has the linear_acceleration {reading}, expected '
                      f'three finite numbers up to {self._largest:.3g}; it is dropped: check the '
                      'driver', once_in=_AGAIN)
            samples = samples[good]
        if len(samples):
            since = arrived - self.statistics.arrived
            self.statistics.add(samples, arrived)
            self.active.temperatures.add(samples[:, 0], samples[:, 7])
            before = self.live.detector.interruptions[-1:]
            self._change(self.live.push(samples, self.settings.auto_capture))
            last = self.live.detector.interruptions[-1:]
            if last != before:
                self._report_jump(last[0].seconds, since)

    def _report_jump(self, seconds: float, since: float) -> None:
        """Log a jump of the stamps, unless no messages arrived for as long [s]."""
        if abs(seconds - since) > SILENT:
            self._log('warning', f'the stamps jumped {"back" if seconds < 0.0 else "ahead"} by '
                      f'{abs(seconds):.1f} s; the rest before it has ended, and the poses are '
                      'kept: unless a recording is played, check the clock of the driver',
                      once_in=_FAULT_AGAIN)

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

    def _change(self, changes: Iterable[Change]) -> None:
        """Process the changes that samples caused."""
        for change in changes:
            self._report_still()
            self._process(change)
        self._report_still()

    def _report_still(self) -> None:
        # Without messages, or without a clock, nobody knows whether the sensor rests.
        blind = max(self.statistics.age, self.statistics.stopped) > SILENT
        if (self.live.still and not blind) is not self._still:
            self._still = not self._still
            self._still_since = self.statistics.stamp - self.settings.still_window
            self._events.append(Still(self._still))

    def _process(self, change: Change) -> None:
        """Update the drift monitor and the poses."""
        least = self.settings.drift_warn / self.settings.gravity
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
            new = change.rest is not None and self.guide.is_new_rest(change.rest.start)
            self.poses_changed(ended=bool(change.ended), new_rest=new)

    # The sensor and its files

    def _bind(self, frame_id: str) -> None:
        """Set the sensor from the first message."""
        self.frame_id = frame_id
        self._log('info', f'Imu messages arrive on {self.topic}, frame_id {frame_id!r}')
        self._show_frame()
        if self.files.store is None or self._loaded - {self.sensor}:
            self._begin_again()
        elif not self.settings.sensor:
            self.files.take(self.sensor)

    def _show_frame(self) -> None:
        """Show poses and mounting in the frame of the sensor, which was not known before."""
        frame_id, calibration = self.frame_id, self.active.calibration
        if frame_id and frame_id == self.settings.output_frame_id:
            self._log('warning', f'output_frame_id is {frame_id!r}, the frame of the sensor: TF '
                      'turns levelled messages twice; choose another output_frame_id, or set '
                      'rotate to false')
        if frame_id and calibration is not None and calibration.is_levelled:
            self._events.append(Mounting(calibration.rotation, frame_id))
        if self.guide.plan is not None:
            self._events.append(ShowPoses(self.guide.plan.up, self.guide.plan.asked,
                                          frame_id or ''))

    def _switch_to(self, frame_id: str) -> None:
        """Switch to another sensor."""
        self._change(self.live.interrupt(self.settings.auto_capture))
        self.frame_id = frame_id
        if not self.settings.sensor:  # otherwise the user has set the sensor
            self._begin_again()
        self._show_frame()

    def _begin_again(self) -> None:
        """Discard poses and calibration of another sensor, and load those of this sensor."""
        self.live = LiveCapture(capture_settings(self.settings), self.units)
        enabled = self.active.enabled
        self.active = ActiveCalibration(self.settings.gravity, rotates=self.settings.rotate)
        self.active.enabled = enabled
        self.guide, self.preview = Guide(), None
        self.fitted_poses, self._loaded, self._auto_fit_waits = 0, set(), False
        self.changes += 1
        store = self.files.take(self.sensor)
        self._check_lock()
        if store is not None:
            self._events.append(self._load(store, self.live))

    def _load(self, store: Store, live: LiveCapture) -> Task:
        """Read the files of a sensor, and use them unless another one has replaced it."""
        loaded: Loaded = yield Files(load, store)
        if self.live is live:
            self._adopt_loaded(loaded)
        return ''

    def _check_lock(self) -> None:
        """Report it if another node uses the files."""
        if self.files.problem:
            self.problem = self.files.problem
            self._log('error', self.problem)

    def _adopt_loaded(self, loaded: Loaded) -> None:
        """Use the stored poses and calibration."""
        self._loaded = {each.sensor for each in (loaded.calibration, loaded.poses)
                        if each is not None and each.sensor}
        if loaded.poses is not None:
            self.live.book.add_stored(loaded.poses)
            self._log('info', f'read {counted(len(loaded.poses), "pose")} from the store')
        if loaded.calibration is not None:
            self.adopt(loaded.calibration)
            self.fitted_poses = len(loaded.calibration.poses)
        self.problem = loaded.problem
        for line in filter(None, (loaded.problem, *loaded.notes)):
            self._log('error', line)
        self._show_poses(store=False)

    def adopt(self, calibration: Calibration | None) -> None:
        """Use this calibration for the correction, with the given mounting if there is one."""
        self.preview, self.problem = None, ''
        self.changes += 1
        if calibration is None:
            self.active.adopt(None)
            return
        stored, calibration = calibration, self.with_given(calibration)
        if stored.is_levelled and not np.allclose(stored.rotation[:, 2],
                                                  calibration.rotation[:, 2]):
            self._log('warning', 'the stored mounting differs from the given one by more than 10° '
                      'of tilt: the given mounting is used; call ~/set_level with the robot level')
        self.active.adopt(calibration)
        self._log('info', f'correcting with {title(calibration)}')
        for line in calibration.warnings:
            self._log('warning', line)
        if calibration.is_levelled:
            self._events.append(Mounting(calibration.rotation, self.frame_id or ''))

    def set_mounting(self, rotation: Floats) -> None:
        """Use a mounting ΔR that is known from elsewhere, (3, 3)."""
        if self._given is not None and np.allclose(self._given, rotation):
            return
        self._given = rotation
        self._log('info', mounting_words(rotation, self.frame_id or '', self.settings.base_frame))
        if self.active.calibration is not None:
            self.adopt(self.active.calibration)

    def with_given(self, calibration: Calibration) -> Calibration:
        """Return a calibration with the given mounting, if there is one."""
        if self._given is None:
            return calibration
        return with_given_mounting(calibration, self._given)

    def present_context(self) -> Context:
        """Return the present time and temperature as one row of context, if known."""
        known = {'time': self.statistics.stamp, 'temperature': self.statistics.temperature}
        return {key: np.array([value]) for key, value in known.items() if math.isfinite(value)}

    def offer(self, calibration: Calibration | None) -> None:
        """Publish this calibration on ~/preview only; None: discard the offered one."""
        self.preview = calibration
        self.changes += 1

    def tick(self) -> None:
        """Check the stream, and try to lock the files; to be called about once per second."""
        store = self.files.try_again()
        if store is not None:
            self._events.append(self._load(store, self.live))
        self._report_still()
        self._report_stream()
        self._report_outside()
        self._auto_fit()

    def _outside(self) -> dict[str, Outside]:
        """Return the quantities that are outside of the range of the calibration now."""
        calibration = self.active.calibration
        if calibration is None:
            return {}
        now = {**self.present_context(), 'std': np.zeros((1, 3)), **{
            key: np.array([value]) for key, value in self.active.temperatures.columns.items()}}
        return {key: each for key, each in outside(calibration, now).items() if each.count}

    def _report_outside(self) -> None:
        """Log once when a quantity leaves the range of the calibration."""
        found = self._outside()
        for key, each in found.items():
            if key not in self._left:
                self._log('warning', f'{each.name} has left the range of the calibration, '
                          f'{each.range_words(each.low, each.high)}: it is '
                          f'{each.range_words(each.least, each.most)}, and {USES_LIMIT}',
                          once_in=_FAULT_AGAIN)
        self._left = frozenset(found)

    def _report_stream(self) -> None:
        """Log a fault of the stream when it appears, and again while it lasts."""
        fault = stream_fault(self.statistics, self.length_g(), self.topic, self.publishers,
                             self.mismatches)
        silent = self.statistics.age > SILENT
        again = self.clock() - self._reported_at >= (_AGAIN if silent else _FAULT_AGAIN)
        kind = _NUMBER.sub('', fault)
        if fault and (again or kind != self._reported):
            waiting = not self.statistics.messages and not self.mismatches
            self._log('info' if waiting else 'warning', f'waiting: {fault}' if waiting else fault)
            self._reported, self._reported_at = kind, self.clock()
        elif not fault and self._reported:
            self._log('info', f'messages arrive as expected, {self.statistics.rate:.1f} Hz')
            self._reported = ''

    def close(self) -> None:
        """Unlock the files."""
        self.files.release()

    # Poses and state

    def poses_changed(self, *, ended: bool, new_rest: bool = False) -> None:
        """Draw and store the poses, and fit if auto_fit is set; `ended`: a rest has ended."""
        self._show_poses(store=self.files.locked, new_rest=new_rest)
        count = len(self.live.book.poses())
        if ended or count > self.fitted_poses:
            self._auto_fit_waits = True
        self._auto_fit()

    def _auto_fit(self) -> None:
        """Start an automatic fit if one is due."""
        due = self.clock() - self._auto_fit_at >= _AUTO_FIT_EVERY
        if (self.settings.auto_fit and self._auto_fit_waits and due and self.files.locked
                and len(self.live.book.poses()) >= self.settings.auto_fit_poses):
            self._auto_fit_waits, self._auto_fit_at = False, self.clock()
            self._events.append(self.commands.auto_fit(self.live))

    def auto_fit_later(self) -> None:
        """Repeat an automatic fit when the next one is due."""
        self._auto_fit_waits = True

    def _show_poses(self, *, store: bool, new_rest: bool = False) -> None:
        """Add a task that stores the poses, and draws them with the next pose."""
        poses = self.live.book.poses()
        self._events.append(self._shown(
            poses, self.guide, self.guide.added(len(poses)), new_rest,
            self.files.store if store else None))

    def _shown(self, poses: Poses, guide: Guide, added: int, new_rest: bool, store: Store | None
               ) -> Task:
        """Store and draw poses, this number more than before; return the line about a new rest."""
        units, model = self.units, self.settings.model
        due = added != 0 or guide.plan is None
        try:
            yield Files() if store is None else Files(store.save_poses, poses)
        except OSError as error:
            self._log('error', f'the poses could not be stored: {error}; '
                      f'{writing_advice(error)}', once_in=_AGAIN)
        # Computed even where only an average has changed, so that the lines keep their order.
        plan: Plan | None = yield (Compute(plan_for, poses, units, model)
                                   if due and len(poses) else Compute())
        if due and not len(poses):  # without the start of the worker process
            plan = plan_for(poses, units, model)
        if plan is not None and guide is self.guide:  # otherwise, it is of another sensor
            guide.plan = plan
            self._events.append(ShowPoses(plan.up, plan.asked, self.frame_id or ''))
        return guide.line(poses, units, added=added > 0) if new_rest else ''

    @property
    def _all_used(self) -> bool:
        """Whether the calibration in use, or the one that is offered, is a fit to all poses."""
        return 0 < self.guide.poses == self.fitted_poses

    @property
    def advice(self) -> str:
        """Return what to do next with the poses."""
        if self._all_used:
            return 'the calibration uses these poses'
        return self.guide.advice

    def progress(self, reading: Triple | None = None) -> Progress:
        """
        Return the progress of the calibration.

        Parameters
        ----------
        reading : (float, float, float), optional
            The newest reading; by default the last one that was pushed.

        """
        plan = self.guide.plan
        silent = self.statistics.age > SILENT
        newest = Newest() if silent else self.newest(reading)
        direction = None if plan is None or self._all_used else plan.asked.direction
        return Progress(
            still=self._still and not silent,
            stillness=math.nan if silent else self._stillness(),
            dwell=self.statistics.stamp - self._still_since if self._still else 0.0,
            min_dwell=self.settings.min_dwell, poses=self.guide.poses,
            total=0 if plan is None else plan.asked.total,
            coverage=0.0 if plan is None else plan.coverage,
            accuracy=math.nan if plan is None else plan.asked.error * plan.noise_g,
            advice=self.advice, direction=() if direction is None else tuple(direction.tolist()),
            up=newest.up, length=newest.length, corrected=newest.corrected,
            temperature=self.statistics.temperature)

    def _stillness(self) -> float:
        """Return the spread of the last samples relative to the largest of a still sensor."""
        arrived, stillness = self._spread
        if arrived != self.statistics.arrived:  # the threshold takes longer than all the rest
            stillness = self.statistics.spread / self.live.detector.threshold
            self._spread = self.statistics.arrived, stillness
        return stillness

    def newest(self, reading: Triple | None = None) -> Newest:
        """Return direction and length of the newest reading; the parameter is as in `progress`."""
        if reading is None:
            if self.statistics.newest is None:
                return Newest()
            reading = tuple(self.statistics.newest.tolist())
        calibration, plan = self.preview or self.active.calibration, self.guide.plan
        known = {'time': self.statistics.stamp}
        if calibration is not None:
            known |= self.active.temperatures.columns_of(calibration.model)
        if math.isfinite(self.statistics.temperature):
            known['temperature'] = self.statistics.temperature
        return self._newest.described(reading, calibration, known,
                                      () if plan is None else plan.zero)

    def _log(self, severity: Severity, words: str, *, once_in: float = 0.0) -> None:
        self._events.append(Log(severity, words, once_in))

    def length_g(self) -> float:
        """Return |a| of the last messages [g]; NaN if not known."""
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
            rest_ago = 0.0 if self.live.still else max(
                0.0, self.statistics.stamp - active.rest.end)
        return Health(
            sensor=self.sensor, state=self._state(), problem=self.problem, topic=self.topic,
            publishers=self.publishers, mismatches=self.mismatches,
            calibration='' if active.calibration is None else title(active.calibration),
            outside='; '.join(each.words for key, each in self._outside().items()
                              if key != 'std'),
            file='' if store is None else str(store.calibration),
            writable=store is None or store.is_writable(),
            statistics=self.statistics, length=self.length_g(), rest_ago=rest_ago,
            residual=active.residual, drift=active.drift, poses=len(poses),
            doubtful=_doubtful(poses), interruptions=len(breaks),
            last_interruption=f'{breaks[-1].kind}, {breaks[-1].seconds:.2f} s' if breaks else '',
            threshold=detector.threshold, next_pose=self.advice,
            mounting='' if active.calibration is None or not active.calibration.is_levelled
            else mounting_words(active.calibration.rotation, self.frame_id or '',
                                self.settings.base_frame),
            gyro=active.gyro, noise=active.noise)

    def _state(self) -> str:
        if not self.publishes:
            return 'another node uses the files, nothing is published'
        if not self.active.enabled:
            return 'correction switched off, raw messages are published'
        if self.preview is not None:
            return 'a new calibration waits for ~/save or ~/undo'
        if self.active.calibration is not None:
            return ('correcting, with a calibration of a part of the orientations'
                    if is_partial(self.active.calibration) else 'correcting')
        if not self.statistics.messages:
            return 'waiting for the first message'
        return ('no calibration, raw messages are published' if self.settings.passthrough
                else 'no calibration, nothing is published')


def _doubtful(poses: Poses) -> int:
    return int(np.sum(poses['doubtful'])) if 'doubtful' in poses else 0


def _check_frames(settings: CalibratorSettings) -> None:
    """Refuse settings of the mounting that contradict each other."""
    if any(settings.mounting_rpy) and settings.base_frame:
        raise InputError('both mounting_rpy and base_frame are set, expected one of them',
                         'remove one')
    if settings.publish_tf and settings.output_frame_id and (
            settings.output_frame_id == settings.base_frame):
        raise InputError(f'publish_tf would make {settings.base_frame!r}, the frame of the '
                         'robot, a child of the frame of the sensor',
                         'set publish_tf to false, or choose another output_frame_id')
