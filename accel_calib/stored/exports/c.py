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

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import re

import numpy as np
from numpy.typing import NDArray

from .made import about, frame_words, Made, Options, steady_at, steady_grid, temperature_range
from ...calibrate import Calibration
from ...effects import (
    CUBE,
    MONOMIALS,
    ODD_SQUARE,
    PRODUCT,
    REFERENCE_TEMPERATURE,
    SIZE,
    SQUARE,
    WAVE,
)
from ...errors import InputError
from ...table import Floats

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

    Parameters
    ----------
    vec_v : (k, 3) array
        Polynomial of the offset in s, the constant first, in the unit of the readings.
    mat_w : (k, 3, 3) array
        Polynomial of the gain in s.
    bend : (k, b) array
        Polynomials of the coefficients of the bending terms in s [g].
    monomial, axis : (b,) array of int
        Function and axis of each bending term.
    inverse : (3, 3) array
        W(0)⁻¹.
    turn : (3, 3) array
        ΔRᵀ times the force per g.
    per_g : float
        Reading per g.
    middle, half : float
        s = (temperature - middle) / half [°C].
    steps : int
        Number of repetitions.

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
        """M, (3, 3)."""
        return self.turn @ self.inverse / self.per_g

    def force(self, reading: Floats, temperature: Floats) -> Floats:
        """Return the (n, 3) force in the unit of the header, by its equations."""
        if self.is_affine:
            return (reading - self.vec_v[0]) @ _single(self.matrix).T
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


def _single(values: Floats) -> Floats:
    return np.asarray(values, np.float32).astype(float)


def header_of(calibration: Calibration) -> Header:
    """Return the numbers of the header of a calibration."""
    low, high = temperature_range(calibration) or (REFERENCE_TEMPERATURE,) * 2
    middle, half = (low + high) / 2.0, max((high - low) / 2.0, 1e-3)
    nodes = np.cos(np.pi * (np.arange(4 * _LARGEST_DEGREE) + 0.5) / (4 * _LARGEST_DEGREE))
    here = steady_at(calibration, middle + half * nodes)
    count, units = len(nodes), calibration.units
    mat_w = _polynomial(nodes, np.broadcast_to(here.mat_w, (count, 3, 3)))
    bend = _polynomial(nodes, np.broadcast_to(here.bend, (len(here.bend), count)).T)
    vec_v = _polynomial(nodes, np.broadcast_to(here.vec_v, (count, 3)))
    terms, which = here.terms, here.terms.bending
    made = Header(
        vec_v=_single(units.from_g(vec_v)), mat_w=_single(mat_w), bend=_single(bend),
        monomial=np.array(terms.monomials, np.intp)[terms.place[which]], axis=terms.axis[which],
        inverse=_single(np.linalg.inv(mat_w[0])),
        turn=_single(calibration.rotation.T * calibration.force_per_g),
        per_g=float(np.float32(units.per_g)), middle=float(np.float32(middle)),
        half=float(np.float32(half)), steps=0)
    return made if made.is_affine else _with_steps(made, calibration)


def _polynomial(nodes: Floats, values: Floats) -> Floats:
    """Return the (k, ...) polynomial of the smallest degree through (n, ...) values at nodes."""
    flat = values.reshape(len(nodes), -1)
    for degree in range(_LARGEST_DEGREE + 1):
        powers = nodes[:, np.newaxis] ** np.arange(degree + 1)
        found = np.linalg.lstsq(powers, flat, rcond=None)[0]
        if not flat.size or np.max(np.abs(powers @ found - flat)) < 0.1 * _SMALL_G:
            break
    found[np.abs(found) < _NOTHING_G] = 0.0
    return found.reshape(len(found), *values.shape[1:])


def _with_steps(header: Header, calibration: Calibration) -> Header:
    """Return the header with as many repetitions as it needs."""
    grid = steady_grid(calibration, 3, _BEYOND)
    before = header.force(grid.reading, grid.temperature)
    for steps in range(1, _LARGEST_STEPS + 1):
        found = replace(header, steps=steps)
        after = found.force(grid.reading, grid.temperature)
        if np.max(np.abs(after - before)) < _SMALL_G * calibration.force_per_g:
            return found
        before = after
    return found


def make_c(calibration: Calibration, options: Options) -> Made:
    """Return a C99 header, which is C++, too."""
    return _make(calibration, options, _C_USE)


def make_arduino(calibration: Calibration, options: Options) -> Made:
    """Return a header for an Arduino sketch."""
    return _make(calibration, options, _ARDUINO_USE)


_C_USE = ('use:', '  float raw[3], force[3];', '  {name}_apply(raw, {temperature}force);')
_ARDUINO_USE = (
    'use: save this file beside the sketch, and write',
    '  #include "{name}.h"',
    '  void loop() {{',
    '    float raw[3] = {{imu.x(), imu.y(), imu.z()}};  // as in the log of the calibration',
    '    float force[3];',
    '    {name}_apply(raw, {temperature}force);',
    '  }}')


def _make(calibration: Calibration, options: Options, use: Sequence[str]) -> Made:
    name = _name_of(calibration, options)
    header = header_of(calibration)
    per_g = calibration.force_per_g
    return Made(_text(header, calibration, name, use),
                lambda reading, temperature: header.force(reading, temperature) / per_g, True)


def _name_of(calibration: Calibration, options: Options) -> str:
    """
    Return the name of the functions, a C identifier.

    Raises
    ------
    InputError
        If the name that was asked for is none.

    """
    if options.name:
        if not _NAME.fullmatch(options.name):
            raise InputError(f'the name is {options.name!r}, expected a letter, and then at most '
                             '40 letters, digits or _', 'choose a name such as imu_left')
        return options.name
    return identifier(calibration.sensor)


def identifier(text: str) -> str:
    """Return a C identifier made from any text."""
    parts = re.findall('[a-z0-9]+', text.lower())
    name = '_'.join(parts)[:40].rstrip('_')
    return name if name[:1].isalpha() else f'accel_{name}'.rstrip('_')


def _text(header: Header, calibration: Calibration, name: str, use: Sequence[str]) -> str:
    unit = 'm/s^2' if calibration.units.is_si else 'g'
    temperature = 'temperature, ' if header.of_temperature else ''
    comment = ['Calibration of an accelerometer, written by accel-calib export.', '',
               *about(calibration), '',
               f'force: {unit}, {frame_words(calibration, True)}; at rest +1 g on the axis that '
               'points up', *_equation(header), '',
               *(line.format(name=name, temperature=temperature) for line in use)]
    guard = f'ACCEL_CALIB_{name.upper()}_H'
    lines = ['/*', *(f' * {line}'.rstrip() for line in comment), ' */', f'#ifndef {guard}',
             f'#define {guard}', '', *_includes(header),
             f'/* 1 if {name}_apply takes the temperature [degC] */',
             f'#define {name.upper()}_NEEDS_TEMPERATURE {int(header.of_temperature)}', '',
             *(_affine(header, name) if header.is_affine else _general(header, name)), '',
             f'#endif /* {guard} */']
    return '\n'.join(lines) + '\n'


def _equation(header: Header) -> list[str]:
    if header.is_affine:
        return ['equation: force = M (raw - B)']
    lines = ['equation: force = R u, u = N ((raw - V(s)) / per_g - (W(s) - W(0)) u - bend(u))']
    if header.of_temperature:
        low, high = header.middle - header.half, header.middle + header.half
        lines.append(f's is the temperature, limited to {low:.6g} to {high:.6g} degC, scaled to '
                     '-1 to 1')
    return lines


def _includes(header: Header) -> list[str]:
    return ['#include <math.h>', ''] if np.any(header.monomial >= WAVE) else []


def literal(value: float) -> str:
    """Return a C literal of a float."""
    text = str(np.float32(value))
    return f'{text}f' if set('.e') & set(text) else f'{text}.0f'


def _array(kind: str, values: Floats) -> str:
    """Return the definition of a C array of one or two dimensions."""
    sizes = ''.join(f'[{size}]' for size in values.shape)
    rows = [', '.join(map(literal, row)) for row in np.atleast_2d(values)]
    inner = '{' + '}, {'.join(rows) + '}'
    body = f'{{{inner}}}' if values.ndim == 2 else inner
    text = f'    static const float {kind}{sizes} = {body};'
    if len(text) <= 99:
        return text
    joined = '},\n        {'.join(rows) if values.ndim == 2 else ',\n        '.join(
        map(literal, values))
    return (f'    static const float {kind}{sizes} = {{\n        '
            + (f'{{{joined}}}}};' if values.ndim == 2 else f'{joined}}};'))


def _affine(header: Header, name: str) -> list[str]:
    return [f'static inline void {name}_apply(const float raw[3], float force[3])', '{',
            _array('M', header.matrix), _array('B', header.vec_v[0]),
            '    const float x = raw[0] - B[0], y = raw[1] - B[1], z = raw[2] - B[2];',
            '    int i;', '',
            '    for (i = 0; i < 3; ++i) {',
            '        force[i] = M[i][0] * x + M[i][1] * y + M[i][2] * z;', '    }', '}']


def _general(header: Header, name: str) -> list[str]:
    temperature = 'float temperature, ' if header.of_temperature else ''
    return [f'static inline void {name}_apply(const float raw[3], {temperature}float force[3])',
            '{', _array('N', header.inverse), _array('R', header.turn),
            *_scaled_temperature(header),
            f'    const float per_unit = {literal(1.0 / header.per_g)};',
            '    float d[3], e[3], u[3];', '    int i, step;', '',
            *(f'    d[{axis}] = (raw[{axis}] - {_horner(header.vec_v[:, axis])}) * per_unit;'
              for axis in range(3)),
            '    for (i = 0; i < 3; ++i) {',
            '        u[i] = N[i][0] * d[0] + N[i][1] * d[1] + N[i][2] * d[2];', '    }',
            f'    for (step = 0; step < {header.steps}; ++step) {{',
            *(f'        e[{axis}] = d[{axis}]{_added(header, axis)};' for axis in range(3)),
            '        for (i = 0; i < 3; ++i) {',
            '            u[i] = N[i][0] * e[0] + N[i][1] * e[1] + N[i][2] * e[2];', '        }',
            '    }', '    for (i = 0; i < 3; ++i) {',
            '        force[i] = R[i][0] * u[0] + R[i][1] * u[1] + R[i][2] * u[2];', '    }', '}']


def _scaled_temperature(header: Header) -> list[str]:
    """Return the lines that compute s; a temperature that is NaN counts as the reference."""
    if not header.of_temperature:
        return []
    low, high = (literal(header.middle + sign * header.half) for sign in (-1.0, 1.0))
    unknown = literal(REFERENCE_TEMPERATURE)
    return [f'    const float known = temperature == temperature ? temperature : {unknown};',
            f'    const float held = known < {low} ? {low} : (known > {high} ? {high} : known);',
            f'    const float s = (held - {_signed(header.middle)}) * {literal(1 / header.half)};']


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


def _added(header: Header, axis: int) -> str:
    """Return the C terms that are taken from d of an axis."""
    parts = []
    for column in range(3):
        change = np.append(0.0, header.mat_w[1:, axis, column])
        if np.any(change):
            parts.append(f'{_horner(change)} * u[{column}]')
    for k in np.flatnonzero(header.axis == axis):
        if np.any(header.bend[:, k]):
            parts.append(f'{_horner(header.bend[:, k])} * {_monomial(int(header.monomial[k]))}')
    return ''.join(f'\n            - {part}' for part in parts)


def _monomial(index: int) -> str:
    """Return the C expression of a bending monomial."""
    x, size = (f'u[{(index - SQUARE) % 3}]', '({0} < 0.0f ? -{0} : {0})')
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
