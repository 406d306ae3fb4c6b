# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The previous pose of each pose: the context of the effect `hysteresis`."""

from __future__ import annotations

import numpy as np

from ..model import Model
from ..sphere import unit
from ..table import Poses

_MOVED = np.radians(3.0)
"""Smallest change of direction of a move [rad]; less may be noise or settling."""


def with_previous(poses_g: Poses, model: Model) -> Poses:
    """
    Return poses with the unit vector towards the previous pose, in order of time, or of rows.

    If successive poses have the same orientation, the last motion counts for all of them.

    Parameters
    ----------
    poses_g : Poses
        Poses in g. A table that has the column already is returned unchanged.
    model : Model
        Model whose gain and offset are used to compute the directions.

    Returns
    -------
    Poses
        The poses with the column ``previous``; it is zero before the first motion.

    """
    if 'previous' in poses_g:
        return poses_g
    mat_w, vec_v = model.linear_part
    force = unit((poses_g.reading - vec_v) @ np.linalg.inv(mat_w).T)
    order = (np.argsort(poses_g['time'], kind='stable') if 'time' in poses_g
             else np.arange(len(poses_g)))
    previous = np.zeros_like(force)
    towards, resting = np.zeros(3), order[0] if len(order) else 0
    for here in order:
        step = force[resting] - force[here]
        length = float(np.linalg.norm(step))
        if length > _MOVED:
            towards, resting = step / length, here
        previous[here] = towards
    return poses_g.with_columns(previous=previous)
