# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrate an accelerometer in place, with gravity (1 g at rest) as the only reference.

>>> import accel_calib as ac
>>> calibration = ac.calibrate('recording.mcap')    # any log, pose table or DataFrame
>>> calibration.rating
>>> calibration.apply(readings)
>>> calibration.save('calibration.yaml')

or step by step:

>>> poses = ac.capture('recording.mcap')            # or ac.read_poses('poses.csv')
>>> calibration = ac.fit(poses, flat=1)
>>> ac.refine(poses, base=calibration)

Data take two paths through the package:

1. Imu -> still pose -> fit -> stored calibration -> corrected Imu
2. poses + calibration -> gap -> named effect -> larger model -> report

The measurement equation
------------------------
One equation computes the reading from the true specific force. Every part of the package uses it::

    u       = ΔR force
    reading = V + W u + sum of effects(u, context)
    force   = ΔRᵀ u,  with u solved from the reading; without effects u = W⁻¹ (reading - V)

The symbols are those of NXP AN5286. V is the zero-g offset, W is the gain (sensitivity and
cross-axis), and ΔR is the mounting: it transforms a vector from the levelled frame to the sensor
frame.

Units
-----
Specific force and readings are in units of local gravity (g) inside the package, as in IEEE 1293
and AN5286, so that a still sensor measures |force| = 1 and a gain has no dimension. The public
functions and the files use the unit of the readings: m/s2, g, or native counts and volts
(`accel_calib.units`). All other quantities are in SI units: s, rad/s, rad. Temperature is in °C.

Sign and frames
---------------
Forces are specific forces (REP-145): a sensor at rest reads +1 g on the axis that points up.
The default levelled frame is that of REP-103 (x forward, y left, z up); see
`accel_calib.calibration.mounting` for the others.

Arrays are (n, 3): one row per pose or sample, columns x, y, z. A vector in frame a is `vec_a`;
`mat_ab` transforms from frame b to frame a.

"""

from importlib import import_module
from pathlib import Path
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from .api import (
        calibrate as calibrate, Calibration as Calibration, capture as capture, compare as compare,
        Effect as Effect, fit as fit, load as load, Poses as Poses, read_poses as read_poses,
        read_recording as read_recording, Recording as Recording, refine as refine,
        Refinement as Refinement, simulate as simulate, verify as verify)

    __version__: str

__all__ = ['Calibration', 'Effect', 'Poses', 'Recording', 'Refinement', 'calibrate', 'capture',
           'compare', 'fit', 'load', 'read_poses', 'read_recording', 'refine', 'simulate',
           'verify']


def __getattr__(name: str) -> Any:
    """Import a public name on first use: ``accel-calib --help`` does not wait for numpy."""
    if name == '__version__':  # that of package.xml beside the package, or the installed one
        source = Path(__file__).parent.parent / 'package.xml'
        if source.is_file():
            text = source.read_text(encoding='utf-8')
            value = text.partition('<version>')[2].partition('<')[0]
        else:
            from importlib.metadata import version  # slow, and not needed in a clone

            value = version(__name__)
    elif name in __all__:
        value = getattr(import_module('.api', __name__), name)
    else:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, '__version__'])
