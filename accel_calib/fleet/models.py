# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the sensors of a fleet have in common, by model of sensor.

**Calibrations that are compared.** A calibration is compared as if its effects were known to be
right. A search in few poses sometimes names another effect than in the other recordings, and
offset and gain then differ by much more than their uncertainty. Only calibrations with the same
effects are therefore compared, those with the most frequent effects of the sensor.

**Typical values.** Each sensor has the values x of model 10 (the mean over its calibrations) with
the covariance C. Over the fleet, x is distributed about m with P + C. `estimated` computes m and P
by expectation maximisation. The distribution over sensors is Student's t, so that a few sensors
unlike the others have little weight.

The correlations of few sensors are mostly chance, and would make some combinations of values seem
certain. They are reduced by n / (n + `_CHANCE`). The mean of n sensors is uncertain itself, which
adds P / n to the covariance for another sensor. At last P is enlarged, if necessary, until half of
the sensors are within the distance that contains half of a normal distribution.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from .store import Row
from ..calibrate import FleetPrior
from ..effects import LADDER, MODELS, parameter_names
from ..estimate import Prior
from ..table import Floats


def alike(rows: Iterable[Row]) -> list[Row]:
    """
    Return the rows of a sensor whose values can be compared.

    Left out are recordings without a calibration, those whose poses do not determine offset, gain
    and cross-axis gain, and those without the most frequent effects. Models 4, 7 and 10 are alike,
    because `accel_calib.compare` compares them with the uncertainty of the largest one.

    Parameters
    ----------
    rows : iterable of dict
        Rows with ``calibration``, ``determined`` and ``effects``.

    Returns
    -------
    list of dict
        The rows that are left, in the same order.

    """
    good = [row for row in rows if row['calibration'] and row['determined']]
    most = next((kind for kind, _ in Counter(map(_kind, good)).most_common(1)), None)
    return [row for row in good if _kind(row) == most]


def _kind(row: Row) -> frozenset[str]:
    """Return the effects of a calibration; none if it has only those of models 4, 7 and 10."""
    effects = frozenset(row['effects'])
    return effects if effects - {*LADDER} else frozenset()


FEWEST = 5
"""Smallest number of sensors of a model whose typical values are computed."""

PRIOR_FILE = 'fleet.yaml'

PRIOR_COLUMNS = ('sensor_model', 'prior_values', 'prior_covariance')
"""Columns of the rows of recordings that `priors_of` needs, beside the sensor."""

_CHANCE = 50.0

_DOF = 4.0
"""Degrees of freedom of the distribution over sensors; few give odd sensors little weight."""

_STEPS = 200
_CONVERGED = 1e-8
_NAMES = parameter_names(MODELS['10'].effects)
_LEAST_SPREAD_G = 1e-5
"""Smallest spread over sensors [g], far below that of any sensors."""


def priors_of(rows: Iterable[Row]) -> dict[str, FleetPrior]:
    """
    Return the typical values by model of sensor.

    Parameters
    ----------
    rows : iterable of dict
        Rows of recordings with ``sensor``, ``sensor_model``, ``prior_values`` and
        ``prior_covariance``; rows without values are left out.

    Returns
    -------
    dict of str to FleetPrior
        Models with at least `FEWEST` sensors.

    """
    size, sums = len(_NAMES), dict[tuple[str, str], list[Any]]()
    for row in rows:
        if row['prior_values']:
            known = sums.setdefault((row['sensor_model'] or '', row['sensor']), [0, 0.0, 0.0])
            known[0] += 1
            known[1] = known[1] + np.array(row['prior_values'])
            known[2] = known[2] + np.array(row['prior_covariance']).reshape(size, size)
    found = {}
    for model in sorted({model for model, _ in sums}):
        chosen = [each for (name, _), each in sums.items() if name == model]
        if len(chosen) >= FEWEST:
            values = np.array([total / count for count, total, _ in chosen])
            covariances = np.array([total / count ** 2 for count, _, total in chosen])
            found[model] = FleetPrior(model, len(chosen), estimated(values, covariances))
    return found


def estimated(values: Floats, covariances: Floats) -> Prior:
    """
    Return mean and covariance over sensors.

    Parameters
    ----------
    values : (n, p) array
        Values of n sensors.
    covariances : (n, p, p) array
        Their covariances.

    Returns
    -------
    Prior
        Mean and covariance for another sensor of the fleet.

    """
    from scipy.special import chdtri

    count, size = values.shape
    mean = np.median(values, axis=0)
    spread = np.median(np.abs(values - mean), axis=0) / 0.6745 + _LEAST_SPREAD_G
    covariance: Floats = np.diag(spread ** 2)
    for _ in range(_STEPS):
        before = covariance
        mean, covariance = _step(values, covariances, mean, covariance)
        if np.max(np.abs(covariance - before)) <= _CONVERGED * np.max(covariance):
            break
    share = count / (count + _CHANCE)
    shrunk = share * covariance + (1.0 - share) * np.diag(np.diag(covariance))
    shrunk = (shrunk + _LEAST_SPREAD_G ** 2 * np.eye(size)) * (1.0 + 1.0 / count)
    median = float(np.median(_squared(values - mean, shrunk + covariances)))
    return Prior(mean, shrunk * max(median / chdtri(size, 0.5), 1.0))


def _squared(away: Floats, covariances: Floats) -> Floats:
    """Return the (n,) squared distances, per (n, p, p) covariance."""
    solved = np.linalg.solve(covariances, away[:, :, np.newaxis])[:, :, 0]
    return np.einsum('np,np->n', away, solved)


def _step(values: Floats, covariances: Floats, mean: Floats, covariance: Floats
          ) -> tuple[Floats, Floats]:
    """Return mean and covariance after a step of expectation maximisation."""
    away = values - mean
    gain = covariance @ np.linalg.inv(covariance + covariances)  # (n, p, p)
    likely = np.einsum('npq,nq->np', gain, away)
    weight = (_DOF + values.shape[1]) / (_DOF + _squared(away, covariance + covariances))
    left = covariance - gain @ covariance
    centre = mean + weight @ likely / np.sum(weight)
    off = mean + likely - centre
    spread = np.einsum('n,np,nq->pq', weight, off, off) + np.sum(left, axis=0)
    return centre, (spread + spread.T) / (2.0 * len(values))
