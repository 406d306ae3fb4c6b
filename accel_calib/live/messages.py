# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The messages between the live page and its server, as JSON.

A viewer sends ``hello`` first and then ``ask``. The server sends messages with a ``kind``. Numbers
that are not known are null. Lengths of vectors are in g, errors in mg, temperatures in °C, and
times in seconds: of a log line since 1970, otherwise of a steady clock.

"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import json
import math
from typing import Any

import numpy as np

from .. import __version__
from ..calibrate import Calibration
from ..errors import InputError
from ..findings import residual_figures
from ..geometry import words_of
from ..session import checks, Level, Progress, Session, Severity, title, words_of_state
from ..stored.exports import CALIBRATION_ALONE
from ..table import Floats
from ..units import MG

Message = Mapping[str, Any]

OFFERED = ('fit', 'refine', 'set_level', 'set_heading', 'calibrate_at_rest')
"""Commands whose result is offered as a preview."""

COMMANDS = ('capture_pose', 'undo_pose', *OFFERED, 'save', 'undo', 'load', 'reset', 'enable',
            'disable')
"""Commands of the page."""

LARGEST = 4096
"""Largest message of a viewer [bytes]."""

PERIOD = 0.05
"""Interval between two messages of progress [s]."""

HISTORY_S = 60.0
"""Time for which a new viewer gets the history [s]."""

_HISTORY = ('time', 'raw', 'corrected', 'temperature')
_DIGITS = 7
_DECIMALS = 6
_NEAR = 0.38
"""Component of a unit vector above which a side points up: about half of that of an edge."""


@dataclass(frozen=True)
class Hello:
    """The first message: the token, and the number of the last log line that the viewer has."""

    token: str
    seen: int


@dataclass(frozen=True)
class Ask:
    """A command, with a number for its answer."""

    id: int  # noqa: A003, the name in the message
    command: str


def request_of(text: str) -> Hello | Ask:
    """
    Return the message of a viewer.

    Raises
    ------
    InputError
        If the text is not such a message.

    """
    wrong = InputError('the message is not understood, expected {"hello": {"token", "seen"}} or '
                       '{"ask": {"id", "command"}}', 'load the page again')
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise wrong from None
    match found:
        case {'hello': {'token': str(token), 'seen': int(seen)}}:
            return Hello(token, seen)
        case {'ask': {'id': int(number), 'command': str(command)}}:
            return Ask(number, command)
    raise wrong


def text_of(message: Message) -> str:
    """Return a message as JSON."""
    return json.dumps(message, ensure_ascii=False, allow_nan=False, separators=(',', ':'))


def welcome(why: str, history: Iterable[Message]) -> Message:
    """
    Return the answer to ``hello``.

    Parameters
    ----------
    why : str
        Why commands are not accepted; empty if they are.
    history : iterable of dict
        Messages of `progress`, the oldest first.

    """
    kept = list(history)
    return {'kind': 'welcome', 'may': not why, 'why': why, 'version': __version__,
            'seconds': HISTORY_S, 'commands': COMMANDS, 'exports': CALIBRATION_ALONE,
            'history': {key: [each[key] for each in kept] for key in _HISTORY}}


def progress(time: float, now: Progress) -> Message:
    """Return the progress of a calibration at a time [s]."""
    return {
        'kind': 'progress', 'time': round(time, 3), 'still': now.still,
        'stillness': _fixed(now.stillness), 'dwell': _fixed(now.dwell),
        'min_dwell': now.min_dwell, 'poses': now.poses, 'total': now.total,
        'coverage': _fixed(now.coverage), 'accuracy_mg': _fixed(now.accuracy * MG),
        'step': now.step, 'advice': now.advice, 'command': now.command,
        'direction': list(now.direction),
        'up': [round(part, _DECIMALS) for part in now.up], 'raw': _fixed(now.length),
        'corrected': _fixed(now.corrected), 'temperature': _fixed(now.temperature)}


def poses(up: Floats) -> Message:
    """Return the poses: (n, 3) directions of up in the sensor axes, unit vectors."""
    return {'kind': 'poses', 'up': _rounded(up),
            'words': [_side_up(direction) for direction in up]}


def log(number: int, severity: Severity, words: str, time: float) -> Message:
    """Return a log line with its number; `time` is that since 1970 [s]."""
    return {'kind': 'log', 'number': number, 'severity': severity, 'words': words,
            'time': round(time, 3)}


def answer(number: int, success: bool, words: str) -> Message:
    """Return the answer to ``ask``."""
    return {'kind': 'answer', 'id': number, 'success': success, 'words': words}


def state(session: Session, problem: str, *, busy: str, page: int) -> Message:
    """
    Return the state of a session.

    Parameters
    ----------
    session : Session
        The session; the calibration that is offered, or otherwise the one in use, is shown.
    problem : str
        What the user must know before all else; empty: the most severe finding.
    busy : str
        Name of the command that runs; may be empty.
    page : int
        Number of the calibration page.

    """
    sensor = session.sensor
    in_use, shown, rating = sensor.calibration, sensor.present, sensor.rating
    return {
        'kind': 'state', 'sensor': session.name, 'source': session.topic,
        'state': words_of_state(session), 'problem': problem or _problem(session),
        'calibration': '' if in_use is None else title(in_use),
        'preview': sensor.offered is not None,
        'levelled': shown is not None and shown.is_levelled,
        'file': session.files.path, 'busy': busy,
        'counts_per_g': None if shown is None else _counts_per_g(shown),
        'rating': None if shown is None or rating is None else {
            'rating': rating.name, 'reason': rating.reason},
        'result': None if shown is None else _result(shown),
        'page': '' if shown is None else f'/calibration.html?{page}'}


def _problem(session: Session) -> str:
    """Return the most severe finding, other than that there is no calibration yet."""
    found = [each for each in checks(session) if each.level > Level.OK and (
        each.name != 'calibration' or session.sensor.calibration or session.problem)]
    return max(found, key=lambda each: each.level).words if found else ''


def _result(calibration: Calibration) -> Message:
    """Return the numbers of a calibration."""
    quality, used = calibration.quality, len(calibration.used_poses)
    return {
        'model': calibration.name, 'date': calibration.date, 'unit': calibration.units.name,
        'poses': used, 'left_out': len(calibration.poses) - used,
        'coverage': _number(quality.coverage),
        'residuals': [[figure.label, _number(figure.value), figure.unit]
                      for figure in residual_figures(quality)],
        'effects': list(calibration.model.effects), 'warnings': list(calibration.warnings),
        'offset': _rounded(calibration.offset), 'offset_sd': _rounded(calibration.offset_sd),
        'gain': _rounded(calibration.gain), 'gain_sd': _rounded(calibration.gain_sd)}


def _counts_per_g(calibration: Calibration) -> float | None:
    """Return the mean sensitivity of a sensor in native units; None in other units."""
    if not calibration.units.is_native:
        return None
    return _number(float(np.mean(np.linalg.norm(calibration.gain, axis=0))))


def _fixed(value: float) -> float | None:
    """Return a number with the decimals of progress; this is faster than `_number`."""
    return round(value, _DECIMALS) if math.isfinite(value) else None


def _number(value: float | None) -> float | None:
    if value is None or not math.isfinite(value):
        return None
    return float(f'{value:.{_DIGITS}g}')


def _rounded(values: Any) -> Any:
    """Return an array as lists."""
    array = np.asarray(values, float)
    if array.ndim == 0:
        return _number(float(array))
    return [_rounded(each) for each in array]


def _side_up(direction: Floats) -> str:
    """Return the side, edge or corner nearest to a direction, such as ``front side``."""
    signs = np.where(np.abs(direction) > _NEAR, np.sign(direction), 0.0)
    return words_of(signs).removeprefix('the ')
