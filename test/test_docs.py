# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The documentation and its pictures agree with the code; test_docs_commands runs its commands."""

import ast
from dataclasses import fields
import importlib
import inspect
from pydoc import locate
import re
import shlex
from xml.etree import ElementTree

import accel_calib as ac
from accel_calib.session import CalibratorSettings
from faults.sample import FACTOR
from inside import EXPORT_FORMATS, LOG_FORMATS, parser
import pytest
from shared import ROOT, text_of
from test_policy import names_of_the_calibrator
import yaml

PAGES = ['README.md', 'CONTRIBUTING.md', 'QUALITY_DECLARATION.md', 'SECURITY.md', *(
    str(path.relative_to(ROOT)) for path in sorted((ROOT / 'docs').rglob('*.md')))]
OWN_PAGES = [page for page in PAGES if 'figures' not in page]


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    return importlib.import_module('tables')


@pytest.fixture
def built(tables):
    """Return the text of a page as the site has it, with the tables of the code."""
    return lambda page: tables.with_tables(text_of(page))


def test_parameter_file_describes_all_parameters_and_has_their_defaults(tables):
    text = tables.PARAMETERS.read_text(encoding='utf-8')
    assert text.splitlines() == [*tables.parameters()], 'run: python docs/tables.py'
    given = yaml.safe_load(text)['/**']['ros__parameters']
    assert CalibratorSettings(**given) == CalibratorSettings()
    assert list(given) == [parameter.name for parameter in fields(CalibratorSettings)]


@pytest.mark.parametrize(('page', 'names'), [
    ('docs/exports.md', EXPORT_FORMATS), ('docs/log_formats.md', LOG_FORMATS)])
def test_every_format_is_in_its_page(page, names, built):
    assert not [name for name in names if f'`{name}`' not in built(page)]


def test_every_table_of_the_code_is_in_a_page_of_the_site_and_none_is_stored(tables, built):
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


def test_api_reference_names_records_where_they_are():
    module = ''
    page = text_of('docs/api.md')
    for kind, name in re.findall(r'^\.\. (currentmodule|autoclass):: (\S+)$', page, re.M):
        if kind == 'currentmodule':
            module = name
        else:
            assert locate(f'{module}.{name}') or locate(name), name


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
            assert anchor[1:] in anchors_of(target), anchor


@pytest.mark.parametrize('page', OWN_PAGES)
def test_named_files_exist(page):
    for path in re.findall(r'`((?:\w+/)+\w+\.(?:py|xml))`', text_of(page)):
        assert (ROOT / path).exists() or (ROOT / 'accel_calib' / path).exists(), path


def anchors_of(path):
    """Return the anchors that GitHub makes of the headings of a page."""
    headings = re.findall(r'^#+ (.+)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def test_services_and_topics_of_the_docs_are_those_of_the_node():
    page = text_of('docs/node.md')
    listed = set(re.findall(r'`(~/\w+|imu/\w+|/diagnostics|temperature)`', '\n'.join(
        line for line in page.splitlines() if re.match(r'\| `.*(_msgs/|std_srvs)', line))))
    of_every_node = re.compile(r'/parameter_events|/rosout|~/(.*_parameters.*|get_.*)')
    assert listed == {name for name in names_of_the_calibrator()
                      if not of_every_node.fullmatch(name)}


def test_the_site_has_every_page():
    index = ''.join(path.read_text('utf-8') for path in (ROOT / 'docs').glob('*.rst'))
    for page in sorted((ROOT / 'docs').rglob('*.md')):
        name = str(page.relative_to(ROOT / 'docs').with_suffix(''))
        if not name.startswith('figures/'):
            assert f'\n   {name}\n' in index, name


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


@pytest.fixture
def pictures(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    return importlib.import_module('pictures')


def without_numbers(text):
    return re.sub(r'[-−]?[\d.]+(e-?\d+)?', '#', text)


def test_the_picture_of_the_poses_is_drawn_from_the_planner(pictures):
    assert (FOLDER / 'poses.svg').read_text('utf-8') == pictures.poses_svg(), RUN_AGAIN


@pytest.mark.skipif(FACTOR == 1, reason='commands run for half a minute: .ci/run')
def test_terminals_show_what_the_commands_print(pictures, tmp_path):
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
