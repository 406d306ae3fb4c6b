# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The page of a fleet: values over the fleet, odd sensors, changes, shared effects, errors.

A sensor is odd in a value if it is so far from the median of its model that one sensor in a
hundred fleets of this size is as far by chance. The spread is computed from the median distance,
so that odd sensors do not enlarge it. Of the sensors whose calibrations do not agree, those are
named that remain with a false discovery rate of `_FALSE` (Benjamini and Hochberg 1995), because a
test of many sensors finds some by chance.

"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .prior import FEWEST
from .store import Row, Store
from .. import __version__
from ..compare.parameters import NAMES
from ..effects import LADDER
from ..errors import counted
from ..files.atomic import write_atomically
from ..report.repeat_charts import in_words, scale_of
from ..report.sheet import heading, listing, scroll_table, section, sheet
from ..significant import short
from ..table import Floats

PAGE = 'fleet.html'
_FALSE = 0.05
_CHANCE = 0.01
_MAD = 1.4826
_EFFICIENCY = 0.37
"""Efficiency of the median distance as a measure of the spread (Rousseeuw and Croux 1993)."""

_MOST = 200
"""Largest number of lines of a table."""

_COLUMNS = ('sensor_model', 'recording', 'date', 'status', 'error', 'advice', 'rating',
            'parameters', *NAMES)


@dataclass(frozen=True)
class Overview:
    """
    What the page shows, collected in one pass over the rows.

    Parameters
    ----------
    values : mapping of str to dict
        Mean of `NAMES` by model of sensor and sensor.
    effects : mapping of str to dict
        Values of the newest calibration beyond V and W, by model and sensor.
    errors : list of dict
        The first rows with an error.
    counts : mapping of str to int
        Recordings by rating, or by status without a rating.

    """

    values: Mapping[str, Mapping[str, Floats]]
    effects: Mapping[str, Mapping[str, Mapping[str, float]]]
    errors: Sequence[Row]
    counts: Mapping[str, int]


def overview(rows: Iterable[Row]) -> Overview:
    """Return what the page shows, from the rows of recordings in order of sensor and date."""
    sums: dict[str, dict[str, list[Any]]] = defaultdict(dict)
    effects: dict[str, dict[str, dict[str, float]]] = defaultdict(dict)
    errors: list[Row] = []
    counts: dict[str, int] = defaultdict(int)
    for row in rows:
        counts[row['rating'] or row['status']] += 1
        if row['status'] != 'ok':
            errors += [row] if len(errors) < _MOST else []
            continue
        if row['rating'] == 'BAD':
            continue
        model, sensor = row['sensor_model'] or '', row['sensor']
        known = sums[model].setdefault(sensor, [0, np.zeros(len(NAMES))])
        known[0] += 1
        known[1] = known[1] + [row[name] for name in NAMES]
        effects[model][sensor] = {each['name']: each['value'] for each in row['parameters']
                                  if each['name'].partition('.')[0] not in LADDER}
    values = {model: {sensor: total / count for sensor, (count, total) in of_model.items()}
              for model, of_model in sums.items()}
    return Overview(values, effects, errors, counts)


def odd_sensors(values: Mapping[str, Floats]) -> list[tuple[str, str, float, float]]:
    """
    Return the sensors that are far from the others.

    Parameters
    ----------
    values : mapping of str to (9,) array
        Values by sensor, of one model.

    Returns
    -------
    list of (str, str, float, float)
        Sensor, name of the value, the value, and its distance in spreads; the farthest first.

    """
    from scipy.special import stdtrit

    if len(values) < FEWEST:
        return []
    names, table = list(values), np.array(list(values.values()))
    away = table - np.median(table, axis=0)
    spread = _MAD * np.median(np.abs(away), axis=0)
    far = np.abs(away) / np.maximum(spread, 1e-9)
    limit = -stdtrit(_EFFICIENCY * len(names), _CHANCE / (2.0 * table.size))
    found = [(names[i], NAMES[k], float(table[i, k]), float(far[i, k]))
             for i, k in zip(*np.nonzero(far > limit), strict=True)]
    return sorted(found, key=lambda each: -each[3])


def not_agreeing(sensors: Iterable[Row]) -> list[Row]:
    """Return the sensors whose calibrations differ, with a false discovery rate of `_FALSE`."""
    tested = sorted((row for row in sensors if row['p_value'] is not None),
                    key=lambda row: float(row['p_value']))
    count = sum(1 for _ in tested)
    last = max((k for k, row in enumerate(tested, 1) if row['p_value'] <= _FALSE * k / count),
               default=0)
    return tested[:last]


def shared_effects(effects: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return a line per value beyond V and W that two or more sensors have, with its range."""
    found: dict[str, list[float]] = defaultdict(list)
    for values in effects.values():
        for name, value in values.items():
            found[name].append(value)
    lines = []
    for name, known in sorted(found.items(), key=lambda each: -len(each[1])):
        if len(known) < 2:
            continue
        low, high = np.quantile(known, [0.1, 0.9])
        _, factor, unit = scale_of(name)
        lines.append(f'{len(known)} of {counted(len(effects), "sensor")}: {name} '
                     f'{short(low * factor)} to {short(high * factor)} {unit}')
    return lines


def write_fleet_page(store: Store, sensors: Sequence[Row]) -> None:
    """Write the page; raise OSError if the file cannot be written."""
    known = overview(store.all_rows(_COLUMNS))
    text = sheet('Fleet', _body(known, sensors))
    write_atomically(store.folder / PAGE, lambda file: file.write(text))


def _body(known: Overview, sensors: Sequence[Row]) -> Iterator[str]:
    """Yield the parts of the page."""
    yield heading('Calibrations of a fleet', [
        counted(sum(known.counts.values()), 'recording'), counted(len(sensors), 'sensor'),
        ', '.join(f'{count} {name}' for name, count in sorted(known.counts.items())),
        f'accel_calib {__version__}'])
    for model, values in sorted(known.values.items()):
        of_model = f' of model {model}' if model else ''
        yield section(f'Values{of_model}', _distribution(values))
        yield section(f'Odd sensors{of_model}', listing(
            f'{sensor}: {name.replace(".", " ")} {in_words(name, value, 0.0)}, {far:.0f} spreads '
            'from the median' for sensor, name, value, far in odd_sensors(values)[:_MOST]))
        yield section(f'Effects that several sensors share{of_model}',
                      listing(shared_effects(known.effects[model])))
    yield section('Sensors that changed', _changes(not_agreeing(sensors)))
    yield section('Recordings without a calibration', scroll_table(
        ('recording', 'error', 'what to do'),
        ((row['recording'], row['error'], row['advice']) for row in known.errors))
        if known.errors else '')


def _distribution(values: Mapping[str, Floats]) -> str:
    """Return a table of the distribution of each value over the sensors."""
    table = np.array(list(values.values()))
    rows = []
    for name, column in zip(NAMES, table.T, strict=True):
        zero, factor, unit = scale_of(name)
        parts = (np.quantile(column, [0.0, 0.1, 0.5, 0.9, 1.0]) - zero) * factor
        rows.append((f'{name.replace(".", " ")} [{unit}]', *map(short, parts)))
    return scroll_table((counted(len(values), 'sensor'), 'smallest', '10 %', 'median', '90 %',
                         'largest'), rows)


def _changes(sensors: Sequence[Row]) -> str:
    """Return a table of the changes of sensors whose calibrations differ."""
    rows = []
    for row in sensors:
        for change in row['changes']:
            lasting = {True: 'for good', False: 'this calibration only', None: 'newest'}
            rows.append((row['sensor'], (change['date'] or '')[:10],
                         change['parameter'].replace('.', ' '),
                         _change_words(change), lasting[change['for_good']]))
    return scroll_table(('sensor', 'first recording after it', 'value', 'change', 'lasts'),
                        rows[:_MOST]) if rows else ''


def _change_words(change: Mapping[str, Any]) -> str:
    """Return a change with its standard deviation."""
    zero = scale_of(change['parameter'])[0]
    return in_words(change['parameter'], change['change'] + zero, change['sd'])
