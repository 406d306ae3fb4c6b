# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
An hour of the node at 1 kHz: messages lost, memory, CPU time and latency, minute by minute.

A driver publishes a sensor that is turned and rests, so that the node captures poses. A caller
uses the services all the time. At the end of each round it resets the node, and the next round
begins without poses and without a calibration. A bare relay of the same messages shows what other
programs on the machine do to the latency::

    python benchmarks/long_run.py --markdown docs/figures/long_run.md

A trend compares each minute with the same minute of the other rounds, because a round has a
pattern of its own: memory and CPU time depend on the number of poses and on the calibration.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
import os
from pathlib import Path
from select import select
import signal
import subprocess
import sys
import tempfile
from threading import Event, Thread
import time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

from figures import Line, machine, markdown, parser, publish, table  # noqa: E402
from imu_trial import cpu_seconds, end, first_of, process, SETTLE  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

CLIENTS = str(ROOT / 'benchmarks' / 'long_run_clients.py')
Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

CALLS = ('fit', 'refine', 'undo', 'save', 'load', 'capture_pose', 'set_level')
"""Services that are called in turn; the last two wait for the next rest of the sensor."""

AT_REST = ('capture_pose', 'set_level')
FIRST_CALL, CALL_EVERY = 35.0, 5.0
"""Time from the start of a round to its first call, with 14 poses then, and between calls [s]."""

REST = 0.7
"""Time from the message on ~/still to a call at rest [s]: the rest is then longer than 1 s."""

START = 30.0
"""Longest time until messages arrive [s]."""

HOUR = 3600.0
KILOBYTE = 1.024e-3
"""Unit of the memory in /proc [MB]."""

_ABOUT = """\
Made by `python benchmarks/long_run.py --minutes {minutes:g} --markdown FILE`. A sensor is turned
through poses at {rate:g} Hz, and the node captures each of them. Every {every:g} s one of these
services is called: {calls}. `~/reset` is called
at the end of each round of {round:g} s. Raw messages are published while there is no calibration
(`passthrough`).

Medians and trends are of the time after a warm-up of {warm:g} min. A trend compares each minute
with the same minute of the other rounds, and ± is its standard error. Resident memory contains
pages that processes share. The worker is the process that fits and refines. A bare relay of the
same messages runs beside the node: its figures show what other programs on the machine do.

Machine: {machine}."""


@dataclass(frozen=True)
class Sample:
    """
    One look at the processes.

    Parameters
    ----------
    node, own, worker, relay : float
        Resident memory of the node; the part of it that no other process shares; resident memory
        of its worker process and of the bare relay [MB].
    cpu, bare : float
        CPU time of the node without its worker process, and of the bare relay [s].

    """

    node: float
    own: float
    worker: float
    relay: float
    cpu: float
    bare: float


@dataclass(frozen=True)
class Answer:
    """The answer of a service, and the time that it took [s]; without words none came."""

    name: str
    seconds: float
    success: bool
    words: str


@dataclass(frozen=True)
class LongRun:
    """
    The measurements of a run.

    Parameters
    ----------
    edges : (n + 1,) array
        Times of the samples [ns].
    per_round : int
        Number of intervals of a round.
    samples : list of Sample
        The samples.
    sent : (m,) array
        Stamps of the messages of the driver [ns].
    ours, bare : (k, 2) array
        Stamp and arrival of the messages of the node and of the bare relay [ns].
    answers : list of Answer
        The answers of the services.
    log : str
        What the node printed.

    """

    edges: Stamps
    per_round: int
    samples: list[Sample]
    sent: Stamps
    ours: Stamps
    bare: Stamps
    answers: list[Answer]
    log: str

    def column(self, name: str) -> Floats:
        """Return a figure of all samples."""
        return np.array([getattr(each, name) for each in self.samples])

    def count(self, stamps: Stamps) -> NDArray[np.int64]:
        """Return the number of different stamps in each interval."""
        return np.histogram(np.unique(stamps), self.edges)[0]

    def lost(self, heard: Stamps) -> NDArray[np.int64]:
        """Return the number of messages in each interval that did not arrive."""
        return self.count(self.sent[~np.isin(self.sent, heard[:, 0])])

    def cpu_us(self, name: str) -> Floats:
        """Return the CPU time per message in each interval [µs]."""
        return np.diff(self.column(name)) * 1e6 / self.count(self.sent)

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

    def grown(self, name: str) -> float:
        """Return the growth of a memory from the end of the warm-up to the end of the run [MB]."""
        column = self.column(name)
        return float(column[-1] - column[self.warm])

    def trend(self, column: Floats) -> tuple[float, float]:
        """Return the slope per hour of a figure after the warm-up, and its standard error."""
        hours = (self.edges[-len(column):] - self.edges[0]) * 1e-9 / HOUR
        return trend(hours[self.warm:], column[self.warm:], self.per_round)

    def called(self, name: str) -> list[Answer]:
        """Return the answers of a service."""
        return [each for each in self.answers if each.name == name]


def trend(times: Floats, values: Floats, period: int) -> tuple[float, float]:
    """
    Return the slope of values that also have a pattern of this period, and its standard error.

    Both are NaN if the values are too few for a standard error.

    """
    phases = np.arange(len(values)) % period == np.arange(period)[:, np.newaxis]
    design = np.column_stack([times, phases.T])
    free = len(values) - design.shape[1]
    if free < 1:
        return np.nan, np.nan
    found = np.linalg.lstsq(design, values, rcond=None)[0]
    variance = float(np.sum((values - design @ found)**2)) / free
    return float(found[0]), float(np.sqrt(variance * np.linalg.inv(design.T @ design)[0, 0]))


# The processes


def children(pid: int) -> list[int]:
    """Return the ids of the processes that a process started."""
    tasks = Path(f'/proc/{pid}/task').glob('*/children')
    return [int(child) for task in tasks for child in task.read_text().split()]


def memory(pid: int) -> tuple[float, float]:
    """Return the resident memory of a process, and the part that it does not share [MB]."""
    lines = Path(f'/proc/{pid}/smaps_rollup').read_text().splitlines()[1:]
    kilobytes = {line.split(':')[0]: int(line.split()[1]) for line in lines}
    own = kilobytes['Private_Clean'] + kilobytes['Private_Dirty']
    return kilobytes['Rss'] * KILOBYTE, own * KILOBYTE


def look(node: int, bare: int) -> Sample:
    """Return a sample of the node and the bare relay."""
    resident, own = memory(node)
    worker = [memory(pid)[0] for pid in children(node)]
    return Sample(resident, own, sum(worker) if worker else np.nan, memory(bare)[0],
                  cpu_seconds(node), cpu_seconds(bare))


@contextmanager
def calibrator(environment: dict[str, str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the node, and write what it prints to a file."""
    command = [sys.executable, '-m', 'accel_calib.ros.run', 'calibrator', '--ros-args', '-p',
               'passthrough:=true']
    with log.open('wb') as printed:
        running = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=printed,
                                   stderr=printed)
        try:
            yield running
        finally:
            running.send_signal(signal.SIGTERM)
            running.wait(timeout=60)


def wait_for(user: subprocess.Popen[str], node: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until messages of the node and of the relay arrive; raise RuntimeError if not."""
    assert user.stdout is not None
    if not select([user.stdout], [], [], START)[0] or node.poll() is not None:
        raise RuntimeError(f'no corrected messages after {START:g} s: '
                           f'{log.read_text(encoding="utf-8")}')
    first_of(user)


class Caller:
    """
    A user who calls the services of the node.

    Parameters
    ----------
    domain : int
        DDS domain.

    """

    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from std_msgs.msg import Bool
        self.answers: list[Answer] = []
        self._rests = 0
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._node = rclpy.create_node('caller', context=self._context, enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._clients: dict[str, Any] = {}
        self._node.create_subscription(Bool, 'calibrator/still', self._on_still, 10)

    def _on_still(self, message: Any) -> None:
        self._rests += message.data

    def wait(self, until: float) -> None:
        """Wait until a time of the monotonic clock [s]."""
        while (left := until - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def call(self, name: str) -> None:
        """Call a service, some of them at the next rest of the sensor."""
        from std_srvs.srv import Trigger
        if name in AT_REST:
            self._wait_for_rest()
        if name not in self._clients:
            self._clients[name] = self._node.create_client(Trigger, f'calibrator/{name}')
            self._clients[name].wait_for_service(10.0)
        began = time.monotonic()
        future = self._clients[name].call_async(Trigger.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=120.0)
        found = future.result() if future.done() else Trigger.Response()
        self.answers.append(Answer(name, time.monotonic() - began, found.success, found.message))

    def _wait_for_rest(self) -> None:
        rests, latest = self._rests, time.monotonic() + 20.0
        while self._rests == rests and time.monotonic() < latest:
            self._executor.spin_once(timeout_sec=0.1)
        self.wait(time.monotonic() + REST)

    def close(self) -> None:
        """Leave DDS."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


def call_in_rounds(caller: Caller, began: float, seconds: float, rounds: int) -> None:
    """Call the services in turn, and reset the node at the end of each round but the last."""
    for k in range(rounds):
        starts, ends = began + k * seconds, began + (k + 1) * seconds
        for n, at in enumerate(np.arange(FIRST_CALL, seconds - CALL_EVERY, CALL_EVERY)):
            if starts + at < ends:
                caller.wait(starts + at)
                caller.call(CALLS[n % len(CALLS)])
        caller.wait(ends)
        if k < rounds - 1:
            caller.call('reset')


def sampled(take: Callable[[], Sample], began: float, interval: float, count: int,
            over: Event) -> Iterator[tuple[int, Sample]]:
    """Yield samples and their times [ns], until there are enough or the run is over."""
    for k in range(count + 1):
        if over.wait(max(began + k * interval - time.monotonic(), 0.0)):
            return
        sample = take()
        print(f'{k * interval:6.0f} s: node {sample.node:.2f} MB, worker {sample.worker:.2f} MB, '
              f'relay {sample.relay:.2f} MB', file=sys.stderr, flush=True)
        yield time.monotonic_ns(), sample


def long_run(rounds: int, seconds: float, interval: float, rate: float = 1000.0, *,
             domain: int | None = None) -> LongRun:
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
    domain : int, optional
        DDS domain; by default that of the process id.

    """
    domain = os.getpid() % 101 + 1 if domain is None else domain
    per_round = round(seconds / interval)
    with tempfile.TemporaryDirectory() as given, ExitStack() as stack:
        folder = Path(given)
        environment = {**os.environ, 'ROS_DOMAIN_ID': str(domain), 'PYTHONPATH': str(ROOT),
                       'ROS_LOG_DIR': given, 'ROS_HOME': given}
        environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        caller = Caller(domain)
        stack.callback(caller.close)
        sent, heard, log = folder / 'sent.npy', folder / 'heard.npz', folder / 'node.log'
        user = stack.enter_context(process([CLIENTS, 'listen', '--file', str(heard)],
                                           environment))
        bare = stack.enter_context(process([CLIENTS, 'relay'], environment))
        node = stack.enter_context(calibrator(environment, log))
        driver = stack.enter_context(process(
            [CLIENTS, 'drive', f'--rate={rate}', '--file', str(sent)], environment))
        wait_for(user, node, log)
        began, over = time.monotonic() + SETTLE, Event()
        taken: list[tuple[int, Sample]] = []
        sampler = Thread(target=lambda: taken.extend(sampled(
            lambda: look(node.pid, bare.pid), began, interval, rounds * per_round, over)))
        sampler.start()
        try:
            call_in_rounds(caller, began, seconds, rounds)
            sampler.join()
        finally:
            over.set()
            sampler.join()
        end(driver)
        time.sleep(1.0)
        end(user)
        stack.close()  # the end of the node is in its log
        arrived = np.load(heard)
        return LongRun(np.array([at for at, _ in taken]), per_round, [each for _, each in taken],
                       np.load(sent), arrived['ours'], arrived['bare'], caller.answers,
                       log.read_text(encoding='utf-8'))


# The page


def words_of(slope: float, error: float, unit: str) -> str:
    """Return a trend in words."""
    return 'too short for a trend' if np.isnan(slope) else f'{slope:+.2f} ± {error:.2f} {unit}'


def memory_line(run: LongRun, what: str, name: str, *, asked: bool = True) -> Line:
    """Return the line of a memory."""
    slope, error = run.trend(run.column(name))
    met = None if np.isnan(slope) or not asked else slope < 1.0
    warm, last = run.column(name)[[run.warm, -1]]
    return Line(f'memory of {what}', f'{warm:.1f} MB after the warm-up, {last:.1f} MB at the end, '
                f'{words_of(slope, error, "MB per hour")}', '< 1 MB per hour' if asked else '',
                len(run.samples) - run.warm, met)


def steady_line(run: LongRun, what: str, column: Floats, unit: str, *, asked: bool = True
                ) -> Line:
    """Return the line of a figure that should not rise."""
    slope, error = run.trend(column)
    met = None if np.isnan(slope) or not asked else slope <= 2.0 * error
    middle = f'{np.median(column[run.warm:]):.2f} {unit}'.strip() if column[run.warm:].size else ''
    return Line(what, f'{middle}, {words_of(slope, error, f"{unit} per hour".strip())}',
                'not rising' if asked else '', len(column) - run.warm, met)


def lines_of(run: LongRun) -> list[Line]:
    """Return the lines of the table."""
    lost, bare = run.lost(run.ours).sum(), run.lost(run.bare).sum()
    answered = [each for each in run.answers if each.words]
    refused = [each for each in answered if not each.success]
    p99, bare_p99 = (run.latency_us(each, 99) for each in (run.ours, run.bare))
    faults = run.log.count('Traceback') + run.log.count('unexpected error')
    count = run.count(run.sent).sum()
    return [
        Line('messages lost', f'{lost} of {count:,} (bare relay: {bare})', '0', 1, lost == 0),
        Line('calls answered', f'{len(answered)} of {len(run.answers)}', 'all', 1,
             len(answered) == len(run.answers)),
        Line('calls refused', f'{len(refused)} of {len(answered)}', '0', 1, not refused),
        Line('tracebacks', f'{faults}', '0', 1, faults == 0),
        memory_line(run, 'the node, resident', 'node'),
        memory_line(run, 'the node, its own part', 'own'),
        memory_line(run, 'the worker process, resident', 'worker'),
        memory_line(run, 'the bare relay, resident', 'relay', asked=False),
        steady_line(run, 'CPU time per message', run.cpu_us('cpu'), 'µs'),
        steady_line(run, 'CPU time per message over that of the bare relay',
                    run.cpu_us('cpu') / run.cpu_us('bare'), ''),
        steady_line(run, 'latency p99', p99, 'µs'),
        steady_line(run, 'latency p99 over that of the bare relay', p99 / bare_p99, ''),
        steady_line(run, 'latency p99 of the bare relay', bare_p99, 'µs', asked=False)]


def calls_of(run: LongRun) -> str:
    """Return a table of the calls."""
    called = {name: found for name in (*CALLS, 'reset') if (found := run.called(name))}
    return markdown(('service', 'calls', 'failed', 'longest answer, s'), (
        (f'`~/{name}`', len(found), sum(not each.success for each in found),
         f'{max(each.seconds for each in found):.2f}') for name, found in called.items()))


def intervals_of(run: LongRun) -> str:
    """Return a table with one line per interval."""
    heads = ('to, min', 'sent', 'received', 'lost', 'node, MB', 'own part, MB', 'worker, MB',
             'CPU, µs', 'p50, µs', 'p99, µs', 'bare CPU, µs', 'bare p50, µs', 'bare p99, µs')
    heard, ends = run.ours, (run.edges[1:] - run.edges[0]) * 1e-9 / 60.0
    columns = [run.count(run.sent), run.count(heard[:, 0]), run.lost(heard),
               run.column('node')[1:], run.column('own')[1:], run.column('worker')[1:],
               run.cpu_us('cpu'), run.latency_us(heard, 50), run.latency_us(heard, 99),
               run.cpu_us('bare'), run.latency_us(run.bare, 50), run.latency_us(run.bare, 99)]
    forms = ['{:.1f}', *3 * ['{:d}'], *3 * ['{:.1f}'], *6 * ['{:.0f}']]
    return markdown(heads, ([form.format(value) for form, value in zip(forms, row)]
                            for row in zip(ends, *columns, strict=True)))


def plan(minutes: float) -> tuple[int, float, float]:
    """Return the number of rounds, their time, and the interval of the samples [s]."""
    if minutes >= 10.0:
        return round(minutes / 5.0), 300.0, 60.0
    rounds = max(round(minutes), 1)
    return rounds, 60.0 * minutes / rounds, 6.0 * minutes / rounds


def main() -> int:
    """Run the benchmark."""
    options = parser(__doc__, minutes=60.0)
    options.add_argument('--rate', type=float, default=1000.0, help='messages per second')
    given = options.parse_args()
    before = machine()
    rounds, seconds, interval = plan(given.minutes)
    run = long_run(rounds, seconds, interval, given.rate)
    for each in run.answers:
        if not each.success:
            print(f'{each.name}: {each.words or "no answer"}', file=sys.stderr)
    about = _ABOUT.format(minutes=given.minutes, rate=given.rate, every=CALL_EVERY,
                          calls=', '.join(f'`~/{name}`' for name in CALLS), round=seconds,
                          warm=run.warm * interval / 60.0, machine=before)
    publish(f'# Figures of a long run\n\n{about}\n\n{table(lines_of(run))}\n\n{calls_of(run)}\n\n'
            f'{intervals_of(run)}\n', given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
