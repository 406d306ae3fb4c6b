# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
An hour of the node at 1 kHz: messages lost, memory, CPU time and latency, and their trends.

A caller uses the services all the time. At the end of each round it resets the node, and the next
round begins without poses and without a calibration.

"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
import time
from typing import Any, NamedTuple

from accel_calib.table import Floats
from figures import check, Frame, Line, markdown, table, tell
from nodes import CALIBRATED, Caller, client, cpu_seconds, node_command, run_trial, Trial
import numpy as np
from numpy.typing import NDArray
from shared import children

CALLS = ('fit', 'refine', 'undo', 'save', 'load', 'capture_pose', 'set_level')
"""Services that are called in turn; the last two wait for the next rest of the sensor."""

AT_REST = ('capture_pose', 'set_level')
FIRST_CALL, CALL_EVERY = 35.0, 5.0
"""Time from the start of a round to its first call, with 14 poses then, and between calls [s]."""

REST = 0.7
"""Time from the message on ~/still to a call at rest [s]: the rest is then longer than 1 s."""

HOUR = 3600.0
KILOBYTE = 1.024e-3
"""Unit of the memory in /proc [MB]."""


class Answer(NamedTuple):
    """A call of a service: its time [s] and the response; without words none came."""

    name: str
    seconds: float
    response: Any


@dataclass(frozen=True)
class LongRun:
    """The measurements of a run."""

    trial: Trial  # of the node, and of the bare relay
    per_round: int  # number of intervals of a round
    # (n + 1,) each, at the ends of the intervals: time [ns]; resident memory of the node, the part
    # of it that no other process shares (own), resident memory of its worker and of the bare relay
    # [MB]; CPU time of the node without its worker (cpu), and of the bare relay (bare) [s].
    samples: dict[str, Floats]
    answers: list[Answer]  # of the services

    @cached_property
    def parts(self) -> list[Trial]:
        """Return the trial by intervals."""
        return [self.trial.between(*ends) for ends in pairwise(self.samples['at'].astype(int))]

    @property
    def sent(self) -> NDArray[np.int64]:
        """Return the number of messages sent in each interval."""
        return np.array([len(part.sent) for part in self.parts])

    def cpu_us(self, name: str) -> Floats:
        """Return the CPU time per message in each interval [µs]."""
        return np.diff(self.samples[name]) * 1e6 / self.sent

    def latency_us(self, program: int, percent: float) -> Floats:
        """Return a percentile of the latency in each interval [µs]; NaN without a message."""
        return np.array([part.latency_us(percent, program) for part in self.parts])

    @property
    def warm(self) -> int:
        """Return the number of intervals of the warm-up: a sixth of the run, in whole rounds."""
        rounds = -(-len(self.parts) // (6 * self.per_round))
        return rounds * self.per_round

    def trend(self, column: Floats) -> tuple[float, float]:
        """Return the slope per hour after the warm-up, and its standard error; NaN if few."""
        at = self.samples['at']
        hours = (at[-len(column):] - at[0])[self.warm:] * 1e-9 / HOUR
        values = column[self.warm:]
        place = np.arange(len(values)) % self.per_round  # a round has a pattern
        design = np.column_stack([hours, place[:, np.newaxis] == np.arange(self.per_round)])
        free = len(values) - design.shape[1]
        if free < 1:
            return np.nan, np.nan
        found = np.linalg.lstsq(design, values, rcond=None)[0]
        variance = float(np.sum((values - design @ found)**2)) / free
        return float(found[0]), float(np.sqrt(variance * np.linalg.inv(design.T @ design)[0, 0]))


def memory_mb(pid: int) -> tuple[float, float]:
    """Return the resident memory of a process, and the part that it does not share [MB]."""
    lines = Path(f'/proc/{pid}/smaps_rollup').read_text().splitlines()[1:]
    kilobytes = {line.split(':')[0]: int(line.split()[1]) for line in lines}
    own = kilobytes['Private_Clean'] + kilobytes['Private_Dirty']
    return kilobytes['Rss'] * KILOBYTE, own * KILOBYTE


def take_sample(node: int, relay: int) -> dict[str, float]:
    """Return a sample of the node and the bare relay, and its time [ns]."""
    resident, own = memory_mb(node)
    worker = [memory_mb(child)[0] for child in children(node)]
    found = {'at': time.monotonic_ns(), 'node': resident, 'own': own,
             'worker': sum(worker) if worker else np.nan, 'relay': memory_mb(relay)[0],
             'cpu': cpu_seconds(node), 'bare': cpu_seconds(relay)}
    tell(*(f'{name} {found[name]:.2f} MB' for name in ('node', 'worker', 'relay')))
    return found


def run_rounds(rounds: int, seconds: float, interval: float, rate: float) -> LongRun:
    """Run rounds of so many seconds; an interval between samples divides them, a rate is in Hz."""
    per_round = round(seconds / interval)
    samples: list[dict[str, float]] = []
    answers: list[Answer] = []

    def during(node: int, relay: int) -> None:
        from std_msgs.msg import Bool
        caller, rests = Caller(), [0]

        def on_still(message: Any) -> None:
            rests[0] += message.data

        def call(name: str) -> None:
            if name in AT_REST:
                before = rests[0]
                caller.wait(time.monotonic() + 20.0, lambda: rests[0] > before)
                caller.wait(time.monotonic() + REST)
            called = time.monotonic()
            response = caller.call(name)
            answers.append(Answer(name, time.monotonic() - called, response))

        caller.node.create_subscription(Bool, 'calibrator/still', on_still, 10)
        caller.node.create_timer(interval, lambda: samples.append(take_sample(node, relay)))
        samples.append(take_sample(node, relay))
        began = time.monotonic()
        for k in range(rounds):
            starts, ends = began + k * seconds, began + (k + 1) * seconds
            for n, at in enumerate(np.arange(FIRST_CALL, seconds - CALL_EVERY, CALL_EVERY)):
                caller.wait(starts + at)
                call(CALLS[n % len(CALLS)])
            caller.wait(ends)
            if k < rounds - 1:
                call('reset')
        caller.wait(began + rounds * seconds + interval,
                    lambda: len(samples) > rounds * per_round)
        caller.close()

    trial: Trial = run_trial({
        CALIBRATED: node_command('passthrough:=true'),
        'bare/data_calibrated': client('relay', 'serialized', 'bare/data_calibrated')},
        rate, during)
    columns = {name: np.array([each[name] for each in samples[:rounds * per_round + 1]])
               for name in samples[0]}
    return LongRun(trial, per_round, columns, answers)


def trend_words(slope: float, error: float, unit: str) -> str:
    """Return a trend in words."""
    return 'too short for a trend' if np.isnan(slope) else f'{slope:+.2f} ± {error:.2f} {unit}'


def lines_of(run: LongRun) -> Iterator[Line]:
    lost, bare = (sum(part.lost(program) for part in run.parts) for program in (0, 1))
    answered = [each for each in run.answers if each.response.message]
    refused = sum(not each.response.success for each in answered)
    faults = sum(map(run.trial.log.count, ('Traceback', 'unexpected error')))
    yield check('messages lost', f'{lost} of {run.sent.sum():,} (bare relay: {bare})', lost,
                least=0, most=0)
    yield Line('calls answered', f'{len(answered)} of {len(run.answers)}', 1, 'all',
               len(answered) == len(run.answers))
    yield check('calls refused', f'{refused} of {len(answered)}', refused, least=0, most=0)
    yield check('tracebacks', f'{faults}', faults, least=0, most=0)
    for what, name in (('the node, resident', 'node'), ('the node, its own part', 'own'),
                       ('the worker process, resident', 'worker'),
                       ('the bare relay, resident', 'relay')):
        slope, error = run.trend(run.samples[name])
        warm, last = run.samples[name][[run.warm, -1]]
        yield check(f'memory of {what}', f'{warm:.1f} MB after the warm-up, {last:.1f} MB at the '
                    f'end, {trend_words(slope, error, "MB per hour")}', slope,
                    most=np.inf if name == 'relay' else 1.0, unit=' MB per hour',
                    sets=len(run.parts) + 1 - run.warm)
    p99, bare_p99 = (run.latency_us(program, 99) for program in (0, 1))
    for what, column, unit in (
            ('CPU time per message', run.cpu_us('cpu'), 'µs'),
            ('CPU time per message over that of the bare relay',
             run.cpu_us('cpu') / run.cpu_us('bare'), ''),
            ('latency p99', p99, 'µs'),
            ('latency p99 over that of the bare relay', p99 / bare_p99, ''),
            ('latency p99 of the bare relay', bare_p99, 'µs')):
        slope, error = run.trend(column)
        asked = column is not bare_p99
        middle = f'{np.median(column[run.warm:]):.2f} {unit}'.strip() if column[
            run.warm:].size else ''
        yield Line(what, f'{middle}, {trend_words(slope, error, f"{unit} per hour".strip())}',
                   len(column) - run.warm, 'not rising' if asked else '',
                   slope <= 2.0 * error if asked and not np.isnan(slope) else None)


def long_run(frame: Frame, minutes: float = 60.0, rate: float = 1000.0) -> Iterator[str]:
    rounds, seconds, interval = round(minutes / 5.0), 300.0, 60.0
    if minutes < 10.0:
        rounds = max(round(minutes), 1)
        seconds, interval = 60.0 * minutes / rounds, 6.0 * minutes / rounds
    run = run_rounds(rounds, seconds, interval, rate)
    for each in run.answers:
        if not each.response.success:
            tell(f'{each.name}: {each.response.message or "no answer"}')
    yield table(lines_of(run))
    called = {name: found for name in (*CALLS, 'reset') if (
        found := [each for each in run.answers if each.name == name])}
    yield markdown(('service', 'calls', 'failed', 'longest answer, s'), (
        (f'`~/{name}`', len(found), sum(not each.response.success for each in found),
         f'{max(each.seconds for each in found):.2f}') for name, found in called.items()))
    yield f'through poses at {rate:g} Hz'
    yield f'at the end of each round of {seconds:g} s'
    yield f'after a warm-up of {run.warm * interval / 60.0:g} min'
