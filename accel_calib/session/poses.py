# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The poses of one sensor: their capture while samples arrive, and which one is next.

**Capture.** A rest becomes a provisional pose as soon as its length is `min_dwell`, so that the
user can turn the sensor to the next pose. Its average is updated each time its length has doubled,
at intervals of `LONG_REST` during a long rest, and at its end: the final dwell replaces the
provisional one, which it overlaps in time. The detector reports an end only when it is certain
that the rest does not continue after a knock. The next rest may have started by then.

A recording that is played again repeats its stamps and readings, and its poses do not count twice.
Only the user removes poses. If later rests show that the sensor may have moved during a pose, the
pose is marked as doubtful, and the fit leaves it out if possible.

**Next pose.** It is chosen again only when a pose is added or removed, or a request was not
followed. While a rest lasts, the advice therefore stays the same, although the average of its pose
still changes.

A rest answers the request before it. An answer in another direction is noted. If the answers agree
with swapped or inverted axes, poses are asked for in the axes that the sensor reads. Otherwise the
request is not repeated.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
import math
from operator import is_

import numpy as np

from ..calibration import lies_in_cone, NextPose, PlannedPose, SessionPlan
from ..finding import Finding
from ..geometry import ATTITUDES, axes_of_signs, SIGNED_AXES, TAKEN, unit
from ..stillness import (
    account_of, CaptureSettings, check_measured, Dwell, dwells_of, overlap, poses_from, Rest,
    select, StillDetector, with_temperature)
from ..table import CONTEXT, Floats, Poses
from ..text import counted
from ..units import MG, Units

_SEPARATE = 64
"""Number of dwells that can be undone one by one; older dwells are merged permanently."""

_BAND = 5.0
"""Poses with a larger difference of temperature are not merged [°C]; ~/refine needs both."""

_SAME_MEAN = 4.0
"""Largest difference of two means of the same samples, in their standard deviations."""

_BANDS = 5
"""Parts of the range of another column so far; poses in different parts are not merged."""

LONG_REST = 300.0
"""Longest interval between updates of a rest [s]."""

_LOOK_EVERY = 0.1
"""Interval at which an ongoing rest is checked [s]."""

_PIECE = 0.6
"""Length, by the stamps, of the pieces of a block [s]; more than that of a batch."""

_NOISE_FELL = 0.9
"""Relative decrease of the threshold after which earlier poses are tested again."""

_SURELY_OVER = (4.0, 40.0)
"""Time after which a rest has certainly ended: in windows and in samples, the longer one."""


@dataclass(frozen=True)
class Change:
    """
    The changes that samples caused.

    `rest` is the latest rest, if it is new or has a new average, `poses` whether the poses
    changed, and `doubted` the number of poses newly marked as doubtful. `refused` are rests that
    ended and are no poses.

    """

    rest: Dwell | None = None
    ended: tuple[Dwell, ...] = ()
    poses: bool = False
    doubted: int = 0
    refused: tuple[Rest, ...] = ()


class LiveCapture:
    """
    The stillness detector and the poses of one sensor; `context` as of `StillDetector`.

    The poses are dwells in the order of their capture, of which the last are held: provisional.

    """

    def __init__(self, settings: CaptureSettings, units: Units,
                 context: Sequence[str] = CONTEXT) -> None:
        self.detector = StillDetector(settings, units, context=context)
        self._settings, self._units, self._begun = settings, units, -math.inf
        self._earlier: list[Dwell] = []
        self._dwells: list[Dwell] = []
        self._held: list[Dwell] = []
        self._made: tuple[list[Dwell], Poses] | None = None
        self._rest: Dwell | None = None
        self._declined: Dwell | None = None
        self._looked = self._was_still = 0.0
        self._judged_at = float('inf')

    @property
    def still(self) -> bool:
        """Return whether the sensor is still."""
        # Until a rest is as long as a pose, the noise is not known, and may be a motion.
        return self.detector.still and self._rest is not None

    # The poses

    def poses(self) -> Poses:
        """Return the pose table, with NaN where a pose lacks a column of the context."""
        dwells, made = [*self._earlier, *self._dwells, *self._held], self._made
        if made is None or len(made[0]) != len(dwells) or not all(map(is_, made[0], dwells)):
            # Merging compares all pairs; the diagnostics ask every second.
            made = self._made = dwells, poses_from(
                self._select(dwells), self._settings, partial=True)
        return made[1]

    def _select(self, dwells: list[Dwell]) -> list[Dwell]:
        """Keep, merge or refuse repeated poses, separately in each band of the context."""
        dwells = with_temperature(dwells)
        keys = sorted({key for dwell in dwells for key in dwell.context} - {'rate'})
        numbers = np.full((len(dwells), len(keys)), -1, np.int64)  # of the bands; unknown: -1
        for k, key in enumerate(keys):
            values = np.array([dwell.context.get(key, np.nan) for dwell in dwells], float)
            known = np.isfinite(values)
            least, width = np.min(values[known]), np.ptp(values[known]) / _BANDS
            least, width = (0.0, _BAND) if key == 'temperature' else (least, width or 1.0)
            numbers[known, k] = np.round((values[known] - least) / width)
        bands: dict[bytes, list[Dwell]] = {}
        for dwell, band in zip(dwells, numbers, strict=True):
            bands.setdefault(band.tobytes(), []).append(dwell)
        return [dwell for band in bands.values()
                for dwell in select(band, self._settings, self._units)]

    def add_stored(self, poses: Poses) -> None:
        """Insert stored poses before the others, each with an orientation of its own."""
        self._earlier[:0] = dwells_of(poses)

    def put(self, dwell: Dwell, *, ended: bool) -> None:
        """Add the pose of a rest, or replace its provisional one; provisional until it `ended`."""
        self._held = [each for each in self._held if not overlap(dwell, each)]
        for each in (*self._earlier, *self._dwells):
            noise = np.hypot(dwell.std / np.sqrt(dwell.count), each.std / np.sqrt(each.count))
            if (overlap(each, dwell) and not each.doubtful
                    and np.all(np.abs(each.mean - dwell.mean) <= _SAME_MEAN * noise)):
                break  # the same stamps and mean: a recording is played again
        else:
            (self._dwells if ended else self._held).append(dwell)
        if len(self._dwells) > _SEPARATE:
            self._earlier = self._select([*self._earlier, self._dwells.pop(0)])

    def _doubt(self, over: list[Dwell]) -> int:
        """Mark poses that will get no final average as doubtful; return their number."""
        for dwell in over:
            self.put(replace(dwell, doubtful=True), ended=True)
        return len(over)

    def undo(self) -> bool:
        """Remove the last pose and do not capture it again; return whether a pose was removed."""
        self._declined = self._rest
        entries = self._held or self._dwells or self._earlier
        return bool(entries and entries.pop())

    def clear(self) -> None:
        """Remove all poses; the ongoing rest is not captured again."""
        self._declined, self._begun = self._rest, self._looked
        self._earlier, self._dwells, self._held = [], [], []

    def capture(self, rest: Dwell) -> None:
        """Capture the ongoing rest as a pose."""
        self.put(rest, ended=False)
        self._declined = None

    def poses_for_fit(self, found: tuple[Finding, ...], needs: Sequence[str] = ()) -> Poses:
        """
        Return the poses with findings about their samples: these, and those of the rests.

        The provisional pose of the ongoing rest is updated. Poses without the columns that the
        calibration `needs` are left out if others have them. RefusedFitError if no sensor
        measures so.

        """
        ongoing = self.detector.current() if self._held else None
        if ongoing is not None and self._is_captured(ongoing, capture=False):
            self.put(ongoing, ended=False)
        check_measured(self.detector.lengths, self._units)
        judged = self.detector.judged()
        ends = {each.start: each.at_limit for each in judged}  # the later ones show it, too
        self._dwells = [replace(each, at_limit=ends.get(each.start, each.at_limit))
                        for each in self._dwells]
        rests = [*(each.rest for each in judged), *self.detector.missing]
        own = [each for each in rests if each.start >= self._begun]
        poses = self.poses()
        holes = {key: np.isnan(poses[key]) for key in (*CONTEXT, *poses.quantities)
                 if key in poses}
        lacking = [key for key in needs if np.any(holes.get(key, False))]
        whole = ~np.any([holes[key] for key in lacking], axis=0)
        if lacking and np.any(whole):
            found = (*found, Finding('note', f'{counted(int(np.sum(~whole)), "pose")} without '
                                     f'{" or ".join(lacking)} left out'))
            poses = poses.take(whole)
        partial = [key for key in holes if np.any(np.isnan(poses[key]))]
        return replace(poses.without_columns(*partial),
                       findings=(*found, *account_of(own, self._settings)))

    # Samples

    def push(self, samples: Floats, capture: bool) -> Iterator[Change]:
        """
        Add samples as `StillDetector.push`, and yield each change before the next samples.

        `capture`: every rest becomes a pose.

        """
        times, pieces = samples[:, 0], [samples]
        if not 0.0 <= times[-1] - times[0] < _PIECE:
            pieces = np.split(samples, np.flatnonzero(np.diff(np.floor(times / _PIECE))) + 1)
        for piece in pieces:
            ended, time = self.detector.push(piece), float(piece[-1, 0])
            change = self._end(ended, capture) if ended else self._look(time, capture)
            refused = tuple(rest for rest in self.detector.refused if not any(
                overlap(rest, each) for each in (*self._held, *self._dwells)))
            if change is not None or refused:
                yield replace(change or Change(), refused=refused)

    def interrupt(self, capture: bool) -> list[Change]:
        """End the ongoing rest, because the stream is interrupted; parameters as in `push`."""
        ended = self.detector.close()
        return [self._end(ended, capture)] if ended else []

    def _is_captured(self, dwell: Dwell, capture: bool) -> bool:
        """Return whether a rest is a pose: already provisional, or every rest becomes a pose."""
        declined = self._declined is not None and overlap(self._declined, dwell)
        return any(overlap(dwell, each) for each in self._held) or (capture and not declined)

    def _look(self, time: float, capture: bool) -> Change | None:
        """Return the changes by the ongoing rest at this time, if it is due."""
        still, rest = self.detector.still, self._rest
        if still:
            self._was_still = time
        if self._looked <= time < self._looked + _LOOK_EVERY:
            return None
        self._looked = time
        if not still:
            over, (windows, samples) = [], _SURELY_OVER
            for held in self._held:
                period = (held.end - held.start) / held.samples
                away = max(windows * self._settings.still_window, samples * period)
                if not held.start <= time <= max(held.end, self._was_still) + away:
                    over.append(held)
            return Change(poses=True, doubted=self._doubt(over)) if over else None
        ongoing = self.detector.ongoing()
        if ongoing is None:
            return None
        known = 0.0 if rest is None or rest.end < ongoing.begin else rest.end - rest.start
        if ongoing.end - ongoing.begin < min(2.0 * known, known + LONG_REST):
            return None  # to judge a dwell costs more than to find its length
        dwell = self.detector.current(ongoing)
        if dwell is None:
            return None
        self._rest, captured = dwell, self._is_captured(dwell, capture)
        if captured:
            self.put(dwell, ended=False)
        return Change(rest=dwell, poses=captured)

    def _end(self, ended: list[Dwell], capture: bool) -> Change:
        captured = [dwell for dwell in ended if self._is_captured(dwell, capture)]
        for dwell in captured:
            self.put(dwell, ended=True)
        last, rest = ended[-1], self._rest
        latest = rest is None or rest.start <= last.end
        if latest:
            self._rest = last
        # Rests end in order: an older provisional pose will not get a final average.
        doubted = self._doubt([each for each in self._held if each.end < last.start])
        threshold = self.detector.threshold
        if threshold <= _NOISE_FELL * self._judged_at:
            self._judged_at = threshold
            moved = {each.start for each in self.detector.judged() if each.reason}
            for k, each in enumerate(self._dwells):
                if each.start in moved and not each.doubtful:
                    self._dwells[k], doubted = replace(each, doubtful=True), doubted + 1
        return Change(last if latest else None, tuple(ended), bool(captured or doubted), doubted)


# ----------------------------------------------------------------------------- the next pose

_FOLLOWED = math.cos(math.radians(30.0))
"""A rest within 30° of what was asked for has followed; the next orientations are 35° away."""

_APART = math.cos(math.radians(50.0))
"""Requests 50° to 130° apart show two axes."""

_ANSWERS = 4
"""Number of answers from which the axes are found."""

_FEWEST_WRONG = 2
"""Smallest number of wrong answers that show swapped or inverted axes."""

_AGREES = math.cos(math.radians(25.0))
"""All answers must be within 25° of those with such axes. Whoever turns the sensor in an own order
seldom agrees by chance (`benchmarks/persons.py`)."""

_AXES = sorted(SIGNED_AXES,
               key=lambda axes: np.sum(np.diag(axes) != 1.0) + 0.1 * np.sum(axes < 0.0))
"""The ways in which axes can be swapped and inverted, the most likely first: reading = A up."""

_SIMPLE = 7
"""Number of them with no, or with one axis inverted, or two swapped."""


@dataclass(frozen=True, eq=False)
class Guide:
    """
    The next pose, and the lines about captured poses; the methods return the guide after them.

    Parameters
    ----------
    chosen : SessionPlan or None
        The next pose for a fit; None before the first choice.
    planned : tuple of PlannedPose or None
        The poses of a refinement that are still asked for, () once all are taken; None: the poses
        are for a fit.
    begun : int
        Number of poses when they were planned.
    axes : (3, 3) array
        The axes of the readings in those of the sensor, one of the 48 with right angles.
    skipped : tuple of (3,) array
        Directions that are not asked for.
    is_stale : bool
        Whether another pose is to be asked for because of the last rest.
    answers : tuple of (array, array)
        The last requests, and the directions that were read instead.
    missed : int
        Number of the last requests in a row that were not followed.
    count, new_at : int, float
        Number of poses, and the header stamp at which it changed [s].
    rest : float
        Start of the last rest that has a line [s].

    """

    chosen: SessionPlan | None = None
    planned: tuple[PlannedPose, ...] | None = None
    begun: int = 0
    axes: Floats = field(default_factory=lambda: _AXES[0])
    skipped: tuple[Floats, ...] = ()
    is_stale: bool = False
    answers: tuple[tuple[Floats, Floats], ...] = ()
    missed: int = 0
    count: int = 0
    new_at: float = math.inf
    rest: float = -math.inf

    @property
    def plan(self) -> SessionPlan | None:
        """Return the next pose, or that of a followed refinement; None before the first choice."""
        plan = self.chosen
        if plan is None:
            return None
        asked = plan.asked
        if self.planned:
            first = self.planned[0]
            asked = NextPose(self.axes.T @ first.up, asked.error, plan.poses + len(self.planned),
                             fits=False, planned=first)
        elif asked.direction is not None:
            asked = replace(asked, direction=self.axes.T @ asked.direction)
        return replace(plan, asked=asked)

    def choose(self, plan: SessionPlan | None) -> Guide:
        """Ask for another pose; those of a refinement that are taken now are not asked for."""
        planned = self.planned
        if plan is None or plan.poses < self.begun:
            planned = None
        elif planned:
            new = plan.up[self.begun:]
            planned = tuple(each for each in planned if not np.any(new @ each.up >= TAKEN))
        return replace(self, chosen=plan, planned=planned, is_stale=False)

    @property
    def poses(self) -> int:
        """Return the number of poses for which the next pose was chosen."""
        return 0 if self.chosen is None else self.chosen.poses

    def answer(self, mean: Floats, units: Units) -> tuple[Guide, str]:
        """Note the mean reading of a new rest; return also how it is not what was asked for."""
        plan = self.plan
        if plan is None or not plan.poses or plan.asked.direction is None or (
                units.is_native and not plan.zero):
            return self, ''
        asked, read = plan.asked.direction, unit(mean - np.array(plan.zero or (0.0, 0.0, 0.0)))
        noted = replace(self, answers=(*self.answers, (asked, read))[-_ANSWERS:])
        wanted = self.axes @ asked
        if read @ wanted >= _FOLLOWED:
            return replace(noted, missed=0), ''
        skips = all(each @ wanted < TAKEN for each in self.skipped)
        noted = replace(noted, skipped=(*self.skipped, *([wanted] if skips else [])),
                        missed=self.missed + 1, is_stale=True)
        asked_all, read_all = map(np.array, zip(*noted.answers, strict=True))
        # Opposite requests show one axis alone, and a robot that tilts reads the same without end.
        telling = np.min(np.abs(asked_all @ asked_all.T)) < _APART and not lies_in_cone(
            np.vstack([plan.up, read_all]))
        wrong, axes = int(np.sum(np.sum(read_all * asked_all, axis=1) < _FOLLOWED)), _AXES[0]
        if telling and wrong >= _FEWEST_WRONG:
            likely = _AXES if len(asked_all) > _FEWEST_WRONG else _AXES[:_SIMPLE]
            axes = next((each for each in likely if np.all(
                np.sum(read_all * (asked_all @ each.T), axis=1) >= _AGREES)), axes)
        if not np.array_equal(axes, self.axes):
            noted = replace(noted, axes=axes, skipped=(), missed=0)
        return noted, f'asked for {_signs(asked)}, the sensor reads {_signs(read)}'

    @property
    def axes_words(self) -> str:
        """Return how the axes are probably swapped or inverted; empty if they are not."""
        if np.array_equal(self.axes, _AXES[0]):
            return ''
        reads = {f'+{name}': _signs(read) for name, read in zip('xyz', self.axes.T)}
        wrong = {name: read for name, read in reads.items() if name != read}
        if all(name[1] == read[1] for name, read in wrong.items()):
            what = (f'the {" and the ".join(f"{name[1]} axis" for name in wrong)} of the readings '
                    f'{"is" if len(wrong) == 1 else "are"} probably inverted')
        else:
            what = 'the axes of the readings are probably swapped: ' + ', '.join(
                f'{name} reads {read}' for name, read in wrong.items())
        return (f'{what}; a calibration does not mind, but the mounting does: correct the driver, '
                'and take the poses again')

    def line(self, poses: Poses, units: Units, words: str, *, asks: bool, added: bool) -> str:
        """
        Return the line about a rest that `added` a pose or repeats one; empty if no news.

        `words` are the next step, empty after the last one; `asks`: it is a pose.

        """
        if not added:
            return f'this rest repeats an earlier pose; next: {words}' if asks else ''
        total = 0 if self.plan is None else self.plan.asked.total
        count = f'{len(poses)} of about {total}' if asks and len(poses) < total else len(poses)
        noise = ''
        if poses.noise is not None and not units.is_native:
            latest = poses.noise[int(np.argmax(poses['time']))]
            noise = f', {float(np.mean(units.to_g(latest))) * MG:.2f} mg'
        return f'pose {count}{noise}{f", next: {words}" if words else ""}'


def _signs(up: Floats) -> str:
    """Return the axes of the side, edge or corner nearest to a direction."""
    return axes_of_signs(ATTITUDES[int(np.argmax(ATTITUDES @ up))])
