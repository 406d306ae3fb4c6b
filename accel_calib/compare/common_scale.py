# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The uncertainty of calibrations, estimated together with others of the same sensor.

A fit with few degrees of freedom estimates its noise badly. With three, the stated variance is
often wrong by a factor of three, and a test based on it would raise a false alarm in a third of
all pairs. The shape of the covariance, (JᵀJ)⁻¹ of the poses, does not depend on the noise. The
scale is therefore estimated from all runs together,

    s² = (b + Σ chi²) / (b + Σ dof)

where the measured noise of the runs counts as b degrees of freedom (for each run as in
`accel_calib.estimate.fit.Fit.variance`), unless the residuals contradict it. A run whose poses
repeat significantly worse than those of the others keeps its own scale.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..calibrate import Calibration, in_g
from ..calibrate.previous_pose import with_previous
from ..estimate.fit import Fit, judge
from ..model import Model
from ..table import Floats, Poses

_WORSE = 0.001
"""A run is noisier than the others if the probability of its chi² is lower."""

_CONTRADICTED = 0.1
"""Measured noise is ignored if the probability of the chi² of all runs is lower."""


@dataclass(frozen=True)
class Spread:
    """
    Covariances of several calibrations on one scale.

    Parameters
    ----------
    covariances : tuple of (p, p) arrays
        Covariance of each ``model.vector`` [g²].
    dof : float
        Degrees of freedom of the common scale.
    noisier : tuple of int
        Indices of calibrations whose poses repeat significantly worse than the others.

    """

    covariances: tuple[Floats, ...]
    dof: float
    noisier: tuple[int, ...]


@dataclass(frozen=True)
class _Run:
    """The chi² of a run, its degrees of freedom, its stated variance, and the dof of its noise."""

    chi2: float
    dof: int
    stated: float
    belief: float


def on_one_scale(calibrations: Sequence[Calibration]) -> Spread:
    """Return the covariances of calibrations of one sensor on a common scale."""
    runs = [_run_of(calibration) for calibration in calibrations]
    factors, noisier, dofs = np.ones(len(runs)), [], []
    for measured in (True, False):  # without measured noise, chi² has no unit
        group = [k for k, run in enumerate(runs) if (run.belief > 0.0) is measured]
        scale, dof, worse = _pooled([runs[k] for k in group])
        for k in group:
            own = runs[k].chi2 / max(runs[k].dof, 1) if k in (group[j] for j in worse) else scale
            factors[k] = own / runs[k].stated if runs[k].stated > 0.0 and dof > 0.0 else 1.0
        noisier += [group[j] for j in worse]
        dofs += [dof] if group and dof > 0.0 else []
    return Spread(tuple(run.covariance * factor
                        for run, factor in zip(calibrations, factors, strict=True)),
                  min(dofs, default=np.inf), tuple(sorted(noisier)))


def _pooled(runs: Sequence[_Run]) -> tuple[float, float, list[int]]:
    """Pool runs; return the scale, its degrees of freedom, and the noisier runs."""
    from scipy.special import fdtrc

    pool, worse = [run for run in runs if run.dof == 0], []
    for k in sorted((k for k, run in enumerate(runs) if run.dof > 0),
                    key=lambda k: runs[k].chi2 / runs[k].dof):
        scale, dof = _scale(pool)
        ratio = runs[k].chi2 / runs[k].dof / max(scale, 1e-300)
        if dof > 0.0 and fdtrc(runs[k].dof, dof, ratio) < _WORSE:
            worse.append(k)
        else:
            pool = [*pool, runs[k]]
    return (*_scale(pool), worse)


def _scale(pool: Sequence[_Run]) -> tuple[float, float]:
    """Return the scale of these runs and its degrees of freedom; 1 and 0 if there are none."""
    from scipy.special import chdtrc

    chi2, dof = sum(run.chi2 for run in pool), sum(run.dof for run in pool)
    belief = sum(run.belief for run in pool)
    if dof > 0 and chdtrc(dof, chi2) < _CONTRADICTED:
        belief = 0.0
    return ((belief + chi2) / (belief + dof) if belief + dof > 0 else 1.0), belief + dof


def _run_of(calibration: Calibration) -> _Run:
    """Return the figures about the noise of a calibration."""
    fit = _fit_of(calibration)
    free = int(np.linalg.matrix_rank(fit.columns))
    # Over its own poses, the variances of a fit sum to the number of free parameters.
    total = float(np.einsum('mp,pq,mq->', fit.columns, calibration.covariance, fit.columns))
    belief = fit.variance_dof - fit.dof if fit.noise_known else 0.0
    return _Run(fit.chi2, fit.equations.count - free, total / free if free else 0.0, belief)


def _fit_of(calibration: Calibration) -> Fit:
    """Return the model of a calibration at the poses it was fitted to."""
    model = Model(calibration.model.values)
    poses_g = with_previous(in_g(calibration.poses, calibration.units), model)
    poses_g = poses_g.take(np.isin(poses_g.row, calibration.used_poses.row))
    if calibration.name != '12':
        poses_g = Poses({key: values for key, values in poses_g.columns.items()
                         if key != 'reference'}, poses_g.row)
    return judge(model, poses_g, np.eye(len(model.vector)))
