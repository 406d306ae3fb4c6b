# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Names of columns: which quantity, axis and unit the name of a column in a log means.

A name is parted into words at blanks, punctuation, digits and capital letters. `WORDS` lists the
words for each quantity, and `UNITS` the units. A unit is in brackets or at the end of the
name. The remaining words distinguish the sensors of a log. Our own names (`ax`, `time`, …) go
before all others.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
import math
import re
import unicodedata

from ..table import COLUMNS

READING = COLUMNS['reading'].names
RATE = COLUMNS['rate'].names
OURS = tuple(name for column in COLUMNS.values() if not column.made for name in column.names)
"""Names that a user can give to a column."""

WORDS: Mapping[str, tuple[str, ...]] = {
    'reading': ('a', 'ac', 'acc', 'acce', 'accel', 'accl', 'acceleration', 'accelerations',
                'accelerometer', 'accelero', 'accsmooth', 'accadc', 'xl', 'gforce', 'gf',
                'beschleunigung', 'aceleracion', 'accelerazione', 'aceleracao'),
    'rate': ('g', 'gy', 'gyr', 'gyro', 'gyroscope', 'gyroadc', 'omega', 'w', 'angvel',
             'angularvelocity', 'angularrate', 'rotationrate', 'rotrate'),
    'time': ('time', 'timestamp', 'timestamps', 't', 'ts', 'stamp', 'clock', 'date', 'datetime',
             'epoch', 'gpst', 'elapsed', 'millis', 'micros', 'uptime', 'zeit', 'temps', 'tiempo',
             'tempo'),
    'temperature': ('temperature', 'temp', 'tmp', 'temperatur', 'temperatura'),
    'supply_voltage': ('vdd', 'vcc', 'supply'),
}
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

CAUSES = frozenset((
    'mag', 'magn', 'magnetic', 'magnetometer', 'compass', 'angle', 'position', 'pos', 'bias',
    'offset', 'setpoint', 'gps', 'baro', 'pressure'))
"""Those of `OTHER_WORDS` that neither the readings nor the orientation determine."""

FREE_WORDS = frozenset(('user', 'free', 'nograv', 'nogravity', 'world'))
"""Words of an acceleration without gravity."""

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

_RAD = math.pi / 180.0
UNITS: Mapping[str, Mapping[str, tuple[str, float]]] = {
    'reading': {
        **dict.fromkeys(('ms2', 'm/s2', 'm/s/s', 'ms-2', 'mps2', 'mss', 'mpss', 'mpsps', 'm/sec2',
                         'm/ss', 'meter/s2', 'meters/s2'), ('m/s2', 1.0)),
        **dict.fromkeys(('g', 'gee', 'gs', 'gn'), ('g', 1.0)),
        **dict.fromkeys(('mg', 'millig'), ('g', 1e-3)),
        **dict.fromkeys(('ug', 'microg'), ('g', 1e-6)),
        **dict.fromkeys(('cm/s2', 'cms2', 'gal'), ('m/s2', 1e-2)),
        **dict.fromkeys(('mm/s2', 'mms2'), ('m/s2', 1e-3)),
        **dict.fromkeys(('ft/s2', 'fts2'), ('m/s2', 0.3048)),
        **dict.fromkeys(('lsb', 'lsbs', 'count', 'counts', 'digit', 'digits', 'v', 'volt', 'volts',
                         'mv'), ('native', 1.0))},
    'rate': {
        **dict.fromkeys(('rad/s', 'rads', 'radps', 'rad/sec', 'rads-1', 'rad', 'radsec',
                         'radians/s'), ('rad/s', 1.0)),
        **dict.fromkeys(('deg/s', 'degs', 'dps', 'degps', 'deg/sec', 'degs-1', 'deg', 'degrees/s',
                         'degree/s', 'degsec', 'degrees/sec'), ('°/s', _RAD)),
        **dict.fromkeys(('mdps', 'mdeg/s'), ('m°/s', 1e-3 * _RAD)),
        'rpm': ('rpm', math.pi / 30.0)},
    'time': {
        **dict.fromkeys(('s', 'sec', 'secs', 'second', 'seconds'), ('s', 1.0)),
        **dict.fromkeys(('ms', 'msec', 'msecs', 'millis', 'milli', 'millisecond', 'milliseconds',
                         'unixms'), ('ms', 1e-3)),
        **dict.fromkeys(('us', 'usec', 'usecs', 'micros', 'micro', 'microsecond', 'microseconds'),
                        ('µs', 1e-6)),
        **dict.fromkeys(('ns', 'nsec', 'nsecs', 'nanos', 'nano', 'nanosec', 'nanosecs',
                         'nanosecond', 'nanoseconds'), ('ns', 1e-9))},
    'temperature': {
        **dict.fromkeys(('c', 'degc', 'celsius'), ('°C', 1.0)),
        **dict.fromkeys(('f', 'degf', 'fahrenheit'), ('°F', 5.0 / 9.0)),
        **dict.fromkeys(('k', 'kelvin'), ('K', 1.0))},
    'supply_voltage': {'v': ('V', 1.0), 'mv': ('mV', 1e-3), 'volt': ('V', 1.0),
                       'volts': ('V', 1.0)},
}
"""Units in names: the unit in words, or of `UnitName`, and the factor to it."""

ZEROS = {'°F': -160.0 / 9.0, 'K': -273.15}
"""Temperature [°C] at 0 of other units."""

_WORD = re.compile(r'[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+')
_BRACKET = re.compile(r'[(\[{<]([^()\[\]{}<>]*)[)\]}>]')
_AXES = {'x': 0, 'y': 1, 'z': 2}
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
    does not state them. `axis` is 0 to 2 (or 1 to 3 where a log counts so), `group` are the other
    words, and `free` is whether the name says that gravity is not in the values.

    """

    quantity: str
    axis: int | None
    unit: str
    group: tuple[str, ...]
    free: bool = False


def unit_text(text: str) -> str:
    """Return the text of a unit in the spelling of `UNITS`."""
    text = unicodedata.normalize('NFKD', text.replace('°', 'deg').replace('º', 'deg')).casefold()
    text = text.replace('μ', 'u').replace('−', '-').replace('⁻', '-').replace('per', '/')
    text = re.sub(r'[\s^*·.⋅_\ufffd]', '', text)
    return text.replace('(', '').replace(')', '')


def unit_of(quantity: str, text: str) -> tuple[str, float] | None:
    """Return a unit of a quantity and the factor to it, or None."""
    return UNITS.get(quantity, {}).get(unit_text(text))


def may_cause(name: str) -> bool:
    """Return whether a column can be a cause, other than what is computed from the readings."""
    known = meaning(name)
    return (known.quantity not in ('reading', 'rate', 'time') and not known.free
            and bare_name(name) not in COUNTERS
            and not (OTHER_WORDS - CAUSES).intersection(known.group))


@lru_cache(maxsize=4096)
def meaning(name: str) -> Meaning:
    """Return what the name of a column means."""
    text = unicodedata.normalize('NFKD', name[:_LONGEST_NAME].replace('°', 'deg'))
    text = ''.join(c for c in text if not unicodedata.combining(c))
    text = text.replace('μ', 'u').replace('ω', 'w')
    brackets = [inner.strip() for inner in _BRACKET.findall(text)]
    words = [word.casefold() for word in _WORD.findall(_BRACKET.sub(' ', text))]
    axis, words = _axis(_parted(words), brackets)
    unit = next((each for each in brackets if is_unit(each)), '')
    quantity = _quantity(words, unit)
    if not unit:
        unit, words = _unit_in(quantity, words)
        quantity = quantity or ('time' if unit else '')
    if not quantity and not unit:
        words += [each for each in brackets if each and not each.isdecimal()]
    return Meaning(quantity, axis, unit, tuple(words), bool(FREE_WORDS.intersection(words)))


def bare_name(name: str) -> str:
    """Return a name in lower case, without punctuation."""
    return re.sub(r'[\W_]', '', name[:_LONGEST_NAME]).casefold()


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of any quantity."""
    return any(unit_of(quantity, text) for quantity in UNITS)


def _parted(words: list[str]) -> list[str]:
    """Return words with axes parted from them, and with pairs of words joined."""
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
    return joined


def _axis(words: list[str], brackets: Sequence[str]) -> tuple[int | None, list[str]]:
    """Return the axis that words or brackets name, and the other words."""
    named = [k for k, word in enumerate(words) if word in _AXES]
    if named:
        k = named[-1]
        return _AXES[words[k]], words[:k] + words[k + 1:]
    for inner in brackets:
        if inner.casefold() in _AXES:
            return _AXES[inner.casefold()], words
        if inner in ('0', '1', '2', '3'):
            return int(inner), words
    if len(words) > 1 and words[-1] in ('0', '1', '2', '3'):
        return int(words[-1]), words[:-1]
    return None, words


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
    if 'time' in found and unit_of('temperature', unit):
        return 'temperature'
    for first in ('time', 'temperature'):
        if first in found:
            return first
    return found[0] if len(found) == 1 else ''


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
