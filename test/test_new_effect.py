# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A new effect takes one entry in the catalogue, one definition of a user, or one column.

The poses of columns are simulated with numpy alone.

"""

from dataclasses import replace
import json
from pathlib import Path
import pickle
import re

import accel_calib as ac
from accel_calib.effects import (
    AXES, by_axis, correct, Effect, EFFECTS, effects_of_file, Model, ONE)
from accel_calib.errors import InputError, StoredCalibrationError
from accel_calib.messages import OneReading
from accel_calib.report import refinement_page
from accel_calib.table import Recording
from faults.sample import sample
from inside import Correction
import numpy as np
import pandas as pd
import pytest
from shared import OWN, python, random_directions, refused, run, run_snippets, SENSOR, table

DOCS = Path(__file__).parent.parent / 'docs' / 'effects.md'

NEW = Effect('offset that grows with the cube of temperature', 'third-order TCO', AXES, 'g',
             0.005, 0.5, by_axis(ONE),
             lambda context, shape: ((context['temperature'] - 25.0) / 20.0) ** 3,
             ('temperature',))
VALUES = [0.02, -0.015, 0.01]


def check_single_readings(calibration, poses, context):
    """Check that readings are corrected one by one, as in the node, as all are together."""
    forces = calibration.correct(poses.reading, context)
    here, there = OneReading(calibration), calibration.force_covariance(forces, context)
    for k in range(5):
        at = here.at({key: values[k].tolist() for key, values in context.items()})
        np.testing.assert_allclose(at.correct(*poses.reading[k].tolist()), forces[k], atol=1e-11)
        np.testing.assert_allclose(np.ravel(at.with_spread(forces[k].tolist(), [0.0] * 9)),
                                   there[k].ravel(), rtol=1e-6)
    np.testing.assert_allclose(calibration.predict(forces, context), poses.reading, atol=1e-9)


def test_a_new_effect_is_simulated_named_fitted_corrected_and_reported(monkeypatch, tmp_path):
    monkeypatch.setitem(EFFECTS, 'offset_cubic_temperature', NEW)
    rng = np.random.default_rng(1)
    poses = ac.simulate({**SENSOR, 'offset_cubic_temperature': VALUES}, seed=2,
                        directions=random_directions(60, rng),
                        temperature=rng.uniform(5.0, 45.0, 60), time=np.arange(60) * 20.0)
    found = ac.refine(poses, base='10')
    assert [step.effect for step in found.steps] == ['offset_cubic_temperature']
    np.testing.assert_allclose([found.steps[0].parameters[axis] for axis in AXES], VALUES,
                               atol=1e-3)
    assert NEW.words.capitalize() in refinement_page(found, 'poses')

    found.calibration.save(tmp_path / 'calibration.yaml')
    calibration = ac.load(tmp_path / 'calibration.yaml')
    np.testing.assert_allclose(calibration.model.values['offset_cubic_temperature'], VALUES,
                               atol=1e-3)
    forces = calibration.apply(poses.reading, temperature=poses['temperature'])
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 9.80665, atol=0.02)
    check_single_readings(calibration, poses, poses.columns)


def still(rng, count, added=0.0, **columns):
    """Return poses of a random sensor in g; `added` is called with the force of each pose."""
    force = random_directions(count, rng)
    gain = np.eye(3) + np.diag(rng.uniform(-0.02, 0.02, 3))
    noise = rng.normal(size=(count, 3)) * 3e-4
    reading = force @ gain.T + rng.uniform(-0.05, 0.05, 3) + noise + (
        added(force) if callable(added) else added)
    named = {f'a{axis}': reading[:, k] for k, axis in enumerate('xyz')}
    spread = {f'std_{axis}': np.full(count, 3e-3) for axis in 'xyz'}
    return pd.DataFrame({'time': np.cumsum(rng.uniform(8.0, 25.0, count)), **named, **spread,
                         'count': 100, **columns})


@pytest.mark.parametrize('name', ['offset_covariate', 'gain_covariate'])
@pytest.mark.parametrize('curved', [False, True])
def test_any_column_that_varies_is_a_cause_without_which_a_log_is_not_corrected_for_it(
        name, curved, tmp_path, capsys):
    rng = np.random.default_rng([7, len(name), curved])
    current = rng.uniform(0.0, 12.0, 60)
    away = (current - 6.0) / 6.0
    course = np.outer(away + 1.2 * curved * away ** 2, [0.004, -0.003, 0.002])
    poses = still(rng, 60, lambda force: course * (force if name == 'gain_covariate' else 1.0),
                  **{'motor current': current, 'battery': rng.uniform(11.0, 12.0, 60)})
    poses.to_csv(tmp_path / 'poses.csv', index=False)
    found = ac.refine(tmp_path / 'poses.csv', units='g')
    assert [(step.effect, step.variable) for step in found.steps] == [(name, 'motor_current')]
    assert found.verdict == 'explained'
    assert found.remaining_gap_mg < 0.4 < 1.0 < found.gap_mg
    assert ('x_square' in found.steps[0].parameters) == curved

    found.calibration.save(tmp_path / 'calibration.yaml')
    stored = ac.load(tmp_path / 'calibration.yaml')
    readings = poses[['ax', 'ay', 'az']].to_numpy()
    sizes = np.linalg.norm(stored.apply(readings, motor_current=current), axis=1)
    assert np.std(sizes) < 5e-4
    with pytest.raises(InputError, match='need motor_current'):
        stored.apply(readings)
    poses.drop(columns='motor current').to_csv(tmp_path / 'samples.csv', index=False)
    assert run('apply', tmp_path / 'samples.csv', '-c', tmp_path / 'calibration.yaml', '-o',
               tmp_path / 'out.csv', '--units', 'g') == 0
    shown = ' '.join(capsys.readouterr().out.split())
    assert f' motor_current: {name}-motor_current' in shown


def test_a_hump_over_any_column_is_a_curve_of_it():
    rng = np.random.default_rng(8)
    pressure = rng.uniform(950.0, 1050.0, 60)
    hump = np.exp(-0.5 * ((pressure - 1003.0) / 12.0) ** 2)
    found = ac.refine(still(rng, 60, np.outer(hump, [0.006, -0.004, 0.005]), pressure=pressure),
                      units='g')
    assert [(step.effect, step.variable) for step in found.steps] == [('empirical', 'pressure')]
    assert found.verdict == 'described'


@pytest.mark.parametrize('seed', range(3))
def test_columns_of_noise_are_not_named(seed):
    rng = np.random.default_rng([9, seed])
    noise = {f'noise_{k}': np.cumsum(rng.normal(size=40)) if k % 2 else rng.normal(size=40)
             for k in range(25)}
    found = ac.refine(still(rng, 40, **noise), units='g')
    assert not any(step.variable for step in found.steps)


def test_text_and_columns_with_holes_are_no_cause(tmp_path):
    rng = np.random.default_rng(10)
    poses = still(rng, 30, room=['lab'] * 30, pressure=rng.uniform(950.0, 1050.0, 30))
    poses['humidity'] = [*rng.uniform(30.0, 50.0, 29), np.nan]
    poses.to_csv(tmp_path / 'poses.csv', index=False)
    assert ac.read_poses(tmp_path / 'poses.csv').quantities == ('pressure',)


@pytest.mark.parametrize(('wrong', 'message'), [
    ({'name': 'Two Words'}, 'name'), ({'typical': 0.0}, 'typical size'), ({'axes': 'yx'}, 'axes'),
    ({'slope': np.square}, 'only one'), ({'variable': 'label'}, 'label'),
    ({'form': np.square, 'slope': lambda u: u}, 'derivative'),
    ({'variable': 'time', 'function': lambda time: time}, 'both'),
    ({'function': lambda *columns: columns[0]}, 'without a column'),
    ({'function': lambda a_z, knee: a_z, 'constants': {'kne': (1, 2)}}, 'kne'),
    *(({'function': lambda temperature, knee: temperature, 'constants': {'knee': numbers}},
       'lowest') for numbers in [(2,), (2, 1), (0, np.inf), (0, 1, 2)])])
def test_an_own_effect_that_cannot_work_is_refused_when_it_is_made(wrong, message):
    with pytest.raises(InputError, match=message):
        ac.Effect(**{'name': 'own', 'words': 'own effect', 'typical': 0.001, **wrong})


BAD = table('bad_functions')


@pytest.mark.parametrize('bad', BAD)
@pytest.mark.parametrize('given', [
    "variable='temperature', change=lambda x: {}", 'form=lambda x: {}',
    "function=lambda temperature, k: (lambda x: {})(temperature), constants={{'k': (1, 2)}}"])
def test_a_function_that_is_none_of_its_arguments_is_refused_in_one_line(
        bad, given, tmp_path, capsys):
    own, poses = tmp_path / 'own.py', still(np.random.default_rng(11), 30,
                                            temperature=np.linspace(10.0, 40.0, 30))
    poses.to_csv(tmp_path / 'poses.csv', index=False)
    own.write_text('import sys\nimport accel_calib as ac\nimport numpy as np\ncalls = []\n'
                   f'own = ac.Effect("own", "own effect", 0.01, {given.format(bad)})\n')
    line = refused(capsys, 'refine', tmp_path / 'poses.csv', '--units', 'g', '--also', own)
    assert "of the effect 'own'" in line
    assert re.search(BAD[bad], line), line
    assert line.strip().isprintable()


def test_poses_are_read_only():
    with pytest.raises(ValueError, match='read-only'):
        ac.simulate().reading[0] = 0.0


def turned(count, seed):
    """Return directions, and the context of own effects in this order of poses."""
    rng = np.random.default_rng([12, seed])
    up = random_directions(count, rng)
    back = np.diff(up, axis=0, prepend=up[:1])
    previous = -back / np.maximum(np.linalg.norm(back, axis=1), 1e-9)[:, np.newaxis]
    return up, {'temperature': rng.uniform(10.0, 50.0, count), 'previous': previous,
                'since_turn': rng.uniform(3.0, 200.0, count), 'time': np.arange(count) * 30.0,
                'motor_current': rng.uniform(0.0, 9.0, count), 'spin': rng.normal(size=count),
                'supply_voltage': rng.uniform(3.0, 3.6, count)}


FIELD = ac.Effect(
    'field_across', 'field of the motor', typical=1e-3, axes='xz', unit='g/√A',
    function=lambda motor_current, force, supply_voltage: (
        (supply_voltage / 3.3 * np.sqrt(motor_current))[:, np.newaxis] * force[:, [1, 2, 0]]))
COMMON = ac.Effect('spin_gain', 'gain that grows with the rate', typical=1e-3, axes='all',
                   function=lambda force, spin: force * spin[:, np.newaxis] ** 2)
TONE = ac.Effect(
    'own_tone', 'periodic error', typical=1e-3,
    function=lambda time, period, phase: np.sin(2.0 * np.pi * time / period + phase),
    constants={'period': (200, 900), 'phase': (0, 3.1)})
TRUTH = {'thermal_knee': [2e-4, -3e-4, 2.5e-4, 31.0], 'dead_band': [0.01, -0.008, 0.012, 0.12],
         'turn_gain': [4e-3, -5e-3, 3e-3, 80.0], 'field_across': [4e-3, -3e-3],
         'spin_gain': [1e-3], 'own_tone': [4e-3, -3e-3, 2e-3, 420.0, 1.0]}


def poses_with(own, turn, values=None, count=72, **options):
    """Return poses of a sensor with an own effect, in g, and their context."""
    up, context = turned(count, turn)
    return ac.simulate({**SENSOR, own.name: TRUTH.get(own.name, values)}, directions=up,
                       units='g', also=[own], **context, **options), context


@pytest.fixture
def own_effects(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_snippets('docs/effects.md')
    return {each.name: each for each in (*names.values(), FIELD, COMMON, TONE)
            if isinstance(each, ac.Effect)}


@pytest.mark.parametrize('name', sample(TRUTH, 4))
def test_an_own_effect_is_found_with_its_constants_stored_and_corrected(
        name, own_effects, tmp_path):
    own = own_effects[name]
    poses, context = poses_with(own, 3, seed=5)
    found = ac.refine(poses, also=[own])
    step, = found.steps
    assert (found.verdict, step.effect) == ('explained', name)
    errors = np.subtract([*step.parameters.values()], TRUTH[name])
    deviations = np.array([*step.parameters_sd.values()])
    assert np.all(deviations > 0.0)
    assert np.all(np.abs(errors) < 4.0 * deviations)
    assert own.words.capitalize() in refinement_page(found, 'poses')

    found.calibration.save(tmp_path / 'calibration.yaml')
    calibration = ac.load(tmp_path / 'calibration.yaml', also=[own])
    assert calibration == found.calibration
    check_single_readings(calibration, poses, context)


def test_effects_of_one_name_do_not_see_each_other(tmp_path):
    below, above = (ac.Effect('knee', 'offset beyond a temperature', typical=1e-4, unit='g/°C',
                              function=lambda temperature, sign=sign: np.maximum(
                                  sign * (temperature - 28.0), 0.0)) for sign in (-1.0, 1.0))
    stored, at = [], {'temperature': np.array([20.0, 36.0])}
    for k, own in enumerate((below, above)):
        poses, _ = poses_with(own, 8, [4e-4, -3e-4, 5e-4], 60)
        ac.refine(poses, also=[own]).calibration.save(tmp_path / f'{k}.yaml')
        stored.append(ac.load(tmp_path / f'{k}.yaml', also=[own]))
    readings = np.tile([0.1, 0.2, 0.97], (2, 1))
    cold, warm = (each.correct(readings, at) for each in stored)
    assert np.all(np.abs(cold - warm) > 1e-3)  # each has kept its own function
    for k, other in enumerate((above, below)):
        with pytest.raises(StoredCalibrationError, match='another definition'):
            ac.load(tmp_path / f'{k}.yaml', also=[other])
        with pytest.raises(StoredCalibrationError, match="needs the effect 'knee'"):
            ac.load(tmp_path / f'{k}.yaml')
    assert 'knee' not in [step.effect for step in ac.refine(poses).steps]
    with pytest.raises(InputError, match="'knee' is not in the catalogue"):
        ac.simulate({'knee': 1e-4})


def test_a_calibration_brings_the_file_of_its_effects_into_another_process(tmp_path):
    (tmp_path / 'own.py').write_text(OWN)
    own = effects_of_file(tmp_path / 'own.py')
    up, context = turned(60, 9)
    poses = ac.simulate({**SENSOR, 'dead_band': [0.01, -0.008, 0.006]}, directions=up, units='g',
                        also=own, **context)
    calibration = ac.refine(poses, also=own).calibration
    assert pickle.loads(pickle.dumps(calibration)) == calibration
    (tmp_path / 'own.py').unlink()
    (tmp_path / 'c.pickle').write_bytes(pickle.dumps(calibration))
    done = python('-c', 'import numpy, pickle, sys; print(pickle.load(open(sys.argv[1], "rb"))'
                  '.correct(numpy.eye(3), {}).tolist())', tmp_path / 'c.pickle')
    np.testing.assert_array_equal(json.loads(done.stdout), calibration.correct(np.eye(3), {}))


def test_firmware_has_what_depends_on_columns_and_is_refused_for_functions_of_the_force(
        own_effects, tmp_path, capsys):
    code = [each for each in re.findall(r'```python\n(.*?)```', DOCS.read_text(), re.S)
            if 'ac.Effect(' in each]
    (tmp_path / 'own.py').write_text('\n'.join(code))
    for name, status in (('thermal_knee', 0), ('dead_band', 2)):
        poses, _ = poses_with(own_effects[name], 4)
        ac.refine(poses, also=[own_effects[name]]).calibration.save('own.yaml')
        assert run('export', 'own.yaml', '--to', 'c', '-o', 'own.h', '--also', 'own.py') == status
        assert ('of the force (dead_band)' in capsys.readouterr().err) == (status == 2)


def test_an_own_effect_that_cannot_be_tested_or_ends_at_a_bound_is_named(own_effects):
    own = own_effects['thermal_knee']
    poses, _ = poses_with(own, 5)
    narrow = replace(own, constants={'knee': (36, 45)})
    assert [line for line in ac.refine(poses, also=[narrow]).advice
            if 'its constant knee ends at its bound 36' in line]
    untimed = poses.without_columns('since_turn', 'time')
    lacking = ac.refine(untimed, also=[own_effects['turn_gain']])
    assert dict(lacking.not_testable)['turn_gain'] == 'since_turn'


def test_samples_are_corrected_without_what_only_poses_have(own_effects):
    own = own_effects['turn_gain']
    poses, _ = poses_with(own, 6)
    calibration = ac.refine(poses, also=[own]).calibration
    correction = Correction(calibration, 'g', '')
    samples = Recording({'time': poses['time'], 'reading': poses.reading}, poses.row, 'g')
    expected = Model({name: calibration.model.values[name] for name in SENSOR})
    np.testing.assert_allclose(correction(samples).reading, correct(expected, poses.reading, {}))
    assert any('since_turn' in note for note in correction.notes)
    one = OneReading(calibration).at({**calibration.model.neutral})
    np.testing.assert_allclose(one.correct(*poses.reading[3]), correction(samples).reading[3])


def test_an_own_effect_does_not_hide_one_of_the_catalogue():
    with pytest.raises(InputError, match='in the catalogue'):
        ac.load('calibration.yaml', also=[ac.Effect('quadratic', 'mine', typical=0.001)])


@pytest.mark.parametrize(('text', 'message'), table('bad_effect_files'))
def test_a_file_without_own_effects_is_refused(text, message, tmp_path, capsys):
    (tmp_path / 'own.py').write_text(text)
    assert message in refused(capsys, 'refine', 'poses.csv', '--also', tmp_path / 'own.py')


def test_a_recording_gives_its_poses_any_other_column(tmp_path):
    rng = np.random.default_rng(14)
    current = np.repeat(rng.uniform(0.0, 12.0, 8), 80)
    force = np.repeat(random_directions(8, rng), 80, axis=0) + 2e-3 * rng.normal(size=(640, 3))
    named = {f'a{axis}': force[:, k] for k, axis in enumerate('xyz')}
    pd.DataFrame({'time': np.arange(640) * 0.02, **named, 'motor_current': current}).to_csv(
        tmp_path / 'recording.csv', index=False)
    poses = ac.capture(tmp_path / 'recording.csv', units='g')
    assert poses.quantities == ('motor_current',)
    np.testing.assert_allclose(poses['motor_current'], current[40::80], atol=0.05)
