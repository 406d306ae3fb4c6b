# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The state of a search: a model fitted to the poses kept, with its residuals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .candidates import Candidate, candidates
from .least_squares import Projected, projected
from .wander import Wander, wander
from ..calibrate.previous_pose import with_previous
from ..effects import CHANGES, effect_named, EFFECTS, LADDER
from ..estimate.fit import estimate, Fit
from ..estimate.solve import NotConvergedError
from ..model import FITTED_SHAPES, Model
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
