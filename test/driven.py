# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A session without threads, and a person who does what it says."""

from collections.abc import Generator
from contextlib import suppress
import math
from typing import Any

from accel_calib.errors import AccelCalibError
from accel_calib.session import (
    answered, CalibratorSettings, columns_of, diagnostics, Log, next_step, progress, Result, run,
    Session, Task)
import numpy as np
import pytest

GRAVITY = 9.80665
RATE = 50.0


class Driver:
    """A session whose jobs are done at once, with its own clock and a stored log."""

    def __init__(self, topic: str = '/imu/data_raw', **parameters: Any) -> None:
        self.now = 0.0
        self.stamp = 1000.0
        self.pace = 1.0  # of the stamps
        self.log: list[Log] = []
        self.results: list[str] = []
        self.session = Session(CalibratorSettings(**parameters), topic, lambda: self.now)
        self.handle()

    def handle(self) -> None:
        while self.session.events:
            event = self.session.events.popleft()
            if isinstance(event, Generator):
                self.end(self.done(event))
            elif isinstance(event, Log):
                self.log.append(event)
            elif isinstance(event, Result):
                self.results.append(event.text)

    def end(self, answer: str) -> None:
        """Log the answer of a command that nobody asked for."""
        self.log += [Log('info', answer)] if answer else []

    def done(self, task: Task) -> str:
        """Return the answer of a command."""
        answer: str = answered(task, self.handle)
        self.handle()
        return answer

    def ask(self, name: str) -> str:
        """Return the answer of a command."""
        return self.done(run(self.session, name))

    def refuses(self, words: str, *names: str) -> None:
        """Check that commands are refused with these words, a regular expression."""
        for name in names:
            with pytest.raises(AccelCalibError, match=words):
                self.ask(name)

    def tick(self, seconds: float = 0.0) -> None:
        """Let time pass, and check the stream."""
        self.now += seconds
        self.session.tick()
        self.handle()

    @property
    def sensor(self) -> Any:
        return self.session.sensor

    @property
    def calibration(self) -> Any:
        return self.session.sensor.calibration

    @property
    def poses(self) -> Any:
        return self.session.sensor.live.poses()

    def feed(self, readings: Any, frame_id: str = 'imu_link', rate: float = np.nan,
             **context: float) -> int:
        """
        Push readings [m/s²] with their context, and return the number of accepted messages.

        The `rate` [rad/s] is that about each axis.

        """
        accepted, columns = 0, columns_of(self.session.state.settings)
        for column, value in context.items():
            self.session.state.around.take(column, value)
        for block in np.array_split(np.asarray(readings), max(1, len(readings) // 15)):
            self.now += len(block) / RATE
            if self.session.accepts(frame_id):
                rows = np.full((len(block), 7 + len(columns)), np.nan)
                rows[:, 0] = self.stamp + self.pace * np.arange(len(block)) / RATE
                rows[:, 1:4], rows[:, 4:7] = block, rate
                rows[:, 7:] = [context.get(column, np.nan) for column in columns]
                self.session.push(rows, self.now)
                accepted += len(block)
            self.stamp += self.pace * len(block) / RATE
            self.handle()
        return accepted

    def logged(self, severity: str = 'error') -> str:
        return '\n'.join(line.words for line in self.log if line.severity == severity)

    def finding(self, name: str) -> Any:
        return next(each for each in diagnostics(self.session.state) if each.concern == name)


class Person:
    """
    Somebody who does what the progress says, and nothing else.

    `sensor` returns the reading [g] of a direction of up at a temperature, and `warming` is the
    rise of the temperature by rest [°C]. `flat` is the direction of up with the robot level, and
    `can_reach` whether the robot can be turned so that a direction points up. `shaken` is the
    vibration after the first rest [g].

    """

    def __init__(self, driver: Driver, sensor: Any, *, warming: float = 0.0,
                 flat: Any = (0.0, 0.0, 1.0), can_reach: Any = lambda up: True,
                 shaken: float = 0.0) -> None:
        self.driver, self.sensor, self.warming, self.flat = driver, sensor, warming, flat
        self.can_reach, self.shaken = can_reach, shaken
        self.temperature, self.steps, self.called = 25.0, [], []
        self.times: list[float] = []
        self._up, self._rng = np.array(flat, float), np.random.default_rng(5)

    def rest(self, up: Any, seconds: float = 2.0) -> None:
        """Turn the sensor, and hold it still."""
        count = int(seconds * RATE)
        way = np.linspace(self._up + 1e-3, np.asarray(up, float), 20)
        turning = way / np.linalg.norm(way, axis=1)[:, np.newaxis]
        turning = turning + 0.05 * self._rng.normal(size=(20, 3))
        held = np.repeat([np.asarray(up, float)], count, axis=0)
        reading = np.array([self.sensor(each, self.temperature)
                            for each in np.concatenate([turning, held])])
        shaken = self.shaken if self.steps else 0.0
        reading += max(shaken, 0.0005) * self._rng.normal(size=reading.shape)
        self.driver.feed(reading * GRAVITY, temperature=self.temperature)
        self._up = np.asarray(up, float)
        self.temperature += self.warming

    def nearest(self, up: Any) -> Any:
        """Return the direction on the way to another one that the robot can reach."""
        up = np.array(up) + 1e-3  # no way leads through zero
        way = (self.flat + share * (up - self.flat) for share in np.linspace(1.0, 0.0, 41))
        return next(each / np.linalg.norm(each) for each in way
                    if self.can_reach(each / np.linalg.norm(each)))

    def follow(self, most: int = 80, seconds: float = math.inf) -> str:
        """Do one step after the other; return the kind of the last one, at most so many later."""
        self.rest(self.flat)
        end = self.driver.now + seconds
        for _ in range(most):
            if self.driver.now > end:
                break
            present = self.driver.session.state
            now, action = progress(present), next_step(present)
            assert (now.step, now.advice, now.command) == (
                action.kind, action.text, action.command)
            self.steps.append(action.kind)
            self.times.append(self.driver.now)
            if action.kind == 'done':
                break
            if now.direction and self.can_reach(np.array(now.direction)):
                self.rest(now.direction)
            elif now.direction and not action.command:  # what it can do
                self.rest(self.nearest(now.direction), 3.0)
            elif action.command:
                if action.kind == 'level':
                    self.rest(self.flat, 4.0)
                self.called.append(action.command)
                with suppress(AccelCalibError):
                    self.driver.ask(action.command)
            else:
                self.rest(self._up)
        return self.steps[-1]
