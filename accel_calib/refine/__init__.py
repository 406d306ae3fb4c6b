# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses and a calibration to the gap, the named effect and the larger model.

`refinement` is the entry point: it fits the base, and makes the refined calibration. `base`
prepares the poses. `state` is a model fitted to them, with the effects of the catalogue as columns
of its equations. `linear` scores sets of these columns and of outliers, and `beam` searches for
the best set. `curves` contains causes without a known form: a random walk of the offset, and an
empirical curve; beside them it computes the probability of each effect and of its rivals. `search`
searches near a model and fits in turn. `steps` describes what it found, `plan` chooses the poses
that separate effects from their rivals, and `result` contains the records and their sentences.

"""

from .refinement import refine, refine_with_fleet, refitted
from .result import (
    base_words, chance, PlannedPose, PosePlan, Refinement, residual_words, shown_name, Stage, Step,
    values_of, verdict_words)
from .steps import times_typical

__all__ = ['PlannedPose', 'PosePlan', 'Refinement', 'Stage', 'Step', 'base_words', 'chance',
           'refine', 'refine_with_fleet', 'refitted', 'residual_words', 'shown_name',
           'times_typical', 'values_of', 'verdict_words']
