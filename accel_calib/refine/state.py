# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Where a search stands: the model so far, the poses kept, and the equations near it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .candidates import Candidate, candidates, LADDER
from .equations import Equations, equations, noise_of
from .exact import columns_of, fit_exactly
from .least_squares import Fitted, fitted
from .wander import Wander, wander
from ..calibrate.approach import with_approach
from ..effects import EFFECTS
from ..model import Model
from ..table import Floats, Poses
from ..units import MG


@dataclass(frozen=True)
class State:
    """
    A model fitted to the poses kept.

    Parameters
    ----------
    model : Model
        The fitted model, ΔR = I.
    poses_g : Poses
        The poses kept, in g, with the pose before each.

    """

    model: Model
    poses_g: Poses

    @cached_property
    def noise(self) -> Floats | None:
        """Give the (n, 3) noise of the pose means [g], if known."""
        return noise_of(self.poses_g)

    @cached_property
    def near(self) -> Equations:
        """Give the equations near the model."""
        return equations(self.model, self.poses_g, self.noise)

    @cached_property
    def fitted(self) -> Fitted:
        """Give the equations with the model projected out."""
        return fitted(self.near.residual, columns_of(self.model, self.near, self.poses_g))

    @property
    def dof(self) -> int:
        """Independent equations less fitted values."""
        return self.near.count - self.fitted.onto.shape[1]

    @cached_property
    def found(self) -> dict[str, Candidate]:
        """Give the candidates that the poses can tell from the model, the ladder apart."""
        return self.candidates_among(tuple(name for name in EFFECTS if name not in LADDER))

    def candidates_among(self, names: tuple[str, ...]) -> dict[str, Candidate]:
        """Give those of these effects that the poses can tell from the model."""
        absent = tuple(name for name in names if name not in self.model.values)
        return candidates(self.near, self.fitted, self.poses_g.columns, absent)

    @cached_property
    def wander(self) -> Wander | None:
        """Give the random walk of the offset, if there are times."""
        if 'time' not in self.poses_g or np.ptp(self.poses_g['time']) <= 0.0:
            return None
        return wander(self.near, self.fitted, self.poses_g['time'], self.noise is not None)

    @cached_property
    def beside_walk(self) -> Fitted:
        """Give the equations with the walk of the offset whitened and the model projected out."""
        if self.wander is None:
            return self.fitted
        whitening = self.wander.whitening
        columns = columns_of(self.model, self.near, self.poses_g)
        return fitted(whitening @ self.near.residual, whitening @ columns)

    def found_beside_walk(self) -> dict[str, Candidate]:
        """Give the candidates as they are seen beside a walk of the offset."""
        absent = tuple(name for name in self.found if name not in self.model.values)
        return candidates(self.near, self.beside_walk, self.poses_g.columns, absent,
                          None if self.wander is None else self.wander.whitening)

    def gap_mg(self, residual: Floats) -> float:
        """Give the RMS over the poses of residuals of the equations [mg]."""
        return float(np.sqrt(np.mean(self.near.residual_of_pose(residual) ** 2))) * MG

    @property
    def floor_mg(self) -> float | None:
        """Give what the gap would be were the model right [mg]."""
        if self.noise is None:
            return None
        share = self.dof / len(self.near.residual)
        return self.gap_mg(np.full(len(self.near.residual), np.sqrt(share)))

    def with_effects(self, values: dict[str, Floats]) -> State:
        """Give the state of the model with these effects, all fitted again."""
        model = fit_exactly(Model(values), self.poses_g, self.noise)
        return State(model, self.poses_g)

    def without(self, poses: NDArray[np.intp]) -> State:
        """Leave these poses out, and fit again."""
        kept = np.delete(np.arange(len(self.poses_g)), poses)
        return State(self.model, self.poses_g.take(kept)).with_effects(dict(self.model.values))


def plus(state: State, candidate: Candidate) -> State:
    """Add a candidate to the model and fit everything again."""
    effect = EFFECTS[candidate.effect]
    values = dict(state.model.values)
    if candidate.effect == 'axis_gain':
        gain = values.pop('gain', np.zeros(1))
        values['axis_gain'] = np.full(3, gain[0])
    else:
        values[candidate.effect] = np.concatenate([np.zeros(len(effect.parameters)),
                                                   candidate.shape])
    return state.with_effects(_started(state, values, candidate))


def _started(state: State, values: dict[str, Floats], candidate: Candidate) -> dict[str, Floats]:
    """Begin a time constant with the amplitudes that belong to it."""
    if 'tau' not in EFFECTS[candidate.effect].shape:
        return values
    basis = EFFECTS[candidate.effect].basis(state.near.force, state.poses_g.columns,
                                            candidate.shape)
    seen = state.near.seen(basis)
    onto = state.fitted.onto
    left = seen - onto @ (onto.T @ seen)
    amplitudes = np.linalg.lstsq(left, state.fitted.residual, rcond=1e-7)[0]
    return {**values, candidate.effect: np.concatenate([amplitudes, candidate.shape])}


def beginning(poses_g: Poses, model: Model) -> State:
    """Give the state of a model before anything is added, fitted to all poses."""
    known = with_approach(poses_g, model)
    return State(fit_exactly(model, known, noise_of(known)), known)
