# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The next step of a session leads from the first message to a calibration that is done."""

import json
from typing import Any

from accel_calib.errors import RefusedFitError
from accel_calib.session import enable, next_step, Surroundings
from driven import Driver, GRAVITY, Person
from inside import spread_directions
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


def followed(reading: Any = healthy, *, warms: float = 0.0, flat: Any = (0.0, 0.0, 1.0),
             **parameters: Any) -> tuple[Driver, Person]:
    """Return a session and a person who has followed it to the end."""
    driver = Driver(**parameters)
    person = Person(driver, reading, warming=warms, flat=flat)
    assert person.follow() == 'done'
    return driver, person


def figures(driver: Driver) -> dict[str, Any]:
    return json.loads(driver.results[-1])


def test_a_healthy_sensor_is_done_after_poses_fit_and_level() -> None:
    driver, person = followed()
    assert list(dict.fromkeys(person.steps)) == ['poses', 'fit', 'level', 'done']
    assert driver.sensor.rating.name == 'GOOD'
    np.testing.assert_allclose(driver.calibration.offset / GRAVITY, OFFSET, atol=1e-3)
    assert driver.finding('calibration').level == 'GOOD'
    enable(driver.session, False)
    assert driver.finding('calibration').level == 'USABLE'
    assert 'call ~/enable' in driver.finding('calibration').words


def test_an_effect_of_temperature_leads_to_refine_and_is_kept_by_a_fit() -> None:
    driver, person = followed(warming, warms=1.2)
    assert 'refine' in person.steps
    refined = driver.calibration
    assert 'offset_temperature' in refined.model.effects
    for up in np.eye(3):
        person.rest(up)
    assert next_step(driver.session.state).kind == 'poses'  # far above the range of the poses
    driver.ask('fit')
    again = driver.calibration
    assert again.model.effects == refined.model.effects
    assert not np.array_equal(again.model.vector, refined.model.vector)
    assert len(again.poses) == len(driver.poses)
    np.testing.assert_allclose(again.model.values['offset_temperature'][:3], EFFECT, atol=5e-5)
    assert again.is_levelled
    assert next_step(driver.session.state).kind == 'done'


def test_without_messages_or_in_another_unit_the_stream_comes_first() -> None:
    driver = Driver()
    assert next_step(driver.session.state).kind == 'connect'
    driver.session.change(surroundings=Surroundings(imus=('/camera/imu',)))
    assert next_step(driver.session.state).text.endswith(' /camera/imu')
    person = Person(driver, lambda up, temperature: GRAVITY * healthy(up, temperature))
    person.rest(person.flat)
    assert next_step(driver.session.state).kind == 'unit'


def test_each_fit_refinement_and_levelling_is_reported_as_on_the_command_line(
        capsys: pytest.CaptureFixture[str]) -> None:
    driver, person = followed(warming, warms=1.2, sensor='arm')
    kinds = [json.loads(text)['next']['kind'] for text in driver.results]
    assert kinds[-1] == 'done'
    assert {'refine', 'level'} <= set(kinds)
    store = driver.session.state.files.store
    _, fit = run_json(capsys, 'fit', store.poses)
    _, refined = run_json(capsys, 'refine', store.poses)
    found, calibration = figures(driver), driver.calibration
    assert set(found) >= {*fit, *refined} - {'file', 'read_as', 'read_lines'}
    for result in (found, refined):
        assert 'offset_temperature' in [step['effect'] for step in result['steps']]
    assert (found['rating'], found['in_use'], found['verdict']) == ('GOOD', True, 'explained')
    assert found['next'] == {'kind': 'done', 'text': next_step(driver.session.state).text,
                             'command': ''}
    for key in ('offset', 'gain', 'rotation', 'offset_sd', 'gain_sd'):
        np.testing.assert_allclose(found[key], getattr(calibration, key), atol=1e-12)
    answers = []  # they are short: the log and the result have the details
    for command in ('calibrate_at_rest', 'set_level', 'fit', 'refine'):
        person.rest(person.flat, 4.0)
        answers.append(driver.ask(command))
    assert all(0 < len(answer) < 250 and '; next: ' in answer for answer in answers), answers
    assert all('arm.yaml' not in answer and 'changes offset' not in answer for answer in answers)
    logged = driver.logged('info')
    assert logged.count(f'stored in {store.calibration}') >= len(answers)
    assert figures(driver)['mounting']['urdf'] in logged


def test_an_offered_calibration_waits_for_save_and_is_reported_as_not_in_use() -> None:
    driver, person = followed(confirm=True)
    assert list(dict.fromkeys(person.steps)) == ['poses', 'fit', 'accept', 'level', 'done']
    person.rest(person.flat, 4.0)
    for command in ('calibrate_at_rest', 'set_level'):
        driver.ask(command)
        assert figures(driver)['in_use'] is False
        assert figures(driver)['next']['command'] == '~/save'
    driver.ask('save')
    assert figures(driver)['in_use'] is True


@pytest.mark.parametrize('command', ['set_level', 'calibrate_at_rest'])
def test_a_mounting_alone_is_reported(command: str) -> None:
    driver = Driver(auto_capture=False)
    Person(driver, healthy).rest([0.1, 0.0, 1.0], 4.0)
    driver.ask(command)
    assert figures(driver)['rotation'][2] != [0.0, 0.0, 1.0]
    assert not driver.logged('error')


def test_slow_motion_by_hand_is_named_while_a_pose_is_waited_for() -> None:
    driver = Driver()
    Person(driver, healthy).rest([0.0, 0.0, 1.0])
    time = np.arange(0.0, 5.0, 0.02)
    angle = np.radians(0.9) * time
    up = np.column_stack([np.sin(angle), 0.0 * time, np.cos(angle)])
    noise = 0.0005 * np.random.default_rng(1).normal(size=up.shape)
    driver.feed(GRAVITY * (up @ GAIN + OFFSET + noise))
    action = next_step(driver.session.state)
    assert action.kind == 'poses'
    assert action.text.startswith('turning slowly, ')
    number, unit = action.text.split()[2:4]
    assert (float(number), unit) == (pytest.approx(0.9, abs=0.2), '°/s:')
    driver.tick()
    assert 'turning slowly' in driver.logged('info')


def test_an_upside_down_sensor_is_asked_about_once_unless_its_mounting_is_given() -> None:
    driver, person = followed(flat=(0.0, 0.0, -1.0), sensor='arm')
    assert person.steps.count('level') == 2
    assert driver.sensor.rating.name == 'GOOD'
    driver.session.close()
    again = Driver(sensor='arm')
    assert again.calibration is not None
    assert not again.logged('warning')
    given, person = followed(flat=(0.0, 0.0, -1.0), mounting_rpy=[np.pi, 0.0, 0.0])
    person.rest(person.flat, 4.0)
    given.ask('set_level')
    assert given.sensor.rating.name == 'GOOD'
    assert 'upside down' not in given.logged('warning')


def test_an_effect_far_beyond_those_of_parts_is_reported_and_not_used() -> None:
    driver = Driver()
    driver.session.change(surroundings=Surroundings(
        thermometers=('/board/temperature', '/cpu')))

    def unseen(up: Any, temperature: float) -> Any:
        return healthy(up, temperature) + 3.0 * EFFECT * (temperature - 25.0)

    feed = driver.feed
    driver.feed = lambda readings, temperature: feed(readings)
    person = Person(driver, unseen, warming=1.2)
    for up in spread_directions(24)[np.random.default_rng(2).permutation(24)]:
        person.rest(up)
    driver.ask('fit')
    before = driver.calibration
    with pytest.raises(RefusedFitError, match='times that of typical parts') as refused:
        driver.ask('refine')
    assert '/board/temperature or /cpu' in refused.value.advice
    assert driver.calibration is before
    driver.tick()
    assert 'temperature:=/board/temperature or /cpu' in driver.logged('warning')


def test_the_heading_by_a_raised_nose_is_questioned() -> None:
    driver, person = followed()
    for questioned in (True, False):
        person.rest([0.5, 0.0, 0.8], 4.0)
        assert ('nose was up' in driver.ask('set_heading')) is questioned


def test_an_effect_of_time_does_not_warn_for_ever() -> None:
    driver = Driver()

    def stepping(up: Any, temperature: float) -> Any:
        return (1.01 if driver.stamp > 1030.0 else 1.0) * np.asarray(healthy(up, temperature))

    person = Person(driver, stepping)
    for up in spread_directions(30)[np.random.default_rng(3).permutation(30)]:
        person.rest(up)
    driver.ask('refine')
    assert 'gain_step' in driver.calibration.model.effects
    person.rest(person.flat, 60.0)
    driver.tick()
    assert driver.finding('calibration').level == 'GOOD'
    assert 'range' not in driver.logged('warning')
