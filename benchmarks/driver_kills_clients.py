# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The processes around the node while processes are killed: a driver and a listener.

They count in memory that they share with the benchmark, because a killed process cannot write its
records. Each message has the number of its trial, and its own number in it, where the orientation
would be; the sensor has no orientation.

"""

from __future__ import annotations

import faulthandler
import os
from pathlib import Path
import struct
import time
from typing import Any

from diagnostic_msgs.srv import SelfTest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu

STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
NANO = 1_000_000_000

_STAMP, _NUMBERS = struct.Struct('<iI'), struct.Struct('<dd')
_STAMP_AT, _NUMBERS_AT = 4, -296
"""Place of the stamp and of the orientation in a serialized Imu [bytes]."""


def _begin(folder: Path, environment: dict[str, str]) -> None:
    """Work in a folder, where a crash leaves a core and the Python stack."""
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    faulthandler.enable((folder / 'faults.log').open('a'))


def drive(folder: Path, environment: dict[str, str], trial: Any, sent: Any, rate: float) -> None:
    """Publish a sensor at rest at a rate [1/s] until the process is killed."""
    _begin(folder, environment)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    publisher = Node('driver').create_publisher(Imu, 'imu/data_raw', STREAM)
    message = Imu()
    message.header.frame_id = 'imu_link'
    message.orientation_covariance[0] = -1.0
    message.linear_acceleration.z = 9.81
    data = bytearray(serialize_message(message))
    began, count = time.monotonic_ns(), 0
    while True:
        wait = began + count * NANO / rate - time.monotonic_ns()
        if wait > 0.0:
            time.sleep(wait / NANO)
        count += 1
        now, number = time.monotonic_ns(), trial.value
        _STAMP.pack_into(data, _STAMP_AT, now // NANO, now % NANO)
        sent[number] += 1
        _NUMBERS.pack_into(data, len(data) + _NUMBERS_AT, number, sent[number])
        publisher.publish(bytes(data))


class _Listener:
    """A user of the calibrated messages and of the self-test."""

    def __init__(self, heard: Any, first: Any) -> None:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = Node('listener')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._client = node.create_client(SelfTest, 'calibrator/self_test')
        self._heard, self._first = heard, first
        node.create_subscription(Imu, 'imu/data_calibrated', self._on_imu, STREAM, raw=True)

    def _on_imu(self, data: bytes) -> None:
        trial, number = map(int, _NUMBERS.unpack_from(data, len(data) + _NUMBERS_AT))
        self._first[trial] = self._first[trial] or number
        self._heard[trial] += 1

    def spin(self) -> None:
        """Take what has arrived."""
        self._executor.spin_once(timeout_sec=0.02)

    def ask(self) -> Any:
        """Call the self-test, and return its future; None without a calibrator."""
        if not self._client.service_is_ready():
            return None
        return self._client.call_async(SelfTest.Request())


def listen(folder: Path, environment: dict[str, str], heard: Any, first: Any, asked: Any,
           answered: Any) -> None:
    """
    Count the calibrated messages of each trial until the process is killed.

    The self-test is called when `asked` changes, again every 5 s until it answers.

    """
    _begin(folder, environment)
    listener = _Listener(heard, first)
    future, called = None, 0.0
    while True:
        listener.spin()
        if answered.value != asked.value:
            if future is not None and future.done():
                answered.value, future = asked.value, None
            elif future is None or time.monotonic() - called > 5.0:
                future, called = listener.ask(), time.monotonic()
