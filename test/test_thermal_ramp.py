# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The offset over temperature from a still board: against the truth, and against the autopilots.

The fits of the autopilots stand here as their documents describe them, with `numpy.polyfit` of
degree 3 over all samples:

- PX4: a median filter of 31 samples, means over 2000 intervals of the temperature, and the middle
  of the range as reference;
- ArduPilot: means over 2 s, 35 °C as reference, coefficients in 10⁻⁶ m/s².

"""

from functools import partial
from pathlib import Path
import sys

import accel_calib as ac
from accel_calib.calibration import Curve, curve_of
from accel_calib.effects import OFFSET_POWERS
from accel_calib.logs import write_table
from accel_calib.session import figures
from accel_calib.stillness import cells_of, Ramp, ramp_of
from accel_calib.stored import read_calibration, write_calibration
from accel_calib.table import Recording
from accel_calib.units import MG
from data.logs import make
from driven import Driver
from faults.sample import sample
from inside import Intake, RampIntake, thermally_calibrated
import numpy as np
import pytest
from ramps import BENT, G, LINE, offset_at, ramp, twelve_poses, TWISTED, UP, warming, write_ulog
from scipy.signal import medfilt
from shared import MPS2, refused, rms, run, run_json
from test_exports import qgroundcontrol


def stretches(log: Recording) -> Ramp:
    return ramp_of(cells_of([log], MPS2))


def curve(*logs: Recording) -> Curve:
    return curve_of([stretches(log) for log in logs])


def thermal(*logs: Recording | Intake):
    ramps = [None if isinstance(log, Intake) else stretches(log) for log in logs]
    return thermally_calibrated([
        log if found is None else RampIntake(found.stretches, MPS2, ramp=found)
        for log, found in zip(logs, ramps)])


def coefficients(found: Curve):
    """Return the (degree, 3) coefficients of T - 25 °C and their deviations."""
    places = [found.model.terms.parts[found.model.effects.index(name)].start
              for name in OFFSET_POWERS[1:found.degree + 1]]
    rows = np.add.outer(np.array(places, int), np.arange(3))
    return found.model.vector[rows], np.sqrt(np.diagonal(found.covariance))[rows]


def px4_fit(log: Recording):
    """Return reference [°C] and coefficients (4, 3) of powers 0 to 3 [m/s²/°C^k]."""
    warm = log['temperature']
    reference, edges = (warm.min() + warm.max()) / 2.0, np.linspace(warm.min(), warm.max(), 2001)
    place = np.unique(np.digitize(warm, edges[1:-1]), return_inverse=True)[1]
    x, *axes = (np.bincount(place, each) / np.bincount(place) for each in (
        warm - reference, *medfilt(log.reading, (31, 1)).T))
    return reference, np.polyfit(x, np.transpose(axes), 3)[::-1]


def ardupilot_fit(log: Recording):
    """Return reference [°C] and coefficients (4, 3) of powers 0 to 3 [m/s²/°C^k]."""
    warm, *axes = (np.convolve(each, np.full(10, 0.1), 'valid')  # 2 s at 5 Hz
                   for each in (log['temperature'], *log.reading.T))
    return 35.0, np.polyfit(warm - 35.0, np.transpose(axes), 3)[::-1]


def vendor_at(fit, temperature, reference_c):
    """Return the (n, 3) curve of a vendor, relative to that at a temperature [g]."""
    zero, values = fit
    powers = (np.append(temperature, reference_c) - zero)[:, np.newaxis] ** np.arange(4)
    offset = powers @ values / G
    return offset[:-1] - offset[-1]


VENDORS = {'px4': px4_fit, 'ardupilot': ardupilot_fit}


@pytest.mark.parametrize(('truth', 'degree'), [((), 0), (LINE, 1), (BENT, 2), (TWISTED, 3)])
@pytest.mark.parametrize('seed', sample(range(20), 2))
def test_the_degree_and_the_coefficients_are_those_of_the_sensor(truth, degree, seed):
    found = curve(ramp(seed, truth))
    assert found.degree == degree
    assert (found.reference_c, found.both) == (25.0, False)
    assert set(found.model.effects) == {*OFFSET_POWERS[1:degree + 1]}
    values, deviations = coefficients(found)
    np.testing.assert_allclose(values, np.reshape(truth, (degree, 3)), rtol=0.0,
                               atol=5.0 * np.max(deviations, initial=0.0))
    assert found.band_mg < 1.0


@pytest.mark.parametrize('size_g', [0.9e-3, 1.1e-3])
def test_a_step_of_less_than_1_mg_is_not_named(size_g):
    log = ramp(3, LINE, noise_g=0.001)
    later = (log['time'] > 1000.0)[:, np.newaxis]
    log = log.with_columns(reading=log.reading + later * size_g * G * np.array([0.6, 0.0, 0.8]))
    assert ('offset_step' in curve(log).model.effects) is (size_g > 1e-3)


@pytest.mark.parametrize('wander_g', [0.0, 3e-4, 1e-3])
def test_deviations_include_correlated_noise_which_does_not_raise_the_degree(wander_g):
    runs = [curve(ramp(seed, LINE, wander_g=wander_g, rate_hz=2.0))
            for seed in sample(range(200, 225), 4)]
    assert {each.model.effects for each in runs} == {('offset_temperature',)}
    away = np.array([(values - LINE) / deviations
                     for values, deviations in map(coefficients, runs)])
    assert 0.4 < np.sqrt(np.mean(away ** 2)) < 1.6


def by_rate(log: Recording, size_g: float) -> Recording:
    """Return a log whose offset changes with the rate of the temperature, too [g·s/°C]."""
    rate = np.gradient(log['temperature'], log['time'])
    smooth = np.convolve(rate, np.full(301, 1.0 / 301.0), 'same')[:, np.newaxis]
    return log.with_columns(reading=log.reading + smooth * size_g * np.array([0.5, -1.0, 1.0]) * G)


@pytest.mark.parametrize(('make_log', 'truth'), [
    (partial(ramp, curve=BENT, lag_s=60.0), BENT), (partial(ramp, curve=TWISTED), TWISTED),
    (lambda seed, **how: by_rate(ramp(seed, TWISTED, **how), 0.05), TWISTED)],
    ids=['lag', 'none', 'rate'])
def test_what_differs_between_warming_and_cooling_is_corrected_on_another_run(make_log, truth):
    first, second = (make_log(seed, minutes=80.0, cool=True) for seed in (3, 4))
    made = thermal(first)
    assert made.curve.both
    context = {key: second[key] for key in ('time', 'temperature')}
    left = made.calibration.correct(second.reading, context) / G
    inside = second['time'] > 300.0  # the rate of a stream begins with the samples
    cells = left[inside][:len(left[inside]) // 50 * 50].reshape(-1, 50, 3).mean(axis=1)
    assert rms(np.linalg.norm(cells - cells.mean(axis=0), axis=1)) * MG < 1.2
    steady = np.linspace(0.0, 30.0, 20)
    error = made.curve.at(steady) - offset_at(steady, truth)
    assert np.max(np.abs(error - error.mean(axis=0))) * MG < 1.0


def test_rests_with_times_in_another_unit_are_read_right_or_refused_with_the_unit(
        tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rests = stretches(ramp(3, BENT, minutes=80.0, cool=True)).stretches
    rests, path = rests.without_columns('temperature_rate'), tmp_path / 'rests.csv'
    for unit in (1e-9, 1e-6):
        write_table(path, rests.with_columns(time=np.round(rests['time'] / unit)))
        assert run_json(capsys, 'thermal', path)[1]['thermal']['degree'] == 2
    path.write_text(path.read_text().replace('time', 'time_ns', 1))  # they are in µs
    assert 'probably in a unit that is 1000' in refused(capsys, 'thermal', path)
    write_table(path, rests.with_columns(temperature=rests['temperature'] + 273.15))
    assert 'state its unit in the name' in refused(capsys, 'thermal', path)
    log, count = ramp(3, BENT), 3000
    log = log.take(slice(0, count)).with_columns(rate=np.full((count, 3), 7e4))
    write_table(path, log.without_columns('temperature'))
    assert 'no temperature' in refused(capsys, 'thermal', path)  # whatever the gyro reads


@pytest.mark.parametrize(('low', 'high', 'reference'), [
    (-15.0, 15.0, 15.0), (30.0, 60.0, 30.0), (0.0, 50.0, 25.0)])
def test_the_calibration_is_zero_at_25_degrees_or_the_nearest_end(low, high, reference, tmp_path):
    log = ramp(7, TWISTED, low=low, high=high)
    made = thermal(log)
    assert made.curve.reference_c == pytest.approx(reference, abs=1.5)
    write_calibration(tmp_path / 'c.yaml', made.calibration)
    stored = read_calibration(tmp_path / 'c.yaml')
    assert stored == made.calibration
    low, high = stored.ranges['temperature']
    assert made.curve.range_c == (low, high)
    context = {'temperature': np.linspace(low, high, 50)}
    reading = np.tile(UP * G, (50, 1))
    moved = (reading - stored.correct(reading, context)) / G
    np.testing.assert_allclose(moved, made.curve.at(context['temperature']), atol=1e-12)
    at_25 = offset_at(np.array([made.curve.reference_c]), TWISTED)
    truth = offset_at(context['temperature'], TWISTED) - at_25
    np.testing.assert_allclose(moved, truth, atol=1.5e-3)
    assert made.rating.name == 'USABLE'
    assert made.rating.findings[0].kind == 'thermal_alone'


def written(tmp_path: Path, **logs: Recording) -> list[Path]:
    paths = [tmp_path / f'{name}.csv' for name in logs]
    for path, log in zip(paths, logs.values(), strict=True):
        write_table(path, log)
    return paths


def test_a_ramp_and_a_log_of_poses_become_one_calibration(tmp_path, capsys, monkeypatch):
    paths = written(tmp_path, poses=twelve_poses(11), ramp=ramp(8))
    out = tmp_path / 'c.yaml'
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, 'matplotlib', None)  # only the last command draws its page
        status, result = run_json(capsys, 'thermal', *paths, '-o', out, '--flat', 'first')
        assert (status, result['rating'], result['model']) == (0, 'GOOD', '10')
        stored = read_calibration(out)
        assert stored.is_levelled
        _, open_ = run_json(capsys, 'thermal', *paths, '-o', out)
    assert not out.with_suffix('.html').exists()
    command = open_['next']['command'].split()
    assert command[:-1] == ['accel-calib', 'thermal', *map(str, paths), '-o', str(out), '--flat']
    assert run(*command[1:]) == 0
    assert read_calibration(out).is_levelled
    sd = np.array(result['offset_sd'])
    np.testing.assert_array_less(np.abs(np.array(result['offset']) / G - make.OFFSET_G) * G,
                                 4.0 * sd + 1e-9)
    np.testing.assert_allclose(stored.gain, make.GAIN, atol=2e-3)
    for other in (twelve_poses(12), ramp(9)):
        left = stored.correct(other.reading, dict(other.columns))
        assert abs(np.median(np.linalg.norm(left, axis=1)) / G - 1.0) < 1e-3
    assert out.with_suffix('.html').read_text(encoding='utf-8').count('<svg') == 3
    assert {each['kind'] for each in result['findings']} >= {'open'}
    assert result['thermal']['degree'] == 2


@pytest.mark.usefixtures('without_pages')
def test_a_log_of_px4_is_read_and_its_sensor_kept(tmp_path, capsys):
    pytest.importorskip('pyulog')
    write_ulog(tmp_path / 'ramp.ulg', ramp(8))
    assert run('thermal', tmp_path / 'ramp.ulg', '-o', tmp_path / 'c.yaml') == 0
    assert run('export', tmp_path / 'c.yaml', '--to', 'px4', '-o', tmp_path / 'p.params') == 0
    found = qgroundcontrol((tmp_path / 'p.params').read_text())
    assert found['TC_A0_ID'] == found['CAL_ACC0_ID'] == 1310988
    assert (found['TC_A0_TMIN'], found['TC_A0_TMAX']) == pytest.approx((-10.0, 33.6), abs=1.0)


def test_a_shaken_part_and_a_fast_begin_are_left_out_with_a_note():
    log = ramp(8)
    shaken = (log['time'] > 600.0) & (log['time'] < 620.0)
    rough = np.random.default_rng(1).normal(size=(len(log), 3)) * 0.2 * G
    log = log.with_columns(reading=log.reading + rough * shaken[:, np.newaxis])
    assert 'the board shook' in stretches(log).notes[0]
    values, deviations = coefficients(curve(log))
    assert np.all(np.abs(values - BENT) < 5.0 * deviations)
    assert '5 °C/min' in stretches(ramp(8, minutes=20.0)).notes[0]


def test_calibrate_recognises_a_still_board_in_a_file_and_in_memory(tmp_path):
    path, = written(tmp_path, ramp=ramp(8))
    found = ac.calibrate(path)
    assert 'offset_temperature_quadratic' in found.model.effects
    assert ac.calibrate(ramp(8)).model.effects == found.model.effects


@pytest.mark.parametrize('truth', [LINE, BENT, TWISTED])
def test_the_error_on_a_second_ramp_is_not_larger_than_that_of_the_autopilots(truth):
    """The second ramp has other temperatures, and its noise is left out."""
    errors, warm = [], warming(2000, -9.0, 33.0, cool=True)
    for seed in sample(range(100, 110), 4):
        log = ramp(seed, truth, wander_g=1e-4)
        offsets = [curve(log).at(warm), *(vendor_at(fit(log), warm, 25.0)
                                          for fit in VENDORS.values())]
        errors.append([np.sum(np.var(offset - offset_at(warm, truth), axis=0))
                       for offset in offsets])
    ours, *theirs = np.mean(errors, axis=0)
    assert ours <= 1.02 * min(theirs)


def test_a_session_with_the_offset_over_temperature_alone_says_so(tmp_path: Path) -> None:
    write_calibration(tmp_path / 'c.yaml', thermal(ramp(3)).calibration)
    driver = Driver(calibration_file=str(tmp_path / 'c.yaml'))
    state, kept = driver.session.state, driver.calibration.model.values
    assert dict(figures(state))['state'] == 'correcting the offset over temperature alone'
    driver.feed([0.1, 0.2, 9.8] + 0.01 * np.random.default_rng(1).normal(size=(100, 3)))
    assert 'the offset over temperature is kept' in driver.ask('calibrate_at_rest')
    assert driver.calibration.model.values.keys() == kept.keys()
    assert driver.calibration.is_levelled
