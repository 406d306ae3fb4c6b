# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How fast recordings are read, searched for poses and corrected, and how soon commands answer.

Every measurement is a process of its own, one at a time; those that are compared take turns::

    python benchmarks/recordings.py --markdown docs/figures/recordings.md

The bags, of 1.3 GB each, are made in a temporary folder, where 4 GB must be free.

"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import redirect_stdout
from importlib.metadata import version
import json
import os
from pathlib import Path
import platform
import shutil
from statistics import median
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(ROOT)]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1', PYTHONPATH=str(ROOT))

from accel_calib.cli.main import main as accel_calib  # noqa: E402
from figures import Line, publish, table  # noqa: E402
import numpy as np  # noqa: E402
from recordings_bags import serialized, write_bag  # noqa: E402

FULL = 3_600_000
MESSAGE_BYTES = 324
XSENS = ROOT.parent / 'shared' / 'data' / 'xsens_mti_counts.csv'


def trial(what: str, *arguments: object) -> dict[str, Any]:
    """Run one measurement in a process of its own."""
    done = subprocess.run([sys.executable, HERE / 'recordings_trial.py', what,
                           *map(str, arguments)], capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    print(what, arguments[0], found if what != 'table' else '', file=sys.stderr, flush=True)
    return found


def table_lines() -> list[Line]:
    """Time the Xsens recording: table in, poses and fit out."""
    if not XSENS.exists():
        return []
    spent = trial('table', XSENS)['result']
    total = [sum(parts) for parts in zip(*spent.values(), strict=True)]
    warm = median(total[1:])
    parts = ', '.join(f'{name} {1e3 * median(times[1:]):.0f}' for name, times in spent.items())
    return [Line('Xsens, 51,175 samples, CSV to poses and model 10, in process (imu_tk: 320 ms)',
                 f'{1e3 * warm:.0f} ms ({parts})', '≤ 100 ms', len(total) - 1, warm <= 0.1),
            Line('the same for the first time, imports included', f'{1e3 * total[0]:.0f} ms', '',
                 1, None)]


def bag_lines(folder: Path, storage: str, count: int, repeats: int, calibration: Path
              ) -> list[Line]:
    """Time a bag, and look at the memory for it and for one of a tenth of its length."""
    rows = serialized(count, seed=2031)
    bag = write_bag(folder / storage, storage, rows)
    tenth = write_bag(folder / f'{storage}_tenth', storage, rows[:len(rows) // 10])
    del rows
    out = folder / 'out'
    found: dict[str, list[dict[str, Any]]] = {}
    for _ in range(repeats):
        for what in ('deserialize', 'read', 'poses', 'apply'):
            found.setdefault(what, []).append(trial(what, bag, out, calibration))
            shutil.rmtree(out, ignore_errors=True)
    small = {what: trial(what, tenth, out, calibration)['megabytes']
             for what in ('poses', 'apply')}
    for path in (bag, tenth, out):
        shutil.rmtree(path, ignore_errors=True)
    rate = {what: median(x['result'] / x['seconds'] for x in each)
            for what, each in found.items()}
    busy = {what: median(1e6 * x['cpu'] / x['result'] for x in each)
            for what, each in found.items()}
    times = rate['poses'] / rate['deserialize']
    memory = {what: max(x['megabytes'] for x in found[what]) for what in small}
    allowed = 0.03 * 0.9e-6 * count * MESSAGE_BYTES
    name = f'{storage}, {count:,} messages'
    return [
        Line(f'{name}: to poses, over rosbags deserializing each',
             f'{times:.1f} × ({_thousands(rate["poses"])} over '
             f'{_thousands(rate["deserialize"])} a second)', '≥ 5 ×', repeats, times >= 5.0),
        Line(f'{name}: read alone', f'{_thousands(rate["read"])} a second', '', repeats, None),
        Line(f'{name}: apply', f'{_thousands(rate["apply"])} a second', '≥ 300,000', repeats,
             rate['apply'] >= 300_000),
        Line(f'{name}: CPU a message, deserializing / poses / apply',
             f'{busy["deserialize"]:.2f} / {busy["poses"]:.2f} / {busy["apply"]:.2f} µs', '',
             repeats, None),
        *(Line(f'{name}: largest memory of {what}, with imports',
               f'{memory[what]:.0f} MB ({small[what]:.0f} MB for a tenth of them)', 'bounded',
               repeats, None if count < FULL else memory[what] - small[what] < allowed)
          for what in small)]


def _thousands(rate: float) -> str:
    return f'{1000 * round(rate / 1000):,}'


def command_lines(folder: Path, poses: Path, repeats: int) -> list[Line]:
    """Time whole commands."""
    lines = []
    for what, asked, arguments in (
            ('`accel-calib --help`', 0.25, ['--help']),
            ('`accel-calib fit` of 12 poses', 0.8, ['fit', poses, '-o', folder / 'again.yaml'])):
        spent = []
        for _ in range(repeats):
            begin = time.perf_counter()
            subprocess.run([sys.executable, '-m', 'accel_calib.cli.main', *map(str, arguments)],
                           stdout=subprocess.DEVNULL, check=True)
            spent.append(time.perf_counter() - begin)
        lines.append(Line(f'{what}, whole process', f'{median(spent):.2f} s', f'≤ {asked} s',
                          repeats, median(spent) <= asked))
    return lines


def machine() -> str:
    """Say what this was measured on, and how busy it was."""
    try:
        text = Path('/proc/cpuinfo').read_text(encoding='utf-8')
        name = next(line.split(':')[1].strip() for line in text.splitlines()
                    if line.startswith('model name'))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return (f'{name}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before; Python '
            f'{platform.python_version()}, numpy {np.__version__}, rosbags {version("rosbags")}')


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split('\n')[0])
    parser.add_argument('--messages', type=int, default=FULL)
    parser.add_argument('--repeats', type=int, default=3)
    parser.add_argument('--quick', action='store_true', help='200,000 messages, once')
    parser.add_argument('--temporary', type=Path, help='where to make the folder for the bags')
    parser.add_argument('--markdown', type=Path, help='write the table to this file')
    given = parser.parse_args(arguments)
    count, repeats = (200_000, 1) if given.quick else (given.messages, given.repeats)
    before = machine()
    with TemporaryDirectory(dir=given.temporary) as name:
        folder = Path(name)
        poses, calibration = folder / 'poses.csv', folder / 'calibration.yaml'
        with redirect_stdout(sys.stderr):
            accel_calib(['simulate', '-o', str(poses), '--poses', '12', '--effect', 'offset=0.02'])
            accel_calib(['fit', str(poses), '-o', str(calibration), '--model', '10'])
        lines = command_lines(folder, poses, 11 * repeats)
        lines += table_lines()
        for storage in ('mcap', 'sqlite3'):
            lines += bag_lines(folder, storage, count, repeats, calibration)
    text = _page(table(lines), before, arguments)
    publish(text, given.markdown)
    return 0


def _page(lines: str, before: str, arguments: Sequence[str] | None) -> str:
    given = ' '.join(sys.argv[1:] if arguments is None else arguments)
    return (f'# Figures of recordings\n\nMade by `python benchmarks/recordings.py {given}`. '
            'Medians over the repeats\n(sets); processes that are compared take turns. A rate '
            'is that of the whole work: opening the bag,\nreading, poses, or writing the '
            'corrected copy; of rosbags it is that of the messages alone. Memory is\nbounded '
            'where ten times the messages take less than 3 % of their bytes more.\n\n'
            f'Machine: {before}.\n\n{lines}\n')


if __name__ == '__main__':
    sys.exit(main())
