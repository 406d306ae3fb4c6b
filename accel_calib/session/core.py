# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a session knows: its one state, and who goes on to the next one."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
from typing import Any

from .sensor import new_sensor, Sensor
from .settings import CalibratorSettings
from .store import SensorFiles
from .stream import AGAIN, Around, StreamStatistics
from .worker import Event, Log, Severity, Throttle
from ..calibration import Calibration, with_given_mounting
from ..effects import effects_of_file, OwnEffect
from ..errors import InputError
from ..finding import Finding
from ..findings import mounting_words
from ..geometry import rotation_from_rpy
from ..table import Floats
from ..units import FrameName, Units, units_of


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
    is_refused : bool
        Whether the stored calibration is sound, but not for this node as it was started.
    refusals : mapping of str to (str, tuple)
        What to do about each refused command, or ``poses`` for a fit, and its situation then.
    found : tuple of Finding
        What was found in the samples before they come here.
    enabled : bool
        Whether messages are corrected.
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
    is_refused: bool = False
    refusals: Mapping[str, tuple[str, tuple[object, ...]]] = field(default_factory=dict)
    found: tuple[Finding, ...] = ()
    enabled: bool = True
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


class Holder:
    """
    The present state of a session, and what it reports; parameters and errors as `Session`.

    Attributes
    ----------
    state : State
        The present state; another one after each change.
    events : deque of Event
        What the session reports, in order; whoever shows it removes it.
    throttle : Throttle
        When log lines and automatic fits are due again.

    """

    def __init__(self, settings: CalibratorSettings, topic: str, clock: Callable[[], float],
                 **known: Any) -> None:
        if any(settings.mounting_rpy) and settings.base_frame:
            raise InputError('both mounting_rpy and base_frame are set, expected one of them',
                             'remove one')
        if settings.publish_tf and settings.output_frame_id and (
                settings.output_frame_id == settings.base_frame):
            raise InputError(f'publish_tf would make {settings.base_frame!r}, the frame of the '
                             'robot, a child of the frame of the sensor',
                             'set publish_tf to false, or choose another output_frame_id')
        try:
            own = effects_of_file(Path(settings.also).expanduser()) if settings.also else ()
        except (OSError, RuntimeError) as error:
            raise InputError(f'also is {settings.also}, which cannot be read: {error}',
                             'correct the parameter') from error
        units, rpy = units_of(settings.units, settings.gravity), settings.mounting_rpy
        self.state = replace(State(
            settings, topic, units, sensor=new_sensor(settings, units),
            statistics=StreamStatistics(clock), around=Around(clock), own=own,
            given=rotation_from_rpy(*rpy).T if any(rpy) else None), **known)
        self.events, self.throttle = deque[Event](), Throttle(clock)

    @property
    def sensor(self) -> Sensor:
        """Return the present sensor."""
        return self.state.sensor

    def change(self, **changes: Any) -> None:
        """Go on with a state in which these fields are changed."""
        self.state = replace(self.state, **changes)

    def change_sensor(self, **changes: Any) -> None:
        """Go on with a sensor in which these fields are changed."""
        self.change(sensor=replace(self.sensor, **changes))

    def refuse(self, command: str, words: str) -> None:
        """Note that a command is refused, or ``poses`` for a fit, and what to do."""
        refused = words, self.state.situation_of(command)
        self.change(refusals={**self.state.refusals, command: refused})

    def drop(self, kind: str, severity: Severity, words: str, count: int = 1) -> None:
        """Count dropped messages of a kind, and log why, at most once in `AGAIN`."""
        self.state.statistics.drop(kind, count)
        self.log(severity, words, kind, AGAIN)

    def log(self, severity: Severity, words: str, kind: str = '', once_in: float = 0.0) -> None:
        """Add a log line to the events; of a kind, if it has one, at most one in `once_in` [s]."""
        if words and (not kind or self.throttle.passes(kind, once_in)):
            self.events.append(Log(severity, words))
