# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
An hour of the node at 1 kHz: messages lost, memory, CPU time and latency, minute by minute.

A caller uses the services all the time. At the end of each round it resets the node, and the next
round begins without poses and without a calibration.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
import time
from typing import Any

from figures import Frame, Line, markdown, table, tell
from nodes import Caller, cpu_seconds, node_command, relay_command, run_trial, Stamps, Trial
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

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


@dataclass(frozen=True)
class Answer:
    """The answer of a service, and the time that it took [s]; without words none came."""

    name: str
    seconds: float
    success: bool
    words: str


@dataclass(frozen=True)
class LongRun:
    """The measurements of a run."""

    edges: Stamps  # (n + 1,) times of the samples [ns]
    per_round: int  # number of intervals of a round
    # (n + 1,) each: resident memory of the node, the part of it that no other process shares
    # (own), resident memory of its worker and of the bare relay [MB]; CPU time of the node
    # without its worker (cpu), and of the bare relay (bare) [s].
    samples: dict[str, Floats]
    sent: Stamps  # (m,) stamps of the messages of the driver [ns]
    ours: Stamps  # (k, 2) stamp and arrival of the messages of the node [ns],
    bare: Stamps  # and of the bare relay
    answers: list[Answer]  # of the services
    log: str  # what the node printed

    def count(self, stamps: Stamps) -> NDArray[np.int64]:
        """Return the number of different stamps in each interval."""
        return np.histogram(np.unique(stamps), self.edges)[0]

    def lost(self, heard: Stamps) -> NDArray[np.int64]:
        """Return the number of messages in each interval that did not arrive."""
        return self.count(self.sent[~np.isin(self.sent, heard[:, 0])])

    def cpu_us(self, name: str) -> Floats:
        """Return the CPU time per message in each interval [µs]."""
        return np.diff(self.samples[name]) * 1e6 / self.count(self.sent)

    def latency_us(self, heard: Stamps, percent: float) -> Floats:
        """Return a percentile of the latency in each interval [µs]; NaN without a message."""
        each = np.digitize(heard[:, 0], self.edges) - 1
        late = (heard[:, 1] - heard[:, 0]) * 1e-3
        return np.array([np.percentile(late[each == k], percent) if np.any(each == k) else np.nan
                         for k in range(len(self.edges) - 1)])

    @property
    def warm(self) -> int:
        """Return the number of intervals of the warm-up: a sixth of the run, in whole rounds."""
        rounds = -(-(len(self.edges) - 1) // (6 * self.per_round))
        return rounds * self.per_round

    def trend(self, column: Floats) -> tuple[float, float]:
        """
        Return the slope per hour of a figure after the warm-up, and its standard error.

        The figure also has a pattern of the period of a round. Both are NaN if the values are too
        few for a standard error.

        """
        hours = (self.edges[-len(column):] - self.edges[0])[self.warm:] * 1e-9 / HOUR
        values = column[self.warm:]
        place = np.arange(len(values)) % self.per_round
        design = np.column_stack([hours, place[:, np.newaxis] == np.arange(self.per_round)])
        free = len(values) - design.shape[1]
        if free < 1:
            return np.nan, np.nan
        found = np.linalg.lstsq(design, values, rcond=None)[0]
        variance = float(np.sum((values - design @ found)**2)) / free
        return float(found[0]), float(np.sqrt(variance * np.linalg.inv(design.T @ design)[0, 0]))

    def called(self, name: str) -> list[Answer]:
        """Return the answers of a service."""
        return [each for each in self.answers if each.name == name]


def memory_mb(pid: int) -> tuple[float, float]:
    """Return the resident memory of a process, and the part that it does not share [MB]."""
    lines = Path(f'/proc/{pid}/smaps_rollup').read_text().splitlines()[1:]
    kilobytes = {line.split(':')[0]: int(line.split()[1]) for line in lines}
    own = kilobytes['Private_Clean'] + kilobytes['Private_Dirty']
    return kilobytes['Rss'] * KILOBYTE, own * KILOBYTE


def take_sample(node: int, relay: int) -> dict[str, float]:
    """Return a sample of the node and the bare relay, and its time [ns]."""
    resident, own = memory_mb(node)
    tasks = Path(f'/proc/{node}/task').glob('*/children')
    worker = [memory_mb(int(child))[0] for task in tasks for child in task.read_text().split()]
    found = {'at': time.monotonic_ns(), 'node': resident, 'own': own,
             'worker': sum(worker) if worker else np.nan, 'relay': memory_mb(relay)[0],
             'cpu': cpu_seconds(node), 'bare': cpu_seconds(relay)}
    tell(*(f'{name} {found[name]:.2f} MB' for name in ('node', 'worker', 'relay')))
    return found


def run_rounds(rounds: int, seconds: float, interval: float, rate: float) -> LongRun:
    """
    Run the node for some rounds.

    Parameters
    ----------
    rounds : int
        Number of rounds.
    seconds, interval : float
        Time of a round, and between samples, of which a round has a whole number [s].
    rate : float
        Messages per second.

    """
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
            found = caller.call(name)
            answers.append(Answer(name, time.monotonic() - called, found.success, found.message))

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
        'imu/data_calibrated': node_command('passthrough:=true'),
        'bare/data_calibrated': relay_command('serialized', 'bare/data_calibrated')},
        rate, during)
    columns = {name: np.array([each[name] for each in samples[:rounds * per_round + 1]])
               for name in samples[0]}
    ours, bare = trial.heard
    return LongRun(columns['at'], per_round, columns, trial.sent, ours, bare, answers, trial.log)


def trend_words(slope: float, error: float, unit: str) -> str:
    """Return a trend in words."""
    return 'too short for a trend' if np.isnan(slope) else f'{slope:+.2f} ± {error:.2f} {unit}'


def lines_of(run: LongRun) -> Iterator[Line]:
    lost, bare = run.lost(run.ours).sum(), run.lost(run.bare).sum()
    answered = [each for each in run.answers if each.words]
    refused = sum(not each.success for each in answered)
    faults = run.log.count('Traceback') + run.log.count('unexpected error')
    yield Line('messages lost', f'{lost} of {run.count(run.sent).sum():,} (bare relay: {bare})', 1,
               '0', lost == 0)
    yield Line('calls answered', f'{len(answered)} of {len(run.answers)}', 1, 'all',
               len(answered) == len(run.answers))
    yield Line('calls refused', f'{refused} of {len(answered)}', 1, '0', refused == 0)
    yield Line('tracebacks', f'{faults}', 1, '0', faults == 0)
    for what, name in (('the node, resident', 'node'), ('the node, its own part', 'own'),
                       ('the worker process, resident', 'worker'),
                       ('the bare relay, resident', 'relay')):
        slope, error = run.trend(run.samples[name])
        warm, last = run.samples[name][[run.warm, -1]]
        asked = name != 'relay'
        yield Line(f'memory of {what}', f'{warm:.1f} MB after the warm-up, {last:.1f} MB at the '
                   f'end, {trend_words(slope, error, "MB per hour")}', len(run.edges) - run.warm,
                   '< 1 MB per hour' if asked else '',
                   slope < 1.0 if asked and not np.isnan(slope) else None)
    p99, bare_p99 = (run.latency_us(each, 99) for each in (run.ours, run.bare))
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


def intervals_of(run: LongRun) -> str:
    """Return a table with one line per interval."""
    heads = ('to, min', 'sent', 'received', 'lost', 'node, MB', 'own part, MB', 'worker, MB',
             'CPU, µs', 'p50, µs', 'p99, µs', 'bare CPU, µs', 'bare p50, µs', 'bare p99, µs')
    columns = [(run.edges[1:] - run.edges[0]) * 1e-9 / 60.0, run.count(run.sent),
               run.count(run.ours[:, 0]), run.lost(run.ours),
               *(run.samples[name][1:] for name in ('node', 'own', 'worker')),
               run.cpu_us('cpu'), run.latency_us(run.ours, 50), run.latency_us(run.ours, 99),
               run.cpu_us('bare'), run.latency_us(run.bare, 50), run.latency_us(run.bare, 99)]
    forms = ['{:.1f}', *3 * ['{:d}'], *3 * ['{:.1f}'], *6 * ['{:.0f}']]
    return markdown(heads, ([form.format(value) for form, value in zip(forms, row)]
                            for row in zip(*columns, strict=True)))


def long_run(frame: Frame, minutes: float = 60.0, rate: float = 1000.0) -> Iterator[str]:
    rounds, seconds, interval = round(minutes / 5.0), 300.0, 60.0
    if minutes < 10.0:
        rounds = max(round(minutes), 1)
        seconds, interval = 60.0 * minutes / rounds, 6.0 * minutes / rounds
    run = run_rounds(rounds, seconds, interval, rate)
    for each in run.answers:
        if not each.success:
            tell(f'{each.name}: {each.words or "no answer"}')
    yield table(lines_of(run))
    called = {name: found for name in (*CALLS, 'reset') if (found := run.called(name))}
    yield markdown(('service', 'calls', 'failed', 'longest answer, s'), (
        (f'`~/{name}`', len(found), sum(not each.success for each in found),
         f'{max(each.seconds for each in found):.2f}') for name, found in called.items()))
    yield intervals_of(run)
    yield f'through poses at {rate:g} Hz'
    yield f'at the end of each round of {seconds:g} s'
    yield f'after a warm-up of {run.warm * interval / 60.0:g} min'
