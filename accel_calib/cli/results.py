# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a calibration is in JSON, and in a table for a person."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, TYPE_CHECKING

import numpy as np

from ..calibrate import Calibration, Outlook, outlook, sensing_axes
from ..units import MG

if TYPE_CHECKING:
    from rich.table import Table


def fit_result(calibration: Calibration, asked: str) -> dict[str, Any]:
    """Give the result of ``fit`` of the model asked for, in the names of the documentation."""
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
        'warnings': calibration.warnings, **_own_names(calibration),
        **_outlook(outlook(calibration, asked))}


def _outlook(found: Outlook) -> dict[str, Any]:
    """Give what the poses determine, and the next one."""
    told, asked = found.identifiability, found.next_pose
    unseen = told.open_parameters
    return {
        'uncertainty_mg': found.uncertainty_mg,
        'identifiability': {
            'model': told.model, 'dilution': told.dilution, 'mean_dilution': told.mean_dilution,
            'parameters': {name: {'determined': name not in unseen, 'dilution': deviation}
                           for name, deviation in told.deviations.items()},
            'undetermined': [{'weights': dict(open_.weights), 'words': open_.words}
                             for open_ in told.undetermined]},
        'next_pose': None if asked.direction is None else {
            'direction': asked.direction, 'words': asked.words}}


def _own_names(calibration: Calibration) -> dict[str, Any]:
    """Give what the report calls the parameters of model 9, and of known orientations."""
    if calibration.name == '9':
        axes = sensing_axes(calibration.gain, calibration.offset)
        return {'shifts': axes.shifts, 'scales': axes.scales,
                'angles': {'phi': axes.phi, 'psi': axes.psi, 'theta': axes.theta}}
    if 'reference' in calibration.poses:
        return {'matrix': calibration.gain @ calibration.model.rotation,
                'shift': calibration.offset}
    return {}


def quality_table(calibration: Calibration) -> Table:
    """Give the gap before and after."""
    from rich.table import Table

    quality = calibration.quality
    table = Table(title=f'Error of |force| over {len(calibration.poses)} poses '
                  f'(model {calibration.name})')
    table.add_column('')
    for name in ('before', 'after'):
        table.add_column(name, justify='right')
    table.add_row('gap (RMS), mg', _short(quality.rms_before_mg), _short(quality.rms_after_mg))
    table.add_row('largest, mg', _short(quality.max_before_percent * MG / 100.0),
                  _short(quality.max_after_percent * MG / 100.0))
    table.add_row('of poses held out, mg', '', _short(quality.held_out_rms_mg))
    table.add_row('noise floor, mg', '', _short(quality.noise_floor_mg))
    return table


def parameter_table(calibration: Calibration) -> Table:
    """Give offset and gain with their standard deviations."""
    from rich.table import Table

    unit = {'m/s2': 'm/s²', 'g': 'g', 'native': 'native'}[calibration.units.name]
    table = Table(title='reading = W ΔR force + V')
    table.add_column('axis')
    for name in (f'offset V, {unit}', 'gain W: x', 'y', 'z'):
        table.add_column(name, justify='right')
    values = np.column_stack([calibration.offset, calibration.gain])
    deviations = np.column_stack([calibration.offset_sd, calibration.gain_sd])
    for axis, row, sds in zip('xyz', values, deviations, strict=True):
        table.add_row(axis, *(f'{value:.6g} ± {sd:.1g}' for value, sd in
                              zip(row, sds, strict=True)))
    return table


def _short(value: float | None) -> str:
    return 'not known' if value is None else f'{value:.3g}'
