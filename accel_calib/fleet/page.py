# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The page of a fleet: values over the fleet, odd sensors, changes, shared effects, errors.

The size of the page does not grow with the number of sensors: tables end after `_MOST` lines and
lists of figures after `_MOST_CHANGED`, `_MOST_ODD` and `_NEWEST` sensors. The values are drawn as
histograms, and the drift of all sensors as bands of quantiles. The page says how many sensors it
does not show; `sensors.parquet` and the rows of the recordings have all of them.

"""

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from importlib.util import find_spec
from itertools import islice
from typing import Any
from urllib.parse import unquote

import numpy as np

from .overview import (
    not_agreeing, Odd, odd_sensors, OfModel, Overview, rating_of, shared_effects, table_of)
from .recording import Row
from .sensors import alike, read_parquet, Store
from ..calibration import FleetPrior
from ..comparison import NAMES
from ..effects import MODELS, parameter_names
from ..findings import change_words, CROSS, scale_of
from ..report.sheet import (
    ACCENT, add_band, AFTER, BAND, BEFORE, Drawing, drawn, EDGE, FAINT, legend_below, Mark, Marks,
    page, THIRD, write_page)
from ..report.stability import GROUPS, label_dates, named_words, places_of
from ..table import Floats
from ..text import short, with_minus

PAGE = 'fleet.html'

_MOST = 200
"""Largest number of lines of a table."""

_LONG = 20
"""Number of lines above which a table scrolls."""

_MOST_MODELS = 6
"""Largest number of models of sensors with figures."""

_MOST_CHANGED, _MOST_ODD, _NEWEST = 6, 4, 2
"""Largest numbers of sensors whose calibrations are drawn over time."""

_LASTING = {True: 'for good', False: 'this calibration only', None: 'newest'}
"""Words for whether a change lasts."""

_DRIFTS = 0.05
"""Probability below which a drift is stated."""


def write_fleet_page(store: Store, known: Overview, sensors: Sequence[Row],
                     priors: Mapping[str, FleetPrior]) -> None:
    """Write the page of all sensors, with typical values by model; raise OSError if it fails."""
    differ, odd_names = not_agreeing(sensors), list[str]()
    drawn_too = find_spec('matplotlib') is not None
    models = []
    for number, (name, own) in enumerate(sorted(
            known.models.items(), key=lambda each: (-len(each[1].values), each[0]))):
        odd = odd_sensors(own.values)
        odd_names += [sensor for sensor, _, _, _ in odd]
        prefix = f'model{number}' if drawn_too and number < _MOST_MODELS else ''
        models.append({'name': name, **_section(own, odd, priors.get(name), prefix)})
    drawings, others = _over_time(store, sensors, differ, odd_names) if drawn_too else ([], 0)
    write_page(store.folder / PAGE, page(
        'fleet', 'Fleet', (), rating_of(known, sensors), heading='Calibrations of a fleet',
        script=False,  # the browser shows the text of a marker that is pointed at
        has_figures=drawn_too, left_out=known.left_out, models=models, most_models=_MOST_MODELS,
        differ=differ, changes=_changes(differ), over_time=drawings, others=others, most=_MOST,
        long=_LONG, failed=sum(known.counts[status] for status in ('error', 'unread')),
        errors=[(row['recording'], row['error'], row['advice']) for row in known.errors]))


def _section(known: OfModel, odd: Sequence[Odd], prior: FleetPrior | None, prefix: str
             ) -> dict[str, Any]:
    """Return the section of a model of sensor; its figures have names with the prefix, if any."""
    table = np.array([each.mean for each in known.values.values()])
    distribution, typical = [], []
    for name, column in zip(NAMES, table.T, strict=True):
        zero, factor, unit = scale_of(name)
        parts = (np.quantile(column, [0.0, 0.1, 0.5, 0.9, 1.0]) - zero) * factor
        label = f'{name.replace(".", " ")} [{unit}]'
        distribution.append((label, *(with_minus(short(part)) for part in parts)))
    if prior is not None:
        spread = np.sqrt(np.diag(prior.prior.covariance))
        for name, mean, sd in zip(parameter_names(MODELS['10'].effects), prior.prior.mean, spread,
                                  strict=True):
            _, factor, unit = scale_of(name)
            typical.append((name.replace('.', ' ').replace('_', ' '),
                            with_minus(short(mean * factor)), short(sd * factor), unit))
    return {'sensors': len(known.values), 'odd': [_odd_words(known, each) for each in odd],
            'values': list(_draw_values(f'{prefix}_values', known, odd)) if prefix else [],
            'distribution': distribution, 'shared': shared_effects(known.values),
            'drift': list(_draw_months(f'{prefix}_months', known)) if prefix else [],
            'prior': prior, 'typical': typical}


def _changes(sensors: Sequence[Row]) -> Sequence[tuple[str, ...]]:
    """Return lines about the sensors whose calibrations differ."""
    rows = list[tuple[str, ...]]()
    for row in sensors:
        sensor, drift = row['sensor'], row.get('drift')
        for change in row['changes']:
            date, path = (change['date'] or '')[:10], change.get('recording') or ''
            words = change_words(change['parameter'], change['change'], change['sd'])
            rows.append((sensor, f'{date} {path}'.strip(), words, _LASTING[change['for_good']]))
        if drift and drift['p_value'] < _DRIFTS:
            words = change_words(drift['parameter'], drift['per_year'], drift['sd'])
            rows.append((sensor, '', f'{words} per year', 'drift'))
        elif not row['changes']:
            rows.append((sensor, '', 'no step or drift that is significant alone', ''))
    return rows


def _over_time(store: Store, sensors: Sequence[Row], differ: Sequence[Row],
               odd: Sequence[str]) -> tuple[list[Drawing], int]:
    """Return figures of single sensors, changed, odd and newest ones, and how many are left."""
    by_name = {row['sensor']: row for row in sensors if row['calibrations'] > 1}
    for_good_first = sorted(differ, key=lambda row: not any(
        change['for_good'] for change in row['changes']))
    changed = [row['sensor'] for row in for_good_first]
    newest = sorted(by_name, key=lambda name: by_name[name]['last'] or '', reverse=True)
    chosen: dict[str, None] = {}
    for names, most in ((changed, _MOST_CHANGED), (odd, _MOST_ODD), (newest, _NEWEST)):
        chosen |= dict.fromkeys(islice(
            (name for name in dict.fromkeys(names) if name in by_name and name not in chosen),
            most))
    significant = {row['sensor'] for row in differ}
    files = {unquote(folder): store.data(folder) for folder in store.sensors()}
    drawings = [_draw_sensor(f'sensor{number}', name, alike(read_parquet(files[name])),
                             by_name[name]['changes'] if name in significant else [])
                for number, name in enumerate(chosen)]
    return drawings, len(by_name) - len(chosen)


# ----------------------------------------------------------------------------- figures

_ROOM = 6.0
"""Range of a histogram, in distances of the 10 % and 90 % quantiles from the median."""

_NAMED = 3
"""Largest number of odd sensors whose name is written beside a histogram."""

_LONGEST_NAME = 24
_MOST_DATES = 40
"""Largest number of calibrations in the figure of a sensor: the newest ones."""

_FEW = 12
"""Number of calibrations up to which each has a marker."""

_COLOURS = (AFTER, THIRD, BEFORE)


def _draw_values(prefix: str, known: OfModel, odd: Sequence[Odd]) -> Iterator[Drawing]:
    """Yield histograms of each value over the sensors of a model, with the odd sensors."""
    table = np.array([each.mean for each in known.values.values()])
    for key, words, names in GROUPS:
        hover = {}
        with drawn(3.6, f'{words} [{scale_of(names[0])[2]}]', 3, grid='') as (figure, panels):
            for panel, name in zip(panels, names, strict=True):
                own = [each for each in odd if each[1] == name]
                _draw_histogram(panel, name, table[:, NAMES.index(name)], own)
                if own:
                    hover[name] = tuple(Mark(_odd_words(known, each)) for each in own)
            panels[1].set_ylabel('sensors')
        yield Drawing(f'{prefix}_{key}', f'{words} over the sensors; triangles: odd sensors',
                      figure, hover)


def _draw_histogram(panel: Any, name: str, column: Floats, odd: Sequence[Odd]) -> None:
    zero, factor, _ = scale_of(name)
    values = (column - zero) * factor
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
    reach = _ROOM * max(high - middle, middle - low) or float(np.max(np.abs(values - middle)))
    shown = values[np.abs(values - middle) <= reach]
    bars = int(np.clip(2.0 * np.sqrt(len(shown)), 5, 40))
    heights, edges = np.histogram(shown, bars)
    panel.stairs(heights, edges, fill=True, color=AFTER, alpha=0.45)
    panel.axvline(middle, color=BEFORE, linewidth=1.2)
    panel.text(0.01, 0.95, name.partition('.')[2], transform=panel.transAxes, va='top')
    panel.locator_params(axis='y', integer=True, nbins=3)
    if not odd:
        return
    # The odd sensors are marked, at the edge if they are farther away.
    height = 0.12 * max(float(np.max(heights)), 1.0)
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


def _odd_words(known: OfModel, odd: Odd) -> str:
    """Return an odd sensor with its value."""
    sensor, name, value, far = odd
    sd = float(known.values[sensor].deviation[NAMES.index(name)])
    return f'{sensor}: {named_words(name, value, sd)}, {far:.0f} spreads from the median'


def _short_name(name: str) -> str:
    """Return the end of a long name, where the names of a fleet differ most."""
    return name if len(name) <= _LONGEST_NAME else f'…{name[1 - _LONGEST_NAME:]}'


def _draw_months(prefix: str, known: OfModel) -> Iterator[Drawing]:
    """Yield the drift of all sensors of a model together, as bands of quantiles by month."""
    months, found = known.months.quantiles((0.05, 0.25, 0.5, 0.75, 0.95))
    if len(months) < 3:
        return
    days = np.array([f'{month}-15' for month in months], 'datetime64[D]').astype(float)
    for key, words, names in GROUPS:
        with drawn(3.9, f'{words} minus its median [{scale_of(names[0])[2]}]', 3, sharex=True
                   ) as (figure, panels):
            for panel, name in zip(panels, names, strict=True):
                lines = found[:, :, NAMES.index(name)].T * scale_of(name)[1]
                panel.axhline(0.0, color=FAINT, linewidth=1.2)
                add_band(panel, days, lines[0], lines[4], AFTER, alpha=0.18)
                add_band(panel, days, lines[1], lines[3], AFTER, alpha=0.35)
                panel.plot(days, lines[2], color=AFTER)
                panel.set_ylabel(name.partition('.')[2])
            label_dates(panels[-1], days, 'month of the recording', dated=True)
        yield Drawing(f'{prefix}_{key}', f'{words}: difference from the median of the sensor, by '
                      'month, with bands of 50 % and 90 % of the calibrations', figure)


def _draw_sensor(name: str, sensor: str, rows: Sequence[Row],
                 changes: Sequence[Mapping[str, Any]]) -> Drawing:
    """Draw the newest of the dated `rows` of a sensor, with bands and its changes."""
    shown = rows[-_MOST_DATES:]
    places = {row['key']: place for place, row in enumerate(shown)}
    marked = [(places[change['key']], change) for change in changes if change['key'] in places]
    values, deviations = table_of(shown)
    cross = np.any(deviations[:, [NAMES.index(name) for name in CROSS]])
    groups = [(key, names) for key, _, names in GROUPS if cross or names is not CROSS]
    at, dated = places_of([datetime.fromisoformat(row['date']).timestamp() if row['date'] else None
                           for row in shown])
    with drawn(0.9 + 1.15 * len(groups), _short_name(sensor), len(groups), sharex=True
               ) as (figure, panels):
        for panel, (key, names) in zip(panels, groups, strict=True):
            for value, label, colour in zip(names, 'xyz', _COLOURS, strict=True):
                column, (_, factor, unit) = NAMES.index(value), scale_of(value)
                middle = (values[:, column] - np.median(values[:, column])) * factor
                band = BAND * deviations[:, column] * factor
                add_band(panel, at, middle - band, middle + band, colour)
                panel.plot(at, middle, color=colour, linewidth=1.2, label=label,
                           marker='o' if len(at) <= _FEW else None, markersize=2.5)
            panel.set_ylabel(f'{key.replace("_", "-")}\n[{unit}]')
            for place, change in marked:
                panel.axvline(at[place], color=ACCENT, linewidth=1.4, linestyle='-'
                              if change['for_good'] else (0, (2, 3)))
        hover: dict[str, Marks] = {}
        if marked:
            along = at[[place for place, _ in marked]]
            panels[0].plot(along, np.full(len(along), panels[0].get_ylim()[1]), 'v', color=ACCENT,
                           gid='changes', clip_on=False, **EDGE)
            hover['changes'] = tuple(
                Mark(f'{shown[place]["recording"]}: '
                     f'{change_words(change["parameter"], change["change"], change["sd"])}, '
                     f'{_LASTING[change["for_good"]]}') for place, change in marked)
        label_dates(panels[-1], at, 'date of the recording', dated=dated)
        legend_below(figure, 3, *panels[0].get_legend_handles_labels())
    return Drawing(name, f'{sensor}: calibrations over time with 95 % band', figure, hover)
