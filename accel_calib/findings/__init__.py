# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
The rating of a result: GOOD, USABLE or BAD, with the reason and what to do next.

The rating is about the error of |corrected reading| - 1 g in orientations that were not measured,
RMS over the sphere, without the noise of the new readings. `Expected` estimates it from the parts
that a calibration states:

- the uncertainty of its values, times 1.5 for a bound that holds in 95 % of the cases. A model 4
  or 7 omits values that every sensor has: those that the poses are too noisy to show, or those
  that the poses do not determine, with the size that they have in a common sensor;
- the residual beyond the noise: what the poses show that the model does not contain. Without known
  noise, the whole residual counts;
- the effects of the model that the correction of a single sample cannot use: of time after the
  poses, of the previous pose, and of vibration.

GOOD means that this error is below the limit and that nothing limits its meaning. USABLE means
that the readings are better with the calibration, but it has a named shortcoming. BAD means that
it must not be used. All limits are in `LIMITS`.

"""

from .figures import (
    calibration_json, change_words, CROSS, effect_figures, Expected, figures_of, GAINS, GOOD_MG,
    in_words, LIMITS, linear_figures, OFFSETS, Outlook, outlook, rating_json, refinement_json,
    residual_figures, scale_of)
from .rating import rate, rate_comparison, rate_fleet, rate_noise, rate_verification
from .words import (
    advice_lines, angle_words, base_words, chance_words, difference_words, mounting_figures,
    mounting_words, NOTHING_TO_PLAN, odds_words, outside_words, place_words, plan_lines,
    request_words, rival_words, short_verdict, USES_LIMIT, value_words, verdict_words)
from ..finding import Rating
