# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What all exports share: the steady model, the losses, and text that is safe in any file.

Most formats hold no more than an offset, a matrix and a polynomial in the temperature. They are
made from the steady model: the model in the state in which a sensor is used later. Of the context,
only the temperature is free. The time is that of the last pose, the supply voltage is the mean of
the poses, and vibration, rotation, lag and rate of the temperature are zero.

The loss of a format is the RMS difference to the full correction, measured: the equation of the
format, with the written parameters, corrects readings of 1 g over the sphere, with the context of
the poses.

"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from textwrap import wrap
from typing import Any, TYPE_CHECKING

import numpy as np

from ..calibration import Calibration, in_g, uncertainty_g
from ..effects import (
    add_history, Context, EffectKey, entry_of, formula_of, Model, NOMINAL_SUPPLY,
    REFERENCE_TEMPERATURE)
from ..geometry import angle_of, OVER_THE_SPHERE, spread_directions
from ..table import Floats, range_of
from ..text import plain
from ..units import MG, Units

if TYPE_CHECKING:
    from jinja2 import Environment

Correction = Callable[[Floats, Floats], Floats]
"""(n, 3) readings in the unit of the calibration, (n,) temperatures [°C] -> (n, 3) force [g]."""

LEAST_LOSS_MG = 0.005
"""Smaller losses are not mentioned: rounding to single precision causes about 0.0001 mg."""

TITLE = 'Calibration of an accelerometer, written by accel-calib export'
_LARGEST_TEXT = 200
_TEMPERATURE_KEYS = ('temperature', 'temperature_of_offset', 'temperature_of_gain')
_AXES = {'ros': 'x forward, y left, z up', 'ned': 'x north, y east, z down, read along gravity',
         'android': 'x right, y up the screen, z out of it', 'win8': 'as android, z reversed'}


@dataclass(frozen=True)
class Options:
    """
    Choices of an export.

    Parameters
    ----------
    name : str
        Name of the calibration, a C identifier; empty: the sensor's name.
    instance : int or None
        Number of the accelerometer in the autopilot; None: the first one.
    device_id : int or None
        Device id of the accelerometer in the autopilot; None: not known.
    axes : {'same', 'flu'}
        Axes of the readings: those of the autopilot (``same``), or x forward, y left, z up of the
        same sensor (``flu``, as ROS has them).
    counts_per_g : float or None
        Counts per g of the flight controller; None: found from the calibration, or 2048.

    """

    name: str = ''
    instance: int | None = None
    device_id: int | None = None
    axes: str = 'same'
    counts_per_g: float | None = None


@dataclass(frozen=True)
class Made:
    """
    The values of an export, and what they do.

    `values` fill the template of the format: numbers, arrays and text of one line; `data` is the
    whole file instead, if it is no text. `correct` is the correction that they make by the
    equation of the format; None for a format that holds everything. `levelled` states whether it
    includes the mounting, and `rounded` what the values of an effect are rounded to. `comment` are
    more lines for the comment of the file, and `notes` say what the user has to do.

    """

    values: Mapping[str, Any]
    correct: Correction | None
    levelled: bool
    comment: Sequence[str] = ()
    notes: tuple[str, ...] = ()
    rounded: Mapping[str, str] = field(default_factory=dict)
    data: bytes = b''


@dataclass(frozen=True)
class Format:
    """
    A format that a calibration can be exported to.

    `label` is the name of what reads the file, `suffix` the end of its name, `what` its content in
    a few words, `equation` how the reader corrects, `holds` which effects it has, and `source` the
    definition of the format; empty for formats of this package. `make` returns the values of a
    calibration for the template. What it `takes` beside are fields of `Options`, or the ``noise``
    of the sensor, which it needs. A `metric` reader takes readings in m/s² only.

    """

    label: str
    suffix: str
    what: str
    equation: str
    holds: str
    make: Callable[..., Made]
    source: str = ''
    takes: tuple[str, ...] = ()
    metric: bool = False


@dataclass(frozen=True)
class Loss:
    """
    What a format does not hold: the RMS difference to the full correction that is left [mg].

    The effect is ``mounting`` for ΔR, and empty for all effects together.

    """

    effect: str
    words: str
    leaves_mg: float


@dataclass(frozen=True)
class Grid:
    """Readings with their full correction: what an export is fitted to or measured by."""

    reading: Floats
    temperature: Floats
    force: Floats


# The steady model


def temperature_range(calibration: Calibration) -> tuple[float, float] | None:
    """Return the range of the temperature that acts [°C]; None for a model without temperature."""
    ranges = [calibration.ranges[key] for key in _TEMPERATURE_KEYS
              if key in calibration.ranges and key in calibration.model.over]
    if not ranges:
        return None
    low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
    return low, max(low, high)


def steady_context(calibration: Calibration, temperature: Floats) -> Context:
    """Return the context of the steady model at (n,) temperatures."""
    count, used = len(temperature), calibration.used_poses
    supply = (float(np.mean(used['supply_voltage'])) if 'supply_voltage' in used and len(used)
              else NOMINAL_SUPPLY)
    time = calibration.ranges.get('time', (0.0, 0.0))[1]
    return {**calibration.typical_context(count),
            **{key: np.full(count, value) for key, value in calibration.model.neutral.items()},
            **dict.fromkeys(_TEMPERATURE_KEYS, temperature), 'temperature_rate': np.zeros(count),
            'time': np.full(count, time), 'supply_voltage': np.full(count, supply)}


def steady_grid(calibration: Calibration, temperatures: int = 9, size: float = 1.0) -> Grid:
    """Return forces of this size [g] over the sphere and the range of the temperature."""
    low, high = temperature_range(calibration) or (REFERENCE_TEMPERATURE, REFERENCE_TEMPERATURE)
    levels = np.linspace(low, high, temperatures if high > low else 1)
    force = np.tile(OVER_THE_SPHERE * size, (len(levels), 1))
    temperature = np.repeat(levels, len(OVER_THE_SPHERE))
    reading = calibration.model.at(steady_context(calibration, temperature)).reading(force)
    return Grid(calibration.units.from_g(reading), temperature, force)


def polynomial(nodes: Floats, values: Floats, exact: float, most: int) -> Floats:
    """Return the (k, ...) polynomial of the smallest degree through (n, ...) values at nodes."""
    flat = values.reshape(len(nodes), -1)
    for degree in range(most + 1):
        powers = nodes[:, np.newaxis] ** np.arange(degree + 1)
        found = np.linalg.lstsq(powers, flat, rcond=None)[0]
        if not flat.size or np.max(np.abs(powers @ found - flat)) < exact:
            break
    return found.reshape(len(found), *values.shape[1:])


def single(values: Floats) -> Floats:
    """Return the values in single precision."""
    return np.asarray(np.asarray(values, np.float32), float)


# The losses


def losses_of(calibration: Calibration, label: str, make: Callable[[Calibration], Made],
              made: Made) -> tuple[Loss, ...]:
    """
    Return what an export does not hold: the effects, largest first, then all, then the mounting.

    The part of an effect is the loss for a sensor that has this effect alone.

    """
    def left(values: dict[EffectKey, Floats]) -> float:
        kept = Model(values)
        alone = replace(calibration, model=kept, covariance=np.zeros((len(kept.vector),) * 2))
        return difference_mg(alone, make(alone))

    found, total = list[Loss](), difference_mg(calibration, made)
    if total >= LEAST_LOSS_MG:
        ideal, step = left({}), made.rounded.get('gain')
        words = f'rounds the sensitivity to {step}' if step else 'has no sensitivity'
        found.append(Loss('', f'{label} {words}: leaves {ideal:.2g} mg', ideal))
        for name, values in calibration.model.values.items():
            part = float(np.sqrt(max(left({name: values}) ** 2 - ideal ** 2, 0.0)))
            effect = entry_of(name)
            parameters, shape = effect.split(values)
            what = effect.words.partition(',')[0]
            words = f'has no {what}'
            if str(name) in made.rounded:
                words = f'rounds the {what} to {made.rounded[str(name)]}'
            elif effect.is_lagged(shape) and (
                    left({name: effect.filled(parameters)}) < LEAST_LOSS_MG):
                words = f'has no lag ({shape[0]:.0f} s) in the {what}'
            found.append(Loss(str(name), f'{label} {words}: leaves {part:.2g} mg', part))
        found = sorted((each for each in found if each.leaves_mg >= LEAST_LOSS_MG),
                       key=lambda each: -each.leaves_mg)
        if len(found) != 1 or found[0].leaves_mg < 0.99 * total:
            limits = temperature_range(calibration)
            where = f', from {limits[0]:.0f} to {limits[1]:.0f} degC' if limits else ''
            found.append(Loss('', f'{label} leaves {total:.2g} mg in all{where}', total))
    if calibration.is_levelled and not made.levelled:
        angle = angle_of(calibration.rotation)
        found.append(Loss('mounting', f'this file of {label} holds no mounting: it leaves the '
                          f'rotation of {angle:.2f} deg',
                          2.0 * np.sin(np.radians(angle) / 2.0) * np.sqrt(2.0 / 3.0) * MG))
    return tuple(found)


def difference_mg(calibration: Calibration, made: Made) -> float:
    """Return the RMS difference between the full correction and that of an export [mg]."""
    if made.correct is None:
        return 0.0
    model = calibration.model
    if not set(model.needs) - {'temperature'}:
        grid = steady_grid(calibration)
    else:  # forces over the sphere with the context of the poses
        poses = add_history(in_g(calibration.poses, calibration.units), model)
        known = calibration.held_context(poses.columns)
        rows = np.flatnonzero(np.isin(calibration.poses.row, calibration.used_poses.row))
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, 60).astype(int))]
        directions = spread_directions(100)
        each = np.repeat(rows, len(directions))
        context: dict[str, Any] = {
            **steady_context(calibration, np.full(len(each), REFERENCE_TEMPERATURE)),
            **{key: values[each] for key, values in known.items()}}
        force = np.tile(directions, (len(rows), 1))
        reading = model.at(context).reading(force)
        grid = Grid(calibration.units.from_g(reading), context['temperature'], force)
    wanted = grid.force @ calibration.rotation if made.levelled else grid.force
    found = made.correct(grid.reading, grid.temperature)
    return float(np.sqrt(np.mean(np.sum((found - wanted) ** 2, axis=1)))) * MG


# Text


def plain_text(text: str) -> str:
    """Return one line of ASCII that is safe in a comment of any file, also of trigraphs in C."""
    line = ' '.join(text.split())[:_LARGEST_TEXT]
    safe = ''.join(each if ' ' <= each <= '~' and each not in '?\\' else '.' for each in line)
    while '*/' in safe or '/*' in safe:
        safe = safe.replace('*/', '* /').replace('/*', '/ *')
    return safe


def unit_in_ascii(units: Units, native: str) -> str:
    """Return the unit of readings, with this name for native ones."""
    return native if units.is_native else units.name.replace('s2', 's^2')


def rendered(name: str, chosen: Format, calibration: Calibration, made: Made) -> str:
    """
    Return the text of a file, from the template of this name.

    Its comment has lines about the calibration: sensor, unit, model, quality, and curves.

    """
    quality, poses, units = calibration.quality, calibration.used_poses, calibration.units
    effects = ', '.join(map(str, calibration.model.effects))
    lines = [TITLE, f'sensor: {calibration.sensor or "not named"}',
             f'date: {calibration.date or "not known"}',
             f'readings: {unit_in_ascii(units, "native (counts or volts)")}, '
             f'1 g = {units.per_g:.9g}',
             f'model {calibration.name}: {effects or "no effects"}',
             f'residual over {len(poses)} poses: before {quality.rms_before_mg:.3g} mg, after '
             f'{quality.rms_after_mg:.3g} mg',
             f'uncertainty of |force|: {uncertainty_g(calibration) * MG:.2g} mg (1 sd, largest '
             'over the sphere)']
    for effect, values in calibration.model.values.items():
        formula = formula_of(effect, values, calibration.deviations).replace('°C', 'degC')
        lines += [f'formula of {formula}'] if formula else []
    low, high = range_of(poses, 'temperature')
    if np.isfinite(low):
        lines.append(f'temperature of the poses: {low:.1f} to {high:.1f} degC')
    if chosen.source:
        lines += [f'source: {chosen.source}', f'equation: {chosen.equation}']
    comment = [plain_text(part) for line in (*lines, *made.comment)
               for part in wrap(line, _LARGEST_TEXT)]
    template = _environment().get_template(f'{name}.j2')
    return template.render({**plain(made.values), 'comment': comment})


def frame_words(calibration: Calibration) -> str:
    """Return the frame of the levelled force in words."""
    if not calibration.is_levelled:
        return 'in the axes of the sensor'
    return f'in the levelled frame {calibration.frame}: {_AXES[calibration.frame]}'


@cache
def _environment() -> 'Environment':
    """Return the environment of the templates."""
    # The import is here because it would slow down commands that export nothing.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(loader=PackageLoader('accel_calib.stored'), undefined=StrictUndefined,
                       trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    made.policies['json.dumps_kwargs'] = {'allow_nan': False}
    made.filters |= {'yaml': _yaml, 'single': _single, 'literal': literal, 'signed': signed,
                     'horner': horner,
                     'lines': lambda lines, mark: '\n'.join(
                         f'{mark} {line}'.rstrip() for line in lines),
                     'flat': lambda rows: np.ravel(rows).tolist(),
                     'transposed': lambda rows: np.transpose(rows).tolist()}
    return made


def _yaml(value: Any) -> str:
    """Return numbers for YAML 1.1, which reads 1e-05 without a point as text."""
    if isinstance(value, list):
        return f'[{", ".join(map(_yaml, value))}]'
    mantissa, exponent, power = repr(float(value)).partition('e')
    return mantissa + ('' if '.' in mantissa else '.0') + exponent + power


def _single(value: float) -> str:
    """Return a number in single precision without exponent."""
    if isinstance(value, int):
        return str(value)
    positive_zero = np.float32(value) + np.float32(0.0)
    return np.format_float_positional(positive_zero, unique=True, trim='0')


def literal(value: Any) -> str:
    """Return numbers as literals of C in single precision."""
    if isinstance(value, list):
        return f'{{{", ".join(map(literal, value))}}}'
    text = str(np.float32(value))
    return f'{text}f' if set('.e') & set(text) else f'{text}.0f'


def signed(value: float) -> str:
    """Return a literal, in brackets if it is negative."""
    return f'({literal(value)})' if value < 0 else literal(value)


def horner(polynomial: Sequence[float]) -> str:
    """Return the C expression of a polynomial in s, in brackets if it has more than one part."""
    kept = np.trim_zeros(np.array(polynomial), 'b')
    text = signed(kept[-1]) if len(kept) else '0.0f'
    for value in kept[-2::-1]:
        text = f'({signed(value)} + s * {text})' if value else f's * {text}'
    return text
