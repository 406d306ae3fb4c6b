# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The documentation agrees with the code, and its commands and snippets run."""

from dataclasses import fields
import importlib
import inspect
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys

import accel_calib as ac
from accel_calib.cli.main import COMMANDS, main, parser
from accel_calib.files import write_table
from accel_calib.session import CalibratorSettings
import numpy as np
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PAGES = ['README.md', 'CONTRIBUTING.md', 'QUALITY_DECLARATION.md', 'SECURITY.md', *(
    str(path.relative_to(ROOT)) for path in sorted((ROOT / 'docs').rglob('*.md')))]
OWN_PAGES = [page for page in PAGES if 'figures' not in page]
EFFECTS = {'offset': [0.02, -0.01, 0.03], 'axis_gain': [0.01, -0.02, 0.005],
           'cross_axis': [0.004, 0.002, -0.003]}


def text_of(page):
    return (ROOT / page).read_text(encoding='utf-8')


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    return importlib.import_module('tables')


@pytest.mark.parametrize('page', OWN_PAGES)
def test_tables_are_those_of_the_code(page, tables):
    assert tables.with_tables(text_of(page)) == text_of(page), 'run: python docs/tables.py'


def test_every_table_is_in_a_page(tables):
    pages = ''.join(map(text_of, OWN_PAGES))
    for name in tables.TABLES:
        assert f'<!-- {name} -->' in pages


def test_api_reference_is_made_from_the_docstrings(tables):
    made = tables.api_page.page()
    assert made == text_of('docs/api.md'), 'run: python docs/tables.py'


def test_api_reference_has_every_public_name(tables):
    assert {*tables.api_page.FUNCTIONS, *tables.api_page.RECORDS} == set(ac.__all__)
    for name in ac.__all__:
        assert f'\n### ac.{name}\n' in text_of('docs/api.md')


def test_every_parameter_of_a_public_function_is_documented(tables):
    api_page = tables.api_page
    for name in api_page.FUNCTIONS:
        sections = api_page.parsed(getattr(ac, name))[1]
        listed = [each.lstrip('*') for head, _ in sections['Parameters']
                  for each in api_page.names_in(head)]
        assert listed == list(inspect.signature(getattr(ac, name)).parameters), name
        assert {'Returns', 'Raises'} <= set(sections), name


def test_pages_are_made_without_an_installed_package(tmp_path):
    code = ("import runpy; made = runpy.run_path('docs/tables.py')['api_page']; "
            'print(made.ac.__file__)')
    environment = {key: value for key, value in os.environ.items() if key != 'PYTHONPATH'}
    # -I keeps the working folder out of the path, as for a script that is given by its name.
    done = subprocess.run([sys.executable, '-I', '-c', code], cwd=ROOT, env=environment,
                          capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()) == ROOT / 'accel_calib' / '__init__.py'


def commands_in(page):
    """Return the lines of a page that are commands, without comments."""
    lines = re.findall(r'^ {4,}accel-calib (.*)', text_of(page), re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.parametrize('page', OWN_PAGES)
def test_commands_and_their_options_exist(page):
    named = re.findall(r'`accel-calib ([^`]+)`', text_of(page))
    for words in [*commands_in(page), *map(shlex.split, named)]:
        if words[0] == 'COMMAND':
            continue
        assert words[0] in COMMANDS
        own = words[:words.index('--ros-args')] if '--ros-args' in words else words
        options = {word for word in own if word.startswith('-') and word != '-'}
        known = parser()._subparsers._group_actions[0].choices[words[0]]._option_string_actions
        assert options <= set(known), words


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Give a folder with the files that the pages name, as working folder."""
    monkeypatch.chdir(tmp_path)
    write_table(Path('recording.csv'), ac.simulate(EFFECTS, recording=True, poses=18, seed=1))
    write_table(Path('other_poses.csv'), ac.simulate(EFFECTS, poses=12, seed=2))
    for seed, name in enumerate(('calibration', 'monday', 'tuesday', 'wednesday')):
        ac.fit(ac.simulate(EFFECTS, poses=24, seed=10 + seed)).save(f'{name}.yaml')
    return tmp_path


@pytest.mark.parametrize('page', OWN_PAGES)
def test_commands_of_the_pages_run(page, folder, capsys):
    for words in commands_in(page):
        if {'refine', 'report'} & set(words):
            pytest.importorskip('matplotlib')
            write_poses_with_context()
        given = [word.replace('.mcap', '.csv') for word in words]
        assert main(given) == 0, (words, capsys.readouterr())


def write_poses_with_context():
    time = np.arange(48) * 20.0
    poses = ac.simulate({**EFFECTS, 'offset_temperature': [2e-4, -1e-4, 1.5e-4]}, poses=48,
                        time=time, temperature=30.0 + 10.0 * np.sin(time / 90.0))
    write_table(Path('poses.csv'), poses)


@pytest.mark.parametrize('page', OWN_PAGES)
def test_python_snippets_run(page, folder):
    if page == 'docs/api.md':  # signatures
        return
    if page == 'docs/fleet.md':  # test_fleet.py runs it on results
        return
    names = {}
    for snippet in re.findall(r'^```python\n(.*?)^```', text_of(page), re.MULTILINE | re.DOTALL):
        exec(compile(snippet.replace('.mcap', '.csv'), page, 'exec'), names)


@pytest.mark.parametrize('page', PAGES)
def test_links_lead_somewhere(page):
    for link, anchor in re.findall(r'\]\(([^)#]*)(#[^)]*)?\)', text_of(page)):
        if link.startswith('http'):
            continue
        target = (ROOT / page).parent / link if link else ROOT / page
        assert target.exists(), link
        if anchor:
            assert anchor[1:] in anchors_of(target), anchor


def anchors_of(path):
    """Return the anchors that GitHub makes of the headings of a page."""
    headings = re.findall(r'^#+ (.+)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def test_services_and_topics_of_the_docs_are_those_of_the_node():
    source = text_of('accel_calib/ros/calibrator_node.py')
    table = [line for line in text_of('docs/node.md').splitlines() if line.startswith('| `')]
    listed = set(re.findall(r'`(~/\w+|imu/\w+|/diagnostics|temperature)`', '\n'.join(
        line for line in table if '_msgs/' in line or 'std_srvs' in line)))
    made = set(re.findall(r"'(~/\w+|imu/\w+|/diagnostics|temperature)'", source))
    triggers = re.search(r'_TRIGGERS = \((.*?)\)', source, re.DOTALL).group(1)
    made |= {f'~/{name}' for name in re.findall(r"'(\w+)'", triggers)}
    assert listed == made


def test_parameters_of_the_docs_are_those_of_the_node():
    table = text_of('docs/node.md').partition('| parameters | |\n')[2].partition('\n\n')[0]
    listed = re.findall(r'`(\w+)`', table)
    assert sorted(listed) == sorted(field.name for field in fields(CalibratorSettings))


def test_the_rule_of_frames_is_in_one_place():
    pages = [page for page in OWN_PAGES if '<frame_id>_levelled' in text_of(page)]
    assert pages == ['docs/robot.md']
    for page in ('docs/files.md', 'docs/method.md'):
        assert 'robot.md#which-frame-a-corrected-message-is-in' in text_of(page)


def test_the_readme_is_short_and_shows_pictures():
    readme = text_of('README.md')
    assert len(readme.splitlines()) < 120
    assert len(re.findall(r'!\[[^\]]+\]\(docs/pictures/[\w.]+\)', readme)) >= 3


@pytest.fixture
def conf(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    return importlib.import_module('conf')


@pytest.mark.parametrize(('page', 'link', 'expected'), [
    ('node', '](../launch/a.py)',
     '](https://github.com/accel-calib/accel_calib/blob/main/launch/a.py)'),
    ('guides/esp32', '](../install.md#ros)', '](../install.md#ros)'),
    ('guides/esp32', '](../../README.md#try-it)',
     '](https://github.com/accel-calib/accel_calib/blob/main/README.md#try-it)'),
    ('node', '](robot.md)', '](robot.md)'),
])
def test_links_out_of_the_site_lead_to_the_repository(conf, page, link, expected):
    source = [f'see [it{link}.']
    conf.link_to_repository(None, page, source)
    assert source == [f'see [it{expected}.']


def test_the_site_has_every_page():
    index = text_of('docs/index.rst')
    for page in sorted((ROOT / 'docs').rglob('*.md')):
        name = str(page.relative_to(ROOT / 'docs').with_suffix(''))
        if not name.startswith('figures/'):
            assert f'\n   {name}\n' in index, name


def test_rosdoc2_builds_the_site_of_this_folder():
    parts = list(yaml.safe_load_all(text_of('rosdoc2.yaml')))
    assert parts[1]['builders'] == [{'sphinx': {
        'name': 'accel_calib', 'sphinx_sourcedir': 'docs', 'output_dir': ''}}]
    assert '<rosdoc2>rosdoc2.yaml</rosdoc2>' in text_of('package.xml')
