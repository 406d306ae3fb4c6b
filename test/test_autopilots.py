# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From the log of an autopilot to its parameters, with any rotation of the board and old calibration.

The readings of a sensor become those of a log by the equations of the firmware, the log becomes a
calibration and its export, and the exported parameters correct the readings of the sensor.

"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
import re
from typing import Any

from accel_calib.calibration import Calibration, fit_poses
from accel_calib.errors import DamagedCalibrationError
from accel_calib.logs import write_table
from accel_calib.stillness import capture
from accel_calib.stored import read_calibration, write_calibration
from accel_calib.table import Autopilot, Recording
from data.logs import make
from inside import (
    export, ExportOptions, main, model_with, read_log, simulate_recording, spread_directions)
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_exports import ardupilot, ardupilot_force, by_autopilot, px4_force, qgroundcontrol

mavlink = pytest.importorskip('pymavlink.dialects.v20.common')
pytest.importorskip('pyulog')

OFFSET, GAIN = np.array([0.031, -0.042, 0.055]), np.array([0.02, -0.015, 0.009])
G, DEVICE = make.G, 2490378
OLD = np.array([0.31, -0.22, 0.17]), np.array([1.011, 0.988, 1.004])
"""Offset [m/s²] and scale of the old calibration of the vehicle."""

OLD_38 = np.array([[0.143039, 0.368776, -0.918446], [-0.332133, -0.856289, -0.395546],
                   [-0.932324, 0.361625, 0.0]])
"""Rotation 38 of ArduPilot, as its source has it."""

OF_ARDUPILOT = {41: 'PITCH_7', 42: 'ROLL_45', 43: 'ROLL_315'}
NAMES = {number: entry.name.removeprefix('MAV_SENSOR_ROTATION_')
         for number, entry in mavlink.enums['MAV_SENSOR_ORIENTATION'].items() if number < 41}


def named(name: str) -> Any:
    """Return the rotation of a name such as ROLL_90_YAW_45: about fixed axes, in this order."""
    turns = dict(re.findall(r'(ROLL|PITCH|YAW)_(\d+)', name))
    return Rotation.from_euler('xyz', [float(turns.get(axis, 0)) for axis in (
        'ROLL', 'PITCH', 'YAW')], degrees=True).as_matrix()


def three(start: str, end: str, values: Any) -> dict[str, float]:
    return {f'{start}{axis}{end}': float(value) for axis, value in zip('XYZ', values)}


@pytest.fixture(scope='module')
def raw() -> Recording:
    """Return the readings of the sensor [g], in its own axes."""
    model = model_with({'offset': OFFSET, 'axis_gain': GAIN})
    return simulate_recording(model, spread_directions(14), np.random.default_rng(1),
                              noise_g=0.001, rate_hz=20.0, dwell=2.0, turn=0.6,
                              temperatures=(18.0, 42.0))


def logged(raw: Recording, rotation: Any, corrected: Any = None) -> Recording:
    """Return what the firmware logs of these readings [g]: corrected [m/s²], and then turned."""
    corrected = (raw.reading * G - OLD[0]) * OLD[1] if corrected is None else corrected
    return raw.with_columns(reading=corrected @ rotation.T / G, rate=raw['rate'] @ rotation.T)


def ardupilot_log(path: Path, samples: Recording, parameters: Mapping[str, float],
                  instance: int = 0) -> Path:
    rows = [*make.dataflash_forms(), *(('PARM', (1, name, value, 0.0))
                                       for name, value in parameters.items()),
            *make.imu_rows(samples, instance)]
    path.write_bytes(make.dataflash_bytes(rows))
    return path


def px4_log(path: Path, samples: Recording, parameters: Mapping[str, float]) -> Path:
    """Write sensor_combined, with a slow sensor_accel for the device and its temperature."""
    accel = make.accel_fields(samples.take(slice(0, None, 20)), DEVICE, G)
    selected = {'timestamp': ('uint64_t', make.stamps_us(samples)[:1]),
                'accel_device_id': ('uint32_t', [DEVICE]),
                'gyro_device_id': ('uint32_t', [DEVICE + 1])}
    path.write_bytes(make.ulog_bytes([
        ('sensor_combined', 0, make.combined_fields(samples)), ('sensor_accel', 0, accel),
        ('sensor_selection', 0, selected)], parameters))
    return path


def old_ardupilot(number: int, instance: int = 1) -> dict[str, float]:
    start = f'INS_ACC{"" if instance == 1 else instance}'
    return {'AHRS_ORIENTATION': float(number), f'{start}_ID': float(DEVICE),
            **three(f'{start}OFFS_', '', OLD[0]), **three(f'{start}SCAL_', '', OLD[1])}


def old_px4(number: int) -> dict[str, float]:
    return {'SENS_BOARD_ROT': number, 'CAL_ACC1_ID': DEVICE, 'CAL_ACC0_ID': 7, 'CAL_ACC1_ROT': -1,
            **three('CAL_ACC1_', 'OFF', OLD[0]), **three('CAL_ACC1_', 'SCALE', OLD[1])}


def undone(path: Path, raw: Recording, atol: float = 5e-5) -> Any:
    """Return what a log holds, which must be the readings of the sensor."""
    table = read_log(path).table
    np.testing.assert_allclose(table.reading, raw.reading * G, atol=atol)
    return table


def calibrated(path: Path) -> Calibration:
    log = read_log(path)
    assert isinstance(log.table, Recording)
    return fit_poses(capture(log.table, log.units).poses, log.units, model='7')


def check_exported(calibration: Calibration, to: str, raw: Recording, tmp_path: Path,
                   instance: int = 1) -> dict[str, float]:
    """Check that the firmware corrects the readings of the sensor with the exported parameters."""
    text = export(calibration, to).text_or_bytes
    found, force = by_autopilot(to, text, raw.reading * G, raw['temperature'], tmp_path, instance)
    rests = np.linalg.norm(raw['rate'], axis=1) < 0.05
    length = np.linalg.norm(force, axis=1)[rests] / G
    assert np.abs(np.mean(force[rests] / G - raw['reference'][rests], axis=0)).max() < 1e-3
    assert np.sqrt(np.mean((length - 1.0) ** 2)) < 1.2e-3  # the noise of a sample is 1 mg
    return found


@pytest.mark.parametrize('number', [*NAMES, *OF_ARDUPILOT])
def test_ardupilot_corrects_the_sensor_with_what_a_log_of_any_rotation_gives(number, raw,
                                                                             tmp_path):
    rotation = OLD_38 if number == 38 else named({**NAMES, **OF_ARDUPILOT}[number])
    path = ardupilot_log(tmp_path / 'log.bin', logged(raw, rotation), old_ardupilot(number))
    np.testing.assert_allclose(undone(path, raw)['rate'], raw['rate'], atol=1e-4)
    check_exported(calibrated(path), 'ardupilot', raw, tmp_path)


@pytest.mark.parametrize('number', NAMES)
def test_px4_corrects_the_sensor_with_what_a_log_of_any_rotation_gives(number, raw, tmp_path):
    level = Rotation.from_euler('xyz', [1.5, -2.5, 4.0], degrees=True).as_matrix()
    path = px4_log(tmp_path / 'log.ulg', logged(raw, level @ named(NAMES[number])), {
        **old_px4(number), **three('SENS_BOARD_', '_OFF', [1.5, -2.5, 4.0])})
    np.testing.assert_allclose(undone(path, raw)['rate'], raw['rate'], atol=1e-4)
    found = check_exported(calibrated(path), 'px4', raw, tmp_path, instance=1)
    assert found['CAL_ACC1_ID'] == DEVICE


@pytest.mark.parametrize(('parameters', 'why'), [
    ({}, 'parameters are not in the log'), ({'AHRS_ORIENTATION': 77.0}, 'is 77'),
    ({'AHRS_ORIENTATION': 0.0, 'INS_ACCSCAL_X': 0.0}, 'scale is 0'),
    ({'INS_ACCOFFS_X': float('nan'), 'INS_ACCOFFS_Y': 0.5}, '')])
def test_what_is_not_known_stays_with_the_readings_up_to_the_export(parameters, why, raw, tmp_path,
                                                                    capsys):
    path = ardupilot_log(tmp_path / 'log.bin', logged(raw, np.eye(3)), parameters)
    poses, stored = tmp_path / 'poses.csv', tmp_path / 'calibration.yaml'
    assert main(['capture', str(path), '-o', str(poses)]) == 0
    assert main(['fit', str(poses), '-o', str(stored), '--model', '7']) == 0
    capsys.readouterr()
    target = tmp_path / 'made.param'
    assert main(['export', str(stored), '--to', 'ardupilot', '-o', str(target)]) == 0
    said = capsys.readouterr().err
    assert ('do not load' in said.replace('\n', ' ')) is bool(why)
    assert ('do not load' in target.read_text()) is bool(why)
    assert why in ' '.join(said.split())


THERMAL = {'INS_TCAL1_ENABLE': 1.0, 'INS_TCAL1_TMIN': 20.0, 'INS_TCAL1_TMAX': 40.0,
           'INS_ACC1_CALTEMP': 28.0, **three('INS_TCAL1_ACC1_', '', [3000.0, -2000.0, 1000.0]),
           **three('INS_TCAL1_ACC2_', '', [50.0, 0.0, -70.0]),
           **three('INS_TCAL1_ACC3_', '', np.zeros(3))}


@pytest.mark.parametrize('lacks', ['', 'INS_ACC1_CALTEMP'])  # the default of the firmware: -300
def test_an_old_thermal_calibration_of_ardupilot_is_undone_and_replaced(lacks, raw, tmp_path):
    whole = {**old_ardupilot(1), **THERMAL, **({lacks: -300.0} if lacks else {})}
    corrected = ardupilot_force(whole, raw.reading * G, raw['temperature'])
    old = {name: value for name, value in whole.items() if name != lacks}
    path = ardupilot_log(tmp_path / 'log.bin', logged(raw, named('YAW_45'), corrected), old)
    undone(path, raw)
    made = calibrated(path)
    check_exported(made, 'ardupilot', raw, tmp_path)
    found = ardupilot(export(made, 'ardupilot').text_or_bytes, tmp_path)
    assert {found[f'INS_TCAL1_ACC{order}_{axis}'] for order in (1, 2, 3) for axis in 'XYZ'} == {0}


def test_an_old_thermal_calibration_of_px4_is_undone_and_replaced(raw, tmp_path):
    orders = np.array([[0.03, -0.01, 0.02], [3e-3, -2e-3, 1e-3], [5e-5, 0.0, -7e-5],
                       [1e-6, 2e-6, 0.0]])

    old = {**old_px4(6), 'TC_A_ENABLE': 1, 'TC_A2_ID': DEVICE, 'TC_A2_TREF': 30.0,
           'TC_A2_TMIN': 20.0, 'TC_A2_TMAX': 40.0,
           **{f'TC_A2_X{k}_{axis}': float(part[axis]) for k, part in enumerate(orders)
              for axis in range(3)}}
    corrected = px4_force(old, raw.reading * G, raw['temperature'], 1, thermal=2)
    path = px4_log(tmp_path / 'log.ulg', logged(raw, named('YAW_270'), corrected), old)
    undone(path, raw, atol=2e-3)
    found = qgroundcontrol(export(calibrated(path), 'px4').text_or_bytes)
    assert found['TC_A2_ID'] == DEVICE
    assert {found[f'TC_A2_X{k}_{axis}'] for k in range(4) for axis in range(3)} == {0.0}


def test_the_second_accelerometer_of_ardupilot_keeps_its_place_in_every_file(raw, tmp_path):
    path = ardupilot_log(tmp_path / 'log.bin', logged(raw, named('PITCH_180')),
                         old_ardupilot(12, 2), instance=1)
    poses, stored, target = (tmp_path / name for name in ('poses.csv', 'new.yaml', 'made.param'))
    assert main(['capture', str(path), '-o', str(poses)]) == 0
    assert main(['calibrate', str(poses), '-o', str(stored)]) == 0
    calibration = read_calibration(stored)
    assert calibration.poses.autopilot == Autopilot('ardupilot', 2, DEVICE)
    assert main(['export', str(stored), '--to', 'ardupilot', '-o', str(target)]) == 0
    found = ardupilot(target.read_text(), tmp_path)
    assert found['INS_ACC2_ID'] == DEVICE
    np.testing.assert_allclose(
        [found[f'INS_ACC2OFFS_{axis}'] for axis in 'XYZ'], OFFSET * G, atol=0.2)
    named_one = export(calibration, 'ardupilot', options=ExportOptions(instance=1))
    assert 'INS_ACC_ID' not in named_one.text_or_bytes
    assert 'CAL_ACC0_XOFF' in export(calibration, 'px4').text_or_bytes


def test_the_place_in_the_autopilot_is_checked_and_not_that_of_a_corrected_copy(raw, tmp_path):
    path = ardupilot_log(tmp_path / 'log.bin', logged(raw, np.eye(3)), old_ardupilot(0))
    stored, copy = tmp_path / 'calibration.yaml', tmp_path / 'copy.csv'
    write_calibration(stored, calibrated(path))
    assert main(['apply', str(path), '-c', str(stored), '-o', str(copy)]) == 0
    assert read_log(copy).table.autopilot is None
    text = stored.read_text()
    assert 'firmware: ardupilot' in text
    stored.write_text(text.replace('firmware: ardupilot', 'firmware: 7'))
    with pytest.raises(DamagedCalibrationError, match='autopilot'):
        read_calibration(stored)


@pytest.mark.parametrize('stated', ['{"firmware": "other"}', '{"firmware": "px4", "instance": []}',
                                    '"px4"', '{"no": 1}', '[1]'])
def test_a_comment_that_is_no_place_in_an_autopilot_is_a_comment(stated, raw, tmp_path):
    path = tmp_path / 'table.csv'
    write_table(path, replace(raw, units='g'))
    path.write_text(f'# autopilot: {stated}\n{path.read_text()}')
    assert read_log(path).table.autopilot is None
