# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Memory of the commands over the length of a recording.

Each command runs in a process of its own on recordings of several lengths. The largest resident
memory of the process is that of the kernel (`os.wait4`). The recordings have 100 samples per
second; the sensor rests for 4 s and turns for 1 s, so the number of poses grows with the length::

    python benchmarks/memory.py --markdown docs/figures/memory.md

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import os
from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

import accel_calib as ac  # noqa: E402
from figures import Line, machine, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402

MILLION = 1_000_000
RATE_HZ = 100
_CYCLE_S = 500
"""The readings repeat after this time; the stamps go on."""

_MOST_RISE_MB = 50.0
COMMANDS = {'capture': ('{log}', '-o', '{folder}/poses.csv'),
            'apply': ('{log}', '-c', '{folder}/c.yaml', '-o', '{folder}/corrected{suffix}'),
            'calibrate': ('{log}', '-o', '{folder}/new.yaml', '--no-refine'),
            'noise': ('{log}',)}
_FLAT = ('capture', 'apply')

ABOUT = """# Memory over the length of a recording

Made by `python benchmarks/memory.py {command} --markdown FILE`. The largest resident memory of the
whole process, with Python, numpy and scipy, on CSV recordings at 100 samples per second. The
sensor rests for 4 s and turns for 1 s, so that a million samples have 2,000 poses. `noise` runs on
a recording without turns.

Machine: {machine}."""


def readings(seed: int, still: bool) -> list[str]:
    """Return the readings of a cycle as the ends of lines."""
    made = ac.simulate({'offset': [0.02, -0.01, 0.03]}, recording=True, poses=_CYCLE_S // 5,
                       rate=RATE_HZ, dwell=4.0, turn=1.0, seed=seed)
    values = made.reading[:_CYCLE_S * RATE_HZ]
    if still:
        noise = np.random.default_rng(seed).normal(0.0, 0.02, values.shape)
        values = np.array([0.1, -0.2, 9.8]) + noise
    return [f',{x:.5f},{y:.5f},{z:.5f}\n' for x, y, z in values.tolist()]


def write_csv(path: Path, count: int, ends: Sequence[str]) -> None:
    """Write a recording of `count` samples."""
    with path.open('w', encoding='ascii') as file:
        file.write('time,ax,ay,az\n')
        for start in range(0, count, len(ends)):
            file.writelines(f'{k / RATE_HZ:.2f}{end}' for k, end in
                            zip(range(start, min(start + len(ends), count)), ends))


def peak(command: Sequence[str]) -> float:
    """Run a command of the command line, and return its largest resident memory [MB]."""
    with subprocess.Popen([sys.executable, '-m', 'accel_calib.cli.main', *command], cwd=ROOT,
                          stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1):
        raise RuntimeError(f'{" ".join(command)}: exit status {process.returncode}')
    return usage.ru_maxrss * 1024 / 1e6


def peaks(commands: Sequence[str], sizes: Sequence[int], seed: int, folder: Path
          ) -> Iterator[tuple[str, int, float]]:
    """Yield command, number of samples and largest memory [MB]."""
    poses = ac.simulate({'offset': [0.02, -0.01, 0.03]}, poses=24, seed=seed)
    ac.fit(poses).save(folder / 'c.yaml')
    for size in sizes:
        for still in (False, True):
            log = folder / 'log.csv'
            asked = [name for name in commands if still == (name == 'noise')]
            if asked:
                write_csv(log, size, readings(seed, still))
            for name in asked:
                words = [word.format(log=log, folder=folder, suffix=log.suffix)
                         for word in COMMANDS[name]]
                yield name, size, peak([name, *words])


def lines_of(found: Sequence[tuple[str, int, float]]) -> Iterator[Line]:
    """Yield the lines of the table, and the slope between the last two lengths."""
    for name in dict.fromkeys(each[0] for each in found):
        own = [(size, memory) for command, size, memory in found if command == name]
        for size, memory in own:
            yield Line(f'{name}, {size:,} samples, MB', f'{memory:.0f}', '', 1, None)
        if len(own) > 1:
            (short, before), (long, after) = own[-2:]
            slope = (after - before) / (long - short) * MILLION
            flat = name in _FLAT
            yield Line(f'{name}, MB per million samples from {short:,} to {long:,}',
                       f'{slope:.1f}', f'{_MOST_RISE_MB:.0f} MB in all' if flat else '', 1,
                       after - before < _MOST_RISE_MB if flat else None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, seed=1)
    options.add_argument('--commands', nargs='+', choices=list(COMMANDS), default=list(COMMANDS))
    options.add_argument('--millions', nargs='+', type=float, default=[1, 3, 10],
                         help='samples, in millions, ascending')
    given = options.parse_args(arguments)
    before, found = machine(), []
    with TemporaryDirectory() as name:
        sizes = [round(each * MILLION) for each in given.millions]
        for each in peaks(given.commands, sizes, given.seed, Path(name)):
            found.append(each)
            print(*each, file=sys.stderr, flush=True)
    millions = ' '.join(f'{each:g}' for each in given.millions)
    about = ABOUT.format(command=f'--millions {millions} --seed {given.seed}', machine=before)
    publish(f'{about}\n\n{table(list(lines_of(found)))}\n', given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
