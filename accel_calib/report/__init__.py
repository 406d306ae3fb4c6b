# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
Figures, and the pages of results: self-contained HTML files.

`page` has the page of one calibration, for `fit`, `calibrate`, `verify`, `refine` and `thermal`,
with the figures of `residuals`. `stability` has those of `noise`, `compare` and `history`, which
are imported from there. They make what a page shows; its text stands in a template of the folder
``page``, which `sheet` fills. `sheet` also has the style of all figures. matplotlib is imported
only when a figure is drawn.

"""

from .page import calibration_page, refinement_page, STORED, thermal_page, write_figures
from .residuals import plot_residuals
from .sheet import check_matplotlib, policy, write_page
