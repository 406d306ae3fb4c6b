# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameters of flight controllers: PX4, ArduPilot and Betaflight.

=========== ============================================================== ====================
format      equation of the firmware                                       readings
=========== ============================================================== ====================
PX4         (raw - thermal(T - TREF) - OFF) SCALE, by axis                 m/s², sensor_accel
ArduPilot   (raw - p(T - 35 °C) + p(CALTEMP - 35 °C) - OFFS) SCAL, by axis m/s², IMU message
Betaflight  (raw - acc_calibration) / acc_1G, by axis                      counts
=========== ============================================================== ====================

T is limited to the range of the polynomial. The values are the least-squares fit over the sphere
and the range of the temperature. They are applied before the rotation of the board, in the axes
of the logged readings. ROS drivers turn these readings to x forward, y left, z up;
``axes='flu'`` turns them back by 180° about x, which changes the sign of the offsets of y and z.

Sources: [1]_ PX4, [2]_ its temperature compensation, [3]_ ArduPilot, [4]_ its temperature
calibration, [5]_ Betaflight, [6]_ the parameter file of QGroundControl.

.. [1] https://github.com/PX4/PX4-Autopilot/blob/main/src/lib/sensor_calibration/Accelerometer.hpp
.. [2] https://docs.px4.io/main/en/advanced_config/sensor_thermal_calibration
.. [3] https://github.com/ArduPilot/ardupilot/blob/master/libraries/AP_InertialSensor/
   AP_InertialSensor_Backend.cpp
.. [4] https://ardupilot.org/copter/docs/common-imutempcal.html
.. [5] https://github.com/betaflight/betaflight/blob/master/src/main/sensors/acceleration.c
.. [6] https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/parameters.html

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .made import about, in_metric, Made, Options, steady_at, steady_grid, temperature_range
from ...calibrate import Calibration
from ...effects import AXES
from ...errors import InputError
from ...table import Floats
from ...units import STANDARD_GRAVITY

PX4_URL = ('https://github.com/PX4/PX4-Autopilot/blob/main/src/lib/sensor_calibration/'
           'Accelerometer.hpp')
ARDUPILOT_URL = ('https://github.com/ArduPilot/ardupilot/blob/master/libraries/AP_InertialSensor/'
                 'AP_InertialSensor_Backend.cpp')
BETAFLIGHT_URL = ('https://github.com/betaflight/betaflight/blob/master/src/main/sensors/'
                  'acceleration.c')

_INT32, _REAL32 = 6, 9
"""MAV_PARAM_TYPE of MAVLink."""

_ARDUPILOT_REFERENCE = 35.0
_PER_MILLION = 1e6
_COUNTS_PER_G = 2048.0
"""Counts per g of Betaflight's drivers at the range of 16 g."""

_LARGEST_COUNT = 32767
_PX4_INSTANCES, _ARDUPILOT_INSTANCES = (0, 1, 2, 3), (1, 2, 3)
_TO_FRD = np.array([1.0, -1.0, -1.0])
"""Signs of the axes x forward, y left, z up, in those of an autopilot."""


@dataclass(frozen=True)
class ByAxis:
    """
    A correction by axis: (raw - offset - Σ thermal[k] (T - reference)^(k+1)) scale.

    Parameters
    ----------
    offset : (3,) array
        Offset [m/s²].
    scale : (3,) array
        Scale.
    thermal : (k, 3) array
        Polynomial of the offset without its constant [m/s²/°C^(k+1)]; k is 0 without temperature.
    reference : float
        Temperature of the polynomial [°C].
    limits : tuple of float
        Range of the temperature [°C].

    """

    offset: Floats
    scale: Floats
    thermal: Floats
    reference: float
    limits: tuple[float, float]

    def correct(self, reading: Floats, temperature: Floats) -> Floats:
        """Return the (n, 3) corrected readings [m/s²]."""
        change = np.clip(temperature, *self.limits)[:, np.newaxis] - self.reference
        moved = sum((part * change ** (k + 1) for k, part in enumerate(self.thermal)),
                    np.zeros_like(reading))
        return (reading - moved - self.offset) * self.scale

    def turned(self, signs: Floats) -> ByAxis:
        """Return the correction of the same sensor in axes of other signs."""
        return ByAxis(self.offset * signs, self.scale, self.thermal * signs, self.reference,
                      self.limits)


def fit_by_axis(calibration: Calibration, reference: float | None = None) -> ByAxis:
    """
    Return the correction by axis that is nearest to a calibration in m/s².

    Parameters
    ----------
    calibration : Calibration
        A calibration in m/s².
    reference : float, optional
        Temperature of the polynomial [°C]; without it, the middle of the range.

    """
    low, high = temperature_range(calibration) or (0.0, 0.0)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    reference = middle if reference is None else reference
    grid, degree = steady_grid(calibration), _degree(calibration)
    s = (grid.temperature - middle) / half if degree else grid.temperature
    columns = np.column_stack([s ** k for k in range(degree + 1)])
    offset, scale = np.zeros((degree + 1, 3)), np.zeros(3)
    for axis in range(3):
        found = np.linalg.lstsq(np.column_stack([grid.reading[:, axis], columns]),
                                grid.force[:, axis] * calibration.units.per_g, rcond=None)[0]
        scale[axis], offset[:, axis] = found[0], -found[1:] / found[0]
    shifted = _about(offset, middle, half, reference) if degree else offset
    return ByAxis(shifted[0], scale, shifted[1:], reference, (low, high))


def _degree(calibration: Calibration) -> int:
    """Return the degree of the offset in the temperature: 0, or 1 to 3."""
    low, high = temperature_range(calibration) or (0.0, 0.0)
    if high <= low:
        return 0
    nodes = np.linspace(low, high, 9)
    vec_v = np.broadcast_to(steady_at(calibration, nodes).vec_v, (9, 3))
    s = np.linspace(-1.0, 1.0, 9)
    for degree in range(3):
        powers = s[:, np.newaxis] ** np.arange(degree + 1)
        found = np.linalg.lstsq(powers, vec_v, rcond=None)[0]
        if np.max(np.abs(powers @ found - vec_v)) < 1e-7:
            return degree
    return 3


def _about(polynomial: Floats, middle: float, half: float, reference: float) -> Floats:
    """Return a polynomial in (T - middle) / half as one in T - reference."""
    inner = np.polynomial.Polynomial([(reference - middle) / half, 1.0 / half])
    columns = [np.polynomial.Polynomial(column)(inner) for column in polynomial.T]
    return np.column_stack([np.pad(np.asarray(each.coef), (0, len(polynomial) - len(each.coef)))
                            for each in columns])


def make_px4(calibration: Calibration, options: Options) -> Made:
    """Return a parameter file of QGroundControl for PX4."""
    signs, instance = _signs(options), _instance(options, _PX4_INSTANCES, 'PX4')
    metric = in_metric(calibration, 'PX4')
    found = fit_by_axis(metric).turned(signs)
    device = options.device_id
    prefix, thermal = f'CAL_ACC{instance}_', f'TC_A{instance}_'
    rows: list[tuple[str, float | int]] = [] if device is None else [(f'{prefix}ID', device)]
    rows += [(f'{prefix}{axis.upper()}OFF', value) for axis, value in zip(AXES, found.offset)]
    rows += [(f'{prefix}{axis.upper()}SCALE', value) for axis, value in zip(AXES, found.scale)]
    if len(found.thermal):
        rows += [('TC_A_ENABLE', 1)] + ([] if device is None else [(f'{thermal}ID', device)])
        rows += [(f'{thermal}TREF', found.reference), (f'{thermal}TMIN', found.limits[0]),
                 (f'{thermal}TMAX', found.limits[1])]
        rows += [(f'{thermal}X{order}_{axis}', float(found.thermal[order - 1, axis])
                  if 1 <= order <= len(found.thermal) else 0.0)
                 for order in range(4) for axis in range(3)]
    comment = [*_head(calibration, options, PX4_URL),
               'equation: (raw - thermal(T - TREF) - OFF) * SCALE, by axis, in m/s^2, before the '
               'rotation of the board', 'Vehicle-Id Component-Id Name Value Type']
    lines = [f'1\t1\t{name}\t{number(value)}\t{_INT32 if isinstance(value, int) else _REAL32}'
             for name, value in rows]
    return _made(comment, lines, _as_written(found), metric, calibration, signs,
                 _px4_notes(instance, device, bool(len(found.thermal))))


def _px4_notes(instance: int, device: int | None, thermal: bool) -> tuple[str, ...]:
    if device is not None:
        return ()
    ids = f'CAL_ACC{instance}_ID' + (f' and TC_A{instance}_ID' if thermal else '')
    return (f'PX4 uses these values for the accelerometer whose device id is in {ids}; check it '
            'in QGroundControl, or use --device-id (device_id of sensor_accel)',)


def make_ardupilot(calibration: Calibration, options: Options) -> Made:
    """Return a parameter file of Mission Planner and MAVProxy for ArduPilot."""
    signs = _signs(options)
    instance = _instance(options, _ARDUPILOT_INSTANCES, 'ArduPilot')
    metric = in_metric(calibration, 'ArduPilot')
    found = fit_by_axis(metric, _ARDUPILOT_REFERENCE).turned(signs)
    number_of = '' if instance == 1 else str(instance)
    rows: list[tuple[str, float | int]] = (
        [] if options.device_id is None else [(f'INS_ACC{number_of}_ID', options.device_id)])
    moved, base = np.zeros(3), float(np.clip(_ARDUPILOT_REFERENCE, *found.limits))
    if len(found.thermal):
        # The firmware adds the polynomial at CALTEMP, so that it is zero there.
        moved = sum(part * (base - _ARDUPILOT_REFERENCE) ** (k + 1)
                    for k, part in enumerate(found.thermal))
    for axis, name in enumerate(AXES):
        rows.append((f'INS_ACC{number_of}OFFS_{name.upper()}', found.offset[axis] + moved[axis]))
    rows += [(f'INS_ACC{number_of}SCAL_{name.upper()}', value)
             for name, value in zip(AXES, found.scale)]
    if len(found.thermal):
        rows += [(f'INS_ACC{instance}_CALTEMP', base), *_tcal(found, instance)]
    comment = [*_head(calibration, options, ARDUPILOT_URL),
               'equation: (raw - p(T - 35) + p(CALTEMP - 35) - OFFS) * SCAL, by axis, in m/s^2, '
               'before the rotation of the board; p has the coefficients INS_TCAL / 1e6']
    lines = [f'{name},{number(value)}' for name, value in rows]
    return _made(comment, lines, _as_written(found), metric, calibration, signs, ())


def _tcal(found: ByAxis, instance: int) -> list[tuple[str, float | int]]:
    """Return the parameters of the temperature calibration of ArduPilot."""
    prefix = f'INS_TCAL{instance}_'
    rows: list[tuple[str, float | int]] = [
        (f'{prefix}ENABLE', 1), (f'{prefix}TMIN', found.limits[0]),
        (f'{prefix}TMAX', found.limits[1])]
    for order in range(3):
        values = found.thermal[order] if order < len(found.thermal) else np.zeros(3)
        rows += [(f'{prefix}ACC{order + 1}_{name.upper()}', float(value) * _PER_MILLION)
                 for name, value in zip(AXES, values)]
    return rows


def _as_written(found: ByAxis) -> ByAxis:
    """Return the values as the firmware has them, in single precision."""
    offset, scale, thermal = (np.asarray(np.asarray(each, np.float32), float)
                              for each in (found.offset, found.scale, found.thermal))
    return ByAxis(offset, scale, thermal, found.reference, found.limits)


def _made(comment: list[str], lines: list[str], found: ByAxis, metric: Calibration,
          calibration: Calibration, signs: Floats, notes: tuple[str, ...]) -> Made:
    text = '\n'.join([*(f'# {line}'.rstrip() for line in comment), *lines]) + '\n'
    factor = metric.units.per_g / calibration.units.per_g

    def correct(reading: Floats, temperature: Floats) -> Floats:
        turned = found.correct(reading * factor * signs, temperature)
        return turned * signs / metric.units.per_g

    return Made(text, correct, False, notes)


def make_betaflight(calibration: Calibration, options: Options) -> Made:
    """
    Return commands for the command line of Betaflight.

    Raises
    ------
    InputError
        If an offset is larger than the setting can hold.

    """
    signs, per_g = _signs(options), _counts_per_g(calibration, options)
    factor = (1.0 if calibration.units.is_native else
              per_g / (STANDARD_GRAVITY if calibration.units.is_si else 1.0))
    grid = steady_grid(calibration)
    mean = np.mean(grid.reading * factor - grid.force * per_g, axis=0)
    counts = np.round(mean * signs)
    if np.max(np.abs(counts)) > _LARGEST_COUNT:
        raise InputError(f'the largest offset is {np.max(np.abs(counts)):.0f} counts, expected at '
                         f'most {_LARGEST_COUNT}', 'correct --counts-per-g')
    values = ','.join(f'{int(value)}' for value in counts)
    comment = [*_head(calibration, options, BETAFLIGHT_URL),
               f'equation: (raw - acc_calibration) / acc_1G, by axis, acc_1G = {per_g:g} counts; '
               'the fourth number says that the calibration is done']
    text = '\n'.join([*(f'# {line}' for line in comment), f'set acc_calibration = {values},1',
                      'save', ''])
    return Made(text, lambda reading, temperature: (
        reading * factor - counts * signs) / per_g, False, rounded='counts')


def _counts_per_g(calibration: Calibration, options: Options) -> float:
    """Return the counts per g of the firmware: those asked for, or a power of two near them."""
    if options.counts_per_g is not None:
        return options.counts_per_g
    if not calibration.units.is_native:
        return _COUNTS_PER_G
    return float(2.0 ** np.round(np.log2(calibration.units.per_g)))


def _signs(options: Options) -> Floats:
    return _TO_FRD if options.axes == 'flu' else np.ones(3)


def _instance(options: Options, known: tuple[int, ...], label: str) -> int:
    if options.instance is None:
        return known[0]
    if options.instance not in known:
        raise InputError(f'--instance is {options.instance}, but {label} has accelerometers '
                         f'{known[0]} to {known[-1]}', 'use one of these numbers')
    return options.instance


def _head(calibration: Calibration, options: Options, url: str) -> list[str]:
    """Return the first lines of the comment."""
    axes = {'flu': 'the calibration is in x forward, y left, z up; these values are turned by 180 '
                   'deg about x to x forward, y right, z down',
            'same': 'axes: those of the readings of the calibration, which are taken to be those '
                    'of the firmware'}
    return ['Calibration of an accelerometer, written by accel-calib export.',
            *about(calibration), axes[options.axes], f'source: {url}']


def number(value: float | int) -> str:
    """Return a number in single precision without exponent."""
    if isinstance(value, int):
        return str(value)
    return np.format_float_positional(np.float32(value), unique=True, trim='0')
