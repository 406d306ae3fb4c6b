# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Writing of files that are either complete or unchanged."""

from __future__ import annotations

from collections.abc import Callable
import glob
import os
from pathlib import Path
import shutil
from typing import TextIO

_SUFFIX = '.tmp'


def previous(path: Path) -> Path:
    """Return the path under which the previous file is kept."""
    return path.with_name(f'{path.name}.before')


def write_atomically(path: Path, write: Callable[[TextIO], object], *,
                     keep_before: bool = False) -> None:
    """
    Write a file through a temporary file, which is flushed to the disk and renamed.

    Parameters
    ----------
    path : Path
        The file; its folder must exist.
    write : callable
        Function that writes the content to an open file.
    keep_before : bool
        Keep the previous file as ``<name>.before``.

    Raises
    ------
    OSError
        If the folder is missing or cannot be written. The file is then unchanged.

    """
    temporary = _temporary(path)
    try:
        with temporary.open('w', encoding='utf-8', newline='') as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        if keep_before and path.exists():
            copy_atomically(path, previous(path))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    _flush_folder(path.parent)


def copy_atomically(path: Path, target: Path) -> None:
    """Copy a file within its folder, completely or not at all; raise OSError if it fails."""
    temporary = _temporary(target)
    try:
        shutil.copy2(path, temporary)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> list[Path]:
    """Remove temporary files that killed processes left beside a file; return their paths."""
    found = sorted(path.parent.glob(f'.{glob.escape(path.name)}.*{_SUFFIX}'))
    for each in found:
        each.unlink(missing_ok=True)
    return found


def _temporary(path: Path) -> Path:
    return path.with_name(f'.{path.name}.{os.getpid()}{_SUFFIX}')


def _flush_folder(folder: Path) -> None:
    """Flush a folder, so that a renamed file survives a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
