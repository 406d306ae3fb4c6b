# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Name of the sensor and date of a recording."""

from __future__ import annotations

from datetime import datetime, timezone
import hashlib
from pathlib import PurePosixPath
import re
from urllib.parse import quote

from .inputs import Input
from ..errors import InputError
from ..table import Poses

UNKNOWN = 'unknown'
"""Sensor of a recording in the passed folder itself, whose file has no name of a sensor."""

_LONGEST_FOLDER = 180

_FIRST_STAMP = datetime(2000, 1, 1, tzinfo=timezone.utc).timestamp()
_LAST_STAMP = datetime(2100, 1, 1, tzinfo=timezone.utc).timestamp()
"""Time stamps between these dates count from 1970."""

_DATE = re.compile(r'(?<!\d)(20\d\d)([-_./]?)(0[1-9]|1[0-2])\2(0[1-9]|[12]\d|3[01])'
                   r'(?:[-_T ]?([01]\d|2[0-3])[-_.:]?([0-5]\d)[-_.:]?([0-5]\d))?(?!\d)')
_DATE_FOLDER = re.compile(r'(19|20)\d\d([-_.]?\d\d){0,2}([-_T]?\d{2,6})?|\d{1,2}|[Ww]\d{1,2}')


def sensor_of(found: Input, name: str, pattern: str = '') -> str:
    """
    Return the name of the sensor of a recording.

    Parameters
    ----------
    found : Input
        The recording.
    name : str
        Name of the sensor in the file; empty if it has none.
    pattern : str
        Regular expression for the path, whose groups are the name; empty: the folder below the
        one that was passed and the name in the file.

    Raises
    ------
    InputError
        If the path does not match the pattern.

    """
    if pattern:
        return matched(pattern, found.path, '--sensor-from')
    folders = [part for part in PurePosixPath(found.inside).parts[:-1]
               if not _DATE_FOLDER.fullmatch(part)]
    if name and name not in folders:
        folders.append(name)
    return '/'.join(folders) or UNKNOWN


def matched(pattern: str, text: str, option: str) -> str:
    """Return the groups of a regular expression in a text, or the whole match without groups."""
    match = re.search(pattern, text)
    if match is None:
        raise InputError(f'{text} does not match {option} {pattern!r}, expected a match',
                         f'correct {option}, or leave out this recording')
    return '/'.join(filter(None, match.groups())) or match.group()


def as_folder(sensor: str) -> str:
    """Return the name of a sensor as the name of one folder."""
    name = quote(sensor, safe=' ()+,@').replace('~', '%7E')
    if not name.strip('.'):
        name = name.replace('.', '%2E')
    if len(name) <= _LONGEST_FOLDER:
        return name
    rest = hashlib.blake2b(sensor.encode(), digest_size=8).hexdigest()
    return f'{name[:_LONGEST_FOLDER]}~{rest}'


def date_of(found: Input, poses: Poses | None, modified_s: float | None) -> tuple[str, str]:
    """
    Return the date of a recording in ISO 8601, and where it comes from.

    Parameters
    ----------
    found : Input
        The recording.
    poses : Poses or None
        Its poses.
    modified_s : float or None
        Time of the last change of the file [s since 1970].

    Returns
    -------
    str, str
        The date in UTC, and ``stamps``, ``path`` or ``file``; both are empty if it is not known.

    """
    if poses is not None and 'time' in poses and len(poses):
        first = float(poses['time'][0])
        if _FIRST_STAMP <= first < _LAST_STAMP:
            return _iso(first), 'stamps'
    matches = list(_DATE.finditer(found.inside))
    if matches:
        year, _, month, day, *clock = matches[-1].groups()
        try:
            hour, minute, second = (int(part or 0) for part in clock)
            when = datetime(int(year), int(month), int(day), hour, minute, second,
                            tzinfo=timezone.utc)
            return when.isoformat(timespec='seconds'), 'path'
        except ValueError:  # such as 30 February
            pass
    return ('', '') if modified_s is None else (_iso(modified_s), 'file')


def _iso(stamp: float) -> str:
    return datetime.fromtimestamp(stamp, timezone.utc).isoformat(timespec='seconds')
