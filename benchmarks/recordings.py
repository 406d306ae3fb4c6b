# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Rates of reading recordings, of finding their poses and of correcting them; duration of commands.

Each measurement is a fresh process, one at a time; those that are compared take turns::

    python benchmarks/recordings.py --markdown docs/figures/recordings.md

The bags have an Imu at 1 kHz that is turned through 36 poses, and other topics. They take 1.3 GB
each in a temporary folder, where 4 GB must be free.

"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import redirect_stdout
from importlib.metadata import version
import os
from pathlib import Path
import shutil
from statistics import median
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1', PYTHONPATH=str(ROOT))

from accel_calib.cli.main import main as accel_calib  # noqa: E402
from accel_calib.effects import model_with, simulate_recording  # noqa: E402
from accel_calib.geometry import spread_directions  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, machine, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import get_typestore, Stores  # noqa: E402
from trial import trial  # noqa: E402

FULL = 3_600_000
"""Messages of a bag: an hour at 1 kHz."""

MESSAGE_BYTES = 324
XSENS = ROOT.parent / 'shared' / 'data' / 'xsens_mti_counts.csv'

_PAGE = """\
# Figures of recordings

Made by `python benchmarks/recordings.py {command}`. Figures are medians over the repeats
(sets); processes that are compared take turns. A rate is that of the whole work: opening the bag,
reading it, and finding poses or writing the corrected copy. The rate of rosbags excludes the
opening. Memory is bounded if ten times the messages take less than 3 % of their bytes more.

Machine: {machine}.

{lines}
"""

RATE_HZ = 1000
_POSES = 36
_RATE, _FORCE = slice(-192, -168), slice(-96, -72)  # bytes of a serialized Imu
_EFFECTS = {'offset': np.array([0.02, -0.03, 0.01]), 'axis_gain': np.array([0.01, -0.02, 0.015]),
            'cross_axis': np.array([0.004, -0.002, 0.003])}


def serialized(count: int, seed: int) -> NDArray[np.uint8]:
    """Return `count` serialized Imu messages, one row per message."""
    turn = 2.0
    recording = simulate_recording(
        model_with(_EFFECTS), spread_directions(_POSES), np.random.default_rng(seed),
        rate_hz=RATE_HZ, turn=turn, dwell=(count / RATE_HZ + turn) / _POSES - turn)
    count = min(count, len(recording))
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    vector, zero = types['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0), np.zeros(9)
    message = types['sensor_msgs/msg/Imu'](
        types['std_msgs/msg/Header'](types['builtin_interfaces/msg/Time'](0, 0), 'imu_link'),
        types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0), zero, vector, zero, vector,
        zero)
    one = np.frombuffer(store.serialize_cdr(message, 'sensor_msgs/msg/Imu'), np.uint8)
    rows = np.tile(one, (count, 1))
    number = np.arange(count)
    stamps = np.column_stack([number // RATE_HZ, number % RATE_HZ * (10 ** 9 // RATE_HZ)])
    rows[:, 4:12] = stamps.astype('<u4').view(np.uint8)
    rows[:, _RATE] = np.ascontiguousarray(recording['rate'][:count]).view(np.uint8)
    force = units_of('m/s2').from_g(recording.reading[:count])
    rows[:, _FORCE] = np.ascontiguousarray(force).view(np.uint8)
    return rows


def write_bag(path: Path, storage: str, rows: NDArray[np.uint8]) -> Path:
    """Write the messages, with a temperature and a string ten times a second."""
    store = get_typestore(Stores.ROS2_JAZZY)
    header = store.types['std_msgs/msg/Header']
    stamp = store.types['builtin_interfaces/msg/Time']
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        imu, warm, words = (writer.add_connection(*each, typestore=store) for each in (
            ('/imu', 'sensor_msgs/msg/Imu'), ('/temperature', 'sensor_msgs/msg/Temperature'),
            ('/words', 'std_msgs/msg/String')))
        for k, row in enumerate(rows):
            time = k * (10 ** 9 // RATE_HZ)
            writer.write(imu, time, row.tobytes())
            if k % 100 == 0:
                seconds = stamp(k // RATE_HZ, time % 10 ** 9)
                writer.write(warm, time, store.serialize_cdr(store.types[
                    'sensor_msgs/msg/Temperature'](header(seconds, 'imu_link'), 25.0, 0.0),
                    'sensor_msgs/msg/Temperature'))
                writer.write(words, time, store.serialize_cdr(
                    store.types['std_msgs/msg/String'](f'word {k}'), 'std_msgs/msg/String'))
    return path


def table_lines() -> list[Line]:
    """Time the Xsens recording, from the file to poses and fit."""
    if not XSENS.exists():
        return [Line(f'Xsens: not measured, {XSENS} is missing', '', '', 0, None)]
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
    """Time a bag; measure the memory for it and for a bag of a tenth of its length."""
    rows = serialized(count, seed=2031)
    bag = write_bag(folder / storage, storage, rows)
    tenth = write_bag(folder / f'{storage}_tenth', storage, rows[:len(rows) // 10])
    del rows
    out = folder / 'out'
    found: dict[str, list[dict[str, Any]]] = {}
    for _ in range(repeats):
        for what in ('deserialize', 'read', 'poses', 'apply'):
            files = (bag, out, calibration) if what == 'apply' else (bag,)
            found.setdefault(what, []).append(trial(what, *files))
            shutil.rmtree(out, ignore_errors=True)
    small = {'poses': trial('poses', tenth)['megabytes'],
             'apply': trial('apply', tenth, out, calibration)['megabytes']}
    for path in (bag, tenth, out):
        shutil.rmtree(path, ignore_errors=True)
    rate = {what: median(x['result'] / x['seconds'] for x in each)
            for what, each in found.items()}
    busy = {what: median(1e6 * x['cpu'] / x['result'] for x in each)
            for what, each in found.items()}
    times = {what: rate[what] / rate['deserialize'] for what in ('read', 'poses')}
    memory = {what: max(x['megabytes'] for x in found[what]) for what in small}
    allowed = 0.03 * 0.9e-6 * count * MESSAGE_BYTES
    name = f'{storage}, {count:,} messages'
    return [
        *(Line(f'{name}: rate of {words}, times that of rosbags deserializing each message',
               f'{times[what]:.1f} × ({_thousands(rate[what])} and '
               f'{_thousands(rate["deserialize"])} per second)', f'≥ {least:g} ×', repeats,
               times[what] >= least)
          for what, words, least in (('poses', 'reading and finding poses', 5.0),
                                     ('read', 'reading', 4.0))),
        Line(f'{name}: rate of apply', f'{_thousands(rate["apply"])} per second', '≥ 300,000',
             repeats, rate['apply'] >= 300_000),
        Line(f'{name}: CPU per message, deserializing / poses / apply',
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, messages=FULL, repeats=3)
    options.add_argument('--quick', action='store_true', help='200,000 messages, once')
    options.add_argument('--temporary', type=Path, help='parent of the temporary folder')
    given = options.parse_args(arguments)
    count, repeats = (200_000, 1) if given.quick else (given.messages, given.repeats)
    before = f'{machine()}, rosbags {version("rosbags")}'
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
    command = ' '.join(sys.argv[1:] if arguments is None else arguments)
    publish(_PAGE.format(command=command, machine=before, lines=table(lines)), given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
