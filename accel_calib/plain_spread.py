# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The uncertainty of the correction of one reading at a time, beside `accel_calib.plain`.

What `Calibration.force_covariance` is for many forces; a test holds the two together.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from operator import add

import numpy as np

from .calibrate import Calibration
from .effects import EFFECTS
from .model import Model, parameter_basis
from .plain import arrays_of, linear, others_of
from .plain_effects import PlainContext, PlainEffect, Triple
from .table import Floats

Spread = Callable[[Triple, PlainContext, Sequence[float]], Sequence[float]]
"""Specific force, context, the nine numbers of a covariance -> these with that of it added."""


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
        Takes a corrected force, its context and a symmetric covariance, row by row; gives that and
        what the calibration leaves uncertain.

    """
    others = others_of(calibration.model)
    unit = calibration.force_per_g * scale
    if others is None:
        return _spread_through_arrays(calibration, scale)
    return (_bent_spread(calibration.model, calibration.covariance, unit) if others
            else _linear_spread(calibration.model, calibration.covariance, unit))


def _spread_through_arrays(calibration: Calibration, scale: float) -> Spread:
    def spread(force: Triple, context: PlainContext, own: Sequence[float]) -> Sequence[float]:
        found = calibration.force_covariance(np.array([force]) / scale, arrays_of(context))
        return [float(each) for each in (found * scale**2).ravel() + own]

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
    ((a0, a1, a2, a3, a4, a5, a6, a7, a8, a9), (b0, b1, b2, b3, b4, b5, b6, b7, b8, b9),
     (c0, c1, c2, c3, c4, c5, c6, c7, c8, c9), (d0, d1, d2, d3, d4, d5, d6, d7, d8, d9),
     (e0, e1, e2, e3, e4, e5, e6, e7, e8, e9), (f0, f1, f2, f3, f4, f5, f6, f7, f8, f9)) = six

    def spread(force: Triple, context: PlainContext, own: Sequence[float]) -> Sequence[float]:
        x, y, z = force
        xx, xy, xz, _, yy, yz, _, _, zz = own
        # Written out: a loop over the six takes twice the time.
        xx += a0 + x * (a1 + a4 * x + a5 * y + a6 * z) + y * (a2 + a7 * y + a8 * z) + z * (
            a3 + a9 * z)
        xy += b0 + x * (b1 + b4 * x + b5 * y + b6 * z) + y * (b2 + b7 * y + b8 * z) + z * (
            b3 + b9 * z)
        xz += c0 + x * (c1 + c4 * x + c5 * y + c6 * z) + y * (c2 + c7 * y + c8 * z) + z * (
            c3 + c9 * z)
        yy += d0 + x * (d1 + d4 * x + d5 * y + d6 * z) + y * (d2 + d7 * y + d8 * z) + z * (
            d3 + d9 * z)
        yz += e0 + x * (e1 + e4 * x + e5 * y + e6 * z) + y * (e2 + e7 * y + e8 * z) + z * (
            e3 + e9 * z)
        zz += f0 + x * (f1 + f4 * x + f5 * y + f6 * z) + y * (f2 + f7 * y + f8 * z) + z * (
            f3 + f9 * z)
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

    def spread(force: Triple, context: PlainContext, own: Sequence[float]) -> Sequence[float]:
        u = into(*force, context)
        rows = zip(*(each.basis(u, context) for each in others))
        known = [1.0, *force, *chain.from_iterable(chain.from_iterable(rows))]
        moved = turn @ _inverse(_slope(mat_w, others, u, context)) @ (
            np.dot(known, table).reshape(3, -1))
        return [*map(add, own, (moved @ moved.T).ravel().tolist())]

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
