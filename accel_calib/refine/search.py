# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The search for missing effects.

First the ladder: offset, gain, gain by axis, cross-axis, as far as the base lacks them, always the
one that lowers the criterion most. Then, in turn: poses that stand out go, if that lowers the
criterion more than any effect; otherwise the best effect is added, or the best pair where that is
better still, and everything is fitted again; then earlier names are tried anew, each against being
left out and against every other effect. At the end, names that explain no more than a part of what
lies above the noise are taken back: the rest then comes from something that is not in the
catalogue, and so may they.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .candidates import Candidate, LADDER
from .equations import kinds
from .knocked import knocked
from .least_squares import Fitted, fitted
from .noise import is_down_to_noise, is_noise
from .output import Clipped, off_grid, unclipped
from .pairs import best_pair, pair_is_better
from .score import agrees, fall_of, LEVEL, probability
from .state import beginning, plus, State
from ..model import Model
from ..table import Poses

_LARGEST = 5
"""Effects that are added at most."""

_KNOCKED_BETTER = 2.0
"""How many times more poses that stand out must say than any effect."""

_AS_GOOD = 6.0
"""Within this of the best criterion the effect with the fewest parameters is taken."""

_WALK_SIGNIFICANT = 8.0
"""Twice the logarithm of the likelihood ratio: p = 0.002."""

_LEAST_SHARE = 0.6
"""Part of what lies above the noise that the names must explain, if something else is left."""

WANDER = 'offset_wander'


@dataclass(frozen=True)
class Found:
    """
    What a search came to.

    Parameters
    ----------
    base, final : State
        Before and after; the same poses are kept in both.
    added : tuple of str
        Effects added, in order; `WANDER` last where the rest is a random walk of the offset.
    knocked : (d,) array of int
        Indices of the disturbed poses.
    taken_back : tuple of str
        Names that did not explain enough.
    clipped : Clipped or None
        Poses at the limit of the sensor; left out, too.
    grid_g : float or None
        Step of the grid on which readings lie [g], where it matters.
    with_clipped : State or None
        The base fitted to the clipped poses as well.

    """

    base: State
    final: State
    added: tuple[str, ...]
    knocked: NDArray[np.intp]
    taken_back: tuple[str, ...] = ()
    clipped: Clipped | None = None
    grid_g: float | None = None
    with_clipped: State | None = None


def search(poses_g: Poses, base: Model) -> Found:
    """
    Search for what a base model lacks.

    Parameters
    ----------
    poses_g : Poses
        In g.
    base : Model
        With ΔR = I.

    """
    everyone = np.arange(len(poses_g))
    whole, clip = unclipped(poses_g, base)
    if clip is not None:
        everyone = np.delete(everyone, clip.poses)
        poses_g = poses_g.take(everyone)
    poses_g, grid = off_grid(poses_g, base)
    found = _search(poses_g, base, _KNOCKED_BETTER)
    if not is_noise(found.final):  # a few knocked poses may look like an effect
        other = _search(poses_g, base, 0.0)
        if other.knocked.size and is_noise(other.final):
            found = other
    return replace(found, knocked=everyone[found.knocked], clipped=clip, grid_g=grid,
                   with_clipped=whole)


def _search(poses_g: Poses, base: Model, patience: float) -> Found:
    """
    Search among the effects that are columns beside the model.

    Poses that stand out go first where they say more than `patience` times any effect.

    """
    state = beginning(poses_g, base)
    state, ladder = _climb(state)
    state, out = _settle(state, np.arange(len(poses_g)), patience)
    start, added = state, ladder
    names: tuple[str, ...] = ()
    been: set[frozenset[str]] = set()  # a name may go again when another comes: not for ever
    while len(names) < _LARGEST and not (names and is_down_to_noise(state)):
        if frozenset(names) in been:
            break
        been.add(frozenset(names))
        step = _next(state)
        if not step:
            break
        for candidate in step:
            among = state.candidates_among((candidate.effect,))
            if candidate.effect in among:
                state = plus(state, among[candidate.effect])
                names = (*names, candidate.effect)
        state, more = _climb(state)  # what was missing may have hidden a rung
        added = (*added, *more)
        state, names = _tried_anew(state, names)
    if out.size or names:
        state, out, start = _settled_again(poses_g, start, state)
    names, state, back = _judged(start, state, names)
    if _walks(state):
        state, names = _called_for_beside_walk(state, names)
        return _end(poses_g, base, state, (*added, *names, WANDER), out, back)
    return _end(poses_g, base, state, (*added, *names), out, back)


def _end(poses_g: Poses, base: Model, state: State, added: tuple[str, ...],
         out: NDArray[np.intp], back: tuple[str, ...]) -> Found:
    kept = np.delete(np.arange(len(poses_g)), out)
    there = {*state.model.values, WANDER}
    if 'axis_gain' in there:
        there.add('gain')  # a rung below it
    added = tuple(name for name in added if name in there)
    return Found(beginning(poses_g.take(kept), base), state, added, out, back)


def _climb(state: State) -> tuple[State, tuple[str, ...]]:
    """Add the effects of V and W that the base lacks and the poses call for."""
    added: tuple[str, ...] = ()
    while True:
        found = state.candidates_among(_rungs(state))
        best = _best(found, state.fitted, state.dof)
        if best is None or not _called_for(best, found, state):
            return state, added
        if best.effect == 'axis_gain' and 'gain' in found and probability(
                found['gain'], state.fitted, state.dof, len(found)) < LEVEL:
            best = found['gain']  # one rung at a time
        state = plus(state, best)
        added = (*added, best.effect)


def _called_for(best: Candidate, found: dict[str, Candidate], state: State) -> bool:
    """Tell whether a rung is called for, alone or with all the others: one may hide another."""
    columns = fitted(np.zeros(len(state.near.residual)), np.zeros((len(state.near.residual), 0)))
    for candidate in found.values():
        columns = columns.with_columns(candidate.columns)
    together = replace(best, columns=columns.onto)
    return any(probability(candidate, state.fitted, state.dof, len(found)) < LEVEL
               for candidate in (best, together))


def _rungs(state: State) -> tuple[str, ...]:
    """Give the effects of the ladder that may come next."""
    present = state.model.values
    rungs = ['offset', 'cross_axis']
    if 'axis_gain' not in present:
        rungs += ['gain', 'axis_gain']
    if len(kinds(state.poses_g)[0]):
        rungs.append('misalignment')
    return tuple(name for name in LADDER if name in rungs and name not in present)


def _best(found: dict[str, Candidate], fitted: Fitted, dof: int) -> Candidate | None:
    """Give the candidate with which the criterion falls most, or a smaller one as good."""
    if not found:
        return None
    falls = {name: fall_of(candidate, fitted, dof) for name, candidate in found.items()}
    most = max(falls.values())
    near = [name for name, falls_by in falls.items() if falls_by > most - _AS_GOOD]
    return found[min(near, key=lambda name: (found[name].parameters, -falls[name]))]


def _settle(state: State, rows: NDArray[np.intp], patience: float
            ) -> tuple[State, NDArray[np.intp]]:
    """Take out poses that stand out, where that says more than any effect."""
    standing = knocked(state.near, state.fitted)
    best = _best(state.found, state.fitted, state.dof)
    rival = 0.0 if best is None else fall_of(best, state.fitted, state.dof)
    if state.wander is not None:
        rival = max(rival, state.wander.fall)
    if not standing.poses.size or standing.fall <= patience * rival:
        return state, rows[:0]
    return state.without(standing.poses), rows[standing.poses]


def _settled_again(poses_g: Poses, start: State, state: State
                   ) -> tuple[State, NDArray[np.intp], State]:
    """Judge all poses anew in the model that was found."""
    # Near the model of the good poses: one that the knocked ones shaped bends the equations.
    whole = State(state.model, beginning(poses_g, start.model).poses_g)
    standing = knocked(whole.near, whole.fitted)
    again = whole.without(standing.poses)
    before = State(start.model, again.poses_g).with_effects(dict(start.model.values))
    return again, standing.poses, before


def _next(state: State) -> tuple[Candidate, ...]:
    """Give the effect, or the pair of effects, to add; none where nothing is missing."""
    found = state.found
    single = _best(found, state.fitted, state.dof)
    if single is None:
        return ()
    among = len(found)
    walk = state.wander
    falls = fall_of(single, state.fitted, state.dof)
    pair = best_pair(found, state) if falls > 0.0 else None
    if pair is not None and pair_is_better(pair, single, state, among):
        return pair
    if walk is not None and walk.fall > falls and not is_noise(state):
        return _next_beside_walk(state)
    admitted = (probability(single, state.fitted, state.dof, among) < LEVEL
                and agrees(single, state.fitted))
    return (single,) if admitted else ()


def _next_beside_walk(state: State) -> tuple[Candidate, ...]:
    """Give the effect that is called for although the offset wanders; none if there is none."""
    found = state.found_beside_walk()
    single = _best(found, state.beside_walk, state.dof)
    if single is None or probability(single, state.beside_walk, state.dof, len(found)) > LEVEL:
        return ()
    among = state.candidates_among((single.effect,))
    return (single,) if single.effect in among and agrees(among[single.effect],
                                                          state.fitted) else ()


def _tried_anew(state: State, names: tuple[str, ...]) -> tuple[State, tuple[str, ...]]:
    """Try each name against being left out, and against every other effect."""
    for name in names:
        if name not in state.model.values:
            continue
        values = {key: part for key, part in state.model.values.items() if key != name}
        without = state.with_effects(values)
        found = without.found
        if name not in found:
            continue
        best = _best(found, without.fitted, without.dof)
        if best is None or probability(found[name], without.fitted, without.dof,
                                       len(found)) > LEVEL:
            state, names = without, tuple(other for other in names if other != name)
        elif best.effect != name and best.effect not in names:
            state = plus(without, best)
            names = tuple(best.effect if other == name else other for other in names)
    return state, names


def _judged(start: State, state: State, names: tuple[str, ...]
            ) -> tuple[tuple[str, ...], State, tuple[str, ...]]:
    """Take the names back if something else is left and they explain too little of the whole."""
    if not names or state.noise is None or is_noise(state):
        return names, state, ()
    above = start.fitted.rss - start.dof
    explained = 1.0 - (state.fitted.rss - state.dof) / max(above, 1e-300)
    if explained >= _LEAST_SHARE:
        return names, state, ()
    return (), start, names


def _called_for_beside_walk(state: State, names: tuple[str, ...]
                            ) -> tuple[State, tuple[str, ...]]:
    """Keep the names that are called for although the offset wanders."""
    for name in names:
        values = {key: part for key, part in state.model.values.items() if key != name}
        without = state.with_effects(values)
        found = without.found_beside_walk()
        if name not in found or probability(found[name], without.beside_walk, without.dof,
                                            len(found)) > LEVEL:
            state, names = without, tuple(other for other in names if other != name)
    return state, names


def _walks(state: State) -> bool:
    """Tell whether what is left is a random walk of the offset."""
    walk = state.wander
    if walk is None or walk.likelihood_ratio < _WALK_SIGNIFICANT or is_noise(state):
        return False
    return bool(walk.left_out @ walk.left_out < state.fitted.left_out @ state.fitted.left_out)
