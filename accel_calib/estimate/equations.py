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
A with u, by bending terms, is neglected: it is of the order of e times these terms.)

**Noise.** Weight of the measured noise of poses against the residuals of a fit.

The variance of a residual is λ times the variance predicted by the noise of its pose. Either the
noise is correct and λ = 1, or poses repeat worse or better than their samples predict. Then log λ
is uniformly distributed from log 0.01 to log 10⁴. The residuals decide between both (Bayes' rule
with the likelihood λ^(-dof/2) exp(-chi²/2λ)). The distribution of a parameter is then a mixture of
normal distributions. Its stated variance is chosen so that ±1.96 standard deviations contain 95 %
of the mixture. If the noise was not measured, λ is estimated from the residuals alone, and the
mixture is Student's t. If there are no degrees of freedom either, the noise of a common sensor is
assumed.

In tests the measured noise counts as a number of degrees of freedom (moderated variance, Smyth
2004).

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..effects import AtContext, Context, Model, times
from ..geometry import unit
from ..table import Floats, Poses

USUAL_NOISE_G = 5e-4
"""Noise of a pose mean of a common MEMS sensor, assumed if it was not measured [g]."""

_NO_NOISE_G = 1e-9
"""Noise below this counts as no noise [g]."""

LEAST_NOISE = 0.1
"""Smallest noise of a pose, relative to the median over the poses."""

_BELIEF = 8.0
_BELIEF_IN_USUAL = 3.0
"""Degrees of freedom in a test that measured noise, and assumed noise, count as."""

_RIGHT = 0.7
"""Prior probability that the measured noise is correct."""

_INTERVAL = 0.95
_NORMAL = 1.959964
_SCALES = np.logspace(-2.0, 4.0, 121)
_ONE = 40
"""Values of λ; index of λ = 1."""

_BEYOND = 1e3
"""chi² per degree of freedom above which the measured noise is ignored."""


def believable(noise: Floats | None) -> Floats | None:
    """
    Return the noise of poses, raised where it is far below that of the other poses.

    Parameters
    ----------
    noise : (n, 3) array or None
        Standard deviation of pose means [g].

    Returns
    -------
    (n, 3) array or None
        None if the noise is not known, or is zero for most poses.

    """
    if noise is None or not len(noise):
        return None
    median = np.median(noise)
    return np.maximum(noise, LEAST_NOISE * median) if median > _NO_NOISE_G else None


def belief_in(noise_known: bool) -> float:
    """Return the degrees of freedom that the noise counts as in a test."""
    return _BELIEF if noise_known else _BELIEF_IN_USUAL


@cache
def _grid() -> tuple[Floats, Floats]:
    """Return (k,) half widths, and the (m, k) part of N(0, λ) within each of them."""
    from scipy.special import ndtr

    width = np.geomspace(0.15, 250.0, 141)
    return width, 2.0 * ndtr(width / np.sqrt(_SCALES)[:, np.newaxis]) - 1.0


def variance_factor(chi2: float, dof: int, noise_known: bool) -> float:
    """
    Return the ratio of the stated variance to the variance predicted by the noise.

    Parameters
    ----------
    chi2 : float
        Sum of the squared residuals in units of the noise.
    dof : int
        Number of equations minus number of free values.
    noise_known : bool
        Whether the noise was measured; otherwise the unit of `chi2` is `USUAL_NOISE_G`.

    """
    if dof <= 0:
        return 1.0 if noise_known else _student(_BELIEF_IN_USUAL)
    if not noise_known or chi2 > _BEYOND * dof:
        return chi2 / dof * _student(dof)
    return _of_mixture(chi2, dof)


def _student(dof: float) -> float:
    """Return the squared ratio of the 95 % intervals of Student's t and a normal variable."""
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.5 + _INTERVAL / 2.0) / _NORMAL) ** 2


def _of_mixture(chi2: float, dof: int) -> float:
    """Return the factor for measured noise, which may be correct."""
    width, held = _grid()
    likelihood = (chi2 * (1.0 - 1.0 / _SCALES) - dof * np.log(_SCALES)) / 2.0
    largest = np.max(likelihood)
    weight = np.exp(likelihood - largest) * (1.0 - _RIGHT)
    weight[_ONE] += _RIGHT * len(_SCALES) * np.exp(-largest)
    part = (weight / np.sum(weight)) @ held
    above = int(np.argmax(part >= _INTERVAL))
    share = (_INTERVAL - part[above - 1]) / (part[above] - part[above - 1])
    between = width[above - 1] * (width[above] / width[above - 1]) ** share
    return float(between / _NORMAL) ** 2


Indices = NDArray[np.intp]


_TURNS = 5
_STRAIGHT = 1e-9
"""Most turns of a common direction, and the turn at which it is found [rad]."""


class _Part(Protocol):
    """The equations of poses of one kind."""

    residual: Any
    pose: Indices

    def columns(self, model: Model) -> Floats:
        """Return the (m, p) derivative of the prediction by the values of a model."""


@dataclass(frozen=True)
class Equations:
    """
    The equations of poses near a model.

    Parameters
    ----------
    parts : tuple
        Equations of each kind of pose.
    force : (n, 3) array
        u of each pose; a unit vector where the orientation is not known [g].
    scale : (n,) array
        Noise of each pose in its equations [g].
    count : int
        Number of independent equations.
    noise_known : bool
        Whether the noise was measured; otherwise the noise of all poses is `USUAL_NOISE_G`.

    """

    parts: tuple[_Part, ...]
    force: Floats
    scale: Floats
    count: int
    noise_known: bool

    @property
    def residual(self) -> Floats:
        """(m,) array, the residuals in units of the noise."""
        return _joined([part.residual for part in self.parts])

    @property
    def pose(self) -> Indices:
        """(m,) array, index of the pose that each equation belongs to."""
        return _joined([part.pose for part in self.parts])

    def columns(self, model: Model) -> Floats:
        """Return the (m, p) derivative of the prediction by the values of a model, per noise."""
        return _joined([part.columns(model) for part in self.parts])

    def of_poses(self, residual: Floats) -> Floats:
        """Return the (n,) residuals of poses [g]: signed for one equation each, else RMS."""
        sizes = residual * self.scale[self.pose]
        if len(sizes) == len(self.scale):
            signed = np.zeros(len(self.scale))
            signed[self.pose] = sizes
            return signed
        return np.sqrt(np.bincount(self.pose, sizes ** 2, len(self.scale)))


def _joined(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def noise_of(poses_g: Poses) -> Floats | None:
    """Return the believable (n, 3) noise of the pose means [g]; None if it is not known."""
    return believable(poses_g.noise)


def kinds(poses: Poses) -> tuple[Indices, list[Indices], Indices]:
    """
    Return the indices of poses of known, shared and unknown orientation.

    Returns
    -------
    (a,) array, list of arrays, (c,) array
        Poses of known orientation, groups of poses with the same orientation, and poses of which
        only |force| = 1 g is known.

    """
    everyone = np.arange(len(poses))
    if 'reference' in poses:
        return everyone, [], everyone[:0]
    if 'orientation' not in poses:
        return everyone[:0], [], everyone
    _, group, size = np.unique(poses['orientation'], return_inverse=True, return_counts=True)
    order = np.argsort(group, kind='stable')
    groups = np.split(order, np.cumsum(size)[:-1])
    return (everyone[:0], [each for each in groups if len(each) > 1],
            np.array([each[0] for each in groups if len(each) == 1], np.intp))


def equations(model: Model, poses_g: Poses, noise: Floats | None) -> Equations:
    """
    Set up the equations of poses near a model.

    Parameters
    ----------
    model : Model
        The model, with ΔR = I.
    poses_g : Poses
        Poses in g.
    noise : (n, 3) array or None
        Noise of the pose means, as `noise_of` returns it [g].

    Returns
    -------
    Equations
        The equations; a residual is NaN where the force of the reading is not unique.

    """
    known, shared, alone = kinds(poses_g)
    s = np.full(poses_g.reading.shape, USUAL_NOISE_G) if noise is None else noise
    parts: list[_Part] = []
    force, scale = np.empty_like(s), np.empty(len(s))
    if len(known):
        parts.append(_Known(model, poses_g, s))
        force, scale = poses_g['reference'], np.sqrt(np.mean(s ** 2, axis=1))
    if shared:
        which = np.concatenate(shared)
        part = _Shared(model, poses_g.take(which), s[which], which,
                       np.repeat(np.arange(len(shared)), [len(group) for group in shared]))
        parts.append(part)
        force[which], scale[which] = part.force, np.sqrt(np.mean(s[which] ** 2, axis=1))
    if len(alone):
        everyone = len(alone) == len(s)
        one = _Alone(model, poses_g if everyone else poses_g.take(alone), s[alone], alone)
        parts.append(one)
        force[alone], scale[alone] = one.force, one.sigma
    count = sum(len(part.residual) for part in parts) - 2 * len(shared)
    return Equations(tuple(parts), force, scale, count, noise is not None)


class _Alone:
    """Equations of poses of which only |force| = 1 g is known; symbols as in the module."""

    def __init__(self, model: Model, poses_g: Poses, s: Floats, pose: Indices) -> None:
        self.pose = pose
        self._context: Context = poses_g.columns
        here = model.at(self._context)
        u = here.force(poses_g.reading)
        length = np.sqrt(np.sum(u * u, axis=1))[:, np.newaxis]
        self.force = u / length
        inverse = here.inverse_slope(u)
        transposed = inverse.swapaxes(-1, -2)
        a = times(transposed, self.force)
        spread = a * s ** 2
        variance = np.sum(a * spread, axis=1)[:, np.newaxis]
        g = times(inverse, spread / variance)
        across = g - self.force * np.sum(self.force * g, axis=1)[:, np.newaxis]
        h = times(transposed, across / length)
        e = length - 1.0
        self.sigma = np.sqrt(variance[:, 0])
        self.residual = e[:, 0] / self.sigma
        weighted = a / self.sigma[:, np.newaxis]
        self._rows = weighted - self.residual[:, np.newaxis] * h
        self._rows_along = weighted * e
        self._at, self._along = u, g

    def columns(self, model: Model) -> Floats:
        """Return the derivative; see `Equations.columns`."""
        return (model.basis(self._at, self._context).along(self._rows)
                - model.basis(self._at, self._context, self._along).along(self._rows_along))


class _Known:
    """Equations of poses of known orientation."""

    def __init__(self, model: Model, poses_g: Poses, s: Floats) -> None:
        self._sigma, self._poses = s.ravel(), poses_g
        self.pose = np.repeat(np.arange(len(s)), 3)
        reading = model.at(poses_g.columns).reading(poses_g['reference'])
        self.residual = (poses_g.reading - reading).ravel() / self._sigma

    def columns(self, model: Model) -> Floats:
        """Return the derivative; see `Equations.columns`."""
        basis = model.basis(self._poses['reference'], self._poses.columns).full
        return basis.reshape(len(self._sigma), basis.shape[2]) / self._sigma[:, np.newaxis]


class _Shared:
    """
    Equations of poses in groups with a common unknown orientation.

    A rotation of the common direction changes the readings of a group by T = A [t1 t2] per noise,
    with two tangents t. The direction is rotated until the residuals have no part in the span of
    T, so that the derivative is exact; the part of the derivative in this span is projected out.

    """

    def __init__(self, model: Model, poses_g: Poses, s: Floats, pose: Indices, group: Indices
                 ) -> None:
        self._sigma, self._context, self._group = s, poses_g.columns, group
        self.pose = np.repeat(pose, 3)
        here = model.at(poses_g.columns)
        mean = np.array([np.bincount(group, column) for column in
                         here.force(poses_g.reading).T]).T
        self.force = unit(mean)[group]
        for _ in range(_TURNS):
            off, tangents = self._around(here, poses_g.reading)
            turn = self._normal @ self._summed(np.swapaxes(self._turn, 1, 2) @ off)
            if np.max(np.abs(turn)) < _STRAIGHT:
                break
            self.force = unit(self.force + (tangents @ turn[group])[:, :, 0])
        off, _ = self._around(here, poses_g.reading)
        self.residual = self._projected(off).ravel()

    def _around(self, here: AtContext, reading: Floats) -> tuple[Floats, Floats]:
        """Set up the turns about the common directions; return residuals and tangents."""
        first = unit(np.cross(self.force, np.eye(3)[np.argmin(np.abs(self.force), axis=1)]))
        tangents = np.stack([first, np.cross(self.force, first)], axis=2)
        self._turn = here.slope(self.force) @ tangents / self._sigma[:, :, np.newaxis]
        self._normal = np.linalg.inv(self._summed(np.swapaxes(self._turn, 1, 2) @ self._turn))
        return ((reading - here.reading(self.force)) / self._sigma)[:, :, np.newaxis], tangents

    def _summed(self, parts: Floats) -> Floats:
        """Return the sums of (n, …) parts by group."""
        size, groups = math.prod(parts.shape[1:]), int(self._group[-1]) + 1
        summed = np.zeros((groups, size))
        for k, column in enumerate(parts.reshape(len(parts), size).T):
            summed[:, k] = np.bincount(self._group, column, groups)
        return summed.reshape(groups, *parts.shape[1:])

    def _projected(self, rows: Floats) -> Floats:
        """Return (n, 3, p) rows minus the part that a rotation of the direction explains."""
        onto = self._normal @ self._summed(np.swapaxes(self._turn, 1, 2) @ rows)
        return rows - self._turn @ onto[self._group]

    def columns(self, model: Model) -> Floats:
        """Return the derivative; see `Equations.columns`."""
        basis = model.basis(self.force, self._context).full
        rows = self._projected(basis / self._sigma[:, :, np.newaxis])
        return rows.reshape(len(self.pose), basis.shape[2])
