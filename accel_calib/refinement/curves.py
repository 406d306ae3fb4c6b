# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Gaps without a known form: empirical curves, and an offset that wanders.

**Curves.** They show where the gap lies, if no known effect has its form. A curve changes a
carrier (offset, gain, cross-axis, |force|, or one axis of them) with a variable (time,
temperature, its rate, supply, vibration, the force along the axis, or any quantity). It is a sum
of a few cosines over the range of the variable (`accel_calib.effects.EmpiricalCurve`), or of
spherical harmonics of a few degrees over the direction of the force, which are the forms of
nonlinearities along oblique axes. For each carrier and variable, the cosines or degrees are added
in the order of their gain while the score of `.linear` rises; each costs its values and 2 log k
for the choice of the k-th. The best curve is taken if it is significant. The score is strict, so
further modes next to those of the curve are added while they lower its held-out residual.

**Wander.** The effect `offset_wander` is an offset that changes slowly. It is a random process,
expanded in its Karhunen-Loève modes

    w(t) = Σ_k a_k sin((k - ½) π τ) / ((k - ½) π),   τ from 0 to 1 over the poses

with independent amplitudes a_k of equal variance for each axis. It enters the equations through
the same columns as an offset. Its size is estimated by maximum likelihood: with the base projected
out, the residual along the singular vectors of the modes has the variances s² (1 + λ Λ_i). With a
fixed number of modes, the cost is linear in the number of poses.

**Two names for one curve.** Two nonlinearities whose values by axis are in proportion may be parts
of one curve outside of the catalogue (`one_curve`). A second one that is too small for a value of
each axis may still show with one value, in the proportion of the first.

"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations, product
import math
from typing import cast, NamedTuple

import numpy as np

from .linear import Block, LEAST_OWN, LEVEL, Linear, Set, with_outliers
from .state import candidates, left_open, linearised, outside_of, State
from ..effects import (
    AXES, CATALOGUE, curves_over, EffectKey, EFFECTS, EmpiricalCurve, factors_of, Model,
    parameter_names)
from ..estimate import Fit, judge, left_out
from ..table import Floats, Poses

_MOST_MODES = 10
_LARGEST_SHARE = 0.35
"""Largest number of cosines, and largest share of the degrees of freedom, of a curve."""

_LEAST_DOF = 30
"""Degrees of freedom below which no curve is looked for; a few poses fit many curves."""

_PATIENCE = 2
"""Cosines without a better score after which no more are added; a wave needs several."""

_FALL = 3.0
"""Decrease of the held-out squares, in variances, by which a further mode pays for each value."""

CLEARLY = 10.0
"""Smallest score of a curve."""

_PROPORTION = 2.0
"""Evidence for a proportion of two effects that makes them parts of one curve (Kass and Raftery
1995: positive)."""

_TURNS = np.linspace(0.0, np.pi, 1801)
"""Angles at which a proportion of two effects is looked for; the middle one is a right angle."""

_EQUAL = 1e-9
"""Relative difference below which numbers of a quantity are equal."""

_OF_READING = 0.1
"""Scatter of the ratio of a quantity to the length of the readings below which it is computed from
them, relative to the scatter of the length."""


class FoundCurve(NamedTuple):
    """
    A curve beside a model, and the indices of the outliers beside it.

    Its (p,) values include the range of the variable. The score is relative to no curve, and the
    p-value is the probability that noise alone makes one of all curves this good. `explained` is
    the part of the squares above the noise, of poses held out, that it explains.

    """

    name: EmpiricalCurve
    values: Floats
    score: float
    out: tuple[int, ...]
    p_value: float
    explained: float


class _Family(NamedTuple):
    """The curves of a carrier and its parts over a variable, with all modes in one curve."""

    curve: EmpiricalCurve
    shape: Floats

    @property
    def parts(self) -> list[tuple[str, slice]]:
        """Return no part, for the carrier, and each of its parts, with the places of values."""
        parts = self.curve.parts
        alone = [(part, slice(k, None, len(parts))) for k, part in enumerate(parts)]
        return [('', slice(None)), *(alone if len(parts) > 1 else ())]


def causes(poses_g: Poses) -> tuple[str, ...]:
    """Return the quantities that vary, other than row numbers and lengths of the readings."""
    length, found = np.linalg.norm(poses_g.reading, axis=1), []
    for key in poses_g.quantities:
        values = poses_g[key]
        known = values[np.isfinite(values)]
        if not len(known) or np.ptp(known) <= _EQUAL * np.max(np.abs(known)):
            continue
        steps, ratio = np.diff(values), values / length
        counts_rows = np.all(np.abs(steps - steps[:1]) <= _EQUAL * np.abs(steps[:1]))
        is_length = (np.std(ratio) * np.mean(length)
                     < _OF_READING * np.std(length) * np.abs(np.mean(ratio)))
        if not counts_rows and not is_length:
            found.append(key)
    return tuple(found)


def best_curve(state: State, poses_g: Poses, out: tuple[int, ...], *, least: float = CLEARLY,
               of_force: bool = False) -> FoundCurve | None:
    """
    Return the best curve beside a model, or None if its score is below `least`.

    `out` are the indices of the outliers; `of_force`: only curves over the force or its
    direction. The choice among all curves is paid for in either case.

    """
    fit = judge(state.model, poses_g)
    plain = linearised(fit, state.model.effects, beside=left_open(state))
    if plain.dof < _LEAST_DOF:
        return None
    families, best = list[_Family](), None
    for curve in curves_over(causes(poses_g)):
        entry = curve.entry
        if set(entry.needs) <= set(poses_g.columns):
            shapes = [np.zeros(0)] if entry.shapes is None else entry.shapes(poses_g.columns)
            families += (_Family(curve, shape) for shape in shapes)
    tried = sum(len(family.parts) for family in families)
    most = least + 2.0 * math.log(tried)
    for family in families:
        if of_force and not family.curve.entry.bends:
            continue
        whole = _whole(plain, fit, family)
        kept = _kept(whole, out)
        for part, which in family.parts:
            least_rss = _rss_beside(kept, which)
            if kept.score(least_rss, 1.0, 0.0) > most:
                problem = _of_part(whole, family, part, which)
                grown = _grown(_kept(problem, out), least_rss, most)
                if grown.score > most:
                    best, most = Set.of(problem, grown.blocks, out), grown.score
    return None if best is None else _accepted(most - 2.0 * math.log(tried), best, tried)


def _whole(plain: Linear, fit: Fit, family: _Family) -> Linear:
    """Return the problem with all modes of a carrier as one candidate."""
    (curve, shape), entry = family, family.curve.entry
    count, one = len(entry.parameters), replace(curve, modes=curve.modes[:1])
    if entry.factor is None:
        columns = fit.equations.columns(Model({curve: np.zeros(count)}))
    else:
        factors = factors_of(curve, [shape], fit.poses_g.columns)[0]
        each_mode = factors[::len(one.entry.terms), np.newaxis]
        columns = fit.equations.columns_of(one, each_mode)
    columns, sizes = outside_of(plain.onto, columns)
    return replace(plain, every=np.vstack([columns.T, plain.residual]), sizes=sizes, choice=0.0,
                   blocks=(Block(curve, shape, slice(0, count), entry),))


def _of_part(whole: Linear, family: _Family, part: str, which: slice) -> Linear:
    """Return the problem with each mode of a carrier, or of its part, as a candidate."""
    curves = [replace(family.curve, modes=(mode,), part=part) for mode in family.curve.modes]
    ends = np.cumsum([0, *(len(each.entry.parameters) for each in curves)]).tolist()
    blocks = tuple(Block(each, family.shape, slice(*ends[k:k + 2]), family.curve.entry,
                         tried=k + 1.0) for k, each in enumerate(curves))
    return replace(whole, every=np.vstack([whole.every[:-1][which], whole.residual]),
                   sizes=whole.sizes[which], blocks=blocks)


def _kept(problem: Linear, out: tuple[int, ...]) -> Linear:
    """Return the problem of the other poses, for its products alone."""
    nothing = Set.of(problem, (), out)
    return replace(problem, taken=nothing.across.T, base_rss=nothing.rss,
                   dof=problem.dof - int(nothing.parameters))


def _rss_beside(problem: Linear, which: slice) -> float:
    """Return the RSS beside some columns, which no set of them falls below."""
    products = np.concatenate(problem.products_with(range(len(problem.blocks))))[which]
    left, along = products[:, :-1][:, which], products[:, -1]
    # The small squares are for modes inside of the base: the equations have a solution.
    gain = along @ np.linalg.solve(left + 1e-9 * np.eye(len(left)), along)
    return float(problem.base_rss - gain)


def _grown(problem: Linear, least_rss: float, least: float) -> Set:
    """
    Return the modes with the best score.

    No set of them has an RSS below `least_rss`. If no score can exceed `least`, the set is not the
    best one.

    """
    best = now = Set.of(problem)
    for _ in range(min(_MOST_MODES, len(problem.blocks))):
        if problem.score(least_rss, now.parameters + 1.0, 0.0) <= max(best.score, least):
            break
        scores = now.scores_beside
        scores[list(now.blocks)] = -np.inf
        if not np.max(scores) > -np.inf:  # all are there, or none is outside of the others
            break
        now = now.extended(int(np.argmax(scores)))
        if now.parameters > _LARGEST_SHARE * problem.dof:
            break
        if now.score > best.score:
            best = now
        elif len(now.blocks) >= len(best.blocks) + _PATIENCE:
            break
    return best


def _extended(chosen: Set) -> Set:
    """Return a curve with further modes, within 2 of its own, that lower its held-out squares."""
    near = {block + step for block in chosen.blocks for step in range(-2, 3)} - {*chosen.blocks}
    larger = [new for block in near & {*range(len(chosen.linear.blocks))}
              if (new := chosen.extended(block)).parameters <= _LARGEST_SHARE * new.linear.dof]
    best = min(larger, key=_held_out, default=chosen)
    price = _FALL * (best.parameters - chosen.parameters) * chosen.variance
    return _extended(best) if _held_out(best) + price < _held_out(chosen) else chosen


def _accepted(score: float, chosen: Set, tried: int) -> FoundCurve | None:
    """Return a curve, or None if it is not significant."""
    # The outliers are found again: without the curve, good poses may have looked like outliers.
    chosen = max(with_outliers([chosen]), key=lambda either: either.score)
    nothing = chosen.instead(())
    p_value = min(1.0, chosen.chance(nothing) * tried * math.prod(
        each.tried for each in chosen.entries))
    if p_value > LEVEL:
        return None
    chosen = _extended(chosen)
    blocks, first = sorted(chosen.blocks), chosen.entries[0]
    waves = [cast(EmpiricalCurve, chosen.linear.blocks[block].effect) for block in blocks]
    curve = replace(waves[0], modes=tuple(wave.modes[0] for wave in waves))
    values = np.concatenate([*(chosen.parts[block] for block in blocks), first.shape])
    explained = 1.0 - _held_out(chosen) / max(_held_out(nothing), 1e-300)
    return FoundCurve(name=curve, values=values, score=score, out=chosen.out, p_value=p_value,
                      explained=explained)


def _held_out(chosen: Set) -> float:
    """
    Return the sum of squares of the residuals, each predicted from the other equations (PRESS).

    It is without what the noise makes of it, if the noise is known.

    """
    onto, residual = chosen.spanned
    own = 1.0 - np.sum(chosen.linear.onto ** 2, axis=1) - np.sum(onto ** 2, axis=1)
    kept = own > 1e-6  # not the outliers
    squares = (residual[kept] / np.maximum(own[kept], LEAST_OWN)) ** 2
    return float(np.sum(squares - (1.0 / own[kept] if chosen.linear.worth else 0.0)))


def nearest_effects(before: State) -> dict[str, float]:
    """Return the two known effects that leave least of the residual, and what they leave [mg]."""
    names = tuple(name for name in EFFECTS if name not in before.model.values)
    best: list[tuple[float, str, float]] = []
    for each in candidates(names, before.poses_g):  # one by one, which takes less memory
        linear = linearised(before.fit, before.model.effects, (each,))
        gain, rank = Set.of(linear).gains()
        number = int(np.argmax(gain))
        if rank[number]:
            _, left = Set.of(linear, (number,)).spanned
            best.append((-gain[number], str(each.effect), before.gap_mg(left)))
    return {name: left_mg for _, name, left_mg in sorted(best)[:2]}


def one_curve(state: State) -> tuple[str, ...]:
    """
    Return two nonlinearities in the same proportion on each axis; empty if there are none.

    They may be parts of one curve, because two causes have directions of their own. The second one
    may be in the model, or only show beside it.

    """
    named = _by_axis(state.model.effects)
    if not named:
        return ()
    further = [name for name in _by_axis(EFFECTS) if name not in named]
    pairs = {pair: _proportion(pair, state) for pair in combinations(named, 2)}
    linear = linearised(state.fit, state.model.effects, candidates(further, state.poses_g))
    for name, block in product(named, linear.blocks):
        column = linear.columns[:, block.columns] @ (
            linear.sizes[block.columns] * state.model.values[name])
        gain = (column @ linear.residual) ** 2 / max(float(column @ column), 1e-300)
        score = linear.score(linear.base_rss - gain, 1.0, linear.choice)
        pairs[name, str(block.effect)] = float(score)
    best = max(pairs, key=lambda pair: pairs[pair], default=())
    return best if best and pairs[best] > _PROPORTION else ()


def _by_axis(effects: Iterable[EffectKey]) -> list[str]:
    """Return the nonlinearities of the catalogue with one value for each axis."""
    return [name for name in effects if isinstance(name, str)
            and CATALOGUE[name].family == 'force' and CATALOGUE[name].parameters == AXES]


def _proportion(pair: tuple[str, str], state: State) -> float:
    """
    Return the evidence for a proportion of two effects of a model.

    The density of the weaker effect at such a proportion is compared with that of a direction that
    is uniform over the sphere. With a and b the values by axis, relative to their lengths, the
    evidence is 2 log s - min χ²(t): χ²(t) is that of b cos t - a sin t, and s the smaller one of
    χ²(0°) and χ²(90°).

    """
    names = parameter_names(state.model.effects)
    own = [names.index(f'{name}.{axis}') for name in pair for axis in AXES]
    values = state.model.vector[own]
    weights = np.column_stack([-np.sin(_TURNS), np.cos(_TURNS)]) / np.linalg.norm(
        values.reshape(2, 3), axis=1)
    mix = np.kron(weights[:, np.newaxis], np.eye(3))
    away = mix @ values
    spread = mix @ state.fit.covariance[np.ix_(own, own)] @ mix.transpose(0, 2, 1)
    chi2 = np.sum(away * np.linalg.solve(spread, away[..., np.newaxis])[..., 0], axis=1)
    return float(2.0 * np.log(min(chi2[0], chi2[len(chi2) // 2])) - np.min(chi2))


_MODES = 60
"""Modes of each axis: the rest has less than 1 % of the variance of a random walk."""

_RATIOS = np.geomspace(1e-4, 1e6, 81)
_LEAST_WHITE = 0.5
"""Smallest part of the measured variance that remains for the noise of the poses."""

SIGNIFICANT = 8.0
"""Twice the logarithm of the likelihood ratio above which a walk is named."""

_CHANCE = 4.0
"""The same of a scatter against none, up to which it is chance (p 0.05) and is no rival of a walk.
Of 48 simulated tables whose deviations were too small, none was called a walk."""


class Process(NamedTuple):
    """Orthonormal modes of a walk outside of the base, (m, r), and their relative variances."""

    axes: Floats
    values: Floats


@dataclass(frozen=True)
class Walk:
    """
    A walk beside a set, with its variance relative to the noise, and the score of both.

    The likelihood ratio is twice its logarithm, against no walk, or against an offset that
    scatters from pose to pose by more than `_CHANCE`.

    """

    process: Process
    ratio: float
    score: float
    likelihood_ratio: float

    def whitened(self, linear: Linear) -> Linear:
        """Return the equations whitened for the walk and the noise."""
        spread = 1.0 + self.ratio * self.process.values
        axes = self.process.axes
        across = axes.T @ linear.every.T
        return replace(linear, white=(axes, 1.0 - 1.0 / np.sqrt(spread), across),
                       taken=across.T * np.sqrt(1.0 - 1.0 / spread),
                       penalty=float(np.sum(np.log(spread))) + _charge(linear))

    def residuals(self, chosen: Set, force: Floats) -> tuple[Floats, Floats]:
        """Return the residual without the walk, and the same with each orientation held out."""
        spread = 1.0 + self.ratio * self.process.values
        onto, residual = chosen.spanned
        left = self.process.axes - onto @ (onto.T @ self.process.axes)
        precision = np.diag(1.0 / np.maximum(spread - 1.0, 1e-12)) + left.T @ left
        smooth = np.linalg.solve(np.linalg.cholesky(precision), left.T).T
        residual = residual - smooth @ (smooth.T @ residual)
        basis = np.hstack([chosen.linear.onto, onto, smooth])
        return residual, left_out(residual, basis, chosen.linear.pose, force, LEAST_OWN)[0]


def process_of(linear: Linear, poses: Poses) -> Process | None:
    """Return the modes of a walk; None if the times are not known."""
    time = poses.columns.get('time', np.zeros(0))
    known = np.isfinite(time)
    if len(np.unique(time[known])) < 2:
        return None
    tau = np.where(known, time - np.min(time[known]), 0.0) / float(np.ptp(time[known]))
    number = np.pi * (np.arange(min(int(np.sum(known)), _MODES)) + 0.5)
    waves = np.sin(number * tau[:, np.newaxis])
    shapes = (waves / number)[linear.pose]
    modes = (linear.offset[:, :, np.newaxis] * shapes[:, np.newaxis]).reshape(len(shapes), -1)
    modes -= linear.onto @ (linear.onto.T @ modes)
    wide = len(modes) < modes.shape[1]
    values, vectors = np.linalg.eigh(modes @ modes.T if wide else modes.T @ modes)
    kept = values > 1e-10 * values[-1]
    if not np.any(kept):
        return None
    axes = vectors[:, kept]
    return Process(axes if wide else modes @ (axes / np.sqrt(values[kept])),
                   values[kept] / values[-1])


def walk_beside(chosen: Set, process: Process) -> Walk:
    """Return the most likely walk beside a set."""
    linear, (spanned, residual) = chosen.linear, chosen.spanned
    spread = 1.0 + _RATIOS[:, np.newaxis] * process.values
    taken = 1.0 - 1.0 / spread
    onto, own = process.axes.T @ spanned, chosen.across[:, -1]
    along, count = process.axes.T @ linear.residual, onto.shape[1]
    squares = (onto[:, :, np.newaxis] * onto[:, np.newaxis]).reshape(len(onto), count ** 2)
    normal = np.eye(count) - (taken @ squares).reshape(len(taken), count, count)
    side = own - (taken * along) @ onto
    explained = np.einsum('li,li->l', side,
                          np.linalg.solve(normal, side[:, :, np.newaxis])[:, :, 0])
    rss = float(linear.residual @ linear.residual) - taken @ along ** 2 - explained
    dof = linear.dof - count
    allowed = (rss >= _LEAST_WHITE * dof if linear.worth else _RATIOS <= 1e3)
    allowed[0] = True
    weight = linear.worth + linear.dof
    deviance = np.sum(np.log(spread), axis=1) + weight * np.log(
        (linear.worth + np.maximum(rss, 1e-300)) / (linear.worth + chosen.rss + 1e-300))
    best = int(np.argmin(np.where(allowed, deviance, np.inf)))
    fall = float(-deviance[best])
    # An offset that scatters is no walk: poses that repeat worse than their samples have the same
    # additional variance in g, which shows most where the samples vary little. As the modes of the
    # walk, it is compared outside of the base (restricted likelihood).
    size, base = np.sum(linear.offset ** 2, axis=1), linear.onto
    spread = 1.0 + _RATIOS[:, np.newaxis] * size / max(float(np.max(size)), 1e-300)
    inside = np.linalg.slogdet(base.T @ (base / spread[:, :, np.newaxis]))[1]
    of_scatter = np.sum(np.log(spread), axis=1) + inside + weight * np.log(
        (linear.worth + (1.0 / spread) @ residual ** 2 + 1e-300)
        / (linear.worth + chosen.rss + 1e-300))
    return Walk(process, float(_RATIOS[best]), chosen.score + fall - _charge(linear),
                fall - max(float(-np.min(of_scatter)) - _CHANCE, 0.0))


def _charge(linear: Linear) -> float:
    """Return what a walk costs in the score: its size, and its choice among the candidates."""
    return float(np.log(max(linear.dof, 2)) + linear.choice)
