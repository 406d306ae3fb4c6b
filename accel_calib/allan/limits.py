# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What limits the noise figures, in words: notes, and how long a rest has to be.

**How long a rest has to be.** The flat part of the curve begins where the white noise has
decreased to it, at τ = N²/(0.664 B)². For a bias instability that is seen in nine of ten
simulated rests, the rest has to be 100 times as long. If the curve does not show B, its upper
limit gives the shortest length; for common parts τ is about 24 s. A random walk is seen if the
curve rises over two octaves. Common parts need hours.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from .curve import FLAT
from .records import AxisNoise, FIGURES, Kind, shown_unit
from .rest import Rest

_INSTABILITY_S = 40.0 * 60.0
"""Shortest rest that shows the bias instability of common parts [s]: 100 times τ = 24 s."""

_LENGTH_FOR_B = 100.0
"""Rest that shows B, in units of the τ at which white noise equals the flat part."""

_WALK_S = 5.0 * 3600.0
"""Shortest rest that shows the random walk of common parts [s]."""

_TOO_LONG = 100.0 * 3600.0
"""Longest rest that is worth a figure [s]."""

_DISTURBED = ('the curve at long τ has another form (temperature or disturbance); record at a '
              'constant temperature')

_WHITE_SAMPLES = 500

_LONGER = 4.0
"""Two octaves."""

_DEPARTS = 0.1
"""Part of the deviation by which a curve departs visibly from its components."""

_LEAST_P = 1e-4
"""Smallest probability of χ² without a note."""

_WARM = 1.0
"""Change of the temperature that is worth a warning [°C]."""

_MINUTE, _HOUR = 60.0, 3600.0


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
    """Yield what limits the figures of one axis."""
    unit, scale = shown_unit(axis.kind, 'bias_instability', axis.unit)
    if axis.step:
        yield (f'the noise is smaller than one step of the output ({_three(axis.step * scale)} '
               f'{unit}), so that the figures are those of the rounding; record with more digits '
               'or a smaller range')
    if axis.figures['quantisation'].seen:
        yield ('the curve falls with slope -1 at short τ: rounding of the output (quantisation '
               'noise); the white noise is that of longer τ')
    drift = axis.figures['drift']
    if drift.seen and not _disturbed(axis):
        hourly = _three(drift.value * scale * _HOUR)
        yield (f'a steady drift of {hourly} {unit} per hour raises the curve at long τ '
               '(warm-up?); it is not part of the figures')
    yield from _departures(axis)


def _departures(axis: AxisNoise) -> Iterator[str]:
    """Yield where the curve is not that of the components."""
    ratio = axis.deviation / axis.model - 1.0
    below = ratio[axis.tau < axis.used[0]]
    above = ratio[axis.tau > axis.used[1]]
    if len(below) and np.max(np.abs(below)) > _DEPARTS:
        why = 'a low-pass filter' if below[0] < 0.0 else 'vibration or rounding'
        side = 'below' if below[0] < 0.0 else 'above'
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


def needs_of(axes: Sequence[AxisNoise], rest: Rest) -> dict[tuple[Kind, str], str]:
    """Return why figures are not seen, and what to do."""
    longest: dict[tuple[Kind, str], tuple[float, str]] = {}
    for axis in axes:
        for figure in FIGURES:
            if not axis.figures[figure].seen:
                need = _NEEDED[figure](axis, rest)
                key = axis.kind, figure
                longest[key] = max(longest.get(key, need), need)
    return {key: words for key, (_, words) in longest.items()}


def _white_need(axis: AxisNoise, rest: Rest) -> tuple[float, str]:
    """Return why the white noise is not seen."""
    if rest.samples < _WHITE_SAMPLES:
        return _needs_rest(_WHITE_SAMPLES / rest.rate, rest)
    return np.inf, ('the curve does not fall with slope -1/2 at the shortest τ '
                    f'({duration(axis.tau[0])}); record at a higher rate, with more digits')


def _instability_need(axis: AxisNoise, rest: Rest) -> tuple[float, str]:
    """Return how long the rest has to be for the flat part of the curve."""
    white = axis.figures['noise_density']
    if axis.figures['random_walk'].seen:
        return np.inf, 'the random walk hides it: the curve has no flat part'
    if _disturbed(axis):
        return np.inf, _DISTURBED
    flat = FLAT * axis.figures['bias_instability'].upper**2
    hidden = _LENGTH_FOR_B * white.value**2 / flat if white.seen else 0.0
    return _needs_rest(max(_INSTABILITY_S, hidden, _LONGER * rest.seconds), rest)


def _walk_need(axis: AxisNoise, rest: Rest) -> tuple[float, str]:
    """Return how long the rest has to be for a curve that rises."""
    if _disturbed(axis):
        return np.inf, _DISTURBED
    return _needs_rest(max(_WALK_S, _LONGER * rest.seconds), rest)


def _disturbed(axis: AxisNoise) -> bool:
    """Return whether the curve at long τ is not that of the components."""
    return bool(axis.tau[-1] > axis.used[1])


_NEEDED: dict[str, Callable[[AxisNoise, Rest], tuple[float, str]]] = {
    'noise_density': _white_need, 'bias_instability': _instability_need,
    'random_walk': _walk_need}


def _needs_rest(seconds: float, rest: Rest) -> tuple[float, str]:
    """Return a length, and the words for it."""
    about = (f'more than {duration(_TOO_LONG)}' if seconds > _TOO_LONG
             else f'about {duration(_rounded(seconds))}')
    return seconds, f'needs {about} at rest, this has {duration(rest.seconds)}'


def _rounded(seconds: float) -> float:
    """Return a duration rounded up to one or two digits of its unit."""
    unit = next(each for each in (_HOUR, _MINUTE, 1.0) if seconds >= 2.0 * each or each == 1.0)
    step = unit * (1.0 if seconds < 10.0 * unit else 5.0 if seconds < 60.0 * unit else 50.0)
    return float(np.ceil(seconds / step - 1e-9) * step)


def duration(seconds: float) -> str:
    """Return a duration in its usual unit, with two significant digits."""
    if seconds >= 2.0 * _HOUR:
        return f'{_two(seconds / _HOUR)} h'
    if seconds >= 2.0 * _MINUTE:
        return f'{_two(seconds / _MINUTE)} min'
    return f'{_two(seconds)} s' if seconds >= 1.0 else f'{_two(seconds * 1e3)} ms'


def _two(value: float) -> str:
    return f'{value:.0f}' if value >= 10.0 else f'{value:.2g}'


def _three(value: float) -> str:
    """Return a number with three significant digits, without a power of ten."""
    return f'{float(f"{value:.3g}"):g}'
