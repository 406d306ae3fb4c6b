# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Sensors, directions and poses, for benchmarks that draw them, and the error of a fit."""

from accel_calib.effects import Model, model_with
from accel_calib.geometry import unit
from accel_calib.statistics import rms
from accel_calib.table import Floats, numbered, Poses
from accel_calib.units import MG
import numpy as np


def random_directions(count: int, rng: np.random.Generator) -> Floats:
    """Return (count, 3) unit vectors, uniformly distributed over the sphere."""
    return unit(rng.normal(size=(count, 3)))


def held(directions: Floats, degrees: float, rng: np.random.Generator) -> Floats:
    """Turn each of (n, 3) directions by some degrees in each of two axes."""
    off = rng.normal(size=directions.shape) * np.radians(degrees)
    return unit(directions + off - directions * np.sum(off * directions, axis=1, keepdims=True))


def sensor(rng: np.random.Generator) -> Model:
    """Draw a sensor with offset, gains and cross-axis gains."""
    sizes = {'offset': 0.03, 'axis_gain': 0.02, 'cross_axis': 0.01}
    return model_with({name: rng.normal(size=3) * size for name, size in sizes.items()})


def joined(poses: Poses, more: Poses) -> Poses:
    """Return poses followed by others."""
    columns = {key: np.concatenate([poses[key], more[key]]) for key in poses.columns}
    return Poses(columns, numbered(columns))


def length_error_mg(force: Floats) -> float:
    """Return the RMS error of |force| [mg]."""
    return rms(np.linalg.norm(force, axis=1) - 1.0) * MG
