# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib report``: refine a calibration, and write a report with figures."""

from __future__ import annotations

import argparse
from pathlib import Path

from . import options
from .refine import add_inputs, refine_file
from .terminal import working
from ..report import check_matplotlib, write_figures, write_page
from ..text import counted

_EXAMPLE = 'accel-calib report poses.csv -o report.html --figures figures'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('poses', type=Path, metavar='POSES',
                      help='pose table (CSV), or recording (bag, or table of samples)')
    made.add_argument('-o', '--output', type=Path, required=True, metavar='FILE',
                      help='report to write (HTML)')
    made.add_argument('--figures', type=Path, metavar='FOLDER',
                      help='folder for the figures as SVG and PNG')
    add_inputs(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Refine, and write the report and the figures."""
    check_matplotlib()
    result = refine_file(args, args.poses)
    with working('drawing the page'):
        write_page(args.output, result, str(args.poses))
    console = options.console(args)
    console.print(f'{result.verdict}, stored in {args.output}')
    if args.figures is not None:
        count = len(write_figures(args.figures, result))
        console.print(f'{counted(count, "file")}, stored in {args.figures}')
    return 0
