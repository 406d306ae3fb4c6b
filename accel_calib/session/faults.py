# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What is wrong with the messages of a session, and the log lines about it."""

from __future__ import annotations

import math

from .core import State
from .settings import context_topics
from .stream import AGAIN, SILENT, StreamStatistics
from ..calibrate import USES_LIMIT
from ..effects import Model
from ..errors import AccelCalibError
from ..table import is_quantity
from ..text import counted
from ..units import Units


def missing_context(session: State) -> dict[str, str]:
    """Return by column of the context why it is missing, and what follows."""
    calibration, found = session.sensor.calibration, dict[str, str]()
    model = Model({}) if calibration is None else calibration.model
    wanted = [*context_topics(session.settings), *(
        key for key in model.needs if is_quantity(key) or key == 'supply_voltage')]
    for column in filter(session.around.is_missing, dict.fromkeys(wanted)):
        why = session.missing.get(column) or (
            'the samples do not have it' if session.publishers is None else
            f"start the node with context:=['{column}:=TOPIC'], and its topic")
        names = [name for name in model.effects
                 if column in Model({name: model.values[name]}).needs]
        follows = ''
        if column in session.around.values:
            follows = '; the last value holds'
        elif names and is_quantity(column):
            follows = f'; {" and ".join(names)} {"is" if len(names) == 1 else "are"} left out'
        found[column] = f'no {column} arrives: {why}{follows}'
    return found


def thermometer_words(session: State) -> str:
    """Return how the node would get a temperature; empty if it has one."""
    if math.isfinite(session.around.temperature):
        return ''
    if 'temperature' in session.missing:
        return session.missing['temperature']
    topics = ' or '.join(session.thermometers)
    return (f'restart the node with temperature:={topics}' if topics else
            'publish the temperature of the sensor on the topic temperature')


def slow_turn(session: State) -> str:
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


def stream_faults(session: State) -> dict[str, str]:
    """Return by kind what is wrong with the messages, and what to do."""
    statistics, names = session.statistics, session.publishers or ()
    faults = {
        'publishers': '' if len(names) < 2 else (
            f'{"two" if len(names) == 2 else len(names)} publishers on the topic {session.topic}: '
            f'{", ".join(names)}; expected one sensor: stop the others, or give each sensor its '
            'own topic; a driver that was killed disappears after about 20 s'),
        'mismatches': '; '.join(session.mismatches),
        'silence' if session.publishers else 'no_publisher': _silence(session),
        'stamps': statistics.stamp_fault}
    if statistics.dropped_ago < _DROPPED_SHOWN_FOR:
        faults |= {kind: f'dropped {counted(statistics.dropped[kind], what)} {why}'
                   for kind, (what, why) in _DROPPED.items() if statistics.dropped[kind]}
    faults['unit'] = _wrong_unit(statistics, session.units)
    return {kind: words for kind, words in faults.items() if words}


def _silence(session: State) -> str:
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


FAULT_AGAIN = 60.0
"""Shortest time between two equal log lines about another fault of the stream [s]."""


class Reports:
    """The log lines about the messages of a session, which is the only argument."""

    def __init__(self, session: State) -> None:
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
                        'thermometers', 10.0 * FAULT_AGAIN)
        self._context()

    def unreadable(self, size: int) -> None:
        """Count an unreadable message of this size [bytes]."""
        self._session.statistics.drop('not_finite')
        self._session.log('warning', f'an Imu message of {size} bytes cannot be read; it is '
                          'dropped: check the driver', 'unreadable', AGAIN)

    def uncorrected(self, error: AccelCalibError) -> None:
        """Count a corrected message that is not published because of an error."""
        self._session.statistics.drop('implausible')
        self._session.log('error', f'messages are not corrected: {error}', 'uncorrected', AGAIN)

    def _limits(self) -> None:
        left = self._session.sensor.limits_left(self._session.context)
        for key, each in left.items():
            if key not in self._left:
                self._session.log(
                    'warning', f'{each.name} has left the range of the calibration, '
                    f'{each.range_words(each.low, each.high)}: it is '
                    f'{each.range_words(each.least, each.most)}, and {USES_LIMIT}',
                    f'limits of {key}', FAULT_AGAIN)
        self._left = frozenset(left)

    def _context(self) -> None:
        """Log when a column of the context is missing or back, and that poses lack it."""
        session, missing = self._session, missing_context(self._session)
        for column, words in missing.items():
            if column not in self._missing:
                session.log('warning', words, f'missing {column}', FAULT_AGAIN)
        for column in sorted(self._missing - missing.keys()):
            session.log('info', f'{column} arrives')
        self._missing = frozenset(missing)
        for column in context_topics(session.settings):
            lack, have = session.sensor.live.book.lacking(column)
            if lack and have:
                session.log('warning', f'{lack} of {counted(lack + have, "pose")} have no '
                            f'{column}, so that ~/refine cannot use it: call ~/reset, and take '
                            'the poses again', f'poses without {column}', 10.0 * FAULT_AGAIN)

    def _faults_of_stream(self) -> None:
        """Log a fault of the stream when it appears, and again while it lasts."""
        session, statistics = self._session, self._session.statistics
        faults = stream_faults(session)
        limit = AGAIN if statistics.age > SILENT else FAULT_AGAIN
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
