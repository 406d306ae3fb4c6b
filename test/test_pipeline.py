# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The plan of a fit beside a calibration that is in use."""

from dataclasses import replace

import accel_calib as ac
from accel_calib.errors import RefusedFitError
from inside import calibrated_by, FitPlan, is_partial
import numpy as np
import pytest
from shared import MPS2, SENSOR

PLAN = FitPlan(model='10', refined=False)


def test_frame_and_mounting_of_the_calibration_in_use_are_kept() -> None:
    first, second = (ac.simulate(SENSOR, poses=16, seed=seed) for seed in (1, 2))
    assert not calibrated_by(second, MPS2, PLAN).calibration.is_levelled
    before = calibrated_by(first, MPS2, replace(PLAN, flat=3, frame='android')).calibration
    after = calibrated_by(second, MPS2, replace(PLAN, before=before)).calibration
    assert after.frame == before.frame
    np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-3)
    moved = calibrated_by(second, MPS2, replace(PLAN, before=before, flat=5)).calibration
    assert np.max(np.abs(moved.rotation - before.rotation)) > 0.1


def test_poses_near_one_direction_are_fitted_if_planned_and_replace_no_full_fit() -> None:
    tilts = np.array([[0, 0], [0.25, 0], [-0.2, 0.1], [0, 0.25], [0.1, -0.25], [-0.15, -0.2]])
    cone = ac.simulate(SENSOR, directions=np.column_stack([tilts, np.ones(len(tilts))]))
    with pytest.raises(RefusedFitError):
        calibrated_by(cone, MPS2, PLAN)
    partial = calibrated_by(cone, MPS2, replace(PLAN, partial=True)).calibration
    assert is_partial(partial)
    again = calibrated_by(cone, MPS2, replace(PLAN, partial=True, before=partial)).calibration
    assert is_partial(again)
    full = calibrated_by(ac.simulate(SENSOR, poses=16), MPS2, PLAN).calibration
    with pytest.raises(RefusedFitError):
        calibrated_by(cone, MPS2, replace(PLAN, partial=True, before=full))
