# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The simulated sensor of the samples of logs, and flight logs that tests change.

Offset, gain and cross-axis of the sensor are known (`OFFSET_G`, `GAIN`), so that a test can
compare a fit with them. `README.md` has the source of each layout.

"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import struct
from typing import Any

from accel_calib.table import Floats, Recording
from inside import model_with, simulate_recording, spread_directions
import numpy as np
import yaml

RATE_HZ, POSES, DWELL, TURN = 20.0, 12, 3.0, 0.8
NOISE_G = 0.003
OFFSET_G = np.array([0.031, -0.042, 0.055])
GAIN = np.array([[1.012, 0.004, -0.003], [0.004, 0.991, 0.002], [-0.003, 0.002, 1.006]])
"""W, symmetric."""

WARM = (28.0, 31.0)
G = 9.80665
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


def accel_fields(samples: Recording, device: int, per_g: float = 1.0) -> Fields:
    """Return sensor_accel."""
    time, n = stamps_us(samples), len(samples)
    reading = (samples.reading * per_g).T.tolist()
    return {'timestamp': ('uint64_t', time), 'timestamp_sample': ('uint64_t', time),
            'device_id': ('uint32_t', [device] * n),
            **{axis: ('float', values) for axis, values in zip('xyz', reading)},
            'temperature': ('float', samples['temperature'].tolist())}


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


def ulog_bytes(messages: Sequence[tuple[str, int, Fields]],
               parameters: Mapping[str, float] = {}) -> bytes:
    """
    Return a ULog with these messages (name, number of the sensor, fields), in order of time.

    Whole numbers are parameters of type int32.

    """
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
    for name, number in parameters.items():
        kind, letter = ('int32_t', 'i') if isinstance(number, int) else ('float', 'f')
        key = f'{kind} {name}'.encode()
        out += block(b'P', bytes([len(key)]) + key + struct.pack(f'<{letter}', number))
    rows: list[tuple[int, bytes]] = []
    for number, (name, instance, fields) in enumerate(messages):
        out += block(b'A', struct.pack('<BH', instance, number) + name.encode())
        layout = '<H' + ''.join(ULOG_TYPES[kind] for kind, _ in fields.values())
        for values in zip(*(values for _, values in fields.values())):
            rows.append((int(values[0]), block(b'D', struct.pack(layout, number, *values))))
    return out + b''.join(row for _, row in sorted(rows, key=lambda each: each[0]))


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


def dataflash_forms() -> list[Row]:
    """Return the messages that declare the others."""
    return [('FMT', (number, 3 + struct.calcsize('<' + ''.join(
        DATAFLASH_TYPES[letter] for letter in letters)), name, letters, names))
        for name, (number, letters, names) in DATAFLASH.items()]


def dataflash_bytes(rows: Sequence[Row]) -> bytes:
    """Return a binary log."""
    out = []
    for name, values in rows:
        number, letters, _ = DATAFLASH[name]
        raw = [value.encode() if isinstance(value, str) else value for value in values]
        layout = '<' + ''.join(DATAFLASH_TYPES[letter] for letter in letters)
        out.append(b'\xa3\x95' + bytes([number]) + struct.pack(layout, *raw))
    return b''.join(out)


COUNTS = 2048
"""acc_1G of the simulated flight controller."""

TRUTHS: dict[str, Truth] = {name: truth(**given) for name, given in yaml.safe_load(
    Path(__file__).with_name('truths.yaml').read_text(encoding='utf-8')).items()}
"""What a fit of each sample with gravity is to find."""
