# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The messages of a session: statistics, faults, and log lines.

Rates and ages use the arrival times by a steady clock, so that they are also right for a bag that
is played at another speed. They cover the last `_SPAN` seconds.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
import math
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from .settings import context_topics
from ..calibrate import USES_LIMIT
from ..effects import Model
from ..errors import AccelCalibError
from ..table import Floats, is_quantity
from ..text import counted
from ..units import Units

if TYPE_CHECKING:
    from .session import Session

_SPAN = 5.0
"""Time over which rate and faults are counted [s]."""

_HELD = 3.0
"""Time without shaking after which a sensor that is not still is turning slowly [s]."""

_TURNS = 0.1
"""Slowest turn that is reported [°/s]; the noise of the readings looks like slower ones."""

SILENT = 2.0
"""Time without messages after which the stream counts as silent [s]."""

_FEWEST = 5
"""Smallest number of messages for a statement about stamps."""

_FEW = 0.5
"""Share of repeated stamps above which the stamps count as constant."""


class _Batch(NamedTuple):
    """
    Messages that were added together.

    `arrived` and `stamp` are those of the last one [s]; `mean` is the (3,) mean reading, and
    `spread` the largest standard deviation over its axes. The others are numbers of messages.

    """

    arrived: float
    stamp: float
    mean: Floats
    spread: float
    messages: int
    zero: int
    repeated: int
    backward: int


class StreamStatistics:
    """
    Statistics of a stream of messages.

    Attributes
    ----------
    messages : int
        Number of messages.
    dropped : Counter of str
        Number of dropped ones, by the kinds of `_DROPPED`.
    stamp, arrived : float
        Stamp of the last message, and its arrival by the steady clock [s].
    newest : (3,) array or None
        The last reading.
    spread : float
        Largest standard deviation over the axes of the last batch [unit of the reading].

    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.messages, self.dropped = 0, Counter[str]()
        self.stamp = self.spread = math.nan
        self.arrived = self._advanced = self._dropped_at = -math.inf
        self.newest: Floats | None = None
        self._batches: deque[_Batch] = deque()

    def add(self, rows: Floats, arrived: float) -> None:
        """Count messages; parameters as in `Session.push`."""
        stamps = rows[:, 0]
        steps = np.diff(stamps, prepend=self.stamp)  # the first step of a stream is NaN
        readings = rows[:, 1:4]
        self.spread = float(np.max(readings.std(axis=0)))
        self._batches.append(_Batch(
            arrived, float(stamps[-1]), readings.mean(axis=0), self.spread, len(rows),
            *(int(np.sum(each)) for each in (stamps == 0.0, steps == 0.0, steps < 0.0))))
        while self._batches[0].arrived < arrived - _SPAN:
            self._batches.popleft()
        self.messages += len(rows)
        if np.any(steps):  # NaN, too
            self._advanced = arrived
        self.stamp, self.arrived, self.newest = float(stamps[-1]), arrived, readings[-1]

    def turn_rate(self, threshold: float, expected: float) -> float:
        """Return the rate of a slow turn without shaking [°/s]; 0 if there is none."""
        track = [each for each in self._batches if 0.0 <= self.stamp - each.stamp <= _HELD]
        if not track or max(each.spread for each in track) >= threshold:
            return 0.0
        seconds = self.stamp - track[0].stamp
        steps = np.diff([each.mean for each in track], axis=0)
        way = float(np.sum(np.linalg.norm(steps, axis=1))) / expected
        rate = math.degrees(way) / seconds if seconds > 0.8 * _HELD else 0.0
        return rate if rate > _TURNS else 0.0

    def drop(self, kind: str, count: int = 1) -> None:
        """Count dropped messages of one of the kinds of `_DROPPED`."""
        self.dropped[kind] += count
        if kind != 'implausible':  # its raw message is already counted
            self.messages += count
        self._dropped_at = self._clock()

    @property
    def dropped_ago(self) -> float:
        """Time since the last dropped message [s]; infinite if there was none."""
        return self._clock() - self._dropped_at

    @property
    def age(self) -> float:
        """Time since the last message [s]; infinite if there was none."""
        return self._clock() - self.arrived

    @property
    def stopped(self) -> float:
        """Time for which messages have arrived with one and the same stamp [s]."""
        return self.arrived - self._advanced

    @property
    def rate(self) -> float:
        """Messages per second over the last seconds; 0 if the stream is silent."""
        if self.age > SILENT or len(self._batches) < 2:
            return 0.0
        span = self._batches[-1].arrived - self._batches[0].arrived
        count = sum(batch.messages for batch in self._batches) - self._batches[0].messages
        return count / span if span > 0.0 else 0.0

    def length_g(self, units: Units) -> float:
        """Return |a| of the last messages [g]; NaN if not known."""
        return math.nan if units.is_native else self.length / units.per_g

    @property
    def length(self) -> float:
        """Length of the mean reading of the last batch; NaN without messages."""
        return float(np.linalg.norm(self._batches[-1].mean)) if self._batches else math.nan

    @property
    def stamp_fault(self) -> str:
        """Return what is wrong with the stamps of the last seconds, and what to do, or ''."""
        if self.age > SILENT:
            return ''
        messages, zero, repeated, backward = np.sum([each[4:] for each in self._batches], axis=0)
        if messages < _FEWEST:
            return ''
        if zero > _FEW * messages:
            return ('the stamps are zero, expected the time of each reading: set header.stamp in '
                    'the driver')
        if repeated > _FEW * messages:
            return (f'the stamps are constant ({self.stamp:.3f} s), expected the time of each '
                    'reading: set header.stamp in the driver')
        if backward > 1:
            return (f'the stamps are out of order in {backward} of the last {messages} '
                    'messages, expected increasing stamps: check that only one driver publishes')
        return ''


HELD = 30.0
"""Time for which the last value of a quantity holds [s]."""


class Around:
    """
    The last value of each column of the context; `values` is another mapping after each change.

    A quantity holds for `HELD`: after that, its effect is left out. Temperature and supply voltage
    hold until the next value, because their effects cannot be left out without a jump.

    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._begun = clock, clock()
        self._came: dict[str, float] = {}
        self.values: Mapping[str, float] = {}

    @property
    def temperature(self) -> float:
        """Return the temperature [°C]; NaN: none."""
        return self.values.get('temperature', math.nan)

    def take(self, column: str, value: float) -> None:
        """Take a value that has arrived; one that is not finite is ignored."""
        if math.isfinite(value):
            self._came[column] = self._clock()
            self.values = {**self.values, column: value}

    def expire(self) -> None:
        """Remove the quantities that hold no longer."""
        old = [column for column in self.values if is_quantity(column) and self.is_missing(column)]
        if old:
            self.values = {column: value for column, value in self.values.items()
                           if column not in old}

    def is_missing(self, column: str) -> bool:
        """Return whether nothing has arrived for too long."""
        limit = HELD if column in self._came else AGAIN
        return self._clock() - self._came.get(column, self._begun) > limit


def missing_context(session: Session) -> dict[str, str]:
    """Return by column of the context why it is missing, and what follows."""
    calibration = session.sensor.calibration
    model = Model({}) if calibration is None else calibration.model
    wanted = [*context_topics(session.settings), *(
        key for key in model.needs if is_quantity(key) or key == 'supply_voltage')]
    return {column: _missing_words(session, model, column) for column in dict.fromkeys(wanted)
            if session.around.is_missing(column)}


def _missing_words(session: Session, model: Model, column: str) -> str:
    why = session.missing.get(column) or (
        'the samples do not have it' if session.publishers is None else
        f"start the node with context:=['{column}:=TOPIC'], and its topic")
    names = [name for name in model.effects if column in Model({name: model.values[name]}).needs]
    if column in session.around.values:
        follows = '; the last value holds'
    elif names and is_quantity(column):
        follows = f'; {" and ".join(names)} {"is" if len(names) == 1 else "are"} left out'
    else:
        follows = ''
    return f'no {column} arrives: {why}{follows}'


def thermometer_words(session: Session) -> str:
    """Return how the node would get a temperature; empty if it has one."""
    if math.isfinite(session.around.temperature):
        return ''
    if 'temperature' in session.missing:
        return session.missing['temperature']
    topics = ' or '.join(session.thermometers)
    return (f'restart the node with temperature:={topics}' if topics else
            'publish the temperature of the sensor on the topic temperature')


def slow_turn(session: Session) -> str:
    """Return that the sensor turns slowly, and what to do; empty if it is still or shaken."""
    statistics, live = session.statistics, session.sensor.live
    if live.still or session.units.is_native or statistics.age > SILENT:
        return ''
    rate = statistics.turn_rate(live.detector.threshold, session.units.per_g)
    return f'turning slowly, {rate:.1f} °/s: rest it on something' if rate else ''


_DROPPED_SHOWN_FOR = 60.0
"""Duration of the warning after a dropped message [s]."""

_DROPPED = {
    'not_finite': ('message', 'with NaN, infinite or absurd readings: check the driver'),
    'foreign': ('message', 'of another sensor: use a separate topic for each sensor'),
    'implausible': ('corrected message', 'with implausible values: check the calibration')}
"""Kinds of dropped messages: what was dropped, and what to do."""

_LIKELY_G = (0.2, 5.0)
"""Range of |a| [g]; outside of it the unit is probably wrong."""

_WITHOUT_GRAVITY_G = 0.07
"""Mean |a| below which no unit makes the readings those of a sensor that measures gravity [g]."""

_UNITS = (('g', 0.8, 1.2), ('m/s2', 8.0, 12.0))
"""Units with the lowest and highest |reading| of a resting sensor in this unit."""


def stream_faults(session: Session) -> dict[str, str]:
    """Return by kind what is wrong with the messages, and what to do."""
    statistics = session.statistics
    faults = {
        'publishers': _publishers(session), 'mismatches': '; '.join(session.mismatches),
        'silence' if session.publishers else 'no_publisher': _silence(session),
        'stamps': statistics.stamp_fault}
    if statistics.dropped_ago < _DROPPED_SHOWN_FOR:
        faults |= {kind: f'dropped {counted(statistics.dropped[kind], what)} {why}'
                   for kind, (what, why) in _DROPPED.items() if statistics.dropped[kind]}
    faults['unit'] = _wrong_unit(statistics, session.units)
    return {kind: words for kind, words in faults.items() if words}


def _publishers(session: Session) -> str:
    names = session.publishers
    if names is None or len(names) < 2:
        return ''
    count = 'two' if len(names) == 2 else str(len(names))
    return (f'{count} publishers on the topic {session.topic}: {", ".join(names)}; expected one '
            'sensor: stop the others, or give each sensor its own topic; a driver that was killed '
            'disappears after about 20 s')


def _silence(session: Session) -> str:
    topic, publishers = session.topic, session.publishers
    if session.mismatches or (
            min(session.statistics.age, session.statistics.dropped_ago) <= SILENT):
        return ''
    if publishers is None:
        return (f'{topic} sends no samples: check the board, its cable and its program; the poses '
                'are kept')
    if publishers:
        return (f'no Imu messages on {topic}, although {publishers[0]} publishes there: check '
                'the driver')
    there = f', such as {" or ".join(session.imus)}' if session.imus else ''
    return (f'no Imu messages on {topic}, and no publisher: start the driver, or remap '
            f'imu/data_raw to its topic{there}')


def _wrong_unit(statistics: StreamStatistics, units: Units) -> str:
    length, size = statistics.length_g(units), statistics.length
    if not (length < _LIKELY_G[0] or length > _LIKELY_G[1]):
        return ''
    if length < _WITHOUT_GRAVITY_G and not units.is_native:
        return (f'|a| is {length:.3g} g, expected about 1 g at rest: this is linear acceleration, '
                'gravity removed: let the driver publish what the accelerometer reads')
    likely = next((name for name, low, high in _UNITS if low < size < high), 'native')
    return (f'|a| is {length:.3g} g, expected about 1 g at rest: start the node with '
            f'units:={likely}')


AGAIN = 10.0
"""Shortest time between two equal log lines about single messages or a silent stream [s]."""

_FAULT_AGAIN = 60.0
"""Shortest time between two equal log lines about another fault of the stream [s]."""


class Reports:
    """The log lines about the messages of a session, which is the only argument."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._faults: tuple[object, ...] | None = None
        self._faults_at = -math.inf
        self._left: frozenset[str] = frozenset()
        self._missing: frozenset[str] = frozenset()

    def tick(self) -> None:
        """Report what is wrong with the messages now; to be called about once per second."""
        self._faults_of_stream()
        self._limits()
        session, turn = self._session, slow_turn(self._session)
        if turn and session.settings.auto_capture:
            session.log('info', f'no pose yet: {turn}', 'slow_turn', AGAIN)
        if (session.thermometers and session.statistics.messages
                and math.isnan(session.around.temperature)
                and 'temperature' not in context_topics(session.settings)):
            session.log('warning', f'no temperature arrives; {thermometer_words(session)}',
                        'thermometers', 10.0 * _FAULT_AGAIN)
        self._context()

    def foreign(self, frame_id: str) -> None:
        """Count a message of another sensor."""
        self._session.statistics.drop('foreign')
        self._session.log('error', f'an Imu message has frame_id {frame_id!r}, expected '
                          f'{self._session.frame_id!r}; it is dropped: use a separate topic for '
                          'each sensor', 'foreign', AGAIN)

    def absurd(self, readings: Floats, largest: float) -> None:
        """Count readings that are not of a sensor."""
        reading = tuple(readings[0].tolist())
        self._session.statistics.drop('not_finite', len(readings))
        self._session.log('warning', f'an Imu message has the linear_acceleration {reading}, '
                          f'expected three finite numbers up to {largest:.3g}; it is dropped: '
                          'check the driver', 'absurd', AGAIN)

    def unreadable(self, size: int) -> None:
        """Count an unreadable message of this size [bytes]."""
        self._session.statistics.drop('not_finite')
        self._session.log('warning', f'an Imu message of {size} bytes cannot be read; it is '
                          'dropped: check the driver', 'unreadable', AGAIN)

    def uncorrected(self, error: AccelCalibError) -> None:
        """Count a corrected message that is not published because of an error."""
        self._session.statistics.drop('implausible')
        self._session.log('error', f'messages are not corrected: {error}', 'uncorrected', AGAIN)

    def jump(self, seconds: float, since: float) -> None:
        """Log a jump of the stamps, unless no messages arrived for as long [s]."""
        if abs(seconds - since) > SILENT:
            where = 'back' if seconds < 0.0 else 'ahead'
            self._session.log('warning', f'the stamps jumped {where} by {abs(seconds):.1f} s; the '
                              'rest before it has ended, and the poses are kept: unless a '
                              'recording is played, check the clock of the driver',
                              f'jump {where}', _FAULT_AGAIN)

    def _limits(self) -> None:
        left = self._session.sensor.limits_left(self._session.context)
        for key, each in left.items():
            if key not in self._left:
                self._session.log(
                    'warning', f'{each.name} has left the range of the calibration, '
                    f'{each.range_words(each.low, each.high)}: it is '
                    f'{each.range_words(each.least, each.most)}, and {USES_LIMIT}',
                    f'limits of {key}', _FAULT_AGAIN)
        self._left = frozenset(left)

    def _context(self) -> None:
        """Log when a column of the context is missing or back, and that poses lack it."""
        session, missing = self._session, missing_context(self._session)
        for column, words in missing.items():
            if column not in self._missing:
                session.log('warning', words, f'missing {column}', _FAULT_AGAIN)
        for column in sorted(self._missing - missing.keys()):
            session.log('info', f'{column} arrives')
        self._missing = frozenset(missing)
        for column in context_topics(session.settings):
            lack, have = session.sensor.live.book.lacking(column)
            if lack and have:
                session.log('warning', f'{lack} of {counted(lack + have, "pose")} have no '
                            f'{column}, so that ~/refine cannot use it: call ~/reset, and take '
                            'the poses again', f'poses without {column}', 10.0 * _FAULT_AGAIN)

    def _faults_of_stream(self) -> None:
        """Log a fault of the stream when it appears, and again while it lasts."""
        session, statistics = self._session, self._session.statistics
        faults = stream_faults(session)
        limit = AGAIN if statistics.age > SILENT else _FAULT_AGAIN
        again = session.clock() - self._faults_at >= limit
        kinds = (frozenset(faults), session.mismatches)
        if faults and (again or kinds != self._faults):
            waiting, words = not statistics.messages and not session.mismatches, '; '.join(
                faults.values())
            session.log('info' if waiting else 'warning',
                        f'waiting: {words}' if waiting else words)
            self._faults, self._faults_at = kinds, session.clock()
        elif not faults and self._faults is not None:
            session.log('info', f'messages arrive as expected, {statistics.rate:.1f} Hz')
            self._faults = None
