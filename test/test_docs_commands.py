# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The commands and the snippets of the documentation run.

Every command ``accel-calib`` in an indented block, or in a fenced block ``sh`` or ``console``, is
run, in the order of the page and in one temporary folder. A file that a command reads is one of
`FILES`, or the page names the sample of ``test/data/logs`` that it is::

    <!-- files: log.csv=esp32/counts.log -->

A snippet whose first line is ``# NAME.py`` is written to this file first.
``<!-- status: 1 -->`` above a block states the exit status of its last command. The commands
`OF_ROS` need ROS 2 or do not end by themselves; test_ros_*.py, test_terminal.py and
test_live_sources.py run them.

"""

from dataclasses import dataclass
import itertools
import json
from pathlib import Path
import re
import shlex
import shutil
from tempfile import TemporaryDirectory

import accel_calib as ac
from accel_calib.logs import write_table
from bag_files import write_bag
from faults.sample import sample
from inside import COMMANDS, main, model_with, simulate_recording, spread_directions
import numpy as np
import pytest
import ramps
import shared
from shared import LOGS, python, ROOT, run_snippets, text_of

PAGES = sorted(str(path.relative_to(ROOT)) for path in (
    ROOT / 'README.md', *(ROOT / 'docs').rglob('*.md')))
OF_ROS = {'node', 'simulator', 'watch', 'demo', 'live'}
SENSOR = {**shared.SENSOR, 'offset': [0.03, -0.02, 0.04]}
LIBRARIES = {'.ulg': 'pyulog', '.bin': 'pymavlink'}


@dataclass(frozen=True)
class Block:
    """The commands of a block, without the name of the program, and the status of the last."""

    commands: list[list[str]]
    status: int


def blocks_of(text):
    """Return the files that a page names, by their kind, and its blocks."""
    files = dict(item.split('=') for found in re.findall(r'<!-- files: (.*?) -->', text)
                 for item in found.split())
    blocks = []
    pattern = (r'(?:<!-- status: (\d) -->\s*)?^```(?:sh|console)\n(.*?)^```'
               r'|((?:^ {4,}accel-calib .*\n)+)')
    for status, fenced, indented in re.findall(pattern, text, re.MULTILINE | re.DOTALL):
        body = fenced or re.sub('(?m)^ +', '', indented)
        lines = body.replace('\\\n', ' ').splitlines()
        commands = [shlex.split(line.removeprefix('$ '), comments=True) for line in lines
                    if re.match(r'(\$ )?accel-calib ', line)]
        blocks.append(Block([words[1:] for words in commands], int(status or 0)))
    return files, blocks


def recording(**settings):
    return ac.simulate(SENSOR, recording=True, mounting=(2.0, -4.0, 0.0), **settings)


def poses(seed):
    return ac.simulate(SENSOR, poses=24, mounting=(2.0, -4.0, 0.0), seed=seed)


def bag(path):
    up = np.vstack([[0.0, 0.0, 1.0], spread_directions(13)])
    write_bag(path, 'mcap', simulate_recording(
        model_with(SENSOR), up, np.random.default_rng(7), noise_g=0.003, rate_hz=50.0, dwell=3.0,
        turn=0.8, temperatures=(24.0, 31.0)))


def bag_file(path):
    with TemporaryDirectory() as folder:
        bag(Path(folder) / 'bag')
        next(Path(folder).rglob('*.mcap')).rename(path)


def calibration(seed):
    return lambda path: ac.fit(poses(seed), flat=1).save(path)


def fleet(folder):
    for robot in range(6):
        (folder / f'robot_{robot}').mkdir(parents=True)
        own = {**SENSOR, 'offset': np.array(SENSOR['offset']) + 0.002 * robot}
        write_table(folder / f'robot_{robot}' / 'poses.csv',
                    ac.simulate(own, poses=14, seed=40 + robot))


FILES = {
    'recording': bag,
    'recording.mcap': bag_file,
    'recordings/': fleet,
    'warm_up.csv': lambda path: write_table(path, ramps.ramp(3)),
    'warm_up.ulg': lambda path: ramps.write_ulog(path, ramps.ramp(3)),
    'twelve_poses.csv': lambda path: write_table(path, ramps.twelve_poses(4)),
    'recording.csv': lambda path: write_table(path, recording(poses=14, seed=9)),
    'poses.csv': lambda path: write_table(path, poses(8)),
    'other_poses.csv': lambda path: write_table(path, poses(18)),
    **{f'{name}.yaml': calibration(seed) for seed, name in enumerate(
        ('calibration', 'monday', 'tuesday', 'wednesday'))},
}
"""How to write the files that pages name; the names mean the same in all pages."""


@pytest.mark.parametrize('page', sample([page for page in PAGES if any(
    block.commands for block in blocks_of(text_of(page))[1])
    and page != 'docs/evidence.md'], 5))  # test_docs.py runs it
def test_commands_of_the_blocks_run(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    files, blocks = blocks_of(text_of(page))
    for name, log in files.items():
        if Path(log).suffix in LIBRARIES:
            pytest.importorskip(LIBRARIES[Path(log).suffix])
        shutil.copy(LOGS / log, name)
    for name, code in re.findall(r'^```python\n# (\w+\.py)\n(.*?)^```', text_of(page),
                                 re.MULTILINE | re.DOTALL):
        Path(name).write_text(code)
    if any(words[0] == 'fleet' for block in blocks for words in block.commands):
        pytest.importorskip('distributed')
    for block in blocks:
        statuses = [run(words) for words in block.commands if words[0] not in OF_ROS]
        expected = [0] * (len(statuses) - 1) + [block.status] * bool(statuses)
        assert statuses == expected, (block.commands, capsys.readouterr())


def run(words):
    """Run a command; return its exit status, also where it exits by itself."""
    for before, name in itertools.pairwise(words):
        if before not in {'-o', '--output'}:
            provide(name)
    if 'report' in words or '--report' in words:
        pytest.importorskip('matplotlib')
    try:
        return main(words)
    except SystemExit as exit_:
        return exit_.code


def provide(name):
    """Write one of the files that pages name, if it is missing."""
    if name in FILES and not Path(name).exists():
        FILES[name](Path(name))


@pytest.mark.parametrize('page', [
    page for page in PAGES if '```python' in text_of(page)
    and page != 'docs/fleet.md'])  # test_fleet.py runs it
def test_snippets_of_python_run_and_print_what_the_page_shows(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in re.findall(r"'([\w./]+)'", text_of(page)):
        provide(name)
    run_snippets(page, lambda shown: shown == capsys.readouterr().out)


def test_every_command_without_ros_is_run_by_a_page():
    run_ = {words[0] for page in PAGES for block in blocks_of(text_of(page))[1]
            for words in block.commands}
    assert set(COMMANDS) - OF_ROS <= run_


def code_of(name):
    """Return the code of an example: of a notebook, that of all its cells."""
    text = (ROOT / 'examples' / name).read_text(encoding='utf-8')
    if not name.endswith('.ipynb'):
        return text
    return '\n'.join(''.join(cell['source']) for cell in json.loads(text)['cells']
                     if cell['cell_type'] == 'code')


def hidden_effect(output):
    assert re.findall(r'Missing effect: (\w+)', output) == ['offset_temperature']
    assert output.endswith('Verdict: explained.\n')


def whole_recording(output):
    assert '18 of 18' in output
    a_small_residual(output)
    assert output.endswith(' [0. 0. 1.]\n')


def a_small_residual(output):
    before, after = map(float, re.search(r'residual (\S+) -> (\S+) mg', output).groups())
    assert before > 20.0
    assert after < 0.5


def error_of_each_model(output):
    largest = [float(value) for value in re.findall(r'largest error (\S+) mg', output)]
    # Figures 1 to 4 of AN5286: about 50, 10, 5 and 2.5 mg.
    np.testing.assert_allclose(largest, [50.0, 10.0, 5.0, 2.5], rtol=0.1)
    assert '<svg' in Path('surfaces.svg').read_text(encoding='utf-8')
    assert Path('surfaces.png').read_bytes().startswith(b'\x89PNG')


EXAMPLES = {'find_hidden_effect.py': hidden_effect, 'calibrate_recording.py': whole_recording,
            'error_surfaces.py': error_of_each_model, 'calibrate.ipynb': a_small_residual}
"""What the output of each example shows."""


def test_every_example_is_run():
    assert {*EXAMPLES} == {path.name for path in (ROOT / 'examples').iterdir() if path.is_file()}


@pytest.mark.parametrize('name', EXAMPLES)
def test_examples_use_nothing_but_the_public_face_and_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for library in {'error_surfaces.py': ['matplotlib'],
                    'calibrate.ipynb': ['matplotlib', 'pandas']}.get(name, ()):
        pytest.importorskip(library)
    imports = re.findall(r'^(?:from|import) (.*)', code_of(name), re.MULTILINE)
    own = [line for line in imports if 'accel_calib' in line]
    assert own == ['accel_calib as ac']
    written = ['surfaces.png', 'surfaces.svg'] if name == 'error_surfaces.py' else []
    done = python('-c', code_of(name), *written[::-1], folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == written
    EXAMPLES[name](done.stdout)


def test_the_notebook_holds_no_output():
    notebook = json.loads((ROOT / 'examples' / 'calibrate.ipynb').read_text(encoding='utf-8'))
    code = [cell for cell in notebook['cells'] if cell['cell_type'] == 'code']
    assert any('offset_temperature' in ''.join(cell['source']) for cell in code)
    assert not [cell for cell in code if cell['outputs'] or cell['execution_count']]
    assert notebook['nbformat'] == 4
