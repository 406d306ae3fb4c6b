# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Mounting from a flat pose, for all frames and orientations, including singular ones."""

from accel_calib.calibrate import flat_direction, FRAMES
from accel_calib.errors import InputError
from inside import mounting, rotation_from_rpy, with_heading, with_heading_of
import numpy as np
import pytest
from shared import random_directions

ATTITUDES = [(0, 0, 0), (90, 0, 0), (-90, 0, 0), (180, 0, 0), (0, 90, 0), (0, -90, 0),
             (0, 180, 0), (0, 0, 90), (20, -30, 40), (90, 90, 90), (179.9, 0.1, 0)]


@pytest.mark.parametrize('frame', FRAMES)
@pytest.mark.parametrize('rpy', ATTITUDES)
def test_flat_pose_is_levelled_by_a_proper_rotation(frame, rpy):
    flat = rotation_from_rpy(*np.radians(rpy)) @ flat_direction(frame) * 9.81
    rotation = mounting(flat, frame)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation.T @ flat / 9.81, flat_direction(frame), atol=1e-12)


@pytest.mark.parametrize('frame', ['ned', 'android', 'ros'])
def test_columns_are_those_of_an5286(frame):
    for x, y, z in random_directions(50, np.random.default_rng(1)) * 2.0:
        rotation, root, size = mounting(np.array([x, y, z]), frame), np.hypot(y, z), 2.0
        np.testing.assert_allclose(rotation[:, 2] * size, (x, y, z))
        np.testing.assert_allclose(rotation[:, 0] * size, (root, -x * y / root, -x * z / root))


@pytest.mark.parametrize(('frame', 'nose_down'), [
    ('ros', (-0.8, 0.0, 0.6)), ('ned', (0.8, 0.0, 0.6)), ('android', (0.0, -0.8, 0.6)),
    ('win8', (0.0, 0.8, -0.6)), ('ros', (-0.6, 0.0, -0.8))])
@pytest.mark.parametrize('rpy', [(170.0, 35.0, -120.0), (0.0, 90.0, 0.0), (90.0, 0.0, 45.0)])
def test_a_pose_with_the_nose_down_fixes_the_heading(rpy, frame, nose_down):
    truth = rotation_from_rpy(*np.radians(rpy))
    levelled = mounting(truth @ flat_direction(frame), frame)
    found = with_heading(levelled, truth @ nose_down, frame)
    np.testing.assert_allclose(found, truth, atol=1e-12)


def test_levelling_again_keeps_the_heading():
    before = rotation_from_rpy(*np.radians((10.0, -20.0, 130.0)))
    tilt = rotation_from_rpy(*np.radians((3.0, 2.0, 0.0)))
    level = mounting(tilt @ before[:, 2])
    found = with_heading_of(before, level)
    np.testing.assert_allclose(found[:, 2], level[:, 2], atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert np.degrees(np.arccos(found[:, 0] @ before[:, 0])) < 4.0
    np.testing.assert_array_equal(with_heading_of(before, mounting(before[:, 0])),
                                  mounting(before[:, 0]))


def test_a_second_pose_that_is_the_first_is_refused():
    with pytest.raises(InputError, match='within 10° of the flat pose'):
        with_heading(np.eye(3), np.array([0, 0.05, 1.0]))


@pytest.mark.parametrize('flat', [(0, 0, 0), (np.nan, 0, 1)])
def test_a_flat_pose_without_gravity_is_refused(flat):
    with pytest.raises(InputError, match='expected about 1 g'):
        mounting(np.array(flat, float))
