# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The settings of both nodes: one table each.

A field of `CalibratorSettings` or `SimulatorSettings` is a parameter: name, default, description,
limits. From here it is declared in the node, checked (see `parameters`), listed in
``config/calibrator.yaml`` and given to the code.

"""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import Any

from ..calibrate import FrameName, FRAMES, METHODS, MODEL_NAMES
from ..calibrate.unknown import Method
from ..capture import CaptureSettings, Repeated
from ..capture.settings import REPEATED
from ..errors import InputError
from ..units import STANDARD_GRAVITY, UNIT_NAMES, UnitName

_MODELS = tuple(name for name in MODEL_NAMES if name != '12')  # needs known orientations
_CAPTURE = CaptureSettings()


def _parameter(default: Any, words: str, *, limits: tuple[float, float] | None = None,
               choices: tuple[str, ...] = (), live: bool = False) -> Any:
    """Describe a parameter; `live` ones can be set while the node runs."""
    about = {'words': words, 'limits': limits, 'choices': choices, 'live': live}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=about)
    return field(default=default, metadata=about)


@dataclass(frozen=True)
class CalibratorSettings:
    """Parameters of the calibrator."""

    sensor: str = _parameter(
        '', 'Name of the sensor: names its stored files, and a calibration of another sensor is '
        'refused. Empty: frame_id of the first message')
    units: UnitName = _parameter(
        'm/s2', 'Unit of the incoming linear_acceleration; what goes out is in m/s²',
        choices=UNIT_NAMES)
    gravity: float = _parameter(STANDARD_GRAVITY, 'Local gravity [m/s²]', limits=(1.0, 30.0))
    model: str = _parameter(
        'auto', 'Model that ~/fit fits: its number of parameters, or auto for the smallest that '
        'the poses call for', choices=_MODELS, live=True)
    method: Method = _parameter(
        'ml', 'Fit by maximum likelihood (weighs poses, leaves out disturbed ones), or by the '
        'algebraic cost of AN5286', choices=METHODS, live=True)
    frame: FrameName = _parameter(
        'ros', 'Levelled frame that ~/set_level turns to', choices=FRAMES)
    output_frame_id: str = _parameter(
        '', 'frame_id of corrected messages. Empty: that of the incoming ones', live=True)
    calibration_file: str = _parameter(
        '', 'Where the calibration is stored; the poses beside it. Empty: '
        '$ROS_HOME/accel_calib/<sensor>.yaml, with ~/.ros where ROS_HOME is not set')
    passthrough: bool = _parameter(
        False, 'Publish raw messages unchanged until there is a calibration', live=True)
    auto_capture: bool = _parameter(
        True, 'Capture a pose whenever the sensor rests', live=True)
    auto_fit: bool = _parameter(
        False, 'Fit without being asked, at auto_fit_poses poses and at each one after', live=True)
    auto_fit_poses: int = _parameter(12, 'Poses from which auto_fit fits', limits=(4, 1000),
                                     live=True)
    still_window: float = _parameter(
        _CAPTURE.still_window, 'Length of the window that is judged to be still [s]',
        limits=(0.05, 10.0))
    still_std_max: float = _parameter(
        _CAPTURE.still_std_max, 'Largest standard deviation of a still axis [m/s², or native '
        'units]. 0: found from the noise of the sensor', limits=(0.0, 1e6))
    still_gyro_max: float = _parameter(
        _CAPTURE.still_gyro_max, 'Largest mean angular rate of a still sensor [rad/s]. 0: not '
        'looked at, for gyros have biases', limits=(0.0, 10.0))
    still_norm_tolerance: float = _parameter(
        _CAPTURE.still_norm_tolerance, 'How far |a| of a still sensor may be from 1 g [g]',
        limits=(0.01, 1.0))
    min_dwell: float = _parameter(
        _CAPTURE.min_dwell, 'Shortest rest that makes a pose [s]', limits=(0.1, 600.0))
    max_dwell: float = _parameter(
        0.0, 'Longer rests are cut into several poses [s]. 0: never', limits=(0.0, 3600.0))
    min_pose_angle: float = _parameter(
        _CAPTURE.min_pose_angle, 'Poses closer than this are repeated ones [rad]',
        limits=(0.0, 1.5))
    repeated: Repeated = _parameter(
        'merge', 'What becomes of a repeated pose: a robot that parks repeats itself. At another '
        'temperature it is none',
        choices=REPEATED)
    drift_warn: float = _parameter(
        0.01, 'Smallest lasting departure of |a| at rest from 1 g that is warned of, where it is '
        'beyond the uncertainty that the calibration states [m/s²]',
        limits=(0.0, 100.0), live=True)


@dataclass(frozen=True)
class SimulatorSettings:
    """Parameters of the simulator."""

    frame_id: str = _parameter('imu', 'frame_id of the messages')
    rate: float = _parameter(200.0, 'Messages a second [Hz]', limits=(1.0, 10000.0))
    poses: int = _parameter(12, 'Poses, spread evenly over the sphere', limits=(1, 1000))
    dwell: float = _parameter(3.0, 'Time in each pose [s]', limits=(0.01, 3600.0))
    turn: float = _parameter(1.0, 'Time from pose to pose [s]', limits=(0.01, 3600.0))
    wait: float = _parameter(
        0.0, 'Before the first pose, wait this long for listeners [s]. 0: start at once',
        limits=(0.0, 3600.0))
    listeners: int = _parameter(1, 'Listeners to wait for', limits=(1, 100))
    loop: bool = _parameter(False, 'Start again after the last pose')
    hold: bool = _parameter(True, 'Hold the last pose until told to end; otherwise end there')
    flat_first: bool = _parameter(False, 'Lie flat (z of the robot up) before the poses')
    flat_last: bool = _parameter(True, 'Lie flat (z of the robot up) after the poses')
    mounting: list[float] = _parameter(
        [0.0, 0.0, 0.0], 'Roll, pitch and yaw of the sensor on the robot [°]')
    effects: list[str] = _parameter(
        [''], "What is wrong with the sensor, as 'offset=0.1,-0.2,0.3' in the units of the "
        'catalogue (g)')
    noise: float = _parameter(0.02, 'Standard deviation of a sample [m/s²]', limits=(0.0, 10.0))
    gyro_noise: float = _parameter(0.002, 'Standard deviation of a sample [rad/s]',
                                   limits=(0.0, 10.0))
    gravity: float = _parameter(STANDARD_GRAVITY, 'Local gravity [m/s²]', limits=(1.0, 30.0))
    temperature: list[float] = _parameter(
        [25.0, 25.0], 'Temperature at the first and the last sample [°C]')
    seed: int = _parameter(1, 'Of the noise', limits=(0, 2 ** 31 - 1))


def capture_settings(settings: CalibratorSettings) -> CaptureSettings:
    """
    Give the settings of the capture, in its units.

    Raises
    ------
    InputError
        If they do not go together.

    """
    std_max = settings.still_std_max
    try:
        return CaptureSettings(
            settings.still_window,
            std_max if settings.units == 'native' else std_max / settings.gravity,
            settings.still_gyro_max, settings.still_norm_tolerance, settings.min_dwell,
            settings.max_dwell or math.inf, settings.min_pose_angle, settings.repeated)
    except ValueError as error:
        raise InputError(f'the parameters do not go together: {error}', 'change one') from error
