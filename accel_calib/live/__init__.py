# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The live page: a calibration in a browser, served by the node or without ROS.

`server` serves the page. `exchange` makes the messages of a session, and its viewers send and
receive them. The session is that of the node, or that of `host` with samples of another source.
`page` contains the files for the browser.

"""

from ..errors import needing


def check_installed() -> None:
    """Raise InputError if aiohttp, which the modules of this folder import, is not installed."""
    with needing('aiohttp pyserial segno', 'the live page'):
        import aiohttp  # noqa: F401
