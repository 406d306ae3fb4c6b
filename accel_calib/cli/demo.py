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

    from ..ros.demo import Outcome

_EXAMPLE = 'accel-calib demo --hidden temperature'

HIDDEN = {
    'temperature': 'offset_temperature=4e-4,-3e-4,5e-4',
    'temperature-lag': 'offset_temperature=8e-4,-6e-4,1e-3,12,0',
    'gain-temperature': 'gain_temperature=5e-4,-4e-4,6e-4',
    'quadratic': 'quadratic=0.004,-0.003,0.005'}
"""What the sensor can hide, as effects of the simulator. The lag is that of the die, 12 s."""

_ERRORS = {'vector_mg': 'error of a, RMS [mg]', 'rms_mg': 'error of |a|, RMS [mg]',
           'max_mg': 'error of |a|, largest [mg]', 'tilt_deg': 'error of up, RMS [deg]'}

CHECK_FAILED = 1
"""Exit status if the error does not shrink, or the hidden effect is not found."""


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
    outcome = demonstrate(report, HIDDEN.get(args.hidden, ''))
    options.write_json(args.json, _to_json(outcome))
    console.print(_table(outcome))
    if args.hidden is not None:
        report(_verdict(outcome))
    return 0 if outcome.succeeded else CHECK_FAILED


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
    from rich.table import Table

    table = Table(title=f'Errors at {outcome.rests} rests in other poses, '
                  f'after {outcome.seconds:.0f} s')
    table.add_column('')
    for name in (('imu/data_calibrated', 'after ~/refine') if outcome.hidden else
                 ('imu/data_raw', 'imu/data_calibrated')):
        table.add_column(name, justify='right')
    before, after = asdict(outcome.before), asdict(outcome.after)
    for name, words in _ERRORS.items():
        table.add_row(words, f'{before[name]:.3g}', f'{after[name]:.3g}')
    return table
