# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures, and the pages of calibrations: self-contained HTML files.

`page` makes the pages of one calibration: of `fit`, `calibrate`, `verify` and `refine`. Their
sections are in `calibration_sections` and `refinement_sections`. `repeat_pages` makes those of
several calibrations: of `compare` and `history`. `sheet` is the skeleton of all pages.

`charts`, `ladder`, `curve` and `repeat_charts` draw the figures in the style of `style`, and
`drawings` gives them names. matplotlib is imported only when a figure is drawn.

"""

from .drawings import write_figures
from .page import write_calibration_page, write_page
from .repeats import write_comparison_page, write_history_page
from .style import check_matplotlib, has_matplotlib

__all__ = ['check_matplotlib', 'has_matplotlib', 'write_calibration_page',
           'write_comparison_page', 'write_figures', 'write_history_page', 'write_page']
