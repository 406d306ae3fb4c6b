# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Bags for `recordings`: an Imu at 1 kHz that is turned through 36 poses, with other topics."""

from __future__ import annotations

from pathlib import Path

from accel_calib.simulate import model_with, simulate_recording
from accel_calib.sphere import spread_directions
from accel_calib.units import units_of
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

RATE_HZ = 1000
_POSES = 36
_RATE, _FORCE = slice(-192, -168), slice(-96, -72)  # of a serialized Imu
_EFFECTS = {'offset': np.array([0.02, -0.03, 0.01]), 'axis_gain': np.array([0.01, -0.02, 0.015]),
            'cross_axis': np.array([0.004, -0.002, 0.003])}


def serialized(count: int, seed: int) -> NDArray[np.uint8]:
    """Give so many serialized Imu messages, one a row."""
    turn = 2.0
    recording = simulate_recording(
        model_with(_EFFECTS), spread_directions(_POSES), np.random.default_rng(seed),
        rate_hz=RATE_HZ, turn=turn, dwell=(count / RATE_HZ + turn) / _POSES - turn)
    count = min(count, len(recording))
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    vector, zero = types['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0), np.zeros(9)
    message = types['sensor_msgs/msg/Imu'](
        types['std_msgs/msg/Header'](types['builtin_interfaces/msg/Time'](0, 0), 'imu_link'),
        types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0), zero, vector, zero, vector,
        zero)
    one = np.frombuffer(store.serialize_cdr(message, 'sensor_msgs/msg/Imu'), np.uint8)
    rows = np.tile(one, (count, 1))
    number = np.arange(count)
    stamps = np.column_stack([number // RATE_HZ, number % RATE_HZ * (10 ** 9 // RATE_HZ)])
    rows[:, 4:12] = stamps.astype('<u4').view(np.uint8)
    rows[:, _RATE] = np.ascontiguousarray(recording['rate'][:count]).view(np.uint8)
    force = units_of('m/s2').from_g(recording.reading[:count])
    rows[:, _FORCE] = np.ascontiguousarray(force).view(np.uint8)
    return rows


def write_bag(path: Path, storage: str, rows: NDArray[np.uint8]) -> Path:
    """Write the messages, and a temperature and a word ten times a second."""
    store = get_typestore(Stores.ROS2_JAZZY)
    header = store.types['std_msgs/msg/Header']
    stamp = store.types['builtin_interfaces/msg/Time']
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        imu, warm, words = (writer.add_connection(*each, typestore=store) for each in (
            ('/imu', 'sensor_msgs/msg/Imu'), ('/temperature', 'sensor_msgs/msg/Temperature'),
            ('/words', 'std_msgs/msg/String')))
        for k, row in enumerate(rows):
            time = k * (10 ** 9 // RATE_HZ)
            writer.write(imu, time, row.tobytes())
            if k % 100 == 0:
                seconds = stamp(k // RATE_HZ, time % 10 ** 9)
                writer.write(warm, time, store.serialize_cdr(store.types[
                    'sensor_msgs/msg/Temperature'](header(seconds, 'imu_link'), 25.0, 0.0),
                    'sensor_msgs/msg/Temperature'))
                writer.write(words, time, store.serialize_cdr(
                    store.types['std_msgs/msg/String'](f'word {k}'), 'std_msgs/msg/String'))
    return path
