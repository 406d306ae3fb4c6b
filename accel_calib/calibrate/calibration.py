# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The Calibration: a fitted model with its units, its sensor and what is known of its quality."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .checks import FLAT, flat_warnings
from .mounting import FrameName, mounting, with_heading, with_heading_of
from ..effects import AXES, Context
from ..html_table import table
from ..model import correct, force_slope, Model, parameter_names, predict, sensor_force
from ..table import Floats, Poses, Table
from ..units import Units

HELD = ('time', 'temperature', 'supply_voltage')
"""Quantities at whose range the effects end: beyond what the poses saw they are held."""

_Known = TypeVar('_Known', bound=Table)


@dataclass(frozen=True)
class Quality:
    """
    How well a calibration does on the poses it was fitted to.

    Parameters
    ----------
    rms_before_mg, rms_after_mg : float
        Residual without and with the calibration [mg].
    max_before_percent, max_after_percent : float
        Largest error without and with the calibration [% of 1 g].
    held_out_rms_mg : float or None
        Residual of each pose when the others are fitted [mg]; None if a pose cannot be left out.
    noise_floor_mg : float or None
        What the residual would be if the model were right [mg]; None if the noise is not known.
    chi2_per_dof : float or None
        Squared residuals over their noise; None without noise or redundancy.
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


@dataclass(frozen=True, repr=False)
class Calibration:
    """
    A fitted model, ready to correct.

    Parameters
    ----------
    name : str
        Model that was fitted: 4, 7, 9, 10 or 12, or ``ideal``.
    method : str
        ``ml`` or ``algebraic``.
    model : Model
        The effects with their values, and ΔR.
    units : Units
        Unit of the readings.
    sensor : str
        Name of the sensor, frame_id of its messages; empty if it was not given.
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
    stream : str
        Topic of its messages, with namespace; empty for recordings.

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
    stream: str = ''

    def __post_init__(self) -> None:
        size = len(self.model.vector)
        if self.covariance.shape != (size, size):
            raise ValueError(f'covariance has shape {self.covariance.shape}, expected '
                             f'{(size, size)}')

    def __repr__(self) -> str:
        about = [f'model {self.name}', f'{len(self.used_poses)} of {len(self.poses)} poses',
                 f'residual {self.quality.rms_after_mg:.3g} mg', self.units.name, self.sensor,
                 self.date[:10]]
        return f'Calibration({"; ".join(filter(None, about))})'

    def _repr_html_(self) -> str:
        """Return offset and gain as a table, for notebooks."""
        rows = [[axis, *(f'{value:.6g} ± {sd:.1g}' for value, sd in zip(values, deviations))]
                for axis, values, deviations in zip(
                    AXES, np.column_stack([self.offset, self.gain]),
                    np.column_stack([self.offset_sd, self.gain_sd]))]
        head = ['axis', f'offset V [{self.units.name}]', *(f'gain W, {axis}' for axis in AXES)]
        lines = ''.join(f'<p>{escape(line)}</p>\n' for line in (repr(self), *self.warnings))
        return table(head, rows) + lines

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the values, in the order of the covariance."""
        return parameter_names(self.model.effects)

    @property
    def force_per_g(self) -> float:
        """Units of corrected force per g: 1 for native readings, whose force is in g."""
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
    def matrix(self) -> Floats:
        """
        W⁻¹, (3, 3), in units of the reading.

        Corrected force is ``rotation.T @ matrix @ (reading - offset)``, as long as the calibration
        has offset and gains alone; `correct` knows the other effects too.

        """
        return np.linalg.inv(self.gain)

    @property
    def rotation(self) -> Floats:
        """ΔR, (3, 3): takes a vector in the levelled frame to the sensor frame."""
        return self.model.rotation

    @property
    def is_levelled(self) -> bool:
        """Return whether ΔR is known."""
        return not np.array_equal(self.rotation, np.eye(3))

    @property
    def offset_sd(self) -> Floats:
        """Return the standard deviation of V, (3,), in the unit of the readings."""
        rows = _linear_rows(self.model, np.zeros((1, 3)))[0]
        return self.units.from_g(_deviation(rows, self.covariance))

    @property
    def gain_sd(self) -> Floats:
        """Return the standard deviation of W, (3, 3)."""
        rows = _linear_rows(self.model, np.vstack([np.zeros(3), np.eye(3)]))
        columns = [_deviation(row - rows[0], self.covariance) for row in rows[1:]]
        return np.column_stack(columns) * (self.units.per_g / self.force_per_g)

    @property
    def used_poses(self) -> Poses:
        """Return the poses that the calibration was fitted to, in the unit of the readings."""
        rejected = [pose.row for pose in self.rejected]
        return self.poses.take(~np.isin(self.poses.row, rejected))

    @cached_property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Least and largest time, temperature and supply at which its effects were seen."""
        used = self.used_poses
        return {key: (float(np.min(used[key])), float(np.max(used[key])))
                for key in HELD if key in self.model.needs and key in used and len(used)}

    def held(self, known: _Known) -> _Known:
        """Return a table whose context is held at the edge of `ranges`."""
        if not any(key in known for key in self.ranges):
            return known
        return known.with_columns(**_held(known.columns, self.ranges))

    def correct(self, reading: Floats, context: Context | None = None) -> Floats:
        """
        Correct readings.

        Parameters
        ----------
        reading : (n, 3) array
            In the unit of the readings.
        context : mapping of str to array, optional
            What the effects need; held at the edge of `ranges`.

        Returns
        -------
        (n, 3) array
            Specific force in the levelled frame, in the same unit; in g for native readings.

        Raises
        ------
        InputError
            If the effects need a column that is not given, or cannot be undone.

        """
        known = self._context(context)
        return correct(self.model, self.units.to_g(reading), known) * self.force_per_g

    def apply(self, readings: ArrayLike, **known: ArrayLike) -> Floats:
        """
        Correct samples.

        Parameters
        ----------
        readings : (n, 3) or (3,) array
            In the unit of the readings.
        **known : float or (n,) array, (n, 3) array for ``rate``
            What the effects need beside a sample: ``time`` [s], ``temperature`` [°C],
            ``supply_voltage`` [V], ``rate`` [rad/s].

        Returns
        -------
        (n, 3) or (3,) array
            Specific force in the levelled frame, in the same unit; in g for native readings.

        Raises
        ------
        InputError
            If the effects need a quantity that is not given, or cannot be undone.

        """
        given = np.asarray(readings, float)
        rows = np.atleast_2d(given)
        context = {key: np.broadcast_to(np.asarray(values, float),
                                        (len(rows), 3) if key == 'rate' else (len(rows),))
                   for key, values in known.items()}
        return self.correct(rows, of_samples(context, len(rows))).reshape(given.shape)

    def predict(self, force: Floats, context: Context | None = None) -> Floats:
        """Return what the sensor reads under this (n, 3) force; the inverse of `correct`."""
        known = self._context(context)
        return self.units.from_g(predict(self.model, force / self.force_per_g, known))

    def force_covariance(self, force: Floats, context: Context | None = None) -> Floats:
        """
        Return how uncertain the calibration leaves a corrected force.

        Parameters
        ----------
        force : (n, 3) array
            Corrected forces, in the levelled frame, as `correct` returns them.
        context : mapping of str to array, optional
            What the effects need, n rows each.

        Returns
        -------
        (n, 3, 3) array
            Covariances in the squared unit of force.

        """
        model, known = self.model, self._context(context)
        u = force / self.force_per_g @ model.rotation.T
        basis = model.basis(u, known).full
        moved = model.rotation.T @ np.linalg.solve(force_slope(model, u, known), basis)
        covariance: Floats = moved @ self.covariance @ np.swapaxes(moved, 1, 2)
        return covariance * self.force_per_g ** 2

    def _context(self, context: Context | None) -> Context:
        if not context or not self.ranges:
            return context or {}
        return {**context, **_held(context, self.ranges)}


def of_samples(known: Context, count: int) -> Context:
    """
    Return the context of single samples.

    How strongly the sensor vibrates and which pose it came from cannot be known from one sample;
    both are taken as none, and so is a rate that is NaN.

    Parameters
    ----------
    known : mapping of str to array
        What is known beside the samples.
    count : int
        Number of samples.

    """
    none = np.zeros((count, 3))
    return {**known, 'std': none, 'previous': none,
            'rate': np.nan_to_num(known['rate']) if 'rate' in known else none}


def _held(context: Context, ranges: Mapping[str, tuple[float, float]]) -> dict[str, Floats]:
    return {key: np.clip(context[key], *limits) for key, limits in ranges.items()
            if key in context}


def _linear_rows(model: Model, u: Floats) -> Floats:
    """Return the (n, 3, p) part of each value in V + W u; 0 for values outside V and W."""
    linear = Model({name: values for (name, values), effect in
                    zip(model.values.items(), model.terms.effects, strict=True) if effect.linear})
    rows = np.zeros((len(u), 3, len(model.vector)))
    place = [parameter_names(model.effects).index(name)
             for name in parameter_names(linear.effects)]
    rows[:, :, place] = linear.basis(u, {}).full
    return rows


def _deviation(rows: Floats, covariance: Floats) -> Floats:
    """Return the standard deviation of each of these (m, p) combinations of values."""
    return np.sqrt(np.maximum(np.einsum('ip,pq,iq->i', rows, covariance, rows), 0.0))


def level(calibration: Calibration, reading: Floats, frame: FrameName,
          context: Context | None = None) -> Calibration:
    """
    Level the mounting from one flat pose.

    Parameters
    ----------
    calibration : Calibration
        With any ΔR; the heading of a mounting that is levelled already is kept.
    reading : (3,) array
        Mean reading of the flat pose, in the unit of the readings.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    context : mapping of str to array, optional
        What the effects need, one row.

    Returns
    -------
    Calibration
        The same with ΔR of that pose, and a warning if it looks like a fault of the wiring.

    """
    rotation = mounting(_in_sensor_axes(calibration, reading, context), frame)
    if calibration.is_levelled and frame == calibration.frame:
        rotation = with_heading_of(calibration.rotation, rotation)
    others = [warning for warning in calibration.warnings if not warning.startswith(FLAT)]
    return replace(calibration, model=Model(calibration.model.values, rotation), frame=frame,
                   warnings=(*others, *flat_warnings(rotation, frame)))


def set_heading(calibration: Calibration, reading: Floats, context: Context | None = None
                ) -> Calibration:
    """
    Find the heading of the mounting from one pose with the nose of the robot down.

    Parameters
    ----------
    calibration : Calibration
        Levelled.
    reading : (3,) array
        Mean reading of that pose, in the unit of the readings.
    context : mapping of str to array, optional
        What the effects need, one row.

    Returns
    -------
    Calibration
        The same with that heading.

    Raises
    ------
    InputError
        If the nose is down by less than 10°.

    """
    nose_down = _in_sensor_axes(calibration, reading, context)
    rotation = with_heading(calibration.rotation, nose_down, calibration.frame)
    return replace(calibration, model=Model(calibration.model.values, rotation))


def _in_sensor_axes(calibration: Calibration, reading: Floats, context: Context | None) -> Floats:
    """Return the specific force of one reading in the axes of the sensor [g]."""
    reading_g = calibration.units.to_g(np.asarray(reading, float))[np.newaxis]
    return sensor_force(calibration.model, reading_g, calibration._context(context))[0]
