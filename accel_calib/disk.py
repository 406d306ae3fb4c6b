# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Writing of files that are either complete or unchanged.

Only regular files are replaced, through links to their target. A file keeps its permissions and,
as far as the user may set it, its owner. Temporary files have names that cannot be predicted, and
are created exclusively. Only regular files are read, too: others can block without end.

"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import glob
import os
from pathlib import Path
import secrets
import shutil
import stat
import sys
import time
from typing import BinaryIO, TextIO

from .errors import InputError

STANDARD_OUTPUT = '-'

FORMAT = 'accel_calib calibration'
FIRST_LINE = f'format: {FORMAT}'
"""Format of a stored calibration, and its first line, by which readers of logs know it."""

BEFORE = rb'(?:\xef\xbb\xbf)?(?:\s|#[^\n]*\n|---)*'
"""What an editor or a person puts before the first line: a mark of the encoding, and comments."""

_SUFFIX = '.tmp'
_STALE_S = 3600.0
"""Age of a temporary file that no process writes any more [s]."""

_LONGEST_NAME = 200


def previous(path: Path) -> Path:
    """Return the path under which the previous file is kept."""
    return path.with_name(f'{path.name}.before')


def write_atomically(path: Path, write: Callable[[TextIO], object], *,
                     keep_before: bool = False) -> None:
    """
    Write a file through a temporary file, which is flushed to the disk and renamed.

    `write` writes the content to an open file. With `keep_before` the previous file is kept as
    ``<name>.before``. The path ``-`` is standard output.

    Raises
    ------
    InputError
        If the path is no regular file, or is write-protected.
    OSError
        If the folder is missing or cannot be written. The file is then unchanged.

    """
    if str(path) == STANDARD_OUTPUT:
        sys.stdout.flush()
        write(sys.stdout)
        sys.stdout.flush()
        return
    target = Path(os.path.realpath(path))
    with _replacing(target) as file, open(os.dup(file.fileno()), 'w', encoding='utf-8',
                                          errors='backslashreplace', newline='') as text:
        write(text)
        text.flush()
        os.fsync(file.fileno())
        if keep_before and target.exists():
            copy_atomically(target, previous(target))
    folder = os.open(target.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # so that the renamed file survives a loss of power
    except OSError as err:
        err.filename = str(target.parent)
        raise
    finally:
        os.close(folder)
    # The file is written in any case: a leftover that stays does no harm.
    remove_leftovers(target, older_than=_STALE_S)


def copy_atomically(path: Path, target: Path) -> None:
    """Copy a file, its mode and its time within a folder, completely or not at all."""
    with path.open('rb') as source, _replacing(target) as file:
        shutil.copyfileobj(source, file)
        file.flush()
        state = os.fstat(source.fileno())
        os.fchmod(file.fileno(), stat.S_IMODE(state.st_mode))
        os.utime(file.fileno(), ns=(state.st_atime_ns, state.st_mtime_ns))


@contextmanager
def _replacing(target: Path) -> Iterator[BinaryIO]:
    """Yield a new file that replaces the target at the end; it is removed after an error."""
    old = replaceable(target)
    temporary = target.with_name(f'.{target.name[:_LONGEST_NAME]}.{secrets.token_hex(8)}{_SUFFIX}')
    try:
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)
        try:
            with open(handle, 'wb') as file:
                if old is not None:
                    with suppress(PermissionError):  # the owner stays, if the user may set it
                        os.fchown(handle, old.st_uid, old.st_gid)
                    os.fchmod(handle, stat.S_IMODE(old.st_mode))
                yield file
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as err:
        if str(err.filename or temporary) == str(temporary):
            err.filename = str(target)
        raise


def replaceable(path: Path) -> os.stat_result | None:
    """Return the state of a file, no link, that may be replaced; None if there is no file."""
    try:
        old = path.lstat()
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(old.st_mode):
        raise InputError(f'{path} is not a regular file, expected one that can be replaced',
                         'choose another name')
    if not old.st_mode & 0o222:
        raise InputError(f'{path} is write-protected, expected a file that may be replaced',
                         'choose another name, or allow writing with chmod u+w')
    return old


def remove_leftovers(path: Path, older_than: float = 0.0) -> list[OSError]:
    """Remove what killed processes left beside a file, this old [s]; return what failed."""
    name = glob.escape(path.name[:_LONGEST_NAME])
    failed = []
    for each in sorted(path.parent.glob(f'.{name}.*{_SUFFIX}')):
        try:
            if time.time() - each.lstat().st_mtime >= older_than:
                each.unlink(missing_ok=True)
        except FileNotFoundError:  # another process was faster
            continue
        except OSError as error:
            failed.append(error)
    return failed


_KINDS = {stat.S_IFDIR: 'a folder', stat.S_IFIFO: 'a pipe (FIFO)', stat.S_IFSOCK: 'a socket',
          stat.S_IFCHR: 'a character device', stat.S_IFBLK: 'a block device'}


def check_regular(path: Path) -> None:
    """Check that a path is a regular file or a link to one; InputError if not, OSError if none."""
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), 'a special file')
        raise InputError(f'{path} is {kind}, expected a regular file',
                         'choose a file' if stat.S_ISDIR(mode) else
                         'store its content in a file, and choose that file')
