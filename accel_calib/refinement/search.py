# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The search for missing effects.

1. The effects of the ladder (offset, gain, gain by axis, cross-axis) that the base lacks are
   added.
2. A beam search (`.settle`) finds the set of effects, outliers and a random walk of the offset
   with the best score, in the equations near the model.
3. All values are fitted again, without the outliers, and the equations are set up near the new
   model. Steps 2 and 3 are repeated until the set remains the same, and again with products of two
   columns if a gap or a walk remains.
4. If the named effects explain only a small part of the residual above the noise, they are
   removed: the residual then has a cause outside of the catalogue. Beside a gap or a walk, an
   effect is also removed if its quantity explains more when it is shifted in time.
5. If a gap remains, or a walk, `.curves` looks for an empirical curve; a walk is added if it is
   the better description.
6. In the final model, an effect is removed if it is not significant or does not lower the held-out
   residual, and gives way to one that is more probable in its place.
7. If a scatter that all poses have (`accel_calib.estimate.outliers`) is as good an explanation as
   what was found, the search is repeated with it as part of the noise.

A set is kept only if its fit converged, the cost decreased and its values are plausible.

**Long tables.** A sample of a long table bounds the time and the memory of a refinement; such
tables come from machines, or are samples in place of poses. With `MOST` equations a refinement
takes 10 s and 300 MB as a rule, and about a minute and 900 MB in the worst case: all context, and
noise that no effect explains. A pose has one equation, or three if its orientation is known or
shared. The sample takes one pose out of each part of the table. The place in the part changes by
the golden ratio, so that a table that repeats the same turns gives all of them.

**Stored calibration as the base.** The calibration is the simulation, and the new poses are the
measurement. The poses of the calibration are added to the new poses, without their times, because
the clocks of two recordings can differ. If the file was edited by hand, or the new poses are
partly those of the calibration and contradict it, the readings that the calibration predicts
replace its measured ones.

"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
import scipy

from .curves import (
    best_curve, causes, CLEARLY, FoundCurve, one_curve, process_of, SIGNIFICANT, Walk, walk_beside)
from .linear import LEVEL, Set
from .settle import fit_without, make_sound, Near, settle
from .state import (
    beginning, Candidate, Clipped, fitted_state, linearised, off_grid, slope_of_temperature, State,
    unclipped, without)
from ..calibration import Calibration, in_g
from ..effects import (
    add_history, CHANGES, Covariate, COVARIATES, EffectKey, EFFECTS, entry_of, factors_of,
    included, LADDER, linear_values, Model, OwnEffect, parameter_names, unchanged, WANDER,
    with_vector)
from ..estimate import beside_scatter, estimate, judge, kinds, scatter_of, stated
from ..finding import has
from ..geometry import unit
from ..table import CONTEXT, Floats, Poses

MOST = 6000
"""Largest number of equations that a refinement uses."""

_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0

_SAME = 0.999
"""Quantile of chi² below which a stored calibration agrees with poses of its fit."""

_TIMED = 30.0
"""A curve over time must have a score better than a walk by this."""

_INSTEAD = {'force': 2.0, 'offset': 10.0, 'gain': 10.0}
"""A curve in place of one effect must have a score better by this (Kass and Raftery 1995:
positive, very strong). One over what changes slowly begins with half a wave, almost a line."""

_SEVERAL = 10.0
"""Each further effect of the same kind must raise the score by this: one unknown cause is more
likely than several that act at once (Kass and Raftery 1995: very strong)."""

_ALIKE = 0.5
"""Correlation of a quantity with itself, shifted in time, below which it counts as another one."""

_MOST_VARIED = 8
"""Largest number of columns whose products are tried; more would cost too much in the score."""

_LESS = 0.8
"""A scatter is tried again if less than this part of it is left."""

_LEAST_SHARE = 0.6
"""Part of the residual above the noise that the named effects must explain."""

_HELD_OUT = 0.7
"""Part of the squares above the noise that a curve must explain in poses held out. Chance also
finds a curve over some quantity for an offset that wanders, which explains less."""


def sampled(poses: Poses) -> Poses:
    """Return the poses for `MOST` equations, and as many of those of a stored calibration."""
    most = MOST // (3 if {'reference', 'orientation'} & set(poses.columns) else 1)
    if len(poses) <= most:
        return poses
    new = poses['new'] > 0.0 if 'new' in poses else np.ones(len(poses), bool)
    parts = []
    for part in (np.flatnonzero(new), np.flatnonzero(~new)):
        count = len(part)
        kept = _spread(count, most)
        if 'orientation' in poses and count > most:
            group = np.unique(poses['orientation'][part], return_inverse=True)[1]
            groups = int(group.max()) + 1
            whole = np.flatnonzero(np.isin(group, _spread(groups, max(most * groups // count, 1))))
            if most // 2 <= len(whole) <= 2 * most:
                kept = whole  # all poses of some orientations
        parts.append(part[kept])
    return poses.take(np.sort(np.concatenate(parts)))


def _spread(count: int, wanted: int) -> NDArray[np.intp]:
    """Return at most `wanted` different indices, one out of each part of the range."""
    if count <= wanted:
        return np.arange(count)
    part = np.arange(wanted)
    return np.unique(((part + part * _GOLDEN % 1.0) * (count / wanted)).astype(np.intp))


def beside_stored(poses_g: Poses, calibration: Calibration, model: Model) -> Poses:
    """
    Return new poses in g followed by those of a stored calibration, with the column ``new``.

    The ways between the poses of the calibration are those that `model` corrects.
    Return only the new poses, without this column, if the calibration has no effects or no poses,
    or was fitted to some of the new poses and still agrees with them.

    """
    stored = add_history(in_g(calibration.poses, calibration.units), model)
    stored = stored.take(np.isin(stored.row, calibration.used_poses.row))
    if not len(stored) or not calibration.model.effects:
        return poses_g
    new, old = ({tuple(row) for row in poses.reading.round(7).tolist()}  # files round
                for poses in (poses_g, stored))
    shared, edited = not new.isdisjoint(old), has(calibration.noted, 'edited')
    if shared and not edited:
        as_stored = Model(calibration.model.values)
        fit = estimate(as_stored, poses_g)
        excess = judge(as_stored, calibration.held(poses_g)).chi2 - fit.chi2
        worse = max(fit.chi2 / max(fit.dof, 1), 1.0)
        if excess / worse < scipy.special.chdtri(len(as_stored.vector), 1.0 - _SAME):
            return poses_g  # a fit is no better than the calibration
    if shared or edited:  # with the readings that the calibration predicts in their directions
        here = calibration.model.at(stored.columns)
        stored = stored.with_columns(reading=here.reading(unit(here.force(stored.reading))))
    ours, count = {**poses_g.columns, 'new': np.ones(len(poses_g))}, len(stored)
    optional = ('temperature', 'supply_voltage', 'rate', 'previous', *poses_g.quantities)
    unknown = {key: np.full((count, *ours[key].shape[1:]), np.nan)
               for key in optional if key in ours}
    theirs = {**unknown, **stored.columns, 'new': np.zeros(count)}
    if 'time' in calibration.ranges:  # limited to the range of the calibration
        ours['time'] = np.clip(ours['time'], *calibration.ranges['time'])
    elif 'time' in ours:
        theirs['time'] = np.full(count, np.nan)
    joined = join(replace(poses_g, columns=ours), replace(stored, columns=theirs))
    return joined if joined.noise is not None else joined.without_columns('std', 'count')


def join(poses: Poses, stored: Poses) -> Poses:
    """Return poses followed by those of a stored calibration, in orientations of their own."""
    columns = {key: np.concatenate([values, stored[key]])
               for key, values in poses.columns.items() if key in stored}
    if 'orientation' in poses or 'orientation' in stored:
        ours, theirs = (each['orientation'] if 'orientation' in each else
                        np.arange(float(len(each))) for each in (poses, stored))
        columns['orientation'] = np.concatenate([
            ours, np.min(ours) - 1.0 - theirs + np.min(theirs)])
    rows = int(poses.row.max()) + 1 + np.arange(len(stored))
    return replace(poses, columns=columns, row=np.concatenate([poses.row, rows]))


@dataclass(frozen=True)
class Found:
    """
    The result of a search.

    `base` and `final` are the states before and after it, with the same poses. `outliers` (d,) are
    the indices of the outliers. `near` has the equations near the final model. `added` are the
    added effects, in order, with `WANDER` last if the rest is a random walk of the offset; they
    are listed at the end of a search. `taken_back` are effects that were removed because they
    explain too little, or no more than by chance. Poses at the limit of the sensor are left out:
    they are `clipped`, and `with_clipped` is the base fitted to all poses. `grid_g` is the step of
    the grid of the readings [g], if it is relevant. `also` are the own effects that were asked
    for.

    """

    base: State
    final: State
    outliers: NDArray[np.intp]
    near: Near
    curve: FoundCurve | None = None
    added: tuple[EffectKey, ...] = ()
    taken_back: tuple[EffectKey, ...] = ()
    clipped: Clipped | None = None
    grid_g: float | None = None
    with_clipped: State | None = None
    also: tuple[OwnEffect, ...] = ()

    @cached_property
    def walk(self) -> Walk | None:
        """Return the walk beside the final model, at the poses kept."""
        linear = self.final.linear
        process = process_of(linear, self.final.poses_g) if self.near.walk is not None else None
        return None if process is None else walk_beside(Set.of(linear), process)

    @cached_property
    def left(self) -> tuple[Floats, Floats]:
        """Return the final residual without the walk, and the same held out."""
        if self.walk is None:
            return self.final.residual, self.final.held_out
        return self.walk.residuals(Set.of(self.final.linear), self.final.fit.equations.force)

    @cached_property
    def one_curve(self) -> tuple[str, ...]:
        """Return two effects that may be parts of one curve; empty if there are none."""
        return one_curve(self.final)


def search(poses_g: Poses, base: Model, also: tuple[OwnEffect, ...] = (), step: float = 0.0
           ) -> Found:
    """
    Search for the effects that a base lacks; `NotConvergedError` if its fit fails.

    `also` are own effects of the user, which are tried beside the catalogue, and `step` is that of
    the thermometer [°C].

    """
    everyone = np.arange(len(poses_g))
    whole, clip = unclipped(poses_g, base)
    if clip is not None:
        everyone = np.delete(everyone, clip.poses)
        poses_g = poses_g.take(everyone)
    poses_g, grid = off_grid(poses_g, base)
    found = _search(poses_g, base, also)
    again = _with_own_noise if 'new' in poses_g else _with_scatter
    found = again(found, poses_g, base, also)
    if step and (noise := poses_g.noise) is not None and not found.final.is_noise:
        # A walk, a curve or an effect could describe what the steps leave, alike in neighbours.
        slope = slope_of_temperature(judge(found.final.model, poses_g))
        change = step / np.sqrt(12.0) * np.abs(slope)
        if np.any(change):
            share = (found.final.rss / found.final.dof - 1.0) / np.mean((change / noise) ** 2)
            scatter = change * np.sqrt(min(float(share), 1.0))
            found = _beside(poses_g.with_columns(own_scatter=scatter), base, also)
    return replace(found, base=_weighted(found.base), final=_weighted(found.final),
                   outliers=everyone[found.outliers], clipped=clip, grid_g=grid,
                   with_clipped=whole, also=also)


def _with_own_noise(found: Found, poses_g: Poses, base: Model, also: tuple[OwnEffect, ...]
                    ) -> Found:
    """
    Search again if new poses, or those of a stored calibration, are noisier than stated.

    A walk or a curve could otherwise describe that one of them scatters more. The factors of the
    noise are those of the residuals beside the named effects.

    """
    near, noise = found.near, poses_g.noise
    if noise is None or not near.plain.worth or not (found.walk or found.curve):
        return found
    onto, residual = near.beside.spanned
    own = 1.0 - np.sum(near.plain.onto ** 2, axis=1) - np.sum(onto ** 2, axis=1)
    new, factor = poses_g['new'] > 0.0, np.ones(len(poses_g))
    for group in (new, ~new):
        rows = group[near.plain.pose]
        factor[group] = max(np.sum(residual[rows] ** 2) / max(np.sum(own[rows]), 1.0), 1.0)
    if np.ptp(factor) == 0.0:
        return found
    scatter = noise * np.sqrt(factor - 1.0)[:, np.newaxis]
    return _beside(poses_g.with_columns(own_scatter=scatter), base, also)


def _with_scatter(found: Found, poses_g: Poses, base: Model, also: tuple[OwnEffect, ...]) -> Found:
    """
    Search again if poses that scatter alike are as good an explanation as what was found.

    If their noise differs, the quiet ones have too much weight, and effects fit their scatter.

    """
    if not found.added:
        return found
    scatter, largest = scatter_of(found.base.fit), np.inf
    near = found.near
    added = near.beside.score if near.walk is None else near.walk.score
    curve = 0.0 if found.curve is None else found.curve.score
    if added + curve - near.beside.instead(()).score > scatter.evidence:
        return found
    while scatter.shows and scatter.size_g < _LESS * largest:
        largest = scatter.size_g
        found = _beside(beside_scatter(poses_g, largest), base, also)
        if not found.added:
            break
        scatter = scatter_of(found.final.fit)
    return found


def _weighted(state: State) -> State:
    """Return a state fitted beside the scatter of its poses, if it shows."""
    scatter, poses_g = scatter_of(state.fit), state.poses_g
    if not scatter.shows:
        return state
    found = fitted_state(state.model, beside_scatter(poses_g, scatter.size_g))
    return state if found is None else State(stated(found.fit))


def _beside(poses_g: Poses, base: Model, also: tuple[OwnEffect, ...]) -> Found:
    """Search in poses with a scatter, and state the result without it."""
    found = _search(poses_g, base, also)
    return replace(found, base=State(stated(found.base.fit)), final=State(stated(found.final.fit)))


def _search(poses_g: Poses, base: Model, also: tuple[OwnEffect, ...]) -> Found:
    """Search among the effects that are columns of the equations."""
    start = beginning(poses_g, base)
    poses_g = start.poses_g
    begun, near, _ = settle(start, poses_g, base.effects, _visible(start, LADDER), of_ladder=True)
    ladder = near.names
    fixed = (*base.effects, *ladder)
    fixed = tuple(name for name in fixed if name not in included(fixed))
    quantities = causes(poses_g)
    names: tuple[EffectKey, ...] = (
        *_visible(begun, LADDER), *(name for name in EFFECTS if name not in LADDER),
        *(own for own in also if own.name not in {*map(str, fixed)}),
        *(Covariate(part, (quantity,), power) for quantity in quantities
          for part in COVARIATES for power in (1, 2)),
        *_visible(begun, CHANGES))
    state, near, trial = settle(begun, poses_g, fixed, names)
    varied = {*quantities, *(column for column in CONTEXT if column in poses_g)}
    if len(varied) <= _MOST_VARIED and (near.walk is not None or not state.is_noise):
        products: tuple[EffectKey, ...] = tuple(
            Covariate(part, pair) for pair in combinations(sorted(varied), 2)
            for part in COVARIATES)
        beside = settle(begun, poses_g, fixed, (*names, *products))
        if not {*products}.isdisjoint(beside[1].names):
            state, near, trial = beside
        del beside  # before the next columns are made
    out, begun = near.chosen.out, fit_without(begun, poses_g, near.chosen.out)
    first = fit_without(start, poses_g, out) if out else start
    found = Found(first, state, np.array(out, np.intp), near)
    share = 1.0 - (state.rss - state.dof) / max(begun.rss - begun.dof, 1e-300)
    if near.names and near.walk is None and not state.is_noise and share < _LEAST_SHARE:
        found = replace(found, final=begun, taken_back=near.names,
                        near=replace(near, chosen=near.chosen.instead(())))
    chance = tuple(name for name in found.near.names if _is_coincidence(found, name))
    fewer = _less(found, chance)
    found = found if fewer is None else replace(fewer, taken_back=chance)
    found = _described(found, start, poses_g)
    state, near = make_sound(found.final, found.near, trial, found.base.model, ladder)
    there = {*state.model.values, *included(state.model.values), WANDER} - _of_a_turn(state)
    beyond = (*ladder, *near.names, *(() if found.curve is None else (found.curve.name,)),
              *(() if near.walk is None else (WANDER,)))
    return replace(found, final=state, near=near,
                   added=tuple(name for name in beyond if name in there))


def _is_coincidence(found: Found, name: EffectKey) -> bool:
    """
    Return whether an effect beside a gap or a walk explains less than its quantity, shifted.

    By chance, what is not recorded resembles another quantity that changes slowly. The quantity of
    the effect is therefore shifted cyclically in time. A true cause explains more than each shift
    that is hardly correlated with it.

    """
    state, values, entry = found.final, found.final.model.values, entry_of(name)
    if not entry.needs or name not in values or (found.walk is None and state.is_noise):
        return False
    shape = entry.split(values[name])[1]
    factor, = factors_of(name, [shape], state.fit.context)
    count, poses_g = len(state.poses_g), state.poses_g
    order = np.argsort(poses_g['time']) if 'time' in poses_g else np.arange(count)
    away = factor[:, order] - np.mean(factor, axis=1, keepdims=True)
    shifts = np.unique(np.linspace(1, count - 1, 100).astype(int))  # 100 or fewer
    moved = np.array([np.roll(away, shift, axis=1) for shift in shifts])
    alike = np.abs(np.sum(moved * away, axis=(1, 2))) > _ALIKE * np.sum(away ** 2)
    factors = moved[~alike][:, :, np.argsort(order)]  # (s, t or 1, n)
    if len(factors) < 2:
        return False
    shifted = Candidate(name, entry, (shape,) * len(factors), tuple(range(len(factors))),
                        tried=1.0, factors=factors)
    linear = linearised(state.fit, tuple(each for each in values if each != name), (shifted,))
    *others, own = Set.of(linear).gains()[0]
    return bool(max(others) > own)


def _described(found: Found, start: State, poses_g: Poses) -> Found:
    """Add an empirical curve if the names leave a gap, or if it is better than they or a walk."""
    if found.walk is None:
        instead = _with_one_curve(found, start, poses_g)
        if instead is not None or found.final.is_noise:
            return instead or found
    curve = best_curve(found.final, poses_g, found.near.chosen.out)
    if curve is None:
        return found
    # It may replace the effects of its variable.
    variable = curve.name.variable
    entries = {name: entry_of(name) for name in found.near.names}
    fewer = _less(found, [name for name, entry in entries.items()
                          if (entry.over or entry.needs) == (variable,)])
    if fewer is not None:
        again = best_curve(fewer.final, poses_g, found.near.chosen.out)
        if again is not None and again.name.variable == variable:
            return _described(fewer, start, poses_g)
    walking = _walking(found)
    if walking is not None and not _is_better(curve, walking.near):
        return walking
    return _with_curve(found, curve, start, poses_g) or found


def _with_one_curve(found: Found, start: State, poses_g: Poses) -> Found | None:
    """
    Replace the effects that change the same by one curve, if its score is better.

    A form outside of the catalogue is imitated by the effects nearest to it, and a smooth change
    whose cause is not recorded by those that change slowly. None if the names are better.

    """
    for what, better in _INSTEAD.items():
        names = [name for name in found.near.names
                 if (entry := entry_of(name)).family and entry.changes == what]
        if (beside := _less(found, names)) is None:
            continue
        gained = found.near.beside.score - beside.near.beside.score
        curve = best_curve(
            beside.final, poses_g, beside.near.chosen.out, of_force=what == 'force',
            least=max(gained + better - _SEVERAL * (len(names) - 1), CLEARLY))
        described = None if curve is None else _with_curve(beside, curve, start, poses_g)
        if described is not None and (described.final.is_noise or not found.final.is_noise):
            return described
    return None


def _with_curve(found: Found, curve: FoundCurve, start: State, poses_g: Poses) -> Found | None:
    """Return what was found, with a curve; None if its fit fails or poses held out disagree."""
    if curve.explained < _HELD_OUT:
        return None
    after = fitted_state(Model({**found.final.model.values, curve.name: curve.values}),
                         without(poses_g, curve.out))
    if after is None or after.fit.at_bound:
        return None
    near = replace(found.near, walk=None, chosen=found.near.beside)
    return replace(found, base=fit_without(start, poses_g, curve.out), final=after, near=near,
                   curve=curve, outliers=np.array(curve.out, np.intp))


def _less(found: Found, names: Collection[EffectKey]) -> Found | None:
    """
    Return what was found without some effects, with a walk estimated anew.

    None if there are no such effects, or if the fit without them fails.

    """
    state = found.final.refit_without(names) if names else None
    if state is None:
        return None
    near = replace(found.near, walk=None, chosen=found.near.beside.without(*names))
    fewer = replace(found, final=state, near=near)
    return fewer if found.walk is None else _walking(fewer) or fewer


def _walking(found: Found) -> Found | None:
    """Return what was found, with a walk; None if a walk is not significant."""
    near = found.near
    if found.walk is not None:
        return found
    walk = None if near.process is None else walk_beside(near.beside, near.process)
    if walk is None or walk.likelihood_ratio < SIGNIFICANT:
        return None
    near = replace(near, walk=walk, chosen=near.chosen.within(walk.whitened(near.plain)))
    return replace(found, near=near)


def _is_better(curve: FoundCurve, near: Near) -> bool:
    """Return whether a curve is better than a walk; one over time must be clearly better."""
    walk = 0.0 if near.walk is None else near.walk.score - near.beside.score
    return curve.score > walk + (_TIMED if curve.name.variable == 'time' else 0.0)


def _visible(state: State, names: Iterable[str]) -> tuple[str, ...]:
    """Return the effects of these names that a model lacks and the poses can show."""
    present = {*state.model.values, *included(state.model.values)}
    unknown = not len(kinds(state.poses_g)[0])
    return tuple(name for name in names if name not in present
                 and not (unknown and entry_of(name).known_orientation))


def _of_a_turn(state: State) -> set[EffectKey]:
    """
    Return the changes of gains that a mount that has turned explains.

    With W and its change C, the sensor reads (W + C) u, or W R u if it has turned by R. R is
    linear in its angles only to first order; the rest of W R - W is a symmetric change. R is that
    of W⁻¹ (W + C) = R P, and the changes are compared with it within their covariance. The fit
    does not depend on what is named.

    """
    changes = {name: CHANGES[name] for name in state.model.values if name in CHANGES}
    values: dict[EffectKey, Floats] = {
        change.base: state.model.values[name] for name, change in changes.items()}
    gains = [name for name, change in changes.items()
             if not entry_of(change.base).is_offset and not change.known_orientation]
    if not gains or not any(entry_of(name).known_orientation for name in values):
        return set()
    mat_w, mat_c = state.model.linear_part[0], Model(values).linear_part[0] - np.eye(3)
    left, _, right = np.linalg.svd(np.eye(3) + np.linalg.solve(mat_w, mat_c))
    turned = linear_values(np.eye(3) + mat_w @ (left @ right - np.eye(3)), np.zeros(3))
    names = parameter_names(state.model.effects)
    index = [names.index(f'{name}.{part}') for name in gains
             for part in entry_of(name).parameters]
    away = np.concatenate([state.model.values[name] - turned[CHANGES[name].base]
                           for name in gains])
    chi2 = away @ np.linalg.solve(state.fit.covariance[np.ix_(index, index)], away)
    return set(gains) if chi2 < scipy.special.chdtri(len(away), LEVEL) else set()


def with_changes(model: Model) -> tuple[Model, Floats]:
    """
    Return a model with the changes since the stored calibration included in its effects.

    The (q, p) matrix maps the values of `model` to those of the result.

    """
    effects: list[EffectKey] = []
    for name in sorted(model.effects, key=CHANGES.__contains__):  # the changes last
        own = unchanged(name)
        contained = included((own,)).intersection(effects)
        if contained:
            effects[effects.index(contained.pop())] = own
        elif own not in effects and own not in included(effects):
            effects.append(own)
    names = parameter_names(tuple(effects))
    owners: list[tuple[str, ...]] = []
    for own in map(unchanged, model.effects):  # of each value, those of the result it adds to
        whole = tuple(effect for effect in effects if own in included((effect,)))
        owners += [(value,) if own in effects else parameter_names(whole)
                   for value in parameter_names((own,))]
    matrix = np.array([[name in owner for owner in owners] for name in names], float)
    matrix = matrix.reshape(len(names), len(owners))
    values = with_vector(tuple(effects), matrix @ model.vector).values
    return Model(values, model.rotation), matrix
