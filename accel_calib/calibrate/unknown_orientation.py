# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit of poses of unknown orientation: model 4, 7, 9 or 10 by |force| = 1 g.

The method ``ml``, the default, weights poses by their noise and leaves out outliers. The method
``algebraic`` minimises the cost functions of AN5286 and the ESGI'95 report, unweighted and with
every row.

``auto`` goes from the smallest model to larger models. It selects each model that explains
significantly more than noise, by an F test at `_LEVEL` with the moderated variance of
`accel_calib.estimate.fit.Fit`.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .calibration import Calibration, Method, Rejected
from .pose_planning import refuse_if_unfit, unseen
from .quality import fit_findings, in_g, record_of, rival_findings
from ..effects import Model, MODELS, sensor_force, with_linear_part, with_vector
from ..errors import RefusedFitError, TAKE_ALL_SIDES
from ..estimate import (
    closed_form, covariance_with, dilution, estimate, Fit, fit_norm, fit_sphere, free_parameters,
    judge, LARGEST_DILUTION, lower_triangular, NORM_MODELS, NotConvergedError, originals, Point,
    pose_noise, poses_needed, Rival, rivals, solve, start_of, TIES, WEAK_DILUTION)
from ..finding import Finding
from ..geometry import unit
from ..table import Floats, Poses
from ..text import listed
from ..units import MG, Units

_LEVEL = 0.03

_MOST_NAMED = 3
"""Largest number of groups of equal rows in a warning."""


def directions_of(poses: Poses, units: Units) -> Floats:
    """
    Return approximate directions of up before a fit, (n, 3) unit vectors in the sensor axes.

    They start from the centre of the readings if the poses determine it. Native readings always
    start from the centre of their sphere.

    """
    raw = unit(poses.reading)
    if not units.is_native and dilution('4', raw) > WEAK_DILUTION:
        return raw
    return unit(poses.reading - fit_sphere(poses.reading)[1])


@dataclass(frozen=True)
class NormFit:
    """
    The fit of poses of unknown orientation, with the reason for the choice of the model.

    `kept` are the indices of the k poses kept, without copies, and `directions` are (k, 3), their
    approximate directions of up. `left_out` are the indices of the outliers, with their copies.
    `rivals` are poses that may be wrong instead of them.

    """

    name: str
    reason: str
    fit: Fit
    kept: NDArray[np.intp]
    left_out: NDArray[np.intp]
    directions: Floats
    findings: tuple[Finding, ...]
    rivals: tuple[Rival, ...] = ()

    @property
    def covariance(self) -> Floats:
        """Return the covariance, which includes the fits of the rivals."""
        return covariance_with(self.fit, self.rivals)


def fit_unknown(poses: Poses, units: Units, model: str, method: Method) -> Calibration:
    """Fit poses of unknown orientation; parameters and errors as in `fit_poses`."""
    units = own_scale(poses, units)
    found = solve_unknown(in_g(poses, units), directions_of(poses, units), model, method)
    return calibration_of(found, poses, units, method)


def calibration_of(found: NormFit, poses: Poses, units: Units, method: Method) -> Calibration:
    """Return a fit to these poses as a Calibration."""
    out = rejected_by(found.fit.model, in_g(poses, units).take(found.left_out))
    return record_of(found.fit, poses, units, found.directions, found.name, method,
                     covariance=found.covariance, rejected=out, reason=found.reason,
                     noted=found.findings)


def own_scale(poses: Poses, units: Units) -> Units:
    """Return native units with the scale estimated from the poses; other units unchanged."""
    if not units.is_native:
        return units
    if len(poses) < free_parameters('4'):
        refuse_if_unfit('4', np.zeros((len(poses), 3)))
    return Units('native', float(fit_sphere(poses.reading)[0][0, 0]))


def solve_unknown(poses_g: Poses, directions: Floats, model: str, method: Method) -> NormFit:
    """
    Fit model 4, 7, 9, 10 or ``auto`` to poses in g by |force| = 1 g; method as in `fit_poses`.

    `directions` are (n, 3), the approximate direction of up in each pose, unit vectors.
    RefusedFitError is raised if the poses do not determine the model.

    """
    poses_g = only_norm(poses_g)
    dilutions = _dilutions(model, directions, pose_noise(poses_g.noise, directions))
    original = originals(poses_g) if method == 'ml' else np.arange(len(poses_g))
    kept = np.unique(original)
    fits: dict[str, Fit] = {}
    if method == 'ml':
        largest = list(dilutions)[-1]
        fits[largest], among = _fit_norm(largest, poses_g.take(kept))
        kept = kept[among]
    left, used = poses_g.take(kept), directions[kept]
    noise = pose_noise(left.noise, used)
    if len(kept) < len(poses_g):
        dilutions = _dilutions(model, used, noise)
    fits = {name: fits.get(name) or _fit_rows(left, name, method) for name in dilutions}
    name, reason = ((model, f'model {model} was requested') if model != 'auto'
                    else _choose(fits))
    unlike = _rivals(name, fits[name], kept, np.unique(original), poses_g)
    findings = (*copies(original, poses_g), *rival_findings(unlike, poses_g.row),
                *fit_findings(fits[name], dilutions[name]))
    if model == 'auto':
        findings = (*findings, *unseen(list(dilutions)[-1], used, noise))
    return NormFit(name, reason, fits[name], kept, np.flatnonzero(~np.isin(original, kept)), used,
                   findings, unlike)


def _rivals(name: str, fit: Fit, kept: NDArray[np.intp], distinct: NDArray[np.intp],
            poses_g: Poses) -> tuple[Rival, ...]:
    """Return the rivals of a fit to the poses kept, given the indices without copies."""
    def refit(others: Poses) -> Fit:
        found = estimate(start_of(form.norm, others.reading), others)
        return _in_sensing_axes(found.model.linear_part, others) if form.sensing_axes else found

    form = MODELS[name]
    if len(kept) == len(distinct):
        return ()
    found = rivals(fit, np.searchsorted(distinct, kept), poses_g.take(distinct), refit)
    return tuple(each._replace(left_out=int(distinct[each.left_out]),
                               instead=int(distinct[each.instead])) for each in found)


def copies(original: NDArray[np.intp], poses: Poses) -> Iterator[Finding]:
    """Yield a finding about the rows that count as one pose, from the result of `originals`."""
    first, count = np.unique(original, return_counts=True)
    groups = [poses.row[original == each].tolist() for each in first[count > 1]]
    if groups:
        shown = '; '.join(listed('row', rows) for rows in groups[:_MOST_NAMED])
        more = len(groups) - _MOST_NAMED
        yield Finding('copies', f'equal rows count as one pose: {shown}'
                      f'{f"; and {more} more" if more > 0 else ""}',
                      rows=tuple(row for rows in groups for row in rows))


def only_norm(poses_g: Poses) -> Poses:
    """Return the poses with the columns that a fit by |force| = 1 g uses."""
    kept = ('reading', 'std', 'count')
    return Poses({key: poses_g[key] for key in kept if key in poses_g}, poses_g.row)


def _dilutions(model: str, directions: Floats, noise: Floats | None) -> dict[str, float]:
    """Return the dilution of each candidate model that the poses determine, smallest first."""
    names = NORM_MODELS if model == 'auto' else (model,)
    dilutions = {name: dilution(name, directions, noise) for name in names
                 if len(directions) >= poses_needed(name)}
    determined = {name: each for name, each in dilutions.items() if each <= LARGEST_DILUTION}
    if names[0] not in determined:
        refuse_if_unfit(names[0], directions, noise)
    return determined


def _fit_norm(name: str, poses_g: Poses) -> tuple[Fit, NDArray[np.intp]]:
    """Fit a model without the outliers; model 9 in its own axes."""
    form = MODELS[name]
    try:
        fit, kept = fit_norm(form.norm, poses_g)
    except NotConvergedError:
        raise RefusedFitError(
            f'the {len(poses_g)} poses are not on an ellipsoid, but model {name} needs one',
            f'{TAKE_ALL_SIDES}, and hold it still in each') from None
    if form.sensing_axes:
        fit = _in_sensing_axes(fit.model.linear_part, poses_g.take(kept))
    return fit, kept


def _in_sensing_axes(linear_part: tuple[Floats, Floats], poses_g: Poses) -> Fit:
    """Return model 9 at these poses, from W in any axes, and V."""
    mat_w, vec_v = linear_part
    turned = with_linear_part(lower_triangular(mat_w), vec_v).values
    model = Model({name: turned.get(name, np.zeros(3)) for name in MODELS['9'].effects})
    return judge(model, poses_g, TIES)


def _fit_rows(poses_g: Poses, name: str, method: Method) -> Fit:
    if method == 'ml':
        return estimate(start_of(name, poses_g.reading), poses_g)
    mat_w, vec_v = closed_form(name, poses_g.reading)
    if not np.all(np.isfinite(mat_w)):
        raise RefusedFitError(f'the poses are not on an ellipsoid, but model {name} needs one',
                              TAKE_ALL_SIDES)
    if MODELS[name].sensing_axes:
        return _in_sensing_axes(_of_the_report(mat_w, vec_v, poses_g), poses_g)
    return judge(start_of(name, poses_g.reading), poses_g)


def _of_the_report(mat_w: Floats, vec_v: Floats, poses_g: Poses) -> tuple[Floats, Floats]:
    """Return the W and V that minimise the sum of (|a| - g)², eq. 17 of the ESGI'95 report."""
    effects = MODELS['10'].effects

    def point_at(values: Floats) -> Point:
        model = with_vector(effects, values)
        u = sensor_force(model, poses_g.reading, {})
        length = np.linalg.norm(u, axis=1)
        rows = (u / length[:, np.newaxis]) @ np.linalg.inv(model.linear_part[0])
        return Point(length - 1.0, model.basis(u, {}).along(rows))

    values = with_linear_part(mat_w, vec_v).values
    start = np.concatenate([values[name] for name in effects])
    free = np.full(len(start), np.inf)
    found, _ = solve(point_at, start, -free, free)
    return with_vector(effects, found).linear_part


def _choose(fits: Mapping[str, Fit]) -> tuple[str, str]:
    """Return the smallest model that the data support, and the reason."""
    chosen, *larger = fits
    reasons: list[str] = []
    for name in larger:
        chance = _by_chance(fits[chosen], fits[name])
        change = f'{_rms_mg(fits[chosen]):.3g} to {_rms_mg(fits[name]):.3g} mg'
        if chance < _LEVEL:
            reasons.append(f'model {name} reduces the residual of model {chosen} from {change} '
                           f'(by chance: p = {chance:.1g})')
            chosen = name
        else:
            reasons.append(f'model {name} would change it from {change}, which noise explains '
                           f'(p = {chance:.2g})')
    return chosen, '; '.join(reasons) or f'the poses determine only model {chosen}'


def _rms_mg(fit: Fit) -> float:
    return float(np.sqrt(np.mean(fit.equations.of_poses(fit.residual) ** 2))) * MG


def _by_chance(small: Fit, large: Fit) -> float:
    """Return the probability that noise alone explains the improvement by the larger model."""
    from scipy.special import fdtrc

    if large.variance_dof <= 0:
        return 1.0
    added = small.dof - large.dof
    gained = max(small.chi2 - large.chi2, 0.0) / added
    return float(fdtrc(added, large.variance_dof, gained / max(large.variance, 1e-300)))


def rejected_by(model: Model, poses_g: Poses) -> tuple[Rejected, ...]:
    """Return outliers with their distance from 1 g under a model."""
    if not len(poses_g):
        return ()
    away = np.linalg.norm(sensor_force(model, poses_g.reading, {}), axis=1) - 1.0
    return tuple(Rejected(int(row), f'outlier: |force| differs by {error * MG:+.2f} mg from 1 g '
                          'in the fit of the others', 'outlier')
                 for row, error in zip(poses_g.row, away, strict=True))
