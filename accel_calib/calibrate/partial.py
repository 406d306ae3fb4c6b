# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrations of a sensor that cannot be turned over.

A robot with wheels tilts by 10° or 20°. Its poses do not determine offset and gain, and a fit is
refused. Two results are still possible:

- `mounting_only`: no values at all. The calibration carries the mounting ΔR after `level`.
- `fit_partial`: the values of model 10 that are most probable for a common sensor with these
  readings (maximum a posteriori).

**Prior.** Before any pose, each value of model 10 is normally distributed about zero with the
typical size of its effect (`accel_calib.effects`). The poses reduce this uncertainty only in the
combinations that they carry. Poses near one direction determine the sum of offset and gain along
it, and, by their tilt, some combinations across it. The covariance of the result is the posterior
covariance. It is small for |force| in the directions of the poses. In the other directions it is
nearly that of a sensor without calibration.

**Noise.** Poses often repeat worse than the noise of their samples predicts. If this is not taken
into account, little holds the values, and they follow the errors of the poses far beyond those of
common sensors. The poses are therefore fitted with several variance factors of the noise, from a
large one to 1, each fit starting from the previous one. The evidence of a factor is the
probability of the readings r, given factor and prior,

    r ~ N(0, factor · noise² + J P Jᵀ)

with P the covariance of the prior, linearised at the fit. The stated noise, a factor of 1, has the
prior probability `_STATED`. The variance factor is that of a full fit, computed at the most
probable one, but at least as large.

**Knocked poses.** A pose was knocked with a probability of 1 %. Its reading then has any error up
to `_LARGEST_ERROR_G`. The poses that are farthest from the fit of the others are left out in turn,
and the number of knocked poses with the largest evidence is taken. Poses that all repeat badly are
explained better by a larger variance factor, and are kept.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .calibration import Calibration, Rejected
from .gate import deviations_g, gated, sound_rows, sure_rows, uncertainty_g
from .pose_planning import (
    Cone,
    cone_of,
    determines,
    joined,
    missing_poses,
    turn_words,
)
from .quality import fit_findings, in_g, quality_of
from .rest_noise import with_rest_noise
from .unknown_orientation import copies, only_norm, PRIOR, rejected_by
from ..effects import EFFECTS, Model, MODELS, sensor_force, with_vector
from ..errors import InputError, RefusedFitError
from ..estimate import (
    estimate,
    Fit,
    judge,
    LARGEST_SHARE,
    NotConvergedError,
    originals,
    Prior,
    variance_factor,
)
from ..finding import Finding, without
from ..geometry import unit
from ..table import check_units, Floats, Poses
from ..text import counted
from ..units import MG, Units

_NAME = '10'
_EFFECTS = MODELS[_NAME].effects

_LOG_KNOCKED = float(np.log(0.01))
"""Logarithm of the probability that a pose was knocked."""

_SUSPICIOUS = 9.0
"""Squared distance from the fit of the others, per variance, below which all poses are kept if
the stated noise is the most probable."""

_TRIED = 3
"""Number of poses of which the one is left out whose removal is best."""

_LEAST_OWN = 1e-6
"""Smallest 1 - leverage of a pose that is compared with the others."""

_LEAST_FACTOR = 1e-6
"""Smallest variance factor; with 0, values that the poses do not see would have no prior."""

_LARGEST_ERROR_G = 0.5
"""Largest error of |reading| of a common sensor [g], five times the typical offset."""

FIRST_NOISE_G = 0.1
_NOISE_STEP = 3.0
"""Noise of the first fit [g], and the factor by which it is reduced."""

_STATED = 0.7
"""Prior probability that the stated noise is right, as in `accel_calib.estimate.equations`."""

_AS_STATED = float(np.log(_STATED / (1.0 - _STATED) * 10.0))
"""Its logarithm relative to that of each of about ten other factors."""

_LEAST_FACTOR = 1e-6
"""Smallest variance factor; with 0, values that the poses do not see would have no prior."""


def typical_spread() -> Floats:
    """Return the (9,) standard deviations of the values of model 10 over common sensors."""
    return np.array([EFFECTS[name].typical for name in _EFFECTS for _ in EFFECTS[name].parameters])


def common_sensors() -> Prior:
    """Return the distribution of the values of model 10 over common sensors."""
    spread = typical_spread()
    return Prior(np.zeros(len(spread)), np.diag(spread ** 2))


def mounting_only(poses: Poses, units: Units, *, sensor: str = '', date: str = ''
                  ) -> Calibration:
    """
    Return a calibration without offset and gain, to be levelled.

    Parameters
    ----------
    poses : Poses
        Still poses, one or more, in the unit of the readings.
    units : Units
        Unit of the readings, not native.
    sensor, date : str
        Name of the sensor and date, stored in the record. By default the name in the poses.

    Returns
    -------
    Calibration
        A calibration with the name ``ideal``, no effects and ΔR = I. `level` adds the mounting.
        Its warning states the error that is left in a common sensor.

    Raises
    ------
    InputError
        If the readings are in native units, or clearly in another unit.
    RefusedFitError
        If no row is a plausible reading at rest.

    """
    sound, rejected = usable(poses, units, 'a mounting')
    fit = judge(Model({}), only_norm(in_g(sound, units)))
    quality = quality_of(fit, units, unit(sound.reading))
    calibration = Calibration(
        'ideal', PRIOR, Model({}), units, sensor or poses.sensor, 'ros', date, fit.covariance,
        quality, poses, rejected, 'mounting alone: offset and gain are not calibrated',
        (Finding('open', _not_calibrated()),))
    return with_rest_noise(gated(calibration), poses)


def _not_calibrated() -> str:
    offset = EFFECTS['offset'].typical
    return ('offset and gain are not calibrated: a common sensor has an offset of '
            f'{offset * MG:.0f} mg on each axis, so |a| is off by about as much, and away from '
            f'the level pose the tilt by about {np.degrees(np.arcsin(offset)):.0f}°')


def fit_partial(poses: Poses, units: Units, *, sensor: str = '', date: str = '') -> Calibration:
    """
    Fit model 10 to poses near one direction, with the spread of common sensors as the prior.

    Only |force| = 1 g is used, even if the orientations are known.

    Parameters
    ----------
    poses : Poses
        Still poses, one or more, in the unit of the readings. Use this function if a fit is
        refused and `lies_in_cone` is true for their directions. If the sensor can be turned, a
        fit with more poses is better.
    units : Units
        Unit of the readings, not native.
    sensor, date : str
        Name of the sensor and date, stored in the record. By default the name in the poses.

    Returns
    -------
    Calibration
        The calibration with ΔR = I and the method `PRIOR`. Its covariance includes the prior. The
        reason states what the poses determine, and a finding what they leave open.

    Raises
    ------
    InputError
        If the readings are in native units, or clearly in another unit.
    RefusedFitError
        If no row is a plausible reading at rest, or the readings contradict a common sensor.
    ValueError
        If the poses determine model 10.

    """
    sound, rejected = usable(poses, units, 'a partial fit')
    directions = unit(sound.reading)
    if determines(_NAME, directions):
        raise ValueError(f'the {len(sound)} poses determine model {_NAME}, expected poses near '
                         'one direction: use fit_poses')
    poses_g = only_norm(in_g(sound, units))
    original = originals(poses_g)
    fit, kept, _ = without_knocked(poses_g, np.unique(original), common_sensors())
    out = rejected_by(fit.model, poses_g.take(~np.isin(original, kept)))
    calibration = Calibration(
        _NAME, PRIOR, fit.model, units, sensor or poses.sensor, 'ros', date, fit.covariance,
        quality_of(fit, units, directions[kept]), poses,
        tuple(sorted((*rejected, *out), key=lambda each: each.row)), '', ())
    about = carried(calibration)
    calibration = replace(calibration, reason=_known_words(about),
                          noted=(_open(about), *copies(original, poses_g),
                                 *partial_findings(fit)))
    return with_rest_noise(gated(calibration), poses)


def usable(poses: Poses, units: Units, what: str) -> tuple[Poses, tuple[Rejected, ...]]:
    """Return the plausible poses, without doubtful ones if others are left, and the other rows."""
    if units.is_native:
        raise InputError(f'the readings are in native units, and {what} does not determine their '
                         'scale; expected readings in m/s2 or g', 'convert the readings, or turn '
                         'the sensor to 9 or more poses spread over the sphere and fit')
    check_units(poses, units)
    sound, rejected = sound_rows(poses, units)
    sound, others = _of_plausible_length(sound, units)
    rejected = (*rejected, *others)
    sure, doubts = sure_rows(sound)
    if len(sure):
        sound, rejected = sure, (*rejected, *doubts)
    if not len(sound):
        raise RefusedFitError(f'found 0 sound poses of {counted(len(poses), "row")}, expected at '
                              'least 1', 'hold the sensor still and capture a pose')
    return sound, rejected


def _of_plausible_length(poses: Poses, units: Units) -> tuple[Poses, tuple[Rejected, ...]]:
    """Separate readings of about 1 g from others, which are no readings of gravity alone."""
    length = np.linalg.norm(units.to_g(poses.reading), axis=1)
    near = np.abs(length - 1.0) <= _LARGEST_ERROR_G
    return poses.take(near), tuple(
        Rejected(int(row), f'the length of the reading is {each:.3g} g, expected about 1 g')
        for row, each in zip(poses.row[~near], length[~near], strict=True))


@dataclass(frozen=True)
class _Likely:
    """A fit with its variance factor, the poses kept, and the logarithm of the evidence."""

    fit: Fit
    factor: float
    kept: NDArray[np.intp]
    log_evidence: float


def without_knocked(poses_g: Poses, kept: NDArray[np.intp], prior: Prior,
                    noise_g: float = FIRST_NOISE_G, share: float = LARGEST_SHARE
                    ) -> tuple[Fit, NDArray[np.intp], float]:
    """
    Fit poses without those that were knocked.

    Parameters
    ----------
    poses_g : Poses
        Poses in g.
    kept : (k,) array of int
        Indices of the poses to fit, without copies.
    prior : Prior
        Distribution of the values over sensors.
    noise_g : float
        Largest noise that is tried [g].
    share : float
        Largest share of knocked poses.

    Returns
    -------
    Fit, (k,) array of int, float
        The fit, the poses kept, and the logarithm of the evidence.

    """
    total = len(kept)
    now = best = _likely(poses_g, kept, 0, prior, noise_g)
    for knocked in range(1, int(share * total) + 1):
        away = _away(now.fit) / now.factor
        farthest = np.argsort(-away, kind='stable')[:_TRIED]
        if now.factor == 1.0 and away[farthest[0]] < _SUSPICIOUS:
            break
        now = max((_likely(poses_g, np.delete(now.kept, each), knocked, prior, noise_g)
                   for each in farthest), key=lambda each: each.log_evidence)
        best = max(best, now, key=lambda each: each.log_evidence)
    fit = best.fit
    factor = variance_factor(fit.chi2, fit.dof, fit.noise_known)
    if best.factor > 1.0:
        factor = max(factor, best.factor)
    fit = estimate(fit.model, fit.poses_g, prior, max(factor, _LEAST_FACTOR))
    return fit, best.kept, best.log_evidence


def _away(fit: Fit) -> Floats:
    """Return the (n,) squared distances of poses from the fit of the others, per variance."""
    own = fit.by_pose.own(fit.by_pose.spread)[:, 0, 0]
    return fit.by_pose.residual[:, 0] ** 2 / np.maximum(own, _LEAST_OWN)


def _likely(poses_g: Poses, kept: NDArray[np.intp], knocked: int, prior: Prior,
            noise_g: float) -> _Likely:
    """Return the fit with the most probable variance factor; the other poses were knocked."""
    used = poses_g.take(kept)
    model, factors = with_vector(_EFFECTS, prior.mean), _factors(used, noise_g)
    found = []
    for factor in factors:
        try:
            fit = estimate(model, used, prior, factor)
        except NotConvergedError:  # poses as precise as this contradict every common sensor
            break
        model, evidence = fit.model, _log_evidence(fit, factor, prior)
        if factor == 1.0:
            evidence += _AS_STATED
        scale = float(np.median(fit.equations.scale))
        evidence += knocked * (_LOG_KNOCKED + np.log(scale / _LARGEST_ERROR_G))
        found.append(_Likely(fit, factor, kept, evidence))
    if not found:
        raise NotConvergedError
    return max(found, key=lambda each: each.log_evidence)


def _factors(poses_g: Poses, noise_g: float) -> list[float]:
    """Return the variance factors to try, from that of a large noise to 1."""
    scale = float(np.median(judge(Model({}), poses_g).equations.scale))
    steps = int(np.ceil(max(np.log(noise_g / scale) / np.log(_NOISE_STEP), 0.0)))
    return [_NOISE_STEP ** (2.0 * step) for step in range(steps, -1, -1)]


def _log_evidence(fit: Fit, factor: float, prior: Prior) -> float:
    """Return the logarithm of the probability of the readings with this variance factor."""
    columns = fit.columns @ prior.root
    deviation = 0.0 if fit.prior is None else float(np.sum(fit.prior.residual ** 2))
    spread = factor * np.eye(len(columns)) + columns @ columns.T
    return -((fit.chi2 + deviation) / factor + float(np.linalg.slogdet(spread)[1])) / 2.0


def partial_findings(fit: Fit) -> tuple[Finding, ...]:
    """Return the findings about the noise of the poses."""
    found = fit_findings(fit, 0.0)
    if fit.dof > 0:
        return found
    return (Finding('no_check', f'{counted(len(fit.poses_g), "pose")} cannot show whether poses '
                    'repeat as well as the noise of their samples predicts', 'take more poses'),
            *without(found, 'no_check'))


@dataclass(frozen=True)
class Carried:
    """
    What the poses of a partial fit determine, and what they leave open.

    Parameters
    ----------
    count : int
        Number of poses used.
    cone : Cone
        Mean direction of the poses in the sensor axes, and their largest angle from it.
    along_g, among_g, elsewhere_g : float
        Standard deviation of |force| along this direction; the largest among the poses; the
        largest over the sphere [g].
    offset_along_g, offset_across_g : float
        Standard deviation of the offset along this direction, and the largest across it [g].
    tilt_deg : float
        Standard deviation of the direction of up, before the mounting is levelled [°].
    gain : (3,) array
        Standard deviation of the gain of each axis.
    cross_axis : float
        Largest standard deviation of a cross-axis gain.

    """

    count: int
    cone: Cone
    along_g: float
    among_g: float
    elsewhere_g: float
    offset_along_g: float
    offset_across_g: float
    tilt_deg: float
    gain: Floats
    cross_axis: float


def carried(calibration: Calibration) -> Carried:
    """
    Return what the poses of a partial fit determine.

    Parameters
    ----------
    calibration : Calibration
        As `fit_partial` returns it, with or without a mounting.

    """
    model, covariance = calibration.model, calibration.covariance
    reading = calibration.units.to_g(calibration.used_poses.reading)
    up = unit(sensor_force(model, reading, {}))
    cone = cone_of(up)
    axis = cone.axis[np.newaxis]
    moved = np.linalg.solve(model.linear_part[0], model.basis(axis, {}).full[0])
    deviation = np.sqrt(np.diag(covariance))
    place = {name: [each.startswith(f'{name}.') for each in calibration.parameters]
             for name in _EFFECTS}
    offset = covariance[np.ix_(place['offset'], place['offset'])]
    return Carried(
        len(up), cone, float(deviations_g(calibration, axis)[0]),
        float(np.max(deviations_g(calibration, up))), uncertainty_g(calibration),
        float(np.sqrt(cone.axis @ offset @ cone.axis)), _across(offset, cone.axis),
        float(np.degrees(_across(moved @ covariance @ moved.T, cone.axis))),
        deviation[place['axis_gain']], float(np.max(deviation[place['cross_axis']])))


def _across(covariance: Floats, axis: Floats) -> float:
    """Return the largest standard deviation at right angles to an axis."""
    across = np.eye(3) - np.outer(axis, axis)
    return float(np.sqrt(np.max(np.linalg.eigvalsh(across @ covariance @ across))))


def carried_words(calibration: Calibration) -> str:
    """
    Return what a calibration carries and leaves open, as one line.

    Parameters
    ----------
    calibration : Calibration
        As `fit_partial` or `mounting_only` returns it.

    Returns
    -------
    str
        One line with numbers; empty for a calibration with another method.

    """
    if calibration.method != PRIOR:
        return ''
    if not calibration.model.effects:
        return f'mounting alone; {_not_calibrated()}'
    about = carried(calibration)
    return f'{_known_words(about)}; {_open(about).words}'


def _known_words(about: Carried) -> str:
    """Return a text about what the poses determine."""
    if about.count == 1:
        return (f'1 pose: along gravity the sum of offset and gain, and so |a|, is known to '
                f'{_mg(about.along_g)}')
    return (f'the {about.count} poses lie within {about.cone.degrees:.0f}° of one direction: '
            'along gravity the sum of offset and gain, and so |a|, is known to '
            f'{_mg(about.along_g)}, and at each pose |a| to {_mg(about.among_g)}')


def _open(about: Carried) -> Finding:
    """Return what the poses leave open, and the poses that determine it."""
    gains = joined([f'±{100.0 * each:.1f} % on {axis}'
                    for axis, each in zip('xyz', about.gain, strict=True)])
    missing = turn_words(missing_poses(_NAME, about.cone.axis[np.newaxis]))
    return Finding(
        'open', f'open: offset along gravity ±{_mg(about.offset_along_g)}, across it '
        f'±{_mg(about.offset_across_g)} ({about.tilt_deg:.1f}° of tilt until it is levelled), '
        f'gain {gains}, cross-axis ±{100.0 * about.cross_axis:.1f} %; elsewhere on the sphere '
        f'|a| is known to {_mg(about.elsewhere_g)}', f'to determine them, {missing}')


def _mg(value_g: float) -> str:
    value = value_g * MG
    return f'{value:.0f} mg' if value >= 10.0 else f'{value:.2g} mg'
