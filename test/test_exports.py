# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Exports: each file, read as its maker reads it, corrects as the calibration does."""

from contextlib import suppress
from dataclasses import replace
import io
from itertools import product
import json
import re
import shutil
import subprocess

from accel_calib.calibration import Calibration, GyroBias, Quality
from accel_calib.effects import effect_named, entry_of
from accel_calib.errors import InputError
from accel_calib.stored import read_calibration
from accel_calib.units import Units, units_of
from inside import (
    export, EXPORT_FORMATS, ExportOptions, identifier, model_with, rotation_from_rpy,
    simulate_poses, spread_directions)
import numpy as np
import pytest
from shared import KNOWN as AFFINE, rms, ROOT, run, table
import yaml

BY_AXIS = {name: AFFINE[name] for name in ('offset', 'axis_gain')}
THERMAL, BENDING, CURVES, NOISE = (table('exported_effects')[name] for name in (
    'thermal', 'bending', 'curves', 'noise'))
TEMPERATURE = {**THERMAL, 'gain_temperature': [0.0003, -0.0002, 0.0001]}
GYRO = GyroBias(np.array([0.01, -0.02, 0.005]), np.full(3, 1e-4), 12, np.nan, np.zeros(3), ())
TILTED = rotation_from_rpy(0.1, -0.2, 0.05)
RANGE = (12.0, 38.0)


def sensor_with(*groups, rotation=None, unit='m/s2', per_g=None, limits=RANGE):
    """Return a calibration with exactly these effects, whose poses cover the temperatures."""
    effects = {name: values for group in groups for name, values in group.items()}
    model = model_with(effects, rotation)
    rng, count = np.random.default_rng(1), 30
    context = {'time': 60.0 * np.arange(count), 'temperature': np.linspace(*limits, count),
               'supply_voltage': rng.uniform(3.2, 3.4, count),
               'previous': spread_directions(count)[rng.permutation(count)]}
    units = units_of(unit) if per_g is None else Units(unit, per_g)
    poses = simulate_poses(model, spread_directions(count), rng, noise_g=0.0005, context=context)
    poses = poses.with_columns(reading=units.from_g(poses.reading), std=units.from_g(poses['std']))
    return Calibration('10', 'ml', model, units, 'imu_link', 'ros', '2026-01-01T00:00:00+00:00',
                       1e-9 * np.eye(int(np.sum(model.stated))),
                       Quality(30.0, 0.1, 5.0, 0.02, 0.2, 0.1, 1.0, 1.0), poses, (), '', ())


def text_of(calibration, to, noise=None, **options):
    return export(calibration, to, noise, ExportOptions(**options)).text_or_bytes


def samples(calibration, limits=RANGE):
    """Return readings in single precision, their temperatures, and the forces of `apply`."""
    rng = np.random.default_rng(2)
    force = spread_directions(40) * rng.uniform(0.3, 1.6, (40, 1)) * calibration.force_per_g
    temperature = rng.uniform(*limits, 40).astype(np.float32).astype(float)
    known = known_of(calibration, temperature)
    reading = calibration.predict(force, known).astype(np.float32).astype(float)
    return reading, temperature, calibration.apply(reading, **known)


def known_of(calibration, temperature):
    """Return the context that a calibration needs; its drift ends with the last pose."""
    known = {'temperature': temperature, 'time': np.full(len(temperature), 1e9)}
    return {name: known[name] for name in calibration.model.needs if name in known}


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
        (folder / 'cases.h').write_text(f'{includes}#define CASES {" ".join(calls)}\n')
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
    subprocess.run([*language, *strict, f'-I{folder}', ROOT / 'test' / 'data' / 'headers.c', '-o',
                    folder / 'main', '-lm'], check=True)
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
    'drifting': sensor_with(AFFINE, {'offset_drift': [0.01, 0.02, 0.01, 0.0]}),
}


@pytest.mark.parametrize('to', ['c', 'arduino'])
def test_a_header_corrects_as_apply_does_in_c_and_in_cpp(to, compiled):
    texts = {name: text_of(each, to, name=name) for name, each in HEADERS.items()}
    readings, temperatures, _ = zip(*map(samples, HEADERS.values()))
    for temperature in temperatures:  # nan: not known
        temperature[:3] = -40.0, 90.0, np.nan
    for found in compiled(texts, readings, temperatures):
        for name, forces, reading, temperature in zip(
                HEADERS, found, readings, temperatures, strict=True):
            made = HEADERS[name]
            wanted = made.apply(reading, **known_of(made, temperature))
            assert np.max(np.abs(forces - wanted)) / made.force_per_g < 2e-6, name


@pytest.mark.parametrize(('text', 'name'), table('identifiers'))
def test_any_text_becomes_an_identifier(text, name):
    assert identifier(text) == name


@pytest.mark.parametrize(('name', 'to', 'options', 'message'), table('export_refused'))
def test_what_a_format_cannot_hold_is_refused(name, to, options, message):
    made = sensor_with({'offset': [20.0, 0.0, 0.0]}) if name == 'vast' else HEADERS[name]
    with pytest.raises(InputError, match=message):
        text_of(made, to, **options)


def qgroundcontrol(text):
    """Read a parameter file as QGroundControl does: five columns with tabs."""
    rows = [line.split('\t') for line in text.splitlines() if line and not line.startswith('#')]
    assert all(len(row) == 5 and row[:2] == ['1', '1'] for row in rows)
    assert all(re.fullmatch(r'-?\d+(\.\d+)?', row[3]) for row in rows)
    assert all((row[4] == '6') == ('.' not in row[3]) for row in rows)
    return {row[2]: float(row[3]) for row in rows}


def px4_force(found, reading, temperature, instance=0, thermal=None):
    """Correct readings by the equation of PX4 [m/s²]."""
    def three(pattern):
        return np.array([found[pattern.format(axis)] for axis in 'XYZ'])

    prefix, thermal = f'CAL_ACC{instance}_', f'TC_A{instance if thermal is None else thermal}_'
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


def by_autopilot(to, text, reading, temperature, tmp_path, *instance):
    """Return parameters as an autopilot reads them, and readings [m/s²] as it corrects them."""
    if to == 'px4':
        found = qgroundcontrol(text)
        return found, px4_force(found, reading, temperature, *instance)
    found = ardupilot(text, tmp_path)
    return found, ardupilot_force(found, reading, temperature, *instance)


@pytest.mark.parametrize('to', ['px4', 'ardupilot'])
@pytest.mark.parametrize('unit', ['m/s2', 'g'])
@pytest.mark.parametrize('limits', [RANGE, (-10.0, 20.0), (40.0, 70.0)])
@pytest.mark.parametrize('thermal', [{}, THERMAL])
def test_autopilots_correct_as_apply_does_if_there_is_no_cross_axis_gain(
        to, unit, limits, thermal, tmp_path):
    made = sensor_with(BY_AXIS, thermal, unit=unit, limits=limits)
    reading, temperature, wanted = samples(made, limits)
    factor, found = 1.0 if unit == 'm/s2' else 9.80665, export(made, to)
    assert found.losses == ()
    _, force = by_autopilot(to, found.text_or_bytes, reading * factor, temperature, tmp_path)
    np.testing.assert_allclose(force, wanted * factor, atol=2e-5)


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
    _, force = by_autopilot(to, turned.text_or_bytes, reading * turn, temperature, tmp_path)
    np.testing.assert_allclose(force, wanted * turn, atol=2e-5)


def betaflight(text):
    """Read the commands of Betaflight: three offsets of 16 bits, and 1."""
    lines = [line for line in text.splitlines() if not line.startswith('#')]
    found = re.fullmatch(r'set acc_calibration = (-?\d+),(-?\d+),(-?\d+),1', lines[0])
    assert lines[1:] == ['save']
    assert all(-32768 <= int(value) <= 32767 for value in found.groups())
    return [int(value) for value in found.groups()]


@pytest.mark.parametrize(('options', 'unit', 'per_g', 'scale'), [
    ({}, 'm/s2', None, 2048.0), ({}, 'g', None, 2048.0),
    ({'counts_per_g': 4096.0}, 'm/s2', None, 4096.0), ({}, 'native', 2048.0, 2048.0),
    ({}, 'native', 500.0, 500.0)])
def test_betaflight_gets_its_offsets_in_counts(options, unit, per_g, scale):
    made = sensor_with(BY_AXIS, unit=unit, per_g=per_g)
    assert betaflight(text_of(made, 'betaflight', **options)) == [
        round(each * scale) for each in BY_AXIS['offset']]
    losses = export(made, 'betaflight', options=ExportOptions(**options)).losses
    assert all(' offset to counts: ' in each for each in losses if 'rounds' in each)
    losses = export(made, 'inav', options=ExportOptions(**options)).losses
    assert all(' rounds the ' in each or each.startswith('iNav leaves ') for each in losses)


@pytest.mark.parametrize('given', [
    {'name': 'imu'}, {'instance': 2}, {'device_id': 7}, {'axes': 'flu'}, {'counts_per_g': 900.0},
    {'noise': NOISE}])
def test_an_option_changes_the_file_or_is_refused(given):
    made = {unit: sensor_with(BY_AXIS, unit=unit, per_g=per_g)
            for unit, per_g in (('m/s2', None), ('native', 1000.0))}
    taken = set()
    for to, unit in product(EXPORT_FORMATS, made):
        options = {'noise': NOISE, **given} if 'noise' in EXPORT_FORMATS[to].takes else given
        with suppress(InputError):
            text = text_of(made[unit], to, **options)
            taken.add(to)
            assert 'noise' in options or text != text_of(made[unit], to)
    assert taken == {to for to, each in EXPORT_FORMATS.items() if {*given} <= {*each.takes}}
    with pytest.raises(InputError, match='takes no --'):
        text_of(made['m/s2'], 'json', **given)


def imu_calib(text, raw):
    """Correct readings by SM and bias, in the unit of the readings."""
    found = yaml.safe_load(text)
    assert set(found) == {'SM', 'bias'}
    assert all(isinstance(value, float) for value in found['SM'] + found['bias'])
    return raw @ np.reshape(found['SM'], (3, 3)).T - found['bias']


@pytest.mark.parametrize('name', ['affine', 'in_g', 'counts', 'levelled'])
def test_imucal_corrects_as_apply_does(name):
    imucal = pytest.importorskip('imucal')
    made = replace(HEADERS[name], gyro=GYRO)
    reading, _, wanted = samples(made)
    found = imucal.FerrarisCalibrationInfo.from_json(text_of(made, 'imucal'))
    units = {'affine': 'm/s^2', 'levelled': 'm/s^2', 'in_g': 'g', 'counts': 'a.u.'}
    forces, rates = found.calibrate(reading, np.tile(GYRO.bias + np.eye(3)[2],
                                                     (len(reading), 1)), units[name], 'rad/s')
    factor = 9.80665 if name == 'counts' else 1.0
    np.testing.assert_allclose(forces, wanted * factor, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(rates[0], made.rotation.T @ [0.0, 0.0, 1.0], atol=1e-12)
    assert found.acc_unit == ('g' if name == 'in_g' else 'm/s^2')


def inav(text, raw):
    """Correct counts by applyAccelerationZero of iNav, with its integers and their ranges [g]."""
    found = dict(re.findall(r'^set (\w+) = (-?\d+)$', text, re.M))
    zero, gain = (np.array([int(found.pop(f'acc{name}_{axis}')) for axis in 'xyz'])
                  for name in ('zero', 'gain'))
    assert not found
    assert text.endswith('\nsave\n')
    assert np.all((np.abs(zero) < 2 ** 15) & (gain >= 1) & (gain <= 8192))
    return np.fix((np.round(raw * 2048).astype(int) - zero) * gain / 4096) / 2048


def mpu6050(text, raw):
    """Add the change to words with a factory trim, and return what the chip then reads [g]."""
    change = np.array(re.findall(r'change\[3\] = {(.*)};', text)[0].split(','), int)
    factory = np.random.default_rng(3).integers(-9000, 9000, 3)
    words = (factory + change).astype(np.int16)
    np.testing.assert_array_equal(words & 1, factory & 1)  # reserved
    return raw + ((words >> 1) - (factory >> 1)) / 1024


def fusion(text, raw):
    """Correct readings by FusionModelInertial, in single precision [g]."""
    found = {name: np.array(re.findall(r'([^{ ,]+)f', body), np.float32)
             for name, body in re.findall(r'^static const \w+ (\w+) = {(.*)};', text, re.M)}
    matrix, sensitivity, offset = (found[f'accelerometer{name}'] for name in (
        'Misalignment', 'Sensitivity', 'Offset'))
    return ((raw.astype(np.float32) - offset) * sensitivity) @ matrix.reshape(3, 3).T


def realsense(text, raw):
    """Correct readings as check_X of rs-imu-calibration: with one row for each column of raw."""
    found = json.loads(text)['imus'][0]['accelerometer']
    return np.column_stack([raw, -np.ones(len(raw))]) @ np.reshape(
        found['scale_and_alignment'] + found['bias'], (4, 3))


def openvins(text, raw):
    """Correct readings as the Propagator of OpenVINS, from the bias that it starts with."""
    first, rest = text.split('\n', 1)
    assert first == '%YAML:1.0'
    found = yaml.safe_load(rest)['imu0']
    assert {**found, **NOISE, 'model': 'kalibr'} == found
    np.testing.assert_array_equal([found['Tw'], found['R_IMUtoGYRO']], [np.eye(3)] * 2)
    scale = np.linalg.inv(found['Ta'])
    np.testing.assert_allclose(np.triu(scale, 1), 0.0, atol=1e-12)  # not read for kalibr
    turn, bias = np.array(found['R_IMUtoACC']), re.search(r'init_dyn_bias_a: (\[.*\])', text)[1]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    return (raw - json.loads(bias)) @ scale.T @ turn


def dlio(text, raw):
    """Correct readings by callbackImu of DLIO, in single precision."""
    found = yaml.safe_load(text)['/**']['ros__parameters']
    assert found['imu/calibration'] is False
    matrix, bias = (np.array(found[f'imu/intrinsics/accel/{name}'], np.float32)
                    for name in ('sm', 'bias'))
    return raw.astype(np.float32) @ matrix.reshape(3, 3).T - bias


USERS = {  # with the unit of readings and forces, what is held, and the largest difference [g]
    inav: ('g', ('offset', 'axis_gain'), 2.1 / 2048), mpu6050: ('g', ('offset',), 1.01 / 2048),
    fusion: ('own', AFFINE, 1e-6), realsense: ('m/s2', AFFINE, 1e-12),
    openvins: ('m/s2', AFFINE, 2e-6), dlio: ('m/s2', AFFINE, 1e-6),
    imu_calib: ('like apply', AFFINE, 1e-9)}


@pytest.mark.parametrize(('user', 'unit', 'per_g'), [
    *((user, unit, None) for user in USERS for unit in ('m/s2', 'g')),
    *((user, 'native', 2071.0) for user in (inav, fusion, imu_calib))])
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_a_program_corrects_from_its_file_as_apply_does(user, unit, per_g, seed):
    needed, held, most = USERS[user]
    rng = np.random.default_rng(seed)
    effects = {name: rng.uniform(-0.04, 0.04, 3) for name in held}
    turned = user in (fusion, realsense, imu_calib)
    turn = rotation_from_rpy(*rng.uniform(-0.3, 0.3, 3)) if turned else None
    made = sensor_with(effects, rotation=turn, unit=unit, per_g=per_g)
    count = made.units.per_g / 2048 if per_g is None else 1.0
    reading = np.round(samples(made)[0] / count) * count
    raw = reading / count / 2048 * {'g': 1.0, 'm/s2': 9.80665}.get(needed, 2048 * count)
    noise = NOISE if 'noise' in EXPORT_FORMATS[user.__name__].takes else None
    found = export(made, user.__name__, noise)
    force = user(found.text_or_bytes, raw) / {
        'm/s2': 9.80665, 'like apply': made.force_per_g}.get(needed, 1.0)
    np.testing.assert_allclose(force, made.apply(reading) / made.force_per_g, atol=most)
    assert user is openvins or found.leaves_mg < 2e3 * most  # a vector


def test_the_gyro_is_turned_where_the_file_says_so():
    made, rate = replace(HEADERS['levelled'], gyro=GYRO), np.array([0.1, 0.2, 0.3])
    found = json.loads(text_of(made, 'realsense'))['imus'][0]['gyroscope']
    turned = (GYRO.bias + rate) @ np.reshape(found['scale_and_alignment'], (3, 3)) - found['bias']
    np.testing.assert_allclose(turned, TILTED.T @ rate, atol=1e-12)
    matrix = re.search(r'gyroscopeMisalignment = {(.*)};', text_of(made, 'fusion'))[1]
    np.testing.assert_allclose(np.array(matrix.replace('f', '').split(','), float).reshape(3, 3),
                               TILTED.T, atol=1e-7)
    node = yaml.safe_load(text_of(made, 'dlio'))['/**']['ros__parameters']
    np.testing.assert_array_equal(node['imu/intrinsics/gyro/bias'], GYRO.bias)
    assert any('rotation of' in line for line in export(made, 'dlio').losses)


@pytest.mark.parametrize(('stream', 'topic'), [('', '/imu0'), ('/left/imu: "x"',) * 2])
def test_kalibr_gets_the_noise_as_numbers(stream, topic):
    made = replace(HEADERS['affine'], stream=stream)
    found = yaml.safe_load(text_of(made, 'kalibr', NOISE))
    assert found == {**NOISE, 'rostopic': topic}
    assert all(isinstance(found[key], float) for key in NOISE)


def test_vins_gets_the_noise_of_one_sample():
    assert yaml.safe_load(text_of(HEADERS['affine'], 'vins', NOISE)) == {
        'acc_n': pytest.approx(1.1e-3 * 200 ** 0.5),
        'gyr_n': pytest.approx(2e-4 * 200 ** 0.5), 'acc_w': pytest.approx(1e-5 * 200 ** 0.5),
        'gyr_w': pytest.approx(3e-6 * 200 ** 0.5), 'g_norm': 9.80665}


@pytest.mark.parametrize('to', ['kalibr', 'vins', 'openvins'])
@pytest.mark.parametrize(('noise', 'message'), [
    (None, '--noise is not given'), ({}, 'has no accelerometer_noise_density'),
    ({**NOISE, 'update_rate': 10**400}, 'has update_rate 1000'),
    *(({**NOISE, **changed}, words) for changed, words in table('missing_noise'))])
def test_noise_that_is_missing_is_refused(to, noise, message):
    with pytest.raises(InputError, match=re.escape(message)):
        export(HEADERS['affine'], to, noise)


@pytest.mark.parametrize('to', ['kalibr', 'vins'])
def test_a_random_walk_that_is_not_seen_is_written_as_its_upper_limit(to):
    noise = {**NOISE, 'accelerometer_random_walk': None,
             'accelerometer_random_walk_axes_upper': [2e-5, 4e-5, 3e-5],
             'accelerometer_random_walk_reason': 'the rest is too short'}
    made = export(HEADERS['affine'], to, noise)
    limit = text_of(HEADERS['affine'], to, {**NOISE, 'accelerometer_random_walk': 4e-5})
    assert yaml.safe_load(made.text_or_bytes) == yaml.safe_load(limit)
    assert noise['accelerometer_random_walk_reason'] in made.notes[-1]
    with pytest.raises(InputError, match='has no accelerometer_random_walk: the rest is too'):
        export(HEADERS['affine'], to, {**noise, 'accelerometer_random_walk_axes_upper': [None]})


@pytest.mark.parametrize('name', HEADERS)
def test_json_and_npz_hold_everything(name):
    made = HEADERS[name]
    found = json.loads(text_of(made, 'json'))
    arrays = np.load(io.BytesIO(text_of(made, 'npz')), allow_pickle=False)
    for key in ('matrix', 'offset', 'rotation', 'gain', 'values', 'covariance'):
        np.testing.assert_array_equal(np.reshape(found[key], arrays[key].shape), arrays[key])
    values = {key: [each[part] for part in entry_of(effect_named(key)).values if part in each]
              for key, each in found['effects'].items()}
    assert json.loads(str(arrays['effects'])) == found['effects']
    again = replace(made, model=model_with(values, np.array(found['rotation'])))
    reading, temperature, wanted = samples(made)
    np.testing.assert_allclose(again.apply(reading, **known_of(made, temperature)), wanted)
    assert export(made, 'json').losses == ()
    assert export(made, 'json').notes == () or {*made.model.effects} > {*AFFINE}


@pytest.mark.parametrize('to', ['px4', 'ardupilot', 'json'])
def test_the_loss_is_the_difference_that_the_written_values_leave(to, tmp_path):
    made, force = HEADERS['bending'], spread_directions(300)
    found, reading = export(made, to), made.predict(force * 9.80665)
    if to == 'json':  # which loses nothing, but matrix and offset alone do
        values = json.loads(found.text_or_bytes)
        corrected = (reading - values['offset']) @ np.transpose(values['matrix'])
    else:
        _, corrected = by_autopilot(to, found.text_or_bytes, reading, None, tmp_path)
    left = rms_mg(corrected / 9.80665 - force)
    assert re.search(rf'\bleaves? {left:.2g} mg', (found.losses or found.notes)[-1])
    assert to == 'json' or found.leaves_mg == pytest.approx(left, rel=1e-6)


@pytest.mark.parametrize(('effects', 'to', 'words'), table('export_losses'))
def test_effects_that_a_format_lacks_are_losses_in_numbers(effects, to, words):
    made = export(sensor_with(AFFINE if to != 'px4' else BY_AXIS, effects), to)
    assert len(made.losses) == 1
    assert made.losses[0].startswith(words)
    assert made.details[0].leaves_mg == pytest.approx(made.leaves_mg, rel=0.02)
    assert made.leaves_mg > 0.1


def test_the_mounting_is_a_loss_where_a_format_does_not_hold_it():
    levelled = sensor_with(BY_AXIS, rotation=rotation_from_rpy(0.0, np.radians(3.0), 0.0))
    for to in ('px4', 'ardupilot', 'betaflight'):
        made = export(levelled, to)
        assert any('rotation of 3.00' in line for line in made.losses)
        moved = rms(spread_directions(500) @ levelled.rotation - spread_directions(500), axis=0)
        mounting, = (each.leaves_mg for each in made.details if each.effect == 'mounting')
        assert mounting == pytest.approx(1e3 * np.linalg.norm(moved), rel=0.01)
        assert made.leaves_mg == pytest.approx(export(sensor_with(BY_AXIS), to).leaves_mg)
    for to in ('c', 'imu_calib', 'imucal', 'json'):
        assert export(levelled, to).losses == ()


@pytest.mark.parametrize('to', EXPORT_FORMATS)
def test_the_command_writes_beside_the_calibration(to, stored, tmp_path, capsys):
    noise = tmp_path / 'noise.json'
    noise.write_text(json.dumps(NOISE), encoding='utf-8')
    given = stored('calibration.yaml')
    before = given.read_bytes()
    for _ in range(2):  # the second time, it replaces its own file
        capsys.readouterr()
        assert run('export', given, '--to', to, *(
            ('--noise', noise) if 'noise' in EXPORT_FORMATS[to].takes else ())) == 0
    path = tmp_path / f'calibration{EXPORT_FORMATS[to].suffix}'
    takes = EXPORT_FORMATS[to].takes
    wanted = export(read_calibration(given), to, NOISE if 'noise' in takes else None,
                    ExportOptions(**{'name': 'calibration'} if 'name' in takes else {}))
    assert path.read_bytes() == wanted.data
    assert given.read_bytes() == before
    printed = capsys.readouterr()
    assert printed.out == ''
    for line in wanted.losses:
        assert line in ' '.join(printed.err.split())
