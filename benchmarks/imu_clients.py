# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The processes around the node: a driver, a user, and bare relays for comparison.

The driver stamps each message with the monotonic clock and records the stamps; the user records
stamp and arrival. Both write their records as arrays at the end of standard input. All are as
cheap as rclpy allows: serialized messages under EventsExecutor. They have the qualities of service
of the node, so that only the work differs.

"""

from __future__ import annotations

import argparse
from array import array
import itertools
from pathlib import Path
import struct
import sys
import threading
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.task import Future
from sensor_msgs.msg import Imu, Temperature

SENSOR = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
USER = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)

STILL, TURNING, GRAVITY = 4.0, 1.0, 9.80665
VARIANTS = 512
NANO = 1_000_000_000


def messages(turning: bool, rng: np.random.Generator) -> list[bytearray]:
    """Return messages of a sensor at rest in a random attitude, or turning."""
    direction = rng.normal(size=3)
    direction *= GRAVITY / np.linalg.norm(direction)
    noise, gyro = (3.0, 1.0) if turning else (0.02, 0.002)
    made = []
    for _ in range(VARIANTS):
        message = Imu()
        message.header.frame_id = 'imu_link'
        message.orientation_covariance[0] = -1.0
        message.angular_velocity_covariance = (np.eye(3) * gyro**2).ravel()
        message.linear_acceleration_covariance = (np.eye(3) * 0.02**2).ravel()
        reading, rate = direction + rng.normal(size=3) * noise, rng.normal(size=3) * gyro
        for axis, force, omega in zip('xyz', reading, rate):
            setattr(message.linear_acceleration, axis, float(force))
            setattr(message.angular_velocity, axis, float(omega))
        made.append(bytearray(serialize_message(message)))
    return made


def ended() -> Any:
    """Return a function that returns whether standard input has ended."""
    over = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        over.set()

    threading.Thread(target=wait, daemon=True).start()
    return over.is_set


def drive(rate: float, file: Path) -> None:
    """Publish messages at a rate [1/s]; 0: without a pause."""
    node = Node('driver')
    imu = node.create_publisher(Imu, 'imu/data_raw', STREAM)
    temperature = node.create_publisher(Temperature, 'temperature', STREAM)
    rng = np.random.default_rng(1)
    stretches = [(messages(turning, rng), TURNING if turning else STILL)
                 for _ in range(12) for turning in (False, True)]
    stamp = struct.Struct('<iI').pack_into
    over, sent = ended(), array('q')
    warm_every = max(1, int((rate or 1e4) / 10.0))
    period, due, now = NANO / (rate or np.inf), float(time.monotonic_ns()), 0
    for made, seconds in itertools.cycle(stretches):
        until = time.monotonic_ns() + seconds * NANO
        while now < until and not over():
            due += period
            wait = due - time.monotonic_ns() if rate else 0.0
            if wait > 0.0:
                time.sleep(wait / NANO)
            now = time.monotonic_ns()
            data = made[len(sent) % VARIANTS]
            stamp(data, 4, now // NANO, now % NANO)
            imu.publish(bytes(data))
            sent.append(now)
            if len(sent) == 1:
                print(now, flush=True)
            if len(sent) % warm_every == 0:
                temperature.publish(Temperature(temperature=25.0 + rng.uniform(-5.0, 5.0)))
        if over():
            break
    np.save(file, np.array(sent))


def listen(file: Path) -> None:
    """Record stamp and arrival of the calibrated messages."""
    node = Node('user')
    heard: list[bytes] = []
    came = array('q')

    def on_imu(data: bytes) -> None:
        came.append(time.monotonic_ns())
        heard.append(data[4:12])

    node.create_subscription(Imu, 'imu/data_calibrated', on_imu, USER, raw=True)
    executor, over, printed = EventsExecutor(), ended(), False
    executor.add_node(node)
    while not over():
        executor.spin_until_future_complete(Future(), timeout_sec=0.05)
        if heard and not printed:
            print(came[0], flush=True)
            printed = True
    stamps = np.frombuffer(b''.join(heard), '<i4,<u4')
    np.save(file, np.column_stack([stamps['f0'].astype(np.int64) * NANO + stamps['f1'],
                                   np.array(came[:len(heard)])]))
    executor.shutdown()


def relay(kind: str) -> None:
    """Publish each message unchanged; a sink drops it."""
    node = Node('relay')
    out = node.create_publisher(Imu, 'imu/data_calibrated', STREAM)
    callback = out.publish if kind != 'sink' else lambda data: None
    executor = SingleThreadedExecutor() if kind == 'typed' else EventsExecutor()
    node.create_subscription(Imu, 'imu/data_raw', callback, SENSOR, raw=kind != 'typed')
    executor.add_node(node)
    over = ended()
    while not over():
        executor.spin_until_future_complete(Future(), timeout_sec=0.25)
    executor.shutdown()


def main() -> int:
    """Run the process that the first argument names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('what', choices=['drive', 'listen', 'serialized', 'typed', 'sink'])
    parser.add_argument('--rate', type=float, default=1000.0)
    parser.add_argument('--file', type=Path)
    parser.add_argument('--namespace', default='/')
    given = parser.parse_args()
    rclpy.init(args=['--ros-args', '-r', f'__ns:={given.namespace}'])
    if given.what == 'drive':
        drive(given.rate, given.file)
    elif given.what == 'listen':
        listen(given.file)
    else:
        relay(given.what)
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
