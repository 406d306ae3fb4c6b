# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Whether calibrations of one sensor agree within their uncertainties.

Each calibration i has parameters x_i that do not depend on its axes
(`accel_calib.calibrate.rotation_free`) with covariance C_i
(`accel_calib.calibrate.common_scale`). If they are all of one sensor, contrasts of the x_i, such
as their differences, are normal about zero with the covariance K diag(C_i) Kᵀ, and

    T² = dᵀ (K diag(C_i) Kᵀ)⁺ d,   d = K x

over its rank has an F distribution with the degrees of freedom of the noise. A parameter that a
model leaves out is known to it without doubt: where another model finds that it is not zero, the
two do not agree. Beside T², which looks in all directions at once, each parameter of each run is
held against the mean of the other runs (Student's t), for a change of one parameter alone. The
smaller of the two probabilities counts, twice for there being two, and for the number of
parameters (Bonferroni). The run without which T² falls most is the one that differs.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .alike import contexts_of, notes_of, refuse_if_unlike
from .calibration import Calibration
from .common_scale import on_one_scale
from .likelihood import norm_jacobian
from .rotation_free import rotation_free, RotationFree
from ..effects import Context
from ..model import sensor_force
from ..sphere import spread_directions
from ..table import Floats
from ..units import MG

LEVEL = 0.03
"""Calibrations that agree are said not to in at most this share of the cases."""

_DIRECTIONS = spread_directions(300)
_SAME_G = 1e-7
"""Differences below this are none; to this a parameter is known that a model leaves out."""

_NO_SPREAD = 1e-10
"""A variance this much below the largest is none."""


@dataclass(frozen=True)
class Parameter:
    """
    One parameter over the runs.

    Parameters
    ----------
    name : str
        ``offset.x``, ``gain.xy``, …: of V, and of the symmetric gain.
    values, stated_sd : (n,) array
        Of each run [g].
    spread : float
        Standard deviation over the runs [g].
    ratio : float or None
        The spread over the stated deviation, RMS; None where that is zero.

    """

    name: str
    values: Floats
    stated_sd: Floats
    spread: float
    ratio: float | None


@dataclass(frozen=True)
class Run:
    """
    One calibration against the others.

    Parameters
    ----------
    rms_mg, expected_mg : float
        Difference of the corrected |a| to the mean of the others, RMS over all directions, and
        what the uncertainties lead one to expect [mg].
    largest_mg : float
        The largest such difference [mg].
    direction : (3,) array
        Where that is: what points up, in the axes of the sensor.
    p_value : float
        Probability of a difference as large, if this run is like the others.

    """

    rms_mg: float
    expected_mg: float
    largest_mg: float
    direction: Floats
    p_value: float


@dataclass(frozen=True)
class Comparison:
    """
    Whether calibrations agree.

    Parameters
    ----------
    agree : bool
        Whether they do, at `LEVEL`.
    p_value : float
        Probability of differences as large, if they are of one sensor that has not changed.
    chi2 : float
        T², the squared differences over their variances.
    dof : int
        What T² is on average, if they agree.
    outlier : int or None
        The one run without which the others agree, from 0.
    runs : tuple of Run
        Each against the others.
    parameters : tuple of Parameter
        Spread over the runs.
    tilt_deg : float or None
        Largest angle between what two levelled runs take for up [°]; None with fewer than two.
    notes : tuple of str
        What else to know.

    """

    agree: bool
    p_value: float
    chi2: float
    dof: int
    outlier: int | None
    runs: tuple[Run, ...]
    parameters: tuple[Parameter, ...]
    tilt_deg: float | None
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Runs:
    """Runs in common parameters: (n, t) values, (n, t, t) covariances, dof of the noise."""

    values: Floats
    covariances: Floats
    dof: float

    def without(self, run: int) -> _Runs:
        """Give the others."""
        return _Runs(np.delete(self.values, run, 0), np.delete(self.covariances, run, 0),
                     self.dof)

    @property
    def squared(self) -> tuple[float, int]:
        """T² and its rank: differences over their variances, in all directions at once."""
        count = len(self.values)
        contrasts = np.linalg.svd(np.ones((1, count)))[2][1:]
        away = (contrasts @ self.values).ravel()
        covariance = np.einsum('ai,irs,bi->arbs', contrasts, self.covariances, contrasts)
        variances, vectors = np.linalg.eigh(covariance.reshape(away.size, away.size))
        along = vectors.T @ away
        vary = variances > _NO_SPREAD * max(float(np.max(variances, initial=0.0)), 1e-300)
        if np.linalg.norm(along[~vary]) > _SAME_G:
            return np.inf, int(np.sum(vary))
        return float(np.sum(along[vary] ** 2 / variances[vary])), int(np.sum(vary))

    @property
    def least(self) -> Floats:
        """(n,) array, the probability of the parameter of each run that is off the most."""
        from scipy.special import stdtr

        variance = np.maximum(np.diagonal(self.covariances, axis1=1, axis2=2), 0.0) + _SAME_G ** 2
        weight = 1.0 / variance
        others = np.sum(weight, axis=0) - weight
        mean = (np.sum(weight * self.values, axis=0) - weight * self.values) / others
        sizes = np.abs(self.values - mean) / np.sqrt(variance + 1.0 / others)
        number = np.sum(np.any(variance > 4.0 * _SAME_G ** 2, axis=0))
        least: Floats = 2.0 * stdtr(self.dof, -np.max(sizes, axis=1)) * max(number, 1)
        return least

    @property
    def p_value(self) -> float:
        """Probability of differences as large, if the runs agree."""
        count = len(self.values)
        tests = 1 if count == 2 else count
        return _either(_beyond(*self.squared, self.dof), float(np.min(self.least)) * tests)


def _beyond(chi2: float, rank: int, dof: float) -> float:
    """Give the probability that T² of this rank is as large."""
    from scipy.special import chdtrc, fdtrc

    if rank == 0 or not np.isfinite(chi2):
        return 1.0 if np.isfinite(chi2) else 0.0
    return float(chdtrc(rank, chi2) if np.isinf(dof) else fdtrc(rank, dof, chi2 / rank))


def _either(first: float, second: float) -> float:
    return min(1.0, 2.0 * min(first, second))


def compare(calibrations: Sequence[Calibration]) -> Comparison:
    """
    Say whether calibrations of one sensor agree within their uncertainties.

    Parameters
    ----------
    calibrations : sequence of Calibration
        Two or more, of any models.

    Returns
    -------
    Comparison
        The answer, with what differs by how much.

    Raises
    ------
    InputError
        If they cannot be compared: fewer than two, other sensors, other units, no uncertainty.

    """
    refuse_if_unlike(calibrations)
    contexts = contexts_of(calibrations)
    per_g = float(np.mean([run.units.per_g for run in calibrations]))
    free = [rotation_free(run, context, per_g)
            for run, context in zip(calibrations, contexts, strict=True)]
    names = tuple(dict.fromkeys(name for run in free for name in run.names))
    spread = on_one_scale(calibrations)
    values = np.array([_into(names, run, run.values) for run in free])
    runs = _Runs(values, np.array([_covariance(names, run, covariance) for run, covariance
                                   in zip(free, spread.covariances, strict=True)]), spread.dof)
    stated = np.sqrt([np.maximum(np.diag(_covariance(names, run, calibration.covariance)), 0.0)
                      for run, calibration in zip(free, calibrations, strict=True)])
    chi2, rank = runs.squared
    p_value = runs.p_value
    return Comparison(
        p_value >= LEVEL, p_value, chi2, rank, _outlier(runs) if p_value < LEVEL else None,
        _each(calibrations, contexts, spread.covariances, free, _p_values(runs)),
        tuple(_parameter(*column) for column in zip(names, values.T, stated.T, strict=True)),
        _tilt_deg(calibrations, free), notes_of(calibrations, names, stated, spread.noisier))


def _into(names: tuple[str, ...], run: RotationFree, rows: Floats) -> Floats:
    """Give (t, …) rows in the order of the common names; those that a run lacks are zero."""
    found = np.zeros((len(names), *rows.shape[1:]))
    found[[names.index(name) for name in run.names]] = rows
    return found


def _covariance(names: tuple[str, ...], run: RotationFree, covariance: Floats) -> Floats:
    slope = _into(names, run, run.slope)
    carried: Floats = slope @ covariance @ slope.T
    return carried


def _p_values(runs: _Runs) -> Floats:
    """Give the probability, for each run, of its differences to the others."""
    if len(runs.values) == 2:
        return np.full(2, runs.p_value)
    chi2, rank = runs.squared
    found = []
    for k, least in enumerate(runs.least):
        others, others_rank = runs.without(k).squared
        found.append(_either(_beyond(chi2 - others, rank - others_rank, runs.dof), float(least)))
    return np.array(found)


def _outlier(runs: _Runs) -> int | None:
    """Find the one run without which the others agree."""
    if len(runs.values) == 2:
        return None
    left = [runs.without(k) for k in range(len(runs.values))]
    best = int(np.argmin([others.squared[0] for others in left]))
    return best if left[best].p_value >= LEVEL else None


def _parameter(name: str, values: Floats, stated: Floats) -> Parameter:
    spread, typical = float(np.std(values, ddof=1)), float(np.sqrt(np.mean(stated ** 2)))
    return Parameter(name, values, stated, spread, spread / typical if typical > 0.0 else None)


def _each(calibrations: Sequence[Calibration], contexts: Sequence[Context],
          covariances: Sequence[Floats], free: Sequence[RotationFree], p_values: Floats
          ) -> tuple[Run, ...]:
    """Compare the corrected |a| of each run with that of the others, over all directions."""
    reading = (np.mean([run.vec_v for run in free], axis=0)
               + _DIRECTIONS @ np.mean([run.mat_s for run in free], axis=0))
    told = [_length(*one, reading) for one in
            zip(calibrations, contexts, covariances, free, strict=True)]
    length, variance = (np.array(part) for part in zip(*told, strict=True))
    weight = 1.0 / (np.mean(variance, axis=1) + _SAME_G ** 2)
    runs = []
    for k, p_value in enumerate(p_values):
        others = np.delete(weight, k) / np.sum(np.delete(weight, k))
        away = length[k] - others @ np.delete(length, k, 0)
        expected = variance[k] + others ** 2 @ np.delete(variance, k, 0)
        largest = int(np.argmax(np.abs(away)))
        runs.append(Run(_rms(away) * MG, _rms(np.sqrt(expected)) * MG,
                        float(np.abs(away[largest])) * MG, _DIRECTIONS[largest], float(p_value)))
    return tuple(runs)


def _length(calibration: Calibration, context: Context, covariance: Floats, free: RotationFree,
            reading: Floats) -> tuple[Floats, Floats]:
    """Give the corrected |a| of (n, 3) readings in the common unit and its variance, (n,) each."""
    model = calibration.model
    here = {key: np.repeat(column, len(reading), 0) for key, column in context.items()}
    u = sensor_force(model, reading / free.reading_scale, here)
    rows = norm_jacobian(model, u, here)
    variance = np.maximum(np.einsum('np,pq,nq->n', rows, covariance, rows), 0.0)
    return np.linalg.norm(u, axis=1) * free.force_scale, variance * free.force_scale ** 2


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values ** 2)))


def _tilt_deg(calibrations: Sequence[Calibration], free: Sequence[RotationFree]) -> float | None:
    """Give the largest angle between what levelled runs take for up [°]."""
    up = [run.axes[:, 2] for run, calibration in zip(free, calibrations, strict=True)
          if not np.array_equal(calibration.model.rotation, np.eye(3))]
    if len(up) < 2:
        return None
    apart = np.linalg.norm(np.array(up)[:, np.newaxis] - np.array(up), axis=2)
    return float(np.degrees(2.0 * np.arcsin(np.max(apart) / 2.0)))
