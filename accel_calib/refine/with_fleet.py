# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The refinement of few poses with the typical values of a fleet.

The search for effects is that without a fleet, because a fleet says nothing about effects beyond
offset, gain and cross-axis. It needs more poses than model 10 has values. If it names effects, the
fitted values are combined with the fleet (`accel_calib.calibrate.prior`): offset, gain and
cross-axis move towards the fleet, and the effects with them as far as the poses cannot distinguish
them.

Otherwise the result is the fit with the fleet. If the poses do not carry a search, the first
advice states the reason, and all effects are listed as not testable.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .records import PosePlan, Refinement, Stage
from .refinement import refine
from .state import is_noise
from .words import not_testable
from ..calibrate import (
    Calibration,
    fit_with_fleet,
    FLEET,
    FleetPrior,
    gated,
    in_g,
    only_norm,
    posterior,
    quality_of,
    with_history,
    with_rest_noise,
)
from ..effects import Model, MODELS, PROCESSES, with_vector
from ..errors import RefusedFitError
from ..estimate import Fit, judge
from ..geometry import unit
from ..table import Poses
from ..text import counted
from ..units import MG, Units

_BASE = '10'


def refine_with_fleet(poses: Poses, units: Units, fleet: FleetPrior, *, sensor: str = '',
                      date: str = '') -> Refinement:
    """
    Find effects beyond model 10, with the typical values of a fleet for model 10.

    Parameters
    ----------
    poses : Poses
        Poses in the unit of the readings.
    units : Units
        Unit of the readings, not native.
    fleet : FleetPrior
        Typical values of sensors of the same model.
    sensor, date : str
        Name of the sensor and date for the refined calibration.

    Returns
    -------
    Refinement
        The refined calibration has the method ``fleet``, and its covariance includes the prior.
        Its steps have the residuals of the search, which does not use the fleet.

    Raises
    ------
    InputError
        If the readings are in native units, or clearly in another unit.
    RefusedFitError
        As `accel_calib.calibrate.fit_with_fleet`.

    """
    fitted = fit_with_fleet(poses, units, fleet, sensor=sensor, date=date)
    try:
        found = refine(poses, units, base=_BASE, sensor=sensor, date=date)
    except RefusedFitError as err:
        return _without_search(fitted, err.message, err.advice)
    if found.refusal:
        return _without_search(fitted, *found.refusal)
    if found.calibration.model.effects == MODELS[_BASE].effects:
        return _with(found, fitted)
    return _with(found, _combined(found.calibration, found.poses_g, fleet))


def _combined(refined: Calibration, poses_g: Poses, fleet: FleetPrior) -> Calibration:
    """Return a refined calibration with the fleet included."""
    values, covariance, findings = posterior(refined.model.vector, refined.covariance, fleet)
    model = with_vector(refined.model.effects, values)
    columns = {key: each for key, each in poses_g.columns.items()
               if key not in ('reference', 'orientation')}
    fit = judge(model, Poses(columns, poses_g.row))
    name = f' of model {fleet.model}' if fleet.model else ''
    return with_rest_noise(gated(replace(
        refined, model=Model(model.values, refined.model.rotation), covariance=covariance,
        method=FLEET, noted=(*findings, *refined.noted),
        quality=quality_of(fit, refined.units, unit(fit.equations.force)),
        reason=f'{refined.reason}; with the typical values of '
               f'{counted(fleet.sensors, "sensor")}{name}')), refined.poses)


def _with(found: Refinement, calibration: Calibration) -> Refinement:
    """Return a refinement with another calibration of the same effects."""
    fit = judge(Model(calibration.model.values), found.poses_g)
    last = Stage(found.stages[-1].name, fit.equations.of_poses(fit.residual) * MG)
    walk = any(step.effect in PROCESSES for step in found.steps)  # not in the calibration
    remaining = found.remaining_gap_mg if walk else _gap_mg(fit)
    return replace(found, calibration=calibration, remaining_gap_mg=remaining,
                   stages=found.stages if walk else (*found.stages[:-1], last))


def _gap_mg(fit: Fit) -> float:
    """Return the RMS of the residual over the poses [mg]."""
    return float(np.sqrt(np.mean(fit.equations.of_poses(fit.residual) ** 2))) * MG


def _without_search(fitted: Calibration, message: str, advice: str) -> Refinement:
    """Return the fit with the fleet as a refinement, with the reason why nothing was searched."""
    poses_g = in_g(fitted.used_poses, fitted.units)
    fit = judge(Model(fitted.model.values), with_history(only_norm(poses_g), fitted.model))
    gap, ratio = _gap_mg(fit), fitted.quality.chi2_per_dof
    quiet = not ratio or is_noise(fit.chi2, fit.chi2 / ratio)
    return Refinement(
        'no_gap' if quiet else 'unexplained', fitted.quality.noise_floor_mg, gap, gap, (),
        tuple(each.row for each in fitted.rejected),
        tuple(not_testable(poses_g, {}, fitted.model.effects)),
        (f'no effects were searched: {message}; the result is the fit with the fleet', advice),
        fitted, (), fit.poses_g, fit.equations.force,
        (Stage('base', fit.equations.of_poses(fit.residual) * MG),), PosePlan())
