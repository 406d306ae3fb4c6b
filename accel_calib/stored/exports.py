# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Exports of a calibration to the places where it is used, and the plan of poses as CSV.

An export is one entry of `FORMATS`, and a template of the same name in the folder ``templates``.
The values for the templates are made in `.formats`; `.made` measures what an export does not hold,
and fills the template.

"""

from collections.abc import Mapping
import csv
from dataclasses import dataclass, field, fields, replace
from functools import partial
import io
import json
from pathlib import Path
from types import MappingProxyType
from typing import TextIO

import numpy as np

from .calibration_yaml import CORRECTION
from .formats import (
    affine, ardupilot, counts, header, identifier, imucal, Noise, noise_alone, openvins, px4,
    read_noise)
from .made import difference_mg, Format, LEAST_LOSS_MG, Loss, losses_of, Made, Options, rendered
from .. import __version__
from ..calibration import Calibration, PosePlan
from ..disk import write_atomically
from ..errors import InputError
from ..findings import plan_lines
from ..geometry import attitude_words
from ..text import one_line
from ..units import STANDARD_GRAVITY

__all__ = ['CALIBRATION_ALONE', 'FORMATS', 'Exported', 'Format', 'Loss', 'Noise', 'Options',
           'export', 'identifier', 'read_noise', 'write_plan']

_CONTEXT = {'temperature': ('temperature', 1.0), 'supply_voltage': ('supply_voltage', 1.0),
            'std': ('vibration', STANDARD_GRAVITY), 'time': ('wait', 1.0)}
"""Column of the plan and its unit, by column of the poses: °C, V, m/s², s after the last pose.
Quantities keep their name."""

_GITHUB = 'https://github.com/'
_ALL = 'offset, gains, mounting'
_BY_AXIS = 'offset, gain of each axis, thermal offset'
_OF_AUTOPILOT, _OF_COUNTS = ('instance', 'device_id', 'axes'), ('axes', 'counts_per_g')
_OF_FILE = 'that of the [file](files.md#calibration)'


def _whole(calibration: Calibration, as_arrays: bool = False) -> Made:
    """Return all values, perhaps as a NumPy archive: texts and effects are arrays of text."""
    quality, model = calibration.quality, calibration.model
    left = difference_mg(calibration, Made({}, lambda reading, temperature: (
        reading - calibration.offset) @ calibration.matrix.T @ calibration.rotation
        / calibration.force_per_g, True))
    notes = () if left < LEAST_LOSS_MG else (
        f'matrix and offset without the other effects leave {left:.2g} mg',)
    content = {
        'format': 'accel_calib export', 'package_version': __version__, 'equation': CORRECTION,
        'sensor': calibration.sensor, 'stream': calibration.stream, 'date': calibration.date,
        'units': calibration.units.name, 'per_g': calibration.units.per_g,
        'force_per_g': calibration.force_per_g, 'model': calibration.name,
        'frame': calibration.frame, 'levelled': calibration.is_levelled,
        'matrix': calibration.matrix, 'offset': calibration.offset,
        'gain': calibration.gain, 'rotation': calibration.rotation,
        'offset_sd': calibration.offset_sd, 'gain_sd': calibration.gain_sd,
        'parameters': list(calibration.parameters), 'values': model.vector,
        'covariance': calibration.covariance,
        'effects': {str(name): {'unit': effect.unit, **effect.shown(values)}
                    for (name, values), effect in zip(model.values.items(), model.terms.effects,
                                                      strict=True)},
        'ranges': {key: list(limits) for key, limits in calibration.ranges.items()},
        'rms_before_mg': quality.rms_before_mg, 'rms_after_mg': quality.rms_after_mg}
    if not as_arrays:
        return Made({'content': content}, None, True, notes=notes)
    arrays = {key: np.asarray(value) for key, value in content.items()
              if not isinstance(value, Mapping)}
    arrays['effects'] = np.asarray(json.dumps(content['effects'], allow_nan=False))
    arrays |= {f'effect.{name}': values for name, values in model.values.items()}
    arrays |= {f'range.{key}': np.array(each) for key, each in calibration.ranges.items()}
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return Made({}, None, True, notes=notes, data=file.getvalue())


FORMATS: Mapping[str, Format] = MappingProxyType({
    'c': Format(
        'C header', '.h', 'header in C99 and C++, single precision',
        equation='force = M (raw - B), and [more](#c-and-arduino)', holds='all but lag, time, '
        'supply and rotation', make=header, takes=('name',)),
    'arduino': Format(
        'Arduino header', '.h', 'header for an Arduino sketch', equation='as `c`', holds='as `c`',
        make=header, takes=('name',)),
    'px4': Format(
        'PX4', '_px4.params', 'parameter file of QGroundControl',
        equation='(raw - thermal(T - TREF) - OFF) SCALE', holds=_BY_AXIS, make=px4,
        takes=_OF_AUTOPILOT, metric=True, source=_GITHUB + 'PX4/PX4-Autopilot/blob/main/src/lib/'
        'sensor_calibration/Accelerometer.hpp'),
    'ardupilot': Format(
        'ArduPilot', '_ardupilot.param', 'parameter file of Mission Planner and MAVProxy',
        equation='(raw - p(T - 35) + p(CALTEMP - 35) - OFFS) SCAL', holds=_BY_AXIS, make=ardupilot,
        takes=_OF_AUTOPILOT, metric=True, source=_GITHUB + 'ArduPilot/ardupilot/blob/master/'
        'libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp'),
    'betaflight': Format(
        'Betaflight', '_betaflight.txt', 'commands for its command line',
        equation='(raw - acc_calibration) / acc_1G', holds='offset in counts',
        make=partial(counts, label='Betaflight'),
        source=_GITHUB + 'betaflight/betaflight/blob/master/src/main/sensors/acceleration.c',
        takes=_OF_COUNTS),
    'inav': Format(
        'iNav', '_inav.txt', 'commands for its command line', equation='(raw - acczero) accgain / '
        '4096 / acc_1G', holds='offset, gain of each axis',
        make=partial(counts, label='iNav', with_gain=True),
        source=_GITHUB + 'iNavFlight/inav/blob/master/src/main/sensors/acceleration.c',
        takes=_OF_COUNTS),
    'mpu6050': Format(
        'MPU-6050', '_mpu6050.h', 'change of the offset registers; MPU-6500 and 9250, too',
        equation='raw + change, in 1/2048 g', holds='offset in 0.98 mg',
        make=partial(counts, label='MPU-6050', register_per_g=2048.0, step=2, notes=(
            'add the change to the words that the chip has after power-on, each time, and verify '
            'it with new poses: drivers state 1/2048 g, but also 1/4096 g for the MPU-6050',)),
        source='RM-MPU-9250A-00 rev. 1.4, section 4.39, and mpu_set_accel_bias_6050_reg of '
        'InvenSense', takes=('name', *_OF_COUNTS)),
    'fusion': Format(
        'Fusion', '_fusion.h', 'parameters of FusionCalibrationInertial by x-io',
        equation='force = misalignment ((raw - offset) * sensitivity)', holds=_ALL,
        make=partial(affine, force_per_g=1.0),
        source=_GITHUB + 'xioTechnologies/Fusion/blob/main/Fusion/FusionModel.h'),
    'realsense': Format(
        'RealSense', '_realsense.json', 'calibration.json of rs-imu-calibration',
        equation='force = scale_and_alignment^T raw - bias', holds=f'{_ALL}, gyro bias',
        make=partial(affine, notes=(
            'it is for readings that are recorded with enable_motion_correction = 0',)),
        metric=True, source=_GITHUB + 'IntelRealSense/librealsense/blob/master/tools/'
        'rs-imu-calibration/rs-imu-calibration.py'),
    'openvins': Format(
        'OpenVINS', '_imu_chain.yaml', 'kalibr_imu_chain.yaml with gains and noise',
        equation='force = R_IMUtoACC^T Ta^-1 (raw - estimated bias)', holds='gains, noise',
        make=openvins,
        source=_GITHUB + 'rpng/open_vins/blob/master/ov_msckf/src/state/Propagator.cpp',
        takes=('noise',), metric=True),
    'dlio': Format(
        'DLIO', '_dlio.yaml', 'parameters of its ROS 2 node', equation='force = sm raw - bias',
        holds='offset, gains, gyro bias',
        make=partial(affine, levelled=False, notes=(
            'DLIO turns readings by extrinsics/baselink2imu/R first: this file is for R = 1',)),
        source=_GITHUB + 'vectr-ucla/direct_lidar_inertial_odometry/blob/master/src/dlio/odom.cc',
        metric=True),
    'imu_calib': Format(
        'imu_calib', '_imu_calib.yaml', 'YAML file of the ROS package',
        equation='force = SM raw - bias', holds=_ALL, make=affine,
        source=_GITHUB + 'dpkoch/imu_calib/blob/master/src/accel_calib/accel_calib.cpp'),
    'imucal': Format(
        'imucal', '_imucal.json', 'FerrarisCalibrationInfo as JSON',
        equation='force = R_a^-1 K_a^-1 (raw - b_a)', holds=f'{_ALL}, gyro bias', make=imucal,
        source='https://imucal.readthedocs.io/en/latest/modules/generated/imucal.html'),
    'kalibr': Format(
        'Kalibr', '_imu.yaml', 'imu.yaml with the noise', equation='none', holds='noise',
        make=partial(noise_alone, label='Kalibr'),
        source=_GITHUB + 'ethz-asl/kalibr/wiki/IMU-Noise-Model', takes=('noise',)),
    'vins': Format(
        'VINS', '_vins.yaml', 'lines of the noise for its configuration', equation='none',
        holds='noise', make=partial(noise_alone, label='VINS'),
        takes=('noise',), source=_GITHUB + 'HKUST-Aerial-Robotics/VINS-Fusion/blob/master/'
        'vins_estimator/src/factor/integration_base.h'),
    'json': Format(
        'JSON', '.json', 'all values', equation=_OF_FILE, holds='everything', make=_whole),
    'npz': Format(
        'NumPy', '.npz', 'all values as arrays', equation=_OF_FILE, holds='everything',
        make=partial(_whole, as_arrays=True))})
"""The formats by name."""

CALIBRATION_ALONE = tuple(name for name, each in FORMATS.items() if 'noise' not in each.takes)
"""Formats that need nothing but the calibration."""


@dataclass(frozen=True)
class Exported:
    """
    The file of an export, and the end of its name.

    `leaves_mg` is the RMS difference to the full correction over the sphere, without the mounting
    [mg], `details` what the format does not hold, by effect, and `notes` what the user has to do.

    """

    text_or_bytes: str | bytes
    suffix: str
    leaves_mg: float
    details: tuple[Loss, ...] = field(default=(), repr=False)
    notes: tuple[str, ...] = ()

    @property
    def losses(self) -> tuple[str, ...]:
        """Return what the format does not hold, with numbers; one line each."""
        return tuple(loss.words for loss in self.details)

    @property
    def data(self) -> bytes:
        content = self.text_or_bytes
        return content.encode() if isinstance(content, str) else content

    def write(self, file: TextIO) -> None:
        file.buffer.write(self.data)


def export(calibration: Calibration, to: str, noise: Noise | None = None,
           options: Options = Options()) -> Exported:
    """
    Return the file of a calibration in another format, and what it does not hold.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    to : str
        One of `FORMATS`.
    noise : mapping, optional
        Noise of the sensor (`read_noise`), for formats that need it.
    options : Options
        Choices that some formats have.

    Raises
    ------
    InputError
        If the format cannot hold the calibration at all, needs what is not given, or does not take
        what is.
    ValueError
        If there is no such format.

    """
    if to not in FORMATS:
        raise ValueError(f'format is {to!r}, expected one of {", ".join(FORMATS)}')
    chosen = FORMATS[to]
    asked = ['noise'] * (noise is not None) + [
        each.name for each in fields(options) if getattr(options, each.name) != each.default]
    for name in (each for each in asked if each not in chosen.takes):
        raise InputError(f'{chosen.label} takes no --{name.replace("_", "-")}', 'leave it out; '
                         f'{", ".join(each for each in FORMATS if name in FORMATS[each].takes)} '
                         'take it')
    beside = (noise if chosen.takes == ('noise',) else options,) if chosen.takes else ()
    if chosen.metric and calibration.units.is_native:
        raise InputError(
            f'the calibration is for native readings, but {chosen.label} corrects readings in '
            f'm/s2', f'fit a calibration to the readings that {chosen.label} logs in m/s2')

    def make(of: Calibration) -> Made:
        if not chosen.metric:
            return chosen.make(of, *beside)
        metric = of.in_units('m/s2')
        made, factor = chosen.make(metric, *beside), metric.units.per_g / of.units.per_g
        correct = made.correct
        return made if correct is None else replace(
            made, correct=lambda reading, temperature: correct(reading * factor, temperature))

    made = make(calibration)
    content = made.data or rendered(to, chosen, calibration, made)
    return Exported(content, chosen.suffix, difference_mg(calibration, made),
                    losses_of(calibration, chosen.label, make, made), made.notes)


def write_plan(path: Path, plan: PosePlan) -> None:
    """
    Write the poses of a plan; the direction that points up is a unit vector in the sensor axes.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    columns = {**{key: (key, 1.0) for pose in plan.poses for key in pose.context}, **_CONTEXT}
    text = io.StringIO()
    text.writelines(f'# {one_line(line)}\n' for line in plan_lines(plan))
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(['pose', 'up_x', 'up_y', 'up_z', 'attitude',
                     *(name for name, _ in columns.values()), 'separates', 'expected_probability'])
    for number, pose in enumerate(plan.poses, 1):
        context = [format(pose.context[key] * scale, '.6g') if key in pose.context else ''
                   for key, (_, scale) in columns.items()]
        writer.writerow([number, *(f'{part:.6f}' for part in pose.up),
                         attitude_words(np.array(pose.up)), *context,
                         ' / '.join(map(str, pose.separates)), f'{pose.expected:.4f}'])
    write_atomically(path, lambda file: file.write(text.getvalue()))
