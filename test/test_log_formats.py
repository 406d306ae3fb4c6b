# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Samples of the makers' layouts: each is read, captured and fitted, and the truth is found."""

from typing import Any

from accel_calib.calibration import Calibration, fit_poses, level_by_rows
from accel_calib.logs import LogOptions
from accel_calib.stillness import capture
from accel_calib.table import Recording
from data.logs import make
from inside import read_log
import numpy as np
import pytest
from shared import LOGS

WITHIN_SD = 5.0


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
