# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Search over sets of effects and outliers, by the score of `.linear`.

The search is a beam: it keeps the best few sets, and extends each by one effect at a time. After
each extension the shapes are chosen again, and the outliers are found again among all poses, with
and without the earlier ones. So a pair may be found of which neither effect is visible alone, and
an effect is not judged by poses that were knocked.

A set is accepted only if each of its effects is significant beside the others.

**Random walk.** A walk of the offset (`.wander`) competes with the sets: the same search is done
with equations whitened for the walk, and its score includes the walk.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from .linear import Block, LEVEL, Linear, Set
from ..effects import effect_named, fitted_places
from ..estimate import by_pose, outliers_among

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

_INSTEAD = ({'gain', 'axis_gain'}, {'gain_change', 'axis_gain_change'})
"""Effects of which one includes the other."""


def explored(linear: Linear) -> list[Set]:
    """
    Return the sets visited, the best score first.

    Parameters
    ----------
    linear : Linear
        The equations, with candidates.

    """
    front = _distinct(linear, with_outliers(linear, linear.made()))
    visited = list(front)
    best, idle = max(each.score for each in front), 0
    for _ in range(LARGEST):
        grown = _distinct(linear, [new for before in front for new in _extended(linear, before)])
        grown = [_with_best_shapes(linear, new) for new in grown[:_TESTED]]
        grown = [each for new in grown for each in with_outliers(linear, new)]
        front = _distinct(linear, grown)[:_WIDTH]
        if not front:
            break
        fewer = [each for one in front[:3] for each in _fewer(linear, one)]
        visited += [*front, *fewer]
        idle = 0 if front[0].score > best else idle + 1
        best = max(best, front[0].score)
        if idle == _PATIENCE:
            break
    return _distinct(linear, visited)


def simpler(linear: Linear, chosen: Set) -> Iterator[Set]:
    """
    Yield sets with one effect less, in which another effect has the best searched shape.

    Between the shapes that are tried, two effects may imitate one: an offset that changes with
    temperature and with its rate is one that lags.

    """
    if len(chosen.blocks) < 2:
        return
    for less in _fewer(linear, chosen):
        for effect in dict.fromkeys(block.effect for block in linear.blocks if _is_fitted(block)):
            others = [block for block in less.blocks if linear.blocks[block].effect != effect]
            if effect in _barred({linear.blocks[block].effect for block in others}):
                continue
            gain, _ = linear.gains(linear.made(others, chosen.out))
            own = [number for number, block in enumerate(linear.blocks)
                   if block.effect == effect and _is_fitted(block)]
            new = linear.made([*others, max(own, key=lambda number: gain[number])], chosen.out)
            if new.score > _NEARLY * chosen.score:
                yield new


def _is_fitted(block: Block) -> bool:
    """Return whether a fit changes the shape of a block."""
    return bool(block.searched and fitted_places(effect_named(block.effect), block.shape))


def names_of(linear: Linear, chosen: Set) -> tuple[str, ...]:
    """Return the names of the effects of a set."""
    return tuple(linear.blocks[block].effect for block in chosen.blocks)


def accepted(linear: Linear, visited: Iterable[Set]) -> Iterator[Set]:
    """Yield the sets whose effects are all significant, the preferred one first."""
    left = sorted(visited, key=lambda each: -each.score)
    while left:
        near: list[Set] = []
        for each in left:
            if near and each.score < near[0].score - _AS_GOOD:
                break
            if is_significant(linear, each):
                near.append(each)
        if not near:
            return
        best = min(near, key=lambda each: (
            each.parameters, any('new' in effect_named(name).needs
                                 for name in names_of(linear, each)), -each.score))
        yield best
        left = [each for each in left if each is not best]


def is_significant(linear: Linear, chosen: Set) -> bool:
    """Return whether each effect of a set is significant beside the others."""
    return all(linear.probability(chosen, block) < LEVEL for block in chosen.blocks)


def _extended(linear: Linear, before: Set) -> Iterator[Set]:
    """Yield the set with one more effect, for the effects with the best scores."""
    gain, rank = linear.gains(before)
    barred = _barred(set(names_of(linear, before)))
    scores: dict[str, tuple[float, int]] = {}
    for number, block in enumerate(linear.blocks):
        if rank[number] and block.effect not in barred:
            score = linear.score_with(before, number, gain[number], rank[number])
            if score > scores.get(block.effect, (-np.inf, 0))[0]:
                scores[block.effect] = score, number
    for _, number in sorted(scores.values(), reverse=True)[:_BRANCHES]:
        yield linear.made((*before.blocks, number), before.out)


def _barred(names: set[str]) -> set[str]:
    """Return the effects that cannot be added to a set with these names."""
    return names.union(*(group for group in _INSTEAD if group & names))


def _with_best_shapes(linear: Linear, chosen: Set) -> Set:
    """Choose the shape of each effect again, with the others as they are."""
    for place, number in enumerate(chosen.blocks[:-1]):
        same = [other for other, block in enumerate(linear.blocks)
                if block.effect == linear.blocks[number].effect]
        if len(same) == 1:
            continue
        others = (*chosen.blocks[:place], *chosen.blocks[place + 1:])
        gain, _ = linear.gains(linear.made(others, chosen.out))
        best = max(same, key=lambda other: gain[other])
        if best != number:
            new = linear.made((*chosen.blocks[:place], best, *chosen.blocks[place + 1:]),
                              chosen.out)
            chosen = max(chosen, new, key=lambda each: each.score)
    return chosen


def with_outliers(linear: Linear, chosen: Set) -> Iterator[Set]:
    """Yield a set as it is, and with the outliers that it leaves."""
    yield chosen
    plain = linear.made(chosen.blocks) if chosen.out else chosen
    onto = np.hstack([linear.onto, plain.onto])
    found = outliers_among(by_pose(plain.residual, onto, linear.pose), plain.rss,
                           linear.dof - int(plain.parameters), linear.poses,
                           noise_known=linear.worth > 0.0)
    if tuple(found.poses.tolist()) != chosen.out:
        yield linear.made(chosen.blocks, found.poses.tolist())


def _fewer(linear: Linear, chosen: Set) -> Iterator[Set]:
    """Yield a set without one of its effects."""
    if len(chosen.blocks) > 1:
        for block in chosen.blocks:
            yield linear.without(chosen, block)


def _distinct(linear: Linear, sets: Iterable[Set]) -> list[Set]:
    """Return the best set of each list of names and outliers, the best score first."""
    found: dict[tuple[frozenset[str], tuple[int, ...]], Set] = {}
    for each in sorted(sets, key=lambda each: -each.score):
        found.setdefault((frozenset(names_of(linear, each)), each.out), each)
    return list(found.values())
