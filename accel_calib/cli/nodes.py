# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib demo``, ``live``, ``node`` and ``simulator``: what runs while messages arrive."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any, TYPE_CHECKING

from rich.table import Table

from .commands import HIDDEN
from .frame import console, Done, Output, table
from .inputs import log_options, settings
from .terminal import ended
from ..errors import InputError, NEEDS_ROS

if TYPE_CHECKING:
    from ..ros.demo import Outcome

_ERRORS = {'vector_mg': 'error of a, RMS [mg]', 'rms_mg': 'error of |a|, RMS [mg]',
           'max_mg': 'error of |a|, largest [mg]', 'tilt_deg': 'error of up, RMS [deg]'}

CHECK_FAILED = 1
"""Exit status if the error does not shrink, or the hidden effect is not found."""


def run_node(args: argparse.Namespace) -> Done:
    """Run the calibrator until it is ended."""
    from ..ros.run import calibrator

    return Done(status=calibrator([args.command, *args.for_ros]))


def run_simulator(args: argparse.Namespace) -> Done:
    """Run the simulator until it is ended."""
    from ..ros.run import simulator

    return Done(status=simulator([args.command, *args.for_ros]))


def run_live(args: argparse.Namespace) -> Done:
    """Serve the live page without ROS until the user ends it."""
    from ..live import check_installed
    check_installed()
    from ..live.host import Host
    from ..live.sources import open_source
    from ..session import CalibratorSettings

    output = Output()
    with (open_source(args.source, log_options(args), baud=args.baud,
                      speed=args.speed) as source, ended() as is_over):
        if source.read_as:
            output.print(f'read as: {source.read_as}')
        host = Host(source, CalibratorSettings(
            units=source.units.name, gravity=args.gravity, calibration_file=str(args.output),
            web_host=args.host, web_port=args.port, also=str(args.also or ''), **settings(args)),
            lambda line: output.print(line.words))
        try:
            print(host.server.announce(), flush=True)  # a file name is not wrapped
            host.run(is_over)
        finally:
            host.close()
    return Done()


def run_demo(args: argparse.Namespace) -> Done:
    """Run simulator and calibrator in separate processes."""
    try:
        from ..ros.demo import demonstrate, demonstrate_page
    except ImportError as err:
        raise InputError(f'ROS 2 is not installed ({err}), but the demonstration needs it',
                         NEEDS_ROS) from err
    output = console(args)
    if args.web:
        from ..live import check_installed
        from ..session import WEB_PORT

        check_installed()
        with ended() as is_over:
            demonstrate_page(WEB_PORT, output.print, is_over)
        return Done()
    outcome = demonstrate(output.print, HIDDEN.get(args.hidden, ''))
    verdict = [] if args.hidden is None else [_verdict(outcome)]
    return Done(_to_json(outcome), [_table(outcome), *verdict],
                0 if outcome.succeeded else CHECK_FAILED)


def _to_json(outcome: Outcome) -> dict[str, Any]:
    """Return the JSON: errors before and after by name, and the rest of the outcome."""
    found = asdict(outcome)
    for when in ('before', 'after'):
        for name, value in found.pop(when).items():
            quantity, unit = name.split('_')
            found[f'{quantity}_{when}_{unit}'] = value
    return found


def _verdict(outcome: Outcome) -> str:
    """Return whether the hidden effect was found."""
    named = ', '.join(outcome.found) or 'nothing'
    lag = f' with a lag of {outcome.lag_s:.1f} s' if outcome.lag_s else ''
    passed = 'found' if outcome.hidden in outcome.found else 'NOT found'
    return f'{passed}: hidden was {outcome.hidden}, ~/refine added {named}{lag}'


def _table(outcome: Outcome) -> Table:
    columns = (('imu/data_calibrated', 'after ~/refine') if outcome.hidden else
               ('imu/data_raw', 'imu/data_calibrated'))
    before, after = asdict(outcome.before), asdict(outcome.after)
    return table(
        f'Errors at {outcome.rests} rests in other poses, after {outcome.seconds:.0f} s',
        ('', *columns), ((words, f'{before[name]:.3g}', f'{after[name]:.3g}')
                         for name, words in _ERRORS.items()))
