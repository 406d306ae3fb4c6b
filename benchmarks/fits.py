# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Time of fits: one sensor, up to a million poses, and the refinement of 5,000 poses.

Everything runs on one core. The closed form is compared with the ellipsoid by numpy's least
squares, the likelihood with scipy's `least_squares` and its numerical derivatives; both are what
people commonly write by hand. Times of fits are CPU time, the least of several runs. A refinement
runs in a fresh process, on poses of an independent generator (`test/generator.py`); its memory is
that of the process::

    python benchmarks/fits.py --markdown docs/figures/fits.md

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
import os
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
import time

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')

from accel_calib.calibration import fit_poses  # noqa: E402
from accel_calib.estimate import closed_form  # noqa: E402
from accel_calib.table import Floats  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, machine, parser, publish, table  # noqa: E402
from generator import Setup, simulate, write_csv  # noqa: E402
import numpy as np  # noqa: E402
from robust_sets import Case, draw, draw_sensor, NOISE, spread  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402
from trial import trial  # noqa: E402

G = units_of('g')
SEED = 2031
_LONG_ENOUGH, _TOO_LONG = 1.0, 5.0

REFINED = 5_000
"""Poses of a refinement."""

HIDDEN: tuple[Mapping[str, float], ...] = (
    {'offset_temperature': 3.0}, {'offset_temperature': 5.0, 'quadratic': 5.0},
    {'offset_wander': 3.0}, {})
"""Sizes of the effects that hide in the poses of a refinement, by name."""

Curves = dict[str, tuple[list[int], list[float]]]


def least_time(work: Callable[[], object]) -> float:
    """Return the least CPU time of the work [s]: of 1 s of runs, or of 3 runs within 5 s."""
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
    """Fit |M (reading - V)| = 1 as one does by hand: least squares, numerical derivatives."""
    def residual(values: Floats) -> Floats:
        mat_m = values[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)
        return np.linalg.norm((reading - values[6:]) @ mat_m, axis=1) - 1.0

    start = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return least_squares(residual, start).x


def one_sensor() -> Iterator[Line]:
    """Measure fits of one sensor."""
    for count, closed, likely in ((12, 60.0, 2.0), (36, 60.0, 2.5), (1000, 100.0, 10.0)):
        case = draw(np.random.default_rng([SEED, count]), count)
        reading = case.poses.reading
        took = least_time(partial(closed_form, '10', reading)) * 1e6
        beside = least_time(partial(plain_ellipsoid, reading)) * 1e6
        yield Line(f'closed form, {count} poses [µs] (by hand)', f'{took:.0f} ({beside:.0f})',
                   f'≤ {closed:g}', 1, took <= closed)
        took = least_time(partial(fit_poses, case.poses, G, model='10')) * 1e3
        beside = least_time(partial(plain_likelihood, reading)) * 1e3
        yield Line(f'likelihood with geometry, outliers, covariance and quality: {count} poses '
                   '[ms] (values alone, by hand)', f'{took:.2f} ({beside:.2f})', f'≤ {likely:g}',
                   1, took <= likely)
        took = least_time(partial(fit_poses, case.poses, G)) * 1e3
        yield Line(f'the same for three models, and the choice (auto): {count} poses [ms]',
                   f'{took:.2f}', '', 1, None)


def readings_of(sensors: int, poses: int = 12) -> Floats:
    """Draw readings of many sensors, (m, n, 3)."""
    rng = np.random.default_rng([SEED, 100_000])
    force = np.stack([spread(poses, rng) for _ in range(1000)])
    gain = np.stack([draw_sensor(rng, '10').gain for _ in range(len(force))])
    reading = np.resize(force @ gain, (sensors, poses, 3))
    return reading + NOISE * rng.normal(size=reading.shape)


def many_sensors() -> Line:
    """Measure the closed form of many sensors in one call."""
    took = least_time(partial(closed_form, '10', readings_of(1000)))
    return Line('closed form alone, 1,000 sensors at a time: sensors/s', f'{1000 / took:,.0f}', '',
                1000, None)


def refinements(hidden: Sequence[Mapping[str, float]]) -> Iterator[Line]:
    """Measure refinements of large tables."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / 'poses.csv'
        for effects in hidden:
            made = simulate(np.random.default_rng([SEED, REFINED]), effects, Setup(poses=REFINED))
            write_csv(path, made.columns)
            found = trial('refined', path)
            what = (f'refine, {REFINED:,} poses with {" and ".join(effects) or "nothing"} hidden '
                    f'({found["result"]})')
            yield Line(f'{what}: time [s]', f'{found["seconds"]:.1f}', '≤ 10', 1,
                       found['seconds'] <= 10.0)
            yield Line(f'{what}: largest memory, with imports [MB]', f'{found["megabytes"]:.0f}',
                       '≤ 200', 1, found['megabytes'] <= 200.0)


def growth() -> tuple[Curves, list[Line]]:
    """Measure how the time grows with the poses, up to a million."""
    sizes = [10 ** k for k in range(2, 7)]
    cases = {size: draw(np.random.default_rng([SEED, size]), size) for size in sizes}

    def closed(case: Case) -> object:
        return closed_form('10', case.poses.reading)

    def likely(case: Case) -> object:
        return fit_poses(case.poses, G, model='10')

    curves: Curves = {}
    lines = []
    for name, work in (('closed form', closed), ('likelihood', likely)):
        took = [least_time(partial(work, cases[size])) for size in sizes]
        curves[name] = sizes, took
        slope = float(np.polyfit(np.log(sizes[-3:]), np.log(took[-3:]), 1)[0])
        lines.append(Line(f'{name}: time of {sizes[-1]:,} poses [s], and its exponent from '
                          f'{sizes[-3]:,}', f'{took[-1]:.3g}, {slope:.2f}', 'exponent ≤ 1.1',
                          sizes[-1], slope <= 1.1))
    return curves, lines


def draw_growth(curves: Curves, path: Path) -> None:
    """Draw the growth, log-log."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout='constrained')
    axes = figure.add_subplot()
    for name, (at, took) in curves.items():
        axes.loglog(at, took, marker='o', label=name)
    axes.set_xlabel('poses')
    axes.set_ylabel('CPU time [s]')
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, metadata={'Date': None})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__)
    options.add_argument('--quick', action='store_true',
                         help='without the growth, and with one refinement')
    given = options.parse_args(arguments)
    before = machine()
    lines = [*one_sensor(), many_sensors(), *refinements(HIDDEN[:1] if given.quick else HIDDEN)]
    drawn = ''
    if not given.quick:
        curves, grown = growth()
        lines += grown
        if given.markdown:
            draw_growth(curves, given.markdown.with_suffix('.svg'))
            drawn = f'\n![time over poses]({given.markdown.stem}.svg)\n'
    text = (f'# Figures of fits\n\n{__doc__.strip()}\n\n{before}.\n\n{table(lines)}\n{drawn}')
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
