# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Whether what a model leaves is more than the measured noise of the pose means."""

from __future__ import annotations

from .state import State

_CHI2_LEVEL = 1e-3
_CHI2_RATIO = 1.3
"""Poses repeat somewhat worse than their samples say; so much is let pass."""


def is_noise(state: State) -> bool:
    """
    Tell whether what a model leaves may be no more than noise.

    True where the noise is not known, for then nothing says otherwise.

    """
    return state.noise is None or is_noise_of(state.fitted.rss, state.dof)


def is_down_to_noise(state: State) -> bool:
    """Tell whether measured noise accounts for all that is left: then nothing more is named."""
    return state.noise is not None and is_noise(state)


def is_noise_of(rss: float, dof: float) -> bool:
    """Tell whether a weighted residual sum of squares is one that measured noise leaves."""
    from scipy.special import chdtrc

    return bool(dof <= 0 or rss <= _CHI2_RATIO * dof or chdtrc(dof, rss) > _CHI2_LEVEL)
