# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The computations of a session, with their texts; most run in the worker process."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import Any, cast

import numpy as np

from .guidance import FEWEST_IN_CONE, is_partial, Plan
from .sensor import gyro_bias_of_rest
from .settings import CalibratorSettings
from ..calibrate import (
    Calibration, directions_of, fit_partial, fit_poses, flat_direction, level, lies_in_cone,
    next_pose, outlook)
from ..capture import Dwell, poses_from
from ..effects import LADDER, Model
from ..errors import RefusedFitError
from ..estimate import fit_sphere, pose_noise
from ..findings import calibration_json, rate, rate_refinement, Rating, refinement_json
from ..geometry import coverage, spread_directions
from ..refine import PlannedPose, refine, Refinement, refitted
from ..refine.words import residual_words, shown_name, times_typical, verdict_words
from ..table import Floats, Poses
from ..text import counted, listed, now, plain
from ..units import MG, Units

_DIRECTIONS = 100
"""Number of directions over which two calibrations are compared."""

_BEYOND = 100.0
"""Ratio to the typical size above which an effect is not caused by the sensor."""

_FEWEST_NATIVE = 4
"""Smallest number of poses to estimate the centre of native readings."""


@dataclass(frozen=True)
class Fitted:
    """
    A fit, or a refinement, with its rating.

    `words` are the answer, one sentence, and `details` are for the log. `differs`: an automatic
    fit replaces the calibration before it. `refusal` is the reason and the advice if it must not
    be used, and `planned` are the poses to take next.

    """

    calibration: Calibration
    rating: Rating
    words: str
    details: list[str]
    differs: bool = True
    refinement: Refinement | None = None

    @property
    def refusal(self) -> tuple[str, ...]:
        """Return the reason and the advice of a refused refinement; empty if it can be used."""
        return () if self.refinement is None else self.refinement.refusal

    @property
    def planned(self) -> tuple[PlannedPose, ...]:
        """Return the poses to take next."""
        return () if self.refinement is None else self.refinement.plan.poses


def fit(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
        before: Calibration | None) -> Fitted:
    """Return a fit of all poses with its rating; parameters and errors are as in `fitted`."""
    calibration = fitted(poses, units, settings, sensor, before)
    rating = rate(calibration)
    return Fitted(calibration, rating, summary(calibration, rating),
                  [*fit_details(calibration), change_words(before, calibration)],
                  replaces(before, calibration))


def fitted(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
           before: Calibration | None) -> Calibration:
    """
    Return a fit of all poses, in the levelled frame of the calibration before.

    Effects that a refinement has added to it are kept, with new values. RefusedFitError if the
    poses do not determine the model; the advice is how to turn the sensor next. InputError if the
    readings are clearly in another unit.

    """
    full = before is not None and not is_partial(before)
    up = poses_up(poses, units)
    few = not units.is_native and len(up) >= FEWEST_IN_CONE and lies_in_cone(up)
    if before is not None and is_refined(before):
        calibration = refitted(before, poses, sensor=sensor, date=now())
    elif few and not full:
        calibration = fit_partial(poses, units, sensor=sensor, date=now())
    else:
        calibration = fit_poses(poses, units, model=settings.model, method=settings.method,
                                sensor=sensor, date=now())
    if before is None or not before.is_levelled:
        return calibration
    context = before.typical_context(1)
    flat = flat_direction(before.frame) * before.force_per_g
    reading = before.predict(flat[np.newaxis], context)[0]
    headed = replace(calibration, model=Model(calibration.model.values, before.rotation),
                     frame=before.frame)
    return level(headed, reading, before.frame, context)


def is_refined(calibration: Calibration) -> bool:
    """Return whether a calibration has effects beyond offset and gain."""
    return any(name not in LADDER for name in calibration.model.effects)


def at_rest(rest: Dwell, units: Units, sensor: str, before: Calibration | None) -> Calibration:
    """
    Return a calibration from one rest: the offset along gravity, and the bias of the gyro.

    The offset and gain of a full fit before are kept.

    """
    if before is None or is_partial(before):
        rotation = np.eye(3) if before is None else before.rotation
        found = fit_partial(poses_from([rest]), units, sensor=sensor, date=now())
        before = replace(found, model=Model(found.model.values, rotation))
    return replace(before, gyro=gyro_bias_of_rest(rest) or before.gyro)


def change_words(before: Calibration | None, after: Calibration) -> str:
    """Return what changes with a new calibration, as one line; empty without an earlier one."""
    if before is None:
        return ''
    offset = after.units.to_g(after.offset - before.offset) * MG
    gain = 100.0 * (np.linalg.solve(before.gain, after.gain) - np.eye(3))
    turn = before.rotation.T @ after.rotation
    angle = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))))
    effects = sorted(set(before.model.effects) ^ set(after.model.effects))
    words = [f'offset by ({", ".join(f"{part:+.2f}" for part in offset)}) mg',
             f'gain by up to {np.max(np.abs(gain)):.3f} %', f'mounting by {angle:.2f}°']
    words += [f'{"with" if name in after.model.effects else "without"} {name}' for name in effects]
    return f'changes {", ".join(words)}'


def replaces(before: Calibration | None, after: Calibration) -> bool:
    """
    Return whether an automatic fit replaces a calibration.

    It does if it differs by more than its own uncertainty, and the other has only offset and gain.

    """
    if before is None:
        return True
    if is_refined(before):
        return False
    if is_partial(before):
        return True
    up = spread_directions(_DIRECTIONS)
    (gain, offset), (gain_before, offset_before) = (
        each.model.linear_part for each in (after, before))
    change = up @ (gain - gain_before).T + offset - offset_before
    covariance = after.force_covariance(up * after.force_per_g) / after.force_per_g ** 2
    return bool(np.sum(change ** 2) > np.sum(np.trace(covariance, axis1=1, axis2=2)))


def refined(poses: Poses, units: Units, sensor: str, before: Calibration | None, hint: str = '',
            own: tuple[str, ...] = ()) -> Fitted:
    """
    Return the refinement of a calibration (None: of a fit).

    An effect far beyond those of parts is refused; `hint` says which quantity may be missing. The
    own effects of these names are tried beside the catalogue.
    RefusedFitError if there are too few poses; InputError if the readings are clearly in another
    unit.

    """
    refinement = refine(poses, units, base='auto' if before is None else before, sensor=sensor,
                        date=now(), also=own)
    beyond = [step for step in refinement.steps if times_typical(step) > _BEYOND]
    if beyond and not refinement.refusal:
        refinement = replace(refinement, refusal=(
            f'{beyond[0].effect} is {times_typical(beyond[0]):.0f} times that of typical parts',
            f'find what else changed with it; {hint}' if hint else 'find what else changed with '
            'it: check the mounting and the setup, and take the poses again'))
    rating = rate_refinement(refinement)
    details = refinement_details(refinement)
    if not refinement.refusal:
        details.append(change_words(before, refinement.calibration))
    return Fitted(refinement.calibration, rating, summary_of(refinement, rating), details,
                  refinement=refinement)


def rated(calibration: Calibration, refinement: Refinement | None) -> Rating:
    """Return the rating of a calibration, and of the refinement that it is from."""
    return rate(calibration, refinement=refinement)


def result_of(calibration: Calibration, refinement: Refinement | None, model: str
              ) -> dict[str, Any]:
    """Return a calibration, and its refinement, for JSON as on the command line."""
    found = {} if refinement is None else refinement_json(refinement)
    whole = {**calibration_json(calibration, outlook(calibration, model)), **found}
    return cast('dict[str, Any]', plain(whole))


def poses_up(poses: Poses, units: Units) -> Floats:
    """Return the approximate up in each pose, (n, 3); n = 0: native centre is not known."""
    if units.is_native and len(poses) < _FEWEST_NATIVE:
        return np.zeros((0, 3))
    try:
        return directions_of(poses, units)
    except RefusedFitError:
        return np.zeros((0, 3))


def plan_for(poses: Poses, units: Units, model: str) -> Plan:
    """
    Return the next pose for a fit of this model, or that more poses no longer help.

    As long as the directions of native readings are not known, the poses are taken for those that
    were asked for. Otherwise the same pose would be asked for again.

    """
    up = poses_up(poses, units)
    noise, noise_g = pose_noise(poses.noise, up), None
    if noise is not None and len(noise) and not units.is_native:
        noise_g = float(np.median(units.to_g(noise)))
    fitted_model = '10' if model == 'auto' else model
    asked = next_pose(up, fitted_model, noise, noise_g=noise_g)
    supposed = up
    while len(supposed) < len(poses) and asked.direction is not None:
        supposed = np.vstack([supposed, asked.direction])
        asked = next_pose(supposed, fitted_model)
    return Plan(asked, len(poses), up, math.nan if noise_g is None else noise_g,
                coverage(up) if len(up) else 0.0, _zero(poses, units) if len(up) else ())


def _zero(poses: Poses, units: Units) -> tuple[float, ...]:
    """Return the centre of native readings; empty for readings whose zero is known."""
    if not units.is_native:
        return ()
    return tuple(fit_sphere(poses.reading)[1].tolist())


def summary(calibration: Calibration, rating: Rating) -> str:
    """Return the rating and the residual of a fit in one sentence."""
    quality = calibration.quality
    about = calibration.reason if is_partial(calibration) else (
        f'model {calibration.name} from {len(calibration.used_poses)} of '
        f'{counted(len(calibration.poses), "pose")}')
    return (f'{rating.name}: {about}, residual {quality.rms_before_mg:.2f} mg before, '
            f'{quality.rms_after_mg:.3f} mg after')


def fit_details(calibration: Calibration) -> list[str]:
    """Return noise floor, poses that are left out, and warnings of a fit."""
    floor = calibration.quality.noise_floor_mg
    return [*([] if floor is None else [f'noise floor {floor:.3f} mg']),
            *(f'pose {each.row} left out: {each.reason}' for each in calibration.rejected),
            *calibration.warnings]


def summary_of(refinement: Refinement, rating: Rating) -> str:
    """Return the rating, the verdict with the named effects, and the residual in one sentence."""
    names = [shown_name(step.name) + (f' (or {", ".join(step.likely_rivals)})' if step.rivals
                                      else '') for step in refinement.steps]
    found, verb = ' and '.join(names), 's' if len(names) == 1 else ''
    verdict = {'no_gap': 'no gap beyond the noise', 'explained': f'{found} explain{verb} the gap',
               'described': f'{found} describe{verb} the gap'}.get(
        refinement.verdict, f'a gap remains beyond {found}' if names else 'a gap remains that no '
        'effect explains')
    return f'{rating.name}: {verdict}, {residual_words(refinement)}'


def refinement_details(refinement: Refinement) -> list[str]:
    """Return the verdict, where each effect shows, poses that are left out, and warnings."""
    lines = [verdict_words(refinement).rstrip('.')]
    lines += [f'{shown_name(step.name)} {step.gap_before_mg:.3f} to {step.gap_after_mg:.3f} mg, '
              f'{step.where}' for step in refinement.steps]
    if refinement.disturbed_poses:
        lines.append(f'left out: {listed("pose", refinement.disturbed_poses)}')
    return [*lines, *refinement.calibration.warnings, *refinement.advice]
