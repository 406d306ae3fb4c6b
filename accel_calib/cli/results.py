# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Calibrations and refinements as JSON, and as tables and lines of text."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, TYPE_CHECKING

import numpy as np

from ..calibrate import Calibration, GyroBias, Outlook, outlook
from ..effects import effect_named, LADDER, value_unit
from ..estimate.closed_form import sensing_axes
from ..refine.words import base_words, chance
from ..table import Floats
from ..text import counted, short, with_sd
from ..units import MG

if TYPE_CHECKING:
    from rich.table import Table

    from .terminal import Output
    from ..refine import Refinement


def calibration_result(calibration: Calibration, asked: str) -> dict[str, Any]:
    """Return a calibration for JSON; `asked` is the requested model."""
    return {
        'model': calibration.name, 'method': calibration.method,
        'units': calibration.units.name, 'sensor': calibration.sensor,
        'frame': calibration.frame, 'offset': calibration.offset, 'gain': calibration.gain,
        'rotation': calibration.model.rotation, 'offset_sd': calibration.offset_sd,
        'gain_sd': calibration.gain_sd, 'parameters': calibration.parameters,
        'covariance': calibration.covariance,
        'poses_used': len(calibration.poses) - len(calibration.rejected),
        'poses_rejected': [asdict(rejected) for rejected in calibration.rejected],
        **asdict(calibration.quality), 'reason': calibration.reason,
        'warnings': calibration.warnings, **_own_names(calibration), **_rest_noise(calibration),
        **_outlook(outlook(calibration, asked))}


def _rest_noise(calibration: Calibration) -> dict[str, Any]:
    """Return the gyro bias [rad/s] and the noise of a sample for JSON; None if not known."""
    gyro, noise = calibration.gyro, calibration.noise
    return {'gyro_bias': gyro and gyro.bias, 'gyro_bias_sd': gyro and gyro.sd,
            'noise_force': noise and _known(noise.force),
            'noise_rate': noise and _known(noise.rate)}


def _known(values: Floats) -> Floats | None:
    return None if np.isnan(values).all() else values


def _gyro_line(gyro: GyroBias) -> str:
    """Return the gyro bias as a line of text, in °/s."""
    values = ', '.join(f'{axis} {with_sd(bias, sd)}' for axis, bias, sd in zip(
        'xyz', np.degrees(gyro.bias), np.degrees(gyro.sd), strict=True))
    slope = ('' if not np.any(gyro.slope) else
             f' at {gyro.temperature:.1f} °C, changes by '
             f'{", ".join(f"{each:+.2g}" for each in np.degrees(gyro.slope))} °/s per °C')
    return f'gyro bias: {values} °/s{slope} ({counted(gyro.rests, "rest")})'


def _outlook(found: Outlook) -> dict[str, Any]:
    """Return what the poses determine, and the next pose, for JSON."""
    seen, asked = found.identifiability, found.next_pose
    unseen = seen.open_parameters
    return {
        'uncertainty_mg': found.uncertainty_mg,
        'identifiability': {
            'model': seen.model, 'dilution': seen.dilution, 'mean_dilution': seen.mean_dilution,
            'parameters': {name: {'determined': name not in unseen, 'dilution': deviation}
                           for name, deviation in seen.deviations.items()},
            'undetermined': [{'weights': dict(open_.weights), 'words': open_.words}
                             for open_ in seen.undetermined]},
        'next_pose': None if asked.direction is None else {
            'direction': asked.direction, 'words': asked.words}}


def _own_names(calibration: Calibration) -> dict[str, Any]:
    """Return the parameters of models 9 and 12 with the names of the ESGI'95 report."""
    if calibration.name == '9':
        axes = sensing_axes(calibration.gain, calibration.offset)
        return {'shifts': axes.shifts, 'scales': axes.scales,
                'angles': {'phi': axes.phi, 'psi': axes.psi, 'theta': axes.theta}}
    if 'reference' in calibration.poses:
        return {'matrix': calibration.gain @ calibration.model.rotation,
                'shift': calibration.offset}
    return {}


def show_calibration(console: Output, calibration: Calibration) -> None:
    """Print quality, parameters, poses left out and warnings of a calibration."""
    console.print(_quality_table(calibration))
    console.print(_parameter_table(calibration))
    if calibration.gyro is not None:
        console.print(_gyro_line(calibration.gyro))
    for rejected in calibration.rejected:
        console.print(f'left out: row {rejected.row}: {rejected.reason}')
    for warning in calibration.warnings:
        console.print(f'note: {warning}')


def _quality_table(calibration: Calibration) -> Table:
    """Return a table of the residual before and after the fit."""
    from rich.table import Table

    quality = calibration.quality
    table = Table(title='Residual of |force| [mg]')
    table.add_column(f'model {calibration.name}, {counted(len(calibration.used_poses), "pose")}')
    for name in ('before', 'after'):
        table.add_column(name, justify='right')
    table.add_row('RMS', _short(quality.rms_before_mg), _short(quality.rms_after_mg))
    table.add_row('largest', _short(quality.max_before_percent * MG / 100.0),
                  _short(quality.max_after_percent * MG / 100.0))
    table.add_row('held out', '', _short(quality.held_out_rms_mg))
    table.add_row('noise floor', '', _short(quality.noise_floor_mg))
    return table


def _parameter_table(calibration: Calibration) -> Table:
    """Return a table of the parameters that the model has, with their standard deviations."""
    from rich.table import Table

    table = Table(title='reading = W ΔR force + V', show_header=False)
    table.add_column('', no_wrap=True)
    table.add_column('', no_wrap=True, justify='right')
    table.add_column('', no_wrap=True)
    for row in (*_linear_rows(calibration), *_effect_rows(calibration)):
        table.add_row(*row)
    return table


def _linear_rows(calibration: Calibration) -> Iterator[tuple[str, str, str]]:
    """Yield name, value and unit of the entries of V and W that the model has."""
    name = calibration.units.name
    unit = {'m/s2': 'm/s²', 'g': 'g', 'native': 'native'}[name]
    for axis, value, sd in zip('xyz', calibration.offset, calibration.offset_sd, strict=True):
        yield f'offset {axis}', with_sd(value, sd), unit
    per_g = 'per g' if name == 'native' else ''
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2), (1, 0), (2, 0), (2, 1)):
        value, sd = calibration.gain[i, j], calibration.gain_sd[i, j]
        mirrored = i > j and value == calibration.gain[j, i]
        if (sd > 0.0 or value) and not mirrored:
            yield f'gain {"xyz"[i]}{"xyz"[j] if i != j else ""}', with_sd(value, sd), per_g


def _effect_rows(calibration: Calibration) -> Iterator[tuple[str, str, str]]:
    """Yield name, value and unit of the parameters beyond V and W."""
    deviations = dict(zip(calibration.parameters, np.sqrt(np.diag(calibration.covariance)),
                          strict=True))
    for effect, values in calibration.model.values.items():
        shown = {} if effect in LADDER else effect_named(effect).shown(values)
        for own, value in shown.items():
            unit, scale = value_unit(effect, own)
            sd = deviations[f'{effect}.{own}']
            yield f'{effect} {own}', with_sd(value * scale, sd * scale), unit


def _short(value: float | None) -> str:
    return 'not known' if value is None else f'{value:.3g}'


def refine_result(result: Refinement) -> dict[str, Any]:
    """Return the result of ``refine`` for JSON."""
    return {
        'verdict': result.verdict, 'base': result.calibration.name,
        'poses_used': len(result.poses_g), 'noise_floor_mg': result.noise_floor_mg,
        'gap_mg': result.gap_mg,
        'steps': [{**asdict(step), 'words': effect_named(step.name).words}
                  for step in result.steps],
        'remaining_gap_mg': result.remaining_gap_mg,
        'disturbed_poses': result.disturbed_poses,
        'not_testable': [{'effect': effect, 'needs': needs}
                         for effect, needs in result.not_testable],
        'advice': result.advice, 'plan': result.plan.lines,
        'warnings': result.calibration.warnings,
        'refusal': result.refusal[0] if result.refusal else None}


def in_a_line(result: dict[str, Any]) -> str:
    """Return one of several results as one line."""
    if 'error' in result:
        return f'{result["error"]}; {result["advice"]}'
    names = ' + '.join([result['base'], *(step['effect'] for step in result['steps'])])
    return (f'{result["verdict"]}: {names}, {short(result["gap_mg"])} -> '
            f'{short(result["remaining_gap_mg"])} mg')


def steps_table(result: Refinement) -> Table:
    """Return a table of the steps."""
    from rich.table import Table

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
