# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Drift of a calibrated sensor: every rest is compared with 1 g and the stated uncertainty.

A rest has the error e = |force| - 1. The variance of e has three parts: the noise of the mean
along the force, the uncertainty of the calibration (common to rests in similar orientations), and
the part by which the poses of the calibration repeat worse than the noise of their samples
predicts. The last part is badly known from few poses. A factor on the stated scatter is therefore
estimated from the median of the differences of successive rests, which a lasting change does not
affect.

**Lasting change.** It is detected by a likelihood ratio. The errors of the last n rests are
jointly normal with covariance S. S contains the noise of each rest, and the uncertainty of the
calibration. Each rest can be disturbed by a knock, with probability `_KNOCKED` and a size of about
`_KNOCK` [g]. The likelihood is therefore the sum over all 2ⁿ combinations of knocks. The
alternative is a change that began at the third last rest or earlier:

    offset   e changes by up · b    b normal with a standard deviation of `_SIZES`, three axes
    gain     e changes by b         the same in every orientation

The likelihood of the alternative is averaged over instants, kinds and sizes. The change may
continue to vary by `_WANDER` of its size, for example with temperature. By Markov's inequality the
ratio exceeds `SURE` by chance in at most one of `SURE` rests. One or two knocks are not a lasting
change; three rests that agree are. A change that was reported is over after `MEMORY` rests in
succession without it, so that rests in orientations that hide it do not clear it.

"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ..calibration import Calibration
from ..effects import Context, length_rows, sensor_force
from ..statistics import rms, SIGMA_OF_MAD
from ..table import Floats, range_of
from ..text import counted
from ..units import MG

MEMORY = 6
"""Number of rests that are used."""

_FEWEST = 3
"""Smallest number of rests that a lasting change has."""

SURE = float(np.exp(13.0))
"""Likelihood ratio above which a change is reported: 440,000."""

_KNOCKED, _KNOCK = 0.003, 0.05   # probability and size [g] of a knock
_SIZES = (0.005, 0.05)           # sizes of a change [g]
_WANDER = 0.1                    # variation of a change from rest to rest, relative to its size
_CLEAR = 20.0                    # likelihood ratio above which one kind is clearly distinguished

KINDS: dict[str, Callable[[Floats], Floats]] = {
    'offset': lambda up: up, 'gain': lambda up: np.ones((len(up), 1))}
"""Kinds of change: (n, 3) up -> (n, q) derivative of the errors by the change."""


@dataclass(frozen=True)
class LastingChange:
    """
    A lasting change: its more likely kind, and the number of rests since it began.

    `clear` is whether the orientations of the rests clearly distinguish the kind from the other.
    `shift` is the (q,) change [g], and `covariance` is its (q, q) covariance [g²]. `error` is the
    effect on |a| at these rests, RMS [g]; signed if the sign is the same for all.

    """

    rests: int
    kind: str
    clear: bool
    shift: Floats
    covariance: Floats
    error: float


def change(error: Floats, covariance: Floats, up: Floats) -> LastingChange | None:
    """
    Return a lasting change, or None if the stated uncertainty or knocks explain the errors.

    `error` is (n,): |force| - 1 of the last rests in order of time [g]. `covariance` is (n, n),
    that of these errors without a change [g²]. `up` is (n, 3), unit vectors in the sensor axes.

    """
    most = 0.5 * float(error @ np.linalg.solve(covariance, error))
    if len(error) < _FEWEST or most - len(error) * np.log1p(-_KNOCKED) < np.log(SURE):
        return None   # the ratio cannot be larger
    number = np.arange(len(up), 0, -1)[:, np.newaxis]  # of rests from each one to the last
    slopes = {(kind, rests): np.where(number <= rests, slope_of(up), 0.0)
              for kind, slope_of in KINDS.items() for rests in range(_FEWEST, len(error) + 1)}
    found = {key: np.logaddexp.reduce([
        _likelihood(error, covariance + _added(slope, size)) for size in _SIZES])
        for key, slope in slopes.items()}
    same = _likelihood(error, covariance) + np.log(len(found) * len(_SIZES))
    if np.logaddexp.reduce(list(found.values())) - same < np.log(SURE):
        return None
    kind, rests = max(found, key=lambda key: found[key])
    each = [np.logaddexp.reduce([found[key] for key in found if key[0] == other])
            for other in KINDS]
    # The estimate, without the rests that were most likely knocked.
    slope, size = slopes[kind, rests], max(_SIZES)
    knocked, likely = _knocks(error, covariance + _added(slope, size))
    spread = covariance + np.diag(_KNOCK ** 2 * knocked[np.argmax(likely)])
    weighted = slope.T @ np.linalg.inv(spread)
    spread_of_shift = np.linalg.inv(weighted @ slope + np.eye(slope.shape[1]) / size ** 2)
    shift = spread_of_shift @ weighted @ error
    moved = slope[len(up) - rests:] @ shift
    sign = float(np.sign(moved[0])) if np.ptp(np.sign(moved)) == 0.0 else 1.0
    return LastingChange(
        rests=rests, kind=kind, clear=bool(np.ptp(each) > np.log(_CLEAR)), shift=shift,
        covariance=spread_of_shift, error=sign * rms(moved))


def is_over(known: LastingChange, error: Floats, covariance: Floats, up: Floats) -> bool:
    """Return whether this change is clearly absent now; parameters as in `change`."""
    slope = KINDS[known.kind](up)
    stays = _likelihood(error - slope @ known.shift,
                        covariance + slope @ known.covariance @ slope.T)
    return bool(_likelihood(error, covariance) - stays > np.log(SURE))


def _added(slope: Floats, size: float) -> Floats:
    """Return the (n, n) covariance of the errors that a change of this size causes."""
    common: Floats = size ** 2 * slope @ slope.T
    return common + _WANDER ** 2 * np.diag(np.diag(common))


def _likelihood(error: Floats, covariance: Floats) -> float:
    """Return the logarithm of the likelihood, summed over all combinations of knocks."""
    return float(np.logaddexp.reduce(_knocks(error, covariance)[1]))


def _knocks(error: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return the (k, n) combinations of knocks as 0 and 1, and their (k,) log likelihoods."""
    knocked = np.array(list(product((0.0, 1.0), repeat=len(error))))
    spread = covariance + _KNOCK ** 2 * knocked[:, :, np.newaxis] * np.eye(len(error))
    count = knocked.sum(axis=1)
    weight = count * np.log(_KNOCKED) + (len(error) - count) * np.log1p(-_KNOCKED)
    solved = np.linalg.solve(spread, np.broadcast_to(error, knocked.shape)[:, :, np.newaxis])
    fit = solved[:, :, 0] @ error + np.linalg.slogdet(spread)[1]
    return knocked, weight - 0.5 * fit


_LEAST_NOISE = 2e-5   # smallest noise of a rest [g]
_LEARN = 0.02         # relative step of the scatter per rest; larger in the beginning
_WARMER = 2.0         # temperatures outside of the range by more cause an advice [°C]


@dataclass(frozen=True)
class RestError:
    """
    One rest: its error |force| - 1 [g], and the variance from the noise of the mean [g²].

    `slope` is the (p,) derivative of the error by the values of the model, `up` the (3,) unit
    vector in the sensor axes. The temperature [°C] is NaN if it is not known.

    """

    error: float
    variance: float
    slope: Floats
    up: Floats
    temperature: float


@dataclass(frozen=True)
class Drift:
    """
    The state of the monitor: a calibration, the last rests since then, and the number of all.

    `scatter` is the factor on the stated scatter of the rests. `change` is the lasting change,
    None if the sensor is unchanged, and `since` the number of the first rest with it, 1-based, or
    0. It was clearly absent in the last `without` rests.

    """

    calibration: Calibration
    rests: tuple[RestError, ...] = ()
    count: int = 0
    scatter: float = 1.0
    change: LastingChange | None = None
    since: int = 0
    without: int = 0

    @property
    def temperatures(self) -> tuple[float, ...]:
        """Lowest and highest temperature of the poses [°C]; empty if not known."""
        limits = range_of(self.calibration.poses, 'temperature')
        return () if np.isnan(limits[0]) else limits

    @property
    def repeats(self) -> float:
        """Variance of the pose means beyond their noise [g²]; infinite for a mounting."""
        own = self.calibration
        if not own.model.effects:
            return np.inf
        quality, used = own.quality, len(own.poses) - len(own.rejected)
        spare = used - int(np.linalg.matrix_rank(np.nan_to_num(own.covariance)))
        excess = quality.rms_after_mg ** 2 - (quality.noise_floor_mg or 0.0) ** 2
        return max(excess, 0.0) / MG ** 2 * used / spare if spare > 0 else 0.0

    @property
    def stated(self) -> float:
        """Stated standard deviation of the error of the last rest [g]."""
        return float(np.sqrt(_covariance(self, self.rests[-1:])[0, 0])) if self.rests else np.nan

    @property
    def error(self) -> float:
        """Median of | |a| - 1 | over the last rests [g]; NaN without rests."""
        return float(np.median([abs(rest.error) for rest in self.rests])) if self.rests else np.nan

    @property
    def lasted(self) -> int:
        """Return the number of rests since the change; 0 without a change."""
        return self.count - self.since + 1 if self.since else 0

    @property
    def remedy(self) -> tuple[str, str]:
        """Return what to do after a change, and the service with which it begins."""
        if self.temperatures:
            low, high = self.temperatures
            now = self.temperature
            if now < low - _WARMER or now > high + _WARMER:
                return (f'the temperature is {now:.1f} °C, but the sensor was calibrated at '
                        f'{low:.1f} to {high:.1f} °C: capture poses at this temperature and call '
                        '~/refine', 'refine')
        return 'call ~/reset, capture poses and call ~/fit', 'reset'

    @property
    def temperature(self) -> float:
        """Temperature of the last rest [°C]; NaN if not known."""
        return self.rests[-1].temperature if self.rests else np.nan


def rest_errors(calibration: Calibration, reading: Floats, noise: Floats, context: Context
                ) -> list[RestError]:
    """Return rests from (n, 3) mean readings and the noise of these means, in their unit."""
    model, units = calibration.model, calibration.units
    u = sensor_force(model, units.to_g(reading), context)
    length = np.linalg.norm(u, axis=1)
    rows = length_rows(model, u, context)
    variance = np.sum((rows * units.to_g(noise)) ** 2, axis=1)
    slope = -model.basis(u, context).along(rows)
    temperature = np.asarray(context.get('temperature', np.full(len(u), np.nan)), float)
    return [RestError(float(length[k]) - 1.0, float(variance[k]) + _LEAST_NOISE ** 2, slope[k],
                      u[k] / length[k], float(temperature[k])) for k in range(len(u))]


def compared(before: Drift, rest: RestError, least: float) -> Drift:
    """Return the state of the monitor after one more rest; `least` is the least change [g]."""
    rests, scatter = (*before.rests, rest), before.scatter
    if len(rests) > MEMORY:  # from two rests that are older than a possible change
        covariance = _covariance(before, rests[:2])
        stated = np.sqrt(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1])
        step = max(_LEARN, 2.0 / (before.count + 4.0))
        more = abs(rests[0].error - rests[1].error) > stated / SIGMA_OF_MAD
        scatter = max(1.0, scatter * float(np.exp(step if more else -step)))
    after = replace(before, rests=rests[-MEMORY:], count=before.count + 1, scatter=scatter)
    covariance = _covariance(after, after.rests)
    if not np.all(np.isfinite(covariance)):
        return after
    seen = (np.array([each.error for each in after.rests]), covariance,
            np.array([each.up for each in after.rests]))
    found = change(*seen)
    if found is not None and abs(found.error) >= least:
        since = before.since or after.count - found.rests + 1
        # A report keeps to one cause, so that another kind than before is not clear.
        clear = found.clear and (before.change is None or before.change.kind == found.kind)
        return replace(after, change=replace(found, clear=clear), since=since, without=0)
    if before.change is None or not is_over(before.change, *seen):
        return replace(after, without=0)
    if before.without + 1 < MEMORY:
        return replace(after, without=before.without + 1)
    return replace(after, change=None, since=0, without=0)


def _covariance(state: Drift, rests: tuple[RestError, ...]) -> Floats:
    """Return the (n, n) covariance of the errors of these rests without a change [g²]."""
    slope = np.array([rest.slope for rest in rests])
    noise = np.array([rest.variance for rest in rests]) + state.repeats
    spread = slope @ state.calibration.covariance @ slope.T
    return np.asarray(spread + np.diag(state.scatter ** 2 * noise))


def status(state: Drift) -> str:
    """Return the state of the sensor and advice as one line."""
    if not state.count:
        return 'no rest since the calibration'
    if not np.isfinite(state.stated):
        return 'the calibration has no uncertainty, so rests cannot be compared with it'
    if state.change is None:
        return (f'|a| at rest differs by {state.error * MG:.2f} mg from 1 g, stated uncertainty '
                f'{state.stated * MG:.2f} mg')
    found = state.change
    changed = 'the offset or the gain has changed'
    if found.clear and len(found.shift) == 1:
        changed = f'the gain has changed by {100.0 * found.shift[0]:+.2f} %'
    elif found.clear:
        x, y, z = found.shift * MG
        changed = f'the offset has changed by ({x:+.1f}, {y:+.1f}, {z:+.1f}) mg'
    return (f'|a| at rest has differed by {found.error * MG:+.2f} mg from 1 g for '
            f'{counted(state.lasted, "rest")}, stated uncertainty {state.stated * MG:.2f} mg'
            f'; {changed}: {state.remedy[0]}')
