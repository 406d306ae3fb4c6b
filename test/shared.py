# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Helpers of several tests: the folder of real recordings, and a simulated sensor."""

from pathlib import Path

from inside import Model, model_with
import numpy as np
import pytest

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'


def data(name: str) -> Path:
    """Return the path of a real recording, or skip the test if it is missing."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f'{path} is not here')
    return path


def sensor(rng: np.random.Generator, *effects: str) -> Model:
    """Return a random sensor with these effects; by default offset, gains and cross-axis."""
    sizes = {'offset': 0.05, 'gain': 0.02, 'axis_gain': 0.02, 'cross_axis': 0.01,
             'misalignment': 0.01}
    names = effects or ('offset', 'axis_gain', 'cross_axis')
    widths = {'gain': 1}
    return model_with({name: rng.normal(size=widths.get(name, 3)) * sizes[name]
                       for name in names})
