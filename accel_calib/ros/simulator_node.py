# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The simulator node: it publishes an Imu that turns through poses, and its temperature.

A timer publishes the samples that are due, with stamps at intervals of exactly 1/rate. The
acceleration is in m/s². ``~/truth`` is the specific force of the robot, without effects, noise and
mounting. ``~/next`` turns the sensor to the next pose, and ``~/flat`` puts the robot flat. With
``dwell:=0`` the sensor stays in each pose until one of them is called, as a person waits who holds
it.

"""

from dataclasses import dataclass
from itertools import cycle
import math
import time

from geometry_msgs.msg import Vector3, Vector3Stamped
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .declare import declared, STREAM
from ..effects import (
    context_of_samples, entry_of, model_with, parse_effect, predict, thermal_stream, turn_between)
from ..errors import InputError
from ..geometry import rotation_from_rpy, spread_directions
from ..session import parameter
from ..table import Floats, numbered, Recording
from ..units import STANDARD_GRAVITY

_FLAT = np.array([0.0, 0.0, 1.0])
_KNOWN = frozenset({'time', 'temperature', 'rate', 'std'})
"""Columns of the context that the simulator has."""

_TEMPERATURE_EVERY = 0.1
"""Interval between temperature messages [s]."""

_GOLDEN = 0.618
"""Stride between poses in mixed order, relative to their number: about the golden ratio."""

_LONGEST_TICK = 0.005
"""Longest interval between checks of the clock [s]."""


@dataclass(frozen=True)
class SimulatorSettings:
    """Parameters of the simulator."""

    frame_id: str = parameter('imu', 'frame_id of the messages')
    rate: float = parameter(200.0, 'Messages per second [Hz]', limits=(1.0, 10000.0))
    poses: int = parameter(12, 'Number of poses, spread evenly over the sphere', limits=(1, 1000))
    dwell: float = parameter(
        3.0, 'Duration of each pose [s]. 0: until ~/next or ~/flat is called',
        limits=(0.0, 3600.0))
    mixed: bool = parameter(
        False, 'Take the poses in mixed order, so that direction is not correlated with time or '
        'temperature')
    turn: float = parameter(1.0, 'Duration of each turn between poses [s]', limits=(0.01, 3600.0))
    wait: float = parameter(
        0.0, 'Longest time to wait for subscribers before the first pose [s]. 0: start at once',
        limits=(0.0, 3600.0))
    listeners: int = parameter(1, 'Number of subscribers to wait for', limits=(1, 100))
    loop: bool = parameter(False, 'Start again after the last pose')
    hold: bool = parameter(True, 'Stay in the last pose; otherwise the node ends after it')
    flat_first: bool = parameter(False, 'Add a flat pose (z of the robot up) before the poses')
    flat_last: bool = parameter(True, 'Add a flat pose (z of the robot up) after the poses')
    mounting: list[float] = parameter(
        [0.0, 0.0, 0.0], 'Roll, pitch and yaw of the sensor on the robot [°]')
    effects: list[str] = parameter(
        [''], "Effects of the sensor, such as 'offset=0.1,-0.2,0.3' in the units of the catalogue "
        '(g)')
    noise: float = parameter(0.02, 'Standard deviation of an acceleration sample [m/s²]',
                             limits=(0.0, 10.0))
    gyro_noise: float = parameter(0.002, 'Standard deviation of an angular rate sample [rad/s]',
                                  limits=(0.0, 10.0))
    gravity: float = parameter(STANDARD_GRAVITY, 'Local gravity [m/s²]', limits=(1.0, 30.0))
    temperature: list[float] = parameter(
        [25.0, 25.0], 'Temperature of the first and of the last sample [°C]')
    temperature_period: float = parameter(
        0.0, 'Period in which the temperature swings between both values of temperature [s]. 0: '
        'it changes evenly from the first to the last', limits=(0.0, 86400.0))
    seed: int = parameter(1, 'Seed of the noise', limits=(0, 2 ** 31 - 1))


class SimulatedImu:
    """
    The samples of a sensor that is turned through poses, `next_pose` of them so far.

    InputError if an effect is not in the catalogue.

    """

    def __init__(self, settings: SimulatorSettings) -> None:
        # The attitude transforms from sensor to robot axes, ΔR from robot to sensor axes.
        rotation = rotation_from_rpy(*(math.radians(angle) for angle in settings.mounting)).T
        self._settings = settings
        self._model = model_with(
            dict(parse_effect(text) for text in settings.effects if text), rotation)
        self._thermal = thermal_stream(self._model)
        without = [str(each) for each in self._model.effects
                   if not _KNOWN.issuperset(entry_of(each).needs)]
        if without:
            raise InputError(f'the node does not simulate {" and ".join(without)}',
                             'leave it out, or use accel-calib simulate')
        self._rng = np.random.default_rng(settings.seed)
        count, spread = settings.poses, spread_directions(settings.poses)
        if settings.mixed:  # in an order of which every part is spread over the sphere
            stride = next(step for step in range(round(_GOLDEN * count), 2 * count + 1)
                          if math.gcd(step, count) == 1)
            spread = spread[np.arange(count) * stride % count]
        self.directions = np.vstack([
            *[_FLAT] * settings.flat_first, spread, *[_FLAT] * settings.flat_last])
        self._coming = cycle(self.directions) if settings.loop else iter(self.directions)
        self._up = next(self._coming)
        self.next_pose = 1
        self._resting = round(settings.dwell * settings.rate)
        self._path = self._rest(max(1, self._resting))
        self._sent = 0

    @property
    def duration(self) -> float:
        """Time for all poses once [s]."""
        settings, count = self._settings, len(self.directions)
        return count * settings.dwell + (count - 1) * settings.turn

    def turn_to(self, up: Floats) -> None:
        """Let the sensor turn to a direction now; what was to come before is left out."""
        self._up, self._path = self._path[0, :3] if len(self._path) else self._up, self._path[:0]
        self._append(up)

    def advance(self) -> Floats | None:
        """Return the direction of the next pose, which is then one of those so far; None: over."""
        up = next(self._coming, None)
        self.next_pose += up is not None
        return up

    def samples(self, count: int) -> Recording:
        """Return the next samples [g], at most this number; none after the end."""
        settings = self._settings
        while (lacking := count - len(self._path)) > 0:
            up = self.advance() if self._resting else None
            if up is not None:
                self._append(up)
            elif settings.hold or not self._resting:
                self._path = np.concatenate([self._path, self._rest(lacking)])
            else:
                break
        path, self._path = self._path[:count], self._path[count:]
        force, rate = path[:, :3], path[:, 3:]
        time = (self._sent + np.arange(len(path))) / settings.rate
        self._sent += len(path)
        first, last = settings.temperature
        swing = 0.5 - 0.5 * np.cos(2.0 * np.pi * time / (settings.temperature_period or np.inf))
        noise_g = settings.noise / settings.gravity
        known = {'time': time, 'temperature': first + (last - first) * (
            swing if settings.temperature_period else np.interp(time, [0.0, self.duration], [
                0.0, 1.0])), 'rate': rate @ self._model.rotation.T}
        context = {**context_of_samples(known, len(path), self._model, self._thermal),
                   'std': np.full_like(force, noise_g)}
        rng = self._rng
        columns = {
            **known, 'reference': force,
            'reading': predict(self._model, force, context) + rng.normal(
                size=force.shape) * noise_g,
            'rate': known['rate'] + rng.normal(size=force.shape) * settings.gyro_noise}
        return Recording(columns, numbered(columns))

    def _append(self, up: Floats) -> None:
        """Append the turn to a direction, and the rest there."""
        turning = max(1, round(self._settings.turn * self._settings.rate))
        force, rate = turn_between(self._up, up, self._settings.turn, turning)
        self._up = up
        self._path = np.concatenate([self._path, np.hstack([force, rate]),
                                     self._rest(self._resting)])

    def _rest(self, count: int) -> Floats:
        """Return force and rate of a rest, (count, 6)."""
        return np.tile(np.append(self._up, np.zeros(3)), (count, 1))


class SimulatorNode(Node):
    """Publish the readings of a simulated sensor."""

    def __init__(self) -> None:
        super().__init__('simulator')
        self.settings = declared(self, SimulatorSettings)
        self._simulated = SimulatedImu(self.settings)
        self._imu = self.create_publisher(Imu, 'imu/data_raw', STREAM)
        self._temperature = self.create_publisher(Temperature, 'temperature', STREAM)
        self._truth = self.create_publisher(Vector3Stamped, '~/truth', STREAM)
        self.create_service(Trigger, '~/next', self._on_next)
        self.create_service(Trigger, '~/flat', self._on_flat)
        self._message = Imu()  # with the fields that do not change
        self._message.orientation_covariance[0] = -1.0
        self._message.angular_velocity_covariance = (
            np.eye(3) * self.settings.gyro_noise ** 2).ravel()
        self._message.linear_acceleration_covariance = (
            np.eye(3) * self.settings.noise ** 2).ravel()
        self._sent = 0
        self._began = Time()
        self._began_steady = 0.0

    def start(self) -> None:
        """Start; to be called when the node has an executor."""
        self._patience_ends = time.monotonic() + self.settings.wait
        self.create_timer(min(1.0 / self.settings.rate, _LONGEST_TICK), self._on_tick,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_next(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        up = self._simulated.advance()
        if up is not None:
            self._simulated.turn_to(up)
        response.success = up is not None
        response.message = (
            f'turning to pose {self._simulated.next_pose}' if response.success else
            f'all {self.settings.poses} poses are taken, expected another one: restart the '
            'simulator, or set loop to true')
        return response

    def _on_flat(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._simulated.turn_to(_FLAT)
        response.success, response.message = True, 'turning until z of the robot points up'
        return response

    def _on_tick(self) -> None:
        now = time.monotonic()
        if self._sent == 0:
            listeners = self._imu.get_subscription_count()
            if now < self._patience_ends and listeners < self.settings.listeners:
                return
            self._began, self._began_steady = self.get_clock().now(), now
        due = int((now - self._began_steady) * self.settings.rate) + 1
        samples, gravity = self._simulated.samples(due - self._sent), self.settings.gravity
        for row in range(len(samples)):
            after_start = round(self._sent / self.settings.rate * 1e9)
            stamp = Time(nanoseconds=self._began.nanoseconds + after_start).to_msg()
            header, message = Header(stamp=stamp, frame_id=self.settings.frame_id), self._message
            message.header = header
            message.linear_acceleration = vector3(samples.reading[row] * gravity)
            message.angular_velocity = vector3(samples['rate'][row])
            self._imu.publish(message)
            self._truth.publish(Vector3Stamped(
                header=header, vector=vector3(samples['reference'][row] * gravity)))
            if self._sent % max(1, round(_TEMPERATURE_EVERY * self.settings.rate)) == 0:
                self._temperature.publish(Temperature(
                    header=header, temperature=float(samples['temperature'][row])))
            self._sent += 1
        if self._sent < due:
            self.context.try_shutdown()

    def close(self) -> None:
        """Do nothing, because there is nothing to finish."""


def vector3(numbers: Floats) -> Vector3:
    """Return a (3,) array as a message."""
    return Vector3(**dict(zip('xyz', numbers.tolist())))
