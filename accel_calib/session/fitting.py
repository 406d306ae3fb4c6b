# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The computations of the commands: functions of the poses, which run in the worker process."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from .settings import CalibratorSettings
from ..calibration import Calibration
from ..effects import OwnEffect, shown_name
from ..findings import (
    calibration_json, outlook, rate, Rating, refinement_json, rival_words, verdict_words)
from ..geometry import angle_of, spread_directions
from ..pipeline import calibrated, is_partial, is_refined, Plan
from ..refinement import refine as refine_poses, Refinement
from ..table import Poses
from ..text import counted, listed, now, plain
from ..units import MG, Units

_DIRECTIONS = 100
"""Number of directions over which two calibrations are compared."""

_BEYOND = 100.0
"""Ratio to the typical size above which an effect is not caused by the sensor."""


@dataclass(frozen=True)
class Fitted:
    """
    A new calibration: a fit, a refinement or another mounting.

    `words` are the answer, one sentence, and `details` are for the log. `rating` is None if it is
    not known yet.

    """

    calibration: Calibration
    words: str
    details: list[str]
    rating: Rating | None = None
    refinement: Refinement | None = None


def fit(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
        before: Calibration | None) -> Fitted:
    """
    Return a fit of all poses with its rating, in the levelled frame of the calibration before.

    Errors are as in `pipeline.calibrated`; the advice is how to turn the sensor next.

    """
    found = calibrated(poses, units, Plan(
        settings.model, settings.method, refined=False, sensor=sensor, before=before,
        partial=True))
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
        f'{quality.rms_after_mg:.3f} mg after', details, rating)


def refine(poses: Poses, units: Units, sensor: str, before: Calibration | None, hint: str,
           own: tuple[OwnEffect, ...]) -> Fitted:
    """
    Return the refinement of a calibration (None: of a fit).

    An effect far beyond those of parts is refused; `hint` says which quantity may be missing. The
    own effects are tried beside the catalogue.
    RefusedFitError if there are too few poses; InputError if the readings are clearly in another
    unit.

    """
    refinement = refine_poses(poses, units, base='auto' if before is None else before,
                              sensor=sensor, date=now(), also=own)
    beyond = [step for step in refinement.steps if step.times_typical > _BEYOND]
    if beyond and not refinement.refusal:
        refinement = replace(refinement, refusal=(
            f'{beyond[0].effect} is {beyond[0].times_typical:.0f} times that of typical parts',
            f'find what else changed with it; {hint}' if hint else 'find what else changed with '
            'it: check the mounting and the setup, and take the poses again'))
    calibration = refinement.calibration
    rating = rate(calibration, refinement=refinement)
    details = [verdict_words(refinement).rstrip('.'), *(
        f'{shown_name(step.name)} {step.gap_before_mg:.3f} to {step.gap_after_mg:.3f} mg, '
        f'{step.where}' for step in refinement.steps)]
    if refinement.disturbed_poses:
        details.append(f'left out: {listed("pose", refinement.disturbed_poses)}')
    details += [*calibration.warnings, *refinement.advice]
    if not refinement.refusal:
        details.append(change_words(before, calibration))
    names = [shown_name(step.name) + (f' (or {", ".join(rival_words(step))})' if step.rivals
                                      else '') for step in refinement.steps]
    found, verb = ' and '.join(names), 's' if len(names) == 1 else ''
    verdict = {'no_gap': 'no gap beyond the noise', 'explained': f'{found} explain{verb} the gap',
               'described': f'{found} describe{verb} the gap', 'drifts': 'the offset drifts',
               'unexplained': f'a gap remains beyond {found}' if names else
               'a gap remains that no effect explains'}[refinement.verdict]
    return Fitted(calibration, f'{rating.name}: {verdict}, {rating.figures}', details, rating,
                  refinement)


def rated(calibration: Calibration, refinement: Refinement | None, rating: Rating | None,
          model: str) -> tuple[Rating, dict[str, Any]]:
    """Return the rating of a calibration, if it is not known, and its JSON as of commands."""
    found = {} if refinement is None else refinement_json(refinement)
    whole = {**calibration_json(calibration, outlook(calibration, model)), **found}
    return (rate(calibration, refinement=refinement) if rating is None else rating,
            cast('dict[str, Any]', plain(whole)))


def change_words(before: Calibration | None, after: Calibration) -> str:
    """Return what changes with a new calibration, as one line; empty without an earlier one."""
    if before is None:
        return ''
    offset = after.units.to_g(after.offset - before.offset) * MG
    gain = 100.0 * (np.linalg.solve(before.gain, after.gain) - np.eye(3))
    angle = angle_of(before.rotation.T @ after.rotation)
    effects = set(before.model.effects) ^ set(after.model.effects)
    words = [f'offset by ({", ".join(f"{part:+.2f}" for part in offset)}) mg',
             f'gain by up to {np.max(np.abs(gain)):.3f} %', f'mounting by {angle:.2f}°']
    words += [f'{"with" if name in after.model.effects else "without"} {name}'
              for name in sorted(effects, key=str)]
    return f'changes {", ".join(words)}'


def differs(before: Calibration | None, after: Calibration) -> bool:
    """Return whether an automatic fit differs from a calibration by more than its uncertainty."""
    if before is None or is_refined(before) or is_partial(before):
        return before is None or not is_refined(before)  # a refined one is kept
    up = spread_directions(_DIRECTIONS)
    (gain, offset), (gain_before, offset_before) = (
        each.model.linear_part for each in (after, before))
    change = up @ (gain - gain_before).T + offset - offset_before
    covariance = after.force_covariance(up * after.force_per_g) / after.force_per_g ** 2
    return bool(np.sum(change ** 2) > np.sum(np.trace(covariance, axis1=1, axis2=2)))
