# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The rows on a disk: a Parquet data set with each result once; and each sensor over time.

**Store.** A worker writes a row to ``pending/<sensor>/<key>.json``. `Store.merge` adds the rows of
a sensor to its Parquet file, and then marks their keys as done, and which sensor has the
recording. `Store.finish` removes the pending rows when all that depends on them is written. Each
step replaces files atomically, and the rows are merged by content. So a run can stop anywhere, and
the next run merges the same rows again. Errors of the store, such as a full disk, are raised: they
concern all recordings.

**Calibrations that are compared.** A calibration is compared as if its effects were known to be
right. A search in few poses sometimes names another effect than in the other recordings, and
offset and gain then differ by much more than their uncertainty. Only calibrations with the same
effects are therefore compared, those with the most frequent effects of the sensor.

**Changes.** A sensor has many steps from one calibration to the next, and a fleet many sensors. A
step counts as a change only if its probability, times the number of steps, is below the level of
`accel_calib.comparison`. The change is for good if the calibration after the next one differs,
too; otherwise the calibration after the step is the odd one.

**Drift.** A sensor that drifts steadily differs at every step. A step is therefore a change only
if it remains significant when the drift is subtracted. The drift of a value is here the median of
its rates over the steps, which few large steps do not move. At last a line with a step at each
lasting change is fitted to each value, and the row has the most significant slope.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import fcntl
from hashlib import blake2b
import json
import os
from pathlib import Path
import shutil
import time
from typing import Any, TYPE_CHECKING
from urllib.parse import unquote

import numpy as np
import scipy

from .recording import as_folder, Row, schema, UNKNOWN
from ..calibration import Calibration
from ..comparison import History, history_of, LEVEL, Parameter
from ..disk import write_atomically
from ..effects import LADDER, OwnEffect
from ..errors import InputError, known_error
from ..stored import read_calibration
from ..table import Floats

if TYPE_CHECKING:
    import pyarrow as pa

UNREAD = '~unread'
"""Folder of the rows of recordings that could not be read; no sensor has this folder."""

_DATA = 'data.parquet'
SENSORS = 'sensors.parquet'
"""File of the rows of all sensors."""

_NEEDED: dict[str, tuple[str, ...]] = {
    SENSORS: ('sensor',), _DATA: ('key', 'content', 'recording', 'date', 'status')}
"""Columns without which a row is damaged, by the name of the file."""


@dataclass(frozen=True)
class Store:
    """
    The folder of the results; all workers must see it under this name.

    It has the data set in ``recordings``, rows to be merged in ``pending``, the keys of rows that
    are merged in ``done``, and the folders of their sensors in ``places``.

    """

    folder: Path

    def data(self, name: str) -> Path:
        """Return the Parquet file of a sensor, by the name of its folder."""
        return self.folder / 'recordings' / f'sensor={name}' / _DATA

    def add(self, row: Row) -> None:
        """
        Write a row, to be merged into the data set; raise OSError if it fails.

        It is written for its sensor, and for those that have the recording or its content so far.
        ValueError is raised for a row that the data set cannot hold.

        """
        import pyarrow as pa

        text, names = json.dumps(row), {as_folder(row['sensor'])}
        pa.Table.from_pylist([json.loads(text)], schema())
        for known in self.places(row).values():
            names.update(known)
        for name in names:
            path = self.folder / 'pending' / name / f'{row["key"]}.json'
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, lambda file: file.write(_sealed(text)))

    def waiting(self) -> list[str]:
        """Return the folders of sensors with pending rows, in order."""
        return sorted(each.name for each in self.folder.glob('pending/*') if each.is_dir())

    def merge(self, name: str) -> None:
        """
        Add the pending rows of a sensor, by the name of its folder, to its Parquet file.

        They replace rows of the same content, and rows of the same recording that have an error.
        A pending row of another sensor replaces the row of the recording here, also of one that
        has been moved. The rows are in order of date. If it raises OSError, the next `merge`
        completes it.

        """
        folder, data = self.folder / 'pending' / name, self.data(name)
        new = [_pending_row(path) for path in sorted(
            folder.glob('*.json'), key=lambda path: path.stat().st_mtime)]
        if not new:
            return
        contents = {row['recording']: row['content'] for row in new}
        old, added = read_parquet(data), [row for row in new if as_folder(row['sensor']) == name]
        newest = {row['content']: row for row in added}
        moved = {*contents.values()} - {*newest}  # perhaps; a copy is still there, too
        rows = [*newest.values(), *(
            row for row in old if row['content'] not in newest
            and (row['content'] not in moved or '://' in row['recording']
                 or Path(row['recording']).exists())
            and (row['recording'] not in contents or (
                row['status'] == 'ok' and row['content'] != contents[row['recording']])))]
        if rows:
            write_parquet(data, sorted(rows, key=lambda row: (
                row['date'] or '', row['recording'])), schema())
        elif data.exists():
            shutil.rmtree(data.parent)
        for key in {row['key'] for row in (*old, *added)} - {row['key'] for row in rows}:
            self.mark(key).unlink(missing_ok=True)
            for path in (self.folder / 'calibrations' / name).glob(f'{key}*'):
                path.unlink(missing_ok=True)
        for row in added:
            mark = self.mark(row['key'])
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.write_text(f'{name}\n{row.get("calibration", "")}', encoding='utf-8')
            for place, known in self.places(row).items():
                if name not in known:
                    place.parent.mkdir(parents=True, exist_ok=True)
                    with place.open('a', encoding='utf-8') as file:
                        file.write(f'{name}\n')

    def finish(self, name: str) -> None:
        """Remove the pending rows of a sensor that are in the data set."""
        folder = self.folder / 'pending' / name
        if not folder.exists():
            return
        for path in folder.iterdir():  # with temporary files of killed workers
            if path.suffix != '.json' or self.mark(path.stem).exists():
                path.unlink(missing_ok=True)
        if not any(folder.iterdir()):  # a worker of a killed program may still write
            folder.rmdir()

    def files(self) -> Iterator[Path]:
        """Yield all files with rows."""
        for pattern in (SENSORS, f'recordings/*/{_DATA}', 'pending/*/*.json'):
            yield from sorted(self.folder.glob(pattern))

    def set_aside(self, path: Path) -> Path:
        """Move a file with rows away, so that they are made again; return its new path."""
        moved = self.folder / 'damaged' / str(time.time_ns()) / path.relative_to(self.folder)
        moved.parent.mkdir(parents=True)
        path.rename(moved)
        return moved

    def forget_lost(self) -> None:
        """Remove the marks of results of which a file is gone, so that they are made again."""
        known = {os.fsencode(each.parent.name.partition('=')[2])
                 for each in self.folder.glob(f'recordings/sensor=*/{_DATA}')}
        for mark in self.folder.glob('done/*/*'):
            name, _, calibration = mark.read_bytes().partition(b'\n')
            if name not in known or not (self.folder / os.fsdecode(calibration)).exists():
                mark.unlink()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Make the folder, and hold it for this program; raise InputError if another has it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / 'lock').open('w') as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as err:
                raise InputError(f'another program writes to {self.folder}, expected no other',
                                 'wait for it, or choose another folder') from err
            yield

    def sensors(self) -> list[str]:
        """Return the folders of all sensors in the data set, in order."""
        names = (each.name.partition('=')[2] for each in self.folder.glob('recordings/sensor=*'))
        return sorted(name for name in names if name != UNREAD)

    def mark(self, key: str) -> Path:
        """Return the file that is there if the result with this key is in the data set."""
        return self.folder / 'done' / key[:2] / key

    def places(self, row: Row) -> dict[Path, list[str]]:
        """Return, by file, the folders of sensors that had the recording, or its content."""
        found = {}
        for column in ('recording', 'content'):
            key = blake2b(row[column].encode(), digest_size=16).hexdigest()
            place = self.folder / 'places' / key[:2] / key
            found[place] = place.read_text('utf-8').splitlines() if place.exists() else []
        return found


def write_parquet(path: Path, rows: list[Row], columns: pa.Schema) -> None:
    """Write rows as Parquet, completely or not at all; raise OSError if it fails."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.Table.from_pylist(rows, columns)
    write_atomically(path, lambda file: pq.write_table(table, file.buffer,
                                                       write_page_checksum=True))


def read_parquet(path: Path) -> list[Row]:
    """Return the rows of a Parquet file; none without a file."""
    import pyarrow.parquet as pq

    if not path.exists():
        return []
    return pq.ParquetFile(path, page_checksum_verification=True).read().to_pylist()


def is_damaged(path: Path) -> bool:
    """Return whether a file of `Store.files`, or a row of it, is damaged; OSError is raised."""
    import pyarrow as pa

    needed = _NEEDED.get(path.name, ())
    if path.parent.name == f'sensor={UNREAD}':
        needed = ('recording', 'status')
    try:
        if path.suffix == '.json':
            _pending_row(path)
            return False
        return any(row[name] is None for row in read_parquet(path) for name in needed)
    except OSError as err:
        if err.errno is not None:
            raise
        return True
    except (ValueError, LookupError, pa.ArrowException):
        return True


def _pending_row(path: Path) -> Row:
    """Return a row that `Store.add` wrote; ValueError if the file is damaged."""
    content = path.read_text(encoding='utf-8')
    text = content.partition('\n')[0]
    if content != _sealed(text):
        raise ValueError('the row and its digest differ')
    row: Row = json.loads(text)
    return row


def _sealed(text: str) -> str:
    """Return a line with its digest; the page checksums of Parquet leave headers uncovered."""
    return f'{text}\n{blake2b(text.encode(), digest_size=8).hexdigest()}\n'


# ----------------------------------------------------------------------------- over time

_MOST_COMPARED = 100
"""Largest number of calibrations of a sensor that are compared: the newest ones."""

_YEAR_S = 365.25 * 86400.0
_FEWEST_STEPS = 3
"""Smallest number of steps that distinguish a drift from a change."""

_SHORTEST_YEARS = 1.0 / 365.25
"""Shortest time from the first to the last calibration that has a drift per year [year]."""


def alike(rows: Iterable[Row]) -> list[Row]:
    """
    Return the rows of a sensor whose values can be compared, in the same order.

    Left out are recordings without a calibration, those whose poses do not determine offset, gain
    and cross-axis gain, and those without the most frequent effects. Models 4, 7 and 10 are alike,
    because `accel_calib.comparison` compares them with the uncertainty of the largest one.

    """
    good = [row for row in rows if row['calibration'] and row['determined']]
    effects = [frozenset(row['effects']) for row in good]
    kinds = [each if each - {*LADDER} else frozenset() for each in effects]
    most = [kind for kind, _ in Counter(kinds).most_common(1)]
    return [row for row, kind in zip(good, kinds, strict=True) if kind in most]


def sensors_schema() -> pa.Schema:
    """Return the columns of the row of a sensor."""
    import pyarrow as pa

    text, number, count = pa.string(), pa.float64(), pa.int64()
    change = pa.struct([
        ('key', text), ('date', text), ('p_value', number), ('parameter', text),
        ('change', number), ('sd', number), ('for_good', pa.bool_()), ('recording', text)])
    drift = pa.struct([('parameter', text), ('per_year', number), ('sd', number),
                       ('p_value', number)])
    return pa.schema([
        ('sensor', text), ('sensor_model', text), ('recordings', count), ('errors', count),
        ('calibrations', count), ('agree', pa.bool_()), ('p_value', number), ('first', text),
        ('last', text), ('changes', pa.list_(change)), ('drift', drift), ('note', text)])


def model_of(rows: Sequence[Row]) -> str:
    """Return the model of a sensor, as its newest row has it."""
    return rows[-1]['sensor_model'] or '' if rows else ''


def merge_sensor(name: str, store: Store, own: tuple[OwnEffect, ...] = ()) -> Row:
    """
    Merge the pending rows of a sensor, compare its calibrations, and return the row of the sensor.

    It runs on a worker. `name` is the folder of the sensor, and `own` are the effects of the user
    that its calibrations may have. OSError is raised if a file cannot be read or written.

    """
    store.merge(name)
    rows = read_parquet(store.data(name))
    sensor = unquote(name)
    good = alike(rows)[-_MOST_COMPARED:] if sensor != UNKNOWN else []
    about: Row = {**dict.fromkeys(sensors_schema().names), 'sensor': sensor,
                  'recordings': len(rows), 'calibrations': len(good),
                  'errors': sum(row['status'] != 'ok' for row in rows), 'changes': [],
                  'sensor_model': model_of(rows)}
    if good:
        about |= {'first': good[0]['date'], 'last': good[-1]['date']}
    if len(good) < 2:
        return about
    try:
        return about | _compared([read_calibration(store.folder / row['calibration'], own)
                                  for row in good], good)
    except OSError:
        raise
    except Exception as err:  # such as calibrations in different units
        return about | {'note': str(known_error(err))}


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
    years, rates = years_of(history), np.zeros(len(history.parameters))
    at = np.arange(float(len(history.moments))) if years is None else years
    steps = np.diff(at)
    if len(steps) >= _FEWEST_STEPS and np.all(steps > 0.0):
        rates = np.median([np.diff(each.values) for each in history.parameters] / steps, axis=1)
    for k, change in enumerate(history.changes):
        most = _most_changed(history, k, k + 1, rates * steps[k], limit)
        if back or most is None or change.comparison.p_value >= limit:
            back = False  # no change, or from the odd one back to the others
            continue
        for_good = None  # the calibration after the newest one is not there yet
        if k + 2 < len(history.moments):
            drift = rates * (at[k + 2] - at[k])
            for_good = (_most_changed(history, k, k + 2, drift, limit) is not None
                        and history.between(k, k + 2).p_value < limit)
        lasting[k + 1] = for_good
        back = for_good is False
        row = rows[order[k + 1]]
        changes.append({'key': row['key'], 'date': row['date'], 'parameter': most.name,
                        'p_value': change.comparison.p_value,
                        'change': float(most.values[k + 1] - most.values[k]),
                        'sd': float(np.hypot(*most.stated_sd[k:k + 2])),
                        'for_good': for_good, 'recording': row['recording']})
    return {**found, 'changes': changes, 'drift': drift_of(history, lasting)}


def _most_changed(history: History, one: int, other: int, drift: Floats, limit: float
                  ) -> Parameter | None:
    """
    Return the value that changed most between two calibrations; None if none did.

    The (t,) changes by the steady drift of the values are subtracted.

    """
    values = history.parameters
    away = np.array([each.values[other] - each.values[one] for each in values]) - drift
    sd = np.array([np.hypot(each.stated_sd[one], each.stated_sd[other]) for each in values])
    far = np.divide(np.abs(away), sd, out=np.zeros(len(sd)), where=sd > 0.0)
    most = int(np.argmax(far))
    least = -scipy.special.ndtri(limit / (2.0 * len(far)))
    return values[most] if far[most] > least else None


def years_of(history: History) -> Floats | None:
    """Return the dates of the calibrations [year]; None if one is not known."""
    dates = [moment.when.timestamp() for moment in history.moments if moment.when is not None]
    return np.array(dates) / _YEAR_S if len(dates) == len(history.moments) else None


def drift_of(history: History, changes: Mapping[int, bool | None] = {}) -> Row | None:
    """
    Return the most significant drift of a value over the dates; None without enough of them.

    A line, with a step at each lasting change, is fitted with the stated standard deviations. If
    the values scatter more about it, the standard deviation of the slope is enlarged accordingly.
    The probability is that some value drifts so much by chance; the drift is per year [g].

    `changes` state whether a change is for good, by the index of the first calibration after it. A
    calibration whose change is not for good is left out.

    """
    years = years_of(history)
    if years is None or np.ptp(years) < _SHORTEST_YEARS:
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
        tail = float(scipy.special.stdtr(dof, -abs(fitted[0]) / spread))
        p_value = 2.0 * tail * len(history.parameters)
        found.append({'parameter': each.name, 'per_year': float(fitted[0]), 'sd': spread,
                      'p_value': min(p_value, 1.0)})
    return min(found, key=lambda each: float(each['p_value']), default=None)


def write_sensors(store: Store, rows: Sequence[Row]) -> list[Row]:
    """Add or replace the rows of sensors, and return the rows of all that have a recording."""
    path = store.folder / SENSORS
    known = {row['sensor']: row for row in (*read_parquet(path), *rows)}
    found = [known[name] for name in sorted(known) if known[name]['recordings']]
    write_parquet(path, found, sensors_schema())
    return found
