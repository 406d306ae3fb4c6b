# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The public functions, such as ``ac.fit`` after ``import accel_calib as ac``."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
import math
from os import PathLike
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from .calibration import Calibration as Calibration, Verification, verify as verify_calibration
from .comparison import compare as compare_calibrations, Comparison
from .effects import model_with, own_effects, OwnEffect, simulate_poses, simulate_recording
from .errors import InputError
from .geometry import rotation_from_rpy, spread_directions, unit
from .logs import (
    are_samples, Frame, LogOptions, read_poses as read_pose_table,
    read_recording as read_whole_recording)
from .pipeline import calibrated, calibrated_log, captured_from, Flat, options_for, Plan, poses_of
from .refinement import refine as find_effects, Refinement as Refinement
from .stored import read_calibration
from .table import (
    check_units, check_values, Floats, in_unit, LARGEST, median_length, numbered, Poses as Poses,
    Recording as Recording, Table)
from .text import now
from .units import FrameName, Method, STANDARD_GRAVITY, UnitName, units_of

Effect = OwnEffect
Source = str | PathLike[str]
Data = Any
"""A table, an (n, 3) array of readings, or a DataFrame with the column names of any log."""

_MOST_ROWS = 10_000_000
"""Largest number of simulated rows, which take some 2 GB."""


def load(path: Source, *, also: Sequence[Effect] = ()) -> Calibration:
    """
    Read a stored calibration.

    Parameters
    ----------
    path : str or Path
        YAML file written by `Calibration.save`, a command or the node.
    also : sequence of Effect
        Own effects that the calibration may have.

    Returns
    -------
    Calibration
        The calibration, with a warning if the file was edited by hand.

    Raises
    ------
    StoredCalibrationError
        If the file is damaged, has another version, or has implausible values.
    OSError
        If the file cannot be read.

    """
    return read_calibration(Path(path), own_effects(also))


def read_poses(path: Source) -> Poses:
    """
    Read a pose table: text in any dialect, with the columns by name.

    Parameters
    ----------
    path : str or Path
        The table.

    Returns
    -------
    Poses
        The poses, in the unit of the table.

    Raises
    ------
    InputError
        If the table cannot be read, or is a recording.
    OSError
        If the file cannot be read.

    """
    return read_pose_table(Path(path))


def read_recording(path: Source, *, topic: str = '', sensor: str = '', in_child: bool = True
                   ) -> Recording:
    """
    Read a recording.

    Any format of docs/log_formats.md.

    Parameters
    ----------
    path : str or Path
        File or folder.
    topic : str
        Imu topic, for a bag with several Imu topics.
    sensor : str
        frame_id of the messages to read, for a topic with several sensors.
    in_child : bool
        Whether a binary file is read in a child process, which damaged bytes may end.

    Returns
    -------
    Recording
        All samples.

    Raises
    ------
    InputError
        If the recording cannot be read, or contains no samples or samples of several sensors.
    OSError
        If the file cannot be read.

    """
    return read_whole_recording(Path(path), topic, sensor, in_child=in_child)


def capture(recording: Source | Recording | Data, *, units: UnitName | None = None,
            gravity: float = STANDARD_GRAVITY, topic: str = '', sensor: str = '',
            **settings: Any) -> Poses:
    """
    Find the still poses of a recording.

    Parameters
    ----------
    recording : str, Path, Recording or DataFrame
        The samples, with times. A DataFrame has the columns of any log.
    units : {'m/s2', 'g', 'native'}, optional
        Unit of the readings; by default the unit of the recording, or m/s².
    gravity : float
        Local gravity [m/s²].
    topic, sensor : str
        As in `read_recording`.
    **settings
        Fields of `accel_calib.stillness.CaptureSettings`, such as ``min_dwell=2.0``;
        ``still_std_max`` is in the unit of the readings. Also fields of
        `accel_calib.logs.LogOptions`, such as ``columns={'ax': 'acc_x'}``.

    Returns
    -------
    Poses
        The poses, in the unit of the readings and in order of time.

    Raises
    ------
    InputError
        If there is no still stretch, the readings are clearly in another unit, or a setting is
        out of range.

    """
    if not isinstance(recording, str | PathLike | Recording) and (
            isinstance(recording, Table) or not hasattr(recording, 'columns')):
        raise InputError(f'found {type(recording).__name__}, expected a recording',
                         'pass a path, a Recording, or a DataFrame with times')
    found, _ = captured_from(*_asked(recording, units, gravity, {
        'topic': topic, 'sensor': sensor, **settings}))
    return found.poses


def calibrate(log: Source | Poses | Recording | Data, *, units: UnitName | None = None,
              gravity: float = STANDARD_GRAVITY, flat: Flat = None,
              nose_down: int | None = None, frame: FrameName = 'ros', sensor: str = '',
              refined: bool = True, also: Sequence[Effect] = (), **settings: Any) -> Calibration:
    """
    Calibrate from any log: read or capture the poses, fit, find further effects, and level.

    A recording of a still board whose temperature changes gives the offset over temperature alone.

    Parameters
    ----------
    log : str, Path, Poses, Recording, DataFrame or (n, 3) array
        A recording or a pose table. A DataFrame has the columns of any log.
    units, gravity
        As in `fit`.
    flat : int, 'first' or 'last', optional
        Pose with the robot level: its row, 1-based, or the first or last pose.
    nose_down, frame
        As in `fit`.
    sensor : str
        Name of the sensor; for a bag, frame_id of the messages to read.
    refined : bool
        Whether to look for effects beyond offset and gain, and to add them.
    also : sequence of Effect
        Own effects, which are tried beside those of the catalogue.
    **settings
        As in `capture`.

    Returns
    -------
    Calibration
        The calibration; its `rating` says whether it is good.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model, or the result is not plausible.
    InputError
        If the log cannot be read, has no still stretch, or a setting is out of range.
    OSError
        If the file cannot be read.

    """
    plan = Plan(refined=refined, flat=flat, nose_down=nose_down, frame=frame, sensor=sensor,
                also=own_effects(also))
    source, options, asked = _asked(log, units, gravity, {'sensor': sensor, **settings})
    found = poses_of(source, options, asked)
    return calibrated_log(source, options, found, plan).calibration


def fit(poses: Source | Poses | Data, *, units: UnitName | None = None,
        gravity: float = STANDARD_GRAVITY, model: str = 'auto', method: Method = 'ml',
        flat: int | None = None, nose_down: int | None = None, frame: FrameName = 'ros',
        sensor: str = '') -> Calibration:
    """
    Fit a calibration to still poses.

    Parameters
    ----------
    poses : str, Path, Poses, DataFrame or (n, 3) array
        The poses; a recording is captured.
    units : {'m/s2', 'g', 'native'}, optional
        Unit of the readings; by default that of the poses, or m/s² for an array.
    gravity : float
        Local gravity [m/s²].
    model : {'auto', '4', '7', '9', '10', '12'}
        Number of parameters, or the smallest of 4, 7 and 10 that the poses support. Poses in a
        plane are fitted by 10, with the typical values of sensors for what they do not show.
    method : {'ml', 'algebraic'}
        Maximum likelihood, or the cost functions of AN5286 and the ESGI'95 report.
    flat : int, optional
        Row of a pose with the robot level, 1-based. It determines the mounting ΔR up to the
        heading.
    nose_down : int, optional
        Row of a pose with the nose of the robot tilted straight down, 1-based. It determines the
        heading.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    sensor : str
        Name of the sensor; by default the name in the poses.

    Returns
    -------
    Calibration
        The calibration, with its uncertainty, quality and warnings.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model, or the result is not plausible.
    InputError
        If the readings are clearly in another unit, or a row does not exist.

    """
    plan = Plan(model=model, method=method, refined=False, flat=flat, nose_down=nose_down,
                frame=frame, sensor=sensor)
    found = poses_of(*_asked(poses, units, gravity))
    return calibrated(found.poses, found.units, plan).calibration


def refine(poses: Source | Poses | Data, *, base: str | Calibration = 'auto',
           units: UnitName | None = None, gravity: float = STANDARD_GRAVITY, sensor: str = '',
           also: Sequence[Effect] = ()) -> Refinement:
    """
    Find effects that a calibration lacks, and add them to it.

    Parameters
    ----------
    poses : str, Path, Poses, DataFrame or (n, 3) array
        The poses, with all known columns of context.
    base : {'auto', 'ideal', '4', '7', '10', '12'} or Calibration
        The model to start from. A stored calibration is compared as it is, without a new fit.
    units : {'m/s2', 'g', 'native'}, optional
        Unit of the readings; by default the unit of the poses, or of the base, or m/s².
    gravity : float
        Local gravity [m/s²]; not used with a stored calibration.
    sensor : str
        Name of the sensor; by default the name in the poses.
    also : sequence of Effect
        Own effects, which are tried beside those of the catalogue.

    Returns
    -------
    Refinement
        The verdict, the effects with their residuals before and after, and the refined
        calibration, in the unit of the poses.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the base, or are too few to find an effect.
    InputError
        If the readings are clearly in another unit.

    """
    start: str | Calibration = base
    if isinstance(base, Calibration):
        start, table = _beside(base, poses, units)
        known = start.units
    else:
        read = poses_of(*_asked(poses, units, gravity))
        table, known = read.poses, read.units
    return find_effects(table, known, base=start, sensor=sensor, date=now(),
                        also=own_effects(also))


def verify(poses: Source | Poses | Data, calibration: Source | Calibration, *,
           units: UnitName | None = None) -> Verification:
    """
    Compute the residuals of a calibration on poses that it was not fitted to.

    Parameters
    ----------
    poses : str, Path, Poses, DataFrame or (n, 3) array
        The poses. A calibration in g is converted for poses in m/s², and the other way round.
    calibration : str, Path or Calibration
        The calibration.
    units : {'m/s2', 'g', 'native'}, optional
        Unit of the readings; by default the unit of the poses, or that of g and m/s² that their
        length shows.

    Returns
    -------
    Verification
        Residual before and after [mg], largest errors [%], and noise floor [mg].

    Raises
    ------
    InputError
        If the readings are clearly in another unit, or lack a column that the effects need, or if
        only one of calibration and poses is in native units.

    """
    stored = calibration if isinstance(calibration, Calibration) else load(calibration)
    known, table = _beside(stored, poses, units)
    check_units(table, known.units)
    return verify_calibration(known, table)


def compare(calibrations: Sequence[Source | Calibration]) -> Comparison:
    """
    Test whether calibrations of one sensor agree within their uncertainties.

    Parameters
    ----------
    calibrations : sequence of str, Path or Calibration
        Two or more calibrations.

    Returns
    -------
    Comparison
        Whether they agree, and where they differ.

    Raises
    ------
    InputError
        If the calibrations cannot be compared.

    """
    return compare_calibrations([each if isinstance(each, Calibration) else load(each)
                                 for each in calibrations])


@overload
def simulate(effects: Mapping[str, ArrayLike] = ..., *, recording: Literal[False] = ...,
             **options: Any) -> Poses: ...


@overload
def simulate(effects: Mapping[str, ArrayLike] = ..., *, recording: Literal[True],
             **options: Any) -> Recording: ...


@np.errstate(over='ignore', invalid='ignore')  # the check refuses such numbers
def simulate(effects: Mapping[str, ArrayLike] = {}, *, recording: bool = False, poses: int = 24,
             directions: ArrayLike | None = None, noise: float = 0.003, samples: int = 100,
             rate: float = 100.0, dwell: float = 3.0, turn: float = 1.0,
             temperature: ArrayLike = (), mounting: ArrayLike = (0.0, 0.0, 0.0),
             reference: bool = False, units: UnitName = 'm/s2',
             gravity: float = STANDARD_GRAVITY, seed: int = 0, also: Sequence[Effect] = (),
             **context: ArrayLike) -> Poses | Recording:
    """
    Simulate poses, or a recording, of a sensor with known effects.

    Parameters
    ----------
    effects : mapping of str to array
        Values by effect, in the units of the catalogue (g); one value is used for all axes.
    recording : bool
        Return samples of a sensor that is turned, instead of pose means.
    poses : int
        Number of poses, spread evenly over the sphere; the first pose is flat. The others are in
        mixed order, so that direction is not correlated with time or temperature.
    directions : (n, 3) array, optional
        Directions of up in the levelled frame, of any length; they replace `poses`.
    noise : float
        Standard deviation of a sample [g].
    samples : int
        Samples per pose.
    rate, dwell, turn : float
        For a recording: samples per second, and duration of each rest and of each turn [s].
    temperature : (2,) or (n,) array
        First and last temperature, or the temperature of each pose [°C].
    mounting : (3,) array
        Roll, pitch and yaw of the sensor on the robot [°].
    reference : bool
        Add the true specific force as ``reference`` (known orientation).
    units : {'m/s2', 'g', 'native'}
        Unit of the result.
    gravity : float
        Local gravity [m/s²].
    seed : int
        Seed of the noise.
    also : sequence of Effect
        Own effects that `effects` can name.
    **context : array
        Further columns of context, such as ``time`` [s]; n rows each.

    Returns
    -------
    Poses or Recording
        The readings in that unit. A recording has the angular rate, too.

    Raises
    ------
    InputError
        If an effect is not in the catalogue, or needs a column that is missing; or a number is
        out of range, or makes readings beyond any sensor.

    """
    rows = min(poses, _MOST_ROWS) * (dwell + turn) * rate if recording else 0
    for name, value, least, most in (
            ('poses', poses, 1, _MOST_ROWS), ('samples', samples, 1, _MOST_ROWS),
            ('noise', noise, 0, LARGEST), ('seed', seed, 0, math.inf),
            ('rate', rate, 1e-9, LARGEST), ('dwell', dwell, 0, LARGEST),
            ('turn', turn, 0, LARGEST),
            ('poses * (dwell + turn) * rate', rows, 0, _MOST_ROWS)):
        if not least <= value <= most:
            raise InputError(f'{name} is {str(value)[:40]}, expected {least:g} to '
                             f'{most:g}', f'correct {name}')
    known = units_of(units, gravity)
    # The attitude transforms from sensor to robot axes, ΔR from robot to sensor axes.
    rotation = rotation_from_rpy(*np.radians(np.asarray(mounting, float))).T
    model = model_with(effects, rotation, own_effects(also))
    up = _unit_directions(directions, poses)
    rng, warm = np.random.default_rng(seed), np.asarray(temperature, float)
    is_ramp = warm.shape in ((0,), (2,))
    columns = {key: np.asarray(values, float) for key, values in (
        context if is_ramp else {**context, 'temperature': warm}).items()}
    for key, values in columns.items():
        if recording or values.shape[:1] != (len(up),):
            expected = 'no value by pose in a recording' if recording else f'{len(up)} rows'
            raise InputError(f'{key} has shape {values.shape}, expected {expected}',
                             f'give {key} for each pose')
    if recording:
        found: Table = simulate_recording(model, up, rng, noise_g=noise, rate_hz=rate, dwell=dwell,
                                          turn=turn, temperatures=warm.tolist())
    else:
        if is_ramp and len(warm):
            columns['temperature'] = np.linspace(warm[0], warm[1], len(up))
        found = simulate_poses(model, up, rng, noise_g=noise, samples=samples,
                               context={'reference': up, **columns})
    found = in_unit(found, known.from_g, native=known.is_native)
    if not np.all(np.abs(found.reading) < LARGEST):
        raise InputError('the simulated readings are beyond any sensor, expected finite numbers '
                         f'below {LARGEST:g}', 'use smaller effects, noise and temperatures')
    kept = found if reference else found.without_columns('reference')
    return replace(kept, units=units)  # type: ignore[return-value]


def _unit_directions(given: ArrayLike | None, count: int) -> Floats:
    """Return the given directions, or as many spread evenly, the first up, in mixed order."""
    if given is None:
        mixed = np.random.default_rng(count).permutation(spread_directions(count)[1:])
        return np.vstack([[[0.0, 0.0, 1.0]], mixed])
    up = np.asarray(given, float)
    if up.ndim != 2 or up.shape[1] != 3 or not np.all(np.linalg.norm(up, axis=1) > 0.0):
        raise InputError(f'directions has shape {up.shape}, expected (n, 3) vectors',
                         'give a vector other than zero for each pose')
    return unit(up)


def _asked(given: Source | Poses | Recording | Data, units: UnitName | None,
           gravity: float = STANDARD_GRAVITY, settings: Mapping[str, Any] = {}
           ) -> tuple[Any, LogOptions, dict[str, Any]]:
    """Return a source of poses, how to read it, and the settings of the capture."""
    of_log = {each.name for each in fields(LogOptions)} & settings.keys()
    options = LogOptions(units=units or '', gravity=gravity,
                         **{name: settings[name] for name in of_log})
    source: Any = given
    if isinstance(given, str | PathLike):
        source = Path(given)
    elif hasattr(given, 'columns') and not isinstance(given, Table):
        source = Frame(given)
    elif not isinstance(given, Table):
        reading: Floats = np.ma.asarray(given, float).filled(np.nan)
        columns, shape = {'reading': reading}, reading.shape
        if len(shape) != 2 or shape[1] != 3:
            raise InputError(f'the array has shape {shape}, expected (n, 3) readings',
                             'pass such an array, a table or a DataFrame')
        check_values(columns, 'the array')
        if are_samples(columns):
            raise InputError(f'the {shape[0]} rows of the array look like samples of a recording, '
                             'expected one row for each pose', 'pass a Recording, or a DataFrame '
                             'with a column time')
        source = Poses(columns, numbered(columns))
    return source, options, {name: settings[name] for name in settings if name not in of_log}


def _beside(calibration: Calibration, given: Source | Poses | Data, units: UnitName | None
            ) -> tuple[Calibration, Poses]:
    """Return a calibration in the unit of poses, and these poses."""
    source, options, settings = _asked(given, units)
    poses = poses_of(source, options_for(calibration, options), settings).poses
    return in_units_of(calibration, replace(poses, units=units or poses.units)), poses


def in_units_of(calibration: Calibration, table: Table) -> Calibration:
    """
    Return the same calibration for the readings of a table.

    If the table states no unit, the median length of the readings decides between g and m/s².

    """
    own = calibration.units
    if table.units or own.is_native or not len(table):
        return calibration.in_units(table.units or own.name)
    other = calibration.in_units('g' if own.is_si else 'm/s2')
    length = median_length(table.reading)
    border = math.sqrt(own.per_g * other.units.per_g)
    return other if (length > border) is (other.units.per_g > border) else calibration
