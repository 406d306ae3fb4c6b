# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Commands that overlap: each sees what those before it stored, and answers when it has stored."""

from collections.abc import Callable, Iterator
from queue import Queue
import time
from typing import Any

from accel_calib.errors import AccelCalibError
from accel_calib.session import answered, Compute, Files, nothing, run, Task
from driven import Driver
from inside import spread_directions, Worker
import pytest
from shared import Readings

pytestmark = pytest.mark.usefixtures('home')


class Loop:
    """The thread of a session, with the worker of its commands."""

    def __init__(self, driver: Driver) -> None:
        self._calls = Queue[Any]()
        self.worker = Worker(driver.session.events, self._calls.put, lambda event: None)

    def answer(self, *commands: tuple[str, Task], look: Callable[[], Any] = nothing) -> list[Any]:
        """Begin commands at once, and return what is seen when each is answered with success."""
        found: list[Any] = []

        def answered(success: bool, words: Any) -> None:
            assert success, words
            found.append(look())

        for name, task in commands:
            self.worker.do(name, task, answered)
        while len(found) < len(commands):
            self._calls.get(timeout=60.0)()
        return found


@pytest.fixture
def driver(readings: Readings) -> Driver:
    """Return a session with two calibrations, poses, and a sensor at rest."""
    made = Driver(sensor='arm')
    made.feed(readings(spread_directions(12)))
    made.ask('fit')
    made.feed(readings([[0.0, 0.0, 1.0]], dwell=4.0))
    made.ask('set_level')
    return made


@pytest.fixture
def loop(driver: Driver) -> Iterator[Loop]:
    made = Loop(driver)
    yield made
    made.worker.close()


def test_a_fit_is_discarded_if_another_command_has_changed_the_calibration_meanwhile(
        driver: Driver) -> None:
    path, after = driver.session.state.files.store.calibration, list[Any]()

    def state() -> Any:
        return driver.calibration, path.exists() and path.read_bytes()

    def asked_during_a_fit(other: str) -> str:
        def ask() -> None:
            driver.ask(other)
            after.append(state())

        others = iter([ask])
        return answered(run(driver.session, 'fit'), lambda: next(others, nothing)())

    for other in ('save', 'capture_pose', 'undo_pose', 'enable'):
        assert asked_during_a_fit(other)
        assert state()[0] is not after[-1][0]
    for other in ('fit', 'calibrate_at_rest', 'load', 'undo', 'reset'):
        with pytest.raises(AccelCalibError, match='another command changed the calibration'):
            asked_during_a_fit(other)
        assert (state(), driver.session.state.refusal_of('fit')) == (after[-1], '')
    assert driver.session.state.computing == 0


def test_what_is_answered_is_stored(driver: Driver, loop: Loop) -> None:
    store = driver.session.state.files.store

    def values_of(calibration: Any) -> Any:
        return calibration and [calibration.model.vector.tolist(), calibration.rotation.tolist()]

    def stored() -> Any:
        return values_of(store.load_calibration()), len(store.load_poses() or ())

    for name in ('undo_pose', 'capture_pose', 'fit', 'set_level', 'calibrate_at_rest', 'save',
                 'undo', 'load', 'reset'):
        found, = loop.answer((name, run(driver.session, name)), look=stored)
        assert found == (values_of(driver.calibration), len(driver.poses)), name


@pytest.mark.parametrize(('step', 'expected'), [
    (Files, ['begun', 'done', 'other', 'stored']),
    (Compute, ['begun', 'other', 'stored', 'done'])])
def test_a_command_begins_when_no_files_are_used_and_does_not_wait_for_a_computation(
        step: Any, expected: list[str], loop: Loop) -> None:
    seen = []

    def first() -> Task:
        seen.append('begun')
        yield step(time.sleep, 0.5)
        seen.append('done')

    def second() -> Task:
        seen.append('other')
        yield Files(nothing)
        seen.append('stored')

    loop.answer(('first', first()), ('second', second()))
    assert seen == expected
