# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The pose before each pose: what hysteresis needs beside the reading."""

from __future__ import annotations

import numpy as np

from ..model import Model
from ..sphere import unit
from ..table import Poses

_MOVED = np.radians(3.0)
"""Change of direction from which the sensor was moved [rad]; less may be noise or settling."""


def with_previous(poses_g: Poses, model: Model) -> Poses:
    """
    Add the unit vector towards the previous pose, in the order of time or else of the rows.

    A pose in the orientation of the one before it was reached by the same motion.

    Parameters
    ----------
    poses_g : Poses
        In g; poses that have the column are returned as they are.
    model : Model
        Its gain and offset give the directions.

    Returns
    -------
    Poses
        With the column ``previous``: zero for the first pose and those that did not move from it.

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
