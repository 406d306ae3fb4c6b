# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The equations that poses of known, shared or unknown orientation impose on the values of a model.

A model allows each pose a set of readings. For a known orientation this set is a point. If only
|force| = 1 g is known, it is the image of the unit sphere, nearly an ellipsoid. The residual of a
pose is the distance of its reading from this set, in units of the noise:

- known orientation: (reading - predict(reference)) / s, three equations;
- only |force| = 1 g known: (|u| - 1) / σ, with u the force computed from the reading, A the slope
  of the reading, a = A⁻ᵀû and σ² = Σ_j a_j² s_j². To first order this is the distance from the
  surface along its normal. Without the division by σ, the sum of squares would be zero for W → ∞;
- shared unknown orientation: (reading - predict(d)) / s for the common direction d, minus the part
  that a rotation of d explains.

The equations are linear in small changes k of the values,

    residual = columns · k + noise of variance 1

with the exact derivative. A value that adds B(u) to the reading changes (|u| - 1) / σ by

    -[ (a - e h)·B(u) - e a·B'(u)g ] / σ,
    e = |u| - 1,  g = A⁻¹ N a / σ²,  h = A⁻ᵀ(I - ûûᵀ)g / |u|

where N is the covariance of the reading, and B'(u)g is the derivative of B along g. (The change of
A with u, by bending terms, and B' of own effects are neglected: they are of the order of e times
these terms.)

**Copies.** Rows of a table that are one measurement, entered several times, count as one pose.
As separate poses, they would make the noise seem smaller than it is, and the other poses would
look like outliers. Two rests in the same orientation are no copies: by chance, only one pair in
5000 differs by less than `_ALIKE` of the noise on all axes.

**Noise.** The variance of a residual is λ times the variance predicted by the noise of its pose.
Either the noise is correct and λ = 1, or poses repeat worse or better than their samples predict,
with log λ uniformly distributed from log 0.01 to log 10⁴. The residuals decide between both
(Bayes' rule with the likelihood λ^(-dof/2) exp(-chi²/2λ)). The distribution of a parameter is then
a mixture of normal distributions, and its stated variance is such that ±1.96 standard deviations
contain 95 % of it. If the noise was not measured, λ is estimated from the residuals alone, and the
mixture is Student's t. Without degrees of freedom, the noise of a common sensor is assumed.

In tests the measured noise counts as a number of degrees of freedom (moderated variance, Smyth
2004).

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy

from ..effects import Context, EachShape, EffectKey, Model, terms_of, times
from ..geometry import unit
from ..statistics import NORMAL_95, over_axes, STATED_NOISE
from ..table import Poses
from ..units import Floats, Indices

_BLOCK = 8192
"""Number of poses per block; their equations fit in the cache."""

USUAL_NOISE_G = 5e-4
"""Noise of a pose mean of a common MEMS sensor, assumed if it was not measured [g]."""

_NO_NOISE_G = 1e-9
"""Noise below this counts as no noise [g]."""

_LEAST_NOISE = 0.1
"""Smallest noise of a pose, relative to the median over the poses."""

_ALIKE = 0.1
"""Largest difference between the readings of copies, relative to the noise of a pose. Differences
up to half of it always count as none."""

_EQUAL_G = 1e-7
"""The same if the noise is not known [g]."""

_DECIMALS = 7
"""Number of decimals in which the context of copies is equal."""

_OF_READING = ('reading', 'std', 'count', 'label')
"""Columns that are not context."""

_TURNS = 5
_STRAIGHT = 1e-9
"""Most turns of a common direction, and the turn at which it is found [rad]."""

_BELIEF = 8.0
_BELIEF_IN_USUAL = 3.0
"""Degrees of freedom in a test that measured noise, and assumed noise, count as."""

_INTERVAL = 0.95
_SCALES = np.logspace(-2.0, 4.0, 121)
_ONE = 40
"""Values of λ; index of λ = 1."""

_BEYOND = 1e3
"""chi² per degree of freedom above which the measured noise is ignored."""

_DOUBT_BELOW = 0.01
"""Probability of the chi² of the poses left below which they contradict the measured noise."""

_DOUBTED = 1.0
"""Degrees of freedom that contradicted noise counts as."""


def believable(noise: Floats | None) -> Floats | None:
    """Return the (n, 3) noise of means [g], raised where far too low; None if unknown or 0."""
    if noise is None or not len(noise):
        return None
    median = np.median(noise)
    return np.maximum(noise, _LEAST_NOISE * median) if median > _NO_NOISE_G else None


def pose_noise(noise: Floats | None, directions: Floats) -> Floats | None:
    """Return the (n,) noise of |reading| from the (n, 3) noise of means; None if unknown."""
    believed = believable(noise) if len(directions) else None
    if believed is None:
        return None
    along = np.linalg.norm(directions * believed, axis=1)
    median = np.median(along)
    return np.maximum(along, _LEAST_NOISE * median) if median > 0.0 else None


def originals(poses_g: Poses) -> Indices:
    """Return the (n,) index of the first pose that each pose, with its context, is a copy of."""
    reading, noise = poses_g.reading, believable(poses_g.noise)
    found = np.arange(len(reading))
    cell = max(_EQUAL_G, 0.0 if noise is None else _ALIKE * float(np.median(noise)))
    place = reading / cell
    if np.all(np.diff(np.sort(place[:, 0])) > 1.0):
        return found
    context = [values.round(_DECIMALS) for key, values in poses_g.columns.items()
               if key not in _OF_READING]
    # Two readings half a cell apart are in the same cell of at least one of these grids.
    for shift in product((0.0, 0.5), repeat=3):
        rows = np.column_stack([np.floor(place + shift), *context])
        order = np.lexsort(rows.T)
        is_new = np.any(np.diff(rows[order], axis=0, prepend=np.nan) != 0.0, axis=1)
        first = np.minimum.reduceat(order, np.flatnonzero(is_new))
        found[order] = np.minimum(found[order], first[np.cumsum(is_new) - 1])
    return found[found]


def kinds(poses: Poses) -> tuple[Indices, list[Indices], Indices]:
    """
    Return the indices of poses by kind of orientation: known, shared, unknown.

    Those of shared orientation are a list of groups.

    """
    everyone, columns = np.arange(len(poses.row)), poses.columns
    if 'reference' in columns:
        return everyone, [], everyone[:0]
    if 'orientation' not in columns:
        return everyone[:0], [], everyone
    _, group, size = np.unique(columns['orientation'], return_inverse=True, return_counts=True)
    order = np.argsort(group, kind='stable')
    groups = np.split(order, np.cumsum(size)[:-1])
    return (everyone[:0], [each for each in groups if len(each) > 1],
            np.array([each[0] for each in groups if len(each) == 1], np.intp))


class _Kind(NamedTuple):
    """Poses of one kind: index, group if shared, context, reading and noise s of means [g]."""

    which: Indices
    group: Indices
    context: Context
    reading: Floats
    s: Floats


@dataclass(frozen=True)
class Measured:
    """
    Poses in g by kind of orientation, those of unknown orientation in blocks; see `measured`.

    `parts` are the poses of each kind, with the class of their equations. `unknown` is the number
    of unknown angles of shared orientations.

    """

    parts: tuple[tuple[type[_Known | _Shared | _Alone], _Kind], ...]
    count: int
    unknown: int
    noise_known: bool


def measured(poses_g: Poses) -> Measured:
    """Return poses in g as the equations use them, without the noise that is not believable."""
    reading, noise = poses_g.reading, believable(poses_g.noise)
    s = np.full(reading.shape, USUAL_NOISE_G) if noise is None else noise
    known, shared, alone = kinds(poses_g)
    # The context of a pose can be that of the others, too: a low pass has a history.
    size = _BLOCK if {*poses_g.columns} <= {*_OF_READING} else max(len(alone), 1)
    by_kind: list[tuple[type[_Known | _Shared | _Alone], list[Indices]]] = [
        (_Known, [known]), (_Shared, shared), *(
            (_Alone, [alone[first:first + size]]) for first in range(0, len(alone), size))]
    parts = []
    for of, groups in by_kind:
        which = np.concatenate([known[:0], *groups])
        group = np.repeat(np.arange(len(groups)), [len(each) for each in groups])
        if len(which) and np.array_equal(which, np.arange(len(s))):
            parts.append((of, _Kind(which, group, poses_g.columns, reading, s)))
        elif len(which):
            context = {key: values[which] for key, values in poses_g.columns.items()}
            parts.append((of, _Kind(which, group, context, reading[which], s[which])))
    return Measured(tuple(parts), len(s), 2 * len(shared), noise is not None)


@dataclass(frozen=True)
class Equations:
    """
    The equations of poses near a model.

    Parameters
    ----------
    parts : tuple
        Equations of each kind of pose, in units of the noise.
    force : (n, 3) array
        u of each pose; a unit vector where the orientation is not known [g].
    scale : (n,) array
        Noise of each pose in its equations [g].
    count : int
        Number of independent equations.
    noise_known : bool
        Whether the noise was measured; otherwise the noise of all poses is `USUAL_NOISE_G`.
    residual : (m,) array
        Residuals in units of the noise.
    pose : (m,) array of int
        Index of the pose that each equation belongs to.

    """

    parts: tuple[_Known | _Shared | _Alone, ...]
    force: Floats
    scale: Floats
    count: int
    noise_known: bool
    residual: Floats
    pose: Indices

    def columns(self, model: Model) -> Floats:
        """Return the (m, p) derivative of the prediction by the values of a model, per noise."""
        return np.concatenate([part.columns(model) for part in self.parts])

    def columns_of(self, effect: EffectKey, factors: Floats) -> Floats:
        """Return the (m, s p) derivative for s shapes; factors as from `effects.factors_of`."""
        return np.concatenate([part.columns(EachShape(terms_of((effect,)), (
            factors if factors.shape[2] == 1 else factors[:, :, part.which])))
            for part in self.parts])

    def of_poses(self, residual: Floats) -> Floats:
        """Return the (n,) residuals of poses [g]: signed for one equation each, else RMS."""
        sizes = residual * self.scale[self.pose]
        if len(sizes) == len(self.scale):
            return np.bincount(self.pose, sizes).astype(float)
        return np.sqrt(np.bincount(self.pose, sizes ** 2, len(self.scale)))


def equations(model: Model, poses: Measured) -> Equations:
    """Set up the equations near a model with ΔR = I; NaN where a reading's force is not unique."""
    parts = tuple(of(model, kind) for of, kind in poses.parts)
    force, scale = np.empty((poses.count, 3)), np.empty(poses.count)
    for part in parts:
        force[part.which], scale[part.which] = part.force, part.scale
    residual = np.concatenate([part.residual for part in parts])
    return Equations(
        parts=parts, force=force, scale=scale, count=len(residual) - poses.unknown,
        noise_known=poses.noise_known, residual=residual,
        pose=np.concatenate([part.pose for part in parts]))


class _Alone:
    """Equations of poses of which only |force| = 1 g is known; symbols as in the module."""

    def __init__(self, model: Model, poses: _Kind) -> None:
        self.which = self.pose = poses.which
        self._context = poses.context
        here = model.at(self._context)
        u = here.force(poses.reading)
        length = np.sqrt(np.sum(u * u, axis=1))[:, np.newaxis]
        self.force = u / length
        inverse = here.inverse_slope(u)
        transposed = inverse.swapaxes(-1, -2)
        a = times(transposed, self.force)
        spread = a * poses.s ** 2
        variance = np.sum(a * spread, axis=1)[:, np.newaxis]
        g = times(inverse, spread / variance)
        across = g - self.force * np.sum(self.force * g, axis=1)[:, np.newaxis]
        h = times(transposed, across / length)
        e = length - 1.0
        self.scale = np.sqrt(variance[:, 0])
        self.residual = e[:, 0] / self.scale
        weighted = a / self.scale[:, np.newaxis]
        self._rows = weighted - self.residual[:, np.newaxis] * h
        self._rows_along = weighted * e
        self._at, self._along = u, g

    def columns(self, model: Model | EachShape) -> Floats:
        terms, axis = model.terms, model.terms.axis
        plain = terms.plain(self._at) * self._rows.T[axis]
        plain -= terms.plain(self._at, self._along) * self._rows_along.T[axis]
        return model.basis_of(plain, self._context, self._at).summed


class _Known:
    """Equations of poses of known orientation."""

    def __init__(self, model: Model, poses: _Kind) -> None:
        self._sigma, self._context = poses.s.ravel(), poses.context
        self.which, self.pose = poses.which, np.repeat(poses.which, 3)
        self.force, self.scale = poses.context['reference'], over_axes(poses.s)
        reading = model.at(self._context).reading(self.force)
        self.residual = (poses.reading - reading).ravel() / self._sigma

    def columns(self, model: Model | EachShape) -> Floats:
        basis = model.basis_of(model.terms.plain(self.force), self._context, self.force).full
        return basis.reshape(len(self._sigma), basis.shape[2]) / self._sigma[:, np.newaxis]


class _Shared:
    """
    Equations of poses in groups with a common unknown orientation.

    A rotation of the common direction changes the readings of a group by T = A [t1 t2] per noise,
    with two tangents t. The direction is rotated until the residuals have no part in the span of
    T, so that the derivative is exact; the part of the derivative in this span is projected out.

    """

    def __init__(self, model: Model, poses: _Kind) -> None:
        self._sigma, self._context, self._group = poses.s, poses.context, poses.group
        self._starts = np.flatnonzero(np.diff(poses.group, prepend=-1))
        self.which, self.pose = poses.which, np.repeat(poses.which, 3)
        self.scale = over_axes(poses.s)
        here = model.at(self._context)
        self.force = unit(np.add.reduceat(here.force(poses.reading), self._starts))[self._group]
        for turns in range(_TURNS + 1):
            first = unit(np.cross(self.force, np.eye(3)[np.argmin(np.abs(self.force), axis=1)]))
            tangents = np.stack([first, np.cross(self.force, first)], axis=2)
            self._turn = here.slope(self.force) @ tangents / self._sigma[:, :, np.newaxis]
            self._normal = np.linalg.inv(np.add.reduceat(
                np.swapaxes(self._turn, 1, 2) @ self._turn, self._starts))
            off = (poses.reading - here.reading(self.force)) / self._sigma
            turn = self._part_of_turns(off[:, :, np.newaxis])
            if turns == _TURNS or np.max(np.abs(turn)) < _STRAIGHT:
                break
            self.force = unit(self.force + (tangents @ turn)[:, :, 0])
        self.residual = off.ravel() - (self._turn @ turn).ravel()

    def _part_of_turns(self, rows: Floats) -> Floats:
        """Return the (n, 2, p) turns of the directions that explain (n, 3, p) rows best."""
        summed = np.add.reduceat(np.swapaxes(self._turn, 1, 2) @ rows, self._starts)
        return (self._normal @ summed)[self._group]

    def columns(self, model: Model | EachShape) -> Floats:
        basis = model.basis_of(model.terms.plain(self.force), self._context, self.force).full
        rows = basis / self._sigma[:, :, np.newaxis]
        rows = rows - self._turn @ self._part_of_turns(rows)
        return rows.reshape(len(self.pose), basis.shape[2])


def belief_in(noise_known: bool, dof: int = 0, chi2: float = 0.0) -> float:
    """Return the degrees of freedom that the noise counts as, given the chi² of the poses kept."""
    if noise_known and scipy.special.chdtrc(max(dof, 1), chi2) < _DOUBT_BELOW:
        return _DOUBTED
    return _BELIEF if noise_known else _BELIEF_IN_USUAL


@cache
def _grid() -> tuple[Floats, Floats]:
    """Return (k,) half widths, and the (m, k) part of N(0, λ) within each of them."""
    width = np.geomspace(0.15, 250.0, 141)
    return width, 2.0 * scipy.special.ndtr(width / np.sqrt(_SCALES)[:, np.newaxis]) - 1.0


def variance_factor(chi2: float, dof: int, noise_known: bool) -> float:
    """
    Return the ratio of the stated variance to the variance predicted by the noise.

    `chi2` is the sum of the squared residuals in units of the noise, or of `USUAL_NOISE_G` if not
    `noise_known`, and `dof` the number of equations minus that of free values.

    """
    if noise_known and dof <= 0:
        return 1.0
    if not noise_known or chi2 > _BEYOND * dof:  # Student's t
        scale, freedom = (chi2 / dof, float(dof)) if dof > 0 else (1.0, _BELIEF_IN_USUAL)
        limit = float(scipy.special.stdtrit(freedom, 0.5 + _INTERVAL / 2.0))
        return scale * (limit / NORMAL_95) ** 2
    # The measured noise may be correct: a mixture over λ, with a share of `STATED_NOISE` at 1.
    width, within = _grid()
    likelihood = (chi2 * (1.0 - 1.0 / _SCALES) - dof * np.log(_SCALES)) / 2.0
    largest = np.max(likelihood)
    weight = np.exp(likelihood - largest) * (1.0 - STATED_NOISE)
    weight[_ONE] += STATED_NOISE * len(_SCALES) * np.exp(-largest)
    part = (weight / np.sum(weight)) @ within
    between = np.exp(np.interp(_INTERVAL, part, np.log(width)))
    return float(between / NORMAL_95) ** 2
