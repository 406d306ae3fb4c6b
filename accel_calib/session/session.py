# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The entry point of a session: samples, the sensor that they belong to, its files and calibration.

Only one thread may use a session. Long work (fits, files) is a `Task`, which runs in this thread
and yields `Step`s; their `run` can be called in any thread. All durations of the measurement use
header stamps, so that a bag or a simulation can run at any speed. Only the age of the last message
uses a steady clock.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
import json
import math
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from .commands import Commands, rated
from .guidance import next_action, NOT_KNOWN, plan_for
from .live_capture import Change
from .sensor import Sensor, title
from .settings import CalibratorSettings, own_effects
from .store import SensorFiles, Store, tidied, unusable, writing_advice
from .stream import AGAIN, Around, Reports, SILENT, StreamStatistics
from .worker import (
    answered, Compute, Event, Files, Log, Mounting, nothing, Parse, Result, Severity, ShowPoses,
    Still, Task, Throttle)
from ..calibrate import (
    Calibration, in_frame, mounting_figures, mounting_of, mounting_words, on_topics,
    with_given_mounting)
from ..compare import status
from ..errors import InputError
from ..findings import rating_json
from ..table import Floats, Poses
from ..text import counted
from ..units import FrameName, units_of

if TYPE_CHECKING:
    from ..finding import Finding
    from ..findings import Rating
    from ..refine import Refinement

BATCH = 0.3
"""
Interval at which messages are passed to a session [s].

A batch takes several ms on a slow machine, and messages that arrive in this time wait. At 1 kHz
and 3 batches per second, these are less than 1 % of the messages.

"""

_LARGEST_G, _LARGEST_NATIVE = 1e4, 2.0 ** 32
"""Larger readings are not of a sensor, and would cost the detector its digits [g, native]."""

_SEVERITY: dict[str, Severity] = {'GOOD': 'info', 'USABLE': 'warning', 'BAD': 'error'}
"""Severity of the log line about a finding, by its level."""


class Session:
    """
    The calibrator of one sensor; InputError if the settings contradict each other.

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
    frame : {'ros', 'android'}
        Levelled frame of calibrations.
    enabled : bool
        Whether messages are corrected.
    publishers : tuple of str or None
        Names of the nodes that publish the messages; None: the samples come from a board.
    missing : dict of str to str
        Why a column of the parameter `context` does not arrive, for the log.
    imus, thermometers : tuple of str
        Topics with messages of Imus and of temperatures that other nodes publish.
    mismatches : tuple of str
        Publishers and subscribers with another QoS, which exchange no messages with this node.
    computing : int
        Number of fits and refinements that are running.
    ended : bool
        Whether no more samples can come, because a recording has ended.
    events : deque of Event
        What the session reports, in order; whoever shows it removes it.

    """

    def __init__(self, settings: CalibratorSettings, topic: str,
                 clock: Callable[[], float] = monotonic) -> None:
        self.settings, self.topic, self.clock = settings, topic, clock
        self.units = units_of(settings.units, settings.gravity)
        self.sensor = Sensor(settings, self.units)
        self.statistics, self.around = StreamStatistics(clock), Around(clock)
        self.missing: dict[str, str] = {}
        self.found: tuple[Finding, ...] = ()  # in the samples before they come here
        self.files = SensorFiles(settings, topic)
        self.commands, self.reports = Commands(self), Reports(self)
        # Messages in ned are those of ros, turned.
        self.frame: FrameName = 'ros' if settings.frame == 'ned' else settings.frame
        self.frame_id: str | None = None
        self.problem = ''
        self.publishers: tuple[str, ...] | None = ()
        self.mismatches: tuple[str, ...] = ()
        self.imus: tuple[str, ...] = ()
        self.thermometers: tuple[str, ...] = ()
        self.enabled, self.still, self.still_since = True, False, math.nan
        self.computing, self.ended = 0, False
        _check_frames(settings)
        self.own = own_effects(settings)
        self._given = mounting_of(settings.mounting_rpy) if any(settings.mounting_rpy) else None
        self._largest = (_LARGEST_NATIVE if self.units.is_native
                         else _LARGEST_G * self.units.per_g)
        self.events, self._filter = deque[Event](), Throttle(clock)
        known = settings.sensor or settings.calibration_file
        if not known or not self._open(answered):
            self.show_poses(store=False)

    @property
    def name(self) -> str:
        """Name of the sensor; empty if not known yet."""
        return self.settings.sensor or self.frame_id or ''

    @property
    def context(self) -> dict[str, float]:
        """Present time [s], if known, and last values of the context."""
        stamp = self.statistics.stamp
        return {**self.around.values, **({} if math.isnan(stamp) else {'time': stamp})}

    def set_settings(self, settings: CalibratorSettings) -> None:
        """Replace the settings that can change while the node runs."""
        before, self.settings = self.settings, settings
        if settings.rotate != before.rotate:
            self.sensor.set_rotates(settings.rotate)
        if settings.model != before.model:
            self.sensor.guide.plan = None
            self.show_poses(store=False)

    def log(self, severity: Severity, words: str, kind: str = '', once_in: float = 0.0) -> None:
        """Add a log line to the events; of a kind, if it has one, at most one in `once_in` [s]."""
        if words and (not kind or self._filter.passes(kind, once_in)):
            self.events.append(Log(severity, words))

    def tick(self) -> None:
        """Check the stream, and try to lock the files; to be called about once per second."""
        store = self.files.try_again()
        if store is not None:
            self.events.append(_load(self, store, self.sensor))
        self._report_still()
        self.around.expire()
        self.reports.tick()
        self.events += self.commands.due()

    def close(self) -> None:
        """Unlock the files."""
        self.files.release()

    # Samples

    def accepts(self, frame_id: str) -> bool:
        """
        Return whether messages with this frame_id belong to the sensor; the first one defines it.

        A message of another sensor ends the ongoing rest. After `SILENT`, it replaces the sensor.

        """
        if frame_id == self.frame_id:
            return True
        if self.frame_id is None:
            self._bind(frame_id)
            return True
        if self.statistics.age > SILENT:
            self._switch_to(frame_id)
            return True
        self._change(self.sensor.live.interrupt(self.settings.auto_capture))
        self.reports.foreign(frame_id)
        return False

    def push(self, samples: Floats, arrived: float) -> None:
        """
        Add samples of the sensor.

        Parameters
        ----------
        samples : (n, 7 + k) array
            As in `accel_calib.capture.StillDetector.push`, with the context of `columns_of`.
        arrived : float
            Arrival time of the last sample, by the steady clock [s].

        """
        good = (np.abs(samples[:, 1:4]) <= self._largest).all(axis=1)  # and no NaN
        if not np.all(good):
            self.reports.absurd(samples[~good, 1:4], self._largest)
            samples = samples[good]
        if len(samples):
            since = arrived - self.statistics.arrived
            self.statistics.add(samples, arrived)
            self.sensor.temperatures.add(samples[:, 0], samples[:, 7])
            live = self.sensor.live
            before = live.detector.interruptions[-1:]
            self._change(live.push(samples, self.settings.auto_capture))
            last = live.detector.interruptions[-1:]
            if last != before:
                self.reports.jump(last[0].seconds, since)

    def _change(self, changes: Iterable[Change]) -> None:
        sensor, least = self.sensor, self.settings.drift_warn / self.settings.gravity
        for change in changes:
            self._report_still()
            had_changed = sensor.has_changed
            if change.rest is not None:
                sensor.update(change.rest, least)
            for dwell in change.ended:
                sensor.end(dwell, least)
            if sensor.drift is not None and sensor.has_changed is not had_changed:
                self.log('warning' if sensor.has_changed else 'info', status(sensor.drift))
            if change.doubted:
                self.log('warning', f'{counted(change.doubted, "pose")} taken while the sensor '
                         'moved or vibrated, as by motors: later rests are quieter; a fit leaves '
                         'out such poses if the others are sufficient')
            for rest in change.refused:
                if 2.0 * (rest.end - rest.start) > self.settings.min_dwell and (
                        next_action(self).kind == 'poses'):
                    self.log('info', f'this rest gave no pose: {rest.words}', rest.reason, AGAIN)
            if change.poses:
                new = change.rest is not None and sensor.guide.is_new_rest(change.rest.start)
                self.poses_changed(ended=bool(change.ended), new_rest=new)
        self._report_still()

    def _report_still(self) -> None:
        # Without messages, or without a clock, nobody knows whether the sensor rests.
        blind = max(self.statistics.age, self.statistics.stopped) > SILENT
        if (self.sensor.live.still and not blind) is not self.still:
            self.still = not self.still
            self.still_since = self.statistics.stamp - self.settings.still_window
            self.events.append(Still(self.still))

    # The sensor and its files

    def _bind(self, frame_id: str) -> None:
        """Set the sensor from the first message."""
        self.frame_id = frame_id
        self.log('info', f'Imu messages arrive on {self.topic}, frame_id {frame_id!r}' if frame_id
                 else f'samples arrive from {self.topic}')
        self._show_frame()
        if self.files.store is None or self.sensor.owners - {self.name}:
            self._begin_again()
        elif not self.settings.sensor:
            self.files.take(self.name)

    def _switch_to(self, frame_id: str) -> None:
        self.log('warning', f'the messages now have frame_id {frame_id!r} instead of '
                 f'{self.frame_id!r}: switching to this sensor')
        self._change(self.sensor.live.interrupt(self.settings.auto_capture))
        self.frame_id = frame_id
        if not self.settings.sensor:  # otherwise the user has set the sensor
            self._begin_again()
        self._show_frame()

    def _show_frame(self) -> None:
        """Show poses and mounting in the frame of the sensor, which was not known before."""
        frame_id = self.frame_id
        if frame_id and frame_id == self.settings.output_frame_id:
            self.log('warning', f'output_frame_id is {frame_id!r}, the frame of the sensor: TF '
                     'turns levelled messages twice; choose another output_frame_id, or set '
                     'rotate to false')
        self._show_mounting()
        plan = self.sensor.guide.plan
        if plan is not None:
            self.events.append(ShowPoses(plan.up, plan.asked, frame_id or ''))

    def _begin_again(self) -> None:
        """Discard poses and calibration of another sensor, and load those of this sensor."""
        self.sensor = Sensor(self.settings, self.units)
        self._open(self.events.append)

    def _open(self, run: Callable[[Task], object]) -> bool:
        """Lock and load the files of the sensor; return whether no other node uses them."""
        store = self.files.take(self.name)
        self.problem = self.files.problem
        self.log('error', self.problem)
        if store is not None:
            run(_load(self, store, self.sensor))
        return store is not None

    # The calibration

    def adopt(self, calibration: Calibration | None, refinement: Refinement | None = None,
              rating: Rating | None = None) -> None:
        """Correct with this calibration, and with the given mounting if there is one."""
        self.problem = ''
        if calibration is None:
            self.sensor.adopt(None)
            self.rate(None)
            return
        levelled = calibration.is_levelled
        if levelled and calibration.frame != self.frame:
            self.log('warning', f'the stored mounting is for the frame {calibration.frame}, but '
                     f'frame is {self.settings.frame}: it is turned, and a measured heading is '
                     'kept')
            calibration = in_frame(calibration, self.frame)
        stored, calibration = calibration, self.with_given(calibration)
        if levelled and not np.allclose(stored.rotation[:, 2], calibration.rotation[:, 2]):
            self.log('warning', 'the stored mounting differs from the given one by more than 10° '
                     'of tilt: the given mounting is used; call ~/set_level with the robot level')
        self.sensor.adopt(calibration)
        self.rate(refinement, rating)
        turned = calibration.is_levelled and self.settings.rotate
        self.log('info', f'correcting with {title(calibration)}; messages are in the frame '
                 f'{self.settings.frame if turned else "of the sensor"}')
        for finding in calibration.noted:
            self.log(_SEVERITY[finding.level], finding.words)
        self._show_mounting()

    def _show_mounting(self) -> None:
        calibration = self.sensor.calibration
        if self.frame_id and calibration is not None and calibration.is_levelled:
            levelled = on_topics(calibration, self.settings.frame)
            self.events.append(Mounting(levelled.rotation, self.frame_id))

    def rate(self, refinement: Refinement | None, rating: Rating | None = None) -> None:
        """Add a task that rates the present calibration, if need be, and reports it as JSON."""
        sensor = self.sensor
        sensor.refinement = refinement
        if rating is not None or sensor.present is None:
            sensor.rating = rating
        if sensor.present is not None:
            self.events.append(_report_rating(self, sensor, sensor.present, rating))

    def set_mounting(self, rotation: Floats) -> None:
        """Use a mounting ΔR that is known from elsewhere, (3, 3)."""
        if self._given is not None and np.allclose(self._given, rotation):
            return
        self._given = rotation
        self.log('info', mounting_words(rotation, self.frame_id or '', self.settings.base_frame))
        if self.sensor.calibration is not None:
            self.adopt(self.sensor.calibration, self.sensor.refinement)

    def with_given(self, calibration: Calibration) -> Calibration:
        """Return a calibration with the given mounting, if there is one."""
        return (calibration if self._given is None
                else with_given_mounting(calibration, self._given))

    def mounting_words(self, calibration: Calibration | None) -> str:
        """Return the mounting of a calibration as one line; empty if it is not known."""
        if calibration is None or not calibration.is_levelled:
            return ''
        return mounting_words(calibration.rotation, self.frame_id or '', self.settings.base_frame)

    # Poses

    def poses_changed(self, *, ended: bool, new_rest: bool = False) -> None:
        """Draw and store the poses, and fit if auto_fit is set; `ended`: a rest has ended."""
        self.show_poses(store=self.files.locked, new_rest=new_rest)
        if ended or len(self.sensor.live.book.poses()) > self.sensor.fitted_poses:
            self.sensor.auto_fit_waits = True
        self.events += self.commands.due()

    def show_poses(self, *, store: bool, new_rest: bool = False) -> None:
        """Add a task that stores the poses, and draws them with the next pose."""
        sensor = self.sensor
        poses = sensor.live.book.poses()
        added = sensor.guide.added(len(poses), self.statistics.stamp)
        self.events.append(_draw_poses(
            self, sensor, poses, added, new_rest, self.files.store if store else None))


def _load(session: Session, store: Store, sensor: Sensor) -> Task:
    """Read the files of a sensor, and use them unless another one has replaced it."""
    calibration: Calibration | None = None
    poses: Poses | None = None
    problem = ''
    notes: list[str] = yield Files(tidied, store)
    try:
        calibration = yield Parse(store.load_calibration)
    except Exception as error:  # the node starts in any case
        problem = yield Files(unusable, store.calibration, error)
    if calibration is not None and calibration.stream not in ('', store.identity.topic):
        notes.append(f'{store.calibration} was made for {calibration.stream}, but it is used '
                     f'for {store.identity.topic}')
    try:
        poses = yield Files(store.load_poses)
    except Exception as error:
        notes.append((yield Files(unusable, store.poses, error, True)))
    if session.sensor is not sensor:
        return ''
    sensor.owners = {each.sensor for each in (calibration, poses)
                     if each is not None and each.sensor}
    if poses is not None:
        sensor.live.book.add_stored(poses)
        session.log('info', f'read {counted(len(poses), "pose")} from the store')
    if calibration is not None:
        session.adopt(calibration)
        sensor.fitted_poses = len(calibration.poses)
    session.problem = problem
    for line in filter(None, (problem, *notes)):
        session.log('error', line)
    session.show_poses(store=False)
    return ''


def _report_rating(session: Session, sensor: Sensor, calibration: Calibration,
                   rating: Rating | None) -> Task:
    """Rate a calibration, and report it, unless another one has replaced it."""
    rating, found = yield Compute(rated, calibration, sensor.refinement, rating,
                                  session.settings.model)
    if sensor.present is not calibration:
        return ''
    sensor.rating = rating
    action = next_action(session)
    if action is not NOT_KNOWN:
        found['in_use'] = sensor.offered is not calibration
        if calibration.is_levelled:
            found['mounting'] = mounting_figures(
                calibration.rotation, session.frame_id or '', session.settings.base_frame)
        command = action.command and f'~/{action.command}'
        session.events.append(Result(json.dumps({
            **found, **rating_json(rating, action.kind, action.words, command)})))
    return ''


def _draw_poses(session: Session, sensor: Sensor, poses: Poses, added: int, new_rest: bool,
                store: Store | None) -> Task:
    """Store and draw poses, this number more than before; return the line of a new rest."""
    guide, given = sensor.guide, (poses, session.units, session.settings.model)
    due = added != 0 or guide.plan is None
    try:
        yield Files(nothing) if store is None else Files(store.save_poses, poses)
    except OSError as error:
        session.log('error', f'the poses could not be stored: {error}; {writing_advice(error)}',
                    'not_stored', AGAIN)
    # Computed even where only an average has changed, so that the lines keep their order.
    plan = yield Compute(plan_for, *given) if due and len(poses) else Compute(nothing)
    if due and not len(poses):  # without the start of the worker process
        plan = plan_for(*given)
    if plan is not None and sensor is session.sensor:
        guide.plan = plan
        session.events.append(ShowPoses(plan.up, plan.asked, session.frame_id or ''))
    if not new_rest or sensor is not session.sensor:
        return ''
    return guide.line(poses, session.units, next_action(session), added=added > 0)


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
