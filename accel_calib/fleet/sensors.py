# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrations of one sensor over time: whether they agree, and where it changed for good.

A sensor has many steps from one calibration to the next, and a fleet many sensors. A step counts
as a change only if its probability, times the number of steps, is below the level of
`accel_calib.compare`. The change is for good if the calibration after the next one differs, too;
otherwise the calibration after the step is the odd one.

A sensor that drifts steadily differs at every step. A step is therefore a change only if it
remains significant when the drift is subtracted. The drift of a value is here the median of its
rates over the steps, which few large steps do not move. At last a line with a step at each lasting
change is fitted to each value, and the row has the most significant slope.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from .alike import alike
from .store import Row, Store, write_parquet
from ..calibrate import Calibration
from ..compare import History, history_of, LEVEL
from ..errors import AccelCalibError
from ..stored import read_calibration
from ..table import Floats

if TYPE_CHECKING:
    import pyarrow as pa

_MOST_COMPARED = 100
"""Largest number of calibrations of a sensor that are compared: the newest ones."""

_FILE = 'sensors.parquet'
_YEAR_S = 365.25 * 86400.0
_FEWEST_STEPS = 3
"""Smallest number of steps that distinguish a drift from a change."""


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
    Merge the pending rows of a sensor, and compare its calibrations; it runs on a worker.

    Parameters
    ----------
    name : str
        Folder of the sensor.
    store : Store
        The results.

    Returns
    -------
    dict
        The row of the sensor.

    Raises
    ------
    OSError
        If a file cannot be read or written.

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
    The values of a sensor with their steady drift.

    Parameters
    ----------
    names : sequence of str
        Names of the values.
    at : (n,) array
        Times of the calibrations [year], or their numbers without dates.
    values, deviations : (t, n) array
        Values and their standard deviations [g].
    rates : (t,) array
        Median change per unit of `at`; 0 with fewer than `_FEWEST_STEPS` steps.

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
    Return the most significant drift of a value over the dates.

    A line, with a step at each lasting change, is fitted with the stated standard deviations. If
    the values scatter more about it, the standard deviation of the slope is enlarged accordingly.

    Parameters
    ----------
    history : History
        The calibrations.
    changes : mapping of int to bool or None
        Whether a change is for good, by the index of the first calibration after it. If it is not
        for good, this calibration is left out.

    Returns
    -------
    dict or None
        Name of the value, its drift per year with the standard deviation [g], and the probability
        that some value drifts so much by chance. None without enough dates.

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
    write_parquet(store.folder / _FILE, found, sensors_schema())
    return found


def read_sensors(store: Store) -> list[Row]:
    """Return the rows of all sensors; none if there is no file."""
    import pyarrow.parquet as pq

    path = store.folder / _FILE
    return pq.ParquetFile(path).read().to_pylist() if path.exists() else []
