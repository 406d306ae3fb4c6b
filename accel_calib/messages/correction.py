# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of sensor_msgs/Imu messages by a calibration.

One rule holds for the node and for recordings. A corrected message has offset, gain and the
mounting ΔR applied. If ΔR is a rotation of the frame, everything in the message is turned into the
levelled frame, and the message has the frame_id of that frame:

==================  ======================================================================
acceleration        ΔRᵀ W⁻¹ (reading - V), and the other effects of the calibration
angular velocity    ΔRᵀ rate
orientation         q ⊗ q(ΔR), the attitude of the levelled frame in the same world
covariances         A C Aᵀ with A = ΔRᵀ, for the acceleration ΔRᵀ W⁻¹; all three are stated
                    about the x, y and z axes of the message (sensor_msgs/Imu)
frame_id            `output_frame`
==================  ======================================================================

A calibration without a mounting (`Calibration.in_sensor_frame`) leaves the frame unchanged. Then
only the acceleration and its covariance differ from the raw message, and a covariance that is not
finite. The stamp never changes.

The conventions for covariances are kept: a first element of -1 means no data, and all zero means
unknown. A covariance that is not finite becomes unknown. The covariance of the calibration is
added to a known covariance of the acceleration.

**Single messages.** `Rewriter` has the result of `corrected`, but computes with Python floats:
each call of numpy takes about 1 µs, and `Calibration.correct` makes dozens. `OneReading` sums the
terms of the catalogue (`accel_calib.effects`). With the context fixed, the affine terms sum to
an offset and a gain; only the bending terms are iterated, as in `accel_calib.effects.model`.
Covariances rarely change from message to message, so that each is transformed only once.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
import math
from operator import add
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..calibration import Calibration, SampleNoise
from ..effects import (
    AFFINE, check_context, context_of_samples, CONVERGED_G, Effect, FORCE, LARGEST_FORCE_G,
    LARGEST_ITERATIONS, MONOMIALS, ONE, own_slope, thermal_stream, ThermalStream, too_large)
from ..errors import InputError
from ..geometry import quaternion_of
from ..logs import (
    ACCELERATION, ACCELERATION_COVARIANCE, ANGULAR_VELOCITY, ANGULAR_VELOCITY_COVARIANCE, Layout,
    layout_with, LITTLE_ENDIAN, NAME_AT, NINE, ORIENTATION, ORIENTATION_COVARIANCE, STAMP,
    STAMP_AT, THREE)
from ..table import Floats


def output_scale(calibration: Calibration, gravity: float) -> float:
    """Return m/s² per unit of corrected force; `gravity` is the local gravity [m/s²]."""
    return 1.0 if calibration.units.is_si else gravity / calibration.force_per_g


def corrected(calibration: Calibration, doubles: Floats, context: Mapping[str, NDArray[Any]] = {},
              scale: float = 1.0) -> Floats:
    """
    Return the corrected doubles of Imu messages, (n, 37).

    Parameters
    ----------
    calibration : Calibration
        The calibration, in the unit of the messages.
    doubles : (n, 37) array
        One row per message; see `accel_calib.logs.bag`.
    context : mapping of str to array, optional
        Columns that the effects need, n rows each.
    scale : float
        Factor on the corrected force.

    """
    known = context_of_samples(context, len(doubles), calibration.model)
    rotation = calibration.model.rotation
    result = doubles.copy()
    force = calibration.correct(doubles[:, ACCELERATION], known)
    result[:, ACCELERATION] = scale * force
    if calibration.is_levelled:
        result[:, ANGULAR_VELOCITY] = doubles[:, ANGULAR_VELOCITY] @ rotation
        present = doubles[:, ORIENTATION_COVARIANCE.start] != -1.0
        x, y, z, w = doubles[present, ORIENTATION].T
        result[present, ORIENTATION] = np.array(_compose(x, y, z, w, *quaternion_of(rotation))).T
    turn = rotation.T if calibration.is_levelled else np.eye(3)
    for part, matrix in ((ANGULAR_VELOCITY_COVARIANCE, turn), (ORIENTATION_COVARIANCE, turn), (
            ACCELERATION_COVARIANCE, scale * rotation.T @ np.linalg.inv(calibration.gain))):
        result[:, part], stated = _transformed(matrix, doubles[:, part])
    if np.any(stated):
        rows = {key: values[stated] for key, values in known.items()}
        added = calibration.force_covariance(force[stated], rows)
        result[stated, ACCELERATION_COVARIANCE] += scale ** 2 * added.reshape(-1, 9)
    return result


def output_frame(calibration: Calibration, frame_id: str, chosen: str = '') -> str:
    """Return the frame_id of corrected messages; `chosen` is that of the levelled frame."""
    return (chosen or f'{frame_id}_levelled') if calibration.is_levelled else frame_id


def _transformed(matrix: Floats, covariance: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """
    Return A C Aᵀ for (n, 9) covariances C, and which of them are known.

    An unknown covariance becomes zero, and one without data (-1) is unchanged.

    """
    absent = covariance[:, 0] == -1.0
    known = ~absent & np.any(covariance != 0.0, axis=1) & np.all(np.isfinite(covariance), axis=1)
    found = np.where(absent[:, np.newaxis], covariance, 0.0)
    found[known] = (matrix @ covariance[known].reshape(-1, 3, 3) @ matrix.T).reshape(-1, 9)
    return found, known


def _compose(x: Any, y: Any, z: Any, w: Any, p: float, q: float, r: float, s: float
             ) -> tuple[Any, Any, Any, Any]:
    """Return the product of two quaternions (x, y, z, w); the first can have arrays."""
    return (w * p + x * s + y * r - z * q, w * q - x * r + y * s + z * p,
            w * r + x * q - y * p + z * s, w * s - x * p - y * q - z * r)


# ---------------------------------------------------------------------------- one reading

Triple = tuple[float, float, float]
Matrix = Sequence[float]
"""Nine numbers, row by row."""

Known = Mapping[str, Any]
"""Context of one reading: floats and triples, with the keys of `accel_calib.effects.Context`."""

_Term = tuple[int, int, float]
"""Axis, monomial, and weight times value of a term of an effect."""

_Bend = tuple[int, float, Callable[[float, float, float], float],
              Callable[[float, float, float], Triple]]
"""Axis, coefficient, value and gradient of a bending term with its context fixed."""

_SLOW = 3
"""Iterations after which the slope is computed at the present force."""


class OneReading:
    """
    A calibration prepared for the correction of single readings; `scale` is on the force.

    `monomials` are the indices of those of the model; the affine monomials are first.

    """

    def __init__(self, calibration: Calibration, scale: float = 1.0) -> None:
        model = calibration.model
        self._calibration = calibration
        unit = calibration.force_per_g * scale
        self.turn: Matrix = (model.rotation.T * unit).ravel().tolist()
        self.back: Matrix = (model.rotation / unit).ravel().tolist()
        self.per_g = calibration.units.per_g
        self._effects: list[tuple[Effect, list[float], list[_Term]]] = []
        self.of_force: list[tuple[Effect, list[float], list[_Term]]] = []
        for effect, values in zip(model.terms.effects, model.values.values(), strict=True):
            size, shape = effect.split(values)
            terms = [(each.axis, each.monomial, each.weight * float(size[each.parameter]))
                     for each in effect.terms]
            kept = self.of_force if effect.of_force else self._effects
            kept.append((effect, shape.tolist(), terms))
        self._effects.sort(key=lambda each: each[0].scales)  # last, when all gains are there
        used = model.terms.monomials
        self.monomials = (*range(AFFINE), *(index for index in used if index >= AFFINE))

    def at(self, known: Known) -> AtReading:
        """Return the calibration at a context; a quantity that is missing is an InputError."""
        check_context(self._calibration.model, known)
        ranges = self._calibration.ranges
        if ranges:  # effects are not extrapolated
            known = {**known, **{key: min(max(known[key], low), high)
                                 for key, (low, high) in ranges.items() if key in known}}
        affine, bends = [0.0] * 12, list[_Bend]()  # V and W - I, row by row, and bending terms
        for effect, shape, terms in self._effects:
            factors = _factors(effect, known, shape, terms)
            if effect.scales:
                affine[3:] = [part * (1.0 + terms[0][2] * factors[0]) for part in affine[3:]]
            for (axis, monomial, size), factor in zip(terms, factors):
                if monomial == ONE:
                    affine[axis] += size * factor
                elif monomial < AFFINE:
                    affine[3 + 3 * axis + monomial - FORCE] += size * factor
                else:
                    bends.append((axis, size * factor, *MONOMIALS[monomial]))
        return AtReading(self, affine, bends, known)

    @cached_property
    def _spread_rows(self) -> tuple[Floats, Floats]:
        """Return the (m, t) monomial of each row of the basis, and its (t, 3 p) part of a root."""
        model, covariance = self._calibration.model, self._calibration.covariance
        size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))  # constants have other units
        variances, axes = np.linalg.eigh(covariance / size / size[:, np.newaxis])
        root = model.rows.to_value.T @ (axes * size[:, np.newaxis] * np.sqrt(
            np.maximum(variances, 0.0)))
        of_axis = np.eye(3)[model.rows.axis][:, :, np.newaxis]
        monomials = np.take(model.terms.monomials, model.rows.place)
        return (np.equal.outer(self.monomials, monomials).astype(float),
                (of_axis * root[:, np.newaxis]).reshape(len(root), -1))

    def spread_basis(self, known: Known, u: Triple) -> Floats:
        """Return the (m, 3 p) basis of each monomial times a root of the covariance."""
        model = self._calibration.model
        row = {key: np.asarray(value, float)[np.newaxis] for key, value in known.items()}
        basis = model.basis_of(model.terms.weight[:, np.newaxis], row, np.array([u]))
        which, rows = self._spread_rows
        return np.asarray((which * basis.terms[:, 0]) @ rows)


def _factors(effect: Effect, known: Known, shape: Any, terms: Sequence[_Term]) -> list[float]:
    """Return the factor of an effect on each of its terms; 0 where its context is NaN."""
    factor: Any = effect.factor(known, shape) if effect.factor is not None else 1.0
    if isinstance(factor, np.ndarray):
        return np.broadcast_to(np.nan_to_num(factor), len(terms)).tolist()
    return [0.0 if factor != factor else float(factor)] * len(terms)


class AtReading:
    """
    A calibration with its context fixed; `OneReading.at` returns it.

    `correct` is the function reading x, y, z -> specific force in the levelled frame, times the
    scale. It raises InputError if the effects cannot be corrected.

    """

    def __init__(self, owner: OneReading, affine: Sequence[float], bends: list[_Bend],
                 known: Known) -> None:
        self._owner, self._bends, self._known = owner, bends, known
        a, b, c, d, e, f, g, h, i = affine[3:]
        self._gain = (a + 1.0, b, c, d, e + 1.0, f, g, h, i + 1.0)
        inverse = _inverse(self._gain)
        offset = _times(inverse, *affine[:3])
        if bends or owner.of_force:
            self.correct = self._solving(inverse, offset)
        else:
            matrix = _matmul(owner.turn, inverse)
            self.correct = _affine([part / owner.per_g for part in matrix],
                                   _times(owner.turn, *offset))

    def _solving(self, inverse: Matrix, offset: Triple) -> Callable[[float, float, float], Triple]:
        """
        Return the function that solves for u, and rotates it.

        The method is Newton's, with a slope that is computed again only if convergence is slow.
        `model.AtContext.force` solves the same equation for many readings.

        """
        undone = _affine([part / self._owner.per_g for part in inverse], offset)
        turn, bend, near, far = self._owner.turn, self._bend, CONVERGED_G, LARGEST_FORCE_G
        toward: Matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

        def correct(x: float, y: float, z: float) -> Triple:
            nonlocal toward
            p, q, r = left, mid, right = undone(x, y, z)
            last = near
            for count in range(LARGEST_ITERATIONS):
                j, k, m = _times(inverse, *bend(p, q, r))
                j, k, m = p + j - left, q + k - mid, r + m - right
                if count == _SLOW:
                    toward = _matmul(_inverse(self._slope_at((p, q, r))), self._gain)
                j, k, m = _times(toward, j, k, m)
                p, q, r = p - j, q - k, r - m
                if not (-far < p < far and -far < q < far and -far < r < far):
                    break
                step = max(abs(j), abs(k), abs(m))
                if step * step < near * last:  # the next step would be smaller than that
                    return _times(turn, p, q, r)
                last = step
            raise too_large()

        return correct

    def _bend(self, x: float, y: float, z: float) -> list[float]:
        """Return what the bending terms add to a reading at a force [g]."""
        added = [0.0, 0.0, 0.0]
        for axis, size, value, _ in self._bends:
            added[axis] += size * value(x, y, z)
        for effect, shape, terms in self._owner.of_force:
            factors = _factors(effect, {**self._known, 'force': (x, y, z)}, shape, terms)
            for (axis, _, size), factor in zip(terms, factors):
                added[axis] += size * factor
        return added

    def _slope_at(self, u: Triple) -> Matrix:
        """Return the slope of the reading at a force."""
        if self._owner.of_force:
            bent = own_slope(lambda at: np.array([self._bend(*at[0])]), np.array([u]))
            return [*map(add, self._gain, bent.ravel().tolist())]
        slope = list(self._gain)
        for axis, size, _, gradient in self._bends:
            for at, part in enumerate(gradient(*u), 3 * axis):
                slope[at] += size * float(part)
        return slope

    def with_spread(self, force: Triple, own: Sequence[float]) -> Sequence[float]:
        """
        Return the covariance of a corrected force, with the uncertainty of the calibration.

        `own` is the covariance of the force from the noise of the reading, row by row.

        """
        if self._bends or self._owner.of_force:
            u = _times(self._owner.back, *force)
            monomials = [MONOMIALS[index].value(*u) for index in self._owner.monomials]
            to_force = np.reshape(_matmul(self._owner.turn, _inverse(self._slope_at(u))), (3, 3))
            basis = (self._owner.spread_basis(self._known, u) if self._owner.of_force
                     else self._basis)
            moved = to_force @ np.dot(monomials, basis).reshape(3, -1)
            added = (moved @ moved.T).ravel().tolist()
        else:
            xx, xy, xz, yy, yz, zz = [form(*force) for form in self._forms]
            added = [xx, xy, xz, xy, yy, yz, xz, yz, zz]
        return [*map(add, own, added)]

    @cached_property
    def _forms(self) -> list[Callable[[float, float, float], float]]:
        """
        Entries of the covariance as quadratic forms of the force; the upper triangle.

        Between messages the caches of the processor are lost: numpy would take 20 µs instead of 2.

        """
        basis = self._basis.reshape(AFFINE, 3, -1)
        moved = np.reshape(_matmul(self._owner.turn, _inverse(self._gain)), (3, 3)) @ basis
        moved[1:] = np.einsum('ij,ikp->jkp', np.reshape(self._owner.back, (3, 3)), moved[1:])
        each = np.einsum('mip,njp->mnij', moved, moved).reshape(AFFINE, AFFINE, 9)
        both = each + np.swapaxes(each, 0, 1)
        form = np.array([both[m, n] / (2.0 if m == n else 1.0)
                         for m, n in zip(*np.triu_indices(AFFINE), strict=True)])
        return [_quadratic(form[:, entry].tolist()) for entry in (0, 1, 2, 4, 5, 8)]

    @cached_property
    def _basis(self) -> Floats:
        return self._owner.spread_basis(self._known, (0.0, 0.0, 0.0))


def _affine(matrix: Matrix, less: Triple) -> Callable[[float, float, float], Triple]:
    """Return the function v -> matrix @ v - less."""
    a, b, c, d, e, f, g, h, i = matrix
    p, q, r = less
    return lambda x, y, z: (
        a * x + b * y + c * z - p, d * x + e * y + f * z - q, g * x + h * y + i * z - r)


def _quadratic(form: Sequence[float]) -> Callable[[float, float, float], float]:
    """Return the quadratic form with the coefficients of 1, x, y, z, xx, xy, xz, yy, yz, zz."""
    a, b, c, d, e, f, g, h, i, j = form
    return lambda x, y, z: (
        a + x * (b + e * x + f * y + g * z) + y * (c + h * y + i * z) + z * (d + j * z))


def _times(matrix: Matrix, x: float, y: float, z: float) -> Triple:
    a, b, c, d, e, f, g, h, i = matrix
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _matmul(one: Matrix, other: Matrix) -> Matrix:
    columns = [_times(one, *other[k::3]) for k in range(3)]
    return [part for row in zip(*columns) for part in row]


def _inverse(matrix: Matrix) -> Matrix:
    """Return the inverse of a gain, which the gate has found not to be singular."""
    a, b, c, d, e, f, g, h, i = matrix
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    size = a * p + b * q + c * r
    return (p / size, (c * h - b * i) / size, (b * f - c * e) / size,
            q / size, (a * i - c * g) / size, (c * d - a * f) / size,
            r / size, (b * g - a * h) / size, (a * e - b * d) / size)


# --------------------------------------------------------------------------- one message

LARGEST_G = 100.0
"""Larger corrected forces are not published [g]. The range of common accelerometers is 16 to 40 g;
shock sensors cannot be calibrated by gravity."""

_FORCE, _FRONT, _WHOLE = (
    struct.Struct(each) for each in ('<12d', '<4d72s3d72s', '<4d72s3d72s3d72s'))
_ABSENT = struct.pack('<d', -1.0)
_UNKNOWN = bytes(72)
_NONE: Triple = (0.0, 0.0, 0.0)


class _Seen(NamedTuple):
    """
    A covariance as given, whether its quantity is in the message, and the corrected one.

    `turned` has the numbers of the corrected one; None if it is not known.

    """

    given: bytes
    present: bool
    new: bytes
    turned: list[float] | None


class Rewriter:
    """
    Correct messages of one layout.

    Parameters
    ----------
    layout, calibration
        Layout of the messages, and the calibration in the unit of the readings.
    gravity : float
        Local gravity [m/s²].
    frame_id : str
        frame_id of the corrected messages.
    noise : SampleNoise, optional
        Noise of the samples, stated in messages whose covariance is unknown.
    thermal : ThermalStream, optional
        Lag and rate of the temperature before the messages; by default they start in equilibrium.

    Attributes
    ----------
    layout : Layout
        Layout of the corrected messages.
    bias : (float, float, float)
        Bias that is subtracted from the angular velocity [rad/s].

    """

    def __init__(self, layout: Layout, calibration: Calibration, gravity: float, frame_id: str,
                 noise: SampleNoise | None = None, thermal: ThermalStream | None = None) -> None:
        scale = output_scale(calibration, gravity)
        self.bias: Triple = _NONE
        self._turns = calibration.is_levelled
        self._turn = tuple(calibration.rotation.T.ravel().tolist())
        self._quaternion = quaternion_of(calibration.rotation)
        self._inverse = calibration.rotation.T @ np.linalg.inv(calibration.gain) * scale
        self._calibration = OneReading(calibration, scale)
        self._needs, self._neutral = calibration.model.needs, calibration.model.neutral
        self._thermal = thermal if thermal is not None else thermal_stream(calibration.model)
        self._per_message = bool({'time', 'rate'}.intersection(self._needs))
        self._at = None if self._needs else self._calibration.at({})
        self._context: Mapping[str, float] | None = None
        self._largest = LARGEST_G * gravity
        self._given, self.layout = layout, layout_with(frame_id)
        self._renamed = self.layout.name != layout.name
        self._name = self.layout.name + bytes(self.layout.begin - self.layout.name_end)
        stated = [np.full(3, np.nan)] * 2 if noise is None else [noise.force, noise.rate]
        self._fill_force, self._fill_rate = (
            np.diag(np.square(each)).astype('<f8').tobytes() if np.all(np.isfinite(each))
            else _UNKNOWN for each in stated)
        self._seen_force = self._seen_rate = self._seen_orientation = _Seen(b'', True, b'', None)

    def __call__(self, data: bytes, context: Mapping[str, float]) -> bytes | None:
        """
        Return the corrected message; None for a reading that is not finite.

        `context` is another mapping if it has changed. Missing context and a corrected force that
        is not plausible are an InputError.

        """
        *front, x, y, z, covariance = _WHOLE.unpack_from(data, self._given.begin)
        if not math.isfinite(x + y + z):
            return None
        at = self._at
        if at is None or (self._needs and (self._per_message or context is not self._context)):
            at = self._at_context(data, front, context)
        force = at.correct(x, y, z)
        largest = self._largest
        a, b, c = force
        if not (-largest < a < largest and -largest < b < largest and -largest < c < largest):
            words = ', '.join(f'{part:.3g}' for part in force)
            raise InputError(f'the corrected acceleration is ({words}) m/s², expected less than '
                             f'{LARGEST_G:.0f} g', 'check the calibration and the driver')
        seen = self._seen_force
        if covariance != seen.given:
            seen = self._seen_force = _seen(self._inverse, covariance, self._fill_force)
        before = self._before(data, front)
        if seen.turned is None:
            return before + THREE.pack(a, b, c) + seen.new
        return before + _FORCE.pack(a, b, c, *at.with_spread(force, seen.turned))

    def _before(self, data: bytes, front: Sequence[Any]) -> bytes:
        """Return the message before the acceleration; `front` are its fields there."""
        x, y, z, w, orientation_spread, p, q, r, rate_spread = front
        if rate_spread != self._seen_rate.given:
            self._seen_rate = _seen(self._turn, rate_spread, self._fill_rate)
        if orientation_spread != self._seen_orientation.given:
            self._seen_orientation = _seen(self._turn, orientation_spread, _UNKNOWN)
        _, has_rate, new_rate, _ = self._seen_rate
        _, has_orientation, new_orientation, _ = self._seen_orientation
        u, v, t = self.bias
        begin = self._given.begin
        head = (LITTLE_ENDIAN + data[STAMP_AT:NAME_AT] + self._name if self._renamed
                else data[:begin])
        if not (self._turns or u or v or t or new_rate != rate_spread
                or new_orientation != orientation_spread):
            return head + data[begin:begin + _FRONT.size]
        if has_rate:
            p, q, r = p - u, q - v, r - t
        if self._turns:
            if has_orientation:
                x, y, z, w = _compose(x, y, z, w, *self._quaternion)
            p, q, r = _times(self._turn, p, q, r)
        return head + _FRONT.pack(x, y, z, w, new_orientation, p, q, r, new_rate)

    def _at_context(self, data: bytes, front: Sequence[Any], context: Mapping[str, float]
                    ) -> AtReading:
        """Return the calibration at the context of a message, and cache it."""
        seconds, nanoseconds = STAMP.unpack_from(data, STAMP_AT)
        rate, absent = tuple(front[5:8]), front[8][:8] == _ABSENT
        time = seconds + nanoseconds * 1e-9
        known: dict[str, Any] = {
            **self._neutral, **context, 'time': time, 'std': _NONE, 'previous': _NONE,
            'rate': _NONE if absent or not all(map(math.isfinite, rate)) else rate}
        if self._thermal is not None and 'temperature' in context:
            self._thermal.add(time, context['temperature'])
            known.update(self._thermal.value)
        self._at, self._context = self._calibration.at(known), context
        return self._at


def _seen(matrix: Any, covariance: bytes, fill: bytes) -> _Seen:
    """Return a covariance C with A C Aᵀ, and `fill` in place of an unknown C."""
    if covariance[:8] == _ABSENT:
        return _Seen(covariance, False, covariance, None)
    either = np.frombuffer(covariance + fill, '<f8').reshape(2, 9)
    found, known = _transformed(np.reshape(matrix, (3, 3)), either)
    for turned in found[known].tolist():
        return _Seen(covariance, True, NINE.pack(*turned), turned)
    return _Seen(covariance, True, _UNKNOWN, None)


def motion_of(data: bytes, layout: Layout, gravity: Floats) -> bytes:
    """Return a serialized Vector3Stamped: the acceleration of a message minus gravity [m/s²]."""
    x, y, z = THREE.unpack_from(data, layout.place(ACCELERATION))
    return data[:layout.begin] + THREE.pack(x - gravity[0], y - gravity[1], z - gravity[2])
