# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Noise figures of a sensor from the longest rest of a recording.

**Rest.** The detector of `accel_calib.stillness` finds the rests, which end at an interruption of
the stamps. A few missing samples are left out, because a recording that loses one sample in a
thousand would otherwise have no long rest; a sample in their place that repeats another one would
make the white noise too large. Stamps with jitter are not used one by one: samples come from a
regular clock, and their order is right.

Accelerometers and gyros have three figures by axis: the white-noise density N (velocity or angle
random walk), the bias instability B and the random walk K (of the acceleration, or of the rate).
Kalibr and VINS use N and K of all axes together, for which the mean of the squares is taken.

**How long a rest has to be.** The flat part of the curve begins where the white noise has
decreased to it, at τ = N²/(0.664 B)². For a bias instability that is seen in nine of ten
simulated rests, the rest has to be 100 times as long. If the curve does not show B, its upper
limit gives the shortest length; for common parts τ is about 24 s. A random walk is seen if the
curve rises over two octaves. Common parts need hours.

"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import scipy

from .allan import (
    allan_variances, AxisNoise, COMPONENTS, FIGURES, fit_components, FLAT, Kind, KINDS, LEVEL,
    NoiseFigures, octaves, shares, Spread, spread_of)
from ..errors import InputError
from ..stillness import CaptureSettings, StillDetector
from ..table import concatenated, Floats, numbered, Recording
from ..text import counted
from ..units import is_native, STANDARD_GRAVITY, Units

WORDS = {'quantisation': 'quantisation noise', 'noise_density': 'white noise',
         'bias_instability': 'bias instability', 'random_walk': 'random walk'}

_MICRO_G = 1e6 / STANDARD_GRAVITY

_MILLI_DEGREES = float(np.degrees(1e3))

_ONE_SIDED = 2.0 ** 0.5
"""Data sheets state the density for positive frequencies alone, which is √2 N."""

TYPICAL: Mapping[tuple[str, str, str], tuple[float, float]] = {
    ('accelerometer', 'noise_density', 'm/s²'): (
        70.0 / _MICRO_G / _ONE_SIDED, 400.0 / _MICRO_G / _ONE_SIDED),
    ('gyroscope', 'noise_density', 'rad/s'): (
        2.8 / _MILLI_DEGREES / _ONE_SIDED, 5.0 / _MILLI_DEGREES / _ONE_SIDED)}
"""
N of a quiet and of a noisy common part, by sensor, figure and unit.

From the data sheets of ICM-42688-P (TDK DS-000347, tables 1 and 2) and MPU-6050 (InvenSense
PS-MPU-6000A-00, revision 3.4, sections 6.1 and 6.2). They do not state the other figures.

"""

_SHOWN = {
    ('accelerometer', 'noise_density'): ('µg/√Hz', _MICRO_G),
    ('accelerometer', 'bias_instability'): ('µg', _MICRO_G),
    ('accelerometer', 'random_walk'): ('µg/s/√Hz', _MICRO_G),
    ('gyroscope', 'noise_density'): ('m°/s/√Hz', _MILLI_DEGREES),
    ('gyroscope', 'bias_instability'): ('°/h', float(np.degrees(3600.0))),
    ('gyroscope', 'random_walk'): ('m°/s²/√Hz', _MILLI_DEGREES),
}

_NATIVE = {'noise_density': 'native/√Hz', 'bias_instability': 'native',
           'random_walk': 'native/s/√Hz'}

_INSTABILITY_S = 40.0 * 60.0
"""Shortest rest that shows the bias instability of common parts [s]: 100 times τ = 24 s."""

_LENGTH_FOR_B = 100.0
"""Rest that shows B, in units of the τ at which white noise equals the flat part."""

_WALK_S = 5.0 * 3600.0
"""Shortest rest that shows the random walk of common parts [s]."""

_TOO_LONG = 100.0 * 3600.0
"""Longest rest that is worth a figure [s]."""

_WHITE_SAMPLES = 500

_DEPARTS = 0.1
"""Part of the deviation by which a curve departs visibly from its components."""

_LEAST_P = 1e-4
"""Smallest probability of χ² without a note."""

_WARM = 1.0
"""Change of the temperature that is worth a warning [°C]."""

_MINUTE, _HOUR = 60.0, 3600.0

LEAST_SAMPLES = 64
"""Smallest number of samples of a rest: five octaves of τ."""

_LONG = 1.5
"""Interval between stamps that indicates a missing sample, in units of the usual interval."""

_INTERRUPTED = 10
"""Number of missing samples in a row that interrupts a rest."""

_RATES, _OTHER_RATE = 20, 1.25
"""Largest number of parts of a rest whose rates are compared, and ratio of two that differ."""

_MOST_MISSING = 0.02
"""Largest part of missing samples; with more long intervals, the stamps have jitter."""

_UNEVEN = 0.1
"""Standard deviation of the intervals that is worth a note, in units of the mean interval."""

_COARSE = 1.0
"""Noise in units of the step of the output below which rounding changes the noise."""

_BLOCK_S = 1.0
"""Length of the averages in which a coarse record is searched for a rest [s]."""

_NEAR_STEP = 2.0
"""Noise in units of the step below which steps can look like motions."""

_AROUND, _MOVED = 5, 3.0
"""Number of blocks before and after a motion, and its least size in steps."""

_DISTURBED = 12.0
"""Variance of the samples of a disturbed block, in units of the usual one or of a step."""


@dataclass(frozen=True)
class LongRest:
    """
    The longest rest of a recording.

    `start` is the first stamp [s], and `rate` the samples per second [Hz]. `values` (c, n) are
    readings [g], and angular rates [rad/s] if the recording has them; `temperature` (n,) is in °C.
    `notes` state what is not regular.

    """

    start: float
    rate: float
    values: Floats
    temperature: Floats | None
    notes: tuple[str, ...]

    @property
    def samples(self) -> int:
        """Return the number of samples."""
        return int(self.values.shape[1])

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.samples / self.rate


def longest_rest(recording: Recording, units: Units) -> LongRest:
    """Return the longest rest without an interruption; raise InputError if it is too short."""
    best, seconds = recording.take(slice(0)), 0.0
    for samples, seen in ((recording, recording), *_averaged(recording)):
        detector = StillDetector(CaptureSettings(), units, keep=None)
        detector.add_recording(seen)
        detector.close()
        for dwell in sorted(detector.dwells(), key=lambda dwell: dwell.start - dwell.end):
            if dwell.end - dwell.start <= seconds:
                break
            for part in _uninterrupted(samples['time'], dwell.start, dwell.end):
                length = float(samples['time'][part[1] - 1] - samples['time'][part[0]])
                if length > seconds:
                    best, seconds = samples.take(slice(*part)), length
    count, time = len(best), recording['time']
    if count < LEAST_SAMPLES:
        recorded = float(np.ptp(time)) if len(time) else 0.0
        found = counted(count, 'sample') if count else 'no sample'
        raise InputError(f'the longest rest in {recorded:.3g} s has {found}, expected at least '
                         f'{LEAST_SAMPLES}', 'record the sensor for some minutes to hours while '
                         'nothing touches it')
    return _regular(best, units)


def _averaged(recording: Recording) -> Iterator[tuple[Recording, Recording]]:
    """
    Yield the samples of a coarse record without disturbed blocks, and the means of the blocks.

    Where the noise is small beside the step of the output, single steps look like motions. Means
    over a block with an added noise of one step do not show them. They would not show a knock
    or a small turn either, but the scatter in a block and the change between blocks do.

    """
    if not len(recording):
        return
    block = np.floor((recording['time'] - recording['time'][:1]) / _BLOCK_S)
    starts = np.flatnonzero(np.diff(block, prepend=np.nan))
    count = np.diff(starts, append=len(block))[:, np.newaxis]

    def means(values: Floats) -> Floats:
        sums: Floats = np.add.reduceat(values.reshape(len(block), -1), starts) / count
        return sums.reshape(len(starts), *values.shape[1:])

    reading = recording.reading - recording.reading[:1]
    variance = np.maximum(means(reading ** 2) - means(reading) ** 2, 0.0)
    usual = np.median(variance, axis=0)
    step = min(filter(None, map(coarse_step, reading.T, np.sqrt(usual) / _NEAR_STEP)), default=0.0)
    if step == 0.0:
        return
    calm = np.all(variance <= _DISTURBED * np.maximum(usual, step ** 2 / 4.0), axis=1)
    sums = np.cumsum(means(reading), axis=0)
    change = sums[2 * _AROUND:] - 2.0 * sums[_AROUND:-_AROUND] + sums[:-2 * _AROUND]
    calm[1 + _AROUND:1 + _AROUND + len(change)] &= np.all(
        np.abs(change) <= _AROUND * _MOVED * step, axis=1)
    known = {key: means(recording[key])[calm] for key in ('time', 'reading', 'rate')
             if key in recording}
    known['reading'] += np.random.default_rng(0).normal(size=known['reading'].shape) * step
    yield recording.take(np.repeat(calm, count[:, 0])), Recording(known, numbered(known))


def coarse_step(values: Floats, noise: float) -> float:
    """Return the step of the output if the noise of a sample is smaller, otherwise 0."""
    levels = np.unique(values[:1_000_000])
    if len(levels) > 4096:
        return 0.0
    gaps = np.diff(levels)
    # Rounding of a computation leaves gaps that are not steps.
    gaps = gaps[gaps > 1e-9 * max(float(np.max(np.abs(levels))), noise)]
    step = float(np.min(gaps)) if len(gaps) else 0.0
    return step if noise < _COARSE * step else 0.0


def _uninterrupted(time: Floats, start: float, end: float) -> Iterator[tuple[int, int]]:
    """Yield first index and end of the parts of a rest without interruptions."""
    inside = np.flatnonzero((time >= start) & (time <= end))
    step = np.diff(time[inside])
    if not len(step):
        return
    # With the mean, because stamps that come in groups have a median near 0.
    usual = float(np.median(step)) + float(np.mean(np.maximum(step, 0.0)))
    cuts = (np.diff(inside) > 1) | (step < 0.0) | (step > _INTERRUPTED * usual)
    for part in np.split(inside, np.flatnonzero(cuts) + 1):
        ends = np.linspace(0, len(part) - 1, 1 + max(min(_RATES, len(part) // LEAST_SAMPLES), 1))
        ends = ends.astype(np.intp)
        intervals = np.diff(time[part[ends]]) / np.diff(ends)
        changes = np.abs(np.diff(np.log(np.maximum(intervals, 1e-300)))) > np.log(_OTHER_RATE)
        around = np.convolve(changes, np.ones(3), 'same')[:len(changes)] > 0.0
        for piece in np.split(part, ends[1:-1][around]):  # without the part of the change
            yield int(piece[0]), int(piece[-1]) + 1


def _regular(rest: Recording, units: Units) -> LongRest:
    """Return the samples of a rest with equal spacing."""
    time = rest['time']
    step = np.diff(time)
    usual = float(np.median(step))
    notes = []
    late = step > _LONG * usual
    missing = np.maximum(np.round(step[late] / usual) - 1.0, 0.0).sum() if usual > 0.0 else np.inf
    if not 0.0 < missing <= _MOST_MISSING * len(time):
        missing, mean = 0.0, float(np.mean(step))
        if float(np.std(step)) > _UNEVEN * mean:
            notes.append(
                f'the stamps are uneven ({np.min(step) * 1e3:.3g} to {np.max(step) * 1e3:.3g} ms '
                f'apart): the samples are taken as regular, one each {mean * 1e3:.4g} ms')
    else:
        notes.append(f'{counted(int(missing), "sample")} of {len(time) + int(missing)} are '
                     'missing in the rest: those around them are taken as successive')
    rate = (len(time) + missing - 1.0) / float(time[-1] - time[0])
    values = units.to_g(rest.reading.T)
    if 'rate' in rest:
        values = np.concatenate([values, rest['rate'].T])
    return LongRest(float(time[0]), rate, values, rest.columns.get('temperature'), tuple(notes))


def whole(blocks: Iterable[Recording]) -> Recording:
    """Return blocks of a recording as one, with the columns that all have."""
    parts = [block for block in blocks if len(block)]
    if not parts:
        raise InputError('the recording has no samples, expected a long rest',
                         'check that this is the intended file')
    return concatenated(parts)


def shown_unit(kind: str, figure: str, unit: str) -> tuple[str, float]:
    """Return the unit of a figure for people, and the factor from the unit of the figure."""
    if is_native(unit):
        return _NATIVE[figure], 1.0
    return _SHOWN[kind, figure]


def notes_of(axes: Sequence[AxisNoise], temperature: tuple[float, float] | None) -> Iterator[str]:
    """Yield what limits the figures."""
    if temperature is not None and temperature[1] - temperature[0] > _WARM:
        yield (f'the temperature changed by {temperature[1] - temperature[0]:.1f} °C '
               f'({temperature[0]:.1f} to {temperature[1]:.1f} °C): bias instability and random '
               'walk include its effect; record at a constant temperature')
    groups: dict[tuple[str, str], list[str]] = {}
    for axis in axes:
        for note in _axis_notes(axis):
            groups.setdefault((axis.kind, note), []).append(axis.axis)
    for (kind, note), names in groups.items():
        yield f'{kind} {", ".join(names)}: {note}'


def _axis_notes(axis: AxisNoise) -> Iterator[str]:
    unit, scale = shown_unit(axis.kind, 'bias_instability', axis.unit)
    if axis.step:
        yield (f'the noise is smaller than one step of the output ({_three(axis.step * scale)} '
               f'{unit}), so that the figures are those of the rounding; record with more digits '
               'or a smaller range')
    if axis.figures['quantisation'].seen:
        yield ('the curve falls with slope -1 at short τ: rounding of the output (quantisation '
               'noise); the white noise is that of longer τ')
    drift = axis.figures['drift']
    if drift.seen and axis.tau[-1] <= axis.used[1]:
        hourly = _three(drift.value * scale * _HOUR)
        yield (f'a steady drift of {hourly} {unit} per hour raises the curve at long τ '
               '(warm-up?); it is not part of the figures')
    # Where the curve is not that of the components.
    ratio = axis.deviation / axis.model - 1.0
    below = ratio[axis.tau < axis.used[0]]
    above = ratio[axis.tau > axis.used[1]]
    if len(below) and np.max(np.abs(below)) > _DEPARTS:
        side, why = (('below', 'a low-pass filter') if below[0] < 0.0 else
                     ('above', 'vibration or rounding'))
        yield (f'for τ below {duration(axis.used[0])} the curve is {side} that of white noise '
               f'({why}); the figures are from longer τ')
    if len(above) and np.max(np.abs(above)) > _DEPARTS:
        slope = float(np.mean(axis.slope[axis.tau[1:] > axis.used[1]]))
        yield (f'for τ above {duration(axis.used[1])} the curve has slope {slope:+.1f}, and not '
               'the form of a random walk (drift with temperature, or disturbance); the figures '
               'are from shorter τ')
    if axis.p_value < _LEAST_P:
        yield ('the curve does not have the form of white noise, bias instability and random walk '
               '(vibration?); the figures are approximate')


def _need_of(axis: AxisNoise, figure: str, rest: LongRest) -> tuple[float, str]:
    """Return the length of a rest that shows a figure, with words; infinite if none shows it."""
    if figure == 'noise_density':
        if rest.samples >= _WHITE_SAMPLES:
            return np.inf, ('the curve does not fall with slope -1/2 at the shortest τ '
                            f'({duration(axis.tau[0])}); record at a higher rate, with more '
                            'digits')
        seconds = _WHITE_SAMPLES / rest.rate
    else:
        seconds = _WALK_S
        if figure == 'bias_instability':
            if axis.figures['random_walk'].seen:
                return np.inf, 'the random walk hides it: the curve has no flat part'
            white = axis.figures['noise_density']
            flat = FLAT * axis.figures['bias_instability'].upper**2
            hidden = _LENGTH_FOR_B * white.value**2 / flat if white.seen else 0.0
            seconds = max(_INSTABILITY_S, hidden)
        if axis.tau[-1] > axis.used[1]:  # the curve at long τ is not that of the components
            return np.inf, ('the curve at long τ has another form (temperature or disturbance); '
                            'record at a constant temperature')
        seconds = max(seconds, 4.0 * rest.seconds)  # two octaves more
    # Rounded up to one or two digits of its unit.
    unit = next(each for each in (_HOUR, _MINUTE, 1.0) if seconds >= 2.0 * each or each == 1.0)
    step = unit * (1.0 if seconds < 10.0 * unit else 5.0 if seconds < 60.0 * unit else 50.0)
    about = (f'more than {duration(_TOO_LONG)}' if seconds > _TOO_LONG
             else f'about {duration(float(np.ceil(seconds / step - 1e-9) * step))}')
    return seconds, f'needs {about} at rest, this has {duration(rest.seconds)}'


def duration(seconds: float) -> str:
    """Return a duration in its usual unit, with two significant digits."""
    units = (('h', _HOUR, 2.0), ('min', _MINUTE, 2.0), ('s', 1.0, 1.0))
    value, unit = next(((seconds / size, unit) for unit, size, least in units
                        if seconds >= least * size), (seconds * 1e3, 'ms'))
    return f'{value:.0f} {unit}' if value >= 10.0 else f'{value:.2g} {unit}'


def _three(value: float) -> str:
    """Return a number with three significant digits, without a power of ten."""
    return f'{float(f"{value:.3g}"):g}'


_POWERS = (1.0, 0.5, 0.0, -0.5, -1.0)
"""Power of τ0 in each of `COMPONENTS`."""

_MOST_RATE = 0.03
"""Noise density that no gyro in rad/s has [rad/s/√Hz]: 100 times that of a cheap one."""

_LEAST_VARIANCE = 1e-18
"""Allan variance that is only rounding, for samples with the standard deviation 1."""


def noise_of(recording: Recording, units: Units, gravity: float = STANDARD_GRAVITY,
             progress: Callable[[int, int], object] = lambda done, count: None) -> NoiseFigures:
    """
    Return the noise figures of the longest rest of a recording without an interruption.

    Figures of native readings stay in native units. `gravity` [m/s²] is the local one, for
    readings in g. `progress` is called with the number of axes done and of all axes.

    Raises
    ------
    InputError
        If there is no rest of at least 64 samples.

    """
    progress(0, 6 if 'rate' in recording else 3)
    rest = longest_rest(recording, units)
    lengths = octaves(rest.samples)
    spread = spread_of(lengths, rest.samples)
    axes, notes = [], list(rest.notes)
    density = np.std(np.diff(rest.values[3:]), axis=1) / np.sqrt(2.0 * rest.rate)
    rad_s = bool(np.all(density < _MOST_RATE))
    if not rad_s:
        notes.append('the angular rates are not in rad/s, because their noise is too large: they '
                     'are taken as native')
    scales = {'accelerometer': ('native', units.per_g) if units.is_native else ('m/s²', gravity),
              'gyroscope': ('rad/s' if rad_s else 'native', 1.0)}
    for k, (values, (kind, axis)) in enumerate(zip(rest.values, product(KINDS, 'xyz'))):
        unit, scale = scales[kind]
        if np.ptp(values) > 0.0 and np.std(values) > 0.0:
            axes.append(_axis_noise(values * scale, rest.rate, spread, kind=kind, axis=axis,
                                    unit=unit))
        else:
            notes.append(f'{kind} {axis}: all samples of the rest are the same, so that the axis '
                         'shows no noise; record with more digits or a smaller range')
        progress(k + 1, len(rest.values))
    temperature = None
    if rest.temperature is not None and np.isfinite(rest.temperature).any():
        known = rest.temperature[np.isfinite(rest.temperature)]
        means = [float(np.mean(part)) for part in np.array_split(known, min(100, len(known)))]
        temperature = min(means), max(means)
    needs: dict[tuple[Kind, str], tuple[float, str]] = {}  # the longest one of all axes
    for each, figure in product(axes, FIGURES):
        if not each.figures[figure].seen:
            need, key = _need_of(each, figure, rest), (each.kind, figure)
            needs[key] = max(needs.get(key, need), need)
    return NoiseFigures(
        axes=tuple(axes), start=rest.start, seconds=rest.seconds, samples=rest.samples,
        rate=rest.rate, temperature=temperature, notes=(*notes, *notes_of(axes, temperature)),
        needs={key: words for key, (_, words) in needs.items()})


def _axis_noise(values: Floats, rate: float, spread: Spread, *, kind: Kind, axis: str, unit: str
                ) -> AxisNoise:
    lengths = octaves(len(values))
    size = float(np.std(values))
    variances = np.maximum(allan_variances(values / size, lengths), _LEAST_VARIANCE)
    fitted = fit_components(variances, lengths, spread)
    # Beyond the range the form is not known: a random walk has the fewest degrees of freedom.
    forms = (fitted.squares, np.array([0.0, 0.0, 0.0, 1.0, 0.0]))
    expected, walk = (shares(lengths) @ squares for squares in forms)
    covariance, of_walk = map(spread.covariance, forms)
    freedom = 2.0 * np.where(np.arange(len(variances)) > fitted.last,
                             walk**2 / np.diag(of_walk), expected**2 / np.diag(covariance))
    low, high = (np.sqrt(variances * freedom / scipy.stats.chi2.ppf(part, freedom))
                 for part in (0.5 + 0.5 * LEVEL, 0.5 - 0.5 * LEVEL))
    tau = lengths / rate
    across = np.diff(np.eye(len(lengths)), axis=0)
    relative = covariance / np.outer(expected, expected)
    return AxisNoise(
        kind=kind, axis=axis, unit=unit, tau=tau, deviation=size * np.sqrt(variances),
        low=size * low, high=size * high, model=size * np.sqrt(expected),
        slope=0.5 * np.diff(np.log2(variances)),
        slope_sd=0.5 / np.log(2.0) * np.sqrt(np.diag(across @ relative @ across.T)),
        figures={name: each.times(size * (1.0 / rate) ** power) for name, each, power in
                 zip(COMPONENTS, fitted.components, _POWERS, strict=True)},
        used=(float(tau[fitted.first]), float(tau[fitted.last])), p_value=fitted.p_value,
        step=coarse_step(values, size * float(np.sqrt(variances[0]))))


_CURVE = ('axis', 'unit', 'tau', 'deviation', 'low', 'high', 'model', 'slope', 'slope_sd', 'used',
          'p_value')
_NATIVE_REASON = {
    'accelerometer': 'the readings are in native units; state the unit, or apply a calibration',
    'gyroscope': 'the rates are not in rad/s; convert them'}


def to_json(found: NoiseFigures) -> dict[str, Any]:
    """
    Return the figures for JSON.

    ``accelerometer_noise_density`` [m/s²/√Hz], ``accelerometer_random_walk`` [m/s³/√Hz],
    ``gyroscope_noise_density`` [rad/s/√Hz], ``gyroscope_random_walk`` [rad/s²/√Hz] and
    ``update_rate`` [Hz] have the names and units of Kalibr's imu.yaml. NaN, which is null in JSON,
    is a figure that is not seen; ``…_reason`` is then the reason.

    """
    result: dict[str, Any] = {
        'update_rate': found.rate,
        'rest': {'start': found.start, 'seconds': found.seconds, 'samples': found.samples},
        'temperature': found.temperature, 'notes': found.notes}
    for kind in KINDS:
        axes = found.of(kind)
        native = any(is_native(axis.unit) for axis in axes)
        result[f'{kind}_unit'] = axes[0].unit if axes else None
        for figure in FIGURES:
            name, by_axis = f'{kind}_{figure}', {axis.axis: axis.figures[figure] for axis in axes}
            every = [by_axis.get(axis) for axis in 'xyz'] if axes else []
            result[name], result[f'{name}_sd'] = (
                (None, None) if native else found.common(kind, figure))
            for end, field in (('', 'value'), ('_sd', 'sd'), ('_interval', 'interval'),
                               ('_upper', 'upper')):
                result[f'{name}_axes{end}'] = [each and getattr(each, field) for each in every]
            result[f'{name}_reason'] = (
                _NATIVE_REASON[kind] if native else found.needs.get((kind, figure)) if axes else
                f'the recording has no {kind} with noise')
    result['curves'] = [{'sensor': axis.kind, **{name: getattr(axis, name) for name in _CURVE}}
                        for axis in found.axes]
    return result
