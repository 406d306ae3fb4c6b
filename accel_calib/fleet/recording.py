# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The recordings of a fleet, and the row of one recording.

Recordings come from files, folders, globs, lists and addresses. Their row has sensor, date and
content hash, and the figures of the calibration: capture, fit, refine, rate. It needs bounded
memory: a log is read in blocks, and the row has a bounded size. Errors that belong to the
recording are part of the row.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
import hashlib
import json
import os
from pathlib import Path, PurePosixPath
import re
import tempfile
from typing import Any, TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from .. import __version__
from ..calibration import Calibration, determines, directions_of, fit_poses
from ..comparison import NAMES, rotation_free
from ..disk import check_regular
from ..effects import MODELS, NOMINAL_SUPPLY, OwnEffect, REFERENCE_TEMPERATURE
from ..errors import AccelCalibError, InputError, known_error, RefusedFitError
from ..findings import residual_figures
from ..logs import LogOptions, SUFFIXES
from ..pipeline import calibrated, Intake, Outcome, Plan, poses_of
from ..stored.made import steady_context
from ..table import Poses
from ..text import one_line

if TYPE_CHECKING:
    import pyarrow as pa

_MAGIC = '*?['
_METADATA = 'metadata.yaml'
"""File in the folder of a rosbag2, which is one recording."""


@dataclass(frozen=True)
class Input:
    """
    A recording that was found: its absolute path, or an address such as ``s3://bucket/a.mcap``.

    `inside` is its path below the folder or glob that was passed, with ``/``.

    """

    path: str
    inside: str


def recordings(given: Iterable[str]) -> Iterator[Input]:
    """
    Yield the recordings of files, folders, globs, lists (``@list.txt``) and addresses.

    InputError is raised if one of them does not exist or holds no recording, and OSError if a list
    or a folder cannot be read.

    """
    for text in given:
        names = [text]
        if text.startswith('@'):
            path = Path(text[1:])
            check_regular(path)
            with path.open(encoding='utf-8', errors='surrogateescape') as file:
                # Names in a list are relative to it.
                names = [line if '://' in line else str(path.parent / line)
                         for line in map(str.strip, file) if line and line[0] != '#']
        for name in names:
            found = None
            for found in _addresses(name) if '://' in name else _local(name):
                yield found
            if found is None:
                raise InputError(f'{name} holds no recording, expected at least one that ends '
                                 f'with {", ".join(SUFFIXES)}',
                                 'correct the name, or put a glob in quotes')


def _local(text: str) -> Iterator[Input]:
    """
    Yield the recordings of a file, folder or glob of this machine, in order.

    Links come last, and each file and folder is read once, whatever its names: a link to a folder
    above would make many sensors of one.

    """
    path = Path(os.path.abspath(text))
    if path.exists():
        root = path if path.is_dir() and not (path / _METADATA).is_file() else path.parent
        found = [path]
    elif any(letter in text for letter in _MAGIC):
        # The folder above the first part with a wildcard.
        root = next(each for each in reversed(path.parents)
                    if any(letter in path.relative_to(each).parts[0] for letter in _MAGIC))
        found = sorted(root.glob(str(path.relative_to(root))))
    else:
        raise InputError(f'{text} does not exist, expected a recording, a folder, a glob or @LIST',
                         'correct the name')
    waiting, links, seen = deque(found), deque[Path](), set[tuple[int, int]]()
    while waiting or links:
        each = (waiting or links).popleft()
        if not each.exists() or (place := (each.stat().st_dev, each.stat().st_ino)) in seen:
            continue
        seen.add(place)
        if each.is_file() or (each / _METADATA).is_file():
            yield Input(str(each), each.relative_to(root).as_posix())
        elif each.is_dir():
            inside = [part for part in sorted(each.iterdir()) if not part.name.startswith('.')
                      and (part.is_dir() or part.suffix.lower() in SUFFIXES)]
            links.extend(filter(Path.is_symlink, inside))
            waiting.extendleft(part for part in reversed(inside) if not part.is_symlink())


def _addresses(text: str) -> Iterator[Input]:
    """Yield the recordings of an address, in order."""
    with _system(text) as (system, path):
        magic = '*[' if '://' in path else _MAGIC  # ? begins the query of an address of the web
        root = PurePosixPath(path)
        first = next((k for k, part in enumerate(root.parts) if set(part) & set(magic)), None)
        files, folders = list[str](), [path]
        if first is not None:
            root = PurePosixPath(*root.parts[:first])
            found = system.glob(path, detail=True).items()
            files, folders = ([each for each, about in found if about['type'] == kind]
                              for kind in ('file', 'directory'))
        elif system.isfile(path):
            root, files, folders = root.parent, [path], []
        for folder in folders:
            files += [each for each in system.find(folder) if each.lower().endswith(SUFFIXES)]
    for each in sorted(files):
        yield Input(system.unstrip_protocol(each),
                    PurePosixPath(each).relative_to(root).as_posix())


@contextmanager
def _system(text: str) -> Iterator[tuple[Any, str]]:
    """
    Yield the file system of an address, and the path in it.

    The errors of a store, which have many types, become InputError; OSError stays.

    """
    try:
        from fsspec.core import url_to_fs

        system, path = url_to_fs(text)
    except (ImportError, ValueError) as err:
        raise InputError(f'{text} cannot be opened: {err}', 'install fsspec and its package for '
                         'this kind of address, such as s3fs for s3://') from err
    try:
        yield system, path
    except (AccelCalibError, OSError):
        raise
    except Exception as err:
        raise InputError(f'{text} cannot be read: {err or type(err).__name__}, expected a store '
                         'that answers', 'check the address, the network and the credentials, '
                         'and run again') from err


@contextmanager
def on_disk(path: str) -> Iterator[Path]:
    """Yield a recording as a local path; an address is copied to a temporary folder."""
    if (written := as_text(path)) != path:
        raise InputError(f'the name {written} is not UTF-8, expected UTF-8', 'rename it')
    if '://' not in path:
        yield Path(path)
        return
    with tempfile.TemporaryDirectory(prefix='accel_calib-') as folder:
        with _system(path) as (system, inside):
            local = Path(folder) / PurePosixPath(inside.partition('?')[0]).name
            system.get_file(inside, str(local))
        yield local


def content_hash(path: Path) -> str:
    """Return a hash of a file, or of all files of a folder with their names: 128 bits, in hex."""
    made, parts = hashlib.blake2b(digest_size=16), [path]
    if path.is_dir():
        parts = sorted(each for each in path.rglob('*') if each.is_file())
    for each in parts:
        if each != path:
            name = os.fsencode(each.relative_to(path).as_posix())
            made.update(b'%d:%b%d:' % (len(name), name, each.stat().st_size))
        with each.open('rb') as file:
            while block := file.read(1 << 20):
                made.update(block)
    return made.hexdigest()


# ----------------------------------------------------------------------------- names and dates

UNKNOWN = 'unknown'
"""
Sensor of a recording in the passed folder itself, whose file has no name of a sensor. It can be
any sensor, so that such recordings are not compared.
"""

_LONGEST_FOLDER = 180

_FIRST_STAMP = datetime(2000, 1, 1, tzinfo=timezone.utc).timestamp()
_LAST_STAMP = datetime(2100, 1, 1, tzinfo=timezone.utc).timestamp()
"""Time stamps between these dates count from 1970."""

_DATE = re.compile(r'(?<!\d)(20\d\d)([-_./]?)(0[1-9]|1[0-2])\2(0[1-9]|[12]\d|3[01])'
                   r'(?:[-_T ]?([01]\d|2[0-3])[-_.:]?([0-5]\d)[-_.:]?([0-5]\d))?(?!\d)')
_DATE_FOLDER = re.compile(r'(19|20)\d\d([-_.]?\d\d){0,2}([-_T]?\d{2,6})?|\d{1,2}|[Ww]\d{1,2}')


def sensor_of(found: Input, name: str, pattern: str = '') -> str:
    """
    Return the name of the sensor of a recording, whose name in the file can be empty.

    The groups of the regular expression `pattern` in the path are the name. Without a pattern, it
    is the folder below the one that was passed and the name in the file. InputError is raised if
    the path does not match.

    """
    if pattern:
        return one_line(matched(pattern, found.path, '--sensor-from')).strip()
    folders = [part for part in PurePosixPath(found.inside).parts[:-1]
               if not _DATE_FOLDER.fullmatch(part)]
    if name and name not in folders:
        folders.append(name)
    return one_line('/'.join(folders)).strip() or UNKNOWN


def matched(pattern: str, text: str, option: str) -> str:
    """Return the groups of a regular expression in a text, or the whole match without groups."""
    match = re.search(pattern, text)
    if match is None:
        raise InputError(f'{text} does not match {option} {pattern!r}, expected a match',
                         f'correct {option}, or leave out this recording')
    return '/'.join(filter(None, match.groups())) or match.group()


def as_folder(sensor: str) -> str:
    """Return the name of a sensor as the name of one folder."""
    name = quote(sensor, safe=' ()+,@').replace('~', '%7E')
    if not name.strip('.'):
        name = name.replace('.', '%2E')
    if len(name) <= _LONGEST_FOLDER:
        return name
    rest = hashlib.blake2b(sensor.encode(), digest_size=8).hexdigest()
    return f'{name[:_LONGEST_FOLDER]}~{rest}'


def date_of(found: Input, poses: Poses | None, modified_s: float | None) -> tuple[str, str]:
    """
    Return the date of a recording in ISO 8601, UTC, and where it comes from.

    It comes from the ``stamps`` of the poses, the ``path``, or the last change of the ``file``
    [s since 1970]. Both texts are empty if it is not known.

    """
    stamp, source = modified_s, 'file'
    for match in [*_DATE.finditer(found.inside)][-1:]:
        year, _, month, day, *clock = match.groups()
        when = f'{year}-{month}-{day}T{":".join(part or "00" for part in clock)}+00:00'
        with suppress(ValueError):  # such as 30 February
            stamp, source = datetime.fromisoformat(when).timestamp(), 'path'
    if poses is not None and 'time' in poses and len(poses):
        first = float(poses['time'][0])
        if _FIRST_STAMP <= first < _LAST_STAMP:
            stamp, source = first, 'stamps'
    if stamp is None:
        return '', ''
    return datetime.fromtimestamp(stamp, timezone.utc).isoformat(timespec='seconds'), source


# ----------------------------------------------------------------------------- rows

Row = dict[str, Any]

_TEXTS = ('key', 'content', 'recording', 'sensor_model', 'version', 'date', 'date_from', 'status',
          'error', 'advice', 'rating', 'rating_reason', 'model', 'refined', 'units', 'calibration')
_NUMBERS = ('rms_before_mg', 'rms_after_mg', 'held_out_rms_mg', 'noise_floor_mg', 'coverage',
            'temperature', 'seconds',
            *(column for name in NAMES for column in (name, f'{name}.sd')))

RESULTS = 3
"""Version of the rows. Another version makes all recordings be calibrated again."""

_WHOLE_MODEL = '10'


def schema() -> pa.Schema:
    """Return the columns of a row; the sensor is the name of its folder."""
    import pyarrow as pa

    text, count, number = pa.string(), pa.int64(), pa.float64()
    parameter = pa.struct([('name', text), ('value', number), ('sd', number)])
    return pa.schema([
        *((name, text) for name in _TEXTS), ('poses', count), ('poses_used', count),
        *((name, number) for name in _NUMBERS), ('determined', pa.bool_()),
        ('effects', pa.list_(text)), ('warnings', pa.list_(text)),
        ('parameters', pa.list_(parameter)), ('prior_values', pa.list_(number)),
        ('prior_covariance', pa.list_(number))])


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
        Fields of `accel_calib.stillness.CaptureSettings`.
    refined : bool
        Look for effects beyond offset, gain and cross-axis.
    exports : tuple of str
        Formats of `accel_calib.stored.exports.FORMATS` to write beside each calibration.
    own : tuple of OwnEffect
        Own effects of the user, which are tried beside the catalogue.

    """

    sensor_from: str = ''
    model_from: str = ''
    log: LogOptions = LogOptions()
    settings: dict[str, Any] = field(default_factory=dict)
    refined: bool = True
    exports: tuple[str, ...] = ()
    own: tuple[OwnEffect, ...] = ()


def key_of(content: str, found: Input, options: Options) -> str:
    """Return the key of a result: content, name from the path, version, options, own effects."""
    try:
        place = sensor_of(found, '', options.sensor_from)
    except AccelCalibError as err:
        place = str(err)
    stated = asdict(replace(options, own=()))
    own = dict.fromkeys(each.source[1].hex() for each in options.own if each.source)
    about = json.dumps([content, place, __version__, RESULTS, stated, *own], default=str,
                       sort_keys=True)
    return hashlib.blake2b(about.encode(), digest_size=16).hexdigest()


def row_of(found: Input, path: Path, options: Options) -> tuple[Row, Calibration | None]:
    """Return the row of a recording, and its calibration unless it is BAD or failed."""
    row = _about(found, options, None, path)
    try:
        intake = poses_of(path, options.log, options.settings)
        row = _about(found, options, intake.poses, path)
        outcome = calibrated(intake.poses, intake.units, Plan(
            sensor=row['sensor'], refined=options.refined, also=options.own))
    except OSError:
        raise  # it may be possible to read it later
    except Exception as err:  # also a defect of this program must not stop the other recordings
        error = known_error(err)
        message = error.message.replace(str(path), found.path)  # the path can be that of a copy
        return row | {'status': 'error', 'error': message, 'advice': error.advice}, None
    calibration = replace(outcome.calibration, date=row['date'])
    stored = outcome.rating.name != 'BAD'
    return row | _figures(intake, outcome), calibration if stored else None


def unread_row(found: Input, options: Options, error: AccelCalibError) -> Row:
    """Return the row of a recording that could not be read."""
    written = Input(as_text(found.path), as_text(found.inside))
    return _about(written, options, None, None) | {
        'status': 'unread', 'error': error.message, 'advice': error.advice}


def as_text(name: str) -> str:
    """Return the name of a file, with escapes for what is not UTF-8."""
    return os.fsencode(name).decode(errors='backslashreplace')


def _about(found: Input, options: Options, poses: Poses | None, path: Path | None) -> Row:
    """Return the columns about a recording: sensor, model and date."""
    row: Row = {'recording': found.path, 'version': __version__, 'sensor': UNKNOWN,
                'sensor_model': ''}
    row['date'], row['date_from'] = date_of(
        found, poses, os.stat(path).st_mtime if path and '://' not in found.path else None)
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
    poses, model = calibration.used_poses, calibration.model
    warm = float(np.median(poses['temperature'])) if 'temperature' in poses else None
    # Offset and gain in one context, so that a change of the weather is no change of a sensor.
    here = {**steady_context(calibration, np.array([REFERENCE_TEMPERATURE])),
            'supply_voltage': np.array([NOMINAL_SUPPLY])}
    free = rotation_free(calibration, here, calibration.units.per_g)
    variance = np.einsum('tp,pq,tq->t', free.slope, calibration.covariance, free.slope)
    row: Row = {
        'status': 'ok', 'rating': outcome.rating.name, 'rating_reason': outcome.rating.reason,
        'model': calibration.name, 'effects': [*map(str, model.effects)],
        'refined': outcome.line, 'units': intake.units.name, 'poses': len(calibration.poses),
        'poses_used': len(poses), 'coverage': quality.coverage,
        **{figure.key: figure.value for figure in residual_figures(quality)},
        'temperature': warm, 'warnings': list(calibration.warnings),
        'determined': determines(_WHOLE_MODEL, directions_of(poses, intake.units)),
        'parameters': [{'name': str(name), 'value': value, 'sd': sd} for (name, sd), value, stated
                       in zip(calibration.deviations.items(), model.vector.tolist(), model.stated,
                              strict=True) if stated],
        **{column: float(value) for k, name in enumerate(NAMES) for column, value in (
            (name, free.values[k]), (f'{name}.sd', np.sqrt(max(variance[k], 0.0))))}}
    if not intake.units.is_native:
        # Values of model 10 for the prior, if the poses determine it.
        with suppress(RefusedFitError):
            whole = calibration
            if model.effects != MODELS[_WHOLE_MODEL].effects:
                whole = fit_poses(intake.poses, intake.units, model=_WHOLE_MODEL)
            row |= {'prior_values': whole.model.vector.tolist(),
                    'prior_covariance': whole.covariance.ravel().tolist()}
    return row
