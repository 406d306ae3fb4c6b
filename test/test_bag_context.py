# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Temperature and supply voltage from topics of any type, with or without stamps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from accel_calib.calibrate import Calibration, fit_poses
from accel_calib.errors import InputError
from accel_calib.logs import LogOptions, open_log
from accel_calib.messages import correct_bag
from accel_calib.stored import write_calibration
from accel_calib.table import Recording
from accel_calib.units import units_of
from bag_files import header, IMU, imu, writer_of
from inside import model_with, simulate_poses, spread_directions, together
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

COUNT, STEP = 400, 10 ** 7
RECEIVED = 1_700_000_000 * 10 ** 9
"""Time of the first receipt [ns]."""

OWN = 'own_msgs/msg/Board'
OWN_DEFINITION = """std_msgs/Header header
own_msgs/Analog analog
float32 imu_temp
uint16 errors
================================================================================
MSG: own_msgs/Analog
float64 vcc
float64 load
"""
Values = Callable[[float], Any]


def message(store: Any, msgtype: str, stamp: int, value: Any) -> Any:
    """Return a message of a type with this value."""
    kind = store.types[msgtype]
    if msgtype.startswith('std_msgs/'):
        return kind(value)
    about = header(store, stamp)
    if msgtype == 'sensor_msgs/msg/BatteryState':
        found = {'header': about, 'voltage': value, 'temperature': float('nan'), 'present': True,
                 'location': '', 'serial_number': ''}
        empty = {'cell_voltage': np.zeros(0, np.float32),
                 'cell_temperature': np.zeros(0, np.float32)}
        return kind(**{name: found.get(name, empty.get(name, 0))
                       for name in kind.__dataclass_fields__ if not name.isupper()})
    if msgtype == OWN:
        return kind(about, store.types['own_msgs/msg/Analog'](5.0, 1.0), value, 3)
    return kind(about, value, 0.0)


def write(path: Path, topics: Mapping[str, tuple[str, Values]], kind: str = 'mcap', *,
          stamped: int = RECEIVED, own_stamp: int | None = None,
          force: Sequence[float] = (0.1, -0.2, 9.8)) -> Path:
    """
    Write a bag of 4 s with an Imu and other topics.

    `stamped` is the first stamp of the Imu, `own_stamp` that of the others [ns], and `force` the
    acceleration.

    """
    writer, store, serialize = writer_of(path, kind)
    store.register(get_types_from_msg(OWN_DEFINITION, OWN))
    with writer:
        own = writer.add_connection('/imu/data', IMU, typestore=store)
        others = {name: writer.add_connection(name, msgtype, typestore=store)
                  for name, (msgtype, _) in topics.items()}
        for k in range(COUNT):
            made = imu(store, header(store, stamped + k * STEP), force)
            writer.write(own, RECEIVED + k * STEP, serialize(made, IMU))
            if k % 10:
                continue
            for name, (msgtype, value) in topics.items():
                stamp = (stamped if own_stamp is None else own_stamp) + k * STEP
                made = message(store, msgtype, stamp, value(k * STEP * 1e-9))
                writer.write(others[name], RECEIVED + k * STEP, serialize(made, msgtype))
    return path


def read(path: Path, **asked: str) -> tuple[Recording, tuple[str, ...]]:
    with open_log(path, LogOptions(**asked)) as opened:
        return together(list(opened.blocks)), opened.notes


def warming(seconds: float) -> float:
    return 20.0 + 2.0 * seconds


EXPECTED = warming(np.minimum(np.arange(COUNT) * 0.01, 3.9))


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'bag'])
@pytest.mark.parametrize('number', ['Float32', 'Float64', 'Int16'])
def test_a_number_without_stamp_has_the_time_of_its_receipt(number: str, kind: str,
                                                            tmp_path: Path) -> None:
    whole = number == 'Int16'
    value = (lambda seconds: round(100 * warming(seconds)) // 100) if whole else warming
    path = write(tmp_path / 'r.bag' if kind == 'bag' else tmp_path / kind,
                 {'/imu/temp': (f'std_msgs/msg/{number}', value)}, kind)
    found, notes = read(path, temperature_topic='/imu/temp')
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1.0 if whole else 1e-5)
    assert notes == (f'the messages on /imu/temp (std_msgs/msg/{number}) have no stamp of the '
                     'clock of the Imu: their times are those at which the bag received them',)


def test_a_topic_that_looks_like_a_temperature_is_named_and_not_used(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', {'/imu/temp': ('std_msgs/msg/Float32', warming),
                                    '/speed': ('std_msgs/msg/Float32', warming)})
    found, notes = read(path)
    assert 'temperature' not in found
    assert notes == ('topic /imu/temp (std_msgs/msg/Float32) looks like a temperature and is not '
                     'used: name it with --temperature-topic /imu/temp',)


def test_times_of_receipt_are_converted_to_the_clock_of_the_imu(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', {'/imu/temp': ('std_msgs/msg/Float64', warming)},
                 stamped=12 * 10 ** 9)
    found, _ = read(path, temperature_topic='/imu/temp')
    assert found['time'][0] == 12.0
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-5)


@pytest.mark.parametrize('own_stamp', [0, 5 * 10 ** 9])
def test_a_stamp_of_another_clock_is_replaced_by_the_time_of_receipt(own_stamp: int,
                                                                     tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', {'/t': ('sensor_msgs/msg/Temperature', warming)},
                 own_stamp=own_stamp)
    found, notes = read(path)
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-5)
    assert 'have no stamp of the clock of the Imu' in notes[0]


def test_of_several_temperatures_that_of_the_imu_is_used(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', {
        '/motor/temperature': ('sensor_msgs/msg/Temperature', lambda seconds: 70.0),
        '/imu/temperature': ('sensor_msgs/msg/Temperature', warming)})
    found, notes = read(path)
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-9)
    assert notes == ('topic /motor/temperature (sensor_msgs/msg/Temperature) looks like a '
                     'temperature and is not used: name it with --temperature-topic '
                     '/motor/temperature',)
    found, _ = read(path, temperature_topic='/motor/temperature')
    assert set(found['temperature']) == {70.0}


def test_none_of_several_temperatures_is_used_if_it_is_not_clear_which(tmp_path: Path) -> None:
    one = ('sensor_msgs/msg/Temperature', warming)
    found, notes = read(write(tmp_path / 'bag', {'/a/t': one, '/b/t': one}))
    assert 'temperature' not in found
    assert notes == ('topics /a/t (sensor_msgs/msg/Temperature), /b/t (sensor_msgs/msg/'
                     'Temperature) look like a temperature and are not used: name one with '
                     '--temperature-topic TOPIC',)


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'bag'])
def test_the_voltage_of_a_battery_is_the_supply_where_it_is_named(kind: str,
                                                                  tmp_path: Path) -> None:
    path = write(tmp_path / 'r.bag' if kind == 'bag' else tmp_path / kind, {
        '/battery': ('sensor_msgs/msg/BatteryState', lambda seconds: 12.0 - seconds)}, kind)
    found, notes = read(path, supply_topic='/battery')
    np.testing.assert_allclose(found['supply_voltage'], 12.0 - (EXPECTED - 20.0) / 2.0, atol=1e-5)
    assert notes == ()
    found, notes = read(path)
    assert 'supply_voltage' not in found
    assert notes == ('topic /battery (sensor_msgs/msg/BatteryState) looks like a supply voltage '
                     'and is not used: name it with --supply-topic /battery',)


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'bag'])
def test_fields_of_a_type_of_the_user_are_found(kind: str, tmp_path: Path) -> None:
    path = write(tmp_path / 'r.bag' if kind == 'bag' else tmp_path / kind,
                 {'/board': (OWN, warming)}, kind)
    found, notes = read(path, temperature_topic='/board', supply_topic='/board')
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-5)
    assert set(found['supply_voltage']) == {5.0}
    assert notes == ()
    found, _ = read(path, temperature_topic='/board:analog.load')
    assert set(found['temperature']) == {1.0}
    with pytest.raises(InputError, match='has the numbers analog.vcc, analog.load, imu_temp, '
                                         'errors, expected none; name another topic, or the '
                                         'field with --temperature-topic /board:FIELD'):
        read(path, temperature_topic='/board:none')


def test_kelvin_and_millivolts_are_converted_and_noted(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', {
        '/k': ('std_msgs/msg/Float64', lambda seconds: 273.15 + warming(seconds)),
        '/mv': ('std_msgs/msg/UInt16', lambda seconds: 3300)})
    found, notes = read(path, temperature_topic='/k', supply_topic='/mv')
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-5)
    np.testing.assert_allclose(found['supply_voltage'], 3.3)
    assert 'the numbers on /k (std_msgs/msg/Float64) are read as K' in notes
    assert 'the numbers on /mv (std_msgs/msg/UInt16) are read as mV' in notes


PRESSURE = {'/pressure': ('sensor_msgs/msg/FluidPressure', lambda seconds: 101325.0)}


@pytest.mark.parametrize(('topics', 'asked', 'words'), [
    (PRESSURE, '/pressure', r'topic /pressure \(sensor_msgs/msg/FluidPressure\) has the numbers '
     'fluid_pressure, variance, expected one temperature; name another topic'),
    ({'/p': ('std_msgs/msg/Float64', lambda seconds: 101325.0)}, '/p',
     'the values on /p .* are about 1.013e.05, expected a temperature from -100 to 200 °C'),
    ({'/t': ('std_msgs/msg/Float32', lambda seconds: np.nan)}, '/t',
     'has 40 messages on /t .* with no finite number, expected the temperature'),
    ({'/text': ('std_msgs/msg/String', str)}, '/text', 'has no single number, expected one'),
    ({}, '/none', 'has the topics /imu/data .*, expected /none; choose one of them with')])
def test_a_topic_without_a_temperature_is_refused(
        topics: Mapping[str, tuple[str, Values]], asked: str, words: str, tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', topics)
    with pytest.raises(InputError, match=words):
        read(path, temperature_topic=asked)


def test_a_pressure_is_mentioned_where_there_is_no_temperature(tmp_path: Path) -> None:
    _, notes = read(write(tmp_path / 'bag', PRESSURE))
    assert notes == ('topic /pressure (sensor_msgs/msg/FluidPressure): a pressure is no '
                     'temperature, and the bag has no other topic that looks like one',)


def test_a_temperature_without_numbers_is_not_used(tmp_path: Path) -> None:
    found, notes = read(write(tmp_path / 'bag', {
        '/t': ('sensor_msgs/msg/Temperature', lambda seconds: np.nan)}))
    assert 'temperature' not in found
    assert notes[0].startswith('there is no temperature: 40 messages on /t')


@pytest.fixture(scope='module')
def thermal() -> Calibration:
    """Return a calibration in g that depends on the temperature."""
    rng, directions = np.random.default_rng(4), spread_directions(24)
    model = model_with({'offset': (0.02, -0.01, 0.03), 'axis_gain': (0.01, -0.01, 0.02),
                        'offset_temperature': (0.002, -0.001, 0.003)})
    poses = simulate_poses(model, directions, rng, noise_g=1e-4, context={
        'temperature': rng.uniform(10.0, 40.0, len(directions))})
    from accel_calib.refine import refine

    found = refine(poses, units_of('g'), base='7').calibration
    assert 'offset_temperature' in found.model.effects
    return found


def test_a_bag_is_corrected_with_a_named_temperature(thermal: Calibration, tmp_path: Path
                                                     ) -> None:
    path = write(tmp_path / 'bag', {'/imu/temp': ('std_msgs/msg/Float64', warming)})
    raw, _ = read(path, temperature_topic='/imu/temp')
    notes: list[str] = []
    assert correct_bag(path, thermal, tmp_path / 'out', temperature_topic='/imu/temp',
                       note=notes.append) == COUNT
    found, _ = read(tmp_path / 'out')
    expected = thermal.correct(raw.reading / 9.80665, {'temperature': raw['temperature']})
    np.testing.assert_allclose(found.reading, expected * 9.80665, atol=1e-9)
    assert np.ptp(found.reading, axis=0).max() > 0.05
    assert 'have no stamp' in notes[0]


def test_a_calibration_that_depends_on_a_temperature_names_the_topics(
        thermal: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from inside import main

    path = write(tmp_path / 'bag', {'/imu/temp': ('std_msgs/msg/Float64', warming)})
    write_calibration(tmp_path / 'c.yaml', thermal)
    with pytest.raises(InputError, match='looks like a temperature .* but the calibration depends '
                                         'on the temperature; name the topic with'):
        correct_bag(path, thermal, tmp_path / 'out')
    given = ['apply', str(path), '-c', str(tmp_path / 'c.yaml'), '-o', str(tmp_path / 'out')]
    assert main(given) == 2
    assert main([*given, '--temperature-topic', '/imu/temp']) == 0
    assert 'corrected 400 samples' in capsys.readouterr().out


@pytest.fixture(scope='module')
def calibration_in_g() -> Calibration:
    rng = np.random.default_rng(1)
    return fit_poses(simulate_poses(model_with({'offset': 0.01}), spread_directions(16), rng),
                     units_of('g'))


def test_a_calibration_without_temperature_needs_no_topic(calibration_in_g: Calibration,
                                                          tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', {'/imu/temp': ('std_msgs/msg/Float64', warming)})
    notes: list[str] = []
    assert correct_bag(path, calibration_in_g, tmp_path / 'out', note=notes.append) == COUNT
    assert notes == []


def test_a_calibration_in_g_corrects_a_bag_in_m_s2_and_refuses_one_in_g(
        calibration_in_g: Calibration, tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', {})
    assert correct_bag(path, calibration_in_g, tmp_path / 'out') == COUNT
    raw, found = read(path)[0], read(tmp_path / 'out')[0]
    np.testing.assert_allclose(
        found.reading, calibration_in_g.correct(raw.reading / 9.80665) * 9.80665, rtol=1e-12)
    wrong = write(tmp_path / 'wrong', {}, force=(0.01, -0.02, 1.0))
    with pytest.raises(InputError, match='the length of the readings is about 1, expected about '
                                         '9.807 at rest in m/s2'):
        correct_bag(wrong, calibration_in_g, tmp_path / 'out2')
    assert not (tmp_path / 'out2').exists()
