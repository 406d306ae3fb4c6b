# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The figures of a fleet: values over the sensors, drift of all sensors, and single sensors.

The size of a figure does not depend on the number of sensors: the values are histograms, and the
drift of all sensors is bands of quantiles.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from typing import Any, TYPE_CHECKING

import numpy as np

from .overview import OfModel, table_of
from .task import Row
from ..compare import NAMES
from ..findings import change_in_words, CROSS, GAINS, in_words, OFFSETS, scale_of
from ..report.charts import (
    ACCENT, AFTER, BAND, BEFORE, Drawing, EDGE, FAINT, legend_below, Mark, Marks, new_figure,
    styled, THIRD)
from ..report.repeats import label_dates, places_of, spoken
from ..table import Floats
from ..text import short

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Odd = tuple[str, str, float, float]
"""Sensor, name of a value, the value, and its distance from the median in spreads."""

_GROUPS = (('offset', 'Zero-g offset', OFFSETS), ('gain', 'Gain minus 1', GAINS),
           ('cross', 'Cross-axis gain', CROSS))
_PARTS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles of the drift of a fleet."""

_MOST_BARS = 40
_ROOM = 6.0
"""Range of a histogram, in distances of the 10 % and 90 % quantiles from the median."""

_NAMED = 3
"""Largest number of odd sensors whose name is written beside a histogram."""

_LONGEST_NAME = 24
_NEWEST = 40
"""Largest number of calibrations in the figure of a sensor: the newest ones."""

_FEW = 12
"""Number of calibrations up to which each has a marker."""

_FEWEST_MONTHS = 3
_COLOURS = (AFTER, THIRD, BEFORE)


def of_values(prefix: str, known: OfModel, odd: Sequence[Odd]) -> Iterator[Drawing]:
    """Yield histograms of each value over the sensors of a model, with the odd sensors."""
    table = np.array(list(known.values.values()))
    for key, words, names in _GROUPS:
        hover = {}
        with styled():
            figure = new_figure(3.6, f'{words} [{scale_of(names[0])[2]}]')
            panels = figure.subplots(3, 1)
            for panel, name in zip(panels, names, strict=True):
                own = [each for each in odd if each[1] == name]
                _draw_histogram(panel, name, table[:, NAMES.index(name)], own)
                if own:
                    hover[name] = tuple(Mark(0, odd_words(known, each)) for each in own)
            panels[1].set_ylabel('sensors')
        yield Drawing(f'{prefix}_{key}', f'{words} over the sensors; triangles: odd sensors',
                      figure, hover)


def _draw_histogram(panel: Any, name: str, column: Floats, odd: Sequence[Odd]) -> None:
    zero, factor, _ = scale_of(name)
    values = (column - zero) * factor
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
    reach = _ROOM * max(high - middle, middle - low) or float(np.max(np.abs(values - middle)))
    shown = values[np.abs(values - middle) <= reach]
    bars = int(np.clip(2.0 * np.sqrt(len(shown)), 5, _MOST_BARS))
    heights, edges = np.histogram(shown, bars)
    panel.stairs(heights, edges, fill=True, color=AFTER, alpha=0.45)
    panel.axvline(middle, color=BEFORE, linewidth=1.2)
    panel.text(0.01, 0.95, name.partition('.')[2], transform=panel.transAxes, va='top')
    panel.locator_params(axis='y', integer=True, nbins=3)
    if odd:
        _draw_odd(panel, name, odd, middle, reach, 0.12 * max(float(np.max(heights)), 1.0))


def _draw_odd(panel: Any, name: str, odd: Sequence[Odd], middle: float, reach: float,
              height: float) -> None:
    """Mark the odd sensors, at the edge if they are farther than `reach` from the middle."""
    zero, factor, _ = scale_of(name)
    at = (np.array([each[2] for each in odd]) - zero) * factor
    places = np.clip(at, middle - reach, middle + reach)
    panel.plot(places, np.full(len(at), height), 'v', color=ACCENT, gid=name, markersize=7.0,
               clip_on=False, **EDGE)
    for k, (place, value, each) in enumerate(zip(places[:_NAMED], at, odd, strict=False)):
        beyond = '' if place == value else f' {short(value)} →' if value > place else (
            f' ← {short(value)}')
        panel.annotate(f'{_short_name(each[0])}{beyond}', (place, height), (0.0, 6.0 + 10.0 * k),
                       textcoords='offset points', fontsize=8.0, parse_math=False,
                       ha='right' if place > middle else 'left')


def odd_words(known: OfModel, odd: Odd) -> str:
    """Return an odd sensor with its value."""
    sensor, name, value, far = odd
    sd = float(known.deviations[sensor][NAMES.index(name)])
    return (f'{sensor}: {spoken(name)} {in_words(name, value, sd)}, {far:.0f} spreads '
            'from the median')


def _short_name(name: str) -> str:
    """Return the end of a long name, where the names of a fleet differ most."""
    return name if len(name) <= _LONGEST_NAME else f'…{name[1 - _LONGEST_NAME:]}'


def of_months(prefix: str, known: OfModel) -> Iterator[Drawing]:
    """Yield the drift of all sensors of a model together, as bands of quantiles by month."""
    months, found = known.months.quantiles(_PARTS)
    if len(months) < _FEWEST_MONTHS:
        return
    days = np.array([datetime.fromisoformat(f'{month}-15').toordinal() for month in months], float)
    days -= datetime(1970, 1, 1).toordinal()
    for key, words, names in _GROUPS:
        yield Drawing(f'{prefix}_{key}', f'{words}: difference from the median of the sensor, by '
                      'month, with bands of 50 % and 90 % of the calibrations',
                      _draw_months(words, names, days, found))


def _draw_months(title: str, names: Sequence[str], days: Floats, found: Floats) -> Figure:
    with styled():
        figure = new_figure(3.9, f'{title} minus its median [{scale_of(names[0])[2]}]')
        panels = figure.subplots(3, 1, sharex=True)
        for panel, name in zip(panels, names, strict=True):
            column = found[:, :, NAMES.index(name)] * scale_of(name)[1]
            panel.grid(visible=True)
            panel.axhline(0.0, color=FAINT, linewidth=1.2)
            for low, high, alpha in ((0, 4, 0.18), (1, 3, 0.35)):
                panel.fill_between(days, column[:, low], column[:, high], color=AFTER,
                                   alpha=alpha, linewidth=0.0)
            panel.plot(days, column[:, 2], color=AFTER)
            panel.set_ylabel(name.partition('.')[2])
        label_dates(panels[-1], days, dated=True)
        panels[-1].set_xlabel('month of the recording')
    return figure


def of_sensor(name: str, sensor: str, rows: Sequence[Row], changes: Sequence[Mapping[str, Any]]
              ) -> Drawing:
    """
    Draw the newest calibrations of one sensor over time, with bands and its changes.

    Parameters
    ----------
    name : str
        Name of the figure.
    sensor : str
        Name of the sensor.
    rows : sequence of dict
        Rows of its calibrations, in order of date.
    changes : sequence of mapping
        Its changes, as in `accel_calib.fleet.sensors`.

    """
    shown = rows[-_NEWEST:]
    places = {row['key']: place for place, row in enumerate(shown)}
    marked = [(places[change['key']], change) for change in changes if change['key'] in places]
    values, deviations = table_of(shown)
    cross = np.any(deviations[:, [NAMES.index(name) for name in CROSS]])
    groups = [names for _, _, names in _GROUPS if cross or names is not CROSS]
    at, dated = places_of([_stamp(row['date']) for row in shown])
    with styled():
        figure = new_figure(0.9 + 1.15 * len(groups), _short_name(sensor))
        panels = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
        for panel, names in zip(panels, groups, strict=True):
            columns = [NAMES.index(name) for name in names]
            _draw_group(panel, names, at, values[:, columns], deviations[:, columns])
            for place, change in marked:
                panel.axvline(at[place], color=ACCENT, linewidth=1.4, linestyle='-'
                              if change['for_good'] else (0, (2, 3)))
        hover = _mark_changes(panels[0], shown, at, marked)
        label_dates(panels[-1], at, dated=dated)
        panels[-1].set_xlabel('date of the recording' if dated else 'calibration')
        legend_below(figure, 3, *panels[0].get_legend_handles_labels())
    return Drawing(name, f'{sensor}: calibrations over time with 95 % band', figure, hover)


def _draw_group(panel: Any, names: Sequence[str], at: Floats, values: Floats, deviations: Floats
                ) -> None:
    """Draw three values over time, minus their medians, with bands."""
    panel.grid(visible=True)
    for k, name in enumerate(names):
        _, factor, unit = scale_of(name)
        middle = (values[:, k] - np.median(values[:, k])) * factor
        band = BAND * deviations[:, k] * factor
        panel.fill_between(at, middle - band, middle + band, color=_COLOURS[k], alpha=0.18,
                           linewidth=0.0)
        panel.plot(at, middle, color=_COLOURS[k], linewidth=1.2, label='xyz'[k],
                   marker='o' if len(at) <= _FEW else None, markersize=2.5)
    panel.set_ylabel(f'{names[0].partition(".")[0] if names[0] != "gain.xy" else "cross-axis"}\n'
                     f'[{unit}]')


def _mark_changes(panel: Any, rows: Sequence[Row], at: Floats,
                  changes: Sequence[tuple[int, Mapping[str, Any]]]) -> dict[str, Marks]:
    """Mark the recordings with changes; return the texts of the marks."""
    if not changes:
        return {}
    places = [place for place, _ in changes]
    panel.plot(at[places], np.full(len(places), panel.get_ylim()[1]), 'v', color=ACCENT,
               gid='changes', clip_on=False, **EDGE)
    return {'changes': tuple(Mark(0, f'{rows[place]["recording"]}: {change_words(change)}')
                             for place, change in changes)}


def change_words(change: Mapping[str, Any]) -> str:
    """Return a change with its standard deviation, and whether it lasts."""
    words = change_in_words(change['parameter'], change['change'], change['sd'])
    return f'{spoken(change["parameter"])} {words}, {lasting_words(change["for_good"])}'


def lasting_words(for_good: bool | None) -> str:
    """Return whether a change lasts."""
    return {True: 'for good', False: 'this calibration only', None: 'newest'}[for_good]


def drift_words(drift: Mapping[str, Any]) -> str:
    """Return a drift with its standard deviation."""
    return f'{change_in_words(drift["parameter"], drift["per_year"], drift["sd"])} per year'


def _stamp(date: str | None) -> float | None:
    """Return a date as seconds since 1970; None without a date."""
    if not date:
        return None
    when = datetime.fromisoformat(date.replace('Z', '+00:00'))
    return when.replace(tzinfo=when.tzinfo or timezone.utc).timestamp()
