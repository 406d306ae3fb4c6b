# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The computations of a session, with their texts; most run in the worker process."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import Any, cast

import numpy as np

from .guidance import Plan
from .sensor import gyro_bias_of_rest
from .settings import CalibratorSettings
from .. import pipeline
from ..calibrate import Calibration, directions_of, fit_partial, next_pose, outlook
from ..capture import Dwell, poses_from
from ..effects import Model
from ..errors import RefusedFitError
from ..estimate import fit_sphere, pose_noise
from ..findings import calibration_json, rate, rate_refinement, Rating, refinement_json
from ..geometry import coverage, spread_directions
from ..pipeline import is_partial, is_refined
from ..refine import refine, Refinement
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
    A new calibration: a fit, a refinement or another mounting.

    `words` are the answer, one sentence, and `details` are for the log. `rating` is None if it is
    not known yet. `differs`: an automatic fit replaces the calibration before it.

    """

    calibration: Calibration
    words: str
    details: list[str]
    rating: Rating | None = None
    refinement: Refinement | None = None
    differs: bool = True

    @property
    def refusal(self) -> tuple[str, ...]:
        """Return why it must not be used, and what to do instead; empty if it can be used."""
        if self.refinement is not None and self.refinement.refusal:
            return self.refinement.refusal
        if self.rating is not None and self.rating.name == 'BAD':
            return self.rating.reason, self.rating.next.text
        return ()


def fit(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
        before: Calibration | None) -> Fitted:
    """
    Return a fit of all poses with its rating, in the levelled frame of the calibration before.

    Errors are as in `pipeline.calibrated`; the advice is how to turn the sensor next.

    """
    found = pipeline.calibrated(poses, units, pipeline.Plan(
        settings.model, settings.method, refined=False, sensor=sensor, before=before,
        in_cone=True))
    calibration, rating, quality = found.calibration, found.rating, found.calibration.quality
    about = calibration.reason if is_partial(calibration) else (
        f'model {calibration.name} from {len(calibration.used_poses)} of '
        f'{counted(len(calibration.poses), "pose")}')
    floor = quality.noise_floor_mg
    details = [*([] if floor is None else [f'noise floor {floor:.3f} mg']),
               *(f'pose {each.row} left out: {each.reason}' for each in calibration.rejected),
               *calibration.warnings, change_words(before, calibration)]
    return Fitted(
        calibration, f'{rating.name}: {about}, residual {quality.rms_before_mg:.2f} mg before, '
        f'{quality.rms_after_mg:.3f} mg after', details, rating,
        differs=replaces(before, calibration))


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
    rating, calibration = rate_refinement(refinement), refinement.calibration
    details = [verdict_words(refinement).rstrip('.'), *(
        f'{shown_name(step.name)} {step.gap_before_mg:.3f} to {step.gap_after_mg:.3f} mg, '
        f'{step.where}' for step in refinement.steps)]
    if refinement.disturbed_poses:
        details.append(f'left out: {listed("pose", refinement.disturbed_poses)}')
    details += [*calibration.warnings, *refinement.advice]
    if not refinement.refusal:
        details.append(change_words(before, calibration))
    return Fitted(calibration, f'{rating.name}: {_verdict(refinement)}, '
                  f'{residual_words(refinement)}', details, rating, refinement)


def _verdict(refinement: Refinement) -> str:
    """Return the verdict with the named effects."""
    names = [shown_name(step.name) + (f' (or {", ".join(step.likely_rivals)})' if step.rivals
                                      else '') for step in refinement.steps]
    found, verb = ' and '.join(names), 's' if len(names) == 1 else ''
    return {'no_gap': 'no gap beyond the noise', 'explained': f'{found} explain{verb} the gap',
            'described': f'{found} describe{verb} the gap'}.get(
        refinement.verdict, f'a gap remains beyond {found}' if names else 'a gap remains that no '
        'effect explains')


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
    if before is None or is_refined(before) or is_partial(before):
        return before is None or not is_refined(before)
    up = spread_directions(_DIRECTIONS)
    (gain, offset), (gain_before, offset_before) = (
        each.model.linear_part for each in (after, before))
    change = up @ (gain - gain_before).T + offset - offset_before
    covariance = after.force_covariance(up * after.force_per_g) / after.force_per_g ** 2
    return bool(np.sum(change ** 2) > np.sum(np.trace(covariance, axis1=1, axis2=2)))


def rated(calibration: Calibration, refinement: Refinement | None, rating: Rating | None,
          model: str) -> tuple[Rating, dict[str, Any]]:
    """Return the rating of a calibration, if it is not known, and its JSON as of commands."""
    found = {} if refinement is None else refinement_json(refinement)
    whole = {**calibration_json(calibration, outlook(calibration, model)), **found}
    return (rate(calibration, refinement=refinement) if rating is None else rating,
            cast('dict[str, Any]', plain(whole)))


def plan_for(poses: Poses, units: Units, model: str) -> Plan:
    """
    Return the next pose for a fit of this model, or that more poses no longer help.

    As long as the directions of native readings are not known, the poses are taken for those that
    were asked for. Otherwise the same pose would be asked for again.

    """
    up = _poses_up(poses, units)
    noise, noise_g = pose_noise(poses.noise, up), None
    if noise is not None and len(noise) and not units.is_native:
        noise_g = float(np.median(units.to_g(noise)))
    fitted_model = '10' if model == 'auto' else model
    asked = next_pose(up, fitted_model, noise, noise_g=noise_g)
    supposed = up
    while len(supposed) < len(poses) and asked.direction is not None:
        supposed = np.vstack([supposed, asked.direction])
        asked = next_pose(supposed, fitted_model)
    # The zero of readings in other units than native ones is known.
    zero = fit_sphere(poses.reading)[1].tolist() if units.is_native and len(up) else ()
    return Plan(asked, len(poses), up, math.nan if noise_g is None else noise_g,
                coverage(up) if len(up) else 0.0, tuple(zero))


def _poses_up(poses: Poses, units: Units) -> Floats:
    """Return the approximate up in each pose, (n, 3); n = 0: native centre is not known."""
    if units.is_native and len(poses) < _FEWEST_NATIVE:
        return np.zeros((0, 3))
    try:
        return directions_of(poses, units)
    except RefusedFitError:
        return np.zeros((0, 3))
