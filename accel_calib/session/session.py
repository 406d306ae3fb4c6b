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
from dataclasses import replace
import math
from time import monotonic
from typing import Any

import numpy as np

from .commands import fit_if_due, poses_changed
from .conditions import APART, CONCERNS, conditions, next_step, slow_turn, way_of
from .poses import Change
from .settings import CalibratorSettings
from .state import new_sensor
from .store import SensorFiles, store_of
from .stream import AGAIN, SILENT
from .use import adopt, Holder, open_files, show_mounting, show_poses
from .worker import answered, Still, Task
from ..comparison import status
from ..findings import mounting_words
from ..logs import named_topics
from ..table import Floats
from ..text import counted

BATCH = 0.5
"""
Interval at which messages are passed to a session [s].

A batch takes several ms on a slow machine, and messages that arrive in this time wait. At 1 kHz
and 2 batches per second, these are less than 1 % of the messages.

"""

_FAULT_AGAIN = 60.0
"""Shortest time between two equal log lines about another fault of the stream [s]."""

_OFTEN = ('silence', 'no_publisher')
"""Findings that are logged again after `AGAIN`."""

_LARGEST_G, _LARGEST_NATIVE = 1e4, 2.0 ** 32
"""Larger readings are not of a sensor, and would cost the detector its digits [g, native]."""


class Session(Holder):
    """
    The calibrator of one sensor; InputError if the settings contradict each other.

    Parameters
    ----------
    settings : CalibratorSettings
        The parameters; some can be replaced later.
    topic : str
        Topic of the messages, with namespace.
    clock : callable
        Steady clock [s].
    known : mapping of str to object
        Fields of the first state that are not those of a new one, such as `found`.

    """

    def __init__(self, settings: CalibratorSettings, topic: str,
                 clock: Callable[[], float] = monotonic, **known: Any) -> None:
        super().__init__(settings, topic, clock, **known)
        self._told: list[tuple[str, str]] = []  # kinds and subjects of the logged findings
        units = self.state.units
        self._largest = _LARGEST_NATIVE if units.is_native else _LARGEST_G * units.per_g
        is_named = settings.sensor or settings.calibration_file
        if not is_named or not self._begin(answered):
            show_poses(self, store=False)

    def set_settings(self, settings: CalibratorSettings) -> None:
        """Replace the settings that can change while the node runs."""
        before = self.state.settings
        self.change(settings=settings)
        if settings.model != before.model:
            self.change_sensor(guide=self.sensor.guide.choose(None))
            show_poses(self, store=False)
        if (settings.output_frame_id, settings.rotate) != (
                before.output_frame_id, before.rotate):
            self._show_frame()

    def tick(self) -> None:
        """Check the stream, and try to lock the files; to be called about once per second."""
        files = self.state.files
        if files.store is not None and files.lock is None:
            self.change(files=files.take())
            if self.state.files.lock is not None:
                self.events.append(open_files(self, files.store, self.sensor))
        self._report_still()
        self._report_conditions()
        fit_if_due(self)

    def _report_conditions(self) -> None:
        """Log what is wrong, what is over, and what a pose or an effect would need."""
        state, statistics = self.state, self.state.statistics
        if statistics.age <= SILENT and not statistics.rate:
            return  # what is over can be said with the rate alone
        now = {(each.kind, each.about): each.text for each in conditions(state)
               if each.level != 'GOOD' and each.kind not in APART}
        waits = not statistics.messages and not state.surroundings.mismatches
        for (kind, about), text in now.items():
            name, is_stream = f'{kind} {about}', kind not in CONCERNS
            again = AGAIN if kind in _OFTEN else _FAULT_AGAIN if is_stream else math.inf
            self.log('info' if waits else 'warning', f'waiting: {text}' if waits else text, name,
                     again if (kind, about) in self._told else 0.0)
        over = [key for key in self._told if key not in now and key[0] not in CONCERNS]
        for _, about in over:
            if about in state.around.values:
                self.log('info', f'{about} arrives')
        if over and statistics.rate and all(kind in CONCERNS for kind, _ in now):
            self.log('info', f'messages arrive as expected, {statistics.rate:.1f} Hz')
        self._told = list(now)
        topics = named_topics(state.settings.context)
        if (turn := slow_turn(state)) and state.settings.auto_capture:
            self.log('info', f'no pose yet: {turn}', 'slow_turn', AGAIN)
        if (state.surroundings.thermometers and statistics.messages
                and 'temperature' not in topics and math.isnan(state.around.temperature)):
            self.log('warning', f'no temperature arrives; {way_of("temperature", state)}',
                     'thermometers', 10.0 * _FAULT_AGAIN)
        poses = state.sensor.live.poses()
        for column in filter(poses.__contains__, topics):
            lack = int(np.sum(np.isnan(poses[column])))
            if 0 < lack < len(poses):
                self.log('info', f'{lack} of {counted(len(poses), "pose")} have no {column}, '
                         'so that ~/refine cannot use it', f'poses without {column}',
                         10.0 * _FAULT_AGAIN)

    def close(self) -> None:
        """Unlock the files."""
        self.state.files.release()

    # Samples

    def accepts(self, frame_id: str) -> bool:
        """
        Return whether messages with this frame_id belong to the sensor; the first one defines it.

        A message of another sensor ends the ongoing rest. After `SILENT`, it replaces the sensor.

        """
        if frame_id == self.state.frame_id:
            return True
        if self.state.frame_id is None:
            self.log('info', f'Imu messages arrive on {self.state.topic}, frame_id {frame_id!r}'
                     if frame_id else f'samples arrive from {self.state.topic}')
            self.change(frame_id=frame_id)
            self._show_frame()
            if self.state.files.store is None or self.sensor.owners - {self.state.name}:
                self._begin(self.events.append)
            elif not self.state.settings.sensor:
                self._find_store()
            return True
        self._change(self.sensor.live.interrupt(self.state.settings.auto_capture))
        if self.state.statistics.age <= SILENT:
            self.drop('foreign', 'error', f'an Imu message has frame_id {frame_id!r}, expected '
                      f'{self.state.frame_id!r}; it is dropped: use a separate topic for each '
                      'sensor')
            return False
        self.log('warning', f'the messages now have frame_id {frame_id!r} instead of '
                 f'{self.state.frame_id!r}: switching to this sensor')
        self.change(frame_id=frame_id)
        if not self.state.settings.sensor:  # otherwise the user has set the sensor
            self._begin(self.events.append)
        self._show_frame()
        return True

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
            reading = tuple(samples[~good, 1:4][0].tolist())
            self.drop('not_finite', 'warning', f'an Imu message has the linear_acceleration '
                      f'{reading}, expected three finite numbers up to {self._largest:.3g}; it is '
                      'dropped: check the driver', int(np.sum(~good)))
            samples = samples[good]
        if len(samples):
            since = arrived - self.state.statistics.arrived
            self.state.statistics.add(samples, arrived)
            self.sensor.temperatures.add(samples[:, 0], samples[:, 7])
            live = self.sensor.live
            before = live.detector.interruptions[-1:]
            self._change(live.push(samples, self.state.settings.auto_capture))
            last = live.detector.interruptions[-1:]
            if last != before and abs(last[0].seconds - since) > SILENT:
                where = 'back' if last[0].seconds < 0.0 else 'ahead'
                self.log('warning', f'the stamps jumped {where} by {abs(last[0].seconds):.1f} s; '
                         'the rest before it has ended, and the poses are kept: unless a '
                         'recording is played, check the clock of the driver',
                         f'jump {where}', _FAULT_AGAIN)

    def _change(self, changes: Iterable[Change]) -> None:
        least = self.state.settings.drift_warn / self.state.settings.gravity
        for change in changes:
            self._report_still()
            sensor, had_changed = self.sensor, self.sensor.has_changed
            if change.rest is not None:
                sensor = sensor.update(change.rest, least)
            for dwell in change.ended:
                sensor = sensor.update(dwell, least, ended=True)
            self.change(sensor=sensor)
            if sensor.drift is not None and sensor.has_changed is not had_changed:
                self.log('warning' if sensor.has_changed else 'info', status(sensor.drift))
            if change.doubted:
                self.log('warning', f'{counted(change.doubted, "pose")} taken while the sensor '
                         'moved or vibrated, as by motors: later rests are quieter; a fit leaves '
                         'out such poses if the others are sufficient')
            for rest in change.refused:
                if 2.0 * (rest.end - rest.start) > self.state.settings.min_dwell and (
                        next_step(self.state).kind == 'poses'):
                    self.log('info', f'this rest gave no pose: {rest.words}', rest.reason, AGAIN)
            if change.poses:
                new, guide = change.rest, self.sensor.guide
                new = new if new is not None and new.start > guide.rest else None
                if new is not None:
                    self.change_sensor(guide=replace(guide, rest=new.start))
                poses_changed(self, ended=bool(change.ended), new_rest=new)
        self._report_still()

    def _report_still(self) -> None:
        # Without messages, or without a clock, nobody knows whether the sensor rests.
        blind = max(self.state.statistics.age, self.state.statistics.stopped) > SILENT
        if (self.sensor.live.still and not blind) is not self.state.still:
            since = self.state.statistics.stamp - self.state.settings.still_window
            self.change(still=not self.state.still, still_since=since)
            self.events.append(Still(self.state.still))

    # The sensor and its files

    def _show_frame(self) -> None:
        """Show the mounting in the frames, which have changed."""
        frame_id, settings = self.state.frame_id, self.state.settings
        if frame_id and settings.rotate and frame_id == settings.output_frame_id:
            self.log('warning', f'output_frame_id is {frame_id!r}, the frame of the sensor: TF '
                     'turns levelled messages twice; choose another output_frame_id, or set '
                     'rotate to false')
        show_mounting(self)

    def _begin(self, run: Callable[[Task], object]) -> bool:
        """
        Begin with a new sensor: lock its files, and let `run` load them.

        Returns whether no other node uses them.

        """
        self.change(sensor=new_sensor(self.state.settings, self.state.units), not_stored='')
        self._find_store()
        files = self.state.files
        self.change(problem=files.problem)
        self.log('error', files.problem)
        if files.store is not None and files.lock is not None:
            run(open_files(self, files.store, self.sensor))
        return files.lock is not None

    def _find_store(self) -> None:
        """Go on with the files of the sensor, locked unless another node uses them."""
        state, before = self.state, self.state.files
        store = store_of(state.settings, state.name, state.topic, state.own)
        files = replace(before, store=store)
        if before.path != files.path:
            before.release()
            files = SensorFiles(store)
        self.change(files=files.take())

    def set_mounting(self, rotation: Floats) -> None:
        """Use a mounting ΔR that is known from elsewhere, (3, 3)."""
        if self.state.given is not None and np.allclose(self.state.given, rotation):
            return
        self.change(given=rotation)
        self.log('info', mounting_words(rotation, self.state.frame_id or '',
                                        self.state.settings.base_frame))
        if self.sensor.calibration is not None:
            adopt(self, self.sensor.calibration, self.sensor.refinement)
