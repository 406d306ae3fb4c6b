# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib thermal``: the offset over temperature from a still board that warms up."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from .fit import calibration_lines, page_beside, status_of, store
from .frame import Done, given, log_options, settings
from .output import progress, table, working
from ..calibrate import Calibration, Curve, outlook
from ..effects import AXES
from ..errors import InputError, saying
from ..findings import calibration_json, curve_json
from ..pipeline import Intake, Plan, ramp_or_poses, RampIntake, thermally_calibrated
from ..text import counted, short, with_sd
from ..units import MG


def run_thermal(args: argparse.Namespace) -> Done:
    """Fit the offset over temperature; with a log of poses, one calibration of both."""
    found = []
    for path in args.logs:
        with progress('samples') as moved:
            found.append(ramp_or_poses(path, log_options(args), settings(args), moved))
    return thermal_done(args, args.logs, found)


def thermal_done(args: argparse.Namespace, logs: Sequence[Path],
                 found: Sequence[Intake | RampIntake], *notes: str) -> Done:
    """Fit, store, write the page, and return what is done, with further notes on the logs."""
    ramps = [each for each in found if isinstance(each, RampIntake)]
    poses = _of_poses(found, ramps)
    units = poses.units if poses else ramps[0].units
    lines = [*(line for each in found for line in each.lines), *notes]
    read_as = ', '.join(dict.fromkeys(each.read_as for each in found if each.read_as))
    plan = Plan(**{**given(Plan, args), 'rows': None, 'fleet': None, 'refined': False})
    with saying(read_as), working('fitting'):
        outcome = thermally_calibrated([each.ramp for each in ramps], units,
                                       None if poses is None else poses.poses, plan)
    calibration = outcome.calibration
    (left_out, stored), names = store(args, outcome), ', '.join(map(str, logs))

    def page() -> str:
        from ..report import thermal_page

        return thermal_page(outcome, names, stored=str(args.output), notes=lines)

    return Done(
        {'file': list(logs), **calibration_json(calibration, outlook(calibration, 'auto')),
         'read_as': read_as, 'read_lines': lines, 'thermal': curve_json(outcome.curve)},
        [*lines, *curve_lines(outcome.curve),
         *(calibration_lines(calibration) if poses else _notes(calibration)), *left_out,
         *page_beside(args, page)],
        outcome.rating, status_of(outcome), stored)


def _of_poses(found: Sequence[Intake | RampIntake], ramps: Sequence[RampIntake]) -> Intake | None:
    """Return the one log of poses, if there is one; raise InputError without a ramp."""
    poses = [each for each in found if isinstance(each, Intake)]
    if not ramps:
        raise InputError(f'{counted(len(poses), "log")} of poses in many directions, expected one '
                         'of a still board whose temperature changes', 'record the board while it '
                         'warms up from the freezer, and give this log, too')
    if len(poses) > 1:
        raise InputError(f'{len(poses)} logs are of poses in many directions, expected at most '
                         'one', 'leave out the others')
    return poses[0] if poses else None


def curve_lines(curve: Curve) -> Iterator[Any]:
    """Yield the curve as a table and lines."""
    low, high = curve.range_c
    yield table(f'Offset over T - {curve.reference_c:.1f} °C', ('', *AXES), (
        (f'mg/°C{"" if k == 1 else "²³"[k - 2]}',
         *(with_sd(value * MG, sd * MG) for value, sd in zip(values, deviations)))
        for k, (values, deviations) in enumerate(zip(curve.values, curve.deviations), 1)))
    yield (f'degree {curve.degree} from {low:.1f} to {high:.1f} °C: {short(curve.change_mg)} -> '
           f'{short(curve.residual_mg)} mg, uncertainty up to {short(curve.band_mg)} mg')
    if curve.hysteresis_mg is None:
        yield 'hysteresis: not known, because the temperature only rises or only falls'
    else:
        lag = '' if curve.lag_s is None else f', a lag of {curve.lag_s:.0f} s'
        yield f'hysteresis: {short(curve.hysteresis_mg)} mg between warming and cooling{lag}'


def _notes(calibration: Calibration) -> Iterator[str]:
    for warning in calibration.warnings:
        yield f'note: {warning}'
