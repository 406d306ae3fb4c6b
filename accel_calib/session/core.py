# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a session knows: the state that its commands, its reports and its pages read."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import math

from .sensor import Sensor
from .settings import CalibratorSettings, own_effects
from .store import SensorFiles
from .stream import Around, StreamStatistics
from .worker import Event, Log, Severity, Throttle
from ..calibration import Calibration, mounting_of, mounting_words, with_given_mounting
from ..errors import InputError
from ..finding import Finding
from ..table import Floats
from ..units import FrameName, units_of


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


class State:
    """
    The state of the calibrator of one sensor; InputError if the settings contradict each other.

    Parameters
    ----------
    settings : CalibratorSettings
        The parameters; they can be replaced later.
    topic : str
        Topic of the messages, with namespace.
    clock : callable
        Steady clock [s].

    Attributes
    ----------
    frame : {'ros', 'android'}
        Levelled frame of calibrations.
    frame_id : str or None
        That of the messages; None before the first one.
    problem : str
        Why the stored calibration, or the files, cannot be used.
    is_refused : bool
        Whether the stored calibration is sound, but not for this node as it was started.
    found : tuple of Finding
        What was found in the samples before they come here.
    enabled : bool
        Whether messages are corrected.
    stillness : float
        Spread of the last samples, relative to the largest of a still sensor.
    given : (3, 3) array or None
        Mounting ΔR that is known from elsewhere.
    surroundings : Surroundings
        What is known of the graph of ROS, or of a board.
    computing : int
        Number of fits and refinements that are running.
    events : deque of Event
        What the session reports, in order; whoever shows it removes it.
    throttle : Throttle
        When log lines and automatic fits are due again.

    """

    def __init__(self, settings: CalibratorSettings, topic: str, clock: Callable[[], float]
                 ) -> None:
        if any(settings.mounting_rpy) and settings.base_frame:
            raise InputError('both mounting_rpy and base_frame are set, expected one of them',
                             'remove one')
        if settings.publish_tf and settings.output_frame_id and (
                settings.output_frame_id == settings.base_frame):
            raise InputError(f'publish_tf would make {settings.base_frame!r}, the frame of the '
                             'robot, a child of the frame of the sensor',
                             'set publish_tf to false, or choose another output_frame_id')
        self.settings, self.topic, self.clock = settings, topic, clock
        self.units = units_of(settings.units, settings.gravity)
        self.sensor = Sensor(settings, self.units)
        self.statistics, self.around = StreamStatistics(clock), Around(clock)
        self.own = own_effects(settings)
        self.files = SensorFiles(settings, topic, self.own)
        # Messages in ned are those of ros, turned.
        self.frame: FrameName = 'ros' if settings.frame == 'ned' else settings.frame
        self.frame_id: str | None = None
        self.problem, self.is_refused = '', False
        self._refusals: dict[str, tuple[str, tuple[object, ...]]] = {}
        self.found: tuple[Finding, ...] = ()
        self.surroundings = Surroundings()
        self.enabled, self.still, self.still_since = True, False, math.nan
        self.stillness = math.nan
        self.computing = 0
        self.given: Floats | None = (
            mounting_of(settings.mounting_rpy) if any(settings.mounting_rpy) else None)
        self.events, self.throttle = deque[Event](), Throttle(clock)

    @property
    def name(self) -> str:
        """Name of the sensor; empty if not known yet."""
        return self.settings.sensor or self.frame_id or ''

    @property
    def context(self) -> dict[str, float]:
        """Present time [s], if known, and the context as a calibration uses it."""
        stamp = self.statistics.stamp
        return {**self.around.filled, **({} if math.isnan(stamp) else {'time': stamp})}

    def refuse(self, command: str, words: str) -> None:
        """Note that a command is refused, or ``poses`` for a fit, and what to do."""
        self._refusals[command] = words, self._situation(command)

    def refusal_of(self, command: str) -> str:
        """Return what to do about a command that would be refused again; empty if it may work."""
        words, situation = self._refusals.get(command, ('', None))
        return words if situation and situation == self._situation(command) else ''

    def _situation(self, command: str) -> tuple[object, ...]:
        """Return what a refusal of a command depends on."""
        sensor, rests = self.sensor, command in ('set_level', 'calibrate_at_rest')
        return (sensor, len(sensor.live.book.poses()), sensor.changes,
                rests and sensor.live.detector.current() is None)

    def log(self, severity: Severity, words: str, kind: str = '', once_in: float = 0.0) -> None:
        """Add a log line to the events; of a kind, if it has one, at most one in `once_in` [s]."""
        if words and (not kind or self.throttle.passes(kind, once_in)):
            self.events.append(Log(severity, words))

    def with_given(self, calibration: Calibration) -> Calibration:
        """Return a calibration with the given mounting, if there is one."""
        return calibration if self.given is None else with_given_mounting(calibration, self.given)

    def mounting_words(self, calibration: Calibration | None) -> str:
        """Return the mounting of a calibration as one line; empty if it is not known."""
        if calibration is None or not calibration.is_levelled:
            return ''
        return mounting_words(calibration.rotation, self.frame_id or '', self.settings.base_frame)
