# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From the arguments of a command to its inputs: logs, poses, calibrations, settings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from .frame import Output, progress
from ..calibrate import Calibration, FleetPrior
from ..capture import CaptureSettings
from ..errors import InputError, saying
from ..estimate import NORM_MODELS
from ..intake import Intake, poses_of
from ..logs import LogOptions
from ..pipeline import Plan
from ..stored import OF_FILE, read_calibration, read_prior
from ..table import Poses


def given(record: Any, args: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of a record that have an option; None stands for the default."""
    found = {each.name: getattr(args, each.name, None) for each in fields(record)}
    return {name: value for name, value in found.items() if value is not None}


def log_options(args: argparse.Namespace, calibration: Calibration | None = None) -> LogOptions:
    """Return how to read a log; in the unit of a calibration if the log states none."""
    columns = {ours: theirs for each in args.columns for ours, theirs in each.items()}
    asked = LogOptions(**{**given(LogOptions, args), 'columns': columns})
    if calibration is None:
        return asked
    units = calibration.units
    if units.is_native:  # its readings can look like g
        return replace(asked, default_units='native')
    return replace(asked, gravity=units.per_g) if units.is_si else asked


def settings(args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of the capture that are asked for."""
    return given(CaptureSettings, args)


@contextmanager
def intake(args: argparse.Namespace, path: Path, calibration: Calibration | None = None
           ) -> Iterator[Intake]:
    """Yield the poses of a log, captured from a recording; later errors say how it was read."""
    with progress('samples') as moved:
        found = poses_of(path, log_options(args, calibration), settings(args), moved)
    with saying(found.said):
        yield found


def stored_calibration(path: Path) -> Calibration:
    """Read a stored calibration; report on standard error if it was edited by hand."""
    calibration = read_calibration(path)
    for found in calibration.noted:
        if found.kind in OF_FILE:
            Output(stderr=True).print(f'note: {path}: {found.words}')
    return calibration


def prior(args: argparse.Namespace) -> FleetPrior | None:
    """Return the typical values of ``--prior``."""
    return None if args.prior is None else read_prior(args.prior, args.sensor_model)


def plan_of(args: argparse.Namespace, **more: Any) -> Plan:
    """
    Return how to calibrate.

    Raises
    ------
    InputError
        If ``--prior`` stands with another model.

    """
    plan = Plan(**{**given(Plan, args), 'rows': None, 'fleet': prior(args), 'also': args.own,
                   **more})
    usual = plan.model in ('auto', NORM_MODELS[-1]) and plan.method == 'ml'
    if plan.fleet is not None and not usual:
        raise InputError(f'--prior with --model {plan.model} --method {plan.method}, expected '
                         'model 10 by maximum likelihood', 'leave out these options')
    return plan


def rows_between(poses: Poses, text: str | None) -> slice:
    """
    Return the rows ``A:B`` of a table, 1-based, inclusive; A and B are optional.

    Raises
    ------
    InputError
        If the text is not of this form, or the rows are not in the table.

    """
    first, colon, last = (text or ':').partition(':')
    try:
        start, stop = int(first or 1), int((last if colon else first) or len(poses))
    except ValueError:
        start, stop = 0, 0
    if not 1 <= start <= stop <= len(poses):
        raise InputError(f'--rows is {text}, expected A:B within 1:{len(poses)}',
                         'set A and B to the first and the last row, 1-based')
    return slice(start - 1, stop)
