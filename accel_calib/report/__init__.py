# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures, and the pages of results: self-contained HTML files.

`page` has the page of one calibration, for `fit`, `calibrate`, `verify`, `refine` and `thermal`,
with the figures of `residuals` and of `refinement`. `stability` has those of `noise`, `compare`
and `history`, which are imported from there. `sheet` is the skeleton and the style of all pages
and figures, with the style sheet and the script of the folder ``page``. matplotlib is imported
only when a figure is drawn.

"""

from .page import calibration_page, refinement_page, STORED, thermal_page
from .refinement import write_figures
from .residuals import plot_residuals
from .sheet import check_matplotlib, policy, write_page

__all__ = ['STORED', 'calibration_page', 'check_matplotlib', 'plot_residuals', 'policy',
           'refinement_page', 'thermal_page', 'write_figures', 'write_page']
