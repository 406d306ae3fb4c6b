# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The mounting: levelling, heading, and axes that are wired wrongly."""

from accel_calib.calibration import fit_poses, flat_direction
from accel_calib.errors import InputError
from accel_calib.units import FRAMES
from inside import (
    MODELS, mounting, rotation_from_rpy, simulate_poses, spread_directions, with_heading)
import numpy as np
import pytest
from shared import G, random_directions, sensor


@pytest.mark.parametrize('frame', FRAMES)
@pytest.mark.parametrize('rpy', [
    (0, 0, 0), (90, 0, 0), (-90, 0, 0), (180, 0, 0), (0, 90, 0), (0, -90, 0), (0, 180, 0),
    (0, 0, 90), (20, -30, 40), (90, 90, 90), (179.9, 0.1, 0)])
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


def test_a_second_pose_near_the_first_and_a_flat_pose_without_gravity_are_refused():
    with pytest.raises(InputError, match='within 10° of the flat pose'):
        with_heading(np.eye(3), np.array([0, 0.05, 1.0]))
    for flat in ((0, 0, 0), (np.nan, 0, 1)):
        with pytest.raises(InputError, match='expected about 1 g'):
            mounting(np.array(flat, float))


def wired(mat_p, seed=1):
    """Return poses of known orientation whose axes are permuted by mat_p."""
    rng = np.random.default_rng(seed)
    directions = spread_directions(16) @ rotation_from_rpy(*rng.uniform(-3, 3, 3)).T
    poses = simulate_poses(sensor(rng, *MODELS['12'].effects), directions, rng)
    return poses.with_columns(reading=poses.reading @ mat_p.T, reference=directions)


SWAP_XY = np.eye(3)[[1, 0, 2]]
TURN = rotation_from_rpy(0.0, 0.0, np.radians(45.0))


@pytest.mark.parametrize(('mat_p', 'words'), [
    (np.diag([-1.0, 1, 1]), 'x reads -x'), (SWAP_XY, 'x and y'), (TURN.T, '45° about z'),
    (TURN @ np.diag([1.0, 1, -1]), 'a mirror image')])
def test_a_wiring_fault_is_named_and_model_12_corrects_it(mat_p, words):
    poses = wired(mat_p)
    calibration = fit_poses(poses, G)
    assert calibration.name == '12'
    assert calibration.noted[0].kind == 'wiring'
    assert words in calibration.noted[0].text
    np.testing.assert_allclose(calibration.correct(poses.reading), poses['reference'], atol=3e-3)
