# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrations of one sensor over time: whether they agree, and where it changed for good.

A sensor has many steps from one calibration to the next, and a fleet many sensors. A step counts
as a change only if its probability, times the number of steps, is below the level of
`accel_calib.compare`. The change is for good if the calibration after the next one differs, too;
otherwise the calibration after the step is the odd one.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TYPE_CHECKING
from urllib.parse import unquote

from .store import Row, Store, write_parquet
from ..calibrate import Calibration
from ..compare import compare, history_of, LEVEL
from ..errors import AccelCalibError
from ..files import read_calibration

if TYPE_CHECKING:
    import pyarrow as pa

_MOST_COMPARED = 100
"""Largest number of calibrations of a sensor that are compared: the newest ones."""

_FILE = 'sensors.parquet'


def sensors_schema() -> pa.Schema:
    """Return the columns of the row of a sensor."""
    import pyarrow as pa

    change = pa.struct([('key', pa.string()), ('date', pa.string()), ('p_value', pa.float64()),
                        ('parameter', pa.string()), ('change', pa.float64()),
                        ('sd', pa.float64()), ('for_good', pa.bool_())])
    return pa.schema([
        ('sensor', pa.string()), ('sensor_model', pa.string()), ('recordings', pa.int64()),
        ('errors', pa.int64()), ('calibrations', pa.int64()), ('agree', pa.bool_()),
        ('p_value', pa.float64()), ('first', pa.string()), ('last', pa.string()),
        ('changes', pa.list_(change)), ('note', pa.string())])


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
    good = [row for row in rows if row['calibration']][-_MOST_COMPARED:]
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
    ordered = [calibrations[k] for k in order]
    found: dict[str, Any] = {'agree': history.whole.agree, 'p_value': history.whole.p_value}
    if history.whole.agree:
        return found
    limit, changes, back = LEVEL / len(history.changes), [], False
    for k, change in enumerate(history.changes):
        if change.comparison.p_value >= limit:
            back = False
            continue
        if back:  # from the odd one back to the others
            back = False
            continue
        for_good = _stays(ordered, k, limit)
        back = for_good is False
        row = rows[order[k + 1]]
        changes.append({'key': row['key'], 'date': row['date'], 'parameter': change.parameter,
                        'p_value': change.comparison.p_value, 'change': change.change,
                        'sd': change.sd, 'for_good': for_good})
    return {**found, 'changes': changes}


def _stays(ordered: Sequence[Calibration], before: int, limit: float) -> bool | None:
    """Return whether the calibration after the next differs, too; None if there is none."""
    if before + 2 >= len(ordered):
        return None
    return compare([ordered[before], ordered[before + 2]]).p_value < limit


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
