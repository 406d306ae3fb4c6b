# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The correction of one reading at a time, in plain floats.

A call of numpy costs about a microsecond whatever it does, and `Calibration.correct` makes dozens
of them: nothing for a recording, too much for a stream of single messages. Here what does not
change from reading to reading is worked out once, and some products and sums are left. Equation
and iteration are those of `accel_calib.model`, and a test holds the two together for every effect
of the catalogue. A model with an effect that `plain_effects` does not know goes through arrays.

"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .calibrate import Calibration
from .effects import EFFECTS
from .model import (
    CONVERGED_G,
    LARGEST_FORCE_G,
    LARGEST_ITERATIONS,
    Model,
    too_large,
)
from .plain_effects import plain_effect, PlainContext, PlainEffect, Triple
from .table import Floats

Correct = Callable[[float, float, float, PlainContext], Triple]
"""Reading, context -> specific force in the levelled frame."""


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
    others = others_of(calibration.model)
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


def others_of(model: Model) -> list[PlainEffect] | None:
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
    near, far = CONVERGED_G, LARGEST_FORCE_G

    def correct(x: float, y: float, z: float, context: PlainContext) -> Triple:
        u = undisturbed(x, y, z, context)
        p, q, r = undone(*_summed(constant, u, context), context)
        base_x, base_y, base_z = x, y, z = u[0] + p, u[1] + q, u[2] + r
        if not bends:
            return turn(x, y, z, context)
        for _ in range(LARGEST_ITERATIONS):
            if not (-far < x < far and -far < y < far and -far < z < far):
                break
            p, q, r = undone(*_summed(bends, (x, y, z), context), context)
            p, q, r = base_x + p, base_y + q, base_z + r
            same = -near < p - x < near and -near < q - y < near and -near < r - z < near
            x, y, z = p, q, r
            if same:
                return turn(x, y, z, context)
        raise too_large()

    return correct


def _summed(parts: list[Callable[[Triple, PlainContext], Triple]], u: Triple,
            context: PlainContext) -> Triple:
    """Give what these effects add together."""
    x = y = z = 0.0
    for part in parts:
        p, q, r = part(u, context)
        x, y, z = x + p, y + q, z + r
    return x, y, z


def arrays_of(context: PlainContext) -> dict[str, Floats]:
    """Give a context as one row of arrays."""
    return {key: np.array([value], float) for key, value in context.items()}


def _through_arrays(calibration: Calibration, scale: float) -> Correct:
    def correct(x: float, y: float, z: float, context: PlainContext) -> Triple:
        force = calibration.correct(np.array([[x, y, z]]), arrays_of(context))[0] * scale
        return float(force[0]), float(force[1]), float(force[2])

    return correct
