# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Capture of poses while samples arrive.

A rest becomes a provisional pose as soon as its length is `min_dwell`, so that the user can turn
the sensor to the next pose. Its average is updated each time its length has doubled, at intervals
of `LONG_REST` during a long rest, and at its end. The detector reports an end only when it is
certain that the rest does not continue after a knock. The next rest may have started by then.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .pose_book import overlap, PoseBook
from ..capture import CaptureSettings, Dwell, StillDetector
from ..table import Floats
from ..units import Units

LONG_REST = 300.0
"""Longest interval between updates of a rest [s]."""

_LOOK_EVERY = 0.1
"""Interval at which an ongoing rest is checked [s]."""

_PIECE = 0.35
"""Length, by the stamps, of the pieces into which a block of samples is divided [s]."""

_NOISE_FELL = 0.9
"""Relative decrease of the threshold after which earlier poses are tested again."""

_SURELY_OVER = (4.0, 40.0)
"""Time after which a rest has certainly ended: in windows and in samples, the longer one."""


@dataclass(frozen=True)
class Change:
    """
    The changes that samples caused.

    Parameters
    ----------
    rest : Dwell or None
        The latest rest, if it is new or has a new average.
    ended : tuple of Dwell
        Rests that ended.
    poses : bool
        Whether the poses changed.
    doubted : int
        Number of poses newly marked as doubtful.

    """

    rest: Dwell | None = None
    ended: tuple[Dwell, ...] = ()
    poses: bool = False
    doubted: int = 0


class LiveCapture:
    """
    The stillness detector and the poses of one sensor.

    Parameters
    ----------
    settings : CaptureSettings
        Settings of the detector and of the poses.
    units : Units
        Unit of the readings.

    """

    def __init__(self, settings: CaptureSettings, units: Units) -> None:
        self.detector = StillDetector(settings, units)
        self.book = PoseBook(settings, units)
        self._window = settings.still_window
        self._rest: Dwell | None = None
        self._declined: Dwell | None = None
        self._looked = self._known_until = self._was_still = 0.0
        self._judged_at = float('inf')

    def push(self, samples: Floats, capture: bool) -> list[Change]:
        """
        Add samples.

        Parameters
        ----------
        samples : (n, 9) array
            As in `StillDetector.push`.
        capture : bool
            Whether every rest becomes a pose.

        Returns
        -------
        list of Change
            The changes; empty for most blocks.

        """
        found = [self._after(self.detector.push(piece), float(piece[-1, 0]), capture)
                 for piece in _pieces(samples)]
        return [change for change in found if change is not None]

    def interrupt(self, capture: bool) -> list[Change]:
        """End the ongoing rest, because the stream is interrupted; parameters as in `push`."""
        ended = self.detector.close()
        return [self._end(ended, capture)] if ended else []

    def _after(self, ended: list[Dwell], time: float, capture: bool) -> Change | None:
        """Return the changes by the samples up to this time."""
        if ended:
            return self._end(ended, capture)
        still = self.detector.still
        if still:
            self._was_still = time
        until = self._known_until if still else self._looked + _LOOK_EVERY
        if self._looked <= time < until:
            return None
        self._looked, self._known_until = time, time + _LOOK_EVERY
        return self._look(capture) if still else self._doubt_held(time)

    def capture_now(self) -> Dwell | None:
        """Capture the ongoing rest as a pose, and return it; None if there is no rest."""
        dwell = self.detector.current()
        if dwell is not None:
            self.book.hold(dwell)
            self._declined = None
        return dwell

    def refresh(self) -> None:
        """Update the pose of the ongoing rest."""
        dwell = self.detector.current() if self.book.holding else None
        if dwell is not None and self.book.holds(dwell):
            self.book.hold(dwell)

    def undo(self) -> bool:
        """Remove the last pose and do not capture it again; return whether a pose was removed."""
        self._declined = self._rest
        return self.book.undo()

    def clear(self) -> None:
        """Remove all poses; the ongoing rest is not captured again."""
        self._declined = self._rest
        self.book.clear()

    def _look(self, capture: bool) -> Change | None:
        """Return the changes of the ongoing rest."""
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
        """Return whether a rest is a pose: already provisional, or every rest becomes a pose."""
        declined = self._declined is not None and overlap(self._declined, dwell)
        return self.book.holds(dwell) or (capture and not declined)

    def _end(self, ended: list[Dwell], capture: bool) -> Change:
        """Add rests that ended."""
        captured = [dwell for dwell in ended if self._is_captured(dwell, capture)]
        for dwell in captured:
            self.book.end(dwell)
        last, rest = ended[-1], self._rest
        latest = rest is None or overlap(rest, last) or not rest.start > last.end
        if latest:
            self._rest = last
        # Rests end in order: an older provisional pose will not get a final average.
        doubted = self.book.doubt_held(lambda dwell: dwell.end < last.start)
        doubted += self._judge_again()
        return Change(last if latest else None, tuple(ended), bool(captured or doubted), doubted)

    def _doubt_held(self, time: float) -> Change | None:
        """Mark provisional poses as doubtful that will not get a final average."""
        def is_over(dwell: Dwell) -> bool:
            windows, samples = _SURELY_OVER
            period = _length(dwell) / dwell.samples
            away = max(windows * self._window, samples * period)
            return not dwell.start <= time <= max(dwell.end, self._was_still) + away

        count = self.book.doubt_held(is_over)
        return Change(poses=True, doubted=count) if count else None

    def _judge_again(self) -> int:
        """Mark poses as doubtful that are not still according to the noise known now."""
        threshold = self.detector.threshold
        if threshold > _NOISE_FELL * self._judged_at:
            return 0
        self._judged_at = threshold
        return self.book.doubt(self.detector.doubtful())


def _pieces(samples: Floats) -> list[Floats]:
    """Split samples into pieces of at most `_PIECE`."""
    times = samples[:, 0]
    if 0.0 <= times[-1] - times[0] < _PIECE:
        return [samples]
    return np.split(samples, np.flatnonzero(np.diff(np.floor(times / _PIECE))) + 1)


def _due(length: float) -> float:
    """Return the length of a rest at its next update [s]."""
    return min(2.0 * length, length + LONG_REST)


def _length(dwell: Dwell | None, same_as: Dwell | None = None) -> float:
    """Return the length of a rest [s]; 0 without a rest, or for another rest than `same_as`."""
    if dwell is None or (same_as is not None and not overlap(dwell, same_as)):
        return 0.0
    return dwell.end - dwell.start
