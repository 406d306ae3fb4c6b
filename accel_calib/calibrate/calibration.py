# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The Calibration: a fitted model with its units, its sensor and what is known of its quality."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .mounting import FrameName, mounting
from .wiring import FLAT, flat_warnings
from ..effects import Context, EFFECTS
from ..model import (
    correct,
    force_slope,
    Model,
    parameter_basis,
    parameter_names,
    predict,
    sensor_force,
)
from ..table import Floats, Poses
from ..units import Units


@dataclass(frozen=True)
class Quality:
    """
    How well a calibration does on the poses it was fitted to.

    Parameters
    ----------
    rms_before_mg, rms_after_mg : float
        Gap without and with the calibration [mg].
    max_before_percent, max_after_percent : float
        Largest error without and with the calibration [% of 1 g].
    held_out_rms_mg : float or None
        Gap of each pose when the others are fitted [mg]; None where a pose cannot be left out.
    noise_floor_mg : float or None
        What the gap would be were the model right [mg]; None where the noise is not known.
    chi2_per_dof : float or None
        Squared residuals over their noise; None where noise or redundancy is missing.
    coverage : float
        Share of the sphere that lies within 45° of a pose.

    """

    rms_before_mg: float
    rms_after_mg: float
    max_before_percent: float
    max_after_percent: float
    held_out_rms_mg: float | None
    noise_floor_mg: float | None
    chi2_per_dof: float | None
    coverage: float


@dataclass(frozen=True)
class Rejected:
    """A pose that was left out: its row, from 1, and why."""

    row: int
    reason: str


@dataclass(frozen=True)
class Calibration:
    """
    A fitted model, ready to correct.

    Parameters
    ----------
    name : str
        Model that was fitted: 4, 7, 9, 10 or 12.
    method : str
        ``ml`` or ``algebraic``.
    model : Model
        The effects with their values, and ΔR.
    units : Units
        Unit of the readings.
    sensor : str
        Which sensor; empty where that was not said.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    date : str
        When it was made, ISO 8601.
    covariance : (p, p) array
        Of ``model.vector`` [g].
    quality : Quality
        Figures over the poses used.
    poses : Poses
        All poses given, in the unit of the readings.
    rejected : tuple of Rejected
        Those that were left out.
    reason : str
        Why this model.
    warnings : tuple of str
        What a user should know.

    """

    name: str
    method: str
    model: Model
    units: Units
    sensor: str
    frame: FrameName
    date: str
    covariance: Floats
    quality: Quality
    poses: Poses
    rejected: tuple[Rejected, ...]
    reason: str
    warnings: tuple[str, ...]

    def __post_init__(self) -> None:
        size = len(self.model.vector)
        if self.covariance.shape != (size, size):
            raise ValueError(f'covariance has shape {self.covariance.shape}, expected '
                             f'{(size, size)}')

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the values, in the order of the covariance."""
        return parameter_names(self.model.effects)

    @property
    def force_per_g(self) -> float:
        """Give how many units of corrected force are 1 g: g for native readings."""
        return 1.0 if self.units.name == 'native' else self.units.per_g

    @property
    def offset(self) -> Floats:
        """V, (3,), in the unit of the readings."""
        return self.units.from_g(self.model.linear_part[1])

    @property
    def gain(self) -> Floats:
        """W, (3, 3): dimensionless, or native units per g."""
        return self.model.linear_part[0] * (self.units.per_g / self.force_per_g)

    @property
    def offset_sd(self) -> Floats:
        """Give the standard deviation of V, (3,), in the unit of the readings."""
        rows = _linear_rows(self.model, np.zeros((1, 3)))[0]
        return self.units.from_g(_deviation(rows, self.covariance))

    @property
    def gain_sd(self) -> Floats:
        """Give the standard deviation of W, (3, 3)."""
        rows = _linear_rows(self.model, np.vstack([np.zeros(3), np.eye(3)]))
        columns = [_deviation(row - rows[0], self.covariance) for row in rows[1:]]
        return np.column_stack(columns) * (self.units.per_g / self.force_per_g)

    def correct(self, reading: Floats, context: Context | None = None) -> Floats:
        """
        Correct readings.

        Parameters
        ----------
        reading : (n, 3) array
            In the unit of the readings.
        context : mapping of str to array, optional
            What the effects need.

        Returns
        -------
        (n, 3) array
            Specific force in the levelled frame, in the same unit; in g for native readings.

        """
        return correct(self.model, self.units.to_g(reading), context or {}) * self.force_per_g

    def predict(self, force: Floats, context: Context | None = None) -> Floats:
        """Say what the sensor reads under this (n, 3) force; the inverse of `correct`."""
        return self.units.from_g(predict(self.model, force / self.force_per_g, context or {}))

    def force_covariance(self, force: Floats, context: Context | None = None) -> Floats:
        """
        Say how uncertain the calibration leaves a corrected force.

        Parameters
        ----------
        force : (n, 3) array
            Corrected forces, in the levelled frame, as `correct` gives them.
        context : mapping of str to array, optional
            What the effects need, n rows each.

        Returns
        -------
        (n, 3, 3) array
            Covariances in the squared unit of force.

        """
        model, known = self.model, context or {}
        u = force / self.force_per_g @ model.rotation.T
        basis = parameter_basis(model, u, known)
        moved = model.rotation.T @ np.linalg.solve(force_slope(model, u, known), basis)
        covariance: Floats = moved @ self.covariance @ np.swapaxes(moved, 1, 2)
        return covariance * self.force_per_g ** 2


def _linear_rows(model: Model, u: Floats) -> Floats:
    """Give the (n, 3, p) part that each value has in V + W u; none where it is not linear."""
    parts = [EFFECTS[name].basis(u, {}, np.zeros(0)) if EFFECTS[name].linear
             else np.zeros((len(u), 3, len(EFFECTS[name].values))) for name in model.effects]
    return np.concatenate([np.zeros((len(u), 3, 0)), *parts], axis=2)


def _deviation(rows: Floats, covariance: Floats) -> Floats:
    """Give the standard deviation of each of these (m, p) combinations of parameters."""
    return np.sqrt(np.maximum(np.einsum('ip,pq,iq->i', rows, covariance, rows), 0.0))


def level(calibration: Calibration, reading: Floats, frame: FrameName,
          context: Context | None = None) -> Calibration:
    """
    Level the mounting from one flat pose.

    Parameters
    ----------
    calibration : Calibration
        With any ΔR.
    reading : (3,) array
        Mean reading of the flat pose, in the unit of the readings.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    context : mapping of str to array, optional
        What the effects need, one row.

    Returns
    -------
    Calibration
        The same with ΔR of that pose, and a warning where it looks like a fault of the wiring.

    """
    reading_g = calibration.units.to_g(np.asarray(reading, float))[np.newaxis]
    flat = sensor_force(calibration.model, reading_g, context or {})[0]
    rotation = mounting(flat, frame)
    others = [warning for warning in calibration.warnings if not warning.startswith(FLAT)]
    return replace(calibration, model=Model(calibration.model.values, rotation), frame=frame,
                   warnings=(*others, *flat_warnings(rotation, frame)))
