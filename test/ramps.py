# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Simulated logs of a still board whose temperature changes."""

from collections.abc import Sequence
from pathlib import Path

from accel_calib.geometry import unit
from accel_calib.table import Floats, numbered, Recording
from data.logs import make
import numpy as np
from scipy.signal import lfilter

G = make.G
UP = unit(np.array([[0.02, -0.05, 0.998]]))[0]
LINE = ((5e-4, -4e-4, 3e-4),)
BENT = (*LINE, (6e-6, 0.0, -4e-6))
TWISTED = (*BENT, (1.5e-7, -1e-7, 1e-7))
"""Coefficients of T - 25 °C by power and axis [g/°C^k]."""

Curve = Sequence[Sequence[float]]


def offset_at(temperature: Floats, curve: Curve) -> Floats:
    """Return the (n, 3) change of the offset since 25 °C [g]."""
    away = temperature - 25.0
    return np.array(sum((np.outer(away ** (k + 1), each) for k, each in enumerate(curve)),
                        np.zeros((len(away), 3))))


def warming(count: int, low: float, high: float, *, cool: bool = False) -> Floats:
    """Return temperatures that approach the high one, and then the low one again if asked."""
    if not cool:
        return high - (high - low) * np.exp(-np.linspace(0.0, 3.5, count))
    rise = warming(count // 2, low, high)
    return np.concatenate([rise, low + high - warming(count - count // 2, low, high)])


def ramp(seed: int, curve: Curve = BENT, *, minutes: float = 40.0, rate_hz: float = 5.0,
         low: float = -10.0, high: float = 35.0, noise_g: float = 0.003, wander_g: float = 0.0,
         lag_s: float = 0.0, cool: bool = False, up: Floats = UP) -> Recording:
    """
    Return a ramp of the sensor of the samples of logs [m/s²].

    `wander_g` is that of a random walk at the end, and `lag_s` that of the thermometer, whose
    step is 0.05 °C.

    """
    rng, count = np.random.default_rng(seed), int(minutes * 60.0 * rate_hz)
    warm = warming(count, low, high, cool=cool)
    reading = make.GAIN @ up + make.OFFSET_G + offset_at(warm, curve)
    reading = reading + noise_g * rng.normal(size=(count, 3))
    reading += np.cumsum(rng.normal(size=(count, 3)), axis=0) * wander_g / np.sqrt(count)
    if lag_s:
        kept = np.exp(-1.0 / rate_hz / lag_s)
        warm = warm[0] + lfilter([1.0 - kept], [1.0, -kept], warm - warm[0])
    columns = {'time': np.arange(count) / rate_hz, 'reading': reading * G,
               'temperature': np.round(warm / 0.05) * 0.05}
    return Recording(columns, numbered(columns), 'm/s2')


def twelve_poses(seed: int, curve: Curve = BENT) -> Recording:
    """Return a log of twelve poses of the same sensor, at 28 to 31 °C [m/s²]."""
    found = make.recording(seed)
    reading = (found.reading + offset_at(found['temperature'], curve)) * G
    columns = {**found.columns, 'reading': reading}
    return Recording({key: values for key, values in columns.items() if key != 'reference'},
                     found.row, 'm/s2')


def write_ulog(path: Path, samples: Recording, device: int = 1310988) -> None:
    """Write the samples as sensor_accel of PX4."""
    path.write_bytes(make.ulog_bytes([('sensor_accel', 0, make.accel_fields(samples, device))]))
