# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Time and memory of fits, recordings and commands."""

from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from functools import partial
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
from accel_calib.estimate import closed_form
from accel_calib.geometry import spread_directions
from accel_calib.logs import open_log, read_recording
from accel_calib.messages import correct_bag
from accel_calib.stillness import capture
from accel_calib.stored import read_calibration
from accel_calib.table import Floats
from bag_files import write_bag
from figures import check, DATA, Frame, Line, measure_alone, Measured, run_command, table
import numpy as np
from rosbags.highlevel import AnyReader
from scipy.optimize import least_squares
from sensors import draw_case, draw_sensor, NOISE, spread
from shared import G, KNOWN, MPS2, NATIVE

SEED = 2031


def least_time(work: Callable[[], object]) -> float:
    """Return the least CPU time of work [s], in 1 s and three runs, but not in 5 s of them."""
    times: list[float] = []
    while (sum(times) < 1.0 or len(times) < 3) and sum(times) < 5.0:
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


# ------------------------------------------------------------------------------------------ fits

def fit_ellipsoid(reading: Floats) -> Floats:
    """Fit the ellipsoid as one does by hand: nine monomials, right-hand side one."""
    x, y, z = reading.T
    design = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, x, y, z])
    beta = np.linalg.lstsq(design, np.ones(len(reading)), rcond=None)[0]
    mat_a = beta[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)
    centre = -np.linalg.solve(mat_a, beta[6:]) / 2.0
    values, vectors = np.linalg.eigh(mat_a / (1.0 + centre @ mat_a @ centre))
    return (vectors * np.sqrt(values)) @ vectors.T


def fit_likelihood(reading: Floats) -> Floats:
    """Fit |M (reading - V)| = 1 as one does by hand: least squares, numerical derivatives."""
    def residual(values: Floats) -> Floats:
        mat_m = values[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)
        return np.linalg.norm((reading - values[6:]) @ mat_m, axis=1) - 1.0

    start = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return least_squares(residual, start).x


def lines_of_fits() -> Iterator[Line]:
    """Yield the times of fits of one sensor, and of many sensors in one call."""
    for count, closed, likely in ((12, 60.0, 2.0), (36, 60.0, 2.5), (1000, 100.0, 10.0)):
        poses = draw_case(np.random.default_rng([SEED, count]), count).poses
        took = least_time(partial(closed_form, '10', poses.reading)) * 1e6
        beside = least_time(partial(fit_ellipsoid, poses.reading)) * 1e6
        yield check(f'closed form, {count} poses [µs] (by hand)', f'{took:.0f} ({beside:.0f})',
                    took, most=closed)
        took = least_time(partial(fit_poses, poses, G, model='10')) * 1e3
        beside = least_time(partial(fit_likelihood, poses.reading)) * 1e3
        yield check('likelihood with geometry, outliers, covariance and quality: '
                    f'{count} poses [ms] (values alone, by hand)', f'{took:.2f} ({beside:.2f})',
                    took, most=likely)
        took = least_time(partial(fit_poses, poses, G)) * 1e3
        yield Line(f'the same for three models, and the choice (auto): {count} poses [ms]',
                   f'{took:.2f}')
    rng = np.random.default_rng([SEED, 100_000])
    force = np.stack([spread(12, rng) for _ in range(1000)])
    reading = force @ np.stack([draw_sensor(rng).gain for _ in range(1000)])
    reading += NOISE * rng.normal(size=reading.shape)
    yield Line('closed form alone, 1,000 sensors at a time: sensors/s',
               f'{1000 / least_time(partial(closed_form, "10", reading)):,.0f}', 1000)


def fits(frame: Frame, largest: int = 1_000_000) -> Iterator[str]:
    """Yield the page of fits, also of up to `largest` poses."""
    lines = list(lines_of_fits())
    sizes = [10 ** k for k in range(2, 7) if 10 ** k <= largest]
    poses = {size: draw_case(np.random.default_rng([SEED, size]), size).poses for size in sizes}
    works: dict[str, Callable[[int], object]] = {
        'closed form': lambda size: closed_form('10', poses[size].reading),
        'likelihood': lambda size: fit_poses(poses[size], G, model='10')}
    for name, work in works.items():
        took = [least_time(partial(work, size)) for size in sizes]
        slope = float(np.polyfit(np.log(sizes[-3:]), np.log(took[-3:]), 1)[0])
        lines += [Line(f'{name}: time of {size:,} poses [s]', f'{seconds:.3g}')
                  for size, seconds in zip(sizes[-3:], took[-3:], strict=True)]
        lines.append(check(f'{name}: exponent of this time', f'{slope:.2f}', slope, most=1.1))
    yield table(lines)


# ------------------------------------------------------------------------------------- recordings

FULL = 3_600_000
"""Messages of a bag: an hour at 1 kHz."""

MESSAGE_BYTES = 324
RATE_HZ = 1000
POSES = 36
DESERIALIZED = 400_000
"""Messages that `rosbags` deserializes, at most."""

XSENS = DATA / 'xsens_mti_counts.csv'


def open_bag(bag: Path) -> AnyReader:
    """Open a bag with `rosbags`."""
    reader = AnyReader([bag])
    reader.open()
    return reader


def deserialize(reader: AnyReader) -> int:
    """Deserialize messages one by one through `rosbags`."""
    wanted, count = [c for c in reader.connections if c.topic == '/imu'], 0
    for connection, _, raw in islice(reader.messages(wanted), DESERIALIZED):
        reader.deserialize(raw, connection.msgtype)
        count += 1
    return count


def read(bag: Path) -> int:
    """Read the samples of a bag, and nothing else."""
    with open_log(bag) as stream:
        return sum(len(block) for block in stream.blocks)


def poses(bag: Path) -> int:
    """Find the poses of a bag."""
    with open_log(bag) as stream:
        found = capture(stream.blocks, MPS2)
    if len(found.poses) == 0:
        raise RuntimeError('no poses')
    return found.recorded


def apply(bag: Path, out: Path, calibration: Path) -> int:
    """Write a corrected copy of a bag."""
    return correct_bag(bag, read_calibration(calibration), out)


def calibrate(csv: Path) -> list[list[float]]:
    """Time reading, poses and fit of a recording in counts, 11 times; the first is a warm-up."""
    spent = []
    for _ in range(11):
        marks = [time.perf_counter()]
        recording = read_recording(csv)
        marks.append(time.perf_counter())
        found = capture(recording, NATIVE)
        marks.append(time.perf_counter())
        fit_poses(found.poses, NATIVE, model='10')
        spent.append(np.diff([*marks, time.perf_counter()]).tolist())
    return spent


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
        yield check(f'{what}, whole process', f'{median(spent):.2f} s', median(spent), most=asked,
                    unit=' s', sets=repeats)
    if not XSENS.exists():
        yield Line(f'Xsens: not measured, {XSENS} is missing', '', 0)
        return
    first, *turns = measure_alone(calibrate, XSENS).result
    warm = median(map(sum, turns))
    parts = ', '.join(f'{name} {1e3 * median(each):.0f}'
                      for name, each in zip(('read', 'poses', 'fit'), zip(*turns)))
    yield check('Xsens, 51,175 samples, CSV to poses and model 10, in process (imu_tk: 320 ms)',
                f'{1e3 * warm:.0f} ms ({parts})', 1e3 * warm, most=100.0, unit=' ms',
                sets=len(turns))
    yield Line('the same for the first time, imports included', f'{1e3 * sum(first):.0f} ms')


def lines_of_bag(folder: Path, storage: str, count: int, repeats: int, calibration: Path
                 ) -> Iterator[Line]:
    """Yield the rates of a bag, and the memory beside that for a bag of a tenth of its length."""
    turn = 2.0
    recording = simulate_recording(
        model_with(KNOWN), spread_directions(POSES), np.random.default_rng(2031),
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
            found.setdefault(work.__name__, []).append(measure_alone(
                work, bag, *more, prepare=open_bag if work is deserialize else None))
            shutil.rmtree(out, ignore_errors=True)
    small = {'poses': measure_alone(poses, tenth).megabytes,
             'apply': measure_alone(apply, tenth, out, calibration).megabytes}
    for path in (bag, tenth, out):
        shutil.rmtree(path, ignore_errors=True)
    rate = {what: round(median(x.result / x.seconds for x in each), -3)
            for what, each in found.items()}
    busy = {what: median(1e6 * x.cpu / x.result for x in each) for what, each in found.items()}
    name, plain = f'{storage}, {count:,} messages', f'{rate["deserialize"]:,.0f}'
    for what, words, least in (('poses', 'reading and finding poses', 5.0),
                               ('read', 'reading', 4.0)):
        times = rate[what] / rate['deserialize']
        yield check(f'{name}: rate of {words}, times that of rosbags deserializing each message',
                    f'{times:.1f} × ({rate[what]:,.0f} and {plain} per second)', times,
                    least=least, unit=' ×', sets=repeats)
    yield check(f'{name}: rate of apply', f'{rate["apply"]:,.0f} per second', rate['apply'],
                least=300_000, sets=repeats)
    yield Line(f'{name}: CPU per message, deserializing / poses / apply',
               f'{busy["deserialize"]:.2f} / {busy["poses"]:.2f} / {busy["apply"]:.2f} µs',
               repeats)
    for what, before in small.items():
        largest = max(each.megabytes for each in found[what])
        rise = 0.03 * 0.9e-6 * count * MESSAGE_BYTES
        yield Line(f'{name}: largest memory of {what}, with imports',
                   f'{largest:.0f} MB ({before:.0f} MB for a tenth of them)', repeats, 'bounded',
                   None if count < FULL else largest - before < rise)


def recordings(frame: Frame, messages: int = FULL, repeats: int = 3) -> Iterator[str]:
    """Yield the page; the bags take 1.3 GB each below TMPDIR, where 4 GB must be free."""
    with TemporaryDirectory() as name:
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
                found[name].append((size, measure_alone(run_command, name, *(
                    word.format(log=log, folder=folder) for word in words)).megabytes))
    lines = []
    for name, own in found.items():
        lines += [Line(f'{name}, {size:,} samples, MB', f'{most:.0f}') for size, most in own]
        if len(own) > 1:
            (short, before), (long, after) = own[-2:]
            lines.append(check(
                f'{name}, MB per million samples from {short:,} to {long:,}; in all',
                f'{(after - before) / (long - short) * MILLION:.1f}; {after - before:.0f}',
                after - before, most=MOST_RISE_MB if name in FLAT else np.inf, unit=' MB in all'))
    yield table(lines)
