# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The node finds an effect that its calibration lacks, and corrects it."""

from pathlib import Path
import signal
from typing import Any

from accel_calib.stored import read_calibration, write_calibration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from inside import spread_directions
from inside_ros import force_of
import numpy as np
import pytest
from sensor_msgs.msg import BatteryState, FluidPressure, Temperature
from shared import Readings, Stored, with_effects
from std_msgs.msg import Float32, Float64

POSES = 26
MOVES = np.array([0.002, -0.0015, 0.001])
"""Offset per ampere [g]."""


def message(publisher: Any, value: float) -> Any:
    """Return a message with a number, of the type of a publisher."""
    kind = publisher.msg_type
    field = next(field for field in ('data', 'voltage', 'fluid_pressure', 'temperature')
                 if field in kind.get_fields_and_field_types())
    return kind(**{field: value})


def published(bench: Any, publisher: Any, value: float) -> None:
    """Publish a temperature, or other number, that the node takes before its answer."""
    publisher.publish(message(publisher, value))
    bench.call('self_test')


def meet(bench: Any, publisher: Any, value: float, name: str = 'temperature [°C]') -> None:
    """Publish a number until the node knows it; a publisher may see a node earlier."""
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')

    def known() -> bool:
        publisher.publish(message(publisher, value))
        shown = {value.key: value.value for each in diagnostics for value in each.status[0].values}
        return shown.get(name) == f'{value:.3f}'

    bench.spin(known)


OWN = """
import accel_calib as ac

field = ac.Effect('field_of_motor', 'field of the motor', typical=0.001, unit='g/A',
                  variable='motor_current', change=lambda current: abs(current - 25.0))
"""


def test_an_own_effect_is_named_corrected_and_needed_by_the_node(
        bench: Any, readings: Readings, tmp_path: Path) -> None:
    (tmp_path / 'own.py').write_text(OWN, encoding='utf-8')
    about = {'sensor': 'arm', 'passthrough': True, 'context': ['motor_current:=motor/current']}
    publisher = bench.node.create_publisher(Float64, 'motor/current', 10)
    first = bench.calibrator(**about, also=tmp_path / 'own.py')
    meet(bench, publisher, 25.0, 'motor_current')
    for k, direction in enumerate(spread_directions(POSES)):
        current = 25.0 + 12.0 * np.sin(2.1 * k)
        published(bench, publisher, current)
        bench.feed(readings([direction], dwell=1.8) + MOVES * abs(current - 25.0) * 9.80665)
    answer = bench.call('refine')
    assert answer.success, answer.message
    assert 'field_of_motor' in answer.message
    for current in (15.0, 30.0):
        meet(bench, publisher, current, 'motor_current')
        shift = MOVES * abs(current - 25.0) * 9.80665
        bench.echo([bench.imu(reading + shift) for reading in readings([[0, 0, 1]])[:40]],
                   bench.came_out)
        assert np.linalg.norm(np.mean([*map(force_of, bench.came_out)], axis=0)) == pytest.approx(
            9.80665, abs=0.02)
    assert bench.end(first, signal.SIGINT)[0] == 0
    bench.join_anew()
    second = bench.start('calibrator', **about)
    bench.client('self_test')
    status, printed = bench.end(second, signal.SIGINT)
    assert status == 0, printed
    assert "the effect 'field_of_motor'" in printed
    assert 'the parameter also' in printed
    wrong = bench.start('calibrator', also='/nowhere/own.py')
    printed = wrong.communicate(timeout=60.0)[0]
    assert wrong.returncode == 2, printed
    assert 'also is /nowhere/own.py,' in printed


TOPICS = {'supply_voltage [V]': ('battery', BatteryState, 12.25),
          'pressure': ('air', FluidPressure, 101325.5), 'rotor': ('rotor', Temperature, 55.5),
          'load': ('load', Float32, 0.75), 'temperature [°C]': ('die', Float64, 31.5)}


def test_each_type_of_context_is_read_and_what_cannot_be_read_is_said(bench: Any) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    publishers = {name: (bench.node.create_publisher(kind, topic, 10), value)
                  for name, (topic, kind, value) in TOPICS.items()}
    entries = [f'{name.split()[0]}:=/{topic}' for name, (topic, *_) in TOPICS.items()]
    bench.calibrator(context=[*entries, 'text:=/imu/data_raw', 'none:=/nowhere',
                              'spread:=/rotor/variance'])
    wanted = ('no text arrives: /imu/data_raw has the type sensor_msgs/Imu with the numbers '
              'orientation.x, ', 'no none arrives: there is no topic /nowhere',
              'topics with a number: /air, /battery, /die, /load, /rotor')

    def said() -> bool:
        for publisher, value in publishers.values():
            publisher.publish(message(publisher, value))
        said = diagnostics[-1].status if diagnostics else []
        return any(all(words in each.message for words in wanted) for each in said)

    bench.spin(said)
    shown = {value.key: value.value for value in diagnostics[-1].status[0].values}
    for name, (_, value) in publishers.items():
        assert shown[name] == f'{value:.3f}'
    assert (shown['none'], shown['spread']) == ('not known', '0.000')


def test_without_a_thermometer_the_middle_of_the_range_corrects_and_is_said(
        bench: Any, readings: Readings, stored: Stored) -> None:
    path = stored(sensor='imu_link')
    calibration = with_effects(
        read_calibration(path), {'offset_temperature': [0.01, -0.015, 0.02]}, 1e-14,
        temperature=np.linspace(20.0, 40.0, 20))
    write_calibration(path, calibration)
    progress = bench.listen(DiagnosticStatus, '/calibrator/progress', latched=True)
    bench.calibrator(calibration_file=str(path))
    reading = readings([[0.0, 0.6, 0.8]])[0]
    found = bench.exchange(bench.came_out, lambda: bench.imu(reading))
    expected = calibration.apply(reading[np.newaxis], temperature=[30.0])[0]
    np.testing.assert_allclose(force_of(found), expected, atol=1e-6)

    def told() -> bool:
        return bool(progress) and 'no temperature arrives' in progress[-1].message

    bench.send_until(lambda: bench.imu(reading), told)
    assert progress[-1].level == DiagnosticStatus.WARN
    assert progress[-1].message.endswith('30 °C is used instead')


CURVE = [2e-3, -1e-3, 3e-3, 1e-3, 2e-3, -2e-3, 15.0, 35.0]


@pytest.mark.parametrize(('name', 'values'), [
    ('offset_temperature', [1e-3, -1.5e-3, 2e-3, 30.0, 0.0]),
    ('offset_temperature', [1e-3, -1.5e-3, 2e-3, 30.0, 1.0]),
    ('empirical-offset-temperature-1-2', CURVE)],
    ids=['lag of the die', 'lag of the sensor', 'curve'])
def test_messages_are_corrected_as_offline(bench: Any, readings: Readings, name: str,
                                           values: list[float], stored: Stored
                                           ) -> None:
    path = stored(sensor='imu_link')
    publisher = bench.node.create_publisher(Temperature, 'temperature', 10)
    bench.calibrator(calibration_file=str(path))
    bench.spin(lambda: publisher.get_subscription_count() > 0)
    reading = readings([[0.0, 0.6, 0.8]])[0]
    # The node knows the temperatures before the calibration: a reload continues the lag.
    meet(bench, publisher, 20.0)
    bench.exchange(bench.came_out, lambda: bench.imu(reading))
    # So long after the messages so far that the temperature before does not matter.
    times, warm, found = bench.stamp + 1e5 + np.arange(60), 20.0 + 0.25 * np.arange(60), []
    for k in range(60):
        published(bench, publisher, warm[k])
        if k == 30:
            calibration, turn = read_calibration(path), np.arange(20)
            calibration = with_effects(
                calibration, {name: values}, 1e-14,
                temperature=25.0 + 10.0 * np.cos(turn * 2.0), time=turn * 100.0)
            write_calibration(path, calibration)
            answer = bench.call('load')
            assert answer.success, answer.message
        bench.stamp = times[k] - 0.02  # the next message has the next stamp
        found += bench.echo([bench.imu(reading)], bench.came_out)
    expected = calibration.apply(np.tile(reading, (60, 1)), time=times, temperature=warm)
    # The history has a point every 2 s, so that the rate of the past differs slightly.
    np.testing.assert_allclose([*map(force_of, found[30:])], expected[30:], atol=2e-3)
    assert np.ptp(expected[30:], axis=0).max() > 0.02
    begun_now = calibration.apply(np.tile(reading, (30, 1)), time=times[30:],
                                  temperature=warm[30:])
    if 'lag' in calibration.model.terms.effects[-1].shape:
        assert np.abs(begun_now - expected[30:]).max() > 0.02
