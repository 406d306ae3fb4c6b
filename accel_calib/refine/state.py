# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of a search: a model fitted to the poses kept, with its residuals.

**Long tables.** A sample of a long table bounds the time and the memory of a refinement. Nobody
turns a sensor to thousands of poses by hand: long tables come from machines, or are samples in
place of poses. With `MOST` equations a refinement takes 10 s and 300 MB as a rule, and about a
minute and 900 MB in the worst case: all context, and noise that no effect explains. A pose has one
equation, or three if its orientation is known or shared.

The sample takes one pose out of each part of the table. The place in the part changes by the
golden ratio, so that a table that repeats the same turns gives all of them.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .linear import held_out, Linear, linearised, Set
from ..calibrate import with_history
from ..effects import CHANGES, Model
from ..estimate import estimate, Fit, NotConvergedError
from ..table import Floats, Poses
from ..units import MG

_CHI2_LEVEL = 1e-3
_CHI2_RATIO = 1.3
"""chi² per degree of freedom that still counts as noise: poses repeat worse than samples."""


@dataclass(frozen=True)
class State:
    """
    A model fitted to the poses kept.

    Parameters
    ----------
    fit : Fit
        Fit of the model to the poses.

    """

    fit: Fit

    @property
    def model(self) -> Model:
        """Return the fitted model, ΔR = I."""
        return self.fit.model

    @property
    def poses_g(self) -> Poses:
        """Return the poses kept, in g, with the column ``previous``."""
        return self.fit.poses_g

    @cached_property
    def linear(self) -> Linear:
        """Return the equations with all values of the model projected out, without candidates."""
        return linearised(self.fit, self.model.effects, ())

    @cached_property
    def nothing(self) -> Set:
        """Return the empty set beside the model."""
        return self.linear.made()

    @property
    def residual(self) -> Floats:
        """(m,) array, residuals of the equations with all values fitted."""
        return self.linear.residual

    @property
    def rss(self) -> float:
        """Sum of squared residuals."""
        return self.linear.base_rss

    @property
    def held_out(self) -> Floats:
        """(m,) array, each residual if its own equation is left out of the fit (PRESS)."""
        return held_out(self.residual, 1.0 - np.sum(self.linear.onto ** 2, axis=1))

    @property
    def dof(self) -> int:
        """Return the number of independent equations minus that of fitted values."""
        return self.linear.dof

    @property
    def is_noise(self) -> bool:
        """Whether noise may explain the residual; True if the noise is not known."""
        return not self.fit.noise_known or is_noise(self.rss, self.dof)

    def gap_mg(self, residual: Floats) -> float:
        """Return the RMS over the new poses of (m,) residuals of the equations [mg]."""
        of_poses = self.fit.equations.of_poses(residual)
        if 'new' in self.poses_g:
            of_poses = of_poses[self.poses_g['new'] > 0.0]
        return float(np.sqrt(np.mean(of_poses ** 2))) * MG

    @property
    def floor_mg(self) -> float | None:
        """Return the residual expected of a correct model [mg]; None if the noise is unknown."""
        if not self.fit.noise_known:
            return None
        rows = self.fit.by_pose.rows[self.fit.equations.pose]
        share = np.sqrt(self.dof / len(rows)) * np.ones(len(rows))
        return self.gap_mg(share)

    def without(self, poses: NDArray[np.intp]) -> State | None:
        """Return the state without these poses, fitted, or None without a sound fit."""
        kept = np.delete(np.arange(len(self.poses_g)), poses)
        return fitted_state(self.model, self.poses_g.take(kept))


def is_noise(rss: float, dof: float) -> bool:
    """Return whether measured noise explains a weighted sum of squares."""
    from scipy.special import chdtrc

    return bool(dof <= 0 or rss <= _CHI2_RATIO * dof or chdtrc(dof, rss) > _CHI2_LEVEL)


def changes_beside(model: Model) -> tuple[str, ...]:
    """Return the changes since a stored calibration that can be added to a model."""
    present = set(model.values)
    if 'axis_gain_change' in present:
        present.add('gain_change')
    return tuple(name for name in CHANGES if name not in present)


def beginning(poses_g: Poses, model: Model) -> State:
    """
    Return the state of a base model, fitted to all poses.

    Raises
    ------
    NotConvergedError
        If the fit does not converge.

    """
    return State(estimate(model, with_history(poses_g, model)))


def fitted_state(model: Model, poses_g: Poses) -> State | None:
    """Return the state of a model fitted to poses, or None without a sound fit."""
    try:
        return State(estimate(model, poses_g))
    except NotConvergedError:
        return None


MOST = 6000
"""Largest number of equations that a refinement uses."""

_VECTORS = 3
"""Number of equations of a pose of known or shared orientation."""

_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def sampled(poses: Poses) -> Poses:
    """
    Return the poses for `MOST` equations, and as many of those of a stored calibration.

    Poses that share their orientation stay together, unless too many do.

    """
    most = MOST // (_VECTORS if {'reference', 'orientation'} & set(poses.columns) else 1)
    if len(poses) <= most:
        return poses
    new = poses['new'] > 0.0 if 'new' in poses else np.ones(len(poses), bool)
    parts = [part[_kept(poses.take(part), most)]
             for part in (np.flatnonzero(new), np.flatnonzero(~new)) if len(part)]
    return poses.take(np.sort(np.concatenate(parts)))


def sample_words(used: int, total: int) -> str:
    """Return a warning about a sample."""
    return (f'the refinement uses {used} of {total} poses, spread evenly over the table, to bound '
            'its time and memory; it does not look for disturbed poses among the others; choose '
            'rows to use others')


def _kept(poses: Poses, most: int) -> NDArray[np.intp]:
    """Return the indices of the sample."""
    count = len(poses)
    if 'orientation' in poses and count > most:
        group = np.unique(poses['orientation'], return_inverse=True)[1]
        groups = int(group.max()) + 1
        kept = np.flatnonzero(np.isin(group, _spread(groups, max(most * groups // count, 1))))
        if most // 2 <= len(kept) <= 2 * most:
            return kept
    return _spread(count, most)


def _spread(count: int, wanted: int) -> NDArray[np.intp]:
    """Return at most `wanted` different indices, one out of each part of the range."""
    if count <= wanted:
        return np.arange(count)
    part = np.arange(wanted)
    return np.unique(((part + part * _GOLDEN % 1.0) * (count / wanted)).astype(np.intp))
