# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The catalogue of effects: each adds to the reading, in proportion to its parameters.

An effect is one entry in `EFFECTS`. Simulation, fit, correction and report all read it there,
so that an entry added here works in each of them. For parameters k the reading grows by
``basis(u, context, shape) @ k`` where u is the specific force in the axes of the sensor; how it
grows with u itself is ``slope(u, context, shape, k)``, which the correction and the Jacobian of
the fit need. The values of an effect are k followed by its shape, such as a time constant, in
which it is not linear. Two effects of the output, `saturation` and `quantisation`, act on the
whole reading instead and cannot be undone.

Force, readings and the samples' standard deviation are in g, temperatures in °C. The names and
terms are those of IEEE 1293 (model equation of a linear accelerometer) and of data sheets.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .table import Floats
from .units import STANDARD_GRAVITY

Context = Mapping[str, NDArray[Any]]
Basis = Callable[[Floats, Context, Floats], Floats]
Slope = Callable[[Floats, Context, Floats, Floats], Floats]
Output = Callable[[Floats, Floats], Floats]

REFERENCE_TEMPERATURE = 25.0
"""Temperature at which temperature effects are zero [°C], as in data sheets."""

NOMINAL_SUPPLY = 3.3
"""Supply at which `supply_ratio` is zero [V]."""

HOUR = 3600.0

AXES = ('x', 'y', 'z')


@dataclass(frozen=True)
class Effect:
    """
    One named physical cause of a difference between reading and specific force.

    Parameters
    ----------
    words : str
        What it is, for a person.
    term : str
        Its name in IEEE 1293 or in data sheets.
    parameters : tuple of str
        Names of its p parameters.
    unit : str
        Unit of each parameter.
    typical : float
        Size seen in common parts, in `unit`; ten times as much deserves a remark.
    needs : tuple of str
        Keys of the context without which it can be neither seen nor corrected.
    linear : bool
        Whether it belongs to V and W: linear in u, without context.
    basis : callable
        (n, 3) force, context, (s,) shape -> (n, 3, p), the reading that a parameter of 1 adds.
    slope : callable
        (n, 3) force, context, (s,) shape, (p,) values -> (n, 3, 3), derivative of the reading by
        force.
    shape : tuple of str
        Names of its s further values, in which it is not linear, with their units.
    output : callable or None
        (n, 3) readings, (p,) values -> (n, 3) readings, for effects of the output.

    """

    words: str
    term: str
    parameters: tuple[str, ...]
    unit: str
    typical: float
    needs: tuple[str, ...]
    linear: bool
    basis: Basis
    slope: Slope
    shape: tuple[str, ...] = ()
    output: Output | None = None

    @property
    def values(self) -> tuple[str, ...]:
        """Give the names of all its values: parameters, then shape."""
        return self.parameters + self.shape

    def split(self, values: Floats) -> tuple[Floats, Floats]:
        """Part (p + s,) values into parameters and shape."""
        return values[:len(self.parameters)], values[len(self.parameters):]


def _diagonal(values: Floats) -> Floats:
    """Give (n, 3, 3) diagonal matrices of (n, 3) values."""
    return values[:, :, np.newaxis] * np.eye(3)


def _no_slope(u: Floats, context: Context, shape: Floats, values: Floats) -> Floats:
    return np.zeros((len(u), 3, 3))


def _constant(words: str, term: str, typical: float, needs: tuple[str, ...] = (),
              factor: Callable[[Context, Floats], Floats] | None = None, unit: str = 'g',
              shape_names: tuple[str, ...] = ()) -> Effect:
    """Make an effect that adds the same whatever the force."""
    def basis(u: Floats, context: Context, shape: Floats) -> Floats:
        factors = 1.0 if factor is None else factor(context, shape)
        return _diagonal(np.ones_like(u) * factors)

    return Effect(words, term, AXES, unit, typical, needs, factor is None, basis, _no_slope,
                  shape_names)


def _matrix(words: str, term: str, typical: float, parameters: tuple[str, ...],
            matrices: Any) -> Effect:
    """Make an effect that adds a matrix times force; one (3, 3) matrix a parameter."""
    mats = np.array(matrices, float)

    def basis(u: Floats, context: Context, shape: Floats) -> Floats:
        added: Floats = np.einsum('pij,nj->nip', mats, u)
        return added

    def slope(u: Floats, context: Context, shape: Floats, values: Floats) -> Floats:
        return np.broadcast_to(np.tensordot(values, mats, 1), (len(u), 3, 3))

    return Effect(words, term, parameters, 'g/g', typical, (), True, basis, slope)


def _by_axis(words: str, term: str, typical: float, unit: str,
             bend: Callable[[Floats], Floats], derivative: Callable[[Floats], Floats],
             needs: tuple[str, ...] = (),
             factor: Callable[[Context], Floats] | None = None) -> Effect:
    """Make an effect in which each axis bends by a function of its own force."""
    def scale(context: Context) -> Floats | float:
        return 1.0 if factor is None else factor(context)

    def basis(u: Floats, context: Context, shape: Floats) -> Floats:
        return _diagonal(bend(u) * scale(context))

    def slope(u: Floats, context: Context, shape: Floats, values: Floats) -> Floats:
        return _diagonal(values * derivative(u) * scale(context))

    return Effect(words, term, AXES, unit, typical, needs, False, basis, slope)


def _column(context: Context, key: str) -> Floats:
    """Give a quantity of the context as (n, 1)."""
    return np.asarray(context[key], float)[:, np.newaxis]


def _warming(context: Context) -> Floats:
    """Give the (n, 1) temperature above the reference."""
    return _column(context, 'temperature') - REFERENCE_TEMPERATURE


def _variance(context: Context, shape: Floats) -> Floats:
    """Give the (n, 3) variance of the samples of each pose [g²]."""
    return np.asarray(context['std'], float) ** 2


def _since(context: Context, shape: Floats) -> Floats:
    """Give the (n, 1) time since the start [h]."""
    return (_column(context, 'time') - shape[0]) / HOUR


def _cooling(context: Context, shape: Floats) -> Floats:
    """Give exp(-(t - start) / tau), (n, 1)."""
    start, tau = shape
    return np.exp(-np.maximum(_column(context, 'time') - start, 0.0) / max(tau, 1e-9))


def _after(context: Context, shape: Floats) -> Floats:
    """Give 1 from the instant on, (n, 1)."""
    return (_column(context, 'time') >= shape[0]).astype(float)


def _approach(context: Context, shape: Floats) -> Floats:
    """Give the (n, 3) unit vector from the pose before, seen from this one."""
    return np.asarray(context['approach'], float)


def _supply_basis(u: Floats, context: Context, shape: Floats) -> Floats:
    change = _column(context, 'supply_voltage') / NOMINAL_SUPPLY - 1.0
    return np.concatenate([(u * change)[:, :, np.newaxis], _diagonal(np.ones_like(u) * change)],
                          axis=2)


def _supply_slope(u: Floats, context: Context, shape: Floats, values: Floats) -> Floats:
    change = _column(context, 'supply_voltage') / NOMINAL_SUPPLY - 1.0
    return _diagonal(np.ones_like(u) * change * values[0])


def _lever_basis(u: Floats, context: Context, shape: Floats) -> Floats:
    """Give ω×(ω×r) per metre, in g."""
    rate = np.asarray(context['rate'], float)
    outer = rate[:, :, np.newaxis] * rate[:, np.newaxis, :]
    squared = np.sum(rate ** 2, axis=1)[:, np.newaxis, np.newaxis]
    return (outer - squared * np.eye(3)) / STANDARD_GRAVITY


def _nothing(u: Floats, context: Context, shape: Floats) -> Floats:
    return np.zeros((len(u), 3, 1))


def _clipped(reading: Floats, values: Floats) -> Floats:
    return np.clip(reading, -values[0], values[0])


def _on_a_grid(reading: Floats, values: Floats) -> Floats:
    return np.round(reading / values[0]) * values[0]


_COUPLED = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))


def _coupling_basis(u: Floats, context: Context, shape: Floats) -> Floats:
    basis = np.zeros((len(u), 3, len(_COUPLED)))
    for k, (i, j) in enumerate(_COUPLED):
        basis[:, i, k] = u[:, i] * u[:, j]
    return basis


def _coupling_slope(u: Floats, context: Context, shape: Floats, values: Floats) -> Floats:
    slope = np.zeros((len(u), 3, 3))
    for value, (i, j) in zip(values, _COUPLED, strict=True):
        slope[:, i, i] += value * u[:, j]
        slope[:, i, j] += value * u[:, i]
    return slope


def _unit(i: int, j: int, other: float = 0.0) -> Floats:
    """Give a matrix with 1 at (i, j) and `other` at (j, i)."""
    matrix = np.zeros((3, 3))
    matrix[i, j] = 1.0
    if i != j:
        matrix[j, i] = other
    return matrix


EFFECTS: dict[str, Effect] = {
    'offset': _constant('zero-g offset', 'bias K0, zero-g offset', 0.1),
    'gain': _matrix('one gain for all axes', 'scale factor K1, sensitivity', 0.03, ('all',),
                    [np.eye(3)]),
    'axis_gain': _matrix('gain of each axis', 'scale factor K1, sensitivity', 0.03, AXES,
                         [_unit(i, i) for i in range(3)]),
    'cross_axis': _matrix('cross-axis gain, symmetric', 'cross-axis sensitivity', 0.02,
                          ('xy', 'xz', 'yz'),
                          [_unit(0, 1, 1), _unit(0, 2, 1), _unit(1, 2, 1)]),
    'misalignment': _matrix('rotation of the sensing axes', 'input-axis misalignment', 0.02, AXES,
                            [_unit(2, 1, -1), _unit(0, 2, -1), _unit(1, 0, -1)]),
    'quadratic': _by_axis('square of the force', 'second-order coefficient K2', 0.001, 'g/g²',
                          np.square, lambda u: 2 * u),
    'cubic': _by_axis('cube of the force', 'third-order coefficient K3', 0.001, 'g/g³',
                      lambda u: u ** 3, lambda u: 3 * u ** 2),
    'odd_quadratic': _by_axis('force times its size', 'odd quadratic coefficient Koq', 0.001,
                              'g/g²', lambda u: u * np.abs(u), lambda u: 2 * np.abs(u)),
    'gain_asymmetry': _by_axis('gain that differs by direction', 'scale-factor asymmetry', 0.002,
                               'g/g', np.abs, np.sign),
    'cross_coupling': Effect('product of two axes', 'cross-coupling coefficients Kip, Kio',
                             tuple(f'{AXES[i]}_{AXES[i]}{AXES[j]}' for i, j in _COUPLED),
                             'g/g²', 0.001, (), False, _coupling_basis, _coupling_slope),
    'offset_temperature': _constant('offset that moves with temperature',
                                    'zero-g offset temperature coefficient TCO', 0.001,
                                    ('temperature',), lambda c, shape: _warming(c), 'g/°C'),
    'gain_temperature': _by_axis('gain that moves with temperature',
                                 'sensitivity temperature coefficient TCS', 0.0003, '1/°C',
                                 lambda u: u, np.ones_like, ('temperature',), _warming),
    'supply_ratio': Effect('offset and gain that follow the supply', 'ratiometric output',
                           ('gain', *AXES), 'g/g', 1.0, ('supply_voltage',), False,
                           _supply_basis, _supply_slope),
    'offset_drift': _constant('offset that drifts with time', 'bias drift', 0.0005, ('time',),
                              _since, 'g/h', ('start',)),
    'warm_up': _constant('offset that settles after switching on', 'turn-on transient', 0.005,
                         ('time',), _cooling, 'g', ('start', 'tau')),
    'offset_step': _constant('offset that jumped at an instant', 'bias shift after shock', 0.005,
                             ('time',), _after, 'g', ('instant',)),
    'vibration_rectification': _constant('offset that grows with vibration',
                                         'vibration rectification coefficient VRC', 0.002,
                                         ('std',), _variance, 'g/g²'),
    'hysteresis': _constant('offset that depends on the pose before', 'hysteresis', 0.001,
                            ('approach',), _approach, 'g'),
    'lever_arm': Effect('force of turning, away from the axis', 'size effect', AXES, 'm', 0.1,
                        ('rate',), False, _lever_basis, _no_slope),
    'saturation': Effect('readings that end at a limit', 'full-scale range', ('limit',), 'g', 2.0,
                         (), False, _nothing, _no_slope, output=_clipped),
    'quantisation': Effect('readings on a grid', 'resolution', ('step',), 'g', 0.001, (), False,
                           _nothing, _no_slope, output=_on_a_grid),
}
"""`offset_wander`, a random walk, is no function of its context and so not here; see
`accel_calib.refine`."""
