# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Candidates: effects as columns of the equations, with their ranking and significance.

For an effect with a shape, the shapes of the catalogue are tried. Candidates are ranked by the
Bayesian information criterion with a free scale of the noise (Schwarz 1978). The criterion
decreases by

    N log(RSS / (RSS - gain)) - q log N - 2 log(shapes tried)

if q parameters explain `gain` of the residual sum of squares. An effect is accepted by an F test,
with the probability multiplied by the number of candidates and of shapes tried, and only if it
also reduces the held-out residual. The scale is free because poses repeat worse than the noise of
their samples predicts. The measured noise decides whether a gap remains.

**Projection.** Linear least squares with columns that are added and removed.

`Projected` contains the residual of the equations with the columns of the model projected out. The
gain of further columns is then one small regression. It is, to first order, the joint fit of all
values at the cost of the candidate alone.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..effects import Context, effect_named
from ..estimate.equations import Equations
from ..model import Model
from ..table import Floats

_SEEN = 0.02
"""Smallest part of a column outside of the model; otherwise it cannot be distinguished."""


@dataclass(frozen=True)
class Projected:
    """
    Equations with columns projected out.

    Parameters
    ----------
    onto : (m, r) array
        Orthonormal columns that span the model.
    residual : (m,) array
        Residual of the model.

    """

    onto: Floats
    residual: Floats

    @property
    def rss(self) -> float:
        """Residual sum of squares."""
        return float(self.residual @ self.residual)

    def outside(self, columns: Floats) -> Floats:
        """Return the part of (m, q) columns outside of the model, orthonormal (m, r)."""
        left = columns - self.onto @ (self.onto.T @ columns)
        sizes = np.linalg.norm(columns, axis=0)
        kept = np.linalg.norm(left, axis=0) > _SEEN * np.maximum(sizes, 1e-300)
        if not np.any(kept):
            return columns[:, :0]
        scaled = left[:, kept] / sizes[kept]
        left_vectors, scales, _ = np.linalg.svd(scaled, full_matrices=False)
        return left_vectors[:, scales > _SEEN * max(scales[0], _SEEN)]

    def plus(self, orthonormal: Floats) -> Projected:
        """Return the equations with columns from `outside` projected out, too."""
        return Projected(np.hstack([self.onto, orthonormal]),
                         self.residual - orthonormal @ (orthonormal.T @ self.residual))

    def with_columns(self, columns: Floats) -> Projected:
        """Return the equations with (m, q) columns projected out, too."""
        return self.plus(self.outside(columns))

    @property
    def held_out(self) -> Floats:
        """(m,) array, each residual if its own equation is left out of the fit (PRESS)."""
        own = 1.0 - np.sum(self.onto ** 2, axis=1)
        return self.residual / np.maximum(own, 0.02)


def projected(residual: Floats, columns: Floats) -> Projected:
    """Return the (m,) residual with (m, q) columns projected out."""
    start = Projected(np.zeros((len(residual), 0)), residual)
    return start.with_columns(columns) if columns.shape[1] else start


LEVEL = 0.005
"""Probability that any effect is named if there is no hidden effect."""

RIVAL = 9.0
"""Largest difference of the criterion between an effect and its rivals: odds of 1 to 90."""

_AS_GOOD = 6.0
"""Within this difference from the best criterion, the effect with fewest parameters wins."""

_SHAPES_AT_ONCE = 250
"""If there are more shapes, evenly spread shapes are tried first, then those near the best."""

_USUAL = 1.6
"""Standard deviation of the logarithm of the size of an effect relative to its typical size."""


@dataclass(frozen=True)
class Candidate:
    """
    An effect that is a candidate for a model.

    Parameters
    ----------
    effect : str
        Name of the effect.
    shape : (s,) array
        Shape of the effect.
    columns : (m, r) array
        Columns of the effect outside of the model, orthonormal.
    size : float
        Largest value of the effect if it is added, relative to the typical size.
    visible : float
        Largest change of the residuals by an effect of typical size, relative to the noise.
    searched : int
        Number of values of the shape that were estimated from the same data.
    tried : float
        Number of independent shapes tried.

    """

    effect: str
    shape: Floats
    columns: Floats
    size: float
    visible: float
    searched: int = 0
    tried: float = 1.0

    @property
    def parameters(self) -> int:
        """Return the number of parameters, including searched values of the shape."""
        return self.columns.shape[1] + self.searched

    def beside(self, fitted: Projected) -> Candidate:
        """Return the candidate for a model with further columns."""
        return replace(self, columns=fitted.outside(self.columns))


def candidates(equations: Equations, fitted: Projected, context: Context, names: tuple[str, ...],
               whiten: Callable[[Floats], Floats] | None = None) -> dict[str, Candidate]:
    """
    Return the candidates among these effects that the equations distinguish from the model.

    Parameters
    ----------
    equations : Equations
        Equations near the model.
    fitted : Projected
        The equations with the model projected out.
    context : mapping of str to array
        Context of the poses.
    names : tuple of str
        Names of effects.
    whiten : callable, optional
        Function that was applied to the equations, and is applied to the columns, too.

    """
    found = {}
    for name in names:
        effect = effect_named(name)
        if effect.output is None and all(key in context for key in effect.needs):
            best = _best_shape(name, equations, fitted, context, whiten)
            if best is not None:
                found[name] = best
    return found


class _Tried(NamedTuple):
    """A shape: its index, its gain, and its columns outside of the model and as a whole."""

    place: int
    gain: float
    columns: Floats
    seen: Floats


def _best_shape(name: str, equations: Equations, fitted: Projected, context: Context,
                whiten: Callable[[Floats], Floats] | None) -> Candidate | None:
    """Return the candidate with its best shape, or None if the model spans it."""
    effect = effect_named(name)
    shapes = [np.zeros(0)] if effect.shapes is None else list(effect.shapes(context))
    if not shapes:
        return None

    def tried(place: int) -> _Tried:
        model = Model({name: np.concatenate([np.zeros(len(effect.parameters)), shapes[place]])})
        seen = equations.columns(model)[:, :len(effect.parameters)]
        seen = seen if whiten is None else whiten(seen)
        columns = fitted.outside(seen)
        gain = float(np.sum((columns.T @ fitted.residual) ** 2))
        return _Tried(place, gain if columns.shape[1] else -1.0, columns, seen)

    step = -(-len(shapes) // _SHAPES_AT_ONCE)
    best = max(map(tried, range(0, len(shapes), step)), key=lambda each: each.gain)
    if step > 1:
        near = range(max(best.place - step + 1, 0), min(best.place + step, len(shapes)))
        best = max(map(tried, near), key=lambda each: each.gain)
    if not best.columns.shape[1]:
        return None
    left = best.seen - fitted.onto @ (fitted.onto.T @ best.seen)
    values = np.linalg.lstsq(left, fitted.residual, rcond=1e-7)[0]
    size = float(np.max(np.abs(values))) / effect.typical
    visible = float(np.linalg.norm(left, 2)) * effect.typical
    return Candidate(name, shapes[best.place], best.columns, size, visible, int(len(shapes) > 1),
                     1.0 if len(shapes) == 1 else len(shapes) / 3.0)


def fall(gain: float, rss: float, count: int, parameters: float, tried: float = 1.0) -> float:
    """Return the decrease of the criterion for the gain of a candidate; larger is better."""
    left = max(rss - gain, 1e-12 * rss, 1e-300)
    return float(count * np.log(max(rss, 1e-300) / left) - parameters * np.log(count)
                 - 2.0 * np.log(tried))


def gain_of(columns: Floats, fitted: Projected) -> float:
    """Return the part of the residual sum of squares that orthonormal columns explain."""
    return float(np.sum((columns.T @ fitted.residual) ** 2))


def fall_of(candidate: Candidate, fitted: Projected, count: int) -> float:
    """Return the decrease of the criterion with this candidate."""
    return fall(gain_of(candidate.columns, fitted), fitted.rss, count, candidate.parameters,
                candidate.tried)


def unusual(candidate: Candidate) -> float:
    """Return a penalty for an unusual size of a candidate, on the scale of the criterion."""
    return (max(np.log(max(candidate.size, 1e-300)), 0.0) / _USUAL) ** 2


def best_of(found: dict[str, Candidate], fitted: Projected, count: int) -> Candidate | None:
    """
    Return the candidate with the largest decrease of the criterion.

    Among rivals, which these data cannot distinguish, an effect of a typical size is preferred to
    an implausible one. Among equally good effects, the one with the fewest parameters is
    preferred.

    """
    if not found:
        return None
    falls = {name: fall_of(candidate, fitted, count) for name, candidate in found.items()}
    most = max(falls.values())
    credible = {name: falls_by - unusual(found[name]) for name, falls_by in falls.items()
                if falls_by > most - RIVAL}
    most = max(credible.values())
    near = [name for name, falls_by in credible.items() if falls_by > most - _AS_GOOD]
    return found[min(near, key=lambda name: (found[name].parameters, 'new' in effect_named(
        name).needs, -credible[name]))]


def probability(candidate: Candidate, fitted: Projected, dof: int, among: int) -> float:
    """
    Return the probability that noise alone makes one of the candidates this good.

    Parameters
    ----------
    candidate : Candidate
        The best candidate.
    fitted : Projected
        The equations with the model projected out, without the candidate.
    dof : int
        Number of independent equations minus number of parameters of the model.
    among : int
        Number of candidates.

    """
    from scipy.special import fdtrc

    added = candidate.parameters
    left = dof - added
    if left < 1:
        return 1.0
    gain = gain_of(candidate.columns, fitted)
    rss = max(fitted.rss - gain, 1e-300)
    p = float(fdtrc(added, left, gain / added / (rss / left)))
    return min(1.0, p * among * candidate.tried)


def agrees(candidate: Candidate, fitted: Projected) -> bool:
    """Return whether the candidate reduces the held-out residual."""
    with_it = fitted.plus(candidate.columns).held_out
    return bool(with_it @ with_it < fitted.held_out @ fitted.held_out)


_PAIR_BETTER = 12.0
"""Smallest difference of the criterion between a pair and the best two single steps."""


def best_pair(found: dict[str, Candidate], fitted: Projected, count: int
              ) -> tuple[Candidate, Candidate] | None:
    """Return the pair with the largest decrease of the criterion; the better effect is first."""
    best, most = None, -np.inf
    for first, second in combinations(found.values(), 2):
        onto = np.linalg.qr(np.hstack([first.columns, second.columns]))[0]
        gain = gain_of(onto, fitted)
        falls = fall(gain, fitted.rss, count, first.parameters + second.parameters,
                     first.tried * second.tried)
        if falls > most:
            best, most = (first, second), falls
    if best is None:
        return None
    ordered = sorted(best, key=lambda c: -gain_of(c.columns, fitted))
    return ordered[0], ordered[1]


def pair_is_better(pair: tuple[Candidate, Candidate], single: Candidate, fitted: Projected,
                   count: int, found: dict[str, Candidate]) -> bool:
    """Return whether both effects of a pair are significant and better than single steps."""
    if single.effect in (pair[0].effect, pair[1].effect):
        return False
    for one, other in (pair, pair[::-1]):
        beside = fitted.plus(other.columns)
        left = one.beside(beside)
        if not left.columns.shape[1] or probability(left, beside, count - other.parameters,
                                                    len(found)) > LEVEL:
            return False
    first = fitted.plus(single.columns)
    second = max((fall_of(c.beside(first), first, count) for c in found.values()
                  if c.effect != single.effect), default=0.0)
    with_one = fitted.plus(pair[0].columns)
    together = fall_of(pair[0], fitted, count) + fall_of(pair[1].beside(with_one), with_one, count)
    return together > fall_of(single, fitted, count) + max(second, 0.0) + _PAIR_BETTER
