# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Noise figures from a long rest, by Allan deviation.

`curve` finds the longest rest, and computes its Allan variances and the covariance of their
estimates. `components` fits white noise, bias instability and random walk to them. `figures`
returns these by axis, with their limits in words, and as JSON.

"""

from .components import AxisNoise, FIGURES, Kind, NoiseFigures, shown_unit, TYPICAL, WORDS
from .curve import check_allantools, whole
from .figures import duration, noise_of, to_json

__all__ = ['FIGURES', 'TYPICAL', 'WORDS', 'AxisNoise', 'Kind', 'NoiseFigures', 'check_allantools',
           'duration', 'noise_of', 'shown_unit', 'to_json', 'whole']
