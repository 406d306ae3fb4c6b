# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Comparison of calibrations of one sensor, to test whether they agree within uncertainties.

The test is applied to parameters that do not depend on the axes
(`.parameters`), with covariances on a common scale.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from .comparable import Comparable, comparable
from .parameters import (
    LEVEL,
    on_one_scale,
    outlier,
    p_values,
    rotation_free,
    RotationFree,
    Runs,
    SAME_G,
)
from ..calibrate import Calibration
from ..effects import Context, length_rows, sensor_force
from ..geometry import OVER_THE_SPHERE
from ..table import Floats
from ..text import counted, listed
from ..units import MG

_COMMON = ('temperature', 'supply_voltage')
"""Context that is set to the same value for all runs; other context is specific to a run."""

_WARMER = 5.0
"""Difference of temperature between runs that causes a note [°C]."""


def _contexts_of(calibrations: Sequence[Calibration]) -> tuple[Context, ...]:
    """Return the context for the comparison of each run, one row each."""
    common = {key: np.array([np.mean([np.median(run.poses[key]) for run in calibrations
                                      if key in run.poses])])
              for key in _COMMON if any(key in run.poses for run in calibrations)}
    return tuple({**_own_context(run), **common} for run in calibrations)


def _own_context(run: Calibration) -> Context:
    """Return the median context of a run, with zero rate and without a previous pose."""
    context: dict[str, Floats] = {'rate': np.zeros((1, 3)), 'previous': np.zeros((1, 3))}
    if 'time' in run.poses:
        context['time'] = np.array([np.median(run.poses['time'])])
    if 'std' in run.poses:
        context['std'] = run.units.to_g(np.median(run.poses['std'], axis=0))[np.newaxis]
    return context


def _notes_of(given: Sequence[Comparable], names: tuple[str, ...], deviation: Floats,
              noisier: Sequence[int]) -> tuple[str, ...]:
    """
    Return notes that limit the meaning of a comparison.

    Parameters
    ----------
    given : sequence of Comparable
        The runs.
    names : tuple of str
        Names of the t common parameters.
    deviation : (n, t) array
        Standard deviations of the parameters; 0 if the model of a run omits the parameter.
    noisier : sequence of int
        Indices of runs whose poses repeat worse than those of the others.

    """
    calibrations = [run.calibration for run in given]
    smaller = [f'run {k} (model {run.calibration.name}) omits parameters of model '
               f'{run.sure.name}: they are taken as zero, with the uncertainty that its poses '
               'allow'
               for k, run in enumerate(given, 1) if run.calibration is not run.sure]
    return (*_shared(calibrations), *smaller, *_left_out(names, deviation),
            *_temperatures(calibrations),
            *(f'the poses of run {k + 1} repeat significantly worse than those of the others: the '
              'run has less weight' for k in noisier))


def _shared(calibrations: Sequence[Calibration]) -> list[str]:
    """Return notes about runs with common poses."""
    rows = [{tuple(row) for row in (run.poses.reading / run.force_per_g).round(7).tolist()}
            for run in calibrations]
    notes = []
    for (i, first), (j, second) in combinations(enumerate(rows, 1), 2):
        common, least = len(first & second), min(len(first), len(second))
        if common:
            what = 'all their poses' if common == least else counted(common, 'pose')
            notes.append(f'runs {i} and {j} share {what}: they are not independent, so their '
                         'agreement means little')
    return notes


def _left_out(names: tuple[str, ...], deviation: Floats) -> list[str]:
    """Return notes about parameters that only some of the models have."""
    notes: dict[tuple[int, ...], list[str]] = {}
    for name, column in zip(names, deviation.T, strict=True):
        without = tuple((np.flatnonzero(column == 0.0) + 1).tolist())
        if 0 < len(without) < len(column):
            notes.setdefault(without, []).append(name)
    return [f'the model of {listed("run", runs)} omits {", ".join(found)} and so assumes zero; '
            'for an equal comparison, fit all runs with one model'
            for runs, found in notes.items() if found]


def _temperatures(calibrations: Sequence[Calibration]) -> list[str]:
    """Return a note if the temperatures differ and some runs do not correct for temperature."""
    known = [float(np.median(run.poses['temperature'])) for run in calibrations
             if 'temperature' in run.poses]
    if len(known) < 2 or max(known) - min(known) < _WARMER or all(
            'temperature' in run.model.needs for run in calibrations):
        return []
    return [f'the poses were taken at {min(known):.0f} to {max(known):.0f} °C, and not all runs '
            'correct for temperature: this can cause differences']


@dataclass(frozen=True)
class Parameter:
    """
    Values of one parameter over the runs.

    Parameters
    ----------
    name : str
        ``offset.x``, ``gain.xy``, …: entries of V, and of the symmetric gain.
    values, stated_sd : (n,) array
        Value and stated standard deviation in each run [g].
    spread : float
        Standard deviation over the runs [g].
    ratio : float or None
        Spread over the stated standard deviation (RMS); None if the latter is zero.

    """

    name: str
    values: Floats
    stated_sd: Floats
    spread: float
    ratio: float | None


@dataclass(frozen=True)
class Run:
    """
    One calibration compared with the others.

    Parameters
    ----------
    rms_mg, expected_mg : float
        Difference of the corrected |a| from the mean of the others, RMS over all directions, and
        the same as predicted from the uncertainties [mg].
    largest_mg : float
        Largest difference over all directions [mg].
    direction : (3,) array
        Direction of up, in the sensor axes, where the difference is largest.
    p_value : float
        Probability of a difference at least this large, if this run agrees with the others.

    """

    rms_mg: float
    expected_mg: float
    largest_mg: float
    direction: Floats
    p_value: float


@dataclass(frozen=True)
class Comparison:
    """
    The result of a comparison.

    Parameters
    ----------
    agree : bool
        Whether the calibrations agree, at `LEVEL`.
    p_value : float
        Probability of differences at least this large, if the sensor has not changed.
    chi2 : float
        T², the squared differences over their variances.
    dof : int
        Expected value of T², if the calibrations agree.
    outlier : int or None
        Index of the run without which the others agree, 0-based.
    runs : tuple of Run
        Each run compared with the others.
    parameters : tuple of Parameter
        Spread of each parameter over the runs.
    tilt_deg : float or None
        Largest angle between the directions of up of levelled runs [°]; None with fewer than two.
    notes : tuple of str
        Notes that limit the meaning of the comparison.

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
class _Run:
    """A calibration, its fit with the largest model, its context and rotation-free parameters."""

    calibration: Calibration
    sure: Calibration
    context: Context
    free: RotationFree
    slope: Floats
    covariance: Floats

    def length(self, reading: Floats) -> tuple[Floats, Floats]:
        """Return the corrected |a| of (n, 3) readings and its variance, in the common unit."""
        here = {key: np.repeat(column, len(reading), 0) for key, column in self.context.items()}
        u = sensor_force(self.calibration.model, reading / self.free.reading_scale, here)
        model = self.sure.model
        rows = model.basis(u, here).along(length_rows(model, u, here))
        variance = np.maximum(np.einsum('np,pq,nq->n', rows, self.covariance, rows), 0.0)
        scale = self.free.force_scale
        return np.linalg.norm(u, axis=1) * scale, variance * scale ** 2

    def spread(self, names: tuple[str, ...], covariance: Floats) -> Floats:
        """Return the (t, t) covariance of the common parameters."""
        slope = _into(names, self.free, self.slope)
        carried: Floats = slope @ covariance @ slope.T
        return carried


def compare(calibrations: Sequence[Calibration]) -> Comparison:
    """
    Test whether calibrations of one sensor agree within their uncertainties.

    Parameters
    ----------
    calibrations : sequence of Calibration
        Two or more calibrations with any models.

    Returns
    -------
    Comparison
        The result of the test, with the differences.

    Raises
    ------
    InputError
        If there are fewer than two, their sensors differ, some are in native units and others
        not, or one has no uncertainty.

    """
    return compared(comparable(calibrations))


def compared(given: Sequence[Comparable]) -> Comparison:
    """
    Test whether prepared calibrations agree within their uncertainties.

    Parameters
    ----------
    given : sequence of Comparable
        Two or more of those that `comparable` returned.

    Returns
    -------
    Comparison
        The result of the test, with the differences.

    """
    scaled = on_one_scale([run.scatter for run in given])
    prepared = _prepared(given, scaled.covariances)
    names = tuple(dict.fromkeys(name for run in prepared for name in run.free.names))
    values = np.array([_into(names, run.free, run.free.values) for run in prepared])
    runs = Runs(values, np.array([run.spread(names, run.covariance) for run in prepared]),
                scaled.dof)
    stated = np.sqrt(np.maximum([np.diag(run.spread(names, run.sure.covariance))
                                 for run in prepared], 0.0))
    (chi2, rank), p_value = runs.squared, runs.p_value
    return Comparison(
        p_value >= LEVEL, p_value, chi2, rank, outlier(runs) if p_value < LEVEL else None,
        _each(prepared, p_values(runs)),
        tuple(_parameter(*column) for column in zip(names, values.T, stated.T, strict=True)),
        _tilt_deg(prepared), _notes_of(given, names, stated, scaled.noisier))


def _prepared(given: Sequence[Comparable], covariances: Sequence[Floats]) -> list[_Run]:
    """Return each calibration with its context and parameters in the common unit."""
    calibrations = [run.calibration for run in given]
    per_g = float(np.mean([run.units.per_g for run in calibrations]))
    found = []
    for run, context, covariance in zip(given, _contexts_of(calibrations), covariances,
                                        strict=True):
        free = rotation_free(run.calibration, context, per_g)
        slope = free.slope if run.sure is run.calibration else rotation_free(
            run.sure, context, per_g).slope
        found.append(_Run(run.calibration, run.sure, context, free, slope, covariance))
    return found


def _into(names: tuple[str, ...], run: RotationFree, rows: Floats) -> Floats:
    """Return (t, …) rows in the order of the common names; missing rows are zero."""
    found = np.zeros((len(names), *rows.shape[1:]))
    found[[names.index(name) for name in run.names]] = rows
    return found


def _parameter(name: str, values: Floats, stated: Floats) -> Parameter:
    spread, typical = float(np.std(values, ddof=1)), float(np.sqrt(np.mean(stated ** 2)))
    return Parameter(name, values, stated, spread, spread / typical if typical > 0.0 else None)


def _each(prepared: Sequence[_Run], chances: Floats) -> tuple[Run, ...]:
    """Compare the corrected |a| of each run with that of the others, over all directions."""
    reading = (np.mean([run.free.vec_v for run in prepared], axis=0)
               + OVER_THE_SPHERE @ np.mean([run.free.mat_s for run in prepared], axis=0))
    found = [run.length(reading) for run in prepared]
    length, variance = (np.array(part) for part in zip(*found, strict=True))
    weight = 1.0 / (np.mean(variance, axis=1) + SAME_G ** 2)
    runs = []
    for k, chance in enumerate(chances):
        others = np.delete(weight, k) / np.sum(np.delete(weight, k))
        away = length[k] - others @ np.delete(length, k, 0)
        expected = variance[k] + others ** 2 @ np.delete(variance, k, 0)
        largest = int(np.argmax(np.abs(away)))
        runs.append(Run(_rms(away) * MG, _rms(np.sqrt(expected)) * MG,
                        float(np.abs(away[largest])) * MG, OVER_THE_SPHERE[largest],
                        float(chance)))
    return tuple(runs)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values ** 2)))


def _tilt_deg(prepared: Sequence[_Run]) -> float | None:
    """Return the largest angle between the directions of up of levelled runs [°]."""
    up = [run.free.axes[:, 2] for run in prepared
          if not np.array_equal(run.calibration.model.rotation, np.eye(3))]
    if len(up) < 2:
        return None
    apart = np.linalg.norm(np.array(up)[:, np.newaxis] - np.array(up), axis=2)
    return float(np.degrees(2.0 * np.arcsin(np.max(apart) / 2.0)))
