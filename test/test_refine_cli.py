# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib refine`` and ``report``: the JSON, what is stored, and what is refused."""

import json
import sys

from accel_calib.stored import read_calibration
import pytest
from shared import run, run_json

SENSOR = ['--effect', 'offset=0.02,-0.01,0.03', '--effect', 'axis_gain=0.01,-0.02,0.005',
          '--effect', 'cross_axis=0.004,0.002,-0.003']
HIDDEN = ['--effect', 'quadratic=0.006,-0.004,0.005']
KEYS = {'file', 'verdict', 'noise_floor_mg', 'gap_mg', 'steps', 'remaining_gap_mg',
        'disturbed_poses', 'not_testable', 'advice'}
STEP_KEYS = {'effect', 'rivals', 'parameters', 'gap_before_mg', 'gap_after_mg',
             'held_out_before_mg', 'held_out_after_mg', 'p_value', 'where'}


def simulated(path, *arguments):
    assert run('simulate', '-o', path, *SENSOR, *arguments) == 0
    return path


@pytest.fixture
def hidden(tmp_path, capsys):
    path = simulated(tmp_path / 'hidden.csv', *HIDDEN, '--poses', 60)
    capsys.readouterr()
    return path


def test_a_refinement_is_printed_stored_and_drawn(hidden, tmp_path, capsys):
    pytest.importorskip('matplotlib')
    stored, found, page, other = (tmp_path / name for name in (
        'refined.yaml', 'found.json', 'page.html', 'other.csv'))
    assert run('refine', hidden, '-o', stored, '--sensor', 'imu_link', '--json', found,
               '--report', page) == 0
    printed = capsys.readouterr().out
    for words in ('quadratic', 'square of the force', ' up', '->', 'p < ', 'noise floor',
                  'only noise remains', 'these data cannot show'):
        assert words in printed
    assert page.read_text().startswith('<!DOCTYPE html>')

    result = json.loads(found.read_text())
    assert set(result) >= KEYS
    assert result['file'] == str(hidden)
    assert result['verdict'] == 'explained'
    step = result['steps'][0]
    assert set(step) >= STEP_KEYS
    assert 'quadratic' in {step['effect'], *step['rivals']}
    assert step['gap_after_mg'] < 0.5 * step['gap_before_mg']
    assert all(set(item) == {'effect', 'needs'} for item in result['not_testable'])
    assert 'offset_temperature' in {item['effect'] for item in result['not_testable']}

    calibration = read_calibration(stored)
    assert calibration.sensor == 'imu_link'
    assert len(calibration.model.effects) == 4
    simulated(other, *HIDDEN, '--seed', 7, '--poses', 40)
    capsys.readouterr()
    _, result = run_json(capsys, 'verify', other, '-c', stored)
    assert result['rms_after_mg'] < 1.5 * result['noise_floor_mg']


def test_stored_calibration_is_the_base(hidden, tmp_path, capsys):
    fitted, again = tmp_path / 'fitted.yaml', tmp_path / 'again.yaml'
    assert run('fit', hidden, '-o', fitted, '--model', '10', '--sensor', 'a') == 0
    assert run('refine', hidden, '-c', fitted, '-o', again) == 0
    capsys.readouterr()
    status, result = run_json(capsys, 'refine', hidden, '-c', again)
    assert status == 0
    assert (result['verdict'], result['steps']) == ('no_gap', [])
    assert run('refine', hidden, '-c', fitted, '--sensor', 'b') == 2
    assert "belongs to sensor 'a'" in capsys.readouterr().err


def test_several_tables_return_a_list_in_their_order(hidden, tmp_path, capsys):
    clean = simulated(tmp_path / 'clean.csv', '--poses', 30)
    bad = tmp_path / 'bad.csv'
    bad.write_text('ax,ay\n1,2\n')
    folder = tmp_path / 'out'
    folder.mkdir()
    capsys.readouterr()
    status, results = run_json(capsys, 'refine', clean, bad, hidden, '--jobs', 2, '-o', folder)
    assert status == 2
    assert [result['file'] for result in results] == [str(clean), str(bad), str(hidden)]
    assert [result.get('verdict') for result in results] == ['no_gap', None, 'explained']
    assert set(results[1]) == {'file', 'error', 'advice'}
    assert sorted(path.name for path in folder.iterdir()) == ['clean.yaml', 'hidden.yaml']


def test_table_of_samples_is_captured_first(tmp_path, capsys):
    path = simulated(tmp_path / 'r.csv', '--recording', '--poses', 24, '--dwell', 2)
    capsys.readouterr()
    status, result = run_json(capsys, 'refine', path, '--base', '10')
    assert status == 0
    assert result['poses_used'] + len(result['disturbed_poses']) == 24


@pytest.mark.parametrize('arguments', [
    ('refine', 'missing.csv'), ('refine', 'hidden.csv', '-c', 'missing.yaml'),
    ('refine', 'hidden.csv', '-o', 'none/c.yaml'), ('refine', 'hidden.csv', '--rows', '1:3'),
    ('refine', 'hidden.csv', '--report', 'none/r.html'), ('refine', 'hidden.csv', '--units', 'g'),
    ('refine', 'hidden.csv', 'hidden.csv', '-o', 'c.yaml'), ('refine', 'missing.mcap'),
    ('refine', 'hidden.csv', '--base', '12'), ('report', 'missing.csv', '-o', 'r.html'),
    ('report', 'hidden.csv', '-o', 'none/r.html'),
])
def test_bad_input_is_one_line_and_status_2(arguments, hidden, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    there = sorted(tmp_path.iterdir())
    assert run(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f'accel-calib {arguments[0]}: ')
    assert printed.err.count('\n') == 1
    assert sorted(tmp_path.iterdir()) == there


def test_refusal_is_in_the_json_too(hidden, capsys):
    assert run('refine', hidden, '--rows', '1:3', '--json', '-') == 2
    result = json.loads(capsys.readouterr().out)
    assert {'error', 'advice'} <= set(result)


def test_the_report_has_a_page_and_figures(tmp_path):
    pytest.importorskip('matplotlib')
    table, page, folder = (tmp_path / name for name in ('clean.csv', 'r.html', 'figures'))
    assert run('report', simulated(table, '--poses', 30), '-o', page, '--figures', folder) == 0
    assert page.read_text().startswith('<!DOCTYPE html>')
    names = {path.name for path in folder.iterdir()}
    assert {'ladder.svg', 'ladder.png', 'remaining_sphere.png'} <= names


def test_without_matplotlib_one_line_advises_what_to_install(hidden, tmp_path, capsys,
                                                             monkeypatch):
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    page = tmp_path / 'r.html'
    assert run('refine', hidden, '--report', page) == 2
    printed = capsys.readouterr()
    assert 'pip install matplotlib' in printed.err
    assert printed.err.count('\n') == 1
    assert not page.exists()
    assert run('refine', hidden) == 0
