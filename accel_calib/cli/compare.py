# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib verify``, ``compare``, ``history``, ``noise``: judge calibrations and sensors."""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from rich.table import Table

from .commands import next_command
from .frame import (
    Done, FAILED, intake, log_options, NARROW, progress, read_lines, rows_between, short_if_known,
    stored_calibration, table, Verdict)
from ..calibration import verify
from ..comparison import compare, history_of
from ..errors import InputError
from ..findings import (
    change_words, GAINS, in_words, OFFSETS, rate_comparison, rate_noise, rate_verification,
    rating_json)
from ..logs import open_log
from ..noise import check_allantools, duration, noise_of, to_json, whole
from ..pipeline import Correction
from ..report import calibration_page
from ..report.stability import (
    comparison_page, figure_rows, history_page, kalibr_lines, need_lines, noise_page,
    parameter_rows)
from ..table import check_units, Recording
from ..text import counted, plain, short
from ..units import units_of


def run_verify(args: argparse.Namespace) -> Done:
    """Evaluate a calibration on the poses of a log."""
    stored = stored_calibration(args.calibration, args.own)
    with intake(args, args.poses, stored) as found:
        calibration = stored.in_units(found.units)
        poses = found.poses.take(rows_between(found.poses, args.rows))
        check_units(poses, calibration.units)
        verification = verify(calibration, poses)
    rating = rate_verification(verification, calibration, poses)
    lines = [*found.lines, *(each.words for each in poses.findings)]
    page = partial(calibration_page, calibration, rating, str(args.poses), notes=lines,
                   verification=(verification, poses), stored=str(args.calibration))
    command = next_command(rating.next, args)
    result = {'file': args.poses, 'poses': len(poses), **asdict(verification),
              **rating_json(rating, rating.next, command), 'read_as': found.read_as,
              'read_lines': lines,
              'rating_lines': [*rating.lines, *([f'      {command}'] if command else [])]}
    above = args.max is not None and not verification.rms_after_mg <= args.max
    result |= {} if args.max is None else {'max_mg': args.max, 'above_max': above}
    return Done(result, several_verify([plain(result)], named=False),
                status=FAILED if above or rating.name == 'BAD' else 0, page=page)


def several_verify(results: Sequence[dict[str, Any]], *, named: bool = True) -> Iterator[Any]:
    """Yield how the logs were read, a row for each, and the ratings."""
    names = [f'{result["file"]}: ' if named else '' for result in results]
    for name, result in zip(names, results, strict=True):
        yield from (f'{name}{line}' for line in result['read_lines'])
    yield table(
        'Residual of |force| over these poses [mg]',
        ('poses', 'before', 'after', 'largest after', 'noise floor'),
        ((result['file'], short(result['rms_before_mg']), short(result['rms_after_mg']),
          short(result['max_after_percent'] * 10), short_if_known(result['noise_floor_mg']))
         for result in results))
    for name, result in zip(names, results, strict=True):
        first, *others = result['rating_lines']
        yield Verdict(f'{name}{first}', result['rating'], len(name))
        yield from (f'{name}{line}' for line in others)
        if result.get('above_max'):
            yield (f'{name}residual {short(result["rms_after_mg"])} mg is above --max '
                   f'{result["max_mg"]:g} mg: exit status {FAILED}')


def run_compare(args: argparse.Namespace) -> Done:
    """Test whether calibrations agree."""
    paths = args.calibrations
    calibrations = [stored_calibration(path, args.own) for path in paths]
    comparison = compare(calibrations)
    rating = rate_comparison(comparison)
    models = [calibration.name for calibration in calibrations]
    outlier = comparison.outlier
    lines = [
        table('Corrected |a| minus the mean of the others [mg]',
              ('run', 'model', 'RMS', 'expected', 'largest', 'p'),
              ((f'{number} {path}', model, f'{run.rms_mg:.3g}', f'{run.expected_mg:.3g}',
                f'{run.largest_mg:.3g}', f'{run.p_value:.2g}') for number, (path, model, run) in
               enumerate(zip(paths, models, comparison.runs, strict=True), 1))),
        table('Spread of the parameters over the runs', ('', 'mean', 'spread', 'stated', 'ratio'),
              parameter_rows(comparison)),
        *(f'note: {note}' for note in comparison.notes),
        *filter(None, [comparison.tilt_words])]
    if not comparison.agree and len(comparison.runs) == 2:
        lines.append('a third run would show which one differs')
    result = {**asdict(comparison), 'outlier': None if outlier is None else outlier + 1,
              'runs': [{'file': path, 'model': model, **asdict(run)} for path, model, run in
                       zip(paths, models, comparison.runs, strict=True)]}
    return Done(result, lines, rating, status=0 if comparison.agree else FAILED,
                page=partial(comparison_page, comparison, rating, paths, calibrations))


def run_history(args: argparse.Namespace) -> Done:
    """Sort calibrations by date, and compare them; in JSON, runs are numbered from 1."""
    calibrations = [stored_calibration(path, args.own) for path in args.calibrations]
    history, rows, lines, changes = history_of(calibrations), [], list[str](), []
    paths, labels = args.calibrations, history.labels
    found = {each.name: each for each in history.parameters}
    for k, (label, moment) in enumerate(zip(labels, history.moments, strict=True)):
        warm = '' if moment.temperature is None else f'{moment.temperature:.0f} °C'
        for begin, names in zip((label, warm, ''), zip(OFFSETS, GAINS, strict=True), strict=True):
            cells = (in_words(name, found[name].values[k], found[name].stated_sd[k])
                     for name in names)
            rows.append((begin, names[0][-1], *(cell.rpartition(' ')[0].replace('−', '-')
                                                for cell in cells)))
    for number, change in enumerate(history.changes, 1):
        comparison, most = change.comparison, change_words(
            change.parameter, change.change, change.sd).replace('−', '-')
        rating = rate_comparison(comparison)
        changes.append({
            'from': number, 'to': number + 1, 'agree': comparison.agree,
            'p_value': comparison.p_value, 'rms_mg': comparison.runs[1].rms_mg,
            'largest_mg': comparison.runs[1].largest_mg, 'parameter': change.parameter,
            'change': change.change, 'change_sd': change.sd,
            **rating_json(rating, rating.next, next_command(rating.next, args))})
        verdict = 'agree' if comparison.agree else 'differ'
        lines.append(f'{labels[number - 1]} to {labels[number]}: {verdict} (p = '
                     f'{comparison.p_value:.2g}), {rating.name}; largest change: {most}')
    result = {
        'agree': history.whole.agree, 'p_value': history.whole.p_value,
        'runs': [{'file': paths[moment.index], 'date': moment.when and moment.when.isoformat(),
                  'model': moment.model, 'temperature': moment.temperature,
                  'residual_mg': moment.residual_mg} for moment in history.moments],
        'parameters': [{'name': each.name, 'values': each.values, 'stated_sd': each.stated_sd}
                       for each in history.parameters],
        'changes': changes, 'notes': history.notes}
    shown = [table('', ('date', '', 'offset [mg]', 'gain - 1 [%]'), rows, show_edge=False,
                   **NARROW), *lines, *(f'note: {note}' for note in history.notes)]
    return Done(result, shown, page=partial(history_page, history, paths, calibrations))


def run_noise(args: argparse.Namespace) -> Done:
    """Find a long rest, and compute the figures of its noise."""
    check_allantools()
    calibration = args.calibration and stored_calibration(args.calibration, args.own)
    with open_log(args.recording, log_options(args, calibration)) as log:
        if log.poses is None:
            with progress('samples') as moved:
                recording = whole(log.watched(moved))
        elif 'time' in log.poses and 'count' not in log.poses:
            recording = Recording(**vars(log.poses))  # a table of slow samples looks like poses
        else:
            raise InputError(f'{args.recording} is a pose table, expected a recording',
                             'use the samples of a long rest, with their time')
        lines, units = read_lines(log), log.units
    if calibration:
        recording = Correction(calibration, units, recording.sensor)(recording)
        units = units_of('g') if units.is_native else units
    with progress('axes') as moved:
        found = noise_of(recording, units, args.gravity, moved)
    shown: list[str | Table] = [*lines, f'rest of {duration(found.seconds)}: '
                                f'{counted(found.samples, "sample")} at {found.rate:.5g} Hz']
    for kind in found.kinds:
        axes = found.of(kind)
        rows = list(figure_rows(axes))
        shown.append(table(kind, ('', *(axis.axis for axis in axes)), (
            (f'{label}, {unit}', *cells[:-1]) for label, unit, cells in rows), **NARROW))
        shown += [f'typical {label}: {cells[-1]} {unit}'
                  for label, unit, cells in rows if cells[-1]]
    shown += [*(f'note: {note}' for note in found.notes), *need_lines(found), *kalibr_lines(found)]
    return Done({'recording': args.recording, **to_json(found)}, shown, rate_noise(found),
                page=partial(noise_page, found, str(args.recording)))
