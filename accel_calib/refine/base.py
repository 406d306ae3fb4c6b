# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The base: the model that a refinement starts from."""

from __future__ import annotations

from ..calibrate import Calibration, fit_poses, in_g
from ..calibrate.quality import quality_of
from ..errors import RefusedFitError
from ..estimate.closed_form import fit_4
from ..estimate.fit import judge
from ..model import Model
from ..sphere import unit
from ..table import Floats, Poses
from ..units import Units

BASES = ('auto', 'ideal', '4', '7', '10', '12')


def base_of(poses: Poses, units: Units, name: str) -> Calibration:
    """Return the base as a calibration; errors as in `fit_poses`."""
    if name not in BASES:
        raise ValueError(f'base is {name!r}, expected one of {BASES}')
    if name == 'ideal':
        return ideal(poses, units)
    try:
        return fit_poses(poses, units, model=name)
    except RefusedFitError:
        if name == 'auto' and 'orientation' in poses:
            return ideal(poses, units)
        raise


def ideal(poses: Poses, units: Units) -> Calibration:
    """Return the ideal sensor; for native readings with a fitted offset and scale."""
    values: dict[str, Floats] = {}
    if units.name == 'native':
        mat_w, vec_v = fit_4(poses.reading)
        units = Units('native', float(mat_w[0, 0]))
        values = {'offset': vec_v / units.per_g}
    poses_g = in_g(poses, units)
    fit = judge(Model(values), poses_g)
    return Calibration('ideal', 'ml', fit.model, units, '', 'ros', '', fit.covariance,
                       quality_of(fit, units, unit(poses_g.reading)), poses, (), 'ideal', ())
