# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrations at both ends of a refinement: its base, and the refined one.

**Stored calibration as the base.** The calibration is the simulation, and the new poses are the
measurement. The poses of the calibration are added to the new poses, without their times, because
the clocks of two recordings can differ. If the file was edited by hand, or the new poses are
partly those of the calibration and contradict it, the readings that the calibration predicts
replace its measured ones. Changes of the sensor since the calibration are effects that act only on
the new poses (`accel_calib.effects.CHANGES`). If the context differs between the two sets, effects
of the context compete with these changes.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .base import fitted_state, State
from .words import plain_name
from ..calibrate import (
    BASES, Calibration, fit_findings, fit_poses, gated, in_g, OF_A_FIT, quality_of, record_of,
    refuse_if_unfit, Rejected, sound_rows, sure_rows, uncertainty_g, with_history, with_rest_noise)
from ..effects import CHANGES, included, Model, parameter_names, with_vector
from ..errors import RefusedFitError, TAKE_ALL_SIDES
from ..estimate import estimate, fit_sphere, judge, LARGEST_DILUTION, outliers, variance_factor
from ..finding import Finding, has, without
from ..geometry import unit
from ..table import check_units, Floats, Poses
from ..units import Units

_DIGITS = 7
"""Number of decimals [g] in which two readings of the same pose are equal."""

_SAME = 0.999
"""Quantile of chi² below which a stored calibration agrees with poses of its fit."""

_EITHER = ('temperature', 'supply_voltage', 'rate', 'previous')
"""Context that is set to NaN if the stored poses do not have it, as quantities are."""

_ROUNDS = 6
"""Largest number of fits after which outliers are left out."""

_NAMED = 4
"""Largest number of undetermined values that are named."""


def base_of(poses: Poses, units: Units, name: str, *, sensor: str = '', date: str = ''
            ) -> Calibration:
    """Return the base as a calibration; `sensor`, `date` and errors as in `fit_poses`."""
    if name not in BASES:
        raise ValueError(f'base is {name!r}, expected one of {BASES}')
    if name == 'ideal':
        return ideal(poses, units)
    try:
        return fit_poses(poses, units, model=name, sensor=sensor, date=date)
    except RefusedFitError:
        if name == 'auto' and 'orientation' in poses:
            return ideal(poses, units)
        raise


def ideal(poses: Poses, units: Units) -> Calibration:
    """Return the ideal sensor; for native readings with a fitted offset and scale."""
    values: dict[str, Floats] = {}
    if units.is_native:
        mat_w, vec_v = fit_sphere(poses.reading)
        units = Units('native', float(mat_w[0, 0]))
        values = {'offset': vec_v / units.per_g}
    poses_g = in_g(poses, units)
    fit = judge(Model(values), poses_g)
    return record_of(fit, poses, units, unit(poses_g.reading), 'ideal', 'ml', reason='ideal')


def beside_stored(poses_g: Poses, calibration: Calibration) -> Poses:
    """
    Return new poses in g followed by those of a stored calibration, with the column ``new``.

    Return only the new poses, without this column, if the calibration has no effects or no poses,
    or was fitted to some of the new poses and still agrees with them.

    """
    stored = with_history(in_g(calibration.poses, calibration.units), calibration.model)
    stored = stored.take(np.isin(stored.row, calibration.used_poses.row))
    if not len(stored) or not calibration.model.effects:
        return poses_g
    shared, edited = _shares(poses_g, stored), has(calibration.noted, 'edited')
    if shared and not edited and _agrees(calibration, poses_g):
        return poses_g
    if shared or edited:
        stored = _as_calibrated(stored, calibration)
    count = (len(poses_g), len(stored))
    either = {*_EITHER, *poses_g.quantities}
    columns = {key: _joined(key, poses_g, stored) for key in poses_g.columns
               if key in stored or key in either}
    if 'time' in calibration.ranges:  # limited to the range of the calibration
        held = np.clip(poses_g['time'], *calibration.ranges['time'])
        columns['time'] = np.concatenate([held, stored['time']])
    elif 'time' in poses_g:
        columns['time'] = np.concatenate([poses_g['time'], np.full(count[1], np.nan)])
    if 'orientation' in poses_g:
        least = float(np.min(poses_g['orientation']))
        columns['orientation'] = np.concatenate([
            poses_g['orientation'], least - 1.0 - np.arange(count[1])])
    if 'std' not in columns or 'count' not in columns:
        columns = {key: values for key, values in columns.items() if key not in ('std', 'count')}
    columns['new'] = np.repeat([1.0, 0.0], count)
    return Poses(columns, _rows(poses_g, stored))


def with_stored(poses: Poses, calibration: Calibration) -> Poses:
    """Return poses followed by those of a stored calibration, in the unit of the readings."""
    stored = calibration.used_poses
    columns = {key: np.concatenate([poses[key], stored[key]]) for key in poses.columns
               if key in stored}
    return replace(poses, columns=columns, row=_rows(poses, stored))


def _rows(poses: Poses, stored: Poses) -> NDArray[np.int64]:
    return np.concatenate([poses.row, int(poses.row.max()) + 1 + np.arange(len(stored))])


def _shares(poses_g: Poses, stored: Poses) -> bool:
    """Return whether a pose is in both tables."""
    new, old = ({tuple(row) for row in poses.reading.round(_DIGITS).tolist()}
                for poses in (poses_g, stored))
    return not new.isdisjoint(old)


def _agrees(calibration: Calibration, poses_g: Poses) -> bool:
    """Return whether a fit to the poses is no better than the calibration as stored."""
    from scipy.special import chdtri

    model = Model(calibration.model.values)
    fit = estimate(model, poses_g)
    excess = judge(model, calibration.held(poses_g)).chi2 - fit.chi2
    worse = max(fit.chi2 / max(fit.dof, 1), 1.0)
    return bool(excess / worse < chdtri(len(model.vector), 1.0 - _SAME))


def _as_calibrated(stored: Poses, calibration: Calibration) -> Poses:
    """Return the poses with the readings that the calibration predicts in their directions."""
    here = calibration.model.at(stored.columns)
    return stored.with_columns(reading=here.reading(unit(here.force(stored.reading))))


def _joined(key: str, poses_g: Poses, stored: Poses) -> Floats:
    ours = poses_g[key]
    theirs = stored[key] if key in stored else np.full((len(stored), *ours.shape[1:]), np.nan)
    return np.concatenate([ours, theirs])


def with_changes(model: Model) -> tuple[Model, Floats]:
    """
    Return a model with the changes since the stored calibration included in its effects.

    The (q, p) matrix maps the values of `model` to those of the result.

    """
    effects: list[str] = []
    for name in sorted(model.effects, key=CHANGES.__contains__):  # the changes last
        own = plain_name(name)
        contained = included((own,)).intersection(effects)
        if contained:
            effects[effects.index(contained.pop())] = own
        elif own not in effects and own not in included(effects):
            effects.append(own)
    names = parameter_names(tuple(effects))
    owners = [owner for name in model.effects for owner in _owners(name, effects)]
    matrix = np.array([[name in owner for owner in owners] for name in names], float)
    matrix = matrix.reshape(len(names), len(owners))
    values = with_vector(tuple(effects), matrix @ model.vector).values
    return Model(values, model.rotation), matrix


def _owners(name: str, effects: list[str]) -> list[set[str]]:
    """Return the names of the values, among those of some effects, that each value adds to."""
    own = plain_name(name)
    if own in effects:
        return [{value} for value in parameter_names((own,))]
    whole = tuple(effect for effect in effects if own in included((effect,)))
    return [set(parameter_names(whole))] * len(parameter_names((own,)))


def without_orientation(poses: Poses) -> Poses:
    """Return the poses as poses of unknown orientation."""
    return Poses({key: values for key, values in poses.columns.items()
                  if key not in ('reference', 'orientation')}, poses.row)


@dataclass(frozen=True)
class Given:
    """The input poses, those used [g], whether the base is stored, rejected rows, and notes."""

    poses: Poses
    poses_g: Poses
    stored: bool
    rejected: tuple[Rejected, ...]
    notes: tuple[Finding, ...]

    @property
    def joint(self) -> bool:
        """Whether the poses of the stored calibration are used, too."""
        return 'new' in self.poses_g


def refitted(before: Calibration, poses: Poses, *, sensor: str = '', date: str = ''
             ) -> Calibration:
    """
    Fit the values of a calibration anew to other poses, with the same effects.

    Parameters
    ----------
    before : Calibration
        The calibration; its unit is that of the readings.
    poses : Poses
        Poses with the columns that the effects need.
    sensor, date : str
        Name of the sensor and date for the result.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the values, or the result is not plausible.
    InputError
        If the readings are clearly in another unit.

    """
    check_units(poses, before.units)
    sure, doubts = sure_rows(poses)
    sound, unsound = sound_rows(sure, before.units)
    poses_g = with_history(in_g(sound, before.units), before.model)
    lacking = [key for key in before.model.needs if key not in poses_g]
    if lacking:
        raise RefusedFitError(f'the poses have no {" or ".join(lacking)}, which the calibration '
                              'in use corrects for', 'record it, or call ~/reset')
    given = Given(poses, poses_g, stored=True, rejected=(*doubts, *unsound), notes=())
    final = _settled(before.model, poses_g)
    out = [Rejected(int(row), 'outlier', 'outlier') for row in poses_g.row
           if row not in final.poses_g.row]
    rejected = tuple(sorted((*given.rejected, *out), key=lambda each: each.row))
    calibration, refusal = refined_calibration(before, final, (), given, rejected)
    if refusal:
        raise RefusedFitError(*refusal)
    return replace(calibration, reason=before.reason, sensor=sensor or before.sensor, date=date)


def _settled(model: Model, poses_g: Poses) -> State:
    """Return the state of a model fitted to poses without the outliers."""
    kept, out = poses_g, np.zeros(0, np.intp)
    for _ in range(_ROUNDS):
        kept = kept.take(np.setdiff1d(np.arange(len(kept)), out))
        state = fitted_state(Model(model.values), kept)
        if state is None:
            break
        out = outliers(state.fit, len(poses_g)).poses
        if not len(out):
            return state
    raise RefusedFitError('the effects of the calibration cannot be fitted to these poses, '
                          'expected a fit that converges', TAKE_ALL_SIDES)


def refined_calibration(base: Calibration, final: State, added: tuple[str, ...], given: Given,
                        rejected: tuple[Rejected, ...]) -> tuple[Calibration, tuple[str, ...]]:
    """Return the refined calibration, and the refusal if it must not be used."""
    model, matrix = with_changes(final.model)
    kept, poses = final.poses_g, given.poses
    unchanged = final.model.effects == model.effects
    if given.joint and unchanged and all(key in base.poses for key in model.needs):
        poses = with_stored(given.poses, base)
    elif given.joint:
        kept = kept.take(kept['new'] > 0.0)
    at_poses = judge(model, kept if base.form.known_orientation
                     else without_orientation(kept))
    names = ', '.join(plain_name(name) for name in added)
    others = without(base.noted, *OF_A_FIT)
    findings = [each for each in others if not given.stored or each.kind == 'flat_pose']
    refined = replace(
        base, model=Model(model.values, base.model.rotation),
        covariance=matrix @ final.fit.covariance @ matrix.T,
        quality=quality_of(at_poses, base.units, unit(at_poses.equations.force)), poses=poses,
        rejected=rejected, noted=(*given.notes, *findings), method='ml',
        reason=f'{base.reason}; refined: {names or "nothing added"}')
    try:
        return _determined(gated(with_rest_noise(refined, given.poses)), final)
    except RefusedFitError as refused:
        return refined, (refused.message, refused.advice)


def _determined(refined: Calibration, final: State) -> tuple[Calibration, tuple[str, ...]]:
    """Return a calibration with findings, or a refusal if the poses do not determine it."""
    fit = final.fit
    if refined.name == 'ideal':  # an offset that was not fitted is not zero
        refuse_if_unfit('4', unit(fit.equations.force))
    if fit.undetermined:
        return refined, (f'the poses do not determine {", ".join(fit.undetermined[:_NAMED])}'
                         f'{", …" if len(fit.undetermined) > _NAMED else ""}',
                         TAKE_ALL_SIDES)
    factor = variance_factor(fit.chi2, fit.dof, fit.noise_known)
    dilution = uncertainty_g(refined) / float(np.median(fit.equations.scale) * np.sqrt(factor))
    if dilution > LARGEST_DILUTION:
        return refined, ('the poses do not determine the refined calibration: the error of |a| '
                         f'is up to {dilution:.3g} times that of a pose, expected less than '
                         f'{LARGEST_DILUTION:.0f} times',
                         TAKE_ALL_SIDES)
    return replace(refined, noted=(*refined.noted, *fit_findings(fit, dilution))), ()
