# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The context of readings that is computed from other columns, or limited to that of the poses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..effects import acting_temperature, Context, Model, rate_at, ThermalStream
from ..table import Floats

THERMAL = ('temperature_rate', 'temperature_of_offset', 'temperature_of_gain')
"""Context that is computed from time and temperature."""

HELD = ('time', 'temperature', *THERMAL, 'supply_voltage')
"""Context that is limited to the range of the poses; effects are not extrapolated."""


def of_samples(known: Context, count: int, model: Model,
               stream: ThermalStream | None = None) -> Context:
    """
    Return the context of single samples.

    A single sample does not show the vibration or the previous pose. Both are set to zero, and so
    is a rate that is NaN. Lag and rate of the temperature come from earlier samples, unless they
    are known already.

    Parameters
    ----------
    known : mapping of str to array
        Known context of the samples.
    count : int
        Number of samples.
    model : Model
        Model that the context is for.
    stream : ThermalStream, optional
        Temperature before these samples; these samples are added.

    Returns
    -------
    mapping of str to array
        The columns that the model needs, ``count`` rows each.

    """
    none = np.zeros((count, 3))
    found = {**known, 'std': none, 'previous': none,
             'rate': np.nan_to_num(known['rate']) if 'rate' in known else none}
    lacking = not all(key in known for key in model.over if key in THERMAL)
    stream = thermal_stream(model) if stream is None and lacking else stream
    if stream is not None and 'time' in known and 'temperature' in known:
        found.update(stream.add_all(known['time'], known['temperature']))
    return found


def thermal_stream(model: Model) -> ThermalStream | None:
    """Return the lag and rate of the temperature that a model needs; None if it needs none."""
    rate = 'temperature_rate' in model.over
    return ThermalStream(model.lags, rate=rate) if model.lags or rate else None


def with_acting(model: Model, known: Context) -> Context:
    """Return a context with rate and lag of the temperature, from its rows as history."""
    wanted = [key for key in model.over if key in THERMAL and key not in known]
    if not wanted or 'time' not in known or 'temperature' not in known:
        return known
    known = {**known, 'temperature_rate': rate_at(known)}
    return {**known, **{key: acting_temperature(known, key, *lag)
                        for key, lag in model.lags.items()}}


def limited(context: Context, ranges: Mapping[str, tuple[float, float]]) -> dict[str, Floats]:
    """Return the columns that have a range, limited to it."""
    return {key: np.clip(context[key], *limits) for key, limits in ranges.items()
            if key in context}
