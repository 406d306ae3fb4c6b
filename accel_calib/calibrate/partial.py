# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrations from few poses, with the typical values of sensors (`.prior`).

A robot with wheels tilts by 10° or 20°. Its poses do not determine offset and gain, and a fit is
refused. Three results are still possible:

- `mounting_only`: no values at all. The calibration carries the mounting ΔR after `level`.
- `fit_partial`: the values of model 10 that are most probable for a common sensor with these
  readings (maximum a posteriori).
- `fit_with_fleet`: the same, for a sensor of a fleet whose values are known. Poses are left out as
  knocked only if the poses determine the values without the fleet.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .calibration import Calibration, FLEET, PRIOR, Rejected
from .fit import deviations_g, finished, sound_rows, sure_rows, uncertainty_g
from .pose_planning import determines, enumerated, missing_poses, turn_words
from .prior import (
    FIRST_NOISE_G, FLEET_NOISE_G, FleetPrior, LARGEST_ERROR_G, most_probable, NAME, PriorFit,
    priors_of, UNLIKE_FLEET)
from .quality import fit_findings, in_g, record_of
from .unknown_orientation import copies, only_norm, rejected_by
from ..effects import AXES, EFFECTS, Model, MODELS, sensor_force
from ..errors import InputError, RefusedFitError
from ..estimate import Fit, judge, LARGEST_SHARE, NotConvergedError
from ..finding import Finding, without
from ..geometry import Cone, cone_of, unit
from ..table import check_units, Floats, Poses
from ..text import counted
from ..units import MG, Units


def mounting_only(poses: Poses, units: Units, *, sensor: str = '', date: str = ''
                  ) -> Calibration:
    """
    Return a calibration named ``ideal``, without effects and with ΔR = I, to be levelled.

    `level` adds the mounting. A warning states the error that is left in a common sensor.
    Parameters as in `fit_partial`.

    Raises
    ------
    InputError
        If the readings are in native units, or clearly in another unit.
    RefusedFitError
        If no row is a plausible reading at rest.

    """
    sound, rejected = usable(poses, units, 'a mounting')
    fit = judge(Model({}), only_norm(in_g(sound, units)))
    return finished(record_of(
        fit, poses, units, unit(sound.reading), 'ideal', PRIOR, rejected=rejected,
        reason='mounting alone: offset and gain are not calibrated',
        noted=(Finding('open', _not_calibrated()),), sensor=sensor or poses.sensor, date=date),
        poses)


def _not_calibrated() -> str:
    offset = EFFECTS['offset'].typical
    return ('offset and gain are not calibrated: a common sensor has an offset of '
            f'{offset * MG:.0f} mg on each axis, so |a| is off by about as much, and away from '
            f'the level pose the tilt by about {np.degrees(np.arcsin(offset)):.0f}°')


def fit_partial(poses: Poses, units: Units, *, sensor: str = '', date: str = '') -> Calibration:
    """
    Fit model 10 to poses near one direction, with the spread of common sensors as the prior.

    Use this function if a fit is refused and `lies_in_cone` is true for the directions. If the
    sensor can be turned, a fit with more poses is better. Only |force| = 1 g is used, even if the
    orientations are known.

    Parameters
    ----------
    poses : Poses
        Still poses, one or more, in the unit of the readings.
    units : Units
        Unit of the readings, not native.
    sensor, date : str
        Stored in the record. By default the name in the poses.

    Returns
    -------
    Calibration
        The calibration with ΔR = I and the method `PRIOR`. Its covariance includes the prior. The
        reason states what the poses determine, and a finding what they leave open.

    Raises
    ------
    InputError
        If the readings are in native units, or clearly in another unit.
    RefusedFitError
        If no row is a plausible reading at rest, or the readings contradict a common sensor.
    ValueError
        If the poses determine model 10.

    """
    sound, rejected = usable(poses, units, 'a partial fit')
    if determines(NAME, unit(sound.reading)):
        raise ValueError(f'the {len(sound)} poses determine model {NAME}, expected poses near '
                         'one direction: use fit_poses')
    found = most_probable(only_norm(in_g(sound, units)), priors_of(), FIRST_NOISE_G,
                          LARGEST_SHARE)
    calibration = _recorded(found, poses, sound, units, PRIOR, rejected)
    about = carried(calibration)
    return finished(replace(
        calibration, sensor=sensor or poses.sensor, date=date, reason=_known_words(about),
        noted=(_open(about), *calibration.noted)), poses)


def fit_with_fleet(poses: Poses, units: Units, fleet: FleetPrior, *, sensor: str = '',
                   date: str = '') -> Calibration:
    """
    Fit model 10 with the typical values of a fleet as the prior.

    Only |force| = 1 g is used, even if the orientations are known. The calibration has ΔR = I and
    the method `FLEET`. Its covariance includes the prior. Parameters as in `fit_partial`.

    Raises
    ------
    InputError
        If the readings are in native units, or clearly in another unit.
    RefusedFitError
        If no row is a plausible reading at rest, or the uncertainty is too large.

    """
    sound, rejected = usable(poses, units, 'a fit with a fleet')
    share = LARGEST_SHARE if determines(NAME, unit(sound.reading)) else 0.0
    try:
        found = most_probable(only_norm(in_g(sound, units)), priors_of(fleet), FLEET_NOISE_G,
                              share)
    except NotConvergedError:
        raise RefusedFitError('the readings contradict the values of the fleet, expected a sensor '
                              'of the same model', 'check the unit and the poses, or fit without '
                              '--prior') from None
    calibration = _recorded(found, poses, sound, units, FLEET, rejected)
    name = f' of model {fleet.model}' if fleet.model else ''
    return finished(replace(
        calibration, sensor=sensor or poses.sensor, date=date,
        reason=f'{counted(len(found.kept), "pose")} with the typical values of '
        f'{counted(fleet.sensors, "sensor")}{name}',
        noted=(*(UNLIKE_FLEET,) * found.is_unlike, *calibration.noted)), poses)


def _recorded(found: PriorFit, poses: Poses, sound: Poses, units: Units, method: str,
              rejected: tuple[Rejected, ...]) -> Calibration:
    """Return a fit to the sound poses as a calibration."""
    out = sound.take(~np.isin(found.original, found.kept))
    return record_of(
        found.fit, poses, units, unit(sound.reading)[found.kept], NAME, method,
        rejected=(*rejected, *rejected_by(found.fit.model, in_g(out, units))),
        noted=(*copies(found.original, sound), *partial_findings(found.fit)))


def usable(poses: Poses, units: Units, what: str) -> tuple[Poses, tuple[Rejected, ...]]:
    """Return the plausible poses, without doubtful ones if others are left, and the other rows."""
    if units.is_native:
        raise InputError(f'the readings are in native units, and {what} does not determine their '
                         'scale; expected readings in m/s2 or g', 'convert the readings, or turn '
                         'the sensor to 9 or more poses spread over the sphere and fit')
    check_units(poses, units)
    sound, rejected = sound_rows(poses, units)
    sound, others = _of_plausible_length(sound, units)
    rejected = (*rejected, *others)
    sure, doubts = sure_rows(sound)
    if len(sure):
        sound, rejected = sure, (*rejected, *doubts)
    if not len(sound):
        raise RefusedFitError(f'found 0 sound poses of {counted(len(poses), "row")}, expected at '
                              'least 1', 'hold the sensor still and capture a pose')
    return sound, rejected


def _of_plausible_length(poses: Poses, units: Units) -> tuple[Poses, tuple[Rejected, ...]]:
    """Separate readings of about 1 g from others, which are no readings of gravity alone."""
    length = np.linalg.norm(units.to_g(poses.reading), axis=1)
    near = np.abs(length - 1.0) <= LARGEST_ERROR_G
    return poses.take(near), tuple(
        Rejected(int(row), f'the length of the reading is {size:.3g} g, expected about 1 g')
        for row, size in zip(poses.row[~near], length[~near], strict=True))


def partial_findings(fit: Fit) -> tuple[Finding, ...]:
    """Return the findings about the noise of the poses."""
    found = fit_findings(fit, 0.0)
    if fit.dof > 0:
        return found
    return (Finding('no_check', f'{counted(len(fit.poses_g), "pose")} cannot show whether poses '
                    'repeat as well as the noise of their samples predicts', 'take more poses'),
            *without(found, 'no_check'))


@dataclass(frozen=True)
class Carried:
    """
    What the poses of a partial fit determine, and what they leave open.

    All fields but `count` and `cone` are standard deviations. Those of |force| are along the mean
    direction of the poses, and the largest among the poses and over the sphere [g]. Those of the
    offset are along this direction, and the largest across it [g]. `tilt_deg` is that of up before
    the mounting is levelled [°], `gain` is (3,), and `cross_axis` is the largest.

    """

    count: int
    cone: Cone
    along_g: float
    among_g: float
    elsewhere_g: float
    offset_along_g: float
    offset_across_g: float
    tilt_deg: float
    gain: Floats
    cross_axis: float


def carried(calibration: Calibration) -> Carried:
    """Return what the poses of a calibration from `fit_partial` determine."""
    model, covariance = calibration.model, calibration.covariance
    reading = calibration.units.to_g(calibration.used_poses.reading)
    up = unit(sensor_force(model, reading, {}))
    cone = cone_of(up)
    axis = cone.axis[np.newaxis]
    moved = np.linalg.solve(model.linear_part[0], model.basis(axis, {}).full[0])
    deviation = np.sqrt(np.diag(covariance))
    place = {name: [own.startswith(f'{name}.') for own in calibration.parameters]
             for name in MODELS[NAME].effects}
    offset = covariance[np.ix_(place['offset'], place['offset'])]
    return Carried(
        len(up), cone, float(deviations_g(calibration, axis)[0]),
        float(np.max(deviations_g(calibration, up))), uncertainty_g(calibration),
        float(np.sqrt(cone.axis @ offset @ cone.axis)), _across(offset, cone.axis),
        float(np.degrees(_across(moved @ covariance @ moved.T, cone.axis))),
        deviation[place['axis_gain']], float(np.max(deviation[place['cross_axis']])))


def _across(covariance: Floats, axis: Floats) -> float:
    """Return the largest standard deviation at right angles to an axis."""
    across = np.eye(3) - np.outer(axis, axis)
    return float(np.sqrt(np.max(np.linalg.eigvalsh(across @ covariance @ across))))


def _known_words(about: Carried) -> str:
    """Return a text about what the poses determine."""
    if about.count == 1:
        return (f'1 pose: along gravity the sum of offset and gain, and so |a|, is known to '
                f'{_mg(about.along_g)}')
    return (f'the {about.count} poses lie within {about.cone.degrees:.0f}° of one direction: '
            'along gravity the sum of offset and gain, and so |a|, is known to '
            f'{_mg(about.along_g)}, and at each pose |a| to {_mg(about.among_g)}')


def _open(about: Carried) -> Finding:
    """Return what the poses leave open, and the poses that determine it."""
    gains = enumerated([f'±{100.0 * gain:.1f} % on {axis}'
                        for axis, gain in zip(AXES, about.gain, strict=True)])
    missing = turn_words(missing_poses(NAME, about.cone.axis[np.newaxis]))
    return Finding(
        'open', f'open: offset along gravity ±{_mg(about.offset_along_g)}, across it '
        f'±{_mg(about.offset_across_g)} ({about.tilt_deg:.1f}° of tilt until it is levelled), '
        f'gain {gains}, cross-axis ±{100.0 * about.cross_axis:.1f} %; elsewhere on the sphere '
        f'|a| is known to {_mg(about.elsewhere_g)}', f'to determine them, {missing}')


def _mg(value_g: float) -> str:
    value = value_g * MG
    return f'{value:.0f} mg' if value >= 10.0 else f'{value:.2g} mg'
