# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The equations near a model as a linear problem: candidates as columns, and sets of them.

With the model of the base projected out, the equations are

    residual = columns · values + noise of variance λ

One block of columns belongs to one effect with one shape. A set is a choice of blocks, with
poses that are left out; leaving a pose out is a further column, 1 at the pose and 0 elsewhere.
To first order, the gain of a set is that of the joint fit of all its values. It depends only on
the products of the columns with each other and with the residual. Those of the blocks that a
search chooses are computed once, and the others never. A set is then a part of their Cholesky
factor, at a cost that does not depend on the number of poses, and the gains of all blocks beside a
set are computed at once.

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

`extend_each` extends sets by one effect, `choose_shapes` chooses the shapes of their effects
again, and `with_outliers` finds their outliers: the steps of the search in `.settle`.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, groupby
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
import scipy

from ..effects import Effect, EffectKey, kind_of
from ..estimate import by_pose, outliers_among
from ..table import Floats

SEEN = 0.02
"""Smallest part of a column outside of the model; otherwise it cannot be distinguished."""

LEVEL = 0.01
"""Probability that any effect is named if there is no hidden effect."""

_USUAL = 1.6
"""Standard deviation of the logarithm of the size of an effect relative to its typical size."""

_MOST_UNUSUAL = 6.0
"""Largest penalty for an unusual size."""

_RARE = 5.0
"""Additional cost of each pose that is left out: few poses are knocked."""

LEAST_OWN = 0.02
"""Smallest 1 - leverage; below it, an equation alone determines a value."""

_BRANCHES = 5
"""Number of effects by which a set is extended."""

_TESTED = 6
"""Number of extended sets whose shapes and outliers are found again."""

DECIMALS = 6
"""Decimals of scores and probabilities that are sorted: not the last bit of a processor decides,
and equal ones keep their order."""


class Block(NamedTuple):
    """Columns of an effect with one (s,) shape, its values searched, and the shapes tried."""

    effect: EffectKey
    shape: Floats
    columns: slice
    entry: Effect
    searched: int = 0
    tried: float = 1.0


Group = tuple[NDArray[np.intp], NDArray[np.intp], Floats]
"""Blocks of the same width, as in `Linear.by_width`."""


@dataclass(frozen=True)
class Linear:
    """
    The equations of all poses near a model, with the base projected out.

    The orthonormal columns `onto` (m, p) span the base. `pose` (m,) is the index of the pose of
    each equation. `every` (c + 1, m) has as rows the columns of all blocks outside of the base,
    relative to their norms `sizes` (c,) before it was projected out, and last the residual of the
    base, in units of the noise. `worth` is ν, 0 if the noise is not known. `dof` is N, the number
    of independent equations minus that of values of the base. Scores are relative to `base_rss`,
    the residual sum of squares of the base. `offset` (m, 3) are the columns of an offset. `choice`
    is the cost of the choice of one effect among the candidates, and `penalty` that of a walk,
    which is subtracted from all scores. The products of the rows of `taken` (c + 1, r) are
    subtracted from those of `every`, after whitening or without some poses. `white` has (m, r)
    orthonormal directions along which the equations are whitened, the (r,) part of each that is
    taken away, and their (r, c + 1) products with the columns and the residual.

    What was computed so far is kept: in `made` the products of blocks, in `outliers` those found
    beside blocks, and in `without_poses` `root` and `across` of the sets without effects, by the
    poses left out.

    """

    onto: Floats
    pose: NDArray[np.intp]
    blocks: tuple[Block, ...]
    every: Floats
    sizes: Floats
    worth: float
    dof: int
    base_rss: float
    offset: Floats
    choice: float
    penalty: float = 0.0
    taken: Floats | None = None
    white: tuple[Floats, Floats, Floats] | None = None
    made: dict[int, Floats] = field(default_factory=dict, init=False)
    outliers: dict[frozenset[int], tuple[int, ...]] = field(default_factory=dict, init=False)
    without_poses: dict[tuple[int, ...], tuple[Floats, Floats]] = field(
        default_factory=dict, init=False)

    @property
    def columns(self) -> Floats:
        """Return the (m, c) columns of all blocks."""
        return self.every[:-1].T

    @property
    def residual(self) -> Floats:
        """Return the (m,) residual of the base."""
        return np.asarray(self.every[-1])

    @cached_property
    def poses(self) -> int:
        """Return the number of poses."""
        return int(self.pose.max()) + 1

    @cached_property
    def kinds(self) -> int:
        """Return the number of effects tried; the covariates of all quantities count as one."""
        return len({kind_of(block.effect) for block in self.blocks})

    @cached_property
    def numbers_of(self) -> dict[EffectKey, NDArray[np.intp]]:
        numbers: dict[EffectKey, list[int]] = {}
        for number, block in enumerate(self.blocks):
            numbers.setdefault(block.effect, []).append(number)
        return {effect: np.array(each) for effect, each in numbers.items()}

    def _products(self, one: Any, other: Any) -> Floats:
        """Return the products of two selections of the columns and the residual."""
        found = self.every[one] @ self.every[other].T
        return found if self.taken is None else found - self.taken[one] @ self.taken[other].T

    @cached_property
    def with_residual(self) -> Floats:
        """Return the (c + 1,) products of the residual with the columns and itself."""
        # By a dot product as `base_rss`: the score of the base is exactly 0.
        return np.append(self._products(slice(-1), -1), self._products(-1, -1))

    def products_with(self, blocks: Sequence[int]) -> list[Floats]:
        """Return the (w, c + 1) products of each block with all columns and the residual."""
        new = [block for block in blocks if block not in self.made]
        if new:
            parts = [self.blocks[block].columns for block in new]
            ends = np.cumsum([part.stop - part.start for part in parts])
            index = [column for part in parts for column in range(part.start, part.stop)]
            self.made.update(zip(new, np.split(self._products(index, slice(None)), ends[:-1])))
        return [self.made[block] for block in blocks]

    @cached_property
    def by_width(self) -> list[Group]:
        """Blocks of the same width: (k,) blocks, (k, w) columns, and (k, w, w) products."""
        found: dict[int, list[tuple[Any, Any, Any]]] = {}
        first = 0
        for width, run in groupby(each.columns.stop - each.columns.start for each in self.blocks):
            count, start = len(list(run)), self.blocks[first].columns.start
            own = slice(start, start + count * width)
            parts = self.every[own].reshape(count, width, -1)
            products = parts @ parts.swapaxes(1, 2)
            if self.taken is not None:
                parts = self.taken[own].reshape(count, width, -1)
                products -= parts @ parts.swapaxes(1, 2)
            index = np.arange(own.start, own.stop).reshape(count, width)
            found.setdefault(width, []).append((first + np.arange(count), index, products))
            first += count
        return [(np.concatenate(numbers), np.concatenate(index), np.concatenate(products))
                for numbers, index, products in (zip(*parts) for parts in found.values())]

    def score(self, rss: Any, parameters: Any, charge: Any) -> Any:
        """Return the score of sets from their RSS, number of values and other charges."""
        whole = self.worth + self.dof
        fall = whole * np.log((self.worth + self.base_rss + 1e-300) / (
            self.worth + np.maximum(rss, 1e-12 * self.base_rss) + 1e-300))
        few = whole / np.maximum(whole - parameters - 1.0, 1e-9)
        return fall - few * parameters * math.log(max(self.dof, 2)) - charge - self.penalty

    @cached_property
    def costs(self) -> tuple[Floats, Floats]:
        """(b,) arrays, values searched of each block, and what its choice costs."""
        return (np.array([block.searched for block in self.blocks], float),
                self.choice + 2.0 * np.log(np.array([block.tried for block in self.blocks])))

    def whitened(self, columns: Floats) -> Floats:
        """Return (m,) or (m, q) columns outside of the base, whitened as the equations are."""
        if self.white is None:
            return columns
        axes, loss, _ = self.white
        return columns - axes @ ((axes.T @ columns).T * loss).T

    def rows_of(self, poses: tuple[int, ...]) -> NDArray[np.intp]:
        """Return the indices of the equations of poses."""
        return np.flatnonzero(np.isin(self.pose, poses)) if poses else np.zeros(0, np.intp)


@dataclass(frozen=True, eq=False)
class Set:
    """
    Effects that are added to the base, and poses that are left out.

    `blocks` are the indices of the blocks of the effects in the problem `linear`, and `out` those
    of the poses. The columns of the k equations of these poses are orthonormal times `root`
    (k, k). With those of the blocks, they are k' columns; times `mix` (k', q) they are an
    orthonormal basis. `across` (q, c + 1) are the products of the basis with the columns of the
    problem and, last, with its residual.

    """

    linear: Linear = field(repr=False)
    blocks: tuple[int, ...]
    out: tuple[int, ...]
    root: Floats = field(repr=False)
    across: Floats = field(repr=False)
    mix: Floats = field(repr=False)

    @classmethod
    def of(cls, linear: Linear, blocks: Iterable[int] = (), out: Iterable[int] = ()) -> Set:
        out = tuple(sorted(out))
        if out not in linear.without_poses:
            rows = linear.rows_of(out)
            own, across = linear.onto[rows], linear.every[:, rows].T.copy()
            left = np.eye(len(rows)) - own @ own.T
            if linear.white is not None:
                axes, loss, along = linear.white
                taken = axes[rows] * (loss * (2.0 - loss))
                left -= taken @ axes[rows].T
                across -= taken @ along
            size, turn = np.linalg.eigh(left)
            root = turn / np.sqrt(np.maximum(size, 1e-12))  # against division by zero
            linear.without_poses[out] = root, root.T @ across
        root, across = linear.without_poses[out]
        found = cls(linear, (), out, root, across, mix=np.eye(len(across)))
        for block in blocks:
            found = found.extended(block)
        return found

    def extended(self, block: int) -> Set:
        part = self.linear.blocks[block].columns
        along = self.across[:, part]
        left = self.linear.products_with([block])[0] - along.T @ self.across
        size, axes = np.linalg.eigh(left[:, part])
        kept = is_seen(size)
        new = axes[:, kept] / np.sqrt(size[kept])
        rows, count = self.mix.shape
        mix = np.zeros((rows + len(left), count + new.shape[1]))
        mix[:rows, :count], mix[:rows, count:] = self.mix, -self.mix @ (along @ new)
        mix[rows:, count:] = new
        return Set(self.linear, (*self.blocks, block), self.out, self.root,
                   np.concatenate([self.across, new.T @ left]), mix=mix)

    def instead(self, blocks: Iterable[int]) -> Set:
        """Return the set of other blocks, with the same poses left out."""
        return Set.of(self.linear, blocks, self.out)

    def within(self, linear: Linear) -> Set:
        """Return the same set in other equations with the same candidates."""
        return Set.of(linear, self.blocks, self.out)

    def without(self, *effects: EffectKey) -> Set:
        return self.instead(block for block in self.blocks
                            if self.linear.blocks[block].effect not in effects)

    @property
    def smaller(self) -> list[Set]:
        """Return a set of several effects without each of them."""
        return [self.without(effect) for effect in self.effects if len(self.blocks) > 1]

    @cached_property
    def rss(self) -> float:
        gain = self.across[:, -1] @ self.across[:, -1]
        return max(float(self.linear.with_residual[-1] - gain), 0.0)

    @cached_property
    def parameters(self) -> float:
        """Return the number of values, with searched shapes and equations left out."""
        return float(len(self.across) + np.sum(self.linear.costs[0][list(self.blocks)]))

    @cached_property
    def charge(self) -> float:
        """Return what is subtracted from the score apart from the number of values."""
        charge = float(np.sum(self.linear.costs[1][list(self.blocks)])) + self.unusual
        return charge + len(self.out) * (2.0 * math.log(max(self.linear.poses, 2)) + _RARE)

    @cached_property
    def unusual(self) -> float:
        """Return the penalty for effects that are far larger than in common sensors."""
        if not self.blocks:
            return 0.0
        largest = np.array([np.max(np.abs(part)) for part in self.parts.values()])
        typical = [each.entry.typical for each in self.entries]
        away = np.log(np.maximum(largest / typical, 1.0)) / _USUAL
        return float(np.sum(np.minimum(away ** 2, _MOST_UNUSUAL)))

    @cached_property
    def score(self) -> float:
        """Return the criterion, 0 for the base."""
        return float(self.linear.score(self.rss, self.parameters, self.charge))

    @cached_property
    def entries(self) -> list[Block]:
        return [self.linear.blocks[block] for block in self.blocks]

    @cached_property
    def effects(self) -> tuple[EffectKey, ...]:
        return tuple(each.effect for each in self.entries)

    @cached_property
    def parts(self) -> dict[int, Floats]:
        """Return the (p,) values of the columns of each block."""
        values = self.mix[len(self.root):] @ self.across[:, -1] / self.linear.sizes[self._index]
        ends = accumulate(each.columns.stop - each.columns.start for each in self.entries)
        return dict(zip(self.blocks, np.split(values, list(ends))))

    @property
    def values(self) -> dict[EffectKey, Floats]:
        """Return the values of each effect, which end with those of its shape."""
        return {each.effect: np.concatenate([part, each.shape])
                for each, part in zip(self.entries, self.parts.values(), strict=True)}

    @property
    def _index(self) -> list[int]:
        return [column for each in self.entries
                for column in range(each.columns.start, each.columns.stop)]

    @property
    def spanned(self) -> tuple[Floats, Floats]:
        """Return (m, q) orthonormal columns that span the set, and the (m,) residual beside it."""
        linear, count = self.linear, len(self.root)
        onto = linear.whitened(linear.columns[:, self._index]) @ self.mix[count:]
        if self.out:
            rows = linear.rows_of(self.out)
            units = -linear.onto @ linear.onto[rows].T
            units[rows, np.arange(count)] += 1.0
            onto += linear.whitened(units) @ (self.root @ self.mix[:count])
        return onto, linear.whitened(linear.residual) - onto @ self.across[:, -1]

    def gains(self, effect: EffectKey | None = None) -> tuple[Floats, Floats]:
        """Return (b,) gains and ranks of the blocks beside the set; 0 for other effects."""
        linear, across = self.linear, self.across
        along = linear.with_residual[:-1] - across[:, -1] @ across[:, :-1]
        gain, rank = np.zeros(len(linear.blocks)), np.zeros(len(linear.blocks))
        groups = linear.by_width
        if effect is not None:  # its blocks are consecutive
            first, last = linear.numbers_of[effect][[0, -1]]
            ranges = [(group, slice(*np.searchsorted(group[0], (first, last + 1))))
                      for group in groups]
            groups = [(own[part], index[part], products[part])
                      for (own, index, products), part in ranges if part.start < part.stop]
        for numbers, index, left in self.beside(groups):
            gain[numbers], rank[numbers] = _explained(left, along[index])
        return gain, rank

    def beside(self, groups: Iterable[Group]) -> Iterator[Group]:
        """Yield blocks as `Linear.by_width`, with their products beside the set."""
        for numbers, index, products in groups:
            parts = np.moveaxis(self.across[:, index], 0, 2)
            yield numbers, index, products - parts @ np.swapaxes(parts, 1, 2)

    def best_of(self, effect: EffectKey) -> int:
        """Return the block of an effect with the largest gain in addition to the set."""
        own = self.linear.numbers_of[effect]
        return int(own[np.argmax(self.gains(effect)[0][own])])

    @property
    def scores_beside(self) -> Floats:
        """Return the (b,) scores with one more block, before the penalty for its size, or -inf."""
        gain, rank = self.gains()
        searched, cost = self.linear.costs
        scores = self.linear.score(self.rss - gain, self.parameters + rank + searched,
                                   self.charge + cost)
        return np.where(rank > 0.0, scores, -np.inf)

    def probability(self, effect: EffectKey) -> float:
        """Return the probability that noise alone makes an effect this good beside the others."""
        chance, own = self.chance(self.without(effect)), self.entries[self.effects.index(effect)]
        return min(1.0, chance * self.linear.kinds * own.tried)

    @property
    def left(self) -> float:
        """Return the degrees of freedom of the variance."""
        return self.linear.worth + self.linear.dof - self.parameters

    @property
    def variance(self) -> float:
        """Return the moderated variance of an equation, in units of the noise."""
        return (self.linear.worth + self.rss + 1e-300) / max(self.left, 1.0)

    def chance(self, fewer: Set) -> float:
        """Return the probability that noise alone makes the set this good beside a smaller one."""
        added = self.parameters - fewer.parameters
        if added < 1 or self.left < 1:
            return 1.0
        ratio = (fewer.rss - self.rss) / added / self.variance
        return float(scipy.special.fdtrc(added, self.left, ratio))


def with_outliers(sets: Iterable[Set]) -> Iterator[Set]:
    """Yield sets of one problem as they are, and with the outliers that each leaves, if others."""
    sets = list(sets)
    new = {frozenset(chosen.blocks): Set.of(chosen.linear, chosen.blocks) if chosen.out else chosen
           for chosen in sets if frozenset(chosen.blocks) not in chosen.linear.outliers}
    if new:  # at once, which is faster
        linear, spanned = sets[0].linear, [whole.spanned for whole in new.values()]
        parts = [by_pose(residual, np.hstack([linear.onto, onto]), linear.pose)
                 for onto, residual in spanned]
        basis = np.zeros((len(parts), *parts[0].residual.shape,
                          max(part.columns.shape[2] for part in parts)))
        for own, part in zip(basis, parts, strict=True):
            own[:, :, :part.columns.shape[2]] = part.columns
        found = outliers_among(np.stack([part.residual for part in parts]), basis, parts[0].rows,
                               [linear.dof - int(whole.parameters) for whole in new.values()],
                               linear.poses, noise_known=linear.worth > 0.0)
        linear.outliers.update(zip(new, (tuple(out.tolist()) for out in found), strict=True))
    for chosen in sets:
        yield chosen
        out = chosen.linear.outliers[frozenset(chosen.blocks)]
        if out != chosen.out:
            yield Set.of(chosen.linear, chosen.blocks, out)


def _explained(products: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return what k blocks explain, and their ranks, from their products (k, w, w) and (k, w)."""
    width, size = along.shape[1], np.trace(products, axis1=1, axis2=2)
    if width == 1:
        seen = size > SEEN ** 2
        return along[:, 0] ** 2 * seen / np.where(seen, size, 1.0), seen.astype(float)
    # No eigenvalue is below this, as the others are at most `size` together.
    least = np.linalg.det(products) * ((width - 1) / np.maximum(size, SEEN ** 2)) ** (width - 1)
    whole = least > SEEN ** 2 * np.maximum(size, 1.0)
    gain, rank = np.zeros(len(size)), np.full(len(size), width)
    solved = np.linalg.solve(products[whole], along[whole][:, :, np.newaxis])[:, :, 0]
    gain[whole] = np.sum(along[whole] * solved, axis=1)
    if np.all(whole):
        return gain, rank
    squares, axes = np.linalg.eigh(products[~whole])
    kept = is_seen(squares)
    towards = (along[~whole][:, np.newaxis] @ axes)[:, 0]
    gain[~whole] = np.sum(towards ** 2 * kept / np.where(kept, squares, 1.0), axis=1)
    rank[~whole] = np.sum(kept, axis=1)
    return gain, rank


def is_seen(squares: Floats) -> NDArray[np.bool_]:
    """Return which directions of columns are outside of a basis, by their increasing squares."""
    return (squares > SEEN ** 2) & (squares > SEEN ** 2 * squares[..., -1:])


def extend_each(front: list[Set]) -> list[Set]:
    """Return the best sets with one effect more than those of a front."""
    likely: list[tuple[float, Set, int]] = []  # the largest possible score, a set, a new block
    for before in front:
        linear, scores = before.linear, before.scores_beside
        tops: dict[EffectKey, tuple[float, int]] = {}
        for effect, numbers in linear.numbers_of.items():
            number = int(numbers[np.argmax(scores[numbers])])
            if scores[number] > -np.inf and not is_barred(linear.blocks[number], before.entries):
                tops[effect] = round(float(scores[number]), DECIMALS), number
        likely += [(score + before.unusual, before, number) for score, number in sorted(
            tops.values(), key=lambda each: -each[0])[:_BRANCHES]]
    likely.sort(key=lambda each: -each[0])
    front[0].linear.products_with([number for _, _, number in likely[:_TESTED]])  # at once: fast
    best: list[Set] = []
    for most, before, number in likely:
        if len(best) == _TESTED and best[-1].score > most:
            break
        best = best_of_each([*best, before.extended(number)])[:_TESTED]
    return best


def choose_shapes(chosen: Set) -> Set:
    """Choose the shape of each effect again, with the others as they are."""
    for place, number in enumerate(chosen.blocks[:-1]):
        effect = chosen.effects[place]
        if len(chosen.linear.numbers_of[effect]) == 1:
            continue
        before, after = chosen.blocks[:place], chosen.blocks[place + 1:]
        best = chosen.instead((*before, *after)).best_of(effect)
        if best != number:
            new = chosen.instead((*before, best, *after))
            chosen = max(chosen, new, key=lambda either: either.score)
    return chosen


def best_of_each(sets: Iterable[Set]) -> list[Set]:
    """Return the best set of each list of effects and outliers, the best score first."""
    best: dict[tuple[frozenset[EffectKey], tuple[int, ...]], Set] = {}
    for chosen in sorted(sets, key=lambda chosen: -round(chosen.score, DECIMALS)):
        best.setdefault((frozenset(chosen.effects), chosen.out), chosen)
    return list(best.values())


def is_barred(block: Block, present: Iterable[Block]) -> bool:
    """Return whether one of the effects present is that of a block, contains it or is in it."""
    return any(block.effect == other.effect or block.effect in other.entry.includes
               or other.effect in block.entry.includes for other in present)
