# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Rivals: effects that would explain the data about as well as a named one.

The probability of an effect against its rivals follows from the score of the set with each of them
in its place, exp(c score / 2), all else being equal (Kass and Raftery 1995). The noise is
estimated from the same equations, so differences are less certain: c is the share of the degrees
of freedom that the set leaves.

"""

from __future__ import annotations

import numpy as np

from .curves import walk_beside
from .search import Near
from ..effects import LADDER, WANDER

LEAST = 0.01
"""Smallest probability of a rival."""


def probabilities(name: str, near: Near) -> dict[str, float]:
    """
    Return the probability of a named effect and of each effect in its place.

    Parameters
    ----------
    name : str
        A chosen effect, or `WANDER`.
    near : Near
        The final equations and set.

    Returns
    -------
    dict
        Probability by name, the most probable first; they sum to 1.

    """
    if name != WANDER and name not in near.names:
        return {name: 1.0}
    scores = _scores(name, near)
    most = max(scores.values())
    weights = {key: float(np.exp(_certainty(near) * (score - most) / 2.0))
               for key, score in scores.items()}
    total = sum(weights.values())
    ordered = sorted(weights, key=lambda key: -weights[key])
    return {key: weights[key] / total for key in ordered}


def _certainty(near: Near) -> float:
    """Return the share of the equations that the set leaves for an estimate of the noise."""
    whole = near.plain.worth + near.plain.dof
    return max((whole - near.chosen.parameters) / whole, LEAST)


def _scores(name: str, near: Near) -> dict[str, float]:
    """Return the score of the set with each effect in the place of the named one."""
    if name == WANDER:
        problem, own = near.plain, []
    else:
        problem, own = near.linear, [near.chosen.blocks[near.names.index(name)]]
    others = problem.made([block for block in near.chosen.blocks if block not in own],
                          near.chosen.out)
    scores = {name: near.chosen.score}
    least = near.chosen.score + 2.0 * np.log(LEAST) / _certainty(near)
    gain, rank = problem.gains(others)
    for number, block in enumerate(problem.blocks):
        if (rank[number] and block.effect not in near.names
                and (block.effect in LADDER or name not in LADDER)
                and problem.score_with(others, number, gain[number], rank[number]) > least):
            score = problem.made((*others.blocks, number), others.out).score
            scores[block.effect] = max(score, scores.get(block.effect, -np.inf))
    if name != WANDER and near.walk is None and near.process is not None:
        scores[WANDER] = walk_beside(near.plain, others, near.process).score
    return scores
