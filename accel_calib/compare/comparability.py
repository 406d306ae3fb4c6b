# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Preconditions and caveats for comparing calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ..calibrate import Calibration
from ..calibrate.unknown_orientation import fit_unknown
from ..effects import Context
from ..errors import counted, InputError, listed, RefusedFitError
from ..model import MODELS
from ..table import Floats

_COMMON = ('temperature', 'supply_voltage')
"""Context that is set to the same value for all runs; other context is specific to a run."""

_LARGER = {'4': ('7', '10'), '7': ('10',)}
"""Models that include a smaller model; for |a|, models 9 and 12 are equivalent to 10."""

_WARMER = 5.0
"""Difference of temperature between runs that causes a note [°C]."""


def refuse_if_unlike(calibrations: Sequence[Calibration]) -> None:
    """
    Check that calibrations can be compared.

    Raises
    ------
    InputError
        If the calibrations cannot be compared.

    """
    if len(calibrations) < 2:
        raise InputError(f'found {counted(len(calibrations), "calibration")}, expected at least 2',
                         'select two or more calibrations of the same sensor')
    sensors = list(dict.fromkeys(run.sensor for run in calibrations if run.sensor))
    if len(sensors) > 1:
        raise InputError(f'the calibrations are of the sensors {" and ".join(sensors)}, expected '
                         'one sensor', 'select calibrations of one sensor; if it was only '
                         'renamed, set sensor: in the files to one name')
    native = [run.units.name == 'native' for run in calibrations]
    if any(native) and not all(native):
        other = next(run.units.name for run in calibrations if run.units.name != 'native')
        raise InputError(f'run {native.index(True) + 1} is in native units and another run in '
                         f'{other}, expected the same unit, because the conversion is not known',
                         'fit all runs from readings in one unit')
    for k, run in enumerate(calibrations, 1):
        if not np.all(np.isfinite(run.covariance)):
            raise InputError(f'run {k} has no uncertainty, expected a finite covariance',
                             'fit it again with more poses')


def with_largest_model(calibrations: Sequence[Calibration]) -> tuple[Calibration, ...]:
    """
    Return fits whose uncertainties are valid for runs with smaller models, too.

    A smaller model assumes that the omitted effects are exactly zero. However, `auto` omits
    effects that are hidden in the noise. The uncertainty of such a run is therefore that of the
    largest model of the runs, fitted to its poses.

    Parameters
    ----------
    calibrations : sequence of Calibration
        The runs.

    Returns
    -------
    tuple of Calibration
        Each run, or a fit of the largest model to its poses if they determine it.

    """
    names = {'10' if run.name in ('9', '12') else run.name for run in calibrations}
    largest = next((name for name in ('10', '7', '4') if name in names), '')
    return tuple(_fitted_with(largest, run) for run in calibrations)


def _fitted_with(name: str, run: Calibration) -> Calibration:
    """Return a fit of a larger model to the poses of a run, or the run if that is not possible."""
    if name not in _LARGER.get(run.name, ()) or run.model.effects != MODELS[run.name]:
        return run
    try:
        return fit_unknown(run.used_poses, run.units, name, 'ml')
    except RefusedFitError:
        return run


def contexts_of(calibrations: Sequence[Calibration]) -> tuple[Context, ...]:
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


def notes_of(calibrations: Sequence[Calibration], sure: Sequence[Calibration],
             names: tuple[str, ...], deviation: Floats, noisier: Sequence[int]
             ) -> tuple[str, ...]:
    """
    Return notes that limit the meaning of a comparison.

    Parameters
    ----------
    calibrations, sure : sequence of Calibration
        The runs, and the result of `with_largest_model` for them.
    names : tuple of str
        Names of the t common parameters.
    deviation : (n, t) array
        Standard deviations of the parameters; 0 if the model of a run omits the parameter.
    noisier : sequence of int
        Indices of runs whose poses repeat worse than those of the others.

    """
    smaller = [f'run {k} (model {run.name}) omits parameters of model {larger.name}: they are '
               'taken as zero, with the uncertainty that its poses allow'
               for k, (run, larger) in enumerate(zip(calibrations, sure, strict=True), 1)
               if run is not larger]
    return (*_shared(calibrations), *smaller, *_left_out(names, deviation),
            *_temperatures(calibrations),
            *(f'the poses of run {k + 1} repeat significantly worse than those of the others: the '
              'run has less weight' for k in noisier))


def _shared(calibrations: Sequence[Calibration]) -> list[str]:
    """Return notes about runs with common poses."""
    rows = [{tuple(row) for row in (run.poses.reading / run.force_per_g).round(9).tolist()}
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
