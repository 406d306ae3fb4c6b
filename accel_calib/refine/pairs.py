# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Pairs of effects: two that are missing together may each look like something else."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from .candidates import Candidate
from .score import fall_of, gain_of, LEVEL, probability
from .state import State

_PAIR_BETTER = 12.0
"""By how much the criterion of a pair must be below that of the best two steps of one."""


def best_pair(found: dict[str, Candidate], state: State) -> tuple[Candidate, Candidate] | None:
    """Give the pair with which the criterion falls most, the better one first."""
    best, most = None, -np.inf
    residual, count = state.fitted.residual, state.dof
    for first, second in combinations(found.values(), 2):
        both = np.hstack([first.columns, second.columns])
        onto = np.linalg.qr(both)[0]
        gain = float(np.sum((onto.T @ residual) ** 2))
        falls = (count * np.log(state.fitted.rss / max(state.fitted.rss - gain, 1e-300))
                 - (first.parameters + second.parameters) * np.log(count)
                 - 2.0 * np.log(first.tried * second.tried))
        if falls > most:
            best, most = (first, second), falls
    if best is None:
        return None
    ordered = sorted(best, key=lambda c: -gain_of(c.columns, state.fitted))
    return ordered[0], ordered[1]


def pair_is_better(pair: tuple[Candidate, Candidate], single: Candidate, state: State,
                   among: int) -> bool:
    """Tell whether both of a pair are called for, and the best single one is in neither's way."""
    if single.effect in (pair[0].effect, pair[1].effect):
        return False
    count = state.dof
    for one, other in (pair, pair[::-1]):
        beside = state.fitted.plus(other.columns)
        left = Candidate(one.effect, one.shape, beside.without_model(one.columns), one.searched,
                         one.tried)
        if not left.columns.shape[1] or probability(
                left, beside, state.dof - other.parameters, among) > LEVEL:
            return False
    first = state.fitted.plus(single.columns)
    second = max((fall_of(replace(c, columns=first.without_model(c.columns)), first, count)
                  for c in state.found.values() if c.effect != single.effect), default=0.0)
    greedy = fall_of(single, state.fitted, count) + max(second, 0.0)
    with_one = state.fitted.plus(pair[0].columns)
    together = fall_of(pair[0], state.fitted, count) + fall_of(
        replace(pair[1], columns=with_one.without_model(pair[1].columns)), with_one, count)
    return together > greedy + _PAIR_BETTER
