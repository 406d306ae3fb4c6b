# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The one way of all surfaces: any log to poses, poses to a calibration, samples to corrected ones.

`poses_of` returns the poses of a log, and captures those of a recording. `calibrated` fits,
refines and levels by a `Plan`; `calibrated_log` also recognises a still board that warms up.
`Correction` applies a stored calibration to samples, block by block.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from pathlib import Path
from typing import Any, Literal, TYPE_CHECKING, TypeVar

import numpy as np

from .calibration import (
    Calibration, check_sensor, Curve, curve_of, determines, directions_of, fit_partial, fit_poses,
    fit_with_fleet, flat_direction, FleetPrior, level, level_by_rows, lies_in_cone, lies_in_plane,
    NORM_MODELS, Outside, outside, PRIOR, thermal_alone, with_curve, without_curve)
from .effects import (
    Context, context_of_samples, entry_of, LADDER, Model, OwnEffect, PROCESSES, thermal_stream)
from .errors import InputError, RefusedFitError, saying
from .finding import explained_by, Finding
from .findings import outside_words, rate, Rating, USES_LIMIT
from .geometry import unit
from .logs import Frame, LogOptions, open_log, OpenLog, Piped, Progress
from .stillness import (
    account_of, capture, Captured, CaptureSettings, cells_of, check_measured, is_one_direction,
    is_turned_over, LEAST_RANGE, LEAST_RESTS, Ramp, ramp_of, rests_in_cells, settings_from)
from .table import check_units, CONTEXT, Poses, range_of, Recording, Table
from .text import counted, now, short
from .units import FrameName, Method, UnitName, Units, units_of

if TYPE_CHECKING:
    from .refinement import Refinement

Source = Path | Piped | Frame | Poses | Recording

_FEW = 6
"""Fewer poses than these are too few for a calibration with all axes."""

_WIDER = (1.5, 4.0, 10.0)
"""Factors by which the limit of the standard deviation is widened, to advise another one."""


@dataclass(frozen=True)
class Intake:
    """
    Poses of a table or captured from a recording, with the unit of their readings.

    `read_as` is how the log was read, empty if nothing was assumed. `notes` are what was left out
    of the log, and `captured` how the poses were captured, if they were.

    """

    poses: Poses
    units: Units
    read_as: str = ''
    notes: tuple[str, ...] = ()
    captured: tuple[str, ...] = ()

    @property
    def said(self) -> str:
        """Return how the log was read and captured, in one line, for an error about it."""
        left_out = (each.text for each in self.poses.findings if each.kind == 'missing')
        return ', '.join(filter(None, (self.read_as, *self.captured, *left_out)))

    @property
    def lines(self) -> tuple[str, ...]:
        """Return `read_as` and the notes, for the terminal and the page."""
        return tuple(filter(None, (self.read_as and f'read as: {self.read_as}', *self.notes,
                                   *self.captured)))


def options_for(calibration: Calibration | None, options: LogOptions) -> LogOptions:
    """Return how to read a log for a calibration: in its unit, if the log states none."""
    if calibration is None:
        return options
    units = calibration.units
    if units.is_native:  # its readings can look like g
        return replace(options, default_units='native')
    return replace(options, gravity=units.per_g) if units.is_si else options


def poses_of(source: Source, options: LogOptions = LogOptions(),
             settings: Mapping[str, Any] = {},
             progress: Progress = lambda done, count: None) -> Intake:
    """
    Return the poses of a log or a table; a recording is captured.

    Parameters
    ----------
    source : Path, Piped, Frame, Poses or Recording
        Pose table or recording, in any format that `accel_calib.logs` reads.
    options : LogOptions
        How to read the log; by default it is recognised.
    settings : mapping
        Fields of `accel_calib.stillness.CaptureSettings` for a recording.
    progress : function of two int
        Called with the number of samples done and of all samples.

    Raises
    ------
    InputError
        If the log cannot be read, or a recording has no still stretch.
    OSError
        If the file cannot be read.

    """
    with _opened(source, options) as log:
        if log.poses is not None:
            settings_from(settings, log.units)  # refuses an unknown one here, too
            return Intake(log.poses, log.units, log.read_as, log.noted())
        return _captured(source, log, options, settings, progress)[0]


def captured_from(source: Source, options: LogOptions, settings: Mapping[str, Any],
                  progress: Progress = lambda done, count: None) -> tuple[Intake, Captured]:
    """Return the poses of a recording and their capture; the rows of a table are samples."""
    with _opened(source, options) as log:
        return _captured(source, log, options, settings, progress)


@contextmanager
def _opened(source: Source, options: LogOptions) -> Iterator[OpenLog]:
    """Open a log, or a table as a log."""
    if not isinstance(source, Table):
        with open_log(source, options) as log:
            yield log
        return
    recorded = isinstance(source, Recording)
    asked, stated = options.units, source.units
    if asked and stated and asked != stated:
        raise InputError(f'the {"recording" if recorded else "pose table"} is in {stated}, '
                         f'expected {asked}', f'set units={stated!r}')
    units = units_of(asked or stated or options.default_units or 'm/s2', options.gravity)
    if isinstance(source, Poses):
        yield OpenLog(iter(()), len(source), units, source.sensor, poses=source)
    else:
        check_units(source, units)
        yield OpenLog(iter((source,)), len(source), units, source.sensor)


def _captured(source: Source, log: OpenLog, options: LogOptions, settings: Mapping[str, Any],
              progress: Progress) -> tuple[Intake, Captured]:
    """Capture the poses of an open log; InputError without a still stretch."""
    asked = settings_from(settings, log.units)
    found = capture(log.watched(progress), log.units, asked)
    if np.any(found.known.least):
        with _opened(source, options) as again:
            found = capture(again.blocks, log.units, asked, found.known)
    check_measured(found.lengths, log.units)
    count, findings = len(found.poses), account_of(found.rests, asked)
    limit, more = 0.0, 0  # the narrowest wider limit that finds enough poses, and how many
    for factor in _WIDER if count < _FEW else ():
        wider = float(f'{factor * max(found.threshold, found.quietest):.2g}')
        if math.isfinite(wider) and more < _FEW:
            widened = settings_from({**settings, 'still_std_max': wider}, log.units)
            with _opened(source, options) as again:
                finds = len(capture(again.blocks, log.units, widened, found.known).poses)
            if finds > more:
                limit, more = wider, finds
    advice = f'{more} with still_std_max {limit:.3g}'
    if not count:
        name = 'the recording' if isinstance(source, Recording) else str(source)
        raise _nothing_still(name, found, log.units, asked, findings, finds=advice if more else '')
    lines = [f'captured {counted(count, "pose")} from {counted(found.recorded, "sample")} in '
             f'{found.seconds:.0f} s']
    if more >= 2 * count:
        lines.append(f'{counted(count, "pose")} only, {advice}')
    return Intake(replace(found.poses, units=log.units.name, findings=(*log.findings, *findings)),
                  log.units, log.read_as, log.noted(), tuple(lines)), found


def _nothing_still(source: str, found: Captured, units: Units, asked: CaptureSettings,
                   findings: Sequence[Finding], finds: str) -> InputError:
    """Return the error for a recording without a still stretch, with the reason if rests have."""
    what = f'{source} has no still stretch in {counted(found.recorded, "sample")}'
    tried = (f'{finds} (wide limits make poses inaccurate)' if finds else
             'a wider limit (still_std_max) finds none either')
    if findings:
        return InputError(f'{what}: {"; ".join(each.text for each in findings)}; expected at '
                          'least one', f'{findings[-1].advice}; {tried}')
    if math.isfinite(found.quietest):
        limit = f', the limit is {found.threshold:.2g}' if math.isfinite(found.threshold) else ''
        what += (f': in its quietest {asked.still_window:g} s the standard deviation is '
                 f'{found.quietest:.2g} {units.name}{limit} for at least {asked.min_dwell:g} s')
    return InputError(f'{what}; expected at least one',
                      f'hold the sensor still in each pose for some seconds; {tried}')


@dataclass(frozen=True)
class RampIntake(Intake):
    """The ramp of a still board; the poses are its stretches [g]."""

    ramp: Ramp = field(kw_only=True)


def ramp_or_poses(source: Path | Piped | Frame, options: LogOptions = LogOptions(),
                  settings: Mapping[str, Any] = {},
                  progress: Progress = lambda done, count: None) -> Intake:
    """
    Return the ramp of a still board, or the poses of a log in many directions.

    Parameters and errors as in `poses_of`. Further InputErrors are those of a ramp
    (`accel_calib.stillness.ramp`).

    """
    with open_log(source, options) as log, saying(
            ', '.join(filter(None, (log.read_as, *log.notes)))):
        cells = _cells(log, log.watched(progress))
        if cells is not None and not is_turned_over(cells):
            return _ramp_intake(cells, log)
    return poses_of(source, options, settings, progress)


def _ramp_intake(cells: Poses, log: OpenLog) -> RampIntake:
    """Return the ramp of a still board from the samples of a log in cells."""
    unused = next((each for each in log.findings
                   if (each.kind, each.about) == ('not_used', 'temperature')), None)
    if unused is not None:
        raise InputError(f'{unused.text}, expected the temperature of the sensor', unused.advice)
    ramp = ramp_of(cells)
    low, high = range_of(ramp.stretches, 'temperature')
    words = f'a still board for {ramp.seconds / 60.0:.0f} min, from {low:.1f} to {high:.1f} °C'
    return RampIntake(ramp.stretches, log.units, log.read_as,
                      captured=(words, *log.notes, *ramp.notes), ramp=ramp)


def _cells(log: OpenLog, samples: Iterable[Recording]) -> Poses | None:
    """Return the samples of a log, or its rests, in cells; None if its poses are in many ways."""
    if log.poses is None:
        return cells_of(samples, log.units)
    return rests_in_cells(log.poses, log.units) if is_one_direction(log.poses.reading) else None


Flat = int | Literal['first', 'last'] | None
"""Row of the flat pose, 1-based, or the first or last pose; None: the mounting stays open."""

FEWEST_IN_CONE = 4
"""Fewest poses near one direction that are fitted; fewer are the beginning of more poses."""


@dataclass(frozen=True)
class Plan:
    """
    How poses become a calibration.

    Parameters
    ----------
    model : {'auto', '4', '7', '9', '10', '12'}
        The model to fit.
    method : {'ml', 'algebraic'}
        Maximum likelihood, or the cost functions of the documents.
    rows : slice, optional
        The poses to fit, by default all; the flat pose can be another one.
    refined : bool
        Look for effects that the calibration lacks, and add them.
    fleet : FleetPrior, optional
        Typical values of sensors of the same model, for few poses; then model 10 is fitted.
    flat : int, 'first', 'last' or None
        Pose with the robot level.
    nose_down : int, optional
        Row of a pose with the nose of the robot tilted down.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    sensor : str
        Name of the sensor; by default the name in the poses.
    also : tuple of OwnEffect
        Own effects of the user, which the search tries beside the catalogue.
    before : Calibration, optional
        The calibration in use. Effects that a refinement has added to it are kept, with new
        values, and the search for effects starts from it. Without a `flat` pose, its levelled
        frame and its mounting are kept.
    partial : bool
        Fit poses that are all near one direction, too, with typical values of sensors, unless
        `before` is a full fit. Poses in a plane from which ``auto`` would fit a smaller model
        are always fitted so.

    """

    model: str = 'auto'
    method: Method = 'ml'
    rows: slice | None = None
    refined: bool = True
    fleet: FleetPrior | None = None
    flat: Flat = None
    nose_down: int | None = None
    frame: FrameName = 'ros'
    sensor: str = ''
    also: tuple[OwnEffect, ...] = ()
    before: Calibration | None = field(default=None, repr=False)
    partial: bool = False


@dataclass(frozen=True)
class Outcome:
    """
    A fitted or refined calibration.

    `refinement` is None if the search for effects was not asked for, or not possible. `line` is
    what was done beyond the fit, and why.

    """

    calibration: Calibration
    refinement: Refinement | None = field(default=None, repr=False)
    line: str = ''

    @cached_property
    def rating(self) -> Rating:
        """Return whether the calibration is good, and the next step."""
        return rate(self.calibration, refinement=self.refinement)


def calibrated(poses: Poses, units: Units, plan: Plan = Plan()) -> Outcome:
    """
    Fit, refine if the poses can carry it, and level, as planned.

    Parameters
    ----------
    poses : Poses
        The poses, in the unit of the readings.
    units : Units
        Unit of the readings.
    plan : Plan
        How to fit, refine and level them.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model, or the result is not plausible.
    InputError
        If the readings are clearly in another unit, or a row does not exist.

    """
    date, chosen = now(), poses if plan.rows is None else poses.take(plan.rows)
    with explained_by(poses.findings):
        calibration = _fit(chosen, units, plan, date)
    refinement, line = None, 'not refined, as asked'
    if plan.refined and is_partial(calibration):
        line = 'not refined: poses in a plane do not show which effect is missing'
    elif plan.refined:
        refinement, line = _refinement(chosen, units, plan, date)
    if refinement is not None and refinement.steps and not refinement.refusal:
        calibration = refinement.calibration
    before = plan.before
    if before is None or plan.flat is not None:
        calibration = level_by_rows(calibration, poses, plan.frame, _row(poses, plan.flat),
                                    plan.nose_down)
    elif before.is_levelled:
        context = before.typical_context(1)
        flat = flat_direction(before.frame) * before.force_per_g
        headed = replace(calibration, model=Model(calibration.model.values, before.rotation),
                         frame=before.frame)
        calibration = level(headed, before.predict(flat[np.newaxis], context)[0], before.frame,
                            context)
    return Outcome(calibration, refinement, line)


def _fit(poses: Poses, units: Units, plan: Plan, date: str) -> Calibration:
    before = plan.before
    if plan.fleet is not None:
        return fit_with_fleet(poses, units, plan.fleet, sensor=plan.sensor, date=date)
    if before is not None and is_refined(before):
        from .refinement import refitted
        return refitted(before, poses, sensor=plan.sensor, date=date)
    if ((before is None or is_partial(before)) and not units.is_native
            and len(poses) >= FEWEST_IN_CONE):
        up, raw = directions_of(poses, units), unit(poses.reading)
        smallest, *_, largest = NORM_MODELS
        in_plane = (  # a smaller model would be fitted, and assume what the poses do not show
            (plan.model, plan.method) == ('auto', 'ml') and 'reference' not in poses
            and lies_in_plane(up) and determines(smallest, raw) and not determines(largest, raw))
        if in_plane or (plan.partial and lies_in_cone(up)):
            return fit_partial(poses, units, sensor=plan.sensor, date=date)
    return fit_poses(poses, units, model=plan.model, method=plan.method, sensor=plan.sensor,
                     date=date)


def is_refined(calibration: Calibration) -> bool:
    """Return whether a calibration has effects beyond offset and gain."""
    return any(name not in LADDER for name in calibration.model.effects)


def is_partial(calibration: Calibration) -> bool:
    """Return whether a calibration is not a full fit: a mounting alone, or a fit to a cone."""
    return calibration.method == PRIOR or not calibration.model.effects


@dataclass(frozen=True)
class ThermalOutcome(Outcome):
    """A calibration with the offset over temperature, its curve, and the logs."""

    curve: Curve = field(kw_only=True)
    logs: Sequence[Intake] = field(kw_only=True)
    read_as: str = field(kw_only=True)


def calibrated_log(source: Source, options: LogOptions, found: Intake, plan: Plan = Plan()
                   ) -> Outcome:
    """
    Calibrate the poses that `poses_of` found in a log, or its ramp if it is of a still board.

    Poses in one direction do not determine a calibration. If the temperature of their recording,
    or of `LEAST_RESTS` poses, spans `LEAST_RANGE`, the board was still while it warmed up.

    """
    poses = found.poses
    if (not found.units.is_native and {'time', 'temperature'} <= {*poses.columns}
            and (found.captured or len(poses) >= LEAST_RESTS) and is_one_direction(poses.reading)):
        with _opened(source, options) as log:
            cells = _cells(log, log.blocks)
            if cells is not None and np.ptp(range_of(cells, 'temperature')) >= LEAST_RANGE:
                return thermally_calibrated([_ramp_intake(cells, log)], plan)
    return calibrated(poses, found.units, plan)


def thermally_calibrated(logs: Sequence[Intake], plan: Plan = Plan()) -> ThermalOutcome:
    """
    Fit the offset over temperature to ramps of a still board, and a calibration to poses, if any.

    Parameters
    ----------
    logs : sequence of Intake or RampIntake
        One or more ramps, each in its own orientation, and at most one log of poses of the same
        sensor in many directions, with their temperature. Its unit is that of the calibration.
    plan : Plan
        How to fit and level the poses; nothing is refined.

    Raises
    ------
    RefusedFitError, InputError
        As in `calibrated`, or if there is no ramp, or the logs are of several sensors.

    """
    read_as = ', '.join(dict.fromkeys(each.read_as for each in logs if each.read_as))
    with saying(read_as):
        turned = [each for each in logs if not isinstance(each, RampIntake)]
        if len(turned) == len(logs):
            raise InputError(f'{counted(len(turned), "log")} of poses in many directions, '
                             'expected one of a still board whose temperature changes', 'record '
                             'the board while it warms up from the freezer, and give this log, '
                             'too')
        if len(turned) > 1:
            raise InputError(f'{len(turned)} logs are of poses in many directions, expected at '
                             'most one', 'leave out the others')
        tables = [each.poses for each in logs]
        # A sensor is known by its device id in an autopilot, or else by its name.
        devices = {each.autopilot.device_id for each in tables if each.autopilot} - {None}
        names = {each.sensor for each in tables if not each.autopilot} - {''}
        for known in (devices, names):
            if len(known) > 1:
                several = ', '.join(sorted(map(str, known)))
                raise InputError(f'the logs are of the sensors {several}, expected one sensor',
                                 'choose one with --sensor, or give the logs of one sensor')
        curve = curve_of([each.ramp for each in logs if isinstance(each, RampIntake)])
        if turned:
            rows, units = turned[0].poses, turned[0].units
            fitted = calibrated(without_curve(curve, rows, units), units, replace(
                plan, refined=False, flat=None, nose_down=None)).calibration
            made = with_curve(fitted, curve, rows)
        else:
            made = thermal_alone(curve, logs[0].units, sensor=plan.sensor, date=now())
            rows = made.poses
        levelled = level_by_rows(made, made.poses, plan.frame, _row(rows, plan.flat),
                                 plan.nose_down)
        return ThermalOutcome(levelled, curve=curve, logs=logs, read_as=read_as)


def _row(poses: Poses, flat: Flat) -> int | None:
    if isinstance(flat, str):
        if flat not in ('first', 'last'):
            raise ValueError(f'flat is {flat!r}, expected a row number, first or last')
        return int(poses.row[0 if flat == 'first' else -1])
    return flat


def _refinement(poses: Poses, units: Units, plan: Plan, date: str
                ) -> tuple[Refinement | None, str]:
    """Return the search for effects, and a line about it; None if the poses are too few."""
    from .refinement import refine  # a fit alone does not load the search

    try:
        found = refine(poses, units, base=plan.fleet or plan.before or 'auto', sensor=plan.sensor,
                       date=date, also=plan.also)
    except RefusedFitError as err:
        return None, f'not refined: {err.message}'
    if found.refusal:
        return found, f'not refined: {found.refusal[0]}'
    if not found.steps:
        why = found.advice[0] if plan.fleet else 'these poses show no further effect'
        return found, f'not refined: {why}'
    change = f'residual {short(found.gap_mg)} -> {short(found.remaining_gap_mg)} mg'
    added = [step.effect for step in found.steps if step.effect not in PROCESSES]
    only_named = [step.effect for step in found.steps if step.effect in PROCESSES]
    words = [f'refined with {", ".join(added)}' if added else 'not refined']
    if only_named:
        words.append(f'found {", ".join(only_named)}, which no calibration corrects')
    return found, f'{"; ".join(words)}: {change}'


_Samples = TypeVar('_Samples', bound=Table)


class Correction:
    """
    The correction of the samples of one log, block by block, in order.

    Parameters
    ----------
    calibration : Calibration
        The calibration; it is converted to the unit of the samples.
    units : Units or {'m/s2', 'g', 'native'}
        Unit of the samples.
    sensor : str
        Name of their sensor; empty if it is not known.

    Attributes
    ----------
    calibration : Calibration
        The calibration in this unit.

    Raises
    ------
    StoredCalibrationError
        If the calibration belongs to another sensor.
    InputError
        If only one of calibration and samples is in native units.

    """

    def __init__(self, calibration: Calibration, units: Units | UnitName, sensor: str) -> None:
        check_sensor(calibration, sensor)
        self.calibration = calibration.in_units(units)
        self._thermal = thermal_stream(self.calibration.model)
        self._compared: dict[str, Outside] = {}
        self._lacking = ''

    def context(self, samples: Table) -> Context:
        """Return the context of the next block, as the effects need it."""
        model = self.calibration.model
        known = {key: values for key, values in samples.columns.items()
                 if key not in CONTEXT or len(values) == 0 or not np.isnan(values).all()}
        found = context_of_samples(known, len(samples), model, self._thermal)
        self._lacking = ''
        if lacking := [key for key in model.neutral if key not in samples]:
            names = [str(each) for each in model.effects if {*entry_of(each).needs} & {*lacking}]
            self._lacking = (f'the samples have no {" and ".join(lacking)}: {" and ".join(names)} '
                             f'{"is" if len(names) == 1 else "are"} not corrected')
        for key, block in outside(self.calibration, found).items():
            before = self._compared.get(key, block)
            self._compared[key] = block if before is block else replace(
                block, count=before.count + block.count, samples=before.samples + block.samples,
                least=min(before.least, block.least), most=max(before.most, block.most))
        return found

    def __call__(self, samples: _Samples) -> _Samples:
        """Return the next block with corrected readings, in m/s² or g, in the levelled frame."""
        own = self.calibration
        columns = {'reading': own.correct(samples.reading, self.context(samples))}
        if 'rate' in samples:
            columns['rate'] = samples['rate'] @ own.model.rotation
        if 'std' in samples:
            columns['std'] = own.units.to_g(samples['std']) * own.force_per_g
        return replace(samples.with_columns(**columns), autopilot=None,
                       units='g' if own.units.is_native else own.units.name)

    @property
    def notes(self) -> list[str]:
        """Return what the samples lack, and what left the range of the calibration, so far."""
        return [*filter(None, [self._lacking]), *(
            f'{each.count} of {counted(each.samples, "sample")} are outside of the range of the '
            f'calibration: {outside_words(each)}; {USES_LIMIT}'
            for each in self._compared.values() if each.count)]
