# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Search over sets of effects and outliers, and the probability of each effect of a set.

The search is a beam: it keeps the best few sets by the score of `.linear`, and extends each by one
effect at a time. After each extension the shapes are chosen again, and the outliers are found
again among all poses, with and without the earlier ones. So a pair may be found of which neither
effect is visible alone, and an effect is not judged by poses that were knocked. A set is accepted
only if each of its effects is significant beside the others.

**Random walk.** A walk of the offset (`.curves`) competes with the sets: the same search is done
with equations whitened for the walk, and its score includes the walk.

**Rivals** are effects that would explain the data about as well as a named one. The probability of
an effect against its rivals follows from the score of the set with each of them in its place,
exp(c score / 2), all else being equal (Kass and Raftery 1995). The noise is estimated from the
same equations, so differences are less certain: c is the share of the degrees of freedom that the
set leaves.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from .curves import Process, Walk, walk_beside
from .linear import Block, Linear, Set
from ..effects import fitted_places, LADDER, WANDER

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

LEAST = 0.01
"""Smallest probability of a rival."""


def explored(linear: Linear) -> list[Set]:
    """Return the sets visited, the best score first."""
    front = _distinct(linear, linear.with_outliers(linear.set_of()))
    visited = list(front)
    best, idle = max(chosen.score for chosen in front), 0
    for _ in range(LARGEST):
        larger = _distinct(linear, [new for before in front for new in _extended(linear, before)])
        larger = [_with_best_shapes(linear, new) for new in larger[:_TESTED]]
        larger = [chosen for new in larger for chosen in linear.with_outliers(new)]
        front = _distinct(linear, larger)[:_WIDTH]
        if not front:
            break
        visited += [*front, *(fewer for new in front[:3] for fewer in linear.fewer(new))]
        idle = 0 if front[0].score > best else idle + 1
        best = max(best, front[0].score)
        if idle == _PATIENCE:
            break
    return _distinct(linear, visited)


def simpler(linear: Linear, chosen: Set) -> list[Set]:
    """
    Return sets with one effect less, in which another effect has the best searched shape.

    Between the shapes that are tried, two effects may imitate one: an offset that changes with
    temperature and with its rate is one that lags.

    """
    fitted: dict[str, list[int]] = {}
    for number, block in enumerate(linear.blocks):
        if block.searched and fitted_places(block.entry, block.shape):
            fitted.setdefault(block.effect, []).append(number)
    sets = []
    for less in linear.fewer(chosen):
        for effect, own in fitted.items():
            others = [block for block in less.blocks if linear.blocks[block].effect != effect]
            if _is_barred(linear.blocks[own[0]], [linear.blocks[block] for block in others]):
                continue
            gain, _ = linear.gains(linear.instead(chosen, others), effect)
            best = max(own, key=lambda number: gain[number])
            new = linear.instead(chosen, [*others, best])
            if new.score > _NEARLY * chosen.score:
                sets.append(new)
    return sets


def accepted(linear: Linear, visited: Iterable[Set]) -> Iterator[Set]:
    """Yield the sets whose effects are all significant, the preferred one first."""
    left = sorted(visited, key=lambda chosen: -chosen.score)
    while left:
        near: list[Set] = []
        for chosen in left:
            if near and chosen.score < near[0].score - _AS_GOOD:
                break
            if linear.is_significant(chosen):
                near.append(chosen)
        if not near:
            return
        best = min(near, key=lambda chosen: (
            chosen.parameters, any('new' in linear.blocks[block].entry.needs
                                   for block in chosen.blocks), -chosen.score))
        yield best
        left = [chosen for chosen in left if chosen is not best]


def _extended(linear: Linear, before: Set) -> list[Set]:
    """Return the set with one more effect, for the effects with the best scores."""
    present = [linear.blocks[block] for block in before.blocks]
    best: dict[str, tuple[float, int]] = {}
    scores = linear.scores_beside(before)
    for effect, numbers in linear.numbers_of.items():
        number = int(numbers[np.argmax(scores[numbers])])
        if scores[number] > -np.inf and not _is_barred(linear.blocks[number], present):
            best[effect] = float(scores[number]), number
    return [linear.extended(before, number)
            for _, number in sorted(best.values(), reverse=True)[:_BRANCHES]]


def _is_barred(block: Block, present: Iterable[Block]) -> bool:
    """Return whether one of the effects present is that of a block, contains it or is in it."""
    return any(block.effect == other.effect or block.effect in other.entry.includes
               or other.effect in block.entry.includes for other in present)


def _with_best_shapes(linear: Linear, chosen: Set) -> Set:
    """Choose the shape of each effect again, with the others as they are."""
    for place, number in enumerate(chosen.blocks[:-1]):
        effect = linear.blocks[number].effect
        if len(linear.numbers_of[effect]) == 1:
            continue
        before, after = chosen.blocks[:place], chosen.blocks[place + 1:]
        best = linear.best_of(effect, linear.instead(chosen, (*before, *after)))
        if best != number:
            new = linear.instead(chosen, (*before, best, *after))
            chosen = max(chosen, new, key=lambda either: either.score)
    return chosen


def _distinct(linear: Linear, sets: Iterable[Set]) -> list[Set]:
    """Return the best set of each list of names and outliers, the best score first."""
    best: dict[tuple[frozenset[str], tuple[int, ...]], Set] = {}
    for chosen in sorted(sets, key=lambda chosen: -chosen.score):
        best.setdefault((frozenset(linear.effects_of(chosen)), chosen.out), chosen)
    return list(best.values())


@dataclass(frozen=True)
class Near:
    """
    The equations of all poses near a model, and what was chosen in them.

    `linear` has the candidates, whitened if there is a `walk` of the offset; `plain` is not
    whitened. `chosen` has the effects and outliers. `process` has the modes of a walk; None if it
    is not tried.

    """

    linear: Linear
    chosen: Set
    walk: Walk | None
    plain: Linear
    process: Process | None

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the chosen effects."""
        return self.linear.effects_of(self.chosen)

    @property
    def key(self) -> tuple[frozenset[str], tuple[int, ...], bool]:
        """Return what was chosen, apart from values and shapes."""
        return frozenset(self.names), self.chosen.out, self.walk is not None


NOTHING: tuple[frozenset[str], tuple[int, ...], bool] = (frozenset(), (), False)
"""The key of a choice without effects, outliers and a walk."""


def probabilities(name: str, near: Near) -> dict[str, float]:
    """Return the probabilities of an effect or `WANDER` and those in its place, largest first."""
    if name != WANDER and name not in near.names:
        return {name: 1.0}
    whole = near.plain.worth + near.plain.dof
    certainty = max((whole - near.chosen.parameters) / whole, LEAST)
    scores = _scores(name, near, near.chosen.score + 2.0 * np.log(LEAST) / certainty)
    most = max(scores.values())
    weights = {key: float(np.exp(certainty * (score - most) / 2.0))
               for key, score in scores.items()}
    total = sum(weights.values())
    ordered = sorted(weights, key=lambda key: -weights[key])
    return {key: weights[key] / total for key in ordered}


def _scores(name: str, near: Near, least: float) -> dict[str, float]:
    """Return the scores above `least` of the set with each effect in the place of a named one."""
    if name == WANDER:
        problem, own = near.plain, []
    else:
        problem, own = near.linear, [near.chosen.blocks[near.names.index(name)]]
    others = problem.set_of([block for block in near.chosen.blocks if block not in own],
                            near.chosen.out)
    names, scores = near.names, {name: near.chosen.score}
    for number, likely in enumerate(problem.scores_beside(others)):
        effect = problem.blocks[number].effect
        if (likely > least and effect not in names
                and (effect in LADDER or name not in LADDER)):
            score = problem.extended(others, number).score
            scores[effect] = max(score, scores.get(effect, -np.inf))
    if name != WANDER and near.walk is None and near.process is not None:
        scores[WANDER] = walk_beside(near.plain, others, near.process).score
    return scores
