# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the effects of a calibration need beside a reading, from messages and rests.

Time is the header stamp, the rate that of the same message, temperature the last that came. How
strongly a sensor in motion vibrates, and from which pose it came, no single message tells: there
`vibration_rectification` and `hysteresis` are taken as none.

"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .conversion import rate_of, seconds

if TYPE_CHECKING:
    from sensor_msgs.msg import Imu

    from ..capture import Dwell
    from ..effects import Context
    from ..units import Units

_NONE = np.zeros((1, 3))


def context_of_message(message: Imu, needs: tuple[str, ...], temperature: Context) -> Context:
    """
    Give the context of a message as one row.

    Parameters
    ----------
    message : Imu
        The message.
    needs : tuple of str
        Keys that the effects need; others are left out, for most calibrations need none.
    temperature : mapping
        The last temperature, one row, if one came.

    """
    if not needs:
        return {}
    rate = rate_of(message)
    known = {'time': np.array([seconds(message.header)]), 'std': _NONE, 'approach': _NONE,
             'rate': _NONE if rate is None else np.array([rate]), **temperature}
    return {key: known[key] for key in needs if key in known}


def context_of_rest(rest: Dwell, units: Units) -> Context:
    """Give the context of a rest as one row, its samples' scatter in g."""
    known = {key: np.array([value]) for key, value in rest.context.items()}
    return {'approach': _NONE, 'rate': _NONE, **known, 'time': np.array([rest.time]),
            'std': units.to_g(rest.std)[np.newaxis]}
