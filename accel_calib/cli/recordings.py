# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib capture``, ``apply``, ``simulate`` and ``noise``: commands on recordings."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from .frame import Done, progress, rated, rating_lines, working
from .inputs import log_options, settings, stored_calibration
from ..calibrate import Calibration, check_sensor, of_samples, Outside, SampleContext
from ..capture import Captured
from ..disk import STANDARD_OUTPUT
from ..effects import Context, parse_effect
from ..errors import InputError
from ..findings import rate_noise
from ..intake import Intake, samples_again, still_poses
from ..logs import is_bag, open_log, OpenLog, Progress, write_blocks, write_table
from ..table import Poses, Recording
from ..text import counted
from ..units import UnitName, Units, units_of

if TYPE_CHECKING:
    from ..noise import AxisNoise, NoiseFigures


def run_capture(args: argparse.Namespace) -> Done:
    """Find the still stretches of a recording, and write the poses."""
    with open_log(args.recording, log_options(args)) as log, progress('samples') as moved:
        captured, wider = still_poses(
            str(args.recording), log.units, settings(args), log.watched(moved),
            lambda: samples_again(args.recording, log_options(args)))
        lines = Intake(captured.poses, log.units, log.read_as, log.notes, wider).lines
    write_table(args.output, replace(captured.poses, units=log.units.name))
    return Done({
        'poses': len(captured.poses), 'samples': captured.recorded,
        'samples_in_poses': captured.samples,
        'threshold': captured.threshold, 'seconds': captured.seconds,
        'interruptions': [item._asdict() for item in captured.interruptions],
        'read_lines': lines}, [*lines, *_captured_lines(args, captured)])


def _captured_lines(args: argparse.Namespace, captured: Captured) -> Iterator[str]:
    yield (f'{counted(len(captured.poses), "pose")} in {captured.seconds:.0f} s of '
           f'{args.recording}, stored in {args.output}')
    for item in captured.interruptions:
        what = {'gap': f'samples are missing for {item.seconds:.3g} s',
                'jump_back': f'the stamps jump back by {-item.seconds:.3g} s',
                'stopped': 'the stamps do not change'}[item.kind]
        yield f'note: after {item.time:.3f} s {what}'


def run_apply(args: argparse.Namespace) -> Done:
    """Correct a recording."""
    calibration = stored_calibration(args.calibration)
    if args.no_rotate:
        calibration = calibration.in_sensor_frame
    left: list[Outside] = []
    lines: list[str] = []
    if isinstance(args.recording, Path) and is_bag(args.recording):
        from ..messages import correct_bag

        if str(args.output) == STANDARD_OUTPUT:
            raise InputError('a bag cannot be written to standard output, expected a file',
                             'name a file with -o')
        with progress('messages') as moved:
            count = correct_bag(args.recording, calibration, args.output, args.topic, moved,
                                left.append, note=lambda line: lines.append(f'note: {line}'),
                                temperature_topic=args.temperature_topic,
                                supply_topic=args.supply_topic, units=args.units or 'm/s2',
                                gravity=args.gravity)
    else:
        count = _correct_table(args, calibration, left.append, lines)
    return Done(shown=[*lines, *(f'note: {each.line}' for each in left),
                       f'corrected {counted(count, "sample")}, stored in {args.output}'])


def _correct_table(args: argparse.Namespace, calibration: Calibration,
                   report: Callable[[Outside], object], lines: list[str]) -> int:
    """Correct a log that is not a bag; how it was read is added to the lines."""
    path, out = args.recording, args.output
    with (open_log(path, log_options(args, calibration)) as log,
          progress('samples') as moved):
        calibration = calibration.in_units(log.units)
        check_sensor(calibration, log.sensor)
        context = SampleContext(calibration)
        blocks = log.watched(moved) if log.poses is None else (log.poses,)
        count = write_blocks(out, (corrected(block, calibration,
                                             context.of(block.columns, len(block)))
                                   for block in blocks))
        lines += [f'read as: {log.read_as}'] if log.read_as else []
        lines += [f'note: {line}' for line in log.notes]
        lines += [f'note: {context.lacking}'] if context.lacking else []
    for each in context.left:
        report(each)
    return count


def corrected(table: Poses | Recording, calibration: Calibration, known: Context
              ) -> Poses | Recording:
    """Return a table with the corrected readings, in m/s² or g; `known` is its context."""
    columns = {'reading': calibration.correct(table.reading, known)}
    units: UnitName = 'g' if calibration.units.is_native else calibration.units.name
    if 'rate' in table:
        columns['rate'] = table['rate'] @ calibration.model.rotation
    if 'std' in table:
        columns['std'] = calibration.units.to_g(table['std']) * calibration.force_per_g
    return replace(table.with_columns(**columns), units=units, autopilot=None)


def run_simulate(args: argparse.Namespace) -> Done:
    """Simulate poses or a recording, and write the table."""
    from ..api import simulate

    chosen = {name: getattr(args, name) for name in signature(simulate).parameters
              if hasattr(args, name) and name != 'also'}
    table = simulate(dict(parse_effect(text) for text in args.effect), **chosen)
    write_table(args.output, table)
    return Done(shown=[f'{counted(len(table), "row")}, stored in {args.output}'])


def run_noise(args: argparse.Namespace) -> Done:
    """Find a long rest, and compute the figures of its noise."""
    from ..noise import check_allantools, to_json
    from ..report import write_page
    from ..report.stability import noise_page

    check_allantools()
    found, lines = _noise(args)
    if args.report is not None:
        with working('drawing the page'):
            write_page(args.report, noise_page(found, str(args.recording)))
        stored = [f'stored in {args.report}']
    else:
        stored = []
    rating = rate_noise(found)
    return Done({'recording': args.recording, **to_json(found), **rated(rating, args)},
                [*lines, *_noise_lines(found), *stored, *rating_lines(rating, args)])


def _noise(args: argparse.Namespace) -> tuple[NoiseFigures, list[str]]:
    """Return the figures, and how the recording was read."""
    from ..noise import noise_of

    asked = log_options(args)
    calibration = args.calibration and stored_calibration(args.calibration)
    if calibration and calibration.units.is_native:
        asked = replace(asked, units=asked.units or 'native')
    with open_log(args.recording, asked) as log:
        with progress('samples') as moved:
            recording = _samples(log, args.recording, moved)
        lines = [f'read as: {log.read_as}'] if log.read_as else []
        lines += [f'note: {note}' for note in log.notes]
        units = log.units
    if calibration:
        recording, units = _corrected_rest(recording, units, calibration)
    with progress('axes') as moved:
        return noise_of(recording, units, args.gravity, moved), lines


def _samples(log: OpenLog, path: Path, moved: Progress) -> Recording:
    """
    Return the samples of a log.

    A table of slow samples has the form of a pose table without the columns of a pose.

    """
    from ..noise import whole

    if log.poses is None:
        return whole(log.watched(moved))
    if 'time' in log.poses and 'count' not in log.poses:
        return Recording(log.poses.columns, log.poses.row, log.poses.units, log.poses.sensor)
    raise InputError(f'{path} is a pose table, expected a recording',
                     'use the samples of a long rest, with their time')


def _corrected_rest(recording: Recording, units: Units, calibration: Calibration
                    ) -> tuple[Recording, Units]:
    """Return the corrected recording, in g if it was in native units."""
    own = calibration.in_units(units)
    check_sensor(own, recording.sensor)
    known = of_samples(recording.columns, len(recording), own.model)
    made = recording.with_columns(reading=own.correct(recording.reading, known))
    return made, units_of('g') if units.is_native else units


def _noise_lines(found: NoiseFigures) -> Iterator[str | Table]:
    """Yield the figures by axis, the notes, and the figures for Kalibr."""
    from ..noise import duration
    from ..report.stability import figure_rows, kalibr_lines, need_lines

    yield (f'rest of {duration(found.seconds)}: {counted(found.samples, "sample")} at '
           f'{found.rate:.5g} Hz')
    for kind in found.kinds:
        yield _noise_table(kind, found.of(kind))
        yield from (f'typical {label}: {cells[-1]} {unit}'
                    for label, unit, cells in figure_rows(found.of(kind)) if cells[-1])
    yield from (f'note: {note}' for note in found.notes)
    yield from need_lines(found)
    yield from kalibr_lines(found)


def _noise_table(kind: str, axes: tuple[AxisNoise, ...]) -> Table:
    """Return the table of one sensor, at most 60 columns wide."""
    from ..report.stability import figure_rows

    table = Table(title=kind, box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column('')
    for axis in axes:
        table.add_column(axis.axis, justify='right', no_wrap=True)
    for label, unit, cells in figure_rows(axes):
        table.add_row(f'{label}, {unit}', *cells[:-1])
    return table
