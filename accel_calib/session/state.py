# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What a session knows: the state, and in it what belongs to one sensor.

All of `Sensor` is replaced when the sensor changes.

Gravity is the mean corrected force of the last rest. It is subtracted while the sensor moves
(Intan RHD2000 application note). This is accurate for motion near the orientation of that rest.

Every rest is compared with 1 g (`accel_calib.comparison.drift`) as soon as it is long enough. The
final average replaces this first comparison. A robot can stand for weeks, so each interval
`LONG_REST` of a long rest counts as one rest.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
import math

import numpy as np

from .poses import Guide, LiveCapture, LONG_REST
from .settings import CalibratorSettings, capture_settings, columns_of
from .store import SensorFiles
from .stream import Around, StreamStatistics
from ..calibration import (
    Calibration, gyro_bias_of_rest, GyroBias, on_topics, Outside, outside, SampleNoise,
    with_given_mounting)
from ..comparison import compared, Drift, rest_errors
from ..effects import Context, OwnEffect, TemperatureHistory
from ..errors import InputError
from ..finding import Finding
from ..findings import mounting_words, Rating
from ..messages import Known, OneReading, output_scale, Triple
from ..refinement import Refinement
from ..stillness import Dwell, overlap, rest_after
from ..table import CONTEXT
from ..units import Floats, FrameName, Units

_SHORT_REST = 30.0
"""Shortest remainder of a partly counted rest that counts [s]."""

_NONE = np.zeros((1, 3))
_AT_REST: Triple = (0.0, 0.0, 0.0)

_LARGEST_BIAS_STEP = 0.02
"""Largest change of a stored bias from rest to rest [rad/s]."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """
    The poses, the plan, the calibration, its drift, and the last rest of one sensor.

    What streams is followed in `live` and `temperatures`. All else changes only with another
    `Sensor`, which the methods return. Two of them are of the same sensor if they have the same
    `live`.

    Parameters
    ----------
    live : LiveCapture
        The poses.
    guide : Guide
        The next pose.
    temperatures : TemperatureHistory
        What the effects of temperature need.
    calibration : Calibration or None
        The calibration in use.
    offered : Calibration or None
        A calibration that waits for ~/save or ~/undo.
    rating, refinement : Rating, Refinement or None
        Rating of the `present` calibration, None while it is not known; and where it is from.
    unsaved : bool
        Whether the calibration in use could not be stored.
    changes : int
        Number of changes of the calibration in use or offered.
    fitted_poses : int
        Number of poses of the last fit; 0 if more poses are asked for.
    auto_fit_waits : bool
        Whether poses wait for an automatic fit.
    owners : set of str
        Sensors that the stored files name.
    drift : Drift or None
        State of the drift monitor; None without a calibration.
    rest : Dwell or None
        The last rest.
    past, counted : Drift, Dwell or None
        State of the drift monitor without the ongoing rest, and what it has of the last one.

    """

    live: LiveCapture
    guide: Guide = field(default_factory=Guide)
    temperatures: TemperatureHistory = field(default_factory=TemperatureHistory)
    calibration: Calibration | None = None
    offered: Calibration | None = None
    rating: Rating | None = None
    refinement: Refinement | None = None
    unsaved: bool = False
    changes: int = 0
    fitted_poses: int = 0
    auto_fit_waits: bool = False
    owners: frozenset[str] = frozenset()
    drift: Drift | None = None
    rest: Dwell | None = None
    past: Drift | None = None
    counted: Dwell | None = None

    @property
    def present(self) -> Calibration | None:
        """Return the calibration that a command starts from: the offered one, or that in use."""
        return self.offered or self.calibration

    def offer(self, calibration: Calibration | None) -> Sensor:
        """Publish this calibration on ~/preview only; None: discard the offered one."""
        return replace(self, offered=calibration, changes=self.changes + 1)

    def adopt(self, calibration: Calibration | None) -> Sensor:
        """Use this calibration; the drift monitor restarts unless only the mounting differs."""
        before, past, counted = self.calibration, self.past, self.counted
        only_levelled = (
            before is not None and calibration is not None
            and before.model.effects == calibration.model.effects
            and np.array_equal(before.model.vector, calibration.model.vector)
            and np.array_equal(before.covariance, calibration.covariance)
            and not np.array_equal(before.model.rotation, calibration.model.rotation))
        if not only_levelled:
            past, counted = None if calibration is None else Drift(calibration), self.rest
        self.temperatures.followed.clear()  # but for models that are asked for from now on
        return replace(self.offer(None), calibration=calibration, unsaved=False, drift=past,
                       past=past, counted=counted)

    @property
    def gyro(self) -> GyroBias | None:
        """
        Bias of the gyro: of the last rest if it agrees with the stored one, or the stored one.

        A platform that turns steadily is still for the accelerometer. A large change of the rate
        is therefore not a bias.

        """
        stored = None if self.calibration is None else self.calibration.gyro
        now = None if self.rest is None else gyro_bias_of_rest(self.rest)
        if now is None or stored is None:
            return now or stored
        step = np.abs(now.bias - stored.at(now.temperature))
        return now if np.all(step < _LARGEST_BIAS_STEP) else stored

    @property
    def noise(self) -> SampleNoise | None:
        """Noise of the samples: that of the calibration, or otherwise of the last rest."""
        if self.calibration is not None and self.calibration.noise is not None:
            return self.calibration.noise
        return None if self.rest is None else SampleNoise(*(
            np.where(each > 0.0, each, np.nan) for each in (self.rest.std, self.rest.rate_std)))

    @property
    def has_changed(self) -> bool:
        """Whether the sensor has changed since the calibration."""
        return self.drift is not None and self.drift.change is not None

    def update(self, rest: Dwell, least: float, *, ended: bool = False) -> Sensor:
        """
        Compare a rest with 1 g: the ongoing one, or one that has `ended`.

        `least` is the smallest change to report [g].

        """
        past, counted, part = self.past, self.counted, self._uncounted(rest)
        if ended:
            past, counted = self._with(rest, least), rest
        elif part is not None and part.end - part.start >= LONG_REST:  # a slow change is no noise
            past, counted = self._with(rest, least), replace(
                rest, std=part.std, count=part.count / part.samples * rest.samples)
        latest = self.rest if ended else rest
        found = past if latest is None else replace(
            self, past=past, counted=counted)._with(latest, least)
        if found is not None and past is not None and found.change and not past.change:
            # What was reported during a rest ends by the rule of `drift`, not with the rest.
            past = replace(past, change=found.change, since=found.since)
        return replace(self, rest=latest, drift=found, past=past, counted=counted)

    def _uncounted(self, rest: Dwell) -> Dwell | None:
        """Return the part of a rest that was not counted yet, or None if it is too short."""
        before = self.counted
        if before is None or not overlap(before, rest) or rest.samples < before.samples:
            return rest
        is_longer = rest.end - before.end >= _SHORT_REST and rest.samples > before.samples
        return rest_after(before, rest) if is_longer else None

    def _with(self, rest: Dwell, least: float) -> Drift | None:
        """Return the state of the monitor after what was not counted yet of a rest."""
        part = self._uncounted(rest)
        if self.past is None or self.calibration is None or part is None:
            return self.past
        context, needs = self.context_of(part, self.calibration), {*self.calibration.model.needs}
        if not needs <= context.keys() or needs.intersection(CONTEXT) - part.context.keys():
            return self.past  # what did not arrive is assumed
        noise = part.std[np.newaxis] / math.sqrt(part.count)
        found = rest_errors(self.calibration, part.mean[np.newaxis], noise, context)
        return compared(self.past, found[0], least)

    def context_of(self, rest: Dwell, calibration: Calibration) -> Context:
        """Return the context of a rest as one row; what did not arrive is as for its messages."""
        typical = {key: np.array([value]) for key, value in calibration.typical.items()}
        known = {key: np.array([value]) for key, value in rest.context.items()}
        return {**typical, 'previous': _NONE, 'rate': _NONE, **known,
                'time': np.array([rest.time]), 'std': calibration.units.to_g(rest.std)[np.newaxis],
                **self.temperatures.during(calibration.model, rest.start, rest.end)}

    def limits_left(self, known: Mapping[str, float]) -> dict[str, Outside]:
        """
        Return the quantities that are outside of the range of the calibration now.

        The time leaves its range for ever, and the last value holds: no pose can be taken there.

        """
        if self.calibration is None:
            return {}
        now = {key: np.array([value]) for key, value in {
            **known, 'std': np.zeros(3),
            **self.temperatures.columns_of(self.calibration.model)}.items()}
        return {key: each for key, each in outside(self.calibration, now).items()
                if each.count and key != 'time'}

    def force_of(self, reading: Triple, known: Known) -> Triple | None:
        """Return the force of a reading by the `present` calibration [g]; None: not known."""
        calibration, prepared = self.present, self._prepared
        if calibration is None or prepared is None:
            return None
        context = {**calibration.model.neutral, 'std': _AT_REST, 'previous': _AT_REST,
                   'rate': _AT_REST, **self.temperatures.columns_of(calibration.model), **known}
        try:
            return prepared.at(context).correct(*reading)
        except InputError:
            return None  # a quantity is not known yet, or the reading is out of range

    @cached_property
    def _prepared(self) -> OneReading | None:
        """Return what corrects one reading by the `present` calibration."""
        return None if self.present is None else OneReading(
            self.present, 1.0 / self.present.force_per_g)


def new_sensor(settings: CalibratorSettings, units: Units) -> Sensor:
    """Return a sensor without poses and calibration."""
    return Sensor(LiveCapture(capture_settings(settings), units, columns_of(settings)))


def title(calibration: Calibration) -> str:
    """Return a short description of a calibration."""
    return (f'model {calibration.name} of {calibration.date or "unknown date"}, '
            f'{calibration.quality.rms_after_mg:.3f} mg, '
            f'{"levelled" if calibration.is_levelled else "not levelled"}')


# ----------------------------------------------------------------------------- the state

@dataclass(frozen=True)
class Surroundings:
    """
    What ROS, or the program behind a page, knows of the samples.

    Parameters
    ----------
    publishers : tuple of str or None
        Names of the nodes that publish the messages; None: the samples come from a board.
    imus, thermometers : tuple of str
        Topics with messages of Imus and of temperatures that other nodes publish.
    mismatches : tuple of str
        Publishers and subscribers with another QoS, which exchange no messages with this node.
    missing : mapping of str to str
        Why a column of the parameter `context` does not arrive.
    ended : bool
        Whether no more samples can come, because a recording has ended.

    """

    publishers: tuple[str, ...] | None = ()
    imus: tuple[str, ...] = ()
    thermometers: tuple[str, ...] = ()
    mismatches: tuple[str, ...] = ()
    missing: Mapping[str, str] = field(default_factory=dict)
    ended: bool = False


@dataclass(frozen=True, eq=False)
class State:
    """
    The state of the calibrator of one sensor.

    The stream is counted in `statistics` and `around`. All else changes only with another state.

    Parameters
    ----------
    settings : CalibratorSettings
        The parameters.
    topic : str
        Topic of the messages, with namespace.
    units : Units
        Unit of the readings.
    sensor : Sensor
        What belongs to the sensor; another sensor replaces all of it.
    statistics, around : StreamStatistics, Around
        The messages, and what is known beside them.
    files : SensorFiles
        The files of the sensor, and their lock.
    own : tuple of OwnEffect
        The effects of the user.
    given : (3, 3) array or None
        Mounting ΔR that is known from elsewhere.
    frame_id : str or None
        That of the messages; None before the first one.
    problem : str
        Why the stored calibration, or the files, cannot be used.
    not_stored : str
        Why the poses could not be stored.
    is_refused : bool
        Whether the stored calibration is sound, but not for this node as it was started.
    refusals : mapping of str to (str, tuple)
        What to do about each refused command, or ``poses`` for a fit, and its situation then.
    found : tuple of Finding
        What was found in the samples before they come here.
    enabled : bool
        Whether messages are corrected.
    is_active : bool
        Whether a managed node may publish them.
    still : bool
        Whether the sensor is still.
    still_since : float
        Stamp since when it is [s].
    surroundings : Surroundings
        What is known of the graph of ROS, or of a board.
    computing : int
        Number of fits and refinements that are running.

    """

    settings: CalibratorSettings
    topic: str
    units: Units
    sensor: Sensor
    statistics: StreamStatistics
    around: Around
    files: SensorFiles = SensorFiles()
    own: tuple[OwnEffect, ...] = ()
    given: Floats | None = None
    frame_id: str | None = None
    problem: str = ''
    not_stored: str = ''
    is_refused: bool = False
    refusals: Mapping[str, tuple[str, tuple[object, ...]]] = field(default_factory=dict)
    found: tuple[Finding, ...] = ()
    enabled: bool = True
    is_active: bool = True
    still: bool = False
    still_since: float = math.nan
    surroundings: Surroundings = Surroundings()
    computing: int = 0

    @property
    def name(self) -> str:
        """Name of the sensor; empty if not known yet."""
        return self.settings.sensor or self.frame_id or ''

    @property
    def frame(self) -> FrameName:
        """Levelled frame of calibrations; messages in ned are those of ros, turned."""
        return 'ros' if self.settings.frame == 'ned' else self.settings.frame

    @property
    def context(self) -> dict[str, float]:
        """Present time [s], if known, and the context as a calibration uses it."""
        stamp = self.statistics.stamp
        return {**self.around.filled, **({} if math.isnan(stamp) else {'time': stamp})}

    def on_topics(self, calibration: Calibration) -> Calibration:
        """Return a calibration in the frame of messages, or without the mounting."""
        return (on_topics(calibration, self.settings.frame) if self.settings.rotate
                else calibration.in_sensor_frame)

    @cached_property
    def gravity(self) -> Floats | None:
        """Corrected force of the last rest, (3,) [m/s²]; None if it cannot be corrected."""
        rest, calibration = self.sensor.rest, self.sensor.calibration
        if rest is None or calibration is None:
            return None
        context, applied = self.sensor.context_of(rest, calibration), self.on_topics(calibration)
        if not {*calibration.model.needs} <= context.keys():
            return None
        force = applied.correct(rest.mean[np.newaxis], context)[0]
        return force * output_scale(applied, self.settings.gravity)

    def refusal_of(self, command: str) -> str:
        """Return what to do about a command that would be refused again; empty if it may work."""
        words, situation = self.refusals.get(command, ('', None))
        return words if situation and situation == self.situation_of(command) else ''

    def situation_of(self, command: str) -> tuple[object, ...]:
        """Return what a refusal of a command depends on."""
        live, rests = self.sensor.live, command in ('set_level', 'calibrate_at_rest')
        return (live, len(live.poses()), self.sensor.changes,
                rests and live.detector.current() is None)

    def with_given(self, calibration: Calibration) -> Calibration:
        """Return a calibration with the given mounting, if there is one."""
        return calibration if self.given is None else with_given_mounting(calibration, self.given)

    def mounting_words(self, calibration: Calibration | None) -> str:
        """Return the mounting of a calibration as one line; empty if it is not known."""
        if calibration is None or not calibration.is_levelled:
            return ''
        return mounting_words(calibration.rotation, self.frame_id or '', self.settings.base_frame)
