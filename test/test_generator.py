# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The independent simulator, with which the refinement is tested, is correct."""

import ast
import csv
from pathlib import Path

import generator
from generator import again, EFFECTS, OUTSIDE, Setup, simulate, write_csv
import numpy as np
import pytest

G = generator.STANDARD_GRAVITY
IN_READING = [name for name in EFFECTS if name not in generator.ON_OUTPUT]


def reading_of(columns):
    return np.column_stack([columns[name] for name in ('ax', 'ay', 'az')]) / G


def corrected(made):
    return (reading_of(made.columns) - made.traits.offset) @ np.linalg.inv(made.traits.gain).T


def test_it_shares_no_code_with_the_package() -> None:
    tree = ast.parse(Path(generator.__file__).read_text(encoding='utf-8'))
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import)
               for alias in node.names}
    modules |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not [name for name in modules if name.startswith('accel_calib')]
    assert 'scipy' not in modules


@pytest.mark.parametrize('name', IN_READING)
@pytest.mark.parametrize(('poses', 'size'), [(24, 6.0), (60, 3.0), (200, 2.0)])
def test_an_effect_has_the_size_asked_for(name: str, poses: int, size: float) -> None:
    made = simulate(np.random.default_rng(1), {name: size}, Setup(poses=poses))
    assert made.sizes[name] == pytest.approx(size, rel=0.1)


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


def test_a_set_is_written_as_a_pose_table(tmp_path: Path) -> None:
    made = simulate(np.random.default_rng(14))
    write_csv(tmp_path / 'poses.csv', made.columns)
    with (tmp_path / 'poses.csv').open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    assert [float(row['ax']) for row in rows] == made.columns['ax'].tolist()


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(ValueError, match='magnetism'):
        simulate(np.random.default_rng(15), {'magnetism': 3.0})
