# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How often the demonstration succeeds, and how long it takes.

Each turn runs `accel-calib demo` as a user does. Busy loops compete for the processors, and one of
its processes after the other is stopped for a while, as by a machine that hangs::

    python benchmarks/demo.py --turns 20 --loops 8
    python benchmarks/demo.py --turns 20 --loops 8 --stop 2
    python benchmarks/demo.py --turns 5 --hidden temperature

"""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parents[1]

from figures import busy, Line, machine, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402

BETWEEN = 1.0
"""Time in which all processes run, between two stops [s]."""

ABOUT = """# The demonstration, on a busy machine

Made by `python benchmarks/demo.py {command} --markdown FILE`.
{loops} busy loops ran beside each turn; one process after the other was stopped for {stop:g} s.

Machine: {machine}."""


def family(parent: int) -> list[int]:
    """Return the id of a process and of those that it has started."""
    found = [parent]
    for pid in found:
        with contextlib.suppress(OSError):  # it has ended meanwhile
            children = Path(f'/proc/{pid}/task/{pid}/children').read_text()
            found += [int(child) for child in children.split()]
    return found


def stopped_in_turn(process: subprocess.Popen[bytes], seconds: float) -> int:
    """Stop one process after the other until the command ends; return the number of stops."""
    stops = 0
    while process.poll() is None:
        pids = family(process.pid)
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.kill(pids[stops % len(pids)], signal.SIGSTOP)
            time.sleep(seconds)
            os.kill(pids[stops % len(pids)], signal.SIGCONT)
        stops += 1
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(BETWEEN)
    return stops


def turn(hidden: str, stop: float) -> tuple[int, float, int, dict[str, float]]:
    """Return the exit status, the duration [s], the number of stops, and the outcome."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / 'result.json'
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, '-m', 'accel_calib.cli.main', 'demo', '--json', str(result),
             *(['--hidden', hidden] if hidden else [])], stdout=subprocess.DEVNULL)
        try:
            stops = stopped_in_turn(process, stop) if stop else 0
            status = process.wait(600)
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait()
        took = time.monotonic() - began
        return status, took, stops, json.loads(result.read_text()) if result.exists() else {}


def main() -> None:
    """Run the turns and print the figures."""
    options = parser(__doc__, turns=20, loops=0)
    options.add_argument('--stop', type=float, default=0.0, help='duration of a stop [s]')
    options.add_argument('--hidden', default='')
    args = options.parse_args()
    before, rows = machine(), []
    with busy(args.loops):
        for number in range(args.turns):
            rows.append(turn(args.hidden, args.stop))
            print(f'turn {number + 1}: exit status {rows[-1][0]} after {rows[-1][1]:.1f} s, '
                  f'{rows[-1][2]} stops', file=sys.stderr, flush=True)
    good = [row for row in rows if row[0] == 0]
    times = np.array([row[1] for row in good] or [np.nan])
    errors = np.array([row[3]['vector_after_mg'] for row in good] or [np.nan])
    sets = len(rows)
    lines = [Line('turns that succeed', str(len(good)), str(sets), sets, len(good) == sets),
             Line('stops in all', str(sum(row[2] for row in rows)), '', sets, None),
             Line('median duration [s]', f'{np.median(times):.1f}', '', sets, None),
             Line('longest duration [s]', f'{np.max(times):.1f}', '', sets, None),
             Line('error of imu/data_calibrated, median [mg]', f'{np.median(errors):.2f}', '',
                  sets, None),
             Line('largest [mg]', f'{np.max(errors):.2f}', '', sets, None)]
    command = f'--turns {args.turns} --loops {args.loops} --stop {args.stop:g}'
    about = ABOUT.format(command=command, loops=args.loops, stop=args.stop,
                         machine=before)
    publish(f'{about}\n\n{table(lines)}\n', args.markdown)
    sys.exit(len(good) != len(rows))


if __name__ == '__main__':
    main()
