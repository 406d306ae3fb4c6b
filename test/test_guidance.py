# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The next step of a session leads from the first message to a calibration that is done."""

from __future__ import annotations

from typing import Any

from accel_calib.finding import STEPS
from driven import Driver, Person
from inside import next_action
import numpy as np
import pytest

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
