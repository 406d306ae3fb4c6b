# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The uncertainty of the correction of one reading at a time, beside `accel_calib.plain`.

What `Calibration.force_covariance` is for many forces; a test holds the two together.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import numpy as np

from .calibrate import Calibration
from .effects import EFFECTS
from .model import Model, parameter_basis
from .plain import arrays_of, linear, others_of
from .plain_effects import PlainContext, PlainEffect, Triple
from .table import Floats

Spread = Callable[[Triple, PlainContext], Sequence[float]]
"""Specific force, context -> the nine numbers of a covariance."""


def plain_spread(calibration: Calibration, scale: float = 1.0) -> Spread:
    """
    Make a function that does for one force what `Calibration.force_covariance` does for many.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    scale : float
        By which force is multiplied, here and in the covariance.

    Returns
    -------
    callable
        Takes a corrected force and its context; gives nine floats, row by row.

    """
    others = others_of(calibration.model)
    unit = calibration.force_per_g * scale
    if others is None:
        return _spread_through_arrays(calibration, scale)
    return (_bent_spread(calibration.model, calibration.covariance, unit) if others
            else _linear_spread(calibration.model, calibration.covariance, unit))


def _spread_through_arrays(calibration: Calibration, scale: float) -> Spread:
    def spread(force: Triple, context: PlainContext) -> Sequence[float]:
        found = calibration.force_covariance(np.array([force]) / scale, arrays_of(context))
        return [float(each) for each in (found * scale**2).ravel()]

    return spread


def _linear_basis(model: Model, unit: float) -> Floats:
    """
    Say how the basis of linear effects grows with a force in the levelled frame.

    Returns
    -------
    (4, 3, p) array
        What it is for no force, then for one unit of force along x, y, z beside that.

    """
    linear = Model({name: values for name, values in model.values.items()
                    if EFFECTS[name].linear})
    along = model.rotation.T / unit
    basis = parameter_basis(linear, np.vstack([np.zeros(3), along]), {})
    basis[1:] -= basis[0]
    return basis


def _linear_spread(model: Model, covariance: Floats, unit: float) -> Spread:
    """Make the function for a linear model: each covariance is a quadratic form of the force."""
    moved = np.einsum('ij,mjp->mip', unit * model.rotation.T @ np.linalg.inv(model.linear_part[0]),
                      _linear_basis(model, unit))
    form = np.einsum('mip,pq,njq->ijmn', moved, covariance, moved)
    form = form + np.swapaxes(form, 2, 3)
    form[:, :, range(4), range(4)] /= 2.0
    six = [form[i, j][np.triu_indices(4)].tolist()
           for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]

    def spread(force: Triple, context: PlainContext) -> Sequence[float]:
        x, y, z = force
        found = [a + x * (b + e * x + f * y + g * z) + y * (c + h * y + i * z) + z * (d + j * z)
                 for a, b, c, d, e, f, g, h, i, j in six]
        xx, xy, xz, yy, yz, zz = found
        return xx, xy, xz, xy, yy, yz, xz, yz, zz

    return spread


def _bent_spread(model: Model, covariance: Floats, unit: float) -> Spread:
    """
    Make the function for a model with other effects.

    With C = F Fᵀ the covariance is (A B F)(A B F)ᵀ, where A is ΔRᵀ over the slope and B the
    basis. B F is linear in the force and in what the other effects have in the basis.

    """
    names = [name for name, values in model.values.items() for _ in values]
    order = sorted(range(len(names)), key=lambda k: not EFFECTS[names[k]].linear)
    size, axes = np.linalg.eigh(covariance[np.ix_(order, order)])
    root = axes * np.sqrt(np.maximum(size, 0.0))
    growth = _linear_basis(model, unit)
    width = growth.shape[2]
    entries = np.einsum('ia,jp->ijap', np.eye(3), root[width:]).reshape(-1, 3, len(names))
    table = np.concatenate([growth @ root[:width], entries]).reshape(-1, 3 * len(names))
    others = others_of(model) or []
    into, turn = linear(model.rotation / unit, np.zeros(3)), model.rotation.T * unit
    mat_w = model.linear_part[0].tolist()

    def spread(force: Triple, context: PlainContext) -> Sequence[float]:
        u = into(*force, context)
        rows = zip(*(each.basis(u, context) for each in others))
        known = [1.0, *force, *chain.from_iterable(chain.from_iterable(rows))]
        moved = turn @ _inverse(_slope(mat_w, others, u, context)) @ (
            np.dot(known, table).reshape(3, -1))
        found: list[float] = (moved @ moved.T).ravel().tolist()
        return found

    return spread


def _slope(mat_w: Sequence[Sequence[float]], others: list[PlainEffect], u: Triple,
           context: PlainContext) -> Sequence[Sequence[float]]:
    """Give the derivative of the reading by force."""
    slope = mat_w
    for each in others:
        if each.slope is not None:
            slope = [[p + s, q + t, r + v]
                     for (p, q, r), (s, t, v) in zip(slope, each.slope(u, context))]
    return slope


def _inverse(matrix: Sequence[Sequence[float]]) -> Floats:
    """Give the inverse of a 3×3 matrix near the identity."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    size = a * p + b * q + c * r
    return np.array([[p / size, (c * h - b * i) / size, (b * f - c * e) / size],
                     [q / size, (a * i - c * g) / size, (c * d - a * f) / size],
                     [r / size, (b * g - a * h) / size, (a * e - b * d) / size]])
