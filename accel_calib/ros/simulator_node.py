# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The simulator node: an Imu, and its temperature, that turns through poses.

All samples are made before the first is sent, by `accel_calib.simulate`; a timer sends those that
are due, with stamps exactly 1/rate apart. Acceleration is in m/s². ``~/truth`` has the specific
force of the robot, without any effect, noise or mounting.

"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from geometry_msgs.msg import Vector3Stamped
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Header

from . import qos
from .conversion import vector3
from .declare import declared
from .settings import SimulatorSettings
from ..simulate import model_with, parse_effect, simulate_recording
from ..sphere import rotation_from_rpy, spread_directions

if TYPE_CHECKING:
    from ..table import Recording

_FLAT = np.array([[0.0, 0.0, 1.0]])
_TEMPERATURE_EVERY = 0.1
"""Between messages of temperature [s]."""

_LONGEST_TICK = 0.005
"""Between looks at the clock [s]."""


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
        """Begin, once there is an executor."""
        self._patience_ends = time.monotonic() + self.settings.wait
        self.create_timer(min(1.0 / self.settings.rate, _LONGEST_TICK), self._on_tick,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_tick(self) -> None:
        """Send what is due."""
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
        """Give the row of the n-th sample; None where it is over."""
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
        """Nothing is left to finish."""


def recording_of(settings: SimulatorSettings) -> Recording:
    """
    Make all samples.

    Returns
    -------
    Recording
        In g.

    Raises
    ------
    InputError
        If an effect is not in the catalogue.

    """
    # The URDF of the sensor takes its axes to the robot's, ΔR the robot's to its axes.
    rotation = rotation_from_rpy(*np.radians(settings.mounting)).T
    effects = dict(parse_effect(text) for text in settings.effects if text)
    flat = [_FLAT] * settings.flat_first, [_FLAT] * settings.flat_last
    directions = np.concatenate([*flat[0], spread_directions(settings.poses), *flat[1]])
    return simulate_recording(
        model_with(effects, rotation), directions,
        np.random.default_rng(settings.seed), noise_g=settings.noise / settings.gravity,
        rate_hz=settings.rate, dwell=settings.dwell, turn=settings.turn,
        gyro_noise=settings.gyro_noise, temperatures=settings.temperature)


def _empty_message(settings: SimulatorSettings) -> Imu:
    """Make a message with all that stays the same."""
    message = Imu()
    message.orientation_covariance[0] = -1.0
    message.angular_velocity_covariance = (np.eye(3) * settings.gyro_noise ** 2).ravel()
    message.linear_acceleration_covariance = (np.eye(3) * settings.noise ** 2).ravel()
    return message
