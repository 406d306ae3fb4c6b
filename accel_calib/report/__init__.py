# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Results as figures, and one page with all of them.

`drawings` lists the figures; `sphere_map`, `against` and `ladder` draw them in one `style`; `page`
puts them into HTML. matplotlib is imported only when a figure is drawn.

"""

from .drawings import all_drawings, write_figures
from .page import page, write_page
from .style import check_matplotlib

__all__ = ['all_drawings', 'check_matplotlib', 'page', 'write_figures', 'write_page']
