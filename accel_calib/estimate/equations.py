# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses as equations: what they say of the values of a model, whatever is known of their orientation.

Each pose has a surface of readings that the model allows: a point where the orientation is known,
and the ellipsoid-like image of the unit sphere where only |force| = 1 g is known. The residual of
a pose is the distance of its reading to that surface, in units of the noise:

- known orientation: (reading - predict(reference)) / s, three equations;
- |force| = 1 g alone: (|u| - 1) / σ, with u the force found from the reading, A the slope of the
  reading, a = A⁻ᵀû and σ² = Σ_j a_j² s_j². To first order this is the distance to the surface
  along its normal. Without the division by σ the sum of squares would vanish for W → ∞, where
  every reading becomes one unit vector;
- poses that share an unknown orientation: (reading - predict(d)) / s for their common direction d,
  less the part that a turn of d accounts for.

The equations are linear in small changes k of the values,

    residual = columns · k + noise of variance 1

with the exact derivative: a value that adds B(u) to the reading changes (|u| - 1) / σ by

    -[ (a - e h)·B(u) - e a·B'(u)g ] / σ,
    e = |u| - 1,  g = A⁻¹ N a / σ²,  h = A⁻ᵀ(I - ûûᵀ)g / |u|

where N is the covariance of the reading and B'(u)g the derivative of B along g. (The change of A
with u, by effects that bend, is neglected: it is of the order of e times their size.)

"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .noise import believable, USUAL_NOISE_G
from ..effects import Context
from ..model import Model, times
from ..sphere import unit
from ..table import Floats, Poses

Indices = NDArray[np.intp]


class _Part(Protocol):
    """The equations of poses of one kind."""

    residual: Any
    pose: Indices

    def columns(self, model: Model) -> Floats:
        """Return the (m, p) derivative of the prediction by the values of any model."""


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
        Noise of each pose in these equations [g].
    count : int
        Number of independent equations.
    noise_known : bool
        Whether the noise was measured; if not, all poses have `USUAL_NOISE_G`.

    """

    parts: tuple[_Part, ...]
    force: Floats
    scale: Floats
    count: int
    noise_known: bool

    @property
    def residual(self) -> Floats:
        """(m,) array, what the model leaves, in units of the noise."""
        return _joined([part.residual for part in self.parts])

    @property
    def pose(self) -> Indices:
        """(m,) array, index of the pose that each equation belongs to."""
        return _joined([part.pose for part in self.parts])

    def columns(self, model: Model) -> Floats:
        """Return the (m, p) derivative of the prediction by the values of any model, per noise."""
        return _joined([part.columns(model) for part in self.parts])

    def of_poses(self, residual: Floats) -> Floats:
        """Return the residual of each pose, (n,) [g]: signed if it has one equation, else RMS."""
        sizes = residual * self.scale[self.pose]
        if len(sizes) == len(self.scale):
            signed = np.zeros(len(self.scale))
            signed[self.pose] = sizes
            return signed
        return np.sqrt(np.bincount(self.pose, sizes ** 2, len(self.scale)))


def _joined(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def noise_of(poses_g: Poses) -> Floats | None:
    """Return the (n, 3) noise of the pose means as far as it is believed [g]; None: unknown."""
    return believable(poses_g.noise)


def kinds(poses: Poses) -> tuple[Indices, list[Indices], Indices]:
    """
    Split poses by what is known of their orientation.

    Returns
    -------
    (a,) array, list of arrays, (c,) array
        Poses of known orientation, groups that share one, and poses of which only |force| = 1 g
        is known.

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
        With ΔR = I.
    poses_g : Poses
        Poses in g.
    noise : (n, 3) array or None
        Noise of their means as far as it is believed [g].

    Returns
    -------
    Equations
        With NaN residuals where the reading belongs to no one force.

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
    """Equations of poses of which only |force| = 1 g is known; see the module for the symbols."""

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
    Equations of poses in groups that share an unknown orientation.

    A turn of the common direction moves the readings of a group by T = A [t1 t2] per noise, with
    two tangents t. The part of the residuals in the span of T is projected out.

    """

    def __init__(self, model: Model, poses_g: Poses, s: Floats, pose: Indices, group: Indices
                 ) -> None:
        self._sigma, self._context, self._group = s, poses_g.columns, group
        self.pose = np.repeat(pose, 3)
        here = model.at(poses_g.columns)
        mean = np.array([np.bincount(group, column) for column in
                         here.force(poses_g.reading).T]).T
        self.force = unit(mean)[group]
        first = np.cross(self.force, np.eye(3)[np.argmin(np.abs(self.force), axis=1)])
        first = unit(first)
        tangents = np.stack([first, np.cross(self.force, first)], axis=2)
        self._turn = here.slope(self.force) @ tangents / s[:, :, np.newaxis]
        self._normal = np.linalg.inv(self._summed(np.swapaxes(self._turn, 1, 2) @ self._turn))
        off = (poses_g.reading - here.reading(self.force)) / s
        self.residual = self._projected(off[:, :, np.newaxis]).ravel()

    def _summed(self, parts: Floats) -> Floats:
        """Sum (n, …) parts by group."""
        size, groups = math.prod(parts.shape[1:]), int(self._group[-1]) + 1
        summed = np.zeros((groups, size))
        for k, column in enumerate(parts.reshape(len(parts), size).T):
            summed[:, k] = np.bincount(self._group, column, groups)
        return summed.reshape(groups, *parts.shape[1:])

    def _projected(self, rows: Floats) -> Floats:
        """Return (n, 3, p) rows less what a turn of the common direction accounts for."""
        onto = self._normal @ self._summed(np.swapaxes(self._turn, 1, 2) @ rows)
        return rows - self._turn @ onto[self._group]

    def columns(self, model: Model) -> Floats:
        """Return the derivative; see `Equations.columns`."""
        basis = model.basis(self.force, self._context).full
        rows = self._projected(basis / self._sigma[:, :, np.newaxis])
        return rows.reshape(len(self.pose), basis.shape[2])
