# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Results to figures, and one page that holds all of them.

`drawings` says which figures there are, `sphere_map`, `against` and `ladder` draw them, `style`
says how they look; `page` puts them into HTML without anything from outside; `words` serves the
terminal too. matplotlib is imported only where a figure is drawn.

"""

from .drawings import all_drawings, write_figures
from .page import page, write_page
from .style import check_matplotlib

__all__ = ['all_drawings', 'check_matplotlib', 'page', 'write_figures', 'write_page']
