# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrations of one sensor, prepared for comparisons.

A run with a smaller model keeps its values, but its uncertainty is that of the largest model. This
fit, and how well the poses of a run repeat, are the same for all comparisons of the run.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .parameters import Scatter, scatter_of
from ..calibrate import Calibration, fit_unknown
from ..errors import InputError, RefusedFitError
from ..estimate import NORM_MODELS
from ..text import counted

_LARGER = {'4': ('7', '10'), '7': ('10',)}
"""Models that include a smaller model; for |a|, models 9 and 12 are equivalent to 10."""


@dataclass(frozen=True)
class Comparable:
    """
    A calibration prepared for comparisons with others of its sensor.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    sure : Calibration
        Fit of the largest model of the sensor to the same poses, or the calibration itself.
    scatter : Scatter
        How well the poses of `sure` repeat.

    """

    calibration: Calibration
    sure: Calibration
    scatter: Scatter


def comparable(calibrations: Sequence[Calibration]) -> tuple[Comparable, ...]:
    """
    Prepare calibrations of one sensor for any number of comparisons among them.

    Parameters
    ----------
    calibrations : sequence of Calibration
        Two or more calibrations with any models.

    Returns
    -------
    tuple of Comparable
        One for each calibration.

    Raises
    ------
    InputError
        If there are fewer than two, or they cannot be compared.

    """
    _refuse_if_unlike(calibrations)
    return tuple(Comparable(run, sure, scatter_of(sure)) for run, sure in
                 zip(calibrations, _with_largest_model(calibrations), strict=True))


def _refuse_if_unlike(calibrations: Sequence[Calibration]) -> None:
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
    native = [run.units.is_native for run in calibrations]
    if any(native) and not all(native):
        other = next(run.units.name for run in calibrations if not run.units.is_native)
        raise InputError(f'run {native.index(True) + 1} is in native units and another run in '
                         f'{other}, expected the same unit, because the conversion is not known',
                         'fit all runs from readings in one unit')
    for k, run in enumerate(calibrations, 1):
        if not run.model.effects:
            raise InputError(f'run {k} is a mounting alone, expected a fit of offset and gain',
                             'leave it out, or fit it with more poses')
        if not np.all(np.isfinite(run.covariance)):
            raise InputError(f'run {k} has no uncertainty, expected a finite covariance',
                             'fit it again with more poses')


def _with_largest_model(calibrations: Sequence[Calibration]) -> tuple[Calibration, ...]:
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
    names = {run.form.norm for run in calibrations}
    largest = next((name for name in reversed(NORM_MODELS) if name in names), '')
    return tuple(_fitted_with(largest, run) for run in calibrations)


def _fitted_with(name: str, run: Calibration) -> Calibration:
    """Return a fit of a larger model to the poses of a run, or the run if that is not possible."""
    if name not in _LARGER.get(run.name, ()) or run.model.effects != run.form.effects:
        return run
    try:
        return fit_unknown(run.used_poses, run.units, name, 'ml')
    except RefusedFitError:
        return run
