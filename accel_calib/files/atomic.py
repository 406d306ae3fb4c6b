# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Writing a file so that it is there whole, or as it was before."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import shutil
from typing import TextIO


def before(path: Path) -> Path:
    """Name the file in which the one before is kept."""
    return path.with_name(f'{path.name}.before')


def write_atomically(path: Path, write: Callable[[TextIO], object], *,
                     keep_before: bool = False) -> None:
    """
    Write to a temporary file beside the target, flush it to the disk, rename it.

    Parameters
    ----------
    path : Path
        The target; its folder must be there.
    write : callable
        Writes the content to an open file.
    keep_before : bool
        Keep the present file as ``<name>.before``.

    Raises
    ------
    OSError
        If the folder is missing or cannot be written; the target is then as it was.

    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
    try:
        with temporary.open('w', encoding='utf-8', newline='') as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        if keep_before and path.exists():
            _keep(path)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    _flush_folder(path.parent)


def _keep(path: Path) -> None:
    """Copy the present file to its name of before, that one too whole or as it was."""
    temporary = path.with_name(f'.{path.name}.{os.getpid()}.before')
    shutil.copy2(path, temporary)
    temporary.replace(before(path))


def _flush_folder(folder: Path) -> None:
    """Make the renaming last through a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
