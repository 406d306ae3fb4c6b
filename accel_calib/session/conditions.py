# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What is the case with a session, and the next step.

`conditions` is the one list, in the order in which to act. Its first entry is the next step, which
the log, ``~/progress``, the answers of the services and the pages show. The diagnostics show all
of it. What is over is in no entry.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
import math

from .core import State
from .pose_guide import Guide, NOT_FOLLOWED
from .settings import context_topics
from .stream import SILENT, StreamStatistics
from ..comparison import status
from ..findings import outside_words, request_words, USES_LIMIT
from ..pipeline import FEWEST_IN_CONE, is_partial
from ..table import column_of, CONTEXT, is_quantity
from ..text import counted
from ..units import MG, Units


class Level(IntEnum):
    """Severity, as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Condition:
    """
    What is the case, and what to do about it.

    Parameters
    ----------
    kind : str
        Kind of the step, one of `accel_calib.finding.STEPS`; empty: not known yet.
    words : str
        What is the case and what to do.
    command : str
        Name of the service for it; may be empty.
    direction : tuple of float
        Direction to point up, a unit vector in the sensor axes; empty: none.
    level : Level
        Severity.
    concern : str
        The check of the diagnostics that it belongs to.
    name : str
        Name among all that can be wrong, for the log; empty: an ordinary step.

    """

    kind: str
    words: str
    command: str = ''
    direction: tuple[float, ...] = ()
    level: Level = Level.OK
    concern: str = 'calibration'
    name: str = ''


_SERVICES = {'fit': 'fit', 'refine': 'refine', 'level': 'set_level', 'save': 'save'}
"""Service for each kind of step that has one."""


def calling(kind: str, text: str) -> Condition:
    """Return a step with the call of its service."""
    command = _SERVICES.get(kind, '')
    return Condition(kind, f'{text}; call ~/{command}' if command else text, command)


_LEVEL = Condition('level', 'place the robot level, hold it still and call ~/set_level; a sensor '
                   'alone is done', 'set_level')

_FAR = 0.25
"""Part of the range of a calibration beyond which poses are asked for."""

_NEEDS_SAMPLES = ('poses', 'level', 'done', '')
"""Kinds of steps that need samples; the others use the poses so far."""


def conditions(state: State) -> list[Condition]:
    """Return what is the case and what to do about it; the next step is the first entry."""
    step, files, of_use = _ordinary(state), list(_files(state)), list(_use(state))
    blocks = bool(state.files.problem) or state.is_refused
    first, files = (files[:1], files[1:]) if blocks else ([], files)
    ended = state.surroundings.ended
    around = [] if ended else [*_stream(state), *_context(state)]
    if step.kind == 'level' and ended:  # nothing can be levelled any more
        step = replace(step, kind='done', words='use the calibration', command='')
    if step.kind not in _NEEDS_SAMPLES:
        found = [step, *files, *around, *of_use]
    elif step.kind == 'done':
        to_do = [each for each in of_use if each.kind != 'done']
        found = [*files, *around, *to_do, step, *(each for each in of_use if each not in to_do)]
    else:  # whoever turns the sensor is told of the files, and goes on
        told = '; '.join(filter(None, [*(each.words for each in files), step.words]))
        level = max([step.level, *(each.level for each in files)])
        found = [*around, replace(step, words=told, level=level), *files, *of_use]
    if axes := state.sensor.guide.axes_words:
        found.append(Condition('poses', axes, level=Level.WARN, concern='stream', name='axes'))
    return [*first, *found]


def next_action(state: State) -> Condition:
    """Return the next step; without a kind while the poses or the rating are being computed."""
    return conditions(state)[0]


def next_words(state: State) -> str:
    """Return the next step as the end of an answer."""
    action = next_action(state)
    return f'; next: {action.words}' if action.words else ''


# ----------------------------------------------------------------------------- poses and fits

def _ordinary(state: State) -> Condition:
    """Return the next step of a calibration of which nothing is in the way."""
    step = _with_sensor(state)
    refusal = state.refusal_of(step.command)
    if refusal and step.kind != 'poses':
        step = replace(step, words=refusal, command='')
    if step.kind == 'poses' and step.level == Level.OK:
        step = _within_reach(state, step)
        held = slow_turn(state)
        step = replace(step, words=f'{held}; {step.words}') if held else step
    if state.sensor.calibration is None:
        step = replace(step, level=max(step.level, Level.WARN))
    return step


def _with_sensor(state: State) -> Condition:
    """Return the next step with the poses and calibrations of the sensor."""
    sensor, rating = state.sensor, state.sensor.rating
    if sensor.offered is not None:
        verdict = '' if rating is None else f', {rating.name}: {rating.reason}'
        return Condition('accept', f'a new calibration waits{verdict}; call ~/save to use and '
                         'store it, or ~/undo to discard it', 'save')
    if sensor.unsaved:
        return replace(calling('save', 'the calibration in use is not stored'),
                       level=Level.ERROR, concern='storage', name='unsaved')
    if sensor.drift is not None and sensor.has_changed:
        return Condition('poses', status(sensor.drift), sensor.drift.remedy[1],
                         level=Level.WARN, concern='drift')
    if sensor.calibration is not None and rating is None:
        return Condition('', '')
    if rating is not None and rating.name == 'GOOD':
        if sensor.calibration is not None and not sensor.calibration.is_levelled:
            return _LEVEL
        return Condition('done', rating.next.text if rating.next.kind == 'done' else
                         'use the calibration')
    return _with_poses(state)


def _with_poses(state: State) -> Condition:
    """Return the next step without a calibration that is good."""
    sensor, rating, guide = state.sensor, state.sensor.rating, state.sensor.guide
    if rating is not None and rating.findings and rating.findings[0].kind == 'flat_pose':
        return Condition('level', f'{rating.reason}; if it is mounted so, place it level again '
                         'and call ~/set_level once more', 'set_level')
    if refusal := state.refusal_of('poses'):
        return Condition('poses', refusal)
    asked, is_fitted = step_of(guide), 0 < guide.poses == sensor.fitted_poses  # to all poses
    if rating is None or not is_fitted or guide.planned is not None:
        return asked
    if rating.next.kind == 'poses' and asked.direction:
        return replace(asked, words=f'{rating.reason}; {asked.words}')
    return calling(rating.next.kind, rating.next.text)


def step_of(guide: Guide) -> Condition:
    """Return what to do next with the poses; without a kind before the first choice."""
    plan = guide.plan
    if guide.planned == ():
        return calling('refine', 'all poses of the plan are taken')
    if plan is None:
        return Condition('', '')
    words = request_words(plan.asked)
    if plan.asked.direction is None:
        return calling('fit', words)
    command = ''
    if plan.asked.fits:
        words, command = f'{words}, or call ~/fit', 'fit'
    return Condition('poses', words, command, tuple(plan.asked.direction.tolist()))


def _within_reach(state: State, step: Condition) -> Condition:
    """Return a step that a robot which cannot be turned further can do, too."""
    guide, present = state.sensor.guide, state.sensor.present
    is_refused = bool(state.refusal_of('poses'))
    if not (is_refused or guide.is_stuck(state.statistics.stamp)):
        return step
    if present is None and not is_refused and guide.poses >= FEWEST_IN_CONE and not (
            state.refusal_of('fit')):
        return replace(step, words=f'{step.words}; if it cannot be turned further, call ~/fit',
                       command='fit')
    if present is None and not state.refusal_of('calibrate_at_rest'):
        return replace(step, words=f'{step.words}; if it cannot be turned over, place the robot '
                       'level, hold it still and call ~/calibrate_at_rest',
                       command='calibrate_at_rest')
    if present is None or not (is_partial(present) or guide.missed >= NOT_FOLLOWED):
        return step
    return (Condition('done', f'use the calibration in these orientations; for others: '
                      f'{step.words}') if present.is_levelled else _LEVEL)


def slow_turn(state: State) -> str:
    """Return that the sensor turns slowly, and what to do; empty if it is still or shaken."""
    statistics, live = state.statistics, state.sensor.live
    if live.still or state.units.is_native or statistics.age > SILENT:
        return ''
    rate = statistics.turn_rate(live.detector.threshold, state.units.per_g)
    return f'turning slowly, {rate:.1f} °/s: rest it on something' if rate else ''


# ----------------------------------------------------------------------------- files and use

def _files(state: State) -> Iterator[Condition]:
    """Yield what is wrong with the files."""
    if state.problem:
        yield Condition('restart', state.problem, level=Level.ERROR)
    store = state.files.store
    if store is not None and not store.is_writable():
        yield Condition(
            'save', f'{state.files.path} cannot be written: correct the permissions, or restart '
            'the node with another calibration_file', level=Level.ERROR, concern='storage')


def _use(state: State) -> Iterator[Condition]:
    """Yield what is wrong with the use of the calibration."""
    if not state.enabled:
        yield Condition('enable', 'correction switched off, raw messages are published: call '
                        '~/enable with true to correct them', level=Level.WARN)
    for key, each in state.sensor.limits_left(state.context).items():
        beyond = max(each.low - each.least, each.most - each.high)
        kind = 'poses' if beyond > _FAR * (each.high - each.low) else 'done'
        yield Condition(kind, f'{outside_words(each)}: {USES_LIMIT}; capture poses there and call '
                        '~/refine', 'refine', level=Level.WARN, name=f'range of {key}')


# ----------------------------------------------------------------------------- samples

def _context(state: State) -> Iterator[Condition]:
    """Yield the columns of the context that are missing, why, and what follows."""
    calibration, around = state.sensor.calibration, state.around
    needs = () if calibration is None else calibration.model.needs
    wanted = [*context_topics(state.settings), *(
        key for key in needs if key in CONTEXT or is_quantity(key))]
    for column in filter(around.is_missing, dict.fromkeys(wanted)):
        follows = ''
        if column in around.values:
            follows = '; the last value holds'
        elif column in needs:
            value = around.assumed.get(column, math.nan)
            follows = f'; {value:.4g} {column_of(column).unit}'.rstrip() + ' is used instead'
        yield Condition(
            'connect', f'no {column} arrives: {_why_missing(state, column)}{follows}',
            level=Level.WARN, concern='stream', name=column)


def _why_missing(state: State, column: str) -> str:
    around = state.surroundings
    return around.missing.get(column) or (
        'the samples do not have it' if around.publishers is None else
        thermometer_words(state) if column == 'temperature' else
        f"start the node with context:=['{column}:=TOPIC'], and its topic")


def thermometer_words(state: State) -> str:
    """Return how the node would get a temperature."""
    around = state.surroundings
    topics = ' or '.join(around.thermometers)
    return around.missing.get('temperature') or (
        f'restart the node with temperature:={topics}' if topics else
        'publish the temperature of the sensor on the topic temperature')


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


def _stream(state: State) -> Iterator[Condition]:
    """Yield what is wrong with the messages, and what to do."""
    statistics, around = state.statistics, state.surroundings
    names = around.publishers or ()
    told = {'mismatches': '; '.join(around.mismatches),
            'silence' if names else 'no_publisher': _silence(state)}
    if len(names) > 1:
        told['publishers'] = (
            f'{"two" if len(names) == 2 else len(names)} publishers on the topic {state.topic}: '
            f'{", ".join(names)}; expected one sensor: stop the others, or give each sensor its '
            'own topic; a driver that was killed disappears after about 20 s')
    told['stamps'] = statistics.stamp_fault
    told['unit'] = _wrong_unit(statistics, state.units)
    if statistics.dropped_ago < _LASTS:
        told |= {kind: f'dropped {counted(statistics.dropped[kind], what)} {why}'
                 for kind, (what, why) in _DROPPED.items() if statistics.dropped[kind]}
    told['vibration'] = '' if told['unit'] else _vibration(state)
    kinds = {'unit': 'unit', 'vibration': 'still'}
    for name, words in told.items():
        if words:
            yield Condition(kinds.get(name, 'connect'), words, level=Level.WARN,
                            concern='stream', name=name)


def _silence(state: State) -> str:
    topic, around = state.topic, state.surroundings
    publishers = around.publishers
    if around.mismatches or (
            min(state.statistics.age, state.statistics.dropped_ago) <= SILENT):
        return ''
    if publishers is None:
        return (f'{topic} sends no samples: check the board, its cable and its program; the poses '
                'are kept')
    if publishers:
        return (f'no Imu messages on {topic}, although {publishers[0]} publishes there: check '
                'the driver')
    there = f', such as {" or ".join(around.imus)}' if around.imus else ''
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


def _vibration(state: State) -> str:
    """Return that the sensor stays in one direction without a rest, and which limit takes it."""
    live, statistics, units = state.sensor.live, state.statistics, state.units
    limit, spread = live.detector.threshold, statistics.shaken(state.units.per_g)
    if not math.isfinite(limit) or spread <= limit or live.still or units.is_native:
        return ''
    return (f'no rest: the readings vary by {spread / units.per_g * MG:.1f} mg, a rest by at most '
            f'{limit / units.per_g * MG:.1f} mg: rest the sensor on something and stop what '
            f'vibrates; if it always does, restart the node with still_std_max:='
            f'{1.5 * spread / units.per_g * state.settings.gravity:.2g}')
