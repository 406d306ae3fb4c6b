# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib demo``: a demonstration without hardware."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any, TYPE_CHECKING

from . import options
from ..errors import InputError, NEEDS_ROS

if TYPE_CHECKING:
    from rich.table import Table

_EXAMPLE = 'accel-calib demo'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run simulator and calibrator in separate processes, and print the result."""
    try:
        from ..ros.demo import demonstrate
    except ImportError as err:
        raise InputError(f'ROS 2 is not installed ({err}), but the demonstration needs it',
                         NEEDS_ROS) from err
    console = options.console(args)
    outcome = asdict(demonstrate(lambda line: console.print(line, markup=False)))
    options.write_json(args.json, outcome)
    console.print(_table(outcome))
    return 0


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
        table.add_row(f'{words} [{unit}]'.replace('[', '\\['),
                      *(f'{outcome[f"{name}_{when}_{unit}"]:.3g}' for when in ('before', 'after')))
    return table
