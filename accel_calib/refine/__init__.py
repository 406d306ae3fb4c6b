# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses and calibration to gap, named effect, larger model.

The way of the data: `equations` sets up what poses say near a model, `candidates` gives the
effects of the catalogue as columns beside them (`output` and `wander` those that are none),
`score` ranks and admits, `search` adds, pairs and takes back, `refinement` tells the story.

"""

from .base import BASES
from .records import Refinement, Stage, Step
from .refinement import refine

__all__ = ['BASES', 'Refinement', 'Stage', 'Step', 'refine']
