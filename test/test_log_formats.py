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
from inside import Log, read_log
import numpy as np
import pytest
from shared import LOGS
from test_logs import write

WITHIN_SD = 5.0


def px4(path: Path) -> Log:
    """Read a log of PX4."""
    pytest.importorskip('pyulog')
    return read_log(path)


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


def test_a_flat_pose_makes_a_level_vehicle_read_up() -> None:
    log = read_log(LOGS / 'px4/log_sensor_accel_0.csv')
    poses = capture(log.table, log.units).poses  # type: ignore[arg-type]
    fitted = fit_poses(poses, log.units, model='10')
    calibration = level_by_rows(fitted, poses, 'ros', 1, None)
    up = calibration.apply(poses.reading[:1])[0] / log.units.per_g
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=2e-3)
    np.testing.assert_allclose(calibration.rotation, make.FRD, atol=2e-2)


# ---------------------------------------------------------------------------------- PX4 logs

def test_vehicle_imu_is_not_read_without_its_interval(tmp_path: Path) -> None:
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
