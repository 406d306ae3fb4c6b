# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures and findings of a fit, its record, and the residuals of a calibration on other poses.

The error of a pose is |force| - 1 g. For model 12 and poses of known orientation it is the length
of the vector error. The residual of a calibration is the RMS of the errors over the poses.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .calibration import Calibration, check_sensor, Quality, Rejected
from .context import with_history
from ..effects import correct, Model, sensor_force
from ..estimate import believable, Fit, judge, Rival, unseen_mistakes, WEAK_DILUTION
from ..finding import Finding
from ..geometry import coverage
from ..table import Floats, Poses
from ..text import listed
from ..units import MG, Units

_LEAST_OWN = 1e-9
"""1 - leverage below this: the pose alone determines a parameter."""


@dataclass(frozen=True)
class Verification:
    """
    Residuals of a calibration on poses that it was not fitted to.

    Parameters
    ----------
    rms_before_mg, rms_after_mg : float
        Residual without and with the calibration [mg].
    max_before_percent, max_after_percent : float
        Largest error without and with the calibration [% of 1 g].
    noise_floor_mg : float or None
        Residual that the noise of the pose means alone causes [mg]; None if it is not known.

    """

    rms_before_mg: float
    rms_after_mg: float
    max_before_percent: float
    max_after_percent: float
    noise_floor_mg: float | None


def in_g(poses: Poses, units: Units) -> Poses:
    """Return the poses with readings, std and reference in g; native references are in g."""
    scaled = {key: units.to_g(poses[key]) for key in ('reading', 'std') if key in poses}
    if 'reference' in poses and not units.is_native:
        scaled['reference'] = units.to_g(poses['reference'])
    return poses.with_columns(**scaled)


def verify(calibration: Calibration, poses: Poses) -> Verification:
    """
    Compute the residuals of a calibration on poses, in the unit of the calibration.

    Raises
    ------
    StoredCalibrationError
        If the calibration belongs to another sensor.

    """
    model, units = calibration.model, calibration.units
    check_sensor(calibration, poses.sensor)
    poses_g = calibration.held(with_history(in_g(poses, units), model))
    vectors = calibration.form.known_orientation and 'reference' in poses
    before = errors_before(poses_g, units, vectors=vectors)
    after = errors_after(model, poses_g, vectors=vectors)
    floor = None
    if believable(poses_g.noise) is not None:
        known = poses_g if vectors else _without_orientation(poses_g)
        scale = judge(Model(model.values), known).equations.scale
        floor = _rms_mg(scale) * float(np.sqrt(3.0 if vectors else 1.0))
    return Verification(_rms_mg(before), _rms_mg(after), _largest_percent(before),
                        _largest_percent(after), floor)


def _without_orientation(poses_g: Poses) -> Poses:
    return Poses({key: values for key, values in poses_g.columns.items()
                  if key not in ('reference', 'orientation')}, poses_g.row)


def quality_of(fit: Fit, units: Units, directions: Floats) -> Quality:
    """Return figures of a fit; `directions` are up in each of its poses, (n, 3) unit vectors."""
    vectors = 'reference' in fit.poses_g
    before = errors_before(fit.poses_g, units, vectors=vectors)
    errors = errors_after(fit.model, fit.poses_g, vectors=vectors)
    held_out = _held_out(fit)
    return Quality(_rms_mg(before), _rms_mg(errors), _largest_percent(before),
                   _largest_percent(errors), None if held_out is None else _rms_mg(held_out),
                   noise_floor_mg(fit) if fit.noise_known else None,
                   fit.chi2 / fit.dof if fit.noise_known and fit.dof > 0 else None,
                   coverage(directions))


def record_of(fit: Fit, poses: Poses, units: Units, directions: Floats, name: str, method: str, *,
              covariance: Floats | None = None, rejected: tuple[Rejected, ...] = (),
              reason: str = '', noted: tuple[Finding, ...] = (), sensor: str = '', date: str = ''
              ) -> Calibration:
    """
    Return a fit as a calibration with ΔR = I, or with the ΔR of its model.

    The gate has not checked it yet: `accel_calib.calibrate.fit.finished` does. A fit is also
    compared with another fit to fewer poses, or of a larger model, which need not be useful.

    Parameters
    ----------
    fit : Fit
        The fit, to the poses that are not rejected.
    poses : Poses
        All poses, in the unit of the readings.
    directions : (n, 3) array
        Direction of up in each pose of the fit, unit vectors.
    covariance : (p, p) array, optional
        Covariance of the values; by default that of the fit.
    units, name, method, rejected, reason, noted, sensor, date
        As in `Calibration`; `rejected` in any order.

    """
    return Calibration(
        name, method, fit.model, units, sensor, 'ros', date,
        fit.covariance if covariance is None else covariance, quality_of(fit, units, directions),
        poses, tuple(sorted(rejected, key=lambda pose: pose.row)), reason, noted)


def noise_floor_mg(fit: Fit) -> float:
    """Return the residual that noise causes after the fit absorbs a part of it [mg]."""
    data, scale = fit.by_pose, fit.equations.scale
    own = np.trace(data.own(data.spread), axis1=1, axis2=2) - (data.columns.shape[1] - data.rows)
    return _rms_mg(scale * np.sqrt(np.maximum(own, 0.0)))


def errors_before(poses_g: Poses, units: Units, *, vectors: bool) -> Floats:
    """
    Return the (n,) errors without a calibration [g].

    Native readings have no known zero; they are measured from the middle of their range.

    """
    reading = poses_g.reading
    if units.is_native:
        reading = reading - (reading.max(axis=0) + reading.min(axis=0)) / 2.0
    if vectors:
        return np.linalg.norm(reading - poses_g['reference'], axis=1)
    return np.linalg.norm(reading, axis=1) - 1.0


def errors_after(model: Model, poses_g: Poses, *, vectors: bool) -> Floats:
    """Return the (n,) errors of corrected poses [g]."""
    if vectors:
        force = correct(model, poses_g.reading, poses_g.columns)
        return np.linalg.norm(force - poses_g['reference'], axis=1)
    return np.linalg.norm(sensor_force(model, poses_g.reading, poses_g.columns), axis=1) - 1.0


def _held_out(fit: Fit) -> Floats | None:
    """
    Return the (n,) errors of each pose under a fit of the other poses [g].

    With H the hat matrix, this error is (I - H_ii)⁻¹ times the residual of the pose (PRESS, Allen
    1974). The result is None if a pose alone determines a parameter.

    """
    data = fit.by_pose
    own = data.own(data.spread)
    if np.any(np.linalg.svd(own, compute_uv=False) < _LEAST_OWN):
        return None
    left_out = np.linalg.solve(own, data.residual[:, :, np.newaxis])[:, :, 0]
    if 'reference' in fit.poses_g:  # differences of readings; W⁻¹ converts them to forces
        noise = believable(fit.poses_g.noise)
        scaled = left_out * (fit.equations.scale[:, np.newaxis] if noise is None else noise)
        left_out = scaled @ np.linalg.inv(fit.model.linear_part[0]).T
        return np.linalg.norm(left_out, axis=1)
    return np.linalg.norm(left_out, axis=1) * fit.equations.scale


def _rms_mg(errors_g: Floats | float) -> float:
    return float(np.sqrt(np.mean(np.square(errors_g)))) * MG


def _largest_percent(errors_g: Floats) -> float:
    return float(np.max(np.abs(errors_g))) * 100.0


_UNSEEN_G = 0.01
"""Mistakes of such poses that do not show are reported above this size [g]."""

_WHOLE_G = 1.0
"""Mistakes above this size are all called large [g]."""

_MOST_NAMED = 5
"""Largest number of rows in a warning."""

_LARGE_CHI2 = 4.0
"""chi² per degree of freedom above which a fit warns."""


OF_A_FIT = ('no_check', 'not_covered', 'noise_not_known', 'beyond_noise', 'hardly_checked',
            'outlier_not_certain')
"""Kinds of findings about one fit, which do not hold for another fit."""


def fit_findings(fit: Fit, dilution: float) -> tuple[Finding, ...]:
    """Return findings about a fit with this dilution."""
    found = []
    if fit.dof == 0:
        found.append(Finding('no_check', 'there are only as many poses as free parameters: the '
                             'fit cannot be checked', 'take more poses'))
    if dilution > WEAK_DILUTION:
        found.append(Finding('not_covered', 'the poses leave a region of the sphere uncovered: '
                             f'there the error is up to {dilution:.0f} times that of a pose',
                             'take the next pose that is suggested'))
    if not fit.noise_known:
        known = ('the residuals alone' if fit.dof > 0 else
                 'the noise of a common sensor, 0.5 mg, which may be wrong for this one')
        found.append(Finding('noise_not_known', 'the poses have no std and count: the '
                             f'uncertainty comes from {known}'))
    elif fit.dof > 0 and fit.chi2 / fit.dof > _LARGE_CHI2:
        found.append(Finding(
            'beyond_noise', f'the residuals are {np.sqrt(fit.chi2 / fit.dof):.1f} times the noise '
            'of the pose means: poses repeat worse than the noise of their samples predicts, or '
            'the model lacks an effect'))
    return (*found, *_hardly_checked(fit))


def _hardly_checked(fit: Fit) -> Iterator[Finding]:
    """Yield a finding about poses whose mistake the other poses do not show."""
    if fit.dof == 0 or fit.prior is not None:
        return
    unseen = unseen_mistakes(fit)
    rows = fit.poses_g.row[unseen > _UNSEEN_G].tolist()
    if not rows:
        return
    largest = float(np.max(unseen))
    size = f'a mistake of {largest * MG:.0f} mg' if largest < _WHOLE_G else 'any mistake'
    yield Finding(
        'hardly_checked', f'the other poses hardly check {listed("row", rows[:_MOST_NAMED])}'
        f'{_and_more(rows)}: {size} would move the result and not show',
        'take one more pose in about the same orientation', 'USABLE', tuple(rows))


def rival_findings(found: tuple[Rival, ...], row: NDArray[np.int64]) -> Iterator[Finding]:
    """Yield a finding about poses that may be wrong instead of those left out."""
    if not found:
        return
    out, instead = (sorted({int(row[index]) for index in indices}) for indices in
                    ([each.left_out for each in found], [each.instead for each in found]))
    yield Finding(
        'outlier_not_certain', f'which row is the outlier is not certain: {listed("row", out)} is '
        f'left out, but the poses agree about as well without '
        f'{"one of " if len(instead) > 1 else ""}{listed("row", instead[:_MOST_NAMED])}'
        f'{_and_more(instead)} instead; the uncertainty includes both cases',
        'take these poses again, or take more poses', 'USABLE', (*out, *instead))


def _and_more(rows: list[int]) -> str:
    return f' and {len(rows) - _MOST_NAMED} more' if len(rows) > _MOST_NAMED else ''
