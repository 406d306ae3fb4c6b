# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Exports of a calibration to the places where it is used, and the plan of poses as CSV.

`.c_header` and `.flight_controllers` make headers and parameters; the other files are made here:

========= ================================================ ==================================
format    equation                                         source
========= ================================================ ==================================
imu_calib force = SM raw - bias                            accel_calib.cpp of dpkoch/imu_calib
imucal    force = R_a⁻¹ K_a⁻¹ (raw - b_a), K_a diagonal    FerrarisCalibrationInfo
Kalibr    no correction; noise by square root of hertz     wiki, IMU Noise Model
VINS      no correction; noise of one sample               integration_base.h of VINS-Fusion
========= ================================================ ==================================

"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
import csv
from dataclasses import dataclass, field
import io
import json
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO, TYPE_CHECKING, TypeGuard

import numpy as np

from . import c_header, flight_controllers
from .c_header import identifier
from .calibration_yaml import CORRECTION
from .made import (
    about, affine_fit, commented, Correction, difference_mg, Format, frame_words, LEAST_LOSS_MG,
    Loss, losses_of, Made, Options, plain_text, unit_in_ascii)
from .. import __version__
from ..calibrate import Calibration
from ..disk import check_regular, write_atomically
from ..errors import InputError
from ..table import Floats, LARGEST
from ..units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from ..refine import PosePlan

__all__ = ['CALIBRATION_ALONE', 'FORMATS', 'Exported', 'Format', 'Loss', 'Noise', 'Options',
           'export', 'identifier', 'read_noise', 'write_plan']

_IMU_CALIB_URL = ('https://github.com/dpkoch/imu_calib/blob/master/src/accel_calib/'
                  'accel_calib.cpp')
_IMUCAL_URL = 'https://imucal.readthedocs.io/en/latest/modules/generated/imucal.html'
_KALIBR_URL = 'https://github.com/ethz-asl/kalibr/wiki/IMU-Noise-Model'
_VINS_URL = ('https://github.com/HKUST-Aerial-Robotics/VINS-Fusion/blob/master/vins_estimator/'
             'src/factor/integration_base.h')

_IMUCAL_VERSION = '2.0.0'

_NOISE = {'accelerometer_noise_density': 'm/s^2/sqrt(Hz)',
          'accelerometer_random_walk': 'm/s^3/sqrt(Hz)',
          'gyroscope_noise_density': 'rad/s/sqrt(Hz)',
          'gyroscope_random_walk': 'rad/s^2/sqrt(Hz)', 'update_rate': 'Hz'}
"""Figures of ``accel-calib noise --json``, and their units."""

_VINS = {'acc_n': ('accelerometer_noise_density', 'm/s^2'),
         'gyr_n': ('gyroscope_noise_density', 'rad/s'),
         'acc_w': ('accelerometer_random_walk', 'm/s^3'),
         'gyr_w': ('gyroscope_random_walk', 'rad/s^2')}
"""Keys of VINS, with the figure of the noise and its unit for one sample."""

_CONTEXT = {'temperature': ('temperature', 1.0), 'supply_voltage': ('supply_voltage', 1.0),
            'std': ('vibration', STANDARD_GRAVITY), 'time': ('wait', 1.0)}
"""Column of the plan and its unit, by column of the poses: °C, V, m/s², s after the last pose.
Quantities keep their name."""

Noise = Mapping[str, Any]


def _affine(calibration: Calibration, factor: float = 1.0) -> tuple[Floats, Floats, Correction]:
    """Return M and c with force = M raw - c in the unit of `apply`, and the correction in g."""
    unit = calibration.force_per_g * factor
    matrix, constant = (each * unit for each in affine_fit(calibration))
    return matrix, constant, lambda reading, temperature: (reading @ matrix.T - constant) / unit


def _make_imu_calib(calibration: Calibration) -> Made:
    matrix, constant, correct = _affine(calibration)
    lines = ['SM:', *(f'  - {_yaml_number(value)}' for value in matrix.ravel().tolist()),
             'bias:', *(f'  - {_yaml_number(value)}' for value in constant.tolist())]
    comment = [f'source: {_IMU_CALIB_URL}',
               f'equation: force = SM raw - bias; SM row by row; {frame_words(calibration)}']
    return Made(commented(calibration, comment, lines), correct, True)


def _make_imucal(calibration: Calibration) -> Made:
    """Return the JSON file of imucal: FerrarisCalibrationInfo."""
    units, gyro = calibration.units, calibration.gyro
    matrix, constant, correct = _affine(calibration, STANDARD_GRAVITY if units.is_native else 1.0)
    gain = np.linalg.inv(matrix)
    sizes = np.linalg.norm(gain, axis=1)
    no_gyro = ' The bias of the gyro is not known: it is 0.' if gyro is None else ''
    content = {
        'cal_type': 'Ferraris',
        'acc_unit': 'm/s^2' if units.is_native else unit_in_ascii(units, ''),
        'gyr_unit': 'rad/s', 'from_acc_unit': unit_in_ascii(units, 'a.u.'),
        'from_gyr_unit': 'rad/s',
        'comment': '; '.join(['written by accel-calib export', *about(calibration)])
        + f'; {frame_words(calibration)}.{no_gyro}',
        'K_a': np.diag(sizes), 'R_a': gain / sizes[:, np.newaxis], 'b_a': gain @ constant,
        'K_g': np.eye(3), 'R_g': calibration.rotation, 'K_ga': np.zeros((3, 3)),
        'b_g': np.zeros(3) if gyro is None else gyro.bias, '_format_version': _IMUCAL_VERSION}
    return Made(_json(content), correct, True)


def _make_json(calibration: Calibration) -> Made:
    return Made(_json(_content(calibration)), None, True, _affine_alone(calibration))


def _make_npz(calibration: Calibration) -> Made:
    """Return all values as a NumPy archive; texts and effects are arrays of text."""
    content = _content(calibration)
    effects = content.pop('effects')
    arrays = {key: np.asarray(value) for key, value in content.items()
              if not isinstance(value, Mapping)}
    arrays['effects'] = np.asarray(json.dumps(effects, allow_nan=False))
    for name, values in calibration.model.values.items():
        arrays[f'effect.{name}'] = values
    for key, limits in calibration.ranges.items():
        arrays[f'range.{key}'] = np.array(limits)
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return Made(file.getvalue(), None, True, _affine_alone(calibration))


def _affine_alone(calibration: Calibration) -> tuple[str, ...]:
    """Return a note about readers that use matrix and offset alone."""
    left = difference_mg(calibration, Made('', lambda reading, temperature: (
        reading - calibration.offset) @ calibration.matrix.T @ calibration.rotation
        / calibration.force_per_g, True))
    if left < LEAST_LOSS_MG:
        return ()
    return (f'matrix and offset without the other effects leave {left:.2g} mg',)


def _content(calibration: Calibration) -> dict[str, Any]:
    quality, model = calibration.quality, calibration.model
    return {
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
        'effects': {name: {'unit': effect.unit, **effect.shown(values)}
                    for (name, values), effect in zip(model.values.items(), model.terms.effects,
                                                      strict=True)},
        'ranges': {key: list(limits) for key, limits in calibration.ranges.items()},
        'rms_before_mg': quality.rms_before_mg, 'rms_after_mg': quality.rms_after_mg}


def _json(content: Mapping[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False, default=lambda array: array.tolist()
                      ) + '\n'


def _make_kalibr(calibration: Calibration, noise: Noise | None) -> Made:
    """Return imu.yaml of Kalibr; raise InputError if a figure of the noise is missing."""
    figures, notes = _noise_figures(noise, 'Kalibr')
    comment = [f'source: {_KALIBR_URL}', 'Kalibr corrects no offset and gain: correct recordings '
               'with accel-calib apply.', *notes]
    # The topic of most examples, if that of the readings is not known.
    topic = json.dumps(plain_text(calibration.stream) or '/imu0')
    lines = [f'rostopic: {topic}', *(
        f'{key}: {_noise_number(figures[key])}  # {unit}' for key, unit in _NOISE.items())]
    return _of_noise(calibration, commented(calibration, comment, lines), notes)


def _make_vins(calibration: Calibration, noise: Noise | None) -> Made:
    """Return lines for VINS; raise InputError if a figure of the noise is missing."""
    figures, notes = _noise_figures(noise, 'VINS')
    root = float(np.sqrt(figures['update_rate']))
    comment = [f'source: {_VINS_URL}',
               'VINS does not correct offset and gain: correct readings with accel-calib first.',
               f'noise of one sample = density * sqrt({figures["update_rate"]:.6g} Hz)', *notes,
               'Put these lines into the configuration file, below "imu parameters".']
    gravity = calibration.units.per_g if calibration.units.is_si else STANDARD_GRAVITY
    lines = [*(f'{name}: {_noise_number(figures[key] * root)}  # {unit}, density '
               f'{figures[key]:.6g}' for name, (key, unit) in _VINS.items()),
             f'g_norm: {_yaml_number(gravity)}  # m/s^2']
    return _of_noise(calibration, commented(calibration, comment, lines), notes)


def _of_noise(calibration: Calibration, text: str, notes: tuple[str, ...]) -> Made:
    """Return the file of a tool that takes the readings as they are."""
    advice = ('the correction is not in this file: use accel-calib apply for recordings, or the '
              'calibrator node')
    return Made(text, lambda reading, temperature: calibration.units.to_g(reading), False,
                (advice, *notes))


def _noise_number(value: float) -> str:
    return _yaml_number(float(f'{value:.9g}'))


def _yaml_number(value: float) -> str:
    """Return a number for YAML 1.1, which reads 1e-05 without a point as text."""
    mantissa, exponent, power = repr(float(value)).partition('e')
    return mantissa + ('' if '.' in mantissa else '.0') + exponent + power


def _noise_figures(noise: Noise | None, label: str) -> tuple[dict[str, float], tuple[str, ...]]:
    """
    Return the figures of the noise that a file needs, and notes about them.

    A random walk that is not seen in the recording is replaced by its upper limit. Other figures
    that are missing or not positive raise InputError.

    """
    if noise is None:
        raise InputError(f'{label} needs the noise of the sensor, but --noise is not given',
                         'run accel-calib noise RECORDING --json noise.json, and add --noise '
                         'noise.json')
    figures, notes = {}, []
    for key in _NOISE:
        value, limits = noise.get(key), noise.get(f'{key}_axes_upper')
        reason = plain_text(str(noise.get(f'{key}_reason') or ''))
        if (value is None and 'random_walk' in key and isinstance(limits, list) and limits
                and all(map(_is_positive, limits))):
            value = max(limits)
            notes.append(f'{key} is not seen ({reason or "no reason is stated"}): its upper limit '
                         f'{value:.3g} is used')
        if not _is_positive(value):
            found = f'has no {key}' if value is None else f'has {key} {value!r}'
            raise InputError(f'the file of the noise {found}{reason and ": "}{reason}, but '
                             f'{label} needs a positive number', 'record a longer rest and run '
                             'accel-calib noise again, or write the figure of the data sheet into '
                             'the file')
        figures[key] = value
    return figures, tuple(notes)


def _is_positive(value: object) -> TypeGuard[float]:
    return (isinstance(value, int | float) and not isinstance(value, bool)
            and 0.0 < value < LARGEST)


def read_noise(path: Path) -> Noise:
    """
    Read a file of ``accel-calib noise --json``.

    Raises
    ------
    InputError
        If it is not a JSON object.
    OSError
        If the file cannot be read.

    """
    check_regular(path)
    content, fault = None, 'is not a JSON file'
    with suppress(ValueError):
        content = json.loads(path.read_text(encoding='utf-8'))
        fault = 'contains no JSON object'
    if not isinstance(content, Mapping):
        raise InputError(f'{path} {fault}, expected the result of accel-calib noise --json',
                         'run accel-calib noise RECORDING --json noise.json')
    return content


FORMATS: Mapping[str, Format] = MappingProxyType({
    **c_header.FORMATS, **flight_controllers.FORMATS,
    'imu_calib': Format('imu_calib', '_imu_calib.yaml', 'YAML file of the ROS package',
                        _make_imu_calib, source=_IMU_CALIB_URL),
    'imucal': Format('imucal', '_imucal.json', 'FerrarisCalibrationInfo as JSON', _make_imucal,
                     source=_IMUCAL_URL),
    'kalibr': Format('Kalibr', '_imu.yaml', 'imu.yaml with the noise', _make_kalibr, 'noise',
                     _KALIBR_URL),
    'vins': Format('VINS', '_vins.yaml', 'lines of the noise for its configuration', _make_vins,
                   'noise', _VINS_URL),
    'json': Format('JSON', '.json', 'all values', _make_json),
    'npz': Format('NumPy', '.npz', 'all values as arrays', _make_npz)})
"""The formats by name."""

CALIBRATION_ALONE = tuple(name for name, each in FORMATS.items() if each.needs != 'noise')
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
        Noise of the sensor (`read_noise`), for ``kalibr`` and ``vins``.
    options : Options
        Choices that some formats have.

    Raises
    ------
    InputError
        If the format cannot hold the calibration at all, or needs what is not given.
    ValueError
        If there is no such format.

    """
    if to not in FORMATS:
        raise ValueError(f'format is {to!r}, expected one of {", ".join(FORMATS)}')
    chosen = FORMATS[to]
    beside = {'': (), 'options': (options,), 'noise': (noise,)}[chosen.needs]

    def make(of: Calibration) -> Made:
        return chosen.make(of, *beside)

    made = make(calibration)
    return Exported(made.content, chosen.suffix, difference_mg(calibration, made),
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

    def write(file: TextIO) -> None:
        file.writelines(f'# {line}\n' for line in plan.lines)
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(['pose', 'up_x', 'up_y', 'up_z', 'attitude',
                         *(name for name, _ in columns.values()), 'separates',
                         'expected_probability'])
        for number, pose in enumerate(plan.poses, 1):
            context = [format(pose.context[key] * scale, '.6g') if key in pose.context else ''
                       for key, (_, scale) in columns.items()]
            writer.writerow([number, *(f'{part:.6f}' for part in pose.up), pose.words, *context,
                             ' / '.join(pose.separates), f'{pose.expected:.4f}'])

    write_atomically(path, write)
