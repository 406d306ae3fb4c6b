# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Persons who do what the guide says, as far as they can: how each of them ends, and when."""

from collections.abc import Iterator
import os
from tempfile import TemporaryDirectory
from unittest.mock import patch

from accel_calib.geometry import ATTITUDES, spread_directions, unit
from accel_calib.session import COMMANDS, conditions
from accel_calib.statistics import rms
from driven import Driver, GRAVITY, Person
from figures import Frame, markdown
import numpy as np
import test_persons


def run_person(name: str, seed: int, number: int) -> tuple[bool, float, float]:
    """Return whether a person ends as expected, when [s], and whether the error holds."""
    case, rng = test_persons.PERSONS[name], np.random.default_rng([seed, number, len(name)])
    test_persons.OFFSET = 0.03 * rng.uniform(-1.0, 1.0, 3)
    test_persons.GAIN = np.eye(3) + 0.015 * np.diag(rng.uniform(-1.0, 1.0, 3))
    with TemporaryDirectory() as home:
        os.environ['ROS_HOME'] = home
        driver = Driver()
        case.change(driver)
        person = Person(driver, case.sensor, **case.about)
        person._rng = rng
        with patch.dict(COMMANDS, dict.fromkeys(case.refuses, test_persons.refused)):
            ended = person.follow(seconds=400.0 if case.ends in ('done', 'fit') else 40.0)
        seconds = person.times[person.steps.index(ended)]
        named = not case.named or case.named in [
            each.kind for each in conditions(driver.session.state)]
        held = np.nan
        if driver.calibration is not None:
            reach = case.about.get('can_reach', lambda up: True)
            up = np.array([(0.0, 0.0, 1.0), *filter(reach, spread_directions(2000))])
            readings = np.array([case.sensor(each, 25.0) for each in up]) * GRAVITY
            force = driver.calibration.correct(readings)
            variance = np.einsum('ni,nij,nj->n', unit(force),
                                 driver.calibration.force_covariance(force), unit(force))
            error = np.linalg.norm(force, axis=1) - GRAVITY
            held = float(rms(error) <= 1.96 * np.sqrt(np.mean(variance)))
        driver.session.close()
    return ended == case.ends and named, seconds, held


def is_told(kind: int, seed: int, number: int) -> bool:
    """Return whether axes are named though the person only turns in an own order."""
    rng = np.random.default_rng([seed, number, kind])
    sides, edges = rng.permutation(ATTITUDES[:6]), rng.permutation(ATTITUDES[6:18])[:6]
    order = (sides, np.vstack([sides, edges]), unit(rng.normal(size=(10, 3))))[kind]
    with TemporaryDirectory() as home:
        os.environ['ROS_HOME'] = home
        driver, told = Driver(), False
        person = Person(driver, test_persons.reading())
        person._rng = rng
        for up in order:
            person.rest(up, 1.4)
            told |= bool(driver.session.sensor.guide.axes_words)
        driver.session.close()
    return told


def persons(frame: Frame, sets: int = 40, seed: int = 1) -> Iterator[str]:
    rows = []
    for name, case in test_persons.PERSONS.items():
        ended, seconds, held = np.array(frame.run_sets(run_person, sets, name, seed), float).T
        known = held[np.isfinite(held)]
        words = case.ends if case.ends == 'done' else f'{case.ends}: {case.named or "refused"}'
        rows.append((name, words, f'{np.sum(ended):.0f} of {sets}', f'{case.seconds:.0f}',
                     f'{np.sum(seconds <= case.seconds):.0f}', f'{np.median(seconds):.0f}',
                     f'{np.sum(known):.0f} of {len(known)}' if len(known) else ''))
    told = frame.run(is_told, [(kind, seed, number) for kind in range(3)
                               for number in range(3 * sets)])
    yield markdown(('person', 'ends', 'as expected', 'limit [s]', 'in time', 'median [s]', 'held'),
                   rows)
    yield (f'Of {len(told)} who turn a sound sensor in an own order of sides, of sides and edges, '
           f'or of any directions, {sum(told)} were told')
