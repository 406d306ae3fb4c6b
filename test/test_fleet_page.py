# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What a fleet shows: odd sensors, shared effects, sensors that changed, and typical values.

Few poses are fitted with the typical values.

"""

from collections.abc import Mapping
from pathlib import Path
import re
from typing import Any
from urllib.parse import unquote

from accel_calib import simulate
from accel_calib.calibration import fit_poses, fit_with_fleet, FleetPrior
from accel_calib.comparison import history_of
from accel_calib.errors import InputError
from accel_calib.estimate import Prior
from accel_calib.findings import rate_fleet
from accel_calib.fleet import Store
from accel_calib.stored import read_calibration, read_prior, write_calibration, write_priors
from accel_calib.table import Floats, Poses
from fleet_case import page_of
from inside import (
    as_folder, digest, digest_of, drift_of, estimated, merge_sensor, Model, MODELS, not_agreeing,
    odd_sensors, OfModel, overview, priors_of, schema, SensorValues, shared_effects,
    simulate_poses, spread_directions, typical_of, unit, with_vector, write_fleet_page,
    write_parquet)
import numpy as np
import pytest
from shared import error_mg, G, rms, table

NAMES = ('offset.x', 'offset.y', 'offset.z', 'gain.x', 'gain.y', 'gain.z', 'gain.xy', 'gain.xz',
         'gain.yz')


def test_the_odd_sensors_of_a_fleet_are_named_and_few_others_by_chance() -> None:
    rng = np.random.default_rng(1)

    def drawn(count: int) -> dict[str, SensorValues]:
        return {f's{k}': SensorValues(0.01 * rng.normal(size=9), np.zeros(9), {})
                for k in range(count)}

    values = drawn(60)
    assert odd_sensors(values) == []
    values['s7'].mean[2] += 0.15
    ((sensor, name, value, far),) = odd_sensors(values)
    assert (sensor, name, value) == ('s7', 'offset.z', values['s7'].mean[2])
    assert far == pytest.approx(15.0, rel=0.4)
    assert sum(bool(odd_sensors(drawn(40))) for _ in range(100)) <= 10


def test_effects_that_sensors_share_are_counted_with_their_range() -> None:
    values = np.linspace(0.5e-3, 0.7e-3, 31)
    effects = {f's{k}': ({'offset_temperature.x': float(values[k])} if k < 31 else {})
               for k in range(40)}
    effects['s39'] = {'quadratic.x': 0.001}
    (line,) = shared_effects({name: SensorValues(np.zeros(9), np.zeros(9), each)
                              for name, each in effects.items()})
    assert re.findall(r'\d\S*|\w+.x', line) == ['31', '40', 'offset_temperature.x', '0.52', '0.68']


def test_few_of_many_unchanged_sensors_are_named_as_changed() -> None:
    rng = np.random.default_rng(3)
    sensors = [{'sensor': f's{k}', 'p_value': float(p)} for k, p in enumerate(rng.random(1000))]
    assert len(not_agreeing(sensors)) <= 2
    sensors += [{'sensor': f'changed{k}', 'p_value': 1e-6} for k in range(20)]
    sensors.append({'sensor': 'single', 'p_value': None})
    named = {row['sensor'] for row in not_agreeing(sensors)}
    assert {f'changed{k}' for k in range(20)} <= named
    assert len(named) < 26


def test_bad_calibrations_and_errors_do_not_enter_the_values() -> None:
    def row(status: str, rating: str | None, offset: float) -> dict[str, object]:
        return {'prior_values': [offset] * 9 if rating == 'BAD' else None,
                'prior_covariance': [0.0] * 81, 'sensor_model': None, 'status': status,
                'rating': rating,
                'calibration': 'a.yaml' if rating in ('GOOD', 'USABLE') else None,
                'determined': offset < 1.0, 'effects': [], 'parameters': [],
                **dict.fromkeys(NAMES, offset)}

    known = overview([digest('s', [
        row('ok', 'GOOD', 0.01), row('ok', 'USABLE', 0.03), row('ok', 'BAD', 5.0),
        row('ok', 'USABLE', 7.0), row('error', None, 9.0)])])
    np.testing.assert_allclose(known.models[''].values['s'].mean, 0.02)
    assert known.counts == {'GOOD': 1, 'USABLE': 2, 'BAD': 1, 'error': 1}
    assert known.left_out == 1
    assert (len(known.errors), known.typical) == (2, [])  # BAD, and the error


def test_a_value_that_is_known_badly_is_not_odd() -> None:
    """Most sensors have no cross-axis gain, so that its spread over the fleet is zero."""
    values = {f's{k}': SensorValues(np.zeros(9), np.zeros(9), {}) for k in range(60)}
    for name, size in (('s3', 3.0), ('s4', 30.0)):
        values[name].mean[6], values[name].deviation[6] = size * 2e-4, 2e-4
    assert [each[:2] for each in odd_sensors(values)] == [('s4', 'gain.xy')]


def test_months_have_the_quantiles_of_all_calibrations() -> None:
    rng = np.random.default_rng(4)
    months = OfModel(rng)
    for _ in range(3000):
        months.add('2026-03', rng.normal(size=9))
    months.add('2026-04', np.zeros(9))  # too few to state quantiles
    names, found = months.quantiles((0.05, 0.5, 0.95))
    assert names == ['2026-03']
    np.testing.assert_allclose(found[0].mean(axis=1), [-1.645, 0.0, 1.645], atol=0.1)


def calibrations_of(offsets: list[float], rng: np.random.Generator) -> list[Any]:
    """Return calibrations of a sensor with these offsets in x [g], one a month."""
    return [fit_poses(simulate({'offset': (each, 0.0, 0.0)}, poses=16, units='g',
                               seed=int(rng.integers(1 << 30))), G, model='10',
                      date=f'2026-{month:02d}-03T00:00:00+00:00')
            for month, each in enumerate(offsets, 1)]


def test_the_drift_of_a_sensor_is_stated_with_its_uncertainty() -> None:
    rng = np.random.default_rng(5)
    drift = drift_of(history_of(calibrations_of([0.010 * k / 12.0 for k in range(8)], rng)))
    assert drift is not None
    assert drift['parameter'] == 'offset.x'
    assert abs(drift['per_year'] - 0.010) < 4.0 * drift['sd'] < 0.002
    assert drift['p_value'] < 1e-3
    steady = drift_of(history_of(calibrations_of([0.01] * 8, rng)))
    assert steady is not None
    assert steady['p_value'] > 0.01
    assert drift_of(history_of(calibrations_of([0.01] * 2, rng))) is None


@pytest.mark.parametrize(('steps', 'expected', 'drift'), [
    *((steps, expected, drift) for drift in (0.0, 0.002) for steps, expected in (
        ('00000000', []), ('00001111', [(4, True)]), ('00010000', [(3, False)]))),
    ('00000001', [(7, None)], 0.0), ('011', [(1, True)], 0.0)])
def test_a_step_is_told_from_a_steady_drift(
        tmp_path: Path, steps: str, expected: list[tuple[int, bool]], drift: float) -> None:
    """Each calibration drifts by `drift` and may be off by 12 mg."""
    store, rng = Store(tmp_path), np.random.default_rng(7)
    calibrations = calibrations_of([drift * k + 0.012 * int(step)
                                    for k, step in enumerate(steps)], rng)
    for k, each in enumerate(calibrations):
        write_calibration(tmp_path / f'{k}.yaml', each)
        store.add({**dict.fromkeys(schema().names), 'sensor': 's', 'key': str(k), 'status': 'ok',
                   'content': str(k), 'date': each.date, 'recording': f'{k}.csv',
                   'calibration': f'{k}.yaml', 'determined': True, 'effects': []})
    row = merge_sensor('s', store)
    assert [(each['recording'], each['for_good']) for each in row['changes']] == [
        (f'{k}.csv', for_good) for k, for_good in expected]
    assert all(each['parameter'] == 'offset.x' for each in row['changes'])
    if drift:
        assert row['drift']['parameter'] == 'offset.x'
        assert row['drift']['per_year'] == pytest.approx(12.0 * drift, rel=0.08)
    elif len(steps) > 3:
        assert row['drift']['p_value'] > 0.01


def write_store(folder: Path, count: int, dates: int = 6, name: str = 'robot_{}/imu_link'
                ) -> tuple[Store, list[dict[str, Any]]]:
    """Write a fleet: all drift in x, sensor 5 is odd in z, sensor 3 changes in y for good."""
    rng, store, sensors = np.random.default_rng(6), Store(folder), []
    nothing = dict.fromkeys(schema().names)
    for k in range(count):
        mean = np.array([0.01, -0.015, 0.3 if k == 5 else 0.03, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
        mean += 0.01 * rng.normal(size=9)
        rows = []
        for date in range(dates):
            values = mean + 3e-4 * rng.normal(size=9) + 0.002 * date * np.eye(9)[0]
            values[1] += 0.012 if k == 3 and date >= dates // 2 else 0.0
            rows.append({
                **nothing, 'key': f'{k}-{date}', 'recording': f'logs/{k}_{date}.mcap',
                'sensor_model': 'A', 'date': f'2026-{date + 1:02d}-03T09:00:00+00:00',
                'status': 'ok', 'rating': 'GOOD', 'calibration': f'{k}-{date}.yaml', 'effects': [],
                'determined': date > 0 or k != 1,
                'parameters': [], **dict(zip(NAMES, values.tolist(), strict=True)),
                **{f'{each}.sd': 3e-4 for each in NAMES}})
        write_parquet(store.data(as_folder(name.format(k))), rows, schema())
        change = {'key': rows[dates // 2]['key'], 'date': rows[dates // 2]['date'],
                  'p_value': 1e-9, 'parameter': 'offset.y', 'change': 0.012, 'sd': 4e-4,
                  'for_good': True, 'recording': rows[dates // 2]['recording']}
        sensors.append({'sensor': unquote(as_folder(name.format(k))), 'calibrations': dates,
                        'recordings': dates,
                        'last': rows[-1]['date'], 'p_value': 1e-9 if k == 3 else 0.5,
                        'changes': [change] if k == 3 else [], 'drift': None})
    return store, sensors


def made_page(store: Store, sensors: list[dict[str, Any]],
              priors: Mapping[str, FleetPrior] = {}) -> str:
    known = overview(digest_of(name, store) for name in store.sensors())
    write_fleet_page(store, known, sensors, priors)
    return page_of(store.folder)


@pytest.fixture(scope='module')
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the page of 120 sensors."""
    prior = FleetPrior('A', 120, Prior(np.full(9, 0.0123), np.eye(9) * 0.02 ** 2))
    return made_page(*write_store(tmp_path_factory.mktemp('store'), 120), {'A': prior})


def test_the_page_draws_the_values_the_drift_and_the_sensors_that_changed(page: str) -> None:
    pytest.importorskip('matplotlib')
    figures = re.findall(r'<figure>.*?</figure>', page, re.DOTALL)
    texts = [' '.join(re.findall(r'>([^<]+)<', figure)) for figure in figures]
    (histogram,) = (text for text in texts if 'Zero-g offset [mg]' in text)
    assert 'robot_5/imu_link' in histogram
    assert 'robot_6/imu_link' not in histogram
    (changed,) = (text for text in texts if 'robot_3/imu_link' in text)
    assert all(each in changed for each in ('logs/3_3.mcap: ', ' y +12.00 ± ', 'for good'))
    assert '12.3' in page.partition('Typical values')[2]


def test_the_page_begins_with_a_verdict_and_needs_no_script_and_no_other_file(page: str) -> None:
    assert not re.search(r'<script|(src|href)="(?!#)|\son\w+=', page)
    ids = re.findall(r'\sid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    body = page.partition('<h1')[2]
    assert '<title>Usable: fleet</title>' in page
    assert body.index('class="verdict USABLE"') < body.index('<section')
    verdict = body.partition('class="verdict')[2].partition('</div>')[0]
    for words in ('720 recordings', '120 sensors', '720 GOOD', '1 sensor changed'):
        assert words in verdict


@pytest.mark.parametrize(('counts', 'changed', 'unnamed', 'name', 'kinds'), table('rated_fleets'))
def test_a_fleet_is_rated_by_its_recordings(
        counts: dict[str, int], changed: int, unnamed: int, name: str, kinds: list[str]) -> None:
    rating = rate_fleet(counts, 2, changed, unnamed)
    assert (rating.name, [each.kind for each in rating.findings]) == (name, kinds)


def test_fleets_of_any_size_and_with_any_names_have_a_page(page: str, tmp_path: Path) -> None:
    assert '1 sensor' in made_page(*write_store(tmp_path / 'one', 1, 1))
    name = '<b onclick="x">$x_{}^$</b>' + 'long ' * 60
    hostile = made_page(*write_store(tmp_path / 'hostile', 12, name=name))
    assert len(page) < 1.05 * len(hostile)  # of ten times as many sensors
    assert '<b ' not in hostile
    assert '&lt;b onclick' in hostile


# Few poses are fitted with the typical values of a fleet


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
    fits = [fit_poses(poses_of(a_sensor(rng, 8.0 if k in (3, 17) else 1.0), 20, rng), G,
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
        fitted = fit_with_fleet(poses, G, fleet)
        without.append(error_mg(fit_poses(poses, G), sensor))
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
    fitted = fit_with_fleet(poses_of(a_sensor(rng), 6, rng), G, fleet, sensor='imu')
    write_calibration(tmp_path / 'a.yaml', fitted)
    stored = read_calibration(tmp_path / 'a.yaml')
    assert (stored.method, stored.reason) == ('fleet', fitted.reason)
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
