# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib live``: the live page without ROS, for a serial port or a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from . import options
from .terminal import ended, Output
from ..live.host import Host
from ..live.link import check_installed, qr_code
from ..live.sources import open_source, Source
from ..session import CalibratorSettings, WEB_PORT

_EXAMPLE = 'accel-calib live /dev/ttyUSB0 --baud 115200 -o calibration.yaml'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.epilog = f'{made.epilog}\n\nopen the link that it prints in a browser; Ctrl-C ends it'
    made.add_argument('source', metavar='LOG-OR-PORT', help='recording to play in real time; or '
                      'serial port that sends one line for each sample, such as t,ax,ay,az')
    made.add_argument('-o', '--output', type=Path, default=Path('calibration.yaml'),
                      metavar='FILE', help='calibration to continue and to store (default: '
                      '%(default)s)')
    made.add_argument('--port', type=_port, default=WEB_PORT, help='port of the page; 0: any '
                      'free port (default: %(default)s)')
    made.add_argument('--host', default='127.0.0.1', metavar='ADDRESS', help='address at which '
                      'the page is served; 0.0.0.0: to the whole network, without encryption '
                      '(default: %(default)s)')
    made.add_argument('--baud', type=int, default=115200, help='baud rate of the serial port '
                      '(default: %(default)s)')
    made.add_argument('--speed', type=options.positive, default=1.0, help='speed of a recording, '
                      'relative to real time (default: %(default)s)')
    options.add_log(made)
    made.set_defaults(run=run)


def _port(text: str) -> int:
    """Return a port from an argument."""
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError(f'{text}: expected a number from 0 to 65535')
    return port


def run(args: argparse.Namespace) -> int:
    """Serve the page until the user ends it."""
    check_installed()
    console = Output()
    with (open_source(args.source, options.log_options(args), baud=args.baud,
                      speed=args.speed) as source, ended() as is_over):
        if source.read_as:
            console.print(f'read as: {source.read_as}')
        host = Host(source, _settings(args, source), lambda line: console.print(line.words))
        try:
            console.print(f'live page: {host.server.link}')
            if sys.stdout.isatty():
                print(qr_code(host.server.link))
            sys.stdout.flush()
            host.run(is_over)
        finally:
            host.close()
    return 0


def _settings(args: argparse.Namespace, source: Source) -> CalibratorSettings:
    """Return the parameters of the session."""
    return CalibratorSettings(units=source.units.name, gravity=args.gravity,
                              calibration_file=str(args.output), web_host=args.host,
                              web_port=args.port)
