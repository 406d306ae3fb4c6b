# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The link of the live page: its address, its QR code, and what prevents it."""

from __future__ import annotations

import errno
import io
from ipaddress import ip_address
import socket

from ..errors import InputError


def check_installed() -> None:
    """
    Check that aiohttp is installed.

    Raises
    ------
    InputError
        If it is not.

    """
    try:
        import aiohttp  # noqa: F401
    except ImportError as error:
        raise InputError('aiohttp is not installed, but the live page needs it',
                         "run pip install 'accel_calib[live]'") from error


def qr_code(link: str) -> str:
    """Return a link as a QR code for a terminal; empty if segno is not installed."""
    try:
        import segno
    except ImportError:
        return ''
    drawn = io.StringIO()
    segno.make(link, micro=False).terminal(out=drawn, compact=True)
    return drawn.getvalue()


def not_bound(error: OSError, host: str, port: int) -> InputError:
    """Return the error for an address that cannot be used."""
    if error.errno == errno.EADDRINUSE:
        return InputError(f'the port {port} of {host} is in use, so there is no live page',
                          'stop the other program, or choose another port')
    return InputError(f'the live page cannot be served at {host}, port {port}: '
                      f'{error.strerror or error}', 'choose an address of this machine, and a '
                      'port above 1023')


def reachable(host: str) -> str:
    """Return an address for a link: that of the network if the server listens everywhere."""
    try:
        address = ip_address(host)
    except ValueError:
        return host
    if not address.is_unspecified:
        return host
    family, outside = ((socket.AF_INET, '192.0.2.1') if address.version == 4
                       else (socket.AF_INET6, '2001:db8::1'))
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((outside, 9))  # sends nothing, but chooses the interface
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])
