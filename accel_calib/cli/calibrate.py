# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib calibrate``: from any log to a calibration, a page and a verdict."""

from __future__ import annotations

import argparse
from pathlib import Path

from . import options
from .results import calibration_result, refine_result, show_calibration
from .terminal import working
from ..calibrate import FRAMES
from ..intake import Intake
from ..pipeline import calibrated, Flat, Outcome
from ..report import has_matplotlib, write_calibration_page
from ..stored import write_calibration

_EXAMPLE = 'accel-calib calibrate log.csv --flat last'

BAD_RATING = 1
"""Exit status for a calibration that is BAD."""


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('log', type=Path, metavar='LOG', help='recording or pose table: CSV in any '
                      'dialect, rosbag2, .mcap, .db3, ROS 1 .bag, PX4 .ulg, ArduPilot .bin')
    made.add_argument('-o', '--output', type=Path, default=Path('calibration.yaml'),
                      metavar='FILE', help='calibration to write (default: %(default)s); the page '
                      'has the same name with .html')
    made.add_argument('--flat', type=_flat, metavar='ROW', help='pose with the robot level: its '
                      'row, 1-based, or first or last; it determines the mounting')
    made.add_argument('--nose-down', type=int, metavar='ROW', help='row of a pose with the nose '
                      'of the robot tilted straight down; it determines the heading')
    made.add_argument('--frame', choices=FRAMES, default='ros',
                      help='levelled frame (default: ros, z up)')
    made.add_argument('--no-refine', action='store_true',
                      help='do not look for effects beyond offset, gain and cross-axis')
    made.add_argument('--keep-bad', action='store_true',
                      help='store a calibration that is BAD, too')
    options.add_prior(made)
    options.add_log(made)
    options.add_max_dwell(made)
    options.add_json(made)
    made.set_defaults(run=run)


def _flat(text: str) -> Flat:
    """Return the flat pose from an argument."""
    if text == 'first':
        return 'first'
    if text == 'last':
        return 'last'
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text}: expected a row, first or last') from None


def run(args: argparse.Namespace) -> int:
    """Calibrate, store, write the page, and print the verdict."""
    with options.errors_in_json(args.json, file=args.log):
        intake = options.intake(args, args.log)
        with working('fitting'):
            outcome = calibrated(intake.poses, intake.units, flat=args.flat,
                                 nose_down=args.nose_down, frame=args.frame, sensor=args.sensor,
                                 refined=not args.no_refine, fleet=options.prior(args))
    stored = _store(args, intake, outcome)
    options.write_json(args.json, {'file': args.log, **_result(intake, outcome)})
    _show(args, intake, outcome, stored)
    return BAD_RATING if outcome.rating.name == 'BAD' else 0


def _store(args: argparse.Namespace, intake: Intake, outcome: Outcome) -> list[str]:
    """Write the calibration, unless it is BAD, and the page; return lines about them."""
    lines = []
    if outcome.rating.name != 'BAD' or args.keep_bad:
        write_calibration(args.output, outcome.calibration)
        lines.append(f'stored in {args.output}')
    else:
        lines.append('not stored, because it is BAD; to store it, use --keep-bad')
    page = args.output.with_suffix('.html')
    if has_matplotlib():
        with working('drawing the page'):
            write_calibration_page(page, outcome.calibration, outcome.rating, str(args.log),
                                   refinement=outcome.refinement, stored=str(args.output),
                                   notes=intake.lines)
        lines.append(f'page: {page}')
    else:
        lines.append(f'no page {page}: matplotlib is not installed')
    return lines


def _result(intake: Intake, outcome: Outcome) -> dict[str, object]:
    """Return the result for JSON."""
    refinement = outcome.refinement
    return {**calibration_result(outcome.calibration, 'auto'), **options.rated(outcome.rating),
            'read_lines': intake.lines, 'refined': outcome.line,
            'refinement': None if refinement is None else refine_result(refinement)}


def _show(args: argparse.Namespace, intake: Intake, outcome: Outcome, stored: list[str]) -> None:
    """Print how the log was read, the calibration, and the verdict last."""
    console = options.console(args)
    for line in intake.lines:
        console.print(line)
    show_calibration(console, outcome.calibration)
    console.print(outcome.line)
    for line in (*stored, *outcome.rating.lines):
        console.print(line)
