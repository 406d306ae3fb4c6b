# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The correction of one reading at a time, for a stream of messages.

A call of numpy takes about a microsecond whatever it does, and `Calibration.correct` makes dozens
of them: nothing for a recording, too much for single messages. Here the terms of the catalogue
(`accel_calib.effects`) are summed in floats: with the context fixed, to an offset and a gain, and
only the terms that bend with the force are iterated, as in `accel_calib.model`.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from .calibrate import Calibration
from .effects import AFFINE, Effect, FORCE, MONOMIALS, ONE
from .model import (
    check_context,
    CONVERGED_G,
    difference,
    FITTED_SHAPES,
    LARGEST_FORCE_G,
    LARGEST_ITERATIONS,
    too_large,
)
from .table import Floats

Triple = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""Nine numbers, row by row."""

Known = Mapping[str, Any]
"""Context of one reading: floats and triples by the keys of `accel_calib.effects.Context`."""


class _Term(NamedTuple):
    """A term of an effect: its axis, monomial, and weight times value."""

    axis: int
    monomial: int
    size: float


class _Part(NamedTuple):
    """An effect whose factor depends on the context, with its values."""

    effect: Effect
    shape: list[float]
    terms: list[_Term]


class _Bend(NamedTuple):
    """A bending term at a context: its axis, size, value and gradient."""

    axis: int
    size: float
    value: Callable[[float, float, float], float]
    gradient: Callable[[float, float, float], Triple]


class OneReading:
    """
    A calibration, ready for single readings.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    scale : float
        Factor on the corrected force.

    """

    def __init__(self, calibration: Calibration, scale: float = 1.0) -> None:
        model = calibration.model
        self.needs = model.needs
        self._calibration = calibration
        self._unit = calibration.force_per_g * scale
        self.turn = _flat(model.rotation.T * self._unit)
        self.back = _flat(model.rotation / self._unit)
        self.per_g = calibration.units.per_g
        self._fixed, self._varying = [0.0] * 12, []
        self._bends: list[_Bend] = []
        for effect, values in zip(model.terms.effects, model.values.values(), strict=True):
            size, shape = effect.split(values)
            terms = [_Term(each.axis, each.monomial, each.weight * float(size[each.parameter]))
                     for each in effect.terms]
            if effect.factor is not None:
                self._varying.append(_Part(effect, shape.tolist(), terms))
            else:
                self._add(terms, None, self._fixed, self._bends)

    def _add(self, terms: list[_Term], factor: Any, affine: list[float], bends: list[_Bend]
             ) -> None:
        """Add terms to V and W - I, row by row, and to the bending terms."""
        for k, (axis, monomial, size) in enumerate(terms):
            if factor is not None:
                size = size * (factor[k] if isinstance(factor, list) else factor)
            if monomial == ONE:
                affine[axis] += size
            elif monomial < AFFINE:
                affine[3 + 3 * axis + monomial - FORCE] += size
            else:
                bends.append(_Bend(axis, size, *MONOMIALS[monomial]))

    def held(self, known: Known) -> Known:
        """Return the context held at the edge of what the calibration has seen."""
        ranges = self._calibration.ranges
        if not ranges:
            return known
        return {**known, **{key: min(max(known[key], low), high)
                            for key, (low, high) in ranges.items() if key in known}}

    def at(self, known: Known) -> AtReading:
        """
        Return the calibration with its context fixed.

        Parameters
        ----------
        known : mapping
            What the effects need.

        Raises
        ------
        InputError
            If something is missing.

        """
        if not self._varying:
            return self._without_context
        check_context(self._calibration.model, known)
        known = self.held(known)
        affine, bends = list(self._fixed), list(self._bends)
        for effect, shape, terms in self._varying:
            self._add(terms, _factor(effect, known, shape), affine, bends)
        return AtReading(self, affine, bends, known)

    @cached_property
    def _without_context(self) -> AtReading:
        return AtReading(self, self._fixed, self._bends, {})

    @cached_property
    def _spread_rows(self) -> tuple[Floats, Floats]:
        """Return which term has which monomial, (m, t), and its part of the root, (t, 3 p)."""
        model = self._calibration.model
        variances, axes = np.linalg.eigh(self._calibration.covariance)
        root = axes * np.sqrt(np.maximum(variances, 0.0))
        rows, monomials, start = [], [], 0
        for effect, values in zip(model.terms.effects, model.values.values(), strict=True):
            shapes = [start + len(effect.parameters) + place for place in _fitted(effect)]
            for own in (None, *shapes):
                for term in effect.terms:
                    at = start + term.parameter if own is None else own
                    size = 1.0 if own is None else values[term.parameter]
                    rows.append(_row(term.axis, term.weight * size * root[at]))
                    monomials.append(term.monomial)
            start += len(effect.values)
        which = np.equal.outer(self.monomials, monomials).astype(float)
        return which, np.array(rows).reshape(len(rows), 3 * len(root))

    @property
    def monomials(self) -> tuple[int, ...]:
        """Return the indices of the monomials of the model, the affine ones first."""
        used = self._calibration.model.terms.monomials
        return (*range(AFFINE), *(index for index in used if index >= AFFINE))

    def spread_basis(self, known: Known) -> Floats:
        """Return what each monomial adds to the basis times a root of the covariance, (m, 3 p)."""
        factors: list[float] = []
        model = self._calibration.model
        for effect, values in zip(model.terms.effects, model.values.values(), strict=True):
            count, shape = len(effect.terms), effect.split(values)[1]
            factor = _factor(effect, known, shape.tolist())
            factors += factor if isinstance(factor, list) else [factor] * count
            for place in _fitted(effect):
                if effect.factor is not None:
                    change = difference(effect.factor, known, shape, place)
                    factors += np.broadcast_to(change, count).tolist()
        which, rows = self._spread_rows
        basis: Floats = (which * factors) @ rows
        return basis


def _fitted(effect: Effect) -> list[int]:
    """Return the places of the fitted constants in the shape of an effect."""
    return [place for place, name in enumerate(effect.shape) if name in FITTED_SHAPES]


def _factor(effect: Effect, known: Known, shape: Any) -> Any:
    """Return the factor of an effect: a float for all terms, or a list with one for each."""
    factor = effect.factor(known, shape) if effect.factor is not None else 1.0
    return factor.tolist() if isinstance(factor, np.ndarray) else float(factor)


def _row(axis: int, values: Floats) -> Floats:
    row = np.zeros((3, len(values)))
    row[axis] = values
    return row.ravel()


class AtReading:
    """
    A calibration with its context fixed; made by `OneReading.at`.

    Attributes
    ----------
    correct : callable
        Reading x, y, z -> specific force in the levelled frame, times the scale. Raises
        InputError if the effects cannot be undone.

    """

    def __init__(self, owner: OneReading, affine: Sequence[float], bends: list[_Bend],
                 known: Known) -> None:
        self._owner, self._bends, self._known = owner, bends, known
        a, b, c, d, e, f, g, h, i = affine[3:]
        self._gain = (a + 1.0, b, c, d, e + 1.0, f, g, h, i + 1.0)
        inverse = _inverse(self._gain)
        offset = _times(inverse, *affine[:3])
        if bends:
            self.correct = self._solving(inverse, offset)
        else:
            matrix = _product(owner.turn, inverse)
            self.correct = _affine([part / owner.per_g for part in matrix],
                                   _times(owner.turn, *offset))

    def _solving(self, inverse: Matrix, offset: Triple) -> Callable[[float, float, float], Triple]:
        """Return the function that solves for u as `model.AtContext.force` does, and turns it."""
        undone = _affine([part / self._owner.per_g for part in inverse], offset)
        bends, turn, near, far = self._bends, self._owner.turn, CONVERGED_G, LARGEST_FORCE_G

        def correct(x: float, y: float, z: float) -> Triple:
            start = u = undone(x, y, z)
            for _ in range(LARGEST_ITERATIONS):
                added = [0.0, 0.0, 0.0]
                for axis, size, value, _ in bends:
                    added[axis] += size * value(*u)
                p, q, r = _times(inverse, *added)
                now = start[0] - p, start[1] - q, start[2] - r
                if not (abs(now[0]) < far and abs(now[1]) < far and abs(now[2]) < far):
                    break
                if (abs(now[0] - u[0]) < near and abs(now[1] - u[1]) < near
                        and abs(now[2] - u[2]) < near):
                    return _times(turn, *now)
                u = now
            raise too_large()

        return correct

    def with_spread(self, force: Triple, own: Sequence[float]) -> Sequence[float]:
        """
        Return a covariance with the uncertainty of the calibration added.

        Parameters
        ----------
        force : 3 floats
            What `correct` returned.
        own : 9 floats
            Covariance of the corrected force without it, row by row.

        """
        if self._bends:
            added = self._bent_spread(_times(self._owner.back, *force))
        else:
            x, y, z = force
            products = (1.0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
            added = np.dot(products, self._form).tolist()
        return [*map(float.__add__, own, added)]

    @cached_property
    def _form(self) -> Floats:
        """(10, 9) array: the covariance as a quadratic form of the force."""
        basis = self._owner.spread_basis(self._known).reshape(AFFINE, 3, -1)
        moved = np.reshape(_product(self._owner.turn, _inverse(self._gain)), (3, 3)) @ basis
        moved[1:] = np.einsum('ij,ikp->jkp', np.reshape(self._owner.back, (3, 3)), moved[1:])
        each = np.einsum('mip,njp->mnij', moved, moved).reshape(AFFINE, AFFINE, 9)
        both = each + np.swapaxes(each, 0, 1)
        return np.array([both[m, n] / (2.0 if m == n else 1.0)
                         for m, n in ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3),
                                      (2, 2), (2, 3), (3, 3))])

    def _bent_spread(self, u: Triple) -> list[float]:
        monomials = [MONOMIALS[index].value(*u) for index in self._owner.monomials]
        slope = list(self._gain)
        for axis, size, _, gradient in self._bends:
            for j, part in enumerate(gradient(*u)):
                slope[3 * axis + j] += size * float(part)
        to_force = np.reshape(_product(self._owner.turn, _inverse(slope)), (3, 3))
        moved = to_force @ np.dot(monomials, self._basis).reshape(3, -1)
        added: list[float] = (moved @ moved.T).ravel().tolist()
        return added

    @cached_property
    def _basis(self) -> Floats:
        return self._owner.spread_basis(self._known)


def _flat(matrix: Floats) -> Matrix:
    a, b, c, d, e, f, g, h, i = matrix.ravel().tolist()
    return a, b, c, d, e, f, g, h, i


def _affine(matrix: Sequence[float], less: Triple) -> Callable[[float, float, float], Triple]:
    """Return the function matrix @ vector - less."""
    a, b, c, d, e, f, g, h, i = matrix
    p, q, r = less

    def apply(x: float, y: float, z: float) -> Triple:
        return a * x + b * y + c * z - p, d * x + e * y + f * z - q, g * x + h * y + i * z - r

    return apply


def _times(matrix: Sequence[float], x: float, y: float, z: float) -> Triple:
    a, b, c, d, e, f, g, h, i = matrix
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _product(one: Sequence[float], other: Sequence[float]) -> Matrix:
    columns = [_times(one, *other[k::3]) for k in range(3)]
    (a, d, g), (b, e, h), (c, f, i) = columns
    return a, b, c, d, e, f, g, h, i


def _inverse(matrix: Sequence[float]) -> Matrix:
    """Return the inverse of a gain, which the gate has checked to be far from singular."""
    a, b, c, d, e, f, g, h, i = matrix
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    size = a * p + b * q + c * r
    return (p / size, (c * h - b * i) / size, (b * f - c * e) / size,
            q / size, (a * i - c * g) / size, (c * d - a * f) / size,
            r / size, (b * g - a * h) / size, (a * e - b * d) / size)
