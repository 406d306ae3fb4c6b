# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The terms of a list of effects as arrays, so that a model adds all of them at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import effect_named
from .form import AFFINE, Effect, FORCE, MONOMIALS, ONE
from ..table import Floats


@dataclass(frozen=True)
class Terms:
    """
    The terms of a list of effects as arrays, one entry per term.

    Parameters
    ----------
    effects : tuple of Effect
        The effects.
    monomials : tuple of int
        Indices in `MONOMIALS` that the terms use.
    place : (t,) array of int
        Index of the term's monomial in `monomials`.
    axis, value : (t,) array of int
        Axis of the reading; index of the parameter among all p values.
    weight : (t,) array
        Constant factor.
    count : (e,) array of int
        Terms of each effect.
    size : int
        p, the number of values.

    """

    effects: tuple[Effect, ...]
    monomials: tuple[int, ...]
    place: NDArray[np.intp]
    axis: NDArray[np.intp]
    value: NDArray[np.intp]
    weight: Floats
    count: NDArray[np.intp]
    size: int

    @cached_property
    def starts(self) -> NDArray[np.intp]:
        """(e,) array, index of the first value of each effect."""
        sizes = [len(effect.values) for effect in self.effects]
        return np.cumsum([0, *sizes])[:-1].astype(np.intp)

    @cached_property
    def to_affine(self) -> Floats:
        """(12, t) array that sums the affine terms into V and, row by row, W - I."""
        monomial = np.array(self.monomials, np.intp)[self.place]
        slot = np.where(monomial == ONE, self.axis, 3 + 3 * self.axis + monomial - FORCE)
        return sums(np.where(monomial < AFFINE, slot, -1), 12)

    @cached_property
    def to_value(self) -> Floats:
        """(p, t) array that sums terms by value."""
        return sums(self.value, self.size)

    @cached_property
    def bending(self) -> NDArray[np.intp]:
        """(b,) array, the terms that bend with the force."""
        return np.flatnonzero(np.array(self.monomials, np.intp)[self.place] >= AFFINE)

    @cached_property
    def bends_to_axis(self) -> Floats:
        """(3, b) array that sums the bending terms by axis."""
        return sums(self.axis[self.bending], 3)

    @cached_property
    def fixed(self) -> bool:
        """Whether all terms are independent of the context."""
        return all(effect.factor is None for effect in self.effects)

    def factors(self, shapes: list[Floats], context: Mapping[str, Any], rows: tuple[int, ...]
                ) -> Floats:
        """Return the (t, *rows) factors of the terms; a factor is 0 where its context is NaN."""
        found = np.ones((len(self.weight), *rows))
        start = 0
        for effect, shape, count in zip(self.effects, shapes, self.count.tolist(), strict=True):
            if effect.factor is not None:
                found[start:start + count] = effect.factor(context, shape)
            start += count
        return np.nan_to_num(found, copy=False)

    def monomials_at(self, u: Floats) -> Floats:
        """Return the (m, n) monomials of (n, 3) forces."""
        x, y, z = u.T
        found = np.empty((len(self.monomials), len(u)))
        for k, index in enumerate(self.monomials):
            found[k] = MONOMIALS[index].value(x, y, z)
        return found

    def gradients_at(self, u: Floats) -> Floats:
        """Return the (m, 3, n) derivatives of the monomials by the force."""
        x, y, z = u.T
        found = np.empty((len(self.monomials), 3, len(u)))
        for k, index in enumerate(self.monomials):
            for axis, part in enumerate(MONOMIALS[index].gradient(x, y, z)):
                found[k, axis] = part
        return found


@lru_cache(maxsize=512)
def terms_of(effects: tuple[str, ...]) -> Terms:
    """Return the terms of the effects of these names."""
    entries = [effect_named(name) for name in effects]
    used = sorted({term.monomial for effect in entries for term in effect.terms} | {ONE})
    rows, start = [], 0
    for effect in entries:
        rows += [(used.index(term.monomial), term.axis, start + term.parameter, term.weight)
                 for term in effect.terms]
        start += len(effect.values)
    place, axis, value, weight = np.array(rows, float).reshape(-1, 4).T
    return Terms(tuple(entries), tuple(used), place.astype(np.intp), axis.astype(np.intp),
                 value.astype(np.intp), weight,
                 np.array([len(effect.terms) for effect in entries], np.intp), start)


def sums(index: NDArray[np.intp], size: int) -> Floats:
    """Return the (size, t) matrix that sums t numbers by their index."""
    found: Floats = (index == np.arange(size)[:, np.newaxis]).astype(float)
    return found


@dataclass(frozen=True)
class Basis:
    """
    Derivative of the reading by the values of a model, term by term.

    Parameters
    ----------
    terms : (t, n) array
        What each term adds to its axis per unit of its value.
    axis : (t,) array of int
        Axis of each term.
    to_value : (p, t) array
        Sums the terms by value.

    """

    terms: Floats
    axis: NDArray[np.intp]
    to_value: Floats

    @property
    def full(self) -> Floats:
        """(n, 3, p) array, the derivative."""
        return np.stack([self.to_value[:, self.axis == axis] @ self.terms[self.axis == axis]
                         for axis in range(3)]).T.swapaxes(1, 2)

    def along(self, rows: Floats) -> Floats:
        """Return the (n, p) product of the derivative with an (n, 3) row per pose."""
        found: Floats = (self.to_value @ (self.terms * rows.T[self.axis])).T
        return found
