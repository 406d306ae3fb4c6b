# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Check of input paths: only regular files are read, because others can block without end."""

from __future__ import annotations

from pathlib import Path
import stat

from ..errors import InputError

_KINDS = {stat.S_IFDIR: 'a folder', stat.S_IFIFO: 'a pipe (FIFO)', stat.S_IFSOCK: 'a socket',
          stat.S_IFCHR: 'a character device', stat.S_IFBLK: 'a block device'}


def check_regular(path: Path) -> None:
    """
    Check that a path is a regular file, or a link to one.

    Raises
    ------
    InputError
        If it is a folder, a pipe, a socket or a device.
    OSError
        If it is missing or cannot be reached.

    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), 'a special file')
        raise InputError(f'{path} is {kind}, expected a regular file',
                         'choose a file' if stat.S_ISDIR(mode) else
                         'store its content in a file, and choose that file')
