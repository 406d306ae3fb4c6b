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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .made import (
    frame_words, Made, Options, polynomial, single, steady_context, steady_grid, temperature_range)
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
_KINDS = {'square': SQUARE, 'cube': CUBE, 'odd_square': ODD_SQUARE, 'size': SIZE,
          'product': PRODUCT, 'wave': WAVE, 'zone': ZONAL}
"""First index in `MONOMIALS` of each kind of bending terms."""

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
    here = calibration.model.at(steady_context(calibration, middle + half * nodes))
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
    bends: list[list[dict[str, Any]]] = [[
        {'polynomial': np.append(0.0, made.mat_w[1:, axis, column]), 'kind': 'force',
         'axis': column} for column in range(3)] for axis in range(3)]
    for k, (monomial, axis) in enumerate(zip(made.monomial.tolist(), made.axis.tolist())):
        kind, first = max((each for each in _KINDS.items() if each[1] <= monomial),
                          key=lambda each: each[1])
        which, of = divmod(monomial - first, 3)
        bends[axis].append({**(ZONES[which]._asdict() if kind == 'zone' else {}), 'kind': kind,
                            'axis': of, 'which': which, 'polynomial': made.bend[:, k]})
    degrees = sorted({ZONES[(index - ZONAL) // 3].degree
                      for index in made.monomial.tolist() if index >= ZONAL})
    values = {
        'name': name, 'affine': made.is_affine, 'M': made.matrix, 'B': made.vec_v[0],
        'N': made.inverse, 'R': made.turn, 'steps': made.steps, 'V': list(made.vec_v.T),
        'roots': bool(np.any(made.monomial >= WAVE)),
        'per_unit': 1.0 / made.per_g,
        # What is taken from d of each axis: polynomials in s times a monomial.
        'bend': [[each for each in terms if np.any(each['polynomial'])] for terms in bends],
        'legendre': [(degree, np.array(next(zone.polynomial for zone in ZONES
                                            if zone.degree == degree))) for degree in degrees],
        'unit': 'm/s^2' if calibration.units.is_si else 'g', 'frame': frame_words(calibration),
        's': {'unknown': REFERENCE_TEMPERATURE, 'middle': made.middle,
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
