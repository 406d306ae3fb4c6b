# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The context of readings: computed from other columns, and limited to the range of the poses.

The order of the poses determines the previous pose of each, for `hysteresis`, and the rate of the
temperature, for `temperature_rate` and lags. The effects of a calibration are not extrapolated:
beyond the range of the poses, the correction uses the limit of the range (`Calibration.ranges`),
and `Outside` says how far beyond it was. A curve over the vibration has a range, too. A single
sample does not show its vibration, so that the correction uses the lower limit.

"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..effects import (
    acting_temperature, Context, EMPIRICAL, empirical_parts, Model, rate_at, ThermalStream,
    variable_of)
from ..geometry import unit
from ..table import column_of, Floats, Poses
from ..text import counted
from ..units import MG

if TYPE_CHECKING:
    from .calibration import Calibration

THERMAL = ('temperature_rate', 'temperature_of_offset', 'temperature_of_gain')
"""Context that is computed from time and temperature."""

HELD = ('time', 'temperature', *THERMAL, 'supply_voltage')
"""Context that is limited to the range of the poses, as quantities are; effects are not
extrapolated."""


def of_samples(known: Context, count: int, model: Model,
               stream: ThermalStream | None = None) -> Context:
    """
    Return the context of single samples that a model needs, ``count`` rows each.

    A single sample does not show the vibration or the previous pose. Both are set to zero, and so
    is a rate that is NaN. A quantity that is not recorded has the value of no change, which
    `SampleContext` notes. Lag and rate of the temperature come from earlier samples, unless they
    are known already. A `stream` has the temperature before these samples; they are added to it.

    """
    none = np.zeros((count, 3))
    found = {**{key: np.full(count, value) for key, value in model.neutral.items()}, **known,
             'std': none, 'previous': none,
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


_MOVED = np.radians(3.0)
"""Smallest change of direction of a move [rad]; less may be noise or settling."""


def with_history(poses_g: Poses, model: Model) -> Poses:
    """
    Return poses in g with the context that comes from the poses before and after.

    That is ``previous``, the unit vector towards the previous pose in order of time, or of rows,
    and ``temperature_rate``. If successive poses have the same orientation, the last motion counts
    for all of them; before the first motion, ``previous`` is zero. Columns that the table has
    already are kept. Gain and offset of the model are used to compute the directions.

    """
    if 'time' in poses_g and 'temperature' in poses_g and 'temperature_rate' not in poses_g:
        poses_g = poses_g.with_columns(temperature_rate=rate_at(poses_g.columns))
    if 'previous' in poses_g:
        return poses_g
    mat_w, vec_v = model.linear_part
    return with_previous(poses_g, unit((poses_g.reading - vec_v) @ np.linalg.inv(mat_w).T))


def with_previous(poses_g: Poses, force: Floats) -> Poses:
    """Return poses with the unit vector towards the previous pose, given (n, 3) unit forces."""
    order = (np.argsort(poses_g['time'], kind='stable') if 'time' in poses_g
             else np.arange(len(poses_g)))
    previous = np.zeros_like(force)
    towards, resting = np.zeros(3), order[0] if len(order) else 0
    for here in order:
        step = force[resting] - force[here]
        length = float(np.linalg.norm(step))
        if length > _MOVED:
            towards, resting = step / length, here
        previous[here] = towards
    return poses_g.with_columns(previous=previous)


def limited(context: Context, ranges: Mapping[str, tuple[float, float]]) -> dict[str, Floats]:
    """Return the columns that have a range, limited to it."""
    return {key: np.clip(context[key], *limits) for key, limits in ranges.items()
            if key in context}


USES_LIMIT = 'the correction uses the limit of the range'

_QUANTITIES: dict[str, tuple[str, str, float]] = {
    'time': ('time since the start of the calibration', 'h', 1.0 / 3600.0),
    'temperature_rate': ('rate of temperature', '°C/min', 60.0),
    'std': ('vibration', 'mg', MG)}
"""Name, unit and factor of the quantities that are not shown as in `accel_calib.table`."""


@dataclass(frozen=True)
class Outside:
    """
    A column of the context, compared with the range of a calibration.

    `count` of all `samples` are outside of the range `low` to `high` of the poses. All samples
    range from `least` to `most`.

    """

    key: str
    count: int
    samples: int
    low: float
    high: float
    least: float
    most: float

    @property
    def name(self) -> str:
        """Return the quantity in words."""
        return _QUANTITIES[self.key][0] if self.key in _QUANTITIES else (
            self.key.replace('_', ' '))

    def range_words(self, low: float, high: float) -> str:
        """Return a range, or one value, with its unit; times count from the first pose."""
        _, unit, factor = _QUANTITIES.get(self.key, ('', column_of(self.key).unit, 1.0))
        start = self.low if self.key == 'time' else 0.0
        first, last = (f'{(value - start) * factor:.4g}' for value in (low, high))
        return f'{first if first == last else f"{first} to {last}"} {unit}'.rstrip()

    @property
    def words(self) -> str:
        """Return what was found and what the range of the calibration is."""
        return (f'{self.name} is {self.range_words(self.least, self.most)}, but the range of the '
                f'calibration is {self.range_words(self.low, self.high)}')

    @property
    def line(self) -> str:
        """Return a line about a recording."""
        return (f'{self.count} of {counted(self.samples, "sample")} are outside of the range of '
                f'the calibration: {self.words}; {USES_LIMIT}')


def outside(calibration: Calibration, known: Context) -> dict[str, Outside]:
    """Return the comparison of each column that has a range; ``count`` is 0 if all are inside."""
    found = {}
    for key, (low, high) in {**calibration.ranges, **_vibration_range(calibration)}.items():
        values = _size(known[key]) if key in known else np.zeros(0)
        values = values[np.isfinite(values)]
        if len(values):
            count = int(np.sum((values < low) | (values > high)))
            found[key] = Outside(key, count, len(values), low, high, float(np.min(values)),
                                 float(np.max(values)))
    return found


def _size(values: Floats) -> Floats:
    """Return the values of a quantity; for vectors, the RMS over the axes."""
    return np.sqrt(np.mean(values ** 2, axis=1)) if values.ndim > 1 else values


def _vibration_range(calibration: Calibration) -> dict[str, tuple[float, float]]:
    """Return the range of the empirical curves over the vibration, if there are any."""
    ends = [values[-2:] for name, values in calibration.model.values.items()
            if name.startswith(f'{EMPIRICAL}-') and empirical_parts(name)[1] == 'std']
    if not ends:
        return {}
    return {'std': (float(np.max([low for low, _ in ends])),
                    float(np.min([high for _, high in ends])))}


class SampleContext:
    """The context of the samples of a log, block by block, and what leaves its ranges."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._thermal = thermal_stream(calibration.model)
        self._compared: dict[str, Outside] = {}
        self.lacking = ''

    def of(self, known: Context, count: int) -> Context:
        """Return the context of the next block as `of_samples` does."""
        context = of_samples(known, count, self._calibration.model, self._thermal)
        self.lacking = _lacking(self._calibration.model, known)
        for key, block in outside(self._calibration, context).items():
            before = self._compared.get(key)
            self._compared[key] = block if before is None else replace(
                block, count=before.count + block.count, samples=before.samples + block.samples,
                least=min(before.least, block.least), most=max(before.most, block.most))
        return context

    @property
    def left(self) -> list[Outside]:
        """Return the quantities that have left the range of the calibration so far."""
        return [each for each in self._compared.values() if each.count]


def _lacking(model: Model, known: Iterable[str]) -> str:
    """Return a line about the quantities that samples do not have; empty if they have all."""
    lacking = [key for key in model.neutral if key not in known]
    names = [name for name in model.effects if variable_of(name) in lacking]
    return (f'the samples have no {" and ".join(lacking)}: {" and ".join(names)} '
            f'{"is" if len(names) == 1 else "are"} not corrected') if lacking else ''
