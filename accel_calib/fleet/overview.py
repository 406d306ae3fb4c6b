# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Statistics over a fleet, collected from a digest of each sensor, and its page.

The workers make the digests: `digest_of`. The memory of the program grows with the number of
sensors (about 130 numbers each), not with that of recordings.

**Odd sensors.** A sensor is odd in a value if it is so far from the median of its model that one
sensor in a hundred fleets of this size is as far by chance. The spread is computed from the median
distance, so that odd sensors do not enlarge it. The standard deviation of the value itself is
added, because a sensor that is known badly is often far from the others.

**Changed sensors.** Of the sensors whose calibrations do not agree, those are named that remain
with a false discovery rate of `_FALSE` (Benjamini and Hochberg 1995), because a test of many
sensors finds some by chance.

**Drift of the fleet.** The difference of each calibration from the median of its sensor, by month.
A month keeps a random sample of `_SAMPLE` differences, from which its quantiles are computed.

**Typical values.** Each sensor has the values x of model 10 (the mean over its calibrations) with
the covariance C. Over the fleet, x is distributed about m with P + C. `estimated` computes m and P
by expectation maximisation. The distribution over sensors is Student's t, so that a few sensors
unlike the others have little weight.

The correlations of few sensors are mostly chance, and would make some combinations of values seem
certain. They are reduced by n / (n + `_SURE`). The mean of n sensors is uncertain itself, which
adds P / n to the covariance for another sensor. At last P is enlarged, if necessary, until half of
the sensors are within the distance that contains half of a normal distribution.

**Page.** Its size does not grow with the number of sensors: tables end after 200 lines, and lists
of figures after `_MOST_CHANGED`, `_MOST_ODD` and `_NEWEST` sensors. The values are drawn as
histograms, and the drift of all sensors as bands of quantiles. The page says how many sensors it
does not show; `sensors.parquet` and the rows of the recordings have all of them.

"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from importlib.util import find_spec
from itertools import islice
from typing import Any
from urllib.parse import unquote

import numpy as np
import scipy

from .recording import Row, UNKNOWN
from .sensors import alike, model_of, read_parquet, Store
from ..calibration import FleetPrior
from ..comparison import NAMES
from ..effects import LADDER, MODELS, parameter_names
from ..estimate import Prior
from ..findings import change_words, CROSS, rate_fleet, Rating, scale_of
from ..report.sheet import (
    ACCENT, add_band, AFTER, BAND, BEFORE, Drawing, drawn, EDGE, FAINT, legend_below, Mark, Marks,
    page, THIRD, write_page)
from ..report.stability import GROUPS, label_dates, named_words, places_of
from ..statistics import SIGMA_OF_MAD
from ..table import Floats
from ..text import counted, short, with_minus

MOST_ERRORS = 200
"""Largest number of recordings without a calibration that are kept."""

FEWEST = 5
"""Smallest number of sensors of a model, or calibrations of a month, for statistics."""

_FALSE = 0.05
_CHANCE = 0.01
_EFFICIENCY = 0.37
"""Efficiency of the median distance as a measure of the spread (Rousseeuw and Croux 1993)."""

_SAMPLE = 400
"""Differences of a month that are kept."""

Odd = tuple[str, str, float, float]
"""Sensor, name of a value, the value, and its distance from the median in spreads."""


@dataclass
class OfModel:
    """
    What is known of the sensors of one model.

    `values` are those by sensor. `kept` are differences of calibrations from the median of their
    sensor, a sample by month, and `counts` the number of all.

    """

    rng: np.random.Generator
    values: dict[str, Values] = field(default_factory=dict)
    kept: dict[str, Floats] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)

    def add(self, month: str, differences: Floats) -> None:
        """Add the (9,) differences of a calibration; each has the same chance to be kept."""
        kept = self.kept.setdefault(month, np.empty((_SAMPLE, len(NAMES))))
        place = self.counts[month]
        self.counts[month] += 1
        if place >= _SAMPLE:
            place = int(self.rng.integers(self.counts[month]))
        if place < _SAMPLE:
            kept[place] = differences

    def quantiles(self, parts: Sequence[float]) -> tuple[list[str], Floats]:
        """Return the months with `FEWEST` or more calibrations, and (months, parts, 9) values."""
        months = [month for month in sorted(self.counts) if self.counts[month] >= FEWEST]
        return months, np.array([np.quantile(self.kept[month][:self.counts[month]], parts, axis=0)
                                 for month in months])


@dataclass(frozen=True)
class Values:
    """
    The calibrations of a sensor that can be compared.

    `mean` (9,) of `NAMES` has the standard `deviation` (9,). `effects` are the values beyond V and
    W of the newest calibration.

    """

    mean: Floats
    deviation: Floats
    effects: Mapping[str, float]


@dataclass(frozen=True)
class Digest:
    """
    What the statistics need of a sensor.

    `counts` are recordings by rating, or by status without a rating. `errors` are the first
    `MOST_ERRORS` rows without a calibration. `left_out` recordings have a calibration that is not
    compared; `values` are those that are, and None without any. `differences` (9,) from the median
    of the sensor are those of calibrations with a date, with their month; there are none of a
    single calibration. `typical` is for `priors_of`.

    """

    sensor: str
    model: str
    counts: Counter[str]
    errors: list[Row]
    left_out: int
    values: Values | None
    differences: list[tuple[str, Floats]]
    typical: list[Typical]


def digest_of(name: str, store: Store) -> Digest:
    """Return the digest of a sensor by the name of its folder; it runs on a worker."""
    return digest(unquote(name), read_parquet(store.data(name)))


def digest(sensor: str, rows: Sequence[Row]) -> Digest:
    """Return the digest of the rows of a sensor, in order of date; without a name, no values."""
    named = rows if sensor != UNKNOWN else ()
    good, known, differences = alike(named), None, []
    if good:
        values, deviations = table_of(good)
        known = Values(
            np.mean(values, axis=0), np.sqrt(np.sum(deviations ** 2, axis=0)) / len(good),
            {each['name']: each['value'] for each in good[-1]['parameters']
             if each['name'].partition('.')[0] not in LADDER})
        away = values - np.median(values, axis=0)
        differences = [(row['date'][:7], change) for row, change in zip(good, away, strict=True)
                       if row.get('date') and len(good) > 1]
    return Digest(
        sensor=sensor, model=model_of(rows), values=known, differences=differences,
        counts=Counter(row['rating'] or row['status'] for row in rows),
        errors=[row for row in rows if not row['calibration']][:MOST_ERRORS],
        left_out=sum(bool(row['calibration']) for row in rows) - len(good),
        typical=typical_of(row for row in named if row['calibration']))


@dataclass
class Overview:
    """
    Statistics over a fleet: the fields of `Digest` for all sensors, and the sensors by model.

    `errors` are the first `MOST_ERRORS`.

    """

    models: dict[str, OfModel] = field(default_factory=dict)
    errors: list[Row] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    left_out: int = 0
    typical: list[Typical] = field(default_factory=list)


def overview(digests: Iterable[Digest]) -> Overview:
    """Return the statistics of the sensors, which are in order of their names."""
    found, rng = Overview(), np.random.default_rng(1)
    for each in digests:
        found.counts.update(each.counts)
        found.errors += each.errors[:MOST_ERRORS - len(found.errors)]
        found.left_out += each.left_out
        found.typical += each.typical
        if each.values is not None:
            known = found.models.setdefault(each.model, OfModel(rng))
            known.values[each.sensor] = each.values
            for month, differences in each.differences:
                known.add(month, differences)
    return found


def table_of(rows: Sequence[Row]) -> tuple[Floats, Floats]:
    """Return the (n, 9) values of `NAMES` of rows, and their standard deviations."""
    return (np.array([[row[name] for name in NAMES] for row in rows], float),
            np.array([[row.get(f'{name}.sd') or 0.0 for name in NAMES] for row in rows], float))


def odd_sensors(values: Mapping[str, Values]) -> list[Odd]:
    """Return the sensors of one model that are far from the others, the farthest first."""
    if len(values) < FEWEST:
        return []
    names, table = list(values), np.array([each.mean for each in values.values()])
    own = np.array([each.deviation for each in values.values()])
    away = table - np.median(table, axis=0)
    spread = np.hypot(SIGMA_OF_MAD * np.median(np.abs(away), axis=0), own)
    far = np.abs(away) / np.maximum(spread, 1e-9)
    limit = -scipy.special.stdtrit(_EFFICIENCY * len(names), _CHANCE / (2.0 * table.size))
    found = [(names[i], NAMES[k], float(table[i, k]), float(far[i, k]))
             for i, k in zip(*np.nonzero(far > limit), strict=True)]
    return sorted(found, key=lambda each: -each[3])


def not_agreeing(sensors: Iterable[Row]) -> list[Row]:
    """Return the sensors whose calibrations differ, with a false discovery rate of `_FALSE`."""
    tested = sorted((row for row in sensors if row['p_value'] is not None),
                    key=lambda row: float(row['p_value']))
    if not tested:
        return []
    adjusted = scipy.stats.false_discovery_control([row['p_value'] for row in tested])
    return [row for row, p_value in zip(tested, adjusted, strict=True) if p_value <= _FALSE]


def rating_of(known: Overview, sensors: Sequence[Row]) -> Rating:
    """Return the rating of a fleet."""
    unnamed = sum(int(row['recordings']) for row in sensors if row['sensor'] == UNKNOWN)
    return rate_fleet(known.counts, len(sensors), len(not_agreeing(sensors)), unnamed)


def shared_effects(values: Mapping[str, Values]) -> list[str]:
    """Return a line per value beyond V and W that two or more sensors have, with its range."""
    found: dict[str, list[float]] = defaultdict(list)
    for own in values.values():
        for name, value in own.effects.items():
            found[name].append(value)
    lines = []
    for name, known in sorted(found.items(), key=lambda each: -len(each[1])):
        low, high = np.quantile(known, [0.1, 0.9])
        _, factor, unit = scale_of(name)
        if len(known) > 1:
            lines.append(f'{len(known)} of {counted(len(values), "sensor")}: {name} '
                         f'{short(low * factor)} to {short(high * factor)} {unit}')
    return lines


# ----------------------------------------------------------------------------- typical values

Typical = tuple[str, Floats, Floats]
"""Model of a sensor, the mean of its values over its recordings, and its covariance."""

_SURE = 50.0

_DOF = 4.0
"""Degrees of freedom of the distribution over sensors; few give odd sensors little weight."""

_LEAST_SPREAD_G = 1e-5
"""Smallest spread over sensors [g], far below that of any sensors."""


def typical_of(rows: Iterable[Row]) -> list[Typical]:
    """Return what `priors_of` needs of a sensor; nothing if no row has values."""
    good = [row for row in rows if row['prior_values']]
    if not good:
        return []
    mean = np.mean([row['prior_values'] for row in good], axis=0)
    covariance = np.sum([row['prior_covariance'] for row in good], axis=0) / len(good) ** 2
    return [(model_of(good), mean, covariance.reshape(len(mean), len(mean)))]


def priors_of(sensors: Iterable[Typical]) -> dict[str, FleetPrior]:
    """Return the typical values of the models with at least `FEWEST` sensors."""
    by_model: dict[str, list[list[Floats]]] = defaultdict(list)
    for model, *known in sensors:
        by_model[model].append(known)
    return {model: FleetPrior(model, len(chosen), estimated(*(
        np.array(each) for each in zip(*chosen))))
            for model, chosen in sorted(by_model.items()) if len(chosen) >= FEWEST}


def estimated(values: Floats, covariances: Floats) -> Prior:
    """Return mean and covariance for another sensor, from (n, p) values, (n, p, p) covariances."""
    count, size = values.shape
    mean = np.median(values, axis=0)
    spread = SIGMA_OF_MAD * np.median(np.abs(values - mean), axis=0) + _LEAST_SPREAD_G
    covariance: Floats = np.diag(spread ** 2)
    for _ in range(200):
        before, away = covariance, values - mean  # a step of expectation maximisation
        gain = covariance @ np.linalg.inv(covariance + covariances)  # (n, p, p)
        weight = (_DOF + size) / (_DOF + _squared(away, covariance + covariances))
        likely = np.einsum('npq,nq->np', gain, away)
        centre = mean + weight @ likely / np.sum(weight)
        off = mean + likely - centre
        spread = np.einsum('n,np,nq->pq', weight, off, off) + np.sum(
            covariance - gain @ covariance, axis=0)
        mean, covariance = centre, (spread + spread.T) / (2.0 * count)
        if np.max(np.abs(covariance - before)) <= 1e-8 * np.max(covariance):
            break
    share = count / (count + _SURE)
    shrunk = share * covariance + (1.0 - share) * np.diag(np.diag(covariance))
    shrunk = (shrunk + _LEAST_SPREAD_G ** 2 * np.eye(size)) * (1.0 + 1.0 / count)
    median = float(np.median(_squared(values - mean, shrunk + covariances)))
    return Prior(mean, shrunk * max(median / scipy.special.chdtri(size, 0.5), 1.0))


def _squared(away: Floats, covariances: Floats) -> Floats:
    """Return the (n,) squared distances, per (n, p, p) covariance."""
    solved = np.linalg.solve(covariances, away[:, :, np.newaxis])[:, :, 0]
    return np.einsum('np,np->n', away, solved)


# ----------------------------------------------------------------------------- the page

PAGE = 'fleet.html'

_MOST_MODELS = 6
"""Largest number of models of sensors with figures."""

_MOST_CHANGED, _MOST_ODD, _NEWEST = 6, 4, 2
"""Largest numbers of sensors whose calibrations are drawn over time."""

_LASTING = {True: 'for good', False: 'this calibration only', None: 'newest'}
"""Words for whether a change lasts."""

_DRIFTS = 0.05
"""Probability below which a drift is stated."""


def changes_of(sensors: Iterable[Row]) -> list[tuple[str, str, str, str]]:
    """Return sensor, recording, words and duration of the changes of sensors that differ."""
    found = []
    for row in not_agreeing(sensors):
        sensor, drift = row['sensor'], row.get('drift')
        for change in row['changes']:
            date, path = (change['date'] or '')[:10], change.get('recording') or ''
            words = change_words(change['parameter'], change['change'], change['sd'])
            found.append((sensor, f'{date} {path}'.strip(), words, _LASTING[change['for_good']]))
        if drift and drift['p_value'] < _DRIFTS:
            words = change_words(drift['parameter'], drift['per_year'], drift['sd'])
            found.append((sensor, '', f'{words} per year', 'drift'))
        elif not row['changes']:
            found.append((sensor, '', 'no step or drift that is significant alone', ''))
    return found


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
        differ=differ, changes=changes_of(sensors), over_time=drawings, others=others,
        failed=sum(known.counts[status] for status in ('BAD', 'error', 'unread')),
        errors=[(row['recording'], row['error'] or f'BAD: {row["rating_reason"]}', row['advice'])
                for row in known.errors]))


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
    months, found = known.quantiles((0.05, 0.25, 0.5, 0.75, 0.95))
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
