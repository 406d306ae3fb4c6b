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
from ..errors import InputError, RefusedFitError
from ..model import MODELS
from ..table import Floats

_COMMON = ('temperature', 'supply_voltage')
"""Context that is set alike for all runs; the rest is each run's own."""

_LARGER = {'4': ('7', '10'), '7': ('10',)}
"""Models that include a smaller one; 9 and 12 add nothing to |a| beyond 10."""

_WARMER = 5.0
"""Difference of temperature between runs that is worth a note [°C]."""


def refuse_if_unlike(calibrations: Sequence[Calibration]) -> None:
    """
    Check that calibrations can be compared.

    Raises
    ------
    InputError
        If they cannot.

    """
    if len(calibrations) < 2:
        raise InputError('there is nothing to compare a single calibration with',
                         'give two or more of the same sensor')
    sensors = list(dict.fromkeys(run.sensor for run in calibrations if run.sensor))
    if len(sensors) > 1:
        raise InputError(f'the calibrations are of the sensors {" and ".join(sensors)}, expected '
                         'one sensor', 'give calibrations of one sensor; if it was only renamed, '
                         'write one name into sensor: of the files')
    native = [run.units.name == 'native' for run in calibrations]
    if any(native) and not all(native):
        other = next(run.units.name for run in calibrations if run.units.name != 'native')
        raise InputError(f'run {native.index(True) + 1} is in native units, another in {other}, '
                         'and nothing says how many native units make one of it',
                         'fit all of them from readings in one unit')
    for k, run in enumerate(calibrations, 1):
        if not np.all(np.isfinite(run.covariance)):
            raise InputError(f'run {k} has no uncertainty', 'fit it again with more poses')


def with_largest_model(calibrations: Sequence[Calibration]) -> tuple[Calibration, ...]:
    """
    Return fits whose uncertainties hold for runs with smaller models, too.

    A smaller model takes what it leaves out to be zero, without uncertainty. But `auto` leaves out
    what it cannot see in the noise, so the uncertainty of such a run is that of the largest model
    of the runs, fitted to its poses.

    Parameters
    ----------
    calibrations : sequence of Calibration
        The runs.

    Returns
    -------
    tuple of Calibration
        Each run itself, or its poses fitted with the largest model, if they determine it.

    """
    names = {'10' if run.name in ('9', '12') else run.name for run in calibrations}
    largest = next((name for name in ('10', '7', '4') if name in names), '')
    return tuple(_fitted_with(largest, run) for run in calibrations)


def _fitted_with(name: str, run: Calibration) -> Calibration:
    """Return the poses of a run fitted with a larger model, if it is one and they determine it."""
    if name not in _LARGER.get(run.name, ()) or run.model.effects != MODELS[run.name]:
        return run
    try:
        return fit_unknown(run.used_poses, run.units, name, 'ml')
    except RefusedFitError:
        return run


def contexts_of(calibrations: Sequence[Calibration]) -> tuple[Context, ...]:
    """Return the context in which each run is compared, one row each."""
    common = {key: np.array([np.mean([np.median(run.poses[key]) for run in calibrations
                                      if key in run.poses])])
              for key in _COMMON if any(key in run.poses for run in calibrations)}
    return tuple({**_own_context(run), **common} for run in calibrations)


def _own_context(run: Calibration) -> Context:
    """Return the middle of a run: not turning, and without a previous pose."""
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
    Return what else to know of a comparison.

    Parameters
    ----------
    calibrations, sure : sequence of Calibration
        The runs, and what `with_largest_model` made of them.
    names : tuple of str
        Of the t common parameters.
    deviation : (n, t) array
        Their standard deviations; 0 if a run leaves one out.
    noisier : sequence of int
        Runs whose poses repeat worse than those of the others.

    """
    smaller = [f'run {k} (model {run.name}) leaves out what model {larger.name} finds in others: '
               'it counts as zero there, with the uncertainty of its poses'
               for k, (run, larger) in enumerate(zip(calibrations, sure, strict=True), 1)
               if run is not larger]
    return (*_shared(calibrations), *smaller, *_left_out(names, deviation),
            *_temperatures(calibrations),
            *(f'the poses of run {k + 1} repeat significantly worse than those of the others: it '
              'counts for less' for k in noisier))


def _shared(calibrations: Sequence[Calibration]) -> list[str]:
    """Return notes on runs that were fitted to the same poses."""
    rows = [{tuple(row) for row in (run.poses.reading / run.force_per_g).round(9).tolist()}
            for run in calibrations]
    notes = []
    for (i, first), (j, second) in combinations(enumerate(rows, 1), 2):
        common, least = len(first & second), min(len(first), len(second))
        if common:
            what = 'the same poses' if common == least else f'{common} poses'
            notes.append(f'runs {i} and {j} share {what}: they are not independent, and that they '
                         'agree says little')
    return notes


def _left_out(names: tuple[str, ...], deviation: Floats) -> list[str]:
    """Return notes on parameters that some models leave out and others have."""
    notes: dict[tuple[int, ...], list[str]] = {}
    for name, column in zip(names, deviation.T, strict=True):
        without = tuple((np.flatnonzero(column == 0.0) + 1).tolist())
        if 0 < len(without) < len(column):
            notes.setdefault(without, []).append(name)
    return [f'{", ".join(found)}: left out by the model of run{"s" * (len(runs) > 1)} '
            f'{", ".join(map(str, runs))}, so that there it counts as known to be zero; for a '
            'comparison of like with like, fit all runs with one model'
            for runs, found in notes.items() if found]


def _temperatures(calibrations: Sequence[Calibration]) -> list[str]:
    """Return a note if temperatures differ and some runs do not correct for that."""
    known = [float(np.median(run.poses['temperature'])) for run in calibrations
             if 'temperature' in run.poses]
    if len(known) < 2 or max(known) - min(known) < _WARMER or all(
            'temperature' in run.model.needs for run in calibrations):
        return []
    return [f'the poses were taken at {min(known):.0f} to {max(known):.0f} °C, and not all runs '
            'correct for temperature: it may be what differs']
