# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Typical values of sensors, and the fit of poses that do not determine a calibration alone.

**Common sensors.** Before any pose, each value of model 10 is normally distributed about zero with
the typical size of its effect (`accel_calib.effects`). The poses reduce this uncertainty only in
the combinations that they carry. Poses near one direction determine the sum of offset and gain
along it, and, by their tilt, some combinations across it. The covariance of the result is the
posterior covariance. It is small for |force| in the directions of the poses. In the other
directions it is nearly that of a sensor without calibration.

**Fleet** (empirical Bayes). The sensors of one model have the values of model 10 with the mean m
and the covariance P. A few sensors are unlike the others. The values of a sensor are therefore
normally distributed about m with one of several covariances: those of the fleet, s² P with a small
s, or those of common sensors, with the probability `_UNLIKE`. The poses are fitted with each of
them, and the most probable one is used: the evidence of the readings times the probability of the
covariance. The readings of a sensor that is unlike the fleet contradict the covariances of the
fleet. It is then fitted as a common sensor.

A fit that needs no prior, such as a refined one, has its values x with the covariance C. They are
combined with the fleet to first order (`posterior`): x + K (m - x) with K = C (C + P)⁻¹.

**Noise.** Poses often repeat worse than the noise of their samples predicts. If this is not taken
into account, little holds the values, and they follow the errors of the poses far beyond those of
common sensors. The poses are therefore fitted with several variance factors of the noise, from a
large one to 1, each fit starting from the previous one. The evidence of a factor is the
probability of the readings r, given factor and prior,

    r ~ N(0, factor · noise² + J P Jᵀ)

with P the covariance of the prior, linearised at the fit. The stated noise, a factor of 1, has the
prior probability `_STATED`. The variance factor is that of a full fit, computed at the most
probable one, but at least as large. The readings of a sensor that is unlike its fleet could also
come from a usual sensor with very large noise: with a fleet, the noise is limited to
`FLEET_NOISE_G`, and the probability of a noise decreases with its factor on the stated noise.

**Knocked poses.** A pose was knocked with a probability of 1 %. Its reading then has any error up
to `LARGEST_ERROR_G`. The poses that are farthest from the fit of the others are left out in turn,
and the number of knocked poses with the largest evidence is taken. Poses that all repeat badly are
explained better by a larger variance factor, and are kept.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..effects import EFFECTS, Model, MODELS, with_vector
from ..errors import RefusedFitError
from ..estimate import estimate, Fit, judge, NotConvergedError, originals, Prior, variance_factor
from ..finding import Finding
from ..table import Floats, Poses

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

_STATED = 0.7
"""Prior probability that the stated noise is right, as in `accel_calib.estimate.equations`."""

_AS_STATED = float(np.log(_STATED / (1.0 - _STATED) * 10.0))
"""Its logarithm relative to that of each of about ten other factors."""

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


@dataclass(frozen=True)
class Candidate:
    """A prior, the logarithm of its probability, and whether it is for sensors unlike a fleet."""

    prior: Prior
    log_probability: float = 0.0
    is_unlike: bool = False


def typical_spread() -> Floats:
    """Return the (9,) standard deviations of the values of model 10 over common sensors."""
    return np.array([EFFECTS[name].typical for name in _EFFECTS for _ in EFFECTS[name].parameters])


def common_sensors() -> Prior:
    """Return the distribution of the values of model 10 over common sensors."""
    spread = typical_spread()
    return Prior(np.zeros(len(spread)), np.diag(spread ** 2))


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
    first equal one. The logarithm of the evidence includes the probability of the prior.
    `is_unlike` is for a prior of sensors unlike the fleet.

    """

    fit: Fit
    factor: float
    kept: NDArray[np.intp]
    log_evidence: float
    original: NDArray[np.intp]
    is_unlike: bool = False


def most_probable(poses_g: Poses, priors: Sequence[Candidate], noise_g: float, share: float
                  ) -> PriorFit:
    """
    Return the fit with the most probable prior, without knocked poses.

    The noise that is tried is at most `noise_g` [g], and knocked poses are at most a `share` of
    all. NotConvergedError is raised if the readings contradict every prior.

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


def without_knocked(poses_g: Poses, kept: NDArray[np.intp], prior: Prior, noise_g: float,
                    share: float) -> PriorFit:
    """Fit poses without those that were knocked."""
    total = len(kept)
    now = best = _likely(poses_g, kept, 0, prior, noise_g)
    for knocked in range(1, int(share * total) + 1):
        away = _away(now.fit) / now.factor
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


def _away(fit: Fit) -> Floats:
    """Return the (n,) squared distances of poses from the fit of the others, per variance."""
    own = fit.by_pose.own(fit.by_pose.spread)[:, 0, 0]
    return fit.by_pose.residual[:, 0] ** 2 / np.maximum(own, _LEAST_OWN)


def _likely(poses_g: Poses, kept: NDArray[np.intp], knocked: int, prior: Prior,
            noise_g: float) -> PriorFit:
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
        evidence += knocked * (_LOG_KNOCKED + np.log(scale / LARGEST_ERROR_G))
        found.append(PriorFit(fit, factor, kept, evidence, kept))
    if not found:
        raise NotConvergedError
    return max(found, key=lambda likely: likely.log_evidence)


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


def posterior(values: Floats, covariance: Floats, fleet: FleetPrior
              ) -> tuple[Floats, Floats, tuple[Finding, ...]]:
    """
    Return fitted values and their covariance with the typical values of a fleet included.

    The covariance of the fleet or of common sensors is chosen that makes the values most probable.
    There is a finding if the sensor is unlike the fleet.

    Parameters
    ----------
    values : (p,) array
        Values of a fit; those of model 10 come first [g].
    covariance : (p, p) array
        Their covariance, without a prior.
    fleet : FleetPrior
        Typical values of sensors of the same model.

    """
    count = len(fleet.prior.mean)
    away = fleet.prior.mean - values[:count]
    found = []
    for candidate in priors_of(fleet):
        spread = covariance[:count, :count] + candidate.prior.covariance
        evidence = candidate.log_probability - (
            away @ np.linalg.solve(spread, away) + np.linalg.slogdet(spread)[1]) / 2.0
        if evidence > -np.inf:
            found.append((evidence, spread, candidate.is_unlike))
    if not found:
        raise RefusedFitError('the fitted values are not finite, expected numbers',
                              'check the poses for mistakes')
    _, spread, is_unlike = max(found, key=lambda part: part[0])
    gain = np.linalg.solve(spread, covariance[:count]).T
    left = covariance - gain @ covariance[:count]
    return values + gain @ away, (left + left.T) / 2.0, (UNLIKE_FLEET,) * is_unlike
