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
The correction of one reading at a time, in plain floats.

A call of numpy costs about a microsecond whatever it does, and `Calibration.correct` makes dozens
of them: nothing for a recording, too much for a stream of single messages. Here what does not
change from reading to reading is worked out once, and some products and sums are left. Equation
and iteration are those of `accel_calib.model`, and a test holds the two together for every effect
of the catalogue. A model with an effect that `plain_effects` does not know goes through arrays.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import numpy as np

from .calibrate import Calibration
from .effects import EFFECTS
from .model import (
    CONVERGED_G,
    LARGEST_FORCE_G,
    LARGEST_ITERATIONS,
    Model,
    parameter_basis,
    too_large,
)
from .plain_effects import plain_effect, PlainContext, PlainEffect, Triple
from .table import Floats

Correct = Callable[[float, float, float, PlainContext], Triple]
"""Reading, context -> specific force in the levelled frame."""

Spread = Callable[[Triple, PlainContext], Sequence[float]]
"""Specific force, context -> the nine numbers of a covariance."""


def plain_correct(calibration: Calibration, scale: float = 1.0) -> Correct:
    """
    Make a function that does for one reading what `Calibration.correct` does for many.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    scale : float
        By which its corrected force is multiplied.

    Returns
    -------
    callable
        Takes a reading as three floats and a context, which must hold what the model needs; gives
        three floats. Raises InputError as `Calibration.correct`.

    """
    others = _others(calibration.model)
    if others is None:
        return _through_arrays(calibration, scale)
    mat_w, vec_v = calibration.model.linear_part
    from_reading = np.linalg.inv(mat_w) / calibration.units.per_g
    offset = -np.linalg.solve(mat_w, vec_v)
    turn = calibration.model.rotation.T * (calibration.force_per_g * scale)
    if not others:
        return linear(turn @ from_reading, turn @ offset)
    return _solving(linear(from_reading, offset), np.linalg.inv(mat_w), others,
                    linear(turn, np.zeros(3)))


def _others(model: Model) -> list[PlainEffect] | None:
    """Give the effects that are not linear; None where one is not known."""
    found = [plain_effect(name, values) for name, values in model.values.items()
             if not EFFECTS[name].linear]
    known = [each for each in found if each is not None]
    return known if len(known) == len(found) else None


def linear(matrix: Floats, offset: Floats) -> Correct:
    """Make the function matrix @ reading + offset, whatever the context."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    j, k, m = offset.tolist()

    def correct(x: float, y: float, z: float, context: PlainContext) -> Triple:
        return a * x + b * y + c * z + j, d * x + e * y + f * z + k, g * x + h * y + i * z + m

    return correct


def _solving(undisturbed: Correct, inverse: Floats, others: list[PlainEffect], turn: Correct
             ) -> Correct:
    """Make the function that solves for u as `model.sensor_force` does, and turns it."""
    constant = [each.added for each in others if each.constant]
    bends = [each.added for each in others if not each.constant]
    undone = linear(-inverse, np.zeros(3))

    def correct(x: float, y: float, z: float, context: PlainContext) -> Triple:
        u = undisturbed(x, y, z, context)
        fixed = _summed(constant, u, context)
        base = _sum(u, undone(*fixed, context))
        if not bends:
            return turn(*base, context)
        u = base
        for _ in range(LARGEST_ITERATIONS):
            if max(map(abs, u)) > LARGEST_FORCE_G:
                break
            before, u = u, _sum(base, undone(*_summed(bends, u, context), context))
            if max(abs(u[0] - before[0]), abs(u[1] - before[1]), abs(u[2] - before[2])
                   ) < CONVERGED_G:
                return turn(*u, context)
        raise too_large()

    return correct


def _sum(one: Triple, other: Triple) -> Triple:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _summed(parts: list[Callable[[Triple, PlainContext], Triple]], u: Triple,
            context: PlainContext) -> Triple:
    """Give what these effects add together."""
    x = y = z = 0.0
    for part in parts:
        p, q, r = part(u, context)
        x, y, z = x + p, y + q, z + r
    return x, y, z


def _arrays(context: PlainContext) -> dict[str, Floats]:
    """Give a context as one row of arrays."""
    return {key: np.array([value], float) for key, value in context.items()}


def _through_arrays(calibration: Calibration, scale: float) -> Correct:
    def correct(x: float, y: float, z: float, context: PlainContext) -> Triple:
        force = calibration.correct(np.array([[x, y, z]]), _arrays(context))[0] * scale
        return float(force[0]), float(force[1]), float(force[2])

    return correct


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
    others = _others(calibration.model)
    unit = calibration.force_per_g * scale
    if others is None:
        return _spread_through_arrays(calibration, scale)
    return (_bent_spread(calibration.model, calibration.covariance, unit) if others
            else _linear_spread(calibration.model, calibration.covariance, unit))


def _spread_through_arrays(calibration: Calibration, scale: float) -> Spread:
    def spread(force: Triple, context: PlainContext) -> Sequence[float]:
        found = calibration.force_covariance(np.array([force]) / scale, _arrays(context))
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
    """Make the function for a model with other effects."""
    names = [name for name, values in model.values.items() for _ in values]
    order = sorted(range(len(names)), key=lambda k: not EFFECTS[names[k]].linear)
    known = covariance[np.ix_(order, order)]
    growth = _linear_basis(model, unit)
    width, flat = growth.shape[2], growth.reshape(4, -1)
    others = _others(model) or []
    mat_w, turn = model.linear_part[0], model.rotation.T * unit
    into = linear(model.rotation / unit, np.zeros(3))

    def spread(force: Triple, context: PlainContext) -> Sequence[float]:
        u = into(*force, context)
        basis = np.empty((3, len(names)))
        basis[:, :width] = np.dot((1.0, *force), flat).reshape(3, width)
        parts = [each.basis(u, context) for each in others]
        basis[:, width:] = [[*chain(*rows)] for rows in zip(*parts)]
        slope = mat_w
        for each in others:
            if each.slope is not None:
                slope = slope + each.slope(u, context)
        moved = turn @ np.linalg.inv(slope) @ basis
        return (moved @ known @ moved.T).ravel().tolist()

    return spread
