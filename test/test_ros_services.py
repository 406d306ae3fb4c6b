# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The services of the calibrator, and their answers if they fail."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import re
from typing import Any

from accel_calib.logs import read_poses
from accel_calib.stored import read_calibration
from accel_calib.units import units_of
from diagnostic_msgs.msg import DiagnosticArray
from inside import Model, next_action, plan_for, simulate_poses, spread_directions
from inside_ros import pose_markers
import numpy as np
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool
from visualization_msgs.msg import MarkerArray

Readings = Callable[..., Any]
Stored = Callable[..., Path]


def count(markers: list[Any], namespace: str = 'poses') -> int:
    return sum(m.ns == namespace for m in markers[-1].markers) if markers else 0


def test_services_report_what_is_missing(bench: Any) -> None:
    bench.calibrator()
    for name, words in (('fit', 'no Imu message yet'), ('set_level', 'no Imu message yet'),
                        ('capture_pose', 'no Imu message yet'), ('undo_pose', 'no poses'),
                        ('save', 'no Imu message yet'), ('undo', 'no Imu message yet'),
                        ('calibrate_at_rest', 'no Imu message yet'), ('load', 'start the driver')):
        answer = bench.call(name)
        assert not answer.success, name
        assert words in answer.message, answer.message
        assert '\n' not in answer.message


def test_refused_fit_advises_how_to_turn_the_sensor(bench: Any, readings: Readings) -> None:
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    bench.calibrator(sensor='arm', passthrough=True)
    bench.spin(lambda: count(markers, 'next') == 2)
    bench.feed(readings([[0, 0, 1], [1, 0, 0]]))
    bench.spin(lambda: count(markers) == 2)
    answer = bench.call('fit')
    assert not answer.success
    assert 'turn the sensor so that' in answer.message
    angles = np.linspace(0.5, 2 * np.pi, 7)
    bench.feed(readings(np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])))
    bench.spin(lambda: count(markers) == 8)
    answer = bench.call('fit')
    assert not answer.success
    assert 'turn the sensor so that' in answer.message
    assert not list(bench.home.glob('accel_calib/*.yaml'))


def test_log_and_markers_report_that_more_poses_no_longer_help() -> None:
    poses = simulate_poses(Model({}), spread_directions(24), np.random.default_rng(1))
    asked = plan_for(poses, units_of('g'), 'auto').asked
    assert re.fullmatch(r'more poses no longer help: 24 poses determine \|a\| to within 0\.18 mg; '
                        'call ~/fit', next_action(asked))
    markers = pose_markers(np.zeros((0, 3)), asked, 'imu').markers
    assert [m.text for m in markers if m.ns == 'next'] == [asked.words]
    few = plan_for(poses.take(slice(0, 8)), units_of('g'), 'auto').asked
    arrow, text = [m for m in pose_markers(np.zeros((0, 3)), few, 'imu').markers
                   if m.ns == 'next']
    np.testing.assert_allclose([getattr(arrow.points[1], axis) for axis in 'xyz'], few.direction)
    assert next_action(few) == text.text == few.words


def test_set_level_warns_of_a_flat_pose_on_another_face(bench: Any, readings: Readings,
                                                        stored: Stored) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    bench.calibrator(calibration_file=str(stored()), sensor='arm', passthrough=True)
    turned = readings([[0, 0, 1], [0, 0, -1]], dwell=6.0)
    bench.feed(turned[:-200])
    rest = iter(turned[-200:])
    bench.spin(lambda: still and still[-1].data)
    answer = bench.call_while('set_level', lambda: bench.imu(next(rest)))
    assert answer.success, answer.message
    assert 'the mounting is levelled by this pose' in answer.message
    assert 'the flat pose reads -1.00 g on z' in answer.message
    assert 'mounted upside down, or z (or every axis) has the wrong sign' in answer.message


def test_poses_are_captured_and_removed_on_request(bench: Any, readings: Readings) -> None:
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(auto_capture=False, sensor='arm', passthrough=True)
    poses = readings([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dwell=3.0)
    bench.feed(poses[:140])
    bench.spin(lambda: still and still[-1].data)
    assert count(markers) == 0
    answer = bench.call_while('capture_pose', lambda: bench.imu(poses[130]))
    assert answer.success, answer.message
    assert re.match(r'1 pose: .*; turn the sensor so that the .* points up \([-+xyz ]+\)$',
                    answer.message)
    bench.spin(lambda: count(markers) == 1)
    asked = markers[-1].markers[-1].text
    assert answer.message.endswith(asked)
    bench.spin(lambda: diagnostics and any(value.key == 'next pose' and value.value == asked
                                           for value in diagnostics[-1].status[0].values))
    bench.feed(poses[140:165])
    bench.spin(lambda: not still[-1].data)
    rng = np.random.default_rng(1)
    answer = bench.call_while('capture_pose', lambda: bench.imu(
        poses[150] + 2.0 * rng.normal(size=3)))
    assert not answer.success
    assert 'not still' in answer.message
    bench.feed(poses[165:310])
    bench.spin(lambda: still[-1].data)
    assert bench.call_while('capture_pose', lambda: bench.imu(poses[300])).success
    bench.spin(lambda: count(markers) == 2)
    table = bench.home / 'accel_calib' / 'arm_poses.csv'
    bench.spin(lambda: len(read_poses(table)) == 2)
    assert bench.call('undo_pose').success
    bench.spin(lambda: count(markers) == 1)
    assert bench.call('undo_pose').success
    assert not bench.call('undo_pose').success


def test_poses_are_fitted_automatically(bench: Any, readings: Readings) -> None:
    path = bench.home / 'accel_calib' / 'arm.yaml'
    bench.calibrator(sensor='arm', auto_fit=True, auto_fit_poses=10, passthrough=True)
    bench.feed(readings(spread_directions(11)))
    bench.spin(path.exists)
    found = read_calibration(path)
    assert found.sensor == 'arm'
    np.testing.assert_allclose(found.offset / 9.80665, [0.03, -0.02, 0.04], atol=1e-3)


def test_refused_calibrations_leave_the_one_in_use(bench: Any, stored: Stored) -> None:
    path = stored('use.yaml', sensor='imu_link')
    good = path.read_text()
    corrected = bench.listen(Imu, 'imu/data_calibrated')
    bench.calibrator(calibration_file=path)
    bench.exchange(corrected, lambda: bench.imu([0, 0, 9.8]))
    other = stored('other.yaml', sensor='another').read_text()
    for text, words in ((good.replace('version: 3', 'version: 999'), 'version 999'),
                        (other, "belongs to sensor 'another'"), ('', 'it is empty'),
                        (good.replace('readings: m/s2', 'readings: native'), 'native')):
        path.write_text(text)
        answer = bench.call('load')
        assert not answer.success
        assert words in answer.message, answer.message
        assert '\n' not in answer.message
        bench.exchange(corrected, lambda: bench.imu([0, 0, 9.8]))
    path.write_text(good)
    assert bench.call('load').success


def test_calibration_of_another_sensor_is_discarded_at_the_first_message(
        bench: Any, stored: Stored) -> None:
    corrected = bench.listen(Imu, 'imu/data_calibrated')
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    path = stored(sensor='another')
    before = path.read_bytes()
    bench.calibrator(calibration_file=path)

    def refused() -> bool:
        bench.send(bench.imu([0, 0, 9.8]))
        return any("'another'" in array.status[0].message for array in diagnostics)

    bench.spin(refused)
    assert not corrected
    assert path.read_bytes() == before


def test_reset_removes_poses_and_calibration_but_keeps_the_files(
        bench: Any, readings: Readings) -> None:
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    bench.calibrator(sensor='arm', passthrough=True)
    bench.feed(readings(spread_directions(11)))
    bench.spin(lambda: count(markers) == 11)
    assert bench.call('fit').success
    assert bench.call('save').success
    folder = bench.home / 'accel_calib'
    stored = (folder / 'arm.yaml').read_bytes()
    answer = bench.call('reset')
    assert answer.success, answer.message
    bench.spin(lambda: count(markers) == 0)
    assert not (folder / 'arm.yaml').exists()
    assert not (folder / 'arm_poses.csv').exists()
    assert (folder / 'arm.yaml.reset1').read_bytes() == stored
    assert len(read_poses(folder / 'arm_poses.csv.reset1')) == 11
    assert not bench.call('load').success


def test_calibration_that_cannot_be_stored_is_used_and_reported(
        bench: Any, readings: Readings, tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('in the way')
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    corrected = bench.listen(Imu, 'imu/data_calibrated')
    bench.calibrator(calibration_file=tmp_path / 'file' / 'arm.yaml', passthrough=True)
    bench.feed(readings(spread_directions(11)))
    bench.spin(lambda: count(markers) == 11)
    answer = bench.call('fit')
    assert not answer.success
    assert 'could not be stored' in answer.message
    got = bench.exchange(corrected, lambda: bench.imu([0, 0, 9.8]))
    assert abs(got.linear_acceleration.x) > 0.1


def test_self_test_names_what_fails(bench: Any, stored: Stored) -> None:
    rng = np.random.default_rng(1)

    def moving() -> Imu:
        return bench.imu(np.array([0, 0, 9.8]) + 3.0 * rng.normal(size=3))

    corrected = bench.listen(Imu, 'imu/data_calibrated')
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(calibration_file=stored('good.yaml'))
    answer = bench.call('self_test')
    assert answer.passed == b'\x00'
    assert 'no Imu messages' in {status.name: status.message for status in answer.status}[
        'calibrator: stream']
    bench.exchange(corrected, moving)
    diagnostics.clear()

    def running() -> bool:
        bench.send(moving())
        return len(diagnostics) > 1

    bench.spin(running)
    answer = bench.call('self_test')
    assert answer.passed == b'\x01', [status.message for status in answer.status]
    assert answer.id == 'imu_link'
