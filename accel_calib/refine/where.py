# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Description of where simulation and measurement disagree: directions, ranges or poses."""

from __future__ import annotations

import numpy as np

from .state import State
from ..effects import effect_named
from ..table import COLUMNS, Floats
from ..units import MG

_LARGEST = 3
_NEAR = np.cos(np.radians(30.0))


def where(effect: str, before: State, after: Floats) -> str:
    """
    Return a description of where an effect explains the disagreement.

    Parameters
    ----------
    effect : str
        The effect.
    before : State
        State without the effect.
    after : (m,) array
        Residuals of the equations with the effect.

    """
    share = (before.fit.equations.of_poses(before.fit.residual - after)) * MG
    if effect == 'offset_step':
        return _instant(before, share)
    needs = effect_named(effect).needs
    column = next((key for key in needs if key in before.poses_g and key != 'new'), None)
    if column is None:
        return _directions(before.fit.equations.force, share)
    return _range(column, before, share)


def _instant(before: State, share: Floats) -> str:
    """Return a text about the instant of the largest change between successive poses."""
    time = before.poses_g['time']
    order = np.argsort(time, kind='stable')[:int(np.sum(np.isfinite(time)))]
    time, moved = time[order], share[order]
    count = np.arange(1, len(moved))
    sums = np.cumsum(moved ** 2)[:-1]
    at = int(np.argmax(np.abs(sums / count - (np.sum(moved ** 2) - sums) / (len(moved) - count))))
    rows = before.poses_g.row[order]
    return f'between {time[at]:.6g} and {time[at + 1]:.6g} s (rows {rows[at]} and {rows[at + 1]})'


def _range(column: str, before: State, share: Floats) -> str:
    """Return a text about the range of a quantity and the disagreement at both ends."""
    known = np.isfinite(before.poses_g[column].reshape(len(share), -1)).all(axis=1)
    values, share = before.poses_g[column][known], share[known]
    if values.ndim > 1:
        values = np.linalg.norm(values, axis=1)
    order = np.argsort(values, kind='stable')
    ends = max(1, len(order) // 5)
    low, high = (np.sqrt(np.mean(share[part] ** 2)) for part in (order[:ends], order[-ends:]))
    name = column.replace('_', ' ')
    unit = COLUMNS[column].unit if column != 'std' else 'g'
    return (f'over {name} {values[order[0]]:.4g} to {values[order[-1]]:.4g} {unit}: '
            f'{low:.2g} mg RMS in the lowest fifth of the poses, {high:.2g} mg in the highest')


def _directions(force: Floats, share: Floats) -> str:
    """Return a text about the directions with the largest disagreement."""
    signs = np.array([(i, j, k) for i in (0, 1, -1) for j in (0, 1, -1) for k in (0, 1, -1)
                      if i or j or k], float)
    units = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    near = units @ force.T >= _NEAR
    counts = np.sum(near, axis=1)
    means = np.where(counts > 0, near @ share / np.maximum(counts, 1), 0.0)
    largest = [k for k in np.argsort(-np.abs(means))[:_LARGEST] if counts[k]]
    return 'with ' + ', '.join(
        f'{_name(signs[k])} up ({means[k]:+.2g} mg over {counts[k]} of {len(share)} poses)'
        for k in largest)


def _name(signs: Floats) -> str:
    return ' '.join(f'{"+" if sign > 0 else "-"}{axis}'
                    for axis, sign in zip('xyz', signs, strict=True) if sign)
