# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Few poses are fitted with the typical values of a fleet."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from accel_calib.calibration import fit_poses, fit_with_fleet, FleetPrior
from accel_calib.errors import InputError
from accel_calib.logs import write_table
from accel_calib.refinement import refine
from accel_calib.stored import read_calibration, read_prior, write_calibration, write_priors
from accel_calib.table import Floats, Poses
from accel_calib.units import Units
from inside import (
    estimated, Model, MODELS, priors_of, simulate_poses, spread_directions, typical_of, unit,
    with_vector)
import numpy as np
import pytest
from shared import error_mg, refused, rms, run_json, table

IN_G = Units('g', 1.0)
MEAN = np.array([0.010, -0.015, 0.030, 0.010, 0.012, -0.020, 0.004, 0.000, -0.003])
SPREAD = np.repeat([0.020, 0.008, 0.006], 3)


def a_sensor(rng: np.random.Generator, factor: float = 1.0) -> Model:
    return with_vector(MODELS['10'].effects, MEAN + factor * SPREAD * rng.normal(size=9))


def poses_of(sensor: Model, count: int, rng: np.random.Generator) -> Poses:
    directions = unit(spread_directions(count) + 0.05 * rng.normal(size=(count, 3)))
    return simulate_poses(sensor, directions, rng)


@pytest.fixture(scope='module')
def fleet() -> FleetPrior:
    """Return the typical values of 40 sensors, two of which are unlike the others."""
    rng = np.random.default_rng(1)
    fits = [fit_poses(poses_of(a_sensor(rng, 8.0 if k in (3, 17) else 1.0), 20, rng), IN_G,
                      model='10') for k in range(40)]
    found = estimated(np.array([each.model.vector for each in fits]),
                      np.array([each.covariance for each in fits]))
    return FleetPrior('', len(fits), found)


def test_the_typical_values_are_those_of_the_fleet_without_the_odd_sensors(
        fleet: FleetPrior) -> None:
    spread = np.sqrt(np.diag(fleet.prior.covariance))
    assert np.all(np.abs(fleet.prior.mean - MEAN) < 3.0 * SPREAD / np.sqrt(40))
    assert np.all((spread > 0.6 * SPREAD) & (spread < 1.6 * SPREAD))


@pytest.mark.parametrize(('off', 'seed', 'share'), [(0.0, 2, 0.6), (0.25, 3, 1.0)])
def test_six_poses_with_the_fleet_have_half_the_error_and_no_larger_one_of_an_odd_sensor(
        off: float, seed: int, share: float, fleet: FleetPrior) -> None:
    rng = np.random.default_rng(seed)
    without, with_fleet, pulled, within = [], [], [], []
    for _ in range(6):
        values = a_sensor(rng).vector + np.eye(9)[2] * off  # up to 12 spreads in z
        sensor = with_vector(MODELS['10'].effects, values)
        poses = poses_of(sensor, 6, rng)
        fitted = fit_with_fleet(poses, IN_G, fleet)
        without.append(error_mg(fit_poses(poses, IN_G), sensor))
        with_fleet.append(error_mg(fitted, sensor))
        pulled.append(float(fitted.offset[2] - values[2]))
        deviation = np.sqrt(np.diag(fitted.covariance))
        within += (np.abs(fitted.model.vector - sensor.vector) / deviation).tolist()
    assert rms(with_fleet) < share * rms(without)
    assert abs(np.mean(pulled)) < 0.02
    assert off or 0.5 < rms(within) < 1.6


def row_with(model: str | None, values: Floats, variance: float) -> dict[str, Any]:
    """Return what the row of a recording says for the typical values."""
    return {'sensor_model': model, 'prior_values': values.tolist(),
            'prior_covariance': (variance * np.eye(9)).ravel().tolist()}


def test_typical_values_are_computed_by_model_from_the_mean_of_the_recordings_of_a_sensor(
        ) -> None:
    (model, mean, covariance), = typical_of([
        row_with(None, np.full(9, value), value) for value in (1.0, 3.0)])
    assert model == ''
    np.testing.assert_allclose(mean, 2.0)
    np.testing.assert_allclose(covariance, np.eye(9))
    rng, without = np.random.default_rng(6), {'sensor_model': 'A', 'prior_values': None}
    sensors = [[row_with(model, mean + 0.01 * rng.normal(size=9), 1e-8) for _ in range(2)]
               for model, mean, count in (('A', 0.0, 12), ('B', 0.1, 12), ('C', 0.0, 4))
               for _ in range(count)]
    found = priors_of(each for rows in [*sensors, [without]] for each in typical_of(rows))
    assert {name: each.sensors for name, each in found.items()} == {'A': 12, 'B': 12}
    assert np.mean(found['B'].prior.mean) == pytest.approx(0.1, abs=0.005)


def test_files_keep_the_typical_values_and_what_was_fitted_with_them(
        fleet: FleetPrior, tmp_path: Path) -> None:
    path, rng = tmp_path / 'fleet.yaml', np.random.default_rng(5)
    write_priors(path, {'A': FleetPrior('A', 40, fleet.prior)})
    np.testing.assert_allclose(read_prior(path).prior.covariance, fleet.prior.covariance)
    with pytest.raises(InputError, match="has A, expected the model 'B'"):
        read_prior(path, 'B')
    fitted = fit_with_fleet(poses_of(a_sensor(rng), 6, rng), IN_G, fleet, sensor='imu')
    write_calibration(tmp_path / 'a.yaml', fitted)
    stored = read_calibration(tmp_path / 'a.yaml')
    assert (stored.method, stored.reason) == ('fleet', fitted.reason)
    assert '40 sensors' in stored.reason
    np.testing.assert_allclose(stored.covariance, fitted.covariance, rtol=1e-6)


@pytest.mark.parametrize(('old', 'new', 'words'), [
    *table('damaged_priors'), ('offset.x', 9000 * 'x', f'names are {100 * "x"}…, offset.y')])
def test_a_damaged_file_is_refused(
        fleet: FleetPrior, tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / 'fleet.yaml'
    write_priors(path, {'': fleet})
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=words):
        read_prior(path)


def bent(sensor: Model) -> Model:
    """Return a sensor with a nonlinearity beyond model 10."""
    return Model({**sensor.values, 'quadratic': np.array([0.012, -0.010, 0.011])})


def test_poses_that_carry_no_search_are_refined_to_the_fit_with_the_fleet(
        fleet: FleetPrior) -> None:
    rng = np.random.default_rng(7)
    poses = poses_of(bent(a_sensor(rng)), 6, rng)
    result, fitted = refine(poses, IN_G, base=fleet), fit_with_fleet(poses, IN_G, fleet)
    np.testing.assert_array_equal(result.calibration.model.vector, fitted.model.vector)
    assert result.steps == ()
    assert all(each in result.advice[0] for each in ('6 poses', 'at least 9'))
    assert 'directions' in dict(result.not_testable)['quadratic']


@pytest.mark.usefixtures('without_pages')
def test_the_command_line_refines_with_the_file_of_the_fleet(
        fleet: FleetPrior, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(11)
    write_priors(tmp_path / 'fleet.yaml', {name: replace(fleet, model=name) for name in 'AB'})
    for count, effects in ((6, []), (16, ['quadratic'])):
        table, out = tmp_path / f'{count}.csv', tmp_path / f'{count}.yaml'
        write_table(table, poses_of(bent(a_sensor(rng)), count, rng))
        given = table, '--units', 'g', '--prior', tmp_path / 'fleet.yaml'
        of_b = *given, '--sensor-model', 'B'
        assert ' A, B, ' in refused(capsys, 'refine', *given)
        status, found = run_json(capsys, 'refine', *of_b, '-o', out)
        assert (status, [step['effect'] for step in found['steps']]) == (0, effects)
        refused(capsys, 'fit', *of_b, '--model', '4')
        stored = read_calibration(out)
        assert stored.method == 'fleet'
        assert stored.reason.endswith(' of model B')
        found = run_json(capsys, 'calibrate', *of_b, '-o', out, '--keep-bad')[1]
        assert read_calibration(out).method == 'fleet'
        assert ('quadratic' in found['refined']) is bool(effects)
        assert ('at least 9' in found['refined']) is not bool(effects)
