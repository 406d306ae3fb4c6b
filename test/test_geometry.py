# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
"""What poses determine, what they do not determine, and the next pose."""

from accel_calib.calibration import (
    dilution, error_left_in, fit_poses, flat_direction, identifiability)
from accel_calib.errors import RefusedFitError
from accel_calib.geometry import sphere_through
from accel_calib.table import Poses
from inside import (
    axes_of, determines, fault_of, left_out, missing_poses, model_with, MODELS, mounting,
    orientations_of, poses_needed, predict, refuse_if_unfit, rotation_from_rpy, rows_of,
    simulate_poses, spread_directions, unit, with_heading)
import numpy as np
import pytest
from shared import attitudes, directions_named, FACES, G, random_directions, sensor

TURN = 2.0 * np.pi * np.arange(12) / 12.0
RING = np.column_stack([np.cos(TURN), np.sin(TURN), np.zeros(12)])


def about(directions, count, degrees, rng):
    """Return directions repeated up to a count, each with a small deviation."""
    chosen = directions[np.arange(count) % len(directions)]
    return unit(chosen + rng.normal(size=chosen.shape) * np.radians(degrees))


def cone(degrees, rng):
    """Return 12 random directions around up."""
    z, angle = rng.uniform((np.cos(np.radians(degrees)), 0.0), (1.0, 2.0 * np.pi), (12, 2)).T
    return np.column_stack([np.sqrt(1.0 - z ** 2) * np.cos(angle),
                            np.sqrt(1.0 - z ** 2) * np.sin(angle), z])


@pytest.mark.parametrize(('model', 'noisy'), [('10', 1.0), ('7', 3.0), ('12', 3.0)])
def test_deviations_and_dilution_are_those_of_the_covariance(model, noisy):
    directions = random_directions(20, np.random.default_rng(2))
    noise = np.where(np.arange(20) < 5, noisy, 1.0)
    rows = rows_of(model, directions)
    weighted = (rows / noise[:, np.newaxis, np.newaxis]).reshape(-1, rows.shape[2])
    covariance = np.linalg.inv(weighted.T @ weighted)
    found = identifiability(model, directions, noise * 7.0)
    np.testing.assert_allclose(list(found.deviations.values()), np.sqrt(np.diag(covariance)))
    sphere = rows_of(model, spread_directions(3000))
    errors = np.einsum('nip,pq,niq->n', sphere, covariance, sphere)
    assert found.dilution == pytest.approx(np.sqrt(np.max(errors)), rel=0.02)
    assert found.mean_dilution == pytest.approx(np.sqrt(np.mean(errors)), rel=0.01)


@pytest.mark.parametrize(('draw', 'least', 'most'), [
    (lambda rng: about(random_directions(5, rng), 12, 1.0, rng), 0.98, 1.0),
    (lambda rng: about(random_directions(5, rng), 12, 2.0, rng), 0.90, 1.0),
    (lambda rng: cone(45.0, rng), 1.0, 1.0),
    (lambda rng: about(RING, 12, 3.0, rng), 0.98, 1.0),
    (lambda rng: random_directions(12, rng), 0.0, 0.03),
    (lambda rng: about(spread_directions(12), 12, 10.0, rng), 0.0, 0.0),
    (lambda rng: about(spread_directions(36), 36, 10.0, rng), 0.0, 0.0)],
    ids=['five, 1°', 'five, 2°', 'cone', 'plane, 3°', 'random', 'spread', '36 spread'])
def test_poses_are_refused_where_a_fit_would_be_wrong_and_only_there(draw, least, most):
    refused = [not determines('10', draw(np.random.default_rng(seed))) for seed in range(100)]
    assert least <= np.mean(refused) <= most


@pytest.mark.parametrize(('directions', 'message'), [
    (np.repeat(FACES, 2, axis=0), '6 directions'), (FACES[:1], '1 pose'), (FACES, '6 poses'),
    (RING, 'in a plane'), (RING @ rotation_from_rpy(1, 2, 3).T, 'in a plane'),
    (cone(45.0, np.random.default_rng(4)), 'within'),
    (np.repeat(FACES[:1], 12, axis=0), 'same orientation'),
    (np.repeat(spread_directions(5), 3, axis=0), '5 directions')])
@pytest.mark.parametrize('model', ['4', '7', '10'])
def test_a_refusal_says_what_is_wrong_and_asks_for_poses_that_make_the_fit_possible(
        model, directions, message):
    if determines(model, directions):
        assert refuse_if_unfit(model, directions) is None
        return
    with pytest.raises(RefusedFitError, match=message if model == '10' else 'pose') as refusal:
        refuse_if_unfit(model, directions)
    asked = directions_named(refusal.value.advice)
    assert len(asked) == len(missing_poses(model, directions))
    assert dilution(model, np.vstack([directions, asked])) <= 3.0
    one_less = np.vstack([directions, asked[:-1]])
    assert dilution(model, one_less) > 3.0 or len(one_less) < poses_needed(model)


@pytest.mark.parametrize('directions', [FACES, spread_directions(12),
                                        cone(90.0, np.random.default_rng(10))])
@pytest.mark.parametrize('smaller', ['4', '7'])
def test_error_of_a_smaller_model_is_that_of_fits_to_common_sensors(smaller, directions):
    rng, errors = np.random.default_rng(11), []
    fresh = random_directions(300, rng)
    for _ in range(100):
        model = model_with({'axis_gain': rng.normal(size=3) * (0.003 if smaller == '4' else 0.0),
                            'cross_axis': rng.normal(size=3) * 0.002})
        poses = simulate_poses(model, directions, rng, noise_g=1e-7)
        fit = fit_poses(Poses({'reading': poses.reading}, poses.row), G, model=smaller,
                        method='algebraic')
        errors.append(np.linalg.norm(fit.correct(predict(model, fresh, {})), axis=1) - 1.0)
    expected = error_left_in(smaller, '10', directions) / 10.0
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(expected, rel=0.12)


@pytest.mark.parametrize('directions', [FACES, RING[:, :2]])
def test_points_on_a_sphere_or_a_circle_have_its_radius(directions):
    radius, off = sphere_through(3.0 * directions + 0.5)
    assert radius == pytest.approx(3.0)
    assert off < 1e-12
    assert sphere_through(np.zeros((6, 3))) == (0.0, 0.0)  # the same point has no radius


# The mounting: levelling, heading, and axes that are wired wrongly


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


def wired(mat_p, seed=1):
    """Return poses of known orientation whose axes are permuted by mat_p."""
    rng = np.random.default_rng(seed)
    directions = attitudes(rng, 16)
    poses = simulate_poses(sensor(rng, *MODELS['12'].effects), directions, rng)
    return poses.with_columns(reading=poses.reading @ mat_p.T, reference=directions)


SWAP_XY = np.eye(3)[[1, 0, 2]]
ABOUT_Z = rotation_from_rpy(0.0, 0.0, np.radians(45.0))


@pytest.mark.parametrize(('mat_p', 'words'), [
    (np.diag([-1.0, 1, 1]), 'x reads -x'), (SWAP_XY, 'x and y'), (ABOUT_Z.T, '45° about z'),
    (ABOUT_Z @ np.diag([1.0, 1, -1]), 'a mirror image')])
def test_a_wiring_fault_is_named_and_model_12_corrects_it(mat_p, words):
    poses = wired(mat_p)
    calibration = fit_poses(poses, G)
    assert calibration.name == '12'
    assert calibration.noted[0].kind == 'wiring'
    assert words in calibration.noted[0].text
    np.testing.assert_allclose(calibration.correct(poses.reading), poses['reference'], atol=3e-3)


@pytest.mark.parametrize('seed', range(5))
def test_correct_wiring_causes_no_warning(seed):
    assert not fit_poses(wired(np.eye(3), seed), G).warnings
    tilted = wired(rotation_from_rpy(*np.radians((8.0, -5.0, 10.0))), seed)
    assert fault_of(axes_of(tilted.reading, tilted['reference'])) is None


@pytest.mark.parametrize('count', [30, 2500])
def test_an_orientation_is_held_out_with_all_of_its_rows(count):
    rng = np.random.default_rng(count)
    force = random_directions(count, rng)
    if count < 100:
        force = about(force[:12], count, 0.5, rng)
    number = orientations_of(force)
    places, first = np.unique(number, return_index=True)
    assert np.all(np.diff(first) > 0)
    near = np.sum(force * force[first][number], axis=1)
    assert np.min(near) >= np.cos(np.radians(5.0))
    assert np.max(force[first] @ force[first].T - 2.0 * np.eye(len(first))) < np.cos(
        np.radians(5.0))
    columns, measured = rng.normal(size=(count, 4)), rng.normal(size=count)
    basis = np.linalg.qr(columns)[0]
    held, smallest = left_out(measured - basis @ (basis.T @ measured), basis, np.arange(count),
                              force, 1e-9)
    for place in places[:5]:
        own = number == place
        values = np.linalg.lstsq(columns[~own], measured[~own], rcond=None)[0]
        np.testing.assert_allclose(held[own], measured[own] - columns[own] @ values, atol=1e-9)
    assert 0.0 < smallest < 1.0
