# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Time and memory of fits, of refinements with many poses, and of the stillness detector."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
import time
import tracemalloc

from accel_calib.calibration import fit_poses
from accel_calib.estimate import closed_form
from accel_calib.geometry import unit
from accel_calib.refinement import refine
from accel_calib.stillness import capture, CaptureSettings, StillDetector
from accel_calib.table import Floats, Recording
from accel_calib.units import units_of
from figures import Frame, Line, measure_alone, table, tell
from generator import Setup, simulate
import numpy as np
from scipy.optimize import least_squares
from sensors import draw_case, draw_sensor, NOISE, poses_of, spread

G, MS2 = units_of('g'), units_of('m/s2')
SEED = 2031


def least_time(work: Callable[[], object], seconds: float = 1.0, runs: int = 3) -> float:
    """Return the least CPU time of work [s], in some seconds and runs, but not in 5 s of them."""
    times: list[float] = []
    while (sum(times) < seconds or len(times) < runs) and sum(times) < 5.0 * max(seconds, 1.0):
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
        yield Line(f'closed form, {count} poses [µs] (by hand)', f'{took:.0f} ({beside:.0f})', 1,
                   f'≤ {closed:g}', took <= closed)
        took = least_time(partial(fit_poses, poses, G, model='10')) * 1e3
        beside = least_time(partial(fit_likelihood, poses.reading)) * 1e3
        yield Line(f'likelihood with geometry, outliers, covariance and quality: {count} poses '
                   '[ms] (values alone, by hand)', f'{took:.2f} ({beside:.2f})', 1,
                   f'≤ {likely:g}', took <= likely)
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
    """Yield the page of fits, and draw how the time grows with the poses."""
    from matplotlib.figure import Figure

    lines = list(lines_of_fits())
    sizes = [10 ** k for k in range(2, 7) if 10 ** k <= largest]
    poses = {size: draw_case(np.random.default_rng([SEED, size]), size).poses for size in sizes}
    figure = Figure(figsize=(6.4, 4.2), layout='constrained')
    axes = figure.add_subplot()
    works: dict[str, Callable[[int], object]] = {
        'closed form': lambda size: closed_form('10', poses[size].reading),
        'likelihood': lambda size: fit_poses(poses[size], G, model='10')}
    for name, work in works.items():
        took = [least_time(partial(work, size)) for size in sizes]
        axes.loglog(sizes, took, marker='o', label=name)
        slope = float(np.polyfit(np.log(sizes[-3:]), np.log(took[-3:]), 1)[0])
        lines.append(Line(f'{name}: time of {sizes[-1]:,} poses [s], and its exponent from '
                          f'{sizes[-3]:,}', f'{took[-1]:.3g}, {slope:.2f}', sizes[-1],
                          'exponent ≤ 1.1', slope <= 1.1))
    axes.set_xlabel('poses')
    axes.set_ylabel('CPU time [s]')
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    if frame.path:
        figure.savefig(frame.path.with_suffix('.svg'), metadata={'Date': None})
    yield table(lines)


# ----------------------------------------------------------------------------------- refinements

HIDDEN = ('', 'offset_temperature', 'offset_wander', 'quadratic', 'ripple')
LONGEST = {5_000: 10.0, 50_000: 100.0}
"""Asked: the longest time by the number of poses [s]."""

MOST_MB = 200.0
"""Asked: the largest memory [MB]."""


def prepare_refinement(hidden: str, count: int, seed: int) -> Callable[[], str]:
    """Return the refinement of simulated poses, which returns its result in words."""
    made = simulate(np.random.default_rng(seed), {hidden: 3.0} if hidden else {},
                    Setup(poses=count, samples=20))
    poses = poses_of(made)
    del made

    def work() -> str:
        found = refine(poses, MS2, base='10')
        names = ' + '.join(str(step.effect) for step in found.steps) or 'nothing'
        return f'{names}, {found.verdict}'

    return work


def refine_cost(frame: Frame, seed: int = 2028, poses: tuple[int, ...] = tuple(LONGEST)
                ) -> Iterator[str]:
    """Yield the page of refinements with many poses."""
    lines = []
    for count in poses:
        for hidden in HIDDEN:
            found = measure_alone(prepare_refinement, hidden, count, seed)
            what = f'{count:,} poses, {hidden or "nothing"} hidden'
            lines += [
                Line(f'{what}: seconds ({found.result})', f'{found.seconds:.1f}', 1,
                     f'≤ {LONGEST[count]:g}', found.seconds <= LONGEST[count]),
                Line(f'{what}: largest memory [MB] ({found.before:.0f} before)',
                     f'{found.megabytes:.0f}', 1, f'≤ {MOST_MB:g}', found.megabytes <= MOST_MB)]
    yield table(lines)


# ---------------------------------------------------------------------------- stillness detector

REST, SHAKEN = 4.0, 1.0
"""Times of a rest and of the shaking after it [s]."""

STREAMED, BATCH = 60_000, 300
"""Samples of a stream at 1000 Hz, and of a batch of 0.3 s, as the node pushes them."""


def recording_of(size: int, rate: float, seed: int, rest: float = REST) -> Recording:
    """Simulate samples with 2 mg of noise in steps of 1/16384 g, and rests of `rest` [s]."""
    rng = np.random.default_rng(seed)
    reading = 2e-3 * rng.standard_normal((size, 3))
    period, resting = round((rest + SHAKEN) * rate), round(rest * rate)
    for start in range(0, size, period):
        reading[start:start + period] += unit(rng.normal(size=3))
        shaken = reading[start + resting:start + period]
        shaken += 0.5 * rng.standard_normal(shaken.shape)
    np.round(reading * 16384.0, out=reading)
    reading /= 16384.0
    return Recording({'time': np.arange(size) / rate, 'reading': reading}, np.arange(1, size + 1))


def lines_of_stream(seed: int) -> Iterator[Line]:
    """Yield the times of `StillDetector.push` of batches, with a gyro."""
    recording = recording_of(STREAMED, 1000.0, seed)
    rate = 2e-3 * np.random.default_rng(seed).standard_normal((STREAMED, 3))
    samples = np.column_stack([recording['time'], recording.reading, rate,
                               np.full((STREAMED, 2), np.nan)])
    detector, took = StillDetector(CaptureSettings(), G), []
    for batch in np.split(samples, STREAMED // BATCH):
        start = time.perf_counter()
        detector.push(batch)
        took.append(time.perf_counter() - start)
    what = f'push of {BATCH} samples at 1000 Hz'
    yield Line(f'{what}: median, largest, ms', f'{1e3 * np.median(took):.2f}, '
               f'{1e3 * np.max(took):.2f}', len(took))
    yield Line(f'{what}: mean per sample, µs', f'{1e6 * np.sum(took) / STREAMED:.2f}', len(took))


def stillness_speed(frame: Frame, largest: int = 3 * 10**7, seed: int = 1) -> Iterator[str]:
    """Yield the page of the detector; memory is the largest that Python and numpy hold at once."""
    lines: list[Line] = []
    each: dict[float, float] = {}
    capture(recording_of(10**5, 100.0, seed), G)
    for rate in (100.0, 1000.0):
        for size in (10**5, 10**6, 10**7, 3 * 10**7):
            if size > largest:
                break
            recording = recording_of(size, rate, seed)
            took = least_time(partial(capture, recording, G), 0.0, 7 if size <= 10**6 else 3)
            each[rate], speed = took / size, size / took / 1e6
            tracemalloc.start()
            capture(recording, G)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            what = f'{size:,} samples at {rate:.0f} Hz'
            lines += [Line(f'{what}, million samples/s', f'{speed:.1f}', 1, '≥ 20', speed >= 20.0),
                      Line(f'{what}, memory beside the array, MB', f'{peak / 1e6:.1f}', 1, 'flat')]
            tell(lines[-2].what, lines[-2].measured)
    lines += lines_of_stream(seed)
    resting = recording_of(10**6, 100.0, seed, rest=1e5)
    still = least_time(partial(capture, resting, G), 0.0) / 10**6
    slow, fast = each[100.0], each[1000.0]
    yield table(lines)
    yield f'A sample costs {1e9 * fast:.0f} ns at 1000 Hz and {1e9 * slow:.0f} ns at 100 Hz'
    yield f'always rests gives {1e-6 / still:.0f} million samples/s at 100 Hz'
    yield f'difference is {1e6 * (slow - still) * 100.0 * (REST + SHAKEN):.0f} µs per rest'
