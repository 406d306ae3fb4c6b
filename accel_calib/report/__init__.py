# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures of a refinement, and one page (the report) with all figures.

`drawings` draws the figures in the style of `style`, and `page` writes the HTML. matplotlib is
imported only when a figure is drawn.

"""

from .drawings import write_figures
from .page import write_page
from .style import check_matplotlib

__all__ = ['check_matplotlib', 'write_figures', 'write_page']
