# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Log lines about the messages: those that are dropped, and faults of the stream."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from .health import stream_faults
from .state import limits_left
from .stream import SILENT
from ..calibrate import USES_LIMIT
from ..errors import AccelCalibError
from ..table import Floats

if TYPE_CHECKING:
    from .session import Session

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
        self._session.log('error', f'messages are not corrected: {error}', 'uncorrected',
                          AGAIN)

    def jump(self, seconds: float, since: float) -> None:
        """Log a jump of the stamps, unless no messages arrived for as long [s]."""
        if abs(seconds - since) > SILENT:
            where = 'back' if seconds < 0.0 else 'ahead'
            self._session.log('warning', f'the stamps jumped {where} by {abs(seconds):.1f} s; the '
                              'rest before it has ended, and the poses are kept: unless a '
                              'recording is played, check the clock of the driver',
                              f'jump {where}', _FAULT_AGAIN)

    def limits(self) -> None:
        """Log once when a quantity leaves the range of the calibration."""
        left = limits_left(self._session)
        for key, each in left.items():
            if key not in self._left:
                self._session.log(
                    'warning', f'{each.name} has left the range of the calibration, '
                    f'{each.range_words(each.low, each.high)}: it is '
                    f'{each.range_words(each.least, each.most)}, and {USES_LIMIT}',
                    f'limits of {key}', _FAULT_AGAIN)
        self._left = frozenset(left)

    def faults(self) -> None:
        """Log a fault of the stream when it appears, and again while it lasts."""
        session, statistics = self._session, self._session.statistics
        faults = stream_faults(statistics, statistics.length_g(session.units), session.topic,
                               session.publishers, session.mismatches)
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
