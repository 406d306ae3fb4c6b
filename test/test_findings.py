# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Findings: kinds, levels and rows decide, and no text does."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import accel_calib as ac
from accel_calib.calibrate import Calibration, fit_poses, level
from accel_calib.finding import Finding, KINDS, ranked, without
from accel_calib.findings import figures_of, rate, Rating
from accel_calib.refine import refine
from accel_calib.table import Poses
from accel_calib.units import units_of
from inside import format_calibration, Model, parse_calibration
import numpy as np
import pytest
from shared import random_directions

G = units_of('g')
COMMON = {'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.01, -0.02, 0.015],
          'cross_axis': [0.006, -0.004, 0.005]}


def poses_of(count: int = 24, **options: Any) -> Poses:
    up = random_directions(count, np.random.default_rng(4))
    return ac.simulate(COMMON, directions=up, units='g', **options)


def with_(poses: Poses, row: int, factor: float) -> Poses:
    reading = poses.reading.copy()
    reading[row] *= factor
    return poses.with_columns(reading=reading)


def upside_down() -> Calibration:
    made = fit_poses(poses_of(), G)
    return level(made, made.predict(np.array([[0.0, 0.0, -1.0]]))[0], 'ros')


def mirrored() -> Calibration:
    poses = poses_of(reference=True)
    return fit_poses(poses.with_columns(reading=poses.reading * [1.0, -1.0, 1.0]), G, model='10')


def edited() -> Calibration:
    text = format_calibration(fit_poses(poses_of(), G))
    return parse_calibration(text.replace("sensor: ''", 'sensor: other'), 'x.yaml')


def refined() -> Calibration:
    stored = replace(edited(), sensor='')
    warm = np.linspace(15.0, 35.0, 24)
    return refine(poses_of(temperature=warm), G, base=stored).calibration


RESULTS: dict[str, Callable[[], Calibration]] = {
    'clean': lambda: fit_poses(poses_of(), G),
    'few': lambda: fit_poses(poses_of(10), G, model='10'),
    'one_side': lambda: fit_poses(poses_of(12), G, model='7'),
    'without_noise': lambda: fit_poses(Poses({'reading': poses_of(12).reading},
                                             np.arange(1, 13)), G),
    'a_knock': lambda: fit_poses(with_(poses_of(11), 5, 1.03), G, model='10'),
    'a_large_residual': lambda: fit_poses(
        poses_of().with_columns(std=np.full((24, 3), 1e-6)), G, model='4'),
    'upside_down': upside_down, 'mirrored': mirrored, 'edited': edited, 'refined': refined}


def figures(calibration: Calibration) -> tuple[Any, ...]:
    rating: Rating = rate(calibration)
    return (rating.name, [(each.kind, each.level, each.rows) for each in rating.findings],
            [each.kind for each in calibration.noted], calibration.name,
            calibration.model.vector.tolist(), [each.row for each in calibration.rejected])


@pytest.mark.parametrize('name', RESULTS)
def test_no_result_depends_on_a_text(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected, checked = figures(RESULTS[name]()), Finding.__post_init__

    def reword(self: Finding) -> None:
        checked(self)
        object.__setattr__(self, 'text', 'reworded')
        object.__setattr__(self, 'advice', 'reworded')

    monkeypatch.setattr(Finding, '__post_init__', reword)
    made = RESULTS[name]()
    told = without(rate(made).findings, 'edited', 'heading')  # constants
    assert {each.text for each in told} <= {'reworded'}
    assert figures(made) == expected


def test_the_verdict_is_the_level_of_the_first_finding() -> None:
    found = rate(RESULTS['mirrored']())
    assert found.name == 'BAD'
    assert (found.findings[0].level, found.findings[0].text) == ('BAD', found.reason)


def test_findings_are_ranked_by_level_and_then_by_kind() -> None:
    first, other, *_, last = KINDS
    note, usable = Finding(first, 'a'), Finding(last, 'b', level='USABLE')
    better, bad = Finding(other, 'c', level='USABLE'), Finding(last, 'd', level='BAD')
    assert ranked([note, usable, better, bad]) == (bad, better, usable, note)
    assert without([note, bad], first) == (bad,)


def test_a_kind_that_is_not_listed_is_refused() -> None:
    with pytest.raises(ValueError, match="'surprise'"):
        Finding('surprise', 'what')


def test_the_figures_of_a_calibration_are_those_of_its_fields() -> None:
    effects = {**COMMON, 'quadratic': [0.004, -0.003, 0.005]}
    poses = ac.simulate(effects, directions=random_directions(40, np.random.default_rng(4)),
                        units='m/s2', noise=1e-4)
    calibration = refine(poses, units_of('m/s2')).calibration
    found = {figure.key: figure for figure in figures_of(calibration)}
    assert found['rms_after_mg'].value == calibration.quality.rms_after_mg
    assert found['max_before_mg'].value == 10.0 * calibration.quality.max_before_percent
    assert found['offset.x'].value == calibration.offset[0]
    assert found['offset.x'].unit == 'm/s²'
    assert found['gain.xy'].sd == calibration.gain_sd[0, 1]
    assert 'gain.yx' not in found  # the same value as gain.xy
    row = calibration.parameters.index('quadratic.z')
    assert found['quadratic.z'].value == 1000.0 * calibration.model.vector[row]
    assert found['quadratic.z'].unit == 'mg/g²'


def test_a_gain_that_is_not_fitted_is_a_figure_without_deviation() -> None:
    calibration = ac.fit(poses_of().reading, units='g')
    fixed = replace(calibration, model=Model({'offset': calibration.offset}),
                    covariance=calibration.covariance[:3, :3])
    found = {figure.key: figure for figure in figures_of(fixed)}
    assert (found['gain.x'].value, found['gain.x'].sd) == (1.0, 0.0)
    assert 'gain.xy' not in found


def test_figures_that_are_not_known_are_left_out() -> None:
    keys = [figure.key for figure in figures_of(ac.fit(poses_of().reading, units='g'))]
    assert 'noise_floor_mg' not in keys
    assert 'rms_after_mg' in keys
