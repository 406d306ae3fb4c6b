# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers as text, with the digits that have a meaning."""

import math

_ZERO = 1e-12
"""Values below are zero but for rounding."""


def short(value: float) -> str:
    """Return a number with three significant digits."""
    return f'{value:.3g}'


def with_sd(value: float, sd: float) -> str:
    """
    Return ``value ± sd`` with two significant digits of the standard deviation.

    A value without a standard deviation has six significant digits.

    """
    if not sd > 0.0:
        return '0' if abs(value) < _ZERO else f'{value:.6g}'
    decimals = max(0, 1 - math.floor(math.log10(sd)))
    return f'{round(value, decimals) + 0.0:.{decimals}f} ± {sd:.{decimals}f}'
