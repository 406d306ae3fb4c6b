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
and the range of the temperature. They are applied before the rotation of the board. Readings of a
flight log have the axes of the sensor (`accel_calib.logs.autopilot`), so that the values replace
those of the vehicle; the log also states the place of the sensor in the parameters. ROS drivers
turn readings to x forward, y left, z up;
``axes='flu'`` turns them back by 180° about x, which changes the sign of the offsets of y and z.

Sources beside the code of the firmware (the URLs below): temperature of PX4 [1]_ and of
ArduPilot [2]_, and the parameter file of QGroundControl [3]_.

.. [1] https://docs.px4.io/main/en/advanced_config/sensor_thermal_calibration
.. [2] https://ardupilot.org/copter/docs/common-imutempcal.html
.. [3] https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/parameters.html

"""

from dataclasses import replace

import numpy as np
from numpy.polynomial import Polynomial

from .made import (
    commented, Format, Made, Options, polynomial, single, steady_at, steady_grid,
    temperature_range)
from ..calibrate import Calibration
from ..errors import InputError
from ..logs import ARDUPILOT_REFERENCE, ByAxis, DEGREE, PER_MILLION
from ..table import Autopilot, Firmware, Floats
from ..units import STANDARD_GRAVITY

_PX4_URL = ('https://github.com/PX4/PX4-Autopilot/blob/main/src/lib/sensor_calibration/'
            'Accelerometer.hpp')
_ARDUPILOT_URL = ('https://github.com/ArduPilot/ardupilot/blob/master/libraries/'
                  'AP_InertialSensor/AP_InertialSensor_Backend.cpp')
_BETAFLIGHT_URL = ('https://github.com/betaflight/betaflight/blob/master/src/main/sensors/'
                   'acceleration.c')

_INT32, _REAL32 = 6, 9
"""MAV_PARAM_TYPE of MAVLink."""

_COUNTS_PER_G = 2048.0
"""Counts per g of Betaflight's drivers at the range of 16 g."""

_LARGEST_COUNT = 32767
_PX4_INSTANCES, _ARDUPILOT_INSTANCES = (0, 1, 2, 3), (1, 2, 3)
_TO_FRD = np.array([1.0, -1.0, -1.0])
"""Signs of the axes x forward, y left, z up, in those of an autopilot."""

_AXES = {'flu': 'the calibration is in x forward, y left, z up; these values are turned by 180 '
                'deg about x to x forward, y right, z down',
         'same': 'axes: those of the readings of the calibration, which are taken to be those '
                 'of the firmware'}

_EXACT_G = 1e-7
"""A polynomial of a smaller degree is used if it is exact to this [g]."""

Parameters = dict[str, float]
"""Parameters of a firmware by name; whole numbers are of type int."""


def _fit_by_axis(calibration: Calibration, options: Options, reference: float | None = None
                 ) -> ByAxis:
    """
    Return the correction by axis that is nearest to a calibration in m/s², in the firmware's axes.

    Without a reference, the temperature of the polynomial is the middle of the range [°C].

    """
    low, high = temperature_range(calibration) or (0.0, 0.0)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    reference = middle if reference is None else reference
    grid, degree = steady_grid(calibration), _degree(calibration)
    s = (grid.temperature - middle) / half if degree else grid.temperature
    columns = np.vander(s, degree + 1, increasing=True)
    inner = Polynomial([(reference - middle) / half, 1.0 / half] if degree else [0.0])
    offset, scale = np.zeros((DEGREE + 1, 3)), np.zeros(3)
    for axis in range(3):
        found = np.linalg.lstsq(np.column_stack([grid.reading[:, axis], columns]),
                                grid.force[:, axis] * calibration.units.per_g, rcond=None)[0]
        # From a polynomial in s to one in T - reference.
        parts = Polynomial(-found[1:] / found[0])(inner).coef
        scale[axis], offset[:len(parts), axis] = found[0], parts
    offset *= _signs(options)
    return ByAxis(offset[0], scale, offset[1:], reference, (low, high))


def _degree(calibration: Calibration) -> int:
    """Return the degree of the offset in the temperature: 0, or 1 to 3."""
    low, high = temperature_range(calibration) or (0.0, 0.0)
    if high <= low:
        return 0
    vec_v = np.broadcast_to(steady_at(calibration, np.linspace(low, high, 9)).vec_v, (9, 3))
    return len(polynomial(np.linspace(-1.0, 1.0, 9), vec_v, _EXACT_G, DEGREE)) - 1


def _make_px4(calibration: Calibration, options: Options) -> Made:
    place, options = _place(calibration, options, 'px4')
    instance = _instance(options, _PX4_INSTANCES, 'PX4')
    metric = _in_metric(calibration, 'PX4')
    found = _fit_by_axis(metric, options)
    prefix = f'CAL_ACC{instance}_'
    thermal = f'TC_A{instance if place.thermal is None else place.thermal}_'
    rows = {**_device(options, prefix), **_three(prefix, 'OFF', found.offset),
            **_three(prefix, 'SCALE', found.scale)}
    if found.of_temperature or place.thermal is not None:
        rows |= {'TC_A_ENABLE': 1, **_device(options, thermal), f'{thermal}TREF': found.reference,
                 f'{thermal}TMIN': found.limits[0], f'{thermal}TMAX': found.limits[1]}
        for order, part in enumerate([np.zeros(3), *found.thermal]):
            rows |= {f'{thermal}X{order}_{axis}': value for axis, value in enumerate(part)}
    ids = f'{prefix}ID' + (f' and {thermal}ID' if found.of_temperature else '')
    notes = _notes(place)
    if options.device_id is None:
        notes += (f'PX4 uses these values for the accelerometer whose device id is in {ids}; '
                  'check it in QGroundControl, or use --device-id (device_id of sensor_accel)',)
    comment = [*_notes(place), _AXES[options.axes], f'source: {_PX4_URL}',
               'equation: (raw - thermal(T - TREF) - OFF) * SCALE, by axis, in m/s^2, before the '
               'rotation of the board', 'Vehicle-Id Component-Id Name Value Type']
    lines = [f'1\t1\t{name}\t{_number(value)}\t'
             f'{_INT32 if isinstance(value, int) else _REAL32}' for name, value in rows.items()]
    text = commented(calibration, comment, lines)
    return _made(text, found, metric, calibration, options, notes)


def _make_ardupilot(calibration: Calibration, options: Options) -> Made:
    place, options = _place(calibration, options, 'ardupilot')
    instance = _instance(options, _ARDUPILOT_INSTANCES, 'ArduPilot')
    metric = _in_metric(calibration, 'ArduPilot')
    found = _fit_by_axis(metric, options, ARDUPILOT_REFERENCE)
    prefix = f'INS_ACC{"" if instance == 1 else instance}'
    # The firmware adds the polynomial at CALTEMP, so that it is zero there.
    offset = found.offset + found.moved(ARDUPILOT_REFERENCE)
    rows = {**_device(options, f'{prefix}_'), **_three(f'{prefix}OFFS_', '', offset),
            **_three(f'{prefix}SCAL_', '', found.scale)}
    thermal = f'INS_TCAL{instance}_'
    if found.of_temperature:
        reference = float(np.clip(ARDUPILOT_REFERENCE, *found.limits))
        rows |= {f'INS_ACC{instance}_CALTEMP': reference, f'{thermal}ENABLE': 1,
                 f'{thermal}TMIN': found.limits[0], f'{thermal}TMAX': found.limits[1]}
    if found.of_temperature or place.thermal is not None:  # zeros replace those of the vehicle
        for order, part in enumerate(found.thermal, 1):
            rows |= _three(f'{thermal}ACC{order}_', '', part * PER_MILLION)
    comment = [*_notes(place), _AXES[options.axes], f'source: {_ARDUPILOT_URL}',
               'equation: (raw - p(T - 35) + p(CALTEMP - 35) - OFFS) * SCAL, by axis, in m/s^2, '
               'before the rotation of the board; p has the coefficients INS_TCAL / 1e6']
    lines = [f'{name},{_number(value)}' for name, value in rows.items()]
    return _made(commented(calibration, comment, lines), found, metric, calibration, options,
                 _notes(place))


def _place(calibration: Calibration, options: Options, firmware: Firmware
           ) -> tuple[Autopilot, Options]:
    """Return the place that the log states, and the options with what they leave open from it."""
    stated = calibration.poses.autopilot
    if stated is None or stated.firmware != firmware:
        return Autopilot(firmware), options
    if options.instance not in (None, stated.instance):
        return Autopilot(firmware, corrected=stated.corrected), options
    return stated, replace(
        options, instance=stated.instance,
        device_id=stated.device_id if options.device_id is None else options.device_id)


def _notes(place: Autopilot) -> tuple[str, ...]:
    """Return a note on readings that the old parameters still correct."""
    return (f'do not load this file: the readings were corrected already, and by what is not '
            f'known ({place.corrected})',) if place.corrected else ()


def _made(text: str, found: ByAxis, metric: Calibration, calibration: Calibration,
          options: Options, notes: tuple[str, ...]) -> Made:
    """Return the file with the correction by its values, in single precision."""
    written = replace(found, offset=single(found.offset), scale=single(found.scale),
                      thermal=single(found.thermal))
    factor, signs = metric.units.per_g / calibration.units.per_g, _signs(options)
    return Made(text, lambda reading, temperature: written.correct(
        reading * factor * signs, temperature) * signs / metric.units.per_g, False, notes)


def _make_betaflight(calibration: Calibration, options: Options) -> Made:
    signs, per_g, units = _signs(options), _counts_per_g(calibration, options), calibration.units
    factor = 1.0 if units.is_native else per_g / (STANDARD_GRAVITY if units.is_si else 1.0)
    grid = steady_grid(calibration)
    counts = np.round(np.mean(grid.reading * factor - grid.force * per_g, axis=0) * signs)
    if np.max(np.abs(counts)) > _LARGEST_COUNT:
        raise InputError(f'the largest offset is {np.max(np.abs(counts)):.0f} counts, expected at '
                         f'most {_LARGEST_COUNT}', 'correct --counts-per-g')
    comment = [_AXES[options.axes], f'source: {_BETAFLIGHT_URL}',
               f'equation: (raw - acc_calibration) / acc_1G, by axis, acc_1G = {per_g:g} counts; '
               'the fourth number says that the calibration is done']
    values = ','.join(f'{int(value)}' for value in counts)
    text = commented(calibration, comment, [f'set acc_calibration = {values},1', 'save'])
    return Made(text, lambda reading, temperature: (reading * factor - counts * signs) / per_g,
                False, rounded={'offset': 'counts'})


def _counts_per_g(calibration: Calibration, options: Options) -> float:
    """Return the counts per g of the firmware: those asked for, or a power of two near them."""
    if options.counts_per_g is not None:
        return options.counts_per_g
    if not calibration.units.is_native:
        return _COUNTS_PER_G
    return float(2.0 ** np.round(np.log2(calibration.units.per_g)))


def _in_metric(calibration: Calibration, label: str) -> Calibration:
    """Return the calibration for readings in m/s²; raise InputError if they are native."""
    if calibration.units.is_native:
        raise InputError(f'the calibration is for native readings, but {label} corrects readings '
                         'in m/s2', f'fit a calibration to the readings that {label} logs in m/s2')
    return calibration.in_units('m/s2')


def _instance(options: Options, known: tuple[int, ...], label: str) -> int:
    if options.instance is None:
        return known[0]
    if options.instance not in known:
        raise InputError(f'--instance is {options.instance}, but {label} has accelerometers '
                         f'{known[0]} to {known[-1]}', 'use one of these numbers')
    return options.instance


def _signs(options: Options) -> Floats:
    return _TO_FRD if options.axes == 'flu' else np.ones(3)


def _device(options: Options, prefix: str) -> Parameters:
    return {} if options.device_id is None else {f'{prefix}ID': options.device_id}


def _three(start: str, end: str, values: Floats) -> Parameters:
    return {f'{start}{axis}{end}': float(value) for axis, value in zip('XYZ', values)}


def _number(value: float) -> str:
    """Return a number in single precision without exponent."""
    if isinstance(value, int):
        return str(value)
    positive_zero = np.float32(value) + np.float32(0.0)
    return np.format_float_positional(positive_zero, unique=True, trim='0')


FORMATS = {
    'px4': Format('PX4', '_px4.params', 'parameter file of QGroundControl', _make_px4, 'options',
                  _PX4_URL),
    'ardupilot': Format('ArduPilot', '_ardupilot.param',
                        'parameter file of Mission Planner and MAVProxy', _make_ardupilot,
                        'options', _ARDUPILOT_URL),
    'betaflight': Format('Betaflight', '_betaflight.txt', 'commands for its command line',
                         _make_betaflight, 'options', _BETAFLIGHT_URL)}
