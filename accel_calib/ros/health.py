# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the calibrator says of itself: one record, judged in one place.

`Health` is shown on ``/diagnostics`` and answers ``~/self_test``. Drift is what the rests since
the calibration was made or loaded say of it, see `accel_calib.calibrate.watching`.

"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from ..calibrate.watching import told
from ..units import MG

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ..calibrate.watching import Watching

_OK, _WARN, _ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

_BAD_SHOWN_FOR = 60.0
"""How long a reading that was not finite is warned of [s]."""

_LIKELY_G = (0.2, 5.0)
"""A |a| outside tells that the unit is wrong [g]."""


@dataclass(frozen=True)
class Health:
    """
    The state of the calibrator.

    Parameters
    ----------
    sensor, state, problem : str
        Name; what it does now; what stands in the way, or empty.
    calibration : str
        Model and date, or empty.
    file : str
        Where the calibration is stored.
    writable : bool
        Whether it can be.
    messages, bad : int
        Imu messages so far; of these not finite.
    bad_ago : float
        Since the last that was not finite [s]; infinite: there was none.
    rate : float
        Messages a second, lately.
    length : float
        |a| of the last message [g]; NaN: not known, or native units.
    temperature : float
        Last one [°C]; NaN: none.
    rest_ago : float
        Since the last rest, by the header stamps [s]; NaN: there was none.
    residual : float
        |a| - 1 g at the last rest [g]; NaN: not known.
    standing : Watching or None
        What the rests say of the calibration; None where there is none.
    poses : int
        Poses captured.
    interruptions : int
        Gaps and jumps of the header stamps.
    last_interruption : str
        What the last of them was, or empty.
    threshold : float
        Largest standard deviation of a still axis [m/s², or native].
    next_pose : str
        Which pose helps most next, or that more no longer pay.

    """

    sensor: str
    state: str
    problem: str
    calibration: str
    file: str
    writable: bool
    messages: int
    bad: int
    bad_ago: float
    rate: float
    length: float
    temperature: float
    rest_ago: float
    residual: float
    standing: Watching | None
    poses: int
    interruptions: int
    last_interruption: str
    threshold: float
    next_pose: str


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    name: str
    level: bytes
    words: str


def findings(health: Health) -> list[Finding]:
    """Judge the state: one finding for each thing looked at."""
    return [_messages(health), _values(health), _calibration(health), _drift(health),
            _storage(health)]


def _messages(health: Health) -> Finding:
    if health.rate > 0.0:
        return Finding('messages', _OK, f'{health.rate:.1f} Hz')
    return Finding('messages', _WARN, 'no Imu messages on imu/data_raw: start the driver, or '
                                      'remap the topic')


def _values(health: Health) -> Finding:
    if health.bad_ago < _BAD_SHOWN_FOR:
        return Finding('values', _WARN, f'{health.bad} readings were NaN or infinite and were '
                                        'dropped: look at the driver')
    if health.length < _LIKELY_G[0] or health.length > _LIKELY_G[1]:
        return Finding('values', _WARN, f'readings are {health.length:.3g} g long, expected '
                                        'about 1 at rest: set the parameter units')
    return Finding('values', _OK, 'finite, and about 1 g')


def _calibration(health: Health) -> Finding:
    if health.problem:
        return Finding('calibration', _ERROR, health.problem)
    if not health.calibration:
        return Finding('calibration', _WARN, f'no calibration yet, {health.poses} poses captured: '
                                             f'{health.next_pose or "turn the sensor"}')
    return Finding('calibration', _OK, health.calibration)


def _drift(health: Health) -> Finding:
    standing = health.standing
    if standing is None:
        return Finding('drift', _OK, 'no calibration yet')
    return Finding('drift', _WARN if standing.departure is not None else _OK, told(standing))


def _storage(health: Health) -> Finding:
    if health.writable:
        return Finding('storage', _OK, health.file)
    return Finding('storage', _ERROR, f'{health.file} cannot be written: mend the permissions, '
                                      'or set calibration_file')


def status_of(health: Health) -> DiagnosticStatus:
    """Give the diagnostics: the worst finding speaks, figures follow."""
    worst = max(findings(health), key=lambda finding: finding.level)
    message = health.state if worst.level == _OK else worst.words
    values = [KeyValue(key=key, value=value) for key, value in _figures(health)]
    return DiagnosticStatus(level=worst.level, name='accel_calib: calibrator', message=message,
                            hardware_id=health.sensor, values=values)


def _figures(health: Health) -> Iterable[tuple[str, str]]:
    yield 'state', health.state
    yield 'sensor', health.sensor
    yield 'calibration', health.calibration or 'none'
    yield 'calibration file', health.file
    yield 'rate [Hz]', f'{health.rate:.1f}'
    yield 'messages', str(health.messages)
    yield 'readings not finite', str(health.bad)
    yield 'residual |a| - 1 g at last rest [mg]', _number(health.residual * MG)
    yield from _drift_figures(health.standing)
    yield 'since last rest [s]', _number(health.rest_ago)
    yield 'poses captured', str(health.poses)
    yield 'next pose', health.next_pose
    yield 'interruptions of the clock', str(health.interruptions)
    yield 'last interruption', health.last_interruption or 'none'
    yield 'temperature [°C]', _number(health.temperature)
    yield 'still below [m/s² or native]', f'{health.threshold:.4g}'


def _drift_figures(standing: Watching | None) -> Iterable[tuple[str, str]]:
    """Give what the rests since the calibration say of it."""
    if standing is None:
        return
    departure, temperatures = standing.departure, standing.temperatures
    yield 'drift since calibration [mg]', _number(standing.drift * MG)
    yield 'stated uncertainty at last rest [mg]', _number(standing.stated * MG)
    yield 'rests since calibration', str(standing.count)
    yield 'rests since it left 1 g', str(standing.lasted)
    if departure is not None:
        yield 'left 1 g by [mg]', _number(departure.error * MG)
    if temperatures:
        yield 'temperature when calibrated [°C]', f'{temperatures[0]:.1f} to {temperatures[1]:.1f}'


def _number(value: float) -> str:
    return f'{value:.3f}' if math.isfinite(value) else 'not known'


def self_test_of(health: Health) -> list[DiagnosticStatus]:
    """Give one status for each finding; all must be OK to pass."""
    return [DiagnosticStatus(level=finding.level, name=f'accel_calib: {finding.name}',
                             message=finding.words, hardware_id=health.sensor)
            for finding in findings(health)]
