# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Candidates: the effects of the catalogue as columns of the equations.

An effect with a shape is searched over it: the time constant over a fine grid (a coarse one makes
up second effects), the instant of a step over all pairs of successive poses.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from .equations import Equations, kinds
from .least_squares import Fitted
from ..effects import Context, EFFECTS
from ..table import COLUMNS, Floats, Poses

LADDER = ('offset', 'gain', 'axis_gain', 'cross_axis', 'misalignment')
"""The effects of V and W, which every sensor has."""

_TAUS = 40
_LEAST_SIDE = 5
"""Poses on each side of a step: with three it could take up any one of them."""


@dataclass(frozen=True)
class Candidate:
    """
    An effect beside a model.

    Parameters
    ----------
    effect : str
        Its name.
    shape : (s,) array
        Its shape.
    columns : (m, r) array
        What it adds to the equations beyond the model, orthonormal.
    searched : int
        Values of its shape that were found from the same data.
    tried : float
        How many independent shapes were tried.

    """

    effect: str
    shape: Floats
    columns: Floats
    searched: int = 0
    tried: float = 1.0

    @property
    def parameters(self) -> int:
        """How many parameters it costs."""
        return self.columns.shape[1] + self.searched


def candidates(equations: Equations, fitted: Fitted, context: Context, names: tuple[str, ...],
               whitening: Floats | None = None) -> dict[str, Candidate]:
    """
    Give the candidates among these effects that the equations can tell from the model.

    Parameters
    ----------
    equations : Equations
        Near the model.
    fitted : Fitted
        With the model projected out.
    context : mapping of str to array
        Of the poses.
    names : tuple of str
        Effects of the catalogue.
    whitening : (m, m) array, optional
        Applied to their columns, as it was to the equations.

    """
    found = {}
    for name in names:
        effect = EFFECTS[name]
        if effect.output is None and all(key in context for key in effect.needs):
            best = _best_shape(name, equations, fitted, context, whitening)
            if best is not None:
                found[name] = best
    return found


def _best_shape(name: str, equations: Equations, fitted: Fitted, context: Context,
                whitening: Floats | None) -> Candidate | None:
    """Give the candidate in its best shape, or None where it cannot be told from the model."""
    best, best_gain = None, 0.0
    shapes = list(_shapes(name, context))
    for shape in shapes:
        basis = EFFECTS[name].basis(equations.force, context, shape)
        seen = equations.seen(basis)
        columns = fitted.without_model(seen if whitening is None else whitening @ seen)
        gain = float(np.sum((columns.T @ fitted.residual) ** 2))
        if columns.shape[1] and (best is None or gain > best_gain):
            tried = 1.0 if len(shapes) == 1 else len(shapes) / 3.0
            best = Candidate(name, shape, columns, int(len(shapes) > 1), tried)
            best_gain = gain
    return best


def _shapes(name: str, context: Context) -> Iterator[Floats]:
    """Give the shapes to try."""
    if name in ('offset_drift', 'warm_up', 'offset_step'):
        time = np.sort(context['time'])
        start, span = time[0], time[-1] - time[0]
        if span <= 0.0:
            return
        if name == 'offset_drift':
            yield np.array([start])
        elif name == 'warm_up':
            for tau in np.geomspace(span / 60.0, span * 1.5, _TAUS):
                yield np.array([start, tau])
        else:
            middles = (time[1:] + time[:-1]) / 2.0
            for instant in np.unique(middles[_LEAST_SIDE - 1:len(middles) - _LEAST_SIDE + 1]):
                yield np.array([instant])
        return
    yield np.zeros(0)


def not_testable(poses_g: Poses, testable: Mapping[str, Candidate], present: tuple[str, ...]
                 ) -> list[tuple[str, str]]:
    """
    Name the effects that these poses cannot show, with what to record.

    Parameters
    ----------
    poses_g : Poses
        In g.
    testable : mapping of str to Candidate
        Effects that they can show.
    present : tuple of str
        Effects of the model, and their rivals.

    """
    missing = []
    known = kinds(poses_g)[0]
    for name, effect in EFFECTS.items():
        if name in testable or name in present or effect.output is not None:
            continue
        if name in ('gain', 'axis_gain') and {'gain', 'axis_gain'} & set(present):
            continue
        lacking = [', '.join(COLUMNS[key].names) for key in effect.needs
                   if key in COLUMNS and key not in poses_g]
        if lacking:
            missing.append((name, ' and '.join(lacking)))
        elif name == 'misalignment' and not len(known):
            missing.append((name, 'ref_x, ref_y, ref_z (known orientation)'))
        else:
            missing.append((name, _more(name)))
    if 'time' not in poses_g:
        missing.append(('offset_wander', 'time'))
    return missing


def _more(name: str) -> str:
    """Say what would make an effect visible whose columns are there."""
    needs = [COLUMNS[key].meaning for key in EFFECTS[name].needs if key in COLUMNS]
    if needs:
        return f'poses between which this changes more: {needs[0]}'
    return 'more poses in more directions'
