# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit of few poses with the typical values of a fleet (empirical Bayes).

A fleet of sensors of one model has the values of model 10 with the mean m and the covariance P
over its sensors. A few sensors are unlike the others. The values of a sensor are therefore
normally distributed about m with one of several covariances: those of the fleet, s² P with a small
s, or those of common sensors (`.partial`), with the probability `_UNLIKE`.

The poses are fitted with each of them, and the most probable one is used: the evidence of the
readings times the probability of the covariance. The readings of a sensor that is unlike the fleet
contradict the covariances of the fleet. It is then fitted as a common sensor.

A fit that needs no prior, such as a refined one, has its values x with the covariance C. They are
combined with the fleet to first order (`posterior`): x + K (m - x) with K = C (C + P)⁻¹.

The same readings could come from a usual sensor with very large noise. The noise is therefore
limited to `_LARGEST_NOISE_G`, and the probability of a noise decreases with its factor on the
stated noise. For the same reason, poses are left out as knocked only if the poses determine the
values without the fleet.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .calibration import Calibration
from .gate import gated
from .partial import partial_findings, typical_spread, usable, without_knocked
from .pose_planning import determines
from .quality import in_g, quality_of
from .rest_noise import with_rest_noise
from .unknown_orientation import copies, FLEET, only_norm, rejected_by
from ..errors import RefusedFitError
from ..estimate import LARGEST_SHARE, NotConvergedError, originals, Prior
from ..finding import Finding
from ..geometry import unit
from ..table import Floats, Poses
from ..text import counted
from ..units import Units

_LIKE = {1.0: 0.9, 2.0: 0.07, 4.0: 0.02}
"""Probability of each factor s on the spread of the fleet, for sensors that belong to it."""

_UNLIKE = {1.0: 0.008, 4.0: 0.002}
"""Probability of each factor on the spread of common sensors, for other sensors."""

_LARGEST_NOISE_G = 0.02
"""Largest error of poses that is tried [g]; larger ones are knocked poses, not noise."""

_UNLIKE_FLEET = Finding('unlike_fleet', 'the sensor is unlike the fleet, so the typical values of '
                        'the fleet are not used', 'take more poses')


@dataclass(frozen=True)
class FleetPrior:
    """
    The typical values of the sensors of one model.

    Parameters
    ----------
    model : str
        Model of the sensors; empty if it is not known.
    sensors : int
        Number of sensors that the values are from.
    prior : Prior
        Mean and covariance over the sensors.

    """

    model: str
    sensors: int
    prior: Prior


def fit_with_fleet(poses: Poses, units: Units, fleet: FleetPrior, *, sensor: str = '',
                   date: str = '') -> Calibration:
    """
    Fit model 10 with the typical values of a fleet as the prior.

    Only |force| = 1 g is used, even if the orientations are known.

    Parameters
    ----------
    poses : Poses
        Still poses, one or more, in the unit of the readings.
    units : Units
        Unit of the readings, not native.
    fleet : FleetPrior
        Typical values of sensors of the same model.
    sensor, date : str
        Name of the sensor and date, stored in the record. By default the name in the poses.

    Returns
    -------
    Calibration
        The calibration with ΔR = I and the method ``fleet``. Its covariance includes the prior.

    Raises
    ------
    InputError
        If the readings are in native units, or clearly in another unit.
    RefusedFitError
        If no row is a plausible reading at rest, or the uncertainty is too large.

    """
    sound, rejected = usable(poses, units, 'a fit with a fleet')
    poses_g = only_norm(in_g(sound, units))
    original = originals(poses_g)
    share = LARGEST_SHARE if determines('10', unit(sound.reading)) else 0.0
    found, best = None, -np.inf
    for prior, probability, unlike in _priors(fleet.prior):
        try:
            fit, kept, evidence = without_knocked(poses_g, np.unique(original), prior,
                                                  _LARGEST_NOISE_G, share)
        except NotConvergedError:  # the readings contradict this prior
            continue
        evidence += np.log(probability) - np.log(max(fit.factor or 1.0, 1.0)) / 2.0
        if evidence > best:
            found, best = (fit, kept, unlike), evidence
    if found is None:
        raise RefusedFitError('the readings contradict the values of the fleet, expected a sensor '
                              'of the same model', 'check the unit and the poses, or fit without '
                              '--prior')
    fit, kept, unlike = found
    out = rejected_by(fit.model, poses_g.take(~np.isin(original, kept)))
    calibration = Calibration(
        '10', FLEET, fit.model, units, sensor or poses.sensor, 'ros', date, fit.covariance,
        quality_of(fit, units, unit(sound.reading)[kept]), poses,
        tuple(sorted((*rejected, *out), key=lambda each: each.row)), _reason(fleet, len(kept)),
        (*(_UNLIKE_FLEET,) * unlike, *copies(original, poses_g), *partial_findings(fit)))
    return with_rest_noise(gated(calibration), poses)


def posterior(values: Floats, covariance: Floats, fleet: FleetPrior
              ) -> tuple[Floats, Floats, tuple[Finding, ...]]:
    """
    Return fitted values with the typical values of a fleet included.

    The covariance of the fleet or of common sensors is chosen that makes the values most probable.

    Parameters
    ----------
    values : (p,) array
        Values of a fit; those of model 10 come first [g].
    covariance : (p, p) array
        Their covariance, without a prior.
    fleet : FleetPrior
        Typical values of sensors of the same model.

    Returns
    -------
    (p,) array, (p, p) array, tuple of Finding
        The values, their covariance, and a finding if the sensor is unlike the fleet.

    """
    count = len(fleet.prior.mean)
    away = fleet.prior.mean - values[:count]
    found, best = None, -np.inf
    for prior, probability, unlike in _priors(fleet.prior):
        spread = covariance[:count, :count] + prior.covariance
        evidence = np.log(probability) - (
            away @ np.linalg.solve(spread, away) + np.linalg.slogdet(spread)[1]) / 2.0
        if evidence > best:
            found, best = (spread, unlike), evidence
    if found is None:
        raise RefusedFitError('the fitted values are not finite, expected numbers',
                              'check the poses for mistakes')
    spread, unlike = found
    gain = np.linalg.solve(spread, covariance[:count]).T
    left = covariance - gain @ covariance[:count]
    return values + gain @ away, (left + left.T) / 2.0, (_UNLIKE_FLEET,) * unlike


def _priors(fleet: Prior) -> list[tuple[Prior, float, bool]]:
    """Return each distribution of the values, its probability, and whether it is of others."""
    common = np.diag(typical_spread() ** 2)
    return [*((Prior(fleet.mean, fleet.covariance * spread ** 2), probability, False)
              for spread, probability in _LIKE.items()),
            *((Prior(fleet.mean, fleet.covariance + common * spread ** 2), probability, True)
              for spread, probability in _UNLIKE.items())]


def _reason(fleet: FleetPrior, count: int) -> str:
    """Return the number of poses, and the fleet."""
    name = f' of model {fleet.model}' if fleet.model else ''
    return (f'{counted(count, "pose")} with the typical values of '
            f'{counted(fleet.sensors, "sensor")}{name}')
