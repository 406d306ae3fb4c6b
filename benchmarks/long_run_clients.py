# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The processes around the node in a long run: a driver, a bare relay, and a user of both.

The driver publishes a sensor that is turned through `POSES` poses, again and again. It has effects
of temperature and a non-linear one, so that a refinement finds something. The records are arrays
of a fixed size per message, so that the user does not become slower during the run.

"""

from __future__ import annotations

import argparse
from array import array
from pathlib import Path
import struct
import time

from accel_calib.ros.simulator_node import SimulatedImu, SimulatorSettings
from imu_clients import ended, NANO, relay, STREAM, USER
import numpy as np
import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.task import Future
from sensor_msgs.msg import Imu, Temperature

BARE = 'bare/data_calibrated'
"""Topic of the messages of the bare relay."""

POSES, DWELL, TURN = 40, 2.0, 0.5
CYCLE = POSES * (DWELL + TURN)
"""Time until the poses begin again [s]; the temperature swings in the same time."""

EFFECTS = ['offset=0.03,-0.02,0.04', 'axis_gain=0.012,-0.015,0.008',
           'cross_axis=0.006,-0.004,0.003', 'offset_temperature=0.001,-0.0005,0.0008',
           'quadratic=0.002,-0.001,0.001']

_EACH = 48
"""Size of an acceleration and an angular rate [bytes]."""


def readings(rate: float) -> tuple[bytes, list[float]]:
    """Return the acceleration [m/s²] and angular rate of each sample, and its temperature [°C]."""
    settings = SimulatorSettings(
        rate=rate, poses=POSES, dwell=DWELL, turn=TURN, mixed=True, flat_last=False,
        effects=EFFECTS, temperature=[15.0, 35.0], temperature_period=CYCLE)
    simulated = SimulatedImu(settings)
    made = simulated.samples(round(simulated.duration * rate))
    columns = np.hstack([made.reading * settings.gravity, made['rate']])
    return columns.astype('<f8').tobytes(), made['temperature'].tolist()


def empty() -> bytearray:
    """Return a serialized message with covariances, which make the most work."""
    message = Imu()
    message.header.frame_id = 'imu_link'
    message.orientation_covariance[0] = -1.0
    message.angular_velocity_covariance = (np.eye(3) * 0.002**2).ravel()
    message.linear_acceleration_covariance = (np.eye(3) * 0.02**2).ravel()
    return bytearray(serialize_message(message))


def drive(rate: float, file: Path) -> None:
    """Publish messages at a rate [1/s], and record their stamps."""
    node = Node('driver')
    imu = node.create_publisher(Imu, 'imu/data_raw', STREAM)
    temperature = node.create_publisher(Temperature, 'temperature', STREAM)
    numbers, temperatures = readings(rate)
    data, stamp = empty(), struct.Struct('<iI').pack_into
    over, sent, warm_every = ended(), array('q'), round(rate / 10.0)
    began = time.monotonic_ns()
    while not over():
        wait = began + len(sent) * NANO / rate - time.monotonic_ns()
        if wait > 0.0:
            time.sleep(wait / NANO)
        row = len(sent) % len(temperatures)
        at = row * _EACH
        data[-96:-72] = numbers[at:at + 24]
        data[-192:-168] = numbers[at + 24:at + _EACH]
        now = time.monotonic_ns()
        stamp(data, 4, now // NANO, now % NANO)
        imu.publish(bytes(data))
        sent.append(now)
        if len(sent) == 1:
            print(now, flush=True)
        if len(sent) % warm_every == 0:
            temperature.publish(Temperature(temperature=temperatures[row]))
    np.save(file, np.array(sent))


class Record:
    """Stamps and arrivals of the messages of a topic [ns]."""

    def __init__(self, node: Node, topic: str) -> None:
        self._numbers = array('q')
        self._stamp = struct.Struct('<iI').unpack_from
        node.create_subscription(Imu, topic, self._on_imu, USER, raw=True)

    def _on_imu(self, data: bytes) -> None:
        now = time.monotonic_ns()
        seconds, rest = self._stamp(data, 4)
        self._numbers.append(seconds * NANO + rest)
        self._numbers.append(now)

    @property
    def empty(self) -> bool:
        """Whether no message arrived yet."""
        return not self._numbers

    def table(self) -> np.ndarray:
        """Return one row per message."""
        return np.array(self._numbers).reshape(-1, 2)


def listen(file: Path) -> None:
    """Record the messages of the node and of the bare relay."""
    node = Node('user')
    ours, bare = Record(node, 'imu/data_calibrated'), Record(node, BARE)
    executor, over, printed = EventsExecutor(), ended(), False
    executor.add_node(node)
    while not over():
        executor.spin_until_future_complete(Future(), timeout_sec=0.05)
        if not (printed or ours.empty or bare.empty):
            print(time.monotonic_ns(), flush=True)
            printed = True
    np.savez(file, ours=ours.table(), bare=bare.table())
    executor.shutdown()


def main() -> None:
    """Run the process that the first argument names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('what', choices=['drive', 'listen', 'relay'])
    parser.add_argument('--rate', type=float, default=1000.0)
    parser.add_argument('--file', type=Path)
    given = parser.parse_args()
    rclpy.init(args=['--ros-args', '-r', f'imu/data_calibrated:={BARE}']
               if given.what == 'relay' else [])
    if given.what == 'drive':
        drive(given.rate, given.file)
    elif given.what == 'listen':
        listen(given.file)
    else:
        relay('serialized')
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
