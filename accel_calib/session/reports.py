# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The log lines about the messages of a session."""

from __future__ import annotations

import math

from .conditions import conditions, slow_turn, thermometer_words
from .core import Holder
from .settings import context_topics
from .stream import AGAIN
from ..errors import AccelCalibError
from ..text import counted

FAULT_AGAIN = 60.0
"""Shortest time between two equal log lines about another fault of the stream [s]."""

_OFTEN = ('silence', 'no_publisher')
"""Conditions that are logged again after `AGAIN`."""


class Reports:
    """The log lines about the messages of a session, which is the only argument."""

    def __init__(self, session: Holder) -> None:
        self._session = session
        self._told: dict[str, str] = {}

    def tick(self) -> None:
        """Report what has changed; to be called about once per second."""
        session, state = self._session, self._session.state
        statistics = state.statistics
        now = {each.name: each for each in conditions(state) if each.name and each.level}
        waits = not statistics.messages and not state.surroundings.mismatches
        for name, each in now.items():
            if name not in self._told:
                session.throttle.forget(name)
            session.log('info' if waits else 'warning', f'waiting: {each.words}' if waits else
                        each.words, name, AGAIN if name in _OFTEN else
                        FAULT_AGAIN if each.concern == 'stream' else math.inf)
        over = [(name, concern) for name, concern in self._told.items() if name not in now]
        for name, concern in over:
            if concern == 'stream' and name in state.around.values:
                session.log('info', f'{name} arrives')
        if any(concern == 'stream' for _, concern in over) and statistics.rate and not any(
                each.concern == 'stream' for each in now.values()):
            session.log('info', f'messages arrive as expected, {statistics.rate:.1f} Hz')
        self._told = {name: each.concern for name, each in now.items()}
        if (turn := slow_turn(state)) and state.settings.auto_capture:
            session.log('info', f'no pose yet: {turn}', 'slow_turn', AGAIN)
        topics = context_topics(state.settings)
        if (state.surroundings.thermometers and statistics.messages
                and 'temperature' not in topics and math.isnan(state.around.temperature)):
            session.log('warning', f'no temperature arrives; {thermometer_words(state)}',
                        'thermometers', 10.0 * FAULT_AGAIN)
        for column in topics:
            lack, have = state.sensor.live.book.lacking(column)
            if lack and have:
                session.log('info', f'{lack} of {counted(lack + have, "pose")} have no {column}, '
                            'so that ~/refine cannot use it', f'poses without {column}',
                            10.0 * FAULT_AGAIN)

    def unreadable(self, size: int) -> None:
        """Count an unreadable message of this size [bytes]."""
        self._session.state.statistics.drop('not_finite')
        self._session.log('warning', f'an Imu message of {size} bytes cannot be read; it is '
                          'dropped: check the driver', 'unreadable', AGAIN)

    def uncorrected(self, error: AccelCalibError) -> None:
        """Count a corrected message that is not published because of an error."""
        self._session.state.statistics.drop('implausible')
        self._session.log('error', f'messages are not corrected: {error}', 'uncorrected', AGAIN)
