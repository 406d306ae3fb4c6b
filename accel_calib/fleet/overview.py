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

**Typical values.** Each sensor has the values x of model 10 (the mean over its calibrations) with
the covariance C. Over the fleet, x is distributed about m with P + C. `estimated` computes m and P
by expectation maximisation. The distribution over sensors is Student's t, so that a few sensors
unlike the others have little weight.

The correlations of few sensors are mostly chance, and would make some combinations of values seem
certain. They are reduced by n / (n + `_SURE`). The mean of n sensors is uncertain itself, which
adds P / n to the covariance for another sensor. At last P is enlarged, if necessary, until half of
the sensors are within the distance that contains half of a normal distribution.

"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from urllib.parse import unquote

import numpy as np
import scipy

from .recording import Row, UNKNOWN
from .sensors import alike, model_of, read_parquet, Store
from ..calibration import FleetPrior
from ..comparison import NAMES
from ..effects import LADDER
from ..estimate import Prior
from ..findings import rate_fleet, Rating, scale_of
from ..table import Floats
from ..text import counted, short
from ..units import SIGMA_OF_MAD

MOST_ERRORS = 200
"""Largest number of errors that are kept."""

FEWEST = 5
"""Smallest number of sensors of a model, or calibrations of a month, for statistics."""

_FALSE = 0.05
_CHANCE = 0.01
_EFFICIENCY = 0.37
"""Efficiency of the median distance as a measure of the spread (Rousseeuw and Croux 1993)."""

_SAMPLE = 400
"""Differences of a month that are kept."""

COLUMNS = ('key', 'sensor_model', 'recording', 'date', 'status', 'error', 'advice', 'rating',
           'calibration', 'determined', 'effects', 'parameters', 'prior_values',
           'prior_covariance', *(column for name in NAMES for column in (name, f'{name}.sd')))
"""Columns of the rows of recordings from which a digest is made."""


Odd = tuple[str, str, float, float]
"""Sensor, name of a value, the value, and its distance from the median in spreads."""


@dataclass
class Months:
    """The differences of calibrations from the median of their sensor, a sample by month."""

    rng: np.random.Generator
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
    `MOST_ERRORS` rows with an error. `left_out` recordings have a calibration that is not
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
    return digest(unquote(name), read_parquet(store.data(name), COLUMNS))


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
        errors=[row for row in rows if row['status'] != 'ok'][:MOST_ERRORS],
        left_out=sum(bool(row['calibration']) for row in rows) - len(good),
        typical=typical_of(named))


@dataclass(frozen=True)
class OfModel:
    """What is known of the sensors of one model: values by sensor, and all differences."""

    values: dict[str, Values]
    months: Months


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
            known = found.models.setdefault(each.model, OfModel({}, Months(rng)))
            known.values[each.sensor] = each.values
            for month, differences in each.differences:
                known.months.add(month, differences)
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
