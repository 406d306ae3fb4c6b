# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From the samples of a still board whose temperature changes to stretches of equal duration.

The samples are summed over cells of 1 s, so that the memory does not grow with the sample rate.
Cells in which the board shakes are left out, and the others are averaged over at most `_STRETCHES`
stretches. The noise of the mean of a stretch comes from the second differences of successive
means, which a slope does not change, and which contain the noise that is correlated within a
stretch.

A ramp is refused if it cannot show what temperature does:

- there is no temperature, or it spans less than `LEAST_RANGE`;
- the board was turned: its direction leaves the first one by more than `_TURNED`;
- the board was shifted: the readings jump across gravity by more than `_JUMP_G` and their noise,
  which neither a polynomial in the temperature nor its rate explains. A jump along gravity is no
  tilt, but a step of the sensor. A slow tilt during a ramp looks like the temperature, and is not
  seen;
- the ramp is too fast for the thermometer, and does not show its lag, because the temperature only
  rises or only falls. Stretches with a rate above `FASTEST` are left out, and the others must span
  `LEAST_RANGE`. A thermometer in the package of the sensor lags by about 10 s. At 5 °C/min it is
  then 0.8 °C behind, which is 0.8 mg in a common part of 1 mg/°C.

The rests of a table stand for the cells of a recording.

"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from .detector import check_finite
from ..effects import rate_at
from ..errors import InputError
from ..geometry import unit
from ..table import Floats, in_unit, numbered, Poses, range_of, Recording
from ..text import counted
from ..units import Bools, MG, Units

LEAST_RANGE = 3.0
"""Smallest range of the temperature of a ramp [°C]; the autopilots ask for 10 °C or more."""

FASTEST = 5.0
"""Largest rate of the temperature [°C/min]."""

LEAST_RESTS = 30
"""Smallest number of stretches, which are 1 s or longer, or of rests."""

_STRETCHES = 240
_SHAKEN, _SHAKEN_G = 6.0, 0.005
"""A cell is shaken if its deviation is above both: relative to the median, and absolute [g]."""

_TURNED, _FIRST = np.radians(6.0), 10
"""Angle at which a board counts as turned [rad]; cells that state its first direction."""

_LEAST_DIRECTIONS = 4
_APART = np.radians(20.0)
"""Number of rests in directions this far apart that make a log one of poses."""

_JUMP_G, _JUMP_NOISES, _NEIGHBOURS = 0.003, 8.0, 4
_DEGREE = 3

_MOVING, _OVERLAP = 0.1, 0.3
"""Part of the largest rate above which the temperature changes; part of the range that warming and
cooling share if the temperature both rises and falls."""


def cells_of(blocks: Iterable[Recording], units: Units) -> Poses:
    """
    Return the averages of samples over cells of 1 s, in g and in order of time.

    Raises
    ------
    InputError
        If there are no samples, one is not finite, or the readings are in native units.

    """
    _check_scale(units)
    parts, first = list[Floats](), None
    for block in filter(len, blocks):
        first = first or block
        start, zero = first['time'][0], units.to_g(first.reading[0])
        check_finite(np.vstack([block['time'], block.reading.T]), block.row)
        time, reading = block['time'] - start, units.to_g(block.reading) - zero
        warm = block['temperature'] if 'temperature' in block else np.full(len(time), np.nan)
        known = np.isfinite(warm)
        cell, place = np.unique(np.floor(time), return_inverse=True)
        sums = (np.bincount(place, column) for column in (
            np.ones(len(time)), known, time, np.where(known, warm, 0.0), *reading.T,
            *(reading ** 2).T))
        parts.append(np.array([cell, *sums]))
    if first is None:
        raise InputError('the log has no samples, expected those of a still board',
                         'record the board while its temperature changes')
    cell, place = np.unique(np.concatenate([part[0] for part in parts]), return_inverse=True)
    n, n_warm, time, warm, *rest = (np.bincount(place, column, len(cell)) for column in
                                    np.concatenate([part[1:] for part in parts], axis=1))
    total, square = np.array(rest[:3]).T, np.array(rest[3:]).T
    mean = total / n[:, np.newaxis]
    variance = (square - mean * total) / np.maximum(n - 1.0, 1.0)[:, np.newaxis]
    with np.errstate(invalid='ignore'):
        columns = {'time': time / n + start, 'temperature': warm / n_warm, 'count': n,
                   'reading': mean + zero, 'std': np.sqrt(np.maximum(variance, 0.0))}
    return Poses(columns, numbered(columns), 'g', first.sensor, first.autopilot)


def rests_in_cells(poses: Poses, units: Units) -> Poses:
    """Return the rests of a board as the cells of a ramp; errors as in `cells_of`."""
    _check_scale(units)
    if 'time' not in poses:
        raise InputError('the rests have no time, expected that of each', 'add a column time')
    check_finite(np.vstack([poses['time'], poses.reading.T]), poses.row)
    cells = in_unit(poses, units.to_g)
    cells = cells.take(np.argsort(cells['time'], kind='stable'))
    kept = ('time', 'temperature', 'count', 'reading', 'std')
    columns = {'count': np.ones(len(cells)), 'temperature': np.full(len(cells), np.nan),
               **{key: cells[key] for key in kept if key in cells}}
    return replace(cells, columns=columns)


def _check_scale(units: Units) -> None:
    if units.is_native:
        raise InputError('the readings are in native units, and a board in one orientation does '
                         'not show their scale; expected readings in m/s2 or g',
                         'convert the readings')


def _is_still(cells: Poses) -> Bools:
    """Return in which cells the board does not shake."""
    size = np.max(cells['std'], axis=1) if 'std' in cells else np.zeros(len(cells))
    return np.asarray(size <= max(_SHAKEN * float(np.median(size)), _SHAKEN_G))


def is_turned_over(cells: Poses) -> bool:
    """Return whether a log has rests in many directions, as one of poses has."""
    up, still = unit(cells.reading), _is_still(cells)
    rest = still[1:] & still[:-1] & (np.sum(up[1:] * up[:-1], axis=1) > np.cos(_TURNED / 6.0))
    found = list[Floats]()
    for each in up[1:][rest]:
        if all(each @ other < np.cos(_APART) for other in found):
            found.append(each)
    return len(found) >= _LEAST_DIRECTIONS


@dataclass(frozen=True)
class Ramp:
    """
    Stretches of a still board whose temperature changes, in order of time.

    `stretches` are means [g] with time, temperature, its rate, std and count; std/√count is the
    noise of a mean. `both` is whether the temperature both rises and falls, and `seconds` the
    duration of the log [s]. `notes` state what was left out.

    """

    stretches: Poses
    both: bool
    seconds: float
    notes: tuple[str, ...] = ()


def ramp_of(cells: Poses) -> Ramp:
    """
    Return the stretches of a still board.

    Raises
    ------
    InputError
        If the cells cannot show what the temperature does; see the module.

    """
    low, high = range_of(cells, 'temperature')
    if np.isnan(low):
        raise InputError('the log has no temperature, expected that of the sensor', 'record it, '
                         'or name its column with --columns temperature=NAME, or its topic with '
                         '--context temperature:=TOPIC')
    if high - low < LEAST_RANGE:
        raise InputError(f'the temperature is {low:.1f} to {high:.1f} °C, expected a range of at '
                         f'least {LEAST_RANGE:g} °C', 'cool the board in a freezer, and record '
                         'while it warms up to room temperature')
    still = _is_still(cells)
    up = unit(cells.reading)
    first = unit(np.median(up[still][:_FIRST], axis=0)[np.newaxis])[0]
    away = np.arccos(np.clip(up @ first, -1.0, 1.0))
    turned = np.flatnonzero((away > _TURNED) & still)
    if len(turned):
        raise _moved(cells['time'][turned[0]] - cells['time'][0],
                     f'it was turned by {np.degrees(away[turned[0]]):.0f}°')
    stretches = _averaged(cells.take(np.isfinite(cells['temperature']) & still))
    _check_jumps(stretches)
    warm, rate = stretches['temperature'], stretches['temperature_rate']
    both = _reverses(warm, rate)
    slow = (np.abs(rate) * 60.0 <= FASTEST) | both
    if np.sum(slow) < LEAST_RESTS or np.ptp(warm[slow]) < LEAST_RANGE:
        raise InputError(
            f'the ramp is too fast for the thermometer: the temperature changes by up to '
            f'{np.max(np.abs(rate)) * 60.0:.0f} °C/min, expected at most {FASTEST:g} °C/min '
            f'over a range of {LEAST_RANGE:g} °C', 'put the board into a closed box while it '
            'warms up')
    notes = []
    if not np.all(still):
        notes.append(f'{counted(int(np.sum(~still)), "second")} left out, in which the board '
                     'shook')
    if not np.all(slow):
        notes.append(f'{int(np.sum(~slow))} of {len(slow)} stretches left out, in which the '
                     f'temperature changes by more than {FASTEST:g} °C/min')
    return Ramp(stretches.take(slow), both,
                float(cells['time'][-1] - cells['time'][0]), tuple(notes))


def _reverses(warm: Floats, rate: Floats) -> bool:
    """Return whether a temperature rises and falls over a range that both share."""
    limit = _MOVING * float(np.quantile(np.abs(rate), 0.95))
    rising, falling = warm[rate > limit], warm[rate < -limit]
    return len(rising) > 0 and len(falling) > 0 and bool(
        min(rising.max(), falling.max()) - max(rising.min(), falling.min())
        >= _OVERLAP * np.ptp(warm))


def _moved(seconds: float, what: str) -> InputError:
    return InputError(f'the board moved {seconds:.0f} s after the start ({what}), expected a '
                      'board that lies still', 'fix the board, keep cables and fans away, and '
                      'record again, or cut the log there')


def _averaged(cells: Poses) -> Poses:
    """Return the stretches with their noise, and the rate of the temperature in each [°C/s]."""
    time = cells['time'] - cells['time'][0]
    warmed, length = float(np.ptp(cells['temperature'])), max(float(time[-1]) / _STRETCHES, 1.0)
    if warmed > _PLAUSIBLE * time[-1]:
        raise InputError(f'the temperature changes by {warmed:.0f} °C in {float(time[-1]):.3g} s, '
                         f'expected at most {_PLAUSIBLE:g} °C/s', 'the times are probably in a '
                         'unit that is 1000 or 1e6 times as long: name their column time_s, '
                         'time_ms or time_us')
    _, place, cell_count = np.unique(np.floor(time / length), return_inverse=True,
                                     return_counts=True)
    if len(cell_count) < LEAST_RESTS:
        raise InputError(f'found {counted(len(cell_count), "rest")} of 1 s or longer, expected at '
                         f'least {LEAST_RESTS}', 'record while the board warms up, for half an '
                         'hour')
    count = np.bincount(place, cells['count'])
    moment, warm, *axes = (
        np.bincount(place, column * cells['count']) / count
        for column in (cells['time'], cells['temperature'], *cells.reading.T))
    reading = np.array(axes).T
    bend = reading[2:] - 2.0 * reading[1:-1] + reading[:-2]
    noise = np.sqrt(np.median(bend ** 2, axis=0) / _MEDIAN_CHI2 / 6.0)
    columns = {'time': moment, 'reading': reading, 'temperature': warm, 'count': count,
               'std': noise * np.sqrt(count)[:, np.newaxis]}
    columns['temperature_rate'] = rate_at(columns)
    return Poses(columns, numbered(columns), 'g', cells.sensor, cells.autopilot)


_PLAUSIBLE = 5.0
"""Largest rate of the temperature of a board [°C/s]."""

_MEDIAN_CHI2 = 0.4549
"""Median of the square of a normal variable."""


def _check_jumps(stretches: Poses) -> None:
    """Refuse a board that was shifted between two stretches."""
    warm, reading = stretches['temperature'], stretches.reading
    scaled = (warm - warm.mean()) / max(float(np.ptp(warm)), 1e-9)
    powers = np.column_stack([scaled[:, np.newaxis] ** np.arange(_DEGREE + 1),
                              stretches['temperature_rate']])
    left = reading - powers @ np.linalg.lstsq(powers, reading, rcond=None)[0]
    sums = np.cumsum(np.vstack([np.zeros(3), left]), axis=0)
    k = _NEIGHBOURS
    means, up = (sums[k:] - sums[:-k]) / k, unit(np.mean(reading, axis=0)[np.newaxis])[0]
    jumps = means[k:] - means[:-k]
    jump = np.linalg.norm(jumps - np.outer(jumps @ up, up), axis=1)
    noise = float(np.linalg.norm(np.median(stretches.noise, axis=0)))  # type: ignore[arg-type]
    at = int(np.argmax(jump))
    if jump[at] > max(_JUMP_G, _JUMP_NOISES * noise * np.sqrt(2.0 / k)):
        raise _moved(float(stretches['time'][at + k] - stretches['time'][0]),
                     f'the readings jump by {jump[at] * MG:.1f} mg, which the temperature does '
                     'not explain')
