# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Guidance for the person who turns the sensor: the next step.

`next_action` is the one answer to what comes next. The log, ``~/progress``, the diagnostics, the
answers of the services and the pages all show it.

"""

from dataclasses import replace

from .core import State
from .faults import slow_turn, stream_faults
from .pose_guide import Action, calling, NOT_KNOWN
from .sensor import Sensor
from ..compare import status
from ..pipeline import FEWEST_IN_CONE, is_partial

_LEVEL = Action('level', 'place the robot level, hold it still and call ~/set_level; a sensor '
                'alone is done', 'set_level')

_NEEDS_SAMPLES = ('poses', 'level', 'done', NOT_KNOWN.kind)
"""Kinds of steps that need samples; the others use the poses so far."""

_FAULTS = {'connect': ('mismatches', 'no_publisher', 'silence', 'publishers', 'stamps'),
           'unit': ('unit',)}
"""Faults of the stream that come before all else, by kind of step."""


def next_action(session: State) -> Action:
    """Return the next step; `NOT_KNOWN` while the poses or the rating are being computed."""
    action = _with_sensor(session.sensor)
    if action.kind not in _NEEDS_SAMPLES:
        return action
    if session.ended:  # nothing can be levelled any more
        return Action('done', 'use the calibration') if action.kind == 'level' else action
    faults = stream_faults(session)
    for kind, names in _FAULTS.items():
        words = '; '.join(faults[name] for name in names if name in faults)
        if words:
            return Action(kind, words)
    if action.kind != 'poses':
        return action
    action, held = _within_reach(session, action), slow_turn(session)
    return replace(action, words=f'{held}; {action.words}') if held else action


def next_words(session: State) -> str:
    """Return the next step as the end of an answer."""
    action = next_action(session)
    return '' if action is NOT_KNOWN else f'; next: {action.words}'


def _within_reach(session: State, action: Action) -> Action:
    """Return a step that a robot which cannot be turned further can do, too."""
    sensor, guide, present = session.sensor, session.sensor.guide, session.sensor.present
    if not guide.is_stuck(session.statistics.stamp) or sensor.has_changed:
        return action
    if present is None and not guide.refused_advice and guide.poses >= FEWEST_IN_CONE:
        return Action('poses', f'{action.words}; if it cannot be turned further, call ~/fit',
                      'fit')
    if present is None:
        return Action('poses', f'{action.words}; if it cannot be turned over, place the robot '
                      'level, hold it still and call ~/calibrate_at_rest', 'calibrate_at_rest')
    if not is_partial(present):
        return action
    return (Action('done', f'use the calibration in these orientations; for others: '
                   f'{action.words}') if present.is_levelled else _LEVEL)


def _with_sensor(sensor: Sensor) -> Action:
    """Return the next step with the poses and calibrations of a sensor."""
    rating = sensor.rating
    if sensor.offered is not None:
        verdict = '' if rating is None else f', {rating.name}: {rating.reason}'
        return Action('accept', f'a new calibration waits{verdict}; call ~/save to use and store '
                      'it, or ~/undo to discard it', 'save')
    if sensor.unsaved:
        return calling('save', 'the calibration in use is not stored')
    if sensor.drift is not None and sensor.has_changed:
        return Action('poses', status(sensor.drift), sensor.drift.remedy[1])
    if sensor.calibration is not None and rating is None:
        return NOT_KNOWN
    if rating is not None and rating.name == 'GOOD':
        if sensor.calibration is not None and not sensor.calibration.is_levelled:
            return _LEVEL
        return Action('done', rating.next.text if rating.next.kind == 'done' else
                      'use the calibration')
    if rating is not None and rating.findings and rating.findings[0].kind == 'flat_pose':
        return Action('level', f'{rating.reason}; if it is mounted so, place it level again and '
                      'call ~/set_level once more', 'set_level')
    if sensor.guide.refused_advice:
        return Action('poses', sensor.guide.refused_advice)
    is_fitted = 0 < sensor.guide.poses == sensor.fitted_poses  # to all poses
    if rating is None or not is_fitted or sensor.guide.planned is not None:
        return sensor.guide.action
    return calling(rating.next.kind, rating.next.text)
