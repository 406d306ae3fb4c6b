# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures, and the pages of calibrations: self-contained HTML files.

`page` makes the pages of one calibration: of `fit`, `calibrate`, `verify` and `refine`. `repeats`
makes those of several calibrations: of `compare` and `history`. `noise_page` is that of `noise`.
`sheet` is the skeleton of all pages, with the style sheet and the script of the folder ``page``.

`charts` has the style of all figures and the figures of `residuals`; `drawings` has those of a
refinement. matplotlib is imported only when a figure is drawn.

"""

from .charts import check_matplotlib, has_matplotlib, plot_residuals
from .drawings import write_figures
from .page import write_calibration_page, write_page
from .repeats import write_comparison_page, write_history_page

__all__ = ['check_matplotlib', 'has_matplotlib', 'plot_residuals', 'write_calibration_page',
           'write_comparison_page', 'write_figures', 'write_history_page', 'write_page']
