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
m/s², without a loss of digits. Leading axes of all arrays are sensors.

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
rotated (`lower_triangular`). `TIES` maps its nine parameters to the twelve values of the model.

**Step.** With A = W⁻², b = A V and k = VᵀA V, |W⁻¹ (reading - V)| = 1 of model 10 is

    readingᵀ A' reading - 2 b'ᵀ reading = 1,   A' = A / (1 - k),  b' = b / (1 - k)

which is linear in A' and b'. In V and W it is not. Precise poses that do not determine all values
leave a thin curved sheet of them, on which a straight step is only short. A step that is straight
in A' and b' stays on the sheet.

"""

from dataclasses import dataclass
from functools import cached_property
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

_IDENTITY, _ONES, _COLUMN = np.eye(3), np.ones(3), np.ones((3, 1))


@dataclass(frozen=True)
class Form:
    """The monomials r_i r_j of a quadric: (k,) arrays of i and j; pairs with i = j are first."""

    first: Indices
    second: Indices

    @cached_property
    def pairs(self) -> Indices:
        """(2 k,) array, all i, then all j."""
        return np.concatenate([self.first, self.second])

    @cached_property
    def twice(self) -> Floats:
        """(k,) array, how often each monomial occurs in rᵀ A r."""
        return np.where(self.first == self.second, 1.0, 2.0)

    @cached_property
    def linear(self) -> Floats:
        """(3, 3 k) array, the part linear in r when the origin moves by c."""
        return 2.0 * self.scatter.reshape(-1, 3, 3).transpose(1, 2, 0).reshape(3, -1)

    @cached_property
    def scatter(self) -> Floats:
        """(k, 9) array, maps the coefficients to the entries of A."""
        entries = np.zeros((len(self.twice), 3, 3))
        each = np.arange(len(self.twice))
        entries[each, self.first, self.second] = entries[each, self.second, self.first] = 1.0
        return entries.reshape(-1, 9)


DIAGONAL = Form(np.array([0, 1, 2]), np.array([0, 1, 2]))
SYMMETRIC = Form(np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2]))


def centred(reading: Floats) -> tuple[Floats, Floats]:
    """Return the (..., 3) mean, and the (..., 3, n) readings minus the mean."""
    transposed = reading.swapaxes(-1, -2)
    mean = transposed.sum(axis=-1) / reading.shape[-2]
    return mean, transposed - mean[..., np.newaxis]


def sphere_of(second: Floats, third: Floats, count: int) -> tuple[Floats, Floats]:
    """
    Return centre (..., 3) and radius (...) of the sphere through n readings r minus their mean.

    It solves the sums over the poses of |r|² = 2 V·r + (W² - |V|²), times r and 1, from the sums
    `second` of r rᵀ, (..., 3, 3), and `third` of |r|² r, (..., 3).

    """
    trace = second[..., 0, 0] + second[..., 1, 1] + second[..., 2, 2]
    ridge = (_RIDGE * trace + 1e-300)[..., np.newaxis, np.newaxis] * _IDENTITY
    centre = np.linalg.solve(second + ridge, third[..., np.newaxis])[..., 0] / 2.0
    squared = trace / count + (centre * centre) @ _ONES
    return centre, np.sqrt(squared + (squared == 0.0))


def _moments(form: Form, r: Floats) -> Floats:
    """Sum the products of the monomials, r and 1 over the poses; r is (..., 3, n)."""
    size = len(form.twice)
    monomials = np.ones((*r.shape[:-2], size + 4, r.shape[-1]))
    monomials[..., size:-1, :] = r
    pairs = r[..., form.pairs, :]
    np.multiply(pairs[..., :size, :], pairs[..., size:, :], out=monomials[..., :size, :])
    return monomials @ monomials.swapaxes(-1, -2)


def _to_sphere(form: Form, centre: Floats, radius: Floats) -> Floats:
    """Return the matrix from monomials of r to those of (r - centre) / radius, times `twice`."""
    size, lead = len(form.twice), centre.shape[:-1]
    change = np.zeros((*lead, size + 4, size + 4))
    diagonal = change.reshape(*lead, -1)[..., ::size + 5]
    moved, twice = centre / -radius, form.twice / (radius * radius)
    diagonal[..., :size] = twice
    diagonal[..., size:] = 1.0 / radius
    change[..., size:-1, :size] = ((moved / radius) @ form.linear).reshape(*lead, 3, size)
    pairs = moved[..., form.pairs]
    change[..., -1, :size] = form.twice * pairs[..., :size] * pairs[..., size:]
    change[..., -1, size:-1] = moved
    change[..., -1, -1] = 1.0
    return change


def _ellipsoid(form: Form, beta: Floats) -> tuple[Floats, Floats]:
    """Return W and V of the quadric with these coefficients; NaN where it is no ellipsoid."""
    size = len(form.twice)
    mat_a = (beta[..., :size] @ form.scatter).reshape(*beta.shape[:-1], 3, 3)
    values, vectors = np.linalg.eigh(mat_a)
    sign = np.copysign(1.0, values[..., 1:2])  # AN5286: negate the whole vector
    with np.errstate(invalid='ignore', divide='ignore'):
        along = (beta[..., np.newaxis, size:-1] @ vectors)[..., 0, :] / (-2.0 * values)
        values = values * sign
        field_squared = (along * along * values) @ _COLUMN - beta[..., -1:] * sign  # B²
        gain = np.sqrt(field_squared / values)  # the middle value is positive: NaN where B² is not
        mat_w = (vectors * gain[..., np.newaxis, :]) @ vectors.swapaxes(-1, -2)
        return mat_w, (vectors @ along[..., np.newaxis])[..., 0]


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
    gains = MODELS[name].gains
    if gains == 1:
        return fit_sphere(reading)
    form = DIAGONAL if gains == 3 else SYMMETRIC
    mean, r = centred(reading)
    size = len(form.twice)
    moments = _moments(form, r[..., :_BLOCK])
    for start in range(_BLOCK, r.shape[-1], _BLOCK):
        moments = moments + _moments(form, r[..., start:start + _BLOCK])
    centre, radius = sphere_of(moments[..., size:-1, size:-1],
                               _ONES @ moments[..., :3, size:-1], r.shape[-1])
    radius = radius[..., np.newaxis]
    change = _to_sphere(form, centre, radius)
    beta = np.linalg.eigh(change.swapaxes(-1, -2) @ moments @ change)[1][..., 0]
    mat_w, offset = _ellipsoid(form, beta)
    return mat_w * radius[..., np.newaxis], mean + centre + offset * radius


def fit_sphere(reading: Floats) -> tuple[Floats, Floats]:
    """Fit an offset and one gain (AN5286 eq. 10-14); arguments and result as `closed_form`."""
    mean, r = centred(reading)
    third = (r @ np.sum(r * r, axis=-2)[..., np.newaxis])[..., 0]
    centre, radius = sphere_of(r @ r.swapaxes(-1, -2), third, r.shape[-1])
    return radius[..., np.newaxis, np.newaxis] * _IDENTITY, mean + centre


def start_of(name: str, reading: Floats) -> Model:
    """Return start values by the closed form; a sphere if the poses are not on an ellipsoid."""
    mat_w, vec_v = closed_form(name, reading)
    if not np.all(np.isfinite(mat_w)):
        mat_w, vec_v = closed_form('4', reading)
    return linear_model(name, mat_w, vec_v)


def agreeing(name: str, poses_g: Poses, most: int) -> Indices:
    """Return the indices of all poses but `most`, selected so that they agree best."""
    count = len(poses_g)
    reading = poses_g.reading
    noise = believable(poses_g.noise)
    noise = np.ones_like(reading) if noise is None else noise
    some = everyone = np.arange(count)
    if count > _ENOUGH:
        some = np.sort(np.random.default_rng(count).choice(count, _ENOUGH, replace=False))
    nearest = some[_subsets(len(some), max(most * len(some) // count, 1),
                            len(parameter_names(MODELS[name].effects)))]
    for tried in (some, *[everyone] * _CONCENTRATIONS):
        best: list[tuple[float, Indices]] = []
        kept, at_once = len(tried) - most * len(tried) // count, max(_DISTANCES // len(tried), 1)
        for first in range(0, len(nearest), at_once):
            squared = _squared_distances(name, reading, nearest[first:first + at_once], tried,
                                         noise)
            inside = np.argpartition(squared, kept - 1, axis=1)[:, :kept]
            trimmed = np.take_along_axis(squared, inside, axis=1).sum(axis=1)
            best = sorted([*best, *zip(trimmed.tolist(), tried[inside])], key=itemgetter(0))[:10]
        nearest = np.array([inside for _, inside in best])
    return np.sort(nearest[0])


def _subsets(count: int, most: int, free: int) -> Indices:
    """Return all subsets of count - most poses, or `_MOST_SUBSETS` random subsets."""
    if comb(count, most) <= _MOST_SUBSETS:
        out = np.array(list(combinations(range(count), most)))
        inside = np.ones((len(out), count), bool)
        np.put_along_axis(inside, out, False, axis=1)
        return np.nonzero(inside)[1].reshape(len(out), -1)
    size = min(free + _SPARE, count - most)
    rng = np.random.default_rng(count)
    parts = np.array_split(np.arange(_MOST_SUBSETS), -(-_MOST_SUBSETS * count // _DISTANCES))
    return np.concatenate([np.argpartition(rng.random((len(part), count)), size - 1, axis=1)[
        :, :size] for part in parts])


def _squared_distances(name: str, reading: Floats, subsets: Indices, tried: Indices,
                       noise: Floats) -> Floats:
    """Return the (s, t) squared distances of tried poses from the closed form of each subset."""
    with np.errstate(all='ignore'):  # some subsets are not on an ellipsoid, or are in a plane
        mat_w, vec_v = closed_form(name, reading[subsets])
        sound = np.isfinite(mat_w).all(axis=(1, 2)) & (np.abs(np.linalg.det(mat_w)) > 0.0)
        inverse = np.linalg.inv(np.where(sound[:, np.newaxis, np.newaxis], mat_w, np.eye(3)))
        u = (reading[tried] - vec_v[:, np.newaxis]) @ np.swapaxes(inverse, 1, 2)
        length = np.linalg.norm(u, axis=2)
        along = (u / length[:, :, np.newaxis]) @ inverse
        squared = (length - 1.0) ** 2 / np.sum((along * noise[tried]) ** 2, axis=2)
    return np.where(sound[:, np.newaxis] & np.isfinite(squared), squared, np.inf)


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


def lower_triangular(mat_w: Floats) -> Floats:
    """Rotate the axes of W (3, 3), so that it is lower triangular with a positive diagonal."""
    return np.linalg.cholesky(mat_w @ mat_w.T)
