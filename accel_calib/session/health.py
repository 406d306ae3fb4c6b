# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of the calibrator and its evaluation.

``/diagnostics`` and ``~/self_test`` report `Health`.

**Statistics.** Statistics of a stream of messages.

"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
import math
from time import monotonic

from ..errors import counted
from ..monitor import Drift, status
from ..table import Floats
from ..units import MG


class StreamStatistics:
    """
    Statistics of a stream of messages; rates use a steady clock.

    Attributes
    ----------
    messages : int
        Number of messages.
    not_finite, foreign, implausible : int
        Numbers of dropped messages: readings that are not finite, messages of another sensor, and
        corrected messages that are not plausible.
    stamp : float
        Stamp of the last message [s].
    arrived : float
        Time of its arrival, by the steady clock [s].
    temperature : float
        Last temperature [°C]; NaN: none.
    reading : (3,) array
        Last reading.
    rate : float
        Messages per second between the last two ticks.

    """

    def __init__(self) -> None:
        self.messages = self.not_finite = self.foreign = self.implausible = 0
        self.stamp = self.temperature = math.nan
        self.arrived = self._dropped_at = -math.inf
        self.reading: Floats | None = None
        self.rate = 0.0
        self._tick_at, self._messages_at_tick = monotonic(), 0

    def add(self, rows: Floats, arrived: float) -> None:
        """Count messages; parameters as in `Session.push`."""
        self.messages += len(rows)
        self.stamp, self.reading, self.arrived = float(rows[-1, 0]), rows[-1, 1:4], arrived

    def drop(self, name: str, count: int = 1) -> None:
        """Count dropped messages; `name` is ``not_finite``, ``foreign`` or ``implausible``."""
        setattr(self, name, getattr(self, name) + count)
        if name != 'implausible':  # its raw message is already counted
            self.messages += count
        self._dropped_at = monotonic()

    @property
    def dropped_ago(self) -> float:
        """Time since the last dropped message [s]; infinite if there was none."""
        return monotonic() - self._dropped_at

    def tick(self) -> None:
        """Update the rate from the messages since the last tick."""
        now = monotonic()
        self.rate = (self.messages - self._messages_at_tick) / max(now - self._tick_at, 1e-3)
        self._tick_at, self._messages_at_tick = now, self.messages


_DROPPED_SHOWN_FOR = 60.0
"""Duration of the warning after a dropped message [s]."""

_LIKELY_G = (0.2, 5.0)
"""Range of |a| [g]; outside of it the unit is probably wrong."""


class Level(IntEnum):
    """Severity, as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Health:
    """
    The state of the calibrator.

    Parameters
    ----------
    sensor, state, problem : str
        Name of the sensor; current state; reason why messages are not corrected, or empty.
    calibration : str
        Model and date, or empty.
    outside : str
        Context outside of the ranges of the calibration, or empty.
    file : str
        File of the calibration.
    writable : bool
        Whether the file can be written.
    statistics : StreamStatistics
        Statistics of the stream.
    length : float
        |a| of the last message [g]; NaN: not known.
    rest_ago : float
        Time since the last rest, by header stamps [s]; NaN: no rest yet.
    residual : float
        |a| - 1 g at the last rest [g]; NaN: not known.
    drift : Drift or None
        State of the drift monitor; None without a calibration.
    poses, doubtful : int
        Number of captured poses, and of doubtful poses among them.
    interruptions : int
        Number of interruptions of the header stamps.
    last_interruption : str
        The last interruption, or empty.
    threshold : float
        Largest standard deviation of a still axis [m/s², or native].
    next_pose : str
        The next pose, or that more poses no longer help.

    """

    sensor: str
    state: str
    problem: str
    calibration: str
    outside: str
    file: str
    writable: bool
    statistics: StreamStatistics
    length: float
    rest_ago: float
    residual: float
    drift: Drift | None
    poses: int
    doubtful: int
    interruptions: int
    last_interruption: str
    threshold: float
    next_pose: str


@dataclass(frozen=True)
class Finding:
    """The result of one check: name, severity and text."""

    name: str
    level: Level
    words: str


def findings(health: Health) -> list[Finding]:
    """Return the findings of all checks."""
    return [_messages(health), _values(health), _calibration(health), _drift(health),
            _storage(health)]


def worst(health: Health) -> Finding:
    """Return the most severe finding, or the state if all findings are OK."""
    found = max(findings(health), key=lambda finding: finding.level)
    return Finding('state', Level.OK, health.state) if found.level == Level.OK else found


def _messages(health: Health) -> Finding:
    if health.statistics.rate > 0.0:
        return Finding('messages', Level.OK, f'{health.statistics.rate:.1f} Hz')
    return Finding('messages', Level.WARN, 'no Imu messages on imu/data_raw: start the driver, or '
                                           'remap the topic')


def _values(health: Health) -> Finding:
    counts = health.statistics
    dropped = [words for count, words in (
        (counts.not_finite, f'dropped {counted(counts.not_finite, "message")} with NaN or '
                            'infinite readings: check the driver'),
        (counts.foreign, f'dropped {counted(counts.foreign, "message")} of another sensor: use a '
                         'separate topic for each sensor'),
        (counts.implausible, f'dropped {counted(counts.implausible, "corrected message")} with '
                             'implausible values: check the calibration')) if count]
    if dropped and counts.dropped_ago < _DROPPED_SHOWN_FOR:
        return Finding('values', Level.WARN, '; '.join(dropped))
    if health.length < _LIKELY_G[0] or health.length > _LIKELY_G[1]:
        return Finding('values', Level.WARN, f'|a| is {health.length:.3g} g, expected about 1 g '
                                             'at rest: set the parameter units')
    return Finding('values', Level.OK, 'finite, and about 1 g')


def _calibration(health: Health) -> Finding:
    if health.problem:
        return Finding('calibration', Level.ERROR, health.problem)
    if not health.calibration:
        return Finding('calibration', Level.WARN, 'no calibration yet, captured '
                       f'{counted(health.poses, "pose")}: {health.next_pose or "turn the sensor"}')
    if health.outside:
        return Finding('calibration', Level.WARN, f'{health.outside}: the correction uses the '
                       'limit of the range; capture poses there and call ~/refine')
    return Finding('calibration', Level.OK, health.calibration)


def _drift(health: Health) -> Finding:
    if health.drift is None:
        return Finding('drift', Level.OK, 'no calibration yet')
    changed = health.drift.change is not None
    return Finding('drift', Level.WARN if changed else Level.OK, status(health.drift))


def _storage(health: Health) -> Finding:
    if health.writable:
        return Finding('storage', Level.OK, health.file)
    return Finding('storage', Level.ERROR, f'{health.file} cannot be written: correct the '
                                           'permissions, or set calibration_file')


def figures(health: Health) -> Iterable[tuple[str, str]]:
    """Yield names and values for the diagnostics."""
    counts = health.statistics
    yield 'state', health.state
    yield 'sensor', health.sensor
    yield 'calibration', health.calibration or 'none'
    yield 'calibration file', health.file
    yield 'rate [Hz]', f'{counts.rate:.1f}'
    yield 'messages', str(counts.messages)
    yield 'readings not finite', str(counts.not_finite)
    yield 'messages of another sensor', str(counts.foreign)
    yield 'corrected messages not plausible', str(counts.implausible)
    yield 'residual |a| - 1 g at last rest [mg]', _number(health.residual * MG)
    yield from _drift_figures(health.drift)
    yield 'since last rest [s]', _number(health.rest_ago)
    yield 'poses captured', str(health.poses)
    yield 'poses doubtful', str(health.doubtful)
    yield 'next pose', health.next_pose
    yield 'interruptions of the clock', str(health.interruptions)
    yield 'last interruption', health.last_interruption or 'none'
    yield 'temperature [°C]', _number(counts.temperature)
    yield 'still below [m/s² or native]', f'{health.threshold:.4g}'


def _drift_figures(drift: Drift | None) -> Iterable[tuple[str, str]]:
    if drift is None:
        return
    yield 'drift since calibration [mg]', _number(drift.error * MG)
    yield 'stated uncertainty at last rest [mg]', _number(drift.stated * MG)
    yield 'rests since calibration', str(drift.count)
    yield 'rests since it changed', str(drift.lasted)
    if drift.change is not None:
        yield 'changed by [mg]', _number(drift.change.error * MG)
    if drift.temperatures:
        low, high = drift.temperatures
        yield 'temperature when calibrated [°C]', f'{low:.1f} to {high:.1f}'


def _number(value: float) -> str:
    return f'{value:.3f}' if math.isfinite(value) else 'not known'
