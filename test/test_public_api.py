# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Members of the public records that the other tests do not call."""

from __future__ import annotations

import accel_calib as ac
import numpy as np
import pytest


@pytest.fixture(scope='module')
def refinement() -> ac.Refinement:
    """Return the refinement of poses with an effect of the temperature, 10 to 50 °C."""
    poses = ac.simulate({'offset': [0.02, -0.01, 0.03], 'offset_temperature': [1e-3, 2e-3, -1e-3]},
                        poses=40, temperature=(10.0, 50.0), noise=1e-3, seed=1)
    return ac.refine(poses, base='10')


def test_stages_are_the_residuals_behind_the_gap(refinement: ac.Refinement) -> None:
    assert [each.name for each in refinement.stages] == ['base', 'offset_temperature']
    rms = [np.sqrt(np.mean(each.residual_mg ** 2)) for each in refinement.stages]
    assert rms == pytest.approx([refinement.gap_mg, refinement.remaining_gap_mg])


def test_typical_context_is_the_middle_of_the_ranges_at_rest(refinement: ac.Refinement) -> None:
    known = refinement.calibration.typical_context(3)
    np.testing.assert_array_equal(known['temperature'], [30.0] * 3)
    np.testing.assert_array_equal(known['rate'], np.zeros((3, 3)))
    np.testing.assert_array_equal(known['std'], np.zeros((3, 3)))


def test_a_temperature_beyond_the_ranges_is_held_at_their_limit(
        refinement: ac.Refinement) -> None:
    poses = refinement.calibration.poses.take(np.arange(3))
    beyond = poses.with_columns(temperature=np.array([-20.0, 25.0, 90.0]))
    held = refinement.calibration.held(beyond)
    np.testing.assert_array_equal(held['temperature'], [10.0, 25.0, 50.0])
    np.testing.assert_array_equal(held.reading, beyond.reading)
    np.testing.assert_array_equal(beyond['temperature'], [-20.0, 25.0, 90.0])
    known = refinement.calibration.held_context({'temperature': beyond['temperature']})
    np.testing.assert_array_equal(known['temperature'], held['temperature'])
