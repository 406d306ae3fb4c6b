# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Binary formats of logs: their first bytes, and the errors of the libraries that read them."""

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
import errno
import io
import os
from pathlib import Path
import re

from ..errors import InputError
from ..text import reason

HEAD = 8192
"""Number of first bytes by which a file is recognised."""

ZIP, OLE = b'PK\x03\x04', b'\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1'
MATLAB, MATLAB_HDF5 = b'MATLAB 5.0 MAT-file', b'MATLAB 7.3 MAT-file'
BLACKBOX = b'H Product:Blackbox flight data recorder'
CONTAINERS = (ZIP, OLE, MATLAB, MATLAB_HDF5, BLACKBOX)
"""First bytes of files of several tables, and of a log that has to be decoded."""

ULOG, DATAFLASH = b'ULog\x01\x12\x35', b'\xa3\x95\x80'
"""First bytes of logs of PX4, and of binary logs of ArduPilot (the head of a message FMT)."""

FLIGHT_LOG = re.compile(rb'\A(?:' + re.escape(ULOG) + b'|' + re.escape(DATAFLASH) + b')'
                        rb'|^FMT, *\d+, *\d+, *\w+, *\w+', re.MULTILINE)
"""What the first bytes of a flight log hold; the text logs of ArduPilot have messages FMT."""

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
