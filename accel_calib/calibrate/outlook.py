# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
"""What the poses of a calibration determine, and which pose would better it most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .calibration import Calibration
from .geometry import pose_noise
from .identifiability import Identifiability, identifiability
from .next_pose import next_pose, NextPose
from ..sphere import spread_directions
from ..table import Floats
from ..units import MG


@dataclass(frozen=True)
class Outlook:
    """
    How a calibration could be better.

    Parameters
    ----------
    identifiability : Identifiability
        Of the model that was asked for; of the largest where the choice was free.
    next_pose : NextPose
        Planned for that model.
    uncertainty_mg : float or None
        Stated error of a corrected |force| (model 12: of the force), RMS over the sphere [mg];
        None where the poses leave nothing to judge it by.

    """

    identifiability: Identifiability
    next_pose: NextPose
    uncertainty_mg: float | None


def outlook(calibration: Calibration, asked: str = 'auto') -> Outlook:
    """
    Look at the poses of a calibration again, as its result shows them.

    Parameters
    ----------
    calibration : Calibration
        Of the linear models, as `accel_calib.calibrate.fit_poses` gives it.
    asked : {'auto', '4', '7', '9', '10', '12'}
        The model that was asked for.

    """
    left_out = [rejected.row for rejected in calibration.rejected]
    poses = calibration.poses.take(~np.isin(calibration.poses.row, left_out))
    mat_w, vec_v = calibration.model.linear_part
    force = np.linalg.solve(mat_w, (calibration.units.to_g(poses.reading) - vec_v).T).T
    directions = force / np.linalg.norm(force, axis=1, keepdims=True)
    noise = pose_noise(poses.noise, directions)
    uncertainty = _uncertainty(calibration)
    planned = asked
    if asked in ('auto', '12'):  # where the orientations turned out wrong, 12 became a norm model
        planned = '12' if calibration.name == '12' else '10'
    fitted = identifiability(calibration.name, directions, noise).mean_dilution
    known = np.isfinite(uncertainty)
    noise_g = uncertainty / fitted if known and np.isfinite(fitted) else None
    return Outlook(identifiability(planned, directions, noise),
                   next_pose(directions, planned, noise, noise_g=noise_g),
                   uncertainty * MG if known else None)


def _uncertainty(calibration: Calibration) -> float:
    """Give the stated error of a corrected force, RMS over the sphere [g]."""
    up: Floats = spread_directions(300)
    per_g = calibration.force_per_g
    covariance = calibration.force_covariance(up * per_g) / per_g ** 2
    errors = (np.trace(covariance, axis1=1, axis2=2) if calibration.name == '12'
              else np.einsum('ni,nij,nj->n', up, covariance, up))
    return float(np.sqrt(np.mean(errors)))
