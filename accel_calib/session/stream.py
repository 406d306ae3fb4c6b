# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What a session keeps of the stream: statistics, the newest reading, and recent temperatures.

**Statistics.** Rates and ages use the arrival times by a steady clock, so that they are also right
for a bag that is played at another speed. They cover the last `_SPAN` seconds.

**Temperatures.** A calibration can change while the node runs. The history then lets the new
calibration start with the lag that the sensor has, and not in equilibrium.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from itertools import islice
import math
from typing import NamedTuple

import numpy as np

from .live_capture import LONG_REST
from ..calibrate import Calibration, thermal_stream
from ..effects import Context, Model, ThermalStream
from ..errors import InputError
from ..messages.one_reading import Known, OneReading, Triple
from ..table import Floats
from ..units import Units

_SPAN = 5.0
"""Time over which rate and faults are counted [s]."""

SILENT = 2.0
"""Time without messages after which the stream counts as silent [s]."""

_FEWEST = 5
"""Smallest number of messages for a statement about stamps."""

_FEW = 0.5
"""Share of repeated stamps above which the stamps count as constant."""


class _Batch(NamedTuple):
    """Messages that were added together: counts, and arrival of the last one [s]."""

    arrived: float
    messages: int
    zero: int
    repeated: int
    backward: int


class StreamStatistics:
    """
    Statistics of a stream of messages.

    Parameters
    ----------
    clock : callable
        Steady clock [s].

    Attributes
    ----------
    messages : int
        Number of messages.
    not_finite, foreign, implausible : int
        Numbers of dropped messages: readings that are not finite, messages of another sensor, and
        corrected messages that are not plausible.
    stamp : float
        Stamp of the last message [s].
    arrived : float
        Time of its arrival, by the steady clock [s].
    temperature : float
        Last temperature [°C]; NaN: none.
    reading : (3,) array or None
        Mean reading of the last batch.
    newest : (3,) array or None
        The last reading.
    spread : float
        Largest standard deviation over the axes of the last batch [unit of the reading].

    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.messages = self.not_finite = self.foreign = self.implausible = 0
        self.stamp = self.temperature = self.spread = math.nan
        self.arrived = self._advanced = self._dropped_at = -math.inf
        self.reading: Floats | None = None
        self.newest: Floats | None = None
        self._batches: deque[_Batch] = deque()

    def add(self, rows: Floats, arrived: float) -> None:
        """Count messages; parameters as in `Session.push`."""
        stamps = rows[:, 0]
        steps = np.diff(stamps, prepend=self.stamp)  # the first step of a stream is NaN
        self._batches.append(_Batch(
            arrived, len(rows), int(np.sum(stamps == 0.0)), int(np.sum(steps == 0.0)),
            int(np.sum(steps < 0.0))))
        while self._batches[0].arrived < arrived - _SPAN:
            self._batches.popleft()
        self.messages += len(rows)
        if np.any(steps):  # NaN, too
            self._advanced = arrived
        self.stamp, self.arrived = float(stamps[-1]), arrived
        self.reading, self.newest = rows[:, 1:4].mean(axis=0), rows[-1, 1:4]
        self.spread = float(np.max(rows[:, 1:4].std(axis=0)))

    def drop(self, name: str, count: int = 1) -> None:
        """Count dropped messages; `name` is ``not_finite``, ``foreign`` or ``implausible``."""
        setattr(self, name, getattr(self, name) + count)
        if name != 'implausible':  # its raw message is already counted
            self.messages += count
        self._dropped_at = self._clock()

    @property
    def dropped_ago(self) -> float:
        """Time since the last dropped message [s]; infinite if there was none."""
        return self._clock() - self._dropped_at

    @property
    def age(self) -> float:
        """Time since the last message [s]; infinite if there was none."""
        return self._clock() - self.arrived

    @property
    def stopped(self) -> float:
        """Time for which messages have arrived with one and the same stamp [s]."""
        return self.arrived - self._advanced

    @property
    def rate(self) -> float:
        """Messages per second over the last seconds; 0 if the stream is silent."""
        if self.age > SILENT or len(self._batches) < 2:
            return 0.0
        span = self._batches[-1].arrived - self._batches[0].arrived
        count = sum(batch.messages for batch in self._batches) - self._batches[0].messages
        return count / span if span > 0.0 else 0.0

    @property
    def context(self) -> dict[str, float]:
        """Present time [s] and temperature [°C], if known."""
        known = {'time': self.stamp, 'temperature': self.temperature}
        return {key: value for key, value in known.items() if math.isfinite(value)}

    def length_g(self, units: Units) -> float:
        """Return |a| of the last messages [g]; NaN if not known."""
        if self.reading is None or units.is_native:
            return math.nan
        return float(np.linalg.norm(self.reading)) / units.per_g

    @property
    def stamp_fault(self) -> str:
        """Return what is wrong with the stamps of the last seconds, and what to do, or ''."""
        if self.age > SILENT:
            return ''
        _, messages, zero, repeated, backward = (
            sum(column) for column in zip(*self._batches, strict=True))
        if messages < _FEWEST:
            return ''
        if zero > _FEW * messages:
            return ('the stamps are zero, expected the time of each reading: set header.stamp in '
                    'the driver')
        if repeated > _FEW * messages:
            return (f'the stamps are constant ({self.stamp:.3f} s), expected the time of each '
                    'reading: set header.stamp in the driver')
        if backward > 1:
            return (f'the stamps are out of order in {backward:.0f} of the last {messages:.0f} '
                    'messages, expected increasing stamps: check that only one driver publishes')
        return ''


_NONE: Triple = (0.0, 0.0, 0.0)


class Newest(NamedTuple):
    """A reading: direction (empty if not known), |a| and corrected |a| [g] (NaN: not known)."""

    up: tuple[float, ...] = ()
    length: float = math.nan
    corrected: float = math.nan


class NewestReading:
    """
    Describe single readings, with the prepared correction.

    Parameters
    ----------
    units : Units
        Unit of the readings.

    """

    def __init__(self, units: Units) -> None:
        self._units = units
        self._prepared: tuple[Calibration, OneReading] | None = None

    def described(self, reading: Triple, calibration: Calibration | None, known: Known,
                  zero: tuple[float, ...] = ()) -> Newest:
        """
        Return direction and length of a reading.

        Native readings have a direction only if their zero is known: from a calibration, or about
        from the poses so far.

        Parameters
        ----------
        reading : (float, float, float)
            The reading, in the unit of the sensor.
        calibration : Calibration or None
            The calibration that corrects it.
        known : mapping
            Present context: time, and temperature with its lags if it is known.
        zero : tuple of float, optional
            Approximate zero of native readings before a calibration; empty if it is not known.

        """
        force = None if calibration is None else self._force(calibration, reading, known)
        corrected = math.nan if force is None else math.hypot(*force)
        if not self._units.is_native:
            length = math.hypot(*reading)
            return Newest(_unit(reading, length), length / self._units.per_g, corrected)
        if calibration is None or force is None:
            parts = tuple(part - at for part, at in zip(reading, zero, strict=False))
            return Newest(_unit(parts, math.hypot(*parts)))
        turned = (calibration.rotation @ force).tolist()
        return Newest(_unit(turned, corrected), corrected=corrected)

    def _force(self, calibration: Calibration, reading: Triple, known: Known) -> Triple | None:
        """Return the corrected force [g]; None if the effects cannot be corrected now."""
        if self._prepared is None or self._prepared[0] is not calibration:
            self._prepared = (calibration, OneReading(calibration, 1.0 / calibration.force_per_g))
        context = {'std': _NONE, 'previous': _NONE, 'rate': _NONE, **known}
        try:
            return self._prepared[1].at(context).correct(*reading)
        except InputError:
            return None  # a quantity is not known yet, or the reading is out of range


def _unit(vector: tuple[float, ...] | list[float], length: float) -> tuple[float, ...]:
    return tuple(part / length for part in vector) if 0.0 < length < math.inf else ()


_APART = 2.0
"""Shortest time between two temperatures of the history [s]."""

_POINTS = 3600
"""Largest number of temperatures of the history: two hours, many times a common lag."""

_RECENT = int(2.0 * LONG_REST / _APART)
"""Number of recent points whose columns are kept; they cover the longest rest."""


class TemperatureHistory:
    """Temperatures of the last hours, and the columns that a model needs from them."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, float]] = deque(maxlen=_POINTS)
        self._columns: deque[tuple[float, dict[str, float]]] = deque(maxlen=_RECENT)
        self._stream: ThermalStream | None = None
        self._followed = Model({})

    def follow(self, model: Model) -> None:
        """Compute the columns of this model from now on, and for the history."""
        same, self._followed = _key(model) == _key(self._followed), model
        if same:
            return
        self._columns.clear()
        self._stream = thermal_stream(model)
        if self._stream is not None:
            self._columns.extend(_replayed(self._stream, self._points))

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
        if self._points and time[-1] < self._points[-1][0]:  # the stream starts again
            self._points.clear()
            self._columns.clear()
        back = np.flatnonzero(np.diff(time) < -_APART)
        begin = int(back[-1]) + 1 if len(back) else 0
        while begin < len(time):
            due = self._points[-1][0] + _APART if self._points else -np.inf
            later = np.flatnonzero(time[begin:] >= due)
            end = begin + int(later[0]) + 1 if len(later) else len(time)
            if self._stream is not None:
                self._stream.add_all(time[begin:end], temperature[begin:end])
            if len(later):
                now = float(time[end - 1])
                self._points.append((now, float(temperature[end - 1])))
                if self._stream is not None:
                    self._columns.append((now, self._stream.value))
            begin = end

    @property
    def columns(self) -> Mapping[str, float]:
        """Return the present columns of the followed model; empty if it needs none."""
        return {} if self._stream is None else self._stream.value

    def columns_of(self, model: Model) -> Mapping[str, float]:
        """Return the present columns of any model; those of another one are computed anew."""
        if _key(model) == _key(self._followed):
            return self.columns
        stream = self.stream(model)
        return {} if stream is None else stream.value

    def stream(self, model: Model) -> ThermalStream | None:
        """Return the lag and rate for a model after this history; None if it needs none."""
        stream = thermal_stream(model)
        if stream is not None:
            _replayed(stream, self._points)
        return stream

    def during(self, model: Model, start: float, end: float) -> Context:
        """Return the mean columns that a model needs between two times; empty if not known."""
        columns = self._columns
        if model is not self._followed and _key(model) != _key(self._followed):
            stream = thermal_stream(model)
            columns = deque() if stream is None else _replayed(stream, self._points)
        inside = [each for time, each in columns if start - _APART <= time <= end]
        if not inside:
            return {}
        return {key: np.array([np.mean([each[key] for each in inside])]) for key in inside[0]}


def _key(model: Model) -> tuple[object, ...]:
    return dict(model.lags), 'temperature_rate' in model.over


def _replayed(stream: ThermalStream, points: deque[tuple[float, float]]
              ) -> deque[tuple[float, dict[str, float]]]:
    """Add a history to a stream, and return the columns at its last points."""
    old = max(len(points) - _RECENT, 0)
    if old:
        stream.add_all(*np.array(list(islice(points, old))).T)
    columns: deque[tuple[float, dict[str, float]]] = deque()
    for time, temperature in islice(points, old, None):
        stream.add(time, temperature)
        columns.append((time, stream.value))
    return columns
