# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib demo``: a demonstration without hardware."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any, TYPE_CHECKING

from . import options
from .terminal import ended
from ..errors import InputError, NEEDS_ROS
from ..live.link import check_installed
from ..session import WEB_PORT

if TYPE_CHECKING:
    from rich.table import Table

    from ..ros.demo_hidden import HiddenOutcome

_EXAMPLE = 'accel-calib demo --hidden temperature'

HIDDEN = ('temperature', 'temperature-lag', 'gain-temperature', 'quadratic')
"""What the sensor can hide; `accel_calib.ros.demo_hidden` has the effects."""

CHECK_FAILED = 1
"""Exit status if the effect is not found, or the error does not shrink."""


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('--hidden', choices=HIDDEN, help='let the sensor hide this effect, and show '
                      'that ~/refine finds it and that the corrected topic gets better')
    made.add_argument('--web', action='store_true', help='calibrate on the live page instead, '
                      f'at port {WEB_PORT}, until Ctrl-C')
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run simulator and calibrator in separate processes, and print the result."""
    try:
        from ..ros.demo import demonstrate, demonstrate_page
        from ..ros.demo_hidden import demonstrate_hidden
    except ImportError as err:
        raise InputError(f'ROS 2 is not installed ({err}), but the demonstration needs it',
                         NEEDS_ROS) from err
    console = options.console(args)

    def report(line: str) -> None:
        console.print(line)

    if args.web:
        check_installed()
        with ended() as is_over:
            demonstrate_page(WEB_PORT, report, is_over)
        return 0
    if args.hidden is not None:
        found = demonstrate_hidden(args.hidden, report)
        options.write_json(args.json, asdict(found))
        report(_verdict(found))
        return 0 if found.succeeded else CHECK_FAILED
    outcome = asdict(demonstrate(report))
    options.write_json(args.json, outcome)
    console.print(_table(outcome))
    return 0


def _verdict(found: HiddenOutcome) -> str:
    """Return the result of the demonstration with a hidden effect."""
    named = ', '.join(found.found) or 'nothing'
    lag = f' with a lag of {found.lag_s:.1f} s' if found.lag_s else ''
    change = (f'RMS error of imu/data_calibrated against ~/truth over {found.rests} rests: '
              f'{found.rms_before_mg:.2f} mg before ~/refine, {found.rms_after_mg:.2f} mg after')
    passed = 'found' if found.hidden in found.found else 'NOT found'
    return (f'{passed}: hidden was {found.hidden}, ~/refine added {named}{lag}\n{change}\n'
            f'after {found.seconds:.0f} s')


def _table(outcome: dict[str, Any]) -> Table:
    from rich.table import Table

    table = Table(title=f'Errors at {outcome["rests"]} rests in other orientations, '
                  f'after {outcome["seconds"]:.0f} s')
    table.add_column('')
    for name in ('imu/data_raw', 'imu/data_calibrated'):
        table.add_column(name, justify='right')
    for words, name, unit in (('error of |a|, RMS', 'rms', 'mg'),
                              ('error of |a|, largest', 'max', 'mg'),
                              ('error of up, RMS', 'tilt', 'deg')):
        table.add_row(f'{words} [{unit}]',
                      *(f'{outcome[f"{name}_{when}_{unit}"]:.3g}' for when in ('before', 'after')))
    return table
