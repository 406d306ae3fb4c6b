# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""One next step: all surfaces name the same one, and its command is the way on."""

import json
from pathlib import Path
import shlex

import accel_calib as ac
from accel_calib.finding import Finding, NextStep, STEPS
from inside import main
import numpy as np
import pytest

COMMON = {'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.01, -0.01, 0.005]}
HIDDEN = {**COMMON, 'quadratic': [0.03, -0.02, 0.02]}


def written(path: Path, effects: dict[str, list[float]], poses: int = 40) -> Path:
    table = ac.simulate(effects, poses=poses, units='g', seed=5)
    rows = [','.join(f'{value:.9g}' for value in (*reading, *std, count)) for reading, std, count
            in zip(table.reading, table['std'], table['count'], strict=True)]
    path.write_text('\n'.join(['ax,ay,az,std_x,std_y,std_z,count', *rows]) + '\n',
                    encoding='utf-8')
    return path


def result_of(line: str, folder: Path) -> dict:
    target = folder / 'result.json'
    assert main([*shlex.split(line)[1:], '--json', str(target)]) == 0, line
    return json.loads(target.read_text(encoding='utf-8'))


@pytest.mark.parametrize(('effects', 'kinds'), [
    (COMMON, ['level', 'done']), (HIDDEN, ['refine', 'level', 'done'])])
@pytest.mark.parametrize('command', ['fit', 'calibrate --no-refine'])
def test_the_commands_of_the_next_steps_lead_to_the_end(effects, kinds, command, tmp_path):
    poses, stored = written(tmp_path / 'my poses.csv', effects), tmp_path / 'c.yaml'
    line, seen = f"accel-calib {command} '{poses}' -o {stored} --units g", []
    while line:
        step = result_of(line.replace('ROW', '1'), tmp_path)['next']
        assert set(step) == {'kind', 'text', 'command'}
        seen.append(step['kind'])
        line = step['command']
    assert seen == kinds
    calibration = ac.load(stored)
    assert calibration.is_levelled
    assert calibration.rating.name == 'GOOD'
    assert set(calibration.model.effects) >= set(effects)


@pytest.mark.parametrize(('effects', 'poses'), [(COMMON, 40), (HIDDEN, 40), (COMMON, 8)])
def test_the_same_poses_have_the_same_verdict_and_next_step_everywhere(effects, poses, tmp_path):
    table, stored = written(tmp_path / 'poses.csv', effects, poses), tmp_path / 'c.yaml'
    keys = ('rating', 'rating_reason', 'findings')
    fit, calibrate = (result_of(f'accel-calib {command} {table} -o {stored} --units g', tmp_path)
                      for command in ('fit', 'calibrate --no-refine'))
    assert [fit[key] for key in keys] == [calibrate[key] for key in keys]
    for key in ('kind', 'text'):
        assert fit['next'][key] == calibrate['next'][key]
    rating = ac.fit(table, units='g').rating
    assert (rating.name, rating.reason) == (fit['rating'], fit['rating_reason'])
    assert (rating.next.kind, rating.next.text) == (fit['next']['kind'], fit['next']['text'])
    page = (tmp_path / 'c.html').read_text(encoding='utf-8')
    assert rating.next.text.replace("'", '&#x27;')[1:] in page


@pytest.mark.parametrize('noise_known', [False, True])
def test_after_a_search_without_result_nobody_is_sent_to_search_again(noise_known, tmp_path):
    path, rng = tmp_path / 'poses.csv', np.random.default_rng(4)
    table = ac.simulate(COMMON, poses=40, units='g', seed=5)
    scattered = table.reading + 0.012 * rng.normal(size=table.reading.shape)
    more = ',std_x,std_y,std_z,count' if noise_known else ''
    path.write_text('\n'.join([f'ax,ay,az{more}', *(
        ','.join(map(str, row.tolist())) + (',0.001,0.001,0.001,100' if noise_known else '')
        for row in scattered)]) + '\n', encoding='utf-8')
    first = result_of(f'accel-calib fit {path} --units g -o {tmp_path}/c.yaml', tmp_path)
    assert (first['rating'], first['next']['kind']) == ('USABLE', 'refine')
    again = result_of(first['next']['command'], tmp_path)
    assert (again['rating'], again['next']['kind']) == ('USABLE', 'poses')


def test_a_finding_names_the_kind_of_its_step() -> None:
    assert Finding('flat_pose', 'turned', 'turn it').next == NextStep('level', 'turn it')
    assert Finding('error', 'large', 'look for it', step='refine').next.kind == 'refine'
    with pytest.raises(ValueError, match="'wait'"):
        NextStep('wait', 'what')
    assert 'done' in STEPS
