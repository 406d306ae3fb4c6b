# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether the responses of a calibrator agree with some order of the calls.

A call takes effect at one moment between its start and its end. `explained` looks for such
moments: an order of all calls in which each response follows from the state that the calls before
it left.
The state is small: the stored calibration, the one in use, the steps of ~/undo, and the number of
poses. Of a calibration it holds which call made it, the angles of its mounting, and the time of
its fit.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
import re

from inside import MOST_STEPS

_NUMBER_OF_POSES = re.compile(r'(\d+) poses?\b')
_ANGLES = re.compile(r'roll (\S+)°, pitch (\S+)°, yaw (\S+)°')
_FEWEST = 4
_OFF = 'correction switched off'  # this state hides that of the calibration
_DATE_S = 1.0  # resolution of the date of a calibration


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
    """A calibration: its number, mounting [whole degrees], and end of its last fit."""

    number: int
    angles: tuple[float, ...]
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
class State:
    """What a calibrator knows and has stored."""

    poses: int
    stored: Made | None = None
    used: Made | None = None
    steps: tuple[Made | None, ...] = ()


def _number_of_poses(call: Call) -> int:
    found = _NUMBER_OF_POSES.search(call.words)
    assert found is not None, call
    return int(found[1])


def _angles(call: Call) -> tuple[float, ...]:
    found = _ANGLES.search(call.words)
    assert found is not None, call
    return tuple(float(f'{float(each):.0f}') for each in found.groups())


def _with_step(state: State, made: Made | None) -> State:
    return replace(state, stored=made, used=made,
                   steps=(*state.steps, state.stored)[-MOST_STEPS:])


def _capture_pose(state: State, call: Call, number: int) -> Iterator[State]:
    if not call.good:
        yield state
    elif _number_of_poses(call) - state.poses in (0, 1):
        yield replace(state, poses=_number_of_poses(call))


def _undo_pose(state: State, call: Call, number: int) -> Iterator[State]:
    if call.good and state.poses - _number_of_poses(call) in (0, 1):
        yield replace(state, poses=_number_of_poses(call))  # poses of one direction are merged
    elif not call.good and not state.poses:
        yield state


def _new(state: State, call: Call, number: int) -> Iterator[State]:
    """Yield the states that a new calibration can leave."""
    if not call.good:
        yield state
        return
    before, fits = state.used or Made(-1, (), -math.inf), call.name in ('fit', 'refine')
    if (fits and state.poses < _FEWEST) or (call.name == 'set_heading' and not before.levelled):
        return
    angles = before.angles if fits else _angles(call)
    yield _with_step(state, Made(number, angles, call.ended if fits else before.fitted))
    if state.used == state.stored is not None and angles == before.angles and not (
            fits and call.begun - before.fitted > _DATE_S):
        yield state  # the same rest or poses again may give an equal file, which is not a step


def _save(state: State, call: Call, number: int) -> Iterator[State]:
    if call.good is (state.used is not None):
        yield state if state.used in (None, state.stored) else _with_step(state, state.used)


def _load(state: State, call: Call, number: int) -> Iterator[State]:
    if call.good is (state.stored is not None):
        yield replace(state, used=state.stored) if call.good else state


def _undo(state: State, call: Call, number: int) -> Iterator[State]:
    steps = state.steps
    while steps and steps[-1] == state.stored:
        steps = steps[:-1]
    if not call.good and not steps:
        yield replace(state, steps=steps)
    elif call.good and steps and ('no calibration any more' in call.words) is (steps[-1] is None):
        yield replace(state, stored=steps[-1], used=steps[-1], steps=steps[:-1])


def _reset(state: State, call: Call, number: int) -> Iterator[State]:
    if call.good:
        after = state if state.stored is None else _with_step(state, None)
        yield replace(after, used=None, poses=0)


def _self_test(state: State, call: Call, number: int) -> Iterator[State]:
    levelled = ', levelled' in call.words
    if _OFF in call.words or levelled is (state.used is not None and state.used.levelled):
        yield state


def _same(state: State, call: Call, number: int) -> Iterator[State]:
    if call.good:
        yield state


AFTER: dict[str, Callable[[State, Call, int], Iterator[State]]] = {
    'capture_pose': _capture_pose, 'undo_pose': _undo_pose, 'fit': _new, 'refine': _new,
    'set_level': _new, 'set_heading': _new, 'calibrate_at_rest': _new, 'save': _save,
    'load': _load, 'undo': _undo, 'reset': _reset, 'enable': _same, 'self_test': _self_test}
"""The states in which a call with its response can leave a calibrator; none: it cannot be."""


def _renumbered(state: State) -> State:
    """Return a state with the numbers of its calibrations in order: only their equality counts."""
    made = [state.stored, state.used, *state.steps]
    numbers = {each.number: -k for k, each in enumerate(made, 1) if each is not None}
    stored, used, *steps = (each and replace(each, number=numbers[each.number]) for each in made)
    return replace(state, stored=stored, used=used, steps=tuple(steps))


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
            for found in map(_renumbered, AFTER[call.name](state, call, 1)):
                if (after, found) not in seen:
                    seen.add((after, found))
                    waiting.append((after, found))
    return None, [calls[k] for k, calls in zip(furthest, clients, strict=True) if k < len(calls)]
