# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The beam search: sets of effects and outliers with the best scores, near a model.

The search keeps the best few sets by the score of `.linear`, and extends each by one effect at a
time. After each extension the shapes are chosen again, and the outliers are found again among all
poses, with and without the earlier ones. So a pair may be found of which neither effect is visible
alone, and an effect is not judged by poses that were knocked. A set is accepted only if each of
its effects is significant beside the others. With a walk of the offset (`.curves`), the search is
repeated with equations whitened for it, and the score includes it.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import scipy

from .linear import Block, LEVEL, Linear, Set, with_outliers
from .state import is_noise
from ..effects import CHANGES, EffectKey, fitted_places, included

_LEVEL_OF_GAP = 0.05
"""`LEVEL` of an effect that explains all of a gap. A larger one names more of the small effects of
few poses, and more where nothing is hidden and the noise is understated."""

_JUST_NOISE = 0.1
"""Probability of a larger sum of squares, above which the rest is just the measured noise."""

_LARGEST = 5
"""Largest number of effects in a set."""

_WIDTH = 4
"""Number of sets that are extended."""

_BRANCHES = 5
"""Number of effects by which a set is extended."""

_TESTED = 6
"""Number of extended sets whose shapes and outliers are found again."""

AS_GOOD = 2.0
"""Within this difference from the best score, the set with fewest values wins."""

_NEARLY = 0.3
"""Smallest share of the score of a set that a reshaped set has before its shape is fitted."""

_DECIMALS = 6
"""Decimals of the scores that sets are sorted by: not the last bit of a processor decides, and
equal scores keep their order."""

_PATIENCE = 2
"""The search ends if the best score has not risen for this number of extensions."""


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
        front = _distinct(with_outliers([Set.of(linear, start)]))
        visited += front
        best, idle = max(chosen.score for chosen in front), 0
        for _ in range(_LARGEST):
            tested = (_with_best_shapes(new) for new in _larger(front))
            front = _distinct(with_outliers(tested))[:_WIDTH]
            if not front:
                break
            visited += [*front, *(fewer for new in front[:3] for fewer in _fewer(new))]
            idle = 0 if front[0].score > best else idle + 1
            best = max(best, front[0].score)
            if idle == _PATIENCE:
                break
    return _distinct(visited)


def _fewer(chosen: Set) -> list[Set]:
    """Return a set of several effects without each of them."""
    return [chosen.without(block) for block in chosen.blocks if len(chosen.blocks) > 1]


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
    for less in _fewer(chosen):
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
            if all(is_significant(chosen, block) for block in chosen.blocks):
                near.append(chosen)
        if not near:
            return
        best = min(near, key=lambda chosen: (
            not chosen.blocks and leaves_gap(chosen), chosen.parameters,
            any('new' in each.entry.needs for each in chosen.entries), -chosen.score))
        yield best
        left = [chosen for chosen in left if chosen is not best]


def _larger(front: list[Set]) -> list[Set]:
    """Return the best sets with one effect more than those of a front."""
    likely: list[tuple[float, Set, int]] = []  # the largest possible score, a set, a new block
    for before in front:
        linear, scores = before.linear, before.scores_beside
        tops: dict[EffectKey, tuple[float, int]] = {}
        for effect, numbers in linear.numbers_of.items():
            number = int(numbers[np.argmax(scores[numbers])])
            if scores[number] > -np.inf and not _is_barred(linear.blocks[number], before.entries):
                tops[effect] = round(float(scores[number]), _DECIMALS), number
        likely += [(score + before.unusual, before, number) for score, number in sorted(
            tops.values(), key=lambda each: -each[0])[:_BRANCHES]]
    likely.sort(key=lambda each: -each[0])
    front[0].linear.products_with([number for _, _, number in likely[:_TESTED]])  # at once: fast
    best: list[Set] = []
    for most, before, number in likely:
        if len(best) == _TESTED and best[-1].score > most:
            break
        best = _distinct([*best, before.extended(number)])[:_TESTED]
    return best


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
    """Return the best set of each list of effects and outliers, the best score first."""
    best: dict[tuple[frozenset[EffectKey], tuple[int, ...]], Set] = {}
    for chosen in sorted(sets, key=lambda chosen: -round(chosen.score, _DECIMALS)):
        best.setdefault((frozenset(chosen.effects), chosen.out), chosen)
    return list(best.values())


def is_significant(chosen: Set, block: int) -> bool:
    """
    Return whether noise alone hardly makes an effect this good beside the others of a set.

    An effect that leaves just the measured noise, where the others leave more, needs less.

    """
    left = chosen.linear.dof - chosen.parameters
    fills_gap = (scipy.special.chdtrc(left, chosen.rss) > _JUST_NOISE
                 and leaves_gap(chosen.without(block)))
    return chosen.probability(block) < (_LEVEL_OF_GAP if fills_gap else LEVEL)


def is_all_noise(chosen: Set) -> bool:
    return is_noise(chosen.rss, chosen.linear.dof - chosen.parameters)


def leaves_gap(chosen: Set) -> bool:
    """Return whether the noise is known and does not explain the rest."""
    return chosen.linear.worth > 0.0 and not is_all_noise(chosen)
