# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure how fast recordings become poses, and in how much memory.

CPU time of one core over arrays that are in memory already, the least of some repeats; memory is
the largest that Python and numpy held at once beside the array (`tracemalloc`, in a run of its
own). The sensor rests for 4 s and is shaken for one, with noise of 2 mg in steps of 1/16384 g.

"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
import time
import tracemalloc

from accel_calib.calibrate import fit_poses
from accel_calib.capture import capture, CaptureSettings, StillDetector
from accel_calib.files import read_recording
from accel_calib.table import Recording
from accel_calib.units import units_of
from figures import Line, publish, table
import numpy as np

DATA = Path(__file__).parents[2] / 'shared' / 'data'
SIZES = (10**5, 10**6, 10**7, 3 * 10**7)
RATES_HZ = (100.0, 1000.0)
G = units_of('g')
_REST, _SHAKEN = 4.0, 1.0   # [s]
_STREAMED = 60_000

ABOUT = """# Speed of the stillness detector

Made by `python benchmarks/stillness_speed.py --seed {seed} --markdown FILE`. CPU
time of one core, arrays in memory, the least of some repeats; a machine shared with others. The
sensor rests for 4 s and is shaken for one. Memory grows with the poses only, 2 kB each."""

LIMIT = """\
At 1000 Hz a sample costs {fast:.0f} ns: some twenty passes over readings that stay in the cache,
for rows, chunk borders, sums, squares and smallest steps. At 100 Hz a sample costs {slow:.0f} ns,
for a chunk is ten samples and a rest 400. The rule takes some 120 passes over the chunks; a sensor
that rests all the time is {long:.0f} million samples/s. The rest is {rest:.0f} µs for each rest:
thirty calls of numpy that join its chunks, and the record that is made of it. To reach 20 million
there takes a tracker that joins all rests of a block in array calls, or a compiled one."""


def recording_of(size: int, rate: float, seed: int, rest: float = _REST) -> Recording:
    """Simulate a recording of so many samples at this rate [Hz]."""
    rng = np.random.default_rng(seed)
    reading = 2e-3 * rng.standard_normal((size, 3))
    period, resting = round((rest + _SHAKEN) * rate), round(rest * rate)
    for start in range(0, size, period):
        force = rng.normal(size=3)
        reading[start:start + period] += force / np.linalg.norm(force)
        shaken = reading[start + resting:start + period]
        shaken += 0.5 * rng.standard_normal(shaken.shape)
    np.round(reading * 16384.0, out=reading)
    reading /= 16384.0
    return Recording({'time': np.arange(size) / rate, 'reading': reading},
                     np.arange(1, size + 1))


def seconds(recording: Recording, repeats: int) -> float:
    """Give the CPU time that `capture` takes [s]."""
    found = []
    for _ in range(repeats):
        start = time.process_time()
        capture(recording, G)
        found.append(time.process_time() - start)
    return min(found)


def memory(recording: Recording) -> float:
    """Give the memory that `capture` holds beside the recording [MB]."""
    tracemalloc.start()
    capture(recording, G)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def of_arrays(sizes: Sequence[int], seed: int) -> tuple[list[Line], dict[float, float]]:
    """Measure arrays of these sizes; give the time of a sample too [s], by rate [Hz]."""
    lines, each = [], {}
    for rate in RATES_HZ:
        for size in sizes:
            recording = recording_of(size, rate, seed)
            best = seconds(recording, 7 if size <= 10**6 else 3)
            each[rate] = best / size
            speed = size / best / 1e6
            lines.append(Line(f'{size:,} samples at {rate:.0f} Hz, million samples/s',
                              f'{speed:.1f}', '≥ 20', 1, speed >= 20.0))
            lines.append(Line(f'{size:,} samples at {rate:.0f} Hz, memory beside the array, MB',
                              f'{memory(recording):.1f}', 'flat', 1, None))
            print(lines[-2].what, lines[-2].measured, file=sys.stderr, flush=True)
    return lines, each


def of_xsens(folder: Path) -> list[Line]:
    """Measure the real recording: reading the file, finding the poses, fitting them."""
    units, found = units_of('native'), []
    for _ in range(7):
        marks = [time.process_time()]
        recording = read_recording(folder / 'xsens_mti_counts.csv').recording
        marks.append(time.process_time())
        poses = capture(recording, units).poses
        marks.append(time.process_time())
        fit_poses(poses, units, model='10')
        found.append(np.diff([*marks, time.process_time()]))
    read, still, fit = 1e3 * np.min(found, axis=0)
    total = 1e3 * float(np.min(np.sum(found, axis=1)))
    return [Line(f'Xsens, {len(recording):,} samples with a gyro: to {len(poses)} poses, ms',
                 f'{still:.0f}', '≤ 25', 7, bool(still <= 25.0)),
            Line('Xsens: reading the file, ms', f'{read:.0f}', '', 7, None),
            Line('Xsens: fit of 10 parameters, ms', f'{fit:.0f}', '', 7, None),
            Line('Xsens, CSV in, poses and fit out, in process, ms', f'{total:.0f}', '≤ 100', 7,
                 total <= 100.0)]


def of_stream(seed: int) -> list[Line]:
    """Measure `StillDetector.push`, sample by sample, with a gyro."""
    recording = recording_of(_STREAMED, 1000.0, seed)
    rate = 2e-3 * np.random.default_rng(seed).standard_normal((_STREAMED, 3))
    rows = list(zip(recording['time'].tolist(), recording.reading.tolist(), rate.tolist()))
    detector, took = StillDetector(CaptureSettings(), G), []
    for row in rows:
        start = time.perf_counter()
        detector.push(*row)
        took.append(time.perf_counter() - start)
    microseconds = 1e6 * np.array(took)
    return [Line('push at 1000 Hz: mean, µs', f'{microseconds.mean():.1f}', '', 1, None),
            Line('push at 1000 Hz: median, µs', f'{np.median(microseconds):.1f}', '', 1, None),
            Line('push that ends a chunk (one in 100): median, µs',
                 f'{np.median(microseconds[microseconds > 50.0]):.0f}', '', 1, None)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--largest', type=int, default=SIZES[-1], help='samples, at most')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--data', type=Path, default=DATA, help='folder of the real recordings')
    parser.add_argument('--markdown', type=Path, help='write the table to this file')
    given = parser.parse_args(arguments)
    sizes = [size for size in SIZES if size <= given.largest]
    capture(recording_of(SIZES[0], RATES_HZ[0], given.seed), G)
    lines, each = of_arrays(sizes, given.seed)
    if given.data.is_dir():
        lines += of_xsens(given.data)
    lines += of_stream(given.seed)
    resting = recording_of(10**6, 100.0, given.seed, rest=1e5)
    slow, fast, still = each[100.0], each[1000.0], seconds(resting, 3) / 10**6
    told = LIMIT.format(fast=1e9 * fast, slow=1e9 * slow, long=1e-6 / still,
                        rest=1e6 * (slow - still) * 100.0 * (_REST + _SHAKEN))
    text = '\n\n'.join([ABOUT.format(seed=given.seed), table(lines), told]) + '\n'
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
