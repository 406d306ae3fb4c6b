# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The mounting ΔR of a sensor from one flat pose (NXP AN5286, section 7), as part of a calibration.

ΔR transforms a vector from the levelled frame to the axes of the sensor. In a flat pose, the
calibrated reading G of the sensor is ΔR times up:

=========  =====================================  ============  ======================
frame      axes                                   flat reading  third column of ΔR
=========  =====================================  ============  ======================
`ros`      x forward, y left, z up (REP-103)      +1 g on z     G over its size
`ned`      x north, y east, z down                +1 g on z     G over its size
`android`  x right, y up the screen, z out of it  +1 g on z     G over its size
`win8`     as android                             -1 g on z     -G over its size
=========  =====================================  ============  ======================

(NED follows AN5286: the reading is positive along gravity, so that a flat pose reads +1 g on z.)
`ned` and `win8` are conventions of gravity. Messages are specific force, so that `on_topics` turns
ΔR into another frame for them.

One flat pose determines only the direction of up: an upside-down sensor and a wrong sign have the
same reading. The heading is zero by the convention of the angles of each frame. For `ros`, `ned`
and `android` the sensor is rolled and pitched but not yawed,

    x column = (√(y²+z²), -xy/√(y²+z²), -xz/√(y²+z²)) / |G|

which is singular if x is vertical (90° pitch). For `win8` the x column is in the x-z plane of the
sensor, which is singular if y is vertical (90° roll). There the limit of a level y axis, or a
level x axis, is used. A second pose, with the nose of the robot tilted straight down, determines
the heading (TRIAD, Black 1964).

**Wiring.** |force| = 1 g does not reveal a wrong sign, swapped axes or a rotated sensor, because
the sphere of poses is the same. Known orientations reveal them. A least squares fit
reading = X force + y is valid for large errors, too, and the orthogonal part Q of X = S Q (polar
decomposition) contains the axes. Q is near the identity if each axis reads its own force.
Otherwise it is near one of the 24 rotations and 24 mirror images that permute the axes, or it is a
rotation by another angle. A rotation can be intended, a mirror image cannot.

"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
import math

import numpy as np
import scipy

from .calibration import Calibration
from .quality import in_g
from ..effects import add_history, AXES, Context, Model, sensor_force
from ..errors import InputError
from ..estimate import fit_12
from ..finding import Finding, Level, without
from ..geometry import angle_of, axes_of_signs, SIGNED_AXES
from ..table import Floats, Poses
from ..units import FrameName, FRAMES

_NOSE_DOWN = {'ros': np.array([-1.0, 0.0, 0.0]), 'ned': np.array([1.0, 0.0, 0.0]),
              'android': np.array([0.0, -1.0, 0.0]), 'win8': np.array([0.0, 1.0, 0.0])}
"""Reading of a sensor whose nose points straight down, for each frame [g]."""

_UPRIGHT = np.cos(np.radians(45.0))
"""Beyond 45° between a flat pose and the expected axis there is a warning."""

_SAME_TILT = np.cos(np.radians(10.0))

_ARBITRARY_HEADING = Finding(
    'heading', 'the heading of the mounting is arbitrary, because an axis of the sensor that '
    'defines it is within 10° of the vertical', 'take a second pose with the nose of the robot '
    'down (~/set_heading or --nose-down), or give the mounting (mounting_rpy or base_frame)')

_VERTICAL = 1e-9
_STEEP = np.cos(np.radians(10.0))
"""Cosine of the angle from the vertical within which a direction has no heading."""

_NEAR = 25.0
"""Largest angle between axes and a permutation that they match [°]."""

_LEAST_SPREAD = 0.1
"""Smallest ratio of the singular values of the centred known forces to determine the axes."""

_ADVICE = 'check the wiring, the driver and the signs of ref_x,ref_y,ref_z'


def flat_direction(frame: str) -> Floats:
    """Return the (3,) unit reading of a sensor that lies flat in this frame."""
    return np.array([0.0, 0.0, -1.0 if frame == 'win8' else 1.0])


def mounting(flat: Floats, frame: str = 'ros') -> Floats:
    """Return ΔR, (3, 3), from a calibrated flat reading in the sensor axes, of any length."""
    length = np.linalg.norm(flat)
    if not (np.isfinite(length) and length > 0.0):
        raise InputError(f'the flat pose has the force {flat}, expected about 1 g',
                         'repeat the flat pose with the sensor at rest')
    x, y, z = column_z = flat / length * flat_direction(frame)[2]
    towards = np.array([1.0, 0.0, 0.0])  # its horizontal part is the x column
    if frame != 'win8' and np.hypot(y, z) < _VERTICAL:  # a level y axis
        towards = np.array([0.0, 0.0, -x])
    elif frame == 'win8' and not np.hypot(x, z) < _VERTICAL:
        towards = np.array([z, 0.0, -x]) * (-1.0 if z < 0.0 else 1.0)
    return _triad(column_z, towards)


def with_heading(rotation: Floats, nose_down: Floats, frame: str = 'ros') -> Floats:
    """
    Return a levelled ΔR with the heading from a pose with the nose of the robot down.

    In that pose the nose (front of the robot, top of a screen) is tilted straight down by 10° to
    170°. `nose_down` is its (3,) calibrated reading in the axes of the sensor, of any length.

    """
    up = rotation[:, 2]
    if not abs(up @ nose_down) <= _STEEP * np.linalg.norm(nose_down):
        raise InputError('the pose with the nose down is within 10° of the flat pose or of its '
                         'opposite, expected a tilt of 10° to 170°',
                         'tilt the nose of the robot further down')
    return _triad(up, nose_down) @ _triad(np.array([0.0, 0.0, 1.0]), _NOSE_DOWN[frame]).T


def with_heading_of(before: Floats, rotation: Floats) -> Floats:
    """Return ΔR with the heading of `before`, unless its x axis is within 10° of the vertical."""
    up, x = rotation[:, 2], before[:, 0]
    return rotation if abs(up @ x) > _STEEP else _triad(up, x)


def _triad(up: Floats, towards: Floats) -> Floats:
    """Return the axes with z up, a unit vector, and x along the horizontal part of `towards`."""
    column_x = towards - up * (up @ towards)
    column_x = column_x / np.linalg.norm(column_x)
    return np.column_stack([column_x, np.cross(up, column_x), up])


def in_frame(calibration: Calibration, frame: FrameName) -> Calibration:
    """
    Return a calibration with the same mounting in another frame.

    A heading that follows from the convention of the frame then follows from that of the other.

    """
    before, rotation = calibration.frame, calibration.rotation
    if frame == before or not calibration.is_levelled:
        return calibration
    flat = rotation @ flat_direction(before)
    turned = mounting(flat, frame)
    if not np.allclose(mounting(flat, before), rotation, atol=1e-6):
        turned = with_heading(turned, rotation @ _NOSE_DOWN[before], frame)
    return replace(calibration, model=Model(calibration.model.values, turned), frame=frame)


def on_topics(calibration: Calibration, frame: str) -> Calibration:
    """
    Return a calibration with the ΔR of messages, which are specific force (REP-145).

    In `ned`, messages are forward-right-down: those of `ros`, turned by 180° about x. InputError
    for `win8`, whose readings are gravity.

    """
    if not calibration.is_levelled or frame in ('ros', 'android'):
        return calibration
    if frame == 'win8':
        raise InputError('the mounting is in the frame win8, whose readings are gravity, but '
                         'messages are specific force (REP-145), expected ros, ned or android',
                         'level the calibration again in one of them, or do not rotate')
    level_up = in_frame(calibration, 'ros')
    to_left_up = np.diag([1.0, -1.0, -1.0])  # from forward-right-down
    return replace(level_up, model=Model(level_up.model.values, level_up.rotation @ to_left_up))


def level_by_rows(calibration: Calibration, poses: Poses, frame: FrameName, flat: int | None,
                  nose_down: int | None) -> Calibration:
    """
    Return a calibration with the mounting from rows of a pose table in its unit, 1-based.

    In row `flat` the robot is level. In row `nose_down` its nose is tilted straight down, which
    determines the heading. Raise InputError if a row does not exist, `nose_down` is set without
    `flat`, or the nose is tilted down by less than 10°.

    """
    if frame not in FRAMES:
        raise ValueError(f'frame is {frame!r}, expected one of {FRAMES}')
    if flat is None:
        if nose_down is not None:
            raise InputError('there is a row with the nose down but no flat row, expected both',
                             'set both rows, or only the flat row')
        return replace(calibration, frame=frame)
    for row in (flat, nose_down):
        if row is not None and not 1 <= row <= len(poses):
            raise InputError(f'row {row} is not in the table, expected 1 to {len(poses)}',
                             'correct the row number')
    known = add_history(in_g(poses, calibration.units), calibration.model)
    levelled = level(calibration, poses.reading[flat - 1], frame,
                     known.take(slice(flat - 1, flat)).columns)
    if nose_down is None:
        return levelled
    return set_heading(levelled, poses.reading[nose_down - 1],
                       known.take(slice(nose_down - 1, nose_down)).columns)


def level(calibration: Calibration, reading: Floats, frame: FrameName,
          context: Context | None = None) -> Calibration:
    """
    Return a calibration with ΔR of one flat pose, and a finding if the wiring may be wrong.

    `reading` (3,) is the mean of the flat pose, in the unit of the readings, and `context` has one
    row of the columns that the effects need. The heading of an existing mounting is kept.

    """
    rotation = mounting(_in_sensor_axes(calibration, reading, context), frame)
    kept = calibration.is_levelled and frame == calibration.frame
    defining = rotation[1 if frame == 'win8' else 0]  # the axis that defines the heading
    arbitrary = bool(not kept and abs(defining[2]) > _STEEP)
    if kept:
        rotation = with_heading_of(calibration.rotation, rotation)
    asked = kept and calibration.rotation[:, 2] @ rotation[:, 2] > _SAME_TILT
    doubts = () if asked else doubts_about_flat(rotation, frame)  # asked once
    return with_mounting(calibration, rotation, 'flat_pose', frame=frame,
                         noted=(*doubts, *(_ARBITRARY_HEADING,) * arbitrary))


def set_heading(calibration: Calibration, reading: Floats, context: Context | None = None
                ) -> Calibration:
    """
    Return a levelled calibration with the heading from one pose with the nose of the robot down.

    Parameters as in `level`. Raise InputError if the nose is tilted down by less than 10°.

    """
    nose_down = _in_sensor_axes(calibration, reading, context)
    return with_mounting(calibration, with_heading(calibration.rotation, nose_down,
                                                   calibration.frame))


def with_mounting(calibration: Calibration, rotation: Floats, *known: str,
                  frame: FrameName | None = None, noted: Iterable[Finding] = ()) -> Calibration:
    """
    Return a calibration with another ΔR, by default in the same frame.

    Heading and the `known` kinds of findings are known, and the findings `noted` are added.

    """
    turned = replace(calibration, model=Model(calibration.model.values, rotation),
                     frame=frame or calibration.frame)
    found = replace(turned, noted=(
        *wiring(turned), *without(turned.noted, 'wiring', 'heading', *known), *noted))
    vars(found)['ranges'] = calibration.ranges  # so that the next message does not compute them
    return found


def with_given_mounting(calibration: Calibration, rotation: Floats) -> Calibration:
    """
    Return a calibration with a mounting that is known from elsewhere, such as a URDF.

    Levelled to within 10° of it, it keeps its tilt, which a flat pose measured.

    """
    if calibration.is_levelled and calibration.rotation[:, 2] @ rotation[:, 2] > _SAME_TILT:
        rotation = with_heading_of(rotation, calibration.rotation)
    return with_mounting(calibration, rotation, 'flat_pose')


def _in_sensor_axes(calibration: Calibration, reading: Floats, context: Context | None) -> Floats:
    """Return the specific force of one reading in the axes of the sensor [g]."""
    reading_g = calibration.units.to_g(np.asarray(reading, float))[np.newaxis]
    return sensor_force(calibration.model, reading_g, calibration.held_context(context))[0]


_LEANS_DEGREES = 10.0
"""Angle of a flat pose from the nearest side of the sensor above which it may not be level."""


def doubts_about_flat(rotation: Floats, frame: str) -> Iterator[Finding]:
    """Yield a finding if the ΔR of a flat pose indicates a wiring fault, or if the pose leans."""
    expected = flat_direction(frame)
    force = rotation @ expected
    face = int(np.argmax(np.abs(force)))
    seen = f'{"-" if force[face] < 0.0 else "+"}{AXES[face]}'
    lean = math.degrees(math.acos(min(abs(force[face]), 1.0)))
    if force @ expected >= _UPRIGHT:
        if lean > _LEANS_DEGREES:
            yield Finding('flat_pose', f'the flat pose leans {lean:.1f}° from the side {seen} of '
                          'the sensor: the sensor is mounted at this angle, or the robot was not '
                          'level', 'if it was not level, level the mounting again')
        return
    if face == 2:
        causes = 'it is mounted upside down, or z (or every axis) has the wrong sign'
        advice = 'if it is not upside down, correct the sign, because a rotation does not'
    else:
        causes = f'it is mounted with {seen} up, or {AXES[face]} and z are swapped'
        advice = 'if it lies flat, correct the wiring or the driver'
    yield Finding('flat_pose', f'the flat pose reads {force[face]:+.2f} g on {AXES[face]}, where '
                  f'a sensor that lies flat reads 1 g on {axes_of_signs(expected)}: {causes}; one '
                  'flat pose cannot distinguish them', advice, 'USABLE')


def wiring(calibration: Calibration) -> Iterator[Finding]:
    """Yield a finding if the known orientations of the poses reveal a wiring fault."""
    poses, name = calibration.poses, calibration.name
    if 'reference' not in poses:
        return
    mat_q = axes_of(poses.reading, poses['reference'])
    if mat_q is None or (found := fault_of(mat_q)) is None:
        return
    level: Level = 'USABLE'
    effect, mirrored = f'model {name} does not correct it', np.linalg.det(mat_q) < 0.0
    if calibration.form.known_orientation:
        level, effect = 'USABLE' if mirrored else 'GOOD', f'model {name} corrects it'
    elif mirrored:
        level, effect = 'BAD', f'{effect}, because |force| = 1 g does not reveal it'
    elif calibration.is_levelled:
        level, effect = 'GOOD', 'the mounting corrects it'
    advice = _ADVICE if mirrored else f'if it is not mounted this way, {_ADVICE}'
    yield Finding('wiring', f'according to the known orientations, {found}; {effect}', advice,
                  level)


def axes_of(reading: Floats, reference: Floats) -> Floats | None:
    """
    Return the orthogonal (3, 3) matrix from known forces to the axes of the readings.

    Both are (n, 3), in any units. The determinant is ±1. None if the forces do not determine it.

    """
    scales = np.linalg.svd(reference - reference.mean(axis=0), compute_uv=False)
    if len(scales) < 3 or scales[2] < _LEAST_SPREAD * scales[0]:
        return None
    left, _, right = np.linalg.svd(fit_12(reading, reference)[0])
    return left @ right


def fault_of(mat_q: Floats) -> str | None:
    """Return the wiring fault of a matrix as from `axes_of`; None if there is none."""
    if angle_of(mat_q) <= _NEAR:  # the angle of a mirror image is 90° or more
        return None
    nearest = max(SIGNED_AXES, key=lambda one: float(np.sum(one * mat_q)))
    if angle_of(mat_q @ nearest.T) > _NEAR:
        if np.linalg.det(mat_q) > 0.0:
            return f'the sensor is rotated by {_turn(mat_q.T)}'
        return ('the readings are a mirror image: an axis has the wrong sign or two axes are '
                'swapped, and the sensor is also rotated')
    read = zip(AXES, map(axes_of_signs, nearest), strict=True)
    reads = ', '.join(f'{axis} reads {other}' for axis, other in read if other != f'+{axis}')
    if np.linalg.det(nearest) > 0.0:
        return f'the sensor is rotated by {_turn(nearest.T)} ({reads})'
    diagonal = np.diag(nearest)
    if np.all(diagonal == -1.0):
        return ('all three axes have the wrong sign: the sensor reports gravity, which points '
                'down, instead of specific force, which points up')
    if np.count_nonzero(diagonal) == 3:
        return f'the {AXES[int(np.argmin(diagonal))]} axis has the wrong sign ({reads})'
    if np.all(nearest >= 0.0):
        swapped = [axis for axis, own in zip(AXES, diagonal, strict=True) if own == 0.0]
        return f'{" and ".join(swapped)} are swapped'
    return f'the axes are permuted to a mirror image: {reads}'


def _turn(rotation: Floats) -> str:
    """Return a rotation of the sensor as an angle about an axis."""
    vector = scipy.spatial.transform.Rotation.from_matrix(rotation).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    axis = vector / angle
    axis = axis if axis[np.argmax(np.abs(axis))] > 0.0 or angle < 179.0 else -axis
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > np.cos(np.radians(_NEAR)):
        signed = angle if axis[largest] > 0.0 else -angle
        return f'{signed:.0f}° about {AXES[largest]}'
    return f'{angle:.0f}° about ({", ".join(f"{part:.2g}" for part in axis)})'
