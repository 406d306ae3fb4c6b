# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulated poses and recordings, from a model that is stated in words or as values.

All readings are in g; `accel_calib.units` converts them. A direction is the direction of up in the
levelled frame, a unit vector of specific force. Simulated noise is seeded.

"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .catalogue import CHANGES, EFFECTS, entry_of, PROCESSES
from .form import Context, EffectKey, EffectRecord
from .history import add_turns, way_to
from .model import Model, predict
from .records import effect_named
from ..errors import InputError
from ..table import Floats, numbered, Poses, Recording
from ..units import Indices


def parse_effect(text: str, own: Sequence[EffectRecord] = ()) -> tuple[str, Floats]:
    """
    Return name and (p,) values from a text such as ``offset=0.01,-0.02,0.03``, as `model_with`.

    It may be one of own effects. Raise `InputError` if the text is not of this form.

    """
    name, equals, values = text.partition('=')
    if not equals:
        raise InputError(f'effect is {text!r}, expected NAME=VALUE,…',
                         f'use one of {", ".join(EFFECTS)}')
    try:
        numbers = np.array([float(part) for part in values.split(',')])
    except ValueError:
        numbers = np.array([np.nan])
    return name, _values_of(name, numbers, own, repr(values))[1]


def _values_of(name: EffectKey, given: ArrayLike, own: Sequence[EffectRecord], text: str = ''
               ) -> tuple[EffectKey, Floats]:
    """Return an effect and its values; one value is used for all axes, and the usual shape."""
    try:
        key = effect_named(name, own) if isinstance(name, str) else name
        if key in PROCESSES or key in CHANGES:
            raise KeyError(name)
    except KeyError:
        raise InputError(f'effect {name!r} is not in the catalogue',
                         f'use one of {", ".join(EFFECTS)}') from None
    effect = entry_of(key)
    values, names = np.atleast_1d(np.asarray(given, float)), effect.values
    least = len(effect.parameters) if effect.usual else len(names)
    counts = sorted({*range(least, len(names) + 1),
                     1 if least == len(effect.parameters) else least})
    if not np.all(np.isfinite(values)) or values.shape not in [(count,) for count in counts]:
        count = ' or '.join(map(str, counts))
        raise InputError(f'effect {name} has values {text or values.tolist()}, expected {count} '
                         f'{"number" if len(names) == 1 else "numbers"} ({", ".join(names)}) in '
                         f'{effect.unit}', f'write for example {name}='
                         f'{",".join(["0.001"] * least)}')
    if len(values) == 1:
        values = np.repeat(values, least)
    return key, np.array(effect.filled(values), float)


def model_with(effects: Mapping[Any, ArrayLike], rotation: Floats | None = None,
               own: Sequence[EffectRecord] = ()) -> Model:
    """
    Return the model with these effects and ΔR, in the order of the catalogue.

    The effects are keys or text forms, perhaps of own effects. The values are in the units of the
    catalogue; one value is used for all axes. Raise
    `InputError` for an effect that is not there, or has another number of finite values.

    """
    values = dict(_values_of(name, given, own) for name, given in effects.items())
    ordered = {key: values[key] for key in (*EFFECTS, *values) if key in values}
    return Model(ordered) if rotation is None else Model(ordered, rotation)


def simulate_poses(model: Model, directions: Floats, rng: np.random.Generator, *,
                   noise_g: float = 0.003, samples: int = 100,
                   context: Context | None = None) -> Poses:
    """
    Simulate averaged still poses, in g, with std, count and context.

    `directions` are (n, 3) specific forces [g], unit vectors at rest. `noise_g` is the standard
    deviation of a sample [g], and `samples` their independent number per pose.

    """
    known = {'std': np.full_like(directions, noise_g), **(context or {})}
    way = way_to((directions @ model.rotation.T)[np.newaxis], known)
    reading = predict(model, directions, add_turns({'previous': way, **known}))
    reading = reading + rng.normal(size=reading.shape) * noise_g / np.sqrt(samples)
    columns = {**known, 'reading': reading, 'count': np.full(len(directions), float(samples))}
    return Poses(columns, numbered(columns))


def turn_between(start: Floats, end: Floats, seconds: float, count: int
                 ) -> tuple[Floats, Floats]:
    """Return a turn along the shortest arc as `path` does, with `count` samples in `seconds`."""
    tau = (np.arange(count) + 1.0)[:, np.newaxis] / (count + 1.0)
    share = tau ** 3 * (10.0 - 15.0 * tau + 6.0 * tau ** 2)
    speed = 30.0 * tau ** 2 * (1.0 - tau) ** 2 / seconds
    normal = end - start * (start @ end)
    if np.linalg.norm(normal) < 1e-9:
        normal = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
    along = normal / np.linalg.norm(normal)
    arc = np.arctan2(np.linalg.norm(np.cross(start, end)), start @ end)
    force = np.cos(arc * share) * start + np.sin(arc * share) * along
    # In body axes, up turns opposite to the body: df/dt = -ω × f.
    change = arc * speed * (np.cos(arc * share) * along - np.sin(arc * share) * start)
    return force, np.cross(change, force)


def path(directions: Floats, rate_hz: float, dwell: float, turn: float
         ) -> tuple[Floats, Floats, Indices]:
    """
    Return force [g] and angular rate [rad/s] along a path, (m, 3) each, in the levelled frame.

    The sensor rests in each of the (n, 3) directions for `dwell` [s]. Each turn takes `turn` [s].
    The third result are the (m,) indices of the last direction.

    """
    resting, turning = max(1, round(dwell * rate_hz)), max(1, round(turn * rate_hz))
    parts = []
    for k, direction in enumerate(directions):
        if k:
            parts.append(turn_between(directions[k - 1], direction, turn, turning))
        parts.append((np.tile(direction, (resting, 1)), np.zeros((resting, 3))))
    forces, rates = zip(*parts)
    force = np.concatenate(forces)
    return force, np.concatenate(rates), np.arange(len(force)) // (resting + turning)


def simulate_recording(model: Model, directions: Floats, rng: np.random.Generator, *,
                       noise_g: float = 0.003, rate_hz: float = 100.0, dwell: float = 3.0,
                       turn: float = 1.0, gyro_noise: float = 0.002,
                       temperatures: Sequence[float] = ()) -> Recording:
    """
    Simulate a sensor that is turned through (n, 3) directions of up, as `path` does.

    The samples are in g, with angular rate and the true force as ``reference``. `noise_g` [g] and
    `gyro_noise` [rad/s] are standard deviations of a sample. The temperature changes linearly in
    time, from the first to the last of `temperatures` [°C].

    """
    force, rate, place = path(directions, rate_hz, dwell, turn)
    count = len(force)
    columns = {'time': np.arange(count) / rate_hz, 'reference': force}
    if temperatures:
        columns['temperature'] = np.linspace(temperatures[0], temperatures[-1], count)
    way = way_to((directions @ model.rotation.T)[np.newaxis], {})
    known = {'std': np.full((count, 3), noise_g), 'previous': way[place], **columns,
             'rate': rate @ model.rotation.T,
             'since_turn': columns['time'] - columns['time'][np.searchsorted(place, place)]}
    noise = rng.normal(size=(count, 3)) * noise_g
    columns['reading'] = predict(model, force, add_turns(known), noise)
    columns['rate'] = known['rate'] + rng.normal(size=(count, 3)) * gyro_noise
    return Recording(columns, numbered(columns))
