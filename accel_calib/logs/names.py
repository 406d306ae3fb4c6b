# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Names in the header of a text log: what those of any author mean, and the layouts of makers.

**Words.** A name is parted into words at blanks, punctuation, digits and capital letters. A unit
is in brackets or at the end of the name. The words that name neither a quantity (`WORDS`) nor a
unit (`UNITS`) distinguish the sensors of a log. Our own names (`ax`, `time`, …) go before all
others.

**Layouts.** Phones, autopilots and small boards have a `LogFormat` for each layout of a text log,
as their makers document it. It only states what the names in the file mean. A unit that the maker
leaves to the user's settings is found from the readings at rest.

**Frames.** A specific force is +1 g along the axis that points up. Phones (phyphox, Sensor Logger
on Android, MATLAB Mobile) and Betaflight log this sign with z up. PX4 and ArduPilot log this sign
with z down, so that a level vehicle reads -1 g on z; ``--frame ros`` turns it. iOS itself
(CoreMotion) has the opposite sign: a phone that lies with its screen up reads -1 g on z. No fit
depends on the sign. A flat pose does, and `LogFormat.note` names the frame for it.

"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property, lru_cache
import math
from pathlib import Path
import re
from typing import Literal
import unicodedata

from ..errors import InputError
from ..table import COLUMNS
from ..text import some
from ..units import UnitName

READING = COLUMNS['reading'].names
RATE = COLUMNS['rate'].names
OURS = tuple(name for column in COLUMNS.values() if not column.made for name in column.names)
"""Names that a user can give to a column."""

_WORDS = {
    'reading': 'a ac acc acce accel accl acceleration accelerations accelerometer accelero '
               'accsmooth accadc xl gforce gf beschleunigung aceleracion accelerazione aceleracao',
    'rate': 'g gy gyr gyro gyroscope gyroadc omega w angvel angularvelocity angularrate '
            'rotationrate rotrate',
    'time': 'time timestamp timestamps t ts stamp clock date datetime epoch gpst elapsed millis '
            'micros uptime tick ticks tow itow zeit uhrzeit temps heure tiempo hora tempo',
    'temperature': 'temperature temp tmp temperatur temperatura',
    'supply_voltage': 'vdd vcc supply'}
WORDS: Mapping[str, tuple[str, ...]] = {key: tuple(text.split()) for key, text in _WORDS.items()}
"""Words that name a quantity, in lower case without accents."""

PAIRS = {('angular', 'velocity'): 'angularvelocity', ('angular', 'rate'): 'angularrate',
         ('rotation', 'rate'): 'rotationrate', ('rot', 'rate'): 'rotationrate',
         ('g', 'force'): 'gforce', ('g', 'f'): 'gf', ('with', 'gravity'): 'withgravity',
         ('including', 'gravity'): 'withgravity'}
"""Two words that are one."""

OTHER_WORDS = frozenset((
    'mag', 'magn', 'magnetic', 'magnetometer', 'compass', 'gravity', 'grav', 'orientation', 'quat',
    'quaternion', 'attitude', 'euler', 'angle', 'roll', 'pitch', 'yaw', 'position', 'pos',
    'covariance', 'cov', 'std', 'stdev', 'sd', 'var', 'variance', 'bias', 'offset', 'ref',
    'setpoint', 'jerk', 'norm', 'error', 'clip', 'angular', 'gps', 'baro', 'pressure'))
"""Words of quantities that are not read."""

FREE_WORDS = frozenset(('user', 'free', 'nograv', 'nogravity', 'world'))
"""Words of an acceleration without gravity."""

COMPUTED_WORDS = FREE_WORDS | OTHER_WORDS - {
    'mag', 'magn', 'magnetic', 'magnetometer', 'compass', 'angle', 'position', 'pos', 'bias',
    'offset', 'setpoint', 'gps', 'baro', 'pressure'}
"""Words of quantities that the readings or the orientation determine, which are no causes."""

WHOLE_WORDS = frozenset(('total', 'withgravity'))
"""Words of an acceleration with gravity, where its maker also has one without."""

LINEAR_WORDS = frozenset(('lin', 'linear'))
"""Words of an acceleration that has gravity or not, as its maker understands them."""

COUNTERS = frozenset(('counter', 'packetcounter', 'packetnumber', 'packet', 'framenumber', 'frame',
                      'frameno', 'sample', 'samples', 'samplenumber', 'nsamples', 'index', 'seq',
                      'pccounter', 'count'))
"""Names of a counter of the samples, in lower case without punctuation."""

TICKS = {'sampletimefine': {'ticks of 100 µs': 1e-4, 'µs': 1e-6}}
"""Units of clocks with a name of their own: of Xsens, by the model."""

MICRO, MILLI, DEGREE_RAD = 1e-6, 1e-3, math.pi / 180.0
_UNITS = {
    'reading': {
        ('m/s2', 1.0): 'ms2 m/s2 m/s/s ms-2 mps2 mss mpss mpsps m/sec2 m/ss meter/s2 meters/s2',
        ('g', 1.0): 'g gee gs gn',
        ('g', 1e-3): 'mg millig',
        ('g', 1e-6): 'ug microg',
        ('m/s2', 1e-2): 'cm/s2 cms2 gal',
        ('m/s2', 1e-3): 'mm/s2 mms2',
        ('m/s2', 0.3048): 'ft/s2 fts2',
        ('native', 1.0): 'lsb lsbs count counts digit digits v volt volts mv'},
    'rate': {
        ('rad/s', 1.0): 'rad/s rads radps rad/sec rads-1 rad radsec radians/s',
        ('°/s', DEGREE_RAD): 'deg/s degs dps degps deg/sec degs-1 deg degrees/s degree/s degsec '
                             'degrees/sec',
        ('m°/s', 1e-3 * DEGREE_RAD): 'mdps mdeg/s',
        ('rpm', math.pi / 30.0): 'rpm'},
    'time': {
        ('s', 1.0): 's sec secs second seconds',
        ('ms', 1e-3): 'ms msec msecs millis milli millisecond milliseconds unixms',
        ('µs', 1e-6): 'us usec usecs micros micro microsecond microseconds',
        ('min', 60.0): 'min mins minute minutes',
        ('h', 3600.0): 'h hr hrs hour hours',
        ('d', 86400.0): 'day days',
        ('ns', 1e-9): 'ns nsec nsecs nanos nano nanosec nanosecs nanosecond nanoseconds'},
    'temperature': {
        ('°C', 1.0): 'c degc celsius',
        ('°F', 5.0 / 9.0): 'f degf fahrenheit',
        ('K', 1.0): 'k kelvin'},
    'supply_voltage': {('V', 1.0): 'v volt volts', ('mV', 1e-3): 'mv'}}
UNITS: Mapping[str, Mapping[str, tuple[str, float]]] = {
    quantity: {text: unit for unit, texts in units.items() for text in texts.split()}
    for quantity, units in _UNITS.items()}
"""Units in names: the unit in words, or of `UnitName`, and the factor to it."""

ZEROS = {'°F': -160.0 / 9.0, 'K': -273.15}
"""Temperature [°C] at 0 of other units."""

_WORD = re.compile(r'[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+')
_BRACKET = re.compile(r'[(\[{<]([^()\[\]{}<>]*)[)\]}>]')
_AXES = {'x': 0, 'y': 1, 'z': 2}
_NUMBERED = {**_AXES, '0': 0, '1': 1, '2': 2, '3': 3}
_FUSED = {f'{word}{axis}': (word, axis) for key in ('reading', 'rate')
          for word in WORDS[key] if len(word) > 1 for axis in _AXES}
_FUSED |= {f'{axis}{word}': (word, axis) for word, axis in _FUSED.values()}
_FUSED |= {f'{axis}out': ('out', axis) for axis in _AXES}
_FUSED |= {f'{letter}{axis}': (letter.upper(), axis) for letter in 'agw' for axis in _AXES}
_FUSED_KINDS = {f'{kind}{word}': (kind, word) for kind in
                (*FREE_WORDS, *LINEAR_WORDS, *WHOLE_WORDS)
                for word in WORDS['reading'] if len(word) > 1}
_LETTERS = {'A': 'reading', 'G': 'rate', 'W': 'rate'}
"""Quantities of the letters in ax, gx and wx."""

BARE = frozenset(('axis', 'value', 'values', 'data', 'out', 'raw', 'component'))
"""Words beside x, y, z in the names of the only sensor of a file."""

_LONGEST_NAME = 200


@dataclass(frozen=True)
class Meaning:
    """
    What a name means.

    `quantity` is a key of `WORDS`, and `unit` the text of the unit; both are empty if the name
    does not state them. `axis` is 0 to 2 (or 1 to 3 where a log counts so), and `group` are the
    other words.

    """

    quantity: str
    axis: int | None
    unit: str
    group: tuple[str, ...]


def unit_of(quantity: str, text: str) -> tuple[str, float] | None:
    """Return a unit of a quantity and the factor to it, in any spelling of `UNITS`, or None."""
    text = unicodedata.normalize('NFKD', text.replace('°', 'deg').replace('º', 'deg')).casefold()
    text = text.replace('μ', 'u').replace('−', '-').replace('⁻', '-').replace('per', '/')
    return UNITS.get(quantity, {}).get(re.sub(r'[\s^*·.⋅_()\ufffd]', '', text))


@lru_cache(maxsize=4096)
def meaning(name: str) -> Meaning:
    """Return what the name of a column means."""
    text = unicodedata.normalize('NFKD', name[:_LONGEST_NAME].replace('°', 'deg'))
    text = ''.join(c for c in text if not unicodedata.combining(c))
    text = text.replace('μ', 'u').replace('ω', 'w')
    brackets = [inner.strip() for inner in _BRACKET.findall(text)]
    words = [word.casefold() for word in _WORD.findall(_BRACKET.sub(' ', text))]
    axis, words = _part_axis(words, brackets)
    unit = next((each for each in brackets if any(unit_of(key, each) for key in UNITS)), '')
    quantity = _quantity(words, unit)
    if not unit:
        unit, words = _unit_in(quantity, words)
        quantity = quantity or ('time' if unit else '')
    if not quantity and not unit:
        words += [each for each in brackets if each and not each.isdecimal()]
    return Meaning(quantity, axis, unit, tuple(words))


def bare_name(name: str) -> str:
    """Return a name in lower case, without punctuation."""
    return re.sub(r'[\W_]', '', name[:_LONGEST_NAME]).casefold()


def _part_axis(words: list[str], brackets: Sequence[str]) -> tuple[int | None, list[str]]:
    """Return the axis that words or brackets name, and the other words, pairs of them joined."""
    if words[:2] in (['g', 'fx'], ['g', 'fy'], ['g', 'fz']):
        words = ['gf', words[1][1], *words[2:]]
    words = [part for word in words for part in _FUSED_KINDS.get(word, (word,))]
    if not _AXES.keys() & set(words):
        words = [part for word in words for part in _FUSED.get(word, (word,))]
    joined: list[str] = []
    for word in words:
        if joined and (joined[-1], word) in PAIRS:
            joined[-1] = PAIRS[joined[-1], word]
        else:
            joined.append(word)
    lettered = [k for k, word in enumerate(joined) if word in _AXES]
    if lettered:
        return _AXES[joined.pop(lettered[-1])], joined
    numbered = [_NUMBERED[each] for each in map(str.casefold, brackets) if each in _NUMBERED]
    if not numbered and len(joined) > 1 and joined[-1] in _NUMBERED:
        numbered = [_NUMBERED[joined.pop()]]
    return (numbered[0] if numbered else None), joined


def _quantity(words: Sequence[str], unit: str) -> str:
    """Return the quantity that words name; empty if none or several."""
    if OTHER_WORDS.intersection(words):
        return ''
    if not words or BARE.issuperset(words):
        return next((key for key in ('reading', 'rate') if unit_of(key, unit)), '')
    found = [key for key, known in WORDS.items()
             if any(len(word) > 1 and word in known for word in words)]
    found = found or [_LETTERS[word] for word in words if word in _LETTERS]
    found = found or [key for key, known in WORDS.items() if words[0] in known]
    found = found or ['time'] * (words[-1] == 't')  # inside a group: imu/t
    if 'time' in found and unit_of('temperature', unit):
        return 'temperature'
    first = next((key for key in ('time', 'temperature') if key in found), '')
    return first or (found[0] if len(found) == 1 else '')


def _unit_in(quantity: str, words: list[str]) -> tuple[str, list[str]]:
    """Return the unit in the last words, or anywhere for a time; and the other words."""
    for count in (4, 3, 2, 1):
        text = ''.join(words[-count:])
        if quantity and len(words) > count and unit_of(quantity, text):
            return text, words[:-count]
        if not quantity and len(words) == count and unit_of('time', text):
            return text, []
    if quantity == 'time':
        text = next((word for word in words if len(word) > 1 and unit_of('time', word)), '')
        return text, words
    return '', words


# ------------------------------------------------------------------------ layouts of makers

@dataclass(frozen=True)
class LogFormat:
    """
    One layout of a text log, named as ``--format`` has it.

    `patterns` are the names in the file, by key of `COLUMNS`; letters in braces are those of the
    axes. ``KEY/`` is the name of the column by which those of a key are divided; ``instance`` is
    that of the number of the sensor, if rows of several alternate. By key, `scales` are factors
    from the unit of the file to ours; a time without one is in a unit that the reader recognises.
    `units` is the unit of the reading, empty if the file does not determine it.

    The names of time, readings, divisors and `marks` together determine the layout if it is
    `plain`; otherwise it is used only where the user names it. `without_gravity` are the maker's
    columns of acceleration without gravity, and its files of it (``.csv``); `other_sensors` are
    its files of other sensors with the same columns. `record` is what to use instead of these
    files, and `note` what else a user should know.

    """

    name: str
    patterns: Mapping[str, str]
    scales: Mapping[str, float] = field(default_factory=dict)
    units: UnitName | Literal[''] = 'm/s2'
    marks: tuple[str, ...] = ()
    without_gravity: tuple[str, ...] = ()
    other_sensors: tuple[str, ...] = ()
    record: str = ''
    note: str = ''
    plain: bool = True

    @cached_property
    def columns(self) -> dict[str, str]:
        """Names in the file of our columns, such as ``ax``."""
        return {ours: theirs for key, pattern in self.patterns.items() for ours, theirs in zip(
            COLUMNS[key].names if key in COLUMNS else (key,), names_of(pattern))}

    @property
    def needed(self) -> tuple[str, ...]:
        """Names that a header of this layout has, in any order."""
        ours = [name for key, name in self.columns.items()
                if key in ('time', *READING) or key.endswith('/')]
        return tuple(dict.fromkeys((*ours, *self.marks)))

    def lacking(self, header: Sequence[str]) -> list[str]:
        """Return the names that a header lacks for this layout; case and spacing are ignored."""
        given = {folded(name) for name in header}
        return [name for name in self.needed if folded(name) not in given]


def folded(name: str) -> str:
    """Return a name without quotes, in lower case, with single spaces."""
    return ' '.join(name.strip().strip('"\'').split()).casefold().replace('²', '^2')


def names_of(pattern: str) -> tuple[str, ...]:
    """Return a name for each of the letters in braces of a pattern, or the only name."""
    before, brace, rest = pattern.partition('{')
    letters, _, after = rest.partition('}')
    return tuple(f'{before}{letter}{after}' for letter in letters) if brace else (pattern,)


_FRD = ('Axes are x forward, y right, z down, so that a level vehicle reads -1 g on z; --flat '
        'turns them to x forward, y left, z up.')

PX4_FIELDS: Mapping[str, Mapping[str, str]] = {
    'sensor_accel': {'reading': '{xyz}'},
    'sensor_combined': {'reading': 'accelerometer_m_s2[{012}]', 'rate': 'gyro_rad[{012}]'},
    'vehicle_imu': {'reading': 'delta_velocity[{012}]', 'reading/': 'delta_velocity_dt',
                    'rate': 'delta_angle[{012}]', 'rate/': 'delta_angle_dt'},
    'vehicle_acceleration': {'reading': 'xyz[{012}]'}}
"""Fields of the messages of PX4 with accelerations, in order of preference, as in
`LogFormat.patterns`; changes of velocity and angle are divided by their intervals [µs]."""

_BLACKBOX_TIMES = {'time (us)': MICRO, 'time (ms)': MILLI, 'time (s)': 1.0, 'time': MICRO}
_BLACKBOX_UNITS: dict[str, UnitName] = {'': 'native', ' (g)': 'g', ' (m/s/s)': 'm/s2'}
_BLACKBOX_RATES = {'gyroADC[{012}] (deg/s)': DEGREE_RAD, 'gyroADC[{012}] (rad/s)': 1.0, '': 0.0}

LAYOUTS: tuple[LogFormat, ...] = (
    # phyphox: https://github.com/phyphox/phyphox-android
    # The data sets of the app's own experiments, and of those made with "Add simple experiment".
    # Both apps multiply by ±9.81 so that a phone with its screen up reads +z.
    *(LogFormat('phyphox', {'time': 'Time (s)', 'reading': pattern}, {'time': 1.0},
                without_gravity=(
                    *names_of('Linear Acceleration {xyz} (m/s^2)'), 'Linear Acceleration.csv',
                    'Linear Accelerometer.csv', 'Acceleration without g.csv'),
                record="record 'Acceleration with g' (Raw sensors) in phyphox")
      for pattern in ('Acceleration {xyz} (m/s^2)', '{xyz} (m/s^2)')),
    # Physics Toolbox: https://www.vieyrasoftware.net
    # The g-force meter has gravity; ax, ay, az beside it are the linear acceleration.
    LogFormat('physics-toolbox', {'time': 'time', 'reading': 'gF{xyz}', 'rate': 'w{xyz}'},
              {'rate': 1.0}, 'g', READING),
    # Sensor Logger: https://github.com/tszheichoi/awesome-sensor-logger/blob/main/UNITS.md
    # One file per sensor with the same header; the name of the file is the name of the sensor.
    LogFormat('sensor-logger', {'time': 'seconds_elapsed', 'reading': '{xyz}'}, {'time': 1.0}, '',
              ('time',), without_gravity=('Accelerometer.csv',),
              other_sensors=('Gravity.csv', 'Gyroscope.csv', 'GyroscopeUncalibrated.csv',
                             'Magnetometer.csv', 'MagnetometerUncalibrated.csv'),
              record='use TotalAcceleration.csv (Android) or AccelerometerUncalibrated.csv of '
                     'Sensor Logger',
              note='Readings in g are those of an iPhone, with the opposite sign: a flat pose '
                   'needs --frame win8.'),
    # MATLAB Mobile:
    # https://www.mathworks.com/help/matlabmobile/ug/logging-accelerometer-data.html
    # The timetable Acceleration, written by writetimetable; or sensorlog_accel_*.csv of a phone's
    # local log, where the time is in ms of Unix time.
    *(LogFormat('matlab', {'time': time, 'reading': '{XYZ}'}, plain=False)
      for time in ('Timestamp', 'Time')),
    # PX4: https://docs.px4.io/main/en/msg_docs/
    # One file for each topic, <log>_<topic>_<instance>.csv, written by ulog2csv of pyulog; the
    # columns are the fields of SensorAccel, SensorCombined, VehicleImu and VehicleAcceleration.
    *(LogFormat('px4', {'time': 'timestamp', **more, **PX4_FIELDS[message]},
                {'time': MICRO, **scales}, marks=marks, note=f'{note}{_FRD}')
      for message, more, scales, marks, note in (
          ('sensor_accel', {'temperature': 'temperature'}, {}, ('device_id', 'error_count'), ''),
          ('sensor_combined', {}, {}, (), 'Readings are corrected by the stored CAL_ACC '
           'parameters; those of sensor_accel are not. '),
          ('vehicle_imu', {}, {'reading': 1.0 / MICRO, 'rate': 1.0 / MICRO}, (), ''),
          ('vehicle_acceleration', {}, {}, ('timestamp_sample',), ''))),
    # ArduPilot: https://ardupilot.org/copter/docs/logmessages.html
    # mavlogdump.py --format csv --types IMU (or ACC) writes the fields of the message after its
    # own timestamp.
    *(LogFormat('ardupilot', {'time': time, 'reading': 'Acc{XYZ}', **more, 'instance': 'I'},
                {'time': MICRO}, marks=marks,
                note=f'Readings are corrected by the stored INS_ACC parameters. {_FRD}')
      for time, more, marks in (
          ('TimeUS', {'rate': 'Gyr{XYZ}', 'temperature': 'T'}, ('GyrX',)),
          ('SampleUS', {}, ('TimeUS',)),
          ('TimeUS', {}, ()))),
    # Betaflight: https://github.com/betaflight/blackbox-tools
    # blackbox_decode, whose options --unit-frame-time, --unit-acceleration and --unit-rotation
    # add the unit to the name, and the export of the Blackbox Explorer. Without units the readings
    # are counts (acc_1G of the log's header per g), and the unit of the gyro is not in the file.
    *(LogFormat('betaflight',
                {'time': time, 'reading': 'accSmooth[{012}]' + ending,
                 **({'rate': turns} if turns else {})},
                {'time': seconds, 'rate': rate}, units,
                names_of(turns) if turns else ('loopIteration',), note='' if ending else
                'Readings are counts, acc_1G of the header of the log to the g.')
      for time, seconds in _BLACKBOX_TIMES.items() for ending, units in _BLACKBOX_UNITS.items()
      for turns, rate in _BLACKBOX_RATES.items()),
    # ESP32 and Arduino: a sketch prints the names and units that its author chose, so that the
    # table of names finds the columns, and the readings at rest determine the unit.
    LogFormat('esp32', {}, units='', plain=False))

NAMES: tuple[str, ...] = tuple(dict.fromkeys(each.name for each in LAYOUTS))
"""Names of the formats, as ``--format`` has them."""


def recognise(header: Sequence[str]) -> LogFormat | None:
    """Return the layout whose names a header has, or None; the one with most names, if several."""
    fitting = [each for each in LAYOUTS if each.plain and not each.lacking(header)]
    return max(fitting, key=lambda each: len(each.needed), default=None)


def format_named(name: str, header: Sequence[str], source: str) -> LogFormat:
    """Return the layout of a maker, one of `NAMES`, that a header has; InputError if none."""
    layouts = [each for each in LAYOUTS if each.name == name]
    if not layouts:
        close = get_close_matches(name, NAMES, 1)
        raise InputError(f'format is {name!r}, expected one of {", ".join(NAMES)}',
                         f'use {close[0]}' if close else 'leave the format out: it is recognised')
    nearest = max(layouts, key=lambda each: (not each.lacking(header), len(each.needed) - len(
        each.lacking(header))))
    if lacking := nearest.lacking(header):
        raise InputError(f'{source} has the columns {some(header)}, and lacks '
                         f'{", ".join(lacking)} of a log of {name}',
                         'leave the format out, or name the columns with --columns')
    return nearest


def check_sensor(header: Sequence[str], path: Path) -> None:
    """Check the name of a file, if its maker gives the files of all sensors the same columns."""
    layout = recognise(header)  # also where the user names another format
    if layout and _file(path.name) in map(_file, layout.other_sensors):
        raise InputError(f'{path} is the log of another sensor ({path.stem}), expected readings '
                         'of an accelerometer', layout.record)


def record_instead(header: Sequence[str], path: Path) -> str:
    """
    Return what to record instead, if the maker marks a file as acceleration without gravity.

    The names are no proof: other tools use them for readings with gravity. So they only add
    advice once the readings at rest show no gravity.

    """
    given = {folded(name) for name in header}
    for layout in LAYOUTS:
        marks = {folded(name) for name in layout.without_gravity if not name.endswith('.csv')}
        if (marks and marks <= given) or (
                layout.plain and not layout.lacking(header)
                and _file(path.name) in map(_file, layout.without_gravity)):
            return layout.record
    return ''


def _file(name: str) -> str:
    """Return the name of a file without spelling and suffix, which programs change."""
    return folded(name).replace(' ', '').removesuffix('.csv')
