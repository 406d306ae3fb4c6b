# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Static transforms: the tree of frames, and the topic /tf_static."""

import math
import re
from typing import Any

from accel_calib.geometry import StaticTransforms
from builtin_interfaces.msg import Time
from inside import quaternion_of, rotation_from_rpy
from inside_ros import LATCHED, publish_static, static_transform, TF_TOPIC, watch_static
import numpy as np
import pytest

MAST = rotation_from_rpy(0.1, -0.2, 1.3)
IMU = rotation_from_rpy(math.pi, 0.4, -0.7)
LIDAR = rotation_from_rpy(0.0, 0.0, 0.5)
BASE = rotation_from_rpy(0.02, 0.03, 2.0)


def robot() -> StaticTransforms:
    """
    Return the transforms of a robot with a sensor on a mast.

    footprint → base → mast → imu, and base → lidar.

    """
    tree = StaticTransforms()
    for parent, child, rotation in (('mast', 'imu', IMU), ('footprint', 'base', BASE),
                                    ('base', 'lidar', LIDAR), ('base', 'mast', MAST)):
        assert tree.add(parent, child, quaternion_of(rotation))
    return tree


@pytest.mark.parametrize(('base', 'frame', 'expected'), [
    ('base', 'mast', MAST),
    ('base', 'imu', MAST @ IMU),
    ('footprint', 'imu', BASE @ MAST @ IMU),
    ('imu', 'base', (MAST @ IMU).T),
    ('lidar', 'imu', LIDAR.T @ MAST @ IMU),
    ('imu', 'lidar', (MAST @ IMU).T @ LIDAR),
    ('imu', 'imu', np.eye(3)),
])
def test_rotations_are_multiplied_along_the_path(base: str, frame: str, expected: Any) -> None:
    np.testing.assert_allclose(robot().rotation(base, frame), expected, atol=1e-12)


@pytest.mark.parametrize(('parameter', 'value', 'instead'), [
    ('base_frame', 'base', 'mounting_rpy'), ('publish_tf', True, 'publish_tf to false')])
def test_without_tf2_msgs_its_parameters_are_refused(
        without_tf2: None, bench: Any, parameter: str, value: Any, instead: str) -> None:
    node = bench.start('calibrator', **{parameter: value})
    status, printed = bench.end(node)
    assert status == 2
    assert re.search(f'the parameter {parameter}.* ros-jazzy-tf2-msgs, .*{instead}', printed)


def test_late_subscriber_receives_the_transforms_of_all_publishers(
        tf_message: Any, bench: Any) -> None:
    publish_static(bench.node, ('base', 'mast', quaternion_of(MAST)),
                   ('base', 'lidar', quaternion_of(LIDAR)))
    publish_static(bench.node, ('/mast', 'imu', quaternion_of(IMU)))
    changes: list[Any] = []
    tree = watch_static(bench.node, lambda: changes.append(tree.rotation('base', 'imu')))
    bench.spin(lambda: len(changes) == 2)
    np.testing.assert_allclose(changes[-1], MAST @ IMU, atol=1e-12)
    np.testing.assert_allclose(tree.rotation('lidar', 'imu'), LIDAR.T @ MAST @ IMU, atol=1e-12)


def test_invalid_transform_is_logged_and_the_rest_of_its_message_is_used(
        tf_message: Any, bench: Any, capfd: pytest.CaptureFixture[str]) -> None:
    changes: list[int] = []
    tree = watch_static(bench.node, lambda: changes.append(1))
    publish_static(bench.node, ('base', 'mast', (0.0, 0.0, 0.0, 0.0)),
                   ('base', 'imu', quaternion_of(IMU)))
    bench.spin(lambda: changes)
    np.testing.assert_allclose(tree.rotation('base', 'imu'), IMU, atol=1e-12)
    assert tree.rotation('base', 'mast') is None
    assert 'base to mast' in capfd.readouterr().err


def test_repeated_transform_is_no_change(tf_message: Any, bench: Any) -> None:
    changes: list[Any] = []
    tree = watch_static(bench.node, lambda: changes.append(tree.rotation('base', 'imu')))
    publisher = bench.node.create_publisher(tf_message, TF_TOPIC, LATCHED)
    received = bench.listen(tf_message, TF_TOPIC, latched=True)
    for rotation in (IMU, IMU, MAST):
        publisher.publish(static_transform(Time(), 'base', 'imu', rotation))
    bench.spin(lambda: len(received) == 3 and len(changes) >= 2)
    np.testing.assert_allclose(changes, [IMU, MAST], atol=1e-12)
