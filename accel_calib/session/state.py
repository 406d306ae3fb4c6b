# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of a session, as its topics and pages show it.

``~/progress`` has the progress of the calibration, ``~/self_test`` one check for each concern, and
``/diagnostics`` the checks and all figures.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, MISSING
import math
from typing import Any, NamedTuple

import numpy as np

from .conditions import CONCERNS, conditions, next_step, thermometer_words
from .core import State
from .sensor import title
from .stream import SILENT
from ..comparison import status
from ..errors import InputError
from ..finding import has, Level, LEVELS
from ..logs import named_topics
from ..messages import Triple
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


def progress(state: State, reading: Triple | None = None) -> Progress:
    """Return the progress; `reading` is the newest one, by default the last that was pushed."""
    sensor, statistics = state.sensor, state.statistics
    plan, silent, native = sensor.guide.plan, statistics.age > SILENT, state.units.is_native
    step, rating = next_step(state), sensor.rating
    if reading is None and statistics.newest is not None:
        reading = tuple(statistics.newest.tolist())
    up: tuple[float, ...] = ()
    length = corrected = math.nan
    if reading is not None and not silent:
        along, force = np.array(reading), sensor.force_of(reading, state.context)
        corrected = math.nan if force is None else math.hypot(*force)
        if native and sensor.present is not None and force is not None:
            along = sensor.present.rotation @ force
        elif native:  # the direction is known only with the zero
            along = along - plan.zero if plan is not None and plan.zero else along * math.nan
        size = math.hypot(*along)
        up = tuple((along / size).tolist()) if 0.0 < size < math.inf else ()
        length = math.nan if native else size / state.units.per_g
    # NaN if it is not known, or not the noise alone.
    noisy = rating is not None and has(rating.findings, 'beyond_noise')
    return Progress(
        still=state.still and not silent,
        stillness=math.nan if silent else statistics.spread / sensor.live.detector.threshold,
        dwell=statistics.stamp - state.still_since if state.still else 0.0,
        min_dwell=state.settings.min_dwell, poses=sensor.guide.poses,
        total=0 if plan is None else plan.asked.total,
        coverage=0.0 if plan is None else plan.coverage,
        accuracy=math.nan if plan is None or noisy else plan.asked.error * plan.noise_g,
        step=step.kind, advice=step.text, command=step.command, direction=step.direction,
        up=up, length=length, corrected=corrected, temperature=state.around.temperature)


class Check(NamedTuple):
    """The result of a check: what is right or wrong, and its level as of a finding."""

    concern: str
    words: str
    level: Level


def diagnostics(state: State) -> list[Check]:
    """Return first the state, with the most severe finding, and then a check for each concern."""
    sensor, drift, found, all_found = state.sensor, state.sensor.drift, [], conditions(state)
    fine = {'stream': f'{state.statistics.rate:.1f} Hz on {state.topic}',
            'calibration': '' if sensor.calibration is None else title(sensor.calibration),
            'drift': 'no calibration yet' if drift is None else status(drift),
            'storage': state.files.path}
    if sensor.calibration is None and sensor.offered is None:
        count = counted(len(sensor.live.poses()), 'pose')
        fine['calibration'] = f'no calibration yet, captured {count}'
    for concern, words in fine.items():
        wrong = [each for each in all_found if each.level != 'GOOD'
                 and CONCERNS.get(each.kind, 'stream') == concern]
        said = list(dict.fromkeys(each.text for each in wrong))
        if all(each.kind in ('step', 'switched_off') and each.level != 'BAD' for each in wrong):
            said[:1] = [': '.join(filter(None, [words, *said[:1]]))]
        level = max((each.level for each in wrong), key=LEVELS.index, default=LEVELS[0])
        found.append(Check(concern, '; '.join(said), level))
    worst = max(all_found, key=lambda each: LEVELS.index(each.level))
    concern = CONCERNS.get(worst.kind, 'stream')
    words = words_of_state(state) if worst.level == 'GOOD' else next(
        each.words for each in found if each.concern == concern)
    return [Check('state', words, worst.level), *found]


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
    poses, breaks = live.poses(), live.detector.interruptions
    yield 'poses captured', str(len(poses))
    yield 'poses doubtful', str(int(np.sum(poses['doubtful'])) if 'doubtful' in poses else 0)
    yield 'next', next_step(state).text or 'turn the sensor'
    yield 'interruptions of the clock', str(len(breaks))
    yield 'last interruption', (
        f'{breaks[-1].kind}, {breaks[-1].seconds:.2f} s' if breaks else 'none')
    yield 'zeros or frozen readings [s]', (
        f'{sum(each.end - each.start for each in live.detector.missing):.1f}')
    yield 'temperature [°C]', (_number(warm) if math.isfinite(warm)
                               else f'not known: {thermometer_words(state)}')
    for column in named_topics(state.settings.context):
        unit = column_of(column).unit
        if column != 'temperature':
            yield f'{column} [{unit}]' if unit else column, _number(
                state.around.values.get(column, math.nan))
    yield 'still below [m/s² or native]', f'{live.detector.threshold:.4g}'
    yield 'mounting', state.mounting_words(sensor.calibration) or 'not known'
    gyro, noise = sensor.gyro, sensor.noise
    if gyro is not None:
        yield 'gyro bias [rad/s]', _vector(gyro.at(warm))
        yield 'gyro bias, standard deviation [rad/s]', _vector(gyro.sd)
    if noise is not None:
        yield 'noise of acceleration [m/s² or native]', _vector(noise.force)
        yield 'noise of angular velocity [rad/s]', _vector(noise.rate)


def _vector(values: Iterable[float]) -> str:
    return ', '.join(f'{value:.4g}' for value in values)


def _number(value: float) -> str:
    return f'{value:.3f}' if math.isfinite(value) else 'not known'
