# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The record of a calibration, and the context in which it corrects readings.

Effects are not extrapolated: beyond the range of the poses, the correction uses the limit of the
range (`Calibration.ranges`), and `.quality.outside` says how far beyond it was. A curve over the
vibration has a range, too. A single sample does not show its vibration, so that the correction
uses the lower limit.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from html import escape
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .rest_noise import GyroBias, SampleNoise
from ..effects import (
    add_acting, AXES, Context, context_of_samples, correct, FROM_TEMPERATURE, Model, ModelForm,
    MODELS, parameter_names, predict)
from ..errors import InputError, RefusedFitError, StoredCalibrationError
from ..finding import Finding, Rating
from ..table import data_frame, Floats, in_unit, name_from, Poses, Record, Table
from ..text import one_line, table, with_sd
from ..units import FrameName, METHODS, UnitName, Units, units_of

ORIENTED = '12'
"""The model of poses of known orientation."""

PRIOR = 'prior'
"""Method of a calibration whose values are partly those of a common sensor; see `.partial`."""

FLEET = 'fleet'
"""Method of a calibration whose values are partly those of a fleet; see `.partial`."""

STORED_METHODS = (*METHODS, PRIOR, FLEET)
"""Methods of stored calibrations; the user selects one of `METHODS`."""

_HELD = ('time', 'temperature', *FROM_TEMPERATURE, 'supply_voltage')
"""Context that is limited to the range of the poses, as quantities are."""

_Known = TypeVar('_Known', bound=Table)


@dataclass(frozen=True)
class Quality:
    """
    Residuals and other figures of a calibration, over the poses it was fitted to.

    RefusedFitError is raised for a negative figure.

    Parameters
    ----------
    rms_before_mg, rms_after_mg : float
        Residual without and with the calibration [mg].
    max_before_percent, max_after_percent : float
        Largest error without and with the calibration [% of 1 g].
    held_out_rms_mg : float or None
        Residual if each pose is predicted from a fit of other orientations [mg]; None if they do
        not determine the model.
    noise_floor_mg : float or None
        Expected residual of a correct model [mg]; None if the noise is not known.
    chi2_per_dof : float or None
        Squared residuals in units of the noise, per degree of freedom; None if the noise is not
        known or there are no degrees of freedom.
    coverage : float
        Share of the sphere within 45° of a pose.

    """

    rms_before_mg: float
    rms_after_mg: float
    max_before_percent: float
    max_after_percent: float
    held_out_rms_mg: float | None
    noise_floor_mg: float | None
    chi2_per_dof: float | None
    coverage: float

    def __post_init__(self) -> None:
        for name, figure in vars(self).items():
            if figure is not None and figure < 0.0:
                raise RefusedFitError(f'{name} is {figure:.3g}, expected 0 or more', 'fit again')


RejectedKind = Literal['implausible', 'doubtful', 'outlier', 'clipped']


@dataclass(frozen=True)
class Rejected:
    """A pose that the fit does not use: its row, 1-based, the reason, and the kind of it."""

    row: int
    reason: str
    kind: RejectedKind = 'implausible'


@dataclass(frozen=True, repr=False, eq=False)
class Calibration(Record):
    """
    A fitted model that corrects readings.

    Two calibrations are equal if all but their dates are.

    Parameters
    ----------
    name : str
        Name of the fitted model: 4, 7, 9, 10, 12 or ``ideal``.
    method : str
        One of `STORED_METHODS`.
    model : Model
        The effects with their values, and ΔR.
    units : Units
        Unit of the readings.
    sensor : str
        Name of the sensor, or frame_id of its messages; empty if not known.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    date : str
        Date of the fit, ISO 8601.
    covariance : (p, p) array
        Covariance of ``model.vector`` [g²]. Rows of shapes at their usual value may be left out;
        they are 0.
    quality : Quality
        Residuals and other figures over the poses used.
    poses : Poses
        All poses, in the unit of the readings.
    rejected : tuple of Rejected
        Poses that the fit does not use.
    reason : str
        Reason for the choice of the model.
    noted : tuple of Finding
        What was noted during the fit, when it was levelled, and when it was read.
    stream : str
        Topic of the messages, with namespace; empty for recordings.
    gyro : GyroBias or None
        Bias of the gyro over the poses used; None if it is not known.
    noise : SampleNoise or None
        White noise of a sample over the poses used; None if it is not known.

    """

    name: str
    method: str
    model: Model
    units: Units
    sensor: str
    frame: FrameName
    date: str = field(compare=False)
    covariance: Floats
    quality: Quality
    poses: Poses
    rejected: tuple[Rejected, ...]
    reason: str
    noted: tuple[Finding, ...]
    stream: str = ''
    gyro: GyroBias | None = None
    noise: SampleNoise | None = None

    def __post_init__(self) -> None:
        for name in ('sensor', 'stream', 'date'):
            object.__setattr__(self, name, name_from(getattr(self, name), name))
        if (self.poses.units, self.poses.sensor) != (self.units.name, self.sensor):
            object.__setattr__(self, 'poses', replace(
                self.poses, units=self.units.name, sensor=self.sensor))
        size, stated = len(self.model.vector), self.model.stated
        covariance = self.covariance.copy()
        if covariance.shape == (np.sum(stated), np.sum(stated)):
            covariance = np.zeros((size, size))
            covariance[np.ix_(stated, stated)] = self.covariance
        if covariance.shape != (size, size):
            raise ValueError(f'covariance has shape {covariance.shape}, expected {(size, size)}')
        covariance.setflags(write=False)
        object.__setattr__(self, 'covariance', covariance)

    def __repr__(self) -> str:
        about = [f'model {self.name}', f'{len(self.used_poses)} of {len(self.poses)} poses',
                 f'residual {self.quality.rms_after_mg:.3g} mg', self.units.name, self.sensor,
                 self.date[:10]]
        return f'Calibration({"; ".join(filter(None, about))})'

    def _repr_html_(self) -> str:
        rows = [[axis, *(with_sd(value, sd) if value or sd else ''
                         for value, sd in zip(values, deviations))]
                for axis, values, deviations in zip(
                    AXES, np.column_stack([self.offset, self.gain]),
                    np.column_stack([self.offset_sd, self.gain_sd]))]
        head = ['axis', f'offset V [{self.units.name}]', *(f'gain W, {axis}' for axis in AXES)]
        lines = ''.join(f'<p>{escape(line)}</p>\n' for line in (repr(self), *self.warnings))
        return table(head, rows) + lines

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what was noted, as lines of text."""
        return tuple(each.words for each in self.noted)

    @property
    def form(self) -> ModelForm:
        """Return the form of the fitted model, before effects were added."""
        return MODELS[self.name]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the values, in the order of `covariance`."""
        return parameter_names(self.model.effects)

    @property
    def deviations(self) -> dict[str, float]:
        """Return the standard deviations of the values, by name."""
        variances = np.maximum(np.diag(self.covariance), 0.0)
        return dict(zip(self.parameters, np.sqrt(variances).tolist(), strict=True))

    @cached_property
    def force_per_g(self) -> float:
        """Corrected force per g, as `Units.force_per_g`."""
        return self.units.force_per_g

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

        The corrected force is ``rotation.T @ matrix @ (reading - offset)`` if the calibration has
        only offset and gains. `correct` includes the other effects.

        """
        return np.linalg.inv(self.gain)

    @property
    def rotation(self) -> Floats:
        """ΔR, (3, 3): transforms from the levelled frame to the sensor frame."""
        return self.model.rotation.copy()

    @cached_property
    def is_levelled(self) -> bool:
        """Whether ΔR is known."""
        return not np.array_equal(self.rotation, np.eye(3))

    @property
    def in_sensor_frame(self) -> Calibration:
        """Return the calibration without the mounting: offset, gain and the other effects."""
        return replace(self, model=Model(self.model.values)) if self.is_levelled else self

    def in_units(self, units: Units | UnitName) -> Calibration:
        """
        Return the same calibration for readings in another unit.

        Drivers convert g to m/s² with the standard gravity, not with the local gravity, so only
        the name of the unit matters here. The effects are in local g, and do not change.

        Raises
        ------
        InputError
            If one of the two units is native and the other is not.

        """
        before, name = self.units, units.name if isinstance(units, Units) else units
        if name == before.name:
            return self
        one, other = units_of(before.name), units_of(name)
        if one.is_native or other.is_native:
            raise InputError(f'the calibration is for readings in {before.name}, but the readings '
                             f'are in {name}, and the scale of native units is not known',
                             f'use readings in {before.name}, or fit a calibration to poses in '
                             f'{name}')
        factor = other.per_g / one.per_g
        noise = self.noise and replace(self.noise, force=self.noise.force * factor)
        return replace(self, units=Units(name, before.per_g * factor), noise=noise,
                       poses=in_unit(self.poses, lambda values: values * factor))

    @property
    def offset_sd(self) -> Floats:
        """Return the standard deviation of V, (3,), in the unit of the readings."""
        return self.units.from_g(self._linear_sd[:, 0])

    @property
    def gain_sd(self) -> Floats:
        """Return the standard deviation of W, (3, 3)."""
        return self._linear_sd[:, 1:] * (self.units.per_g / self.force_per_g)

    @cached_property
    def _linear_sd(self) -> Floats:
        """(3, 4) array, standard deviation of V [g] and of the columns of W."""
        model, effects = self.model, self.model.terms.effects
        linear = Model({name: values for (name, values), effect in
                        zip(model.values.items(), effects, strict=True) if effect.linear})
        place = np.isin(self.parameters, parameter_names(linear.effects))
        # The derivative of V + W u at the origin, and of its change along each axis.
        basis = linear.basis(np.vstack([np.zeros(3), np.eye(3)]), {}).full
        rows = np.concatenate([basis[:1], basis[1:] - basis[0]])
        covariance = self.covariance[np.ix_(place, place)]
        return np.sqrt(np.maximum(np.einsum('kip,pq,kiq->ik', rows, covariance, rows), 0.0))

    @cached_property
    def used_poses(self) -> Poses:
        """Return the poses that the calibration was fitted to, in the unit of the readings."""
        return self.poses.take(~np.isin(self.poses.row, [pose.row for pose in self.rejected]))

    @cached_property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Range over the poses of what the effects depend on; of a lag, the acting temperature."""
        known = add_acting(self.poses.columns, self.model)
        used = np.isin(self.poses.row, self.used_poses.row)
        wanted = {*self.model.over, *({'temperature'} & {*self.model.needs})}
        return {key: (float(np.min(known[key][used])), float(np.max(known[key][used])))
                for key in (*_HELD, *self.poses.quantities)
                if key in wanted and key in known and np.any(used)}

    @cached_property
    def typical(self) -> Mapping[str, float]:
        """Middle of `ranges` of each column, or its value of no change."""
        return {**self.model.neutral,
                **{key: sum(limits) / 2.0 for key, limits in self.ranges.items()}}

    def typical_context(self, count: int) -> Context:
        """Return the middle of `ranges` for `count` samples, without motion and vibration."""
        none = np.zeros((count, 3))
        middle = {key: np.full(count, value) for key, value in self.typical.items()}
        return {'std': none, 'previous': none, 'rate': none, 'time': np.zeros(count), **middle}

    def held(self, known: _Known) -> _Known:
        """Return a table with its context limited to `ranges`."""
        return known.with_columns(**self.held_context(known.columns))

    def correct(self, reading: Floats, context: Context | None = None) -> Floats:
        """
        Correct readings.

        Parameters
        ----------
        reading : (n, 3) array
            Readings, in the unit of the calibration.
        context : mapping of str to array, optional
            Columns that the effects need; limited to `ranges`.

        Returns
        -------
        (n, 3) array
            Specific force in the levelled frame, in the same unit; in g for native readings.

        Raises
        ------
        InputError
            If a column is missing, or the effects cannot be corrected.

        """
        known = self.held_context(context)
        return correct(self.model, self.units.to_g(reading), known) * self.force_per_g

    def apply(self, readings: ArrayLike, **known: ArrayLike) -> Floats:
        """
        Correct samples.

        Parameters
        ----------
        readings : (n, 3) or (3,) array
            Samples, in the unit of the calibration.
        **known : float or (n,) array, (n, 3) array for ``rate``
            Context that the effects need: ``time`` [s], ``temperature`` [°C], ``supply_voltage``
            [V], ``rate`` [rad/s], and quantities by name.

        Returns
        -------
        (n, 3) or (3,) array
            Specific force in the levelled frame, in the same unit; in g for native readings.

        Raises
        ------
        InputError
            If there are not three columns, a reading is not finite, context is missing, or the
            effects cannot be corrected.

        """
        given = np.asarray(readings)
        if given.shape[-1:] != (3,) or given.ndim > 2:
            raise InputError(f'the readings have shape {given.shape}, expected (n, 3) or (3,)',
                             'pass the columns of the acceleration alone, and the context by '
                             'name, such as temperature=…')
        rows = np.atleast_2d(given.astype(float))
        if not np.all(np.isfinite(rows)):
            raise InputError('the readings hold numbers that are not finite, expected finite '
                             'numbers', 'leave out these rows')
        context = {key: np.broadcast_to(np.asarray(values, float),
                                        (len(rows), 3) if key == 'rate' else (len(rows),))
                   for key, values in known.items()}
        found = context_of_samples(context, len(rows), self.model)
        lacking = {*self.model.neutral} - {*context}  # `correct` names them
        found = {key: values for key, values in found.items() if key not in lacking}
        return self.correct(rows, found).reshape(given.shape)

    def predict(self, force: Floats, context: Context | None = None) -> Floats:
        """Return the (n, 3) readings for an (n, 3) force; the inverse of `correct`."""
        known = self.held_context(context)
        return self.units.from_g(predict(self.model, force / self.force_per_g, known))

    def force_covariance(self, force: Floats, context: Context | None = None) -> Floats:
        """
        Return the covariance of corrected forces that the calibration causes.

        Parameters
        ----------
        force : (n, 3) array
            Corrected forces, in the levelled frame, as `correct` returns them.
        context : mapping of str to array, optional
            Columns that the effects need, n rows each.

        Returns
        -------
        (n, 3, 3) array
            Covariances, in the squared unit of the force.

        """
        model, known = self.model, self.held_context(context)
        u = force / self.force_per_g @ model.rotation.T
        basis = model.basis(u, known).full
        moved = model.rotation.T @ np.linalg.solve(model.at(known).slope(u), basis)
        covariance: Floats = moved @ self.covariance @ np.swapaxes(moved, 1, 2)
        return covariance * self.force_per_g ** 2

    def held_context(self, context: Context | None) -> Context:
        """Return a context limited to `ranges`; a value that is NaN becomes the middle."""
        if not context or not self.ranges:
            return context or {}
        known = add_acting(context, self.model)
        return {**known, **{
            key: np.where(np.isnan(known[key]), self.typical[key], np.clip(known[key], *limits))
            for key, limits in self.ranges.items() if key in known}}

    @cached_property
    def rating(self) -> Rating:
        """Return whether the calibration is good: ``name``, ``reason``, ``next``, ``findings``."""
        rating: Rating = _later('findings').rate(self)
        return rating

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what is worth knowing, that which decides the rating first."""
        return self.rating.findings

    def to_dataframe(self) -> Any:
        """
        Return the figures as a pandas DataFrame: ``label``, ``unit``, ``value`` and ``sd`` by key.

        Raises
        ------
        InputError
            If pandas is not installed.

        """
        found = [asdict(each) for each in _later('findings').figures_of(self)]
        keys = [each.pop('key') for each in found]
        return data_frame({name: [each[name] for each in found] for name in found[0]}, keys)

    def plot(self, axes: Any = None) -> Any:
        """
        Draw the residual of each pose without and with the calibration.

        Parameters
        ----------
        axes : matplotlib axes, optional
            Where to draw; by default a new figure.

        Returns
        -------
        matplotlib axes
            The axes; ``axes.figure`` is the figure.

        Raises
        ------
        InputError
            If matplotlib is not installed.

        """
        return _later('report').plot_residuals(self, axes)

    def save(self, path: str | PathLike[str]) -> None:
        """
        Write the calibration as YAML; the previous file is kept as ``<name>.before``.

        Raises
        ------
        RefusedFitError
            If the calibration is not plausible.
        OSError
            If the file cannot be written.

        """
        _later('stored').write_calibration(Path(path), self)

    def report(self, path: str | PathLike[str]) -> Any:
        """
        Refine the calibration on its own poses, and write a report of the result (HTML).

        Returns
        -------
        Refinement
            The result that the report shows.

        Raises
        ------
        RefusedFitError
            If the poses are too few to find an effect.
        InputError
            If matplotlib is not installed.
        OSError
            If the file cannot be written.

        """
        pages = _later('report')
        pages.check_matplotlib()
        result = _later('refinement').refine(self.used_poses, self.units, base=self)
        pages.write_page(Path(path), pages.refinement_page(result, ''))
        return result


def _later(part: str) -> Any:
    """Import a part of the package that takes calibrations, when it is given one."""
    return import_module(f'accel_calib.{part}')


def check_sensor(calibration: Calibration, sensor: str) -> None:
    """Raise StoredCalibrationError if a calibration is of another sensor; '' matches any."""
    sensor = one_line(sensor).strip()
    if calibration.sensor and sensor and calibration.sensor != sensor:
        raise StoredCalibrationError(f'the calibration belongs to sensor {calibration.sensor!r}, '
                                     f'but the readings come from {sensor!r}',
                                     'use the calibration of this sensor, or fit one')
