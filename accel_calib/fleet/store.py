# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The results of a fleet on a disk: a Parquet data set, written so that each result is there once.

A worker writes a row to ``pending/<sensor>/<key>.json``. `Store.merge` adds the rows of a sensor
to its Parquet file, and then marks their keys as done. `Store.finish` removes the pending rows
when all that depends on them is written. Each step replaces files atomically, and the rows are
merged by content. So a run can stop anywhere, and the next run merges the same rows again.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import errno
import fcntl
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING

from .inputs import as_folder
from ..compare import NAMES
from ..disk import write_atomically
from ..errors import InputError

if TYPE_CHECKING:
    import pyarrow as pa

Row = dict[str, Any]

UNREAD = '~unread'
"""Folder of the rows of recordings that could not be read; no sensor has this folder."""

_DATA = 'data.parquet'
_TEXTS = ('key', 'content', 'recording', 'sensor_model', 'version', 'date', 'date_from', 'status',
          'error', 'advice', 'rating', 'rating_reason', 'model', 'refined', 'units', 'calibration')
_COUNTS = ('poses', 'poses_used')
_NUMBERS = ('rms_before_mg', 'rms_after_mg', 'held_out_rms_mg', 'noise_floor_mg', 'coverage',
            'temperature', 'seconds',
            *(column for name in NAMES for column in (name, f'{name}.sd')))


def schema() -> pa.Schema:
    """Return the columns of a row; the sensor is the name of its folder."""
    import pyarrow as pa

    texts, numbers = pa.list_(pa.string()), pa.list_(pa.float64())
    parameter = pa.struct([('name', pa.string()), ('value', pa.float64()), ('sd', pa.float64())])
    return pa.schema([
        *((name, pa.string()) for name in _TEXTS), *((name, pa.int64()) for name in _COUNTS),
        *((name, pa.float64()) for name in _NUMBERS), ('determined', pa.bool_()),
        ('effects', texts), ('warnings', texts),
        ('parameters', pa.list_(parameter)), ('prior_values', numbers),
        ('prior_covariance', numbers)])


@dataclass(frozen=True)
class Store:
    """
    The folder of the results.

    Parameters
    ----------
    folder : Path
        The folder; all workers must see it under this name.

    """

    folder: Path

    @property
    def rows(self) -> Path:
        """Return the folder of the Parquet data set."""
        return self.folder / 'recordings'

    @property
    def pending(self) -> Path:
        """Return the folder of the rows that are not in the data set yet."""
        return self.folder / 'pending'

    def has(self, key: str) -> bool:
        """Return whether the result with this key is in the data set."""
        return self._mark(key).exists()

    def add(self, row: Row) -> None:
        """Write a row, to be merged into the data set; raise OSError if it fails."""
        folder = self.pending / as_folder(row['sensor'])
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / f'{row["key"]}.json',
                         lambda file: json.dump(row, file, allow_nan=True))

    def waiting(self) -> list[str]:
        """Return the folders of sensors with pending rows, in order."""
        if not self.pending.is_dir():
            return []
        return sorted(each.name for each in self.pending.iterdir() if each.is_dir())

    def merge(self, name: str) -> int:
        """
        Add the pending rows of a sensor to its Parquet file.

        Parameters
        ----------
        name : str
            Folder of the sensor, as `waiting` returns it.

        Returns
        -------
        int
            Number of rows of the sensor.

        Raises
        ------
        OSError
            If a file cannot be written. The next `merge` completes it.

        """
        folder = self.pending / name
        paths = sorted(folder.glob('*.json'), key=lambda path: path.stat().st_mtime)
        new = [json.loads(path.read_text(encoding='utf-8')) for path in paths]
        old = self.of_sensor(name)
        rows, replaced = _merged(old, new)
        if new:
            self._write(name, rows)
        for key in replaced:
            self._mark(key).unlink(missing_ok=True)
        for row in new:
            mark = self._mark(row['key'])
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.touch()
        return len(rows)

    def finish(self, name: str) -> None:
        """Remove the pending rows of a sensor that are in the data set."""
        folder = self.pending / name
        for path in folder.iterdir():  # with temporary files of killed workers
            if path.suffix != '.json' or self.has(path.stem):
                path.unlink(missing_ok=True)
        if not any(folder.iterdir()):  # a worker of a killed program may still write
            folder.rmdir()

    def replace_unread(self, rows: list[Row]) -> None:
        """Replace the rows of the recordings that could not be read."""
        if rows or (self.rows / f'sensor={UNREAD}').exists():
            self._write(UNREAD, rows)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Make the folder, and hold it for this program; raise InputError if another has it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / 'lock').open('w') as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as err:
                if err.errno not in (errno.EAGAIN, errno.EACCES):
                    raise
                raise InputError(f'another program writes to {self.folder}, expected no other',
                                 'wait for it, or choose another folder') from err
            yield

    def of_sensor(self, name: str) -> list[Row]:
        """Return the rows of a sensor by the name of its folder."""
        import pyarrow.parquet as pq

        path = self.rows / f'sensor={name}' / _DATA
        return pq.ParquetFile(path).read().to_pylist() if path.exists() else []

    def sensors(self) -> list[str]:
        """Return the folders of all sensors in the data set, in order."""
        if not self.rows.is_dir():
            return []
        names = (each.name.partition('=')[2] for each in self.rows.iterdir()
                 if each.name.startswith('sensor='))
        return sorted(name for name in names if name != UNREAD)

    def all_rows(self, columns: Iterable[str] | None = None) -> Iterator[Row]:
        """Yield all rows with their sensor, one sensor at a time."""
        from urllib.parse import unquote

        import pyarrow.parquet as pq

        chosen = None if columns is None else list(columns)
        for name in (*self.sensors(), UNREAD):
            path = self.rows / f'sensor={name}' / _DATA
            if not path.exists():
                continue
            for row in pq.ParquetFile(path).read(chosen).to_pylist():
                yield {**row, 'sensor': unquote(name)}

    def _write(self, name: str, rows: list[Row]) -> None:
        """Replace the Parquet file of a sensor, completely or not at all."""
        folder = self.rows / f'sensor={name}'
        folder.mkdir(parents=True, exist_ok=True)
        write_parquet(folder / _DATA, rows, schema())

    def _mark(self, key: str) -> Path:
        return self.folder / 'done' / key[:2] / key


def write_parquet(path: Path, rows: list[Row], columns: pa.Schema) -> None:
    """Write rows as Parquet, completely or not at all; raise OSError if it fails."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.Table.from_pylist(rows, columns)
    write_atomically(path, lambda file: pq.write_table(table, file.buffer))


def _merged(old: list[Row], new: list[Row]) -> tuple[list[Row], list[str]]:
    """Return the rows in order of date, and the keys of old rows that new ones replace."""
    newest = {row['content']: row for row in new}
    kept = [row for row in old if row['content'] not in newest]
    keys = {row['key'] for row in newest.values()}
    replaced = [row['key'] for row in (*old, *new)
                if row['content'] in newest and row['key'] not in keys]
    return sorted((*kept, *newest.values()),
                  key=lambda row: (row['date'] or '', row['recording'])), replaced
