# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The recordings of a fleet: where they are, their content hash, and their sensor and date.

They come from files, folders, globs, lists and addresses.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
import hashlib
import os
from pathlib import Path, PurePosixPath
import re
import tempfile
from typing import Any
from urllib.parse import quote

from ..errors import AccelCalibError, InputError
from ..table import Poses

_SUFFIXES = ('.csv', '.tsv', '.txt', '.log', '.mcap', '.db3', '.bag', '.ulg', '.bin')
"""Endings of recordings in a folder; a file that is named itself can have any ending."""

_MAGIC = '*?['
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Input:
    """
    A recording that was found.

    Parameters
    ----------
    path : str
        Absolute path, or address such as ``s3://bucket/a.mcap``.
    inside : str
        Its path below the folder or glob that was passed, with ``/``.

    """

    path: str
    inside: str


def recordings(given: Iterable[str]) -> Iterator[Input]:
    """
    Yield the recordings of files, folders, globs, lists (``@list.txt``) and addresses.

    Parameters
    ----------
    given : iterable of str
        What the user passed.

    Raises
    ------
    InputError
        If one of them does not exist, or holds no recording.
    OSError
        If a list or a folder cannot be read.

    """
    for text in given:
        if text.startswith('@'):
            yield from recordings(_lines(Path(text[1:])))
            continue
        found = None
        for found in _addresses(text) if '://' in text else _local(text):
            yield found
        if found is None:
            raise InputError(f'{text} holds no recording, expected at least one that ends with '
                             f'{", ".join(_SUFFIXES)}',
                             'correct the name, or put a glob in quotes')


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a list; relative names are relative to the list."""
    with path.open(encoding='utf-8') as file:
        for line in filter(None, map(str.strip, file)):
            if not line.startswith('#'):
                yield line if '://' in line else str(path.parent / line)


def _local(text: str) -> Iterator[Input]:
    """Yield the recordings of a file, folder or glob of this machine, in order."""
    path = Path(os.path.abspath(text))
    if path.exists() and (path.is_file() or _is_bag_folder(path)):
        yield Input(str(path), path.name)
    elif path.is_dir():
        yield from _below(path, path)
    elif any(letter in text for letter in _MAGIC):
        root = _root(path)
        for each in sorted(root.glob(str(path.relative_to(root)))):
            if each.is_file() or _is_bag_folder(each):
                yield Input(str(each), each.relative_to(root).as_posix())
            elif each.is_dir():
                yield from _below(each, root)
    else:
        raise InputError(f'{text} does not exist, expected a recording, a folder, a glob or @LIST',
                         'correct the name')


def _is_bag_folder(path: Path) -> bool:
    """Return whether a path is the folder of a rosbag2, which is one recording."""
    return (path / 'metadata.yaml').is_file()


def _root(path: Path) -> Path:
    """Return the folder above the first part with a wildcard."""
    return next(each for each in reversed(path.parents)
                if any(letter in path.relative_to(each).parts[0] for letter in _MAGIC))


def _below(folder: Path, root: Path) -> Iterator[Input]:
    """Yield the recordings in a folder and its subfolders, in order; a bag is one recording."""
    for each in sorted(folder.iterdir()):
        if each.name.startswith('.'):
            continue
        if _is_bag_folder(each) or (each.is_file() and each.suffix.lower() in _SUFFIXES):
            yield Input(str(each), each.relative_to(root).as_posix())
        elif each.is_dir():
            yield from _below(each, root)


def _addresses(text: str) -> Iterator[Input]:
    """Yield the recordings of an address, in order."""
    system, path = _system(text)
    with _as_input_error(text):
        root, found = _found_at(system, path)
    for each in sorted(found):
        yield Input(system.unstrip_protocol(each),
                    PurePosixPath(each).relative_to(root).as_posix())


def _found_at(system: Any, path: str) -> tuple[PurePosixPath, list[str]]:
    """Return the folder above the recordings, and their paths in the file system."""
    magic = '*[' if '://' in path else _MAGIC  # ? begins the query of an address of the web
    parts = PurePosixPath(path).parts
    first = next((k for k, part in enumerate(parts) if set(part) & set(magic)), None)
    if first is None and system.isfile(path):
        return PurePosixPath(path).parent, [path]
    if first is None:
        return PurePosixPath(path), _files_below(system, path)
    found = system.glob(path, detail=True).items()
    files = [each for each, about in found if about['type'] == 'file']
    below = [file for each, about in found if about['type'] == 'directory'
             for file in _files_below(system, each)]
    return PurePosixPath(*parts[:first]), files + below


def _files_below(system: Any, path: str) -> list[str]:
    return [each for each in system.find(path) if each.lower().endswith(_SUFFIXES)]


@contextmanager
def _as_input_error(address: str) -> Iterator[None]:
    """Raise InputError for the errors of a store, which have many types; OSError stays."""
    try:
        yield
    except (AccelCalibError, OSError):
        raise
    except Exception as err:
        raise InputError(f'{address} cannot be read: {err or type(err).__name__}, expected a '
                         'store that answers', 'check the address, the network and the '
                         'credentials, and run again') from err


def _system(text: str) -> tuple[Any, str]:
    """Return the file system of an address, and the path in it."""
    try:
        from fsspec.core import url_to_fs

        system, path = url_to_fs(text)
    except (ImportError, ValueError) as err:
        raise InputError(f'{text} cannot be opened: {err}', 'install fsspec and its package for '
                         'this kind of address, such as s3fs for s3://') from err
    return system, path


@contextmanager
def on_disk(path: str) -> Iterator[Path]:
    """Yield a recording as a local path; an address is copied to a temporary folder."""
    if '://' not in path:
        yield Path(path)
        return
    system, inside = _system(path)
    with tempfile.TemporaryDirectory(prefix='accel_calib-') as folder:
        local = Path(folder) / PurePosixPath(inside.partition('?')[0]).name
        with _as_input_error(path):
            system.get_file(inside, str(local))
        yield local


def content_hash(path: Path) -> str:
    """Return a hash of a file, or of all files of a folder with their names: 128 bits, in hex."""
    made = hashlib.blake2b(digest_size=16)
    if path.is_file():
        _add(made, path)
        return made.hexdigest()
    for each in sorted(path.rglob('*')):
        if each.is_file():
            name = os.fsencode(each.relative_to(path).as_posix())
            made.update(b'%d:%b%d:' % (len(name), name, each.stat().st_size))
            _add(made, each)
    return made.hexdigest()


def _add(made: Any, path: Path) -> None:
    with path.open('rb') as file:
        while block := file.read(_BLOCK):
            made.update(block)


UNKNOWN = 'unknown'
"""Sensor of a recording in the passed folder itself, whose file has no name of a sensor."""

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
        return matched(pattern, found.path, '--sensor-from')
    folders = [part for part in PurePosixPath(found.inside).parts[:-1]
               if not _DATE_FOLDER.fullmatch(part)]
    if name and name not in folders:
        folders.append(name)
    return '/'.join(folders) or UNKNOWN


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
    if poses is not None and 'time' in poses and len(poses):
        first = float(poses['time'][0])
        if _FIRST_STAMP <= first < _LAST_STAMP:
            return _iso(first), 'stamps'
    matches = list(_DATE.finditer(found.inside))
    if matches:
        year, _, month, day, *clock = matches[-1].groups()
        try:
            hour, minute, second = (int(part or 0) for part in clock)
            when = datetime(int(year), int(month), int(day), hour, minute, second,
                            tzinfo=timezone.utc)
            return when.isoformat(timespec='seconds'), 'path'
        except ValueError:  # such as 30 February
            pass
    return ('', '') if modified_s is None else (_iso(modified_s), 'file')


def _iso(stamp: float) -> str:
    return datetime.fromtimestamp(stamp, timezone.utc).isoformat(timespec='seconds')
