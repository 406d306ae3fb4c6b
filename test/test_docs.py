# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The documentation and its pictures agree with the code; test_docs_commands runs its commands."""

import ast
from dataclasses import fields
import importlib
import inspect
from pathlib import Path
import re
import shlex
from xml.etree import ElementTree

import accel_calib as ac
from accel_calib.session import CalibratorSettings
from faults.sample import FACTOR
from inside import COMMANDS, parser
import pytest
from test_policy import names_of_the_calibrator

ROOT = Path(__file__).resolve().parents[1]
PAGES = ['README.md', 'CONTRIBUTING.md', 'QUALITY_DECLARATION.md', 'SECURITY.md', *(
    str(path.relative_to(ROOT)) for path in sorted((ROOT / 'docs').rglob('*.md')))]
OWN_PAGES = [page for page in PAGES if 'figures' not in page]


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
    table = [line for line in text_of('docs/node.md').splitlines() if line.startswith('| `')]
    listed = set(re.findall(r'`(~/\w+|imu/\w+|/diagnostics|temperature)`', '\n'.join(
        line for line in table if '_msgs/' in line or 'std_srvs' in line)))
    of_every_node = re.compile(r'/parameter_events|/rosout|~/(.*_parameters.*|get_.*)')
    assert listed == {name for name in names_of_the_calibrator()
                      if not of_every_node.fullmatch(name)}


def test_parameters_of_the_docs_are_those_of_the_node():
    table = text_of('docs/node.md').partition('| parameters | |\n')[2].partition('\n\n')[0]
    listed = re.findall(r'`(\w+)`', table)
    assert sorted(listed) == sorted(field.name for field in fields(CalibratorSettings))


def test_the_site_has_every_page():
    index = text_of('docs/index.rst')
    for page in sorted((ROOT / 'docs').rglob('*.md')):
        name = str(page.relative_to(ROOT / 'docs').with_suffix(''))
        if not name.startswith('figures/'):
            assert f'\n   {name}\n' in index, name


PAGE = (ROOT / 'docs' / 'troubleshooting.md').read_text(encoding='utf-8')
FOREIGN = {'externally-managed-environment'}
"""Messages of other programs."""

QUOTED = [quote for quote in re.findall(r'^- \*\*`([^`]+)`\*\*', PAGE, re.MULTILINE)
          if quote not in FOREIGN]


def template(node):
    """Return the text of a string in the code, with … for each value in it; None: no string."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return ''.join(template(part) or '…' for part in node.values)
    return None


@pytest.fixture(scope='module')
def templates():
    texts = set()
    for path in (ROOT / 'accel_calib').rglob('*.py'):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding='utf-8'))))
        parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr)
                 for part in node.values}
        documented = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        texts |= {template(node) for node in nodes
                  if id(node) not in parts | documented and template(node)}
    return texts


def is_in(quote, text):
    """Return whether the parts of a quote between … are in a text, in their order."""
    parts = [re.escape(part.strip()) for part in quote.split('…') if part.strip()]
    return re.search('.*'.join(parts), text) is not None


def test_each_quoted_message_is_in_the_code(templates):
    assert len(QUOTED) >= 35
    for quote in QUOTED:
        assert any(is_in(quote, text) for text in templates), quote


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
