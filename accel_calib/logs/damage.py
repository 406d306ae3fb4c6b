# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Errors of the libraries that read logs: one class, and nothing printed."""

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
import errno
import io
import os
from pathlib import Path

from ..errors import InputError
from ..text import reason

_STANDARD_ERROR = 2

_BY_VALUE = (None, errno.EINVAL, errno.EOVERFLOW, errno.EISDIR, errno.EFBIG, errno.ENAMETOOLONG,
             errno.ENOTDIR)
"""System errors that a damaged size or place in a file causes; others are not about its bytes."""


class DamagedLogError(InputError):
    """A library cannot read a log."""


@contextmanager
def damage_refused(what: str, expected: str, advice: str) -> Iterator[None]:
    """
    Turn what a library raises for damaged bytes into a DamagedLogError.

    Errors of the system, such as a missing file or permission, pass.

    """
    try:
        yield
    except InputError:
        raise
    except Exception as err:  # libraries of logs raise errors of any class
        if isinstance(err, OSError) and err.errno not in _BY_VALUE:
            raise
        raise DamagedLogError(f'{what} ({reason(err)}), expected {expected}', advice) from err


@contextmanager
def sound_log(path: Path, expected: str, advice: str = 'copy it from the vehicle again'
              ) -> Iterator[None]:
    """Refuse damage as `damage_refused` does, and drop what a library prints."""
    with damage_refused(f'{path} is damaged', expected, advice), redirect_stdout(
            io.StringIO()), redirect_stderr(io.StringIO()), _silent_c():
        yield


@contextmanager
def _silent_c() -> Iterator[None]:
    """Drop what C code prints to standard error, which Python cannot redirect."""
    try:
        kept = os.dup(_STANDARD_ERROR)
    except OSError:  # standard error is closed, so nothing is printed
        yield
        return
    try:
        with open(os.devnull, 'wb') as nowhere:
            os.dup2(nowhere.fileno(), _STANDARD_ERROR)
            yield
    finally:
        os.dup2(kept, _STANDARD_ERROR)
        os.close(kept)
