# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Watch a sensor: samples in, what changed out.

For the sake of the person who turns the sensor a rest counts as soon as it is `min_dwell` long;
what it comes to is looked at again each time its length has doubled, each `LONG_REST` of a long
one, and when it ends. The detector tells of an end only when it is sure that the rest does not go
on after a knock; the next rest may have begun by then.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .pose_book import overlap, PoseBook
from ..capture import StillDetector

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ..capture import CaptureSettings, Dwell
    from ..table import Floats
    from ..units import Units

LONG_REST = 300.0
"""A rest is looked at this often at least [s], however long it is."""

_LOOK_EVERY = 0.1
"""Between looks at a rest that is going on [s]."""

_PIECE = 0.35
"""Samples that come together are looked at in pieces of this length, by their stamps [s]."""

_NOISE_FELL = 0.9
"""The threshold fell by this factor: poses captured before are judged again."""

_SURELY_OVER = (4.0, 40.0)
"""A rest is over for good this long after it: in windows and in samples, whichever is longer."""


@dataclass(frozen=True)
class Change:
    """
    What a sample changed.

    Parameters
    ----------
    rest : Dwell or None
        The latest rest, where it counts or is known better from now on.
    ended : tuple of Dwell
        Rests that ended.
    poses : bool
        Whether the poses changed.
    taken_back : int
        Poses of which it turned out that the sensor was not still.

    """

    rest: Dwell | None = None
    ended: tuple[Dwell, ...] = ()
    poses: bool = False
    taken_back: int = 0


class Watch:
    """
    Detector and poses of one sensor.

    Parameters
    ----------
    settings : CaptureSettings
        What is still, and which poses to keep.
    units : Units
        Unit of the readings.

    """

    def __init__(self, settings: CaptureSettings, units: Units) -> None:
        self.detector = StillDetector(settings, units)
        self.book = PoseBook(settings, units)
        self._window = settings.still_window
        self._rest: Dwell | None = None
        self._passed_over: Dwell | None = None
        self._looked = self._known_until = self._was_still = 0.0
        self._judged_at = float('inf')

    def push(self, time: float, reading: tuple[float, float, float],
             rate: tuple[float, float, float] | None, context: Mapping[str, float],
             capture: bool) -> Change | None:
        """
        Take one sample.

        Parameters
        ----------
        time : float
            Header stamp [s].
        reading : 3 floats
            In the unit of the readings.
        rate : 3 floats or None
            Angular rate [rad/s].
        context : mapping of str to float
            As `StillDetector.push`.
        capture : bool
            Whether a rest becomes a pose without being asked for.

        Returns
        -------
        Change or None
            None for nearly all samples.

        """
        return self._after(self.detector.push(time, reading, rate, context), time, capture)

    def push_block(self, samples: Floats, capture: bool) -> list[Change]:
        """
        Take many samples.

        Parameters
        ----------
        samples : (n, 9) array
            As `StillDetector.push_block`.
        capture : bool
            As `push`.

        Returns
        -------
        list of Change
            Empty for nearly all blocks.

        """
        found = [self._after(self.detector.push_block(piece), float(piece[-1, 0]), capture)
                 for piece in _pieces(samples)]
        return [change for change in found if change is not None]

    def _after(self, ended: list[Dwell], time: float, capture: bool) -> Change | None:
        """Say what changed with the samples up to this time."""
        if ended:
            return self._end(ended, capture)
        still = self.detector.still
        if still:
            self._was_still = time
        until = self._known_until if still else self._looked + _LOOK_EVERY
        if self._looked <= time < until:
            return None
        self._looked, self._known_until = time, time + _LOOK_EVERY
        return self._look(capture) if still else self._give_up(time)

    def capture_now(self) -> Dwell | None:
        """Take the rest that is going on as a pose; None where there is none."""
        dwell = self.detector.current()
        if dwell is not None:
            self.book.hold(dwell)
            self._passed_over = None
        return dwell

    def refresh(self) -> None:
        """Bring the pose of the rest that is going on up to date."""
        dwell = self.detector.current() if self.book.holding else None
        if dwell is not None and self.book.holds(dwell):
            self.book.hold(dwell)

    def undo(self) -> bool:
        """Take back the last pose, and not capture it again; say whether there was one."""
        self._passed_over = self._rest
        return self.book.undo()

    def clear(self) -> None:
        """Forget all poses; the rest that is going on is not captured again."""
        self._passed_over = self._rest
        self.book.clear()

    def _look(self, capture: bool) -> Change | None:
        """See what the rest that is going on comes to."""
        dwell = self.detector.current()
        if dwell is None or _length(dwell) < _due(_length(self._rest, dwell)):
            return None
        self._rest = dwell
        self._known_until = dwell.start + _due(_length(dwell))
        held = self._is_captured(dwell, capture)
        if held:
            self.book.hold(dwell)
        return Change(rest=dwell, poses=held)

    def _is_captured(self, dwell: Dwell, capture: bool) -> bool:
        """Say whether a rest is a pose: held already, or captured without being asked for."""
        passed_over = self._passed_over is not None and overlap(self._passed_over, dwell)
        return self.book.holds(dwell) or (capture and not passed_over)

    def _end(self, ended: list[Dwell], capture: bool) -> Change:
        """Take up rests that ended."""
        captured = [dwell for dwell in ended if self._is_captured(dwell, capture)]
        for dwell in captured:
            self.book.end(dwell)
        last, rest = ended[-1], self._rest
        latest = rest is None or overlap(rest, last) or not rest.start > last.end
        if latest:
            self._rest = last
        # Rests are told of in order: what is held from before the last one came to nothing.
        taken_back = self.book.give_up(lambda dwell: dwell.end < last.start)
        taken_back += self._judge_again()
        return Change(last if latest else None, tuple(ended), bool(captured or taken_back),
                      taken_back)

    def _give_up(self, time: float) -> Change | None:
        """Take back what was held too early: rests that came to nothing in the end."""
        def is_over(dwell: Dwell) -> bool:
            windows, samples = _SURELY_OVER
            period = _length(dwell) / dwell.samples
            away = max(windows * self._window, samples * period)
            return not dwell.start <= time <= max(dwell.end, self._was_still) + away

        count = self.book.give_up(is_over)
        return Change(poses=True, taken_back=count) if count else None

    def _judge_again(self) -> int:
        """Take back poses that are not still by the noise that is known now."""
        threshold = self.detector.threshold
        if threshold > _NOISE_FELL * self._judged_at:
            return 0
        self._judged_at = threshold
        return self.book.take_back(self.detector.withdrawn())


def _pieces(samples: Floats) -> list[Floats]:
    """Cut samples so that between two looks there is never more than `_PIECE`."""
    times = samples[:, 0]
    if 0.0 <= times[-1] - times[0] < _PIECE:
        return [samples]
    return np.split(samples, np.flatnonzero(np.diff(np.floor(times / _PIECE))) + 1)


def _due(length: float) -> float:
    """Say how long a rest is when it is looked at next [s]."""
    return min(2.0 * length, length + LONG_REST)


def _length(dwell: Dwell | None, same_as: Dwell | None = None) -> float:
    """Give the length of a rest [s]; 0 where there is none, or it is another."""
    if dwell is None or (same_as is not None and not overlap(dwell, same_as)):
        return 0.0
    return dwell.end - dwell.start
