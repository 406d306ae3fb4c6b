# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The search for the best sets of effects, and the fitted model in which each effect is sound.

**Beam search.** The search keeps the best few sets by the score of `.linear`, and extends each by
one effect at a time. After each extension the shapes are chosen again, and the outliers are found
again among all poses, with and without the earlier ones. So a pair may be found of which neither
effect is visible alone, and an effect is not judged by poses that were knocked. A set is accepted
only if each of its effects is significant beside the others. With a walk of the offset
(`.curves`), the search is repeated with equations whitened for it, and the score includes it.

**Search and fit.** The search finds a set in equations near a model, and a fit makes the next
model: `settle` repeats both until the set remains the same. `make_sound` checks the effects of the
final model, and removes or exchanges them.

**Rivals** are effects that would explain the data about as well as a named one. The probability of
an effect against its rivals follows from the score of the set with each of them in its place,
exp(c score / 2), all else being equal (Kass and Raftery 1995), with the preference of the search
for fewer values (`AS_GOOD`). The noise is estimated from the same equations, so differences are
less certain: c is the share of the degrees of freedom that the set leaves.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
import math

import numpy as np
import scipy

from .curves import Process, process_of, SIGNIFICANT, Walk, walk_beside
from .linear import (
    best_of_each, choose_shapes, DECIMALS, extend_each, is_barred, LEVEL, Linear, Set,
    with_outliers)
from .state import (
    Candidate, candidates, fitted_state, is_noise, left_open, linearised, State, with_effect,
    without)
from ..calibration import has_usual_gains
from ..effects import CHANGES, EffectKey, fitted_places, included, LADDER, Model, WANDER
from ..estimate import judge
from ..table import Poses

_LEVEL_OF_GAP = 0.05
"""`LEVEL` of an effect that explains all of a gap. A larger one names more of the small effects of
few poses, and more where nothing is hidden and the noise is understated."""

_JUST_NOISE = 0.1
"""Probability of a larger sum of squares, above which the rest is just the measured noise."""

_LARGEST = 5
"""Largest number of effects in a set."""

_WIDTH = 4
"""Number of sets that are extended."""

AS_GOOD = 2.0
"""Within this difference from the best score, the set with fewest values wins."""

_NEARLY = 0.3
"""Smallest share of the score of a set that a reshaped set has before its shape is fitted."""

_PATIENCE = 2
"""The search ends if the best score has not risen for this number of extensions."""

_ROUNDS = 4
"""Largest number of searches, each near the model of the one before."""

_LADDER_ROUNDS = 20
"""The same for effects of the ladder, whose fits are short: several fail if few attitudes do not
determine them."""

_TREND = 15.0
"""A walk may have a score lower by this, if the other effects change with time and leave a gap."""

_EXACT = 0.05
"""Largest error of a predicted sum of squares, in variances, after which a search ends."""

LEAST = 0.01
"""Smallest probability of a rival."""


def explored(linear: Linear) -> list[Set]:
    """
    Return the sets visited, the best score first.

    The search starts from no effect, and again from all changes of V and W at once: if a stored
    fit has absorbed an effect, only all of them beside it are better than effects that imitate it.

    """
    names = [name for name in linear.numbers_of if name in CHANGES]
    changes = [int(linear.numbers_of[name][0]) for name in names if name not in included(names)]
    visited: list[Set] = []
    for start in {(), tuple(changes)}:
        front = best_of_each(with_outliers([Set.of(linear, start)]))
        visited += front
        best, idle = max(chosen.score for chosen in front), 0
        for _ in range(_LARGEST):
            tested = (choose_shapes(new) for new in extend_each(front))
            front = best_of_each(with_outliers(tested))[:_WIDTH]
            if not front:
                break
            visited += [*front, *(fewer for new in front[:3] for fewer in new.smaller)]
            idle = 0 if front[0].score > best else idle + 1
            best = max(best, front[0].score)
            if idle == _PATIENCE:
                break
    return best_of_each(visited)


def reshaped(chosen: Set) -> list[Set]:
    """
    Return sets with one effect less and the best searched shape of another, or with its own.

    Between the shapes that are tried, two effects may imitate one: an offset that changes with
    temperature and with its rate is one that lags. An effect that was left out may also return
    with the best shape beside the others.

    """
    blocks, fitted = chosen.linear.blocks, dict[EffectKey, list[int]]()
    for number, block in enumerate(blocks):
        if block.searched and fitted_places(block.entry, block.shape):
            fitted.setdefault(block.effect, []).append(number)
    sets = []
    for less in chosen.smaller:
        for effect, own in fitted.items():
            others = less.without(effect)
            if is_barred(blocks[own[0]], others.entries):
                continue
            gain, _ = others.gains(effect)
            new = others.extended(max(own, key=lambda number: gain[number]))
            if new.score > _NEARLY * chosen.score:
                sets.append(new)
    return sets


def accepted(visited: Iterable[Set]) -> Iterator[Set]:
    """
    Yield the sets of `explored` whose effects are significant, the preferred one first.

    The set without effects is not preferred to a better one if it leaves more than the noise.

    """
    left = list(visited)
    while left:
        near: list[Set] = []
        for chosen in left:
            if near and chosen.score < near[0].score - AS_GOOD:
                break
            if all(is_significant(chosen, effect) for effect in chosen.effects):
                near.append(chosen)
        if not near:
            return
        best = min(near, key=lambda chosen: (
            not chosen.blocks and leaves_gap(chosen), chosen.parameters,
            any('new' in each.entry.needs for each in chosen.entries), -chosen.score))
        yield best
        left = [chosen for chosen in left if chosen is not best]


def is_significant(chosen: Set, effect: EffectKey) -> bool:
    """
    Return whether noise alone hardly makes an effect this good beside the others of a set.

    An effect that leaves just the measured noise, where the others leave more, needs less.

    """
    left = chosen.linear.dof - chosen.parameters
    fills_gap = (scipy.special.chdtrc(left, chosen.rss) > _JUST_NOISE
                 and leaves_gap(chosen.without(effect)))
    return chosen.probability(effect) < (_LEVEL_OF_GAP if fills_gap else LEVEL)


def is_all_noise(chosen: Set) -> bool:
    return is_noise(chosen.rss, chosen.linear.dof - chosen.parameters)


def leaves_gap(chosen: Set) -> bool:
    """Return whether the noise is known and does not explain the rest."""
    return chosen.linear.worth > 0.0 and not is_all_noise(chosen)


@dataclass(frozen=True)
class Near:
    """
    What was chosen in the equations of all poses near a model.

    The equations of `chosen` are whitened if there is a `walk`; those of `plain` are not. If no
    walk is tried, `process` is None. `fitted` are the scores of other effects in the place of one,
    by both names, and what is unusual costs them, where their own fit is not as good as these
    equations predict.

    """

    chosen: Set
    plain: Linear
    walk: Walk | None
    process: Process | None
    fitted: Mapping[tuple[EffectKey, EffectKey], tuple[float, float]] = field(default_factory=dict)

    @property
    def beside(self) -> Set:
        """Return what was chosen, in the equations that are not whitened."""
        return self.chosen.within(self.plain)

    @property
    def names(self) -> tuple[EffectKey, ...]:
        return self.chosen.effects

    def score_above(self, base_rss: float) -> float:
        """Return the score relative to a base that leaves this sum of squares."""
        worth = self.plain.worth
        return self.chosen.score + (worth + self.plain.dof) * math.log(
            (worth + base_rss + 1e-300) / (worth + self.plain.base_rss + 1e-300))

    @property
    def key(self) -> tuple[frozenset[EffectKey], tuple[int, ...], bool]:
        """Return what was chosen, apart from values and shapes."""
        return frozenset(self.names), self.chosen.out, self.walk is not None


def probabilities(name: EffectKey, near: Near, *, usual: bool = True) -> dict[EffectKey, float]:
    """
    Return the probabilities of an effect or `WANDER` and those in its place, largest first.

    `usual`: effects that are far larger than in common sensors are less probable; otherwise, the
    data alone decide.

    """
    if name != WANDER and name not in near.names:
        return {name: 1.0}
    whole = near.plain.worth + near.plain.dof
    certainty = max((whole - near.chosen.parameters) / whole, LEAST)
    back = 0.0 if usual else 1.0
    others = near.beside if name == WANDER else near.chosen.without(name)
    scores: dict[EffectKey, float] = {name: near.chosen.score + back * near.chosen.unusual}
    least = 2.0 * np.log(LEAST) / certainty + scores[name] - back * others.unusual
    for number, likely in enumerate(others.scores_beside):
        effect = others.linear.blocks[number].effect
        if (likely > least and effect not in near.names
                and (effect in LADDER or name not in LADDER)):
            larger = others.extended(number)
            score = larger.score + back * larger.unusual - AS_GOOD * float(
                np.sign(larger.parameters - near.chosen.parameters))
            scores[effect] = max(score, scores.get(effect, -np.inf))
    if name != WANDER and near.walk is None and near.process is not None:
        scores[WANDER] = walk_beside(others, near.process).score + back * others.unusual
    for other in scores:
        own, unusual = near.fitted.get((name, other), (np.inf, 0.0))
        scores[other] = min(scores[other], own + back * unusual)
    most = max(scores.values())
    weights = {key: float(np.exp(certainty * (score - most) / 2.0))
               for key, score in scores.items()}
    total = sum(weights.values())
    ordered = sorted(weights, key=lambda key: -round(weights[key], DECIMALS))
    return {key: weights[key] / total for key in ordered}


@dataclass(frozen=True)
class Trial:
    """
    All poses, the effects of a model that stay, and the effects that are tried beside them.

    What is tried must also show beside the model `beside`. `walks`: a walk is tried, too.

    """

    poses_g: Poses
    fixed: tuple[EffectKey, ...]
    tried: tuple[Candidate, ...]
    beside: Model
    walks: bool

    def process(self, linear: Linear) -> Process | None:
        """Return the modes of a walk; None if the times are not known, or no walk is tried."""
        return process_of(linear, self.poses_g) if self.walks else None

    def near(self, state: State) -> Linear:
        return linearised(judge(state.model, self.poses_g), self.fixed, self.tried,
                          self.beside)

    def finer(self, chosen: Set) -> Trial | None:
        """Return the trial with further shapes beside those of a set; None if there are none."""
        shapes = {block.effect: block.shape for block in chosen.entries}
        tried = tuple(each.finer(shapes.get(each.effect), self.poses_g.columns)
                      for each in self.tried)
        same = all(new is old for new, old in zip(tried, self.tried, strict=True))
        return None if same else replace(self, tried=tried)

    def fitted(self, chosen: Set, state: State) -> State | None:
        """Return the fit of a set; None without a sound fit."""
        model = {name: part for name, part in state.model.values.items() if name in self.fixed}
        for effect, values in chosen.values.items():
            model = with_effect(model, effect, values)
        after = fitted_state(Model(model), without(self.poses_g, chosen.out))
        if after is None or not chosen.blocks:
            return after
        return None if after.fit.at_bound or not has_usual_gains(after.model) else after


def settle(state: State, poses_g: Poses, fixed: tuple[EffectKey, ...],
           effects: Iterable[EffectKey], *, of_ladder: bool = False) -> tuple[State, Near, Trial]:
    """
    Search and fit in turn until a set is found again.

    Return the state, the set near it, and what was tried.

    Effects `of_ladder` are searched without a walk, also where the poses leave gains open.

    """
    trial = Trial(poses_g, fixed,
                  tuple(candidates((each for each in effects if each not in fixed), poses_g)),
                  Model({}) if of_ladder else left_open(state), walks=not of_ladder)
    settled: tuple[tuple[EffectKey, ...], tuple[int, ...], bool] | None = None
    begun = set(state.model.effects) <= set(fixed) and len(state.poses_g) == len(poses_g)
    refused: set[frozenset[EffectKey]] = set()
    linear = trial.near(state)
    seen = [Near(Set.of(linear), linear, None, None).key] if begun else []
    for _ in range(_LADDER_ROUNDS if of_ladder else _ROUNDS):
        near = _best_near(linear, trial, refused)
        while (finer := trial.finer(near.chosen)) is not None:
            del near, linear  # before the next columns are made
            trial, linear = finer, finer.near(state)
            near = _best_near(linear, trial, refused)
        if near.key in seen:
            break
        asked = near.key
        near, after = _best_fit(near, state, trial)
        if after is None:
            refused.add(frozenset(near.names))
            continue
        seen += asked, near.key
        settled = near.names, near.chosen.out, near.walk is not None
        # Were the equations linear enough, near the fit the same would be found.
        error, variance = abs(near.beside.rss - after.rss), after.rss / max(after.dof, 1)
        predicted = after.dof > 0 and error < _EXACT * max(variance, 1.0)
        del near, linear  # before the next columns are made
        state, linear = after, trial.near(after)
        if predicted:
            break
    if settled is None and len(state.poses_g) < len(poses_g):  # the set has all poses
        state = fit_without(state, poses_g, ())
    names, out, walks = settled or ((), (), False)
    return state, _at(linear, trial, names, out, walks=walks), trial


def _best_fit(near: Near, state: State, trial: Trial) -> tuple[Near, State | None]:
    """Return the fit of a set, or of a reshaped one whose fit has a better score."""
    tried = [near, *(replace(near, chosen=other) for other in reshaped(near.chosen))]
    fits = [(each, after) for each in tried
            if (after := trial.fitted(each.chosen, state)) is not None]
    return max(fits, default=(near, None), key=lambda fit: float(near.plain.score(
        fit[1].rss, fit[0].chosen.parameters, fit[0].chosen.charge)))


def _best_near(linear: Linear, trial: Trial, refused: set[frozenset[EffectKey]]) -> Near:
    """Return the best set near a model, with or without a walk."""
    def best_of(problem: Linear) -> Set:
        return next((chosen for chosen in accepted(explored(problem))
                     if frozenset(chosen.effects) not in refused), Set.of(problem))

    process = trial.process(linear)
    best = Near(best_of(linear), linear, None, process)
    in_time = ['time' in each.entry.needs for each in best.chosen.entries]
    if process is None or (linear.worth and not any(in_time) and is_all_noise(best.chosen)):
        return best
    beside = Set.of(linear)
    tried = [beside, best.chosen]
    for _ in range(2):  # each set is found beside the walk before
        walk = walk_beside(beside, process)
        if walk.likelihood_ratio < SIGNIFICANT:
            break
        beside = best_of(walk.whitened(linear)).within(linear)
        tried.append(beside)
    most = best.chosen.score
    if all(in_time) and not is_all_noise(best.chosen):
        most -= _TREND  # what changes with time only, and not as known, wanders
    for beside in tried:
        walk = walk_beside(beside, process)
        if walk.likelihood_ratio > SIGNIFICANT and walk.score > most:
            most = walk.score
            best = replace(best, chosen=beside.within(walk.whitened(linear)), walk=walk)
    return best


def _at(linear: Linear, trial: Trial, names: tuple[EffectKey, ...], out: tuple[int, ...], *,
        walks: bool) -> Near:
    """Return a set near its fit, perhaps with a walk; the largest contribution is first."""
    blocks, process = [int(linear.numbers_of[name][-1]) for name in names], trial.process(linear)
    plain = Set.of(linear, blocks, out)
    walk = walk_beside(plain, process) if walks and process is not None else None
    whole = plain if walk is None else plain.within(walk.whitened(linear))
    blocks.sort(key=lambda block: -whole.without(linear.blocks[block].effect).rss)
    return Near(whole.instead(blocks), linear, walk, process)


def fit_without(state: State, poses_g: Poses, out: tuple[int, ...]) -> State:
    """Return a model fitted to all poses but these; with its values if the fit fails."""
    kept = without(poses_g, out)
    return fitted_state(state.model, kept) or State(judge(state.model, kept))


def make_sound(state: State, near: Near, trial: Trial, base: Model,
               ladder: tuple[EffectKey, ...]) -> tuple[State, Near]:
    """
    Return the final model in which each effect is sound, and the set near it.

    An effect is removed if it is not significant, or if the held-out residual is as small without
    it; also one of the ladder beside what was found later, in place of which the values of the
    base return. It gives way to another one that is more probable in its place and whose fit is
    better.

    """
    for name in (name for name in ladder[::-1] if name in state.model.values):
        values = {other: part for other, part in state.model.values.items() if other != name}
        values.update((other, part) for other, part in base.values.items()
                      if other not in (*values, *included(values)))
        fewer = fitted_state(Model(values), state.poses_g)
        if fewer is not None and not (is_significant(ladder_set(state, name), name)
                                      and _lowers(state, fewer)):
            state = fewer
    fixed = tuple(name for name in state.model.values if name not in near.names)
    if {*fixed} != {*trial.fixed}:
        trial = replace(trial, fixed=fixed)
        near = _at(trial.near(state), trial, near.names, near.chosen.out,
                   walks=near.walk is not None)
    while (doubt := _doubtful(state, near)) is not None:
        name, other = doubt
        exchanged = _exchanged(state, near, name, other, trial)
        score, unusual = (-np.inf, 0.0) if exchanged is None else (
            exchanged[1].score_above(near.plain.base_rss), exchanged[1].chosen.unusual)
        if exchanged is None or (other and score <= near.chosen.score):
            near = replace(near, fitted={**near.fitted, doubt: (score, unusual)})
        else:
            state, near = exchanged
    return state, near


def ladder_set(state: State, name: EffectKey) -> Set:
    """Return the set of an effect of the ladder beside all others of a model."""
    others = tuple(other for other in state.model.effects if other != name)
    names = [other for other in LADDER if other not in others]
    linear = linearised(state.fit, others, candidates(names, state.poses_g))
    return Set.of(linear, linear.numbers_of[name].tolist())


def _doubtful(state: State, near: Near) -> tuple[EffectKey, EffectKey] | None:
    """Return an effect that is not sound, and the one for its place, or '' to remove it."""
    for name in near.names[::-1]:  # the smallest contribution first
        if (name, '') in near.fitted:
            continue
        if not is_significant(near.chosen, name):
            return name, ''
        fewer = state.refit_without((name,)) if near.walk is None else None
        if fewer is not None and not _lowers(state, fewer):
            return name, ''
    for name in (*near.names, *(() if near.walk is None else (WANDER,))):
        other = next(iter(probabilities(name, near)))
        if other != name:
            return name, other
    return None


def _lowers(state: State, fewer: State) -> bool:
    """Return whether the held-out residual of a model is below that of one with fewer effects."""
    return state.gap_mg(state.held_out) < fewer.gap_mg(fewer.held_out)


def _exchanged(state: State, near: Near, name: EffectKey, other: EffectKey, trial: Trial
               ) -> tuple[State, Near] | None:
    """Return the fit with another effect, if any, in the place of one, and the set near it."""
    chosen = near.beside.without(name)
    if other and other != WANDER:
        chosen = chosen.extended(chosen.best_of(other))
    after = trial.fitted(chosen, state)
    if after is None:
        return None
    new = _at(trial.near(after), trial, chosen.effects, chosen.out,
              walks=other == WANDER or near.walk is not None)
    if new.walk is not None and new.walk.likelihood_ratio < SIGNIFICANT:
        new = replace(new, walk=None, chosen=new.beside)
    return None if other == WANDER and new.walk is None else (after, new)
