# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Statistics over a fleet, collected from a digest of each sensor.

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

"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from urllib.parse import unquote

import numpy as np

from .inputs import UNKNOWN
from .sensors import alike, FEWEST, Typical, typical_of
from .task import Row, Store
from ..compare import NAMES
from ..effects import LADDER
from ..findings import rate_fleet, Rating, scale_of
from ..table import Floats
from ..text import counted, short

MOST_ERRORS = 200
"""Largest number of errors that are kept."""

_FALSE = 0.05
_CHANCE = 0.01
_MAD = 1.4826
_EFFICIENCY = 0.37
"""Efficiency of the median distance as a measure of the spread (Rousseeuw and Croux 1993)."""

_SAMPLE = 400
"""Differences of a month that are kept."""

_SEED = 1

COLUMNS = ('key', 'sensor_model', 'recording', 'date', 'status', 'error', 'advice', 'rating',
           'calibration', 'determined', 'effects', 'parameters', 'prior_values',
           'prior_covariance', *(column for name in NAMES for column in (name, f'{name}.sd')))
"""Columns of the rows of recordings from which a digest is made."""


class Months:
    """The differences of calibrations from the median of their sensor, a sample by month."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._kept: dict[str, Floats] = {}
        self.counts: dict[str, int] = defaultdict(int)

    def add(self, month: str, differences: Floats) -> None:
        """Add the (9,) differences of a calibration; each has the same chance to be kept."""
        kept = self._kept.setdefault(month, np.empty((_SAMPLE, len(NAMES))))
        place = self.counts[month]
        self.counts[month] += 1
        if place >= _SAMPLE:
            place = int(self._rng.integers(self.counts[month]))
        if place < _SAMPLE:
            kept[place] = differences

    def quantiles(self, parts: Sequence[float]) -> tuple[list[str], Floats]:
        """Return the months with `FEWEST` or more calibrations, and (months, parts, 9) values."""
        months = [month for month in sorted(self.counts) if self.counts[month] >= FEWEST]
        return months, np.array([np.quantile(self._kept[month][:self.counts[month]], parts, axis=0)
                                 for month in months])


@dataclass(frozen=True)
class Values:
    """
    The calibrations of a sensor that can be compared.

    Parameters
    ----------
    mean, deviation : (9,) array
        Mean of `NAMES` over the calibrations, and its standard deviation.
    effects : dict
        Values of the newest calibration beyond V and W.
    months : list of str
        Months of the calibrations, for those with a date; none of a single calibration.
    differences : (n, 9) array
        Their differences from the median of the sensor.

    """

    mean: Floats
    deviation: Floats
    effects: dict[str, float]
    months: list[str]
    differences: Floats

    @classmethod
    def of(cls, rows: Sequence[Row]) -> Values:
        """Return the values of rows."""
        values, deviations = table_of(rows)
        dated = [k for k, row in enumerate(rows) if row.get('date') and len(rows) > 1]
        return cls(np.mean(values, axis=0),
                   np.sqrt(np.sum(deviations ** 2, axis=0)) / len(rows),
                   {each['name']: each['value'] for each in rows[-1]['parameters']
                    if each['name'].partition('.')[0] not in LADDER},
                   [rows[k]['date'][:7] for k in dated],
                   (values - np.median(values, axis=0))[dated])


@dataclass(frozen=True)
class Digest:
    """
    What the statistics need of a sensor.

    Parameters
    ----------
    sensor : str
        Its name.
    counts : mapping of str to int
        Recordings by rating, or by status without a rating.
    errors : list of dict
        The first `MOST_ERRORS` rows with an error.
    left_out : int
        Recordings with a calibration whose values are not compared.
    values : mapping of str to Values
        The calibrations that are compared, by model of sensor.
    typical : list of Typical
        What the typical values need.

    """

    sensor: str
    counts: Counter[str]
    errors: list[Row]
    left_out: int
    values: dict[str, Values]
    typical: list[Typical]


def digest_of(name: str, store: Store) -> Digest:
    """Return the digest of a sensor by the name of its folder; it runs on a worker."""
    return digest(unquote(name), store.of_sensor(name, COLUMNS))


def digest(sensor: str, rows: Sequence[Row]) -> Digest:
    """Return the digest of the rows of a sensor, in order of date."""
    by_model: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        if row['status'] == 'ok' and row['calibration']:
            by_model[row['sensor_model'] or ''].append(row)
    compared = {model: alike(of_model) for model, of_model in by_model.items()}
    return Digest(
        sensor, Counter(row['rating'] or row['status'] for row in rows),
        [row for row in rows if row['status'] != 'ok'][:MOST_ERRORS],
        sum(map(len, by_model.values())) - sum(map(len, compared.values())),
        {model: Values.of(good) for model, good in compared.items() if good}, typical_of(rows))


@dataclass(frozen=True)
class OfModel:
    """
    What is known of the sensors of one model.

    Parameters
    ----------
    values, deviations : mapping of str to (9,) array
        Mean of `NAMES` over the calibrations of a sensor, and its standard deviation, by sensor.
    effects : mapping of str to dict
        Values of the newest calibration beyond V and W, by sensor.
    months : Months
        Drift of all sensors together.

    """

    values: dict[str, Floats]
    deviations: dict[str, Floats]
    effects: dict[str, dict[str, float]]
    months: Months

    def add(self, sensor: str, values: Values) -> None:
        """Add a sensor."""
        self.values[sensor], self.deviations[sensor] = values.mean, values.deviation
        self.effects[sensor] = values.effects
        for month, differences in zip(values.months, values.differences, strict=True):
            self.months.add(month, differences)


@dataclass
class Overview:
    """
    Statistics over a fleet.

    Parameters
    ----------
    models : mapping of str to OfModel
        The sensors by their model.
    errors : list of dict
        The first `MOST_ERRORS` rows with an error.
    counts : mapping of str to int
        Recordings by rating, or by status without a rating.
    left_out : int
        Recordings with a calibration whose values are not compared.
    typical : list of Typical
        What the typical values need.

    """

    models: dict[str, OfModel] = field(default_factory=dict)
    errors: list[Row] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    left_out: int = 0
    typical: list[Typical] = field(default_factory=list)


def overview(digests: Iterable[Digest]) -> Overview:
    """Return the statistics of the sensors, which are in order of their names."""
    found, rng = Overview(), np.random.default_rng(_SEED)
    for each in digests:
        found.counts.update(each.counts)
        found.errors += each.errors[:MOST_ERRORS - len(found.errors)]
        found.left_out += each.left_out
        found.typical += each.typical
        for model, values in each.values.items():
            known = found.models.setdefault(model, OfModel({}, {}, {}, Months(rng)))
            known.add(each.sensor, values)
    return found


def table_of(rows: Sequence[Row]) -> tuple[Floats, Floats]:
    """Return the (n, 9) values of `NAMES` of rows, and their standard deviations."""
    return (np.array([[row[name] for name in NAMES] for row in rows], float),
            np.array([[row.get(f'{name}.sd') or 0.0 for name in NAMES] for row in rows], float))


def odd_sensors(values: Mapping[str, Floats], deviations: Mapping[str, Floats] | None = None
                ) -> list[tuple[str, str, float, float]]:
    """
    Return the sensors of one model that are far from the others, the farthest first.

    Parameters
    ----------
    values, deviations : mapping of str to (9,) array
        Values by sensor, and their standard deviations; by default 0.

    Returns
    -------
    list of (str, str, float, float)
        Sensor, name of the value, the value, and its distance in spreads.

    """
    from scipy.special import stdtrit

    if len(values) < FEWEST:
        return []
    names, table = list(values), np.array(list(values.values()))
    own = np.zeros_like(table) if deviations is None else np.array([deviations[name]
                                                                    for name in names])
    away = table - np.median(table, axis=0)
    spread = np.hypot(_MAD * np.median(np.abs(away), axis=0), own)
    far = np.abs(away) / np.maximum(spread, 1e-9)
    limit = -stdtrit(_EFFICIENCY * len(names), _CHANCE / (2.0 * table.size))
    found = [(names[i], NAMES[k], float(table[i, k]), float(far[i, k]))
             for i, k in zip(*np.nonzero(far > limit), strict=True)]
    return sorted(found, key=lambda each: -each[3])


def not_agreeing(sensors: Iterable[Row]) -> list[Row]:
    """Return the sensors whose calibrations differ, with a false discovery rate of `_FALSE`."""
    tested = sorted((row for row in sensors if row['p_value'] is not None),
                    key=lambda row: float(row['p_value']))
    count = len(tested)
    last = max((k for k, row in enumerate(tested, 1) if row['p_value'] <= _FALSE * k / count),
               default=0)
    return tested[:last]


def rating_of(known: Overview, sensors: Sequence[Row]) -> Rating:
    """Return the rating of a fleet."""
    unnamed = sum(int(row['recordings']) for row in sensors if row['sensor'] == UNKNOWN)
    return rate_fleet(known.counts, len(sensors), len(not_agreeing(sensors)), unnamed)


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
