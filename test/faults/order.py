# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether the responses of a calibrator agree with some order of the calls.

A call takes effect at one moment between its start and its end. `explained` looks for such
moments: an order of all calls in which each response follows from the state that the calls before
it left.
The state is small: the number of poses, the stored calibration, which is the one in use, and the
steps of ~/undo. Of a calibration it holds the angles of its mounting and the time of its fit.
A command that writes an equal file leaves no step. The responses do not show whether a file was
equal. A calibration that may be equal therefore leaves a step that is not sure; ~/undo and the
files at the end decide.

"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
import re

from inside import MOST_STEPS

_NUMBER_OF_POSES = re.compile(r'(\d+) poses?\b')
_ANGLES = re.compile(r'roll (\S+)°, pitch (\S+)°, yaw (\S+)°')
_FEWEST = 4
_OFF = 'correction switched off'  # this state hides that of the calibration
_SAME_FIT_S = 1.5  # resolution of the date of a calibration, and of `Made.fitted`


@dataclass(frozen=True)
class Call:
    """A call of a service: its time by the steady clock [s], and the response."""

    name: str
    begun: float
    ended: float
    words: str
    good: bool


@dataclass(frozen=True)
class Made:
    """A calibration: its mounting [whole degrees], and the end of its fit [whole seconds]."""

    angles: tuple[int, ...]
    fitted: float

    @property
    def levelled(self) -> bool:
        """Whether the mounting is levelled."""
        return bool(self.angles)

    @property
    def full(self) -> bool:
        """Whether it is a fit of poses."""
        return math.isfinite(self.fitted)


@dataclass(frozen=True)
class Step:
    """A step of ~/undo: the calibration before, and whether there surely is such a step."""

    made: Made | None
    sure: bool


@dataclass(frozen=True)
class State:
    """What a calibrator has stored; the calibration in use is the stored one."""

    poses: int
    stored: Made | None = None
    steps: tuple[Step, ...] = ()

    def has(self, count: int) -> bool:
        """Return whether there can be this number of steps."""
        return sum(step.sure for step in self.steps) <= count <= min(len(self.steps), MOST_STEPS)


def _number_of_poses(call: Call) -> int:
    found = _NUMBER_OF_POSES.search(call.words)
    assert found is not None, call
    return int(found[1])


def _angles(call: Call) -> tuple[int, ...]:
    found = _ANGLES.search(call.words)
    assert found is not None, call
    return tuple(round(float(angle)) for angle in found.groups())


def _with_step(state: State, made: Made | None, *, sure: bool = True) -> State:
    steps = (*state.steps, Step(state.stored, sure))
    oldest = len(steps) - MOST_STEPS
    return replace(state, stored=made, steps=tuple(
        replace(step, sure=step.sure and k >= oldest) for k, step in enumerate(steps)))


def _capture_pose(state: State, call: Call) -> Iterator[State]:
    if not call.good:
        yield state
    elif _number_of_poses(call) - state.poses in (0, 1):
        yield replace(state, poses=_number_of_poses(call))


def _undo_pose(state: State, call: Call) -> Iterator[State]:
    if call.good and state.poses - _number_of_poses(call) in (0, 1):
        yield replace(state, poses=_number_of_poses(call))  # poses of one direction are merged
    elif not call.good and not state.poses:
        yield state


def _new(state: State, call: Call) -> Iterator[State]:
    """Yield the states that a new calibration can leave."""
    if not call.good:
        yield state
        return
    before, fits = state.stored or Made((), -math.inf), call.name in ('fit', 'refine')
    if (fits and state.poses < _FEWEST) or (call.name == 'set_heading' and not before.levelled):
        return
    made = (Made(before.angles, float(round(call.ended))) if fits else
            Made(_angles(call), before.fitted))
    may_equal = state.stored is not None and made.angles == before.angles and not (
        fits and call.begun - before.fitted > _SAME_FIT_S)  # the same rest, or the same poses
    yield _with_step(state, made, sure=not may_equal)


def _needs_calibration(state: State, call: Call) -> Iterator[State]:
    if call.good is (state.stored is not None):
        yield state


def _undo(state: State, call: Call) -> Iterator[State]:
    if not call.good:
        if state.has(0):
            yield replace(state, steps=())
        return
    for k, step in reversed(list(enumerate(state.steps))):
        if ('no calibration any more' in call.words) is (step.made is None):
            yield replace(state, stored=step.made, steps=state.steps[:k])
        if step.sure:
            return


def _reset(state: State, call: Call) -> Iterator[State]:
    if call.good:
        yield replace(state if state.stored is None else _with_step(state, None), poses=0)


def _self_test(state: State, call: Call) -> Iterator[State]:
    levelled = ', levelled' in call.words
    if _OFF in call.words or levelled is (state.stored is not None and state.stored.levelled):
        yield state


def _same(state: State, call: Call) -> Iterator[State]:
    if call.good:
        yield state


AFTER: dict[str, Callable[[State, Call], Iterator[State]]] = {
    'capture_pose': _capture_pose, 'undo_pose': _undo_pose, 'fit': _new, 'refine': _new,
    'set_level': _new, 'set_heading': _new, 'calibrate_at_rest': _new,
    'save': _needs_calibration, 'load': _needs_calibration, 'undo': _undo, 'reset': _reset,
    'enable': _same, 'self_test': _self_test}
"""The states in which a call with its response can leave a calibrator; none: it cannot be."""


def explained(clients: Sequence[Sequence[Call]], start: State,
              fits: Callable[[State], bool]) -> tuple[State | None, list[Call]]:
    """
    Look for an order of the calls that explains all responses and the final state.

    Parameters
    ----------
    clients : sequence of sequences of Call
        The calls of each client, which makes one after the other.
    start : State
        The state before the first call.
    fits : callable
        Whether a final state agrees with what is found after the last call.

    Returns
    -------
    State or None
        The final state; None if there is no such order.
    list of Call
        The calls of which none could be next in the order that explains most of them.

    """
    begin = (0,) * len(clients)
    waiting, seen = [(begin, start)], {(begin, start)}
    furthest = begin
    while waiting:
        at, state = waiting.pop()
        nexts = [(c, calls[k]) for c, (k, calls) in enumerate(zip(at, clients, strict=True))
                 if k < len(calls)]
        if not nexts and fits(state):
            return state, []
        furthest = max(furthest, at, key=sum)
        first_end = min((call.ended for _, call in nexts), default=0.0)
        for c, call in nexts:
            if call.begun > first_end:
                continue  # another call ended before this one began
            after = (*at[:c], at[c] + 1, *at[c + 1:])
            for found in AFTER[call.name](state, call):
                if (after, found) not in seen:
                    seen.add((after, found))
                    waiting.append((after, found))
    return None, [calls[k] for k, calls in zip(furthest, clients, strict=True) if k < len(calls)]
