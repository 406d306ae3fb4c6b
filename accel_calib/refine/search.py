# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The search for missing effects.

1. The effects of the ladder (offset, gain, gain by axis, cross-axis) that the base lacks are
   added, always the one that reduces the criterion most.
2. Outliers are left out, if this reduces the criterion more than any effect.
3. The best effect is added, or the best pair if it is clearly better, and all values are fitted
   again. Then every named effect is tested again, against its removal and against every other
   effect. This step is repeated.
4. If the named effects explain only a small part of the residual above the noise, they are
   removed: the residual then has a cause outside of the catalogue.

An effect is kept only if its fit converged, the cost decreased and its values are plausible.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .candidates import (
    agrees,
    best_of,
    best_pair,
    Candidate,
    fall,
    fall_of,
    LEVEL,
    pair_is_better,
    probability,
    projected,
)
from .output import Clipped, off_grid, unclipped
from .state import beginning, State
from ..effects import LADDER, WANDER
from ..estimate.equations import kinds
from ..estimate.fit import judge
from ..estimate.outliers import outliers
from ..model import Model
from ..table import Poses

_LARGEST = 5
"""Largest number of added effects."""

_OUTLIERS_BETTER = 2.0
"""Outliers are left out first if they explain this many times more than any effect."""

_WALK_SIGNIFICANT = 8.0
"""Twice the logarithm of the likelihood ratio above which a walk is named: p = 0.002."""

_LEAST_SHARE = 0.6
"""Part of the residual above the noise that the named effects must explain."""


@dataclass(frozen=True)
class Found:
    """
    The result of a search.

    Parameters
    ----------
    base, final : State
        State before and after the search, with the same poses.
    added : tuple of str
        Added effects, in order; `WANDER` is last if the rest is a random walk of the offset.
    outliers : (d,) array of int
        Indices of the outliers.
    taken_back : tuple of str
        Effects that were removed because they did not explain enough.
    clipped : Clipped or None
        Poses at the limit of the sensor, which are left out.
    grid_g : float or None
        Step of the grid of the readings [g], if it is relevant.
    with_clipped : State or None
        The base fitted to all poses, including the clipped ones.

    """

    base: State
    final: State
    added: tuple[str, ...]
    outliers: NDArray[np.intp]
    taken_back: tuple[str, ...] = ()
    clipped: Clipped | None = None
    grid_g: float | None = None
    with_clipped: State | None = None


def search(poses_g: Poses, base: Model) -> Found:
    """
    Search for the effects that a base model lacks.

    Parameters
    ----------
    poses_g : Poses
        Poses in g.
    base : Model
        The base model, with ΔR = I.

    Raises
    ------
    NotConvergedError
        If the fit of the base does not converge.

    """
    everyone = np.arange(len(poses_g))
    whole, clip = unclipped(poses_g, base)
    if clip is not None:
        everyone = np.delete(everyone, clip.poses)
        poses_g = poses_g.take(everyone)
    poses_g, grid = off_grid(poses_g, base)
    found = _search(poses_g, base, _OUTLIERS_BETTER)
    if not found.final.is_noise:  # a few outliers may look like an effect
        other = _search(poses_g, base, 0.0)
        if other.outliers.size and other.final.is_noise:
            found = other
    return replace(found, outliers=everyone[found.outliers], clipped=clip, grid_g=grid,
                   with_clipped=whole)


def _search(poses_g: Poses, base: Model, patience: float) -> Found:
    """
    Search among the effects that are columns of the equations.

    Outliers are left out first if they explain more than `patience` times any effect.

    """
    start = beginning(poses_g, base)
    state, ladder = _with_ladder(start)
    state, out = _without_outliers(state, patience)
    begun, added = state, ladder
    names: tuple[str, ...] = ()
    tried: set[frozenset[str]] = set()  # effects may replace each other, but not in a cycle
    while len(names) < _LARGEST and not (names and state.is_down_to_noise):
        if frozenset(names) in tried:
            break
        tried.add(frozenset(names))
        after, new = _next(state)
        if not new:
            break
        state, more = _with_ladder(after)  # the missing effect may have hidden an effect of V or W
        names, added = (*names, *new), (*added, *more)
        state, names = _tested_again(state, names)
    if out.size or names:
        state, out, begun = _outliers_again(start, begun, state)
    names, state, back = _judged(begun, state, names)
    if _walks(state):
        state, names = _significant_beside_walk(state, names)
        added = (*added, *names, WANDER)
    else:
        added = (*added, *names)
    return _end(start, state, added, out, back)


def _end(start: State, state: State, added: tuple[str, ...], out: NDArray[np.intp],
         back: tuple[str, ...]) -> Found:
    there = {*state.model.values, WANDER}
    if 'axis_gain' in there:
        there.add('gain')  # axis_gain includes it
    base = start.without(out) if out.size else start
    return Found(base or start, state, tuple(name for name in added if name in there), out, back)


def _with_ladder(state: State) -> tuple[State, tuple[str, ...]]:
    """Add the effects of V and W that the base lacks and the poses support."""
    added: tuple[str, ...] = ()
    while True:
        found = state.candidates_among(_ladder_effects(state))
        best = best_of(found, state.fitted, state.dof)
        if best is None or not _is_supported(best, found, state):
            return state, added
        if best.effect == 'axis_gain' and 'gain' in found and probability(
                found['gain'], state.fitted, state.dof, len(found)) < LEVEL:
            best = found['gain']  # the smaller model first
        after = state.plus(best)
        if after is None:
            return state, added
        state, added = after, (*added, best.effect)


def _is_supported(best: Candidate, found: dict[str, Candidate], state: State) -> bool:
    """Return whether an effect is significant, alone or with all others that it may hide."""
    columns = projected(np.zeros(len(state.fit.residual)), state.fitted.onto[:, :0])
    for candidate in found.values():
        columns = columns.with_columns(candidate.columns)
    together = replace(best, columns=columns.onto)
    return any(probability(candidate, state.fitted, state.dof, len(found)) < LEVEL
               for candidate in (best, together))


def _ladder_effects(state: State) -> tuple[str, ...]:
    """Return the effects of the ladder that can be added next."""
    present = state.model.values
    possible = ['offset', 'cross_axis']
    if 'axis_gain' not in present:
        possible += ['gain', 'axis_gain']
    if len(kinds(state.poses_g)[0]):
        possible.append('misalignment')
    return tuple(name for name in LADDER if name in possible and name not in present)


def _without_outliers(state: State, patience: float) -> tuple[State, NDArray[np.intp]]:
    """Leave out outliers, if this explains more than any effect."""
    none = np.zeros(0, np.intp)
    out = outliers(state.fit, len(state.poses_g))
    if not out.poses.size:
        return state, none
    best = best_of(state.found, state.fitted, state.dof)
    rival = 0.0 if best is None else fall_of(best, state.fitted, state.dof)
    if state.wander is not None:
        rival = max(rival, state.wander.fall)
    rows = np.isin(state.fit.equations.pose, out.poses)
    # 2 log n per outlier is the cost of its selection among n poses.
    falls = (fall(max(state.fitted.rss - out.chi2, 0.0), state.fitted.rss, state.dof,
                  float(np.sum(rows)))
             - 2.0 * len(out.poses) * np.log(len(state.poses_g)))
    after = state.without(out.poses) if falls > patience * rival else None
    return (state, none) if after is None else (after, out.poses)


def _outliers_again(start: State, begun: State, state: State
                    ) -> tuple[State, NDArray[np.intp], State]:
    """Find the outliers among all poses again, with the model of the search."""
    # Linearised at the model of the good poses, because outliers distort other models.
    whole = State(judge(state.model, start.poses_g))
    out = outliers(whole.fit, len(start.poses_g)).poses
    again = whole.without(out)
    before = State(judge(begun.model, start.poses_g)).without(out)
    if again is None or before is None:
        kept = np.isin(start.poses_g.row, state.poses_g.row)
        return state, np.flatnonzero(~kept), begun
    return again, out, before


def _next(state: State) -> tuple[State, tuple[str, ...]]:
    """Return the state with one more effect or pair of effects, and their names; () if none."""
    found = dict(state.found)
    while found:
        new = _admitted(state, found)
        if not new:
            break
        after = _with(state, new)
        if after is not None:
            return after, tuple(candidate.effect for candidate in new)
        del found[new[0].effect]  # it has no sound fit, so try the next one
    return state, ()


def _with(state: State, new: tuple[Candidate, ...]) -> State | None:
    """Return the state with these candidates in the model, or None without a sound fit."""
    for candidate in new:
        among = state.candidates_among((candidate.effect,))
        after = state.plus(among[candidate.effect]) if among else None
        if after is None:
            return None
        state = after
    return state


def _admitted(state: State, found: dict[str, Candidate]) -> tuple[Candidate, ...]:
    """Return the best effect, or the best pair of effects, if it is significant."""
    fitted, dof = state.fitted, state.dof
    single = best_of(found, fitted, dof)
    if single is None:
        return ()
    falls = fall_of(single, fitted, dof)
    pair = best_pair(found, fitted, dof) if falls > 0.0 else None
    if pair is not None and pair_is_better(pair, single, fitted, dof, found):
        return pair
    walk = state.wander
    if walk is not None and walk.fall > falls and not state.is_noise:
        return _admitted_beside_walk(state, found)
    admitted = (probability(single, fitted, dof, len(found)) < LEVEL and agrees(single, fitted))
    return (single,) if admitted else ()


def _admitted_beside_walk(state: State, among: dict[str, Candidate]) -> tuple[Candidate, ...]:
    """Return the best effect if it is significant in addition to a walk of the offset."""
    found = {name: each for name, each in state.found_beside_walk().items() if name in among}
    single = best_of(found, state.beside_walk, state.dof)
    if single is None or probability(single, state.beside_walk, state.dof, len(found)) > LEVEL:
        return ()
    return (single,) if agrees(among[single.effect], state.fitted) else ()


def _tested_again(state: State, names: tuple[str, ...]) -> tuple[State, tuple[str, ...]]:
    """Test each effect against its removal, and against every other effect."""
    for name in names:
        without = state.without_effect(name) if name in state.model.values else None
        if without is None or name not in without.found:
            continue
        found = without.found
        best = best_of(found, without.fitted, without.dof)
        if best is None or probability(found[name], without.fitted, without.dof,
                                       len(found)) > LEVEL:
            state, names = without, tuple(other for other in names if other != name)
        elif best.effect != name and best.effect not in names:
            after = without.plus(best)
            if after is not None:
                state = after
                names = tuple(best.effect if other == name else other for other in names)
    return state, names


def _judged(begun: State, state: State, names: tuple[str, ...]
            ) -> tuple[tuple[str, ...], State, tuple[str, ...]]:
    """Remove all effects if a gap remains and they explain too little of the residual."""
    if not names or not state.fit.noise_known or state.is_noise:
        return names, state, ()
    above = begun.fitted.rss - begun.dof
    explained = 1.0 - (state.fitted.rss - state.dof) / max(above, 1e-300)
    if explained >= _LEAST_SHARE:
        return names, state, ()
    return (), begun, names


def _significant_beside_walk(state: State, names: tuple[str, ...]
                             ) -> tuple[State, tuple[str, ...]]:
    """Keep the effects that are significant in addition to a walk of the offset."""
    for name in names:
        without = state.without_effect(name)
        if without is None:
            continue
        found = without.found_beside_walk()
        if name not in found or probability(found[name], without.beside_walk, without.dof,
                                            len(found)) > LEVEL:
            state, names = without, tuple(other for other in names if other != name)
    return state, names


def _walks(state: State) -> bool:
    """Return whether the remaining residual is a random walk of the offset."""
    walk = state.wander
    if walk is None or walk.likelihood_ratio < _WALK_SIGNIFICANT or state.is_noise:
        return False
    return bool(walk.held_out @ walk.held_out < state.fitted.held_out @ state.fitted.held_out)
