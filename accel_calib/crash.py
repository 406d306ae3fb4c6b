# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The last resort for an exception that nobody expected: one line, and the details in a file."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import traceback

from . import __version__


def crash_words(error: BaseException) -> str:
    """
    Write the traceback of an error to a temporary file, and return one line about it.

    Parameters
    ----------
    error : BaseException
        The error.

    Returns
    -------
    str
        What happened, with the name of the file, which contains an id; without the file if it
        cannot be written.

    """
    what = f'internal error: {type(error).__name__}: {error}'
    try:
        handle, name = tempfile.mkstemp(prefix='accel_calib-', suffix='.txt')
        with os.fdopen(handle, 'w', encoding='utf-8', errors='backslashreplace') as file:
            file.write(f'accel_calib {__version__}, Python {platform.python_version()}, '
                       f'{platform.platform()}\n{" ".join(sys.argv)}\n\n')
            file.write(''.join(traceback.format_exception(error)))
    except OSError:
        return f'{what}; please report it with what you did'
    return f'{what}; please report it with the file {name}'
