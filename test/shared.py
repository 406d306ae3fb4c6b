# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What several tests share: the folder of real recordings, and a sensor to recover."""

from pathlib import Path

from accel_calib.model import Model
from accel_calib.simulate import model_with
import numpy as np
import pytest

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'


def data(name: str) -> Path:
    """Give a real recording, or skip the test where it is missing."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f'{path} is not here')
    return path


def sensor(rng: np.random.Generator, *effects: str) -> Model:
    """Draw a sensor with common errors; offset, gains and cross-axis unless said."""
    sizes = {'offset': 0.05, 'gain': 0.02, 'axis_gain': 0.02, 'cross_axis': 0.01,
             'misalignment': 0.01}
    names = effects or ('offset', 'axis_gain', 'cross_axis')
    widths = {'gain': 1}
    return model_with({name: rng.normal(size=widths.get(name, 3)) * sizes[name]
                       for name in names})
