# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The residual of each pose before and after a calibration, and the variables it is drawn over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..calibrate import Calibration, errors_after, errors_before, in_g, with_history
from ..effects import acting_temperature, AXES, effect_named, rate_at, sensor_force
from ..geometry import unit
from ..table import column_of, Floats, Poses
from ..units import MG

if TYPE_CHECKING:
    from ..refine import Refinement, Stage

_CONTEXT = ('temperature', 'time', 'supply_voltage', 'std', 'rate')

_LABELS = {
    'temperature': ('temperature [°C]', 1.0),
    'temperature_of_offset': ('temperature that acts on the offset [°C]', 1.0),
    'temperature_of_gain': ('temperature that acts on the gain [°C]', 1.0),
    'temperature_rate': ('rate of temperature [°C/min]', 60.0),
    'supply_voltage': ('supply [V]', 1.0), 'std': ('standard deviation of the samples [mg]', MG),
    'rate': ('angular rate [rad/s]', 1.0), 'force': ('force along the axis [g]', 1.0)}
"""Label and factor of each variable."""


@dataclass(frozen=True)
class Variable:
    """
    A variable for the horizontal axis.

    Parameters
    ----------
    label : str
        Name and unit.
    values : (n,) array
        One value per pose.
    unit_range : bool
        Whether the range is -1 to 1 by definition.

    """

    label: str
    values: Floats
    unit_range: bool = False


def variables_of(effect: str, poses_g: Poses, force: Floats, shape: Floats | None = None
                 ) -> list[Variable]:
    """
    Return the variables that an effect depends on: one variable, or one per axis.

    Parameters
    ----------
    effect : str
        Name of the effect in the model.
    poses_g : Poses
        The poses, in g.
    force : (n, 3) array
        Force of each pose [g].
    shape : (s,) array, optional
        Shape of the effect, such as a lag; by default zeros.

    """
    found = effect_named(effect)
    shape = np.zeros(len(found.shape)) if shape is None else shape
    known = with_thermal(poses_g, found.lagged, shape)
    key = next((name for name in found.over_of(shape) if name in known), None)
    if key == 'previous':
        return [Variable(f'from the previous pose, {axis}', known[key][:, k], True)
                for k, axis in enumerate(AXES)]
    if key is None:
        axes = sorted({term.axis for term in found.terms}) or [0, 1, 2]
        return [Variable(f'force along {AXES[k]} [g]', force[:, k], True) for k in axes]
    return [variable_of(key, known[key])]


def with_thermal(poses_g: Poses, lagged: str, shape: Floats) -> Poses:
    """Return poses with the rate of the temperature and the temperature that acts, if known."""
    if 'time' not in poses_g or 'temperature' not in poses_g:
        return poses_g
    found = {'temperature_rate': rate_at(poses_g.columns)}
    if lagged and shape[0]:
        found[lagged] = acting_temperature(poses_g.columns, lagged, shape[0], bool(shape[1]))
    return poses_g.with_columns(**found)


def recorded(poses_g: Poses) -> list[Variable]:
    """Return the variables of the context that change between poses."""
    found = [variable_of(key, poses_g[key]) for key in (*_CONTEXT, *poses_g.quantities)
             if key in poses_g]
    return [variable for variable in found if np.ptp(variable.values) > 0.0]


def variable_of(key: str, values: Floats) -> Variable:
    """Return a variable for the horizontal axis: (n,) values, or the (n, 3) ones of a vector."""
    if key == 'time':
        return _time(values)
    if values.ndim > 1:
        mean = np.mean if key == 'std' else np.sum
        values = np.sqrt(mean(values ** 2, axis=1))
    label, factor = _LABELS.get(key) or (column_of(key).meaning, 1.0)
    return Variable(label, values * factor)


def since_first(poses: Poses) -> Floats:
    """Return the (n,) time of each pose since the first [s]."""
    return poses['time'] - np.min(poses['time'])


def _time(seconds: Floats) -> Variable:
    since = seconds - np.min(seconds)
    span = np.max(since)
    for name, size in (('h', 3600.0), ('min', 60.0)):
        if span > 3.0 * size:
            return Variable(f'time since the first pose [{name}]', since / size)
    return Variable('time since the first pose [s]', since)


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

    def at(self, stage: Stage) -> Residuals:
        """Return the residuals at a stage of the refinement of these poses."""
        return replace(self, after_mg=stage.residual_mg)


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
    vectors = calibration.form.known_orientation and 'reference' in own
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
