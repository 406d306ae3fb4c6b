# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of one reading at a time, for a stream of messages.

Each call of numpy takes about 1 µs, and `Calibration.correct` makes dozens of calls, which is too
slow for single messages. Here the terms of the catalogue (`accel_calib.effects`) are summed as
Python floats. With the context fixed, the affine terms sum to an offset and a gain; only the
bending terms are iterated, as in `accel_calib.effects.model`.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from operator import add
from typing import Any

import numpy as np

from ..calibration import Calibration
from ..effects import (
    AFFINE, check_context, CONVERGED_G, Effect, FORCE, LARGEST_FORCE_G, LARGEST_ITERATIONS,
    MONOMIALS, ONE, own_slope, too_large)
from ..table import Floats

Triple = tuple[float, float, float]
Matrix = Sequence[float]
"""Nine numbers, row by row."""

Known = Mapping[str, Any]
"""Context of one reading: floats and triples, with the keys of `accel_calib.effects.Context`."""


_Term = tuple[int, int, float]
"""Axis, monomial, and weight times value of a term of an effect."""

_Bend = tuple[int, float, Callable[[float, float, float], float],
              Callable[[float, float, float], Triple]]
"""Axis, coefficient, value and gradient of a bending term with its context fixed."""

_SLOW = 3
"""Iterations after which the slope is computed at the present force."""


class OneReading:
    """
    A calibration prepared for the correction of single readings; `scale` is on the force.

    `monomials` are the indices of those of the model; the affine monomials are first.

    """

    def __init__(self, calibration: Calibration, scale: float = 1.0) -> None:
        model = calibration.model
        self.needs = model.needs
        self._calibration = calibration
        unit = calibration.force_per_g * scale
        self.turn: Matrix = (model.rotation.T * unit).ravel().tolist()
        self.back: Matrix = (model.rotation / unit).ravel().tolist()
        self.per_g = calibration.units.per_g
        self._fixed = [0.0] * 12
        self._bends: list[_Bend] = []
        self._varying: list[tuple[Effect, list[float], list[_Term]]] = []
        self.of_force: list[tuple[Effect, list[float], list[_Term]]] = []
        for effect, values in zip(model.terms.effects, model.values.values(), strict=True):
            size, shape = effect.split(values)
            terms = [(each.axis, each.monomial, each.weight * float(size[each.parameter]))
                     for each in effect.terms]
            if effect.factor is not None:
                kept = self.of_force if effect.of_force else self._varying
                kept.append((effect, shape.tolist(), terms))
            else:
                self._add(terms, None, self._fixed, self._bends)
        self._varying.sort(key=lambda each: each[0].scales)
        used = model.terms.monomials
        self.monomials = (*range(AFFINE), *(index for index in used if index >= AFFINE))
        self._fixed_at = (None if self._varying or self.of_force
                          else AtReading(self, self._fixed, self._bends, {}))

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
                value, gradient = MONOMIALS[monomial]
                bends.append((axis, size, value, gradient))

    def at(self, known: Known) -> AtReading:
        """Return the calibration at a context; a quantity that is missing is an InputError."""
        if self._fixed_at is not None:
            return self._fixed_at
        check_context(self._calibration.model, known)
        ranges = self._calibration.ranges
        if ranges:  # effects are not extrapolated
            known = {**known, **{key: min(max(known[key], low), high)
                                 for key, (low, high) in ranges.items() if key in known}}
        affine, bends = list(self._fixed), list(self._bends)
        for effect, shape, terms in self._varying:
            factor = _factor(effect, known, shape)
            if effect.scales:  # all other gains are there
                affine[3:] = [part * (1.0 + terms[0][2] * factor) for part in affine[3:]]
            self._add(terms, factor, affine, bends)
        return AtReading(self, affine, bends, known)

    @cached_property
    def _spread_rows(self) -> tuple[Floats, Floats]:
        """Return the (m, t) monomial of each row of the basis, and its (t, 3 p) part of a root."""
        model, covariance = self._calibration.model, self._calibration.covariance
        size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))  # constants have other units
        variances, axes = np.linalg.eigh(covariance / size / size[:, np.newaxis])
        root = model.rows.to_value.T @ (axes * size[:, np.newaxis] * np.sqrt(
            np.maximum(variances, 0.0)))
        of_axis = np.eye(3)[model.rows.axis][:, :, np.newaxis]
        monomials = np.take(model.terms.monomials, model.rows.place)
        return (np.equal.outer(self.monomials, monomials).astype(float),
                (of_axis * root[:, np.newaxis]).reshape(len(root), -1))

    def spread_basis(self, known: Known, u: Triple) -> Floats:
        """Return the (m, 3 p) basis of each monomial times a root of the covariance."""
        model = self._calibration.model
        row = {key: np.asarray(value, float)[np.newaxis] for key, value in known.items()}
        basis = model.basis_of(model.terms.weight[:, np.newaxis], row, np.array([u]))
        which, rows = self._spread_rows
        return np.asarray((which * basis.terms[:, 0]) @ rows)


def _factor(effect: Effect, known: Known, shape: Any) -> Any:
    """
    Return the factor of an effect: one float for all terms, or a list with one per term.

    A factor is 0 where its context is NaN.

    """
    factor = effect.factor(known, shape) if effect.factor is not None else 1.0
    if isinstance(factor, np.ndarray):
        return np.nan_to_num(factor).tolist()
    return 0.0 if factor != factor else float(factor)


class AtReading:
    """
    A calibration with its context fixed; `OneReading.at` returns it.

    `correct` is the function reading x, y, z -> specific force in the levelled frame, times the
    scale. It raises InputError if the effects cannot be corrected.

    """

    def __init__(self, owner: OneReading, affine: Sequence[float], bends: list[_Bend],
                 known: Known) -> None:
        self._owner, self._bends, self._known = owner, bends, known
        a, b, c, d, e, f, g, h, i = affine[3:]
        self._gain = (a + 1.0, b, c, d, e + 1.0, f, g, h, i + 1.0)
        inverse = _inverse(self._gain)
        offset = _times(inverse, *affine[:3])
        if bends or owner.of_force:
            self.correct = self._solving(inverse, offset)
        else:
            matrix = _product(owner.turn, inverse)
            self.correct = _affine([part / owner.per_g for part in matrix],
                                   _times(owner.turn, *offset))

    def _solving(self, inverse: Matrix, offset: Triple) -> Callable[[float, float, float], Triple]:
        """
        Return the function that solves for u, and rotates it.

        The method is Newton's, with a slope that is computed again only if convergence is slow.
        `model.AtContext.force` solves the same equation for many readings.

        """
        undone = _affine([part / self._owner.per_g for part in inverse], offset)
        turn, bend, near, far = self._owner.turn, self._bend, CONVERGED_G, LARGEST_FORCE_G
        a, b, c, d, e, f, g, h, i = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0

        def correct(x: float, y: float, z: float) -> Triple:
            nonlocal a, b, c, d, e, f, g, h, i
            p, q, r = left, mid, right = undone(x, y, z)
            last = near
            for count in range(LARGEST_ITERATIONS):
                j, k, m = _times(inverse, *bend(p, q, r))
                j, k, m = p + j - left, q + k - mid, r + m - right
                if count == _SLOW:
                    a, b, c, d, e, f, g, h, i = _product(_inverse(self._slope_at((p, q, r))),
                                                         self._gain)
                j, k, m = (a * j + b * k + c * m, d * j + e * k + f * m, g * j + h * k + i * m)
                p, q, r = p - j, q - k, r - m
                if not (-far < p < far and -far < q < far and -far < r < far):
                    break
                step = max(abs(j), abs(k), abs(m))
                if step * step < near * last:  # the next step would be smaller than that
                    return _times(turn, p, q, r)
                last = step
            raise too_large()

        return correct

    def _bend(self, x: float, y: float, z: float) -> list[float]:
        """Return what the bending terms add to a reading at a force [g]."""
        added = [0.0, 0.0, 0.0]
        for axis, size, value, _ in self._bends:
            added[axis] += size * value(x, y, z)
        for effect, shape, terms in self._owner.of_force:
            factor = _factor(effect, {**self._known, 'force': (x, y, z)}, shape)
            for k, (axis, _, size) in enumerate(terms):
                added[axis] += size * (factor[k] if isinstance(factor, list) else factor)
        return added

    def _slope_at(self, u: Triple) -> Matrix:
        """Return the slope of the reading at a force."""
        if self._owner.of_force:
            bent = own_slope(lambda at: np.array([self._bend(*at[0])]), np.array([u]))
            return [*map(add, self._gain, bent.ravel().tolist())]
        slope = list(self._gain)
        for axis, size, _, gradient in self._bends:
            for at, part in enumerate(gradient(*u), 3 * axis):
                slope[at] += size * float(part)
        return slope

    def with_spread(self, force: Triple, own: Sequence[float]) -> Sequence[float]:
        """
        Return the covariance of a corrected force, with the uncertainty of the calibration.

        `own` is the covariance of the force from the noise of the reading, row by row.

        """
        if self._bends or self._owner.of_force:
            u = _times(self._owner.back, *force)
            monomials = [MONOMIALS[index].value(*u) for index in self._owner.monomials]
            to_force = np.reshape(_product(self._owner.turn, _inverse(self._slope_at(u))), (3, 3))
            basis = (self._owner.spread_basis(self._known, u) if self._owner.of_force
                     else self._basis)
            moved = to_force @ np.dot(monomials, basis).reshape(3, -1)
            added = (moved @ moved.T).ravel().tolist()
        else:
            xx, xy, xz, yy, yz, zz = [form(*force) for form in self._forms]
            added = [xx, xy, xz, xy, yy, yz, xz, yz, zz]
        return [*map(add, own, added)]

    @cached_property
    def _forms(self) -> list[Callable[[float, float, float], float]]:
        """Entries of the covariance as quadratic forms of the force; the upper triangle."""
        basis = self._basis.reshape(AFFINE, 3, -1)
        moved = np.reshape(_product(self._owner.turn, _inverse(self._gain)), (3, 3)) @ basis
        moved[1:] = np.einsum('ij,ikp->jkp', np.reshape(self._owner.back, (3, 3)), moved[1:])
        each = np.einsum('mip,njp->mnij', moved, moved).reshape(AFFINE, AFFINE, 9)
        both = each + np.swapaxes(each, 0, 1)
        form = np.array([both[m, n] / (2.0 if m == n else 1.0)
                         for m, n in zip(*np.triu_indices(AFFINE), strict=True)])
        return [_quadratic(form[:, entry].tolist()) for entry in (0, 1, 2, 4, 5, 8)]

    @cached_property
    def _basis(self) -> Floats:
        return self._owner.spread_basis(self._known, (0.0, 0.0, 0.0))


def _affine(matrix: Matrix, less: Triple) -> Callable[[float, float, float], Triple]:
    """Return the function v -> matrix @ v - less."""
    a, b, c, d, e, f, g, h, i = matrix
    p, q, r = less
    return lambda x, y, z: (
        a * x + b * y + c * z - p, d * x + e * y + f * z - q, g * x + h * y + i * z - r)


def _quadratic(form: Sequence[float]) -> Callable[[float, float, float], float]:
    """Return the quadratic form with the coefficients of 1, x, y, z, xx, xy, xz, yy, yz, zz."""
    a, b, c, d, e, f, g, h, i, j = form
    return lambda x, y, z: (
        a + x * (b + e * x + f * y + g * z) + y * (c + h * y + i * z) + z * (d + j * z))


def _times(matrix: Matrix, x: float, y: float, z: float) -> Triple:
    a, b, c, d, e, f, g, h, i = matrix
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _product(one: Matrix, other: Matrix) -> Matrix:
    columns = [_times(one, *other[k::3]) for k in range(3)]
    return [part for row in zip(*columns) for part in row]


def _inverse(matrix: Matrix) -> Matrix:
    """Return the inverse of a gain. `calibrate.gated` has checked that it is not singular."""
    a, b, c, d, e, f, g, h, i = matrix
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    size = a * p + b * q + c * r
    return (p / size, (c * h - b * i) / size, (b * f - c * e) / size,
            q / size, (a * i - c * g) / size, (c * d - a * f) / size,
            r / size, (b * g - a * h) / size, (a * e - b * d) / size)
