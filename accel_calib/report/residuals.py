# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The residual of each pose before and after a calibration, and its text for a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .style import Mark
from ..calibrate import Calibration, in_g
from ..calibrate.quality import errors_after, errors_before, with_history
from ..effects import sensor_force
from ..geometry import unit
from ..table import Floats, Poses
from ..units import MG

if TYPE_CHECKING:
    from ..refine import Refinement


@dataclass(frozen=True)
class Residuals:
    """
    The residuals of poses.

    Parameters
    ----------
    poses_g : Poses
        The n poses that are evaluated, in g.
    force : (n, 3) array
        Direction of up in each pose, in the sensor axes.
    before_mg, after_mg : (n,) array
        Residual without and with the calibration [mg], signed if only |force| is known.
    left_out : Poses
        The d poses that are left out, in the unit of the readings.
    left_out_force : (d, 3) array
        Their directions.
    reasons : mapping of int to str
        Reason by row for the poses left out.
    signed : bool
        Whether `after_mg` is signed, because only |force| is known.

    """

    poses_g: Poses
    force: Floats
    before_mg: Floats
    after_mg: Floats
    left_out: Poses
    left_out_force: Floats
    reasons: Mapping[int, str]
    signed: bool

    @property
    def rms_mg(self) -> float:
        """RMS of the residuals with the calibration [mg]."""
        return float(np.sqrt(np.mean(self.after_mg ** 2)))

    def marks(self, residual_mg: Floats) -> tuple[Mark, ...]:
        """Return the text of each pose with this residual."""
        return marks_of(self.poses_g, residual_mg, signed=self.signed)


def marks_of(poses: Poses, residual_mg: Floats, *, signed: bool) -> tuple[Mark, ...]:
    """Return row, residual and temperature of each pose, such as ``row 11, +0.4 mg, 31 °C``."""
    warm = poses.columns.get('temperature')
    marks = []
    for k, (row, residual) in enumerate(zip(poses.row, residual_mg, strict=True)):
        words = f'row {row}, {milli(residual, signed=signed)} mg'
        if warm is not None and np.isfinite(warm[k]):
            words += f', {warm[k]:.0f} °C'.replace('-', '−')
        marks.append(Mark(int(row), words))
    return tuple(marks)


def milli(value: float, *, signed: bool) -> str:
    """Return a residual with as many decimals as a person compares."""
    size = abs(value)
    decimals = 0 if size >= 1000.0 else 1 if size >= 9.95 else 2 if size >= 0.0995 else 3
    rounded = round(value, decimals) + 0.0
    sign = '+' if signed else ''
    return f'{rounded:{sign}.{decimals}f}'.replace('-', '−')


def residuals_of(calibration: Calibration, poses: Poses | None = None) -> Residuals:
    """
    Return the residuals of a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    poses : Poses, optional
        The poses, in the unit of the calibration; by default the poses of the calibration.

    """
    own = calibration.poses if poses is None else poses
    model, units = calibration.model, calibration.units
    poses_g = calibration.held(with_history(in_g(own, units), model))
    reasons = {each.row: each.reason for each in calibration.rejected if poses is None}
    out = np.isin(own.row, list(reasons))
    kept = poses_g.take(~out)
    force = sensor_force(model, poses_g.reading, poses_g.columns)
    vectors = calibration.name == '12' and 'reference' in own
    before = errors_before(kept, units, vectors=vectors)
    after = errors_after(model, kept, vectors=vectors)
    return Residuals(kept, unit(force[~out]), before * MG, after * MG, own.take(out),
                     unit(force[out]), reasons, not vectors)


def residuals_of_refinement(result: Refinement) -> Residuals:
    """Return the residuals of the poses that a refinement kept."""
    calibration = result.calibration
    own = calibration.poses
    out = own.take(np.isin(own.row, result.disturbed_poses))
    mat_w, vec_v = calibration.model.linear_part
    force = np.linalg.solve(mat_w, (calibration.units.to_g(out.reading) - vec_v).T).T
    reasons = {each.row: each.reason for each in calibration.rejected}
    signed = any(bool(np.any(stage.residual_mg < 0.0)) for stage in result.stages)
    before = errors_before(result.poses_g, calibration.units,
                           vectors=not signed and 'reference' in result.poses_g)
    return Residuals(
        result.poses_g, result.force, before * MG, result.stages[-1].residual_mg, out, unit(force),
        {int(row): reasons.get(int(row), 'disagrees with the other poses') for row in out.row},
        signed)
