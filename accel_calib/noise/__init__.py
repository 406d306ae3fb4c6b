# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
Noise figures from a long rest, by Allan deviation.

`figures` finds the longest rest, and returns its figures by axis, with their limits in words, and
as JSON. `allan` computes Allan variances and the covariance of their estimates, and fits white
noise, bias instability and random walk to them.

"""

from .allan import AxisNoise, check_allantools, FIGURES, Kind, NoiseFigures
from .figures import duration, noise_of, shown_unit, to_json, TYPICAL, whole, WORDS
