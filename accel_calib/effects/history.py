# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The context of poses and samples that follows from those before them.

**Temperature.** Its rate, and the temperature that acts with a lag (`.thermal`).

**Way.** A pose has the way on which it was reached, and when, from the forces of successive poses.
A table states the mean time of a pose. With its duration, the turn before it ends where the pose
begins. Otherwise the time since the turn counts from the last pose before it: between a turn and
the poses on both sides are unknown times, which only change the size of an exponential.

"""

from collections import deque
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from .form import Context
from .model import Model
from .thermal import acting_temperature, between_steps, rate_at, ThermalStream
from ..geometry import unit
from ..table import Floats, Poses

FROM_TEMPERATURE = ('temperature_rate', 'temperature_of_offset', 'temperature_of_gain')
"""Context that is computed from time and temperature."""

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


def _find_way(poses_g: Poses, model: Model) -> Floats:
    """Return the (n, 3) unit vectors towards the previous pose, by the forces of a model."""
    mat_w, vec_v = model.linear_part
    force = (poses_g.reading - vec_v) @ np.linalg.inv(mat_w).T
    way, known = way_to(force[np.newaxis], poses_g.columns), poses_g.columns
    if 'previous' not in model.needs or any(
            key not in known for key in model.needs if key != 'previous'):
        return way

    def forces(previous: Floats) -> Floats:
        turns = add_turns({**known, 'previous': way})
        return model.at({**turns, 'previous': previous}).force(poses_g.reading)

    force = forces(way)
    by_sign = np.array_equal(force, forces(np.sign(way)))
    for _ in range(_MOST_WAYS):
        if by_sign:
            each_sign = [forces(np.broadcast_to(signs, force.shape)) for signs in _SIGNS]
            way = way_to(np.array(each_sign), known, _SIGNS)
        else:
            way = way_to(force[np.newaxis], known)
        before, force = force, forces(way)
        if np.max(np.abs(force - before), initial=0.0) < _SAME_G:
            break
    return way


def add_turns(known: Context) -> Context:
    """
    Return context with the way of the turn before the last one.

    With the time, also with that from the last turn to the start of each pose [s].

    """
    if 'earlier' in known:
        return known
    count = len(known['previous'])
    order = np.argsort(known['time'], kind='stable') if 'time' in known else np.arange(count)
    back, way = np.argsort(order), known['previous'][order]
    turned = np.any(np.diff(way, axis=0, prepend=np.nan), axis=1)
    first = np.maximum.accumulate(np.where(turned, np.arange(count), 0))
    earlier = np.where(first[:, np.newaxis] > 0, way[first - 1], 0.0)[back]
    if 'time' not in known or 'since_turn' in known:
        return {**known, 'earlier': earlier}
    start = (known['time'] - known.get('duration', 0.0) / 2.0)[order]
    if 'duration' not in known:
        first = np.maximum(first - 1, 0)
    return {**known, 'earlier': earlier, 'since_turn': (start - start[first])[back]}


def add_history(poses_g: Poses, model: Model) -> Poses:
    """
    Return poses in g with the context that comes from the poses before and after.

    That is ``temperature_rate``, ``since_turn``, ``earlier``, and ``previous``, the unit vector
    towards the previous pose in order of time, or of rows; columns of the table are kept. A
    temperature in steps is estimated between them. The directions are those that the model
    corrects. If it needs ``previous`` for that, both are iterated; for a model that depends on its
    signs alone, all signs are compared.

    """
    if 'time' in poses_g and 'temperature' in poses_g and 'temperature_rate' not in poses_g:
        poses_g = poses_g.with_columns(
            temperature=between_steps(poses_g['time'], poses_g['temperature']))
        poses_g = poses_g.with_columns(temperature_rate=rate_at(poses_g.columns))
    if 'previous' not in poses_g:
        poses_g = poses_g.with_columns(previous=_find_way(poses_g, model))
    return replace(poses_g, columns=add_turns(poses_g.columns))


def add_acting(known: Context, model: Model) -> Context:
    """Return a context with rate and lag of the temperature, from its rows as history."""
    wanted = [key for key in model.over if key in FROM_TEMPERATURE and key not in known]
    if not wanted or 'time' not in known or 'temperature' not in known:
        return known
    known = {**known, 'temperature_rate': rate_at(known)}
    return {**known, **{key: acting_temperature(known, key, *lag)
                        for key, lag in model.lags.items()}}


def thermal_stream(model: Model) -> ThermalStream | None:
    """Return the lag and rate of the temperature that a model needs; None if it needs none."""
    rate = 'temperature_rate' in model.over
    return ThermalStream(model.lags, rate=rate) if model.lags or rate else None


def context_of_samples(known: Context, count: int, model: Model,
                       stream: ThermalStream | None = None) -> Context:
    """
    Return the context of single samples that a model needs, ``count`` rows each.

    A single sample does not show the vibration or the previous pose; both are zero, and so is a
    rate that is NaN. A quantity that is not recorded has the value of no change. Lag and rate of
    the temperature come from earlier samples, unless they are known already. A `stream` has the
    temperature before these samples; they are added to it.

    """
    none = np.zeros((count, 3))
    found = {**{key: np.full(count, value) for key, value in model.neutral.items()}, **known,
             'std': none, 'previous': none,
             'rate': np.nan_to_num(known['rate']) if 'rate' in known else none}
    lacking = not all(key in known for key in model.over if key in FROM_TEMPERATURE)
    stream = thermal_stream(model) if stream is None and lacking else stream
    if stream is not None and 'time' in known and 'temperature' in known:
        found.update(stream.add_all(known['time'], known['temperature']))
    return found


# ----------------------------------------------------------------------------- a stream

_APART = 2.0
"""Shortest time between two temperatures of the history [s]."""

_POINTS = 3600
"""Largest number of temperatures of the history: two hours, many times a common lag."""


@dataclass(frozen=True, eq=False)
class TemperatureHistory:
    """
    Temperatures of the last hours, and the columns that a model needs from them.

    A calibration that changes while the node runs thus starts with the lag that the sensor has.

    Parameters
    ----------
    points : deque of (float, float)
        Times and temperatures.
    followed : dict
        By what a model needs: its stream, and the columns at the points. Models that are asked for
        are followed.

    """

    points: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_POINTS))
    followed: dict[object, tuple[ThermalStream, deque[tuple[float, Any]]]] = field(
        default_factory=dict)

    def add(self, time: Floats, temperature: Floats) -> None:
        """
        Add samples; a temperature that is NaN is ignored.

        The points do not depend on how the samples are divided into calls: of a recording that is
        played fast, a call may have the samples of many seconds.

        """
        known = np.isfinite(time + temperature)
        if not np.any(known):
            return
        time, temperature = time[known], temperature[known]
        if self.points and time[-1] < self.points[-1][0]:  # the stream starts again
            self.points.clear()
            for _, columns in self.followed.values():
                columns.clear()
        back = np.flatnonzero(np.diff(time) < -_APART)
        begin = int(back[-1]) + 1 if len(back) else 0
        while begin < len(time):
            due = self.points[-1][0] + _APART if self.points else -np.inf
            later = np.flatnonzero(time[begin:] >= due)
            end = begin + int(later[0]) + 1 if len(later) else len(time)
            now = float(time[end - 1])
            if len(later):
                self.points.append((now, float(temperature[end - 1])))
            for stream, columns in self.followed.values():
                stream.add_all(time[begin:end], temperature[begin:end])
                columns.extend([(now, stream.value)] if len(later) else [])
            begin = end

    def columns_of(self, model: Model) -> Mapping[str, float]:
        """Return the present columns of a model."""
        stream, _ = self._follow(model)
        return {} if stream is None else stream.value

    def stream(self, model: Model) -> ThermalStream | None:
        """Return the lag and rate for a model after this history; None if it needs none."""
        return deepcopy(self._follow(model)[0])

    def during(self, model: Model, start: float, end: float) -> Context:
        """Return the mean columns that a model needs between two times; empty if not known."""
        _, columns = self._follow(model)
        inside = [each for time, each in columns if start - _APART <= time <= end]
        return {key: np.array([np.mean([each[key] for each in inside])])
                for key in (inside[0] if inside else ())}

    def _follow(self, model: Model) -> tuple[ThermalStream | None, Iterable[tuple[float, Any]]]:
        """Return the stream of a model, which is followed from now on, and its columns."""
        key, stream = (tuple(model.lags.items()), 'temperature_rate' in model.over), (
            thermal_stream(model))
        if stream is None:
            return None, ()
        if key not in self.followed:
            columns = deque[tuple[float, Any]](maxlen=_POINTS)
            for time, temperature in self.points:
                stream.add(time, temperature)
                columns.append((time, stream.value))
            self.followed[key] = stream, columns
        return self.followed[key]
