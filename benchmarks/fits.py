# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How long fits take: one sensor, a fleet, and up to a million poses or sensors.

Everything runs on one core, beside what people write when they need such a fit: the ellipsoid by
numpy's least squares for the closed form, and scipy's `least_squares` with differences for the
likelihood. Times are CPU time, the least of many runs, or of a few where one takes long::

    python benchmarks/fits.py --markdown docs/figures/fits.md

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from functools import partial
import os
from pathlib import Path
import platform
import sys
import time

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')

from accel_calib.calibrate import closed_form, fit_many, fit_poses  # noqa: E402
from accel_calib.table import Floats  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, publish, table  # noqa: E402
import numpy as np  # noqa: E402
from robust_sets import Case, draw, draw_sensor, NOISE, spread  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402

G = units_of('g')
SEED = 2031
FLEET = 100_000
_LONG_ENOUGH, _TOO_LONG = 1.0, 5.0


def least_time(work: Callable[[], object]) -> float:
    """Give the least CPU time of the work [s], over a second or three runs."""
    times: list[float] = []
    while sum(times) < _LONG_ENOUGH or (len(times) < 3 and sum(times) < _TOO_LONG):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def plain_ellipsoid(reading: Floats) -> Floats:
    """Fit the ellipsoid as one does by hand: nine monomials, right-hand side one."""
    x, y, z = reading.T
    design = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, x, y, z])
    beta = np.linalg.lstsq(design, np.ones(len(reading)), rcond=None)[0]
    mat_a = beta[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)
    centre = -np.linalg.solve(mat_a, beta[6:]) / 2.0
    values, vectors = np.linalg.eigh(mat_a / (1.0 + centre @ mat_a @ centre))
    return (vectors * np.sqrt(values)) @ vectors.T


def plain_likelihood(reading: Floats) -> Floats:
    """Fit |M (reading - V)| = 1 as one does by hand: least squares with differences."""
    def residual(values: Floats) -> Floats:
        mat_m = values[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)
        return np.linalg.norm((reading - values[6:]) @ mat_m, axis=1) - 1.0

    start = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return least_squares(residual, start).x


def one_sensor() -> Iterator[Line]:
    """Measure fits of one sensor."""
    for count, closed, likely in ((12, 60.0, 1.5), (36, 60.0, 2.0), (1000, 100.0, 10.0)):
        case = draw(np.random.default_rng([SEED, count]), count)
        reading = case.poses.reading
        took = least_time(partial(closed_form.fit_10, reading)) * 1e6
        beside = least_time(partial(plain_ellipsoid, reading)) * 1e6
        yield Line(f'closed form, {count} poses [µs] (by hand)', f'{took:.0f} ({beside:.0f})',
                   f'≤ {closed:g}', 1, took <= closed)
        took = least_time(partial(fit_poses, case.poses, G, model='10')) * 1e3
        beside = least_time(partial(plain_likelihood, reading)) * 1e3
        yield Line(f'likelihood, geometry, disturbed poses, covariance, quality: {count} poses '
                   '[ms] (values alone, by hand)', f'{took:.2f} ({beside:.2f})', f'≤ {likely:g}',
                   1, took <= likely)
        took = least_time(partial(fit_poses, case.poses, G)) * 1e3
        yield Line(f'the same for three models, and the choice (auto): {count} poses [ms]',
                   f'{took:.2f}', '', 1, None)


def fleet_of(sensors: int, poses: int = 12) -> tuple[Floats, Floats]:
    """Draw readings of a fleet and their noise, (m, n, 3)."""
    rng = np.random.default_rng([SEED, sensors])
    force = np.stack([spread(poses, rng) for _ in range(min(sensors, 1000))])
    gain = np.stack([draw_sensor(rng, '10').gain for _ in range(len(force))])
    reading = np.resize(force @ gain, (sensors, poses, 3))
    return reading + NOISE * rng.normal(size=reading.shape), np.full(reading.shape, NOISE)


def fleets() -> Iterator[Line]:
    """Measure fits of many sensors."""
    reading, noise = fleet_of(FLEET)
    each = []
    for method, least in (('algebraic', 40_000), ('ml', 5_000)):
        took = least_time(partial(fit_many, reading, G, method=method, noise=noise))
        rate = len(reading) / took
        each.append(rate)
        what = 'closed form' if method == 'algebraic' else 'likelihood and disturbed poses'
        yield Line(f'{FLEET:,} sensors of 12 poses, {what}, uncertainty: sensors/s',
                   f'{rate:,.0f}', f'≥ {least:,}', FLEET, rate >= least)
    took = least_time(partial(closed_form.fit_10, reading[:1000]))
    yield Line('closed form alone, 1,000 sensors at a time: sensors/s', f'{1000 / took:,.0f}', '',
               1000, None)


def growth() -> tuple[dict[str, tuple[list[int], list[float]]], list[Line]]:
    """Measure how the time grows with poses and with sensors, to a million of each."""
    sizes = [10 ** k for k in range(2, 7)]
    curves: dict[str, tuple[list[int], list[float]]] = {}
    cases = {size: draw(np.random.default_rng([SEED, size]), size) for size in sizes}
    reading, noise = fleet_of(sizes[-1])

    def closed(case: Case) -> object:
        return closed_form.fit_10(case.poses.reading)

    def likely(case: Case) -> object:
        return fit_poses(case.poses, G, model='10')

    for name, work in (('poses of one sensor, closed form', closed),
                       ('poses of one sensor, likelihood', likely)):
        curves[name] = sizes, [least_time(partial(work, cases[size])) for size in sizes]
    for method, name in (('algebraic', 'sensors of 12 poses, closed form'),
                         ('ml', 'sensors of 12 poses, likelihood')):
        curves[name] = sizes, [least_time(partial(
            fit_many, reading[:size], G, method=method, noise=noise[:size])) for size in sizes]
    lines = []
    for name, (at, took) in curves.items():
        slope = float(np.polyfit(np.log(at[-3:]), np.log(took[-3:]), 1)[0])
        lines.append(Line(f'{name}: time at {at[-1]:,} [s], and its exponent from {at[-3]:,}',
                          f'{took[-1]:.3g}, {slope:.2f}', 'exponent ≤ 1.1', at[-1], slope <= 1.1))
    return curves, lines


def draw_growth(curves: dict[str, tuple[list[int], list[float]]], path: Path) -> None:
    """Draw the growth, log-log."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout='constrained')
    axes = figure.add_subplot()
    for name, (at, took) in curves.items():
        axes.loglog(at, took, marker='o', label=name)
    axes.set_xlabel('poses, or sensors')
    axes.set_ylabel('CPU time [s]')
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, metadata={'Date': None})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--quick', action='store_true', help='leave the growth out')
    parser.add_argument('--markdown', type=Path, help='write table and figure beside this file')
    given = parser.parse_args(arguments)
    lines = [*one_sensor(), *fleets()]
    drawn = ''
    if not given.quick:
        curves, grown = growth()
        lines += grown
        if given.markdown:
            draw_growth(curves, given.markdown.with_suffix('.svg'))
            drawn = f'\n![time over poses and sensors]({given.markdown.stem}.svg)\n'
    text = (f'# Figures of fits\n\n{__doc__.strip()}\n\n{platform.machine()}, {os.cpu_count()} '
            f'cores, Python {platform.python_version()}, numpy {np.__version__}; load '
            f'{os.getloadavg()[0]:.1f} at the end.\n\n{table(lines)}\n{drawn}')
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
