# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Closed forms: the cost functions of AN5286 and the ESGI'95 report, without weights.

Poses of unknown orientation lie on a quadric: for model 4 a sphere, for model 7 with axes parallel
to those of the sensor, for model 10 with any axes. Poses of known orientation satisfy
reading = X force + y, linear in X and y (ESGI'95 report, section 3).

**Quadric.** Poses of unknown orientation satisfy |W⁻¹ (reading - V)| = 1 (NXP AN5286):

    readingᵀ A reading - 2 readingᵀ A V + VᵀA V - B² = 0,   W⁻¹ = (A / B²)^(1/2)

The coefficients are the eigenvector of XᵀX with the smallest eigenvalue, where a row of X holds
the monomials of a reading. This cost depends on origin and scale. The readings are therefore first
shifted and scaled by the sphere that fits them. Counts and volts then lead to the same result as
m/s², without a loss of digits.

**Sensing axes.** Model 9 of the ESGI'95 report has shifts, scales and angles. Sensing axis i is a
unit vector f_i with the reading m_i = b_i (f_i · a) + s_i. The reference axes e are fixed to the
sensing axes by e1 = f1 and e2 in the f1-f2 plane, so that in these axes

    f1 = (1, 0, 0)
    f2 = (cos φ, sin φ, 0)
    f3 = (cos ψ, cos ξ, cos η),  cos² η = 1 - cos² ξ - cos² ψ,
                                 cos ξ = (cos θ - cos φ cos ψ) / sin φ

with φ between f1 and f2, ψ between f1 and f3, and θ between f2 and f3. The rows f_i form the
matrix T̄ᵒʳᵗʰ of the report (its eq. 11 needs the transpose of its eq. 12), and W = diag(b) T̄ᵒʳᵗʰ
is lower triangular. The angles need not be small.

|force| does not depend on the axes of the force, so this model is fitted as model 10 and then
rotated. `TIES` maps its nine parameters to the twelve values of the model.

**Step.** With A = W⁻², b = A V and k = VᵀA V, |W⁻¹ (reading - V)| = 1 of model 10 is

    readingᵀ A' reading - 2 b'ᵀ reading = 1,   A' = A / (1 - k),  b' = b / (1 - k)

which is linear in A' and b'. In V and W it is not. Precise poses that do not determine all values
leave a thin curved sheet of them, on which a straight step is only short. A step that is straight
in A' and b' stays on the sheet.

"""

from dataclasses import dataclass
from itertools import combinations
from math import comb
from operator import itemgetter

import numpy as np

from .equations import believable
from ..effects import linear_model, Model, MODELS, parameter_names, with_vector
from ..errors import RefusedFitError, TAKE_ALL_SIDES
from ..table import Poses
from ..text import counted
from ..units import Floats, Indices

_RIDGE = 1e-12
"""Keeps the solution finite for poses in a plane; the centre is then in the plane."""

_DISTANCES = 2 ** 16
"""Largest number of distances of poses from subsets that are held at once."""

_BLOCK = 8192
"""Number of poses per block; their monomials fit in the cache."""

_IDENTITY = np.eye(3)

_SQUARES, _PRODUCTS = np.array([[0, 1, 2]] * 2), np.array([[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
"""i and j of the monomials r_i r_j of a quadric, for axes of the sensor, and for any axes."""


@np.errstate(all='ignore')
def along_quadrics(values: Floats, step: Floats) -> Floats:
    """Return the (9,) values after a small step straight in A' and b' (model 10), or NaN."""
    mat_w, vec_v = with_vector(MODELS['10'].effects, values).linear_part
    turned, step_v = with_vector(MODELS['10'].effects, step).linear_part
    step_w = turned - _IDENTITY
    try:
        mat_a = np.linalg.inv(mat_w @ mat_w)
        step_a = -mat_a @ (step_w @ mat_w + mat_w @ step_w) @ mat_a
        vec_b, step_b = mat_a @ vec_v, step_a @ vec_v + mat_a @ step_v
        left = 1.0 - vec_v @ vec_b
        change = (step_v @ vec_b + vec_v @ step_b) / left
        mat_a = (mat_a * (1.0 + change) + step_a) / left
        vec_b = (vec_b * (1.0 + change) + step_b) / left
        centre = np.linalg.solve(mat_a, vec_b)
        squared, axes = np.linalg.eigh(mat_a / (1.0 + centre @ vec_b))
    except np.linalg.LinAlgError:
        return np.full(len(values), np.nan)
    mat_w = (axes / np.sqrt(squared)) @ axes.T
    return linear_model('10', (mat_w + mat_w.T) / 2.0, centre).vector


_MOST_SUBSETS = 400
"""Largest number of subsets that are fitted."""

_SPARE = 3
"""Number of poses in a random subset beyond the free parameters."""

_ENOUGH = 300
"""Number of poses, drawn at random, among which the subsets are compared first."""

_CONCENTRATIONS = 2
"""Number of further closed forms, after each of which the nearest poses are selected again."""

_FACE_COSINE = np.cos(np.radians(20.0))
"""A reading within 20° of a sensor axis is one of the six faces."""


def closed_form(name: str, reading: Floats) -> tuple[Floats, Floats]:
    """
    Fit model 4, 7, 9 or 10 to poses of unknown orientation; 9 is 10 in other axes.

    `reading` is (..., n, 3), in any unit, with at least as many poses as free parameters. Leading
    axes are separate sets. Return W (..., 3, 3), in the unit of the readings per g, and
    V (..., 3); NaN for a set that is not on an ellipsoid.

    """
    sphere, centre = fit_sphere(reading)
    gains = MODELS[name].gains
    if gains == 1:
        return sphere, centre
    first, second = _SQUARES if gains == 3 else _PRODUCTS
    size, twice = len(first), np.where(first == second, 1.0, 2.0)[:, np.newaxis]
    radius = sphere[..., :1, :1]
    r = ((reading - centre[..., np.newaxis, :]) / radius).swapaxes(-1, -2)
    moments = np.zeros((*centre.shape[:-1], size + 4, size + 4))  # XᵀX
    for start in range(0, r.shape[-1], _BLOCK):
        block = r[..., start:start + _BLOCK]
        monomials = np.ones((*block.shape[:-2], size + 4, block.shape[-1]))
        monomials[..., :size, :] = twice * block[..., first, :] * block[..., second, :]
        monomials[..., size:-1, :] = block
        moments += monomials @ monomials.swapaxes(-1, -2)
    beta = np.linalg.eigh(moments)[1][..., 0]
    mat_a = np.zeros((*centre.shape, 3))
    mat_a[..., first, second] = mat_a[..., second, first] = beta[..., :size]
    values, vectors = np.linalg.eigh(mat_a)
    sign = np.copysign(1.0, values[..., 1:2])  # AN5286: negate the whole vector
    with np.errstate(invalid='ignore', divide='ignore'):
        along = (beta[..., np.newaxis, size:-1] @ vectors)[..., 0, :] / (-2.0 * values)
        values = values * sign
        field_squared = np.sum(along * along * values, axis=-1, keepdims=True) - (
            beta[..., -1:] * sign)  # B²
        gain = np.sqrt(field_squared / values)  # the middle value is positive: NaN where B² is not
        mat_w = (vectors * gain[..., np.newaxis, :]) @ vectors.swapaxes(-1, -2)
        offset = (vectors @ along[..., np.newaxis])[..., 0]
        return mat_w * radius, centre + offset * radius[..., 0]


def fit_sphere(reading: Floats) -> tuple[Floats, Floats]:
    """
    Fit an offset and one gain (AN5286 eq. 10-14); arguments and result as `closed_form`.

    With r the readings minus their mean, it solves the sums over the poses of
    |r|² = 2 V·r + (W² - |V|²), times r and 1.

    """
    count, transposed = reading.shape[-2], reading.swapaxes(-1, -2)
    mean = transposed.sum(axis=-1) / count
    r = transposed - mean[..., np.newaxis]
    second = r @ r.swapaxes(-1, -2)
    third = r @ np.sum(r * r, axis=-2)[..., np.newaxis]
    trace = np.trace(second, axis1=-2, axis2=-1)
    ridge = (_RIDGE * trace + 1e-300)[..., np.newaxis, np.newaxis] * _IDENTITY
    centre = np.linalg.solve(second + ridge, third)[..., 0] / 2.0
    squared = trace / count + np.sum(centre * centre, axis=-1)
    radius = np.sqrt(squared + (squared == 0.0))
    return radius[..., np.newaxis, np.newaxis] * _IDENTITY, mean + centre


def start_of(name: str, reading: Floats) -> Model:
    """
    Return start values by the closed form; a sphere if the poses are not on an ellipsoid.

    Those of model 12, which is linear, are 0.

    """
    if MODELS[name].known_orientation:
        return with_vector(MODELS[name].effects, np.zeros(12))
    mat_w, vec_v = closed_form(name, reading)
    if not np.all(np.isfinite(mat_w)):
        mat_w, vec_v = closed_form('4', reading)
    return linear_model(name, mat_w, vec_v)


@np.errstate(all='ignore')  # some subsets are not on an ellipsoid, or are in a plane
def agreeing(name: str, poses_g: Poses, most: int) -> Indices:
    """Return the indices of all poses but `most`, selected so that they agree best."""
    count = len(poses_g)
    reading = poses_g.reading
    noise = believable(poses_g.noise)
    noise = np.ones_like(reading) if noise is None else noise
    some = everyone = np.arange(count)
    if count > _ENOUGH:
        some = np.sort(np.random.default_rng(count).choice(count, _ENOUGH, replace=False))
    few, left = len(some), len(some) - max(most * len(some) // count, 1)
    if comb(few, left) <= _MOST_SUBSETS:
        subsets = np.array([*combinations(range(few), left)])
    else:
        left = min(len(parameter_names(MODELS[name].effects)) + _SPARE, left)
        drawn = np.random.default_rng(few).random((_MOST_SUBSETS, few))
        subsets = np.argpartition(drawn, left - 1, axis=1)[:, :left]
    nearest = some[subsets]
    for tried in (some, *[everyone] * _CONCENTRATIONS):
        best: list[tuple[float, Indices]] = []
        kept, at_once = len(tried) - most * len(tried) // count, max(_DISTANCES // len(tried), 1)
        for first in range(0, len(nearest), at_once):
            mat_w, vec_v = closed_form(name, reading[nearest[first:first + at_once]])
            sound = (np.isfinite(mat_w).all(axis=(1, 2)) & (np.abs(np.linalg.det(mat_w)) > 0.0)
                     )[:, np.newaxis]
            inverse = np.linalg.inv(np.where(sound[..., np.newaxis], mat_w, _IDENTITY))
            u = (reading[tried] - vec_v[:, np.newaxis]) @ np.swapaxes(inverse, 1, 2)
            length = np.linalg.norm(u, axis=2)
            along = (u / length[:, :, np.newaxis]) @ inverse
            squared = (length - 1.0) ** 2 / np.sum((along * noise[tried]) ** 2, axis=2)
            squared = np.where(sound & np.isfinite(squared), squared, np.inf)
            inside = np.argpartition(squared, kept - 1, axis=1)[:, :kept]
            trimmed = np.take_along_axis(squared, inside, axis=1).sum(axis=1)
            best = sorted([*best, *zip(trimmed.tolist(), tried[inside])], key=itemgetter(0))[:10]
        nearest = np.array([inside for _, inside in best])
    return np.sort(nearest[0])


def fit_12(reading: Floats, reference: Floats) -> tuple[Floats, Floats]:
    """
    Fit m = X a + y to poses of known orientation (ESGI'95 report, section 3).

    Return X (3, 3) and y (3,) from (n, 3) readings m in any unit and the (n, 3) true specific
    force a. Raise `RefusedFitError` if the known forces all lie in a plane.

    """
    design = np.column_stack([reference, np.ones(len(reference))])
    solution, _, rank, _ = np.linalg.lstsq(design, reading, rcond=1e-6)
    if rank < 4:
        raise RefusedFitError(f'the known forces of {counted(len(reading), "pose")} lie in a '
                              'plane, expected three dimensions', TAKE_ALL_SIDES)
    return solution[:3].T, solution[3]


def faces(reading: Floats) -> Floats | None:
    """Return the (n, 3) unit vectors of up if poses are exactly the six faces; otherwise None."""
    centre = (reading.max(axis=0) + reading.min(axis=0)) / 2.0
    r = reading - centre
    axis = np.argmax(np.abs(r), axis=1)
    along = np.take_along_axis(r, axis[:, np.newaxis], axis=1)[:, 0]
    reference = np.eye(3)[axis] * np.sign(along)[:, np.newaxis]
    aligned = np.all(np.abs(along) >= _FACE_COSINE * np.linalg.norm(r, axis=1))
    return reference if aligned and len(np.unique(reference, axis=0)) == 6 else None


TIES = np.column_stack([
    *(linear_model('9', _IDENTITY, vec_v).vector for vec_v in _IDENTITY),
    *(linear_model('9', _IDENTITY + np.outer(_IDENTITY[i], _IDENTITY[j]), np.zeros(3)).vector
      for i, j in ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1)))])
"""The (12, 9) matrix from offset and lower triangle of W to the values of model 9."""


@dataclass(frozen=True)
class SensingAxes:
    """
    The nine parameters of the ESGI'95 report.

    `shifts` are s (3,) in the unit of the readings, `scales` b > 0 (3,) in this unit per unit of
    force, and `phi`, `psi` and `theta` the angles [rad].

    """

    shifts: Floats
    scales: Floats
    phi: float
    psi: float
    theta: float


def sensing_axes(mat_w: Floats, vec_v: Floats) -> SensingAxes:
    """Return shifts, scales and angles of W (3, 3) and V (3,), for W in any axes."""
    scales = np.linalg.norm(mat_w, axis=1)
    cosines = (mat_w @ mat_w.T) / np.outer(scales, scales)
    phi, psi, theta = np.arccos(np.clip(cosines[[0, 0, 1], [1, 2, 2]], -1.0, 1.0))
    return SensingAxes(np.array(vec_v), scales, float(phi), float(psi), float(theta))
