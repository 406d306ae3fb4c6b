# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Rates of reading and correcting recordings, durations and memory of commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from importlib.metadata import version
from itertools import islice
from pathlib import Path
import shutil
from statistics import median
import subprocess
import sys
from tempfile import TemporaryDirectory
import time

import accel_calib as ac
from accel_calib.calibration import fit_poses
from accel_calib.cli.main import main as accel_calib
from accel_calib.effects import model_with, simulate_recording
from accel_calib.geometry import spread_directions
from accel_calib.logs import open_log, read_recording
from accel_calib.messages import correct_bag
from accel_calib.stillness import capture
from accel_calib.stored import read_calibration
from accel_calib.units import units_of
from bag_files import write_bag
from figures import DATA, Frame, Line, measure_alone, Measured, ROOT, table, tell
import numpy as np
from rosbags.highlevel import AnyReader

FULL = 3_600_000
"""Messages of a bag: an hour at 1 kHz."""

MESSAGE_BYTES = 324
RATE_HZ = 1000
POSES = 36
DESERIALIZED = 400_000
"""Messages that `rosbags` deserializes, at most."""

XSENS = DATA / 'xsens_mti_counts.csv'
EFFECTS = {'offset': np.array([0.02, -0.03, 0.01]), 'axis_gain': np.array([0.01, -0.02, 0.015]),
           'cross_axis': np.array([0.004, -0.002, 0.003])}


# --------------------------------------------------------- work of a process: of the parts of bags

def deserialize(bag: Path) -> Callable[[], int]:
    """Deserialize messages one by one through `rosbags`; opening the bag is not timed."""
    reader = AnyReader([bag])
    reader.open()
    wanted = [c for c in reader.connections if c.topic == '/imu']

    def work() -> int:
        count = 0
        for connection, _, raw in islice(reader.messages(wanted), DESERIALIZED):
            reader.deserialize(raw, connection.msgtype)
            count += 1
        return count

    return work


def read(bag: Path) -> Callable[[], int]:
    """Read the samples of a bag, and nothing else."""
    def work() -> int:
        with open_log(bag) as stream:
            return sum(len(block) for block in stream.blocks)

    return work


def poses(bag: Path) -> Callable[[], int]:
    """Find the poses of a bag."""
    def work() -> int:
        with open_log(bag) as stream:
            found = capture(stream.blocks, units_of('m/s2'))
        if len(found.poses) == 0:
            raise RuntimeError('no poses')
        return found.recorded

    return work


def apply(bag: Path, out: Path, calibration: Path) -> Callable[[], int]:
    """Write a corrected copy of a bag."""
    return lambda: correct_bag(bag, read_calibration(calibration), out)


def calibrate(csv: Path) -> Callable[[], list[list[float]]]:
    """Time reading, poses and fit of a recording in counts, 11 times; the first is a warm-up."""
    def work() -> list[list[float]]:
        units, spent = units_of('native'), []
        for _ in range(11):
            marks = [time.perf_counter()]
            recording = read_recording(csv)
            marks.append(time.perf_counter())
            found = capture(recording, units)
            marks.append(time.perf_counter())
            fit_poses(found.poses, units, model='10')
            spent.append(np.diff([*marks, time.perf_counter()]).tolist())
        return spent

    return work


# ------------------------------------------------------------------------------------- recordings

def lines_of_commands(folder: Path, table_: Path, repeats: int) -> Iterator[Line]:
    """Yield the times of whole commands, and of the Xsens recording from the file to the fit."""
    for what, asked, arguments in (
            ('`accel-calib --help`', 0.25, ['--help']),
            ('`accel-calib fit` of 12 poses', 0.8, ['fit', table_, '-o', folder / 'again.yaml'])):
        spent = []
        for _ in range(repeats):
            begin = time.perf_counter()
            subprocess.run([sys.executable, '-m', 'accel_calib.cli.main', *map(str, arguments)],
                           stdout=subprocess.DEVNULL, check=True)
            spent.append(time.perf_counter() - begin)
        yield Line(f'{what}, whole process', f'{median(spent):.2f} s', repeats, f'≤ {asked} s',
                   median(spent) <= asked)
    if not XSENS.exists():
        yield Line(f'Xsens: not measured, {XSENS} is missing', '', 0)
        return
    first, *turns = measure_alone(calibrate, XSENS).result
    warm = median(map(sum, turns))
    parts = ', '.join(f'{name} {1e3 * median(each):.0f}'
                      for name, each in zip(('read', 'poses', 'fit'), zip(*turns)))
    yield Line('Xsens, 51,175 samples, CSV to poses and model 10, in process (imu_tk: 320 ms)',
               f'{1e3 * warm:.0f} ms ({parts})', len(turns), '≤ 100 ms', warm <= 0.1)
    yield Line('the same for the first time, imports included', f'{1e3 * sum(first):.0f} ms')


def lines_of_bag(folder: Path, storage: str, count: int, repeats: int, calibration: Path
                 ) -> Iterator[Line]:
    """Yield the rates of a bag, and the memory beside that for a bag of a tenth of its length."""
    turn = 2.0
    recording = simulate_recording(
        model_with(EFFECTS), spread_directions(POSES), np.random.default_rng(2031),
        rate_hz=RATE_HZ, turn=turn, dwell=(count / RATE_HZ + turn) / POSES - turn).take(
            slice(count))
    count = len(recording)
    recording = recording.with_columns(temperature=np.full(count, 25.0))
    bag = write_bag(folder / storage, storage, recording, ['/imu'])
    tenth = write_bag(folder / f'{storage}_tenth', storage, recording.take(slice(count // 10)),
                      ['/imu'])
    del recording
    out = folder / 'out'
    found: dict[str, list[Measured]] = {}
    for _ in range(repeats):
        for work in (deserialize, read, poses, apply):
            more = (out, calibration) if work is apply else ()
            found.setdefault(work.__name__, []).append(measure_alone(work, bag, *more))
            shutil.rmtree(out, ignore_errors=True)
    small = {'poses': measure_alone(poses, tenth).megabytes,
             'apply': measure_alone(apply, tenth, out, calibration).megabytes}
    for path in (bag, tenth, out):
        shutil.rmtree(path, ignore_errors=True)
    rate = {what: median(x.result / x.seconds for x in each) for what, each in found.items()}
    busy = {what: median(1e6 * x.cpu / x.result for x in each) for what, each in found.items()}
    name, plain = f'{storage}, {count:,} messages', thousands(rate['deserialize'])
    for what, words, least in (('poses', 'reading and finding poses', 5.0),
                               ('read', 'reading', 4.0)):
        times = rate[what] / rate['deserialize']
        yield Line(f'{name}: rate of {words}, times that of rosbags deserializing each message',
                   f'{times:.1f} × ({thousands(rate[what])} and {plain} per second)', repeats,
                   f'≥ {least:g} ×', times >= least)
    yield Line(f'{name}: rate of apply', f'{thousands(rate["apply"])} per second', repeats,
               '≥ 300,000', rate['apply'] >= 300_000)
    yield Line(f'{name}: CPU per message, deserializing / poses / apply',
               f'{busy["deserialize"]:.2f} / {busy["poses"]:.2f} / {busy["apply"]:.2f} µs',
               repeats)
    for what, before in small.items():
        largest = max(each.megabytes for each in found[what])
        rise = 0.03 * 0.9e-6 * count * MESSAGE_BYTES
        yield Line(f'{name}: largest memory of {what}, with imports',
                   f'{largest:.0f} MB ({before:.0f} MB for a tenth of them)', repeats, 'bounded',
                   None if count < FULL else largest - before < rise)


def thousands(rate: float) -> str:
    """Return a rate as text, rounded to thousands."""
    return f'{1000 * round(rate / 1000):,}'


def recordings(frame: Frame, messages: int = FULL, repeats: int = 3, temporary: str = ''
               ) -> Iterator[str]:
    """
    Yield the page of recordings.

    The bags have an Imu at 1 kHz that is turned through 36 poses, and other topics. They take 1.3
    GB each in a folder below `temporary`, where 4 GB must be free.

    """
    with TemporaryDirectory(dir=temporary or None) as name:
        folder = Path(name)
        table_, calibration = folder / 'poses.csv', folder / 'calibration.yaml'
        with redirect_stdout(sys.stderr):
            accel_calib(['simulate', '-o', str(table_), '--poses', '12', '--effect',
                         'offset=0.02'])
            accel_calib(['fit', str(table_), '-o', str(calibration), '--model', '10'])
        lines = list(lines_of_commands(folder, table_, 11 * repeats))
        for storage in ('mcap', 'sqlite3'):
            lines += lines_of_bag(folder, storage, messages, repeats, calibration)
    yield f'rosbags {version("rosbags")}'
    yield table(lines)


# ----------------------------------------------------------------------------------------- memory

MILLION = 1_000_000
CSV_HZ = 100
CYCLE_S = 500
"""The readings of a CSV recording repeat after this time; the stamps go on."""

MOST_RISE_MB = 50.0
FLAT = ('capture', 'apply')
COMMANDS = {'capture': ('{log}', '-o', '{folder}/poses.csv'),
            'apply': ('{log}', '-c', '{folder}/c.yaml', '-o', '{folder}/corrected.csv'),
            'calibrate': ('{log}', '-o', '{folder}/new.yaml', '--no-refine'),
            'noise': ('{log}',)}
WITH_MEMORY = """\
import sys
from accel_calib.cli.main import main
status = main()
print(open('/proc/self/status').read(), file=sys.stderr)
sys.exit(status)
"""
"""A command that prints the figures of its process; `getrusage` would include its parent."""


def write_csv(path: Path, count: int, still: bool, seed: int) -> None:
    """Write a recording of `count` samples, still or with turns."""
    made = ac.simulate({'offset': [0.02, -0.01, 0.03]}, recording=True, poses=CYCLE_S // 5,
                       rate=CSV_HZ, dwell=4.0, turn=1.0, seed=seed)
    values = made.reading[:CYCLE_S * CSV_HZ]
    if still:
        noise = np.random.default_rng(seed).normal(0.0, 0.02, values.shape)
        values = np.array([0.1, -0.2, 9.8]) + noise
    ends = [f',{x:.5f},{y:.5f},{z:.5f}\n' for x, y, z in values.tolist()]
    with path.open('w', encoding='ascii') as file:
        file.write('time,ax,ay,az\n')
        file.writelines(f'{k / CSV_HZ:.2f}{ends[k % len(ends)]}' for k in range(count))


def largest_of(command: list[str]) -> float:
    """Run a command of the command line, and return its largest resident memory [MB]."""
    done = subprocess.run([sys.executable, '-c', WITH_MEMORY, *command], cwd=ROOT, text=True,
                          stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(f'{" ".join(command)}: exit status {done.returncode}')
    return int(done.stderr.partition('VmHWM:')[2].split()[0]) * 1.024e-3


def memory(frame: Frame, millions: tuple[float, ...] = (1.0, 3.0, 10.0), seed: int = 1
           ) -> Iterator[str]:
    """Yield the page of memory; `millions` of samples are ascending."""
    found: dict[str, list[tuple[int, float]]] = {name: [] for name in COMMANDS}
    with TemporaryDirectory() as folder:
        log = Path(folder) / 'log.csv'
        ac.fit(ac.simulate({'offset': [0.02, -0.01, 0.03]}, poses=24, seed=seed)).save(
            Path(folder) / 'c.yaml')
        for size in (round(each * MILLION) for each in millions):
            for name, words in COMMANDS.items():
                if name in ('capture', 'noise'):
                    write_csv(log, size, name == 'noise', seed)
                found[name].append((size, largest_of(
                    [name, *(word.format(log=log, folder=folder) for word in words)])))
                tell(name, *found[name][-1])
    lines = []
    for name, own in found.items():
        lines += [Line(f'{name}, {size:,} samples, MB', f'{most:.0f}') for size, most in own]
        if len(own) > 1:
            (short, before), (long, after) = own[-2:]
            flat = name in FLAT
            lines.append(Line(
                f'{name}, MB per million samples from {short:,} to {long:,}',
                f'{(after - before) / (long - short) * MILLION:.1f}', 1,
                f'{MOST_RISE_MB:.0f} MB in all' if flat else '',
                after - before < MOST_RISE_MB if flat else None))
    yield table(lines)
