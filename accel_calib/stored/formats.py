# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The values of the exports: headers, flight controllers, matrices with an offset, and the noise.

**C and Arduino headers** have one function in single precision that corrects a reading. The
steady model (`made`) has an offset V, a gain W and bending terms, each a polynomial in the
temperature. With s the temperature scaled to -1 to 1 over the range of the poses, it computes

    d = (raw - V(s)) / per_g
    u = W(0)⁻¹ (d - (W(s) - W(0)) u - bend(s, u)),   repeated from u = W(0)⁻¹ d
    force = ΔRᵀ u force_per_g

Without temperature and bending terms this is force = M (raw - B). The number of repetitions is the
smallest one after which u changes by less than the precision of a float.

**Flight controllers**, and the registers of a chip:

=========== ============================================================== ====================
format      equation, by axis                                              readings
=========== ============================================================== ====================
PX4         (raw - thermal(T - TREF) - OFF) SCALE                          m/s², sensor_accel
ArduPilot   (raw - p(T - 35 °C) + p(CALTEMP - 35 °C) - OFFS) SCAL          m/s², IMU message
Betaflight  (raw - acc_calibration) / acc_1G                               counts
iNav        (raw - acczero) accgain / 4096 / acc_1G                        counts
MPU-6050    raw + change of the register                                   1/2048 g
=========== ============================================================== ====================

T is limited to the range of the polynomial. The values are the least-squares fit over the sphere
and the range of the temperature. They are applied before the rotation of the board. Readings of a
flight log have the axes of the sensor (`accel_calib.logs.autopilot`), so that the values replace
those of the vehicle; the log also states the place of the sensor in the parameters. ROS drivers
turn readings to x forward, y left, z up; ``axes='flu'`` turns them back by 180° about x, which
changes the sign of the offsets of y and z.

Sources beside those of the formats (`exports`): temperature of PX4 [1]_ and of
ArduPilot [2]_, and the parameter file of QGroundControl [3]_.

**A matrix and an offset.** Each program has its own parameters for the same calibration:

    force = M raw - c = M (raw - V),   M = A diag(s),   M = inv(K R),   M = Q L

A has columns of length 1, which is the rotation of the axes where the gains are those of each axis
(Fusion). K is diagonal, and R has rows of length 1 (imucal). Q is a rotation, and L is lower
triangular with a positive diagonal (OpenVINS, as Kalibr has it). For a model with more than offset
and gain, M and c are the least-squares fit to it.

**Noise.** The figures are those of ``accel-calib noise --json``, per square root of hertz.
VINS-Fusion takes the noise of one sample, which is the density times the square root of the rate.

.. [1] https://docs.px4.io/main/en/advanced_config/sensor_thermal_calibration
.. [2] https://ardupilot.org/copter/docs/common-imutempcal.html
.. [3] https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/parameters.html

"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
import re
from typing import Any, TypeGuard

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from .made import (
    frame_words, Made, Options, plain_text, polynomial, single, steady_context, steady_grid,
    temperature_range, unit_in_ascii)
from .plain_yaml import beginning_of, decoded, shown
from ..calibration import Calibration
from ..effects import (
    CUBE, MONOMIALS, ODD_SQUARE, PRODUCT, REFERENCE_TEMPERATURE, SIZE, SQUARE, WAVE, ZONAL, ZONES)
from ..errors import InputError
from ..logs import ARDUPILOT_REFERENCE, ByAxis, DEGREE, PER_MILLION
from ..table import Autopilot, Firmware, Floats
from ..text import read_json
from ..units import STANDARD_GRAVITY

_LARGEST_DEGREE = 10
_EXACT_G = 1e-7
"""Polynomials and repetitions are exact to this [g], the precision of a float."""

_NOTHING_G = 1e-10
"""Smaller coefficients are rounding errors."""

_LARGEST_STEPS = 20
_KINDS = {'square': SQUARE, 'cube': CUBE, 'odd_square': ODD_SQUARE, 'size': SIZE,
          'product': PRODUCT, 'wave': WAVE, 'zone': ZONAL}
"""First index in `MONOMIALS` of each kind of bending terms."""

_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,40}')
_BEYOND = 2.0
"""The repetitions converge for forces up to this [g]."""


@dataclass(frozen=True)
class Header:
    """
    The numbers of a header, in single precision.

    The polynomials in s = (temperature - middle) / half have the constant first: `vec_v` (k, 3) in
    the unit of the readings, `mat_w` (k, 3, 3), and `bend` (k, b) [g], the coefficients of the
    bending terms. `monomial` and `axis` (b,) are the function and the axis of each bending term.
    `inverse` is W(0)⁻¹, `turn` is ΔRᵀ times the force per g, and `steps` counts the repetitions.

    """

    vec_v: Floats
    mat_w: Floats
    bend: Floats
    monomial: NDArray[np.intp]
    axis: NDArray[np.intp]
    inverse: Floats
    turn: Floats
    per_g: float
    middle: float
    half: float
    steps: int

    @property
    def is_affine(self) -> bool:
        """Whether force = M (raw - B)."""
        return not self.of_temperature and not len(self.axis)

    @property
    def of_temperature(self) -> bool:
        """Whether the correction depends on the temperature."""
        return max(len(self.vec_v), len(self.mat_w), len(self.bend)) > 1

    @property
    def matrix(self) -> Floats:
        """M of an affine header, (3, 3)."""
        return self.turn @ self.inverse / self.per_g

    def force(self, reading: Floats, temperature: Floats) -> Floats:
        """Return the (n, 3) force in the unit of the header, by its equations."""
        if self.is_affine:
            return (reading - self.vec_v[0]) @ single(self.matrix).T
        s = (np.clip(temperature, self.middle - self.half, self.middle + self.half)
             - self.middle) / self.half
        d = (reading - _value(self.vec_v, s)) / self.per_g
        change = np.concatenate([np.zeros((1, 3, 3)), self.mat_w[1:]])
        gain, bend = _value(change, s), _value(self.bend, s)
        u = d @ self.inverse.T
        for _ in range(self.steps):
            added = np.einsum('nij,nj->ni', gain, u)
            for k, (monomial, axis) in enumerate(zip(self.monomial, self.axis)):
                added[:, axis] += bend[:, k] * MONOMIALS[monomial].value(*u.T)
            u = (d - added) @ self.inverse.T
        return u @ self.turn.T


def _value(polynomial: Floats, s: Floats) -> Floats:
    """Return a (k, ...) polynomial at (n,) values; without s for a constant."""
    powers = s[:, np.newaxis] ** np.arange(len(polynomial))
    return np.tensordot(powers, polynomial, 1)


def _header_of(calibration: Calibration) -> Header:
    """Return the numbers of a header, with as many repetitions as it needs."""
    low, high = temperature_range(calibration) or (REFERENCE_TEMPERATURE,) * 2
    middle, half = (low + high) / 2.0, max((high - low) / 2.0, 1e-3)
    count, units = 4 * _LARGEST_DEGREE, calibration.units
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    here = calibration.model.at(steady_context(calibration, middle + half * nodes))
    vec_v, mat_w, bend = (polynomial(nodes, values, 0.1 * _EXACT_G, _LARGEST_DEGREE)
                          for values in (np.broadcast_to(here.vec_v, (count, 3)),
                                         np.broadcast_to(here.mat_w, (count, 3, 3)),
                                         np.broadcast_to(here.bend, (len(here.bend), count)).T))
    for part in (vec_v, mat_w, bend):
        part[np.abs(part) < _NOTHING_G] = 0.0
    terms, which = here.terms, here.terms.bending
    found = Header(
        vec_v=single(units.from_g(vec_v)), mat_w=single(mat_w), bend=single(bend),
        monomial=np.array(terms.monomials, np.intp)[terms.place[which]], axis=terms.axis[which],
        inverse=single(np.linalg.inv(mat_w[0])),
        turn=single(calibration.rotation.T * calibration.force_per_g),
        per_g=float(np.float32(units.per_g)), middle=float(np.float32(middle)),
        half=float(np.float32(half)), steps=0)
    if found.is_affine:
        return found
    grid = steady_grid(calibration, 3, _BEYOND)
    before = found.force(grid.reading, grid.temperature)
    for steps in range(1, _LARGEST_STEPS + 1):
        found = replace(found, steps=steps)
        after = found.force(grid.reading, grid.temperature)
        if np.max(np.abs(after - before)) < _EXACT_G * calibration.force_per_g:
            return found
        before = after
    return found


def header(calibration: Calibration, options: Options) -> Made:
    """Return the values of a header for C99 and C++, or for a sketch."""
    if own := calibration.model.terms.of_force:
        raise InputError(f'the calibration has an own effect of the force ({own[0]}), which has '
                         'no code in C', 'refine without --also, or write this correction by hand')
    made, name = _header_of(calibration), name_of(calibration, options)
    bends: list[list[dict[str, Any]]] = [[
        {'polynomial': np.append(0.0, made.mat_w[1:, axis, column]), 'kind': 'force',
         'axis': column} for column in range(3)] for axis in range(3)]
    for k, (monomial, axis) in enumerate(zip(made.monomial.tolist(), made.axis.tolist())):
        kind, first = max((each for each in _KINDS.items() if each[1] <= monomial),
                          key=lambda each: each[1])
        which, of = divmod(monomial - first, 3)
        bends[axis].append({**(ZONES[which]._asdict() if kind == 'zone' else {}), 'kind': kind,
                            'axis': of, 'which': which, 'polynomial': made.bend[:, k]})
    degrees = sorted({ZONES[(index - ZONAL) // 3].degree
                      for index in made.monomial.tolist() if index >= ZONAL})
    values = {
        'name': name, 'affine': made.is_affine, 'M': made.matrix, 'B': made.vec_v[0],
        'N': made.inverse, 'R': made.turn, 'steps': made.steps, 'V': list(made.vec_v.T),
        'roots': bool(np.any(made.monomial >= WAVE)),
        'per_unit': 1.0 / made.per_g,
        # What is taken from d of each axis: polynomials in s times a monomial.
        'bend': [[each for each in terms if np.any(each['polynomial'])] for terms in bends],
        'legendre': [(degree, np.array(next(zone.polynomial for zone in ZONES
                                            if zone.degree == degree))) for degree in degrees],
        'unit': 'm/s^2' if calibration.units.is_si else 'g', 'frame': frame_words(calibration),
        's': made.of_temperature and {
            'middle': made.middle, 'low': made.middle - made.half,
            'high': made.middle + made.half, 'per_half': 1.0 / made.half}}
    return Made(values, lambda reading, temperature: (
        made.force(reading, temperature) / calibration.force_per_g), True)


def name_of(calibration: Calibration, options: Options) -> str:
    """Return the name of the functions; raise InputError if the one asked for is none in C."""
    if options.name and not _NAME.fullmatch(options.name):
        raise InputError(f'the name is {options.name!r}, expected a letter, and then at most '
                         '40 letters, digits or _', 'choose a name such as imu_left')
    return options.name or identifier(calibration.sensor)


def identifier(text: str) -> str:
    """Return a C identifier made from any text."""
    parts = re.findall('[a-z0-9]+', text.lower())
    name = '_'.join(parts)[:40].rstrip('_')
    return name if name[:1].isalpha() else f'accel_{name}'.rstrip('_')


# Flight controllers

_COUNTS_PER_G = 2048.0
"""Counts per g of Betaflight's drivers at the range of 16 g."""

_LARGEST_COUNT = 32767
_UNIT_GAIN, _LARGEST_GAIN = 4096, 8192
"""The gain 1 of iNav, and the largest one of its settings.yaml."""

_SIGNS = {'flu': np.array([1.0, -1.0, -1.0]), 'same': np.ones(3)}
"""Signs of the axes of readings, in those of an autopilot."""

_AXES = {'flu': 'the calibration is in x forward, y left, z up; these values are turned by 180 '
                'deg about x to x forward, y right, z down',
         'same': 'axes: those of the readings of the calibration, which are taken to be those '
                 'of the firmware'}

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
    grid, degree = steady_grid(calibration), 0
    if high > low:
        context = steady_context(calibration, np.linspace(low, high, 9))
        vec_v = np.broadcast_to(calibration.model.at(context).vec_v, (9, 3))
        degree = len(polynomial(np.linspace(-1.0, 1.0, 9), vec_v, _EXACT_G, DEGREE)) - 1
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
    offset *= _SIGNS[options.axes]
    return ByAxis(offset[0], scale, offset[1:], reference, (low, high))


def px4(calibration: Calibration, options: Options) -> Made:
    """Return the parameters of PX4."""
    place, instance, options = _place(calibration, options, 'px4', (0, 1, 2, 3), 'PX4')
    found = _fit_by_axis(calibration, options)
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
    advice = () if options.device_id is not None else (
        f'PX4 uses these values for the accelerometer whose device id is in {ids}; check it in '
        'QGroundControl, or use --device-id (device_id of sensor_accel)',)
    made = _made(rows, found, calibration, options, place)
    return replace(made, notes=made.notes + advice)


def ardupilot(calibration: Calibration, options: Options) -> Made:
    """Return the parameters of ArduPilot."""
    place, instance, options = _place(calibration, options, 'ardupilot', (1, 2, 3), 'ArduPilot')
    found = _fit_by_axis(calibration, options, ARDUPILOT_REFERENCE)
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
    return _made(rows, found, calibration, options, place)


def _place(calibration: Calibration, options: Options, firmware: Firmware,
           known: tuple[int, ...], label: str) -> tuple[Autopilot, int, Options]:
    """Return the place that the log states, the instance, and the options completed from it."""
    place, stated = Autopilot(firmware), calibration.poses.autopilot
    if stated is not None and stated.firmware == firmware:
        place = replace(place, corrected=stated.corrected)
        if options.instance in (None, stated.instance):
            place, options = stated, replace(
                options, instance=stated.instance,
                device_id=stated.device_id if options.device_id is None else options.device_id)
    instance = known[0] if options.instance is None else options.instance
    if instance not in known:
        raise InputError(f'--instance is {instance}, but {label} has accelerometers '
                         f'{known[0]} to {known[-1]}', 'use one of these numbers')
    return place, instance, options


def _made(rows: Parameters, found: ByAxis, calibration: Calibration, options: Options,
          place: Autopilot) -> Made:
    """Return parameters with the correction by their values, in single precision."""
    written = replace(found, offset=single(found.offset), scale=single(found.scale),
                      thermal=single(found.thermal))
    signs, per_g = _SIGNS[options.axes], calibration.units.per_g
    notes = (f'do not load this file: the readings were corrected already, and by what is not '
             f'known ({place.corrected})',) if place.corrected else ()
    return Made({'rows': rows}, lambda reading, temperature: written.correct(
        reading * signs, temperature) * signs / per_g, False, (*notes, _AXES[options.axes]), notes)


def counts(calibration: Calibration, options: Options, label: str, with_gain: bool = False,
           register_per_g: float | None = None, step: int = 1, notes: tuple[str, ...] = ()
           ) -> Made:
    """
    Return the whole numbers zero and gain of the correction (raw - zero) gain / 4096 in counts.

    The counts are those of the readings, or of a register with this many per g. `step` is the
    smallest change of zero. InputError is raised for values that the program refuses.

    """
    signs, units, per_g = _SIGNS[options.axes], calibration.units, options.counts_per_g
    if per_g is not None and register_per_g is not None and not units.is_native:
        raise InputError(f'{label} takes --counts-per-g for native readings, but those of the '
                         f'calibration are in {units.name}', 'leave it out')
    if per_g is None:  # a power of two near that of the readings
        per_g = (float(2.0 ** np.round(np.log2(units.per_g))) if units.is_native
                 else _COUNTS_PER_G)
    unit = register_per_g or per_g
    factor = unit / (per_g if units.is_native else STANDARD_GRAVITY if units.is_si else 1.0)
    grid = steady_grid(calibration)
    raw, force = grid.reading * factor * signs, grid.force * unit * signs
    slope, zero = np.ones(3), np.mean(raw - force, axis=0)
    if with_gain:
        slope, start = np.transpose([np.polyfit(*each, 1) for each in zip(raw.T, force.T)])
        zero = -start / slope
    zero, gain = np.round(zero / step) * step, np.round(slope * _UNIT_GAIN)
    if np.max(np.abs(zero)) > _LARGEST_COUNT:
        raise InputError(f'the largest offset is {np.max(np.abs(zero)):.0f} counts, expected at '
                         f'most {_LARGEST_COUNT}', 'correct --counts-per-g')
    if np.min(gain) < 1 or np.max(gain) > _LARGEST_GAIN:
        raise InputError(f'the gains are {", ".join(f"{each:.0f}" for each in gain)}, but {label} '
                         f'takes 1 to {_LARGEST_GAIN} ({_UNIT_GAIN} is 1)', 'correct '
                         '--counts-per-g, or fit the calibration to readings in m/s2 or g')
    rounded = {'offset': 'counts' if step == 1 else f'steps of {step}/{unit:g} g',
               **dict.fromkeys(('gain', 'axis_gain') if with_gain else (), f'1/{_UNIT_GAIN}')}
    values = {'name': name_of(calibration, options), 'zero': zero.astype(int),
              'gain': gain.astype(int)}
    return Made(values, lambda reading, temperature: (
        reading * factor * signs - zero) * signs * gain / (_UNIT_GAIN * unit), False,
        (_AXES[options.axes], f'1 g = {unit:g} counts'), notes=notes, rounded=rounded)


def _device(options: Options, prefix: str) -> Parameters:
    return {} if options.device_id is None else {f'{prefix}ID': options.device_id}


def _three(start: str, end: str, values: Floats) -> Parameters:
    return {f'{start}{axis}{end}': float(value) for axis, value in zip('XYZ', values)}


# A matrix and an offset


def affine(calibration: Calibration, force_per_g: float | None = None, levelled: bool = True,
           notes: tuple[str, ...] = ()) -> Made:
    """
    Return a calibration as M, c and the other parameters above.

    The force is in the unit of `Calibration.apply`, or has this many units per g. What is not
    `levelled` leaves the mounting out.

    """
    calibration = calibration if levelled else calibration.in_sensor_frame
    unit, gyro = force_per_g or calibration.force_per_g, calibration.gyro
    bias = np.zeros(3) if gyro is None else gyro.bias
    unknown = [] if gyro else ['the bias of the gyro is not known: it is 0']
    if all(effect.linear for effect in calibration.model.terms.effects):
        sensor = np.linalg.inv(calibration.model.linear_part[0]) / calibration.units.per_g
        constant = sensor @ calibration.offset
    else:
        grid, scale = steady_grid(calibration), calibration.units.per_g
        columns = np.column_stack([grid.reading / scale, np.ones(len(grid.reading))])
        found = np.linalg.lstsq(columns, grid.force, rcond=None)[0]
        sensor, constant = found[:3].T / scale, -found[3]
    matrix, constant = ((calibration.rotation.T @ each) * unit for each in (sensor, constant))
    sensitivity, inverse = np.linalg.norm(matrix, axis=0), np.linalg.inv(matrix)
    gain = np.linalg.norm(inverse, axis=1)
    orthogonal, triangular = (part[..., ::-1] for part in np.linalg.qr(matrix[:, ::-1]))
    triangular, signs = triangular[::-1], np.sign(np.diag(triangular[::-1]))
    turn = calibration.rotation.T
    values = {
        'M': matrix, 'c': constant, 'V': inverse @ constant,
        'A': matrix / sensitivity, 's': sensitivity, 'K': np.diag(gain),
        'R': inverse / gain[:, np.newaxis], 'Q': orthogonal * signs,
        'inverse_of_L': np.linalg.inv(signs[:, np.newaxis] * triangular), 'turn': turn,
        'gyro': bias, 'turned_gyro': turn @ bias, 'unknown': unknown}
    return Made(values, lambda reading, temperature: (reading @ matrix.T - constant) / unit,
                levelled, (f'force: {frame_words(calibration)}',), notes)


def imucal(calibration: Calibration) -> Made:
    """Return the values of FerrarisCalibrationInfo, in m/s² for native readings."""
    units = calibration.units
    made = affine(calibration, STANDARD_GRAVITY if units.is_native else None)
    return replace(made, values={
        **made.values, 'unit': 'm/s^2' if units.is_native else unit_in_ascii(units, ''),
        'from_unit': unit_in_ascii(units, 'a.u.')})


# The noise

_NOISE = {'accelerometer_noise_density': 'm/s^2/sqrt(Hz)',
          'accelerometer_random_walk': 'm/s^3/sqrt(Hz)',
          'gyroscope_noise_density': 'rad/s/sqrt(Hz)',
          'gyroscope_random_walk': 'rad/s^2/sqrt(Hz)', 'update_rate': 'Hz'}
"""Figures of ``accel-calib noise --json``, and their units."""

_LARGEST = 1e6
"""Largest figure; noise and rate of any sensor are far below."""

Noise = Mapping[str, Any]


def noise_alone(calibration: Calibration, noise: Noise | None, label: str) -> Made:
    """
    Return the figures of the noise for a program that takes the readings as they are.

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
    of_figures, of_sample = ({key: float(f'{factor * each:.9g}') for key, each in figures.items()}
                             for factor in (1.0, figures['update_rate'] ** 0.5))
    values = {
        # The topic of most examples, if that of the readings is not known.
        'topic': plain_text(calibration.stream) or '/imu0', 'units': _NOISE,
        'gravity': calibration.units.per_g if calibration.units.is_si else STANDARD_GRAVITY,
        'figures': of_figures, 'sample': of_sample}
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
