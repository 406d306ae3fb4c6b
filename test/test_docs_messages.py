# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Each message that the page about troubleshooting quotes is in the code, word by word."""

import ast
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).resolve().parents[1]
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


def test_a_message_that_is_not_in_the_code_is_found(templates):
    assert not any(is_in('the sensor is … upside down', text) for text in templates)
    assert is_in('has … topics, expected one', 'a.bag has … Imu topics, expected one: …')
    assert not is_in('expected one … has', 'a.bag has … Imu topics, expected one: …')
