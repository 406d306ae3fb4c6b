# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The equations near a model as a linear problem: candidates as columns, and sets of them.

With the model of the base projected out, the equations are

    residual = columns · values + noise of variance λ

One block of columns belongs to one effect with one shape. A set is a choice of blocks, with
poses that are left out; leaving a pose out is a further column, 1 at the pose and 0 elsewhere.
To first order, the gain of a set is that of the joint fit of all its values. It depends only on
the products of the columns with each other and with the residual. They are computed once. A set is
then a part of their Cholesky factor, at a cost that does not depend on the number of poses, and
the gains of all blocks beside a set are computed at once.

**Moderated variance.** The measured noise says λ = 1, and the residuals say what λ is. The noise
is a prior worth ν = 4 degrees of freedom (Smyth 2004, with ν fixed). In F tests, the variance is

    (ν + RSS) / (ν + dof)

and twice the logarithm of the likelihood of a set is -(ν + N) log(ν + RSS). A test with a free
scale (ν = 0) finds little with few poses, and one with the measured noise alone (ν = ∞) finds
effects where the poses repeat worse than their samples.

**Criterion.** The score of a set, which is larger if the set is better (Schwarz 1978):

    (ν + N) log((ν + RSS₀) / (ν + RSS)) - q log N (ν + N) / (ν + N - q - 1)
                                        - 2 Σ log(tried) - Σ unusual

for q values (corrected for few equations, McQuarrie and Tsai 1998), with the number of effects and
of shapes tried, and a penalty if an effect is far larger than in common sensors. A covariate
counts as one effect, and each quantity as one of its shapes: the more quantities, the more each of
them costs, and the effects of the catalogue cost the same. Each pose that is left out costs
2 log n + 5: it is selected among n poses, and few poses are knocked.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..effects import Context, Effect, effect_named, factors_of, kind_of, Model
from ..estimate import by_pose, Equations, Fit, outliers_among
from ..table import Floats, Poses

WORTH = 4.0
"""ν, degrees of freedom that the measured noise counts as."""

LEVEL = 0.01
"""Probability that any effect is named if there is no hidden effect."""

_SEEN = 0.02
"""Smallest part of a column outside of the model; otherwise it cannot be distinguished."""

_DETERMINED = 1e-12
"""Smallest square of a relative singular value of the columns of values that are determined."""

_LARGEST_LOG = 100.0
"""Largest logarithm of a ratio, against overflow."""

_LEAST_OWN = 0.02
"""Smallest 1 - leverage; below it, an equation alone determines a value."""

_USUAL = 1.6
"""Standard deviation of the logarithm of the size of an effect relative to its typical size."""

_MOST_UNUSUAL = 6.0
"""Largest penalty for an unusual size."""

_RARE = 5.0
"""Additional cost of each pose that is left out: few poses are knocked."""

_SHAPES_AT_ONCE = 250
"""If there are more shapes, only evenly spread shapes are tried."""

_MANY_POSES, _FEW_SHAPES = 1000, 60
"""The same for more poses than this."""

_SHAPES_ALIKE = 3.0
"""Number of neighbouring shapes that count as one independent trial."""

_OFFSET = Model({'offset': np.zeros(3)})


class Block(NamedTuple):
    """Columns of an effect with one (s,) shape, its values searched, and the shapes tried."""

    effect: str
    shape: Floats
    columns: slice
    entry: Effect
    searched: int = 0
    tried: float = 1.0


@dataclass(frozen=True)
class Candidate:
    """
    An effect to try with each of its (s,) `shapes`, which count as `tried` independent ones.

    `factors` (shapes, t or 1, n) are those of its terms at the poses. They do not depend on a
    model.

    """

    name: str
    shapes: tuple[Floats, ...]
    tried: float
    factors: Floats

    @property
    def entry(self) -> Effect:
        """Return the effect."""
        return effect_named(self.name)

    def beside(self, present: Floats | None, context: Context) -> Candidate:
        """Return the candidate with the shape of its values in a model, too."""
        if present is None or len(self.shapes) < 2:
            return self
        shape = self.entry.split(present)[1]
        return replace(self, shapes=(*self.shapes, shape), factors=np.concatenate(
            [self.factors, factors_of(self.name, [shape], context)]))

    def blocks(self, start: int, alike: int) -> Iterator[Block]:
        """Yield a block for each shape, from a column on; `alike` candidates are of one kind."""
        count, entry, searched = len(self.entry.parameters), self.entry, len(self.shapes) > 1
        for shape in self.shapes:
            new = searched and not np.array_equal(shape, entry.usual)
            yield Block(self.name, shape, slice(start, start + count), entry, int(new),
                        (self.tried if new else 1.0) * alike)
            start += count


def candidates(names: Iterable[str], poses_g: Poses) -> tuple[Candidate, ...]:
    """Return the effects of these names that the context of the poses allows."""
    found, context = [], poses_g.columns
    for name in names:
        effect = effect_named(name)
        if effect.output is None and all(key in context for key in effect.needs):
            shapes, tried = _shapes(effect, context, len(poses_g))
            if shapes:
                found.append(Candidate(name, shapes, tried, factors_of(name, shapes, context)))
    return tuple(found)


def _shapes(effect: Effect, context: Context, poses: int) -> tuple[tuple[Floats, ...], float]:
    """Return the shapes of an effect to try, and the number that they count as."""
    if effect.shapes is None:
        return (np.zeros(0),), 1.0
    shapes = tuple(effect.shapes(context))
    most = _SHAPES_AT_ONCE if poses <= _MANY_POSES else _FEW_SHAPES
    shapes = shapes[::-(-len(shapes) // most)] if len(shapes) > most else shapes
    return shapes, max(len(shapes) / _SHAPES_ALIKE, 1.0)


@dataclass(frozen=True)
class Linear:
    """
    The equations of all poses near a model, with the base projected out.

    Parameters
    ----------
    onto : (m, p) array
        Orthonormal columns that span the base.
    residual, pose : (m,) array
        Residual of the base, in units of the noise, and index of the pose of each equation.
    columns, sizes : (m, c) array, (c,) array
        Columns of all blocks outside of the base, and their norms before it was projected out, to
        which they are relative.
    products : (c + 1, c + 1) array
        Products of the columns and, last, of the residual with each other, after whitening.
    worth : float
        ν; 0 if the noise is not known.
    dof : int
        N, number of independent equations minus number of values of the base.
    base_rss : float
        Residual sum of squares of the base, to which scores are relative.
    offset : (m, 3) array
        Columns of an offset.
    choice, penalty : float
        What the choice of one effect among the candidates, or of a walk, costs; subtracted from
        all scores.
    white : (m, r) array, (r,) array, or None
        Orthonormal directions along which the equations are whitened, and the part of each that
        is taken away.

    """

    onto: Floats
    residual: Floats
    pose: NDArray[np.intp]
    blocks: tuple[Block, ...]
    columns: Floats
    sizes: Floats
    products: Floats
    worth: float
    dof: int
    base_rss: float
    offset: Floats
    choice: float
    penalty: float = 0.0
    white: tuple[Floats, Floats] | None = None

    @cached_property
    def poses(self) -> int:
        """Return the number of poses."""
        return int(self.pose.max()) + 1

    @cached_property
    def kinds(self) -> int:
        """Return the number of effects tried; the covariates of all quantities count as one."""
        return len({kind_of(block.effect) for block in self.blocks})

    @cached_property
    def numbers_of(self) -> dict[str, NDArray[np.intp]]:
        """Return the blocks of each effect."""
        numbers: dict[str, list[int]] = {}
        for number, block in enumerate(self.blocks):
            numbers.setdefault(block.effect, []).append(number)
        return {effect: np.array(each) for effect, each in numbers.items()}

    @cached_property
    def by_width(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp], Floats]]:
        """Blocks of the same width: (k,) blocks, (k, w) columns, and (k, w, w) products."""
        return list(self._grouped(np.arange(len(self.blocks))))

    def _grouped(self, numbers: NDArray[np.intp]
                 ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Floats]]:
        ends = np.array([(block.columns.start, block.columns.stop) for block in self.blocks],
                        np.intp).reshape(-1, 2)[numbers]
        widths = ends[:, 1] - ends[:, 0]
        for width in np.unique(widths):
            index = ends[widths == width, :1] + np.arange(width)
            yield (numbers[widths == width], index,
                   self.products[index[:, :, np.newaxis], index[:, np.newaxis, :]])

    def effects_of(self, chosen: Set) -> tuple[str, ...]:
        """Return the names of the effects of a set."""
        return tuple(self.blocks[block].effect for block in chosen.blocks)

    def score(self, rss: Any, parameters: Any, charge: Any) -> Any:
        """Return the score of sets from their RSS, number of values and other charges."""
        whole = self.worth + self.dof
        fall = whole * np.log((self.worth + self.base_rss + 1e-300) / (
            self.worth + np.maximum(rss, 1e-12 * self.base_rss) + 1e-300))
        few = whole / np.maximum(whole - parameters - 1.0, 1e-9)
        return fall - few * parameters * math.log(max(self.dof, 2)) - charge - self.penalty

    def rss_of(self, score: float, chosen: Set) -> float:
        """Return the RSS with which a set has a score."""
        room = float(self.score(self.base_rss, chosen.parameters, chosen.charge)) - score
        ratio = math.exp(min(room / (self.worth + self.dof), _LARGEST_LOG))
        return (self.worth + self.base_rss) * ratio - self.worth

    def set_of(self, blocks: Sequence[int] = (), out: Iterable[int] = ()) -> Set:
        """Return the set of these blocks, with these poses left out."""
        out = tuple(sorted(out))
        if out not in self._of_poses:
            self._of_poses[out] = self._span_of(out)
        return self._grown(self._of_poses[out], blocks)

    @cached_property
    def _of_poses(self) -> dict[tuple[int, ...], _Span]:
        """Return the bases of the poses that were left out so far."""
        return {}

    def _span_of(self, out: tuple[int, ...]) -> _Span:
        rows = np.flatnonzero(np.isin(self.pose, out)) if out else np.zeros(0, np.intp)
        units: Floats = np.zeros((len(self.pose), len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        if out:
            units = np.linalg.qr(self.whitened(units - self.onto @ self.onto[rows].T))[0]
        white = self.whitened(units)
        across = np.column_stack([white.T @ self.columns, white.T @ self.residual])
        return _Span((), out, units, across, np.eye(len(rows)))

    def extended(self, before: Set, block: int) -> Set:
        """Return a set with one more block."""
        return self._grown(before.span, (block,))

    def instead(self, chosen: Set, blocks: Sequence[int]) -> Set:
        """Return the set of other blocks, with the same poses left out."""
        return self.set_of(blocks, chosen.out)

    def without(self, chosen: Set, block: int) -> Set:
        """Return a set without one of its blocks."""
        return self.instead(chosen, [other for other in chosen.blocks if other != block])

    def _grown(self, span: _Span, blocks: Sequence[int]) -> Set:
        """Return the set that spans these blocks, too."""
        for block in blocks:
            part = self.blocks[block].columns
            along = span.across[:, part]
            left = self.products[part] - along.T @ span.across
            size, axes = np.linalg.eigh(left[:, part])
            kept = _is_seen(size)
            span = span.beside(block, along, left, axes[:, kept] / np.sqrt(size[kept]))
        searched, cost = self._costs
        own = list(span.blocks)
        charge = float(np.sum(cost[own])) + self._unusual(span)
        charge += len(span.out) * (2.0 * math.log(max(self.poses, 2)) + _RARE)
        parameters = float(len(span.across) + np.sum(searched[own]))
        gain = span.across[:, -1] @ span.across[:, -1]
        rss = max(float(self.products[-1, -1] - gain), 0.0)
        return Set(span, rss, parameters, charge, float(self.score(rss, parameters, charge)))

    def spanned(self, chosen: Set) -> tuple[Floats, Floats]:
        """Return (m, q) orthonormal columns that span a set, and the (m,) residual beside it."""
        columns = self.whitened(self.columns[:, self._index(chosen.blocks)])
        onto = np.hstack([chosen.span.units, columns]) @ chosen.span.mix
        return onto, self.whitened(self.residual) - onto @ chosen.across[:, -1]

    def fewer(self, chosen: Set) -> list[Set]:
        """Return a set of several blocks without each of them."""
        several = chosen.blocks if len(chosen.blocks) > 1 else ()
        return [self.without(chosen, block) for block in several]

    def with_outliers(self, chosen: Set) -> list[Set]:
        """Return a set as it is, and with the outliers that it leaves, if they differ."""
        key = frozenset(chosen.blocks)
        if key not in self._outliers:
            self._outliers[key] = self._outliers_beside(
                self.set_of(chosen.blocks) if chosen.out else chosen)
        out = self._outliers[key]
        return [chosen] if out == chosen.out else [chosen, self.set_of(chosen.blocks, out)]

    @cached_property
    def _outliers(self) -> dict[frozenset[int], tuple[int, ...]]:
        """Return the outliers that were found so far, by the blocks beside them."""
        return {}

    def _outliers_beside(self, plain: Set) -> tuple[int, ...]:
        onto, residual = self.spanned(plain)
        return tuple(outliers_among(
            by_pose(residual, np.hstack([self.onto, onto]), self.pose), plain.rss,
            self.dof - int(plain.parameters), self.poses, noise_known=self.worth > 0.0
        ).poses.tolist())

    def _unusual(self, span: _Span) -> float:
        """Return the penalty for the sizes of the effects."""
        penalty = 0.0
        for block, values in self._values(span).items():
            size = float(np.max(np.abs(values))) / self.blocks[block].entry.typical
            penalty += min((max(math.log(max(size, 1e-300)), 0.0) / _USUAL) ** 2, _MOST_UNUSUAL)
        return penalty

    def values_of(self, chosen: Set) -> dict[int, Floats]:
        """Return the (p,) values of the effect of each block of a set."""
        return self._values(chosen.span)

    def _values(self, span: _Span) -> dict[int, Floats]:
        if not span.blocks:
            return {}
        index = self._index(span.blocks)
        left, right = self.products[index][:, index], self.products[-1, index]
        if span.out:
            across = span.across[:span.units.shape[1]]
            left = left - across[:, index].T @ across[:, index]
            right = right - across[:, index].T @ across[:, -1]
        values = np.linalg.lstsq(left, right, rcond=_DETERMINED)[0] / self.sizes[index]
        found: dict[int, Floats] = {}
        start = 0
        for block in span.blocks:
            part = self.blocks[block].columns
            count = part.stop - part.start
            found[block] = values[start:start + count]
            start += count
        return found

    def _index(self, blocks: Iterable[int]) -> list[int]:
        """Return the columns of these blocks."""
        return [column for block in blocks for column in range(
            self.blocks[block].columns.start, self.blocks[block].columns.stop)]

    def gains(self, beside: Set, effect: str = '') -> tuple[Floats, Floats]:
        """
        Return the (b,) gain of each block in addition to a set, and its (b,) rank.

        Both are 0 for the blocks of other effects, if one is given.

        """
        across = beside.across
        along = self.products[-1, :-1] - across[:, -1] @ across[:, :-1]
        gain, rank = np.zeros(len(self.blocks)), np.zeros(len(self.blocks))
        groups = self._grouped(self.numbers_of[effect]) if effect else self.by_width
        for numbers, index, products in groups:
            parts = np.moveaxis(across[:, index], 0, 2)
            gain[numbers], rank[numbers] = _explained(
                products - parts @ np.swapaxes(parts, 1, 2), along[index])
        return gain, rank

    def best_of(self, effect: str, beside: Set) -> int:
        """Return the block of an effect with the largest gain in addition to a set."""
        own = self.numbers_of[effect]
        return int(own[np.argmax(self.gains(beside, effect)[0][own])])

    @cached_property
    def _costs(self) -> tuple[Floats, Floats]:
        """(b,) arrays, values searched of each block, and what its choice costs."""
        return (np.array([block.searched for block in self.blocks], float),
                self.choice + 2.0 * np.log(np.array([block.tried for block in self.blocks])))

    def scores_beside(self, before: Set) -> Floats:
        """
        Return the (b,) scores with one more block, without the penalty for its size.

        They are -inf for a block that determines nothing.

        """
        gain, rank = self.gains(before)
        searched, cost = self._costs
        scores = self.score(before.rss - gain, before.parameters + rank + searched,
                            before.charge + cost)
        return np.where(rank > 0.0, scores, -np.inf)

    def whitened(self, columns: Floats) -> Floats:
        """Return (m,) or (m, q) columns outside of the base, whitened as the equations are."""
        if self.white is None:
            return columns
        axes, loss = self.white
        whitened: Floats = columns - axes @ ((axes.T @ columns).T * loss).T
        return whitened

    def probability(self, chosen: Set, block: int) -> float:
        """Return the probability that noise alone makes a block this good beside the others."""
        chance = self.chance(self.without(chosen, block), chosen)
        return min(1.0, chance * self.kinds * self.blocks[block].tried)

    def is_significant(self, chosen: Set) -> bool:
        """Return whether each effect of a set is significant beside the others."""
        return all(self.probability(chosen, block) < LEVEL for block in chosen.blocks)

    def chance(self, fewer: Set, more: Set) -> float:
        """Return the probability that noise alone makes a set this good beside a smaller one."""
        from scipy.special import fdtrc

        added = more.parameters - fewer.parameters
        left = self.worth + self.dof - more.parameters
        if added < 1 or left < 1:
            return 1.0
        variance = (self.worth + more.rss + 1e-300) / left
        return float(fdtrc(added, left, (fewer.rss - more.rss) / added / variance))


@dataclass(frozen=True)
class _Span:
    """
    An orthonormal basis of blocks and of poses that are left out, by its products.

    The columns `units` (m, k) span the poses. With those of the blocks, they are k' columns; times
    `mix` (k', q) they are the basis. `across` (q, c + 1) are the products of the basis with the
    columns of the problem and, last, with its residual.

    """

    blocks: tuple[int, ...]
    out: tuple[int, ...]
    units: Floats
    across: Floats
    mix: Floats

    def beside(self, block: int, along: Floats, left: Floats, new: Floats) -> _Span:
        """
        Return the span with a block of w columns.

        `along` (q, w) are the products of the basis with them, `left` (w, c + 1) those of their
        part outside of the basis with all columns, and `new` (w, r) makes this part orthonormal.

        """
        rows, count = self.mix.shape
        mix = np.zeros((rows + len(left), count + new.shape[1]))
        mix[:rows, :count], mix[:rows, count:] = self.mix, -self.mix @ (along @ new)
        mix[rows:, count:] = new
        return _Span((*self.blocks, block), self.out, self.units,
                     np.concatenate([self.across, new.T @ left]), mix)


@dataclass(frozen=True)
class Set:
    """
    Effects that are added to the base, and poses that are left out.

    Beside the `span` of both, the sum of squares `rss` is left. `parameters` is the number of
    values, with searched shapes and equations left out. `charge` is subtracted from the score
    apart from these values. `score` is the criterion, 0 for the base.

    """

    span: _Span = field(repr=False)
    rss: float
    parameters: float
    charge: float
    score: float

    @property
    def blocks(self) -> tuple[int, ...]:
        """Return the indices of the blocks of the effects."""
        return self.span.blocks

    @property
    def out(self) -> tuple[int, ...]:
        """Return the indices of the poses that are left out."""
        return self.span.out

    @property
    def across(self) -> Floats:
        """(q, c + 1) array, products of a basis of the set with the columns and the residual."""
        return self.span.across


def _is_seen(squares: Floats) -> NDArray[np.bool_]:
    """Return which directions of columns are outside of a basis, by their increasing squares."""
    return (squares > _SEEN ** 2) & (squares > _SEEN ** 2 * squares[..., -1:])


def _explained(products: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return what k blocks explain, and their ranks, from their products (k, w, w) and (k, w)."""
    width, size = along.shape[1], np.trace(products, axis1=1, axis2=2)
    # No eigenvalue is below this, as the others are at most `size` together.
    least = np.linalg.det(products) * (max(width - 1, 1) / np.maximum(size, _SEEN ** 2)) ** (
        width - 1)
    whole = least > _SEEN ** 2 * np.maximum(size, 1.0)
    gain, rank = np.zeros(len(size)), np.full(len(size), width)
    solved = np.linalg.solve(products[whole], along[whole][:, :, np.newaxis])[:, :, 0]
    gain[whole] = np.sum(along[whole] * solved, axis=1)
    squares, axes = np.linalg.eigh(products[~whole])
    kept = _is_seen(squares)
    towards = (along[~whole][:, np.newaxis] @ axes)[:, 0]
    gain[~whole] = np.sum(towards ** 2 * kept / np.where(kept, squares, 1.0), axis=1)
    rank[~whole] = np.sum(kept, axis=1)
    return gain, rank


def products_of(columns: Floats, residual: Floats) -> Floats:
    """Return the products of (m, c) columns and, last, an (m,) residual, (c + 1, c + 1)."""
    count = columns.shape[1]
    found = np.empty((count + 1, count + 1))
    np.matmul(columns.T, columns, out=found[:count, :count])
    found[count, :count] = found[:count, count] = columns.T @ residual
    found[count, count] = residual @ residual
    return found


def held_out(residual: Floats, own: Floats) -> Floats:
    """Return (m,) residuals without their own equation (PRESS), from (m,) 1 - leverage `own`."""
    predicted: Floats = residual / np.maximum(own, _LEAST_OWN)
    return predicted


def linearised(fit: Fit, base: tuple[str, ...], tried: Sequence[Candidate] = ()) -> Linear:
    """Return the linear problem at a fit, given the names of the base, and the candidates."""
    near, model = fit.equations, fit.model
    held = Model({name: values for name, values in model.values.items() if name in base})
    further = Model({name: values for name, values in model.values.items() if name not in base})
    residual = near.residual
    if further.values:
        residual = residual + near.columns(further) @ _amplitudes(further)
    onto = _orthonormal(near.columns(held)[:, held.fitted])
    residual = residual - onto @ (onto.T @ residual)
    blocks, raw = _blocks(near, fit.poses_g.columns, further, tried)
    columns, sizes = outside_of(onto, raw)
    kinds = len({kind_of(block.effect) for block in blocks})
    return Linear(onto, residual, near.pose, blocks, columns, sizes,
                  products_of(columns, residual), WORTH if near.noise_known else 0.0,
                  near.count - onto.shape[1], float(residual @ residual), near.columns(_OFFSET),
                  2.0 * math.log(1.0 + kinds))


def visible(fit: Fit, tried: Sequence[Candidate]) -> dict[str, float]:
    """Return the effect on the residuals of candidates of typical size beside a fit, per noise."""
    near, found = fit.equations, {}
    onto = _orthonormal(fit.columns)
    for each in tried:
        columns, sizes = outside_of(onto, near.columns_of(each.name, each.factors))
        own = columns.reshape(len(columns), len(each.shapes), -1).swapaxes(0, 1)
        sized = own * sizes.reshape(len(own), 1, -1)
        seen = _is_seen(np.linalg.eigvalsh(own.swapaxes(1, 2) @ own)).any(axis=1)
        if np.any(seen):
            squares = np.linalg.eigvalsh(sized.swapaxes(1, 2) @ sized)[seen, -1]
            found[each.name] = math.sqrt(np.max(squares)) * each.entry.typical
    return found


def outside_of(onto: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """Return (m, c) columns of norm 1 with a base projected out, and their (c,) norms before."""
    sizes = _norms(columns)
    columns = columns / sizes
    columns -= onto @ (onto.T @ columns)
    return columns, sizes


def _norms(columns: Floats) -> Floats:
    """Return the norms of columns, 1 for a column of zeros."""
    sizes: Floats = np.sqrt(np.einsum('mc,mc->c', columns, columns))
    sizes[sizes == 0.0] = 1.0
    return sizes


def _amplitudes(model: Model) -> Floats:
    """Return the (p,) values of a model with those of its shapes set to zero."""
    parts = [np.concatenate([values[:len(effect.parameters)], np.zeros(len(effect.shape))])
             for effect, values in zip(model.terms.effects, model.values.values(), strict=True)]
    return np.concatenate(parts)


def _orthonormal(columns: Floats) -> Floats:
    if not columns.shape[1]:
        return columns
    vectors, scales, _ = np.linalg.svd(columns / _norms(columns), full_matrices=False)
    return np.asarray(vectors[:, scales > 1e-6 * scales[0]])


def _blocks(near: Equations, context: Context, present: Model, tried: Sequence[Candidate]
            ) -> tuple[tuple[Block, ...], Floats]:
    """Return the blocks of the candidates, and their columns."""
    alike = Counter(kind_of(each.name) for each in tried)
    tried = [each.beside(present.values.get(each.name), context) for each in tried]
    widths = [len(each.shapes) * len(each.entry.parameters) for each in tried]
    columns = np.empty((len(near.pose), sum(widths)), order='F')
    blocks: list[Block] = []
    for each, start, width in zip(tried, np.cumsum([0, *widths]).tolist(), widths):
        columns[:, start:start + width] = near.columns_of(each.name, each.factors)
        blocks += each.blocks(start, alike[kind_of(each.name)])
    return tuple(blocks), columns
