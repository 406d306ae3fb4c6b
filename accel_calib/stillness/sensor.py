# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether numbers can be those of an accelerometer that was turned.

**Axes.** A fit supposes three axes that each read their part of gravity. If they do not, the poses
lie in a plane, and more poses do not help. The plane of poses that were turned about one axis
alone is cut from the sphere of gravity, so that they lie on a circle. If they lie in a plane and
on no circle, an axis does not measure. The normal of the plane names it: along one axis, that axis
is stuck; halfway between two, one of them is a copy of the other.

**Length.** The gravity that a phone computes has the same length in all directions. Noise, offset
and gains of a sensor change that of what it measures.

"""

import math
from typing import NamedTuple

import numpy as np

from ..effects import AXES
from ..errors import RefusedFitError
from ..geometry import sphere_through, unit
from ..text import short
from ..units import Floats, Units

_ONE_DIRECTION = math.cos(math.radians(6.0))
"""Cosine of the largest angle between readings of a board that was not turned."""

_ONE_LENGTH = 1e-3
"""Range of the lengths of samples below which they are computed, relative to their length."""

_TURNED = 0.2
"""Smallest range of the samples of an axis that shows a turn, relative to their length: 11°."""

_FEWEST = 6
"""Fewest readings that determine a circle and check it."""

_NEAR_END, _EMPTY = 0.9, 0.2
"""Smallest part of the range of counts that is near its end, and half of the part of the range
around its middle that is empty if they lost their sign: the reading of 0 g lies between others."""

_FLAT, _FLATTER = 0.02, 0.004
"""Largest ratio of the scatter across a plane to the scatter in it; that of a cap of 2° or less,
which is one orientation."""

_OFF_CIRCLE = 0.05
"""Smallest RMS distance from a circle, relative to its radius, that is on no circle."""

_WIDE = 0.65
"""Smallest extent of the poses from their middle in the plane, relative to 1 g; for native
readings to the distance of the plane from zero."""

_ALONG = 0.98
"""Smallest part of the normal of the plane along the direction that names a fault."""


class Lengths(NamedTuple):
    """Smallest |reading| above 0 and largest one, and range of the axis with the largest range."""

    shortest: float
    longest: float
    spread: float


def check_axes(reading: Floats, units: Units) -> None:
    """
    Raise RefusedFitError if (n, 3) readings show an axis that is stuck or a copy of another.

    Parameters
    ----------
    reading : (n, 3) array
        Means of rests in many orientations, in the unit of the readings.
    units : Units
        Unit of the readings, for the message.

    """
    if len(reading) < _FEWEST:
        return
    largest = float(np.max(reading))
    modulus = 2.0**math.ceil(math.log2(max(largest, 1.0)))
    if units.is_native and np.min(reading) >= 0.0 and largest >= _NEAR_END * modulus and np.all(
            np.abs(reading / modulus - 0.5) >= _EMPTY):
        raise RefusedFitError(
            f'the readings are near 0 or near {modulus:.0f} counts, and none is between: numbers '
            f'of {math.log2(modulus):.0f} bits have lost their sign; expected counts with a sign',
            'read them as signed numbers in the driver')
    middle = np.mean(reading, axis=0)
    _, sizes, turn = np.linalg.svd(reading - middle, full_matrices=False)
    flat = (reading - middle) @ turn[:2].T
    one_g = abs(float(middle @ turn[2])) if units.is_native else units.per_g
    wide = np.max(np.linalg.norm(flat, axis=1)) > _WIDE * one_g  # not a cap of the sphere
    if units.is_native:  # 1 g is not known: a flat piece that is no cap is as good as a wide one
        wide |= sizes[2] < _FLATTER * sizes[1]
    radius, off = sphere_through(flat)
    if sizes[2] > _FLAT * sizes[1] or not wide or off < _OFF_CIRCLE * radius:
        return
    normal = np.abs(turn[2])
    axis = int(np.argmax(normal))
    if normal[axis] > _ALONG:
        what = (f'the {AXES[axis]} axis reads {short(middle[axis])} {units.name} in each of '
                f'{len(reading)} orientations: it does not measure')
    elif (1.0 - np.min(normal)**2) > _ALONG and np.ptp(np.sort(normal)[1:]) < 1.0 - _ALONG:
        one, other = (AXES[k] for k in np.sort(np.argsort(normal)[1:]))
        what = (f'the axes {one} and {other} read the same in each of {len(reading)} '
                'orientations: one is a copy of the other')
    else:
        return
    raise RefusedFitError(f'{what}, expected three axes that each read their part of gravity',
                          'check the wiring, the driver and the columns of the log')


def is_one_direction(reading: Floats) -> bool:
    """Return whether (n, 3) readings at rest are of one board that was not turned."""
    up = unit(reading)
    return bool(np.all(up @ up[:1].T > _ONE_DIRECTION))


def check_measured(lengths: Lengths, units: Units) -> None:
    """
    Raise RefusedFitError if a sensor that was turned always reads the same |reading|.

    Parameters
    ----------
    lengths : Lengths
        Ranges of all samples, in the unit of the readings.
    units : Units
        Unit of the readings, for the message.

    """
    low, high, spread = lengths
    if high - low < _ONE_LENGTH * high and spread > _TURNED * high:
        raise RefusedFitError(
            f'the readings have the same length of {short(high)} {units.name} in all directions, '
            f'to {short(100.0 * (high - low) / high)} %: they are computed, as the gravity of a '
            'phone is, and not measured; expected readings of an accelerometer',
            'record the accelerometer itself, with gravity')
