# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Samples of the makers' layouts: each is read, captured and fitted, and the truth is found."""

from pathlib import Path
import re
from typing import Any

from accel_calib.calibration import Calibration, fit_poses, level_by_rows
from accel_calib.errors import InputError
from accel_calib.logs import LogOptions
from accel_calib.stillness import capture
from accel_calib.table import Recording
from data.logs import make
from inside import format_named, Log, read_log
import numpy as np
import pytest
from shared import LOGS
from test_logs import write

WITHIN_SD = 5.0


def px4(name: str | Path, topic: str = '', sensor: str = '') -> Log:
    """Read a sample of PX4, or another path."""
    pytest.importorskip('pyulog')
    return read_log(LOGS / 'px4' / name, LogOptions(topic=topic, sensor=sensor))


def ardupilot(name: str | Path) -> Log:
    """Read a sample of ArduPilot, or another path."""
    pytest.importorskip('pymavlink')
    return read_log(LOGS / 'ardupilot' / name)


def check(recording: Recording, units: Any, name: str) -> Calibration:
    """Capture and fit a recording, and compare with the truth of the sample."""
    truth = make.TRUTHS[name]
    assert units.name == truth.units
    poses = capture(recording, units).poses
    assert len(poses) == make.POSES
    calibration = fit_poses(poses, units, model='10')
    assert np.all(np.abs(calibration.offset - truth.offset) < WITHIN_SD * calibration.offset_sd)
    assert np.all(np.abs(calibration.gain - truth.gain) < WITHIN_SD * calibration.gain_sd)
    return calibration


@pytest.mark.parametrize('name', make.TRUTHS)
def test_the_truth_of_a_sample_is_found_without_options_and_with_its_format(name: str) -> None:
    for end, library in (('.ulg', 'pyulog'), ('.bin', 'pymavlink'), ('.xls', 'xlrd')):
        if name.endswith(end):
            pytest.importorskip(library)
    log = read_log(LOGS / name)
    assert isinstance(log.table, Recording)
    check(log.table, log.units, name)
    assert ('temperature' in log.table) == make.TRUTHS[name].temperature
    if make.TRUTHS[name].rate:
        assert np.ptp(log.table['rate'], axis=0).max() > 1.0  # rad/s, in the turns
        assert np.abs(np.median(log.table['rate'], axis=0)).max() < 0.01
    if make.TRUTHS[name].temperature:
        assert np.ptp(log.table['temperature']) == pytest.approx(np.ptp(make.WARM), rel=0.05)
    assert log.table['time'][-1] - log.table['time'][0] == pytest.approx(44.75, abs=0.01)
    named = read_log(LOGS / name, LogOptions(format=name.split('/')[0]))
    assert named.units == log.units
    np.testing.assert_allclose(named.table.reading, log.table.reading, rtol=1e-12)
    np.testing.assert_allclose(named.table['time'], log.table['time'], rtol=1e-12)


@pytest.mark.parametrize(('name', 'advice'), list(zip(make.WITHOUT_GRAVITY, (
    "record 'Acceleration with g'", 'use TotalAcceleration.csv'), strict=True)))
def test_a_log_without_gravity_is_refused_and_the_maker_s_other_log_is_named(
        name: str, advice: str) -> None:
    with pytest.raises(InputError, match='gravity') as caught:
        read_log(LOGS / name)
    assert advice in caught.value.advice


@pytest.mark.parametrize('stated', ['', 'sensor-logger', 'matlab', 'esp32'])
@pytest.mark.parametrize('name', make.OTHER_SENSORS)
def test_a_log_of_another_sensor_with_the_same_columns_is_refused(name: str, stated: str) -> None:
    with pytest.raises(InputError, match='another sensor'):
        read_log(LOGS / name, LogOptions(format=stated))


def test_another_and_an_unknown_format_are_refused_with_what_is_lacking_or_meant() -> None:
    with pytest.raises(InputError, match='lacks .*accSmooth'):
        read_log(LOGS / 'phyphox/comma_point.csv', LogOptions(format='betaflight'))
    with pytest.raises(InputError, match='use phyphox'):
        format_named('phypox', ['Time (s)'], 'log.csv')


def test_a_flat_pose_makes_a_level_vehicle_read_up() -> None:
    log = read_log(LOGS / 'px4/log_sensor_accel_0.csv')
    poses = capture(log.table, log.units).poses  # type: ignore[arg-type]
    fitted = fit_poses(poses, log.units, model='10')
    calibration = level_by_rows(fitted, poses, 'ros', 1, None)
    up = calibration.apply(poses.reading[:1])[0] / log.units.per_g
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=2e-3)
    np.testing.assert_allclose(calibration.rotation, make.FRD, atol=2e-2)


# ---------------------------------------------------------------------------------- PX4 logs

def test_a_log_of_the_default_profile_gives_the_selected_sensor_with_its_temperature() -> None:
    log, samples = px4('default.ulg'), make.recording(40, down=True)
    assert log.table.sensor == 'sensor_combined 0'
    np.testing.assert_allclose(log.table['temperature'], samples['temperature'], atol=0.08)
    np.testing.assert_allclose(np.diff(log.table['time']), 1.0 / make.RATE_HZ, atol=1e-6)
    assert any('CAL_ACC' in note for note in log.notes)


def test_the_named_message_and_sensor_of_a_px4_log_are_read() -> None:
    found = px4('default.ulg', 'sensor_accel', '1').table
    samples = make.recording(40, down=True)
    assert found.sensor == 'sensor_accel 1'
    np.testing.assert_allclose(found.reading[:, 0], samples.reading[::20, 0] * make.G, rtol=1e-6)
    with pytest.raises(InputError, match='has sensor_accel 0, expected vehicle_imu'):
        px4('thermal.ulg', 'vehicle_imu')


def test_a_name_of_the_sensor_names_it_and_does_not_choose() -> None:
    log = px4('thermal.ulg', sensor='left imu')
    assert log.table.sensor == 'left imu'
    assert 'sensor_accel 0' in log.read_as
    with pytest.raises(InputError, match='expected a message 3'):
        px4('thermal.ulg', sensor='3')


def test_vehicle_imu_is_divided_by_its_interval_and_not_read_without_it(tmp_path: Path) -> None:
    found = px4('default.ulg', 'vehicle_imu').table
    samples = make.recording(40, down=True)
    np.testing.assert_allclose(found.reading[:, 2], samples.reading[::10, 2] * make.G, rtol=1e-6)
    np.testing.assert_allclose(found['rate'][:, 1], samples['rate'][::10, 1], atol=1e-6)
    fields = make.imu_fields(make.recording(1), 1)  # of another version of PX4
    del fields['delta_velocity_dt']
    with pytest.raises(InputError, match='none of the messages'):
        px4(write(tmp_path, make.ulog_bytes([('vehicle_imu', 0, fields)])))


def test_samples_that_px4_marks_as_invalid_are_left_out_and_counted(tmp_path: Path) -> None:
    fields = make.combined_fields(make.recording(1))
    kind, relative = fields['accelerometer_timestamp_relative']
    fields['accelerometer_timestamp_relative'] = (kind, [0x7fffffff] * 3 + list(relative[3:]))
    log = px4(write(tmp_path, make.ulog_bytes([('sensor_combined', 0, fields)])))
    assert len(log.table['time']) == len(relative) - 3
    assert '3 rows of' in log.notes[0]


def test_flight_logs_that_are_cut_off_are_read_up_to_there(tmp_path: Path) -> None:
    data = (LOGS / 'px4/thermal.ulg').read_bytes()[:40_001]
    assert 300 < len(px4(write(tmp_path, data)).table['time']) < 600
    data = (LOGS / 'ardupilot/two_imus.bin').read_bytes()[:50_003]
    log = ardupilot(write(tmp_path, data))
    assert 400 < len(log.table['time']) < 600
    assert any('1 message cut' in note for note in log.notes)


# ----------------------------------------------------------------------------- ArduPilot logs

@pytest.mark.parametrize('name', ['two_imus.bin', 'two_imus.csv'])
def test_of_two_sensors_the_lowest_or_the_one_that_is_named_is_read(name: str) -> None:
    if name.endswith('.bin'):
        pytest.importorskip('pymavlink')
    path = LOGS / 'ardupilot' / name
    lowest = read_log(path)
    assert len(lowest.table) == len(make.recording(50))
    one, same = (read_log(path, LogOptions(sensor=text)).table for text in ('1', '1.0'))
    samples = make.recording(51, down=True, poses=6)
    np.testing.assert_allclose(one.reading, samples.reading * make.G, rtol=1e-5, atol=1e-6)
    assert same == one
    with pytest.raises(InputError, match='0, .*1, expected .*2'):
        read_log(path, LogOptions(sensor='2'))
    if name.endswith('.bin'):
        assert lowest.table.sensor == 'IMU 0'
        assert any('IMU 1' in note for note in lowest.notes)


def test_the_text_log_has_the_numbers_of_the_binary_log() -> None:
    binary, text = ardupilot('two_imus.bin'), ardupilot('one_imu.log')
    assert set(binary.table.columns) == set(text.table.columns)
    for key, values in binary.table.columns.items():
        np.testing.assert_allclose(text.table[key], values, rtol=1e-6, atol=1e-9)


def test_garbage_within_an_ardupilot_log_is_passed_over_and_noted(tmp_path: Path) -> None:
    whole = (LOGS / 'ardupilot/raw_acc.bin').read_bytes()
    start = whole.index(b'\xa3\x95\x65', 20_000)
    path = write(tmp_path, whole[:start] + b'\x00\x17\xff' * 9 + whole[start:])
    log = ardupilot(path)
    assert ' left out' in ' '.join(log.notes)
    np.testing.assert_array_equal(log.table.reading[:, 2],
                                  ardupilot('raw_acc.bin').table.reading[:, 2])


def test_the_calibration_that_an_ardupilot_log_holds_already_is_named(tmp_path: Path) -> None:
    rows = [*make.dataflash_forms(), ('PARM', (1, 'INS_ACCOFFS_X', 0.25, 0.0)),
            *make.imu_rows(make.recording(1), 0)]
    log = ardupilot(write(tmp_path, make.dataflash_bytes(rows)))
    assert any('INS_ACCOFFS_X 0.25' in note for note in log.notes)


@pytest.mark.parametrize(('suffix', 'content'), [
    *(('.ulg', each) for each in (b'', b'ULog\x01\x12\x35\x01', b'\0\0',
                                  b'ULog\x01\x12\x35\x01' + b'\xff' * 500)),
    *(('.bin', each) for each in (b'', b'\xa3\x95\x80', b'\0\0',
                                  b'\xa3\x95\x80' + b'\xff' * 400))])
def test_what_is_no_flight_log_is_refused_in_one_line(suffix: str, content: bytes, tmp_path: Path
                                                      ) -> None:
    path = write(tmp_path, content, f'log{suffix}')
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        read_log(path)
    assert '\n' not in str(caught.value)
