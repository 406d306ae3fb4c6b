# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Speed and memory of the stillness detector.

Times are CPU time of one core over arrays in memory, the least of several repeats. Memory is the
largest that Python and numpy hold at once beside the array (`tracemalloc`, in a separate run). The
sensor rests for 4 s and is shaken for 1 s, with 2 mg of noise in steps of 1/16384 g::

    python benchmarks/stillness_speed.py --seed 1 --markdown docs/figures/stillness_speed.md

"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import sys
import time
import tracemalloc

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')

from accel_calib.calibration import fit_poses  # noqa: E402
from accel_calib.logs import read_recording  # noqa: E402
from accel_calib.stillness import capture, CaptureSettings, StillDetector  # noqa: E402
from accel_calib.table import Recording  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, machine, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402

DATA = ROOT.parent / 'shared' / 'data'
SIZES = (10**5, 10**6, 10**7, 3 * 10**7)
RATES_HZ = (100.0, 1000.0)
G = units_of('g')
_REST, _SHAKEN = 4.0, 1.0   # [s]
_STREAMED, _BATCH = 60_000, 300
"""Samples of a stream at 1000 Hz, and of a batch of 0.3 s, as the node pushes them."""

ABOUT = """# Speed of the stillness detector

Made by `python benchmarks/stillness_speed.py {command} --markdown FILE`.
Times are CPU time of one core over arrays in memory, the least of several repeats. The sensor
rests for 4 s and is shaken for 1 s.

Machine: {machine}."""

COSTS = """\
A sample costs {fast:.0f} ns at 1000 Hz and {slow:.0f} ns at 100 Hz, where a chunk has ten samples
and a rest 400. A sensor that always rests gives {long:.0f} million samples/s at 100 Hz. The
difference is {rest:.0f} µs per rest: some calls of numpy join its chunks, and a record is made of
it."""


def recording_of(size: int, rate: float, seed: int, rest: float = _REST) -> Recording:
    """Simulate a recording of `size` samples, with rests of `rest` [s]."""
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
    """Return the CPU time of `capture` [s]."""
    found = []
    for _ in range(repeats):
        start = time.process_time()
        capture(recording, G)
        found.append(time.process_time() - start)
    return min(found)


def memory(recording: Recording) -> float:
    """Return the memory that `capture` holds beside the recording [MB]."""
    tracemalloc.start()
    capture(recording, G)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def of_arrays(sizes: Sequence[int], seed: int) -> tuple[list[Line], dict[float, float]]:
    """Measure arrays of these sizes; return also the time per sample [s], by rate [Hz]."""
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
    """Measure reading, poses and fit of the real recording."""
    units, found = units_of('native'), []
    for _ in range(7):
        marks = [time.process_time()]
        recording = read_recording(folder / 'xsens_mti_counts.csv')
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
    """Measure `StillDetector.push` of batches, with a gyro."""
    recording = recording_of(_STREAMED, 1000.0, seed)
    rate = 2e-3 * np.random.default_rng(seed).standard_normal((_STREAMED, 3))
    samples = np.column_stack([recording['time'], recording.reading, rate,
                               np.full((_STREAMED, 2), np.nan)])
    detector, took = StillDetector(CaptureSettings(), G), []
    for batch in np.split(samples, _STREAMED // _BATCH):
        start = time.perf_counter()
        detector.push(batch)
        took.append(time.perf_counter() - start)
    return [Line(f'push of {_BATCH} samples at 1000 Hz: median, largest, ms',
                 f'{1e3 * np.median(took):.2f}, {1e3 * np.max(took):.2f}', '', len(took), None),
            Line(f'push of {_BATCH} samples at 1000 Hz: mean per sample, µs',
                 f'{1e6 * np.sum(took) / _STREAMED:.2f}', '', len(took), None)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, seed=1)
    options.add_argument('--largest', type=int, default=SIZES[-1], help='samples, at most')
    options.add_argument('--data', type=Path, default=DATA, help='folder of the real recordings')
    given = options.parse_args(arguments)
    before = machine()
    sizes = [size for size in SIZES if size <= given.largest] or [given.largest]
    capture(recording_of(SIZES[0], RATES_HZ[0], given.seed), G)
    lines, each = of_arrays(sizes, given.seed)
    lines += (of_xsens(given.data) if given.data.is_dir()
              else [Line(f'Xsens: not measured, {given.data} is missing', '', '', 0, None)])
    lines += of_stream(given.seed)
    resting = recording_of(10**6, 100.0, given.seed, rest=1e5)
    slow, fast, still = each[100.0], each[1000.0], seconds(resting, 3) / 10**6
    costs = COSTS.format(fast=1e9 * fast, slow=1e9 * slow, long=1e-6 / still,
                         rest=1e6 * (slow - still) * 100.0 * (_REST + _SHAKEN))
    command = f'--largest {given.largest} --seed {given.seed}'
    text = f'{ABOUT.format(command=command, machine=before)}\n\n{table(lines)}\n\n{costs}\n'
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
