# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The way on which each pose was reached, and when, from the forces of successive poses.

A table states the mean time of a pose. With its duration, the turn before it ends where the pose
begins. Otherwise the time since the turn counts from the last pose before it: between a turn and
the poses on both sides are unknown times, which only change the size of an exponential.

"""

from itertools import product

import numpy as np

from .form import Context
from .model import Model
from ..geometry import unit
from ..table import Floats, Poses

_MOVED = np.radians(3.0)
"""Smallest change of direction of a move [rad]; less may be noise or settling."""

_NO_MOTION_G = 0.002
"""Motion along an axis that has either sign [g]."""

_MOST_WAYS = 30
_SAME_G = 1e-7
"""Largest number of iterations of the ways between poses, and the change of the forces [g] below
which they end."""

_SIGNS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""Signs of a motion along the axes."""


def way_to(force: Floats, known: Context, signs: Floats = np.zeros((1, 3))) -> Floats:
    """
    Return (n, 3) unit vectors towards the previous pose, in order of the known time, or of rows.

    The last motion counts for all successive poses of one orientation; before the first motion the
    vector is zero. `force` are (c, n, 3) forces [g], for a motion with each of (c, 3) signs; 0 is
    any. Of the motions that have their signs, the one counts whose force is nearest to 1 g.

    """
    previous, away = np.zeros(force.shape[1:]), np.abs(np.linalg.norm(force, axis=2) - 1.0)
    force, towards = unit(force), np.zeros(3)
    order = np.argsort(known['time'], kind='stable') if 'time' in known else np.arange(len(away.T))
    resting = np.mean(force[:, order[:1]], axis=(0, 1))  # no motion leads to the first pose
    for here in order[1:]:
        steps = resting - force[:, here]
        best = int(np.argmin(away[:, here] + np.any(signs * steps < -_NO_MOTION_G, axis=1)))
        step = np.where(signs[best], np.copysign(steps[best], signs[best]), steps[best])
        length = float(np.linalg.norm(step))
        if length > _MOVED:
            towards, resting = step / length, force[best, here]
        previous[here] = towards
    return previous


def way_of(poses_g: Poses, model: Model) -> Floats:
    """Return the (n, 3) unit vectors towards the previous pose, by the forces of a model."""
    mat_w, vec_v = model.linear_part
    force = (poses_g.reading - vec_v) @ np.linalg.inv(mat_w).T
    way, known = way_to(force[np.newaxis], poses_g.columns), poses_g.columns
    if 'previous' not in model.needs or any(
            key not in known for key in model.needs if key != 'previous'):
        return way

    def forces(previous: Floats) -> Floats:
        turns = with_turns({**known, 'previous': way})
        return model.at({**turns, 'previous': previous}).force(poses_g.reading)

    if np.array_equal(forces(way), forces(np.sign(way))):
        both = [forces(np.broadcast_to(each, force.shape)) for each in _SIGNS]
        return way_to(np.array(both), known, _SIGNS)
    for _ in range(_MOST_WAYS):
        before, force = force, forces(way)
        way = way_to(force[np.newaxis], known)
        if np.max(np.abs(force - before), initial=0.0) < _SAME_G:
            break
    return way


def with_turns(known: Context) -> Context:
    """Return context with the time from the last turn to the start of each pose [s], if known."""
    if 'time' not in known or 'since_turn' in known:
        return known
    order = np.argsort(known['time'], kind='stable')
    start = (known['time'] - known.get('duration', 0.0) / 2.0)[order]
    turned = np.any(np.diff(known['previous'][order], axis=0, prepend=np.nan), axis=1)
    first = np.maximum.accumulate(np.where(turned, np.arange(len(order)), 0))
    if 'duration' not in known:
        first = np.maximum(first - 1, 0)
    return {**known, 'since_turn': (start - start[first])[np.argsort(order)]}
