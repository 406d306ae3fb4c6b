# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The independent simulator, with which the refinement is tested, is correct."""

import ast
import csv
from dataclasses import replace
from pathlib import Path

import generator
from generator import again, EFFECTS, OUTSIDE, Setup, simulate, write_csv
import generator_effects
from generator_effects import basis_of, CARRIER
import numpy as np
import pytest

G = generator.STANDARD_GRAVITY
IN_READING = [name for name in EFFECTS if name not in generator.ON_OUTPUT]


def reading_of(columns):
    return np.column_stack([columns[name] for name in ('ax', 'ay', 'az')]) / G


def corrected(made):
    return (reading_of(made.columns) - made.traits.offset) @ np.linalg.inv(made.traits.gain).T


def errors_over_noise(made):
    """Return the errors of |a| over the noise of the samples."""
    return (np.linalg.norm(corrected(made), axis=1) - 1.0) / made.noise


@pytest.mark.parametrize('module', [generator, generator_effects])
def test_it_shares_no_code_with_the_package(module) -> None:
    tree = ast.parse(Path(module.__file__).read_text(encoding='utf-8'))
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import)
               for alias in node.names}
    modules |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not [name for name in modules if name.startswith('accel_calib')]
    assert 'scipy' not in modules


@pytest.mark.parametrize('name', IN_READING)
@pytest.mark.parametrize(('poses', 'size'), [(16, 3.0), (24, 1.5), (60, 100.0), (200, 2.0)])
def test_an_effect_has_the_size_asked_for(name: str, poses: int, size: float) -> None:
    made = simulate(np.random.default_rng(1), {name: size}, Setup(poses=poses))
    assert made.sizes[name] == pytest.approx(size, rel=0.02)


@pytest.mark.parametrize('name', IN_READING)
def test_the_size_is_that_of_what_the_base_leaves_in_the_readings(name: str) -> None:
    made = simulate(np.random.default_rng(2), {name: 30.0}, Setup(poses=200))
    off = (np.linalg.norm(corrected(made), axis=1) - 1.0) / made.noise
    u = made.around.force
    design = np.hstack([u, u ** 2, u[:, [0, 0, 1]] * u[:, [1, 2, 2]]]) / made.noise[:, None]
    left = off - design @ np.linalg.lstsq(design, off, rcond=None)[0]
    assert np.sqrt(np.mean(left ** 2)) == pytest.approx(30.0, rel=0.1)


def test_without_an_effect_the_noise_is_that_of_the_samples() -> None:
    made = simulate(np.random.default_rng(3), {}, Setup(poses=2000))
    off = corrected(made) - made.around.force
    std = np.column_stack([made.columns[f'std_{axis}'] for axis in 'xyz']) / G
    noise = std / np.sqrt(made.columns['count'])[:, None]
    assert np.std(off / noise) == pytest.approx(1.0, abs=0.05)
    assert np.std((np.linalg.norm(corrected(made), axis=1) - 1.0)
                  / made.noise) == pytest.approx(1.0, abs=0.05)
    assert 3.0 < np.max(std) / np.min(std) < 6.0


def test_a_coarse_grid_holds_the_samples() -> None:
    made = simulate(np.random.default_rng(4), {'quantisation': 3.0}, Setup(poses=60))
    step = made.truth['quantisation']['step']
    codes = reading_of(made.columns) / step
    assert np.mean(np.abs(codes - np.round(codes)) < 1e-6) > 0.6
    assert np.median(np.abs(corrected(made) - made.around.force)) > 1e-3


def test_saturation_clips_the_readings() -> None:
    made = simulate(np.random.default_rng(5), {'saturation': 3.0}, Setup(poses=60))
    assert np.max(np.abs(reading_of(made.columns))) <= made.truth['saturation']['limit'] + 1e-12
    ends = np.abs(reading_of(made.columns)) > made.truth['saturation']['limit'] - 0.005
    assert np.sum(np.any(ends, axis=1)) >= generator.LEAST_CLIPPED
    assert made.sizes['saturation'] > 2.9


def test_context_is_recorded_whatever_is_hidden() -> None:
    made = simulate(np.random.default_rng(6), {'quadratic': 3.0})
    columns = made.columns
    assert list(columns) == ['time', 'ax', 'ay', 'az', 'std_x', 'std_y', 'std_z', 'count',
                             'temperature', 'supply_voltage', 'gx', 'gy', 'gz']
    gaps = np.diff(columns['time'])
    assert np.all((gaps >= 9.9) & (gaps <= 60.1))
    assert np.ptp(columns['temperature']) == pytest.approx(30.0, abs=0.1)
    assert np.any(np.diff(columns['temperature']) < 0.0)
    assert np.all((columns['supply_voltage'] >= 3.0) & (columns['supply_voltage'] <= 3.6))


def test_temperature_can_rise_with_time() -> None:
    made = simulate(np.random.default_rng(7), {}, Setup(temperature='rising'))
    assert np.all(np.diff(made.columns['temperature']) >= 0.0)


def test_the_same_generator_gives_the_same_set() -> None:
    one, two = (simulate(np.random.default_rng(8), {'ripple': 3.0}) for _ in range(2))
    for name, column in one.columns.items():
        np.testing.assert_array_equal(column, two.columns[name])


def test_a_knock_shows_in_the_row_that_is_named() -> None:
    made = simulate(np.random.default_rng(9), {}, Setup(knocked=3))
    off = np.linalg.norm(corrected(made), axis=1) - 1.0
    assert len(made.knocked) == 3
    for row, shown in made.knocked.items():
        assert off[row - 1] == pytest.approx(shown, abs=5.0 * made.noise[row - 1])


def test_columns_can_be_left_out() -> None:
    made = simulate(np.random.default_rng(10), {}, Setup(dropped=('temperature', 'gx')))
    assert not {'temperature', 'gx'} & set(made.columns)


def test_several_effects_can_be_hidden() -> None:
    made = simulate(np.random.default_rng(11), {'cubic': 5.0, 'lever_arm': 5.0})
    assert set(made.truth) == {'cubic', 'lever_arm'}
    assert np.min(np.linalg.norm(made.around.rate, axis=1)) > 0.9


@pytest.mark.parametrize('name', [*EFFECTS])
def test_the_same_sensor_takes_other_poses(name: str) -> None:
    made = simulate(np.random.default_rng(12), {name: 3.0})
    other = again(np.random.default_rng(13), made)
    assert other.truth == made.truth
    np.testing.assert_array_equal(other.columns['time'], made.columns['time'])
    assert not np.allclose(other.columns['ax'], made.columns['ax'])
    assert 0.5 < np.mean(other.noise) / np.mean(made.noise) < 2.0


def test_effects_outside_the_catalogue_are_listed() -> None:
    assert set(OUTSIDE) < set(EFFECTS)
    assert len(OUTSIDE) >= 12


def test_each_effect_states_its_carrier_and_variable() -> None:
    assert set(CARRIER) == set(EFFECTS)
    assert {pair[0] for pairs in CARRIER.values() for pair in pairs} == {
        'offset', 'gain', 'cross_axis', 'force'}
    assert {pair[1] for pairs in CARRIER.values() for pair in pairs} == {
        'time', 'temperature', 'temperature_rate', 'force', 'supply', 'vibration'}


@pytest.mark.parametrize('name', [name for name in IN_READING if CARRIER[name]])
def test_an_effect_changes_with_its_variable_and_no_other(name: str) -> None:
    made = simulate(np.random.default_rng(16), {name: 3.0})
    around, n = made.around, made.setup.poses
    still = {'time': {'elapsed': around.elapsed}, 'supply': {'supply': np.full(n, 3.0)},
             'temperature': {'temperature': np.full(n, 40.0)},
             'vibration': {'shaking': np.ones_like(around.shaking)}}
    still['temperature_rate'] = still['temperature']
    variables = {variable for _, variable in CARRIER[name]} - {'force'}
    if variables == {'time'}:
        return  # a series in time is drawn with the sensor
    constant = {key: value for variable in variables for key, value in still[variable].items()}
    flat = basis_of(name, replace(around, **constant), made.traits)
    if all(carrier == 'offset' for carrier, _ in CARRIER[name]):
        np.testing.assert_allclose(flat, flat[:1] * np.ones_like(flat), atol=1e-12)
    others = {key: value for variable in still if variable not in variables
              for key, value in still[variable].items() if key not in constant}
    same = basis_of(name, replace(around, **others), made.traits)
    np.testing.assert_array_equal(same, basis_of(name, around, made.traits))


@pytest.mark.parametrize('name', [name for name in IN_READING
                                  if CARRIER[name] and CARRIER[name][0][0] == 'gain'])
def test_an_effect_on_the_gain_grows_with_the_force(name: str) -> None:
    made = simulate(np.random.default_rng(17), {name: 3.0})
    twice = replace(made.around, force=2.0 * made.around.force)
    np.testing.assert_allclose(basis_of(name, twice, made.traits),
                               2.0 * basis_of(name, made.around, made.traits), atol=1e-12)


def test_a_dead_zone_removes_small_readings_alone() -> None:
    made = simulate(np.random.default_rng(18), {'dead_zone': 3.0}, Setup(poses=2000))
    shape = np.einsum('nii->ni', basis_of('dead_zone', made.around, made.traits))
    u = made.around.force
    assert np.all((made.traits.width >= 0.1) & (made.traits.width <= 0.3))
    near = np.abs(u) < 0.1 * made.traits.width
    np.testing.assert_allclose(shape[near], -u[near], rtol=0.011)
    assert np.max(np.abs(shape[np.abs(u) > 0.95])) < 1e-4


def test_the_gain_is_steep_above_the_knee_alone() -> None:
    made = simulate(np.random.default_rng(19), {'gain_temperature_steep': 3.0}, Setup(poses=2000))
    u, knee = made.around.force, made.traits.knee
    gain = basis_of('gain_temperature_steep', made.around, made.traits)[:, 0, 0] / u[:, 0]
    above = made.around.temperature - knee
    assert np.max(gain[above < -10.0]) < 0.01
    np.testing.assert_allclose(gain[above > 6.0], above[above > 6.0], rtol=0.01)
    assert np.min(made.around.temperature) < knee < np.max(made.around.temperature)


def test_noise_of_1_f_form_is_equal_in_each_octave() -> None:
    powers = []
    for seed in range(60):
        made = simulate(np.random.default_rng(seed), {}, Setup(poses=200))
        time, noise = made.around.elapsed, made.traits.flicker
        spans = time[-1] / np.array([4.0, 8.0, 16.0, 32.0])  # lengths of the octaves
        grid = np.interp(np.arange(0.0, time[-1], 10.0), time, noise[:, 0])
        spectrum = np.abs(np.fft.rfft(grid)) ** 2
        frequency = np.fft.rfftfreq(len(grid), 10.0)
        powers.append([np.sum(spectrum[(frequency >= 1.0 / span) & (frequency < 2.0 / span)])
                       for span in spans])
    octaves = np.mean(powers, axis=0)
    np.testing.assert_allclose(octaves / np.mean(octaves), 1.0, atol=0.35)


@pytest.mark.parametrize('constant', [30.0, 300.0])
def test_a_step_settles_with_the_constant_of_the_low_pass(constant: float) -> None:
    step = np.where(np.arange(1000.0) > 0.0, 1.0, 0.0)
    passed = generator.low_passed(step, constant)
    assert passed[0] == 0.0
    assert passed[int(constant)] == pytest.approx(1.0 - np.exp(-1.0), abs=0.5 / constant)


@pytest.mark.parametrize('lag', [30.0, 300.0, -30.0, -300.0])
@pytest.mark.parametrize('course', ['wandering', 'rising'])
def test_a_temperature_lags_behind_the_other_one(lag: float, course: str) -> None:
    made = simulate(np.random.default_rng(20), {'offset_temperature': 5.0},
                    Setup(poses=500, lag=lag, temperature=course))
    around = made.around
    leading, behind = ((around.temperature, around.recorded) if lag > 0.0
                       else (around.recorded, around.temperature))
    rate = np.gradient(behind, around.elapsed)[1:-1]  # leading = behind + lag d(behind)/dt
    fitted = rate @ (leading - behind)[1:-1] / (rate @ rate)
    assert fitted == pytest.approx(abs(lag), rel=0.1)
    assert leading[0] == behind[0]
    np.testing.assert_array_equal(made.columns['temperature'], np.round(around.recorded, 2))


def test_an_effect_follows_the_temperature_of_the_sensing_element() -> None:
    made = simulate(np.random.default_rng(21), {'offset_temperature': 100.0}, Setup(lag=200.0))
    off = corrected(made) - made.around.force
    element, thermometer = (np.corrcoef(off[:, 0], temperature)[0, 1] ** 2
                            for temperature in (made.around.temperature, made.around.recorded))
    assert element > 0.99
    assert thermometer < 0.9


def test_without_a_lag_the_thermometer_is_right() -> None:
    around = simulate(np.random.default_rng(22)).around
    np.testing.assert_array_equal(around.temperature, around.recorded)


@pytest.mark.parametrize('heavy', [False, True])
def test_poses_scatter_as_often_as_understated(heavy: bool) -> None:
    made = simulate(np.random.default_rng(23), {},
                    Setup(poses=4000, understated=2.0, heavy=heavy))
    std = np.column_stack([made.columns[f'std_{axis}'] for axis in 'xyz']) / G
    noise = std / np.sqrt(made.columns['count'])[:, None]
    off = (corrected(made) - made.around.force) / noise
    assert np.sqrt(np.mean(off ** 2)) == pytest.approx(2.0, rel=0.1)
    assert np.sqrt(np.mean(errors_over_noise(made) ** 2)) == pytest.approx(2.0, rel=0.1)


def test_heavy_tails_are_those_of_student_with_the_variance_of_the_noise() -> None:
    light, heavy = (simulate(np.random.default_rng(24), {}, Setup(poses=4000, heavy=heavy))
                    for heavy in (False, True))
    typical = [np.median(np.abs(corrected(made) - made.around.force) / made.around.sigma)
               * np.sqrt(made.setup.samples) for made in (light, heavy)]
    np.testing.assert_allclose(typical, [0.6745, 0.7649 / np.sqrt(3.0)], rtol=0.05)
    assert np.mean(np.abs(errors_over_noise(light)) > 4.0) < 0.001
    assert np.mean(np.abs(errors_over_noise(heavy)) > 4.0) > 0.003


def test_orientations_repeat_in_a_row() -> None:
    made = simulate(np.random.default_rng(25), {}, Setup(poses=26, repeats=3))
    force = made.around.force
    assert len(np.unique(force, axis=0)) == 9
    np.testing.assert_array_equal(force[:24:3], force[2:24:3])
    assert len(np.unique(made.columns['ax'])) == 26


@pytest.mark.parametrize('setup', [Setup(lag=100.0), Setup(lag=-100.0), Setup(understated=2.0),
                                   Setup(heavy=True), Setup(poses=64, repeats=8)])
def test_other_poses_have_the_same_settings(setup: Setup) -> None:
    made = simulate(np.random.default_rng(26), {'offset_temperature': 5.0}, setup)
    other = again(np.random.default_rng(27), made)
    assert other.setup == setup
    np.testing.assert_array_equal(other.columns['temperature'], made.columns['temperature'])
    np.testing.assert_array_equal(other.around.temperature, made.around.temperature)
    assert len(np.unique(other.around.force, axis=0)) == setup.poses // setup.repeats


def test_the_scatter_of_other_poses_is_new() -> None:
    made = simulate(np.random.default_rng(28), {'repeatability': 5.0})
    other = again(np.random.default_rng(29), made)
    assert abs(np.corrcoef(made.traits.scatter[:, 0], other.traits.scatter[:, 0])[0, 1]) < 0.4


@pytest.mark.parametrize('setting', [{'understated': 0.5}, {'repeats': 0}])
def test_impossible_settings_are_refused(setting) -> None:
    with pytest.raises(ValueError, match='expected 1 or more'):
        Setup(**setting)


def test_a_set_is_written_as_a_pose_table(tmp_path: Path) -> None:
    made = simulate(np.random.default_rng(14))
    write_csv(tmp_path / 'poses.csv', made.columns)
    with (tmp_path / 'poses.csv').open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    assert [float(row['ax']) for row in rows] == made.columns['ax'].tolist()


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(ValueError, match='magnetism'):
        simulate(np.random.default_rng(15), {'magnetism': 3.0})
