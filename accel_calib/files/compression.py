# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The compressions of chunks in MCAP files."""

from __future__ import annotations

from importlib import import_module
import sys
from typing import Any

_MODULES = {'lz4': 'lz4.frame',
            'zstd': 'compression.zstd' if sys.version_info >= (3, 14) else 'backports.zstd'}


def compressed(data: bytes | bytearray, name: str) -> bytes:
    """Compress: '', 'lz4' or 'zstd'."""
    return bytes(data) if not name else bytes(_module(name).compress(data))


def decompressed(data: bytes | memoryview, name: str) -> bytes | memoryview:
    """
    Undo `compressed`.

    Raises
    ------
    ValueError
        If the compression is not known, or the data are damaged.

    """
    if not name:
        return data
    module = _module(name)
    try:
        return bytes(module.decompress(data))
    except (RuntimeError, getattr(module, 'ZstdError', RuntimeError)) as err:
        raise ValueError(str(err)) from err


def _module(name: str) -> Any:
    """Give the module of a compression; `rosbags` brings both."""
    if name not in _MODULES:
        raise ValueError(f'compression {name!r} is not known')
    return import_module(_MODULES[name])
