# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses and calibration to gap, named effect, larger model.

`base` is the model to begin with, `stored` a calibration that is compared as it is. `state` is a
model fitted to the poses kept, `candidates` are the effects of the catalogue as columns beside it
(`output` and `wander` those that are none), `search` adds, pairs and takes back, `refinement` is
the way in and makes the record; `where`, `untestable` and `advice` put it into words.

"""

from .base import BASES
from .records import Refinement, Stage, Step
from .refinement import refine

__all__ = ['BASES', 'Refinement', 'Stage', 'Step', 'refine']
