# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of the calibrator and its evaluation.

``/diagnostics`` and ``~/self_test`` report `Health`.

"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
import math

import numpy as np

from .stream import SILENT, StreamStatistics
from ..calibrate import GyroBias, SampleNoise, USES_LIMIT
from ..compare import Drift, status
from ..table import Floats
from ..text import counted
from ..units import MG

_DROPPED_SHOWN_FOR = 60.0
"""Duration of the warning after a dropped message [s]."""

_LIKELY_G = (0.2, 5.0)
"""Range of |a| [g]; outside of it the unit is probably wrong."""

_UNITS = (('g', 0.8, 1.2), ('m/s2', 8.0, 12.0))
"""Units with the lowest and highest |reading| of a resting sensor in this unit."""


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
    topic : str
        Topic of the raw messages, with namespace and remapping.
    publishers : tuple of str or None
        Names of the nodes that publish on this topic; None: the samples come from a board.
    mismatches : tuple of str
        Publishers and subscribers with another QoS, and what to do.
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
    mounting : str
        The mounting, or empty if it is not known.
    gyro : GyroBias or None
        Bias of the gyro; None if it is not known.
    noise : SampleNoise or None
        Noise of the samples; None if it is not known.

    """

    sensor: str
    state: str
    problem: str
    topic: str
    publishers: tuple[str, ...] | None
    mismatches: tuple[str, ...]
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
    mounting: str
    gyro: GyroBias | None
    noise: SampleNoise | None


@dataclass(frozen=True)
class Check:
    """The result of one check: name, severity and text."""

    name: str
    level: Level
    words: str


def checks(health: Health) -> list[Check]:
    """Return the results of all checks, one for each concern."""
    return [_stream(health), _calibration(health), _drift(health), _storage(health)]


def worst(health: Health) -> Check:
    """Return the most severe check, or the state if all are OK."""
    found = max(checks(health), key=lambda check: check.level)
    if found.level == Level.OK:
        return Check('state', Level.OK, health.state)
    return Check('state', found.level, found.words)


def _stream(health: Health) -> Check:
    """Return the first fault of the stream, or its rate."""
    faults = stream_faults(health.statistics, health.length, health.topic, health.publishers,
                           health.mismatches)
    if faults:
        return Check('stream', Level.WARN, '; '.join(faults.values()))
    return Check('stream', Level.OK, f'{health.statistics.rate:.1f} Hz on {health.topic}')


def stream_faults(statistics: StreamStatistics, length: float, topic: str,
                  publishers: Sequence[str] | None, mismatches: Sequence[str] = ()
                  ) -> dict[str, str]:
    """Return by kind what is wrong with the messages; arguments as in `Health`."""
    silence = '' if mismatches else _silence(statistics, topic, publishers)
    faults = {
        'publishers': _publishers(topic, publishers), 'mismatches': '; '.join(mismatches),
        'silence' if publishers else 'no_publisher': silence, 'stamps': statistics.stamp_fault,
        **_dropped(statistics), 'unit': _wrong_unit(statistics, length)}
    return {kind: words for kind, words in faults.items() if words}


def _publishers(topic: str, names: Sequence[str] | None) -> str:
    if names is None or len(names) < 2:
        return ''
    count = 'two' if len(names) == 2 else str(len(names))
    return (f'{count} publishers on the topic {topic}: {", ".join(names)}; expected one sensor: '
            'stop the others, or give each sensor its own topic')


def _silence(statistics: StreamStatistics, topic: str, publishers: Sequence[str] | None) -> str:
    if min(statistics.age, statistics.dropped_ago) <= SILENT:
        return ''
    if publishers is None:
        return (f'{topic} sends no samples: check the board, its cable and its program; the poses '
                'are kept')
    if publishers:
        return (f'no Imu messages on {topic}, although {publishers[0]} publishes there: check '
                'the driver')
    return (f'no Imu messages on {topic}, and no publisher: start the driver, or remap '
            'imu/data_raw to its topic')


def _dropped(statistics: StreamStatistics) -> dict[str, str]:
    if statistics.dropped_ago >= _DROPPED_SHOWN_FOR:
        return {}
    absurd, foreign, implausible = (
        statistics.not_finite, statistics.foreign, statistics.implausible)
    return {
        'not_finite': f'dropped {counted(absurd, "message")} with NaN, infinite or absurd '
                      'readings: check the driver' if absurd else '',
        'foreign': f'dropped {counted(foreign, "message")} of another sensor: use a separate '
                   'topic for each sensor' if foreign else '',
        'implausible': f'dropped {counted(implausible, "corrected message")} with implausible '
                       'values: check the calibration' if implausible else ''}


def _wrong_unit(statistics: StreamStatistics, length: float) -> str:
    if not (length < _LIKELY_G[0] or length > _LIKELY_G[1]):
        return ''
    reading = statistics.reading
    size = math.nan if reading is None else float(np.linalg.norm(reading))
    likely = next((name for name, low, high in _UNITS if low < size < high), 'native')
    return (f'|a| is {length:.3g} g, expected about 1 g at rest: start the node with '
            f'units:={likely}')


def _calibration(health: Health) -> Check:
    if health.problem:
        return Check('calibration', Level.ERROR, health.problem)
    if not health.calibration:
        return Check('calibration', Level.WARN, 'no calibration yet, captured '
                     f'{counted(health.poses, "pose")}: {health.next_pose or "turn the sensor"}')
    if health.outside:
        return Check('calibration', Level.WARN, f'{health.outside}: {USES_LIMIT}; '
                     'capture poses there and call ~/refine')
    return Check('calibration', Level.OK, health.calibration)


def _drift(health: Health) -> Check:
    if health.drift is None:
        return Check('drift', Level.OK, 'no calibration yet')
    changed = health.drift.change is not None
    return Check('drift', Level.WARN if changed else Level.OK, status(health.drift))


def _storage(health: Health) -> Check:
    if health.writable:
        return Check('storage', Level.OK, health.file)
    return Check('storage', Level.ERROR, f'{health.file} cannot be written: correct the '
                                         'permissions, or restart the node with another '
                                         'calibration_file')


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
    yield 'mounting', health.mounting or 'not known'
    if health.gyro is not None:
        yield 'gyro bias [rad/s]', _vector(health.gyro.at(counts.temperature))
        yield 'gyro bias, standard deviation [rad/s]', _vector(health.gyro.sd)
    if health.noise is not None:
        yield 'noise of acceleration [m/s² or native]', _vector(health.noise.force)
        yield 'noise of angular velocity [rad/s]', _vector(health.noise.rate)


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


def _vector(values: Floats) -> str:
    return ', '.join(f'{value:.4g}' for value in values)


def _number(value: float) -> str:
    return f'{value:.3f}' if math.isfinite(value) else 'not known'
