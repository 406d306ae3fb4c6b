# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib refine`` and ``report``: find effects that a calibration lacks."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from .fit import error_line
from .frame import Done, rated, rating_lines, working
from .inputs import intake, prior, rows_between, stored_calibration
from ..effects import effect_named
from ..findings import rate_refinement, refinement_json
from ..intake import Intake
from ..refine import (
    base_words, chance, refine, refine_with_fleet, Refinement, residual_words, verdict_words)
from ..report import refinement_page, write_figures, write_page
from ..stored import write_calibration
from ..stored.exports import write_plan
from ..text import counted, listed, now, short


def run_refine(args: argparse.Namespace) -> Done:
    """Refine a calibration, and store it unless it is refused."""
    found, result = _refined(args)
    stored = list(_stored(args, result))
    rating = rate_refinement(result)
    return Done({'file': args.poses, **refinement_json(result), **rated(rating, args),
                 'read_as': found.read_as},
                [*found.lines, *_shown(args, result, stored), *rating_lines(rating, args)],
                refusal=result.refusal if args.output else ())


def _refined(args: argparse.Namespace) -> tuple[Intake, Refinement]:
    """Refine with one log."""
    stored = args.calibration and stored_calibration(args.calibration)
    with intake(args, args.poses, stored) as found, working('refining'):
        poses = found.poses.take(rows_between(found.poses, args.rows))
        base, fleet = stored.in_units(found.units) if stored else args.base, prior(args)
        if fleet is not None:
            return found, refine_with_fleet(poses, found.units, fleet, sensor=args.sensor,
                                            date=now(), also=args.own)
        return found, refine(poses, found.units, base=base, sensor=args.sensor, date=now(),
                             also=args.own)


def _stored(args: argparse.Namespace, result: Refinement) -> Iterator[Path]:
    """Write the report, a usable calibration and the plan; yield the paths written."""
    if args.report is not None:
        _draw(args.report, args, result)
        yield args.report
    if args.output is not None and not result.refusal:
        write_calibration(args.output, result.calibration)
        yield args.output
    if args.plan is not None and result.plan.poses:
        write_plan(args.plan, result.plan)
        yield args.plan


def _draw(page: Path, args: argparse.Namespace, result: Refinement) -> None:
    with working('drawing the page'):
        write_page(page, refinement_page(result, str(args.poses)))


def _shown(args: argparse.Namespace, result: Refinement, stored: list[Path]) -> Iterator[Any]:
    if result.steps:
        yield _steps_table(result)
    yield f'{verdict_words(result)}\n{residual_words(result)}'
    if result.disturbed_poses:
        yield f'left out: {listed("row", result.disturbed_poses)}'
    for line in result.calibration.warnings:
        yield f'note: {line}'
    for line in result.advice:
        yield f'advice: {line}'
    if args.plan is not None:
        for line in result.plan.lines:
            yield f'plan: {line}'
    if result.not_testable:
        names = ', '.join(effect for effect, _ in result.not_testable)
        yield f'these data cannot show: {names}'
    for path in stored:
        yield f'stored in {path}'


def several_refine(results: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield a line for each of several results."""
    for result in results:
        yield f'{result["file"]}: {error_line(result) or _in_a_line(result)}'


def _in_a_line(result: dict[str, Any]) -> str:
    names = ' + '.join([result['base'], *(step['effect'] for step in result['steps'])])
    return (f'{result["verdict"]}: {names}, {short(result["gap_mg"])} -> '
            f'{short(result["remaining_gap_mg"])} mg')


def _steps_table(result: Refinement) -> Table:
    """Return a table of the steps."""
    table = Table(title=f'From {base_words(result)}: residuals in mg, held out in brackets',
                  show_lines=True)
    table.add_column('effect, and where it was found', overflow='fold')
    for name in ('residual', 'chance'):
        table.add_column(name, no_wrap=True)
    for number, step in enumerate(result.steps, 1):
        gap = (f'{short(step.gap_before_mg)} -> {short(step.gap_after_mg)}\n'
               f'({short(step.held_out_before_mg)} -> {short(step.held_out_after_mg)})')
        lines = [f'{number}. {step.effect}', effect_named(step.name).words, step.where,
                 f'rivals: {", ".join(step.likely_rivals) or "none"}']
        table.add_row('\n'.join(lines), gap, chance(step.p_value))
    return table


def run_report(args: argparse.Namespace) -> Done:
    """Refine a calibration, and write the report and the figures."""
    _, result = _refined(args)
    _draw(args.output, args, result)
    lines = [f'{result.verdict}, stored in {args.output}']
    if args.figures is not None:
        count = len(write_figures(args.figures, result))
        lines.append(f'{counted(count, "file")}, stored in {args.figures}')
    return Done(shown=lines)
