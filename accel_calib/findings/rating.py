# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The rating of calibrations, refinements, verifications, comparisons, rests and fleets.

Each rule yields what it finds, with what removes it.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from .figures import (
    BAD_ERROR, BOUND, CHANGED, COVERED, degrees, Expected, FAR_OFF, GOOD_ERROR, LEFT_OUT, MANY_OUT,
    MATTERS, mg, NEAR_FLAT, number, PER_OUTLIER, SPAN, TILT, TO_CHECK, TOO_EXACT, without_noise,
    WORST_ERROR)
from .words import request_words
from ..calibration import (
    Calibration, directions_in, flat_direction, free_parameters, lies_in_plane, Verification)
from ..comparison import Comparison, LEVEL
from ..effects import EmpiricalCurve, entry_of, WANDER
from ..errors import TAKE_ALL_SIDES
from ..finding import CAUSES, Finding, NextStep, rated, Rating, without
from ..geometry import coverage, distinct
from ..table import is_quantity, Poses, range_of
from ..text import counted, listed
from ..units import MG

if TYPE_CHECKING:
    from ..noise import NoiseFigures
    from ..refinement import Refinement

_REFINE = 'run refine to find the missing effect'
_CHECK = 'check what differs between the poses, clamp the sensor, and take the poses again'


def rate(calibration: Calibration, *, refinement: Refinement | None = None) -> Rating:
    """
    Rate a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    refinement : Refinement, optional
        A refinement of the same poses; its calibration, or the base, is rated.

    """
    expected, quality = Expected(calibration), calibration.quality
    good = (f'corrected readings in new orientations are right to {mg(expected.error_mg)} '
            f'({degrees(expected.error_mg)} of tilt)')
    figures = [f'{number(quality.rms_before_mg)} -> {mg(quality.rms_after_mg)}']
    if quality.held_out_rms_mg is not None and not expected.is_partial:
        figures.append(f'of new poses {mg(quality.held_out_rms_mg)}')
    noise = quality.noise_floor_mg
    figures += ['noise not known' if noise is None else f'noise {mg(noise)}',
                counted(len(expected.poses), 'pose'),
                f'{100.0 * quality.coverage:.0f} % of the sphere']
    named = [*_find_missing(expected, refinement)]
    error = expected.inexact_mg if named else expected.error_mg
    own = [*_find_failures(expected, refinement), *_find_implausible(expected, refinement),
           *_find_limits(expected), *_find_unchecked(expected), *named,
           *_find_inexact(expected, error, refinement)]
    noted = without(calibration.noted, *(each.kind for each in own))
    return rated((*own, *noted), good, ', '.join(figures), step_after(calibration, refinement))


def _find_failures(expected: Expected, refinement: Refinement | None) -> Iterator[Finding]:
    """Yield a finding if the readings are about as good without the calibration, or bad."""
    own, before, is_partial = expected.own_mg, expected.before_mg, expected.is_partial
    if expected.noise_mg is None and expected.dof < TO_CHECK.value:
        return  # the uncertainty is hardly known
    if own > BAD_ERROR.value:
        yield Finding('error', f'the error in new orientations is {mg(own)}, expected at most '
                      f'{mg(BAD_ERROR.value)}', level='BAD', **_remedy(expected, refinement))
    elif (expected.effects and not is_partial and before is not None
          and own > max(before, MATTERS.value)):
        yield Finding('no_gain', f'the error in new orientations is {mg(own)}, and {mg(before)} '
                      'without the calibration', level='BAD' if own > WORST_ERROR.value else
                      'USABLE', **_remedy(expected, refinement))


def _find_implausible(expected: Expected, refinement: Refinement | None) -> Iterator[Finding]:
    """Yield a finding for each figure of the first line that no useful calibration has."""
    quality = expected.quality
    held_out, noise = quality.held_out_rms_mg, quality.noise_floor_mg
    if held_out is not None and held_out > BAD_ERROR.value and not expected.is_partial:
        yield Finding('held_out', 'orientations that the fit has not seen are wrong by '
                      f'{mg(held_out)}, expected at most {mg(BAD_ERROR.value)}', level='BAD',
                      **_remedy(expected, refinement))
    if noise is None or expected.dof < TO_CHECK.value or not expected.effects:
        return
    rows = expected.outliers
    many = 100.0 * len(rows) > MANY_OUT.value * len(expected.calibration.poses)
    if many and quality.rms_after_mg > FAR_OFF.value * noise:
        yield Finding('far_off', f'the residual is {quality.rms_after_mg / noise:.0f} times the '
                      f'noise beside {counted(len(rows), "outlier")}: the model does not hold, '
                      f'expected at most {FAR_OFF.value:.0f} times', level='BAD', rows=rows,
                      **_remedy(expected, refinement))
    elif quality.rms_after_mg * TOO_EXACT.value < noise:
        yield Finding('too_exact', f'the residual is {mg(quality.rms_after_mg)}, far '
                      f'below the noise of {mg(noise)}: these readings are computed, not measured',
                      'take the readings of the sensor itself', 'BAD')


def _find_limits(expected: Expected) -> Iterator[Finding]:
    """Yield what the calibration is not for, and findings about poses that are left out."""
    if not expected.effects:
        yield Finding('mounting_alone', 'it is a mounting alone: offset and gain are not '
                      'calibrated', _more_poses(expected), 'USABLE')
    elif expected.is_partial and not expected.calibration.form.effects:
        yield Finding('thermal_alone', 'it is the offset over temperature alone: offset and gain '
                      'are not calibrated', 'run thermal with a log of twelve poses, too, or '
                      'calibrate in the autopilot after this', 'USABLE')
    elif expected.is_partial:
        where = 'in a plane' if lies_in_plane(expected.directions) else 'near one direction'
        yield Finding('partial', f'the poses lie {where}: in other orientations the error is '
                      f'up to {mg(expected.worst_mg)}', _more_poses(expected), 'USABLE')
    for each in expected.calibration.noted:
        if each.kind == 'limited' and expected.error_mg > BAD_ERROR.value:
            yield replace(each, text=f'{each.text}; by the others alone the error may be '
                          f'{mg(expected.error_mg)}', level='BAD')
    poses = expected.calibration.poses
    left_out = [each for each in expected.calibration.rejected if each.kind != 'clipped']
    if left_out and 100.0 * len(left_out) > LEFT_OUT.value * len(poses):
        yield Finding('left_out', f'{len(left_out)} of {counted(len(poses), "pose")} were left '
                      'out', 'hold the sensor still in each pose, and take them again',
                      'USABLE', tuple(each.row for each in left_out))


def _find_unchecked(expected: Expected) -> Iterator[Finding]:
    """Yield what the poses do not check."""
    if expected.is_partial or not expected.effects:
        return
    out = expected.outliers
    if expected.dof == 0:
        yield Finding('no_check', 'nothing checks the fit: there are only as many poses as values',
                      _more_poses(expected), 'USABLE')
    elif (expected.quality.held_out_rms_mg is None and expected.is_beyond_noise
          and distinct(expected.directions) <= free_parameters(expected.calibration.name)):
        yield Finding('no_check', 'the poses of one orientation differ by more than their noise, '
                      'and no orientation checks the others', _more_poses(expected), 'BAD')
    elif expected.noise_mg is None and expected.dof < TO_CHECK.value:
        yield Finding('few_checks', f'only {counted(expected.dof, "pose")} more than values check '
                      'the fit, and the noise is not known', _more_poses(expected), 'USABLE')
    elif out and expected.dof < TO_CHECK.value + PER_OUTLIER.value * len(out):
        yield Finding('outliers', f'{counted(len(out), "outlier")} left out, and only '
                      f'{counted(expected.dof, "pose")} more than values check the fit',
                      _more_poses(expected), 'USABLE', out)
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


def _find_missing(expected: Expected, refinement: Refinement | None) -> Iterator[Finding]:
    """Yield what the poses show beside the model, and what later samples are not corrected for."""
    if expected.is_beyond_noise:
        begin, step = f'{mg(expected.hidden_mg)} of the residual are not noise', 'poses'
        if refinement is None:
            what = f'{begin}: an effect is missing, or poses moved'
            advice, step = _REFINE, 'refine'
        elif refinement.steps and expected.effects != refinement.calibration.model.effects:
            names = ' and '.join(step.effect for step in refinement.steps)
            what = f'{begin}; the model lacks {names}'
            advice, step = 'use the refined calibration', 'refine'
            if refinement.refusal:
                why, advice = refinement.refusal
                what = f'{begin}, and the model that explains them is refused: {why}'
                step = 'poses'
        elif any(step.effect == WANDER for step in refinement.steps):
            what = f'{begin}: the offset changed slowly with time ({WANDER})'
            advice = _advise(expected, 'let the sensor warm up, and take the poses within a '
                             'few minutes')
        else:
            what, advice = f'{begin}, and no effect explains them', _advise(expected, _CHECK)
        yield Finding('beyond_noise', what, advice, 'USABLE', step=step)
    for name, size in expected.not_corrected:
        if size <= MATTERS.value:
            continue
        short, entry = 'a curve' if isinstance(name, EmpiricalCurve) else name, entry_of(name)
        context = {*(entry.over or entry.needs)}
        if 'time' in context and 'since_turn' not in context:
            yield Finding('settling', f'the readings changed with time by {mg(size)} ({short}), '
                          'and may change again', _advise(
                              expected, 'let the sensor settle, and take the poses again'),
                          'USABLE')
        else:
            columns = ' and '.join(filter(
                is_quantity, context & {*expected.calibration.model.neutral}))
            where = f'without the column {columns}' if columns else 'in single samples'
            yield Finding('not_corrected', f'{short} of {mg(size)} cannot be corrected {where}',
                          level='USABLE')


def _find_inexact(expected: Expected, error: float, refinement: Refinement | None
                  ) -> Iterator[Finding]:
    """Yield a finding if an error that has no name yet is too large [mg]."""
    if expected.is_partial or not expected.effects:
        return
    large = error > GOOD_ERROR.value
    if large and expected.omitted_mg > max(GOOD_ERROR.value / 2.0, expected.own_mg):
        yield Finding('omitted', f'model {expected.omits} omits what these poses do not '
                      f'determine: the error may be {mg(error)}', _more_poses(expected), 'USABLE')
    elif large:
        yield Finding('new_orientations', f'the error in new orientations is up to {mg(error)}, '
                      f'expected at most {mg(GOOD_ERROR.value)}', level='USABLE',
                      **_remedy(expected, refinement))
    elif expected.worst_mg > WORST_ERROR.value:
        yield Finding('far_from_poses', f'the error is up to {mg(expected.worst_mg)} where there '
                      f'is no pose, expected at most {mg(WORST_ERROR.value)}',
                      _more_poses(expected), 'USABLE')


def _more_poses(expected: Expected) -> str:
    asked = expected.next_pose
    if asked.direction is None:
        return 'take more poses, and hold the sensor longer in each'
    more = asked.total - len(expected.poses)
    poses = counted(more, 'more pose') if more > 0 else 'more poses'
    return f'take {poses}: {request_words(asked)}'


def _remedy(expected: Expected, refinement: Refinement | None) -> dict[str, Any]:
    """Return advice and step of a finding: what reduces the larger part of the error."""
    if expected.hidden_mg <= BOUND * expected.stated_mg:
        return {'advice': _more_poses(expected), 'step': 'poses'}
    if refinement is not None:
        return {'advice': _advise(expected, _CHECK), 'step': 'poses'}
    return {'step': 'refine', 'advice': _REFINE if expected.noise_mg is not None else
            'hold the sensor still in each pose, record std and count, and run refine to find '
            'what is missing'}


def _advise(expected: Expected, otherwise: str) -> str:
    """Return the advice on a column that may be the cause, or another one."""
    return next((each.advice for each in expected.calibration.noted if each.kind in CAUSES),
                otherwise)


def step_after(calibration: Calibration, refinement: Refinement | None = None,
               checked: Sequence[Poses] = ()) -> NextStep:
    """
    Return what to do with a good calibration; the rows are not those of its stored base.

    Poses by which it was `checked` extend the range of temperatures in which it holds.

    """
    poses, words = calibration.used_poses, 'place the robot level, and level the mounting by it'
    if refinement is not None and 'new' in refinement.poses_g:
        old = refinement.poses_g['new'] <= 0.0
        poses = poses.take(~np.isin(poses.row, refinement.poses_g.row[old]))
    if calibration.is_levelled:
        limits = [range_of(each, 'temperature') for each in (poses, *checked)]
        low, high = min(low for low, _ in limits), max(high for _, high in limits)
        room = max(SPAN.value - (high - low), 0.0) / 2.0
        warm = 'record the temperature, too' if math.isnan(low) else (
            f'fit again when the temperature leaves {math.floor(low - room)}..'
            f'{math.ceil(high + room)} °C')
        return NextStep('done', f'use the calibration; {warm}')
    if len(poses):
        up = directions_in(poses, calibration) @ flat_direction(calibration.frame)
        nearest = int(np.argmax(up))
        if up[nearest] >= math.cos(math.radians(NEAR_FLAT.value)):
            row = int(poses.row[nearest])
            return NextStep('level', f'{words}; if it was level in row {row}, by this pose',
                            (row,))
    return NextStep('level', words)


# ----------------------------------------------------------------------------- other results

def rate_verification(verification: Verification, calibration: Calibration, poses: Poses
                      ) -> Rating:
    """
    Rate a calibration by poses that it was not fitted to.

    Parameters
    ----------
    verification : Verification
        Its residuals on these poses.
    calibration : Calibration
        The calibration.
    poses : Poses
        These poses. If they cover only a part of the sphere, the rating is not better than that
        of the calibration itself.

    """
    expected, own = Expected(calibration), rate(calibration)
    floor, again = verification.noise_floor_mg, 'fit again with these poses'
    before, error = (without_noise(each, floor)
                     for each in (verification.rms_before_mg, verification.rms_after_mg))
    found, what = [], f'the error of these poses is {mg(error)}'
    if error > BAD_ERROR.value:
        found.append(Finding('error', f'{what}, expected at most {mg(BAD_ERROR.value)}', again,
                             'BAD', step='fit'))
    elif not calibration.units.is_native and error > max(before, floor or 0.0):
        found.append(Finding('no_gain', f'{what}, and {mg(before)} without the calibration', again,
                             'BAD' if error > MATTERS.value else 'USABLE', step='fit'))
    stated = expected.error_mg
    if own.name == 'GOOD' and error > max(CHANGED.value * stated, MATTERS.value):
        found.append(Finding('changed', f'{what}, and the fit states {mg(stated)}: the sensor has '
                             'changed', again, 'USABLE'))
    elif error > GOOD_ERROR.value:
        found.append(Finding('error', f'{what}, expected at most {mg(GOOD_ERROR.value)}', again,
                             'USABLE', step='fit'))
    if floor is not None and floor > GOOD_ERROR.value:
        found.append(Finding('noise', f'the noise of these poses is {mg(floor)}, too large to see '
                             f'an error of {mg(GOOD_ERROR.value)}', 'hold the sensor longer in '
                             'each pose', 'USABLE'))
    covered = coverage(directions_in(poses, calibration))
    if expected.is_partial or covered < COVERED.value / 100.0:
        found += own.findings
    found += [replace(each, level='GOOD', advice='') for each in calibration.noted
              if each.kind == 'edited']  # as advised, it is verified
    noise = 'noise not known' if floor is None else f'noise {mg(floor)}'
    figures = (f'{number(verification.rms_before_mg)} -> {mg(verification.rms_after_mg)}, '
               f'largest {mg(verification.max_after_percent * MG / 100.0)}, {noise}, '
               f'{counted(len(poses), "pose")}, {100.0 * covered:.0f} % of the sphere')
    return rated(found, f'{what} ({degrees(error)} of tilt)', figures,
                 step_after(calibration, checked=[poses]))


def rate_comparison(comparison: Comparison) -> Rating:
    """
    Rate the agreement of calibrations of one sensor.

    GOOD if they agree, USABLE if the differences are small, otherwise BAD.

    """
    largest = max(comparison.runs, key=lambda run: run.rms_mg)
    figures = (f'{counted(len(comparison.runs), "calibration")} '
               f'{"agree" if comparison.agree else "differ"}: difference {mg(largest.rms_mg)}, '
               f'up to {mg(max(run.largest_mg for run in comparison.runs))}, expected '
               f'{mg(largest.expected_mg)}, p = {comparison.p_value:.1g}, limit {LEVEL:g}')
    found = []
    which = ('' if comparison.outlier is None
             else f'; run {comparison.outlier + 1} differs from the others')
    if not comparison.agree:
        large = largest.rms_mg > GOOD_ERROR.value
        found.append(Finding(
            'disagreement', f'the calibrations differ by {mg(largest.rms_mg)}, which noise does '
            f'not explain{which}', 'use the latest calibration, or take the poses again'
            if large else 'use the latest calibration', 'BAD' if large else 'USABLE',
            step='poses' if large else 'done'))
    elif largest.expected_mg > GOOD_ERROR.value:
        found.append(Finding('noise', 'the uncertainty of the differences is '
                             f'{mg(largest.expected_mg)}, too large to see a change of '
                             f'{mg(GOOD_ERROR.value)}', 'fit them with more poses', 'USABLE'))
    tilt = comparison.tilt_deg
    if tilt is not None and tilt > TILT.value:
        found.append(Finding('mounting', f'the mountings differ by {tilt:.1f}°',
                             'check that the level ground is level, and that the sensor was not '
                             'mounted again', 'USABLE'))
    return rated(found, 'the calibrations agree within their uncertainties', figures,
                 NextStep('done', 'use the latest calibration'))


def rate_noise(found: NoiseFigures) -> Rating:
    """
    Rate the figures of a rest.

    GOOD if it shows white noise and random walk of every axis, USABLE if one of them is not seen
    or the noise is more than twice that of noisy common parts, BAD without white noise.

    """
    from ..noise import duration, shown_unit, TYPICAL, WORDS  # a fit alone does not load it

    findings, shown = list[Finding](), [f'rest of {duration(found.seconds)}']
    for kind in found.kinds:
        axes, density = found.of(kind), found.common(kind, 'noise_density')[0]
        unit, scale = shown_unit(kind, 'noise_density', axes[0].unit)
        if math.isfinite(density):
            shown.append(f'{kind} {density * scale:.3g} {unit}')
        unseen = [name for name in ('noise_density', 'random_walk') if (kind, name) in found.needs]
        findings += [Finding(
            'not_seen', f'the rest does not show the {WORDS[name]} of the {kind} on all axes',
            found.needs[kind, name], 'BAD' if name == 'noise_density' else 'USABLE')
            for name in unseen[:1]]
        limits = TYPICAL.get((kind, 'noise_density', axes[0].unit))
        if limits and density > 2.0 * limits[1]:
            findings.append(Finding(
                'noisy', f'the white noise of the {kind} is {density / limits[1]:.1f} times that '
                'of noisy common parts', 'keep vibration and fans away, and record again',
                'USABLE'))
    return rated(findings, 'the rest shows all figures', ', '.join(shown),
                 NextStep('done', 'use the figures'))


def rate_fleet(counts: Mapping[str, int], sensors: int, changed: int, unnamed: int) -> Rating:
    """
    Rate the calibrations of a fleet.

    GOOD if every recording has a usable calibration and no sensor changed, BAD if none has.

    Parameters
    ----------
    counts : mapping of str to int
        Recordings by rating, or by status without a rating.
    sensors, changed : int
        Number of sensors, and of those whose calibrations do not agree.
    unnamed : int
        Number of recordings without a name of their sensor.

    """
    total, usable = sum(counts.values()), counts.get('GOOD', 0) + counts.get('USABLE', 0)
    figures = (f'{counted(total, "recording")} of {counted(sensors, "sensor")}: '
               f'{", ".join(f"{count} {name}" for name, count in sorted(counts.items()))}')
    found = []
    if unnamed > 1:
        found.append(Finding(
            'unnamed', f'{unnamed} recordings do not state their sensor, and are not compared',
            'take the names of the sensors from the paths with --sensor-from REGEX', 'USABLE'))
    if usable < total:
        found.append(Finding(
            'not_calibrated', f'{total - usable} of {counted(total, "recording")} have no usable '
            'calibration', 'see their errors, and record them again',
            'USABLE' if usable else 'BAD'))
    if changed:
        found.append(Finding('changed', f'{counted(changed, "sensor")} changed',
                             'use the latest calibrations of these', 'USABLE', step='done'))
    return rated(found, 'each recording has a usable calibration', figures,
                 NextStep('done', 'use the calibrations'))
