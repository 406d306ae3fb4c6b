# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Configuration of the documentation site: ``make docs``.

rosdoc2 reads this file, too, from a copy of this folder, so it uses no paths of the repository.
Links to files outside this folder lead to the repository.

"""

from __future__ import annotations

import re
from typing import Any

project = 'accel_calib'
author = 'The accel_calib authors'
project_copyright = f'2026 {author}'
repository = 'https://github.com/accel-calib/accel_calib'

extensions = ['myst_parser']
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}
nitpicky = True

# As deep as the links of the pages go; the anchors are those that GitHub makes.
myst_heading_anchors = 4
myst_enable_extensions = ['colon_fence']

html_theme = 'sphinx_rtd_theme'
html_theme_options = {'navigation_depth': 3}
html_show_sourcelink = False
html_title = 'accel_calib'

# The pages are Markdown; there is no reference that autodoc or another project could resolve.
rosdoc2_settings = {'enable_autodoc': False, 'enable_intersphinx': False,
                    'automatically_extend_intersphinx_mapping': False}

_LINK = re.compile(r'\]\(((?:\.\./)+)([^)#]+)(#[^)]*)?\)')


def link_to_repository(app: Any, page: str, source: list[str]) -> None:
    """Replace links to files outside this folder by links to the repository."""
    depth = page.count('/')

    def replaced(found: re.Match[str]) -> str:
        ups, path, anchor = found.groups()
        if ups.count('../') <= depth:
            return found.group(0)
        return f']({repository}/blob/main/{path}{anchor or ""})'

    source[0] = _LINK.sub(replaced, source[0])


def setup(app: Any) -> None:
    """Connect the functions of this file."""
    app.connect('source-read', link_to_repository)
