# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses and a calibration to the gap, the named effect and the larger model.

`refinement` is the entry point. `calibrations` contains the base, also a stored calibration, and
the refined calibration. `base` prepares the poses and fits the base. `linear` contains the effects
of the catalogue as columns of the equations near a model, and the score of a set of effects and
outliers. `sets` searches for the best set and computes the probability of each effect. `curves`
contains causes without a known form: a random walk of the offset, and an empirical curve. `search`
searches near a model and fits in turn. `result` makes the record, `plan` chooses the poses that
separate effects from their rivals, and `words` makes the sentences.

"""

from .calibrations import refitted
from .plan import PlannedPose, PosePlan
from .refinement import refine, refine_with_fleet
from .result import Refinement, Stage, Step

__all__ = ['PlannedPose', 'PosePlan', 'Refinement', 'Stage', 'Step', 'refine',
           'refine_with_fleet', 'refitted']
