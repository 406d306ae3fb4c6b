# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses and a calibration to the gap, the named effect and the larger model.

`refinement` is the entry point and makes the record (`records`). `stored` prepares a stored
calibration as the base. `search` adds and removes effects. `state` is a model fitted to the poses
kept, with or without a random walk of the offset, and `candidates` ranks the effects of the
catalogue as columns of the equations. `output` contains the effects that are not such columns.
`findings` describes the result.

"""

from .records import Refinement, Stage, Step
from .refinement import BASES, refine

__all__ = ['BASES', 'Refinement', 'Stage', 'Step', 'refine']
