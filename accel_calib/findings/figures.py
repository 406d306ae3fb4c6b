# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The figures of a result, its expected error in new orientations, and the limits of the rating.

Every surface shows these figures: terminal, pages, live page, JSON and Parquet. `figures_of` has
all of a calibration: its residuals [mg], V and W in the unit of the readings, and the values of
the other effects in the units of the catalogue. The functions with ``json`` in their names make
the JSON of results, for the command line and the topic ``~/result``.

The parameters of `accel_calib.comparison` do not depend on the axes of the model. `scale_of`
states how they are shown: offsets in mg, gains minus 1 and cross-axis gains in %. For native
units, 1 g is the mean of the sensitivities.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
import math
from typing import Any, TYPE_CHECKING

import numpy as np
import scipy

from .words import combination_words, plan_lines, request_words
from ..calibration import (
    Calibration, determines, deviations_g, directions_in, error_left_in, free_parameters,
    Identifiability, identifiability, next_pose, NextPose, NORM_MODELS, ORIENTED, PRIOR, Quality,
    stated_uncertainty, uncertainty_g, Verification)
from ..comparison import NAMES
from ..effects import (
    AXES, effect_named, EffectKey, entry_of, LADDER, Model, MODELS, ParameterName, predict,
    value_unit)
from ..estimate import pose_noise, sensing_axes, variance_factor
from ..finding import NextStep, Rating
from ..statistics import rms
from ..text import signed
from ..units import MG

if TYPE_CHECKING:
    from ..refinement import Refinement

_OPEN_PART = 0.1
"""Part of a parameter in the open combinations above which it is not determined."""

OFFSETS, GAINS, CROSS = NAMES[:3], NAMES[3:6], NAMES[6:]


@dataclass(frozen=True)
class Figure:
    """
    A figure of a result.

    `key` is unique in the result, and `label` is for people. `unit` may be empty. `sd` is the
    standard deviation of `value`; 0 if it has none.

    """

    key: str
    label: str
    unit: str
    value: float
    sd: float = 0.0


def figures_of(calibration: Calibration) -> tuple[Figure, ...]:
    """Return all figures of a calibration; those that are not known are left out."""
    return (*residual_figures(calibration.quality), *linear_figures(calibration),
            *effect_figures(calibration))


def residual_figures(found: Quality | Verification) -> Iterator[Figure]:
    """Yield the residuals and the noise floor [mg], as far as they are known."""
    held_out = found.held_out_rms_mg if isinstance(found, Quality) else None
    for key, label, value in (
            ('rms_before_mg', 'residual before', found.rms_before_mg),
            ('max_before_mg', 'largest residual before', found.max_before_percent * MG / 100.0),
            ('rms_after_mg', 'residual after', found.rms_after_mg),
            ('max_after_mg', 'largest residual after', found.max_after_percent * MG / 100.0),
            ('held_out_rms_mg', 'residual of new poses', held_out),
            ('noise_floor_mg', 'noise floor', found.noise_floor_mg)):
        if value is not None:
            yield Figure(key, label, 'mg', value)


def linear_figures(calibration: Calibration) -> Iterator[Figure]:
    """Yield the entries of V and W that the model has; equal off-diagonal ones only once."""
    unit, gain, gain_sd = calibration.units.symbol, calibration.gain, calibration.gain_sd
    for axis, offset, sd in zip(AXES, calibration.offset, calibration.offset_sd, strict=True):
        yield Figure(f'offset.{axis}', f'offset {axis}', unit, float(offset), float(sd))
    per_g = 'per g' if calibration.units.is_native else ''
    # The diagonal of W, what is above it, and what is below it.
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2), (1, 0), (2, 0), (2, 1)):
        value, sd = float(gain[i, j]), float(gain_sd[i, j])
        mirrored = i > j and value == gain[j, i]
        if (sd > 0.0 or value) and not mirrored:
            name = AXES[i] if i == j else f'{AXES[i]}{AXES[j]}'
            yield Figure(f'gain.{name}', f'gain {name}', per_g, value, sd)


def effect_figures(calibration: Calibration) -> Iterator[Figure]:
    """Yield the values of the effects beyond V and W; shapes at their usual value are left out."""
    deviations = calibration.deviations
    for effect, values in calibration.model.values.items():
        shown = {} if effect in LADDER else entry_of(effect).shown(values)
        for name, value in shown.items():
            unit, scale = value_unit(effect, name)
            key = f'{effect}.{name}'
            yield Figure(key, f'{effect} {name}', unit, value * scale, deviations[key] * scale)


def scale_of(name: str) -> tuple[float, float, str]:
    """Return zero, factor and unit of a parameter in figures and tables."""
    if name in OFFSETS:
        return 0.0, MG, 'mg'
    if name in (*GAINS, *CROSS):
        return 1.0 if name in GAINS else 0.0, 100.0, '%'
    effect, _, part = name.rpartition('.')
    try:
        key = name.effect if isinstance(name, ParameterName) else effect_named(effect)
    except KeyError:  # an own effect, by its text in a stored row
        return 0.0, 1.0, ''
    unit, factor = value_unit(key, part)
    return 0.0, factor, unit


def in_words(name: str, value: float, sd: float) -> str:
    """Return a parameter as ``+value ± sd unit``."""
    zero, factor, unit = scale_of(name)
    return signed((value - zero) * factor, sd * factor, unit)


def change_words(name: str, change: float, sd: float) -> str:
    """Return the change of a parameter with its name, such as ``offset x +0.3 ± 0.1 mg``."""
    _, factor, unit = scale_of(name)
    return f'{name.replace(".", " ")} {signed(change * factor, sd * factor, unit)}'


@dataclass(frozen=True)
class Outlook:
    """
    What the poses of a calibration determine, and the pose that improves it most.

    `identifiability` and `next_pose` are for the requested model; for the largest model if the
    choice was ``auto``. `uncertainty_mg` is the stated one of the corrected |force| (model 12: of
    the force), RMS over the sphere, with effects in the middle of their range [mg]; None for a
    mounting alone or an offset over temperature alone.

    """

    identifiability: Identifiability
    next_pose: NextPose
    uncertainty_mg: float | None


def outlook(calibration: Calibration, asked: str = 'auto') -> Outlook:
    """Return what the poses of a calibration determine, and the next pose for a model."""
    poses = calibration.used_poses
    directions = directions_in(poses, calibration)
    noise = pose_noise(poses.noise, directions)
    uncertainty = stated_uncertainty(calibration)
    planned = asked
    if asked in ('auto', ORIENTED):  # with wrong orientations model 12 became 10
        planned = ORIENTED if calibration.form.known_orientation else NORM_MODELS[-1]
    noise_g = None
    if uncertainty is not None and calibration.form.effects and determines(
            calibration.name, directions, noise):
        noise_g = uncertainty / identifiability(calibration.name, directions, noise).mean_dilution
    return Outlook(identifiability(planned, directions, noise),
                   next_pose(directions, planned, noise, noise_g=noise_g),
                   None if uncertainty is None else uncertainty * MG)


def calibration_json(calibration: Calibration, ahead: Outlook) -> dict[str, Any]:
    """Return a calibration for JSON, with what its poses determine; None: not known."""
    gyro, noise = calibration.gyro, calibration.noise
    measured = {} if noise is None else {
        name: values for name, values in (('force', noise.force), ('rate', noise.rate))
        if not np.isnan(values).all()}
    seen, asked = ahead.identifiability, ahead.next_pose
    part = {name: sum(open_.weights.get(name, 0.0) ** 2 for open_ in seen.undetermined)
            for name in seen.deviations}
    own_names = dict[str, Any]()
    if calibration.form.sensing_axes:  # names of the ESGI'95 report
        axes = sensing_axes(calibration.gain, calibration.offset)
        own_names = {'shifts': axes.shifts, 'scales': axes.scales,
                     'angles': {'phi': axes.phi, 'psi': axes.psi, 'theta': axes.theta}}
    elif 'reference' in calibration.poses:
        own_names = {'matrix': calibration.gain @ calibration.model.rotation,
                     'shift': calibration.offset}
    return {
        'model': calibration.name, 'method': calibration.method,
        'units': calibration.units.name, 'sensor': calibration.sensor,
        'frame': calibration.frame, 'offset': calibration.offset, 'gain': calibration.gain,
        'rotation': calibration.model.rotation, 'offset_sd': calibration.offset_sd,
        'gain_sd': calibration.gain_sd, 'parameters': calibration.parameters,
        'covariance': calibration.covariance,
        'poses_used': len(calibration.poses) - len(calibration.rejected),
        'poses_rejected': [asdict(rejected) for rejected in calibration.rejected],
        **asdict(calibration.quality), 'reason': calibration.reason,
        'warnings': calibration.warnings, **own_names,
        'gyro_bias': gyro and gyro.bias, 'gyro_bias_sd': gyro and gyro.sd,
        'noise_force': measured.get('force'), 'noise_rate': measured.get('rate'),
        'uncertainty_mg': ahead.uncertainty_mg,
        'identifiability': {
            'model': seen.model, 'dilution': seen.dilution, 'mean_dilution': seen.mean_dilution,
            'parameters': {
                name: {'determined': part[name] <= _OPEN_PART ** 2, 'dilution': deviation}
                for name, deviation in seen.deviations.items()},
            'undetermined': [{'weights': dict(open_.weights), 'words': combination_words(open_)}
                             for open_ in seen.undetermined]},
        'next_pose': None if asked.direction is None else {
            'direction': asked.direction, 'words': request_words(asked)}}


def refinement_json(result: Refinement) -> dict[str, Any]:
    return {
        'verdict': result.verdict, 'undecided': result.undecided, 'base': result.calibration.name,
        'poses_used': len(result.poses_g), 'noise_floor_mg': result.noise_floor_mg,
        'gap_mg': result.gap_mg,
        'steps': [{
            **{'where' if key == 'place' else key: value for key, value in asdict(step).items()},
            'where': step.where, 'name': str(step.name), 'words': entry_of(step.name).words}
            for step in result.steps],
        'remaining_gap_mg': result.remaining_gap_mg,
        'disturbed_poses': result.disturbed_poses,
        'not_testable': [{'effect': effect, 'needs': needs}
                         for effect, needs in result.not_testable],
        'advice': result.advice, 'plan': plan_lines(result.plan),
        'warnings': result.calibration.warnings,
        'refusal': result.refusal[0] if result.refusal else None}


def rating_json(rating: Rating, step: NextStep, command: str) -> dict[str, Any]:
    """Return a rating for JSON, with the next step and its command."""
    return {'rating': rating.name, 'rating_reason': rating.reason,
            'findings': [each.stated for each in rating.findings],
            'next': {'kind': step.kind, 'text': step.text, 'command': command}}


# ----------------------------------------------------------------------------- expected error

@dataclass(frozen=True)
class Limit:
    """A limit of the rating: its name, value and unit, and what it means."""

    name: str
    value: float
    unit: str
    meaning: str


GOOD_ERROR = Limit(
    'error of a good calibration', 5.0, 'mg', 'largest error in new orientations, RMS over the '
    'sphere, as a bound; 5 mg is a tilt of 0.3°, and the zero-g offset of common parts is 20 to '
    '60 mg')
WORST_ERROR = Limit(
    'error in the worst direction', 10.0, 'mg', 'largest uncertainty in any direction of a good '
    'calibration')
BAD_ERROR = Limit(
    'error of a bad calibration', 30.0, 'mg', 'above this error the calibration is BAD: a common '
    'part without calibration has about this error')
MATTERS = Limit(
    'error that matters', 1.0, 'mg', 'a residual beyond the noise, or an effect that cannot be '
    'corrected, is ignored below this; 1 mg is a tilt of 0.06°')
HIDDEN = Limit(
    'scatter of the poses', 2.0, 'times the noise', 'if the scatter is larger, and the part '
    'beyond the noise is above the error that matters, the model lacks an effect or poses moved')
FAR_OFF = Limit(
    'residual beside many outliers', 20.0, 'times the noise', 'if the residual is larger, the '
    'model does not hold, and what it calls outliers may be as right as the others')
MANY_OUT = Limit(
    'many outliers', 10.0, '%', 'smallest share of the poses beside which the limit above holds; '
    'a hidden effect beside one knocked pose has such a residual, too')
TOO_EXACT = Limit(
    'residual below the noise', 100.0, 'times', 'samples of a sensor scatter, so that a residual '
    'this small is computed from the readings')
LEFT_OUT = Limit('poses left out', 20.0, '%', 'largest share of a good calibration')
TO_CHECK = Limit(
    'poses to check the fit', 3.0, 'poses', 'fewest poses beyond the number of values, if the '
    'noise is not known or outliers were left out')
PER_OUTLIER = Limit(
    'more poses to check, per outlier', 2.0, 'poses', 'a few poses can agree by chance after '
    'outliers were left out')
CHANGED = Limit(
    'error of new poses', 2.0, 'times the error that the fit states', 'if a verification shows a '
    'larger error, and it is above the error that matters, the sensor has changed')
COVERED = Limit(
    'covered part of the sphere', 85.0, '%', 'smallest share within 45° of a pose: elsewhere '
    'nothing checks the model. A verification that covers less is not rated better than the '
    'calibration itself')
TILT = Limit(
    'tilt between level poses', 0.3, '°', 'above this, the mountings of compared calibrations '
    'differ')
NEAR_FLAT = Limit(
    'pose near level', 20.0, '°', 'a pose within this angle of the level pose is suggested as the '
    'flat pose')
SPAN = Limit(
    'range of temperature', 4.0, '°C', 'smallest range for which a calibration is said to be '
    'valid')

GOOD_MG = GOOD_ERROR.value
"""Largest expected error of a good calibration [mg]."""

LIMITS = (GOOD_ERROR, WORST_ERROR, BAD_ERROR, MATTERS, HIDDEN, FAR_OFF, MANY_OUT, TOO_EXACT,
          LEFT_OUT, TO_CHECK, PER_OUTLIER, CHANGED, COVERED, TILT, NEAR_FLAT, SPAN)
"""All limits of the rating."""


BOUND = 1.5
"""Factor from the uncertainty of nine values, RMS over the sphere, to a bound."""

_UNSEEN = 1.6
"""Ratio of the largest omitted values that the F test of `auto` does not see to their noise: the
0.97 quantile of chi² with five degrees of freedom is 2.5 times its mean."""

_UNLUCKY = 0.1
"""Probability that the scatter is larger than the bound that few poses allow."""

_LEVEL = 0.05
"""Level of the test whether the residual is larger than the noise explains."""

_ONLY_AT_POSES = ('time', 'previous', 'std')
"""Context that the correction of a later single sample does not have. Messages and logs may not
have quantities, either."""


class Expected:
    """
    The expected error of a calibration in new orientations, and its parts.

    Attributes
    ----------
    poses, directions, noise : Poses, (n, 3) and (n,) array
        The poses used, up in each, unit vectors in the sensor axes, and its noise.
    outliers : tuple of int
        Rows that were left out as outliers.
    is_partial : bool
        Whether the sensor could not be turned over.
    omits : str
        Name of the smaller model if values that every sensor has are omitted.
    dof : int
        Number of equations of distinct poses beyond the number of free values. The errors of poses
        with known forces are vectors.
    noise_mg, before_mg : float or None
        Noise of a pose [mg], RMS over the poses, and the error without the calibration and without
        noise [mg]; None if it is not known.
    stated_mg, worst_mg : float
        Stated uncertainty [mg], RMS over the sphere (partial: over the poses), and the largest.
    few : float
        Factor on the uncertainty because few poses check the noise.
    hidden_mg : float
        Residual beyond the noise [mg]; without known noise, the residual.
    is_beyond_noise : bool
        Whether the poses show what the model does not contain.
    inexact_mg, error_mg : float
        Part of the expected error that more poses reduce, and the whole, as a bound [mg].
    own_mg : float
        Expected error by what the poses show, without omitted values [mg].

    """

    def __init__(self, calibration: Calibration) -> None:
        quality, effects = calibration.quality, calibration.model.effects
        self.calibration, self.quality, self.effects = calibration, quality, effects
        self.poses = calibration.used_poses
        self.directions = directions_in(self.poses, calibration)
        self.noise = pose_noise(self.poses.noise, self.directions)
        self.outliers = tuple(each.row for each in calibration.rejected if each.kind == 'outlier')
        self.is_partial = calibration.method == PRIOR
        known = {*effects} & {*LADDER}
        self.omits = next((name for name in ('4', '7') if {*MODELS[name].effects} == known), '')
        rows = 3 if calibration.form.known_orientation and 'reference' in self.poses else 1
        free = (free_parameters(calibration.name) if calibration.form.sensing_axes
                else int(np.count_nonzero(np.diag(calibration.covariance))))
        self.dof = dof = max(len(np.unique(self.poses.reading, axis=0)) * rows - free, 0)
        per_dof = math.sqrt(len(self.poses) * rows / dof) if dof else 1.0  # error over residual
        floor, chi2 = quality.noise_floor_mg, quality.chi2_per_dof
        self.noise_mg = None if floor is None else floor * per_dof
        self.before_mg = None if calibration.units.is_native else without_noise(
            quality.rms_before_mg, self.noise_mg)
        self.stated_mg = MG * (
            rms(deviations_g(calibration, self.directions)) if self.is_partial and effects else
            stated_uncertainty(calibration) or 0.0)
        self.worst_mg = uncertainty_g(calibration) * MG if effects else 0.0
        self.few = scatter = 1.0  # the latter: largest scatter that few squares allow, over RMS
        if dof:
            scatter = math.sqrt(dof / float(scipy.special.chdtri(dof, 1.0 - _UNLUCKY)))
            ratio = 1.0 if chi2 is None else chi2
            wider = ratio / variance_factor(ratio * dof, dof, chi2 is not None)
            self.few = max(scatter * math.sqrt(wider), 1.0)
        self.hidden_mg = 0.0
        if dof and not self.is_partial:
            if floor is None or chi2 is None:
                self.hidden_mg = quality.rms_after_mg * per_dof
            elif scipy.special.chdtrc(dof, chi2 * dof) <= _LEVEL:
                self.hidden_mg = without_noise(quality.rms_after_mg, floor) * per_dof
        self.is_beyond_noise = self.noise_mg is not None and self.hidden_mg >= max(
            MATTERS.value, self.noise_mg * math.sqrt(HIDDEN.value ** 2 - 1.0))
        self.inexact_mg = math.hypot(BOUND * self.stated_mg * self.few, self.omitted_mg)
        self.error_mg = math.hypot(
            self.inexact_mg, self.hidden_mg * (1.0 if self.noise_mg is None else scatter),
            *(size for _, size in self.not_corrected))
        self.own_mg = math.hypot(self.stated_mg, self.hidden_mg)

    @cached_property
    def next_pose(self) -> NextPose:
        return next_pose(self.directions, self.calibration.form.largest, self.noise)

    @cached_property
    def omitted_mg(self) -> float:
        """Return the error by values that a smaller model omits [mg]; 0 if it omits none."""
        if not self.omits or self.is_partial:
            return 0.0
        typical = error_left_in(self.omits, '10', self.directions, self.noise) * MG
        own, whole = (identifiability(name, self.directions, self.noise)
                      for name in (self.omits, '10'))
        if whole.undetermined:
            return typical
        ratio = (whole.mean_dilution / own.mean_dilution) ** 2 - 1.0
        return min(_UNSEEN * self.stated_mg * math.sqrt(max(ratio, 0.0)), typical)

    @cached_property
    def not_corrected(self) -> tuple[tuple[EffectKey, float], ...]:
        """
        Return effects that the correction of a later sample cannot use, the largest first.

        Their size is that along the force, RMS over the poses [mg].

        """
        calibration, up = self.calibration, self.directions
        context, sizes = {**self.poses.columns, 'previous': up}, dict[EffectKey, float]()
        if 'std' in self.poses:
            context['std'] = calibration.units.to_g(self.poses['std'])
        for name, values in calibration.model.values.items():
            entry = entry_of(name)
            if {*(entry.over or entry.needs)} & {*_ONLY_AT_POSES, *calibration.model.neutral}:
                alone = Model({name: values})
                known = all(key in context for key in alone.needs)
                along = np.sum((predict(alone, up, context) - up) * up, axis=1) if known else up
                sizes[name] = rms(along) * MG if known else 0.0
        return tuple(sorted(sizes.items(), key=lambda each: -each[1]))


def without_noise(residual_mg: float, noise_mg: float | None) -> float:
    """Return the part of an RMS that is not noise."""
    return math.sqrt(max(residual_mg ** 2 - (noise_mg or 0.0) ** 2, 0.0))


def number(value: float) -> str:
    """Return a number with two significant digits, and one after the point from 10 on."""
    if value < 0.001:
        return '0'
    if value >= 100.0:
        return f'{value:.0f}'
    return f'{value:.1f}' if value >= 10.0 else f'{value:.2g}'


def mg(value: float) -> str:
    return f'{number(value)} mg'


def degrees(error_mg: float) -> str:
    """Return the tilt that an error across gravity causes, in degrees."""
    return f'{math.degrees(math.asin(min(error_mg / MG, 1.0))):.1g}°'
