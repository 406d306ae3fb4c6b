# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Drivers and calibrators that are killed: whether the other processes notice.

The benchmark itself does not use ROS: its processes are those of `nodes`, whose records it reads.

"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
import os
from pathlib import Path
import signal
import subprocess
from tempfile import TemporaryDirectory
import time

from figures import Frame, markdown, ROOT, tell
from nodes import (
    CALIBRATED, client, enter_domain, node_command, PATIENCE, prepare_driver, process, Record, say,
    wait_until)
import numpy as np

PARTIES = ('driver', 'calibrator', 'listener', 'caller')
RATE = 1000.0
"""Messages per second of the driver."""

LATEST, LATEST_END = 0.5, 1.5
"""Latest kill after the first message, or after the start, and latest end after a kill [s]."""

UDP = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
       'FASTRTPS_DEFAULT_PROFILES_FILE': str(ROOT / 'config' / 'fast_dds_udp.xml')}
LOCALHOST = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


@dataclass(frozen=True)
class Case:
    """What is killed, and how; `words` is the description for the table."""

    words: str
    victim: str = 'driver'
    starting: bool = False  # whether every second kill comes while it starts
    ends: bool = False  # whether the calibrator is ended by SIGTERM after each kill of the driver
    loops: int = 0  # number of busy loops beside
    udp: bool = False  # whether the processes use UDP without shared memory


CASES = {
    'driver': Case('the driver is killed'),
    'busy': Case('the same, beside 4 busy loops', loops=4),
    'starting': Case('the driver is killed, every second time while it starts', starting=True),
    'end': Case(f'the driver is killed, and the calibrator is ended up to {LATEST_END:g} s later',
                ends=True),
    'end-udp': Case('the same without shared memory', ends=True, udp=True),
    'calibrator': Case('the calibrator is killed, and started again', 'calibrator'),
    'calibrator-udp': Case('the same without shared memory', 'calibrator', udp=True)}


@dataclass(frozen=True)
class Trial:
    """One life of the victim."""

    seconds: float  # from its start to the first message that the listener received, or NaN
    sent: int  # messages that the driver sent, from the first one received
    heard: int  # messages that the listener received
    died: Mapping[str, int]  # exit statuses of those that ended by themselves, or not with 0
    silent: bool  # whether messages or an answer did not come within `PATIENCE`


class World:
    """The processes of a case that run, and their records."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self.log = folder / 'log'
        self.running: dict[str, subprocess.Popen[str]] = {}
        self.records: dict[str, Record] = {}

    def start(self, name: str) -> None:
        """Start one of the processes; a driver still waits for a line."""
        file = self._folder / f'{name}_{time.monotonic_ns()}'
        commands = {'listener': client('listen', file, CALIBRATED), 'caller': client('ask', file),
                    'calibrator': node_command('passthrough:=true')}
        self.records[name] = Record(file)
        self.running[name] = self._stack.enter_context(
            prepare_driver(RATE, file, self.log) if name == 'driver' else
            process(commands[name], self.log))

    def kill(self, name: str) -> None:
        """Kill a process."""
        if name in self.running:
            self.running[name].kill()
            self.running.pop(name).communicate()

    def end(self, after: float) -> dict[str, int]:
        """End the calibrator by SIGTERM; return its exit status if it is not 0."""
        time.sleep(after)
        calibrator = self.running.pop('calibrator')
        calibrator.send_signal(signal.SIGTERM)
        calibrator.communicate(timeout=PATIENCE)
        return {'calibrator': calibrator.returncode} if calibrator.returncode else {}

    def answer(self) -> bool:
        """Call the self-test of the calibrator; return whether it answers."""
        number = time.monotonic_ns()
        say(self.running['caller'], number)
        return self.wait(lambda: number in self.records['caller'].pairs())

    def died(self) -> dict[str, int]:
        """Return the exit statuses of the processes that have ended."""
        return {name: program.returncode for name, program in self.running.items()
                if program.poll() is not None}

    def wait(self, over: Callable[[], object]) -> bool:
        """Wait until a condition holds; return whether it does and no process has ended."""
        return wait_until(lambda: self.died() or over()) and not self.died()


def run_trial(world: World, case: Case, number: int, rng: np.random.Generator) -> Trial:
    """Start the victim, kill it, and look at the others."""
    missing = [name for name in PARTIES if name not in world.running or name in world.died()]
    if 'driver' in missing:
        world.start('driver')
    began = time.monotonic_ns()
    for name in missing:
        if name != 'driver':
            world.start(name)
    if 'driver' in missing:
        say(world.running['driver'])
    listened, silent = world.records['listener'], False
    before = len(listened)
    if not (case.starting and number % 2):
        silent = not world.wait(lambda: len(listened) > before)
    ends = time.monotonic() + rng.uniform(0.0, LATEST)
    world.wait(lambda: time.monotonic() > ends)
    died = world.died()
    world.kill(case.victim)
    if case.ends and not died:
        died |= world.end(rng.uniform(0.0, LATEST_END))
    elif case.victim == 'driver' and not died:
        silent |= not world.answer()
    died |= world.died()
    heard, sent = listened.pairs()[before:], world.records['driver'].pairs()[:, 0]
    if not len(heard):
        return Trial(np.nan, 0, 0, died, silent and not died)
    seconds = np.nan if case.starting and number % 2 else 1e-9 * (heard[0, 1] - began)
    return Trial(seconds, int(np.sum(sent >= heard[0, 0])), len(heard), died, silent and not died)


def run_case(case: Case, count: int, seed: int) -> Iterator[Trial]:
    """Yield the trials of a case; start again what has ended, or all if they are silent."""
    os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
    os.environ.update(UDP if case.udp else LOCALHOST)
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder, ExitStack() as stack:
        world = World(Path(folder), stack)
        enter_domain(Path(folder))
        for _ in range(case.loops):
            stack.enter_context(process(['-c', 'while True: 1'], world.log))
        for number in range(count):
            each = run_trial(world, case, number, rng)
            tell(f'{number + 1}: {each.seconds:.2f} s, {each.heard} of {each.sent}',
                 *(f'{name} {status_words(status)}' for name, status in each.died.items()),
                 'silent' * each.silent)
            for name in PARTIES if each.silent else ():
                world.kill(name)
            yield each


def status_words(status: int) -> str:
    """Return an exit status in words."""
    return signal.Signals(-status).name if status < 0 else f'status {status}'


def row_of(case: Case, found: list[Trial]) -> tuple[object, ...]:
    def ends_of(*names: str) -> str:
        every = [status_words(status) for each in found for name, status in each.died.items()
                 if name in names]
        return ', '.join(f'{every.count(words)} {words}' for words in sorted(set(every))) or '0'

    seconds = np.array([each.seconds for each in found])
    seconds = seconds[np.isfinite(seconds)]
    start = f'{np.median(seconds):.2f}, {seconds.max():.2f}' if len(seconds) else ''
    sent = sum(each.sent for each in found)
    lost = sent - sum(each.heard for each in found)
    return (case.words, len(found), ends_of('calibrator'), ends_of('driver', 'listener', 'caller'),
            sum(each.silent for each in found),
            f'{lost:,} of {sent:,}' if case.victim == 'driver' and not case.ends else '', start)


def driver_kills(frame: Frame, kills: int = 200, seed: int = 1,
                 cases: tuple[str, ...] = tuple(CASES)) -> Iterator[str]:
    """Yield the parts of the page; `kills` is the number of each case."""
    rows, loads = [], []
    for name in cases:
        rows.append(row_of(CASES[name], list(run_case(CASES[name], kills, seed))))
        loads.append(f'{os.getloadavg()[0]:.0f}')
    yield markdown(('', 'kills', 'ends of the calibrator', 'ends of the others', 'silent',
                    'messages lost', 'from the start to the first message, s: median, longest'),
                   rows)
    yield f'Load of the machine after each case: {", ".join(loads)}.'
