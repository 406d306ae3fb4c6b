# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
One recording to one row, and the rows on a disk: a Parquet data set with each result once.

`calibrate_recording` runs on a worker: capture, fit, refine, rate. It needs bounded memory: a log
is read in blocks, and the row has a bounded size. Errors that belong to the recording are part of
the row. Errors of the store, such as a full disk, are raised: they concern all recordings.

A worker writes a row to ``pending/<sensor>/<key>.json``. `Store.merge` adds the rows of a sensor
to its Parquet file, and then marks their keys as done. `Store.finish` removes the pending rows
when all that depends on them is written. Each step replaces files atomically, and the rows are
merged by content. So a run can stop anywhere, and the next run merges the same rows again.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
import errno
import fcntl
import hashlib
import json
import os
from pathlib import Path
import threading
import time
from typing import Any, TYPE_CHECKING

import numpy as np

from .inputs import as_folder, content_hash, date_of, Input, matched, on_disk, sensor_of, UNKNOWN
from .. import __version__
from ..calibrate import Calibration, determines, directions_of, fit_poses
from ..compare import NAMES, rotation_free
from ..disk import write_atomically
from ..effects import known_code, MODELS
from ..errors import AccelCalibError, crash_words, InputError, RefusedFitError, system_error
from ..findings import residual_figures
from ..intake import Intake, poses_of
from ..logs import LogOptions
from ..pipeline import calibrated, Outcome, Plan
from ..session import WorkerProcess
from ..stored import write_calibration
from ..stored.exports import export
from ..table import Poses

if TYPE_CHECKING:
    import pyarrow as pa

Row = dict[str, Any]

UNREAD = '~unread'
"""Folder of the rows of recordings that could not be read; no sensor has this folder."""

_DATA = 'data.parquet'
SENSORS_FILE = 'sensors.parquet'
_TEXTS = ('key', 'content', 'recording', 'sensor_model', 'version', 'date', 'date_from', 'status',
          'error', 'advice', 'rating', 'rating_reason', 'model', 'refined', 'units', 'calibration')
_COUNTS = ('poses', 'poses_used')
_NUMBERS = ('rms_before_mg', 'rms_after_mg', 'held_out_rms_mg', 'noise_floor_mg', 'coverage',
            'temperature', 'seconds',
            *(column for name in NAMES for column in (name, f'{name}.sd')))

RESULTS = 2
"""Version of the rows. Another version makes all recordings be calibrated again."""

STATUS = ('ok', 'error', 'unread', 'skipped')
"""What can happen to a recording; unread: it could not be read, and is tried again."""

_WHOLE_MODEL = '10'


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

    def merge(self, name: str) -> None:
        """
        Add the pending rows of a sensor, by the name of its folder, to its Parquet file.

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
            mark.write_text(name, encoding='utf-8')

    def finish(self, name: str) -> None:
        """Remove the pending rows of a sensor that are in the data set."""
        folder = self.pending / name
        if not folder.exists():
            return
        for path in folder.iterdir():  # with temporary files of killed workers
            if path.suffix != '.json' or self.has(path.stem):
                path.unlink(missing_ok=True)
        if not any(folder.iterdir()):  # a worker of a killed program may still write
            folder.rmdir()

    def files(self) -> Iterator[Path]:
        """Yield all files with rows."""
        for pattern in (SENSORS_FILE, f'recordings/*/{_DATA}', 'pending/*/*.json'):
            yield from sorted(self.folder.glob(pattern))

    def set_aside(self, path: Path) -> Path:
        """Move a file with rows away, so that they are made again; return its new path."""
        moved = self.folder / 'damaged' / str(time.time_ns()) / path.relative_to(self.folder)
        moved.parent.mkdir(parents=True)
        if path.name == _DATA:
            sensor = path.parent.name.partition('=')[2]
            for mark in self.folder.glob('done/*/*'):
                if mark.read_text(encoding='utf-8') in ('', sensor):  # '': of older versions
                    mark.unlink()
        path.rename(moved)
        return moved

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

    def of_sensor(self, name: str, columns: Sequence[str] | None = None) -> list[Row]:
        """Return the rows of a sensor by the name of its folder, with all columns or these."""
        import pyarrow.parquet as pq

        path = self.rows / f'sensor={name}' / _DATA
        return pq.ParquetFile(path).read(columns).to_pylist() if path.exists() else []

    def sensors(self) -> list[str]:
        """Return the folders of all sensors in the data set, in order."""
        if not self.rows.is_dir():
            return []
        names = (each.name.partition('=')[2] for each in self.rows.iterdir()
                 if each.name.startswith('sensor='))
        return sorted(name for name in names if name != UNREAD)

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


def is_damaged(path: Path) -> bool:
    """Return whether a file of `Store.files` cannot be read; raise OSError of the disk."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        if path.suffix != '.json':
            pq.ParquetFile(path).read()
            return False
        row = json.loads(path.read_text(encoding='utf-8'))
        pa.Table.from_pylist([row], schema())
        return not row.keys() >= {'sensor', 'key', 'content', 'date', 'recording'}
    except OSError as err:
        if err.errno is not None:
            raise
        return True
    except (ValueError, TypeError, AttributeError, pa.ArrowException):
        return True


def _merged(old: list[Row], new: list[Row]) -> tuple[list[Row], list[str]]:
    """Return the rows in order of date, and the keys of old rows that new ones replace."""
    newest = {row['content']: row for row in new}
    kept = [row for row in old if row['content'] not in newest]
    keys = {row['key'] for row in newest.values()}
    replaced = [row['key'] for row in (*old, *new)
                if row['content'] in newest and row['key'] not in keys]
    return sorted((*kept, *newest.values()),
                  key=lambda row: (row['date'] or '', row['recording'])), replaced


# ----------------------------------------------------------------------------- one recording

@dataclass(frozen=True)
class Options:
    """
    How the recordings of a fleet are calibrated.

    Parameters
    ----------
    sensor_from, model_from : str
        Regular expressions for the name of the sensor in the path, and for its model in its name.
    log : LogOptions
        How to read the logs.
    settings : dict
        Fields of `accel_calib.capture.CaptureSettings`.
    refined : bool
        Look for effects beyond offset, gain and cross-axis.
    exports : tuple of str
        Formats of `accel_calib.stored.exports.FORMATS` to write beside each calibration.
    own : tuple of str
        Names of own effects of the user, which are tried beside the catalogue.

    """

    sensor_from: str = ''
    model_from: str = ''
    log: LogOptions = LogOptions()
    settings: dict[str, Any] = field(default_factory=dict)
    refined: bool = True
    exports: tuple[str, ...] = ()
    own: tuple[str, ...] = ()


@dataclass(frozen=True)
class Done:
    """What a worker returns: one of `STATUS`, and the row of an unread recording."""

    status: str
    row: Row | None = None


_apart = threading.local()
"""The process of each thread in which recordings are calibrated, so that it can be ended."""


def calibrate_recording(found: Input, options: Options, store: Store, limit_s: float) -> Done:
    """
    Calibrate one recording, and add the result to the store; raise OSError if it fails.

    A recording that takes longer than `limit_s` [s] counts as unread.

    """
    begin = time.perf_counter()
    if (shown := os.fsencode(found.path).decode(errors='backslashreplace')) != found.path:
        return Done('unread', unread_row(Input(shown, ''), options, InputError(
            f'the name {shown} is not UTF-8, expected UTF-8', 'rename it')))
    try:
        with on_disk(found.path) as path:
            content = content_hash(path)
            key = key_of(content, found, options)
            if store.has(key):
                return Done('skipped')
            row, calibration = _apart_from_here().call_within(limit_s, _result, found, path,
                                                              options)
    except TimeoutError:
        return Done('unread', unread_row(found, options, InputError(
            f'{found.path} takes longer than {limit_s:g} s, expected less',
            'raise --time-limit, or leave it out')))
    except (OSError, EOFError) as err:
        error = system_error(err if isinstance(err, OSError) else OSError(str(err)))
        return Done('unread', unread_row(found, options, error))
    except AccelCalibError as err:  # an address without its package, or a missing match
        return Done('unread', unread_row(found, options, err))
    row |= {'key': key, 'content': content, 'seconds': time.perf_counter() - begin}
    if calibration is not None:
        name = f'calibrations/{as_folder(row["sensor"])}/{key}.yaml'
        (store.folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_calibration(store.folder / name, calibration, keep_before=False)
        row['calibration'] = name
        row['warnings'] += _exported(calibration, store.folder / name, options.exports)
    store.add(row)
    return Done(row['status'])


def _apart_from_here() -> WorkerProcess:
    """Return the process of this thread; it ends with this process."""
    if not hasattr(_apart, 'process'):
        _apart.process = WorkerProcess(idle=False)
    process: WorkerProcess = _apart.process
    return process


def _exported(calibration: Calibration, path: Path, formats: Sequence[str]) -> list[str]:
    """Write exports beside a calibration; return what they do not hold, or why there is none."""
    found = []
    for name in formats:
        try:
            made = export(calibration, name)
        except AccelCalibError as err:
            found.append(f'no export to {name}: {err}')
            continue
        end = Path(made.suffix).suffix or made.suffix  # two formats have the same suffix
        write_atomically(path.with_name(f'{path.stem}_{name}{end}'), made.write)
        found += [f'{name}: {line}' for line in made.losses]
    return found


def key_of(content: str, found: Input, options: Options) -> str:
    """Return the key of a result: content, name from the path, version, options, own effects."""
    try:
        place = sensor_of(found, '', options.sensor_from)
    except AccelCalibError as err:
        place = str(err)
    stated = asdict(options)
    own = [code.hex() for code in known_code().values()] if stated.pop('own') else []
    about = json.dumps([content, place, __version__, RESULTS, stated, *own], default=str,
                       sort_keys=True)
    return hashlib.blake2b(about.encode(), digest_size=16).hexdigest()


def _result(found: Input, path: Path, options: Options) -> tuple[Row, Calibration | None]:
    """Return the row of a recording, and its calibration unless it is BAD or failed."""
    row = _about(found, options, None, path)
    try:
        intake = poses_of(path, options.log, options.settings)
        row = _about(found, options, intake.poses, path)
        outcome = calibrated(intake.poses, intake.units, Plan(
            sensor=row['sensor'], refined=options.refined, also=options.own))
    except OSError:
        raise  # it may be possible to read it later
    except AccelCalibError as err:
        return {**row, **failed(err, {str(path): found.path})}, None
    except Exception as err:  # a defect of this program must not stop the other recordings
        return {**row, 'status': 'error', 'error': crash_words(err),
                'advice': 'report it, with the recording'}, None
    calibration = replace(outcome.calibration, date=row['date'])
    stored = outcome.rating.name != 'BAD'
    return {**row, **_figures(intake, outcome)}, calibration if stored else None


def failed(error: AccelCalibError, names: Mapping[str, str] = {}) -> Row:
    """Return the columns of an error, with these names for those of temporary copies."""
    message = error.message
    for local, name in names.items():
        message = message.replace(local, name)
    return {'status': 'error', 'error': message, 'advice': error.advice}


def unread_row(found: Input, options: Options, error: AccelCalibError) -> Row:
    """Return the row of a recording that could not be read."""
    return {**_about(found, options, None, None), **failed(error), 'status': 'unread'}


def _about(found: Input, options: Options, poses: Poses | None, path: Path | None) -> Row:
    """Return the columns about a recording: sensor, model and date."""
    row: Row = {'recording': found.path, 'version': __version__, 'sensor': UNKNOWN}
    row['date'], row['date_from'] = date_of(
        found, poses, os.stat(path).st_mtime if path and '://' not in found.path else None)
    row['sensor_model'] = ''
    try:
        row['sensor'] = sensor_of(found, poses.sensor if poses else '', options.sensor_from)
        if options.model_from:
            row['sensor_model'] = matched(options.model_from, row['sensor'], '--model-from')
    except AccelCalibError:
        if poses is not None:
            raise
    return row


def _figures(intake: Intake, outcome: Outcome) -> Row:
    """Return the columns of a calibration and its rating."""
    calibration, quality = outcome.calibration, outcome.calibration.quality
    poses = calibration.used_poses
    warm = float(np.median(poses['temperature'])) if 'temperature' in poses else None
    deviation = np.sqrt(np.diag(calibration.covariance))
    return {
        'status': 'ok', 'rating': outcome.rating.name, 'rating_reason': outcome.rating.reason,
        'model': calibration.name, 'effects': list(calibration.model.effects),
        'refined': outcome.line, 'units': intake.units.name, 'poses': len(calibration.poses),
        'poses_used': len(poses), 'coverage': quality.coverage,
        **{figure.key: figure.value for figure in residual_figures(quality)},
        'temperature': warm, 'warnings': list(calibration.warnings),
        'determined': determines(_WHOLE_MODEL, directions_of(poses, intake.units)),
        'parameters': [{'name': name, 'value': value, 'sd': sd} for name, value, sd in zip(
            calibration.parameters, calibration.model.vector.tolist(), deviation.tolist(),
            strict=True)],
        **_linear(calibration), **_for_prior(intake, calibration)}


def _linear(calibration: Calibration) -> Row:
    """Return V and S with their standard deviations, at the middle of the context."""
    free = rotation_free(calibration, calibration.typical_context(1), calibration.units.per_g)
    variance = np.einsum('tp,pq,tq->t', free.slope, calibration.covariance, free.slope)
    return {column: float(value) for k, name in enumerate(NAMES) for column, value in (
        (name, free.values[k]), (f'{name}.sd', np.sqrt(max(variance[k], 0.0))))}


def _for_prior(intake: Intake, found: Calibration) -> Row:
    """Return values and covariance of model 10, if the poses determine it."""
    if intake.units.is_native:
        return {}
    if found.model.effects != MODELS[_WHOLE_MODEL].effects:
        try:
            found = fit_poses(intake.poses, intake.units, model=_WHOLE_MODEL)
        except RefusedFitError:
            return {}
    return {'prior_values': found.model.vector.tolist(),
            'prior_covariance': found.covariance.ravel().tolist()}
