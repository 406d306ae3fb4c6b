# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Write the samples of logs: one simulated sensor, in the layout that each maker documents.

Run ``PYTHONPATH=.:test python test/data/logs/make.py`` in the root of the project. The samples are
simulated, not recorded: offset, gain and cross-axis of the sensor are known (`OFFSET_G`, `GAIN`),
so that a test can compare a fit with them. The source of each layout is at its function.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
import struct
from typing import Any

from accel_calib.table import Floats, Recording
from inside import model_with, simulate_recording, spread_directions
import numpy as np

HERE = Path(__file__).parent
RATE_HZ, POSES, DWELL, TURN = 20.0, 12, 3.0, 0.8
NOISE_G = 0.003
OFFSET_G = np.array([0.031, -0.042, 0.055])
GAIN = np.array([[1.012, 0.004, -0.003], [0.004, 0.991, 0.002], [-0.003, 0.002, 1.006]])
"""W, symmetric."""

WARM = (28.0, 31.0)
G = 9.80665
START = datetime(2026, 7, 14, 9, 30, 12, 250000, tzinfo=timezone.utc)
FRD = np.diag([1.0, -1.0, -1.0])
"""From x forward, y left, z up to x forward, y right, z down."""


@dataclass(frozen=True)
class Truth:
    """
    What a fit of a sample is to find, in the unit of the sample.

    Parameters
    ----------
    units : {'m/s2', 'g', 'native'}
        Unit of the readings after they are read.
    offset : (3,) array
        V.
    gain : (3, 3) array
        W, dimensionless, or native units per g.
    temperature : bool
        Whether the log has a temperature.
    rate : bool
        Whether the log has angular rates in a known unit.

    """

    units: str
    offset: Floats
    gain: Floats
    temperature: bool = False
    rate: bool = False


def truth(units: str, per_g: float = 1.0, sign: float = 1.0, *, temperature: bool = False,
          rate: bool = False) -> Truth:
    """Return the truth in a unit of which 1 g is `per_g`."""
    native = units == 'native'
    return Truth(units, sign * per_g * OFFSET_G, GAIN * (per_g if native else 1.0), temperature,
                 rate)


def recording(seed: int, *, down: bool = False, poses: int = POSES, rate_hz: float = RATE_HZ
              ) -> Recording:
    """Return the samples [g]; with z down if asked. The first pose is flat."""
    cross = [GAIN[0, 1], GAIN[0, 2], GAIN[1, 2]]
    model = model_with({'offset': OFFSET_G, 'axis_gain': GAIN.diagonal() - 1.0,
                        'cross_axis': cross}, FRD if down else None)
    up = np.vstack([[[0.0, 0.0, 1.0]], spread_directions(poses)[1:]])
    return simulate_recording(model, up, np.random.default_rng(seed), noise_g=NOISE_G,
                              rate_hz=rate_hz, dwell=DWELL, turn=TURN, temperatures=WARM)


def lines(folder: Path, name: str, head: Sequence[str], rows: Iterable[str]) -> None:
    """Write a text file with these lines."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('\n'.join([*head, *rows]) + '\n', encoding='utf-8')


def stamps(samples: Recording, seed: int) -> Floats:
    """Return the times of a phone [s], which are not even."""
    jitter = np.random.default_rng(seed).uniform(-2e-4, 2e-4, len(samples))
    return np.maximum.accumulate(samples['time'] + jitter - jitter[0])


# ------------------------------------------------------------------------------ phyphox
# Header in quotes, numbers as 0.000000000E0, one of five pairs of separator and decimal sign:
# https://github.com/phyphox/phyphox-android, DataExport.java, class CsvFormat; the names are those
# of the experiments 'Acceleration with g' and 'Acceleration (without g)'.

PHYPHOX = {'comma_point': (',', '.'), 'tab_point': ('\t', '.'), 'semicolon_point': (';', '.'),
           'tab_comma': ('\t', ','), 'semicolon_comma': (';', ',')}


def phyphox_table(folder: Path, name: str, names: Sequence[str], columns: Floats,
                  separator: str, decimal: str) -> None:
    """Write a table as phyphox does."""
    def number(value: float) -> str:
        mantissa, exponent = f'{value:.9E}'.split('E')
        return f'{mantissa.replace(".", decimal)}E{int(exponent)}'

    lines(folder, name, [separator.join(f'"{each}"' for each in names)],
          (separator.join(map(number, row)) for row in columns.tolist()))


def phyphox(folder: Path) -> None:
    """Write 'Acceleration with g' in each dialect, a simple experiment, and one without g."""
    axes = ('x', 'y', 'z')
    for k, (name, dialect) in enumerate(PHYPHOX.items()):
        samples = recording(10 + k)
        force = samples.reading * G
        size = np.linalg.norm(force, axis=1)
        phyphox_table(folder, f'phyphox/{name}.csv',
                      ['Time (s)', *(f'Acceleration {axis} (m/s^2)' for axis in axes),
                       'Absolute acceleration (m/s^2)'],
                      np.column_stack([stamps(samples, k), force, size]), *dialect)
    samples = recording(15)
    phyphox_table(folder, 'phyphox/simple/Accelerometer.csv',
                  ['Time (s)', *(f'{axis.upper()} (m/s^2)' for axis in axes)],
                  np.column_stack([stamps(samples, 5), samples.reading * G]), ',', '.')
    samples = recording(16, poses=6, rate_hz=10.0)
    force = (samples.reading - samples['reference']) * G - OFFSET_G * G
    phyphox_table(folder, 'phyphox/without_g.csv',
                  ['Time (s)', *(f'Linear Acceleration {axis} (m/s^2)' for axis in axes),
                   'Absolute acceleration (m/s^2)'],
                  np.column_stack([stamps(samples, 6), force, np.linalg.norm(force, axis=1)]),
                  ',', '.')


# ------------------------------------------------------------------------- Sensor Logger
# One file for each sensor: time [ns since 1970], seconds_elapsed, z, y, x. Units and signs:
# https://github.com/tszheichoi/awesome-sensor-logger/blob/main/UNITS.md (and COORDINATES.md)

def logger_table(folder: Path, name: str, time: Floats, force: Floats) -> None:
    """Write a table as Sensor Logger does; the order is z, y, x."""
    elapsed = time + 0.0706953125
    began = int(START.timestamp()) * 10 ** 9
    lines(folder, name, ['time,seconds_elapsed,z,y,x'],
          (f'{began + round(s * 1e6) * 1000},{s:.9g},{z:.10g},{y:.10g},{x:.10g}'
           for s, (x, y, z) in zip(elapsed.tolist(), force.tolist())))


def sensor_logger(folder: Path) -> None:
    """Write the files of an Android phone, and the uncalibrated one of an iPhone."""
    samples = recording(20)
    time = stamps(samples, 20)
    logger_table(folder, 'sensor-logger/android/TotalAcceleration.csv', time, samples.reading * G)
    logger_table(folder, 'sensor-logger/ios/AccelerometerUncalibrated.csv', time,
                 -recording(21).reading)
    samples = recording(22, poses=6, rate_hz=10.0)
    time = stamps(samples, 22)
    moved = (samples.reading - samples['reference'] - OFFSET_G) * G
    logger_table(folder, 'sensor-logger/android/Accelerometer.csv', time, moved)
    logger_table(folder, 'sensor-logger/android/Gravity.csv', time, samples['reference'] * G)


# ------------------------------------------------------------------------- MATLAB Mobile
# writetimetable of the timetable Acceleration (Timestamp, X, Y, Z, m/s²):
# https://www.mathworks.com/help/matlabmobile/ug/logging-accelerometer-data.html
# and sensorlog_accel_*.csv in the zip file of a local log, with ms since 1970, as
# https://www.mathworks.com/help/matlab/ref/readmobilesensordata.html reads it.

def matlab(folder: Path) -> None:
    """Write a timetable, and the file of a local log."""
    def row(values: Sequence[float]) -> str:
        return ','.join(f'{value:.15g}' for value in values)

    samples = recording(30)
    moments = [START + timedelta(seconds=each) for each in stamps(samples, 30).tolist()]
    force = (samples.reading * G).round(6).tolist()
    lines(folder, 'matlab/acceleration.csv', ['Timestamp,X,Y,Z'],
          (f'{each:%d-%b-%Y %H:%M:%S}.{each.microsecond // 1000:03d},{row(values)}'
           for each, values in zip(moments, force)))
    samples = recording(31)
    moments = [START + timedelta(seconds=each) for each in stamps(samples, 31).tolist()]
    force = (samples.reading * G).round(6).tolist()
    lines(folder, 'matlab/sensorlog_accel_20260714_093012.csv', ['timestamp,X,Y,Z'],
          (f'{round(each.timestamp() * 1000)},{row(values)}'
           for each, values in zip(moments, force)))


# ------------------------------------------------------------------------------------ PX4
# Fields of the messages: https://docs.px4.io/main/en/msg_docs/ (SensorAccel, SensorGyro,
# SensorCombined, VehicleImu). File: https://docs.px4.io/main/en/dev_log/ulog_file_format
# CSV: ulog2csv of https://github.com/PX4/pyulog, one file for each message, timestamp first.

ULOG_TYPES = {'uint64_t': 'Q', 'uint32_t': 'I', 'int32_t': 'i', 'uint16_t': 'H', 'float': 'f',
              'uint8_t': 'B', 'bool': '?'}

Fields = dict[str, tuple[str, Sequence[float]]]
"""Type and values of each field; ``name[k]`` is a part of an array."""


def stamps_us(samples: Recording) -> list[int]:
    """Return the times of a vehicle [µs since boot]."""
    return [18_400_000 + round(each * 1e6) for each in samples['time'].tolist()]


def accel_fields(samples: Recording, device: int) -> Fields:
    """Return sensor_accel."""
    x, y, z = (samples.reading * G).T.tolist()
    time, n = stamps_us(samples), len(samples)
    return {'timestamp': ('uint64_t', [each + 212 for each in time]),
            'timestamp_sample': ('uint64_t', time), 'device_id': ('uint32_t', [device] * n),
            'x': ('float', x), 'y': ('float', y), 'z': ('float', z),
            'temperature': ('float', samples['temperature'].tolist()),
            'error_count': ('uint32_t', [0] * n),
            **{f'clip_counter[{k}]': ('uint8_t', [0] * n) for k in range(3)},
            'samples': ('uint8_t', [8] * n)}


def combined_fields(samples: Recording) -> Fields:
    """Return sensor_combined; its accelerometer is sampled 1 ms before the gyro."""
    time, n = stamps_us(samples), len(samples)
    reading, rate = (samples.reading * G).T.tolist(), samples['rate'].T.tolist()
    return {'timestamp': ('uint64_t', [each + 1000 for each in time]),
            **{f'gyro_rad[{k}]': ('float', rate[k]) for k in range(3)},
            'gyro_integral_dt': ('uint32_t', [4000] * n),
            'accelerometer_timestamp_relative': ('int32_t', [-1000] * n),
            **{f'accelerometer_m_s2[{k}]': ('float', reading[k]) for k in range(3)},
            'accelerometer_integral_dt': ('uint32_t', [4000] * n),
            'accelerometer_clipping': ('uint8_t', [0] * n),
            'gyro_clipping': ('uint8_t', [0] * n),
            'accel_calibration_count': ('uint8_t', [1] * n),
            'gyro_calibration_count': ('uint8_t', [1] * n)}


def imu_fields(samples: Recording, device: int) -> Fields:
    """Return vehicle_imu: changes of velocity and angle over 5 ms."""
    time, n, span = stamps_us(samples), len(samples), 5000
    change, angle = ((values * span * 1e-6).T.tolist()
                     for values in (samples.reading * G, samples['rate']))
    return {'timestamp': ('uint64_t', [each + 300 for each in time]),
            'timestamp_sample': ('uint64_t', time),
            'accel_device_id': ('uint32_t', [device] * n),
            'gyro_device_id': ('uint32_t', [device + 1] * n),
            **{f'delta_angle[{k}]': ('float', angle[k]) for k in range(3)},
            **{f'delta_velocity[{k}]': ('float', change[k]) for k in range(3)},
            'delta_angle_dt': ('uint16_t', [span] * n),
            'delta_velocity_dt': ('uint16_t', [span] * n),
            'delta_angle_clipping': ('uint8_t', [0] * n),
            'delta_velocity_clipping': ('uint8_t', [0] * n),
            'accel_calibration_count': ('uint8_t', [1] * n),
            'gyro_calibration_count': ('uint8_t', [1] * n)}


def ulog_bytes(messages: Sequence[tuple[str, int, Fields]]) -> bytes:
    """Return a ULog with these messages (name, number of the sensor, fields), in order of time."""
    def block(kind: bytes, data: bytes) -> bytes:
        return struct.pack('<Hc', len(data), kind) + data

    def declared(fields: Fields) -> str:
        found: dict[str, tuple[str, int]] = {}
        for name, (kind, _) in fields.items():
            base, bracket, _ = name.partition('[')
            found[base] = (kind, found.get(base, (kind, 0))[1] + 1 if bracket else 0)
        return ''.join(f'{kind}[{count}] {name};' if count else f'{kind} {name};'
                       for name, (kind, count) in found.items())

    out = b'ULog\x01\x12\x35\x01' + struct.pack('<Q', 18_000_000)
    out += block(b'B', bytes(40))
    formats = {name: declared(fields) for name, _, fields in messages}
    out += b''.join(block(b'F', f'{name}:{text}'.encode()) for name, text in formats.items())
    key, value = b'char[3] sys_name', b'PX4'
    out += block(b'I', bytes([len(key)]) + key + value)
    rows: list[tuple[int, bytes]] = []
    for number, (name, instance, fields) in enumerate(messages):
        out += block(b'A', struct.pack('<BH', instance, number) + name.encode())
        layout = '<H' + ''.join(ULOG_TYPES[kind] for kind, _ in fields.values())
        for values in zip(*(values for _, values in fields.values())):
            rows.append((int(values[0]), block(b'D', struct.pack(layout, number, *values))))
    return out + b''.join(row for _, row in sorted(rows, key=lambda each: each[0]))


def ulog2csv(folder: Path, name: str, fields: Fields) -> None:
    """Write one message as ulog2csv does."""
    floats = {key: np.float32(values) if kind == 'float' else values
              for key, (kind, values) in fields.items()}
    lines(folder, f'px4/{name}', [','.join(fields)],
          (','.join(map(str, row)) for row in zip(*floats.values())))


def every(fields: Fields, step: int) -> Fields:
    """Return each `step`-th row."""
    return {name: (kind, values[::step]) for name, (kind, values) in fields.items()}


def px4(folder: Path) -> None:
    """Write logs of the default profile and for thermal calibration, and messages as CSV."""
    samples, device = recording(40, down=True), 1310988
    (folder / 'px4').mkdir(parents=True, exist_ok=True)
    selection: Fields = {'timestamp': ('uint64_t', [stamps_us(samples)[0]]),
                         'accel_device_id': ('uint32_t', [device]),
                         'gyro_device_id': ('uint32_t', [device + 1])}
    (folder / 'px4/default.ulg').write_bytes(ulog_bytes([
        ('sensor_selection', 0, selection), ('sensor_combined', 0, combined_fields(samples)),
        ('sensor_accel', 0, every(accel_fields(recording(45, down=True), 1442826), 20)),
        ('sensor_accel', 1, every(accel_fields(samples, device), 20)),
        ('vehicle_imu', 0, every(imu_fields(samples, device), 10))]))
    gyro: Fields = {'timestamp': ('uint64_t', stamps_us(samples)),
                    'timestamp_sample': ('uint64_t', stamps_us(samples)),
                    'device_id': ('uint32_t', [device + 1] * len(samples)),
                    **{axis: ('float', samples['rate'][:, k].tolist())
                       for k, axis in enumerate('xyz')}}
    (folder / 'px4/thermal.ulg').write_bytes(ulog_bytes([
        ('sensor_accel', 0, accel_fields(recording(41, down=True), device)),
        ('sensor_gyro', 0, gyro)]))
    ulog2csv(folder, 'log_sensor_accel_0.csv', accel_fields(recording(42, down=True), device))
    ulog2csv(folder, 'log_sensor_combined_0.csv', combined_fields(recording(43, down=True)))
    ulog2csv(folder, 'log_vehicle_imu_0.csv', imu_fields(recording(44, down=True), device))


# ------------------------------------------------------------------------------ ArduPilot
# Messages: https://ardupilot.org/copter/docs/logmessages.html (IMU, ACC, PARM), letters of the
# fields: libraries/AP_InertialSensor/LogStructure.h and libraries/AP_Logger/README.md of
# https://github.com/ArduPilot/ardupilot. CSV: mavlogdump.py --format csv --types IMU of
# https://github.com/ArduPilot/pymavlink

DATAFLASH_TYPES = {'b': 'b', 'B': 'B', 'H': 'H', 'I': 'I', 'f': 'f', 'Q': 'Q', 'n': '4s',
                   'N': '16s', 'Z': '64s'}
DATAFLASH = {
    'FMT': (128, 'BBnNZ', 'Type,Length,Name,Format,Columns'),
    'PARM': (32, 'QNff', 'TimeUS,Name,Value,Default'),
    'IMU': (100, 'QBffffffIIfBBHH',
            'TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz'),
    'ACC': (101, 'QBQfff', 'TimeUS,I,SampleUS,AccX,AccY,AccZ'),
}

Row = tuple[str, tuple[Any, ...]]


def imu_rows(samples: Recording, instance: int) -> list[Row]:
    """Return the messages IMU of a sensor."""
    values = np.column_stack([samples['rate'], samples.reading * G]).tolist()
    warm = samples['temperature'].tolist()
    return [('IMU', (time, instance, *each, 0, 0, degrees, 1, 1, 1000, 1000))
            for time, each, degrees in zip(stamps_us(samples), values, warm)]


def dataflash_rows() -> list[Row]:
    """Return the messages of a log with two sensors, in order of time."""
    first, second = recording(50, down=True), recording(51, down=True, poses=6)
    rows = [*imu_rows(first, 0), *imu_rows(second, 1)]
    parameters: list[Row] = [('PARM', (18_000_000, name, value, 0.0)) for name, value in
                             (('INS_ACCOFFS_X', 0.0), ('INS_ACCSCAL_X', 1.0))]
    forms: list[Row] = [('FMT', (number, 3 + struct.calcsize('<' + ''.join(
        DATAFLASH_TYPES[letter] for letter in letters)), name, letters, names))
        for name, (number, letters, names) in DATAFLASH.items()]
    return [*forms, *parameters, *sorted(rows, key=lambda each: each[1][0])]


def dataflash_bytes(rows: Sequence[Row]) -> bytes:
    """Return a binary log."""
    out = []
    for name, values in rows:
        number, letters, _ = DATAFLASH[name]
        raw = [value.encode() if isinstance(value, str) else value for value in values]
        layout = '<' + ''.join(DATAFLASH_TYPES[letter] for letter in letters)
        out.append(b'\xa3\x95' + bytes([number]) + struct.pack(layout, *raw))
    return b''.join(out)


def ardupilot(folder: Path) -> None:
    """Write a log of two sensors in binary and as CSV, one in text, and one with ACC."""
    rows = dataflash_rows()
    (folder / 'ardupilot').mkdir(parents=True, exist_ok=True)
    (folder / 'ardupilot/two_imus.bin').write_bytes(dataflash_bytes(rows))
    one = [(name, values) for name, values in rows if name != 'IMU' or values[1] == 0]

    def text(value: object) -> str:
        return f'{value:.7g}' if isinstance(value, float) else str(value)

    lines(folder, 'ardupilot/one_imu.log', [],
          (', '.join([name, *map(text, values)]) for name, values in one))
    samples = recording(52, down=True)
    acc = [('ACC', (time + 90, 0, time, *force)) for time, force in
           zip(stamps_us(samples), (samples.reading * G).tolist())]
    (folder / 'ardupilot/raw_acc.bin').write_bytes(dataflash_bytes(
        [row for row in rows if row[0] in ('FMT', 'PARM')] + acc))
    began = START.timestamp()
    lines(folder, 'ardupilot/two_imus.csv', ['timestamp,' + DATAFLASH['IMU'][2]],
          (','.join([f'{began + values[0] * 1e-6:.8f}', *map(text, values)])
           for name, values in rows if name == 'IMU'))


# ----------------------------------------------------------------------------- Betaflight
# blackbox_decode: https://github.com/betaflight/blackbox-tools, src/blackbox_decode.c
# (writeMainCSVHeader, UNIT_NAME in src/units.h; ', ' between the cells, raw numbers as %3d).
# Export of the Blackbox Explorer: https://github.com/betaflight/blackbox-log-viewer,
# public/js/webworkers/csv-export-worker.js (settings first, names in quotes, NaN if empty).

COUNTS = 2048
"""acc_1G of the simulated flight controller."""


def betaflight(folder: Path) -> None:
    """Write the CSV of blackbox_decode, raw and with units, and that of the Blackbox Explorer."""
    samples = recording(60)
    counts = np.rint(samples.reading * COUNTS).astype(int).tolist()
    turns = np.rint(np.degrees(samples['rate'])).astype(int).tolist()
    names = [f'{name}[{k}]' for name in ('rcCommand', 'gyroADC', 'accSmooth') for k in range(3)]
    head = ['loopIteration', 'time (us)', *names[:3], 'vbatLatest (V)', *names[3:], 'motor[0]',
            'flightModeFlags (flags)']
    lines(folder, 'betaflight/LOG00001.01.csv', [', '.join(head)],
          (', '.join([f'{k * 50:3d}', f'{time}', '  0', '  0', '  0', '16.42',
                      *(f'{value:3d}' for value in (*turn, *count)), ' 48', 'ARM'])
           for k, (time, turn, count) in enumerate(zip(stamps_us(samples), turns, counts))))
    samples = recording(61)
    head = ['loopIteration', 'time (s)', *(f'gyroADC[{k}] (deg/s)' for k in range(3)),
            *(f'accSmooth[{k}] (m/s/s)' for k in range(3))]
    values = np.column_stack([np.degrees(samples['rate']), samples.reading * G]).tolist()
    lines(folder, 'betaflight/units.csv', [', '.join(head)],
          (', '.join([f'{k * 50:3d}', f'{time * 1e-6:.6f}', *(f'{value:.2f}' for value in each)])
           for k, (time, each) in enumerate(zip(stamps_us(samples), values))))
    samples = recording(62)
    counts = np.rint(samples.reading * COUNTS).astype(int).tolist()
    head = ['loopIteration', 'time', *names, 'flightModeFlags']
    settings = {'"frameIntervalI"': '32', '"acc_1G"': f'{COUNTS}', '"gyroScale"': '1',
                '"rates"': '"70,70,70"', '"Firmware revision"': '"Betaflight 4.5.1"',
                '"Craft name"': '""'}
    lines(folder, 'betaflight/explorer.csv',
          [*(f'{name},{value}' for name, value in settings.items()),
           ','.join(f'"{name}"' for name in head)],
          (','.join([f'{k * 50},{time}', '0,0,0,0,0,0', *map(str, count), 'NaN'])
           for k, (time, count) in enumerate(zip(stamps_us(samples), counts))))


# ------------------------------------------------------------------------ ESP32 and Arduino
# A serial log has no maker's layout. Boot messages as in
# https://docs.espressif.com/projects/esp-idf/en/latest/esp32/api-guides/startup.html and counts of
# an MPU-6050 at ±2 g and ±250 °/s (16384 to the g, 131 to the °/s, RM-MPU-6000A).

BOOT = ('ets Jul 29 2019 12:21:46', '',
        'rst:0x1 (POWERON_RESET),boot:0x13 (SPI_FAST_FLASH_BOOT)',
        'configsip: 0, SPIWP:0xee',
        'clk_drv:0x00,q_drv:0x00,d_drv:0x00,cs0_drv:0x00,hd_drv:0x00,wp_drv:0x00',
        'mode:DIO, clock div:1', 'load:0x3fff0030,len:1184', 'entry 0x400805e4',
        'MPU6050 ready, +-2 g, 250 deg/s')


def esp32(folder: Path) -> None:
    """Write counts with boot messages and a line cut at the end, and one in m/s² without them."""
    samples = recording(70)
    counts = np.rint(samples.reading * 16384).astype(int).tolist()
    turns = np.rint(np.degrees(samples['rate']) * 131).astype(int).tolist()
    time = np.rint(samples['time'] * 1000).astype(int).tolist()
    rows = [';'.join(map(str, (1204 + t, *count, *turn, f'{warm:.2f}'))) for t, count, turn, warm
            in zip(time, counts, turns, samples['temperature'].tolist())]
    lines(folder, 'esp32/counts.log',
          [*BOOT, 'timestamp_ms;accX;accY;accZ;gyroX;gyroY;gyroZ;temp'], [*rows, rows[-1][:11]])
    samples = recording(71)
    values = np.column_stack([samples.reading * G, samples['rate']]).tolist()
    time = np.rint(samples['time'] * 1e6).astype(int).tolist()
    lines(folder, 'esp32/micros.csv', ['micros,ax,ay,az,gx,gy,gz'],
          (f'{880_115 + t},{",".join(f"{value:.4f}" for value in each)}'
           for t, each in zip(time, values)))


MAKERS: dict[str, Callable[[Path], None]] = {
    'phyphox': phyphox, 'sensor-logger': sensor_logger, 'matlab': matlab, 'px4': px4,
    'ardupilot': ardupilot, 'betaflight': betaflight, 'esp32': esp32}

_SI = truth('m/s2', G)
_WARM = truth('m/s2', G, temperature=True)
_ALL = truth('m/s2', G, temperature=True, rate=True)
TRUTHS: dict[str, Truth] = {
    **{f'phyphox/{name}.csv': _SI for name in PHYPHOX},
    'phyphox/simple/Accelerometer.csv': _SI,
    'sensor-logger/android/TotalAcceleration.csv': _SI,
    'sensor-logger/ios/AccelerometerUncalibrated.csv': truth('g', sign=-1.0),
    'matlab/acceleration.csv': _SI,
    'matlab/sensorlog_accel_20260714_093012.csv': _SI,
    'px4/default.ulg': _ALL,
    'px4/thermal.ulg': _ALL,
    'px4/log_sensor_accel_0.csv': _WARM,
    'px4/log_sensor_combined_0.csv': truth('m/s2', G, rate=True),
    'px4/log_vehicle_imu_0.csv': truth('m/s2', G, rate=True),
    'ardupilot/two_imus.bin': _ALL,
    'ardupilot/one_imu.log': _ALL,
    'ardupilot/raw_acc.bin': _SI,
    'ardupilot/two_imus.csv': _ALL,
    'betaflight/LOG00001.01.csv': truth('native', COUNTS),
    'betaflight/explorer.csv': truth('native', COUNTS),
    'betaflight/units.csv': truth('m/s2', G, rate=True),
    'esp32/counts.log': truth('native', 16384.0, temperature=True),
    'esp32/micros.csv': truth('m/s2', G, rate=True),
}
"""What a fit of each sample with gravity is to find."""

WITHOUT_GRAVITY = ('phyphox/without_g.csv', 'sensor-logger/android/Accelerometer.csv')
OTHER_SENSORS = ('sensor-logger/android/Gravity.csv',)


def main() -> None:
    """Write all samples beside this file."""
    for write in MAKERS.values():
        write(HERE)


if __name__ == '__main__':
    main()
