# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib fit``, ``calibrate`` and ``fleet``: from logs to calibrations."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from rich.table import Table

from .frame import console, Done, progress, rated, rating_lines, table, Verdict, working
from .inputs import given, intake, log_options, plan_of, rows_between, settings
from ..calibrate import Calibration, GyroBias, Outlook, outlook
from ..disk import STANDARD_OUTPUT
from ..errors import system_error
from ..findings import calibration_json, effect_figures, linear_figures, Rating, refinement_json
from ..intake import Intake
from ..pipeline import calibrated, Outcome
from ..stored import write_calibration
from ..text import counted, short, with_sd
from ..units import MG

if TYPE_CHECKING:
    from ..fleet import Summary

BAD_RATING = 1
"""Exit status for a calibration that is BAD."""


def run_fit(args: argparse.Namespace) -> Done:
    """Fit and store a calibration."""
    with intake(args, args.poses) as found, working('fitting'):
        outcome = calibrated(found.poses, found.units, plan_of(
            args, refined=False, rows=rows_between(found.poses, args.rows)))
    calibration, rating = outcome.calibration, outcome.rating
    ahead = outlook(calibration, args.model)
    stored = [] if args.output is None else [_store(args, calibration, rating)]
    if args.report is not None:
        from ..report import calibration_page, write_page

        with working('drawing the page'):
            write_page(args.report, calibration_page(
                calibration, rating, str(args.poses), notes=found.lines,
                stored=str(args.output or 'calibration.yaml')))
        stored.append(f'stored in {args.report}')
    return Done({'file': args.poses, **calibration_json(calibration, ahead),
                 **rated(rating, args), 'read_as': found.read_as, 'read_lines': found.lines},
                [*_shown(found, calibration, ahead), *stored,
                 *rating_lines(rating, args)],
                BAD_RATING if rating.name == 'BAD' else 0)


def _store(args: argparse.Namespace, calibration: Calibration, rating: Rating) -> str:
    """Write a calibration unless it is BAD; return a line about it."""
    if rating.name == 'BAD' and not args.keep_bad:
        return 'not stored, because it is BAD; to store it, use --keep-bad'
    write_calibration(args.output, calibration)
    return f'stored in {args.output}'


def _shown(found: Intake, calibration: Calibration, ahead: Outlook) -> Iterator[Any]:
    yield from found.lines
    yield from calibration_lines(calibration)
    yield f'model {calibration.name}: {calibration.reason}'
    yield f'next pose: {ahead.next_pose.words}'


def several_fit(results: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield a line for each of several results."""
    for result in results:
        line = f'{result["file"]} ' + (error_line(result) or (
            f'model {result["model"]}: {result["rms_before_mg"]:.3g} -> '
            f'{result["rms_after_mg"]:.3g} mg, '))
        yield line if 'error' in result else Verdict(
            f'{line}{result["rating"]}', result['rating'], len(line))


def error_line(result: dict[str, Any]) -> str:
    """Return the error of one of several inputs; empty if there is none."""
    return f'{result["error"]}; {result["advice"]}' if 'error' in result else ''


def run_calibrate(args: argparse.Namespace) -> Done:
    """Calibrate, store, and write the page."""
    with intake(args, args.log) as found, working('fitting'):
        outcome = calibrated(found.poses, found.units, plan_of(args))
    stored = _stored_outcome(args, found, outcome)
    ahead = outlook(outcome.calibration, 'auto')
    refinement, rating = outcome.refinement, outcome.rating
    return Done(
        {'file': args.log, **calibration_json(outcome.calibration, ahead), **rated(rating, args),
         'read_as': found.read_as, 'read_lines': found.lines, 'refined': outcome.line,
         'refinement': None if refinement is None else refinement_json(refinement)},
        [*found.lines, *calibration_lines(outcome.calibration), outcome.line, *stored,
         *rating_lines(rating, args)], BAD_RATING if rating.name == 'BAD' else 0)


def _stored_outcome(args: argparse.Namespace, found: Intake, outcome: Outcome) -> list[str]:
    """Write the calibration and the page; return lines about them."""
    from ..report import calibration_page, has_matplotlib, write_page

    line = _store(args, outcome.calibration, outcome.rating)
    if str(args.output) == STANDARD_OUTPUT:
        return [line]
    page = args.output.with_suffix('.html')
    if not has_matplotlib():
        return [line, f'no page {page}: matplotlib is not installed']
    try:
        with working('drawing the page'):
            write_page(page, calibration_page(
                outcome.calibration, outcome.rating, str(args.log), stored=str(args.output),
                refinement=outcome.refinement, notes=found.lines))
    except OSError as err:  # the calibration is stored
        return [line, f'no page {page}: {system_error(err)}']
    return [line, f'page: {page}']


def run_fleet(args: argparse.Namespace) -> Done:
    """Calibrate many recordings on Dask."""
    from ..fleet import cluster, LIMIT_S, Options, recordings, run, STATUS, Store

    with working('looking for recordings'):
        found = list({each.path: each for each in recordings(args.recordings)}.values())
    asked = Options(**{**given(Options, args), 'log': log_options(args),
                       'settings': settings(args), 'exports': tuple(dict.fromkeys(args.export))})
    with cluster(args.scheduler, args.workers) as client:
        console(args).print(f'{counted(len(found), "recording")}; dashboard: '
                            f'{client.dashboard_link}')
        with progress('recordings') as moved:
            summary = run(client, found, asked, Store(args.output.absolute()), moved,
                          args.time_limit or LIMIT_S)
    return Done({'recordings': len(found), **{name: summary.counts[name] for name in STATUS},
                 'sensors': summary.sensors, **rated(summary.rating, args)},
                [*_summary_lines(summary, args.output), *rating_lines(summary.rating, args)])


def _summary_lines(summary: Summary, output: Path) -> Iterator[str]:
    """Yield the summary as lines of text."""
    counts = summary.counts
    yield (f'{counts["ok"]} calibrated, {counts["error"]} with an error, {counts["unread"]} '
           f'could not be read, {counts["skipped"]} skipped because they are done')
    for path in summary.damaged:
        yield f'note: a file of the results was damaged and was made again; it is now {path}'
    for row in summary.sensors:
        for change in row['changes']:
            if change['for_good']:
                yield (f'{row["sensor"]} changed for good at {change["date"]}: '
                       f'{change["parameter"]} (p = {change["p_value"]:.2g})')
    yield f'{counted(len(summary.sensors), "sensor")}, stored in {output}'


def _gyro_line(gyro: GyroBias) -> str:
    """Return the gyro bias as a line of text, in °/s."""
    values = ', '.join(f'{axis} {with_sd(bias, sd)}' for axis, bias, sd in zip(
        'xyz', np.degrees(gyro.bias), np.degrees(gyro.sd), strict=True))
    slope = ('' if not np.any(gyro.slope) else
             f' at {gyro.temperature:.1f} °C, changes by '
             f'{", ".join(f"{each:+.2g}" for each in np.degrees(gyro.slope))} °/s per °C')
    return f'gyro bias: {values} °/s{slope} ({counted(gyro.rests, "rest")})'


def calibration_lines(calibration: Calibration) -> Iterator[Any]:
    """Yield tables and lines: quality, parameters, poses left out and warnings."""
    yield _quality_table(calibration)
    yield _parameter_table(calibration)
    if calibration.gyro is not None:
        yield _gyro_line(calibration.gyro)
    for rejected in calibration.rejected:
        yield f'left out: row {rejected.row}: {rejected.reason}'
    for warning in calibration.warnings:
        yield f'note: {warning}'


def _quality_table(calibration: Calibration) -> Table:
    """Return a table of the residual before and after the fit."""
    quality = calibration.quality
    return table('Residual of |force| [mg]', (
        f'model {calibration.name}, {counted(len(calibration.used_poses), "pose")}', 'before',
        'after'), (
        ('RMS', short(quality.rms_before_mg), short(quality.rms_after_mg)),
        ('largest', short(quality.max_before_percent * MG / 100.0),
         short(quality.max_after_percent * MG / 100.0)),
        ('held out', '', short_if_known(quality.held_out_rms_mg)),
        ('noise floor', '', short_if_known(quality.noise_floor_mg))))


def _parameter_table(calibration: Calibration) -> Table:
    """Return a table of the parameters that the model has, with their standard deviations."""
    table = Table(title='reading = W ΔR force + V', show_header=False)
    table.add_column('', no_wrap=True)
    table.add_column('', no_wrap=True, justify='right')
    table.add_column('', no_wrap=True)
    for each in (*linear_figures(calibration), *effect_figures(calibration)):
        table.add_row(each.label, with_sd(each.value, each.sd), each.unit)
    return table


def short_if_known(value: float | None) -> str:
    """Return a number in three digits, or that it is not known."""
    return 'not known' if value is None else short(value)
