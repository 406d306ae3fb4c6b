# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What PX4 and ArduPilot do to the readings of an accelerometer, and which of their messages is read.

Both correct in the axes of the sensor, and then rotate to those of the vehicle ([1]_, [2]_):

    logged = R ((raw - thermal(T) - offset) scale),   by axis, in m/s²

=========  ======================================================  ================================
           PX4                                                     ArduPilot
=========  ======================================================  ================================
R          level adjustment (SENS_BOARD_X_OFF, …) times the board  AHRS_ORIENTATION, when booted
           (SENS_BOARD_ROT), or CAL_ACCn_ROT of an external one
offset     CAL_ACCn_XOFF, …                                        INS_ACCOFFS_X, …
scale      CAL_ACCn_XSCALE, …                                      INS_ACCSCAL_X, …
thermal    TC_An_X0_0, … about TC_An_TREF, if TC_A_ENABLE is 1     INS_TCALn_ACC1_X, … in 10⁻⁶
                                                                   about 35 °C, less its value at
                                                                   INS_ACCn_CALTEMP
=========  ======================================================  ================================

T is limited to the range of the polynomial. Rotations are numbered as in MAVLink [3]_, and
ArduPilot has three more; a rotation is roll, then pitch, then yaw about fixed axes. `raw_columns`
undoes all of this, so that readings, and the parameters made from them, are those of the sensor.

A flight log holds several messages with accelerations, each of several sensors. `choose` takes the
first message in order of preference whose samples are dense enough for the capture of poses.

.. [1] https://github.com/PX4/PX4-Autopilot/blob/main/src/lib/sensor_calibration/Accelerometer.hpp
.. [2] https://github.com/ArduPilot/ardupilot/blob/master/libraries/AP_InertialSensor/
   AP_InertialSensor_Backend.cpp
.. [3] https://mavlink.io/en/messages/common.html#MAV_SENSOR_ORIENTATION

"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry import rotation_from_rpy
from ..table import Autopilot, Floats, numbered, Recording
from ..text import counted, some

FILTERED = 'vehicle_acceleration'
"""Message of PX4 with filtered readings, without the bias that it estimates."""

DENSE_HZ = 5.0
"""Samples per second below which another message is preferred."""

ARDUPILOT_REFERENCE = 35.0
"""Temperature about which the polynomial of ArduPilot is [°C]."""

PER_MILLION = 1e6
"""Factor of the stored coefficients of ArduPilot."""

DEGREE = 3
"""Degree of the polynomials of the offset in the temperature."""

_ROTATIONS: Mapping[int, Sequence[float]] = dict(enumerate((
    *((0, 0, yaw) for yaw in range(0, 360, 45)), (180, 0, 0), (180, 0, 45), (180, 0, 90),
    (180, 0, 135), (0, 180, 0), (180, 0, 225), (180, 0, 270), (180, 0, 315), (90, 0, 0),
    (90, 0, 45), (90, 0, 90), (90, 0, 135), (270, 0, 0), (270, 0, 45), (270, 0, 90),
    (270, 0, 135), (0, 90, 0), (0, 270, 0), (0, 180, 90), (0, 180, 270), (90, 90, 0),
    (180, 90, 0), (270, 90, 0), (90, 180, 0), (270, 180, 0), (90, 270, 0), (180, 270, 0),
    (270, 270, 0), (90, 180, 90), (90, 0, 270), (90, 68, 293), (0, 315, 0), (90, 315, 0))))
"""Roll, pitch and yaw [deg] of the rotations by number, as PX4 has them."""

_OF_ARDUPILOT = {**_ROTATIONS, 38: (90, 68.8, 293.3), 41: (0, 7, 0), 42: (45, 0, 0),
                 43: (315, 0, 0)}
"""The same, as ArduPilot has them."""

_CUSTOM = {100: ('AHRS_CUSTOM_ROLL', 'AHRS_CUSTOM_PIT', 'AHRS_CUSTOM_YAW'),
           101: ('CUST_ROT1_ROLL', 'CUST_ROT1_PITCH', 'CUST_ROT1_YAW'),
           102: ('CUST_ROT2_ROLL', 'CUST_ROT2_PITCH', 'CUST_ROT2_YAW')}
"""Parameters of the custom rotations of ArduPilot [deg]; 100 is that of releases before 4.2."""

_BEFORE_MAVLINK, _FIRST_OTHER = (1, 11), 26
"""PX4 before this release numbers the rotations from this one on in another way."""

_MATTER = re.compile(r'INS\d?_(ACC|TCAL)|AHRS_(ORIENTATION|CUSTOM)|CUST_ROT|CAL_ACC|SENS_BOARD|'
                     r'TC_A')
_AT_BOOT = re.compile(r'AHRS_|CUST_ROT')
"""Parameters that take effect when the vehicle is booted again."""

_TURNS = re.compile('ROT|ORIENTATION|BOARD')
_ABOUT = {
    'px4': ('PX4 log', 'temperature of the sensor', 'read sensor_accel, which CAL_ACC does not '
            'correct (add 4 or 64 to SDLOG_PROFILE to log it at 10 Hz)'),
    'ardupilot': ('ArduPilot log', 'temperature T',
                  'take the log from the vehicle whole: it begins with all parameters')}
"""What a log is, what its temperature is, and what to do if the correction is not known."""

_SLOTS, _THERMAL = range(4), 'TC_A'
_NAMED = 3

Values = Mapping[str, float]
"""Parameters by name."""


@dataclass(frozen=True)
class ByAxis:
    """
    A correction: R ((raw - offset - Σ thermal[k] (T - reference)^(k+1)) scale), by axis.

    `offset` (3,) is in m/s², `thermal` (3, 3) in m/s²/°C^(k+1), and `scale` (3,) has no unit. T is
    limited to `limits` [°C]; without temperature `thermal` is zero. R is `rotation` (3, 3).

    """

    offset: Floats
    scale: Floats
    thermal: Floats
    reference: float
    limits: tuple[float, float]
    rotation: Floats = field(default_factory=lambda: np.eye(3))

    def correct(self, reading: Floats, temperature: Floats) -> Floats:
        """Return the (n, 3) corrected readings [m/s²]."""
        return (reading - self.moved(temperature) - self.offset) * self.scale @ self.rotation.T

    def raw(self, corrected: Floats, temperature: Floats) -> Floats:
        """Return the (n, 3) readings of the sensor [m/s²]; the inverse of `correct`."""
        return corrected @ self.rotation / self.scale + self.offset + self.moved(temperature)

    def moved(self, temperature: Floats | float) -> Floats:
        """Return the change of the offset at temperatures (n,), (n, 3) [m/s²]."""
        change = np.clip(temperature, *self.limits) - self.reference
        return sum((np.multiply.outer(change ** (k + 1), part)
                    for k, part in enumerate(self.thermal)), np.zeros(3))

    @property
    def of_temperature(self) -> bool:
        """Whether the correction depends on the temperature."""
        return bool(np.any(self.thermal))


class UnknownCorrectionError(Exception):
    """A log does not state how its readings are corrected."""


class Parameters:
    """
    The parameters of a vehicle that matter here, in order of time; `lookup` finds a value.

    They are made of the times from which values hold, as stored, the names and the values; those
    that are not numbers are left out. `unit` is that of the times [s].

    """

    def __init__(self, stated: Iterable[tuple[Any, str, Any]], unit: float) -> None:
        self.stated: list[tuple[float, str, float]] = []
        self.used: dict[str, float] = {}
        for time, name, value in stated:
            if _MATTER.match(name):
                with suppress(ValueError):  # a damaged line of text, or a damaged parameter
                    when, number = float(time) * unit, float(value)
                    if math.isfinite(when) and math.isfinite(number):
                        self.stated.append((when, name, number))

    def spans(self) -> Iterator[tuple[float, float, Values]]:
        """Yield from when to when which values hold; the first of each holds from the start."""
        values = {name: value for _, name, value in reversed(self.stated)}
        start = -np.inf
        for time, name, value in self.stated:
            if values[name] != value and not _AT_BOOT.match(name):
                yield start, time, dict(values)
                values[name], start = value, time
        yield start, np.inf, values

    def lookup(self, values: Values, name: str, usual: float) -> float:
        """Return a value, or the usual one; others than the usual one are named in a note."""
        value = float(values.get(name, usual))
        if not np.isfinite(value):
            raise UnknownCorrectionError(f'{name} is not a number')
        if value != usual:
            self.used[name] = value
        return value

    def three(self, values: Values, pattern: str, usual: float) -> Floats:
        """Return the values of the axes, (3,), scales if 1 is usual; ``{}`` is the axis."""
        found = np.array([self.lookup(values, pattern.format(axis), usual) for axis in 'XYZ'])
        if usual == 1.0 and np.any(found <= 0.0):
            raise UnknownCorrectionError(f'a scale is {np.min(found):g}')
        return found


Correction = Callable[[Values], ByAxis]
"""Function that returns the correction of some values, or raises UnknownCorrectionError."""


def raw_columns(columns: Mapping[str, Floats], parameters: Parameters, correction: Correction
                ) -> dict[str, Floats]:
    """Return columns with the readings of the sensor in its own axes; rates are only turned."""
    time, found = columns['time'], {key: values.copy() for key, values in columns.items()}
    temperature = found.get('temperature', np.zeros(len(time)))
    for start, stop, values in parameters.spans():
        which = (time >= start) & (time < stop)
        if not np.any(which):
            continue
        old = correction(values)
        if old.of_temperature and 'temperature' not in found:
            raise UnknownCorrectionError('it depends on the temperature, which the log lacks')
        found['reading'][which] = old.raw(found['reading'][which], temperature[which])
        if 'rate' in found:
            found['rate'][which] = found['rate'][which] @ old.rotation
    if not parameters.stated:
        raise UnknownCorrectionError('its parameters are not in the log')
    return found


def px4_slot(stated: Iterable[Values], device: int, name: str = 'CAL_ACC') -> int | None:
    """Return n of CAL_ACCn or TC_An of a device; None if PX4 has none of it in use."""
    return next((slot for values in stated if name != _THERMAL or values.get('TC_A_ENABLE') == 1
                 for slot in _SLOTS if device and values.get(f'{name}{slot}_ID') == device), None)


def px4_correction(parameters: Parameters, autopilot: Autopilot, release: tuple[int, int] | None,
                   message: str, values: Values) -> ByAxis:
    """Return the correction of PX4 for an accelerometer in a message, of a known release."""
    if message == FILTERED:
        raise UnknownCorrectionError(f'{message} lacks the bias that PX4 estimates')
    device, slot = autopilot.device_id, autopilot.instance
    if device is None:
        raise UnknownCorrectionError('the log does not state the device id of the accelerometer')
    start = 'uncalibrated ' if slot is None else f'CAL_ACC{slot}_'
    offset = parameters.three(values, f'{start}{{}}OFF', 0.0)
    scale = parameters.three(values, f'{start}{{}}SCALE', 1.0)
    number = parameters.lookup(values, f'{start}ROT', -1.0)
    if number < 0.0:  # internal: it follows the board
        number = parameters.lookup(values, 'SENS_BOARD_ROT', 0.0)
    if number >= _FIRST_OTHER and release is not None and release < _BEFORE_MAVLINK:
        raise UnknownCorrectionError(f'PX4 {release[0]}.{release[1]} numbers rotation '
                                     f'{number:.0f} in another way')
    level = parameters.three(values, 'SENS_BOARD_{}_OFF', 0.0)
    rotation = (rotation_from_rpy(*np.radians(level))
                @ _numbered('SENS_BOARD_ROT', number, _ROTATIONS))
    slot = px4_slot([values], device, _THERMAL)
    start = 'uncalibrated ' if slot is None else f'{_THERMAL}{slot}_'
    constant, *thermal = (np.array([parameters.lookup(values, f'{start}X{order}_{axis}', 0.0)
                                    for axis in range(3)]) for order in range(DEGREE + 1))
    limits = values.get(f'{start}TMIN', 0.0), values.get(f'{start}TMAX', 100.0)
    return ByAxis(offset=offset + constant, scale=scale, thermal=np.array(thermal),
                  reference=values.get(f'{start}TREF', 25.0), limits=limits, rotation=rotation)


def ardupilot_correction(parameters: Parameters, instance: int, values: Values) -> ByAxis:
    """Return the correction of ArduPilot for an accelerometer, numbered from 1."""
    if instance not in (1, 2, 3):
        raise UnknownCorrectionError(f'parameters of accelerometer {instance} are not read')
    start, thermal_start = f'INS_ACC{"" if instance == 1 else instance}', f'INS_TCAL{instance}_'
    offset = parameters.three(values, f'{start}OFFS_{{}}', 0.0)
    scale = parameters.three(values, f'{start}SCAL_{{}}', 1.0)
    thermal, limits = np.zeros((DEGREE, 3)), (0.0, 0.0)
    if values.get(f'{thermal_start}ENABLE') == 1:
        thermal = np.array([parameters.three(values, f'{thermal_start}ACC{order}_{{}}', 0.0)
                            for order in range(1, DEGREE + 1)]) / PER_MILLION
        limits = values.get(f'{thermal_start}TMIN', 0.0), values.get(f'{thermal_start}TMAX', 70.0)
    number = parameters.lookup(values, 'AHRS_ORIENTATION', 0.0)
    names = _CUSTOM.get(int(number), ())
    lacking = [name for name in names if name not in values]
    if lacking:
        raise UnknownCorrectionError(
            f'AHRS_ORIENTATION is {number:.0f}, and the log lacks {lacking[0]}')
    degrees = [parameters.lookup(values, name, 0.0) for name in names]
    rotation = (rotation_from_rpy(*np.radians(degrees)) if names
                else _numbered('AHRS_ORIENTATION', number, _OF_ARDUPILOT))
    found = ByAxis(offset=offset, scale=scale, thermal=thermal, reference=ARDUPILOT_REFERENCE,
                   limits=limits, rotation=rotation)
    # The firmware adds the polynomial at CALTEMP, so that it is zero there.
    at_offset = values.get(f'INS_ACC{instance}_CALTEMP', -300.0)
    return replace(found, offset=offset - found.moved(at_offset))


def _numbered(name: str, number: float, known: Mapping[int, Sequence[float]]) -> Floats:
    """Return the rotation with a number."""
    if int(number) not in known:
        raise UnknownCorrectionError(f'{name} is {number:.0f}, a rotation that is not known')
    return rotation_from_rpy(*np.radians(known[int(number)]))


# ------------------------------------------------------------------------- messages of a log

@dataclass(frozen=True)
class Message:
    """The samples of one message of one sensor: fields by the names of the log, and time [s]."""

    name: str
    instance: int
    fields: Mapping[str, NDArray[Any]]
    time: Floats

    @property
    def rate_hz(self) -> float:
        """Return the samples per second; 0 for less than two samples."""
        span = float(np.ptp(self.time)) if len(self.time) > 1 else 0.0
        return (len(self.time) - 1) / span if span > 0.0 else 0.0

    def __str__(self) -> str:
        return f'{self.name} {self.instance}'


FlightLog = tuple[Recording, str, tuple[str, ...]]
"""Samples of one sensor, such as ``sensor_accel 0``, in m/s²; how they are read; and notes: what
was not used, and what to know of the readings."""


@dataclass(frozen=True)
class Choice:
    """The message to read, the name of its sensor, and notes on the messages that are not."""

    message: Message
    sensor: str
    notes: Sequence[str]

    def log(self, columns: Mapping[str, Floats], autopilot: Autopilot, parameters: Parameters,
            correction: Correction | None, notes: Iterable[str]) -> FlightLog:
        """Return the log without a correction, or with a note why that is not known."""
        more, axes = list[str](), 'x forward, y right, z down'
        kind, temperature, advice = _ABOUT[autopilot.firmware]
        try:
            columns = raw_columns(columns, parameters, correction) if correction else columns
        except UnknownCorrectionError as err:
            autopilot = replace(autopilot, corrected=str(err))
            more.append(f'readings are left as the vehicle corrected them ({err}), so do not load '
                        f'an export of their calibration into it; {advice}')
        else:
            if parameters.used:
                used = sorted(parameters.used.items(), key=lambda each: 'ACC' in each[0])
                words = ', '.join(f'{name} {value:.4g}' for name, value in used[:_NAMED])
                others = f' and {len(used) - _NAMED} more' if len(used) > _NAMED else ''
                more.append(f'the correction by the vehicle is undone: {words}{others}')
            if any(map(_TURNS.search, parameters.used)):
                axes = 'axes of the sensor, before the rotation of the board'
        read_as = f'{kind}, {self.message} at {self.message.rate_hz:.4g} Hz, m/s2, {axes}'
        if 'temperature' in columns:
            read_as += f', {temperature}'
        recording = Recording(columns, numbered(columns), 'm/s2', self.sensor, autopilot)
        return recording, read_as, (*notes, *self.notes, *more)

    def rates(self, time: Floats, sources: Iterable[Message], names: Sequence[str]
              ) -> dict[str, Floats]:
        """Return the angular rates of the first source with these fields that is as dense."""
        return at(time, 'rate', (
            (message, vectors(message.fields, names)) for message in sources
            if message.rate_hz >= 0.5 * self.message.rate_hz and set(names) <= set(message.fields)
        ))


def choose(found: Sequence[Message], preferred: Sequence[str], topic: str, sensor: str,
           source: str) -> Choice:
    """
    Return the message to read, from those `found`; raise InputError if there is none.

    `topic` is the name of the message; empty: the first of `preferred` that is dense. `sensor` is
    the number of the sensor, alone or after the name of its message; any other text is a name for
    the sensor, and does not choose.

    """
    usable = [message for message in found if message.name in preferred and len(message.time)]
    if not usable:
        raise InputError(f'{source} has none of the messages {", ".join(preferred)}, expected one '
                         'with accelerations', 'log the accelerometer, see docs/log_formats.md')
    chooses = sensor.isdecimal() or sensor in map(str, found)
    number = sensor if chooses else ''
    wanted = [message for message in usable if topic in ('', message.name)
              and number in ('', str(message.instance), str(message))]
    if not wanted:
        raise InputError(f'{source} has {some(usable)}, expected '
                         f'{" ".join(filter(None, (topic or "a message", number)))}',
                         'name one of these, for example --topic '
                         f'{usable[0].name} --sensor {usable[0].instance}')
    order = sorted(wanted, key=lambda message: (preferred.index(message.name), message.instance))
    dense = [message for message in order if message.rate_hz >= DENSE_HZ]
    best = dense[0] if dense else max(order, key=lambda message: message.rate_hz)
    notes = []
    rest = [each for each in usable if each.name == best.name and each.instance != best.instance]
    if rest:
        notes.append(f'{best} is read; other sensors: {some(rest)} (--sensor {rest[0].instance})')
    other = [each for each in usable if each.name != best.name]
    if other:
        names = ', '.join(dict.fromkeys(f'{each.name} ({each.rate_hz:.3g} Hz)' for each in other
                                        if each.instance == other[0].instance))
        notes.append(f'not used: {names} (--topic {other[0].name})')
    return Choice(best, str(best) if chooses or not sensor else sensor, notes)


def vectors(fields: Mapping[str, NDArray[Any]], names: Sequence[str]) -> Floats:
    """Return the fields of three axes, (n, 3)."""
    return np.column_stack([fields[name] for name in names]).astype(float)


def at(time: Floats, key: str, sources: Iterable[tuple[Message, NDArray[Any]]]
       ) -> dict[str, Floats]:
    """
    Return a column at these times: the first values of other messages that are all finite numbers.

    They are interpolated; the ends are held.

    """
    for source, values in sources:
        if len(values) and np.all(np.isfinite(values)):
            order = np.argsort(source.time, kind='stable')
            parts = [np.interp(time, source.time[order], part[order].astype(float))
                     for part in np.atleast_2d(values.T)]
            return {key: np.column_stack(parts) if len(parts) > 1 else parts[0]}
    return {}


def sound(message: Message, columns: Mapping[str, Floats], why: str
          ) -> tuple[dict[str, Floats], list[str]]:
    """Return the rows whose values are all finite, and a note on the others."""
    kept = np.all(np.isfinite(np.column_stack([*columns.values()])), axis=1)
    dropped = int(np.sum(~kept))
    notes = [f'{counted(dropped, "row")} of {message} left out: {why}'] if dropped else []
    return {key: values[kept] for key, values in columns.items()}, notes
