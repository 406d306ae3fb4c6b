# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Poses of unknown orientation: which are disturbed, which model, the fit, how good it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args, Literal

import numpy as np
from numpy.typing import NDArray

from . import closed_form
from .calibration import Calibration, Rejected
from .disturbed import extreme, ROUNDS
from .geometry import dilution, free_parameters, NORM_MODELS, pose_noise, WEAK_DILUTION
from .likelihood import Fit, fit_norm, judge, norm_fit_at
from .norm_fit import form_of
from .quality import in_g, quality_of
from .refusal import carries, refuse_if_unfit, unseen
from .selection import choose
from .sensing_axes import lower_triangular
from ..sphere import unit
from ..table import Floats, Poses
from ..units import MG, Units

Method = Literal['ml', 'algebraic']
METHODS = get_args(Method)

CLOSED_FORMS: dict[str, Callable[[Floats], tuple[Floats, Floats]]] = {
    '4': closed_form.fit_4, '7': closed_form.fit_7,
    '9': closed_form.fit_10, '10': closed_form.fit_10}


def directions_of(poses: Poses, units: Units) -> Floats:
    """
    Say where up is in each pose, as far as it is known before a fit.

    Parameters
    ----------
    poses : Poses
        In the unit of the readings.
    units : Units
        That unit; native readings mean nothing but from the centre of their sphere.

    Returns
    -------
    (n, 3) array
        Unit vectors in the axes of the sensor, from the centre of the readings where that is
        plain.

    """
    raw = unit(poses.reading)
    if units.name != 'native' and dilution('4', raw) > WEAK_DILUTION:
        return raw
    return unit(poses.reading - closed_form.fit_4(poses.reading)[1])


@dataclass(frozen=True)
class NormFit:
    """
    What poses of unknown orientation come to.

    Parameters
    ----------
    name : str
        The model.
    reason : str
        Why this one.
    fit : Fit
        To the poses that are kept.
    kept : (k,) array of int
        Indices of these poses.
    warnings : tuple of str
        What a user should know.

    """

    name: str
    reason: str
    fit: Fit
    kept: NDArray[np.intp]
    warnings: tuple[str, ...]


def fit_unknown(poses: Poses, units: Units, model: str, method: Method) -> Calibration:
    """Fit poses of which only |force| = 1 g is known; arguments and errors as `fit_poses`."""
    units = own_scale(poses, units)
    found = solve_unknown(in_g(poses, units), directions_of(poses, units), model, method)
    return calibration_of(found, poses, units, method)


def calibration_of(found: NormFit, poses: Poses, units: Units, method: Method) -> Calibration:
    """Make the record of a fit to these poses."""
    poses_g, fit = in_g(poses, units), found.fit
    rejected = _rejections(poses_g, fit, np.setdiff1d(np.arange(len(poses)), found.kept))
    kept = found.kept
    quality = quality_of(fit, poses_g.take(kept), units, directions_of(poses, units)[kept])
    return Calibration(found.name, method, fit.model, units, '', 'ros', '', fit.covariance,
                       quality, poses, rejected, found.reason, found.warnings)


def own_scale(poses: Poses, units: Units) -> Units:
    """Give native units the scale that the poses show, and others as they are."""
    if units.name != 'native':
        return units
    if len(poses) < free_parameters('4'):
        refuse_if_unfit('4', np.zeros((len(poses), 3)))
    return Units('native', float(closed_form.fit_4(poses.reading)[0][0, 0]))


def solve_unknown(poses_g: Poses, directions: Floats, model: str, method: Method) -> NormFit:
    """
    Fit poses in g by |force| = 1 g.

    Parameters
    ----------
    poses_g : Poses
        In g.
    directions : (n, 3) array
        About where up is in each, unit vectors.
    model : {'auto', '4', '7', '9', '10'}
        The model, or the smallest that the poses call for.
    method : {'ml', 'algebraic'}
        As `fit_poses`.

    Returns
    -------
    NormFit
        The fit, and to which poses.

    Raises
    ------
    RefusedFitError
        If the poses cannot carry the model.

    """
    noise = pose_noise(poses_g.noise, directions)
    carried = _carried(model, directions, noise)
    fits: dict[str, Fit] = {}
    kept = np.arange(len(poses_g))
    if method == 'ml':
        kept, fit = _undisturbed(poses_g, list(carried)[-1])
        fits[list(carried)[-1]] = fit
    left, directions = poses_g.take(kept), directions[kept]
    if len(kept) < len(poses_g):
        noise = pose_noise(left.noise, directions)
        carried = _carried(model, directions, noise)
    fits = {name: fits.get(name) or _fit_rows(left, name, method) for name in carried}
    if model != 'auto':
        warnings = warnings_of(fits[model], carried[model])
        return NormFit(model, f'model {model} was asked for', fits[model], kept, warnings)
    choice = choose(fits)
    warnings = (*warnings_of(fits[choice.name], carried[choice.name]),
                *unseen(list(carried)[-1], directions, noise))
    return NormFit(choice.name, choice.reason, fits[choice.name], kept, warnings)


def _carried(model: str, directions: Floats, noise: Floats | None) -> dict[str, float]:
    """Give the dilution of each model to look at that the poses carry, the smallest first."""
    first, *others = NORM_MODELS if model == 'auto' else (model,)
    found = {first: dilution(first, directions, noise)}
    refuse_if_unfit(first, directions, noise)
    for name in others:
        if carries(name, directions, noise):
            found[name] = dilution(name, directions, noise)
    return found


def _undisturbed(poses_g: Poses, name: str) -> tuple[NDArray[np.intp], Fit]:
    """Give the indices of the poses that are not disturbed, and the fit to them."""
    kept = np.arange(len(poses_g))
    for _ in range(ROUNDS):
        fit = _fit_rows(poses_g.take(kept), name, 'ml')
        out = extreme(fit.weighted[np.newaxis], fit.jacobian[np.newaxis],
                      np.ones((1, len(kept)), bool), fit.noise_known, len(poses_g))[0]
        if not np.any(out):
            return kept, fit
        kept = kept[~out]
    return kept, _fit_rows(poses_g.take(kept), name, 'ml')


def _fit_rows(poses_g: Poses, name: str, method: Method) -> Fit:
    """Fit a model for unknown orientation to poses in g."""
    mat_w, vec_v = CLOSED_FORMS[name](poses_g.reading)
    if name == '9':
        mat_w = lower_triangular(mat_w)
    if method == 'ml':
        return fit_norm(name, mat_w, vec_v, poses_g.reading, poses_g.noise)
    if name == '9':  # the cost of the report is the likelihood without weights
        mat_w, vec_v = fit_norm(name, mat_w, vec_v, poses_g.reading, None).model.linear_part
    free = form_of(name).free(mat_w, vec_v)
    return norm_fit_at(name, free, poses_g.reading, poses_g.noise)


def _rejections(poses_g: Poses, fit: Fit, out: Floats) -> tuple[Rejected, ...]:
    """Say of each pose left out how far it is from 1 g in the fit of the others."""
    if len(out) == 0:
        return ()
    away = judge(fit.model, poses_g.reading, poses_g.columns, None).residual
    return tuple(Rejected(int(poses_g.row[k]), f'disturbed: |force| is {away[k] * MG:+.2f} mg off '
                          'what the other poses say') for k in out)


def warnings_of(fit: Fit, stretched: float) -> tuple[str, ...]:
    """Say what a user should know of a fit."""
    warnings = []
    if fit.dof == 0:
        warnings.append('there are just as many poses as free parameters: nothing is left to '
                        'check the fit with; take more poses')
    if stretched > WEAK_DILUTION:
        warnings.append(f'the poses leave a gap on the sphere: there the error is up to '
                        f'{stretched:.0f} times that of a pose; take the next pose asked for')
    if not fit.noise_known:
        warnings.append('std and count of the poses are not given: the uncertainty comes from '
                        'the residuals alone')
    elif fit.dof > 0 and fit.chi2 / fit.dof > 4.0:
        warnings.append(f'the residuals are {np.sqrt(fit.chi2 / fit.dof):.1f} times the noise of '
                        'the pose means: poses repeat worse than their samples say, or the model '
                        'lacks an effect')
    return tuple(warnings)
