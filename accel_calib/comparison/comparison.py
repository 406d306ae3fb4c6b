# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Comparison of calibrations of one sensor, also in order of their dates.

The test of `.agreement` is applied in one unit and one context for all calibrations. So a change
of the temperature between two dates does not appear as a change of the sensor, if the calibrations
contain its effect.

"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from itertools import combinations, pairwise

import numpy as np

from .agreement import (
    Comparable, comparable, ENTRIES, LEVEL, on_one_scale, outlier, p_values, rotation_free,
    RotationFree, Runs, SAME_G)
from ..calibration import Calibration
from ..effects import Context, length_rows, sensor_force
from ..errors import InputError
from ..finding import has
from ..geometry import OVER_THE_SPHERE
from ..statistics import rms
from ..text import counted, listed
from ..units import Floats, MG

_COMMON = ('temperature', 'supply_voltage')
"""Context that has one value for all runs, as quantities have; other context is that of a run."""

_WARMER = 5.0
"""Difference of temperature between runs that causes a note [°C]."""


def _notes_of(given: Sequence[Comparable], names: tuple[str, ...], deviation: Floats,
              noisier: Sequence[int]) -> Iterator[str]:
    """Yield notes that limit the meaning; the (n, t) deviation is 0 where a model omits one."""
    calibrations = [run.calibration for run in given]
    rows = [{tuple(row) for row in (run.poses.reading / run.force_per_g).round(7).tolist()}
            for run in calibrations]
    for (i, first), (j, second) in combinations(enumerate(rows, 1), 2):
        common, least = len(first & second), min(len(first), len(second))
        if common:
            what = 'all their poses' if common == least else counted(common, 'pose')
            yield (f'runs {i} and {j} share {what}: they are not independent, so their agreement '
                   'means little')
    for k, run in enumerate(given, 1):
        if run.calibration is not run.sure:
            yield (f'run {k} (model {run.calibration.name}) omits parameters of model '
                   f'{run.sure.name}: they are taken as zero, with the uncertainty that its poses '
                   'allow')
    omitted: dict[tuple[int, ...], list[str]] = {}
    for name, column in zip(names, deviation.T, strict=True):
        without = tuple((np.flatnonzero(column == 0.0) + 1).tolist())
        if 0 < len(without) < len(column):
            omitted.setdefault(without, []).append(name)
    for runs, found in omitted.items():
        yield (f'the model of {listed("run", runs)} omits {", ".join(found)} and so assumes zero; '
               'for an equal comparison, fit all runs with one model')
    yield from _notes_of_context(calibrations)
    yield from (f'the file of run {k} was edited by hand since it was stored'
                for k, run in enumerate(calibrations, 1) if has(run.noted, 'edited'))
    for k in noisier:
        yield (f'the poses of run {k + 1} repeat significantly worse than those of the others: '
               'the run has less weight')


def _notes_of_context(calibrations: Sequence[Calibration]) -> Iterator[str]:
    known = [float(np.median(run.poses['temperature'])) for run in calibrations
             if 'temperature' in run.poses]
    corrected = all('temperature' in run.model.needs for run in calibrations)
    if len(known) >= 2 and not max(known) - min(known) < _WARMER and not corrected:
        yield (f'the poses were taken at {min(known):.0f} to {max(known):.0f} °C, and not all '
               'runs correct for temperature: this can cause differences')
    for key in _COMMON:
        unknown = [k for k, run in enumerate(calibrations, 1) if key not in run.poses]
        if unknown and any(key in run.model.needs for run in calibrations):
            yield (f'the {key.replace("_", " ")} of the poses of {listed("run", unknown)} is not '
                   'known, and other runs correct for it: this can cause differences')


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

    @property
    def tilt_words(self) -> str:
        """Return `tilt_deg` as one line; empty if it is not known."""
        return '' if self.tilt_deg is None else (
            'the directions of up of levelled calibrations differ by up to '
            f'{self.tilt_deg:.3g}°; the test does not use them')


def compare(calibrations: Sequence[Calibration]) -> Comparison:
    """
    Test whether two or more calibrations of one sensor agree within their uncertainties.

    Raises
    ------
    InputError
        If there are fewer than two, their sensors differ, some are in native units and others
        not, or one has no uncertainty.

    """
    return compare_runs(comparable(calibrations))


def compare_runs(given: Sequence[Comparable]) -> Comparison:
    """Test whether calibrations that were prepared together agree, two or more of them."""
    scaled = on_one_scale([run.repeatability for run in given])
    prepared = _prepare(given)
    names = tuple(dict.fromkeys(name for _, free in prepared for name in free.names))
    values = np.zeros((len(given), len(names)))  # of missing parameters, too
    spreads = np.zeros((2, len(given), len(names), len(names)))  # on one scale, and as stated
    for k, (run, (_, free)) in enumerate(zip(given, prepared, strict=True)):
        place = [names.index(name) for name in free.names]
        values[k, place] = free.values
        for which, covariance in enumerate((scaled.covariances[k], run.sure.covariance)):
            spreads[which, k][np.ix_(place, place)] = free.slope @ covariance @ free.slope.T
    runs = Runs(values, spreads[0], scaled.dof)
    stated = np.sqrt(np.maximum(np.diagonal(spreads[1], axis1=1, axis2=2), 0.0))
    (chi2, rank), p_value = runs.squared, runs.p_value
    parameters = []
    for name, column, sds in zip(names, values.T, stated.T, strict=True):
        size, typical = float(np.std(column, ddof=1)), rms(sds)
        parameters.append(Parameter(name, column, sds, size,
                                    size / typical if typical > 0.0 else None))
    up = np.array([free.axes[:, 2] for run, (_, free) in zip(given, prepared, strict=True)
                   if run.calibration.is_levelled])
    tilt_deg = None
    if len(up) > 1:
        apart = np.max(np.linalg.norm(up[:, np.newaxis] - up, axis=2))
        tilt_deg = float(np.degrees(2.0 * np.arcsin(apart / 2.0)))
    return Comparison(
        agree=p_value >= LEVEL, p_value=p_value, chi2=chi2, dof=rank,
        outlier=outlier(runs) if p_value < LEVEL else None,
        runs=_compare_each(given, prepared, scaled.covariances, p_values(runs)),
        parameters=tuple(parameters), tilt_deg=tilt_deg,
        notes=tuple(_notes_of(given, names, stated, scaled.noisier)))


def _prepare(given: Sequence[Comparable]) -> Sequence[tuple[Context, RotationFree]]:
    """
    Return the context of each run, and its parameters in the common unit.

    The context is one row: medians over the poses, and no motion. The slope of the parameters is
    that of the largest model.

    """
    calibrations = [run.calibration for run in given]
    per_g = float(np.mean([run.units.per_g for run in calibrations]))
    known = [{*run.poses.quantities, *_COMMON} & {*run.poses.columns} for run in calibrations]
    common = {key: np.array([np.mean([np.nanmedian(run.poses[key]) for run, own in zip(
        calibrations, known, strict=True) if key in own])]) for key in set[str]().union(*known)}
    found = []
    for run in given:
        poses, still = run.calibration.poses, np.zeros((1, 3))
        context: dict[str, Floats] = {'rate': still, 'previous': still, **common}
        if 'time' in poses:
            context['time'] = np.array([np.median(poses['time'])])
        if 'std' in poses:
            std = np.median(poses['std'], axis=0)
            context['std'] = run.calibration.units.to_g(std)[np.newaxis]
        found.append((context, replace(rotation_free(run.calibration, context, per_g),
                                       slope=rotation_free(run.sure, context, per_g).slope)))
    return found


def _compare_each(given: Sequence[Comparable], prepared: Sequence[tuple[Context, RotationFree]],
                  covariances: Sequence[Floats], chances: Floats) -> tuple[Run, ...]:
    """Compare the corrected |a| of each run with that of the others, over all directions."""
    mean, mat_s = np.mean([free.values[:9] for _, free in prepared], axis=0), np.zeros((3, 3))
    mat_s[ENTRIES] = mat_s.T[ENTRIES] = mean[3:]
    reading = mean[:3] + OVER_THE_SPHERE @ mat_s
    length, variance = np.empty((2, len(prepared), len(reading)))  # in the common unit
    for k, (run, (context, free)) in enumerate(zip(given, prepared, strict=True)):
        here = {key: np.repeat(column, len(reading), 0) for key, column in context.items()}
        u = sensor_force(run.calibration.model, reading / free.reading_scale, here)
        rows = run.sure.model.basis(u, here).along(length_rows(run.sure.model, u, here))
        spread = np.maximum(np.einsum('np,pq,nq->n', rows, covariances[k], rows), 0.0)
        length[k] = np.linalg.norm(u, axis=1) * free.force_scale
        variance[k] = spread * free.force_scale ** 2
    weight = 1.0 / (np.mean(variance, axis=1) + SAME_G ** 2)
    runs = []
    for k, chance in enumerate(chances):
        others = np.delete(weight, k) / np.sum(np.delete(weight, k))
        away = length[k] - others @ np.delete(length, k, 0)
        expected = variance[k] + others ** 2 @ np.delete(variance, k, 0)
        largest = int(np.argmax(np.abs(away)))
        runs.append(Run(rms(away) * MG, rms(np.sqrt(expected)) * MG,
                        float(np.abs(away[largest])) * MG, OVER_THE_SPHERE[largest],
                        float(chance)))
    return tuple(runs)


@dataclass(frozen=True)
class Moment:
    """
    One calibration of a history, with its index among those given, 0-based.

    The date is in UTC, and the temperature [°C] is the median over the poses used; None if not
    known.

    """

    index: int
    when: datetime | None
    model: str
    temperature: float | None
    residual_mg: float


@dataclass(frozen=True)
class DatedChange:
    """
    The comparison of two successive calibrations.

    `parameter` is the one that changed most, relative to the stated standard deviation `sd` of the
    change [g].

    """

    comparison: Comparison
    parameter: str
    change: float
    sd: float


@dataclass(frozen=True)
class History:
    """
    Calibrations of one sensor in order of date, and the values of each parameter.

    There are n - 1 changes from each to the next, and `whole` compares all.

    """

    moments: tuple[Moment, ...]
    parameters: tuple[Parameter, ...]
    changes: tuple[DatedChange, ...]
    whole: Comparison
    notes: tuple[str, ...]
    runs: tuple[Comparable, ...] = field(repr=False)

    def between(self, first: int, second: int) -> Comparison:
        """Return the comparison of two of the calibrations, by their number in the order."""
        return compare_runs([self.runs[first], self.runs[second]])

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the day of each calibration, with the time where a day has several."""
        days = [moment.when and moment.when.strftime('%Y-%m-%d') for moment in self.moments]
        short = len(set(days)) == len(days)
        return tuple('no date' if moment.when is None else
                     moment.when.strftime('%Y-%m-%d' if short else '%Y-%m-%d %H:%M')
                     for moment in self.moments)


def history_of(calibrations: Sequence[Calibration]) -> History:
    """
    Return calibrations of one sensor in order of date, with the change at each step.

    If one has no date, the order is kept.

    Raises
    ------
    InputError
        If there are fewer than two, they cannot be compared, or a date is not valid.

    """
    runs = comparable(calibrations)
    moments = []
    for k, run in enumerate(calibrations):
        poses, when = run.used_poses, None
        warm = float(np.median(poses['temperature'])) if 'temperature' in poses else None
        if run.date:
            try:
                when = datetime.fromisoformat(run.date.replace('Z', '+00:00'))
            except ValueError:
                raise InputError(f'the date of calibration {k + 1} is {run.date!r}, expected a '
                                 'date such as 2026-11-22T09:30:00+00:00',
                                 'correct date: in the file') from None
            when = when.replace(tzinfo=when.tzinfo or timezone.utc).astimezone(timezone.utc)
        moments.append(Moment(k, when, run.name, warm, run.quality.rms_after_mg))
    undated = [moment.index + 1 for moment in moments if moment.when is None]
    if not undated:
        moments.sort(key=lambda moment: str(moment.when))  # all in UTC
    ordered = tuple(runs[moment.index] for moment in moments)
    whole, changes = compare_runs(ordered), []
    for pair in pairwise(ordered):
        comparison = compare_runs(pair)
        steps = [(each.name, float(each.values[1] - each.values[0]),
                  float(np.hypot(*each.stated_sd))) for each in comparison.parameters]
        most = max(steps, key=lambda each: abs(each[1]) / each[2] if each[2] > 0.0 else 0.0)
        changes.append(DatedChange(comparison, *most))
    notes = [f'calibration {number} has no date: the order is that of the input'
             for number in undated]
    return History(tuple(moments), whole.parameters, tuple(changes), whole,
                   notes=(*notes, *whole.notes), runs=ordered)
