# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The parameters of the calibrator.

Each field defines a parameter: name, default, description and limits. The node declares them
(`accel_calib.ros.declare`), and ``config/calibrator.yaml`` lists them with their defaults.

Types are checked here and not by rclpy. rclpy refuses ``5`` for ``5.0`` and ``model:=10`` for
``'10'``, and ends the node with a traceback.

"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, Field, field, fields, replace
import math
from typing import Any, TYPE_CHECKING, TypeVar

from ..effects import MODELS
from ..errors import InputError
from ..logs import named_topics
from ..stillness import CaptureSettings, REPEATED, Repeated, settings_from
from ..table import CONTEXT
from ..units import (
    FrameName, FRAMES, is_native, Method, METHODS, MODEL_NAMES, STANDARD_GRAVITY, UNIT_NAMES,
    UnitName, units_of)

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

WEB_PORT = 8080
"""Usual port of the live page."""

Settings = TypeVar('Settings', bound='DataclassInstance')
"""A dataclass whose fields are made by `parameter`."""


def parameter(default: Any, words: str, *, limits: tuple[float, float] | None = None,
              choices: tuple[str, ...] = (), live: bool = False) -> Any:
    """
    Return a field that is a parameter.

    Parameters
    ----------
    default : bool, int, float, str or list of them
        Default value; it defines the type of the parameter.
    words : str
        Description, with the unit.
    limits : (float, float), optional
        Least and largest value.
    choices : tuple of str
        Possible values of a text; empty: any text.
    live : bool
        Whether it can be set while the node runs.

    """
    about = {'default': default, 'words': words, 'limits': limits, 'choices': choices,
             'live': live}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=about)
    return field(default=default, metadata=about)


_ACCEPTED: dict[type, tuple[type, ...]] = {
    int: (int,), float: (int, float), str: (int, float, str)}


def expected(given: Field[Any]) -> str:
    """Return a text about the values that a parameter accepts."""
    if given.metadata['choices']:
        return 'one of ' + ', '.join(given.metadata['choices'])
    default = given.metadata['default']
    if isinstance(default, list):
        kind = 'strings' if isinstance(default[0], str) else f'{len(default)} numbers'
        return f'a list of {kind}'
    kind = {bool: 'true or false', int: 'a whole number', float: 'a number',
            str: 'text'}[type(default)]
    limits = given.metadata['limits']
    return kind if limits is None else f'{kind} from {limits[0]:.10g} to {limits[1]:.10g}'


def changed(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """
    Return the settings with these parameters converted to their types; ignore other names.

    InputError if a parameter does not accept its value.

    """
    known, accepted = {each.name: each for each in fields(settings)}, {}
    for name in filter(known.__contains__, values):
        value, default, found = values[name], known[name].metadata['default'], None
        choices, limits = known[name].metadata['choices'], known[name].metadata['limits']
        kind = type(default)
        if kind is list:
            with suppress(TypeError, ValueError):  # rclpy passes arrays and bytes
                items = [type(default[0])(item) for item in value]
                if not isinstance(default[0], float) or len(items) == len(default):
                    found = items
        elif bool in (kind, type(value)):
            found = value if type(value) is kind else None
        elif isinstance(value, _ACCEPTED[kind]):
            found = kind(value)
        if (found is None or (choices and found not in choices)
                or (limits is not None and not limits[0] <= found <= limits[1])):
            raise InputError(f'parameter {name} is {value!r}, expected {expected(known[name])}',
                             'correct the value')
        accepted[name] = found
    return replace(settings, **accepted)


_MODELS = tuple(name for name in MODEL_NAMES
                if name not in MODELS or not MODELS[name].known_orientation)
_FRAMES = tuple(name for name in FRAMES if name != 'win8')  # its readings are gravity
_CAPTURE = CaptureSettings()


@dataclass(frozen=True)
class CalibratorSettings:
    """Parameters of the calibrator."""

    sensor: str = parameter(
        '', 'Name of the sensor and of the stored files. A calibration of another sensor is '
        'refused. Empty: the sensor is named by the frame_id of the messages, the files by topic '
        'and frame_id')
    units: UnitName = parameter(
        'm/s2', 'Unit of the incoming linear_acceleration; the unit of the output is m/s²',
        choices=UNIT_NAMES)
    gravity: float = parameter(STANDARD_GRAVITY, 'Local gravity [m/s²]', limits=(1.0, 30.0))
    model: str = parameter(
        'auto', 'Model for ~/fit: its number of parameters, or auto for the smallest model that '
        'the data support', choices=_MODELS, live=True)
    method: Method = parameter(
        'ml', 'Method of the fit: maximum likelihood, which weights poses by their noise and '
        'leaves out outliers, or the algebraic cost function of AN5286', choices=METHODS,
        live=True)
    frame: FrameName = parameter(
        'ros', 'Levelled frame of the messages, which are specific force (REP-145): ros is '
        'forward-left-up, ned forward-right-down, android right-forward-up', choices=_FRAMES)
    rotate: bool = parameter(
        True, 'Turn corrected messages into the levelled frame once the mounting is known. false: '
        'correct offset and gain alone, and stay in the frame of the sensor', live=True)
    output_frame_id: str = parameter(
        '', 'frame_id of messages in the levelled frame. Empty: <frame_id>_levelled', live=True)
    mounting_rpy: list[float] = parameter(
        [0.0, 0.0, 0.0], 'Mounting of the sensor on the robot, as in the origin of a URDF: roll, '
        'pitch and yaw of the sensor in the frame of the robot [rad]. ~/set_level corrects its '
        'tilt and keeps its heading. Zeros: not given')
    base_frame: str = parameter(
        '', 'Frame of the robot. The mounting is then taken from the static transforms between '
        'this frame and that of the sensor, on /tf_static. Empty: not used')
    publish_tf: bool = parameter(
        False, 'Publish the levelled frame on /tf_static, as a child of the frame of the sensor')
    context: list[str] = parameter(
        [''], 'Further topics with a number that may act on the sensor, as column:=topic or, of a '
        "message with several numbers, column:=topic/field, such as ['supply_voltage:=battery', "
        "'rotor_temperature:=/motor/state/temperature']. ~/refine tries each column as a cause")
    gyro_bias: bool = parameter(
        False, 'Subtract the bias of the gyro, measured at rest, from the angular velocity',
        live=True)
    fill_covariance: bool = parameter(
        False, 'State the noise of the samples, measured at rest, in messages with unknown '
        'covariance', live=True)
    confirm: bool = parameter(
        False, 'Publish a new calibration or mounting on ~/preview only, until ~/save accepts it '
        'or ~/undo discards it', live=True)
    calibration_file: str = parameter(
        '', 'File of the calibration; the poses are stored in the same folder. Empty: '
        '$ROS_HOME/accel_calib/<topic>@<frame_id>.yaml, or <sensor>.yaml if sensor is set; '
        'ROS_HOME is ~/.ros by default')
    passthrough: bool = parameter(
        False, 'Publish raw messages unchanged until there is a calibration', live=True)
    also: str = parameter(
        '', 'Python file with own effects (accel_calib.Effect), which ~/refine tries beside the '
        'catalogue, and which a calibration that has them needs. It is executed. Empty: none')
    auto_capture: bool = parameter(True, 'Capture a pose at each rest of the sensor', live=True)
    auto_fit: bool = parameter(
        False, 'Fit automatically after auto_fit_poses poses, at most once per minute, and use '
        'the result if it differs from the calibration by more than its uncertainty', live=True)
    auto_fit_poses: int = parameter(12, 'Number of poses before the first automatic fit',
                                    limits=(4, 1000), live=True)
    still_window: float = parameter(
        _CAPTURE.still_window, 'Length of the window of the stillness test [s]',
        limits=(0.05, 10.0))
    still_std_max: float = parameter(
        _CAPTURE.still_std_max, 'Largest standard deviation of a still axis [m/s², or native '
        'units]. 0: derived from the noise of the sensor', limits=(0.0, 1e6))
    still_gyro_max: float = parameter(
        _CAPTURE.still_gyro_max, 'Largest mean angular rate of a still sensor [rad/s]. 0: not '
        'checked, because gyros have biases', limits=(0.0, 10.0))
    still_norm_tolerance: float = parameter(
        _CAPTURE.still_norm_tolerance, 'Largest difference of |a| of a rest from 1 g, beside '
        'what all rests have in common [g]', limits=(0.01, 1.0))
    min_dwell: float = parameter(
        _CAPTURE.min_dwell, 'Shortest rest that becomes a pose [s]', limits=(0.1, 600.0))
    max_dwell: float = parameter(
        0.0, 'Longer rests are split into several poses [s]. 0: never', limits=(0.0, 3600.0))
    min_pose_angle: float = parameter(
        _CAPTURE.min_pose_angle, 'Poses within this angle count as repeated [rad]',
        limits=(0.0, 1.5))
    repeated: Repeated = parameter(
        'merge', 'Keep repeated poses, merge them with the earlier pose, or refuse them. A parked '
        'robot repeats its pose. A pose at another temperature does not count as repeated',
        choices=REPEATED)
    drift_warn: float = parameter(
        0.01, 'Smallest lasting change of |a| at rest for a warning; it must also exceed the '
        'stated uncertainty of the calibration [m/s²]', limits=(0.0, 100.0), live=True)
    web_port: int = parameter(
        0, f'Port of the live page, such as {WEB_PORT}. 0: no page', limits=(0, 65535))
    web_host: str = parameter(
        '127.0.0.1', 'Address at which the live page is served. 0.0.0.0: to the whole network, '
        'without encryption')

    def __post_init__(self) -> None:
        if any(self.mounting_rpy) and self.base_frame:
            raise InputError('both mounting_rpy and base_frame are set, expected one of them',
                             'remove one')
        if self.publish_tf and self.output_frame_id and self.output_frame_id == self.base_frame:
            raise InputError(f'publish_tf would make {self.base_frame!r}, the frame of the '
                             'robot, a child of the frame of the sensor',
                             'set publish_tf to false, or choose another output_frame_id')


def columns_of(settings: CalibratorSettings) -> tuple[str, ...]:
    """Return the columns of the context of a sample."""
    return tuple(dict.fromkeys((*CONTEXT, *named_topics(settings.context))))


def capture_settings(settings: CalibratorSettings) -> CaptureSettings:
    """Return the settings of the capture, in g if the unit is known; InputError if impossible."""
    given = {each.name: getattr(settings, each.name) for each in fields(CaptureSettings)}
    given['max_dwell'] = settings.max_dwell or math.inf
    given['still_std_max'] /= 1.0 if is_native(settings.units) else settings.gravity
    return settings_from(given, units_of('g'))
