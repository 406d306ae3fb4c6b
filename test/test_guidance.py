# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The next step of a session leads from the first message to a calibration that is done."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from accel_calib.errors import RefusedFitError
from accel_calib.finding import STEPS
from driven import Driver, Person
from inside import next_action, spread_directions
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


def degrees_from_flat(up: Any) -> float:
    return float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))


@pytest.mark.parametrize(('reach', 'command'), [(10.0, 'fit'), (0.5, 'calibrate_at_rest')])
def test_a_robot_that_cannot_be_turned_over_is_offered_what_its_poses_carry(
        reach: float, command: str) -> None:
    driver = Driver()
    person = Person(driver, healthy, can_reach=lambda up: degrees_from_flat(up) <= reach)
    tilt = np.sin(np.radians(reach - 0.1))
    for x, y in ((tilt, 0.0), (-tilt, 0.0), (0.0, tilt), (0.0, -tilt)):
        person.rest([x, y, np.sqrt(1.0 - tilt ** 2)])
    assert person.follow() == 'done', person.steps
    assert [name for name in person.called if name != 'set_level'] == [command]
    assert driver.session.sensor.calibration.is_levelled
    error = driver.session.sensor.gravity - [0.0, 0.0, 9.80665]
    np.testing.assert_allclose(error, 0.0, atol=0.05)


def test_slow_motion_by_hand_is_named_while_a_pose_is_waited_for() -> None:
    driver = Driver()
    Person(driver, healthy).rest([0.0, 0.0, 1.0])
    time = np.arange(0.0, 5.0, 0.02)
    angle = np.radians(0.9) * time
    up = np.column_stack([np.sin(angle), 0.0 * time, np.cos(angle)])
    noise = 0.0005 * np.random.default_rng(1).normal(size=up.shape)
    driver.feed(9.80665 * (up @ GAIN + OFFSET + noise))
    action = next_action(driver.session)
    assert action.kind == 'poses'
    assert action.words.startswith('turning slowly, ')
    assert action.words.split('; ')[0].endswith(' °/s: rest it on something')
    assert float(action.words.split()[2]) == pytest.approx(0.9, abs=0.2)
    driver.session.tick()
    driver.handle()
    assert 'no pose yet: turning slowly' in driver.logged('info')


def test_an_upside_down_sensor_is_asked_about_once() -> None:
    driver = Driver(sensor='arm')
    person = Person(driver, healthy, flat=(0.0, 0.0, -1.0))
    assert person.follow() == 'done'
    assert person.steps.count('level') == 2
    assert driver.session.sensor.rating.name == 'GOOD'
    driver.session.close()
    again = Driver(sensor='arm')
    assert again.session.sensor.calibration is not None
    assert not again.logged('warning')


def test_a_given_mounting_answers_whether_the_sensor_is_upside_down() -> None:
    driver = Driver(mounting_rpy=[np.pi, 0.0, 0.0])
    person = Person(driver, healthy, flat=(0.0, 0.0, -1.0))
    assert person.follow() == 'done'
    person.rest(person.flat, 4.0)
    driver.done(driver.session.commands.set_level())
    assert driver.session.sensor.rating.name == 'GOOD'
    assert 'upside down' not in driver.logged('warning')


def test_an_effect_far_beyond_those_of_parts_is_reported_and_not_used() -> None:
    driver = Driver()
    driver.session.thermometers = ('/board/temperature', '/cpu')
    person = Person(driver, warming, warming=1.2)
    fast = 3.0 * EFFECT

    def unseen(up: Any, temperature: float) -> Any:
        return healthy(up, temperature) + fast * (temperature - 25.0)

    person.sensor = unseen
    feed = driver.feed
    driver.feed = lambda readings, temperature=0.0: feed(readings)
    for up in spread_directions(24)[np.random.default_rng(2).permutation(24)]:
        person.rest(up)
    driver.done(driver.session.commands.fit())
    before = driver.session.sensor.calibration
    with pytest.raises(RefusedFitError, match='times that of typical parts') as refused:
        driver.done(driver.session.commands.refine())
    assert '/board/temperature or /cpu' in refused.value.advice
    assert driver.session.sensor.calibration is before
    driver.session.tick()
    driver.handle()
    assert 'temperature:=/board/temperature or /cpu' in driver.logged('warning')


def test_answers_are_short_and_the_log_and_the_result_have_the_details() -> None:
    driver = Driver(sensor='arm')
    person = Person(driver, warming, warming=1.2)
    person.follow()
    answers = []
    for command in ('calibrate_at_rest', 'set_level', 'fit', 'refine'):
        person.rest(person.flat, 4.0)
        answers.append(driver.done(getattr(driver.session.commands, command)()))
    assert all(0 < len(answer) < 250 and '; next: ' in answer for answer in answers), answers
    assert all('arm.yaml' not in answer and 'changes offset' not in answer for answer in answers)
    store = driver.session.files.store
    assert driver.logged('info').count(f'stored in {store.calibration}') >= len(answers)
    assert 'changes offset by' in driver.logged('info')
    assert 'static_transform_publisher --roll' in driver.logged('info')
    assert figures(driver)['mounting']['urdf'] in driver.logged('info')


def test_the_heading_by_a_raised_nose_is_questioned() -> None:
    driver = Driver()
    person = Person(driver, healthy)
    assert person.follow() == 'done'
    person.rest([0.5, 0.0, 0.8], 4.0)
    assert 'if the nose was up' in driver.done(driver.session.commands.set_heading())
    person.rest([0.5, 0.0, 0.8], 4.0)
    assert 'if the nose was up' not in driver.done(driver.session.commands.set_heading())


def test_a_correction_that_is_switched_off_is_a_warning() -> None:
    driver = Driver()
    assert Person(driver, healthy).follow() == 'done'
    assert driver.finding('calibration').level == 0
    driver.session.commands.enable(False)
    assert driver.finding('calibration').level == 1
    assert 'call ~/enable' in driver.finding('calibration').words


def test_an_effect_of_time_does_not_warn_for_ever() -> None:
    driver = Driver()

    def stepping(up: Any, temperature: float) -> Any:
        return (1.01 if driver.stamp > 1030.0 else 1.0) * np.asarray(healthy(up, temperature))

    person = Person(driver, stepping)
    for up in spread_directions(30)[np.random.default_rng(3).permutation(30)]:
        person.rest(up)
    driver.done(driver.session.commands.refine())
    assert 'gain_step' in driver.session.sensor.calibration.model.effects
    person.rest(person.flat, 60.0)
    driver.session.tick()
    driver.handle()
    assert driver.finding('calibration').level == 0
    assert 'has left the range' not in driver.logged('warning')


def test_a_wrong_topic_names_those_that_exist() -> None:
    driver = Driver()
    driver.session.imus = ('/camera/imu',)
    assert next_action(driver.session).words.endswith('its topic, such as /camera/imu')
