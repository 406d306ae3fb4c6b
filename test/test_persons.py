# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The next step leads any person to a calibration that is done, or to one named reason."""

from collections.abc import Callable
from dataclasses import dataclass, field
import json
from pathlib import Path
import re
import resource
import signal
from typing import Any

from accel_calib.errors import InputError, RefusedFitError
from accel_calib.session import (
    BUTTONS, conditions, diagnostics, enable, figures as health_figures, next_step, progress, run,
    Surroundings, words_of_state)
from driven import Driver, GRAVITY, Person
from inside import spread_directions
import numpy as np
import pytest
from shared import run_json

pytestmark = pytest.mark.usefixtures('home')

OFFSET, GAIN = np.array([0.03, -0.02, 0.05]), np.diag([1.01, 0.99, 1.02])
MOST_SECONDS = 90.0


def reading(axes: Any = None, scale: float = 1.0, gravity: float = 1.0) -> Callable[..., Any]:
    """Return the sensor of a driver with these axes, in another unit, or without gravity."""
    axes = np.eye(3) if axes is None else np.array(axes, float)
    return lambda up, temperature: scale * axes @ (GAIN @ np.asarray(up) * gravity + (
        OFFSET if gravity else 0.0))


def within(degrees: float) -> Callable[[Any], bool]:
    return lambda up: bool(up[2] >= np.cos(np.radians(degrees)))


@dataclass(frozen=True)
class Case:
    """A person: the sensor, what can be done, the last step, and the condition that is named."""

    ends: str
    named: str = ''
    sensor: Callable[..., Any] = reading()
    about: dict[str, Any] = field(default_factory=dict)
    change: Callable[[Driver], object] = lambda driver: None
    refuses: tuple[str, ...] = ()
    seconds: float = MOST_SECONDS


def silent(driver: Driver) -> None:
    feed = driver.feed

    def now(readings: Any, **given: Any) -> None:
        if driver.now < 5.0:
            feed(readings, **given)
        else:
            driver.tick(2.0)

    driver.feed = now


def refused(session: Any) -> Any:
    raise InputError('the disk has no place', 'free some')


def slowed(pace: float) -> Callable[[Driver], object]:
    return lambda driver: setattr(driver, 'pace', pace)


SWAPPED, INVERTED = [[0, 1, 0], [1, 0, 0], [0, 0, 1]], np.diag([1, 1, -1])
TURNED = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]

PERSONS = {
    'flat': Case('done', about={'can_reach': within(0.5)}),
    'tilts by 30°': Case('done', about={'can_reach': within(30.0)}, seconds=60.0),
    'tilts by 12°': Case('done', about={'can_reach': within(12.0)}, seconds=60.0),
    'one axis': Case('done', about={'can_reach': lambda up: abs(up[0]) < 0.1}),
    'swapped': Case('done', 'axes', reading(SWAPPED), seconds=300.0),
    'inverted': Case('done', 'axes', reading(INVERTED), seconds=300.0),
    'turned': Case('done', 'axes', reading(TURNED), seconds=300.0),
    'vibrates': Case('still', 'vibration', about={'shaken': 0.04}),
    'silent': Case('connect', 'no_publisher', change=silent),
    'no clock': Case('connect', 'stamps', change=slowed(0.0)),
    'stamps in ms as ns': Case('connect', 'stamps', change=slowed(1e-6)),
    'stamps in ns as s': Case('connect', 'stamps', change=slowed(1e9)),
    'g as m/s²': Case('unit', 'unit', reading(scale=1.0 / GRAVITY)),
    'mg as m/s²': Case('unit', 'unit', reading(scale=1000.0 / GRAVITY)),
    'no gravity': Case('unit', 'unit', reading(gravity=0.0)),
    'refusing services': Case('fit', refuses=('fit', 'calibrate_at_rest'), seconds=300.0)}


@pytest.mark.parametrize('name', PERSONS)
def test_every_person_ends_in_a_calibration_or_in_one_named_reason(
        name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case, driver = PERSONS[name], Driver()
    case.change(driver)
    for command in case.refuses:
        monkeypatch.setitem(BUTTONS, command, refused)
    person = Person(driver, case.sensor, **case.about)
    seconds = case.seconds if case.ends in ('done', 'fit') else 15.0
    assert person.follow(seconds=seconds) == case.ends, person.steps
    driver.tick()
    found = conditions(driver.session.state)
    assert not case.named or case.named in [each.kind for each in found]
    now, words = progress(driver.session.state), dict(health_figures(driver.session.state))
    assert (now.advice, now.step) == (found[0].next.text, found[0].next.kind)
    assert words['next'] == now.advice
    if case.named:
        wrong = next(each for each in found if each.kind == case.named)
        assert wrong.words in driver.finding('stream').words
        assert wrong.words in driver.logged('warning')
    if case.ends == 'done':
        assert driver.calibration.is_levelled
        gravity = np.linalg.norm(driver.session.state.gravity)
        np.testing.assert_allclose(gravity, GRAVITY, rtol=5e-3)
    assert len(person.called) == len(set(person.called)) or case.ends == 'done'


def test_axes_of_a_driver_are_named_after_two_rests_and_poses_are_asked_for_as_they_read() -> None:
    for axes, words in ((INVERTED, 'the z axis of the readings is probably inverted'),
                        (SWAPPED, '+x reads +y, +y reads +x')):
        driver = Driver(sensor=words[4:9])
        person = Person(driver, reading(axes))
        person.follow(seconds=25.0)
        assert words in driver.logged('warning')
        lines = driver.logged('info').splitlines()
        missed = [line for line in lines if line.startswith('asked for ')]
        assert 2 <= len(missed) <= 4, missed
        assert np.array_equal(driver.sensor.guide.axes, axes)


def test_the_correction_and_the_range_of_the_calibration_come_before_done() -> None:
    driver = Driver(sensor='warm')
    person = Person(driver, lambda up, warm: reading()(up, warm) + 1e-3 * (warm - 25.0),
                    warming=0.5)
    assert person.follow() == 'done'
    assert 'offset_temperature' in driver.calibration.model.effects
    enable(driver.session, False)
    assert next_step(driver.session.state).kind == 'enable'
    enable(driver.session, True)
    person.warming, person.temperature = 0.0, 60.0
    person.rest(person.flat, 4.0)
    action = next_step(driver.session.state)
    assert (action.kind, action.command) == ('poses', 'refine')
    assert conditions(driver.session.state)[0].level == 'USABLE'


def test_a_calibration_that_cannot_be_stored_leaves_no_file_and_is_asked_for_until_it_is(
        home: Path) -> None:
    driver = Driver(sensor='full')
    person = Person(driver, reading())
    for up in spread_directions(16):
        person.rest(up)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
        driver.refuses('could not be stored', 'fit')
        person.rest([0.5, 0.5, -0.7])
        assert 'the poses could not be stored' in diagnostics(driver.session.state)[-1].words
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    folder = driver.session.state.files.store.calibration.parent
    assert [path.name for path in folder.iterdir() if 'before' in path.name] == []
    assert driver.calibration is not None
    action = next_step(driver.session.state)
    assert (action.kind, action.command) == ('save', 'save')
    assert conditions(driver.session.state)[0].level == 'BAD'
    driver.ask('save')
    assert next_step(driver.session.state).kind == 'level'
    assert diagnostics(driver.session.state)[-1].level == 'GOOD'


def test_an_assumed_temperature_is_that_of_messages_and_mounting_and_not_of_drift() -> None:
    followed(warming, warms=1.2, sensor='arm')[0].session.close()
    driver = Driver(sensor='arm')
    feed = driver.feed
    driver.feed = lambda readings, temperature: feed(readings)
    person = Person(driver, warming)
    person.rest([0.2, 0.1, 1.0], 12.0)
    assert driver.sensor.drift.count == 0
    assert 'not compared: the rests have no temperature' in [
        each.words for each in diagnostics(driver.session.state)]
    driver.ask('set_level')
    gravity = driver.session.state.gravity
    reading = warming([0.2, 0.1, 1.0], 25.0) * GRAVITY
    force = driver.sensor.force_of(tuple(reading), driver.session.state.context)
    np.testing.assert_allclose(gravity / GRAVITY, force, atol=1e-3)
    np.testing.assert_allclose(gravity[:2], 0.0, atol=1e-2)


def test_no_pose_is_asked_for_after_the_end_of_a_recording() -> None:
    driver = Driver()
    person = Person(driver, reading())
    driver.session.change(surroundings=Surroundings(publishers=None, ended=True))
    assert next_step(driver.session.state).text.startswith('in another recording, turn the sensor')
    assert words_of_state(driver.session.state) == 'waiting for the first message'
    for up in spread_directions(12):
        person.rest(up)
    assert next_step(driver.session.state).text == 'no more poses can come; call ~/fit'
    assert words_of_state(driver.session.state) == 'no calibration'
    driver.refuses('the samples have ended', 'capture_pose', 'set_level')


def test_a_refusal_that_passes_with_the_moment_is_no_next_step() -> None:
    driver = Driver()
    person = Person(driver, reading())
    for up in spread_directions(12):
        person.rest(up)
    driver.ask('fit')
    step = next_step(driver.session.state)
    driver.now += 0.7
    driver.refuses('arrived 0.7 s ago', 'set_level')
    driver.now -= 0.7
    driver.feed(np.random.default_rng(1).normal(size=(50, 3)) + GRAVITY / 3.0 ** 0.5)
    driver.refuses('is not still|1 g at rest', 'set_level', 'calibrate_at_rest')
    assert next_step(driver.session.state) == step
    assert step.command == 'set_level'


def test_no_step_is_named_while_it_is_being_computed_and_poses_are_counted_at_once() -> None:
    driver = Driver(sensor='rated')
    person = Person(driver, reading())
    for up in spread_directions(16):
        person.rest(up)
    driver.ask('fit')
    lines = len(driver.log)
    driver.session.change_sensor(rating=None)
    person.rest([0.3, 0.3, 0.9])
    action = next_step(driver.session.state)
    assert (action.kind, action.text) == ('', '')
    assert not [line.words for line in driver.log[lines:] if 'next: ' in line.words]
    driver.ask('fit')
    fit, count = run(driver.session, 'fit'), progress(driver.session.state).poses
    next(fit)
    driver.handle = lambda: None  # the choice of the next pose waits for the fit
    person.rest([-0.9, 0.4, 0.2])
    now = progress(driver.session.state)
    assert (now.poses, now.step) == (count + 1, '')


def test_a_step_offers_no_fit_of_the_same_poses_and_names_a_pose_after_each_refusal() -> None:
    driver = Driver()
    person = Person(driver, lambda up, warm: healthy(up, warm) + 0.01 * np.asarray(up)[[1, 2, 1]])
    for up in [*np.eye(3), *-np.eye(3), [0.6, 0.8, 0.0], [0.0, -0.6, 0.8]]:
        person.rest(up)
        if len(driver.poses) < 3:  # both ask for the same pose
            with pytest.raises(RefusedFitError) as refused:
                driver.ask('fit')
            assert refused.value.advice in next_step(driver.session.state).text
    for command in ('fit', 'refine'):
        driver.refuses('not used', command)
        step = next_step(driver.session.state)
        assert (step.kind, len(step.direction)) == ('poses', 3)
        assert '~/fit' not in step.text
    person.rest([0.8, 0.0, 0.6])
    driver.ask('fit')
    assert next_step(driver.session.state).command != 'fit'
    assert dict(health_figures(driver.session.state))['rating'].startswith('USABLE: nothing')
    for up in spread_directions(5):  # in an own order
        person.rest(up)
    missed = driver.sensor.guide.missed
    assert (next_step(driver.session.state).text.count('~/fit'), missed >= 3) == (1, True)
    driver.ask('fit')
    lines = len(driver.log)
    assert next_step(driver.session.state).kind == 'level'
    person.rest([0.5, 0.5, -0.7])  # no pose was asked for
    assert driver.sensor.guide.missed == missed
    assert not [line.words for line in driver.log[lines:] if 'asked for' in line.words]


def test_a_sensor_at_rest_does_not_turn_and_a_quick_turn_does_not_remove_gravity() -> None:
    driver, rng = Driver(), np.random.default_rng(4)

    def feed(up: Any) -> None:
        driver.feed(GRAVITY * (np.array(up) + 0.01 * rng.normal(size=(len(up), 3))))
        driver.tick()
        assert conditions(driver.session.state)[0].step in ('', 'poses')
        assert 'turning' not in next_step(driver.session.state).text

    for seconds in (0.4, 0.8, 0.3, 0.9):
        feed([[0.0, 0.0, 1.0]] * 200)
        driver.stamp += seconds
        feed([[0.0, 0.0, 1.0]] * 20)
    angle = np.linspace(0.0, np.pi, 15)
    feed(np.column_stack([np.sin(angle), 0.0 * angle, np.cos(angle)]))


def test_a_fault_of_the_readings_is_not_one_of_the_calibration_and_no_gyro_has_no_bias() -> None:
    driver, up = Driver(), GRAVITY * np.array([[0.0, 0.0, 1.0]] * 200)
    driver.feed(up, rate=0.0)
    assert 'gyro' not in driver.ask('calibrate_at_rest')
    words = dict(health_figures(driver.session.state))
    assert 'gyro bias [rad/s]' not in words
    assert 'not known' in words['noise of angular velocity [rad/s]']
    for scale in (0.002, 8.0):
        driver.feed(scale * up)
        driver.session.drop('implausible', 'error', '')
        driver.tick()
        assert conditions(driver.session.state)[0].kind == 'unit'
        assert not re.search('calibration|native', driver.finding('stream').words)


# Persons who can do it


EFFECT, healthy = np.array([1e-3, -8e-4, 1.2e-3]), reading()


def warming(up: Any, temperature: float) -> Any:
    return healthy(up, temperature) + EFFECT * (temperature - 25.0)


def followed(read: Any = healthy, *, warms: float = 0.0, flat: Any = (0.0, 0.0, 1.0),
             **parameters: Any) -> tuple[Driver, Person]:
    """Return a session and a person who has followed it to the end."""
    driver = Driver(**parameters)
    person = Person(driver, read, warming=warms, flat=flat)
    assert person.follow() == 'done'
    return driver, person


def figures(driver: Driver) -> dict[str, Any]:
    return json.loads(driver.results[-1])


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


def test_slow_motion_by_hand_is_named_while_a_pose_is_waited_for() -> None:
    driver = Driver()
    Person(driver, healthy).rest([0.0, 0.0, 1.0])
    time = np.arange(0.0, 5.0, 0.02)
    angle = np.radians(0.9) * time
    up = np.column_stack([np.sin(angle), 0.0 * time, np.cos(angle)])
    noise = 0.0005 * np.random.default_rng(1).normal(size=up.shape)
    driver.feed(GRAVITY * (up @ GAIN + OFFSET + noise))
    action = next_step(driver.session.state)
    number, = re.findall(r'([\d.]+) °/s', action.text)
    assert action.kind == 'poses'
    assert abs(float(number) - 0.9) < 0.2


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
    driver.session.change(surroundings=Surroundings(thermometers=('/board/temperature', '/cpu')))
    feed = driver.feed
    driver.feed = lambda readings, temperature: feed(readings)
    person = Person(driver, lambda up, warm: healthy(up, warm) + 3.0 * EFFECT * (warm - 25.0),
                    warming=1.2)
    for up in spread_directions(24)[np.random.default_rng(2).permutation(24)]:
        person.rest(up)
    driver.ask('fit')
    before = driver.calibration
    with pytest.raises(RefusedFitError) as refused:
        driver.ask('refine')
    assert '/board/temperature or /cpu' in refused.value.advice
    assert driver.calibration is before


def test_an_effect_of_time_does_not_warn_for_ever() -> None:
    driver = Driver()
    person = Person(driver, lambda up, warm: healthy(up, warm) * (
        1.01 if driver.stamp > 1030.0 else 1.0))
    for up in spread_directions(30)[np.random.default_rng(3).permutation(30)]:
        person.rest(up)
    driver.ask('refine')
    assert 'gain_step' in driver.calibration.model.effects
    person.rest(person.flat, 60.0)
    driver.tick()
    assert driver.finding('calibration').level == 'GOOD'
    assert 'range' not in driver.logged('warning')
