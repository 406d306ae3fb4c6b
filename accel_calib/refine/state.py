# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of a search: a model fitted to the poses kept, with its residuals.

**Random walk.** The effect `offset_wander`: an offset that changes slowly without a known form.

The offset is a random walk w(t), expanded in its Karhunen-Loève modes

    w(t) = Σ_k a_k sin((k - ½) π τ) / ((k - ½) π),   τ from 0 to 1 over the poses

with independent amplitudes a_k of equal variance for each axis. It enters the equations through
the same columns as an offset. Its size is estimated by restricted maximum likelihood (Patterson
and Thompson 1971): with the model projected out, the residual z along the singular vectors of the
modes has the variances s² (1 + λ Λ_i). With a fixed number of modes the cost is linear in the
number of poses.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .candidates import Candidate, candidates, Projected, projected
from ..calibrate.quality import with_previous
from ..effects import CHANGES, effect_named, EFFECTS, LADDER
from ..estimate.equations import Equations
from ..estimate.fit import estimate, Fit, NotConvergedError
from ..model import FITTED_SHAPES, Model
from ..table import Floats, Poses
from ..units import MG

_MODES = 60
"""Modes of each axis: the rest has less than 1 % of the variance of a random walk."""

_RATIOS = np.geomspace(1e-4, 1e6, 81)
_LARGEST_RATIO = 1e3
_LEAST_WHITE = 0.5
"""Smallest part of the measured variance that remains for the noise of the poses."""

_NO_CHANGE = 1e-9
"""Directions that are shrunk by less than this part are left out."""

_OFFSET = Model({'offset': np.zeros(3)})


@dataclass(frozen=True)
class Wander:
    """
    A random walk of the offset.

    Parameters
    ----------
    fall : float
        Decrease of the information criterion.
    likelihood_ratio : float
        Twice the logarithm of the likelihood ratio against no walk.
    residual : (m,) array
        Residual minus the estimated walk.
    held_out : (m,) array
        The same, with each equation predicted from the others.
    axes, shrink : (m, r) array, (r,) array
        Directions of the walk among the equations, and the factor that whitens each.

    """

    fall: float
    likelihood_ratio: float
    residual: Floats
    held_out: Floats
    axes: Floats
    shrink: Floats

    def whitened(self, columns: Floats) -> Floats:
        """Return (m,) or (m, q) columns, whitened for the sum of walk and noise."""
        along = self.axes.T @ columns
        return columns - self.axes @ ((1.0 - self.shrink) * along.T).T


def wander(equations: Equations, fitted: Projected, time: Floats) -> Wander:
    """
    Estimate a random walk of the offset.

    Parameters
    ----------
    equations : Equations
        Equations near the model.
    fitted : Projected
        The equations with the model projected out.
    time : (n,) array
        Times of the poses [s]; NaN for poses before the walk begins.

    """
    modes = _modes(equations, time)
    outside = modes - fitted.onto @ (fitted.onto.T @ modes)
    vectors, singular, _ = np.linalg.svd(outside, full_matrices=False)
    largest = max(float(singular[0]) ** 2, 1e-300)
    values = singular ** 2 / largest
    along = vectors.T @ fitted.residual
    squared, dof = along ** 2, equations.count - fitted.onto.shape[1]
    rest = max(fitted.rss - float(np.sum(squared)), 0.0)
    spread = 1.0 + _RATIOS[:, np.newaxis] * values
    scale = (np.sum(squared / spread, axis=1) + rest) / dof
    allowed = scale >= _LEAST_WHITE if equations.noise_known else _RATIOS <= _LARGEST_RATIO
    allowed[0] = True
    deviance = np.sum(np.log(spread), axis=1) + dof * np.log(np.maximum(scale, 1e-300))
    best = int(np.argmin(np.where(allowed, deviance, np.inf)))
    ratio = float(dof * np.log(max(fitted.rss, 1e-300) / dof) - deviance[best])
    taken = 1.0 - 1.0 / spread[best]
    residual = fitted.residual - vectors @ (taken * along)
    # Without its own equation each residual is P z over the diagonal of P.
    diagonal = 1.0 - np.sum(fitted.onto ** 2, axis=1) - vectors ** 2 @ taken
    axes, size, _ = np.linalg.svd(modes, full_matrices=False)
    shrink = 1.0 / np.sqrt(1.0 + _RATIOS[best] * size ** 2 / largest)
    shrunk = shrink < 1.0 - _NO_CHANGE
    axes, shrink = axes[:, shrunk], shrink[shrunk]
    return Wander(ratio - np.log(max(dof, 2)), ratio, residual,
                  residual / np.maximum(diagonal, 0.02), axes, shrink)


def _modes(equations: Equations, time: Floats) -> Floats:
    """Return the (m, 3 k) columns of the modes."""
    known = np.isfinite(time)
    first = np.min(time[known])
    tau = np.where(known, time - first, 0.0) / max(float(np.ptp(time[known])), 1e-300)
    number = np.pi * (np.arange(min(int(np.sum(known)), _MODES)) + 0.5)
    shapes = np.sin(number * tau[:, np.newaxis]) / number
    offset = equations.columns(_OFFSET)
    return np.hstack([offset[:, [axis]] * shapes[equations.pose] for axis in range(3)])


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
    def fitted(self) -> Projected:
        """Return the equations with the model projected out."""
        return projected(self.fit.residual, self.fit.columns)

    @property
    def dof(self) -> int:
        """Return the number of independent equations minus that of fitted values."""
        return self.fit.equations.count - self.fitted.onto.shape[1]

    @cached_property
    def found(self) -> dict[str, Candidate]:
        """Return the candidates, without the effects of the ladder."""
        return self.candidates_among((*(name for name in EFFECTS if name not in LADDER),
                                      *changes_beside(self.model)))

    def candidates_among(self, names: tuple[str, ...]) -> dict[str, Candidate]:
        """Return the candidates among these effects that the poses distinguish from the model."""
        absent = tuple(name for name in names if name not in self.model.values)
        return candidates(self.fit.equations, self.fitted, self.poses_g.columns, absent)

    @cached_property
    def wander(self) -> Wander | None:
        """Return the random walk of the offset, or None if the times are not known."""
        if 'time' not in self.poses_g:
            return None
        time = self.poses_g['time']
        if not np.any(np.isfinite(time)) or not np.ptp(time[np.isfinite(time)]) > 0.0:
            return None
        return wander(self.fit.equations, self.fitted, time)

    @cached_property
    def beside_walk(self) -> Projected:
        """Return the equations whitened for a walk, with the model projected out."""
        if self.wander is None:
            return self.fitted
        return projected(self.wander.whitened(self.fit.residual),
                         self.wander.whitened(self.fit.columns))

    def found_beside_walk(self) -> dict[str, Candidate]:
        """Return the candidates in the equations whitened for a walk of the offset."""
        return candidates(self.fit.equations, self.beside_walk, self.poses_g.columns,
                          tuple(self.found),
                          None if self.wander is None else self.wander.whitened)

    @property
    def is_noise(self) -> bool:
        """Whether noise may explain the residual; True if the noise is not known."""
        return not self.fit.noise_known or is_noise(self.fitted.rss, self.dof)

    @property
    def is_down_to_noise(self) -> bool:
        """Whether measured noise explains the residual; then no further effect is named."""
        return self.fit.noise_known and self.is_noise

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

    def with_effects(self, values: dict[str, Floats]) -> State | None:
        """Return the state with these effects, fitted, or None without a sound fit."""
        return _state(Model(values), self.poses_g)

    def without_effect(self, name: str) -> State | None:
        """Return the state without an effect, fitted, or None without a sound fit."""
        return self.with_effects({key: part for key, part in self.model.values.items()
                                  if key != name})

    def without(self, poses: NDArray[np.intp]) -> State | None:
        """Return the state without these poses, fitted, or None without a sound fit."""
        kept = np.delete(np.arange(len(self.poses_g)), poses)
        return _state(self.model, self.poses_g.take(kept))

    def plus(self, candidate: Candidate) -> State | None:
        """
        Return the state with a candidate in the model, fitted.

        Returns
        -------
        State or None
            None if the fit did not converge, the cost did not decrease, or a value is at the bound
            of its plausible range.

        """
        effect = effect_named(candidate.effect)
        values = dict(self.model.values)
        if candidate.effect == 'axis_gain':
            gain = values.pop('gain', np.zeros(1))
            values['axis_gain'] = np.full(3, gain[0])
        else:
            values[candidate.effect] = np.concatenate([np.zeros(len(effect.parameters)),
                                                       candidate.shape])
        after = self.with_effects(self._started(values, candidate))
        if after is None or not after.fit.chi2 < self.fit.chi2 or after.fit.at_bound:
            return None
        return after

    def _started(self, values: dict[str, Floats], candidate: Candidate) -> dict[str, Floats]:
        """Return start values with amplitudes, for a candidate with a fitted shape constant."""
        effect = effect_named(candidate.effect)
        if not set(FITTED_SHAPES) & set(effect.shape):
            return values
        count = len(effect.parameters)
        model = Model({candidate.effect: values[candidate.effect]})
        seen = self.fit.equations.columns(model)[:, :count]
        left = seen - self.fitted.onto @ (self.fitted.onto.T @ seen)
        amplitudes = np.linalg.lstsq(left, self.fitted.residual, rcond=1e-7)[0]
        return {**values, candidate.effect: np.concatenate([amplitudes, candidate.shape])}


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
    return State(estimate(model, with_previous(poses_g, model)))


def _state(model: Model, poses_g: Poses) -> State | None:
    try:
        return State(estimate(model, poses_g))
    except NotConvergedError:
        return None
