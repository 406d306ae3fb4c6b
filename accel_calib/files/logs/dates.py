# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Dates with a time, and times of the day, in seconds.

Dates are those of ISO 8601, ``2026-01-31T12:00:00.250Z``, with a blank for the T or slashes, and
``31-Jan-2026`` and ``31.01.2026``. A date without a zone is taken as UTC.

"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
import re

import numpy as np

from ...errors import InputError
from ...table import Floats

_PATTERN = re.compile(
    r'(?:(\d{4}[-/]\d{1,2}[-/]\d{1,2}|\d{1,2}-[A-Za-z]{3}-\d{4}|\d{1,2}\.\d{1,2}\.\d{4})[T ])?'
    r'(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d+))?)? ?(Z|UTC|[-+]\d{2}(?::?\d{2})?)?', re.ASCII)
_FORMS = ('%Y-%m-%d', '%d-%b-%Y', '%d.%m.%Y')


def is_clock(text: str) -> bool:
    """Return whether a text is a date with a time, or a time of the day."""
    return _PATTERN.fullmatch(text) is not None


def has_date(text: str) -> bool:
    """Return whether a text is a date with a time."""
    found = _PATTERN.fullmatch(text)
    return found is not None and found[1] is not None


def seconds_of(texts: Sequence[str], path: Path, rows: Sequence[int]) -> Floats:
    """
    Return the seconds since 1970 of dates, or since midnight of times of the day.

    Parameters
    ----------
    texts : sequence of str
        The dates.
    path : Path
        The file, for error messages.
    rows : sequence of int
        Row numbers of the dates.

    Raises
    ------
    InputError
        If a text is no date or time.

    """
    seconds = np.empty(len(texts))
    for k, text in enumerate(texts):
        found = _seconds(text)
        if found is None:
            raise InputError(f'{path}: row {rows[k]} has the time {text[:40]!r}, expected one '
                             'such as 2026-01-31T12:00:00.250', 'correct the row or remove it')
        seconds[k] = found
    return seconds


def _seconds(text: str) -> float | None:
    """Return a date in seconds, or None if it is none."""
    found = _PATTERN.fullmatch(text)
    if found is None:
        return None
    date, hour, minute, second, digits, zone = found.groups()
    day = _day(date) if date else 0.0
    if day is None or not (int(hour) < 24 and int(minute) < 60 and int(second or 0) <= 60):
        return None
    fraction = float(f'0.{digits}') if digits else 0.0
    whole = day + int(hour) * 3600.0 + int(minute) * 60.0 + int(second or 0)
    return whole - _offset(zone) + fraction


@lru_cache(maxsize=64)
def _day(date: str) -> float | None:
    """Return the seconds from 1970 to a day, or None if there is no such day."""
    for form in _FORMS:
        try:
            day = datetime.strptime(date.replace('/', '-'), form)
        except ValueError:  # It has another form.
            continue
        return day.replace(tzinfo=timezone.utc).timestamp()
    return None


@lru_cache(maxsize=64)
def _offset(zone: str | None) -> float:
    """Return the offset of a time zone [s]."""
    if zone in (None, 'Z', 'UTC'):
        return 0.0
    size = int(zone[1:3]) * 3600.0 + int(zone[3:].lstrip(':') or 0) * 60.0
    return -size if zone[0] == '-' else size
