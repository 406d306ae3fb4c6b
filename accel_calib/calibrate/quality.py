# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How well a calibration does: on the poses it was fitted to, and on poses it has not seen.

The error of a pose is |force| - 1 g; of a pose of known orientation under model 12, which knows
the axes, it is the length of the vector error. The gap is its RMS over the poses.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .approach import with_approach
from .calibration import Calibration, Quality
from .geometry import coverage
from .likelihood import Fit, norm_rows
from .uncertainty import believable
from ..model import correct, sensor_force
from ..table import Floats, Poses
from ..units import MG, Units

_ALONE = 1e-9
"""Of a residual less than this is left: its pose alone determines a parameter."""


@dataclass(frozen=True)
class Verification:
    """
    How well a calibration does on poses it has not seen; fields as `Quality`.

    Parameters
    ----------
    rms_before_mg, rms_after_mg : float
        Gap without and with the calibration [mg].
    max_before_percent, max_after_percent : float
        Largest error without and with the calibration [% of 1 g].
    noise_floor_mg : float or None
        Gap that the noise of the pose means alone would leave [mg]; None where it is not known.

    """

    rms_before_mg: float
    rms_after_mg: float
    max_before_percent: float
    max_after_percent: float
    noise_floor_mg: float | None


def in_g(poses: Poses, units: Units) -> Poses:
    """Give the same poses with readings, std and reference in g (native references are)."""
    scaled = {key: units.to_g(poses[key]) for key in ('reading', 'std') if key in poses}
    if 'reference' in poses and units.name != 'native':
        scaled['reference'] = units.to_g(poses['reference'])
    return poses.with_columns(**scaled)


def verify(calibration: Calibration, poses: Poses) -> Verification:
    """
    Say how well a calibration does on these poses.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    poses : Poses
        In the unit of its readings.

    Returns
    -------
    Verification
        Gaps before and after.

    """
    poses_g = with_approach(in_g(poses, calibration.units), calibration.model)
    vectors = calibration.name == '12' and 'reference' in poses
    before = _before(poses_g, calibration.units, vectors=vectors)
    model = calibration.model
    if vectors:
        after = np.linalg.norm(correct(model, poses_g.reading, poses_g.columns)
                               - poses_g['reference'], axis=1)
    else:
        after = _norm_errors(sensor_force(model, poses_g.reading, poses_g.columns))
    return Verification(_rms_mg(before), _rms_mg(after), _largest_percent(before),
                        _largest_percent(after), _noise_floor_mg(calibration, poses_g, vectors))


def _noise_floor_mg(calibration: Calibration, poses_g: Poses, vectors: bool) -> float | None:
    """Give the gap that the noise of the pose means alone would leave [mg]."""
    noise = believable(poses_g.noise)
    if noise is None:
        return None
    if vectors:
        inverse = np.linalg.inv(calibration.model.linear_part[0])
        return _rms_mg(np.sqrt(np.sum(noise ** 2 @ (inverse ** 2).T, axis=1)))
    u = sensor_force(calibration.model, poses_g.reading, poses_g.columns)
    rows = norm_rows(calibration.model, u, poses_g.columns)
    return _rms_mg(np.linalg.norm(rows * noise, axis=1))


def quality_of(fit: Fit, poses_g: Poses, units: Units, directions: Floats) -> Quality:
    """
    Say how well a fit does.

    Parameters
    ----------
    fit : Fit
        To these poses; with three residuals a pose where their orientations are known.
    poses_g : Poses
        The poses, in g.
    units : Units
        Unit of the sensor's readings.
    directions : (n, 3) array
        Where up is in each pose, unit vectors.

    """
    count = len(poses_g)
    vectors = len(fit.residual) > count
    before = _before(poses_g, units, vectors=vectors)
    # Residuals of known orientation are differences of readings; W⁻¹ makes them forces.
    to_force = np.linalg.inv(fit.model.linear_part[0]) if vectors else np.eye(1)
    errors = np.linalg.norm(fit.residual.reshape(count, -1) @ to_force.T, axis=1)
    held_out = np.linalg.norm(_held_out(fit, count) @ to_force.T, axis=1)
    floor = None
    if fit.noise_known:
        left = fit.sigma * np.sqrt(np.maximum(1.0 - fit.leverage, 0.0))
        floor = _rms_mg(np.linalg.norm(left.reshape(count, -1), axis=1))
    return Quality(_rms_mg(before), _rms_mg(errors), _largest_percent(before),
                   _largest_percent(errors),
                   None if np.any(np.isnan(held_out)) else _rms_mg(held_out), floor,
                   fit.chi2 / fit.dof if fit.noise_known and fit.dof > 0 else None,
                   coverage(directions))


def _before(poses_g: Poses, units: Units, *, vectors: bool) -> Floats:
    """
    Give the errors without a calibration, (n,) in g.

    Native readings mean nothing without one; they are seen from the middle of their range.

    """
    reading = poses_g.reading
    if units.name == 'native':
        reading = reading - (reading.max(axis=0) + reading.min(axis=0)) / 2.0
    if vectors:
        return np.linalg.norm(reading - poses_g['reference'], axis=1)
    return _norm_errors(reading)


def _norm_errors(force: Floats) -> Floats:
    """Give |force| - 1 of each row."""
    errors: Floats = np.linalg.norm(force, axis=1) - 1.0
    return errors


def _held_out(fit: Fit, count: int) -> Floats:
    """
    Give each pose's residual when it is left out of the fit, (count, 1 or 3) [g].

    With H the hat matrix the error of a pose is (I - H_ii)⁻¹ times its residual (PRESS, Allen
    1974); NaN where the pose alone determines a parameter.

    """
    each = len(fit.residual) // count
    if each == 1:
        own = 1.0 - fit.leverage
        if np.any(own < _ALONE):
            return np.full((count, 1), np.nan)
        return (fit.residual / own)[:, np.newaxis]
    orthonormal = fit.orthonormal.reshape(count, each, -1)
    blocks = np.eye(each) - orthonormal @ np.swapaxes(orthonormal, 1, 2)
    if np.any(np.linalg.svd(blocks, compute_uv=False) < _ALONE):
        return np.full((count, each), np.nan)
    weighted = fit.weighted.reshape(count, each, 1)
    left_out: Floats = np.linalg.solve(blocks, weighted)[:, :, 0] * fit.sigma.reshape(count, each)
    return left_out


def _rms_mg(errors_g: Floats) -> float:
    return float(np.sqrt(np.mean(errors_g ** 2))) * MG


def _largest_percent(errors_g: Floats) -> float:
    return float(np.max(np.abs(errors_g))) * 100.0
