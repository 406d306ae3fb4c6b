# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What is the case with a session, the next step, and how topics and pages show them.

`conditions` is the one list, in the order in which to act: everything that is wrong, and the next
step of a calibration (kind ``step``). The step of its first entry is the next one, which the log,
``~/progress``, the answers of the services and the pages show. The diagnostics show all of it.
What is over is in no entry.

``~/progress`` has the progress of the calibration, ``~/self_test`` one check for each concern, and
``/diagnostics`` the checks and all figures.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, MISSING, replace
import math
from typing import Any, NamedTuple

import numpy as np

from .poses import Guide
from .state import State, title
from .store import ANOTHER_FILE
from .stream import SILENT
from ..comparison import status
from ..errors import InputError
from ..finding import Finding, has, Level, LEVELS, NextStep
from ..findings import outside_words, request_words, USES_LIMIT
from ..logs import named_topics
from ..messages import Triple
from ..pipeline import FEWEST_IN_CONE, is_partial
from ..table import column_of, CONTEXT, is_quantity
from ..text import counted
from ..units import MG

CONCERNS = {'step': 'calibration', 'unusable': 'calibration', 'switched_off': 'calibration',
            'outside': 'calibration', 'changed': 'drift', 'read_only': 'storage',
            'unsaved': 'storage'}
"""The check of the diagnostics by kind of finding; the others are of the stream."""

APART = ('step', 'unusable', 'switched_off', 'changed', 'read_only')
"""Kinds of findings that are logged when they begin, and not with the others."""

_SERVICES = {'fit': 'fit', 'refine': 'refine', 'level': 'set_level', 'save': 'save'}
"""Service for each kind of step that has one."""


def _step(kind: str, text: str, command: str = '', **about: Any) -> Finding:
    """Return a step of a calibration."""
    return Finding('step', text, step=kind, command=command, **about)


def _calling(kind: str, text: str) -> Finding:
    """Return a step with the call of its service."""
    command = _SERVICES.get(kind, '')
    return _step(kind, f'{text}; call ~/{command}' if command else text, command)


_LEVEL = _step('level', 'place the robot level, hold it still and call ~/set_level; a sensor '
               'alone is done', 'set_level')

_FAR = 0.25
"""Part of the range of a calibration beyond which poses are asked for."""

_WITHOUT_NEW = 30.0
"""Time without a new pose after which the robot probably cannot be turned further [s]."""

_NOT_FOLLOWED = 3
"""Number of requests in a row that are not followed, with the same meaning."""

_NEEDS_SAMPLES = ('poses', 'level', 'done', '')
"""Kinds of steps that need samples; the others use the poses so far."""


def conditions(state: State) -> list[Finding]:
    """Return what is the case and what to do about it; the next step is that of the first one."""
    step, files, of_use = _feasible_step(state), [], list(_check_use(state))
    if state.problem:
        files.append(Finding('unusable', state.problem, level='BAD'))
    store = state.files.store
    if store is not None and not store.is_writable():
        files.append(Finding(
            'read_only', f'{state.files.path} cannot be written: correct the permissions, or '
            f'{ANOTHER_FILE}', level='BAD'))
    elif state.not_stored:
        files.append(Finding('unsaved', state.not_stored, level='BAD'))
    blocks = bool(state.files.problem) or state.is_refused
    first, files = (files[:1], files[1:]) if blocks else ([], files)
    ended = state.surroundings.ended
    around = [] if ended else [*_check_stream(state), *_check_context(state)]
    if step.step == 'level' and ended:  # nothing can be levelled any more
        step = replace(step, step='done', text='use the calibration', command='')
    elif step.step == 'poses' and ended:  # nor turned
        step = _calling('fit', 'no more poses can come') if step.command == 'fit' else replace(
            step, text=f'in another recording, {step.text}', direction=())
    if step.step not in _NEEDS_SAMPLES:
        found = [step, *files, *around, *of_use]
    elif step.step == 'done':
        to_do = [each for each in of_use if each.step != 'done']
        found = [*files, *around, *to_do, step, *(each for each in of_use if each not in to_do)]
    else:  # whoever turns the sensor is told of the files, and goes on
        told = '; '.join(filter(None, [*(each.text for each in files), step.text]))
        level = 'BAD' if files else step.level
        found = [*around, replace(step, text=told, level=level), *files, *of_use]
    if axes := state.sensor.guide.axes_words:
        found.append(Finding('axes', axes, level='USABLE'))
    return [*first, *found]


def next_step(state: State) -> NextStep:
    """Return the next step; without a kind while the poses or the rating are being computed."""
    return conditions(state)[0].next


def next_words(state: State) -> str:
    """Return the next step as the end of an answer."""
    step = next_step(state)
    return f'; next: {step.text}' if step.text else ''


# ----------------------------------------------------------------------------- poses and fits

def _feasible_step(state: State) -> Finding:
    """Return the next step of a calibration; also for a robot that cannot be turned further."""
    step, guide, present = _ordinary_step(state), state.sensor.guide, state.sensor.present
    refusal, is_refused = state.refusal_of(step.command), bool(state.refusal_of('poses'))
    if refusal and step.step != 'poses':
        step = replace(step, text=refusal, command='')
    if step.step == 'poses' and step.kind == 'step':
        is_missed = guide.missed >= _NOT_FOLLOWED
        is_stuck = (is_refused or is_missed
                    or state.statistics.stamp - guide.new_at >= _WITHOUT_NEW)
        can_fit = step.command == 'fit' and not refusal
        if is_stuck and present is not None and not can_fit and (
                is_partial(present) or is_missed):
            step = _LEVEL if not present.is_levelled else _step(
                'done', f'use the calibration in these orientations; for others: {step.text}')
        elif is_stuck and present is None and not is_refused and (
                guide.poses >= FEWEST_IN_CONE and not state.refusal_of('fit')):
            step = step if can_fit else replace(
                step, text=f'{step.text}; if it cannot be turned further, call ~/fit',
                command='fit')
        elif is_stuck and present is None and not state.refusal_of('calibrate_at_rest'):
            step = replace(step, text=f'{step.text}; if it cannot be turned over, place the robot '
                           'level, hold it still and call ~/calibrate_at_rest',
                           command='calibrate_at_rest')
        if turning := slow_turn(state):
            step = replace(step, text=f'{turning}; {step.text}')
    missing = state.sensor.calibration is None and step.level == 'GOOD'
    return replace(step, level='USABLE') if missing else step


def _ordinary_step(state: State) -> Finding:
    """Return the next step with the poses and calibrations of the sensor."""
    sensor, rating, guide = state.sensor, state.sensor.rating, state.sensor.guide
    if sensor.offered is not None:
        verdict = '' if rating is None else f', {rating.name}: {rating.reason}'
        return _step('accept', f'a new calibration waits{verdict}; call ~/save to use and '
                     'store it, or ~/undo to discard it', 'save')
    if sensor.unsaved:
        return Finding('unsaved', 'the calibration in use is not stored; call ~/save',
                       level='BAD', step='save', command='save')
    if sensor.drift is not None and sensor.has_changed:
        return Finding('changed', status(sensor.drift), level='USABLE', step='poses',
                       command=sensor.drift.remedy[1])
    is_new = guide.count != guide.poses  # the next pose is chosen after the computation
    if (sensor.calibration is not None and rating is None) or (state.computing and is_new):
        return _step('', '')
    if rating is not None and rating.name == 'GOOD':
        is_done = sensor.calibration is None or sensor.calibration.is_levelled
        return _LEVEL if not is_done else _step(
            'done', rating.next.text if rating.next.kind == 'done' else 'use the calibration')
    if rating is not None and rating.findings and rating.findings[0].kind == 'flat_pose':
        return _step('level', f'{rating.reason}; if it is mounted so, place it level again '
                     'and call ~/set_level once more', 'set_level')
    is_fitted, refusal = 0 < guide.count == sensor.fitted_poses, state.refusal_of('poses')
    asked = step_of(guide, may_fit=not is_fitted and not refusal)  # a fit would give the same
    if refusal:
        text = f'{refusal}; {asked.text}' if asked.direction else refusal
        return _step('poses', text, direction=asked.direction)
    if rating is None or not is_fitted or guide.planned is not None:
        return asked
    if rating.next.kind == 'poses' and asked.direction:
        return replace(asked, text=f'{rating.reason}; {asked.text}')
    return _calling(rating.next.kind, rating.next.text)


def step_of(guide: Guide, *, may_fit: bool = True) -> Finding:
    """Return what to do next with the poses; without a kind before the first choice."""
    plan = guide.plan
    if guide.planned == ():
        return _calling('refine', 'all poses of the plan are taken')
    if plan is None:
        return _step('', '')
    asked = plan.asked
    words = request_words(asked)
    if asked.direction is None:
        return _calling('fit', words)
    fits = asked.fits and may_fit
    return _step('poses', f'{words}, or call ~/fit' if fits else words, 'fit' if fits else '',
                 direction=tuple(asked.direction.tolist()))


def slow_turn(state: State) -> str:
    """Return that the sensor turns slowly, and what to do; empty if it is still or shaken."""
    statistics, live = state.statistics, state.sensor.live
    if live.still or state.units.is_native or statistics.age > SILENT:
        return ''
    rate = statistics.turn_rate(live.detector.threshold, state.units.per_g)
    return f'turning slowly, {rate:.1f} °/s: rest it on something' if rate else ''


def _check_use(state: State) -> Iterator[Finding]:
    """Yield what is wrong with the use of the calibration."""
    if not state.enabled:
        yield Finding('switched_off', 'correction switched off, raw messages are published: call '
                      '~/enable with true to correct them', level='USABLE', step='enable')
    for key, each in state.sensor.limits_left(state.context).items():
        beyond = max(each.low - each.least, each.most - each.high)
        step = 'poses' if beyond > _FAR * (each.high - each.low) else 'done'
        yield Finding('outside', f'{outside_words(each)}: {USES_LIMIT}; capture poses there and '
                      'call ~/refine', level='USABLE', step=step, about=key, command='refine')


# ----------------------------------------------------------------------------- samples

def _check_context(state: State) -> Iterator[Finding]:
    """Yield the columns of the context that are missing, why, and what follows."""
    calibration, around = state.sensor.calibration, state.around
    needs = () if calibration is None else calibration.model.needs
    wanted = [*named_topics(state.settings.context), *(
        key for key in needs if key in CONTEXT or is_quantity(key))]
    for column in filter(around.is_missing, dict.fromkeys(wanted)):
        follows, why = '', way_of(column, state)
        if column in around.values:
            follows = '; the last value holds'
        elif column in needs:
            value = around.assumed.get(column, math.nan)
            follows = f'; {value:.4g} {column_of(column).unit}'.rstrip() + ' is used instead'
        yield Finding('no_value', f'no {column} arrives: {why}{follows}', level='USABLE',
                      about=column)


def way_of(column: str, state: State) -> str:
    """Return how a column of the context would arrive, or why it does not."""
    around = state.surroundings
    if around.publishers is None:
        return f'the samples have no {column}'
    if column != 'temperature' or column in around.missing:
        return around.missing.get(
            column, f"start the node with context:=['{column}:=TOPIC'], and its topic")
    topics = ' or '.join(around.thermometers)
    return (f'restart the node with temperature:={topics}' if topics else
            'publish the temperature of the sensor on the topic temperature')


def _restart(state: State, parameter: str, value: str) -> str:
    """Return how to start again with a parameter: of the node, or as an option."""
    if state.surroundings.publishers is None:
        return f'start again with --{parameter.replace("_", "-")} {value}'
    return f'restart the node with {parameter}:={value}'


_LASTS = 5.0
"""Time after which a dropped message is over [s]."""

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


def _check_stream(state: State) -> list[Finding]:
    """Return what is wrong with the messages, and what to do."""
    topic, statistics, around = state.topic, state.statistics, state.surroundings
    units, live, names = state.units, state.sensor.live, around.publishers
    found = {'mismatches': '; '.join(around.mismatches)}
    if not around.mismatches and min(statistics.age, statistics.dropped_ago) > SILENT:
        there = f', such as {" or ".join(around.imus)}' if around.imus else ''
        found['silence' if names else 'no_publisher'] = (
            f'{topic} sends no samples: check the board, its cable and its program; the poses are '
            'kept' if names is None else
            f'no Imu messages on {topic}, although {names[0]} publishes there: check the driver'
            if names else
            f'no Imu messages on {topic}, and no publisher: start the driver, or remap '
            f'imu/data_raw to its topic{there}')
    if names and len(names) > 1:
        found['publishers'] = (
            f'{"two" if len(names) == 2 else len(names)} publishers on the topic {topic}: '
            f'{", ".join(names)}; expected one sensor: stop the others, or give each sensor its '
            'own topic; a driver that was killed disappears after about 20 s')
    found['stamps'] = statistics.stamp_fault
    size = statistics.length
    length = math.nan if units.is_native else size / units.per_g
    is_wrong = length < _LIKELY_G[0] or length > _LIKELY_G[1]  # not if it is NaN
    if is_wrong:
        likely = next((name for name, low, high in _UNITS if low < size < high), '')
        found['unit'] = f'|a| is {length:.3g} g, expected about 1 g at rest: ' + (
            'this is linear acceleration, gravity removed: let the driver publish what the '
            'accelerometer reads' if length < _WITHOUT_GRAVITY_G else
            'its rests were about 1 g before: correct the range or the unit of the driver'
            if not likely and (state.sensor.present or state.sensor.guide.count) else
            _restart(state, 'units', likely or 'native'))
    if statistics.dropped_ago < _LASTS:
        found |= {kind: f'dropped {counted(statistics.dropped[kind], what)} {why}'
                  for kind, (what, why) in _DROPPED.items() if statistics.dropped[kind]
                  and not (is_wrong and kind == 'implausible')}  # it is not the calibration
    limit, spread = live.detector.threshold, statistics.shaken(units.per_g)
    if math.isfinite(limit) and spread > limit and not (
            is_wrong or live.still or units.is_native):  # stays in one direction, but no rest
        per_g = units.per_g if names is None else state.settings.gravity  # of the option
        found['vibration'] = (
            f'no rest: the readings vary by {spread / units.per_g * MG:.1f} mg, a rest by at most '
            f'{limit / units.per_g * MG:.1f} mg: rest the sensor on something and stop what '
            'vibrates; if it always does, '
            + _restart(state, 'still_std_max', f'{1.5 * spread / units.per_g * per_g:.2g}'))
    return [Finding(kind, text, level='USABLE') for kind, text in found.items() if text]


# ----------------------------------------------------------------------------- what is shown

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
        min_dwell=state.settings.min_dwell,
        poses=sensor.guide.count if state.computing else sensor.guide.poses,
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
    if drift is not None and not drift.count and (lacking := [
            each.about for each in all_found if each.kind == 'no_value']):
        fine['drift'] = f'not compared: the rests have no {" and no ".join(lacking)}'
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
    silent = '' if state.surroundings.publishers is None else ', nothing is published'
    return next(words for holds, words in (
        (state.files.problem, f'another node uses the files{silent}'),
        (not state.is_active, 'not activated, nothing is published'),
        (not state.enabled, 'correction switched off, raw messages are published'),
        (state.sensor.offered is not None, 'a new calibration waits for ~/save or ~/undo'),
        (calibration is not None and not calibration.model.effects,
         'correcting the mounting alone, offset and gain are not calibrated'),
        (calibration is not None and is_partial(calibration) and not calibration.form.effects,
         'correcting the offset over temperature alone'),
        (calibration is not None and is_partial(calibration),
         'correcting, with a calibration of a part of the orientations'),
        (calibration is not None, 'correcting'),
        (not state.statistics.messages, 'waiting for the first message'),
        (state.settings.passthrough, 'no calibration, raw messages are published'),
        (True, f'no calibration{silent}')) if holds)


def figures(state: State) -> Iterator[tuple[str, str]]:
    """Yield names and values for the diagnostics."""
    sensor, counts, warm = state.sensor, state.statistics, state.around.temperature
    gravity, rest, drift, live = state.gravity, sensor.rest, sensor.drift, sensor.live
    yield 'state', words_of_state(state)
    yield 'sensor', state.name
    yield 'calibration', 'none' if sensor.calibration is None else title(sensor.calibration)
    rating = None if sensor.offered is not None else sensor.rating  # of that in use
    yield 'rating', 'not known' if rating is None else f'{rating.name}: {rating.reason}'
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
                               else f'not known: {way_of("temperature", state)}')
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
    return ', '.join(f'{value:.4g}' if math.isfinite(value) else 'not known' for value in values)


def _number(value: float) -> str:
    return f'{value:.3f}' if math.isfinite(value) else 'not known'
