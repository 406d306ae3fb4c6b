# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Values of programs that need the noise of a sensor: Kalibr, VINS-Fusion and OpenVINS.

The figures are those of ``accel-calib noise --json``, per square root of hertz. VINS-Fusion takes
the noise of one sample, which is the density times the square root of the rate.

"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

from .affine import affine
from .made import Made, plain_text
from .plain_yaml import beginning_of, decoded, shown
from ..calibration import Calibration
from ..errors import InputError
from ..text import read_json
from ..units import STANDARD_GRAVITY

_NOISE = {'accelerometer_noise_density': 'm/s^2/sqrt(Hz)',
          'accelerometer_random_walk': 'm/s^3/sqrt(Hz)',
          'gyroscope_noise_density': 'rad/s/sqrt(Hz)',
          'gyroscope_random_walk': 'rad/s^2/sqrt(Hz)', 'update_rate': 'Hz'}
"""Figures of ``accel-calib noise --json``, and their units."""

_LARGEST = 1e6
"""Largest figure; noise and rate of any sensor are far below."""

Noise = Mapping[str, Any]


def noise_alone(calibration: Calibration, noise: Noise | None, label: str) -> Made:
    """Return the figures of a program that takes the readings as they are."""
    figures, notes = _noise_figures(noise, label)
    root = figures['update_rate'] ** 0.5
    values = {
        # The topic of most examples, if that of the readings is not known.
        'topic': plain_text(calibration.stream) or '/imu0', 'units': _NOISE,
        'gravity': calibration.units.per_g if calibration.units.is_si else STANDARD_GRAVITY,
        'figures': _short(figures), 'sample': _short({
            key: each * root for key, each in figures.items()})}
    return Made(values, lambda reading, temperature: calibration.units.to_g(reading), False, notes,
                ('the correction is not in this file: use accel-calib apply for recordings, or '
                 'the calibrator node', *notes))


def openvins(calibration: Calibration, noise: Noise | None) -> Made:
    """Return the figures of the noise and the gains; OpenVINS estimates the offset itself."""
    of_noise = noise_alone(calibration, noise, 'OpenVINS')
    made = affine(calibration, levelled=False)
    start = ', '.join(f'{each:.6g}' for each in made.values['V'])
    advice = ('OpenVINS estimates the offset; estimator_config.yaml holds its start: '
              f'init_dyn_bias_a: [{start}]')
    return replace(
        made, values={**of_noise.values, **made.values},
        correct=lambda reading, temperature: (
            calibration.units.to_g(reading) @ made.values['M'].T),
        comment=(*made.comment, advice, *of_noise.comment), notes=(advice, *of_noise.comment))


def _short(figures: Mapping[str, float]) -> dict[str, float]:
    return {key: float(f'{value:.9g}') for key, value in figures.items()}


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
            found = f'has no {key}' if value is None else f'has {key} {shown(value)}'
            raise InputError(f'the file of the noise {found}{reason and ": "}{reason}, but '
                             f'{label} needs a number above 0, up to {_LARGEST:g}',
                             'record a longer rest and run accel-calib noise again, or write the '
                             'figure of the data sheet into the file')
        figures[key] = value
    return figures, tuple(notes)


def _is_positive(value: object) -> TypeGuard[float]:
    return (isinstance(value, int | float) and not isinstance(value, bool)
            and 0.0 < value <= _LARGEST)


def read_noise(path: Path) -> Noise:
    """
    Read a file of ``accel-calib noise --json``.

    Raises
    ------
    InputError
        If it is not a JSON object, or is too large.
    OSError
        If the file cannot be read.

    """
    content, fault = None, 'contains no JSON object'
    try:
        content = read_json(decoded(beginning_of(path)))
    except ValueError as err:
        fault = f'is not a JSON file ({err})'
    if not isinstance(content, Mapping):
        raise InputError(f'{path} {fault}, expected the result of accel-calib noise --json',
                         'run accel-calib noise RECORDING --json noise.json')
    return content
