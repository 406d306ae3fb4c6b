# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the effects of a model add to one reading, in plain floats; for `accel_calib.plain`.

What an effect is, `accel_calib.effects` says, for arrays; a test holds each effect here to it.
Effects of the output, which cannot be undone, add nothing.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import Any, NamedTuple

from .effects import EFFECTS, HOUR, NOMINAL_SUPPLY, REFERENCE_TEMPERATURE
from .table import Floats
from .units import STANDARD_GRAVITY

Triple = tuple[float, float, float]
Rows = tuple[list[float], list[float], list[float]]
"""Three rows, one an axis, with a number for each value of an effect, or for each axis."""

PlainContext = Mapping[str, Any]
"""What is known beside a reading: floats and triples, with the keys of `effects.Context`."""

_ZERO: Triple = (0.0, 0.0, 0.0)


class PlainEffect(NamedTuple):
    """
    An effect with its values.

    Parameters
    ----------
    constant : bool
        Whether what it adds is the same for every force.
    added : callable
        Force, context -> what it adds to the reading.
    basis : callable
        Force, context -> derivative by each of its values.
    slope : callable
        Force, context -> derivative by force; None: zero.

    """

    constant: bool
    added: Callable[[Triple, PlainContext], Triple]
    basis: Callable[[Triple, PlainContext], Rows]
    slope: Callable[[Triple, PlainContext], Rows] | None = None


def _diagonal(x: float, y: float, z: float) -> Rows:
    return [x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]


def _shift(values: list[float], factor: Callable[[PlainContext, list[float]], Triple]
           ) -> PlainEffect:
    """Make an effect that adds three values times factors, whatever the force."""
    (a, b, c), shape = values[:3], values[3:]

    def added(u: Triple, context: PlainContext) -> Triple:
        x, y, z = factor(context, shape)
        return a * x, b * y, c * z

    def basis(u: Triple, context: PlainContext) -> Rows:
        rows = _diagonal(*factor(context, shape))
        for k in range(len(shape)):
            step = 0.0
            if k == 1:  # tau, by difference, as `model.parameter_basis` does
                step = 1e-4 * max(abs(shape[k]), 1.0)
            ahead, behind = (factor(context, [*shape[:k], shape[k] + way, *shape[k + 1:]])
                             for way in (step, -step))
            for row, value, high, low in zip(rows, values, ahead, behind):
                row.append(value * (high - low) / (2.0 * step or 1.0))
        return rows

    return PlainEffect(True, added, basis)


def _bend(values: list[float], bend: Callable[[float], float],
          derivative: Callable[[float], float], warmed: bool = False) -> PlainEffect:
    """Make an effect in which each axis bends by its own force."""
    a, b, c = values

    def added(u: Triple, context: PlainContext) -> Triple:
        s = context['temperature'] - REFERENCE_TEMPERATURE if warmed else 1.0
        return a * s * bend(u[0]), b * s * bend(u[1]), c * s * bend(u[2])

    def basis(u: Triple, context: PlainContext) -> Rows:
        s = context['temperature'] - REFERENCE_TEMPERATURE if warmed else 1.0
        return _diagonal(s * bend(u[0]), s * bend(u[1]), s * bend(u[2]))

    def slope(u: Triple, context: PlainContext) -> Rows:
        s = context['temperature'] - REFERENCE_TEMPERATURE if warmed else 1.0
        return _diagonal(a * s * derivative(u[0]), b * s * derivative(u[1]),
                         c * s * derivative(u[2]))

    return PlainEffect(False, added, basis, slope)


def _coupling(values: list[float]) -> PlainEffect:
    """Make the effect of products of two axes: xy, xz, yx, yz, zx, zy."""
    a, b, c, d, e, f = values

    def added(u: Triple, context: PlainContext) -> Triple:
        x, y, z = u
        return x * (a * y + b * z), y * (c * x + d * z), z * (e * x + f * y)

    def basis(u: Triple, context: PlainContext) -> Rows:
        x, y, z = u
        return ([x * y, x * z, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, y * x, y * z, 0.0, 0.0],
                [0.0, 0.0, 0.0, 0.0, z * x, z * y])

    def slope(u: Triple, context: PlainContext) -> Rows:
        x, y, z = u
        return ([a * y + b * z, a * x, b * x], [c * y, c * x + d * z, d * y],
                [e * z, f * z, e * x + f * y])

    return PlainEffect(False, added, basis, slope)


def _supply(values: list[float]) -> PlainEffect:
    """Make the effect of a ratiometric output: of the gain, then of the offsets."""
    gain, a, b, c = values

    def change(context: PlainContext) -> float:
        return float(context['supply_voltage']) / NOMINAL_SUPPLY - 1.0

    def added(u: Triple, context: PlainContext) -> Triple:
        s = change(context)
        return s * (gain * u[0] + a), s * (gain * u[1] + b), s * (gain * u[2] + c)

    def basis(u: Triple, context: PlainContext) -> Rows:
        s = change(context)
        return [u[0] * s, s, 0.0, 0.0], [u[1] * s, 0.0, s, 0.0], [u[2] * s, 0.0, 0.0, s]

    def slope(u: Triple, context: PlainContext) -> Rows:
        s = change(context) * gain
        return _diagonal(s, s, s)

    return PlainEffect(False, added, basis, slope)


def _lever(values: list[float]) -> PlainEffect:
    """Make the effect of turning about another point."""
    a, b, c = values

    def basis(u: Triple, context: PlainContext) -> Rows:
        x, y, z = context['rate']
        per_g = 1.0 / STANDARD_GRAVITY
        xx, yy, zz = x * x * per_g, y * y * per_g, z * z * per_g
        xy, xz, yz = x * y * per_g, x * z * per_g, y * z * per_g
        return [-yy - zz, xy, xz], [xy, -xx - zz, yz], [xz, yz, -xx - yy]

    def added(u: Triple, context: PlainContext) -> Triple:
        (p, q, r), (s, t, v), (w, m, n) = basis(u, context)
        return p * a + q * b + r * c, s * a + t * b + v * c, w * a + m * b + n * c

    return PlainEffect(True, added, basis)


def _nothing(values: list[float]) -> PlainEffect:
    """Make an effect of the output."""
    return PlainEffect(True, lambda u, context: _ZERO, lambda u, context: ([0.0], [0.0], [0.0]))


def _same(value: float) -> Triple:
    return value, value, value


def _warm_up(context: PlainContext, shape: list[float]) -> Triple:
    start, tau = shape
    return _same(math.exp(-max(context['time'] - start, 0.0) / max(tau, 1e-9)))


def _squares(context: PlainContext, shape: list[float]) -> Triple:
    x, y, z = context['std']
    return x * x, y * y, z * z


_MAKERS: dict[str, Callable[[list[float]], PlainEffect]] = {
    'quadratic': lambda k: _bend(k, lambda u: u * u, lambda u: 2.0 * u),
    'cubic': lambda k: _bend(k, lambda u: u * u * u, lambda u: 3.0 * u * u),
    'odd_quadratic': lambda k: _bend(k, lambda u: u * abs(u), lambda u: 2.0 * abs(u)),
    'gain_asymmetry': lambda k: _bend(k, abs, lambda u: float((u > 0.0) - (u < 0.0))),
    'cross_coupling': _coupling,
    'offset_temperature': lambda k: _shift(
        k, lambda known, shape: _same(known['temperature'] - REFERENCE_TEMPERATURE)),
    'gain_temperature': lambda k: _bend(k, lambda u: u, lambda u: 1.0, warmed=True),
    'supply_ratio': _supply,
    'offset_drift': lambda k: _shift(
        k, lambda known, shape: _same((known['time'] - shape[0]) / HOUR)),
    'warm_up': lambda k: _shift(k, _warm_up),
    'offset_step': lambda k: _shift(
        k, lambda known, shape: _same(float(known['time'] >= shape[0]))),
    'vibration_rectification': lambda k: _shift(k, _squares),
    'hysteresis': lambda k: _shift(k, lambda known, shape: known['approach']),
    'lever_arm': _lever,
    'saturation': _nothing,
    'quantisation': _nothing,
}


def plain_effect(name: str, values: Floats) -> PlainEffect | None:
    """Give an effect that is not linear with its values; None where it is not known here."""
    maker = None if EFFECTS[name].linear else _MAKERS.get(name)
    return None if maker is None else maker([float(value) for value in values])
