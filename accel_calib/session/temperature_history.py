# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Recent temperatures of the stream, for calibrations with a lag or a rate of the temperature.

A calibration can change while the node runs. The history then lets the new calibration start with
the lag that the sensor has, and not in equilibrium.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from itertools import islice

import numpy as np

from .live_capture import LONG_REST
from ..calibrate import thermal_stream
from ..effects import Context, Model, ThermalStream
from ..table import Floats

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
