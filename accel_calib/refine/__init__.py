# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses and a calibration to the gap, the named effect and the larger model.

`refinement` is the entry point and makes the record (`records`). `stored` prepares a stored
calibration as the base. `search` searches near a model and fits in turn; `state` is a model fitted
to the poses kept. `linear` contains the effects of the catalogue as columns of the equations near
a model, and the score of a set of effects and outliers. `sets` searches for the best set, and
`wander` compares it with a random walk of the offset. `curves` finds an empirical curve where no
effect fits, and `rivals` computes the probability of each effect. `output` contains the effects
that are not columns of the equations. `findings` describes the result, and `plan` chooses the
poses that separate effects from their rivals. `with_fleet` includes the typical values of a fleet.

"""

from .records import PlannedPose, PosePlan, Refinement, Stage, Step
from .refinement import refine
from .with_fleet import refine_with_fleet

__all__ = ['PlannedPose', 'PosePlan', 'Refinement', 'Stage', 'Step', 'refine', 'refine_with_fleet']
