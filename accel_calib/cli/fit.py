# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The commands that calibrate, and those from files to files.

``fit``, ``calibrate``, ``thermal``, ``refine``, ``report``, ``fleet``, ``capture``, ``apply``,
``simulate``, ``export``.

"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from rich.table import Table

from .frame import (
    check_target, console, Done, fleet_prior, given, intake, log_options, Output, progress,
    read_lines, rows_between, short_if_known, stored_calibration, table, Target, Verdict)
from ..calibration import Calibration, NORM_MODELS
from ..disk import STANDARD_OUTPUT, write_atomically
from ..effects import AXES, entry_of, parse_effect
from ..errors import InputError
from ..findings import (
    base_words, calibration_json, chance_words, effect_figures, linear_figures, Outlook, outlook,
    plan_lines, rate, Rating, refinement_json, request_words, rival_words, value_words,
    verdict_words)
from ..logs import is_bag, open_log, write_blocks, write_table
from ..pipeline import (
    calibrated, calibrated_log, captured_from, Correction, Intake, Outcome, Plan, ramp_or_poses,
    RampIntake, thermally_calibrated, ThermalOutcome)
from ..stillness import CaptureSettings
from ..stored import write_calibration
from ..text import counted, listed, now, short, with_sd
from ..units import MG

if TYPE_CHECKING:
    from ..refinement import Refinement


def run_fit(args: argparse.Namespace) -> Done:
    """Fit and store a calibration."""
    plan = replace(plan_of(args), refined=False)
    with intake(args, args.poses) as found, progress('fitting'):
        rows = rows_between(found.poses, args.rows) if args.rows else None
        outcome = calibrated(found.poses, found.units, replace(plan, rows=rows))
    calibration = outcome.calibration
    ahead = outlook(calibration, args.model)
    return _store(
        args, outcome, args.poses, found.read_as, found.lines, ahead=ahead,
        shown=_tables(calibration), page=partial(_page, args, args.poses, found, outcome),
        first=(f'model {calibration.name}: {calibration.reason}',
               f'next pose: {request_words(ahead.next_pose)}'))


def run_calibrate(args: argparse.Namespace) -> Done:
    """Calibrate and store."""
    plan = plan_of(args)
    with intake(args, args.log) as found, progress('fitting'):
        outcome = calibrated_log(args.log, log_options(args), found, plan)
    if isinstance(outcome, ThermalOutcome):
        return _store_thermal(args, [args.log], outcome,
                              'its temperature changes: fitted as by accel-calib thermal')
    refinement = outcome.refinement
    return _store(
        args, outcome, args.log, found.read_as, found.lines, first=(outcome.line,),
        shown=_tables(outcome.calibration) if args.verbose else (),
        page=partial(_page, args, args.log, found, outcome), refined=outcome.line,
        refinement=None if refinement is None else refinement_json(refinement))


def run_thermal(args: argparse.Namespace) -> Done:
    """Fit the offset over temperature; with a log of poses, one calibration of both."""
    found = []
    for path in args.logs:
        with progress('samples') as moved:
            found.append(ramp_or_poses(path, log_options(args), given(CaptureSettings, args),
                                       moved))
    with progress('fitting'):
        outcome = thermally_calibrated(found, Plan(**given(Plan, args)))
    return _store_thermal(args, args.logs, outcome)


def _store_thermal(args: argparse.Namespace, logs: Sequence[Path], outcome: ThermalOutcome,
                   *notes: str) -> Done:
    """Store, and return what is done, with further notes on the logs."""
    from ..report import thermal_page

    calibration = outcome.calibration
    lines = [*(line for each in outcome.logs for line in each.lines), *notes]
    is_whole = any(not isinstance(each, RampIntake) for each in outcome.logs)
    curve, values = outcome.curve, Table(title='Effects of temperature', show_header=False)
    for each in effect_figures(calibration):
        values.add_row(each.label, with_sd(each.value, each.sd), each.unit)
    band, (low, high) = f', uncertainty up to {short(curve.band_mg)} mg', curve.range_c
    errors = [*curve.held_out_mg.values()]
    return _store(
        args, outcome, list(logs), outcome.read_as, lines, thermal={
            'reference_c': curve.reference_c, 'range_c': curve.range_c, 'degree': curve.degree,
            'effects': [*map(str, curve.model.effects)], 'band_mg': curve.band_mg,
            'change_mg': curve.change_mg, 'residual_mg': curve.residual_mg,
            'held_out_mg': curve.held_out_mg},
        shown=[values if curve.model.effects else
               'the offset does not change with the temperature',
               f'degree {curve.degree} from {low:.1f} to {high:.1f} °C: {short(curve.change_mg)} '
               f'-> {short(curve.residual_mg)} mg{band if curve.model.effects else ""}',
               f'held-out parts of the log: {short(errors[0])} -> {short(errors[-1])} mg',
               *(_tables(calibration) if is_whole and args.verbose else ())],
        page=partial(thermal_page, outcome, list(map(str, logs)), stored=str(args.output),
                     notes=lines))


def plan_of(args: argparse.Namespace) -> Plan:
    """Return how to calibrate; raise InputError if ``--prior`` stands with another model."""
    fleet = fleet_prior(args)
    plan = Plan(**{**given(Plan, args), 'fleet': fleet, 'also': args.own})
    usual = plan.model in ('auto', NORM_MODELS[-1]) and plan.method == 'ml'
    if fleet is not None and not usual:
        raise InputError(f'--prior with --model {plan.model} --method {plan.method}, expected '
                         'model 10 by maximum likelihood', 'leave out these options')
    return plan


def _store(args: argparse.Namespace, outcome: Outcome, file: Path | list[Path], read_as: str,
           lines: Sequence[str], *, shown: Iterable[Any], page: Callable[[], str],
           first: Sequence[str] = (), ahead: Outlook | None = None, **result: Any) -> Done:
    """
    Write a calibration unless it is BAD, and return what is done.

    The rows left out are noted first; if they are several, their reasons come last.

    """
    calibration = outcome.calibration
    stored, left_out = _write(args, calibration, outcome.rating)
    reasons = [f'left out: row {each.row}: {each.reason}' for each in calibration.rejected]
    notes = [*reasons, *first, *lines]
    if len(reasons) > 1:
        rows = [each.row for each in calibration.rejected]
        notes = [f'left out: {listed("row", rows)}', *first, *lines, *reasons]
    known = calibration_json(calibration, ahead or outlook(calibration, 'auto'))
    return Done({'file': file, **known, 'read_as': read_as, 'read_lines': lines, **result},
                [*shown, *left_out], outcome.rating, stored=stored, page=page, notes=notes)


def _write(args: argparse.Namespace, calibration: Calibration, rating: Rating
           ) -> tuple[list[Path], list[str]]:
    """Write a calibration unless it is BAD; return the files written, and why there is none."""
    if args.output is None:
        return [], []
    if rating.name == 'BAD' and not args.keep_bad:
        return [], ['not stored, because it is BAD; to store it, use --keep-bad']
    write_calibration(args.output, calibration)
    return [args.output], []


def _page(args: argparse.Namespace, log: Path, found: Intake, outcome: Outcome) -> str:
    from ..report import calibration_page

    return calibration_page(outcome.calibration, outcome.rating, str(log), notes=found.lines,
                            refinement=outcome.refinement,
                            stored=str(args.output or 'calibration.yaml'))


def several_fit(results: Sequence[dict[str, Any]]) -> Iterator[Verdict]:
    """Yield a line for each of several results."""
    for result in results:
        line = (f'{result["file"]}: model {result["model"]}: {result["rms_before_mg"]:.3g} -> '
                f'{result["rms_after_mg"]:.3g} mg, ')
        yield Verdict(f'{line}{result["rating"]}', result['rating'], len(line))


def _tables(calibration: Calibration) -> Iterator[Any]:
    """Yield the residuals, the values of the model, and the gyro bias."""
    quality, gyro = calibration.quality, calibration.gyro
    yield table('Residual of |force| [mg]', (
        f'model {calibration.name}, {counted(len(calibration.used_poses), "pose")}', 'before',
        'after'), (
        ('RMS', short(quality.rms_before_mg), short(quality.rms_after_mg)),
        ('largest', short(quality.max_before_percent * MG / 100.0),
         short(quality.max_after_percent * MG / 100.0)),
        ('held out', '', short_if_known(quality.held_out_rms_mg)),
        ('noise floor', '', short_if_known(quality.noise_floor_mg))))
    parameters = Table(title='reading = W ΔR force + V', show_header=False)
    parameters.add_column('', no_wrap=True)
    parameters.add_column('', no_wrap=True, justify='right')
    parameters.add_column('', no_wrap=True)
    for each in (*linear_figures(calibration), *effect_figures(calibration)):
        parameters.add_row(each.label, with_sd(each.value, each.sd), each.unit)
    yield parameters
    if gyro is not None:
        values = ', '.join(f'{axis} {with_sd(bias, sd)}' for axis, bias, sd in zip(
            AXES, np.degrees(gyro.bias), np.degrees(gyro.sd), strict=True))
        slope = ('' if not np.any(gyro.slope) else
                 f' at {gyro.temperature:.1f} °C, changes by '
                 f'{", ".join(f"{each:+.2g}" for each in np.degrees(gyro.slope))} °/s per °C')
        yield f'gyro bias: {values} °/s{slope} ({counted(gyro.rests, "rest")})'


# ----------------------------------------------------------------------------- effects

def run_refine(args: argparse.Namespace) -> Done:
    """Refine a calibration, and store it unless it is refused."""
    from ..report import calibration_page

    found, result = _refined(args)
    rating = rate(result.calibration, refinement=result)
    stored, left_out = ([], []) if result.refusal else _write(args, result.calibration, rating)
    if args.plan is not None and result.plan.poses:
        from ..stored.exports import write_plan

        write_plan(args.plan, result.plan)
        stored.append(args.plan)
    table = Table(title=f'From {base_words(result)}: residuals in mg, held out in brackets',
                  show_lines=True)
    table.add_column('effect, and where it was found', overflow='fold')
    for name in ('residual', 'chance'):
        table.add_column(name, no_wrap=True)
    for number, step in enumerate(result.steps, 1):
        gap = (f'{short(step.gap_before_mg)} -> {short(step.gap_after_mg)}\n'
               f'({short(step.held_out_before_mg)} -> {short(step.held_out_after_mg)})')
        lines = [f'{number}. {step.effect}', entry_of(step.name).words,
                 ', '.join(f'{name} {value}'.lstrip() for name, value in value_words(step)),
                 step.where, f'rivals: {", ".join(rival_words(step)) or "none"}']
        table.add_row('\n'.join(filter(None, lines)), gap, chance_words(step.p_value))
    rows, missing = result.disturbed_poses, [name for name, _ in result.not_testable]
    plan = [f'plan: {line}' for line in plan_lines(result.plan)] if args.plan is not None else []
    return Done({'file': args.poses, **refinement_json(result), 'read_as': found.read_as},
                [*([table] if result.steps else ()), *plan, *left_out], rating,
                stored=stored, refusal=result.refusal if args.output else (),
                page=partial(calibration_page, result.calibration, rating, str(args.poses),
                             refinement=result, stored=str(args.output or 'calibration.yaml')),
                notes=[verdict_words(result),
                       *([f'left out: {listed("row", rows)}'] if rows else ()),
                       *(f'advice: {line}' for line in result.advice), *found.lines,
                       *([f'these data cannot show: {", ".join(missing)}'] if missing else ())])


def run_report(args: argparse.Namespace) -> Done:
    """Refine a calibration, and write the report and the figures."""
    from ..report import refinement_page, write_figures

    _, result = _refined(args)
    lines: list[str] = [result.verdict]
    if args.figures is not None:
        count = len(write_figures(args.figures, result))
        lines.append(f'{counted(count, "file")}, stored in {args.figures}')
    return Done(shown=lines, page=partial(refinement_page, result, str(args.poses)))


def _refined(args: argparse.Namespace) -> 'tuple[Intake, Refinement]':
    """Refine with one log."""
    from ..refinement import refine  # a fit alone does not load the search

    fleet = fleet_prior(args)
    stored = args.calibration and stored_calibration(args.calibration, args.own)
    with intake(args, args.poses, stored) as found, progress('refining'):
        poses = found.poses.take(rows_between(found.poses, args.rows))
        base = stored.in_units(found.units) if stored else fleet or args.base
        return found, refine(poses, found.units, base=base, sensor=args.sensor, date=now(),
                             also=args.own)


def several_refine(results: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield a line for each of several results."""
    for result in results:
        names = ' + '.join([result['base'], *(step['effect'] for step in result['steps'])])
        yield (f'{result["file"]}: {result["verdict"]}: {names}, {short(result["gap_mg"])} -> '
               f'{short(result["remaining_gap_mg"])} mg')


# ----------------------------------------------------------------------------- fleets

def run_fleet(args: argparse.Namespace) -> Done:
    """Calibrate many recordings on Dask."""
    from ..fleet import changes_of, cluster, LIMIT_S, Options, recordings, run, STATUS, Store

    with progress('looking for recordings'):
        found = list({each.path: each for each in recordings(args.recordings)}.values())
    asked = Options(**{**given(Options, args), 'log': log_options(args),
                       'settings': given(CaptureSettings, args),
                       'exports': tuple(dict.fromkeys(args.export))})
    with cluster(args.scheduler, args.workers) as client:
        console(args).print(f'{counted(len(found), "recording")}; dashboard: '
                            f'{client.dashboard_link}')
        with progress('recordings') as moved:
            summary = run(client, found, asked, Store(args.output.absolute()), moved,
                          limit_s=args.time_limit or LIMIT_S)
    counts = summary.counts
    return Done(
        {'recordings': len(found), **{name: counts[name] for name in STATUS},
         'sensors': summary.sensors},
        [f'{counts["ok"]} calibrated, {counts["error"]} with an error, {counts["unread"]} '
         f'could not be read, {counts["skipped"]} skipped because they are done',
         *(f'note: a file of the results was damaged and was made again; it is now {path}'
           for path in summary.damaged),
         *(f'{sensor}: {", ".join(filter(None, about))}'
           for sensor, *about in changes_of(summary.sensors)),
         f'{counted(len(summary.sensors), "sensor")}, stored in {args.output}'],
        summary.rating)


# ----------------------------------------------------------------------------- files to files

def run_capture(args: argparse.Namespace) -> Done:
    """Find the still stretches of a recording, and write the poses."""
    with progress('samples') as moved:
        found, captured = captured_from(args.recording, log_options(args),
                                        given(CaptureSettings, args), moved)
    write_table(args.output, found.poses)
    lines = [*found.lines, *(f'note: {each.words}' for each in found.poses.findings)]
    for item in captured.interruptions:
        what = {'gap': f'samples are missing for {item.seconds:.3g} s',
                'jump_back': f'the stamps jump back by {-item.seconds:.3g} s',
                'stopped': 'the stamps do not change'}[item.kind]
        lines.append(f'note: after {item.time:.3f} s {what}')
    return Done({
        'poses': len(captured.poses), 'samples': captured.recorded,
        'samples_in_poses': captured.samples,
        'threshold': captured.threshold, 'seconds': captured.seconds,
        'rests': [{'start': each.start, 'end': each.end, 'taken': not each.reason,
                   'reason': each.words} for each in captured.rests],
        'findings': [each.stated for each in found.poses.findings],
        'interruptions': [item._asdict() for item in captured.interruptions],
        'read_lines': replace(found, captured=found.captured[1:]).lines},
        lines, stored=[args.output])


def run_apply(args: argparse.Namespace) -> Done:
    """Correct a recording."""
    calibration = stored_calibration(args.calibration, args.own)
    if args.no_rotate:
        calibration = calibration.in_sensor_frame
    lines, notes = list[str](), list[str]()
    if isinstance(args.recording, Path) and is_bag(args.recording):
        from ..messages import correct_bag

        if str(args.output) == STANDARD_OUTPUT:
            raise InputError('a bag cannot be written to standard output, expected a file',
                             'name a file with -o')
        with progress('messages') as moved:
            count = correct_bag(args.recording, calibration, args.output, log_options(args),
                                moved, note=notes.append)
    else:
        with (open_log(args.recording, log_options(args, calibration)) as log,
              progress('samples') as moved):
            correction = Correction(calibration, log.units, log.sensor)
            blocks = log.watched(moved) if log.poses is None else (log.poses,)
            count = write_blocks(args.output, map(correction, blocks))
            lines += read_lines(log)
        notes += correction.notes
    return Done(shown=[*lines, *(f'note: {note}' for note in notes),
                       f'corrected {counted(count, "sample")}'], stored=[args.output])


def run_simulate(args: argparse.Namespace) -> Done:
    """Simulate poses or a recording, and write the table."""
    from ..api import simulate

    chosen = {name: getattr(args, name) for name in signature(simulate).parameters
              if hasattr(args, name) and name != 'also'}
    effects = dict(parse_effect(text, args.own) for text in args.effect)
    table = simulate(effects, also=args.own, **chosen)
    write_table(args.output, table)
    return Done(shown=[counted(len(table), 'row')], stored=[args.output])


def run_export(args: argparse.Namespace) -> Done:
    """Write the file, and print what it does not hold on standard error."""
    from ..stored.exports import export, FORMATS, identifier, Options, read_noise

    calibration = stored_calibration(args.calibration, args.own)
    is_file = args.output != STANDARD_OUTPUT
    named = args.output if is_file and args.output is not None else args.calibration
    own = identifier(Path(named).stem) if 'name' in FORMATS[args.to].takes else ''
    chosen = Options(**{**given(Options, args), 'name': args.name or own})
    noise = None if args.noise is None else read_noise(args.noise)
    made = export(calibration, args.to, noise, chosen)
    target = (args.calibration.with_name(f'{args.calibration.stem}{made.suffix}')
              if args.output is None else Path(args.output))
    if is_file:
        check_target(Target('output', target, 'export', '-o'), [args.calibration],
                     force=args.force)
    write_atomically(target, made.write)
    console = Output(stderr=True)
    for line in (*made.losses, *(f'note: {note}' for note in made.notes),
                 *([f'stored in {target}'] if is_file else [])):
        console.print(line)
    return Done({'format': args.to, 'file': target if is_file else None,
                 'calibration': args.calibration, 'leaves_mg': made.leaves_mg,
                 'losses': [asdict(loss) for loss in made.details], 'notes': made.notes})
