# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Drivers and calibrators that are killed: whether the other processes notice.

A driver publishes at 1 kHz, a calibrator corrects the messages, and a listener receives them and
calls the self-test. All are processes of their own. In each trial the driver, or the calibrator,
is started and killed by SIGKILL at a random time. The benchmark itself does not use ROS::

    python benchmarks/driver_kills.py --kills 200 --markdown docs/figures/driver_kills.md

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
import multiprocessing
import os
from pathlib import Path
import signal
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

import driver_kills_clients as clients  # noqa: E402
from figures import busy, machine, markdown, parser, publish  # noqa: E402
import numpy as np  # noqa: E402

PARTIES = ('driver', 'calibrator', 'listener')
RATE = 1000.0
"""Messages per second of the driver."""

PATIENCE = 60.0
"""Longest time until messages arrive, and until the self-test answers [s]."""

LATEST, LATEST_END = 0.5, 1.5
"""Latest kill after the first message, or after the start, and latest end after a kill [s]."""

UDP = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
       'FASTRTPS_DEFAULT_PROFILES_FILE': str(ROOT / 'config' / 'fast_dds_udp.xml')}
LOCALHOST = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


@dataclass(frozen=True)
class Case:
    """
    What is killed, and how.

    Parameters
    ----------
    words : str
        Description for the table.
    victim : str
        The process that is killed.
    starting : bool
        Whether every second kill comes while it starts.
    ends : bool
        Whether the calibrator is ended by SIGTERM after each kill of the driver.
    loops : int
        Number of busy loops beside.
    udp : bool
        Whether the processes use UDP without shared memory.

    """

    words: str
    victim: str = 'driver'
    starting: bool = False
    ends: bool = False
    loops: int = 0
    udp: bool = False


CASES = {
    'driver': Case('the driver is killed'),
    'busy': Case('the same, beside 4 busy loops', loops=4),
    'starting': Case('the driver is killed, every second time while it starts', starting=True),
    'end': Case(f'the driver is killed, and the calibrator is ended up to {LATEST_END:g} s later',
                ends=True),
    'end-udp': Case('the same without shared memory', ends=True, udp=True),
    'calibrator': Case('the calibrator is killed, and started again', 'calibrator'),
    'calibrator-udp': Case('the same without shared memory', 'calibrator', udp=True)}

_ABOUT = """\
Made by `python benchmarks/driver_kills.py --kills {kills} --markdown FILE`. A driver at
{rate:g} Hz, a calibrator and a listener are processes of their own. In each trial one of them is
started, and killed by SIGKILL up to {latest:g} s after the listener has received messages. The
others must live. After the kill of a driver, the self-test of the calibrator must answer. "Silent"
are the trials in which no messages arrived, or no answer, for {patience:g} s; then all processes
are started anew.

The transport is the default one, shared memory; without it, it is UDP with
`config/fast_dds_udp.xml`. {loads} Machine: {machine}."""


@dataclass(frozen=True)
class Trial:
    """
    One life of the victim.

    Parameters
    ----------
    seconds : float
        Time from its start to the first message that the listener received; NaN without one.
    sent, heard : int
        Messages that the driver sent, from the first one received, and that the listener
        received.
    died : dict
        Exit statuses of processes that ended by themselves, or not with status 0.
    silent : bool
        Whether messages or an answer did not come within `PATIENCE`.

    """

    seconds: float
    sent: int
    heard: int
    died: Mapping[str, int]
    silent: bool


class World:
    """
    The three processes.

    Parameters
    ----------
    folder : Path
        Folder of their logs.
    count : int
        Number of trials.

    """

    def __init__(self, folder: Path, count: int) -> None:
        # A server that has imported ROS starts driver and listener within 0.1 s.
        self._context = multiprocessing.get_context('forkserver')
        self._context.set_forkserver_preload(['driver_kills_clients'])
        self._folder = folder
        self.running: dict[str, Any] = {}
        self.trial = self._context.RawValue('i', 0)
        self.sent, self.heard, self.first = (self._context.RawArray('q', count) for _ in range(3))
        self.asked, self.answered = (self._context.RawValue('i', -1) for _ in range(2))

    def start(self, name: str) -> None:
        """Start one of the processes."""
        folder = self._folder / name
        folder.mkdir(exist_ok=True)
        if name == 'calibrator':
            with (folder / 'calibrator.log').open('ab') as log:
                self.running[name] = subprocess.Popen(
                    [sys.executable, '-X', 'faulthandler', '-m', 'accel_calib.ros.run',
                     'calibrator', '--ros-args', '-p', 'passthrough:=true'], cwd=folder,
                    stdout=log, stderr=log)
            return
        target: Any
        target, given = {
            'driver': (clients.drive, (self.trial, self.sent, RATE)),
            'listener': (clients.listen, (self.heard, self.first, self.asked, self.answered)),
        }[name]
        # The environment is given, because that of the server is the one of its start.
        process = self._context.Process(target=target, args=(folder, dict(os.environ), *given))
        process.start()
        self.running[name] = process

    def status(self, name: str) -> int | None:
        """Return the exit status of a process, or None."""
        process = self.running[name]
        found: int | None = (process.poll() if isinstance(process, subprocess.Popen)
                             else process.exitcode)
        return found

    def kill(self, name: str) -> None:
        """Kill a process."""
        process = self.running.pop(name, None)
        if process is not None:
            process.kill()
            (process.wait if isinstance(process, subprocess.Popen) else process.join)()

    def end(self, after: float) -> dict[str, int]:
        """End the calibrator by SIGTERM; return its exit status if it is not 0."""
        calibrator = self.running.pop('calibrator')
        time.sleep(after)
        calibrator.send_signal(signal.SIGTERM)
        status = calibrator.wait(PATIENCE)
        return {'calibrator': status} if status else {}

    def died(self) -> dict[str, int]:
        """Return the exit statuses of the processes that have ended."""
        found = {name: self.status(name) for name in self.running}
        return {name: status for name, status in found.items() if status is not None}

    def wait(self, over: Callable[[], bool]) -> bool:
        """Wait until a condition holds; return whether it does and no process has ended."""
        ends = time.monotonic() + PATIENCE
        while not over():
            if self.died() or time.monotonic() > ends:
                return False
            time.sleep(0.002)
        return True


def one(world: World, case: Case, number: int, rng: np.random.Generator) -> Trial:
    """Start the victim, kill it, and look at the others."""
    world.trial.value = number
    began, seconds, silent = time.monotonic(), np.nan, False
    world.start(case.victim)
    if not (case.starting and number % 2):
        silent = not world.wait(lambda: world.heard[number] > 0)
        seconds = np.nan if silent else time.monotonic() - began
    ends = time.monotonic() + rng.uniform(0.0, LATEST)
    world.wait(lambda: time.monotonic() > ends)
    died = world.died()
    world.kill(case.victim)
    if case.ends and not died:
        died |= world.end(rng.uniform(0.0, LATEST_END))
    elif case.victim == 'driver' and not died:
        world.asked.value = number
        silent |= not world.wait(lambda: world.answered.value == number)
    died |= world.died()
    sent = world.sent[number] - world.first[number] + 1 if world.heard[number] else 0
    return Trial(seconds, sent, world.heard[number], died, silent and not died)


def trials(world: World, case: Case, count: int, seed: int) -> Iterator[Trial]:
    """Yield one trial after the other; start again what has ended."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        for name in PARTIES:
            if name != case.victim and (name not in world.running
                                        or world.status(name) is not None):
                world.start(name)
        found = one(world, case, number, rng)
        if found.silent:
            for name in PARTIES:
                world.kill(name)
        yield found


def run(case: Case, count: int, seed: int, folder: Path | None) -> Iterator[Trial]:
    """Run the trials of a case."""
    os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
    os.environ.update(UDP if case.udp else LOCALHOST)
    with ExitStack() as stack:
        temporary = stack.enter_context(TemporaryDirectory())
        os.environ.update(ROS_HOME=temporary, ROS_LOG_DIR=temporary)
        stack.enter_context(busy(case.loops))
        world = World((folder or Path(temporary)).absolute(), count)
        for name in PARTIES:
            stack.callback(world.kill, name)
        for number, each in enumerate(trials(world, case, count, seed), 1):
            print(f'{number}: {each.seconds:.2f} s, {each.heard} of {each.sent}',
                  *(f'{name} {words_of(status)}' for name, status in each.died.items()),
                  'silent' * each.silent, file=sys.stderr, flush=True)
            yield each


def words_of(status: int) -> str:
    """Return an exit status in words."""
    return signal.Signals(-status).name if status < 0 else f'status {status}'


def row_of(case: Case, found: list[Trial]) -> tuple[object, ...]:
    """Return the row of the table."""
    def ended(names: tuple[str, ...]) -> str:
        every = [words_of(status) for each in found for name, status in each.died.items()
                 if name in names]
        return ', '.join(f'{every.count(words)} {words}' for words in sorted(set(every))) or '0'

    seconds = np.array([each.seconds for each in found])
    seconds = seconds[np.isfinite(seconds)]
    start = f'{np.median(seconds):.2f}, {seconds.max():.2f}' if len(seconds) else ''
    sent = sum(each.sent for each in found)
    lost = sent - sum(each.heard for each in found)
    arrived = f'{lost:,} of {sent:,}' if case.victim == 'driver' and not case.ends else ''
    return (case.words, len(found), ended(('calibrator',)), ended(('driver', 'listener')),
            sum(each.silent for each in found), arrived, start)


def main() -> int:
    """Run the benchmark."""
    options = parser(__doc__, seed=1)
    options.add_argument('--cases', nargs='+', choices=list(CASES), default=list(CASES))
    options.add_argument('--kills', type=int, default=200, help='kills of each case')
    options.add_argument('--folder', type=Path, help='keep the logs of the processes here')
    given = options.parse_args()
    before = machine()
    os.environ.update(ROS_DOMAIN_ID=str(os.getpid() % 101 + 1), PYTHONPATH=os.pathsep.join(
        [str(ROOT), str(ROOT / 'benchmarks')]))
    rows, loads = [], []
    for name in given.cases:
        found = list(run(CASES[name], given.kills, given.seed, given.folder))
        loads.append(f'{os.getloadavg()[0]:.0f}')
        rows.append(row_of(CASES[name], found))
        print(*rows[-1], sep=', ', file=sys.stderr, flush=True)
    about = _ABOUT.format(
        kills=given.kills, rate=RATE, latest=LATEST, patience=PATIENCE, machine=before,
        loads=f'Load of the machine after each case: {", ".join(loads)}.')
    heads = ('', 'kills', 'ends of the calibrator', 'ends of the others', 'silent',
             'messages lost', 'from the start to the first message, s: median, longest')
    publish(f'# Figures of processes that are killed\n\n{about}\n\n{markdown(heads, rows)}\n',
            given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
