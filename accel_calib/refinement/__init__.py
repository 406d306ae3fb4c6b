# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
From poses and a calibration to the gap, the named effect and the larger model.

`refinement` is the entry point: it fits the base, and makes the refined calibration and the record
of the result. `state` prepares the poses, and is a model fitted to them, with the effects of the
catalogue as columns of its equations. `linear` scores and extends sets of these columns and of
outliers. `settle` searches for the best sets near a model and fits them, in turn, until each
effect is sound, and computes the probability of each effect and of its rivals. `search` is the
whole method. `curves` contains causes without a known form: a random walk of the offset, and an
empirical curve. `steps` states what was found; `accel_calib.findings` has the words for it.

"""

from .refinement import refine, Refinement, refitted
from .steps import named_entries, Remark, Stage, Step
