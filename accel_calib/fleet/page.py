# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The page of a fleet: values over the fleet, odd sensors, changes, shared effects, errors.

The size of the page does not grow with the number of sensors: tables end after `_MOST` lines and
lists of figures after `_MOST_CHANGED`, `_MOST_ODD` and `_NEWEST` sensors. The page says how many
it does not show; `sensors.parquet` and the rows of the recordings have all of them.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from urllib.parse import unquote

import numpy as np

from .charts import (
    change_words, drift_words, lasting_words, Odd, odd_words, of_months, of_sensor, of_values)
from .overview import not_agreeing, odd_sensors, OfModel, Overview, rating_of, shared_effects
from .sensors import alike
from .task import Row, Store
from .. import __version__
from ..calibrate import FleetPrior
from ..compare import NAMES
from ..effects import MODELS, parameter_names
from ..findings import Rating, scale_of
from ..report.charts import Drawing, has_matplotlib
from ..report.repeats import spoken
from ..report.sheet import (
    figures, heading, listing, paragraph, rated_sheet, scroll_table, section, verdict_box,
    write_sheet)
from ..text import counted, short

PAGE = 'fleet.html'

_MOST = 200
"""Largest number of lines of a table."""

_LONG = 20
"""Number of lines above which a table scrolls."""

_MOST_MODELS = 6
"""Largest number of models of sensors with figures."""

_MOST_CHANGED, _MOST_ODD, _NEWEST = 6, 4, 2
"""Largest numbers of sensors whose calibrations are drawn over time."""

_DRIFTS = 0.05
"""Probability below which a drift is stated."""


def write_fleet_page(store: Store, known: Overview, sensors: Sequence[Row],
                     priors: Mapping[str, FleetPrior]) -> None:
    """Write the page of all sensors, with typical values by model; raise OSError if it fails."""
    rating = rating_of(known, sensors)
    write_sheet(store.folder / PAGE, rated_sheet('Fleet', rating, _body(
        store, known, sensors, priors, rating), script=False))


def _body(store: Store, known: Overview, sensors: Sequence[Row],
          priors: Mapping[str, FleetPrior], rating: Rating) -> Iterator[str]:
    """Yield the parts of the page."""
    differ = not_agreeing(sensors)
    yield heading('Calibrations of a fleet', [f'accel_calib {__version__}'])
    yield verdict_box(rating)
    if not has_matplotlib():
        yield paragraph('This page has no figures, because matplotlib is not installed.')
    yield paragraph(f'Not compared: {counted(known.left_out, "recording")} whose poses do not '
                    'determine offset, gain and cross-axis gain, or with other effects than most '
                    'recordings of the sensor.' if known.left_out else '', 'soft')
    odd_names: list[str] = []
    models = sorted(known.models.items(), key=lambda each: (-len(each[1].values), each[0]))
    for number, (model, of_model) in enumerate(models):
        odd = odd_sensors(of_model.values, of_model.deviations)
        odd_names += [sensor for sensor, _, _, _ in odd]
        yield from _of_model(model, of_model, odd, f'model{number}', priors.get(model),
                             drawn=number < _MOST_MODELS)
    yield paragraph(f'Figures of the {_MOST_MODELS} models with the most sensors are shown, of '
                    f'{len(models)} models.' if len(models) > _MOST_MODELS else '', 'soft')
    yield _changes(differ)
    yield _over_time(store, sensors, differ, odd_names)
    yield section('Recordings without a calibration', _errors(known))


def _of_model(model: str, known: OfModel, odd: Sequence[Odd], prefix: str,
              prior: FleetPrior | None, *, drawn: bool) -> Iterator[str]:
    """Yield the sections of a model of sensor."""
    drawn = drawn and has_matplotlib()
    name = f' (model {model})' if model else ''
    values = _figures(of_values(f'{prefix}_values', known, odd)) if drawn else ''
    yield section(f'Values{name}', values, values and paragraph(
        'Histograms over the sensors. Line: median. Triangles: odd sensors.', 'soft'),
        _distribution(known.values))
    yield section(f'Odd sensors{name}', listing(
        odd_words(known, each) for each in odd[:_MOST]),
        _not_shown(len(odd) - _MOST, 'odd value'))
    yield section(f'Effects that several sensors share{name}',
                  listing(shared_effects(known.effects)))
    drift = _figures(of_months(f'{prefix}_months', known)) if drawn else ''
    yield section(f'Drift of all sensors{name}', drift and paragraph(
        'Difference of each calibration from the median of its sensor, by month: the median, and '
        'bands with 50 % and 90 % of the calibrations.'), drift)
    yield section(f'Typical values{name}', _typical(prior) if prior else '')


def _distribution(values: Mapping[str, object]) -> str:
    """Return a table of the distribution of each value over the sensors."""
    table = np.array(list(values.values()))
    rows = []
    for name, column in zip(NAMES, table.T, strict=True):
        zero, factor, unit = scale_of(name)
        parts = (np.quantile(column, [0.0, 0.1, 0.5, 0.9, 1.0]) - zero) * factor
        rows.append((f'{spoken(name)} [{unit}]', *map(short, parts)))
    return scroll_table((counted(len(values), 'sensor'), 'smallest', '10 %', 'median', '90 %',
                         'largest'), rows, 'whole-cells', 'Distribution')


def _typical(fleet: FleetPrior) -> str:
    """Return a table of the typical values and spreads."""
    spread = np.sqrt(np.diag(fleet.prior.covariance))
    rows = []
    for name, mean, sd in zip(parameter_names(MODELS['10'].effects), fleet.prior.mean, spread,
                              strict=True):
        _, factor, unit = scale_of(name)
        rows.append((name.replace('.', ' ').replace('_', ' '), short(mean * factor),
                     short(sd * factor), unit))
    words = (f'Model 10, from {counted(fleet.sensors, "sensor")}, in fleet.yaml for --prior of '
             'fit and refine.')
    return paragraph(words) + scroll_table(('value', 'typical', 'spread', 'unit'), rows,
                                           'whole-cells', 'Typical values')


def _changes(sensors: Sequence[Row]) -> str:
    """Return the section of the sensors whose calibrations differ."""
    rows = [line for row in sensors for line in _change_lines(row)]
    if not rows:
        return ''
    return section('Sensors that changed', paragraph(
        f'The calibrations of {counted(len(sensors), "sensor")} differ by more than their '
        'uncertainty. A change is for good if the next calibration differs from the values before '
        'it, too.'), scroll_table(
        ('sensor', 'first recording after it', 'change', 'lasts'), rows[:_MOST], '',
        'Sensors that changed', long=len(rows) > _LONG), _not_shown(len(rows) - _MOST, 'line'))


def _change_lines(row: Row) -> Iterator[tuple[str, str, str, str]]:
    """Yield the changes of a sensor, or its drift."""
    sensor, drift = row['sensor'], row.get('drift')
    for change in row['changes']:
        date, path = (change['date'] or '')[:10], change.get('recording') or ''
        words, _, _ = change_words(change).rpartition(', ')
        yield sensor, f'{date} {path}'.strip(), words, lasting_words(change['for_good'])
    if drift and drift['p_value'] < _DRIFTS:
        yield sensor, '', f'{spoken(drift["parameter"])} {drift_words(drift)}', 'drift'
    elif not row['changes']:
        yield sensor, '', 'no step or drift that is significant alone', ''


def _over_time(store: Store, sensors: Sequence[Row], differ: Sequence[Row],
               odd: Sequence[str]) -> str:
    """Return the figures of single sensors: changed, odd and newest ones."""
    if not has_matplotlib():
        return ''
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
    folders = {unquote(folder): folder for folder in store.sensors()}
    drawn = [of_sensor(f'sensor{number}', name, alike(store.of_sensor(folders[name])),
                       by_name[name]['changes'] if name in significant else [])
             for number, name in enumerate(chosen)]
    return section('Sensors over time', paragraph(
        'Difference of each calibration from the median of its sensor, with 95 % band. '
        'Line: the sensor changed for good at this recording. Dotted line: only this calibration '
        'differs, or it is the newest one. Sensors that changed, odd sensors, and the newest '
        'recordings.'), _figures(drawn),
        _not_shown(len(by_name) - len(chosen), 'other sensor')) if drawn else ''


def _errors(known: Overview) -> str:
    """Return a table of the recordings without a calibration."""
    if not known.errors:
        return ''
    rows = [(row['recording'], row['error'], row['advice']) for row in known.errors[:_MOST]]
    count = sum(known.counts[status] for status in ('error', 'unread'))
    return scroll_table(('recording', 'error', 'what to do'), rows, '', 'Errors',
                        long=len(rows) > _LONG) + _not_shown(count - len(rows), 'recording')


def _figures(drawn: Iterable[Drawing]) -> str:
    """Return figures; the browser shows the text of a marker that is pointed at."""
    return figures(drawn, 'pair', script=False)


def _not_shown(count: int, what: str) -> str:
    """Return how many are not shown; nothing if all are."""
    return paragraph(f'{counted(count, what)} not shown.', 'soft') if count > 0 else ''
