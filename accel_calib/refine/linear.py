# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The equations near a model as a linear problem: candidates as columns, and sets of them.

With the model of the base projected out, the equations are

    residual = columns · values + noise of variance λ

One block of columns belongs to one effect with one shape. A set is a choice of blocks, with
poses that are left out; leaving a pose out is a further column, 1 at the pose and 0 elsewhere.
To first order, the gain of a set is that of the joint fit of all its values, at the cost of one
projection. The gain of every block beside a set is computed at once, by one matrix product.

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
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..effects import Context, Effect, effect_named, kind_of, Model
from ..estimate import by_pose, Equations, Fit, outliers_among
from ..table import Floats

WORTH = 4.0
"""ν, degrees of freedom that the measured noise counts as."""

LEVEL = 0.01
"""Probability that any effect is named if there is no hidden effect."""

_SEEN = 0.02
"""Smallest part of a column outside of the model; otherwise it cannot be distinguished."""

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
        Orthonormal directions along which the equations were whitened, and the part of each that
        was taken away.

    """

    onto: Floats
    residual: Floats
    pose: NDArray[np.intp]
    blocks: tuple[Block, ...]
    columns: Floats
    sizes: Floats
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
    def along(self) -> Floats:
        """(c,) array, products of the columns with the residual."""
        return self.columns.T @ self.residual

    @cached_property
    def by_width(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp], Floats]]:
        """Blocks of the same width: (k,) blocks, (k, w) columns, and (k, w, w) products."""
        numbers_of: dict[int, list[int]] = {}
        for number, block in enumerate(self.blocks):
            numbers_of.setdefault(block.columns.stop - block.columns.start, []).append(number)
        groups: list[tuple[NDArray[np.intp], NDArray[np.intp], Floats]] = []
        for width, numbers in numbers_of.items():
            starts = np.array([self.blocks[number].columns.start for number in numbers], np.intp)
            index = starts[:, np.newaxis] + np.arange(width)
            products = np.empty((len(numbers), width, width))
            for i in range(width):
                for j in range(i, width):
                    pair = self.columns[:, index[:, i]], self.columns[:, index[:, j]]
                    products[:, i, j] = np.einsum('mk,mk->k', *pair)
                    products[:, j, i] = products[:, i, j]
            groups.append((np.array(numbers, np.intp), index, products))
        return groups

    def effects_of(self, chosen: Set) -> tuple[str, ...]:
        """Return the names of the effects of a set."""
        return tuple(self.blocks[block].effect for block in chosen.blocks)

    def score(self, rss: float, parameters: float, charge: float) -> float:
        """Return the score of a set from its RSS, number of values and other charges."""
        fall = (self.worth + self.dof) * math.log(
            (self.worth + self.base_rss + 1e-300) / (self.worth + max(rss, 1e-12 * self.base_rss)
                                                     + 1e-300))
        whole = self.worth + self.dof
        few = whole / max(whole - parameters - 1.0, 1e-9)
        return fall - few * parameters * math.log(max(self.dof, 2)) - charge - self.penalty

    def set_of(self, blocks: Sequence[int] = (), out: Iterable[int] = ()) -> Set:
        """Return the set of these blocks, with these poses left out."""
        out = tuple(sorted(out))
        rows = np.flatnonzero(np.isin(self.pose, out)) if out else np.zeros(0, np.intp)
        units: Floats = np.zeros((len(self.pose), len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        units = self.whitened(units - self.onto @ self.onto[rows].T)
        onto, ranks = np.linalg.qr(units)[0], [float(len(rows))]
        raw = [self.columns[:, self.blocks[block].columns] for block in blocks]
        for columns in raw:
            new = _outside(columns, onto)
            onto, ranks = np.hstack([onto, new]), [*ranks, float(new.shape[1])]
        residual = self.residual - onto @ (onto.T @ self.residual)
        searched = sum(self.blocks[block].searched for block in blocks)
        charge = 2.0 * sum(math.log(self.blocks[block].tried) for block in blocks)
        charge += self._unusual(blocks, raw, onto[:, :len(rows)])
        charge += len(blocks) * self.choice
        charge += len(out) * (2.0 * math.log(max(self.poses, 2)) + _RARE)
        parameters = sum(ranks) + searched
        rss = float(residual @ residual)
        return Set(tuple(blocks), out, onto, residual, rss, tuple(ranks[1:]), parameters,
                   charge, self.score(rss, parameters, charge))

    def without(self, chosen: Set, block: int) -> Set:
        """Return a set without one of its blocks."""
        return self.set_of([other for other in chosen.blocks if other != block], chosen.out)

    def fewer(self, chosen: Set) -> list[Set]:
        """Return a set of several blocks without each of them."""
        several = chosen.blocks if len(chosen.blocks) > 1 else ()
        return [self.without(chosen, block) for block in several]

    def with_outliers(self, chosen: Set) -> list[Set]:
        """Return a set as it is, and with the outliers that it leaves, if they differ."""
        plain = self.set_of(chosen.blocks) if chosen.out else chosen
        onto = np.hstack([self.onto, plain.onto])
        outliers = outliers_among(
            by_pose(plain.residual, onto, self.pose), plain.rss,
            self.dof - int(plain.parameters), self.poses, noise_known=self.worth > 0.0)
        out = outliers.poses.tolist()
        return [chosen] if tuple(out) == chosen.out else [chosen, self.set_of(chosen.blocks, out)]

    def _unusual(self, blocks: Sequence[int], raw: list[Floats], units: Floats) -> float:
        """Return the penalty for the sizes of the effects."""
        penalty = 0.0
        for block, values in self._values(blocks, raw, units).items():
            size = float(np.max(np.abs(values))) / self.blocks[block].entry.typical
            penalty += min((max(math.log(max(size, 1e-300)), 0.0) / _USUAL) ** 2, _MOST_UNUSUAL)
        return penalty

    def values_of(self, chosen: Set) -> dict[int, Floats]:
        """Return the (p,) values of the effect of each block of a set."""
        raw = [self.columns[:, self.blocks[block].columns] for block in chosen.blocks]
        rows = int(chosen.onto.shape[1] - sum(chosen.ranks))
        return self._values(chosen.blocks, raw, chosen.onto[:, :rows])

    def _values(self, blocks: Sequence[int], raw: list[Floats], units: Floats
                ) -> dict[int, Floats]:
        if not blocks:
            return {}
        columns = np.hstack(raw)
        columns = columns - units @ (units.T @ columns)
        values = np.linalg.lstsq(columns, self.residual, rcond=1e-7)[0]
        by_block: dict[int, Floats] = {}
        start = 0
        for block in blocks:
            part = self.blocks[block].columns
            end = start + part.stop - part.start
            by_block[block] = values[start:end] / self.sizes[part]
            start = end
        return by_block

    def visible(self) -> dict[str, float]:
        """Return the effect on the residuals of each candidate of typical size, per noise."""
        largest: dict[str, float] = {}
        for block in self.blocks:
            left = _outside(self.columns[:, block.columns], self.onto[:, :0])
            if left.shape[1]:
                own = self.columns[:, block.columns] * self.sizes[block.columns]
                size = float(np.linalg.norm(own, 2)) * block.entry.typical
                largest[block.effect] = max(size, largest.get(block.effect, 0.0))
        return largest

    def gains(self, beside: Set) -> tuple[Floats, Floats]:
        """Return the (b,) gain of each block in addition to a set, and its (b,) rank."""
        across = beside.onto.T @ self.columns
        along = self.along - across.T @ (beside.onto.T @ self.residual)
        gain, rank = np.zeros(len(self.blocks)), np.zeros(len(self.blocks))
        for numbers, index, products in self.by_width:
            parts = np.moveaxis(across[:, index], 0, 2)
            left = products - parts @ np.swapaxes(parts, 1, 2)
            size, axes = np.linalg.eigh(left)
            kept = (size > _SEEN ** 2) & (size > _SEEN ** 2 * size[:, -1:])
            towards = (np.swapaxes(axes, 1, 2) @ along[index][:, :, np.newaxis])[:, :, 0]
            squares = np.where(kept, towards ** 2 / np.where(kept, size, 1.0), 0.0)
            gain[numbers], rank[numbers] = np.sum(squares, axis=1), np.sum(kept, axis=1)
        return gain, rank

    def score_with(self, before: Set, block: int, gain: float, rank: float) -> float:
        """Return the score of a set with one more block, without the penalty for its size."""
        entry = self.blocks[block]
        return self.score(before.rss - gain, before.parameters + rank + entry.searched,
                          before.charge + self.choice + 2.0 * math.log(entry.tried))

    def scores_beside(self, before: Set) -> Floats:
        """Return the (b,) scores with one more block; -inf for one that determines nothing."""
        gain, rank = self.gains(before)
        return np.array([self.score_with(before, k, gain[k], rank[k]) if rank[k] else -np.inf
                         for k in range(len(self.blocks))])

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
        return min(1.0, chance * _kinds(self.blocks) * self.blocks[block].tried)

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
class Set:
    """
    Effects that are added to the base, and poses that are left out.

    `blocks` are the indices of the blocks of the effects, and `out` those of the poses. The
    orthonormal columns `onto` (m, q) span both, those of the poses first, and leave `residual`
    (m,) with the sum of squares `rss`. `ranks` are the numbers of values that each block
    determines beside the blocks before it. `parameters` is the number of values, with searched
    shapes and equations left out. `charge` is subtracted from the score apart from these values.
    `score` is the criterion, 0 for the base.

    """

    blocks: tuple[int, ...]
    out: tuple[int, ...]
    onto: Floats = field(repr=False)
    residual: Floats = field(repr=False)
    rss: float
    ranks: tuple[float, ...]
    parameters: float
    charge: float
    score: float


def _outside(columns: Floats, onto: Floats) -> Floats:
    """Return the part of (m, w) columns outside of an orthonormal basis, orthonormal (m, r)."""
    left = columns - onto @ (onto.T @ columns)
    vectors, scales, _ = np.linalg.svd(left, full_matrices=False)
    return vectors[:, (scales > _SEEN) & (scales > _SEEN * scales[:1])]


def held_out(residual: Floats, own: Floats) -> Floats:
    """Return (m,) residuals without their own equation (PRESS), from (m,) 1 - leverage `own`."""
    predicted: Floats = residual / np.maximum(own, _LEAST_OWN)
    return predicted


def linearised(fit: Fit, base: tuple[str, ...], names: Iterable[str] = ()) -> Linear:
    """Return the linear problem at a fit, given the names of the base and of the candidates."""
    near, model = fit.equations, fit.model
    held = Model({name: values for name, values in model.values.items() if name in base})
    further = Model({name: values for name, values in model.values.items() if name not in base})
    residual = near.residual
    if further.values:
        residual = residual + near.columns(further) @ _amplitudes(further)
    onto = _orthonormal(near.columns(held)[:, held.fitted])
    residual = residual - onto @ (onto.T @ residual)
    candidates = {name: effect_named(name) for name in names}
    blocks, raw = _blocks(near, fit.poses_g.columns, further, candidates, len(fit.poses_g))
    columns, sizes = outside_of(onto, raw)
    return Linear(onto, residual, near.pose, blocks, columns, sizes,
                  WORTH if near.noise_known else 0.0, near.count - onto.shape[1],
                  float(residual @ residual), near.columns(_OFFSET),
                  2.0 * math.log(1.0 + _kinds(blocks)))


def _kinds(blocks: Iterable[Block]) -> int:
    """Return the number of effects tried; the covariates of all quantities count as one."""
    return len({kind_of(block.effect) for block in blocks})


def outside_of(onto: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """Return (m, c) columns of norm 1 with a base projected out, and their (c,) norms before."""
    sizes = _norms(columns)
    columns = columns / sizes
    return columns - onto @ (onto.T @ columns), sizes


def _norms(columns: Floats) -> Floats:
    """Return the norms of columns, 1 for a column of zeros."""
    sizes: Floats = np.linalg.norm(columns, axis=0)
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


def _blocks(near: Equations, context: Context, present: Model, candidates: dict[str, Effect],
            poses: int) -> tuple[tuple[Block, ...], Floats]:
    """Return the blocks of the candidates that the context allows, and their columns."""
    blocks: list[Block] = []
    columns: list[Floats] = [np.zeros((len(near.pose), 0))]
    start = 0
    usable = {name: effect for name, effect in candidates.items() if effect.output is None
              and all(key in context for key in effect.needs)}
    alike = Counter(map(kind_of, usable))
    for name, effect in usable.items():
        count = len(effect.parameters)
        for shape, searched, tried in _shapes(effect, context, present.values.get(name), poses):
            model = Model({name: np.concatenate([np.zeros(count), shape])})
            columns.append(near.columns(model)[:, :count])
            blocks.append(Block(name, shape, slice(start, start + count), effect, searched,
                                tried * alike[kind_of(name)]))
            start += count
    return tuple(blocks), np.hstack(columns)


def _shapes(effect: Effect, context: Context, present: Floats | None, poses: int
            ) -> list[tuple[Floats, int, float]]:
    """Return the shapes of an effect to try, with the values searched and the number tried."""
    if effect.shapes is None:
        return [(np.zeros(0), 0, 1.0)]
    shapes = list(effect.shapes(context))
    most = _SHAPES_AT_ONCE if poses <= _MANY_POSES else _FEW_SHAPES
    shapes = shapes[::-(-len(shapes) // most)] if len(shapes) > most else shapes
    if len(shapes) == 1:
        return [(shapes[0], 0, 1.0)]
    tried = max(len(shapes) / _SHAPES_ALIKE, 1.0)
    if present is not None:
        shapes = [*shapes, effect.split(present)[1]]
    return [(shape, 0, 1.0) if np.array_equal(shape, effect.usual) else (shape, 1, tried)
            for shape in shapes]
