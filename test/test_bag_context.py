# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Temperature and supply voltage from topics of any type, with or without stamps."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from accel_calib.errors import InputError
from accel_calib.logs import field_of, LogOptions, open_log
from accel_calib.messages import correct_bag
from accel_calib.stored import write_calibration
from accel_calib.table import concatenated, quantity_key, Recording
from bag_files import fill, header, IMU, imu, writer_of
from inside import main
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from shared import known, with_effects

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


def write(folder: Path, topics: Mapping[str, tuple[str, Values]], kind: str = 'mcap', *,
          stamped: int = RECEIVED, own_stamp: int | None = None) -> Path:
    """Write a bag of 4 s with an Imu and other topics, and their first stamps [ns]."""
    path = folder / ('in.bag' if kind == 'bag' else 'in')
    writer, store = writer_of(path, kind)
    store.register(get_types_from_msg(OWN_DEFINITION, OWN))

    def made() -> Iterator[tuple[int, int, Any]]:
        for k in range(COUNT):
            at = k * STEP
            yield 0, RECEIVED + at, imu(store, header(store, stamped + at), (0.1, -0.2, 9.8))
            for topic, (msgtype, value) in enumerate(topics.values(), 1) if k % 10 == 0 else ():
                stamp = (stamped if own_stamp is None else own_stamp) + at
                yield topic, RECEIVED + at, message(store, msgtype, stamp, value(at * 1e-9))

    names = [('/imu/data', IMU), *((name, msgtype) for name, (msgtype, _) in topics.items())]
    fill(writer, store, names, made())
    return path


def read(path: Path, **asked: str) -> tuple[Recording, tuple[str, ...]]:
    with open_log(path, LogOptions(context=asked)) as opened:
        return concatenated(list(opened.blocks)), opened.notes


def warming(seconds: float) -> float:
    return 20.0 + 2.0 * seconds


EXPECTED = warming(np.minimum(np.arange(COUNT) * 0.01, 3.9))


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'bag'])
@pytest.mark.parametrize('number', ['Float32', 'Float64', 'Int16'])
def test_a_number_without_stamp_has_the_time_of_its_receipt(number: str, kind: str,
                                                            tmp_path: Path) -> None:
    whole = number == 'Int16'
    value = (lambda seconds: round(100 * warming(seconds)) // 100) if whole else warming
    path = write(tmp_path, {'/imu/temp': (f'std_msgs/msg/{number}', value)}, kind)
    found, notes = read(path, temperature='/imu/temp')
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1.0 if whole else 1e-5)
    assert len(notes) == 1
    assert all(each in notes[0] for each in ('/imu/temp', f'/{number}', 'no stamp'))


@pytest.mark.parametrize(('msgtype', 'clock'), [
    ('std_msgs/msg/Float64', {'stamped': 12 * 10 ** 9}),
    ('sensor_msgs/msg/Temperature', {'own_stamp': 0}),
    ('sensor_msgs/msg/Temperature', {'own_stamp': 5 * 10 ** 9})])
def test_times_of_receipt_are_converted_to_the_clock_of_the_imu(
        msgtype: str, clock: Mapping[str, int], tmp_path: Path) -> None:
    found, notes = read(write(tmp_path, {'/t': (msgtype, warming)}, **clock),
                        temperature='/t')
    assert found['time'][0] == clock.get('stamped', RECEIVED) * 1e-9
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-5)
    assert 'have no stamp' in notes[0]


FLOAT, WARM = 'std_msgs/msg/Float32', ('sensor_msgs/msg/Temperature', warming)
PRESSURE = {'/pressure': ('sensor_msgs/msg/FluidPressure', lambda seconds: 101325.0)}


@pytest.mark.parametrize(('topics', 'words'), [
    ({'/imu/temp': (FLOAT, warming), '/speed': (FLOAT, warming)},
     ['topic /imu/temp (std_msgs/msg/Float32)', '--context temperature:=/imu/temp']),
    ({'/a/t': WARM, '/b/t': WARM}, ['topics /a/t (', ', /b/t (', '--context temperature:=TOPIC']),
    (PRESSURE, ['topic /pressure (', 'a pressure is no temperature']),
    ({'/t': ('sensor_msgs/msg/Temperature', lambda seconds: np.nan)},
     ['40 messages on /t (sensor_msgs/msg/Temperature)'])])
def test_a_topic_that_is_not_clearly_the_temperature_is_named_and_not_used(
        topics: Mapping[str, tuple[str, Values]], words: list[str], tmp_path: Path) -> None:
    found, notes = read(write(tmp_path, topics))
    assert 'temperature' not in found
    assert [each for each in words if each not in notes[0]] == []


def test_of_several_temperatures_that_of_the_imu_is_used(tmp_path: Path) -> None:
    path = write(tmp_path, {
        '/motor/temperature': ('sensor_msgs/msg/Temperature', lambda seconds: 70.0),
        '/imu/temperature': WARM})
    found, notes = read(path)
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-9)
    assert len(notes) == 1
    assert notes[0].endswith(' --context temperature:=/motor/temperature')
    found, _ = read(path, temperature='/motor/temperature')
    assert set(found['temperature']) == {70.0}


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'bag'])
def test_the_voltage_of_a_battery_is_the_supply_where_it_is_named(kind: str,
                                                                  tmp_path: Path) -> None:
    path = write(tmp_path, {
        '/battery': ('sensor_msgs/msg/BatteryState', lambda seconds: 12.0 - seconds)}, kind)
    found, notes = read(path, supply_voltage='/battery')
    np.testing.assert_allclose(found['supply_voltage'], 12.0 - (EXPECTED - 20.0) / 2.0, atol=1e-5)
    assert notes == ()
    found, notes = read(path)
    assert 'supply_voltage' not in found
    assert len(notes) == 1
    assert notes[0].endswith(' --context supply_voltage:=/battery')


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'bag'])
def test_fields_of_a_type_of_the_user_are_found(kind: str, tmp_path: Path) -> None:
    path = write(tmp_path, {'/board': (OWN, warming)}, kind)
    found, notes = read(path, temperature='/board', supply_voltage='/board')
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-5)
    assert set(found['supply_voltage']) == {5.0}
    assert notes == ()
    found, _ = read(path, temperature='/board/analog/load')
    assert set(found['temperature']) == {1.0}
    found, notes = read(path, load='/board/analog.load')
    assert set(found[quantity_key('load')]) == {1.0}
    with pytest.raises(InputError, match='has the numbers analog.vcc, analog.load, imu_temp, '
                                         'errors, expected none; name another topic, or the '
                                         'field with --context temperature:=/board/FIELD'):
        read(path, temperature='/board/none')


def test_kelvin_and_millivolts_are_converted_and_noted(tmp_path: Path) -> None:
    path = write(tmp_path, {
        '/k': ('std_msgs/msg/Float64', lambda seconds: 273.15 + warming(seconds)),
        '/mv': ('std_msgs/msg/UInt16', lambda seconds: 3300)})
    found, notes = read(path, temperature='/k', supply_voltage='/mv')
    np.testing.assert_allclose(found['temperature'], EXPECTED, atol=1e-5)
    np.testing.assert_allclose(found['supply_voltage'], 3.3)
    assert any('/k ' in note and note.endswith(' as K') for note in notes)
    assert any('/mv ' in note and note.endswith(' as mV') for note in notes)


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
    path = write(tmp_path, topics)
    with pytest.raises(InputError, match=words):
        read(path, temperature=asked)


@pytest.mark.parametrize(('column', 'numbers', 'asked', 'field'), [
    ('temperature', ('voltage', 'temperature'), '', 'temperature'),
    ('temperature', ('fluid_pressure', 'variance'), '', ''),
    ('pressure', ('fluid_pressure', 'variance'), '', 'fluid_pressure'),
    ('motor_current', ('voltage', 'current'), '', 'current'),
    ('load', ('voltage', 'current'), '', 'voltage'),
    ('load', ('left', 'right'), '', ''), ('load', ('left', 'right'), 'right', 'right'),
    ('load', ('left',), '', 'left'), ('load', ('left',), 'right', '')])
def test_a_field_is_read_only_if_one_can_hold_the_column(
        column: str, numbers: tuple[str, ...], asked: str, field: str) -> None:
    assert field_of(column, numbers, asked) == field


def test_a_bag_is_corrected_with_a_named_temperature(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    thermal = with_effects(known('g'), {'offset_temperature': (0.002, -0.001, 0.003)},
                           temperature=np.linspace(10.0, 40.0, 20))
    path, out = write(tmp_path, {'/imu/temp': ('std_msgs/msg/Float64', warming)}), tmp_path / 'out'
    with pytest.raises(InputError, match='looks like a temperature .* but the calibration depends '
                                         'on the temperature; name the topic with'):
        correct_bag(path, thermal, out)
    notes: list[str] = []
    options = LogOptions(context={'temperature': '/imu/temp'})
    assert correct_bag(path, thermal, out, options, note=notes.append) == COUNT
    assert 'have no stamp' in notes[0]
    raw, found = read(path, temperature='/imu/temp')[0], read(out)[0]
    expected = thermal.correct(raw.reading / 9.80665, {'temperature': raw['temperature']})
    np.testing.assert_allclose(found.reading, expected * 9.80665, atol=1e-9)
    assert np.ptp(found.reading, axis=0).max() > 0.05

    write_calibration(tmp_path / 'c.yaml', thermal)
    given = ['apply', str(path), '-c', str(tmp_path / 'c.yaml'), '-o', str(tmp_path / 'other')]
    assert main(given) == 2
    assert main([*given, '--context', 'temperature:=/imu/temp']) == 0
    assert 'corrected 400 samples' in capsys.readouterr().out


def test_a_calibration_without_temperature_needs_no_topic(tmp_path: Path) -> None:
    path = write(tmp_path, {'/imu/temp': ('std_msgs/msg/Float64', warming)})
    notes: list[str] = []
    assert correct_bag(path, known('g'), tmp_path / 'out', note=notes.append) == COUNT
    assert notes == []
