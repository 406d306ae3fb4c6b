# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The cost of the live page for the Imu path at 1 kHz: CPU and latency of the node.

The node runs without a page, with a page that nobody watches, and with two viewers that take all
messages::

    python benchmarks/live_page.py --markdown docs/figures/live_page.md

"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import socket
import subprocess
import sys
import time

from figures import Line, machine, parser, publish, table
from imu_path import cpu, median, quantile, ratio, stored
from imu_trial import node, Trial, trial

RATE = 1000.0
VIEWERS = 2

_CASES = ('off', 'none', 'two')
_WORDS = {'off': 'no page', 'none': 'page without viewers', 'two': 'page with two viewers'}
_LONGEST_WAIT = 10.0
_WATCH = '--watch'

_ABOUT = """\
Made by `python benchmarks/live_page.py {command}--markdown FILE`. A driver, the node with a
levelled 10-parameter calibration and a user share the cores with the viewers, which are one more
process. The cases take turns; ratios are medians over the turns.

Machine: {machine}."""


def run(turns: int, seconds: float) -> dict[str, list[Trial]]:
    """Return the trials of each case."""
    trials: dict[str, list[Trial]] = {case: [] for case in _CASES}
    with stored() as (linear, _):
        for _ in range(turns):
            for case in _CASES:
                port = free_port()
                command = node(linear, *([] if case == 'off' else [f'web_port:={port}']))
                trials[case].append(trial(command, RATE, during(case, port, seconds)))
    return trials


def free_port() -> int:
    """Return a port that no program uses."""
    with socket.create_server(('127.0.0.1', 0)) as probe:
        return int(probe.getsockname()[1])


def during(case: str, port: int, seconds: float) -> Callable[[], None]:
    """Return the function that is called during a measurement."""
    def idle() -> None:
        time.sleep(seconds)

    def watched() -> None:
        with viewers(port):
            time.sleep(seconds)

    return watched if case == 'two' else idle


@contextmanager
def viewers(port: int) -> Iterator[None]:
    """Run the viewers as a process; fail if they have not taken messages all the time."""
    began = time.monotonic()
    running = subprocess.Popen([sys.executable, __file__, _WATCH, str(port)], text=True,
                               stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    yield
    seconds = time.monotonic() - began
    counts = [int(count) for count in running.communicate()[0].split()]
    assert len(counts) == VIEWERS, counts
    assert min(counts) > 10.0 * (seconds - 2.0), counts


async def watch(port: int) -> list[int]:
    """Take all messages until standard input is closed; return their number for each viewer."""
    import aiohttp
    over = asyncio.Event()
    asyncio.get_running_loop().add_reader(sys.stdin, over.set)

    async def view(client: aiohttp.ClientSession) -> int:
        count = 0
        async with client.ws_connect(f'http://127.0.0.1:{port}/stream', max_msg_size=0) as stream:
            await stream.send_json({'hello': {'token': '', 'seen': 0}})
            while not over.is_set():
                await stream.receive_str(timeout=_LONGEST_WAIT)
                count += 1
        return count

    async with aiohttp.ClientSession() as client:
        return list(await asyncio.gather(*(view(client) for _ in range(VIEWERS))))


def lines(trials: dict[str, list[Trial]]) -> list[Line]:
    """Return the lines of the table."""
    turns, found = len(trials['off']), []
    for case in _CASES:
        of = trials[case]
        found.append(Line(
            f'{_WORDS[case]}: CPU per message; latency p50 and p99; messages lost',
            f'{median(of, cpu):.0f} µs; {median(of, quantile(50)):.0f} and '
            f'{median(of, quantile(99)):.0f} µs; {sum(each.lost for each in of)}',
            '', turns, None))
    for case, before in (('two', 'none'), ('two', 'off')):
        for name, limit, of_trial in (('CPU', 1.1, cpu),
                                      ('p99', 1.3, quantile(99))):
            over = ratio(trials, of_trial, case, before)
            found.append(Line(f'{name} of {_WORDS[case]}, over {_WORDS[before]}', f'{over:.2f}',
                              f'≤ {limit}', turns, over <= limit))
    return found


def main() -> None:
    """Print the table, or write it to a file."""
    options = parser(__doc__, turns=7, seconds=20.0)
    options.add_argument(_WATCH, type=int, metavar='PORT', help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.watch is not None:
        print(*asyncio.run(watch(given.watch)))
        return
    command = ''.join(f'--{name} {getattr(given, name):g} ' for name in ('turns', 'seconds')
                      if getattr(given, name) != options.get_default(name))
    about = _ABOUT.format(command=command, machine=machine())
    made = table(lines(run(given.turns, given.seconds)))
    publish(f'# Figures of the live page\n\n{about}\n\n{made}\n', given.markdown)


if __name__ == '__main__':
    main()
