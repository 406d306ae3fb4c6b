# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib noise``: noise density, bias instability and random walk from a long rest."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from rich import box
from rich.table import Table

from .frame import Done, progress, working
from .inputs import log_options, stored_calibration
from ..calibrate import Calibration, check_sensor, of_samples
from ..errors import InputError
from ..logs import open_log, OpenLog, Progress
from ..noise import (
    AxisNoise,
    check_allantools,
    duration,
    joined,
    noise_of,
    NoiseFigures,
    to_json,
)
from ..report.noise_page import figure_rows, kalibr_lines, need_lines, write_noise_page
from ..table import Recording
from ..text import counted
from ..units import Units, units_of


def run_noise(args: argparse.Namespace) -> Done:
    """Find the rest, and compute the figures."""
    check_allantools()
    found, lines = _noise(args)
    if args.report is not None:
        with working('drawing the page'):
            write_noise_page(args.report, found, str(args.recording))
        stored = [f'stored in {args.report}']
    else:
        stored = []
    return Done({'recording': args.recording, **to_json(found)},
                [*lines, *_shown(found), *stored])


def _noise(args: argparse.Namespace) -> tuple[NoiseFigures, list[str]]:
    """Return the figures, and how the recording was read."""
    asked = log_options(args)
    calibration = args.calibration and stored_calibration(args.calibration)
    if calibration and calibration.units.name == 'native':
        asked = replace(asked, units=asked.units or 'native')
    with open_log(args.recording, asked) as log:
        with progress('samples') as moved:
            recording = _samples(log, args.recording, moved)
        lines = [f'read as: {log.read_as}'] if log.read_as else []
        lines += [f'note: {note}' for note in log.notes]
        units = log.units
    if calibration:
        recording, units = _corrected(recording, units, calibration)
    with progress('axes') as moved:
        return noise_of(recording, units, args.gravity, moved), lines


def _samples(log: OpenLog, path: Path, moved: Progress) -> Recording:
    """
    Return the samples of a log.

    A table of slow samples has the form of a pose table without the columns of a pose.

    """
    if log.poses is None:
        return joined(log.watched(moved))
    if 'time' in log.poses and 'count' not in log.poses:
        return Recording(log.poses.columns, log.poses.row, log.poses.units, log.poses.sensor)
    raise InputError(f'{path} is a pose table, expected a recording',
                     'use the samples of a long rest, with their time')


def _corrected(recording: Recording, units: Units, calibration: Calibration
               ) -> tuple[Recording, Units]:
    """Return the corrected recording, in g if it was in native units."""
    own = calibration.in_units(units)
    check_sensor(own, recording.sensor)
    known = of_samples(recording.columns, len(recording), own.model)
    made = recording.with_columns(reading=own.correct(recording.reading, known))
    return made, units_of('g') if units.name == 'native' else units


def _shown(found: NoiseFigures) -> Iterator[str | Table]:
    """Yield the figures by axis, the notes, and the figures for Kalibr."""
    yield (f'rest of {duration(found.seconds)}: {counted(found.samples, "sample")} at '
           f'{found.rate:.5g} Hz')
    for kind in found.kinds:
        yield _table(kind, found.of(kind))
    yield from (f'note: {note}' for note in found.notes)
    yield from need_lines(found)
    yield from kalibr_lines(found)


def _table(kind: str, axes: tuple[AxisNoise, ...]) -> Table:
    """Return the table of one sensor, at most 60 columns wide."""
    table = Table(title=kind, box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column('')
    for axis in axes:
        table.add_column(axis.axis, justify='right', no_wrap=True)
    for label, unit, cells in figure_rows(axes):
        table.add_row(f'{label}, {unit}', *cells)
    return table
