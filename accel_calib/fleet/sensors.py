# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrations of single sensors over time, and the typical values of a model of sensor.

**Calibrations that are compared.** A calibration is compared as if its effects were known to be
right. A search in few poses sometimes names another effect than in the other recordings, and
offset and gain then differ by much more than their uncertainty. Only calibrations with the same
effects are therefore compared, those with the most frequent effects of the sensor.

**Changes.** A sensor has many steps from one calibration to the next, and a fleet many sensors. A
step counts as a change only if its probability, times the number of steps, is below the level of
`accel_calib.compare`. The change is for good if the calibration after the next one differs, too;
otherwise the calibration after the step is the odd one.

**Drift.** A sensor that drifts steadily differs at every step. A step is therefore a change only
if it remains significant when the drift is subtracted. The drift of a value is here the median of
its rates over the steps, which few large steps do not move. At last a line with a step at each
lasting change is fitted to each value, and the row has the most significant slope.

**Typical values.** Each sensor has the values x of model 10 (the mean over its calibrations) with
the covariance C. Over the fleet, x is distributed about m with P + C. `estimated` computes m and P
by expectation maximisation. The distribution over sensors is Student's t, so that a few sensors
unlike the others have little weight.

The correlations of few sensors are mostly chance, and would make some combinations of values seem
certain. They are reduced by n / (n + `_CHANCE`). The mean of n sensors is uncertain itself, which
adds P / n to the covariance for another sensor. At last P is enlarged, if necessary, until half of
the sensors are within the distance that contains half of a normal distribution.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from .task import Row, SENSORS_FILE, Store, write_parquet
from ..calibrate import Calibration, FleetPrior
from ..compare import History, history_of, LEVEL
from ..effects import LADDER, MODELS, parameter_names
from ..errors import AccelCalibError
from ..estimate import Prior
from ..stored import read_calibration
from ..table import Floats

if TYPE_CHECKING:
    import pyarrow as pa

_MOST_COMPARED = 100
"""Largest number of calibrations of a sensor that are compared: the newest ones."""

_YEAR_S = 365.25 * 86400.0
_FEWEST_STEPS = 3
"""Smallest number of steps that distinguish a drift from a change."""

FEWEST = 5
"""Smallest number of sensors of a model whose typical values are computed."""

PRIOR_FILE = 'fleet.yaml'

Typical = tuple[str, Floats, Floats]
"""Model of a sensor, the mean of its values over its recordings, and its covariance."""

_CHANCE = 50.0

_DOF = 4.0
"""Degrees of freedom of the distribution over sensors; few give odd sensors little weight."""

_STEPS = 200
_CONVERGED = 1e-8
_NAMES = parameter_names(MODELS['10'].effects)
_LEAST_SPREAD_G = 1e-5
"""Smallest spread over sensors [g], far below that of any sensors."""


def alike(rows: Iterable[Row]) -> list[Row]:
    """
    Return the rows of a sensor whose values can be compared, in the same order.

    Left out are recordings without a calibration, those whose poses do not determine offset, gain
    and cross-axis gain, and those without the most frequent effects. Models 4, 7 and 10 are alike,
    because `accel_calib.compare` compares them with the uncertainty of the largest one.

    """
    good = [row for row in rows if row['calibration'] and row['determined']]
    most = next((kind for kind, _ in Counter(map(_kind, good)).most_common(1)), None)
    return [row for row in good if _kind(row) == most]


def _kind(row: Row) -> frozenset[str]:
    """Return the effects of a calibration; none if it has only those of models 4, 7 and 10."""
    effects = frozenset(row['effects'])
    return effects if effects - {*LADDER} else frozenset()


def sensors_schema() -> pa.Schema:
    """Return the columns of the row of a sensor."""
    import pyarrow as pa

    change = pa.struct([('key', pa.string()), ('date', pa.string()), ('p_value', pa.float64()),
                        ('parameter', pa.string()), ('change', pa.float64()),
                        ('sd', pa.float64()), ('for_good', pa.bool_()),
                        ('recording', pa.string())])
    drift = pa.struct([('parameter', pa.string()), ('per_year', pa.float64()),
                       ('sd', pa.float64()), ('p_value', pa.float64())])
    return pa.schema([
        ('sensor', pa.string()), ('sensor_model', pa.string()), ('recordings', pa.int64()),
        ('errors', pa.int64()), ('calibrations', pa.int64()), ('agree', pa.bool_()),
        ('p_value', pa.float64()), ('first', pa.string()), ('last', pa.string()),
        ('changes', pa.list_(change)), ('drift', drift), ('note', pa.string())])


def merge_sensor(name: str, store: Store) -> Row:
    """
    Merge the pending rows of a sensor, compare its calibrations, and return the row of the sensor.

    It runs on a worker. `name` is the folder of the sensor. OSError is raised if a file cannot be
    read or written.

    """
    store.merge(name)
    rows = store.of_sensor(name)
    good = alike(rows)[-_MOST_COMPARED:]
    about: Row = {**dict.fromkeys(sensors_schema().names), 'sensor': unquote(name),
                  'recordings': len(rows), 'calibrations': len(good),
                  'errors': sum(row['status'] != 'ok' for row in rows), 'changes': [],
                  'sensor_model': rows[-1]['sensor_model'] if rows else ''}
    if good:
        about |= {'first': good[0]['date'], 'last': good[-1]['date']}
    if len(good) < 2:
        return about
    try:
        return about | _compared([read_calibration(store.folder / row['calibration'])
                                  for row in good], good)
    except AccelCalibError as err:  # such as calibrations in different units
        return about | {'note': str(err)}


def _compared(calibrations: Sequence[Calibration], rows: Sequence[Row]) -> Row:
    """Return whether the calibrations agree, and their changes."""
    history = history_of(calibrations)
    order = [moment.index for moment in history.moments]
    found: dict[str, Any] = {'agree': history.whole.agree, 'p_value': history.whole.p_value}
    if history.whole.agree:
        return {**found, 'drift': drift_of(history)}
    limit, back = LEVEL / len(history.changes), False
    changes: list[Row] = []
    lasting: dict[int, bool | None] = {}
    steady = _Steady.of(history)
    for k, change in enumerate(history.changes):
        name = steady.changed(k, k + 1, limit)
        if change.comparison.p_value >= limit or name is None:
            back = False
            continue
        if back:  # from the odd one back to the others
            back = False
            continue
        lasting[k + 1] = for_good = _stays(history, steady, k, limit)
        back = for_good is False
        row = rows[order[k + 1]]
        changes.append({'key': row['key'], 'date': row['date'], 'parameter': name,
                        'p_value': change.comparison.p_value, **steady.change(name, k),
                        'for_good': for_good, 'recording': row['recording']})
    return {**found, 'changes': changes, 'drift': drift_of(history, lasting)}


@dataclass(frozen=True)
class _Steady:
    """
    The (t, n) values of a sensor with their standard deviations [g], and their steady drift.

    `at` are the (n,) times of the calibrations [year], or their numbers without dates. `rates` are
    the (t,) median changes per unit of `at`; 0 with fewer than `_FEWEST_STEPS` steps.

    """

    names: Sequence[str]
    at: Floats
    values: Floats
    deviations: Floats
    rates: Floats

    @classmethod
    def of(cls, history: History) -> _Steady:
        """Return the values of a history."""
        years = years_of(history)
        at = np.arange(float(len(history.moments))) if years is None else years
        values = np.array([each.values for each in history.parameters])
        steps = np.diff(at)
        rates = np.zeros(len(values))
        if len(steps) >= _FEWEST_STEPS and np.all(steps > 0.0):
            rates = np.median(np.diff(values) / steps, axis=1)
        return cls([each.name for each in history.parameters], at, values,
                   np.array([each.stated_sd for each in history.parameters]), rates)

    def changed(self, one: int, other: int, limit: float) -> str | None:
        """Return the value that changed most between two calibrations; None if none did."""
        from scipy.special import ndtri

        away = self.values[:, other] - self.values[:, one]
        away -= self.rates * (self.at[other] - self.at[one])
        sd = np.hypot(self.deviations[:, one], self.deviations[:, other])
        far = np.where(sd > 0.0, np.abs(away) / np.where(sd > 0.0, sd, 1.0), 0.0)
        most = int(np.argmax(far))
        return self.names[most] if far[most] > -ndtri(limit / (2.0 * len(far))) else None

    def change(self, name: str, step: int) -> Row:
        """Return the change of a value at a step, with its standard deviation."""
        row = self.names.index(name)
        return {'change': float(self.values[row, step + 1] - self.values[row, step]),
                'sd': float(np.hypot(*self.deviations[row, step:step + 2]))}


def _stays(history: History, steady: _Steady, before: int, limit: float) -> bool | None:
    """Return whether the calibration after the next differs, too; None if there is none."""
    if before + 2 >= len(history.runs):
        return None
    if steady.changed(before, before + 2, limit) is None:
        return False
    return history.between(before, before + 2).p_value < limit


def years_of(history: History) -> Floats | None:
    """Return the dates of the calibrations [year]; None if one is not known."""
    dates = [moment.when.timestamp() for moment in history.moments if moment.when is not None]
    return np.array(dates) / _YEAR_S if len(dates) == len(history.moments) else None


def drift_of(history: History, changes: Mapping[int, bool | None] = {}) -> Row | None:
    """
    Return the most significant drift of a value over the dates; None without enough dates.

    A line, with a step at each lasting change, is fitted with the stated standard deviations. If
    the values scatter more about it, the standard deviation of the slope is enlarged accordingly.
    The probability is that some value drifts so much by chance; the drift is per year [g].

    Parameters
    ----------
    history : History
        The calibrations.
    changes : mapping of int to bool or None
        Whether a change is for good, by the index of the first calibration after it. If it is not
        for good, this calibration is left out.

    """
    from scipy.special import stdtr

    years = years_of(history)
    if years is None:
        return None
    kept = np.ones(len(years), bool)
    kept[[index for index, for_good in changes.items() if not for_good]] = False
    steps = [np.arange(len(years)) >= index for index, for_good in changes.items() if for_good]
    columns = np.column_stack([years - np.mean(years), np.ones(len(years)), *steps])[kept]
    dof = len(columns) - columns.shape[1]
    if dof < 1 or np.linalg.matrix_rank(columns) < columns.shape[1]:
        return None
    found: list[Row] = []
    for each in history.parameters:
        sd = each.stated_sd[kept]
        if not np.all(sd > 0.0):
            continue
        solved = np.linalg.pinv(columns / sd[:, np.newaxis])
        fitted = solved @ (each.values[kept] / sd)
        chi2 = float(np.sum(((each.values[kept] - columns @ fitted) / sd) ** 2))
        spread = float(np.sqrt(np.sum(solved[0] ** 2) * max(chi2 / dof, 1.0)))
        p_value = 2.0 * float(stdtr(dof, -abs(fitted[0]) / spread)) * len(history.parameters)
        found.append({'parameter': each.name, 'per_year': float(fitted[0]), 'sd': spread,
                      'p_value': min(p_value, 1.0)})
    return min(found, key=lambda each: float(each['p_value']), default=None)


def write_sensors(store: Store, rows: Sequence[Row]) -> list[Row]:
    """Add or replace the rows of sensors, and return the rows of all of them."""
    known = {row['sensor']: row for row in (*read_sensors(store), *rows)}
    found = [known[name] for name in sorted(known)]
    write_parquet(store.folder / SENSORS_FILE, found, sensors_schema())
    return found


def read_sensors(store: Store) -> list[Row]:
    """Return the rows of all sensors; none if there is no file."""
    import pyarrow.parquet as pq

    path = store.folder / SENSORS_FILE
    return pq.ParquetFile(path).read().to_pylist() if path.exists() else []


# ----------------------------------------------------------------------------- typical values

def typical_of(rows: Iterable[Row]) -> list[Typical]:
    """Return what `priors_of` needs of a sensor, by model; rows without values are left out."""
    size, by_model = len(_NAMES), dict[str, list[Row]]()
    for row in rows:
        if row['prior_values']:
            by_model.setdefault(row['sensor_model'] or '', []).append(row)
    return [(model, np.mean([row['prior_values'] for row in good], axis=0),
             np.sum([row['prior_covariance'] for row in good], axis=0).reshape(size, size)
             / len(good) ** 2) for model, good in by_model.items()]


def priors_of(sensors: Iterable[Typical]) -> dict[str, FleetPrior]:
    """Return the typical values of the models with at least `FEWEST` sensors."""
    by_model: dict[str, list[Typical]] = {}
    for each in sensors:
        by_model.setdefault(each[0], []).append(each)
    return {model: FleetPrior(model, len(chosen), estimated(
        np.array([values for _, values, _ in chosen]),
        np.array([covariance for _, _, covariance in chosen])))
        for model, chosen in sorted(by_model.items()) if len(chosen) >= FEWEST}


def estimated(values: Floats, covariances: Floats) -> Prior:
    """
    Return mean and covariance for another sensor of the fleet.

    Parameters
    ----------
    values : (n, p) array
        Values of n sensors.
    covariances : (n, p, p) array
        Their covariances.

    """
    from scipy.special import chdtri

    count, size = values.shape
    mean = np.median(values, axis=0)
    spread = np.median(np.abs(values - mean), axis=0) / 0.6745 + _LEAST_SPREAD_G
    covariance: Floats = np.diag(spread ** 2)
    for _ in range(_STEPS):
        before = covariance
        mean, covariance = _step(values, covariances, mean, covariance)
        if np.max(np.abs(covariance - before)) <= _CONVERGED * np.max(covariance):
            break
    share = count / (count + _CHANCE)
    shrunk = share * covariance + (1.0 - share) * np.diag(np.diag(covariance))
    shrunk = (shrunk + _LEAST_SPREAD_G ** 2 * np.eye(size)) * (1.0 + 1.0 / count)
    median = float(np.median(_squared(values - mean, shrunk + covariances)))
    return Prior(mean, shrunk * max(median / chdtri(size, 0.5), 1.0))


def _squared(away: Floats, covariances: Floats) -> Floats:
    """Return the (n,) squared distances, per (n, p, p) covariance."""
    solved = np.linalg.solve(covariances, away[:, :, np.newaxis])[:, :, 0]
    return np.einsum('np,np->n', away, solved)


def _step(values: Floats, covariances: Floats, mean: Floats, covariance: Floats
          ) -> tuple[Floats, Floats]:
    """Return mean and covariance after a step of expectation maximisation."""
    away = values - mean
    gain = covariance @ np.linalg.inv(covariance + covariances)  # (n, p, p)
    likely = np.einsum('npq,nq->np', gain, away)
    weight = (_DOF + values.shape[1]) / (_DOF + _squared(away, covariance + covariances))
    left = covariance - gain @ covariance
    centre = mean + weight @ likely / np.sum(weight)
    off = mean + likely - centre
    spread = np.einsum('n,np,nq->pq', weight, off, off) + np.sum(left, axis=0)
    return centre, (spread + spread.T) / (2.0 * len(values))
