# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The rules of the rating of a calibration: what is found, and what removes it."""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import TYPE_CHECKING

import numpy as np

from .expected import BOUND, depends_on, directions_in, Expected
from .limits import (
    BAD_ERROR, COVERED, GOOD_ERROR, HIDDEN, LEFT_OUT, MATTERS, NEAR_FLAT, PER_OUTLIER, SPAN,
    TO_CHECK, WORST_ERROR)
from ..calibrate import Calibration, flat_direction
from ..effects import EMPIRICAL, WANDER
from ..errors import TAKE_ALL_SIDES
from ..finding import Finding, NextStep, ranked, without
from ..text import counted, listed
from ..units import MG

if TYPE_CHECKING:
    from ..refine import Refinement

_REFINE = NextStep('refine', 'run refine to find the missing effect')
_CHECK = NextStep('poses', 'check what differs between the poses, clamp the sensor, and take the '
                  'poses again')


def findings_of(expected: Expected, refinement: Refinement | None) -> tuple[Finding, ...]:
    """Return what is worth knowing about a calibration, that which decides its rating first."""
    named = [*_beyond_noise(expected, refinement), *_not_corrected(expected)]
    error = expected.inexact_mg if named else expected.error_mg
    own = [*_refused(expected, refinement), *_too_large(expected, refinement), *_limited(expected),
           *_checked(expected), *named, *_inexact(expected, error, refinement),
           *_left_out(expected)]
    kinds = {each.kind for each in own}
    return ranked((*own, *without(expected.calibration.noted, *kinds)))


def _refused(expected: Expected, refinement: Refinement | None) -> Iterator[Finding]:
    """Yield the reason why the gate refuses the calibration, if it is the refined one."""
    if refinement is not None and refinement.refusal and _has(expected, refinement):
        message, advice = refinement.refusal
        yield Finding('refused', message, advice, 'BAD')


def _too_large(expected: Expected, refinement: Refinement | None) -> Iterator[Finding]:
    """Yield a finding if the readings are as good without the calibration."""
    own, remedy = expected.own_mg, _remedy(expected, refinement)
    before, calibrated = expected.before_mg, bool(expected.calibration.model.effects)
    if expected.noise_mg is None and expected.dof < TO_CHECK.value:
        return  # the uncertainty is hardly known
    if own > BAD_ERROR.value:
        yield Finding('error', f'the error in new orientations is {mg(own)}, expected at most '
                      f'{mg(BAD_ERROR.value)}', remedy.text, 'BAD', step=remedy.kind)
    elif calibrated and before is not None and own > max(before, MATTERS.value) and (
            not expected.is_partial):
        yield Finding('no_gain', f'the error in new orientations is {mg(own)}, and {mg(before)} '
                      'without the calibration', remedy.text,
                      'BAD' if own > WORST_ERROR.value else 'USABLE', step=remedy.kind)


def _limited(expected: Expected) -> Iterator[Finding]:
    """Yield a finding if the calibration is partial, or only a mounting."""
    if not expected.calibration.model.effects:
        yield Finding('mounting_alone', 'it is a mounting alone: offset and gain are not '
                      'calibrated', _more_poses(expected), 'USABLE')
    elif expected.is_partial:
        yield Finding('partial', 'the poses lie near one direction: in other orientations the '
                      f'error is up to {mg(expected.worst_mg)}', _more_poses(expected), 'USABLE')


def _checked(expected: Expected) -> Iterator[Finding]:
    """Yield findings if too few poses check the fit."""
    if expected.is_partial or not expected.calibration.model.effects:
        return
    if expected.dof == 0:
        yield Finding('no_check', 'nothing checks the fit: there are only as many poses as values',
                      _more_poses(expected), 'USABLE')
    elif expected.noise_mg is None and expected.dof < TO_CHECK.value:
        yield Finding('few_checks', f'only {counted(expected.dof, "pose")} more than values check '
                      'the fit, and the noise is not known', _more_poses(expected), 'USABLE')
    else:
        yield from _too_few_left(expected)
    open_ = 1.0 - expected.quality.coverage
    if 100.0 * open_ > 100.0 - COVERED.value:
        yield Finding('not_covered', f'{100.0 * open_:.0f} % of the sphere is far from all poses, '
                      'and nothing checks the model there', TAKE_ALL_SIDES
                      if expected.next_pose.direction is None else _more_poses(expected),
                      'USABLE')
    if 'doubtful' in expected.poses and np.any(expected.poses['doubtful']):
        rows = expected.poses.row[expected.poses['doubtful'] > 0.0].tolist()
        yield Finding('doubtful', f'the sensor may have moved in {listed("row", rows)}',
                      'take these poses again', 'USABLE', tuple(rows))


def _too_few_left(expected: Expected) -> Iterator[Finding]:
    """Yield a finding if few poses check the fit after outliers were left out."""
    out = [each.row for each in expected.calibration.rejected if each.kind == 'outlier']
    if out and expected.dof < TO_CHECK.value + PER_OUTLIER.value * len(out):
        yield Finding('outliers', f'{counted(len(out), "outlier")} left out, and only '
                      f'{counted(expected.dof, "pose")} more than values check the fit',
                      _more_poses(expected), 'USABLE', tuple(out))


def _beyond_noise(expected: Expected, refinement: Refinement | None) -> Iterator[Finding]:
    """Yield a finding if the poses show what the model does not contain."""
    hidden, noise = expected.hidden_mg, expected.noise_mg
    if noise is None or hidden < MATTERS.value or hidden < noise * math.sqrt(
            HIDDEN.value ** 2 - 1.0):
        return
    begin, step = f'{mg(hidden)} of the residual are not noise', 'poses'
    if refinement is None:
        what = f'{begin}: an effect is missing, or poses moved'
        advice, step = _REFINE.text, _REFINE.kind
    elif refinement.steps and not _has(expected, refinement):
        names = ', '.join(step.effect for step in refinement.steps)
        what = f'{begin}: {names} is missing in the model'
        advice = refinement.refusal[1] if refinement.refusal else 'use the refined calibration'
        step = 'poses' if refinement.refusal else 'refine'
    elif any(step.effect == WANDER for step in refinement.steps):
        what = f'{begin}: the offset changed slowly with time ({WANDER})'
        advice = 'let the sensor warm up, and take the poses within a few minutes'
    else:
        what = f'{begin}, and no effect explains them'
        advice = _CHECK.text
    yield Finding('beyond_noise', what, advice, 'USABLE', step=step)


def _has(expected: Expected, refinement: Refinement) -> bool:
    """Return whether a calibration has the effects of a refinement."""
    return expected.calibration.model.effects == refinement.calibration.model.effects


def _not_corrected(expected: Expected) -> Iterator[Finding]:
    """Yield the effects of the model that a later sample is not corrected for."""
    for name, size in expected.not_corrected:
        if size > MATTERS.value:
            short = 'a curve' if name.startswith(EMPIRICAL) else name
            if 'time' in depends_on(name):
                yield Finding('settling', f'the readings changed with time by {mg(size)} '
                              f'({short}), and may change again', 'let the sensor settle, and '
                              'take the poses again', 'USABLE')
            else:
                columns = ' and '.join(depends_on(name) & {*expected.calibration.model.neutral})
                where = f'without the column {columns}' if columns else 'in single samples'
                yield Finding('not_corrected', f'{short} of {mg(size)} cannot be corrected '
                              f'{where}', level='USABLE')


def _inexact(expected: Expected, error: float, refinement: Refinement | None
             ) -> Iterator[Finding]:
    """Yield a finding if an error that has no name yet is too large [mg]."""
    if expected.is_partial or not expected.calibration.model.effects:
        return
    if error > GOOD_ERROR.value:
        if expected.omitted_mg > max(GOOD_ERROR.value / 2.0, expected.own_mg):
            yield Finding('omitted', f'model {expected.omits} omits what these poses do not '
                          f'determine: the error may be {mg(error)}', _more_poses(expected),
                          'USABLE')
        else:
            remedy = _remedy(expected, refinement)
            yield Finding('new_orientations', 'the error in new orientations is up to '
                          f'{mg(error)}, expected at most {mg(GOOD_ERROR.value)}', remedy.text,
                          'USABLE', step=remedy.kind)
    elif expected.worst_mg > WORST_ERROR.value:
        yield Finding('far_from_poses', f'the error is up to {mg(expected.worst_mg)} where there '
                      f'is no pose, expected at most {mg(WORST_ERROR.value)}',
                      _more_poses(expected), 'USABLE')


def _left_out(expected: Expected) -> Iterator[Finding]:
    """Yield a finding if many poses were left out."""
    calibration = expected.calibration
    rows = tuple(each.row for each in calibration.rejected)
    if rows and 100.0 * len(rows) > LEFT_OUT.value * len(calibration.poses):
        yield Finding('left_out', f'{len(rows)} of {counted(len(calibration.poses), "pose")} were '
                      'left out', 'hold the sensor still in each pose, and take them again',
                      'USABLE', rows)


def _more_poses(expected: Expected) -> str:
    """Return which pose to take next."""
    asked = expected.next_pose
    if asked.direction is None:
        return 'take more poses, and hold the sensor longer in each'
    more = asked.total - len(expected.poses)
    return f'take {counted(more, "more pose") if more > 0 else "more poses"}: {asked.words}'


def _remedy(expected: Expected, refinement: Refinement | None) -> NextStep:
    """Return what reduces the larger part of the error."""
    if expected.hidden_mg <= BOUND * expected.stated_mg:
        return NextStep('poses', _more_poses(expected))
    if refinement is not None:
        return _CHECK
    if expected.noise_mg is None:
        return NextStep('refine', 'hold the sensor still in each pose, record std and count, and '
                        'run refine to find what is missing')
    return _REFINE


def step_after(calibration: Calibration) -> NextStep:
    """Return what to do with a good calibration."""
    if calibration.is_levelled:
        return NextStep('done', f'use the calibration; {temperature_words(calibration)}')
    poses, words = calibration.used_poses, 'place the robot level, and level the mounting by it'
    if len(poses):
        up = directions_in(poses, calibration) @ flat_direction(calibration.frame)
        nearest = int(np.argmax(up))
        if up[nearest] >= math.cos(math.radians(NEAR_FLAT.value)):
            row = int(poses.row[nearest])
            return NextStep('level', f'{words}; if it was level in row {row}, by this pose',
                            (row,))
    return NextStep('level', words)


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
