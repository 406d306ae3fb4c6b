# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The documentation says what the code does."""

import importlib.util
from pathlib import Path
import re

from accel_calib.cli.main import parser
import pytest

ROOT = Path(__file__).resolve().parents[1]


def tables():
    spec = importlib.util.spec_from_file_location('tables', ROOT / 'docs' / 'tables.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize('page', sorted((ROOT / 'docs').glob('*.md')), ids=lambda path: path.name)
def test_tables_are_those_of_the_code(page):
    text = page.read_text(encoding='utf-8')
    assert tables().with_tables(text) == text, 'run: python docs/tables.py'


def test_every_table_is_in_a_page():
    pages = ''.join(path.read_text(encoding='utf-8') for path in (ROOT / 'docs').glob('*.md'))
    for name in tables().TABLES:
        assert f'<!-- {name} -->' in pages


def test_commands_of_the_readme_exist():
    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    known = set(parser()._subparsers._group_actions[0].choices)
    assert set(re.findall(r'^ +accel-calib (\w+)', text, re.MULTILINE)) <= known


@pytest.mark.parametrize('page', ['README.md', 'CONTRIBUTING.md', *(
    str(path.relative_to(ROOT)) for path in (ROOT / 'docs').rglob('*.md'))])
def test_links_lead_somewhere(page):
    path = ROOT / page
    for link in re.findall(r'\]\(([^)#]+)\)', path.read_text(encoding='utf-8')):
        assert link.startswith('http') or (path.parent / link).exists(), link


def test_services_and_topics_of_the_readme_are_those_of_the_node():
    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    source = (ROOT / 'accel_calib' / 'ros' / 'calibrator_node.py').read_text(encoding='utf-8')
    table = [line for line in text.splitlines() if line.startswith('| `')]
    listed = set(re.findall(r'`(~/\w+|imu/\w+|/diagnostics|temperature)`', '\n'.join(
        line for line in table if '_msgs/' in line or 'std_srvs' in line)))
    made = set(re.findall(r"'(~/\w+|imu/\w+|/diagnostics|temperature)'", source))
    triggers = re.search(r'_TRIGGERS = \((.*?)\)', source, re.DOTALL).group(1)
    made |= {f'~/{name}' for name in re.findall(r"'(\w+)'", triggers)}
    assert listed == made
