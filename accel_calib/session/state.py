# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of a session, as its topics and pages show it.

``~/progress`` has the progress of the calibration, ``~/self_test`` one check for each concern, and
``/diagnostics`` the checks and all figures.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, MISSING
import math
from typing import Any

import numpy as np

from .conditions import Condition, conditions, Level, next_action, thermometer_words
from .core import State
from .sensor import title
from .settings import context_topics
from .stream import SILENT
from ..comparison import status
from ..errors import InputError
from ..finding import has
from ..messages.one_reading import Triple
from ..pipeline import is_partial
from ..table import column_of
from ..text import counted
from ..units import MG


def _figure(name: str, write: Callable[[Any], str], read: Callable[[str], Any],
            default: Any = MISSING) -> Any:
    """Return a field with the name of its figure, and what writes and reads its value."""
    return field(default=default, metadata={'name': name, 'write': write, 'read': read})


_VECTOR = (lambda parts: ' '.join(f'{part:.4f}' for part in parts),
           lambda text: tuple(map(float, text.split())))
"""What writes and reads the components of a vector."""


@dataclass(frozen=True)
class Progress:
    """
    The progress of a calibration, for the topic ``~/progress``.

    Parameters
    ----------
    still : bool
        Whether the sensor is still.
    stillness : float
        Standard deviation of the last messages, relative to the largest of a still sensor; NaN: no
        messages.
    dwell, min_dwell : float
        Length of the ongoing rest, and shortest rest that becomes a pose [s].
    poses, total : int
        Number of poses, and about how many there will be.
    coverage : float
        Share of the sphere within 45° of a pose.
    accuracy : float
        Expected error of |a| after a fit now [g]; infinite if the poses do not determine it, NaN
        if the noise is not known.
    step : str
        Kind of the next step, one of `accel_calib.finding.STEPS`; empty before it is known.
    advice : str
        The next step in words.
    command : str
        Name of the service for it; empty if there is none.
    direction : tuple of float
        Direction to point up, a unit vector in the sensor axes; empty: none.
    up : tuple of float
        Direction of the newest raw reading, a unit vector in the sensor axes; empty: not known.
    length, corrected : float
        Raw and corrected |a| of the newest message [g]; the correction is the offered one while a
        calibration waits for ~/save. NaN: not known.
    temperature : float
        Temperature [°C]; NaN: not known.

    """

    still: bool = _figure('still', lambda still: str(still).lower(),
                          {'true': True, 'false': False}.__getitem__)
    stillness: float = _figure('stillness [1: limit]', '{:.3g}'.format, float)
    dwell: float = _figure('dwell [s]', '{:.1f}'.format, float)
    min_dwell: float = _figure('min_dwell [s]', '{:g}'.format, float)
    poses: int = _figure('poses', str, int)
    total: int = _figure('poses in all, about', str, int)
    coverage: float = _figure('coverage', '{:.3f}'.format, float)
    accuracy: float = _figure('expected accuracy [mg]', lambda error: f'{error * MG:.3g}',
                              lambda text: float(text) / MG)
    step: str = _figure('step', str, str)
    advice: str = _figure('next', str, str)
    command: str = _figure('service', str, str)
    direction: tuple[float, ...] = _figure('next direction', *_VECTOR)
    up: tuple[float, ...] = _figure('up', *_VECTOR, default=())
    length: float = _figure('|a| [g]', '{:.5f}'.format, float, default=math.nan)
    corrected: float = _figure('|a| corrected [g]', '{:.5f}'.format, float, default=math.nan)
    temperature: float = _figure('temperature [°C]', '{:.2f}'.format, float, default=math.nan)

    def figures(self) -> Iterator[tuple[str, str]]:
        """Yield names and values."""
        for each in fields(self):
            yield each.metadata['name'], each.metadata['write'](getattr(self, each.name))

    @classmethod
    def from_figures(cls, figures: Mapping[str, str]) -> Progress:
        """
        Return the progress with these figures, as `figures` yields them; ignore others.

        InputError if a figure is missing or cannot be read.

        """
        found = {}
        for each in fields(cls):
            name = each.metadata['name']
            try:
                found[each.name] = each.metadata['read'](figures[name])
            except (KeyError, ValueError) as err:
                what = f'{name}: {figures[name]}' if name in figures else f'no figure {name}'
                raise InputError(
                    f'the progress of the node has {what}, expected the figures of this version',
                    'install the same version of accel_calib on both machines') from err
        return cls(**found)


Newest = tuple[tuple[float, ...], float, float]
"""A reading: direction (empty if not known), |a| and corrected |a| [g] (NaN: not known)."""

_NOT_KNOWN: Newest = (), math.nan, math.nan


def progress(state: State, reading: Triple | None = None) -> Progress:
    """Return the progress; `reading` is the newest one, by default the last that was pushed."""
    sensor, statistics = state.sensor, state.statistics
    plan, silent = sensor.guide.plan, statistics.age > SILENT
    up, length, corrected = _NOT_KNOWN if silent else _newest(state, reading)
    action, rating = next_action(state), sensor.rating
    # NaN if it is not known, or not the noise alone.
    noisy = rating is not None and has(rating.findings, 'beyond_noise')
    accuracy = math.nan if plan is None or noisy else plan.asked.error * plan.noise_g
    return Progress(
        still=state.still and not silent,
        stillness=math.nan if silent else state.stillness,
        dwell=statistics.stamp - state.still_since if state.still else 0.0,
        min_dwell=state.settings.min_dwell, poses=sensor.guide.poses,
        total=0 if plan is None else plan.asked.total,
        coverage=0.0 if plan is None else plan.coverage,
        accuracy=accuracy, step=action.kind, advice=action.words,
        command=action.command,
        direction=action.direction,
        up=up, length=length, corrected=corrected, temperature=state.around.temperature)


def _newest(state: State, reading: Triple | None) -> Newest:
    """Describe the newest reading; a native one has a direction only if its zero is known."""
    sensor, newest = state.sensor, state.statistics.newest
    if reading is None:
        if newest is None:
            return _NOT_KNOWN
        reading = tuple(newest.tolist())
    force = sensor.force_of(reading, state.context)
    corrected = math.nan if force is None else math.hypot(*force)
    if not state.units.is_native:
        length = math.hypot(*reading)
        return _unit(reading, length), length / state.units.per_g, corrected
    if sensor.present is None or force is None:
        zero = () if sensor.guide.plan is None else sensor.guide.plan.zero
        parts = [part - at for part, at in zip(reading, zero, strict=False)]
        return _unit(parts, math.hypot(*parts)), math.nan, math.nan
    return _unit((sensor.present.rotation @ force).tolist(), corrected), math.nan, corrected


def _unit(vector: Sequence[float], length: float) -> tuple[float, ...]:
    return tuple(part / length for part in vector) if 0.0 < length < math.inf else ()


def diagnostics(state: State) -> list[Condition]:
    """Return the state, which is the first of the most severe conditions, and all `checks`."""
    found = conditions(state)
    by_concern = {each.concern: each for each in _checked(state, found)}
    first = max(found, key=lambda each: each.level)
    words = by_concern[first.concern].words if first.level else words_of_state(state)
    return [Condition('', words, level=first.level, concern='state'), *by_concern.values()]


def checks(state: State) -> list[Condition]:
    """Return the results of all checks, one for each concern."""
    return diagnostics(state)[1:]


def _checked(state: State, found: Sequence[Condition]) -> Iterator[Condition]:
    """Yield for each concern the conditions that are wrong, or that all is fine."""
    sensor, drift = state.sensor, state.sensor.drift
    fine = {'stream': f'{state.statistics.rate:.1f} Hz on {state.topic}',
            'calibration': '' if sensor.calibration is None else title(sensor.calibration),
            'drift': 'no calibration yet' if drift is None else status(drift),
            'storage': state.files.path}
    if sensor.calibration is None and sensor.offered is None:
        count = counted(len(sensor.live.book.poses()), 'pose')
        fine['calibration'] = f'no calibration yet, captured {count}'
    for concern, words in fine.items():
        wrong = [each for each in found if each.concern == concern and each.level]
        said = list(dict.fromkeys(each.words for each in wrong))
        if not any(each.name or each.level == Level.ERROR for each in wrong):  # a mere step
            said[:1] = [': '.join(filter(None, [words, *said[:1]]))]
        yield Condition('', '; '.join(said), concern=concern,
                        level=max([Level.OK, *(each.level for each in wrong)]))


def words_of_state(state: State) -> str:
    """Return whether messages are corrected, and why not."""
    calibration = state.sensor.calibration
    return next(words for holds, words in (
        (state.files.problem, 'another node uses the files, nothing is published'),
        (not state.enabled, 'correction switched off, raw messages are published'),
        (state.sensor.offered is not None, 'a new calibration waits for ~/save or ~/undo'),
        (calibration is not None and is_partial(calibration),
         'correcting, with a calibration of a part of the orientations'),
        (calibration is not None, 'correcting'),
        (not state.statistics.messages, 'waiting for the first message'),
        (state.settings.passthrough, 'no calibration, raw messages are published'),
        (True, 'no calibration, nothing is published')) if holds)


def figures(state: State) -> Iterator[tuple[str, str]]:
    """Yield names and values for the diagnostics."""
    sensor, counts, warm = state.sensor, state.statistics, state.around.temperature
    gravity, rest, drift, live = sensor.gravity, sensor.rest, sensor.drift, sensor.live
    yield 'state', words_of_state(state)
    yield 'sensor', state.name
    yield 'calibration', 'none' if sensor.calibration is None else title(sensor.calibration)
    yield 'calibration file', state.files.path
    yield 'rate [Hz]', f'{counts.rate:.1f}'
    yield 'messages', str(counts.messages)
    yield 'readings not finite', str(counts.dropped['not_finite'])
    yield 'messages of another sensor', str(counts.dropped['foreign'])
    yield 'corrected messages not plausible', str(counts.dropped['implausible'])
    yield 'residual |a| - 1 g at last rest [mg]', _number(math.nan if gravity is None else (
        float(np.linalg.norm(gravity)) / state.settings.gravity - 1.0) * MG)
    if drift is not None:
        yield 'drift since calibration [mg]', _number(drift.error * MG)
        yield 'stated uncertainty at last rest [mg]', _number(drift.stated * MG)
        yield 'rests since calibration', str(drift.count)
        yield 'rests since it changed', str(drift.lasted)
        if drift.change is not None:
            yield 'changed by [mg]', _number(drift.change.error * MG)
        if drift.temperatures:
            low, high = drift.temperatures
            yield 'temperature when calibrated [°C]', f'{low:.1f} to {high:.1f}'
    yield 'since last rest [s]', _number(math.nan if rest is None else (
        0.0 if live.still else max(0.0, counts.stamp - rest.end)))
    yield from _figures_of_capture(state)
    yield 'still below [m/s² or native]', f'{live.detector.threshold:.4g}'
    yield 'mounting', state.mounting_words(sensor.calibration) or 'not known'
    gyro, noise = sensor.gyro, sensor.noise
    if gyro is not None:
        yield 'gyro bias [rad/s]', _vector(gyro.at(warm))
        yield 'gyro bias, standard deviation [rad/s]', _vector(gyro.sd)
    if noise is not None:
        yield 'noise of acceleration [m/s² or native]', _vector(noise.force)
        yield 'noise of angular velocity [rad/s]', _vector(noise.rate)


def _figures_of_capture(state: State) -> Iterator[tuple[str, str]]:
    live, warm = state.sensor.live, state.around.temperature
    poses, breaks = live.book.poses(), live.detector.interruptions
    yield 'poses captured', str(len(poses))
    yield 'poses doubtful', str(int(np.sum(poses['doubtful'])) if 'doubtful' in poses else 0)
    yield 'next', next_action(state).words or 'turn the sensor'
    yield 'interruptions of the clock', str(len(breaks))
    yield 'last interruption', (
        f'{breaks[-1].kind}, {breaks[-1].seconds:.2f} s' if breaks else 'none')
    yield 'zeros or frozen readings [s]', (
        f'{sum(each.end - each.start for each in live.detector.missing):.1f}')
    yield 'temperature [°C]', (_number(warm) if math.isfinite(warm)
                               else f'not known: {thermometer_words(state)}')
    for column in context_topics(state.settings):
        unit = column_of(column).unit
        if column != 'temperature':
            yield f'{column} [{unit}]' if unit else column, _number(
                state.around.values.get(column, math.nan))


def _vector(values: Iterable[float]) -> str:
    return ', '.join(f'{value:.4g}' for value in values)


def _number(value: float) -> str:
    return f'{value:.3f}' if math.isfinite(value) else 'not known'
