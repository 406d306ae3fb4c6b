# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Exports: each file, read as its maker reads it, corrects as the calibration does."""

from dataclasses import replace
import io
import json
import re
import shutil
import subprocess

from accel_calib.calibrate import Calibration, GyroBias, Quality
from accel_calib.errors import InputError
from accel_calib.finding import has
from accel_calib.units import Units, units_of
from inside import (
    export, EXPORT_FORMATS, ExportOptions, format_calibration, identifier, Model, model_with,
    parse_calibration, rotation_from_rpy, simulate_poses, spread_directions, terms_of)
import numpy as np
import pytest
from shared import run
import yaml

AFFINE = {'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.012, -0.015, 0.008],
          'cross_axis': [0.006, -0.004, 0.003]}
BY_AXIS = {'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.012, -0.015, 0.008]}
THERMAL = {'offset_temperature': [0.001, -0.0005, 0.0003],
           'offset_temperature_quadratic': [1e-5, -2e-5, 1e-5]}
TEMPERATURE = {**THERMAL, 'gain_temperature': [0.0003, -0.0002, 0.0001]}
BENDING = {'quadratic': [0.003, -0.002, 0.001], 'cubic': [0.002, 0.001, -0.003],
           'odd_quadratic': [0.001, 0.002, 0.001], 'gain_asymmetry': [0.002, 0.001, -0.002],
           'cross_coupling': [0.001, -0.002, 0.001, 0.0005, 0.001, 0.002]}
CURVES = {'empirical-offset-force-1-2': [0.001, 0.002, -0.001, 0.0005, 0.001, -0.002],
          'empirical-gain.z-temperature-1-2': [0.004, -0.002, 12.0, 38.0],
          'empirical-force-direction-3-4': np.linspace(-0.002, 0.003, 16)}
TILTED = rotation_from_rpy(0.1, -0.2, 0.05)
RANGE = (12.0, 38.0)
HOSTILE = ['*/ int x; /*', 'a??/', 'b\\', 'c\n#error', '\u00fcber\u2028\x00', '/**/', '"%s', '']
NOISE = {'accelerometer_noise_density': 1.1e-3, 'accelerometer_random_walk': 1e-5,
         'gyroscope_noise_density': 2e-4, 'gyroscope_random_walk': 3e-6, 'update_rate': 200}


def calibration_of(model, *, unit='m/s2', per_g=None, sensor='imu_link', seed=1, limits=RANGE):
    """Return a calibration with exactly this model, whose poses cover the range of temperature."""
    rng = np.random.default_rng(seed)
    count = 30
    context = {'time': 60.0 * np.arange(count), 'temperature': np.linspace(*limits, count),
               'supply_voltage': rng.uniform(3.2, 3.4, count),
               'previous': spread_directions(count)[rng.permutation(count)]}
    units = units_of(unit) if per_g is None else Units(unit, per_g)
    poses = simulate_poses(model, spread_directions(count), rng, noise_g=0.0005, context=context)
    poses = poses.with_columns(reading=units.from_g(poses.reading),
                               std=units.from_g(poses['std']))
    return Calibration('10', 'ml', model, units, sensor, 'ros', '2026-01-01T00:00:00+00:00',
                       1e-9 * np.eye(int(np.sum(model.stated))),
                       Quality(30.0, 0.1, 5.0, 0.02, 0.2, 0.1, 1.0, 1.0), poses, (), '', ())


def sensor_with(*groups, rotation=None, **options):
    effects = {name: values for group in groups for name, values in group.items()}
    known = {name: values for name, values in effects.items() if '-' not in name}
    model = model_with(known, rotation)
    curves = {name: np.array(effects[name]) for name in effects if '-' in name}
    return calibration_of(Model({**model.values, **curves}, model.rotation), **options)


def samples(calibration, seed=2, size=(0.3, 1.6), limits=RANGE):
    """Return readings in single precision, their temperatures, and the forces of `apply`."""
    rng = np.random.default_rng(seed)
    force = spread_directions(40) * rng.uniform(*size, (40, 1)) * calibration.force_per_g
    temperature = rng.uniform(*limits, 40).astype(np.float32).astype(float)
    known = {'temperature': temperature} if 'temperature' in calibration.model.needs else {}
    reading = calibration.predict(force, known).astype(np.float32).astype(float)
    return reading, temperature, calibration.apply(reading, **known)


def rms_mg(difference):
    return float(np.sqrt(np.mean(np.sum(difference ** 2, axis=1)))) * 1e3


@pytest.fixture(scope='session')
def compiled(tmp_path_factory):
    """Return a function that compiles headers in C and C++ and returns their forces in both."""
    if not (shutil.which('gcc') and shutil.which('g++')):
        pytest.skip('gcc and g++ are not installed')

    def run(headers, reading, temperature):
        folder = tmp_path_factory.mktemp('c')
        for name, text in headers.items():
            (folder / f'{name}.h').write_text(text, encoding='ascii')
        calls = [f'case {k}: {name}_apply(raw, {"t, " if needs(name, text) else ""}force); break;'
                 for k, (name, text) in enumerate(headers.items())]
        includes = ''.join(f'#include "{name}.h"\n#include "{name}.h"\n' for name in headers)
        (folder / 'main.c').write_text(
            f'#include <stdio.h>\n{includes}int main(void)\n{{\n    float raw[3], force[3], t;\n'
            '    int which;\n    while (scanf("%d %f %f %f %f", &which, raw, raw + 1, raw + 2, &t)'
            f' == 5) {{\n    switch (which) {{\n{" ".join(calls)}\n    default: return 1; }}\n'
            '    printf("%.9g %.9g %.9g\\n", (double)force[0], (double)force[1], '
            '(double)force[2]);\n    }\n    return 0;\n}\n', encoding='ascii')
        rows = [f'{k} {" ".join(map(str, values))} {t}' for k in range(len(headers))
                for values, t in zip(reading[k].tolist(), temperature[k].tolist(), strict=True)]
        return [built(folder, language, '\n'.join(rows)).reshape(len(headers), -1, 3)
                for language in (('gcc', '-std=c99'), ('g++', '-std=c++11', '-x', 'c++'))]

    return run


def needs(name, text):
    found = re.search(rf'#define {name.upper()}_NEEDS_TEMPERATURE (\d)', text)
    return found[1] == '1'


def built(folder, language, rows):
    strict = ['-Wall', '-Wextra', '-pedantic', '-Werror', '-Wconversion', '-Wshadow',
              '-Wdouble-promotion', '-Wundef', '-O2']
    subprocess.run([*language, *strict, str(folder / 'main.c'), '-o', str(folder / 'main'), '-lm'],
                   check=True)
    out = subprocess.run([folder / 'main'], input=rows, text=True, capture_output=True, check=True)
    return np.array([line.split() for line in out.stdout.splitlines()], float)


HEADERS = {
    'affine': sensor_with(AFFINE), 'in_g': sensor_with(AFFINE, unit='g'),
    'counts': sensor_with(AFFINE, unit='native', per_g=16412.0),
    'levelled': sensor_with(AFFINE, rotation=TILTED),
    'thermal': sensor_with(AFFINE, TEMPERATURE, rotation=TILTED),
    'bending': sensor_with(AFFINE, BENDING), 'curves': sensor_with(AFFINE, CURVES),
    'all_of_it': sensor_with(AFFINE, TEMPERATURE, BENDING, CURVES, rotation=TILTED,
                             unit='native', per_g=256.0),
    'ideal': sensor_with({}), 'one_temperature': sensor_with(AFFINE, THERMAL, limits=(21.0, 21.0)),
}


@pytest.mark.parametrize('to', ['c', 'arduino'])
def test_a_header_corrects_as_apply_does_in_c_and_in_cpp(to, compiled):
    texts = {name: export(each, to, options=ExportOptions(name=name)).text_or_bytes
             for name, each in HEADERS.items()}
    data = [samples(each) for each in HEADERS.values()]
    for found in compiled(texts, [each[0] for each in data], [each[1] for each in data]):
        for name, forces, (_, _, wanted) in zip(HEADERS, found, data, strict=True):
            error = np.max(np.abs(forces - wanted)) / HEADERS[name].force_per_g
            assert error < 2e-6, name


def test_a_header_holds_the_temperature_in_the_range_of_the_poses(compiled):
    made = HEADERS['thermal']
    reading = np.tile(samples(made)[0][:1], (5, 1))
    temperature = np.array([-40.0, RANGE[0], 90.0, RANGE[1], np.nan])  # nan: the reference
    text = export(made, 'c', options=ExportOptions(name='held')).text_or_bytes
    for found in compiled({'held': text}, [reading], [temperature]):
        np.testing.assert_array_equal(found[0][0], found[0][1])
        np.testing.assert_array_equal(found[0][2], found[0][3])
        np.testing.assert_allclose(found[0], made.apply(reading, temperature=temperature),
                                   atol=3e-6 * 9.8)


@pytest.mark.parametrize('sensor', HOSTILE)
@pytest.mark.parametrize('to', [name for name in EXPORT_FORMATS if name not in ('npz', 'json')])
def test_foreign_text_stays_in_comments(to, sensor):
    """The lines of a file that are not comments do not depend on the names in the calibration."""
    def lines(name):
        made = replace(HEADERS['affine'], sensor=name, date=name, stream='')
        text = export(made, to, NOISE, ExportOptions(name='imu')).text_or_bytes
        return [line for line in text.split('\n') if not re.match(r'#? |# | \*|  "comment"', line)]

    assert lines(sensor) == lines('imu_link')


@pytest.mark.parametrize(('text', 'name'), [
    ('calibration', 'calibration'), ('IMU left/2', 'imu_left_2'), ('9dof', 'accel_9dof'),
    ('', 'accel'), ('*/', 'accel'), ('\u00fc', 'accel'), ('__a__', 'a'), ('x' * 99, 'x' * 40)])
def test_any_text_becomes_an_identifier(text, name):
    assert identifier(text) == name


@pytest.mark.parametrize('name', ['9', 'a b', 'a;', '_a', '\u00fc', 'a' * 42])
def test_a_name_that_is_no_identifier_is_refused(name):
    with pytest.raises(InputError, match='expected a letter'):
        export(HEADERS['affine'], 'c', options=ExportOptions(name=name))


def qgroundcontrol(text):
    """Read a parameter file as QGroundControl does: five columns with tabs."""
    rows = [line.split('\t') for line in text.splitlines() if line and not line.startswith('#')]
    assert all(len(row) == 5 and row[:2] == ['1', '1'] for row in rows)
    assert all(re.fullmatch(r'-?\d+(\.\d+)?', row[3]) for row in rows)
    assert all((row[4] == '6') == ('.' not in row[3]) for row in rows)
    return {row[2]: float(row[3]) for row in rows}


def px4_force(found, reading, temperature, instance=0):
    """Correct readings by the equation of PX4 [m/s²]."""
    def three(pattern):
        return np.array([found[pattern.format(axis)] for axis in 'XYZ'])

    prefix, thermal = f'CAL_ACC{instance}_', f'TC_A{instance}_'
    moved = np.zeros_like(reading)
    if found.get('TC_A_ENABLE'):
        change = np.clip(temperature, found[f'{thermal}TMIN'], found[f'{thermal}TMAX'])
        change = (change - found[f'{thermal}TREF'])[:, np.newaxis]
        for order in range(4):
            moved += change ** order * [found[f'{thermal}X{order}_{k}'] for k in range(3)]
    return (reading - moved - three(prefix + '{}OFF')) * three(prefix + '{}SCALE')


def ardupilot(text, tmp_path):
    """Read a parameter file with the library of MAVProxy."""
    mavparm = pytest.importorskip('pymavlink.mavparm')
    path = tmp_path / 'ardupilot.param'
    path.write_text(text, encoding='ascii')
    found = mavparm.MAVParmDict()
    assert found.load(str(path))
    assert len(found) == sum(not line.startswith('#') for line in text.splitlines())
    return dict(found)


def ardupilot_force(found, reading, temperature, instance=1):
    """Correct readings by the equation of ArduPilot [m/s²]."""
    number = '' if instance == 1 else instance
    prefix = f'INS_TCAL{instance}_'

    def three(name):
        return np.array([found[f'{name}_{axis}'] for axis in 'XYZ'])

    def polynomial(value):
        change = np.atleast_1d(np.clip(value, found[f'{prefix}TMIN'], found[f'{prefix}TMAX']))
        return sum((change - 35.0)[:, np.newaxis] ** (k + 1) * three(f'{prefix}ACC{k + 1}')
                   for k in range(3)) * 1e-6

    corrected = reading.copy()
    if found.get(f'{prefix}ENABLE') == 1.0:
        corrected += polynomial(found[f'INS_ACC{instance}_CALTEMP']) - polynomial(temperature)
    return (corrected - three(f'INS_ACC{number}OFFS')) * three(f'INS_ACC{number}SCAL')


@pytest.mark.parametrize('unit', ['m/s2', 'g'])
@pytest.mark.parametrize('limits', [RANGE, (-10.0, 20.0), (40.0, 70.0)])
@pytest.mark.parametrize('thermal', [{}, THERMAL])
def test_autopilots_correct_as_apply_does_if_there_is_no_cross_axis_gain(unit, limits, thermal,
                                                                         tmp_path):
    made = sensor_with(BY_AXIS, thermal, unit=unit, limits=limits)
    reading, temperature, wanted = samples(made, limits=limits)
    factor = 1.0 if unit == 'm/s2' else 9.80665
    px4, other = (export(made, to) for to in ('px4', 'ardupilot'))
    assert (px4.losses, other.losses) == ((), ())
    for forces in (px4_force(qgroundcontrol(px4.text_or_bytes), reading * factor, temperature),
                   ardupilot_force(ardupilot(other.text_or_bytes, tmp_path), reading * factor,
                                   temperature)):
        np.testing.assert_allclose(forces, wanted * factor, atol=2e-5)


def test_the_parameters_of_an_autopilot_have_its_instance_and_device(tmp_path):
    made = sensor_with(BY_AXIS, THERMAL)
    reading, temperature, wanted = samples(made)
    px4 = qgroundcontrol(export(made, 'px4', options=ExportOptions(instance=2, device_id=2490378)
                                ).text_or_bytes)
    assert (px4['CAL_ACC2_ID'], px4['TC_A2_ID']) == (2490378, 2490378)
    np.testing.assert_allclose(px4_force(px4, reading, temperature, 2), wanted, atol=2e-5)
    for instance in (1, 2, 3):
        text = export(made, 'ardupilot', options=ExportOptions(instance=instance, device_id=7)
                      ).text_or_bytes
        found = ardupilot(text, tmp_path)
        assert found[f'INS_ACC{"" if instance == 1 else instance}_ID'] == 7
        np.testing.assert_allclose(ardupilot_force(found, reading, temperature, instance), wanted,
                                   atol=2e-5)
    for to in ('px4', 'ardupilot'):
        with pytest.raises(InputError, match='--instance is 9'):
            export(made, to, options=ExportOptions(instance=9))


@pytest.mark.parametrize('to', ['px4', 'ardupilot', 'betaflight'])
def test_readings_from_ros_are_turned_to_the_axes_of_the_autopilot(to, tmp_path):
    turn = np.array([1.0, -1.0, -1.0])
    made = sensor_with(BY_AXIS, THERMAL)
    reading, temperature, wanted = samples(made)
    same, turned = (export(made, to, options=ExportOptions(axes=axes)) for axes in ('same', 'flu'))
    assert turned.leaves_mg == pytest.approx(same.leaves_mg, rel=1e-6, abs=1e-6)
    if to == 'betaflight':
        counts = [np.array(betaflight(each.text_or_bytes)) for each in (same, turned)]
        np.testing.assert_array_equal(counts[0] * turn, counts[1])
        return
    found = (px4_force(qgroundcontrol(turned.text_or_bytes), reading * turn, temperature)
             if to == 'px4' else ardupilot_force(ardupilot(turned.text_or_bytes, tmp_path),
                                                 reading * turn, temperature))
    np.testing.assert_allclose(found, wanted * turn, atol=2e-5)


@pytest.mark.parametrize('to', ['px4', 'ardupilot'])
def test_counts_are_refused_for_an_autopilot_that_works_in_metric_units(to):
    with pytest.raises(InputError, match='native readings, but .* m/s2'):
        export(HEADERS['counts'], to)


def betaflight(text):
    """Read the commands of Betaflight: three offsets of 16 bits, and 1."""
    lines = [line for line in text.splitlines() if not line.startswith('#')]
    found = re.fullmatch(r'set acc_calibration = (-?\d+),(-?\d+),(-?\d+),1', lines[0])
    assert lines[1:] == ['save']
    assert all(-32768 <= int(value) <= 32767 for value in found.groups())
    return [int(value) for value in found.groups()]


@pytest.mark.parametrize(('options', 'unit', 'per_g', 'scale'), [
    (ExportOptions(), 'm/s2', None, 2048.0), (ExportOptions(), 'g', None, 2048.0),
    (ExportOptions(counts_per_g=4096.0), 'm/s2', None, 4096.0),
    (ExportOptions(), 'native', 2048.0, 2048.0), (ExportOptions(), 'native', 500.0, 500.0)])
def test_betaflight_gets_its_offsets_in_counts(options, unit, per_g, scale):
    made = sensor_with(BY_AXIS, unit=unit, per_g=per_g)
    assert betaflight(export(made, 'betaflight', options=options).text_or_bytes) == [
        round(each * scale) for each in BY_AXIS['offset']]


def test_an_offset_that_betaflight_cannot_hold_is_refused():
    with pytest.raises(InputError, match='counts, expected at most 32767'):
        export(sensor_with(BY_AXIS), 'betaflight', options=ExportOptions(counts_per_g=1e6))


@pytest.mark.parametrize('name', ['affine', 'in_g', 'counts', 'levelled'])
def test_imu_calib_corrects_as_apply_does(name):
    reading, _, wanted = samples(HEADERS[name])
    found = yaml.safe_load(export(HEADERS[name], 'imu_calib').text_or_bytes)
    assert set(found) == {'SM', 'bias'}
    assert all(isinstance(value, float) for value in found['SM'] + found['bias'])
    forces = reading @ np.reshape(found['SM'], (3, 3)).T - found['bias']
    np.testing.assert_allclose(forces, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('name', ['affine', 'in_g', 'counts', 'levelled'])
def test_imucal_corrects_as_apply_does(name):
    imucal = pytest.importorskip('imucal')
    gyro = GyroBias(np.array([0.01, -0.02, 0.005]), np.full(3, 1e-4), 12, np.nan, np.zeros(3),
                    ())
    made = replace(HEADERS[name], gyro=gyro)
    reading, _, wanted = samples(made)
    found = imucal.FerrarisCalibrationInfo.from_json(export(made, 'imucal').text_or_bytes)
    units = {'affine': 'm/s^2', 'levelled': 'm/s^2', 'in_g': 'g', 'counts': 'a.u.'}
    forces, rates = found.calibrate(reading, np.tile(gyro.bias + np.eye(3)[2],
                                                     (len(reading), 1)), units[name], 'rad/s')
    factor = 9.80665 if name == 'counts' else 1.0
    np.testing.assert_allclose(forces, wanted * factor, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(rates[0], made.rotation.T @ [0.0, 0.0, 1.0], atol=1e-12)
    assert found.acc_unit == ('g' if name == 'in_g' else 'm/s^2')


def test_kalibr_gets_the_noise_as_numbers():
    found = yaml.safe_load(export(HEADERS['affine'], 'kalibr', NOISE).text_or_bytes)
    assert found == {**NOISE, 'rostopic': '/imu0'}
    assert all(isinstance(found[key], float) for key in NOISE)
    named = replace(HEADERS['affine'], stream='/left/imu: "x"')
    assert yaml.safe_load(export(named, 'kalibr', NOISE).text_or_bytes
                          )['rostopic'] == '/left/imu: "x"'


def test_vins_gets_the_noise_of_one_sample():
    found = yaml.safe_load(export(HEADERS['affine'], 'vins', NOISE).text_or_bytes)
    assert found == {'acc_n': pytest.approx(1.1e-3 * 200 ** 0.5),
                     'gyr_n': pytest.approx(2e-4 * 200 ** 0.5),
                     'acc_w': pytest.approx(1e-5 * 200 ** 0.5),
                     'gyr_w': pytest.approx(3e-6 * 200 ** 0.5), 'g_norm': 9.80665}


@pytest.mark.parametrize('to', ['kalibr', 'vins'])
@pytest.mark.parametrize(('noise', 'message'), [
    (None, '--noise is not given'), ({}, 'has no accelerometer_noise_density'),
    ({**NOISE, 'gyroscope_random_walk': None}, 'has no gyroscope_random_walk'),
    ({**NOISE, 'update_rate': 0.0}, 'has update_rate 0.0'),
    ({**NOISE, 'update_rate': True}, 'has update_rate True'),
    ({**NOISE, 'update_rate': float('nan')}, 'has update_rate nan'),
    ({**NOISE, 'update_rate': '200'}, "has update_rate '200'")])
def test_noise_that_is_missing_is_refused(to, noise, message):
    with pytest.raises(InputError, match=re.escape(message)):
        export(HEADERS['affine'], to, noise)


@pytest.mark.parametrize('to', ['kalibr', 'vins'])
def test_a_random_walk_that_is_not_seen_is_written_as_its_upper_limit(to):
    noise = {**NOISE, 'accelerometer_random_walk': None,
             'accelerometer_random_walk_axes_upper': [2e-5, 4e-5, 3e-5],
             'accelerometer_random_walk_reason': 'the rest is too short'}
    made = export(HEADERS['affine'], to, noise)
    limit = export(HEADERS['affine'], to, {**NOISE, 'accelerometer_random_walk': 4e-5})
    assert yaml.safe_load(made.text_or_bytes) == yaml.safe_load(limit.text_or_bytes)
    assert 'upper limit' in made.text_or_bytes
    assert 'accelerometer_random_walk is not seen (the rest is too short)' in made.notes[-1]
    with pytest.raises(InputError, match='has no accelerometer_random_walk: the rest is too'):
        export(HEADERS['affine'], to, {**noise, 'accelerometer_random_walk_axes_upper': [None]})


@pytest.mark.parametrize('name', HEADERS)
def test_json_and_npz_hold_everything(name):
    made = HEADERS[name]
    text, archive = (export(made, to).text_or_bytes for to in ('json', 'npz'))
    found = json.loads(text)
    arrays = np.load(io.BytesIO(archive), allow_pickle=False)
    for key in ('matrix', 'offset', 'rotation', 'gain', 'values', 'covariance'):
        np.testing.assert_array_equal(np.reshape(found[key], arrays[key].shape), arrays[key])
    values = {key: [each[part] for part in terms_of((key,)).effects[0].values if part in each]
              for key, each in found['effects'].items()}
    assert json.loads(str(arrays['effects'])) == found['effects']
    again = replace(made, model=Model({key: np.array(each) for key, each in values.items()},
                                      np.array(found['rotation'])))
    reading, temperature, wanted = samples(made)
    known = {'temperature': temperature} if 'temperature' in made.model.needs else {}
    np.testing.assert_allclose(again.apply(reading, **known), wanted)
    assert export(made, 'json').losses == ()


def test_json_states_what_matrix_and_offset_leave_alone():
    made = export(HEADERS['bending'], 'json')
    found = json.loads(made.text_or_bytes)
    reading = HEADERS['bending'].predict(spread_directions(300) * 9.80665)
    forces = (reading - found['offset']) @ np.transpose(found['matrix'])
    left = rms_mg(forces / 9.80665 - spread_directions(300))
    assert f'leave {left:.2g} mg' in made.notes[0]
    assert export(HEADERS['affine'], 'json').notes == ()


def test_the_loss_is_the_difference_that_the_written_values_leave(tmp_path):
    made = sensor_with(AFFINE, BENDING)
    force = spread_directions(300)
    reading = made.predict(force * 9.80665)
    for to, found in (
            ('px4', px4_force(qgroundcontrol(export(made, 'px4').text_or_bytes), reading, None)),
            ('ardupilot', ardupilot_force(ardupilot(export(made, 'ardupilot').text_or_bytes,
                                                    tmp_path), reading, None))):
        left = rms_mg(found / 9.80665 - force)
        assert export(made, to).leaves_mg == pytest.approx(left, rel=1e-6)
        assert export(made, to).losses[-1].endswith(f'leaves {left:.2g} mg in all')


@pytest.mark.parametrize(('effects', 'to', 'words'), [
    ({'gain_temperature': [0.0005] * 3}, 'px4', 'PX4 has no gain that changes with temperature'),
    ({'offset_temperature': [0.001] * 3}, 'imucal', 'imucal has no offset that changes with'),
    ({'offset_temperature': [1e-3, 1e-3, 1e-3, 900.0, 0.0]}, 'c', 'C header has no lag (900 s)'),
    ({'offset_drift': [0.01, 0.02, 0.01, 0.0]}, 'c', 'C header has no offset that drifts'),
    ({'supply_ratio': [1.0, 0.1, 0.1, 0.1]}, 'c', 'C header has no offset and gain in proportion'),
    ({'temperature_rate': [1.0] * 3}, 'c', 'C header has no offset in proportion to the rate'),
    ({'hysteresis': [0.002] * 3}, 'c', 'C header has no offset that depends on the previous'),
    ({'quadratic': [0.003] * 3}, 'imu_calib', 'imu_calib has no square of the force')])
def test_effects_that_a_format_lacks_are_losses_in_numbers(effects, to, words):
    made = export(sensor_with(AFFINE if to != 'px4' else BY_AXIS, effects), to)
    assert len(made.losses) == 1
    assert made.losses[0].startswith(words)
    assert made.details[0].leaves_mg == pytest.approx(made.leaves_mg, rel=0.02)
    assert made.leaves_mg > 0.1


def test_a_drift_is_exported_as_it_was_at_the_last_pose(compiled):
    made = sensor_with(AFFINE, {'offset_drift': [0.01, 0.02, 0.01, 0.0]})
    reading = samples(sensor_with(AFFINE))[0]
    text = export(made, 'c', options=ExportOptions(name='later')).text_or_bytes
    for found in compiled({'later': text}, [reading], [np.zeros(len(reading))]):
        np.testing.assert_allclose(found[0], made.apply(reading, time=1e9), atol=3e-6 * 9.8)


def test_the_mounting_is_a_loss_where_a_format_does_not_hold_it():
    levelled = sensor_with(BY_AXIS, rotation=rotation_from_rpy(0.0, np.radians(3.0), 0.0))
    for to in ('px4', 'ardupilot', 'betaflight'):
        made = export(levelled, to)
        assert any('leaves the rotation of 3.00 deg' in line for line in made.losses)
        assert made.leaves_mg == pytest.approx(export(sensor_with(BY_AXIS), to).leaves_mg)
    for to in ('c', 'imu_calib', 'imucal', 'json'):
        assert export(levelled, to).losses == ()


def test_a_stored_correction_that_was_edited_is_reported_and_not_used():
    made = HEADERS['affine']
    text = format_calibration(made)
    first = repr(made.matrix.tolist()[0][0])
    edited = text.replace(f'[{first},', '[1.5,', 1)
    assert edited != text
    found = parse_calibration(edited, 'c.yaml')
    assert has(found.noted, 'correction_in_file')
    np.testing.assert_array_equal(found.matrix, made.matrix)
    again = parse_calibration(format_calibration(found), 'c.yaml')
    assert not has(again.noted, 'correction_in_file')
    changed = text.replace('residual', 'residual ', 1).replace('sensor: imu_link', 'sensor: other')
    assert not has(parse_calibration(changed, 'c.yaml').noted, 'correction_in_file')


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / 'calibration.yaml'
    path.write_text(format_calibration(HEADERS['affine']), encoding='utf-8')
    return path


@pytest.mark.parametrize('to', EXPORT_FORMATS)
def test_the_command_writes_beside_the_calibration(to, stored, tmp_path, capsys):
    noise = tmp_path / 'noise.json'
    noise.write_text(json.dumps(NOISE), encoding='utf-8')
    before = stored.read_bytes()
    assert run('export', stored, '--to', to, '--noise', noise) == 0
    path = tmp_path / f'calibration{EXPORT_FORMATS[to].suffix}'
    wanted = export(HEADERS['affine'], to, NOISE, ExportOptions(name='calibration'))
    content = wanted.text_or_bytes
    assert path.read_bytes() == (content if isinstance(content, bytes) else content.encode())
    assert stored.read_bytes() == before
    printed = capsys.readouterr()
    assert printed.out == ''
    for line in wanted.losses:
        assert line in ' '.join(printed.err.split())
    assert f'stored in {path}' in ' '.join(printed.err.split())


def test_the_command_writes_to_standard_output_and_its_losses_to_standard_error(stored, capfd):
    assert run('export', stored, '--to', 'px4', '-o', '-') == 0
    printed = capfd.readouterr()
    assert printed.out == export(HEADERS['affine'], 'px4').text_or_bytes
    assert 'PX4 has no cross-axis gain: leaves 6.4 mg' in printed.err


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--to', 'c', '-o', 'calibration.yaml'], 'is an input'),
    (['--to', 'c', '-o', 'none/imu.h'], 'is not a folder'),
    (['--to', 'json', '-o', '-', '--json', '-'], 'are both -'),
    (['--to', 'kalibr'], '--noise is not given'),
    (['--to', 'kalibr', '--noise', 'calibration.yaml'], 'is not a JSON file'),
    (['--to', 'kalibr', '--noise', 'list.json'], 'contains no JSON object'),
    (['--to', 'kalibr', '--noise', 'none.json'], 'none.json'),
    (['--to', 'c', '--name', '*/'], 'expected a letter')])
def test_the_command_refuses_in_one_line_and_writes_nothing(arguments, message, stored, tmp_path,
                                                            monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'list.json').write_text('[1]', encoding='utf-8')
    before = stored.read_bytes()
    assert run('export', 'calibration.yaml', *arguments) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith('accel-calib export: ')
    assert message in printed.err
    assert printed.err.count('\n') == 1
    assert stored.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ['calibration.yaml', 'list.json']
