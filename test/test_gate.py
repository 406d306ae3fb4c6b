# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The gate: bad rows, absurd numbers and edited files never lead to a wrong calibration."""

from dataclasses import replace
import json
from pathlib import Path

from accel_calib.calibration import fit_poses, gated
from accel_calib.errors import RefusedFitError
from accel_calib.stored import OF_FILE, read_calibration
from inside import format_calibration, Model, parse_calibration, simulate_poses, spread_directions
import numpy as np
import pytest
from shared import G, MPS2, poses_of, sensor, table

STORED = Path(__file__).parent / 'data'

TWELVE = table('twelve_readings')


def left_out(calibration):
    return [each.row for each in calibration.rejected]


@pytest.mark.parametrize('row', [
    (0.0, 0.0, 0.0), *((7.6, value, 6.2) for value in (1e150, -1e300, 1e20, 1e6))])
@pytest.mark.parametrize('model', ['auto', '4', '7', '9', '10'])
def test_an_impossible_reading_is_left_out_and_named(model, row):
    expected = fit_poses(poses_of(TWELVE), MPS2, model=model)
    found = fit_poses(poses_of([*TWELVE, row]), MPS2, model=model)
    assert left_out(found) == [13]
    np.testing.assert_allclose(found.offset, expected.offset, rtol=1e-6)
    np.testing.assert_allclose(found.gain, expected.gain, rtol=1e-6)


@pytest.mark.parametrize('value', [1e150, -1e300, 1e20, 1e6])
def test_an_impossible_reading_is_refused_where_every_row_is_kept(value):
    with pytest.raises(RefusedFitError, match='row 13: the reading'):
        fit_poses(poses_of([*TWELVE, (7.6, value, 6.2)]), MPS2, model='4', method='algebraic')


@pytest.mark.parametrize('absurd', [
    {'std': 1e300}, {'std': 1e150}, {'std': 1e5}, {'reading': 1e6, 'std': 1e6}])
def test_an_absurd_deviation_is_left_out_and_named(absurd):
    poses = simulate_poses(sensor(np.random.default_rng(1)), spread_directions(14),
                           np.random.default_rng(2))
    columns = {key: poses[key].copy() for key in absurd}
    for key, value in absurd.items():
        columns[key][5] = value
    found = fit_poses(poses.with_columns(**columns), G)
    assert left_out(found) == [6]
    assert 'reading' in absurd or 'not at rest' in found.rejected[0].reason


@pytest.fixture(scope='module')
def calibration():
    poses = simulate_poses(sensor(np.random.default_rng(5)), spread_directions(14),
                           np.random.default_rng(6))
    return fit_poses(poses, G, model='10', sensor='imu')


def test_a_residual_that_is_not_a_number_is_refused(calibration):
    quality = replace(calibration.quality, rms_after_mg=np.nan)
    with pytest.raises(RefusedFitError, match='the residual is nan mg'):
        gated(replace(calibration, quality=quality))


@pytest.mark.parametrize('values', table('overflowing_effects'))
def test_values_that_overflow_are_refused(values, calibration):
    changed = Model({name: np.array(part) for name, part in {**calibration.model.values,
                                                             **values}.items()})
    covariance = np.zeros((len(changed.vector),) * 2)
    with pytest.raises(RefusedFitError):
        gated(replace(calibration, model=changed, covariance=covariance))


def test_a_file_edited_by_hand_is_used_with_a_warning_and_its_effects_count(calibration):
    text, matrix = format_calibration(calibration), calibration.matrix
    for old, new, kinds in (
            ('sensor: imu', 'sensor: imu', []), ('sensor: imu', 'sensor: other', ['edited']),
            (f'[{matrix[0, 0]!s},', '[1.5,', ['edited', 'correction_in_file'])):
        assert old in text
        found = parse_calibration(text.replace(old, new, 1), 'x.yaml')
        assert [each.kind for each in found.noted if each.kind in OF_FILE] == kinds
        np.testing.assert_array_equal(found.matrix, matrix)
        assert found.sensor == ('other' if 'other' in new else 'imu')
        again = parse_calibration(format_calibration(found), 'x.yaml')
        assert not {each.kind for each in again.noted} & {*OF_FILE}


def test_stored_calibrations_still_load_and_correct_as_they_did():
    corrected = json.loads((STORED / 'calibration_corrected.json').read_text())
    assert len(corrected) == 4
    context = {'temperature': np.array([22.0]), 'time': np.array([600.0])}
    for name, force in corrected.items():
        found = read_calibration(STORED / name)
        reading = np.array([[0.3, -0.4, 0.8]]) * found.units.per_g
        np.testing.assert_allclose(found.correct(reading, context)[0], force, rtol=1e-9)
        assert np.all(np.isfinite(found.covariance))
        assert parse_calibration(format_calibration(found), name).model.effects == (
            found.model.effects)
