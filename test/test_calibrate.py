# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""One command from any log to a calibration, a page and a verdict."""

from dataclasses import replace

import accel_calib as ac
from accel_calib.errors import RefusedFitError
from accel_calib.stored import read_calibration
from inside import are_samples, calibrated_by, FitPlan, is_partial
import numpy as np
import pytest
from shared import data, MPS2, OPTIONS, random_directions, run, run_json, run_on_small_disk, SENSOR


def calibrated(capsys, *arguments):
    """Return exit status and JSON of the command."""
    return run_json(capsys, 'calibrate', *arguments)


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / 'log.csv'
    assert run('simulate', '-o', path, '--recording', '--poses', 14, '--dwell', 3, *OPTIONS,
               '--mounting', 5, -3, 0) == 0
    return path


def test_a_recording_becomes_a_calibration_a_page_and_a_verdict(recording, tmp_path, capsys):
    out = tmp_path / 'c.yaml'
    status, result = calibrated(capsys, recording, '-o', out, '--flat', 'first')
    assert (status, result['rating']) == (0, 'GOOD')
    assert result['rating_reason']
    np.testing.assert_allclose(np.array(result['offset']) / 9.80665, SENSOR['offset'], atol=2e-3)
    stored = read_calibration(out)
    assert stored.is_levelled
    np.testing.assert_allclose(stored.apply(stored.poses.reading[0]), (0, 0, 9.80665), atol=0.05)
    np.testing.assert_allclose(stored.offset, result['offset'])
    assert 'GOOD' in (tmp_path / 'c.html').read_text(encoding='utf-8')


def bent(path, *, bend_mg):
    """Write poses of a sensor whose readings are far from an ellipsoid, without their noise."""
    up = random_directions(40, np.random.default_rng(5))
    rough = np.sign(np.sin(9.0 * up[:, :1])) * bend_mg * 1e-3
    np.savetxt(path, 9.80665 * up * (1.0 + rough), delimiter=',', header='ax,ay,az', comments='')
    return path


@pytest.mark.parametrize('command', ['calibrate', 'fit', 'refine'])
def test_a_bad_calibration_is_not_stored_unless_asked_for(command, tmp_path, capsys):
    path, out = bent(tmp_path / 'poses.csv', bend_mg=40.0), tmp_path / 'c.yaml'
    for more in ((), ('--keep-bad',)):
        status, result = run_json(capsys, command, path, '-o', out, *more)
        assert (status, result['rating'], out.exists()) == (1, 'BAD', bool(more))
        assert out.with_suffix('.html').exists() is (command == 'calibrate')
    status, result = run_json(capsys, 'verify', path, '-c', out)
    assert (status, result['rating']) == (1, 'BAD')


def test_what_the_gate_refuses_is_never_stored(tmp_path, capsys):
    path, out = bent(tmp_path / 'poses.csv', bend_mg=150.0), tmp_path / 'c.yaml'
    status, result = calibrated(capsys, path, '-o', out, '--keep-bad')
    assert (status, {*result}, out.exists()) == (2, {'file', 'error', 'advice'}, False)


@pytest.mark.usefixtures('without_pages')
@pytest.mark.parametrize(('flat', 'row'), [('last', 13), ('3', 2)])
def test_the_flat_pose_is_the_first_the_last_or_a_row(flat, row, recording, tmp_path, capsys):
    out = tmp_path / 'c.yaml'
    calibrated(capsys, recording, '-o', out, '--flat', flat, '--no-refine')
    stored = read_calibration(out)
    np.testing.assert_allclose(stored.apply(stored.poses.reading[row]), (0, 0, 9.80665), atol=0.05)


@pytest.mark.usefixtures('without_pages')
@pytest.mark.parametrize('name', ['xsens_mti_counts', 'mpu9150_imu1'])
def test_real_logs_become_good_calibrations_without_an_option(name, tmp_path, capsys):
    status, result = calibrated(capsys, data(f'{name}.csv'), '-o', tmp_path / 'c.yaml',
                                '--no-refine')
    assert (status, result['rating']) == (0, 'GOOD')
    assert result['units'] == ('native' if name.startswith('xsens') else 'm/s2')
    assert result['rms_after_mg'] <= (0.115 if name.startswith('xsens') else 0.3)  # as imu_tk


@pytest.mark.parametrize(('step', 'rows', 'count', 'samples'), [
    (0.01, 20, {}, True), (20.0, 60, {}, False), (0.1, 60, {'count': np.ones(60)}, False),
    (10.0, 6000, {}, True)])
def test_samples_are_distinguished_from_poses(step, rows, count, samples):
    columns = {'time': np.arange(rows) * step, 'reading': np.ones((rows, 3)), **count}
    assert are_samples(columns) == samples


@pytest.mark.parametrize(('per_g', 'unit'), [(1000.0, 'g'), (1024.0, 'native')])
def test_whole_numbers_are_mg_only_where_1_g_is_about_1000(per_g, unit, tmp_path):
    made = ac.simulate({}, recording=True, poses=10, units='g')
    np.savetxt(tmp_path / 'log.csv', np.column_stack([made['time'], np.round(
        per_g * made.reading)]), delimiter=',', header='time,ax,ay,az', comments='')
    assert ac.capture(tmp_path / 'log.csv').units == unit


@pytest.mark.parametrize(('size_kb', 'status', 'left'), [(64, 0, ['c.yaml']), (4, 2, [])])
@pytest.mark.parametrize('command', ['calibrate', 'fit'])
def test_a_page_or_calibration_that_does_not_fit_on_the_disk_is_one_line(
        command, size_kb, status, left, recording, tmp_path):
    disk = tmp_path / 'disk'
    more = {'calibrate': ['--no-refine'], 'fit': ['--report', disk / 'c.html']}[command]
    done, copy = run_on_small_disk(disk, size_kb, command, recording, '-o', disk / 'c.yaml', *more)
    assert (done.returncode, done.stderr.count('\n')) == (status, 1 if status else 0)
    assert 'No space left' in (done.stderr if status else done.stdout)
    assert [each.name for each in copy.iterdir()] == left
    assert all(read_calibration(copy / name).name for name in left)


# The plan of a fit beside a calibration that is in use

PLAN = FitPlan(model='10', refined=False)


def test_frame_and_mounting_of_the_calibration_in_use_are_kept() -> None:
    first, second = (ac.simulate(SENSOR, poses=16, seed=seed) for seed in (1, 2))
    assert not calibrated_by(second, MPS2, PLAN).calibration.is_levelled
    before = calibrated_by(first, MPS2, replace(PLAN, flat=3, frame='android')).calibration
    after = calibrated_by(second, MPS2, replace(PLAN, before=before)).calibration
    assert after.frame == before.frame
    np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-3)
    moved = calibrated_by(second, MPS2, replace(PLAN, before=before, flat=5)).calibration
    assert np.max(np.abs(moved.rotation - before.rotation)) > 0.1


def test_poses_near_one_direction_are_fitted_if_planned_and_replace_no_full_fit() -> None:
    tilts = np.array([[0, 0], [0.25, 0], [-0.2, 0.1], [0, 0.25], [0.1, -0.25], [-0.15, -0.2]])
    cone = ac.simulate(SENSOR, directions=np.column_stack([tilts, np.ones(len(tilts))]))
    with pytest.raises(RefusedFitError):
        calibrated_by(cone, MPS2, PLAN)
    partial = calibrated_by(cone, MPS2, replace(PLAN, partial=True)).calibration
    assert is_partial(partial)
    again = calibrated_by(cone, MPS2, replace(PLAN, partial=True, before=partial)).calibration
    assert is_partial(again)
    full = calibrated_by(ac.simulate(SENSOR, poses=16), MPS2, PLAN).calibration
    with pytest.raises(RefusedFitError):
        calibrated_by(cone, MPS2, replace(PLAN, partial=True, before=full))
