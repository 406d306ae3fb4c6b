# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses and a calibration to the gap, the named effect and the larger model.

`refinement` is the entry point: it fits the base, and makes the refined calibration and the record
of the result. `base` prepares the poses. `state` is a model fitted to them, with the effects of
the catalogue as columns of its equations. `linear` scores sets of these columns and of outliers.
`beam` searches for the best sets near a model, `settle` repeats this and the fit in turn until
each effect is sound, and `search` is the whole method. `curves` contains causes without a known
form: a random walk of the offset, and an empirical curve; beside them it computes the probability
of each effect and of its rivals. `steps` describes what was found, and `plan` chooses the poses
that separate effects from their rivals.

"""

from .plan import PlannedPose, PosePlan
from .refinement import base_words, refine, Refinement, refitted, verdict_words
from .steps import chance, named_entries, shown_name, Stage, Step, times_typical, values_of

__all__ = ['PlannedPose', 'PosePlan', 'Refinement', 'Stage', 'Step', 'base_words', 'chance',
           'named_entries', 'refine', 'refitted', 'shown_name', 'times_typical', 'values_of',
           'verdict_words']
