# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Watching a calibrated sensor: every rest is held against 1 g and what the calibration states.

A rest tells e = |force| - 1. Its standard deviation is made up of the noise of its mean along the
force, of what the calibration leaves open (of its covariance, alike for rests in like attitudes),
and of how much worse than their samples the poses of the calibration repeat. Few poses tell
that badly, so the scatter of the rests is learned too: the factor by which they repeat worse than
stated follows the median of the differences of successive rests, which a shift does not move.
`departure` decides from the last rests; what is known of them is one record of bounded size.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .calibration import Calibration
from .departure import Departure, departure, is_over, MEMORY
from .likelihood import norm_jacobian, norm_rows
from ..effects import Context
from ..model import sensor_force
from ..table import Floats
from ..units import MG

_LEAST_NOISE = 2e-5   # [g] no rest is known better
_LEARN = 0.02         # by this part the scatter moves with each rest, faster at first
_MEDIAN = 0.6745      # of the absolute value, standard normal
_WARMER = 2.0         # [°C] from here on the temperature has moved


@dataclass(frozen=True)
class Rest:
    """
    What a rest tells.

    Parameters
    ----------
    error : float
        |force| - 1 [g].
    variance : float
        Of its noise [g²].
    slope : (p,) array
        Derivative of the error by the values of the model.
    up : (3,) array
        Unit vector, in the axes of the sensor.
    temperature : float
        [°C]; NaN where it is not known.

    """

    error: float
    variance: float
    slope: Floats
    up: Floats
    temperature: float


@dataclass(frozen=True)
class Watching:
    """
    What the rests since a calibration have told.

    Parameters
    ----------
    covariance : (p, p) array
        Of the calibration [g²].
    repeats : float
        Variance by which its poses repeat worse than their samples say [g²].
    temperatures : tuple of float
        Lowest and highest at which it was made [°C]; empty where that is not known.
    rests : tuple of Rest
        The last ones.
    count : int
        Rests so far.
    scatter : float
        Times that the rests scatter more than stated.
    departure : Departure or None
        None: the sensor is as calibrated.
    since : int
        Number of the first rest that showed the departure, from 1; 0 without one.

    """

    covariance: Floats
    repeats: float
    temperatures: tuple[float, ...]
    rests: tuple[Rest, ...] = ()
    count: int = 0
    scatter: float = 1.0
    departure: Departure | None = None
    since: int = 0

    @property
    def stated(self) -> float:
        """Give the standard deviation that the error of the last rest should have [g]."""
        return float(np.sqrt(_covariance(self, self.rests[-1:])[0, 0])) if self.rests else np.nan

    @property
    def drift(self) -> float:
        """Give the median of | |a| - 1 | over the last rests [g]; NaN: there were none."""
        return float(np.median([abs(rest.error) for rest in self.rests])) if self.rests else np.nan

    @property
    def lasted(self) -> int:
        """Give the rests since the departure began; 0 without one."""
        return self.count - self.since + 1 if self.since else 0

    @property
    def temperature(self) -> float:
        """Give that of the last rest [°C]; NaN where it is not known."""
        return self.rests[-1].temperature if self.rests else np.nan


def rests_of(calibration: Calibration, reading: Floats, noise: Floats, context: Context
             ) -> list[Rest]:
    """
    Hold rests against 1 g.

    Parameters
    ----------
    calibration : Calibration
        The calibration in use.
    reading, noise : (n, 3) array
        Mean readings and the noise of these means, in the unit of the readings.
    context : mapping of str to array
        What the effects need, n rows.

    """
    model, units = calibration.model, calibration.units
    u = sensor_force(model, units.to_g(reading), context)
    length = np.linalg.norm(u, axis=1)
    variance = np.sum((norm_rows(model, u, context) * units.to_g(noise)) ** 2, axis=1)
    slope = norm_jacobian(model, u, context)
    temperature = np.asarray(context.get('temperature', np.full(len(u), np.nan)), float)
    return [Rest(float(length[k]) - 1.0, float(variance[k]) + _LEAST_NOISE ** 2, slope[k],
                 u[k] / length[k], float(temperature[k])) for k in range(len(u))]


def watching(calibration: Calibration) -> Watching:
    """Begin to watch a sensor with this calibration."""
    poses = calibration.poses
    temperatures: tuple[float, ...] = ()
    if 'temperature' in poses and len(poses):
        known = poses['temperature']
        temperatures = (float(np.min(known)), float(np.max(known)))
    return Watching(calibration.covariance, _repeats(calibration), temperatures)


def _repeats(calibration: Calibration) -> float:
    """Give the variance of pose means that their samples do not account for [g²]."""
    quality, used = calibration.quality, len(calibration.poses) - len(calibration.rejected)
    spare = used - int(np.linalg.matrix_rank(np.nan_to_num(calibration.covariance)))
    excess = quality.rms_after_mg ** 2 - (quality.noise_floor_mg or 0.0) ** 2
    return max(excess, 0.0) / MG ** 2 * used / spare if spare > 0 else 0.0


def compared(before: Watching, rest: Rest, least: float) -> Watching:
    """
    Hold one more rest against what is stated.

    Parameters
    ----------
    before : Watching
        The rests so far.
    rest : Rest
        The next one.
    least : float
        Smaller departures are passed over [g].

    """
    rests = (*before.rests, rest)
    scatter = _scatter(before, rests[:2]) if len(rests) > MEMORY else before.scatter
    after = replace(before, rests=rests[-MEMORY:], count=before.count + 1, scatter=scatter)
    covariance = _covariance(after, after.rests)
    if not np.all(np.isfinite(covariance)):
        return after
    seen = (np.array([each.error for each in after.rests]), covariance,
            np.array([each.up for each in after.rests]))
    found = departure(*seen)
    if found is not None and abs(found.error) >= least:
        since = before.since or after.count - found.rests + 1
        return replace(after, departure=found, since=since)
    if before.departure is not None and is_over(before.departure, *seen):
        return replace(after, departure=None, since=0)
    return after


def _covariance(state: Watching, rests: tuple[Rest, ...]) -> Floats:
    """Give the (n, n) covariance of the errors of these rests, were nothing changed [g²]."""
    slope = np.array([rest.slope for rest in rests])
    noise = np.array([rest.variance + state.repeats for rest in rests])
    covariance: Floats = slope @ state.covariance @ slope.T + np.diag(state.scatter ** 2 * noise)
    return covariance


def _scatter(state: Watching, rests: tuple[Rest, ...]) -> float:
    """Learn from the difference of two rests, old enough not to be those of a change."""
    covariance = _covariance(state, rests)
    stated = np.sqrt(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1])
    step = max(_LEARN, 2.0 / (state.count + 4.0))
    more = abs(rests[0].error - rests[1].error) > _MEDIAN * stated
    return max(1.0, state.scatter * float(np.exp(step if more else -step)))


def told(state: Watching) -> str:
    """Say in a line how the sensor stands, and what to do."""
    if not state.count:
        return 'no rest since the calibration yet'
    if not np.isfinite(state.stated):
        return 'the calibration states no uncertainty that rests could be held against'
    if state.departure is None:
        return (f'{state.drift * MG:.2f} mg off 1 g at rest since the calibration, '
                f'{state.stated * MG:.2f} mg stated')
    found = state.departure
    return (f'|a| at rest is {found.error * MG:+.2f} mg off 1 g, for {state.lasted} rests now, '
            f'where {state.stated * MG:.2f} mg is stated{_way(found)}: {_advice(state)}')


def _way(found: Departure) -> str:
    """Say what moved, where the attitudes of the rests tell it."""
    if not found.clear:
        return ''
    if found.way == 'gain':
        return f'; the gain has moved by {100.0 * found.shift[0]:+.2f} %'
    x, y, z = found.shift * MG
    return f'; the offset has moved by ({x:+.1f}, {y:+.1f}, {z:+.1f}) mg'


def _advice(state: Watching) -> str:
    """Say what to do about a departure."""
    if state.temperatures:
        low, high = state.temperatures
        now = state.temperature
        if now < low - _WARMER or now > high + _WARMER:
            return (f'the temperature is {now:.1f} °C, it was {low:.1f} to {high:.1f} °C when '
                    'calibrated: capture poses at this temperature and call ~/refine')
    return 'call ~/reset, capture poses and call ~/fit'
