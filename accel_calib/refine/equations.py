# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses as equations: what they say of the values of a model, whatever is known of their orientation.

Near a model with force u and slope A = d reading / du, a change B k of the reading is seen

- where the orientation is known, in all three components: B k;
- where only |force| = 1 g is known, along the force: û A⁻¹ B k;
- where poses share an unknown orientation, in all components of each, less the two directions in
  which their common orientation may turn. A pose alone in its orientation is the case before.

Each equation is divided by its noise, so that all have unit variance where the noise is right, and
the unknown orientations are projected out. What is left is linear least squares

    residual = Jacobian · k + noise

in which the values of the model and of any candidate stand side by side.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..calibrate.likelihood import norm_rows
from ..calibrate.uncertainty import believable
from ..effects import Context
from ..model import force_slope, Model, reading_of, sensor_force
from ..table import Floats, Poses


@dataclass(frozen=True)
class Equations:
    """
    The equations of poses near a model.

    Parameters
    ----------
    residual : (m,) array
        What the model leaves, in units of the noise.
    seen : callable
        Takes the (n, 3, p) reading that values add to each pose to the (m, p) equations.
    pose : (m,) array of int
        Index of the pose that an equation mainly belongs to.
    force : (n, 3) array
        u of each pose, on the unit sphere where the orientation is not known [g].
    scale : (n,) array
        Noise of each pose in these equations [g]; 1 g where it is not known.
    count : int
        How many equations are independent.

    """

    residual: Floats
    seen: Callable[[Floats], Floats]
    pose: NDArray[np.intp]
    force: Floats
    scale: Floats
    count: int

    def residual_of_pose(self, residual: Floats) -> Floats:
        """Give the size of the residuals of each pose, (n,) [g]; signed where it has but one."""
        sizes = residual * self.scale[self.pose]
        if len(sizes) == len(self.scale):
            signed = np.zeros(len(self.scale))
            signed[self.pose] = sizes
            return signed
        return np.sqrt(np.bincount(self.pose, sizes ** 2, len(self.scale)))


def noise_of(poses_g: Poses) -> Floats | None:
    """Give the (n, 3) noise of the pose means [g], or None where it is not known."""
    return believable(poses_g.noise)


def kinds(poses: Poses) -> tuple[NDArray[np.intp], list[NDArray[np.intp]], NDArray[np.intp]]:
    """
    Part poses by what is known of their orientation.

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
    numbers = poses['orientation']
    groups = [np.flatnonzero(numbers == number) for number in np.unique(numbers)]
    shared = [group for group in groups if len(group) > 1]
    alone = np.array([group[0] for group in groups if len(group) == 1], np.intp)
    return everyone[:0], shared, alone


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
        Noise of their means [g].

    """
    known, shared, alone = kinds(poses_g)
    context = poses_g.columns
    force = sensor_force(model, poses_g.reading, context)
    s = np.ones_like(force) if noise is None else noise
    parts: list[tuple[Floats, Callable[[Floats], Floats], NDArray[np.intp]]] = []
    scale = np.ones(len(poses_g))
    if len(known):
        force = poses_g['reference']
        parts.append(_known(model, poses_g, force, s))
        scale = np.sqrt(np.mean(s ** 2, axis=1))
    for group in shared:
        force = force.copy()
        force[group] = _common_direction(force[group])
        parts.append(_shared(model, poses_g.take(group), group, force[group], s[group]))
        scale[group] = np.sqrt(np.mean(s[group] ** 2, axis=1))
    if len(alone):
        part, deviation = _alone(model, context, force, s, alone)
        parts.append(part)
        scale[alone] = deviation
        force = force.copy()
        force[alone] /= np.linalg.norm(force[alone], axis=1, keepdims=True)
    return Equations(np.concatenate([part[0] for part in parts]),
                     lambda basis: np.concatenate([part[1](basis) for part in parts]),
                     np.concatenate([part[2] for part in parts]), force, scale,
                     sum(len(part[0]) for part in parts) - 2 * len(shared))


def _common_direction(force: Floats) -> Floats:
    mean = force.mean(axis=0)
    unit: Floats = mean / np.linalg.norm(mean)
    return unit


def _rows(context: Context, which: NDArray[np.intp]) -> dict[str, Floats]:
    return {key: values[which] for key, values in context.items()}


def _alone(model: Model, context: Context, force: Floats, noise: Floats, which: NDArray[np.intp]
           ) -> tuple[tuple[Floats, Callable[[Floats], Floats], NDArray[np.intp]], Floats]:
    """Give the equations of poses of which only |force| = 1 g is known, and their noise."""
    rows = norm_rows(model, force[which], _rows(context, which))
    sigma = np.linalg.norm(rows * noise[which], axis=1)
    sigma = np.where(np.all(noise[which] == 1.0, axis=1), 1.0, sigma)
    weighted = rows / sigma[:, np.newaxis]
    residual = (np.linalg.norm(force[which], axis=1) - 1.0) / sigma

    def seen(basis: Floats) -> Floats:
        along: Floats = np.einsum('ni,nip->np', weighted, basis[which])
        return along

    return (residual, seen, which), sigma


def _known(model: Model, poses_g: Poses, force: Floats, noise: Floats
           ) -> tuple[Floats, Callable[[Floats], Floats], NDArray[np.intp]]:
    """Give the equations of poses of known orientation."""
    sigma = noise.ravel()
    residual = (poses_g.reading - reading_of(model, force, poses_g.columns)).ravel() / sigma

    def seen(basis: Floats) -> Floats:
        return basis.reshape(len(sigma), basis.shape[2]) / sigma[:, np.newaxis]

    return residual, seen, np.repeat(np.arange(len(force)), 3)


def _shared(model: Model, group: Poses, which: NDArray[np.intp], force: Floats, noise: Floats
            ) -> tuple[Floats, Callable[[Floats], Floats], NDArray[np.intp]]:
    """Give the equations of poses that share one unknown orientation."""
    residual, all_seen, _ = _known(model, group, force, noise)
    tangents = np.linalg.svd(force[:1])[2][1:]  # two directions normal to the force
    slope = force_slope(model, force, group.columns)
    turning = all_seen(np.einsum('nij,kj->nik', slope, tangents))
    onto = np.linalg.qr(turning)[0]

    def seen(basis: Floats) -> Floats:
        rows = all_seen(basis[which])
        return rows - onto @ (onto.T @ rows)

    return residual - onto @ (onto.T @ residual), seen, np.repeat(which, 3)
