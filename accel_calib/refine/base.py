# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The model that a refinement begins with."""

from __future__ import annotations

import numpy as np

from ..calibrate import Calibration, fit_poses
from ..calibrate.closed_form import fit_4
from ..calibrate.likelihood import judge
from ..calibrate.quality import in_g, quality_of
from ..errors import RefusedFitError
from ..model import Model
from ..table import Floats, Poses
from ..units import Units

BASES = ('auto', 'ideal', '4', '7', '10', '12')


def base_of(poses: Poses, units: Units, name: str) -> Calibration:
    """Give the calibration to begin with."""
    if name not in BASES:
        raise ValueError(f'base {name!r} is none of {BASES}')
    if name == 'ideal':
        return ideal(poses, units)
    try:
        return fit_poses(poses, units, model=name)
    except RefusedFitError:
        if name == 'auto' and 'orientation' in poses:
            return ideal(poses, units)
        raise


def ideal(poses: Poses, units: Units) -> Calibration:
    """Give the ideal sensor; native readings have no zero, so theirs is found first."""
    values: dict[str, Floats] = {}
    if units.name == 'native':
        mat_w, vec_v = fit_4(poses.reading)
        units = Units('native', float(mat_w[0, 0]))
        values = {'offset': vec_v / units.per_g}
    poses_g = in_g(poses, units)
    model = Model(values)
    fit = judge(model, poses_g.reading, poses_g.columns, poses_g.noise)
    directions = poses_g.reading / np.linalg.norm(poses_g.reading, axis=1, keepdims=True)
    return Calibration('ideal', 'ml', model, units, '', 'ros', '', fit.covariance,
                       quality_of(fit, poses_g, units, directions), poses, (), 'ideal', ())
