# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The rules of the rating of a calibration: its shortcomings, and what removes them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import get_args, Literal, TYPE_CHECKING

import numpy as np

from .expected import BOUND, depends_on, directions_in, Expected
from .limits import (
    BAD_ERROR,
    COVERED,
    GOOD_ERROR,
    HIDDEN,
    LEFT_OUT,
    MATTERS,
    NEAR_FLAT,
    PER_OUTLIER,
    SPAN,
    TO_CHECK,
    WORST_ERROR,
)
from ..calibrate import Calibration, EDITED, FLAT, NOT_LOCATED, UNCHECKED
from ..calibrate.checks import axes_of, fault_of
from ..calibrate.mounting import flat_direction
from ..effects import EMPIRICAL, WANDER
from ..errors import TAKE_ALL_SIDES
from ..text import counted, listed
from ..units import MG

if TYPE_CHECKING:
    from ..refine import Refinement

RatingName = Literal['GOOD', 'USABLE', 'BAD']
RATINGS: tuple[str, ...] = get_args(RatingName)


@dataclass(frozen=True)
class Shortcoming:
    """A reason for a rating below GOOD, and what removes it."""

    name: RatingName
    reason: str
    remedy: str = ''


def shortcomings(expected: Expected, refinement: Refinement | None) -> list[Shortcoming]:
    """Return the shortcomings of a calibration; the most informative of each name is first."""
    named = [*_beyond_noise(expected, refinement), *_not_corrected(expected)]
    error = expected.inexact_mg if named else expected.error_mg
    return [*_refused(expected, refinement), *_wrong_axes(expected), *_too_large(expected),
            *_limited(expected), *_warned(expected, NOT_LOCATED), *_unchecked(expected), *named,
            *_inexact(expected, error),
            *_left_out(expected), *_warned(expected, UNCHECKED)]


def _refused(expected: Expected, refinement: Refinement | None) -> Iterator[Shortcoming]:
    """Yield the reason why the gate refuses the calibration, if it is the refined one."""
    if refinement is not None and refinement.refusal and _has(expected, refinement):
        message, advice = refinement.refusal
        yield Shortcoming('BAD', message, advice)


def _wrong_axes(expected: Expected) -> Iterator[Shortcoming]:
    """Yield faults of the wiring that known orientations show, and doubts about the flat pose."""
    calibration, poses = expected.calibration, expected.calibration.poses
    check = 'check the wiring, the driver and the signs of ref_x,ref_y,ref_z'
    mat_q = axes_of(poses.reading, poses['reference']) if 'reference' in poses else None
    fault = None if mat_q is None else fault_of(mat_q)
    if mat_q is not None and fault is not None and np.linalg.det(mat_q) < 0.0:
        if calibration.name == '12':
            yield Shortcoming('USABLE', f'{fault}; model 12 corrects it', check)
        else:
            yield Shortcoming('BAD', f'{fault}; model {calibration.name} does not correct it',
                              check)
    elif fault is not None and not calibration.is_levelled and calibration.name != '12':
        yield Shortcoming('USABLE', f'{fault}, and the mounting is not known', check)
    if any(line.startswith(FLAT) for line in calibration.warnings):
        yield Shortcoming('USABLE', 'the flat pose is not near the expected axis: the sensor is '
                          'mounted another way, or an axis is wrong', 'check the mounting, the '
                          'wiring and the signs')


def _too_large(expected: Expected) -> Iterator[Shortcoming]:
    """Yield a shortcoming if the readings are as good without the calibration."""
    own = expected.own_mg
    before, calibrated = expected.before_mg, bool(expected.calibration.model.effects)
    if expected.noise_mg is None and expected.dof < TO_CHECK.value:
        return  # the uncertainty is hardly known
    if own > BAD_ERROR.value:
        yield Shortcoming('BAD', f'the error in new orientations is {mg(own)}, expected at most '
                          f'{mg(BAD_ERROR.value)}', _remedy(expected))
    elif calibrated and before is not None and own > max(before, MATTERS.value) and (
            not expected.is_partial):
        name: RatingName = 'BAD' if own > WORST_ERROR.value else 'USABLE'
        yield Shortcoming(name, f'the error in new orientations is {mg(own)}, and '
                          f'{mg(before)} without the calibration', _remedy(expected))


def _limited(expected: Expected) -> Iterator[Shortcoming]:
    """Yield a shortcoming if the calibration is edited, partial, or only a mounting."""
    calibration = expected.calibration
    if EDITED in calibration.warnings:
        yield Shortcoming('USABLE', EDITED, 'verify it on new poses, or fit again')
    if not calibration.model.effects:
        yield Shortcoming('USABLE', 'it is a mounting alone: offset and gain are not calibrated',
                          _more_poses(expected))
    elif expected.is_partial:
        yield Shortcoming('USABLE', 'the poses lie near one direction: in other orientations the '
                          f'error is up to {mg(expected.worst_mg)}', _more_poses(expected))


def _warned(expected: Expected, begin: str) -> Iterator[Shortcoming]:
    """Yield a shortcoming for each warning of the fit with this beginning."""
    for line in expected.calibration.warnings:
        if line.startswith(begin):
            reason, _, remedy = line.rpartition('; ')
            yield Shortcoming('USABLE', reason, remedy)


def _unchecked(expected: Expected) -> Iterator[Shortcoming]:
    """Yield a shortcoming if too few poses check the fit."""
    if expected.is_partial or not expected.calibration.model.effects:
        return
    if expected.dof == 0:
        yield Shortcoming('USABLE', 'nothing checks the fit: there are only as many poses as '
                          'values', _more_poses(expected))
    elif expected.noise_mg is None and expected.dof < TO_CHECK.value:
        yield Shortcoming('USABLE', f'only {counted(expected.dof, "pose")} more than values '
                          'check the fit, and the noise is not known', _more_poses(expected))
    else:
        yield from _too_few_left(expected)
    open_ = 1.0 - expected.quality.coverage
    if 100.0 * open_ > 100.0 - COVERED.value:
        yield Shortcoming('USABLE', f'{100.0 * open_:.0f} % of the sphere is far from all poses, '
                          'and nothing checks the model there', TAKE_ALL_SIDES
                          if expected.next_pose.direction is None else _more_poses(expected))
    if 'doubtful' in expected.poses and np.any(expected.poses['doubtful']):
        rows = expected.poses.row[expected.poses['doubtful'] > 0.0].tolist()
        yield Shortcoming('USABLE', f'the sensor may have moved in {listed("row", rows)}',
                          'take these poses again')


def _too_few_left(expected: Expected) -> Iterator[Shortcoming]:
    """Yield a shortcoming if few poses check the fit after outliers were left out."""
    out = sum(each.reason.startswith('outlier') for each in expected.calibration.rejected)
    if out and expected.dof < TO_CHECK.value + PER_OUTLIER.value * out:
        yield Shortcoming('USABLE', f'{counted(out, "outlier")} left out, and only '
                          f'{counted(expected.dof, "pose")} more than values check the fit',
                          _more_poses(expected))


def _beyond_noise(expected: Expected, refinement: Refinement | None) -> Iterator[Shortcoming]:
    """Yield a shortcoming if the poses show what the model does not contain."""
    hidden, noise = expected.hidden_mg, expected.noise_mg
    if noise is None or hidden < MATTERS.value or hidden < noise * math.sqrt(
            HIDDEN.value ** 2 - 1.0):
        return
    begin = f'{mg(hidden)} of the residual are not noise'
    if refinement is None:
        yield Shortcoming('USABLE', f'{begin}: an effect is missing, or poses moved',
                          'run refine to find the missing effect')
    elif refinement.steps and not _has(expected, refinement):
        names = ', '.join(step.effect for step in refinement.steps)
        yield Shortcoming('USABLE', f'{begin}: {names} is missing in the model',
                          refinement.refusal[1] if refinement.refusal else
                          'use the refined calibration')
    elif any(step.effect == WANDER for step in refinement.steps):
        yield Shortcoming('USABLE', f'{begin}: the offset changed slowly with time ({WANDER})',
                          'let the sensor warm up, and take the poses within a few minutes')
    else:
        yield Shortcoming('USABLE', f'{begin}, and no effect explains them', 'check what differs '
                          'between the poses, clamp the sensor, and take the poses again')


def _has(expected: Expected, refinement: Refinement) -> bool:
    """Return whether a calibration has the effects of a refinement."""
    return expected.calibration.model.effects == refinement.calibration.model.effects


def _not_corrected(expected: Expected) -> Iterator[Shortcoming]:
    """Yield the effects of the model that a later sample is not corrected for."""
    for name, size in expected.not_corrected:
        if size > MATTERS.value:
            short = 'a curve' if name.startswith(EMPIRICAL) else name
            if 'time' in depends_on(name):
                yield Shortcoming('USABLE', f'the readings changed with time by {mg(size)} '
                                  f'({short}), and may change again', 'let the sensor settle, '
                                  'and take the poses again')
            else:
                yield Shortcoming('USABLE', f'{short} of {mg(size)} cannot be corrected in '
                                  'single samples', '')


def _inexact(expected: Expected, error: float) -> Iterator[Shortcoming]:
    """Yield a shortcoming if an error that has no name yet is too large [mg]."""
    if expected.is_partial or not expected.calibration.model.effects:
        return
    if error > GOOD_ERROR.value:
        if expected.omitted_mg > max(GOOD_ERROR.value / 2.0, expected.own_mg):
            yield Shortcoming('USABLE', f'model {expected.omits} omits what these poses do not '
                              f'determine: the error may be {mg(error)}',
                              _more_poses(expected))
        else:
            yield Shortcoming('USABLE', 'the error in new orientations is up to '
                              f'{mg(error)}, expected at most {mg(GOOD_ERROR.value)}',
                              _remedy(expected))
    elif expected.worst_mg > WORST_ERROR.value:
        yield Shortcoming('USABLE', f'the error is up to {mg(expected.worst_mg)} where there is '
                          f'no pose, expected at most {mg(WORST_ERROR.value)}',
                          _more_poses(expected))


def _left_out(expected: Expected) -> Iterator[Shortcoming]:
    """Yield a shortcoming if many poses were left out."""
    calibration = expected.calibration
    count, total = len(calibration.rejected), len(calibration.poses)
    if total and 100.0 * count > LEFT_OUT.value * total:
        yield Shortcoming('USABLE', f'{count} of {counted(total, "pose")} were left out',
                          'hold the sensor still in each pose, and take them again')


def _more_poses(expected: Expected) -> str:
    """Return which pose to take next."""
    asked = expected.next_pose
    if asked.direction is None:
        return 'take more poses, and hold the sensor longer in each'
    more = asked.total - len(expected.poses)
    return f'take {counted(more, "more pose") if more > 0 else "more poses"}: {asked.words}'


def _remedy(expected: Expected) -> str:
    """Return what reduces the larger part of the error."""
    if expected.hidden_mg <= BOUND * expected.stated_mg:
        return _more_poses(expected)
    if expected.noise_mg is None:
        return ('hold the sensor still in each pose, record std and count, and run refine to find '
                'what is missing')
    return 'run refine to find the missing effect'


def advice_of(calibration: Calibration) -> str:
    """Return what to do with a good calibration."""
    return '; '.join(filter(None, [_level_words(calibration), temperature_words(calibration)]))


def _level_words(calibration: Calibration) -> str:
    """Return how to level a calibration that is not levelled."""
    if calibration.is_levelled:
        return ''
    poses = calibration.used_poses
    again = 'put the robot on level ground and take its row as --flat'
    if not len(poses):
        return again
    up = directions_in(poses, calibration) @ flat_direction(calibration.frame)
    nearest = int(np.argmax(up))
    if up[nearest] < math.cos(math.radians(NEAR_FLAT.value)):
        return again
    return f'if the robot was level in row {poses.row[nearest]}, take it as --flat'


def temperature_words(calibration: Calibration) -> str:
    """Return the range of temperature in which a calibration is valid."""
    poses = calibration.used_poses
    if 'temperature' not in poses or not np.any(np.isfinite(poses['temperature'])):
        return 'record the temperature, too'
    low, high = np.nanmin(poses['temperature']), np.nanmax(poses['temperature'])
    room = max(SPAN.value - (high - low), 0.0) / 2.0
    return (f'fit again when the temperature leaves {math.floor(low - room)}..'
            f'{math.ceil(high + room)} °C')


def number(value: float) -> str:
    """Return a number with two significant digits, and one after the point from 10 on."""
    if value < 0.001:
        return '0'
    if value >= 100.0:
        return f'{value:.0f}'
    return f'{value:.1f}' if value >= 10.0 else f'{value:.2g}'


def mg(value: float) -> str:
    """Return an error with its unit."""
    return f'{number(value)} mg'


def degrees(error_mg: float) -> str:
    """Return the tilt that an error across gravity causes, in degrees."""
    return f'{math.degrees(math.asin(min(error_mg / MG, 1.0))):.1g}°'
