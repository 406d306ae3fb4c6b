# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrations of one sensor in order of their dates, and the comparison of each with the one before.

The parameters are those of `compare`: they do not depend on the axes, and have one unit and one
context for all calibrations. So a change of the temperature between two dates does not appear as a
change of the sensor, if the calibrations contain the effect of the temperature.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from itertools import pairwise

import numpy as np

from .comparable import Comparable, comparable
from .comparison import compared, Comparison, Parameter
from ..calibrate import Calibration
from ..errors import InputError

_FIRST = datetime.min.replace(tzinfo=timezone.utc)


@dataclass(frozen=True)
class Moment:
    """
    One calibration of a history.

    Parameters
    ----------
    index : int
        Index of the calibration among those given, 0-based.
    when : datetime or None
        Date of the fit, in UTC; None if it is not known.
    model : str
        Name of the model.
    temperature : float or None
        Median temperature of the poses used [°C]; None if it is not known.
    residual_mg : float
        Residual over the poses used [mg].

    """

    index: int
    when: datetime | None
    model: str
    temperature: float | None
    residual_mg: float


@dataclass(frozen=True)
class Change:
    """
    The change from one calibration to the next.

    Parameters
    ----------
    comparison : Comparison
        Comparison of the two.
    parameter : str
        Parameter that changed most, relative to its standard deviation.
    change, sd : float
        Its change and the stated standard deviation of the change [g].

    """

    comparison: Comparison
    parameter: str
    change: float
    sd: float


@dataclass(frozen=True)
class History:
    """
    Calibrations of one sensor over time.

    Parameters
    ----------
    moments : tuple of Moment
        The n calibrations, in order of date.
    parameters : tuple of Parameter
        Each parameter with its n values and standard deviations, in the same order.
    changes : tuple of Change
        Change from each calibration to the next, n - 1.
    whole : Comparison
        Comparison of all calibrations.
    notes : tuple of str
        Notes that limit the meaning of the history.
    runs : tuple of Comparable
        The calibrations in the same order, prepared for comparisons.

    """

    moments: tuple[Moment, ...]
    parameters: tuple[Parameter, ...]
    changes: tuple[Change, ...]
    whole: Comparison
    notes: tuple[str, ...]
    runs: tuple[Comparable, ...] = field(repr=False)

    def between(self, first: int, second: int) -> Comparison:
        """Return the comparison of two of the calibrations, by their number in the order."""
        return compared([self.runs[first], self.runs[second]])

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the day of each calibration, with the time where a day has several."""
        days = [moment.when and moment.when.strftime('%Y-%m-%d') for moment in self.moments]
        short = len(set(days)) == len(days)
        return tuple('no date' if moment.when is None else
                     moment.when.strftime('%Y-%m-%d' if short else '%Y-%m-%d %H:%M')
                     for moment in self.moments)


def history_of(calibrations: Sequence[Calibration]) -> History:
    """
    Return calibrations of one sensor in order of date, with the change at each step.

    Parameters
    ----------
    calibrations : sequence of Calibration
        Two or more calibrations, in any order. If one has no date, the order is kept.

    Returns
    -------
    History
        The calibrations, their parameters, and the comparison of each with the one before.

    Raises
    ------
    InputError
        If there are fewer than two, they cannot be compared, or a date is not valid.

    """
    runs = comparable(calibrations)
    moments = [_moment(k, each) for k, each in enumerate(calibrations)]
    undated = [moment.index + 1 for moment in moments if moment.when is None]
    if not undated:
        moments.sort(key=lambda moment: (moment.when or _FIRST, moment.index))
    ordered = tuple(runs[moment.index] for moment in moments)
    whole = compared(ordered)
    notes = [f'calibration {number} has no date: the order is that of the input'
             for number in undated]
    return History(tuple(moments), whole.parameters,
                   tuple(_change(compared(pair)) for pair in pairwise(ordered)),
                   whole, (*notes, *whole.notes), ordered)


def _moment(index: int, calibration: Calibration) -> Moment:
    poses = calibration.used_poses
    warm = float(np.median(poses['temperature'])) if 'temperature' in poses else None
    return Moment(index, _when(index, calibration.date), calibration.name, warm,
                  calibration.quality.rms_after_mg)


def _when(index: int, date: str) -> datetime | None:
    """Return a date in UTC; a date without a time zone is taken as UTC."""
    if not date:
        return None
    try:
        when = datetime.fromisoformat(date.replace('Z', '+00:00'))
    except ValueError:
        raise InputError(f'the date of calibration {index + 1} is {date!r}, expected a date such '
                         'as 2026-11-22T09:30:00+00:00', 'correct date: in the file') from None
    return when.replace(tzinfo=when.tzinfo or timezone.utc).astimezone(timezone.utc)


def _change(comparison: Comparison) -> Change:
    """Return the change from the first to the second of two calibrations."""
    changes = np.array([each.values[1] - each.values[0] for each in comparison.parameters])
    deviations = np.array([np.hypot(*each.stated_sd) for each in comparison.parameters])
    known = deviations > 0.0
    sizes = np.where(known, np.abs(changes) / np.where(known, deviations, 1.0), 0.0)
    most = int(np.argmax(sizes))
    return Change(comparison, comparison.parameters[most].name, float(changes[most]),
                  float(deviations[most]))
