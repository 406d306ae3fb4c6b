# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The simulator node: it publishes an Imu that turns through poses, and its temperature.

`accel_calib.simulate` simulates all samples before the first message. A timer then publishes the
samples that are due, with stamps at intervals of exactly 1/rate. The acceleration is in m/s².
``~/truth`` is the specific force of the robot, without effects, noise and mounting.

"""

from __future__ import annotations

from dataclasses import dataclass
import math
import time

from geometry_msgs.msg import Vector3, Vector3Stamped
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Header

from . import qos
from .declare import declared
from ..calibrate.mounting import mounting_of
from ..model import predict
from ..session.settings import parameter
from ..simulate import model_with, parse_effect, simulate_recording
from ..sphere import spread_directions
from ..table import Floats, Recording
from ..units import STANDARD_GRAVITY

_FLAT = np.array([[0.0, 0.0, 1.0]])
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
    dwell: float = parameter(3.0, 'Duration of each pose [s]', limits=(0.01, 3600.0))
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


class SimulatorNode(Node):
    """Publish the readings of a simulated sensor."""

    def __init__(self) -> None:
        super().__init__('simulator')
        self.settings = declared(self, SimulatorSettings)
        self._recording = recording_of(self.settings)
        self._imu = self.create_publisher(Imu, 'imu/data_raw', qos.STREAM)
        self._temperature = self.create_publisher(Temperature, 'temperature', qos.STREAM)
        self._truth = self.create_publisher(Vector3Stamped, '~/truth', qos.STREAM)
        self._message = _empty_message(self.settings)
        self._sent = 0
        self._began = Time()
        self._began_steady = 0.0

    def start(self) -> None:
        """Start; to be called when the node has an executor."""
        self._patience_ends = time.monotonic() + self.settings.wait
        self.create_timer(min(1.0 / self.settings.rate, _LONGEST_TICK), self._on_tick,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_tick(self) -> None:
        """Publish the samples that are due."""
        now = time.monotonic()
        if self._sent == 0:
            listeners = self._imu.get_subscription_count()
            if now < self._patience_ends and listeners < self.settings.listeners:
                return
            self._began, self._began_steady = self.get_clock().now(), now
        due = int((now - self._began_steady) * self.settings.rate) + 1
        while self._sent < due:
            row = self._row(self._sent)
            if row is None:
                self.context.try_shutdown()
                return
            self._send(row)
            self._sent += 1

    def _row(self, number: int) -> int | None:
        """Return the row of the n-th sample, or None after the last sample."""
        count = len(self._recording)
        if number < count or self.settings.loop:
            return number % count
        resting = max(1, round(self.settings.dwell * self.settings.rate))
        return count - resting + (number - count) % resting if self.settings.hold else None

    def _send(self, row: int) -> None:
        after_start = round(self._sent / self.settings.rate * 1e9)
        stamp = Time(nanoseconds=self._began.nanoseconds + after_start).to_msg()
        header = Header(stamp=stamp, frame_id=self.settings.frame_id)
        gravity, recording, message = self.settings.gravity, self._recording, self._message
        message.header = header
        message.linear_acceleration = vector3(recording.reading[row] * gravity)
        message.angular_velocity = vector3(recording['rate'][row])
        self._imu.publish(message)
        self._truth.publish(Vector3Stamped(
            header=header, vector=vector3(recording['reference'][row] * gravity)))
        if self._sent % max(1, round(_TEMPERATURE_EVERY * self.settings.rate)) == 0:
            self._temperature.publish(Temperature(
                header=header, temperature=float(recording['temperature'][row])))

    def close(self) -> None:
        """Do nothing, because there is nothing to finish."""


def recording_of(settings: SimulatorSettings) -> Recording:
    """
    Return all simulated samples.

    Returns
    -------
    Recording
        The samples, in g.

    Raises
    ------
    InputError
        If an effect is not in the catalogue.

    """
    # The attitude transforms from sensor to robot axes, ΔR from robot to sensor axes.
    rotation = mounting_of([math.radians(angle) for angle in settings.mounting])
    model = model_with(dict(parse_effect(text) for text in settings.effects if text), rotation)
    flat = [_FLAT] * settings.flat_first, [_FLAT] * settings.flat_last
    spread = spread_directions(settings.poses)
    directions = np.concatenate([*flat[0], _mixed(spread) if settings.mixed else spread, *flat[1]])
    ideal = simulate_recording(
        model_with({}, rotation), directions, np.random.default_rng(settings.seed),
        noise_g=settings.noise / settings.gravity, rate_hz=settings.rate, dwell=settings.dwell,
        turn=settings.turn, gyro_noise=settings.gyro_noise)
    noise = ideal.reading - ideal['reference'] @ rotation.T
    known = {**ideal.columns, 'temperature': _temperatures(settings, ideal['time']),
             'std': np.full_like(noise, settings.noise / settings.gravity)}
    reading = predict(model, ideal['reference'], known) + noise
    return ideal.with_columns(reading=reading, temperature=known['temperature'])


def _mixed(directions: Floats) -> Floats:
    """Return directions in an order of which every part is spread over the sphere."""
    count = len(directions)
    stride = next(step for step in range(round(_GOLDEN * count), 2 * count + 1)
                  if math.gcd(step, count) == 1)
    return directions[np.arange(count) * stride % count]


def _temperatures(settings: SimulatorSettings, time: Floats) -> Floats:
    """Return the temperature at each sample, which starts at the first value."""
    first, last = settings.temperature
    if not settings.temperature_period:
        return np.linspace(first, last, len(time))
    return first + (last - first) * (0.5 - 0.5 * np.cos(
        2.0 * np.pi * time / settings.temperature_period))


def _empty_message(settings: SimulatorSettings) -> Imu:
    """Return a message with the fields that do not change."""
    message = Imu()
    message.orientation_covariance[0] = -1.0
    message.angular_velocity_covariance = (np.eye(3) * settings.gyro_noise ** 2).ravel()
    message.linear_acceleration_covariance = (np.eye(3) * settings.noise ** 2).ravel()
    return message


def vector3(numbers: Floats) -> Vector3:
    """Return a (3,) array as a message."""
    return Vector3(x=float(numbers[0]), y=float(numbers[1]), z=float(numbers[2]))
