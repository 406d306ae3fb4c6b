# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The search for the best set of effects and outliers.

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

import numpy as np

from .linear import Block, Linear, Set
from ..effects import fitted_places

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
