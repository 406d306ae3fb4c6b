# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
