# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From where each pose was reached: what hysteresis needs beside the reading."""

from __future__ import annotations

import numpy as np

from ..model import Model
from ..table import Poses

_MOVED = 1e-3
"""Change of the unit force from which a pose is another one."""


def with_approach(poses_g: Poses, model: Model) -> Poses:
    """
    Add the unit vector towards the pose before, in the order of time or else of the rows.

    Parameters
    ----------
    poses_g : Poses
        In g; those that have it already are given back as they are.
    model : Model
        Whose gain and offset tell the directions well enough.

    """
    if 'approach' in poses_g:
        return poses_g
    mat_w, vec_v = model.linear_part
    force = np.linalg.solve(mat_w, (poses_g.reading - vec_v).T).T
    force = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-300)
    order = (np.argsort(poses_g['time'], kind='stable') if 'time' in poses_g
             else np.arange(len(poses_g)))
    steps = np.diff(force[order], axis=0, prepend=force[order][:1])
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    approach = np.zeros_like(force)
    approach[order] = -steps / np.where(lengths > _MOVED, lengths, np.inf)
    return poses_g.with_columns(approach=approach)
