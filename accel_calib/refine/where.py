# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Where simulation and measurement disagree: directions, ranges or poses, with numbers."""

from __future__ import annotations

import numpy as np

from .state import State
from ..effects import EFFECTS
from ..table import COLUMNS, Floats
from ..units import MG

_LARGEST = 3
_NEAR = np.cos(np.radians(30.0))


def where(effect: str, before: State, after: Floats) -> str:
    """
    Say where the disagreement sits that an effect accounts for.

    Parameters
    ----------
    effect : str
        The effect.
    before : State
        Without it.
    after : (m,) array
        Residuals of the equations with it.

    """
    share = (before.near.residual_of_pose(before.fitted.residual - after)) * MG
    if effect == 'offset_step':
        return _instant(before, share)
    needs = ('time',) if effect == 'offset_wander' else EFFECTS[effect].needs
    column = next((key for key in needs if key in COLUMNS and key in before.poses_g), None)
    if column is None:
        return _directions(before.near.force, share)
    return _range(column, before, share)


def _instant(before: State, share: Floats) -> str:
    """Find where successive poses differ most."""
    order = np.argsort(before.poses_g['time'], kind='stable')
    time, moved = before.poses_g['time'][order], share[order]
    count = np.arange(1, len(moved))
    sums = np.cumsum(moved ** 2)[:-1]
    at = int(np.argmax(np.abs(sums / count - (np.sum(moved ** 2) - sums) / (len(moved) - count))))
    rows = before.poses_g.row[order]
    return f'between {time[at]:.6g} and {time[at + 1]:.6g} s (rows {rows[at]} and {rows[at + 1]})'


def _range(column: str, before: State, share: Floats) -> str:
    """Give the range of a quantity and what the disagreement is at its ends."""
    values = before.poses_g[column]
    if values.ndim > 1:
        values = np.linalg.norm(values, axis=1)
    order = np.argsort(values, kind='stable')
    ends = max(1, len(order) // 5)
    low, high = (np.sqrt(np.mean(share[part] ** 2)) for part in (order[:ends], order[-ends:]))
    name = column.replace('_', ' ')
    unit = COLUMNS[column].unit if column != 'std' else 'g'
    return (f'over {name} {values[order[0]]:.4g} to {values[order[-1]]:.4g} {unit}: '
            f'{low:.2g} mg RMS in its lowest fifth, {high:.2g} mg in its highest')


def _directions(force: Floats, share: Floats) -> str:
    """Name the directions in which the disagreement is largest."""
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
