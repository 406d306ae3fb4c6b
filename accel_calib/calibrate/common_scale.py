# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How surely a calibration is known, when others of the same sensor are there to judge by.

A few poses beyond the free parameters tell the noise of a fit badly: with three to spare, the
stated variance is easily wrong by a factor of three, and a test that believed it would raise a
false alarm in a third of all pairs. The shape of the covariance does not depend on that: it is
(JᵀJ)⁻¹ of the poses. Its scale is therefore taken from all runs together,

    s² = (b + Σ chi²) / (b + Σ dof)

where the measured noise of the runs counts as b degrees of freedom (each as in
`accel_calib.calibrate.likelihood.Fit.variance`), unless the residuals contradict it; a run whose
poses repeat significantly worse than those of the others keeps its own.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .approach import with_approach
from .calibration import Calibration
from .likelihood import Fit, fit_reference, judge
from .quality import in_g
from ..table import Floats, Poses

_WORSE = 0.001
"""A run is noisier than the others below this probability of its chi²."""

_CONTRADICTED = 0.1
"""Measured noise is not believed below this probability of the chi² of all runs."""


@dataclass(frozen=True)
class Spread:
    """
    Covariances of several calibrations on one scale.

    Parameters
    ----------
    covariances : tuple of (p, p) arrays
        Of each ``model.vector`` [g].
    dof : float
        Degrees of freedom of the common scale.
    noisier : tuple of int
        Calibrations whose poses repeat significantly worse than those of the others.

    """

    covariances: tuple[Floats, ...]
    dof: float
    noisier: tuple[int, ...]


@dataclass(frozen=True)
class _Told:
    """The chi² of one run, its degrees of freedom, and what its stated variance is times."""

    chi2: float
    dof: int
    stated: float
    belief: float


def used_poses(calibration: Calibration) -> Poses:
    """Give the poses that a calibration was fitted to, in the unit of the readings."""
    rejected = [pose.row for pose in calibration.rejected]
    return calibration.poses.take(~np.isin(calibration.poses.row, rejected))


def on_one_scale(calibrations: Sequence[Calibration]) -> Spread:
    """Give the covariances of calibrations of one sensor, their scale taken from all of them."""
    told = [_told(calibration) for calibration in calibrations]
    factors, noisier, dofs = np.ones(len(told)), [], []
    for measured in (True, False):  # where the noise was not measured, chi² has no unit
        group = [k for k, run in enumerate(told) if (run.belief > 0.0) is measured]
        scale, dof, worse = _pooled([told[k] for k in group])
        for k in group:
            own = told[k].chi2 / max(told[k].dof, 1) if k in (group[j] for j in worse) else scale
            factors[k] = own / told[k].stated if told[k].stated > 0.0 and dof > 0.0 else 1.0
        noisier += [group[j] for j in worse]
        dofs += [dof] if group and dof > 0.0 else []
    return Spread(tuple(run.covariance * factor
                        for run, factor in zip(calibrations, factors, strict=True)),
                  min(dofs, default=np.inf), tuple(sorted(noisier)))


def _pooled(told: Sequence[_Told]) -> tuple[float, float, list[int]]:
    """Pool runs, the quietest first: scale, its degrees of freedom, and the runs too noisy."""
    from scipy.special import fdtrc

    pool, worse = [run for run in told if run.dof == 0], []
    for k in sorted((k for k, run in enumerate(told) if run.dof > 0),
                    key=lambda k: told[k].chi2 / told[k].dof):
        scale, dof = _scale(pool)
        ratio = told[k].chi2 / told[k].dof / max(scale, 1e-300)
        if dof > 0.0 and fdtrc(told[k].dof, dof, ratio) < _WORSE:
            worse.append(k)
        else:
            pool = [*pool, told[k]]
    return (*_scale(pool), worse)


def _scale(pool: Sequence[_Told]) -> tuple[float, float]:
    """Give the scale of these runs and its degrees of freedom; 1 and 0 where nothing tells it."""
    from scipy.special import chdtrc

    chi2, dof = sum(run.chi2 for run in pool), sum(run.dof for run in pool)
    belief = sum(run.belief for run in pool)
    if dof > 0 and chdtrc(dof, chi2) < _CONTRADICTED:
        belief = 0.0
    return ((belief + chi2) / (belief + dof) if belief + dof > 0 else 1.0), belief + dof


def _told(calibration: Calibration) -> _Told:
    """Say what the poses of a calibration tell of its noise."""
    fit = _fit_of(calibration)
    free = int(np.linalg.matrix_rank(fit.jacobian))
    # Over its own poses, the variance of a fit adds up to the number of its free parameters.
    total = float(np.einsum('mp,pq,mq->', fit.jacobian, calibration.covariance, fit.jacobian))
    belief = fit.variance_dof - fit.dof if fit.noise_known else 0.0
    return _Told(fit.chi2, len(fit.weighted) - free, total / free if free else 0.0, belief)


def _fit_of(calibration: Calibration) -> Fit:
    """Judge a calibration by the poses it was fitted to."""
    model, used = calibration.model, used_poses(calibration)
    poses_g = with_approach(in_g(calibration.poses, calibration.units), model)
    poses_g = poses_g.take(np.isin(poses_g.row, used.row))
    if calibration.name == '12' and 'reference' in poses_g:
        return fit_reference(model.effects, poses_g.reading, poses_g['reference'],
                             poses_g.columns, poses_g.noise)
    return judge(model, poses_g.reading, poses_g.columns, poses_g.noise)
