# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrations from poses of a part of the sphere, with the typical values of sensors.

A robot with wheels tilts by 10° or 20°, and other ones turn on one axis. Their poses do not
determine offset and gain. Still possible are `mounting_only`, without values; `fit_partial`, with
the values of model 10 that are most probable for a common sensor with these readings (maximum a
posteriori); and `fit_with_fleet`, for a sensor of a fleet whose values are known. There, poses are
left out as knocked only if the poses determine the values without the fleet.

**Common sensors.** Before any pose, each value of model 10 is normally distributed about zero with
the typical size of its effect (`accel_calib.effects`). The poses reduce this uncertainty only in
the combinations that they carry: poses near one direction determine the sum of offset and gain
along it, and, by their tilt, some combinations across it; poses in a plane determine what acts in
the plane. The covariance of the result is the posterior one. It is small for |force| in the
directions of the poses, and elsewhere nearly that of a sensor without calibration.

**Fleet** (empirical Bayes). The sensors of one model have the values of model 10 with the mean m
and the covariance P. A few sensors are unlike the others. The values of a sensor are therefore
normally distributed about m with one of several covariances: those of the fleet, s² P with a small
s, or those of common sensors, with the probability `_UNLIKE`. The poses are fitted with each of
them, and the most probable one is used: the evidence of the readings times the probability of the
covariance. A sensor whose readings contradict the fleet is fitted as a common sensor. A fit that
needs no prior, such as a refined one, has its values x with the covariance C. They are combined
with the fleet to first order (`posterior`): x + K (m - x) with K = C (C + P)⁻¹.

**Noise.** Poses often repeat worse than the noise of their samples predicts. The values would then
follow the errors of the poses far beyond those of common sensors. The poses are therefore fitted
with several variance factors of the noise, from a large one to 1, each fit starting from the
previous one. The evidence of a factor is the probability of the readings r, given factor and prior

    r ~ N(0, factor · noise² + J P Jᵀ)

with P the covariance of the prior, linearised at the fit. The stated noise, a factor of 1, has the
prior probability `STATED_NOISE`. The variance factor is that of a full fit, computed at the most
probable one, but at least as large. The readings of a sensor that is unlike its fleet could also
come from a usual sensor with very large noise: with a fleet, the noise is limited to
`FLEET_NOISE_G`, and the probability of a noise decreases with its factor on the stated noise.

**Knocked poses.** A pose was knocked with a probability of 1 %. Its reading then has any error up
to `LARGEST_ERROR_G`. The poses that are farthest from the fit of the others are left out in turn,
and the number of knocked poses with the largest evidence is taken. Poses that all repeat badly are
explained better by a larger variance factor, and are kept.

"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .calibration import Calibration, FLEET, PRIOR, Rejected
from .directions import determines, lies_in_plane
from .fit import copies, only_norm, rejected_by, sound_rows, sure_rows
from .planning import missing_poses, turn_words
from .quality import deviations_g, finished, fit_findings, in_g, record_of, uncertainty_g
from ..effects import AXES, EFFECTS, Model, MODELS, sensor_force, with_vector
from ..errors import InputError, RefusedFitError
from ..estimate import (
    estimate, Fit, judge, LARGEST_SHARE, NotConvergedError, originals, Prior, variance_factor)
from ..finding import Finding, without
from ..geometry import cone_of, unit
from ..statistics import STATED_NOISE
from ..table import check_units, Poses
from ..text import counted, enumerated
from ..units import Floats, Indices, MG, Units

NAME = '10'
"""The model whose values have priors."""

_EFFECTS = MODELS[NAME].effects

_LIKE = {1.0: 0.9, 2.0: 0.07, 4.0: 0.02}
"""Probability of each factor s on the spread of the fleet, for sensors that belong to it."""

_UNLIKE = {1.0: 0.008, 4.0: 0.002}
"""Probability of each factor on the spread of common sensors, for other sensors."""

FLEET_NOISE_G = 0.02
"""Largest error of poses that is tried with a fleet [g]; larger ones are knocked poses."""

UNLIKE_FLEET = Finding('unlike_fleet', 'the sensor is unlike the fleet, so the typical values of '
                       'the fleet are not used', 'take more poses')

_LOG_KNOCKED = float(np.log(0.01))
"""Logarithm of the probability that a pose was knocked."""

_SUSPICIOUS = 9.0
"""Squared distance from the fit of the others, per variance, below which all poses are kept if
the stated noise is the most probable."""

_TRIED = 3
"""Number of poses of which the one is left out whose removal is best."""

_LEAST_OWN = 1e-6
"""Smallest 1 - leverage of a pose that is compared with the others."""

LARGEST_ERROR_G = 0.5
"""Largest error of |reading| of a common sensor [g], five times the typical offset."""

FIRST_NOISE_G = 0.1
_NOISE_STEP = 3.0
"""Noise of the first fit [g], and the factor by which it is reduced."""

_AS_STATED = float(np.log(STATED_NOISE / (1.0 - STATED_NOISE) * 10.0))
"""Logarithm of the prior probability that the stated noise is right, relative to that of each of
about ten other factors."""

_LEAST_FACTOR = 1e-6
"""Smallest variance factor; with 0, values that the poses do not see would have no prior."""


@dataclass(frozen=True)
class FleetPrior:
    """
    Mean and covariance of the values over a number of sensors of one model.

    The name of the model is empty if it is not known.

    """

    model: str
    sensors: int
    prior: Prior

    @property
    def words(self) -> str:
        """Return what the values are."""
        name = f' of model {self.model}' if self.model else ''
        return f'the typical values of {counted(self.sensors, "sensor")}{name}'


@dataclass(frozen=True)
class Candidate:
    """A prior, the logarithm of its probability, and whether it is for sensors unlike a fleet."""

    prior: Prior
    log_probability: float = 0.0
    is_unlike: bool = False


def common_sensors() -> Prior:
    """Return the distribution of the values of model 10 over common sensors."""
    spread = [EFFECTS[name].typical for name in _EFFECTS for _ in EFFECTS[name].parameters]
    return Prior(np.zeros(len(spread)), np.diag(np.square(spread)))


def priors_of(fleet: FleetPrior | None = None) -> tuple[Candidate, ...]:
    """Return the priors that a sensor of a fleet can have; of common sensors without a fleet."""
    if fleet is None:
        return (Candidate(common_sensors()),)
    mean, covariance, common = fleet.prior.mean, fleet.prior.covariance, common_sensors()
    return (*(Candidate(Prior(mean, covariance * spread ** 2), float(np.log(probability)))
              for spread, probability in _LIKE.items()),
            *(Candidate(Prior(mean, covariance + common.covariance * spread ** 2),
                        float(np.log(probability)), is_unlike=True)
              for spread, probability in _UNLIKE.items()))


@dataclass(frozen=True)
class PriorFit:
    """
    The fit with the most probable variance factor to the poses kept.

    `kept` are their indices, without copies, and `original` has, for each pose, the index of the
    first equal one. The evidence includes the probability of the prior.

    """

    fit: Fit
    factor: float
    kept: Indices
    log_evidence: float
    original: Indices
    is_unlike: bool = False


def most_probable(poses_g: Poses, priors: Sequence[Candidate], noise_g: float, share: float
                  ) -> PriorFit:
    """
    Return the fit with the most probable prior, without knocked poses.

    The noise is at most `noise_g` [g], and knocked poses are at most a `share` of all. Raise
    NotConvergedError if the readings contradict every prior.

    """
    found, original = [], originals(poses_g)
    for candidate in priors:
        try:
            likely = without_knocked(poses_g, np.unique(original), candidate.prior, noise_g, share)
        except NotConvergedError:  # the readings contradict this prior
            continue
        evidence = likely.log_evidence + candidate.log_probability
        evidence -= np.log(max(likely.fit.factor or 1.0, 1.0)) / 2.0
        found.append(replace(likely, log_evidence=evidence, original=original,
                             is_unlike=candidate.is_unlike))
    if not found:
        raise NotConvergedError
    return max(found, key=lambda likely: likely.log_evidence)


def without_knocked(poses_g: Poses, kept: Indices, prior: Prior, noise_g: float,
                    share: float) -> PriorFit:
    """Fit poses without those that were knocked."""
    total = len(kept)
    now = best = _likely(poses_g, kept, 0, prior, noise_g)
    for knocked in range(1, int(share * total) + 1):
        data = now.fit.by_pose
        own = np.maximum(data.own[:, 0, 0], _LEAST_OWN)
        away = data.residual[:, 0] ** 2 / own / now.factor  # from the fit of the others
        farthest = np.argsort(-away, kind='stable')[:_TRIED]
        if now.factor == 1.0 and away[farthest[0]] < _SUSPICIOUS:
            break
        now = max((_likely(poses_g, np.delete(now.kept, each), knocked, prior, noise_g)
                   for each in farthest), key=lambda likely: likely.log_evidence)
        best = max(best, now, key=lambda likely: likely.log_evidence)
    fit = best.fit
    factor = variance_factor(fit.chi2, fit.dof, fit.noise_known)
    if best.factor > 1.0:
        factor = max(factor, best.factor)
    fit = estimate(fit.model, fit.poses_g, prior, max(factor, _LEAST_FACTOR))
    return replace(best, fit=fit)


def _likely(poses_g: Poses, kept: Indices, knocked: int, prior: Prior, noise_g: float) -> PriorFit:
    """Return the fit with the most probable variance factor; the other poses were knocked."""
    used, model = poses_g.take(kept), with_vector(_EFFECTS, prior.mean)
    found = []
    stated_g = float(np.median(judge(Model({}), used).equations.scale))
    steps = int(np.ceil(max(np.log(noise_g / stated_g) / np.log(_NOISE_STEP), 0.0)))
    for step in range(steps, -1, -1):  # from the factor of a large noise to 1
        factor = _NOISE_STEP ** (2.0 * step)
        try:
            fit = estimate(model, used, prior, factor)
        except NotConvergedError:  # poses as precise as this contradict every common sensor
            break
        model, columns = fit.model, fit.columns @ prior.root
        deviation = 0.0 if fit.prior is None else float(np.sum(fit.prior.residual ** 2))
        spread = factor * np.eye(len(columns)) + columns @ columns.T
        evidence = -((fit.chi2 + deviation) / factor + float(np.linalg.slogdet(spread)[1])) / 2.0
        if factor == 1.0:
            evidence += _AS_STATED
        scale = float(np.median(fit.equations.scale))
        evidence += knocked * (_LOG_KNOCKED + np.log(scale / LARGEST_ERROR_G))
        found.append(PriorFit(fit, factor, kept, evidence, kept))
    if not found:
        raise NotConvergedError
    return max(found, key=lambda likely: likely.log_evidence)


def posterior(values: Floats, covariance: Floats, fleet: FleetPrior
              ) -> tuple[Floats, Floats, tuple[Finding, ...]]:
    """
    Return fitted values and their covariance with the typical values of a fleet included.

    The values (p,) and their covariance (p, p) are those of a fit without a prior [g], with model
    10 first. The prior that makes them most probable is used. There is a finding if it is for
    sensors unlike the fleet.

    """
    count = len(fleet.prior.mean)
    away = fleet.prior.mean - values[:count]
    found = []
    for candidate in priors_of(fleet):
        spread = covariance[:count, :count] + candidate.prior.covariance
        evidence = candidate.log_probability - (
            away @ np.linalg.solve(spread, away) + np.linalg.slogdet(spread)[1]) / 2.0
        found.append((evidence, spread, candidate.is_unlike))
    _, spread, is_unlike = max(found, key=lambda part: part[0])
    gain = np.linalg.solve(spread, covariance[:count]).T
    left = covariance - gain @ covariance[:count]
    return values + gain @ away, (left + left.T) / 2.0, (UNLIKE_FLEET,) * is_unlike


def mounting_only(poses: Poses, units: Units, *, sensor: str = '', date: str = '') -> Calibration:
    """
    Return a calibration named ``ideal``, without effects and with ΔR = I, to be levelled.

    `level` adds the mounting. A finding states the error that is left in a common sensor.
    Parameters and errors as in `fit_partial`.

    """
    sound, rejected = usable(poses, units, 'a mounting')
    fit, offset = judge(Model({}), only_norm(in_g(sound, units))), EFFECTS['offset'].typical
    return finished(record_of(
        fit, poses, units, unit(sound.reading), name='ideal', method=PRIOR, rejected=rejected,
        reason='mounting alone: offset and gain are not calibrated',
        noted=(Finding(
            'open', 'offset and gain are not calibrated: a common sensor has an offset of '
            f'{offset * MG:.0f} mg on each axis, so |a| is off by about as much, and away from '
            f'the level pose the tilt by about {np.degrees(np.arcsin(offset)):.0f}°'),)),
        sensor, date)


def fit_partial(poses: Poses, units: Units, *, sensor: str = '', date: str = '') -> Calibration:
    """
    Fit model 10 to poses near one direction or in a plane, with common sensors as the prior.

    It is for directions that `lies_in_cone`, for which a fit is refused, and those that
    `lies_in_plane`, where a smaller model would assume what they do not show. Only |force| = 1 g
    is used, even if the orientations are known. The calibration has ΔR = I and the method
    `PRIOR`. Its covariance includes the prior. The reason states what the poses determine, and a
    finding what they leave open.

    Parameters
    ----------
    poses : Poses
        Still poses, one or more, in the unit of the readings.
    units : Units
        Unit of the readings, not native.
    sensor, date : str
        Stored in the record. By default the name in the poses.

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
    if determines(NAME, unit(sound.reading)):
        raise ValueError(f'the {len(sound)} poses determine model {NAME}, expected poses near '
                         'one direction or in a plane: use fit_poses')
    found = most_probable(only_norm(in_g(sound, units)), priors_of(), FIRST_NOISE_G, LARGEST_SHARE)
    calibration = _record_of(found, poses, sound, units, method=PRIOR, rejected=rejected)
    reason, left_open = _words_of_part(calibration)
    return finished(replace(calibration, reason=reason, noted=(left_open, *calibration.noted)),
                    sensor, date)


def _words_of_part(calibration: Calibration) -> tuple[str, Finding]:
    """Return what the poses of a part of the sphere determine, and what they leave open."""
    model, covariance = calibration.model, calibration.covariance
    up = unit(sensor_force(model, calibration.units.to_g(calibration.used_poses.reading), {}))
    count, (axis, widest), deviation = len(up), cone_of(up), np.sqrt(np.diag(covariance))
    place = dict(zip(model.effects, model.terms.parts, strict=True))
    offset = covariance[place['offset'], place['offset']]
    at_each = _mg(float(np.max(deviations_g(calibration, up))))
    in_plane = lies_in_plane(up)
    if in_plane:
        axis = np.linalg.svd(up - up.mean(axis=0))[2][2]
    flat = np.eye(3) - np.outer(axis, axis)  # projects to right angles to the axis
    beside = float(np.sqrt(np.linalg.eigvalsh(flat @ offset @ flat)[-1]))
    if in_plane:
        shown, along, across, tilt = up, 'across the plane', 'in it', ''
        reason = f'the {count} poses lie in a plane: at each pose |a| is known to {at_each}'
    else:
        shown, along, across = axis[np.newaxis], 'along gravity', 'across it'
        reason = ('along gravity the sum of offset and gain, and so |a|, is known to '
                  f'{_mg(float(deviations_g(calibration, shown)[0]))}')
        reason = f'1 pose: {reason}' if count == 1 else (
            f'the {count} poses lie within {widest:.0f}° of one direction: {reason}, and at '
            f'each pose |a| to {at_each}')
        moved = flat @ np.linalg.solve(model.linear_part[0], model.basis(shown, {}).full[0])
        degrees = np.degrees(np.sqrt(np.linalg.eigvalsh(moved @ covariance @ moved.T)[-1]))
        tilt = f' ({degrees:.1f}° of tilt until it is levelled)'
    gains = enumerated([f'±{100.0 * gain:.2g} % on {axis_name}' for axis_name, gain in zip(
        AXES, deviation[place['axis_gain']], strict=True)])
    return reason, Finding(
        'open', f'open: offset {along} ±{_mg(float(np.sqrt(axis @ offset @ axis)))}, {across} '
        f'±{_mg(beside)}{tilt}, gain {gains}, cross-axis '
        f'±{100.0 * np.max(deviation[place["cross_axis"]]):.2g} %; elsewhere on the sphere |a| is '
        f'known to {_mg(uncertainty_g(calibration))}',
        f'to determine them, {turn_words(missing_poses(NAME, shown))}')


def fit_with_fleet(poses: Poses, units: Units, fleet: FleetPrior, *, sensor: str = '',
                   date: str = '') -> Calibration:
    """
    Fit model 10 with the typical values of a fleet as the prior, and the method `FLEET`.

    The rest is as in `fit_partial`. RefusedFitError is also raised if the uncertainty is too
    large.

    """
    sound, rejected = usable(poses, units, 'a fit with a fleet')
    share = LARGEST_SHARE if determines(NAME, unit(sound.reading)) else 0.0
    try:
        found = most_probable(only_norm(in_g(sound, units)), priors_of(fleet), FLEET_NOISE_G,
                              share)
    except NotConvergedError:
        raise RefusedFitError('the readings contradict the values of the fleet, expected a sensor '
                              'of the same model', 'check the unit and the poses, or fit without '
                              '--prior') from None
    calibration = _record_of(found, poses, sound, units, method=FLEET, rejected=rejected)
    reason = f'{counted(len(found.kept), "pose")} with {fleet.words}'
    return finished(replace(calibration, reason=reason, noted=(
        *(UNLIKE_FLEET,) * found.is_unlike, *calibration.noted)), sensor, date)


def _record_of(found: PriorFit, poses: Poses, sound: Poses, units: Units, *, method: str,
               rejected: tuple[Rejected, ...]) -> Calibration:
    """Return a fit to the sound poses as a calibration."""
    fit, out = found.fit, sound.take(~np.isin(found.original, found.kept))
    noted = fit_findings(fit, 0.0)
    if fit.dof <= 0:
        noted = (Finding('no_check', f'{counted(len(fit.poses_g), "pose")} cannot show whether '
                         'poses repeat as well as the noise of their samples predicts',
                         'take more poses'), *without(noted, 'no_check'))
    return record_of(
        fit, poses, units, unit(sound.reading)[found.kept], name=NAME, method=method,
        rejected=(*rejected, *rejected_by(fit.model, in_g(out, units))),
        noted=(*copies(found.original, sound), *noted))


def usable(poses: Poses, units: Units, what: str) -> tuple[Poses, tuple[Rejected, ...]]:
    """Return the plausible poses, without doubtful ones if others are left, and the other rows."""
    if units.is_native:
        raise InputError(f'the readings are in native units, and {what} does not determine their '
                         'scale; expected readings in m/s2 or g', 'convert the readings, or turn '
                         'the sensor to 9 or more poses spread over the sphere and fit')
    check_units(poses, units)
    sound, rejected = sound_rows(poses, units)
    length = np.linalg.norm(units.to_g(sound.reading), axis=1)
    near = np.abs(length - 1.0) <= LARGEST_ERROR_G  # others are no readings of gravity alone
    rejected += tuple(
        Rejected(int(row), f'the length of the reading is {size:.3g} g, expected about 1 g')
        for row, size in zip(sound.row[~near], length[~near], strict=True))
    sound = sound.take(near)
    sure, doubts = sure_rows(sound)
    if len(sure):
        sound, rejected = sure, (*rejected, *doubts)
    if not len(sound):
        raise RefusedFitError(f'found 0 sound poses of {counted(len(poses), "row")}, expected at '
                              'least 1', 'hold the sensor still and capture a pose')
    return sound, rejected


def _mg(value_g: float) -> str:
    value = value_g * MG
    return f'{value:.0f} mg' if value >= 10.0 else f'{value:.2g} mg'
