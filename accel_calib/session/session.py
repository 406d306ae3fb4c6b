# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The entry point of a session: samples, the sensor that they belong to, and its files.

Only one thread may use a session. Long work (fits, files) is a `Task`, which runs in this thread
and yields `Step`s; their `run` can be called in any thread. All durations of the measurement use
header stamps, so that a bag or a simulation can run at any speed. Only the age of the last message
uses a steady clock.

"""

from collections.abc import Callable, Iterable
from time import monotonic

import numpy as np

from .commands import Commands, due, poses_changed
from .conditions import next_action
from .core import State
from .live_capture import Change
from .reports import FAULT_AGAIN, Reports
from .sensor import Sensor
from .settings import CalibratorSettings
from .stream import AGAIN, SILENT
from .use import adopt, load, show_mounting, show_poses
from .worker import answered, ShowPoses, Still, Task
from ..calibration import mounting_words
from ..comparison import status
from ..table import Floats
from ..text import counted

BATCH = 0.3
"""
Interval at which messages are passed to a session [s].

A batch takes several ms on a slow machine, and messages that arrive in this time wait. At 1 kHz
and 3 batches per second, these are less than 1 % of the messages.

"""

_LARGEST_G, _LARGEST_NATIVE = 1e4, 2.0 ** 32
"""Larger readings are not of a sensor, and would cost the detector its digits [g, native]."""


class Session(State):
    """
    The calibrator of one sensor; parameters, attributes and errors as of `State`.

    Attributes
    ----------
    commands : Commands
        What the user can ask for.
    reports : Reports
        The log lines about the messages.

    """

    def __init__(self, settings: CalibratorSettings, topic: str,
                 clock: Callable[[], float] = monotonic) -> None:
        super().__init__(settings, topic, clock)
        self.commands, self.reports = Commands(self), Reports(self)
        self._largest = (_LARGEST_NATIVE if self.units.is_native
                         else _LARGEST_G * self.units.per_g)
        known = settings.sensor or settings.calibration_file
        if not known or not self._open(answered):
            show_poses(self, store=False)

    def set_settings(self, settings: CalibratorSettings) -> None:
        """Replace the settings that can change while the node runs."""
        before, self.settings = self.settings, settings
        if settings.rotate != before.rotate:
            self.sensor.set_rotates(settings.rotate)
        if settings.model != before.model:
            self.sensor.guide.plan = None
            show_poses(self, store=False)

    def tick(self) -> None:
        """Check the stream, and try to lock the files; to be called about once per second."""
        store = self.files.try_again()
        if store is not None:
            self.events.append(load(self, store, self.sensor))
        self._report_still()
        self.reports.tick()
        self.events += due(self)

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
            self.log('info', f'Imu messages arrive on {self.topic}, frame_id {frame_id!r}'
                     if frame_id else f'samples arrive from {self.topic}')
            self.frame_id = frame_id
            self._show_frame()
            if self.files.store is None or self.sensor.owners - {self.name}:
                self._begin_again()
            elif not self.settings.sensor:
                self.files.take(self.name)
            return True
        is_replaced = self.statistics.age > SILENT
        if is_replaced:
            self.log('warning', f'the messages now have frame_id {frame_id!r} instead of '
                     f'{self.frame_id!r}: switching to this sensor')
        self._change(self.sensor.live.interrupt(self.settings.auto_capture))
        if is_replaced:
            self.frame_id = frame_id
            if not self.settings.sensor:  # otherwise the user has set the sensor
                self._begin_again()
            self._show_frame()
            return True
        self.statistics.drop('foreign')
        self.log('error', f'an Imu message has frame_id {frame_id!r}, expected {self.frame_id!r}; '
                 'it is dropped: use a separate topic for each sensor', 'foreign', AGAIN)
        return False

    def push(self, samples: Floats, arrived: float) -> None:
        """
        Add samples of the sensor.

        Parameters
        ----------
        samples : (n, 7 + k) array
            As in `accel_calib.stillness.StillDetector.push`, with the context of `columns_of`.
        arrived : float
            Arrival time of the last sample, by the steady clock [s].

        """
        good = (np.abs(samples[:, 1:4]) <= self._largest).all(axis=1)  # and no NaN
        if not np.all(good):
            self.statistics.drop('not_finite', int(np.sum(~good)))
            reading = tuple(samples[~good, 1:4][0].tolist())
            self.log('warning', f'an Imu message has the linear_acceleration {reading}, expected '
                     f'three finite numbers up to {self._largest:.3g}; it is dropped: check the '
                     'driver', 'absurd', AGAIN)
            samples = samples[good]
        if len(samples):
            since = arrived - self.statistics.arrived
            self.statistics.add(samples, arrived)
            self.sensor.temperatures.add(samples[:, 0], samples[:, 7])
            live = self.sensor.live
            before = live.detector.interruptions[-1:]
            self._change(live.push(samples, self.settings.auto_capture))
            self.stillness = self.statistics.spread / live.detector.threshold
            last = live.detector.interruptions[-1:]
            if last != before and abs(last[0].seconds - since) > SILENT:
                where = 'back' if last[0].seconds < 0.0 else 'ahead'
                self.log('warning', f'the stamps jumped {where} by {abs(last[0].seconds):.1f} s; '
                         'the rest before it has ended, and the poses are kept: unless a '
                         'recording is played, check the clock of the driver',
                         f'jump {where}', FAULT_AGAIN)

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
                poses_changed(self, ended=bool(change.ended),
                              new_rest=change.rest if new else None)
        self._report_still()

    def _report_still(self) -> None:
        # Without messages, or without a clock, nobody knows whether the sensor rests.
        blind = max(self.statistics.age, self.statistics.stopped) > SILENT
        if (self.sensor.live.still and not blind) is not self.still:
            self.still = not self.still
            self.still_since = self.statistics.stamp - self.settings.still_window
            self.events.append(Still(self.still))

    # The sensor and its files

    def _show_frame(self) -> None:
        """Show poses and mounting in the frame of the sensor, which was not known before."""
        frame_id = self.frame_id
        if frame_id and frame_id == self.settings.output_frame_id:
            self.log('warning', f'output_frame_id is {frame_id!r}, the frame of the sensor: TF '
                     'turns levelled messages twice; choose another output_frame_id, or set '
                     'rotate to false')
        show_mounting(self)
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
            run(load(self, store, self.sensor))
        return store is not None

    def set_mounting(self, rotation: Floats) -> None:
        """Use a mounting ΔR that is known from elsewhere, (3, 3)."""
        if self.given is not None and np.allclose(self.given, rotation):
            return
        self.given = rotation
        self.log('info', mounting_words(rotation, self.frame_id or '', self.settings.base_frame))
        if self.sensor.calibration is not None:
            adopt(self, self.sensor.calibration, self.sensor.refinement)
