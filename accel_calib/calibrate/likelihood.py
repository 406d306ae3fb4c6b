# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Maximum likelihood: what the poses say of the parameters, and how surely.

A pose of unknown orientation tells one number, |force| = 1 g, and its residual is

    e = |u| - 1,   u the force found from the reading

whose noise is that of the pose mean seen along the force: with slope A = d reading / d u and
row vector a = ûᵀ A⁻¹, the variance is Σ_j a_j² s_j². The Jacobian is exact: a parameter that adds
B to the reading moves u by -A⁻¹ B, so that de/dk = -a B. A pose of known orientation tells three
numbers, reading - predict(reference), linear in the parameters.

Both are least squares, weighted by the noise; the covariance is (JᵀJ)⁻¹. Where the noise is not
known, or the residuals exceed it significantly, the residuals set its scale: poses often repeat
worse than their samples say.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..effects import Context
from ..errors import InputError, RefusedFitError
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

_CHI2_SURPRISE = 0.01
"""Below this probability of the chi², the residuals and not the samples set the noise."""

_NO_NOISE_G = 1e-9
"""Samples that scatter less do not scatter at all."""

_LEAST_NOISE = 0.1
"""A pose that claims less than this part of the median noise is not believed."""


_BELIEF = 8.0
"""What the measured noise of the poses counts as, in degrees of freedom."""


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
        Noise of each residual [g]; 1 where it is not known.
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
        """
        Variance of a weighted residual: 1 as far as the measured noise is believed.

        The measured noise counts as `_BELIEF` degrees of freedom beside those of the residuals
        (moderated variance, Smyth 2004).

        """
        belief = _BELIEF if self.noise_known else 0.0
        return (belief + self.chi2) / (belief + self.dof) if belief + self.dof > 0 else np.nan

    @property
    def variance_dof(self) -> float:
        """Degrees of freedom of `variance`."""
        return self.dof + (_BELIEF if self.noise_known else 0.0)

    @property
    def leverage(self) -> Floats:
        """(m,) array, the share in which each residual shapes its own prediction."""
        orthonormal = np.linalg.qr(self.jacobian)[0]
        return np.minimum(np.sum(orthonormal ** 2, axis=1), 1.0)


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


def believable(noise: Floats) -> Floats | None:
    """Raise noise that is far below the others'; None where most claim to have none at all."""
    median = np.median(noise)
    return np.maximum(noise, _LEAST_NOISE * median) if median > _NO_NOISE_G else None


def fit_norm(start: Model, reading: Floats, context: Context, noise: Floats | None,
             ties: Floats | None = None) -> Fit:
    """
    Fit a model to poses of unknown orientation.

    Parameters
    ----------
    start : Model
        Effects to fit and where to begin.
    reading : (n, 3) array
        Pose means [g].
    context : mapping of str to array
        What the effects need.
    noise : (n, 3) array or None
        Standard deviation of the pose means [g].
    ties : (p, q) array, optional
        All p values from the q that are free; without it each is free.

    Returns
    -------
    Fit
        The fitted model.

    Raises
    ------
    RefusedFitError
        If the fit does not converge.

    """
    ties = np.eye(len(start.vector)) if ties is None else ties
    noise = None if noise is None else believable(noise)
    model = start
    for _ in range(1 if noise is None else 2):  # the weights hardly depend on the model
        u = sensor_force(model, reading, context)
        model = _minimise(model, reading, context, _sigma(model, u, context, noise), ties)
    return judge(model, reading, context, noise, ties)


def judge(model: Model, reading: Floats, context: Context, noise: Floats | None,
          ties: Floats | None = None) -> Fit:
    """Say what poses of unknown orientation tell of this model; arguments as `fit_norm`."""
    ties = np.eye(len(model.vector)) if ties is None else ties
    u = sensor_force(model, reading, context)
    sigma = _sigma(model, u, context, None if noise is None else believable(noise))
    jacobian = norm_jacobian(model, u, context) @ ties / sigma[:, np.newaxis]
    residual = np.linalg.norm(u, axis=1) - 1.0
    covariance = ties @ covariance_of(jacobian, residual / sigma, noise is not None) @ ties.T
    return Fit(model, covariance, residual, sigma, jacobian, noise is not None)


def _sigma(model: Model, u: Floats, context: Context, noise: Floats | None) -> Floats:
    """Give the (n,) noise of |u|, or ones where the (n, 3) noise is not known."""
    if noise is None:
        return np.ones(len(u))
    return np.sqrt(np.sum((norm_rows(model, u, context) * noise) ** 2, axis=1))


def _minimise(start: Model, reading: Floats, context: Context, sigma: Floats,
              ties: Floats) -> Model:
    """Move the free values of the model to the least sum of squares."""
    from scipy.optimize import least_squares

    def model_at(free: Floats) -> Model:
        return with_vector(start.effects, ties @ free)

    def residuals(free: Floats) -> Floats:
        u = sensor_force(model_at(free), reading, context)
        weighted: Floats = (np.linalg.norm(u, axis=1) - 1.0) / sigma
        return weighted

    def jacobian(free: Floats) -> Floats:
        model = model_at(free)
        u = sensor_force(model, reading, context)
        return norm_jacobian(model, u, context) @ ties / sigma[:, np.newaxis]

    free = np.linalg.lstsq(ties, start.vector, rcond=None)[0]
    try:
        found = least_squares(residuals, free, jac=jacobian, method='lm',
                              ftol=1e-14, xtol=1e-12, gtol=1e-14)
    except (np.linalg.LinAlgError, InputError):
        found = None
    if found is None or not found.success:
        raise RefusedFitError('the fit does not converge',
                              'check the poses for mistakes, or take more of them')
    return model_at(found.x)


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
    noise = None if noise is None else believable(noise)
    sigma = np.ones(reading.size) if noise is None else noise.ravel()
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
        If not, or if the chi² is too large to believe the noise, the residuals scale it.
    dof : int, optional
        Degrees of freedom, where they are not m - q.

    Returns
    -------
    (q, q) array
        NaN where the poses leave nothing to judge an unknown noise by.

    """
    from scipy.special import chdtrc

    dof = len(weighted) - jacobian.shape[1] if dof is None else dof
    chi2 = float(weighted @ weighted)
    scale = 1.0
    if not noise_known or (dof > 0 and chdtrc(dof, chi2) < _CHI2_SURPRISE):
        scale = chi2 / dof if dof > 0 else np.nan
    factor = np.linalg.pinv(jacobian)
    return factor @ factor.T * scale
