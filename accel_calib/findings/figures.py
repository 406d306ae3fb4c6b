# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The figures of a result: one table of names, units, values and standard deviations.

Every surface shows these figures: terminal, pages, live page, JSON and Parquet. `figures_of` has
all of a calibration: its residuals [mg], V and W in the unit of the readings, and the values of
the other effects in the units of the catalogue. The functions at the end make the JSON of results,
for the command line and the topic ``~/result``.

The parameters of `accel_calib.compare` do not depend on the axes of the model. `scale_of` states
how they are shown: offsets in mg, gains minus 1 and cross-axis gains in %. For native units, 1 g
is the mean of the sensitivities.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, TYPE_CHECKING

import numpy as np

from ..calibrate import Calibration, Curve, Outlook, Quality, Verification
from ..effects import AXES, effect_named, LADDER, value_unit
from ..estimate import sensing_axes
from ..finding import Rating
from ..table import Floats
from ..text import signed
from ..units import MG

if TYPE_CHECKING:
    from ..refine import Refinement

OFFSETS = ('offset.x', 'offset.y', 'offset.z')
GAINS = ('gain.x', 'gain.y', 'gain.z')
CROSS = ('gain.xy', 'gain.xz', 'gain.yz')
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2), (1, 0), (2, 0), (2, 1))
"""Order of the entries of W."""


@dataclass(frozen=True)
class Figure:
    """
    A figure of a result.

    Parameters
    ----------
    key : str
        Name, which is unique in the result.
    label : str
        Name for people.
    unit : str
        Unit of the value; may be empty.
    value, sd : float
        Value, and its standard deviation; 0 if it has none.

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
    for i, j in _ENTRIES:
        value, sd = float(gain[i, j]), float(gain_sd[i, j])
        mirrored = i > j and value == gain[j, i]
        if (sd > 0.0 or value) and not mirrored:
            name = AXES[i] if i == j else f'{AXES[i]}{AXES[j]}'
            yield Figure(f'gain.{name}', f'gain {name}', per_g, value, sd)


def effect_figures(calibration: Calibration) -> Iterator[Figure]:
    """Yield the values of the effects beyond V and W; shapes at their usual value are left out."""
    variances = np.maximum(np.diag(calibration.covariance), 0.0)
    deviations = dict(zip(calibration.parameters, np.sqrt(variances).tolist(), strict=True))
    for effect, values in calibration.model.values.items():
        shown = {} if effect in LADDER else effect_named(effect).shown(values)
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
    unit, factor = value_unit(effect, part)
    return 0.0, factor, unit


def in_words(name: str, value: float, sd: float) -> str:
    """Return a parameter as ``+value ± sd unit``."""
    zero, _, _ = scale_of(name)
    return change_in_words(name, value - zero, sd)


def change_in_words(name: str, change: float, sd: float) -> str:
    """Return the change of a parameter as ``+value ± sd unit``."""
    _, factor, unit = scale_of(name)
    return signed(change * factor, sd * factor, unit)


def calibration_json(calibration: Calibration, ahead: Outlook) -> dict[str, Any]:
    """Return a calibration for JSON, with what its poses determine."""
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
        'warnings': calibration.warnings, **_own_names(calibration), **_rest_noise(calibration),
        **_outlook(ahead)}


def _rest_noise(calibration: Calibration) -> dict[str, Any]:
    """Return the gyro bias [rad/s] and the noise of a sample for JSON; None if not known."""
    gyro, noise = calibration.gyro, calibration.noise
    return {'gyro_bias': gyro and gyro.bias, 'gyro_bias_sd': gyro and gyro.sd,
            'noise_force': noise and _known(noise.force),
            'noise_rate': noise and _known(noise.rate)}


def _known(values: Floats) -> Floats | None:
    return None if np.isnan(values).all() else values


def _outlook(found: Outlook) -> dict[str, Any]:
    """Return what the poses determine, and the next pose, for JSON."""
    seen, asked = found.identifiability, found.next_pose
    unseen = seen.open_parameters
    return {
        'uncertainty_mg': found.uncertainty_mg,
        'identifiability': {
            'model': seen.model, 'dilution': seen.dilution, 'mean_dilution': seen.mean_dilution,
            'parameters': {name: {'determined': name not in unseen, 'dilution': deviation}
                           for name, deviation in seen.deviations.items()},
            'undetermined': [{'weights': dict(open_.weights), 'words': open_.words}
                             for open_ in seen.undetermined]},
        'next_pose': None if asked.direction is None else {
            'direction': asked.direction, 'words': asked.words}}


def _own_names(calibration: Calibration) -> dict[str, Any]:
    """Return the parameters of models 9 and 12 with the names of the ESGI'95 report."""
    if calibration.form.sensing_axes:
        axes = sensing_axes(calibration.gain, calibration.offset)
        return {'shifts': axes.shifts, 'scales': axes.scales,
                'angles': {'phi': axes.phi, 'psi': axes.psi, 'theta': axes.theta}}
    if 'reference' in calibration.poses:
        return {'matrix': calibration.gain @ calibration.model.rotation,
                'shift': calibration.offset}
    return {}


def refinement_json(result: Refinement) -> dict[str, Any]:
    """Return a refinement for JSON."""
    return {
        'verdict': result.verdict, 'undecided': result.undecided, 'base': result.calibration.name,
        'poses_used': len(result.poses_g), 'noise_floor_mg': result.noise_floor_mg,
        'gap_mg': result.gap_mg,
        'steps': [{**asdict(step), 'words': effect_named(step.name).words}
                  for step in result.steps],
        'remaining_gap_mg': result.remaining_gap_mg,
        'disturbed_poses': result.disturbed_poses,
        'not_testable': [{'effect': effect, 'needs': needs}
                         for effect, needs in result.not_testable],
        'advice': result.advice, 'plan': result.plan.lines,
        'warnings': result.calibration.warnings,
        'refusal': result.refusal[0] if result.refusal else None}


def curve_json(curve: Curve) -> dict[str, Any]:
    """Return the offset over temperature for JSON; values of order k are in mg/°C^k."""
    return {
        'reference_c': curve.reference_c, 'range_c': curve.range_c, 'degree': curve.degree,
        'coefficients': dict(zip(AXES, (curve.values * MG).T, strict=True)),
        'coefficients_sd': dict(zip(AXES, (curve.deviations * MG).T, strict=True)),
        'band_mg': curve.band_mg, 'change_mg': curve.change_mg, 'residual_mg': curve.residual_mg,
        'held_out_mg': curve.held_out_mg, 'hysteresis_mg': curve.hysteresis_mg,
        'lag_s': curve.lag_s}


def rating_json(rating: Rating, kind: str, text: str, command: str) -> dict[str, Any]:
    """Return a rating for JSON, with the kind of the next step, its words and its command."""
    return {'rating': rating.name, 'rating_reason': rating.reason,
            'findings': [each.stated for each in rating.findings],
            'next': {'kind': kind, 'text': text, 'command': command}}
