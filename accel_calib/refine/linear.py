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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..calibrate import with_history
from ..effects import Context, Effect, effect_named, factors_of, included, kind_of, Model
from ..estimate import Equations, estimate, Fit, NotConvergedError
from ..table import Floats, Poses
from ..units import MG

WORTH = 4.0
"""ν, degrees of freedom that the measured noise counts as."""

SEEN = 0.02
"""Smallest part of a column outside of the model; otherwise it cannot be distinguished."""

_LARGEST_LOG = 100.0
"""Largest logarithm of a ratio, against overflow."""

_LEAST_OWN = 0.02
"""Smallest 1 - leverage; below it, an equation alone determines a value."""

_SHAPES_AT_ONCE = 250
"""If there are more shapes, only evenly spread shapes are tried."""

_MANY_POSES, _FEW_SHAPES = 1000, 60
"""The same for more poses than this."""

_SHAPES_ALIKE = 3.0
"""Number of neighbouring shapes that count as one independent trial."""

_CHI2_LEVEL = 1e-3
_CHI2_RATIO = 1.3
"""chi² per degree of freedom that still counts as noise: poses repeat worse than samples."""

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
        return list(self.grouped(np.arange(len(self.blocks))))

    def grouped(self, numbers: NDArray[np.intp]
                ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Floats]]:
        """Yield some blocks, those of the same width together, as `by_width`."""
        ends = np.array([(block.columns.start, block.columns.stop) for block in self.blocks],
                        np.intp).reshape(-1, 2)[numbers]
        widths = ends[:, 1] - ends[:, 0]
        for width in np.unique(widths):
            index = ends[widths == width, :1] + np.arange(width)
            yield (numbers[widths == width], index,
                   self.products[index[:, :, np.newaxis], index[:, np.newaxis, :]])

    def score(self, rss: Any, parameters: Any, charge: Any) -> Any:
        """Return the score of sets from their RSS, number of values and other charges."""
        whole = self.worth + self.dof
        fall = whole * np.log((self.worth + self.base_rss + 1e-300) / (
            self.worth + np.maximum(rss, 1e-12 * self.base_rss) + 1e-300))
        few = whole / np.maximum(whole - parameters - 1.0, 1e-9)
        return fall - few * parameters * math.log(max(self.dof, 2)) - charge - self.penalty

    def rss_of(self, score: float, parameters: float, charge: float) -> float:
        """Return the RSS with which a set has a score."""
        room = float(self.score(self.base_rss, parameters, charge)) - score
        ratio = math.exp(min(room / (self.worth + self.dof), _LARGEST_LOG))
        return (self.worth + self.base_rss) * ratio - self.worth

    @cached_property
    def costs(self) -> tuple[Floats, Floats]:
        """(b,) arrays, values searched of each block, and what its choice costs."""
        return (np.array([block.searched for block in self.blocks], float),
                self.choice + 2.0 * np.log(np.array([block.tried for block in self.blocks])))

    def whitened(self, columns: Floats) -> Floats:
        """Return (m,) or (m, q) columns outside of the base, whitened as the equations are."""
        if self.white is None:
            return columns
        axes, loss = self.white
        whitened: Floats = columns - axes @ ((axes.T @ columns).T * loss).T
        return whitened

    @cached_property
    def outliers(self) -> dict[frozenset[int], tuple[int, ...]]:
        """Return the outliers that were found so far, by the blocks beside them."""
        return {}

    @cached_property
    def without_poses(self) -> dict[tuple[int, ...], Any]:
        """Return the sets without effects that were made so far, by the poses left out."""
        return {}


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
        seen = is_seen(np.linalg.eigvalsh(own.swapaxes(1, 2) @ own)).any(axis=1)
        if np.any(seen):
            squares = np.linalg.eigvalsh(sized.swapaxes(1, 2) @ sized)[seen, -1]
            found[each.name] = math.sqrt(np.max(squares)) * each.entry.typical
    return found


def is_seen(squares: Floats) -> NDArray[np.bool_]:
    """Return which directions of columns are outside of a basis, by their increasing squares."""
    return (squares > SEEN ** 2) & (squares > SEEN ** 2 * squares[..., -1:])


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


@dataclass(frozen=True)
class State:
    """A model fitted to the poses kept."""

    fit: Fit

    @property
    def model(self) -> Model:
        """Return the fitted model, ΔR = I."""
        return self.fit.model

    @property
    def poses_g(self) -> Poses:
        """Return the poses kept, in g, with the column ``previous``."""
        return self.fit.poses_g

    @cached_property
    def linear(self) -> Linear:
        """Return the equations with all values of the model projected out, without candidates."""
        return linearised(self.fit, self.model.effects)

    @property
    def residual(self) -> Floats:
        """(m,) array, residuals of the equations with all values fitted."""
        return self.linear.residual

    @property
    def rss(self) -> float:
        """Sum of squared residuals."""
        return self.linear.base_rss

    @property
    def held_out(self) -> Floats:
        """(m,) array, each residual if its own equation is left out of the fit (PRESS)."""
        return held_out(self.residual, 1.0 - np.sum(self.linear.onto ** 2, axis=1))

    @property
    def dof(self) -> int:
        """Return the number of independent equations minus that of fitted values."""
        return self.linear.dof

    @property
    def is_noise(self) -> bool:
        """Return whether noise may explain the residual; True if the noise is not known."""
        return not self.fit.noise_known or is_noise(self.rss, self.dof)

    def gap_mg(self, residual: Floats) -> float:
        """Return the RMS over the new poses of (m,) residuals of the equations [mg]."""
        of_poses = self.fit.equations.of_poses(residual)
        if 'new' in self.poses_g:
            of_poses = of_poses[self.poses_g['new'] > 0.0]
        return float(np.sqrt(np.mean(of_poses ** 2))) * MG

    def mg_of_poses(self, residual: Floats) -> Floats:
        """Return the (n,) residuals of poses from (m,) residuals of the equations [mg]."""
        return self.fit.equations.of_poses(residual) * MG

    @property
    def floor_mg(self) -> float | None:
        """Return the residual expected of a correct model [mg]; None if the noise is unknown."""
        if not self.fit.noise_known:
            return None
        rows = self.fit.by_pose.rows[self.fit.equations.pose]
        share = np.sqrt(self.dof / len(rows)) * np.ones(len(rows))
        return self.gap_mg(share)


def is_noise(rss: float, dof: float) -> bool:
    """Return whether measured noise explains a weighted sum of squares."""
    from scipy.special import chdtrc

    return bool(dof <= 0 or rss <= _CHI2_RATIO * dof or chdtrc(dof, rss) > _CHI2_LEVEL)


def beginning(poses_g: Poses, model: Model) -> State:
    """Return the state of a base model, fitted to all poses; `NotConvergedError` if that fails."""
    return State(estimate(model, with_history(poses_g, model)))


def fitted_state(model: Model, poses_g: Poses, most: float = np.inf) -> State | None:
    """Return the state of a model fitted to poses; None without a sound fit below `most`."""
    try:
        return State(estimate(model, poses_g, most=most))
    except NotConvergedError:
        return None


def with_effect(model: Mapping[str, Floats], name: str, values: Floats) -> dict[str, Floats]:
    """Return the values of a model with one more effect, which replaces those it contains."""
    contained = included((name,))
    return {**{key: part for key, part in model.items() if key not in contained}, name: values}


def without(poses: Poses, out: Sequence[int] | NDArray[np.intp]) -> Poses:
    """Return the poses but those at these indices."""
    return poses.take(np.delete(np.arange(len(poses)), out))
