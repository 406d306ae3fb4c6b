# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Sets of effects and outliers: their scores, and the search for the best one.

The search is a beam: it keeps the best few sets by the score of `.linear`, and extends each by one
effect at a time. After each extension the shapes are chosen again, and the outliers are found
again among all poses, with and without the earlier ones. So a pair may be found of which neither
effect is visible alone, and an effect is not judged by poses that were knocked. A set is accepted
only if each of its effects is significant beside the others.

**Random walk.** A walk of the offset (`.curves`) competes with the sets: the same search is done
with equations whitened for the walk, and its score includes the walk.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
import math

import numpy as np

from .linear import Block, is_seen, Linear, SEEN
from ..effects import fitted_places
from ..estimate import by_pose, outliers_among
from ..table import Floats

_DETERMINED = 1e-12
"""Smallest square of a relative singular value of the columns of values that are determined."""

_USUAL = 1.6
"""Standard deviation of the logarithm of the size of an effect relative to its typical size."""

_MOST_UNUSUAL = 6.0
"""Largest penalty for an unusual size."""

_RARE = 5.0
"""Additional cost of each pose that is left out: few poses are knocked."""

LEVEL = 0.01
"""Probability that any effect is named if there is no hidden effect."""

LARGEST = 5
"""Largest number of effects in a set."""

_WIDTH = 6
"""Number of sets that are extended."""

_BRANCHES = 6
"""Number of effects by which a set is extended."""

_TESTED = 12
"""Number of extended sets whose shapes and outliers are found again."""

_AS_GOOD = 2.0
"""Within this difference from the best score, the set with fewest values wins."""

_NEARLY = 0.3
"""Smallest share of the score of a set that a simpler set has before its shape is fitted."""

_PATIENCE = 2
"""The search ends if the best score has not risen for this number of extensions."""


@dataclass(frozen=True, eq=False)
class Set:
    """
    Effects that are added to the base, and poses that are left out.

    `blocks` are the indices of the blocks of the effects in the problem `linear`, and `out` those
    of the poses. The columns `units` (m, k) span the poses. With those of the blocks, they are k'
    columns; times `mix` (k', q) they are an orthonormal basis. `across` (q, c + 1) are the
    products of the basis with the columns of the problem and, last, with its residual.

    """

    linear: Linear = field(repr=False)
    blocks: tuple[int, ...]
    out: tuple[int, ...]
    units: Floats = field(repr=False)
    across: Floats = field(repr=False)
    mix: Floats = field(repr=False)

    @classmethod
    def of(cls, linear: Linear, blocks: Iterable[int] = (), out: Iterable[int] = ()) -> Set:
        """Return the set of these blocks, with these poses left out."""
        out = tuple(sorted(out))
        if out not in linear.without_poses:
            linear.without_poses[out] = cls._of_poses(linear, out)
        found: Set = linear.without_poses[out]
        for block in blocks:
            found = found.extended(block)
        return found

    @classmethod
    def _of_poses(cls, linear: Linear, out: tuple[int, ...]) -> Set:
        rows = np.flatnonzero(np.isin(linear.pose, out)) if out else np.zeros(0, np.intp)
        units: Floats = np.zeros((len(linear.pose), len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        if out:
            outside = units - linear.onto @ linear.onto[rows].T
            units = np.linalg.qr(linear.whitened(outside))[0]
        white = linear.whitened(units)
        across = np.column_stack([white.T @ linear.columns, white.T @ linear.residual])
        return cls(linear, (), out, units, across, np.eye(len(rows)))

    def extended(self, block: int) -> Set:
        """Return the set with one more block."""
        part = self.linear.blocks[block].columns
        along = self.across[:, part]
        left = self.linear.products[part] - along.T @ self.across
        size, axes = np.linalg.eigh(left[:, part])
        kept = is_seen(size)
        new = axes[:, kept] / np.sqrt(size[kept])
        rows, count = self.mix.shape
        mix = np.zeros((rows + len(left), count + new.shape[1]))
        mix[:rows, :count], mix[:rows, count:] = self.mix, -self.mix @ (along @ new)
        mix[rows:, count:] = new
        return replace(self, blocks=(*self.blocks, block), mix=mix,
                       across=np.concatenate([self.across, new.T @ left]))

    def instead(self, blocks: Iterable[int]) -> Set:
        """Return the set of other blocks, with the same poses left out."""
        return Set.of(self.linear, blocks, self.out)

    def within(self, linear: Linear) -> Set:
        """Return the same set in other equations with the same candidates."""
        return Set.of(linear, self.blocks, self.out)

    def without(self, block: int) -> Set:
        """Return the set without one of its blocks."""
        return self.instead(other for other in self.blocks if other != block)

    @property
    def fewer(self) -> list[Set]:
        """Return a set of several blocks without each of them."""
        return [self.without(block) for block in self.blocks if len(self.blocks) > 1]

    @property
    def with_outliers(self) -> list[Set]:
        """Return the set as it is, and with the outliers that it leaves, if they differ."""
        found, key = self.linear.outliers, frozenset(self.blocks)
        if key not in found:
            found[key] = (Set.of(self.linear, self.blocks) if self.out else self)._outliers
        out = found[key]
        return [self] if out == self.out else [self, Set.of(self.linear, self.blocks, out)]

    @property
    def _outliers(self) -> tuple[int, ...]:
        linear, (onto, residual) = self.linear, self.spanned
        return tuple(outliers_among(
            by_pose(residual, np.hstack([linear.onto, onto]), linear.pose), self.rss,
            linear.dof - int(self.parameters), linear.poses, noise_known=linear.worth > 0.0
        ).poses.tolist())

    @cached_property
    def rss(self) -> float:
        """Return the sum of squares that is left."""
        gain = self.across[:, -1] @ self.across[:, -1]
        return max(float(self.linear.products[-1, -1] - gain), 0.0)

    @cached_property
    def parameters(self) -> float:
        """Return the number of values, with searched shapes and equations left out."""
        return float(len(self.across) + np.sum(self.linear.costs[0][list(self.blocks)]))

    @cached_property
    def charge(self) -> float:
        """Return what is subtracted from the score apart from the number of values."""
        charge = float(np.sum(self.linear.costs[1][list(self.blocks)]))
        for block, values in self.values.items():
            size = float(np.max(np.abs(values))) / self.linear.blocks[block].entry.typical
            charge += min((max(math.log(max(size, 1e-300)), 0.0) / _USUAL) ** 2, _MOST_UNUSUAL)
        return charge + len(self.out) * (2.0 * math.log(max(self.linear.poses, 2)) + _RARE)

    @cached_property
    def score(self) -> float:
        """Return the criterion, 0 for the base."""
        return float(self.linear.score(self.rss, self.parameters, self.charge))

    @cached_property
    def effects(self) -> tuple[str, ...]:
        """Return the names of the effects."""
        return tuple(self.linear.blocks[block].effect for block in self.blocks)

    @cached_property
    def entries(self) -> list[Block]:
        """Return the blocks."""
        return [self.linear.blocks[block] for block in self.blocks]

    @cached_property
    def values(self) -> dict[int, Floats]:
        """Return the (p,) values of the effect of each block."""
        if not self.blocks:
            return {}
        index, linear = self._index, self.linear
        left, right = linear.products[index][:, index], linear.products[-1, index]
        if self.out:
            across = self.across[:self.units.shape[1]]
            left = left - across[:, index].T @ across[:, index]
            right = right - across[:, index].T @ across[:, -1]
        values = np.linalg.lstsq(left, right, rcond=_DETERMINED)[0] / linear.sizes[index]
        ends = np.cumsum([each.columns.stop - each.columns.start for each in self.entries])
        return dict(zip(self.blocks, np.split(values, ends[:-1]), strict=True))

    @property
    def _index(self) -> list[int]:
        """Return the columns of the blocks."""
        return [column for each in self.entries
                for column in range(each.columns.start, each.columns.stop)]

    @property
    def spanned(self) -> tuple[Floats, Floats]:
        """Return (m, q) orthonormal columns that span the set, and the (m,) residual beside it."""
        columns = self.linear.whitened(self.linear.columns[:, self._index])
        onto = np.hstack([self.units, columns]) @ self.mix
        return onto, self.linear.whitened(self.linear.residual) - onto @ self.across[:, -1]

    def gains(self, effect: str = '') -> tuple[Floats, Floats]:
        """
        Return the (b,) gain of each block in addition to the set, and its (b,) rank.

        Both are 0 for the blocks of other effects, if one is given.

        """
        linear, across = self.linear, self.across
        along = linear.products[-1, :-1] - across[:, -1] @ across[:, :-1]
        gain, rank = np.zeros(len(linear.blocks)), np.zeros(len(linear.blocks))
        groups = linear.grouped(linear.numbers_of[effect]) if effect else linear.by_width
        for numbers, index, products in groups:
            parts = np.moveaxis(across[:, index], 0, 2)
            gain[numbers], rank[numbers] = _explained(
                products - parts @ np.swapaxes(parts, 1, 2), along[index])
        return gain, rank

    def best_of(self, effect: str) -> int:
        """Return the block of an effect with the largest gain in addition to the set."""
        own = self.linear.numbers_of[effect]
        return int(own[np.argmax(self.gains(effect)[0][own])])

    @property
    def scores_beside(self) -> Floats:
        """
        Return the (b,) scores with one more block, without the penalty for its size.

        They are -inf for a block that determines nothing.

        """
        gain, rank = self.gains()
        searched, cost = self.linear.costs
        scores = self.linear.score(self.rss - gain, self.parameters + rank + searched,
                                   self.charge + cost)
        return np.where(rank > 0.0, scores, -np.inf)

    def probability(self, block: int) -> float:
        """Return the probability that noise alone makes a block this good beside the others."""
        chance = self.chance(self.without(block))
        return min(1.0, chance * self.linear.kinds * self.linear.blocks[block].tried)

    @property
    def is_significant(self) -> bool:
        """Return whether each effect of the set is significant beside the others."""
        return all(self.probability(block) < LEVEL for block in self.blocks)

    def chance(self, fewer: Set) -> float:
        """Return the probability that noise alone makes the set this good beside a smaller one."""
        from scipy.special import fdtrc

        worth, added = self.linear.worth, self.parameters - fewer.parameters
        left = worth + self.linear.dof - self.parameters
        if added < 1 or left < 1:
            return 1.0
        variance = (worth + self.rss + 1e-300) / left
        return float(fdtrc(added, left, (fewer.rss - self.rss) / added / variance))


def _explained(products: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return what k blocks explain, and their ranks, from their products (k, w, w) and (k, w)."""
    width, size = along.shape[1], np.trace(products, axis1=1, axis2=2)
    # No eigenvalue is below this, as the others are at most `size` together.
    least = np.linalg.det(products) * (max(width - 1, 1) / np.maximum(size, SEEN ** 2)) ** (
        width - 1)
    whole = least > SEEN ** 2 * np.maximum(size, 1.0)
    gain, rank = np.zeros(len(size)), np.full(len(size), width)
    solved = np.linalg.solve(products[whole], along[whole][:, :, np.newaxis])[:, :, 0]
    gain[whole] = np.sum(along[whole] * solved, axis=1)
    squares, axes = np.linalg.eigh(products[~whole])
    kept = is_seen(squares)
    towards = (along[~whole][:, np.newaxis] @ axes)[:, 0]
    gain[~whole] = np.sum(towards ** 2 * kept / np.where(kept, squares, 1.0), axis=1)
    rank[~whole] = np.sum(kept, axis=1)
    return gain, rank


def explored(linear: Linear) -> list[Set]:
    """Return the sets visited, the best score first."""
    front = _distinct(Set.of(linear).with_outliers)
    visited = list(front)
    best, idle = max(chosen.score for chosen in front), 0
    for _ in range(LARGEST):
        larger = _distinct(new for before in front for new in _extended(before))
        larger = [_with_best_shapes(new) for new in larger[:_TESTED]]
        front = _distinct(each for new in larger for each in new.with_outliers)[:_WIDTH]
        if not front:
            break
        visited += [*front, *(fewer for new in front[:3] for fewer in new.fewer)]
        idle = 0 if front[0].score > best else idle + 1
        best = max(best, front[0].score)
        if idle == _PATIENCE:
            break
    return _distinct(visited)


def simpler(chosen: Set) -> list[Set]:
    """
    Return sets with one effect less, in which another effect has the best searched shape.

    Between the shapes that are tried, two effects may imitate one: an offset that changes with
    temperature and with its rate is one that lags.

    """
    blocks, fitted = chosen.linear.blocks, dict[str, list[int]]()
    for number, block in enumerate(blocks):
        if block.searched and fitted_places(block.entry, block.shape):
            fitted.setdefault(block.effect, []).append(number)
    sets = []
    for less in chosen.fewer:
        for effect, own in fitted.items():
            others = less.instead(number for number in less.blocks
                                  if blocks[number].effect != effect)
            if _is_barred(blocks[own[0]], others.entries):
                continue
            gain, _ = others.gains(effect)
            new = others.extended(max(own, key=lambda number: gain[number]))
            if new.score > _NEARLY * chosen.score:
                sets.append(new)
    return sets


def accepted(visited: Iterable[Set]) -> Iterator[Set]:
    """Yield the sets whose effects are all significant, the preferred one first."""
    left = sorted(visited, key=lambda chosen: -chosen.score)
    while left:
        near: list[Set] = []
        for chosen in left:
            if near and chosen.score < near[0].score - _AS_GOOD:
                break
            if chosen.is_significant:
                near.append(chosen)
        if not near:
            return
        best = min(near, key=lambda chosen: (
            chosen.parameters, any('new' in each.entry.needs for each in chosen.entries),
            -chosen.score))
        yield best
        left = [chosen for chosen in left if chosen is not best]


def _extended(before: Set) -> list[Set]:
    """Return the set with one more effect, for the effects with the best scores."""
    linear, scores = before.linear, before.scores_beside
    best: dict[str, tuple[float, int]] = {}
    for effect, numbers in linear.numbers_of.items():
        number = int(numbers[np.argmax(scores[numbers])])
        if scores[number] > -np.inf and not _is_barred(linear.blocks[number], before.entries):
            best[effect] = float(scores[number]), number
    return [before.extended(number)
            for _, number in sorted(best.values(), reverse=True)[:_BRANCHES]]


def _is_barred(block: Block, present: Iterable[Block]) -> bool:
    """Return whether one of the effects present is that of a block, contains it or is in it."""
    return any(block.effect == other.effect or block.effect in other.entry.includes
               or other.effect in block.entry.includes for other in present)


def _with_best_shapes(chosen: Set) -> Set:
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


def _distinct(sets: Iterable[Set]) -> list[Set]:
    """Return the best set of each list of names and outliers, the best score first."""
    best: dict[tuple[frozenset[str], tuple[int, ...]], Set] = {}
    for chosen in sorted(sets, key=lambda chosen: -chosen.score):
        best.setdefault((frozenset(chosen.effects), chosen.out), chosen)
    return list(best.values())
