# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Maximum likelihood: what the poses say of the parameters, and how surely.

A pose of unknown orientation tells one number, |force| = 1 g, and its residual is

    e = |u| - 1,   u the force found from the reading

whose noise is that of the pose mean seen along the force: with slope A = d reading / d u and
row vector a = ûᵀ A⁻¹, the variance is Σ_j a_j² s_j². The Jacobian is exact: a parameter that adds
B to the reading moves u by -A⁻¹ B, so that de/dk = -a B. A pose of known orientation tells three
numbers, reading - predict(reference), linear in the parameters.

Both are least squares, weighted by the noise; the covariance is (JᵀJ)⁻¹, times what
`accel_calib.calibrate.uncertainty` makes of the residuals: poses often repeat worse than their
samples say.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .norm_fit import form_of, noise_along, solution_at, solve
from .uncertainty import belief_in, believable, USUAL_NOISE_G, variance_factor
from ..effects import Context
from ..errors import RefusedFitError
from ..model import (
    force_slope,
    Model,
    parameter_basis,
    parameter_names,
    reading_of,
    sensor_force,
    with_vector,
)
from ..table import Floats


@dataclass(frozen=True)
class Fit:
    """
    A fitted model with what the poses say of it.

    Parameters
    ----------
    model : Model
        The fitted model, ΔR = I.
    covariance : (p, p) array
        Of ``model.vector`` [g].
    residual : (m,) array
        |force| - 1 of each pose, or the three components of each reading one after another [g].
    sigma : (m,) array
        Noise of each residual [g]; the same for all where it is not known.
    jacobian : (m, q) array
        Derivative of residual / sigma by the q free parameters.
    noise_known : bool
        Whether `sigma` was measured.

    """

    model: Model
    covariance: Floats
    residual: Floats
    sigma: Floats
    jacobian: Floats
    noise_known: bool

    @property
    def weighted(self) -> Floats:
        """(m,) array, residuals over their noise."""
        return self.residual / self.sigma

    @property
    def dof(self) -> int:
        """Residuals less free parameters."""
        return self.jacobian.shape[0] - self.jacobian.shape[1]

    @property
    def chi2(self) -> float:
        """Sum of the squared residuals over their noise."""
        return float(self.weighted @ self.weighted)

    @property
    def variance(self) -> float:
        """Variance of a weighted residual: 1 as far as the noise is believed."""
        return (belief_in(self.noise_known) + self.chi2) / self.variance_dof

    @property
    def variance_dof(self) -> float:
        """Degrees of freedom of `variance`."""
        return belief_in(self.noise_known) + self.dof

    @cached_property
    def orthonormal(self) -> Floats:
        """(m, q) array, columns that span the Jacobian."""
        return np.linalg.qr(self.jacobian)[0]

    @cached_property
    def leverage(self) -> Floats:
        """(m,) array, the share in which each residual shapes its own prediction."""
        return np.minimum(np.sum(self.orthonormal ** 2, axis=1), 1.0)


def norm_rows(model: Model, u: Floats, context: Context) -> Floats:
    """Give a = ûᵀ A⁻¹, (n, 3): what a change of the reading does to |u|."""
    unit = u / np.linalg.norm(u, axis=1, keepdims=True)
    slope = force_slope(model, u, context)
    rows: Floats = np.linalg.solve(np.swapaxes(slope, 1, 2), unit[:, :, np.newaxis])[:, :, 0]
    return rows


def norm_jacobian(model: Model, u: Floats, context: Context) -> Floats:
    """Give the (n, p) derivative of |u| by the values of the model."""
    basis = parameter_basis(model, u, context)
    return -np.einsum('ni,nip->np', norm_rows(model, u, context), basis)


def fit_norm(name: str, mat_w: Floats, vec_v: Floats, reading: Floats, noise: Floats | None
             ) -> Fit:
    """
    Fit a model to poses of unknown orientation.

    Parameters
    ----------
    name : {'4', '7', '9', '10'}
        The model.
    mat_w : (3, 3) array
        Gain to begin with.
    vec_v : (3,) array
        Offset to begin with [g].
    reading : (n, 3) array
        Pose means [g].
    noise : (n, 3) array or None
        Standard deviation of the pose means [g].

    Returns
    -------
    Fit
        The fitted model.

    Raises
    ------
    RefusedFitError
        If the fit does not converge.

    """
    form = form_of(name)
    start = form.free(mat_w, vec_v)
    # The weights hardly depend on the model: those of the start will do.
    sigma = noise_along(form, start, reading, believable(noise))
    solution, converged = solve(form, start, reading, sigma)
    if not converged:
        raise RefusedFitError('the fit does not converge',
                              'check the poses for mistakes, or take more of them')
    return norm_fit_at(name, solution.free, reading, noise)


def norm_fit_at(name: str, free: Floats, reading: Floats, noise: Floats | None) -> Fit:
    """Say what poses of unknown orientation tell of these (q,) free values; as `fit_norm`."""
    form, believed = form_of(name), believable(noise)
    sigma = noise_along(form, free, reading, believed)
    end = solution_at(form, free, reading, sigma)
    dof = len(reading) - end.jacobian.shape[1]
    spread = np.linalg.inv(end.jacobian.T @ end.jacobian) * variance_factor(
        float(end.weighted @ end.weighted), dof, believed is not None)
    return Fit(form.model(free), form.ties @ spread @ form.ties.T, end.residual, sigma,
               end.jacobian, believed is not None)


def judge(model: Model, reading: Floats, context: Context, noise: Floats | None) -> Fit:
    """
    Say what poses of unknown orientation tell of this model.

    Parameters
    ----------
    model : Model
        Any model.
    reading : (n, 3) array
        Pose means [g].
    context : mapping of str to array
        What the effects need.
    noise : (n, 3) array or None
        Standard deviation of the pose means [g].

    """
    u = sensor_force(model, reading, context)
    believed = believable(noise)
    sigma = np.full(len(u), USUAL_NOISE_G)
    if believed is not None:
        sigma = np.linalg.norm(norm_rows(model, u, context) * believed, axis=1)
    jacobian = norm_jacobian(model, u, context) / sigma[:, np.newaxis]
    residual = np.linalg.norm(u, axis=1) - 1.0
    covariance = covariance_of(jacobian, residual / sigma, believed is not None)
    return Fit(model, covariance, residual, sigma, jacobian, believed is not None)


def fit_reference(effects: tuple[str, ...], reading: Floats, reference: Floats, context: Context,
                  noise: Floats | None) -> Fit:
    """
    Fit a model to poses of known orientation: weighted linear least squares.

    Parameters
    ----------
    effects : tuple of str
        Effects to fit.
    reading, reference : (n, 3) array
        Pose means and true specific force [g].
    context : mapping of str to array
        What the effects need.
    noise : (n, 3) array or None
        Standard deviation of the pose means [g].

    Returns
    -------
    Fit
        The fitted model.

    Raises
    ------
    RefusedFitError
        If the known orientations do not determine the effects.

    """
    noise = believable(noise)
    sigma = np.full(reading.size, USUAL_NOISE_G) if noise is None else noise.ravel()
    zero = with_vector(effects, np.zeros(len(parameter_names(effects))))
    basis = parameter_basis(zero, reference, context)
    design = basis.reshape(reading.size, -1) / sigma[:, np.newaxis]
    values, _, rank, _ = np.linalg.lstsq(design, (reading - reference).ravel() / sigma, rcond=1e-9)
    if rank < design.shape[1]:
        raise RefusedFitError(f'the {len(reading)} known orientations do not determine '
                              f'{", ".join(effects)}',
                              'take poses with each side of the sensor up and down')
    model = with_vector(effects, values)
    residual = (reading - reading_of(model, reference, context)).ravel()
    covariance = covariance_of(design, residual / sigma, noise is not None)
    return Fit(model, covariance, residual, sigma, -design, noise is not None)


def covariance_of(jacobian: Floats, weighted: Floats, noise_known: bool,
                  dof: int | None = None) -> Floats:
    """
    Give the covariance of the free parameters.

    Parameters
    ----------
    jacobian : (m, q) array
        Derivative of the weighted residuals.
    weighted : (m,) array
        Residuals over their noise.
    noise_known : bool
        Whether the noise of the residuals was measured.
    dof : int, optional
        Degrees of freedom, where they are not m - q.

    Returns
    -------
    (q, q) array
        By the pseudo-inverse: what the residuals do not determine has no part in it. NaN where
        nothing tells the noise.

    """
    dof = len(weighted) - jacobian.shape[1] if dof is None else dof
    factor = np.linalg.pinv(jacobian)
    return factor @ factor.T * variance_factor(float(weighted @ weighted), dof, noise_known)
