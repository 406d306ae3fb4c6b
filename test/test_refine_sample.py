# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A refinement of a long table uses a sample of its poses, and states it."""

from __future__ import annotations

from accel_calib.refine import refine
from accel_calib.table import numbered, Poses
from accel_calib.units import units_of
from inside import LARGEST_SAMPLE, model_with, MOST_SAMPLED_POSES, sampled, simulate_poses
import numpy as np
import pytest


def table(count: int, **columns: np.ndarray) -> Poses:
    reading = np.random.default_rng(2).normal(size=(count, 3))
    return Poses({'reading': reading, **columns}, numbered({'reading': reading}))


def test_a_table_of_usual_length_is_used_whole() -> None:
    poses = table(MOST_SAMPLED_POSES)
    assert sampled(poses) is poses


@pytest.mark.parametrize('period', [2, 3, 6, 8, 24])
def test_a_sample_has_all_turns_of_a_table_that_repeats_them(period: int) -> None:
    found = sampled(table(16_000))
    assert len(found) == MOST_SAMPLED_POSES
    share = np.bincount(found.row % period) / len(found)
    np.testing.assert_allclose(share, 1.0 / period, atol=0.1 / period)
    assert np.all(np.diff(found.row) > 0)
    assert np.max(np.diff(found.row)) <= 16


def test_poses_that_share_their_orientation_stay_together() -> None:
    found = sampled(table(16_000, orientation=np.arange(16_000) // 4))
    assert len(found) <= MOST_SAMPLED_POSES // 3
    assert np.all(np.unique(found['orientation'], return_counts=True)[1] == 4)
    assert len(sampled(table(16_000, orientation=np.zeros(16_000)))) == MOST_SAMPLED_POSES // 3


def test_few_new_poses_beside_many_of_a_stored_calibration_are_all_used() -> None:
    found = sampled(table(16_000, new=(np.arange(16_000) < 30).astype(float)))
    assert np.sum(found['new']) == 30
    assert len(found) == MOST_SAMPLED_POSES + 30


def test_a_long_table_is_refined_from_a_sample_and_says_so(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*LARGEST_SAMPLE, 400)
    rng, count = np.random.default_rng(4), 1000
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, np.newaxis]
    truth = model_with({'offset': np.array([0.03, -0.02, 0.04]),
                        'quadratic': np.array([2e-3, -1e-3, 3e-3])})
    found = refine(simulate_poses(truth, directions, rng), units_of('g'))
    assert 'quadratic' in [step.effect for step in found.steps]
    assert 'uses 400 of 1000 poses' in found.calibration.warnings[0]
    np.testing.assert_allclose(found.calibration.model.values['quadratic'],
                               truth.values['quadratic'], atol=5e-4)
