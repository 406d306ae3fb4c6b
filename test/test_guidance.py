# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The next step of a session leads from the first message to a calibration that is done."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from accel_calib.finding import STEPS
from driven import Driver, Person
from inside import next_action
import numpy as np
import pytest
from shared import run_json

pytestmark = pytest.mark.usefixtures('home')

EFFECT = np.array([1e-3, -8e-4, 1.2e-3])
OFFSET, GAIN = np.array([0.03, -0.02, 0.05]), np.diag([1.01, 0.99, 1.02])


def healthy(up: Any, temperature: float) -> Any:
    return GAIN @ up + OFFSET


def warming(up: Any, temperature: float) -> Any:
    return healthy(up, temperature) + EFFECT * (temperature - 25.0)


def test_a_healthy_sensor_is_done_after_poses_fit_and_level() -> None:
    driver = Driver()
    person = Person(driver, healthy)
    assert person.follow() == 'done'
    assert list(dict.fromkeys(person.steps)) == ['poses', 'fit', 'level', 'done']
    assert driver.session.sensor.rating.name == 'GOOD'
    np.testing.assert_allclose(driver.session.sensor.calibration.offset / 9.80665, OFFSET,
                               atol=1e-3)


def test_an_effect_of_temperature_leads_to_refine_and_is_kept_by_a_fit() -> None:
    driver = Driver()
    person = Person(driver, warming, warming=1.2)
    assert person.follow() == 'done'
    assert 'refine' in person.steps
    refined = driver.session.sensor.calibration
    assert 'offset_temperature' in refined.model.effects
    for up in np.eye(3):
        person.rest(up)
    assert next_action(driver.session).kind == 'done'
    driver.done(driver.session.commands.fit())
    again = driver.session.sensor.calibration
    assert again.model.effects == refined.model.effects
    assert len(again.poses) == len(driver.session.sensor.live.book.poses())
    np.testing.assert_allclose(again.model.values['offset_temperature'][:3],
                               EFFECT, atol=5e-5)
    assert again.is_levelled
    assert next_action(driver.session).kind == 'done'


def test_an_offered_calibration_waits_for_save_and_the_accuracy_needs_noise_alone() -> None:
    driver = Driver(confirm=True)
    person = Person(driver, healthy)
    assert person.follow() == 'done'
    assert list(dict.fromkeys(person.steps)) == ['poses', 'fit', 'accept', 'level', 'done']


def test_each_step_of_a_session_is_one_of_the_known_steps() -> None:
    driver = Driver()
    assert next_action(driver.session).kind == 'connect'
    person = Person(driver, lambda up, temperature: 9.80665 * healthy(up, temperature))
    person.rest(person.flat)
    assert next_action(driver.session).kind == 'unit'
    assert {'connect', 'unit', 'poses', 'fit', 'level', 'accept', 'done'} <= set(STEPS)


def figures(driver: Driver) -> dict[str, Any]:
    return json.loads(driver.results[-1])  # type: ignore[no-any-return]


def test_each_fit_refinement_and_levelling_is_reported_as_on_the_command_line(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    driver = Driver(sensor='arm')
    Person(driver, warming, warming=1.2).follow()
    kinds = [json.loads(text)['next']['kind'] for text in driver.results]
    assert kinds[-1] == 'done'
    assert {'refine', 'level'} <= set(kinds)
    store = driver.session.files.store
    _, fit = run_json(capsys, 'fit', store.poses)
    _, refined = run_json(capsys, 'refine', store.poses)
    found, calibration = figures(driver), driver.session.sensor.calibration
    assert set(found) >= {*fit, *refined} - {'file', 'read_as', 'read_lines'}
    for result in (found, refined):
        assert 'offset_temperature' in [step['effect'] for step in result['steps']]
    assert (found['rating'], found['in_use'], found['verdict']) == ('GOOD', True, 'explained')
    assert found['next'] == {'kind': 'done', 'text': next_action(driver.session).words,
                             'command': ''}
    for key in ('offset', 'gain', 'rotation', 'offset_sd', 'gain_sd'):
        np.testing.assert_allclose(found[key], getattr(calibration, key), atol=1e-12)


def test_an_offered_result_is_reported_as_not_in_use() -> None:
    driver = Driver(confirm=True)
    person = Person(driver, healthy)
    person.follow()
    person.rest(person.flat, 4.0)
    for command in ('calibrate_at_rest', 'set_level'):
        driver.done(getattr(driver.session.commands, command)())
        assert figures(driver)['in_use'] is False
        assert figures(driver)['next']['command'] == '~/save'
    driver.done(driver.session.commands.save())
    assert figures(driver)['in_use'] is True


@pytest.mark.parametrize('command', ['set_level', 'calibrate_at_rest'])
def test_a_mounting_alone_is_reported(command: str) -> None:
    driver = Driver(auto_capture=False)
    Person(driver, healthy).rest([0.1, 0.0, 1.0], 4.0)
    driver.done(getattr(driver.session.commands, command)())
    assert figures(driver)['rotation'][2] != [0.0, 0.0, 1.0]
    assert not driver.logged('error')
