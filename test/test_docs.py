# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The documentation and its pictures agree with the code, and its commands and snippets run.

Every command ``accel-calib`` in an indented block, or in a fenced block ``sh`` or ``console``, is
run, in the order of the page and in one temporary folder. A file that a command reads is one of
`FILES`, or the page names the sample of ``test/data/logs`` that it is::

    <!-- files: log.csv=esp32/counts.log -->

A snippet whose first line is ``# NAME.py`` is written to this file first.
``<!-- status: 1 -->`` above a block states the exit status of its last command. The commands
`OF_ROS` need ROS 2 or do not end by themselves; test_ros_*.py, test_terminal.py and
test_live_sources.py run them.

"""

import ast
from dataclasses import fields
import inspect
import itertools
import json
from pathlib import Path
import re
import shlex
import shutil
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import accel_calib as ac
from accel_calib.logs import write_table
from accel_calib.session import CalibratorSettings
from bag_files import write_bag
import evidence
from faults.sample import FACTOR, sample
from inside import (
    COMMANDS, export, main, model_with, parser, simulate_recording, spread_directions)
import numpy as np
import pictures
import pytest
import ramps
import shared
from shared import data, GRAVITY, LOGS, python, rms, ROOT, run_snippets, text_of
import tables
from test_policy import names_of_the_calibrator
import yaml

PAGES = ['README.md', 'CONTRIBUTING.md', 'QUALITY_DECLARATION.md', 'SECURITY.md', *(
    str(path.relative_to(ROOT)) for path in sorted((ROOT / 'docs').rglob('*.md')))]
OWN_PAGES = [page for page in PAGES if 'figures' not in page]
USER_PAGES = [page for page in PAGES if page == 'README.md' or page.startswith('docs/')]


def built(page):
    """Return the text of a page as the site has it, with the tables of the code."""
    return tables.with_tables(text_of(page))


def test_parameter_file_describes_all_parameters_and_has_their_defaults():
    text = tables.PARAMETERS.read_text(encoding='utf-8')
    assert text.splitlines() == [*tables.parameters()], 'run: python docs/tables.py'
    given = yaml.safe_load(text)['/**']['ros__parameters']
    assert CalibratorSettings(**given) == CalibratorSettings()
    assert list(given) == [parameter.name for parameter in fields(CalibratorSettings)]


def test_every_table_of_the_code_is_in_a_page_of_the_site_and_none_is_stored():
    for name, table in tables.TABLES.items():
        rows = '\n'.join(table())
        assert any(f'<!-- {name} -->\n\n{rows}\n' in built(page) for page in OWN_PAGES), name
        assert not any(rows in text_of(page) for page in OWN_PAGES), name


def test_api_reference_has_all_public_names_and_their_docstrings_every_parameter():
    page = text_of('docs/api.md').partition('## Records in results')[0]
    assert {*re.findall(r'^\.\. auto(?:function|class):: (\w+)$', page, re.M)} == {*ac.__all__}
    for name in re.findall(r'^\.\. autofunction:: (\w+)$', page, re.M):
        text = inspect.getdoc(getattr(ac, name))
        sections = dict(re.findall(r'^(\w+)\n-{3,}\n(.*?)(?=\n\n\w+\n---|\Z)', text, re.M | re.S))
        listed = [each.strip('* ') for head in re.findall(
            r'^(\*{0,2}\w[^:\n]*)', re.sub(r'(?m)^ .*\n?', '', sections['Parameters']), re.M)
            for each in head.split(',')]
        assert listed == list(inspect.signature(getattr(ac, name)).parameters), name
        assert {'Returns', 'Raises'} <= set(sections), name


@pytest.mark.parametrize('page', OWN_PAGES)
def test_commands_and_their_options_exist(page):
    choices = parser()._subparsers._group_actions[0].choices
    named = re.findall(r'`accel-calib ([^`]+)`|^ {4,}accel-calib (.*)', text_of(page), re.M)
    for line in map(''.join, named):
        command, *words = shlex.split(line.partition('--ros-args')[0], comments=True)
        options = {word for word in words if word.startswith('-') and word != '-'}
        assert command == 'COMMAND' or options <= {*choices[command]._option_string_actions}, line


@pytest.mark.parametrize('page', PAGES)
def test_links_lead_somewhere(page):
    for link, anchor in re.findall(r'\]\(([^)#]*)(#[^)]*)?\)', text_of(page)):
        if link.startswith('http'):
            continue
        target = (ROOT / page).parent / link if link else ROOT / page
        assert target.exists(), link
        if anchor:
            # Anchors that GitHub makes of headings
            headings = re.findall(r'^#+ (.+)$', target.read_text('utf-8').lower(), re.MULTILINE)
            assert anchor[1:] in {re.sub(r'[^\w\- ]', '', heading).replace(' ', '-')
                                  for heading in headings}, anchor


@pytest.mark.parametrize('page', OWN_PAGES)
def test_named_files_exist(page):
    for path in re.findall(r'`((?:\w+/)+\w+\.(?:py|xml))`', text_of(page)):
        assert (ROOT / path).exists() or (ROOT / 'accel_calib' / path).exists(), path


def test_services_and_topics_of_the_docs_are_those_of_the_node():
    page = text_of('docs/node.md')
    listed = set(re.findall(r'`(~/\w+|imu/\w+|/diagnostics|temperature)`', '\n'.join(
        line for line in page.splitlines() if re.match(r'\| `.*(_msgs/|std_srvs)', line))))
    of_every_node = re.compile(r'/parameter_events|/rosout|~/(.*_parameters.*|get_.*)')
    assert listed == {name for name in names_of_the_calibrator()
                      if not of_every_node.fullmatch(name)}


FOREIGN = {'externally-managed-environment'}
"""Messages of other programs."""


def template(node):
    """Return the text of a string in the code, with … for each value in it; None: no string."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return ''.join(template(part) or '…' for part in node.values)
    return None


def test_each_quoted_message_is_in_the_code():
    templates = set()
    for path in (ROOT / 'accel_calib').rglob('*.py'):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding='utf-8'))))
        parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr)
                 for part in node.values}
        documented = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        templates |= {template(node) for node in nodes
                      if id(node) not in parts | documented and template(node)}
    quoted = {*re.findall(r'^- \*\*`([^`]+)`\*\*', text_of('docs/troubleshooting.md'), re.M)}
    assert len(quoted) >= 25
    for quote in quoted - FOREIGN:
        pattern = re.compile('.*'.join(re.escape(part.strip()) for part in quote.split('…')))
        assert any(map(pattern.search, templates)), quote


FOLDER = ROOT / 'docs' / 'pictures'
LARGEST = 300_000  # bytes
RUN_AGAIN = 'run: python docs/pictures.py'


def without_numbers(text):
    return re.sub(r'[-−]?[\d.]+(e-?\d+)?', '#', text)


def test_the_picture_of_the_poses_is_drawn_from_the_planner():
    assert (FOLDER / 'poses.svg').read_text('utf-8') == pictures.poses_svg(), RUN_AGAIN


@pytest.mark.skipif(FACTOR == 1, reason='commands run for half a minute: .ci/run')
def test_terminals_show_what_the_commands_print(tmp_path):
    pictures.prepare(tmp_path)
    for name, commands in pictures.TERMINALS.items():
        drawn = pictures.terminal_svg(name, pictures.recorded(commands, tmp_path))
        stored = (FOLDER / f'{name}.svg').read_text('utf-8')
        assert without_numbers(pictures.shown_text(stored)) == without_numbers(
            pictures.shown_text(drawn)), RUN_AGAIN


@pytest.mark.parametrize('path', sorted(FOLDER.iterdir()), ids=lambda path: path.name)
def test_pictures_are_small_and_need_no_network(path):
    assert path.stat().st_size < LARGEST
    if path.suffix == '.svg':
        root = ElementTree.parse(path).getroot()
        assert root.get('role') == 'img'
        assert root.get('aria-label') or root.get('aria-labelledby')
        text = path.read_text('utf-8').replace('http://www.w3.org/2000/svg', '')
        assert 'http' not in text


# The page of evidence states what its commands find in real recordings


NUMBER = re.compile(r'[-−]?\d+(?:\.\d+)?')


@pytest.fixture(scope='module')
def cases():
    return evidence.cases_of(data('README.md').parent)


def test_the_table_states_what_the_commands_find(cases):
    stated, found = evidence.PAGE.read_text('utf-8'), evidence.with_table(cases)
    assert NUMBER.sub('#', found) == NUMBER.sub('#', stated), 'run: python docs/evidence.py'
    numbers = [[float(each.replace('−', '-')) for each in NUMBER.findall(text)]
               for text in (found, stated)]
    np.testing.assert_allclose(*numbers, rtol=0.1)


def test_the_slopes_of_the_sense_hat_are_those_of_an_independent_analysis(cases):
    slopes = cases[0].calibration.model.values['offset_temperature'][:3]
    np.testing.assert_allclose(1e3 * slopes, [0.57, 0.41, -0.41], atol=0.01)


def test_the_sensor_that_steps_when_it_is_heated_has_the_step_and_the_slope(cases):
    found = cases[1].calibration.model.values
    assert found['offset_step'][3] == pytest.approx(146.0, abs=3.0)
    assert found['offset_step'][2] == pytest.approx(2.5e-3, abs=1e-3)
    assert found['offset_temperature'][2] == pytest.approx(5e-4, abs=2e-4)


def test_the_effects_of_the_cycle_leave_a_third_of_the_polynomial_of_its_publisher(cases):
    columns = np.genfromtxt(data('poses/thermal_cycle_poses.csv'), delimiter=',', names=True,
                            skip_header=1)
    warm = columns['temperature']
    left = [columns[name] - np.polyval(np.polyfit(warm, columns[name], 3), warm)
            for name in ('ax', 'ay', 'az')]
    cubic_mg = 1e3 * rms(np.linalg.norm(left, axis=0)) / GRAVITY
    assert cubic_mg == pytest.approx(4.8, abs=0.05)
    result = cases[2].result
    assert result['rms_after_mg'] == result['thermal']['residual_mg'] < 0.4 * cubic_mg
    for vendor in ('px4', 'ardupilot'):
        assert any('lag' in each for each in export(cases[2].calibration, vendor).losses)


# The commands and the snippets of the pages run


OF_ROS = {'node', 'simulator', 'watch', 'demo', 'live'}
SENSOR = {**shared.SENSOR, 'offset': [0.03, -0.02, 0.04]}
LIBRARIES = {'.ulg': 'pyulog', '.bin': 'pymavlink'}


def blocks_of(text):
    """Return the files that a page names, and the commands of each block and its exit status."""
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
        blocks.append(([words[1:] for words in commands], int(status or 0)))
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


@pytest.mark.parametrize('page', sample([page for page in USER_PAGES if any(
    commands for commands, _ in blocks_of(text_of(page))[1])
    and page != 'docs/evidence.md'], 5))  # `cases` runs it
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
    if any(words[0] == 'fleet' for commands, _ in blocks for words in commands):
        pytest.importorskip('distributed')
    for commands, status in blocks:
        statuses = [run(words) for words in commands if words[0] not in OF_ROS]
        expected = [0] * (len(statuses) - 1) + [status] * bool(statuses)
        assert statuses == expected, (commands, capsys.readouterr())


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
    page for page in USER_PAGES if '```python' in text_of(page)
    and page != 'docs/fleet.md'])  # test_fleet.py runs it
def test_snippets_of_python_run_and_print_what_the_page_shows(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in re.findall(r"'([\w./]+)'", text_of(page)):
        provide(name)
    run_snippets(page, lambda shown: shown == capsys.readouterr().out)


def test_every_command_without_ros_is_run_by_a_page():
    used = {words[0] for page in USER_PAGES for commands, _ in blocks_of(text_of(page))[1]
            for words in commands}
    assert set(COMMANDS) - OF_ROS <= used


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
