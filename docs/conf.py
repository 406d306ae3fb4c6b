# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Configuration of the documentation site: ``make docs``.

Tables and the API reference are made from the code when the site is built. Links to files outside
this folder lead to the repository. rosdoc2 reads this file from a copy of this folder, and puts
the package on the path. Where the package cannot be imported, the lines that stand for the tables
remain.

"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
import re
import sys
from typing import Any

from docutils import nodes

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

project = 'accel_calib'
author = 'The accel_calib authors'
project_copyright = f'2026 {author}'
repository = 'https://github.com/accel-calib/accel_calib'

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}

# Every link between the pages, but not types of other projects in the docstrings.
nitpicky = True
nitpick_ignore_regex = [('py:.*', '.*')]

# As deep as the links of the pages go; the anchors are those that GitHub makes.
myst_heading_anchors = 4
myst_enable_extensions = ['colon_fence']

# The docstrings state types and shapes, and the names of attributes stand in them, too.
autodoc_typehints = 'none'
autodoc_member_order = 'bysource'
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = 'pydata_sphinx_theme'
html_theme_options = {'navbar_align': 'left', 'secondary_sidebar_items': ['page-toc'],
                      'show_prev_next': False}
html_static_path = ['site']
html_css_files = ['site.css']
html_show_sourcelink = False
html_title = 'accel_calib'

rosdoc2_settings = {'enable_autodoc': False, 'enable_intersphinx': False,
                    'automatically_extend_intersphinx_mapping': False}

_LINK = re.compile(r'\]\(((?:\.\./)+)([^)#]+)(#[^)]*)?\)')


def insert_tables(app: Any, page: str, source: list[str]) -> None:
    """Replace the lines that stand for tables by the tables."""
    with suppress(ModuleNotFoundError):
        import tables

        source[0] = tables.with_tables(source[0])


def link_to_repository(app: Any, page: str, source: list[str]) -> None:
    """Replace links to files outside this folder by links to the repository."""
    depth = page.count('/')

    def replaced(found: re.Match[str]) -> str:
        ups, path, anchor = found.groups()
        if ups.count('../') <= depth:
            return found.group(0)
        return f']({repository}/blob/main/{path}{anchor or ""})'

    source[0] = _LINK.sub(replaced, source[0])


def escape_bars(app: Any, kind: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Escape the bars of |a| in docstrings, which reStructuredText takes for a substitution."""
    lines[:] = [re.sub(r'\|(\w+)\|', r'\\|\1\\|', line) for line in lines]


def prepare_tables(app: Any, tree: nodes.document, page: str) -> None:
    """
    Make tables fit narrow screens, which show the cells of a row one below the other.

    Each cell of three or more columns begins with the head of its column, which wide screens hide.
    Words that no column holds may break after a sign.

    """
    for table in tree.findall(nodes.tgroup):
        heads, body = ([*part.findall(nodes.row)] for part in table.children[-2:])
        for row in body if heads else ():
            for head, entry in zip(heads[0].children[1:], row.children[1:]):
                if len(row.children) > 2 and head.astext() and entry.astext():
                    label = nodes.inline('', f'{head.astext()}: ', classes=['of-column'])
                    entry.children[0].insert(0, label)
        for text in [*table.findall(nodes.Text)]:
            parted = re.sub(r'\S{40,}', lambda word: re.sub(
                r'(?<=[,=_/*@])', '\N{ZERO WIDTH SPACE}', word[0]), text)
            if not isinstance(text.parent, nodes.literal):
                text.parent.replace(text, nodes.Text(parted))


def setup(app: Any) -> None:
    """Connect the functions of this file."""
    app.connect('doctree-resolved', prepare_tables)
    app.connect('autodoc-process-docstring', escape_bars)
    app.connect('source-read', insert_tables)
    app.connect('source-read', link_to_repository)
