# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A model is a list of effects with their values: `predict` and `correct` undo each other.

The equation is that of the package: the linear effects make up V and W,

    reading = V + W u + sum of the other effects(u, context),   u = ΔR force

and the correction solves it for u by the iteration u <- W⁻¹ (reading - V - others(u)), a
contraction as long as the other effects are small against the gain.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from .effects import Context, EFFECTS
from .errors import InputError
from .table import COLUMNS, Floats

MODELS: dict[str, tuple[str, ...]] = {
    'ideal': (),
    '4': ('offset', 'gain'),
    '7': ('offset', 'axis_gain'),
    '9': ('offset', 'axis_gain', 'cross_axis', 'misalignment'),
    '10': ('offset', 'axis_gain', 'cross_axis'),
    '12': ('offset', 'axis_gain', 'cross_axis', 'misalignment'),
}
"""Effects of each model. 9 and 10 differ in their axes alone: 9 fixes them to the sensing axes
(ESGI'95 report), 10 makes W symmetric (AN5286)."""

LARGEST_ITERATIONS = 100
CONVERGED_G = 1e-13
"""The iteration ends when u changes by less [g]."""

LARGEST_FORCE_G = 1e6
"""It has run away when u is larger [g]."""


def _identity() -> Floats:
    return np.eye(3)


@dataclass(frozen=True)
class Model:
    """
    Effects and their values.

    Parameters
    ----------
    values : mapping of str to (p,) array
        By name of `accel_calib.effects.EFFECTS`, in the order of the model.
    rotation : (3, 3) array
        ΔR, from the levelled frame to the axes of the sensor.

    """

    values: Mapping[str, Floats]
    rotation: Floats = field(default_factory=_identity)

    def __post_init__(self) -> None:
        for name, values in self.values.items():
            if name not in EFFECTS:
                raise ValueError(f'effect {name!r} is none of {", ".join(EFFECTS)}')
            if np.shape(values) != (len(EFFECTS[name].values),):
                raise ValueError(f'effect {name} has values of shape {np.shape(values)}, expected '
                                 f'{len(EFFECTS[name].values)}')

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects, in order."""
        return tuple(self.values)

    @property
    def vector(self) -> Floats:
        """(p,) array of all values, in order."""
        return np.concatenate([np.zeros(0), *self.values.values()])

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys of the context without which the model cannot correct."""
        return tuple(dict.fromkeys(key for name in self.values for key in EFFECTS[name].needs))

    @cached_property
    def linear_part(self) -> tuple[Floats, Floats]:
        """W (3, 3) and V (3,), both in g."""
        at = np.vstack([np.zeros(3), np.eye(3)])
        reading = at + self._added(at, {}, linear=True)
        return (reading[1:] - reading[0]).T, reading[0]

    @cached_property
    def _inverse_gain(self) -> Floats:
        return np.linalg.inv(self.linear_part[0])

    def _added(self, u: Floats, context: Context, *, linear: bool) -> Floats:
        """Give the (n, 3) reading that the linear effects, or the others, add."""
        total = np.zeros_like(u)
        for name, values in self.values.items():
            if EFFECTS[name].linear is linear:
                parameters, shape = EFFECTS[name].split(values)
                total = total + EFFECTS[name].basis(u, context, shape) @ parameters
        return total

    def _leaves(self, reading: Floats) -> Floats:
        """Give the (n, 3) reading that the output makes of this one."""
        for name, values in self.values.items():
            output = EFFECTS[name].output
            if output is not None:
                reading = output(reading, values)
        return reading


def parameter_names(effects: tuple[str, ...]) -> tuple[str, ...]:
    """Name every parameter of these effects as ``effect.axis``, in the order of all vectors."""
    return tuple(f'{name}.{part}' for name in effects for part in EFFECTS[name].values)


def with_vector(effects: tuple[str, ...], vector: Floats, rotation: Floats | None = None) -> Model:
    """Make a model of these effects from the (p,) vector of all values."""
    sizes = [len(EFFECTS[name].values) for name in effects]
    parts = np.split(vector, np.cumsum(sizes)[:-1]) if sizes else []
    return Model(dict(zip(effects, parts, strict=True)),
                 np.eye(3) if rotation is None else rotation)


def with_linear_part(mat_w: Floats, vec_v: Floats, rotation: Floats | None = None) -> Model:
    """
    Make the model whose gain is W and whose offset is V.

    Parameters
    ----------
    mat_w : (3, 3) array
        Gain; its skew part becomes `misalignment`.
    vec_v : (3,) array
        Zero-g offset [g].
    rotation : (3, 3) array, optional
        ΔR.

    """
    symmetric, skew = (mat_w + mat_w.T) / 2, (mat_w - mat_w.T) / 2
    values = {'offset': np.array(vec_v, float), 'axis_gain': np.diag(mat_w) - 1.0,
              'cross_axis': symmetric[[0, 0, 1], [1, 2, 2]]}
    if np.any(skew):
        values['misalignment'] = skew[[2, 0, 1], [1, 2, 0]]
    return Model(values, np.eye(3) if rotation is None else rotation)


def check_context(model: Model, context: Context) -> None:
    """
    Make sure that the context holds what the effects of the model need.

    Raises
    ------
    InputError
        If a column is missing.

    """
    missing = [', '.join(COLUMNS[key].names) for key in model.needs if key not in context]
    if missing:
        raise InputError(f'the model has effects that need {" and ".join(missing)}, which is not '
                         'given', 'record it beside the readings')


def predict(model: Model, force: Floats, context: Context) -> Floats:
    """
    Say what the sensor reads.

    Parameters
    ----------
    model : Model
        The sensor.
    force : (n, 3) array
        Specific force in the levelled frame [g].
    context : mapping of str to array
        What the effects need beside the force; n rows each.

    Returns
    -------
    (n, 3) array
        Readings [g].

    """
    check_context(model, context)
    return reading_of(model, force @ model.rotation.T, context)


def reading_of(model: Model, u: Floats, context: Context) -> Floats:
    """Say what the sensor reads under the (n, 3) force u, given in its own axes [g]."""
    mat_w, vec_v = model.linear_part
    return model._leaves(vec_v + u @ mat_w.T + model._added(u, context, linear=False))


def sensor_force(model: Model, reading: Floats, context: Context) -> Floats:
    """
    Find the specific force in the axes of the sensor.

    Parameters
    ----------
    model : Model
        The sensor.
    reading : (n, 3) array
        Readings [g].
    context : mapping of str to array
        What the effects need beside the reading; n rows each.

    Returns
    -------
    (n, 3) array
        u [g].

    Raises
    ------
    InputError
        If the effects are so large that the reading belongs to no one force.

    """
    check_context(model, context)
    u = (reading - model.linear_part[1]) @ model._inverse_gain.T
    if all(EFFECTS[name].linear for name in model.values):
        return u
    linear = u
    for _ in range(LARGEST_ITERATIONS):
        before = u
        if np.max(np.abs(u), initial=0.0) > LARGEST_FORCE_G:
            break
        u = linear - model._added(u, context, linear=False) @ model._inverse_gain.T
        if np.max(np.abs(u - before), initial=0.0) < CONVERGED_G:
            return u
    raise too_large()


def too_large() -> InputError:
    """Make the error of a reading that belongs to no one force."""
    return InputError('the effects of the model are too large to be undone at this reading',
                      'calibrate again, with readings in the range in which the sensor is used')


def correct(model: Model, reading: Floats, context: Context) -> Floats:
    """
    Find the specific force from what the sensor read; the inverse of `predict`.

    Parameters
    ----------
    model : Model
        The sensor.
    reading : (n, 3) array
        Readings [g].
    context : mapping of str to array
        What the effects need beside the reading; n rows each.

    Returns
    -------
    (n, 3) array
        Specific force in the levelled frame [g].

    Raises
    ------
    InputError
        As `sensor_force`.

    """
    return sensor_force(model, reading, context) @ model.rotation


def parameter_basis(model: Model, u: Floats, context: Context) -> Floats:
    """
    Say what each value of a model does to the reading.

    Parameters
    ----------
    model : Model
        The sensor.
    u : (n, 3) array
        Force in the axes of the sensor [g].
    context : mapping of str to array
        What the effects need, n rows each.

    Returns
    -------
    (n, 3, p) array
        Derivative of the reading by each value, in the order of ``model.vector``.

    """
    parts: list[Floats] = [np.zeros((len(u), 3, 0))]
    for name, values in model.values.items():
        effect = EFFECTS[name]
        parameters, shape = effect.split(values)
        parts.append(effect.basis(u, context, shape))
        for k in range(len(shape)):  # the one derivative that is taken by difference
            step = np.zeros(len(shape))
            step[k] = 1e-4 * max(abs(shape[k]), 1.0) if effect.shape[k] == 'tau' else 0.0
            change = (effect.basis(u, context, shape + step)
                      - effect.basis(u, context, shape - step)) @ parameters
            parts.append((change / (2.0 * step[k] or 1.0))[:, :, np.newaxis])
    return np.concatenate(parts, axis=2)


def force_slope(model: Model, u: Floats, context: Context) -> Floats:
    """Give the (n, 3, 3) derivative of the reading by the force u in the axes of the sensor."""
    slope = np.broadcast_to(model.linear_part[0], (len(u), 3, 3))
    for name, values in model.values.items():
        if not EFFECTS[name].linear:
            parameters, shape = EFFECTS[name].split(values)
            slope = slope + EFFECTS[name].slope(u, context, shape, parameters)
    return slope
