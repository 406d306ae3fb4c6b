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
Poses to Calibration: check, find disturbed poses, choose the model, fit, say how good it is.

Poses of unknown orientation carry models 4, 7, 9 and 10; poses of known orientation (a reference,
or the six faces) carry 12. `ml`, the default, weighs poses by their noise and leaves disturbed
ones out; `algebraic` is the documents' own costs, unweighted, every row kept.

"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from . import closed_form
from .calibration import Calibration, Rejected
from .disturbed import extreme, ROUNDS
from .geometry import dilution, free_parameters, noise_along, NORM_MODELS, WEAK_DILUTION
from .likelihood import Fit, fit_norm, fit_reference, judge, norm_fit_at
from .norm_fit import form_of
from .quality import in_g, quality_of
from .refusal import carries, refuse_if_unfit, unseen
from .selection import choose
from .sensing_axes import lower_triangular
from ..errors import InputError, RefusedFitError
from ..model import MODELS
from ..table import Floats, Poses, Table
from ..units import MG, Units

Method = Literal['ml', 'algebraic']
METHODS = ('ml', 'algebraic')
MODEL_NAMES = ('auto', '4', '7', '9', '10', '12')

_LIKELY_G = (0.5, 2.0)
_CLOSED_FORMS: dict[str, Callable[[Floats], tuple[Floats, Floats]]] = {
    '4': closed_form.fit_4, '7': closed_form.fit_7,
    '9': closed_form.fit_10, '10': closed_form.fit_10}


def fit_poses(poses: Poses, units: Units, *, model: str = 'auto', method: Method = 'ml',
              sensor: str = '', date: str = '') -> Calibration:
    """
    Fit a calibration.

    Parameters
    ----------
    poses : Poses
        Still poses, in the unit of the readings.
    units : Units
        That unit; the sensitivity of native units is found here.
    model : {'auto', '4', '7', '9', '10', '12'}
        ``auto`` takes 12 where the orientations are known, and otherwise the smallest of 4, 7
        and 10 that the poses call for.
    method : {'ml', 'algebraic'}
        Maximum likelihood, or the documents' own costs.
    sensor, date : str
        Kept in the record.

    Returns
    -------
    Calibration
        With ΔR = I; see `accel_calib.calibrate.calibration.level`.

    Raises
    ------
    RefusedFitError
        If the poses cannot carry the model.
    InputError
        If the readings are plainly not in that unit.

    """
    if model not in MODEL_NAMES or method not in METHODS:
        raise ValueError(f'model {model!r}, method {method!r}; expected {MODEL_NAMES}, {METHODS}')
    check_units(poses, units)
    if model == '12' or (model == 'auto' and 'reference' in poses):
        return _fit_known(poses, units, method, sensor, date)
    return _fit_unknown(poses, units, model, method, sensor, date)


def check_units(poses: Table, units: Units) -> None:
    """
    Make sure that still readings are about 1 g long.

    Raises
    ------
    InputError
        Says which unit they look like.

    """
    if units.name == 'native' or len(poses) == 0:
        return
    length = float(np.median(np.linalg.norm(poses.reading, axis=1)))
    if _LIKELY_G[0] <= length / units.per_g <= _LIKELY_G[1]:
        return
    likely = [name for name, per_g in (('m/s2', 9.80665), ('g', 1.0))
              if _LIKELY_G[0] <= length / per_g <= _LIKELY_G[1]]
    raise InputError(f'the readings are about {length:.4g} long, expected about '
                     f'{units.per_g:.4g} at rest in {units.name}',
                     f'give the units of the readings: {likely[0] if likely else "native"}')


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
    raw = _unit(poses.reading)
    if units.name != 'native' and dilution('4', raw) > WEAK_DILUTION:
        return raw
    return _unit(poses.reading - closed_form.fit_4(poses.reading)[1])


def _unit(vectors: Floats) -> Floats:
    """Give (n, 3) vectors at length 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _fit_unknown(poses: Poses, units: Units, model: str, method: Method, sensor: str,
                 date: str) -> Calibration:
    """Fit poses of which only |force| = 1 g is known."""
    if units.name == 'native':
        if len(poses) < free_parameters('4'):
            refuse_if_unfit('4', np.zeros((len(poses), 3)))
        units = Units('native', float(closed_form.fit_4(poses.reading)[0][0, 0]))
    directions = directions_of(poses, units)
    noise = noise_along(poses.noise, directions)
    refuse_if_unfit(NORM_MODELS[0] if model == 'auto' else model, directions, noise)
    poses_g = in_g(poses, units)
    kept, reason = np.arange(len(poses)), f'model {model} was asked for'
    unasked: tuple[str, ...] = ()
    if method == 'ml':
        kept = _undisturbed(poses_g, _carried(directions, noise)[-1] if model == 'auto' else model)
        refuse_if_unfit(NORM_MODELS[0] if model == 'auto' else model, directions[kept],
                        noise[kept])
    if model == 'auto':
        carried = _carried(directions[kept], noise[kept])
        unasked = unseen(carried[-1], directions[kept], noise[kept])
        choice = choose({name: _fit_rows(poses_g.take(kept), name, method) for name in carried})
        model, reason = choice.name, choice.reason
    fit = _fit_rows(poses_g.take(kept), model, method)
    rejected = _rejections(poses_g, fit, np.setdiff1d(np.arange(len(poses)), kept))
    quality = quality_of(fit, poses_g.take(kept), units, directions[kept])
    warnings = _warnings(fit, dilution(model, directions[kept], noise[kept])) + unasked
    return Calibration(model, method, fit.model, units, sensor, 'ros', date, fit.covariance,
                       quality, poses, rejected, reason, warnings)


def _carried(directions: Floats, noise: Floats) -> list[str]:
    """Name the models that the poses carry, the smallest always."""
    return [NORM_MODELS[0], *(name for name in NORM_MODELS[1:]
                              if carries(name, directions, noise))]


def _undisturbed(poses_g: Poses, name: str) -> NDArray[np.intp]:
    """Give the indices of the poses that are not disturbed, as this model sees them."""
    kept = np.arange(len(poses_g))
    for _ in range(ROUNDS):
        fit = _fit_rows(poses_g.take(kept), name, 'ml')
        out = extreme(fit.weighted[np.newaxis], fit.jacobian[np.newaxis],
                      np.ones((1, len(kept)), bool), fit.noise_known, len(poses_g))[0]
        if not np.any(out):
            break
        kept = kept[~out]
    return kept


def _fit_rows(poses_g: Poses, name: str, method: Method) -> Fit:
    """Fit a model for unknown orientation to poses in g."""
    mat_w, vec_v = _CLOSED_FORMS[name](poses_g.reading)
    if name == '9':
        mat_w = lower_triangular(mat_w)
    if method == 'ml':
        return fit_norm(name, mat_w, vec_v, poses_g.reading, poses_g.noise)
    if name == '9':  # the cost of the report is the likelihood without weights
        mat_w, vec_v = fit_norm(name, mat_w, vec_v, poses_g.reading, None).model.linear_part
    free = form_of(name).free(mat_w, vec_v)
    return norm_fit_at(name, free, poses_g.reading, poses_g.noise)


def _fit_known(poses: Poses, units: Units, method: Method, sensor: str, date: str) -> Calibration:
    """Fit model 12 to poses of known orientation."""
    reason = 'the orientations are given'
    if 'reference' not in poses:
        faces_up = closed_form.faces(poses.reading)
        if faces_up is None:
            raise RefusedFitError('model 12 needs known orientations, the poses have no '
                                  'ref_x,ref_y,ref_z and are not the six faces',
                                  'add the columns, give the six faces alone (--rows), or use '
                                  'model 10')
        reason = 'the poses are the six faces'
        poses = poses.with_columns(reference=faces_up * (
            1.0 if units.name == 'native' else units.per_g))
    if units.name == 'native':
        mat_x = closed_form.fit_12(poses.reading, poses['reference'])[0]
        units = Units('native', float(np.cbrt(abs(np.linalg.det(mat_x)))))
    directions = poses['reference'] / np.linalg.norm(poses['reference'], axis=1, keepdims=True)
    refuse_if_unfit('12', directions)
    poses_g = in_g(poses, units)
    noise = poses_g.noise if method == 'ml' else None
    fit = fit_reference(MODELS['12'], poses_g.reading, poses_g['reference'], poses_g.columns,
                        noise)
    quality = quality_of(fit, poses_g, units, directions)
    return Calibration('12', method, fit.model, units, sensor, 'ros', date, fit.covariance,
                       quality, poses, (), reason, _warnings(fit, 0.0))


def _rejections(poses_g: Poses, fit: Fit, out: Floats) -> tuple[Rejected, ...]:
    """Say of each pose left out how far it is from 1 g in the fit of the others."""
    if len(out) == 0:
        return ()
    away = judge(fit.model, poses_g.reading, poses_g.columns, None).residual
    return tuple(Rejected(int(poses_g.row[k]), f'disturbed: |force| is {away[k] * MG:+.2f} mg off '
                          'what the other poses say') for k in out)


def _warnings(fit: Fit, stretched: float) -> tuple[str, ...]:
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
