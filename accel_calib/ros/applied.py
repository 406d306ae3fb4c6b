# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibration in use, and what rests say of it.

Gravity is the mean corrected force of the last rest, held and subtracted while the sensor moves
(Intan RHD2000 application note): good for motion near the attitude of that rest.

Every rest is held against 1 g (see `accel_calib.calibrate.watching`), as soon as it counts; what
it comes to in the end replaces that. A robot may stand for weeks: of a long rest each part of
`LONG_REST` counts as one.

"""

from __future__ import annotations

from dataclasses import replace
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from .context import context_of_rest
from .pose_book import overlap
from .watch import LONG_REST
from ..calibrate.watching import compared, rests_of, Watching, watching

if TYPE_CHECKING:
    from ..calibrate import Calibration
    from ..capture import Dwell
    from ..effects import Context
    from ..table import Floats

_SHORT_REST = 30.0
"""What is left of a rest of which a part was counted is passed over, if shorter [s]."""


class Applied:
    """
    A calibration, whether it is switched on, and the last rest.

    Parameters
    ----------
    gravity : float
        Local gravity [m/s²].

    """

    def __init__(self, gravity: float) -> None:
        self._g = gravity
        self._past: Watching | None = None
        self._counted: Dwell | None = None
        self.standing: Watching | None = None
        self.calibration: Calibration | None = None
        self.scale = 1.0
        self.enabled = True
        self.rest: Dwell | None = None
        self.gravity: Floats | None = None

    def adopt(self, calibration: Calibration | None) -> None:
        """Use this calibration from now on; what rests say begins anew, but for a new level."""
        if not _only_levelled(self.calibration, calibration):
            self._past = None if calibration is None else watching(calibration)
            self._counted = self.rest
        self.calibration, self.standing = calibration, self._past
        self.scale = 1.0 if calibration is None else output_scale(calibration, self._g)
        self._hold()

    @property
    def departed(self) -> bool:
        """Whether the sensor has left its calibration."""
        return self.standing is not None and self.standing.departure is not None

    def rested(self, rest: Dwell, least: float) -> None:
        """
        Take up what a rest comes to so far.

        Parameters
        ----------
        rest : Dwell
            The latest.
        least : float
            Departures from 1 g that are smaller are passed over [g].

        """
        self.rest = rest
        self._hold()
        part = self._uncounted(rest)
        if part is not None and part.end - part.start >= LONG_REST:
            self._past, self._counted = self._with(part, least), _as_noisy_as(part, rest)
        self._stand(least)

    def ended(self, rest: Dwell, least: float) -> None:
        """Take up what a rest came to in the end; arguments as `rested`."""
        part = self._uncounted(rest)
        self._past = self._past if part is None else self._with(part, least)
        self._counted = rest
        self._stand(least)

    def _stand(self, least: float) -> None:
        """Say how the sensor stands with the rest that is going on."""
        part = None if self.rest is None else self._uncounted(self.rest)
        self.standing = self._past if part is None else self._with(part, least)

    def _uncounted(self, rest: Dwell) -> Dwell | None:
        """Give what of a rest was not counted yet; None where that is too little."""
        before = self._counted
        if before is None or not overlap(before, rest) or rest.samples < before.samples:
            return rest
        return rest_after(before, rest) if rest.end - before.end >= _SHORT_REST else None

    def _with(self, rest: Dwell, least: float) -> Watching | None:
        """Give how the sensor stands with one more rest."""
        context = self._context(rest)
        if self._past is None or self.calibration is None or context is None:
            return self._past
        noise = rest.std[np.newaxis] / math.sqrt(rest.count)
        found = rests_of(self.calibration, rest.mean[np.newaxis], noise, context)
        return compared(self._past, found[0], least)

    def _hold(self) -> None:
        self.gravity = None if self.rest is None else self._force(self.rest)

    def _force(self, rest: Dwell) -> Floats | None:
        """Give the corrected force of a rest [m/s²]; None where it cannot be corrected."""
        context = self._context(rest)
        if self.calibration is None or context is None:
            return None
        return self.calibration.correct(rest.mean[np.newaxis], context)[0] * self.scale

    def _context(self, rest: Dwell) -> Context | None:
        """Give the context of a rest; None where the calibration needs more."""
        if self.calibration is None:
            return None
        context = context_of_rest(rest, self.calibration.units)
        known = all(key in context for key in self.calibration.model.needs)
        return context if known else None

    def _error(self, force: Floats) -> float:
        """Give |a| - 1 g [g]."""
        return float(np.linalg.norm(force)) / self._g - 1.0

    @property
    def residual(self) -> float:
        """Give |a| - 1 g at the last rest [g]; NaN where it is not known."""
        return math.nan if self.gravity is None else self._error(self.gravity)


def output_scale(calibration: Calibration, gravity: float) -> float:
    """
    Say how many m/s² are one unit of corrected force.

    Parameters
    ----------
    calibration : Calibration
        Gives force in the unit of its readings, or in g.
    gravity : float
        Local gravity [m/s²].

    """
    return 1.0 if calibration.units.name == 'm/s2' else gravity / calibration.force_per_g


def rest_after(part: Dwell, whole: Dwell) -> Dwell:
    """Give what came of a rest after an earlier part of it, as noisy as that was."""
    samples = whole.samples - part.samples
    share = samples / whole.samples

    def mean(before: Any, all_of_it: Any) -> Any:
        return (all_of_it - (1.0 - share) * before) / share

    context = {key: mean(part.context.get(key, value), value)
               for key, value in whole.context.items()}
    rest = replace(whole, start=part.end, time=mean(part.time, whole.time), samples=samples,
                   mean=mean(part.mean, whole.mean), context=context)
    return _as_noisy_as(part, rest)


def _as_noisy_as(part: Dwell, rest: Dwell) -> Dwell:
    """Give a rest the noise of a part of it: a slow change is not to pass for noise."""
    return replace(rest, std=part.std, count=part.count / part.samples * rest.samples)


def _only_levelled(before: Calibration | None, after: Calibration | None) -> bool:
    """Tell whether two calibrations differ in nothing but the mounting."""
    return (before is not None and after is not None
            and before.model.effects == after.model.effects
            and np.array_equal(before.model.vector, after.model.vector)
            and np.array_equal(before.covariance, after.covariance)
            and not np.array_equal(before.model.rotation, after.model.rotation))
