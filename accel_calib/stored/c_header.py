# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
C and Arduino headers: one function in single precision that corrects a reading.

The steady model (`made`) has an offset V, a gain W and bending terms, each a polynomial in the
temperature. With s the temperature scaled to -1 to 1 over the range of the poses, the function
computes

    d = (raw - V(s)) / per_g
    u = W(0)⁻¹ (d - (W(s) - W(0)) u - bend(s, u)),   repeated from u = W(0)⁻¹ d
    force = ΔRᵀ u force_per_g

Without temperature and bending terms this is force = M (raw - B). The number of repetitions is the
smallest one after which u changes by less than the precision of a float.

"""

from dataclasses import dataclass, replace
import re

import numpy as np
from numpy.typing import NDArray

from .made import (
    frame_words, literal, Made, Options, polynomial, single, steady_at, steady_grid,
    temperature_range)
from ..calibration import Calibration
from ..effects import (
    CUBE, MONOMIALS, ODD_SQUARE, PRODUCT, REFERENCE_TEMPERATURE, SIZE, SQUARE, WAVE, ZONAL, ZONES)
from ..errors import InputError
from ..table import Floats

_LARGEST_DEGREE = 10
_SMALL_G = 1e-7
"""Polynomials and repetitions are exact to this [g], the precision of a float."""

_NOTHING_G = 1e-10
"""Smaller coefficients are rounding errors."""

_LARGEST_STEPS = 20
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,40}')
_BEYOND = 2.0
"""The repetitions converge for forces up to this [g]."""


@dataclass(frozen=True)
class Header:
    """
    The numbers of a header, in single precision.

    The polynomials in s = (temperature - middle) / half have the constant first: `vec_v` (k, 3) in
    the unit of the readings, `mat_w` (k, 3, 3), and `bend` (k, b) [g], the coefficients of the
    bending terms. `monomial` and `axis` (b,) are the function and the axis of each bending term.
    `inverse` is W(0)⁻¹, `turn` is ΔRᵀ times the force per g, and `steps` counts the repetitions.

    """

    vec_v: Floats
    mat_w: Floats
    bend: Floats
    monomial: NDArray[np.intp]
    axis: NDArray[np.intp]
    inverse: Floats
    turn: Floats
    per_g: float
    middle: float
    half: float
    steps: int

    @property
    def is_affine(self) -> bool:
        """Whether force = M (raw - B)."""
        return not self.of_temperature and not len(self.axis)

    @property
    def of_temperature(self) -> bool:
        """Whether the correction depends on the temperature."""
        return max(len(self.vec_v), len(self.mat_w), len(self.bend)) > 1

    @property
    def matrix(self) -> Floats:
        """M of an affine header, (3, 3)."""
        return self.turn @ self.inverse / self.per_g

    def force(self, reading: Floats, temperature: Floats) -> Floats:
        """Return the (n, 3) force in the unit of the header, by its equations."""
        if self.is_affine:
            return (reading - self.vec_v[0]) @ single(self.matrix).T
        s = (np.clip(temperature, self.middle - self.half, self.middle + self.half)
             - self.middle) / self.half
        d = (reading - _value(self.vec_v, s)) / self.per_g
        change = np.concatenate([np.zeros((1, 3, 3)), self.mat_w[1:]])
        gain, bend = _value(change, s), _value(self.bend, s)
        u = d @ self.inverse.T
        for _ in range(self.steps):
            added = np.einsum('nij,nj->ni', gain, u)
            for k, (monomial, axis) in enumerate(zip(self.monomial, self.axis)):
                added[:, axis] += bend[:, k] * MONOMIALS[monomial].value(*u.T)
            u = (d - added) @ self.inverse.T
        return u @ self.turn.T


def _value(polynomial: Floats, s: Floats) -> Floats:
    """Return a (k, ...) polynomial at (n,) values; without s for a constant."""
    powers = s[:, np.newaxis] ** np.arange(len(polynomial))
    return np.tensordot(powers, polynomial, 1)


def _header_of(calibration: Calibration) -> Header:
    """Return the numbers of a header, with as many repetitions as it needs."""
    low, high = temperature_range(calibration) or (REFERENCE_TEMPERATURE,) * 2
    middle, half = (low + high) / 2.0, max((high - low) / 2.0, 1e-3)
    count, units = 4 * _LARGEST_DEGREE, calibration.units
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    here = steady_at(calibration, middle + half * nodes)
    vec_v, mat_w, bend = (polynomial(nodes, values, 0.1 * _SMALL_G, _LARGEST_DEGREE)
                          for values in (np.broadcast_to(here.vec_v, (count, 3)),
                                         np.broadcast_to(here.mat_w, (count, 3, 3)),
                                         np.broadcast_to(here.bend, (len(here.bend), count)).T))
    for part in (vec_v, mat_w, bend):
        part[np.abs(part) < _NOTHING_G] = 0.0
    terms, which = here.terms, here.terms.bending
    found = Header(
        vec_v=single(units.from_g(vec_v)), mat_w=single(mat_w), bend=single(bend),
        monomial=np.array(terms.monomials, np.intp)[terms.place[which]], axis=terms.axis[which],
        inverse=single(np.linalg.inv(mat_w[0])),
        turn=single(calibration.rotation.T * calibration.force_per_g),
        per_g=float(np.float32(units.per_g)), middle=float(np.float32(middle)),
        half=float(np.float32(half)), steps=0)
    if found.is_affine:
        return found
    grid = steady_grid(calibration, 3, _BEYOND)
    before = found.force(grid.reading, grid.temperature)
    for steps in range(1, _LARGEST_STEPS + 1):
        found = replace(found, steps=steps)
        after = found.force(grid.reading, grid.temperature)
        if np.max(np.abs(after - before)) < _SMALL_G * calibration.force_per_g:
            return found
        before = after
    return found


def header(calibration: Calibration, options: Options) -> Made:
    """Return the values of a header for C99 and C++, or for a sketch."""
    if own := calibration.model.terms.of_force:
        raise InputError(f'the calibration has an own effect of the force ({own[0]}), which has '
                         'no code in C', 'refine without --also, or write this correction by hand')
    made, name = _header_of(calibration), name_of(calibration, options)
    degrees = sorted({ZONES[(index - ZONAL) // 3].degree
                      for index in made.monomial.tolist() if index >= ZONAL})
    values = {
        'name': name, 'roots': bool(np.any(made.monomial >= WAVE)),
        'M': _array('M', made.matrix) if made.is_affine else '', 'B': _array('B', made.vec_v[0]),
        'N': _array('N', made.inverse), 'R': _array('R', made.turn), 'steps': made.steps,
        'V': [_horner(column) for column in made.vec_v.T], 'per_unit': 1.0 / made.per_g,
        'bend': [_added(made, axis, name) for axis in range(3)],
        'legendre': [(degree, _horner(np.array(next(
            zone.polynomial for zone in ZONES if zone.degree == degree)))) for degree in degrees],
        'unit': 'm/s^2' if calibration.units.is_si else 'g', 'frame': frame_words(calibration),
        's': {'unknown': REFERENCE_TEMPERATURE, 'middle': _signed(made.middle),
              'low': made.middle - made.half, 'high': made.middle + made.half,
              'per_half': 1.0 / made.half} if made.of_temperature else None}
    return Made(values, lambda reading, temperature: (
        made.force(reading, temperature) / calibration.force_per_g), True)


def name_of(calibration: Calibration, options: Options) -> str:
    """Return the name of the functions; raise InputError if the one asked for is none in C."""
    if options.name and not _NAME.fullmatch(options.name):
        raise InputError(f'the name is {options.name!r}, expected a letter, and then at most '
                         '40 letters, digits or _', 'choose a name such as imu_left')
    return options.name or identifier(calibration.sensor)


def identifier(text: str) -> str:
    """Return a C identifier made from any text."""
    parts = re.findall('[a-z0-9]+', text.lower())
    name = '_'.join(parts)[:40].rstrip('_')
    return name if name[:1].isalpha() else f'accel_{name}'.rstrip('_')


def _array(kind: str, values: Floats) -> str:
    """Return the definition of a C array of one or two dimensions."""
    sizes = ''.join(f'[{size}]' for size in values.shape)
    parts = ([f'{{{", ".join(map(literal, row))}}}' for row in values] if values.ndim == 2
             else list(map(literal, values)))
    start = f'    static const float {kind}{sizes} = '
    text = f'{start}{{{", ".join(parts)}}};'
    if len(text) <= 99:
        return text
    lines = ',\n        '.join(parts)
    return f'{start}{{\n        {lines}}};'


def _signed(value: float) -> str:
    """Return a literal, in brackets if it is negative."""
    return f'({literal(value)})' if value < 0 else literal(value)


def _horner(polynomial: Floats) -> str:
    """Return the C expression of a polynomial in s, in brackets if it has more than one part."""
    kept = np.trim_zeros(polynomial, 'b')
    text = _signed(kept[-1]) if len(kept) else '0.0f'
    for value in kept[-2::-1]:
        text = f'({_signed(value)} + s * {text})' if value else f's * {text}'
    return text


def _added(header: Header, axis: int, name: str) -> str:
    """Return the C terms that are taken from d of an axis."""
    parts = []
    for column in range(3):
        change = np.append(0.0, header.mat_w[1:, axis, column])
        if np.any(change):
            parts.append(f'{_horner(change)} * u[{column}]')
    for k in np.flatnonzero(header.axis == axis):
        if np.any(header.bend[:, k]):
            parts.append(f'{_horner(header.bend[:, k])} * '
                         f'{_monomial(int(header.monomial[k]), name)}')
    return ''.join(f'\n            - {part}' for part in parts)


def _monomial(index: int, name: str) -> str:
    x, size = (f'u[{(index - SQUARE) % 3}]', '({0} < 0.0f ? -{0} : {0})')
    if index >= ZONAL:
        number, axis = divmod(index - ZONAL, 3)
        cosine = ' + '.join(f'{_signed(towards)} * v[{k}]'
                            for k, towards in enumerate(ZONES[number].towards))
        return f'u[{axis}] * {name}_p{ZONES[number].degree}({cosine})'
    if index >= WAVE:
        mode, axis = divmod(index - WAVE, 3)
        x = f'u[{axis}]'
        held = f'({x} < -1.0f ? -1.0f : ({x} > 1.0f ? 1.0f : {x}))'
        return f'cosf({literal((mode + 1) * np.pi / 2.0)} * ({held} + 1.0f))'
    if index >= PRODUCT:
        one, two = ((0, 1), (0, 2), (1, 2))[index - PRODUCT]
        return f'u[{one}] * u[{two}]'
    if index >= SIZE:
        return size.format(x)
    if index >= ODD_SQUARE:
        return f'{x} * {size.format(x)}'
    return f'{x} * {x} * {x}' if index >= CUBE else f'{x} * {x}'
