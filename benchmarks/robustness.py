# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Trust in a fit: outliers, bad placement, stated uncertainty, choice of the model.

Poses are spread over the sphere with 8° of jitter unless a row says otherwise. The noise of a pose
mean is 0.3 mg by axis; its standard deviation is measured from 100 samples. Errors are RMS errors
of |a| on fresh directions, the median over the sets. Poor geometry has its own page,
[geometry](geometry.md).

Limits: 12 poses leave three residuals. Without a stated noise these must show the noise and a
knocked pose at once. Poses that scatter have a variance in common, but so few do not show it, and
those with little noise have too much weight. Model 7 fits 6 poses of a sensor of 10 parameters
exactly, so that nothing shows the cross-axis gains that it lacks.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
import multiprocessing
import os
from pathlib import Path
import sys
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')  # each process has one core

from accel_calib.calibration import Calibration, fit_poses  # noqa: E402
from accel_calib.effects.simulate import path  # noqa: E402
from accel_calib.errors import AccelCalibError  # noqa: E402
from accel_calib.stillness import capture  # noqa: E402
from accel_calib.table import Floats, numbered, Recording  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from directions import random_directions  # noqa: E402
from figures import Line, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402
from robust_sets import (  # noqa: E402
    Case, draw, draw_sensor, error_mg, knock, misplaced, NOISE, spread, without_noise)
from scipy.signal import lfilter  # noqa: E402

G = units_of('g')
_SHOWS_MG = 2.0
"""Change of |force| from which a knock must be detected [mg]."""

_QUIET = 5.0
"""Ratio of the scatter of poses to the noise that their samples show."""

_SCATTER = f'scatter of {_QUIET:g} times the noise, which differs (e-fold)'

RATE = 100.0
"""Samples per second of a recording."""

Job = tuple[Any, ...]


def fitted(case: Case, model: str = 'auto') -> Calibration | None:
    """Fit a set; None if the fit is refused."""
    try:
        return fit_poses(case.poses, G, model=model)
    except AccelCalibError:
        return None


def error_of(calibration: Calibration | None, case: Case, rng: np.random.Generator) -> float:
    """Return the error of a fit [mg]; infinite if it was refused."""
    return np.inf if calibration is None else error_mg(calibration, case.sensor, rng)


def of_knocks(job: Job) -> tuple[float, bool, bool, float]:
    """
    Fit a set with knocked poses.

    Returns
    -------
    float, bool, bool, float
        Error [mg]; whether exactly the knocked poses are rejected, those that show little aside;
        whether a clean pose is rejected; error of a fit to the clean poses [mg].

    """
    count, knocked, measured, seed = job
    rng = np.random.default_rng([seed, count, knocked])
    clean = draw(rng, count)
    case = knock(clean, rng, knocked) if knocked else clean
    kept = np.flatnonzero(case.shows_mg == 0.0)
    best = fitted(replace(case, poses=case.poses.take(kept)), '10')
    case = case if measured else without_noise(case)
    found = fitted(case, '10')
    named = set() if found is None else {rejected.row - 1 for rejected in found.rejected}
    plain = set(np.flatnonzero(case.shows_mg >= _SHOWS_MG))
    lost = bool(named & set(kept))
    return (error_of(found, case, rng), plain <= named and not lost and found is not None, lost,
            error_of(best, case, rng))


def drawn(rng: np.random.Generator, count: int, kind: str, noise: str) -> Case:
    """Draw a set of a kind of sensor whose noise is one of the words of `intervals`."""
    if noise == 'differs':
        return draw(rng, count, kind, noise=NOISE * np.exp(rng.normal(size=count)))
    if noise == 'scatter':
        quiet = NOISE / _QUIET * np.exp(rng.normal(size=count))
        return draw(rng, count, kind, noise=quiet, scatter=NOISE)
    return draw(rng, count, kind, stated=1.0 / 3.0 if noise == 'understated' else 1.0)


def of_bound(job: Job) -> tuple[Floats, Floats]:
    """Return the errors of model 10 over their Cramér-Rao bounds and over their stated sizes."""
    count, scatters, seed = job
    rng = np.random.default_rng([seed, count])
    case = drawn(rng, count, '10', 'scatter' if scatters else 'measured')
    found = fitted(case, '10')
    assert found is not None
    jacobian = case.sensor.length_slopes(case.force) / case.noise[:, np.newaxis]
    bound = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    away = found.model.vector - case.sensor.values('10')
    return away / bound, away / np.sqrt(np.diag(found.covariance))


def of_placement(job: Job) -> tuple[float, bool]:
    """Fit badly placed orientations; return the error [mg] and whether the fit reports them."""
    count, degrees, seed = job
    rng = np.random.default_rng([seed, count])
    case = misplaced(rng, count, degrees)
    found = fitted(case)
    return error_of(found, case, rng), (found is not None and found.name != '12'
                                        and 'only |force| = 1 g' in found.reason)


def of_intervals(job: Job) -> tuple[Floats, Floats]:
    """Return which parameters and corrected readings are inside their 95 % intervals."""
    kind, model, count, noise, seed = job
    rng = np.random.default_rng([seed, count, int(model)])
    case = drawn(rng, count, kind, noise)
    if model == '12':
        case = replace(case, poses=case.poses.with_columns(reference=case.force))
    found = fitted(without_noise(case) if noise == 'not given' else case, model)
    if found is None or found.name != model:  # refused, or the orientations are not used
        return np.zeros(0), np.zeros(0)
    values = case.sensor.values(model)
    deviation = np.sqrt(np.diag(found.covariance))
    force = random_directions(20, rng)
    got = found.correct(case.sensor.reading(force))
    gain = case.sensor.gain
    if model == '9':
        gain = np.linalg.cholesky(gain @ gain.T)
    true = force @ np.linalg.solve(gain, case.sensor.gain).T
    spread = np.sqrt(np.diagonal(found.force_covariance(got), axis1=1, axis2=2))
    inside = np.abs(found.model.vector - values) <= 1.96 * deviation + 1e-12
    return inside.astype(float), (np.abs(got - true) <= 1.96 * spread).ravel().astype(float)


def of_choice(job: Job) -> dict[str, float]:
    """Return the errors of auto and of each fixed model [mg]."""
    kind, count, seed = job
    rng = np.random.default_rng([seed, count, int(kind)])
    case = draw(rng, count, kind)
    fresh = rng.integers(2 ** 32)
    return {model: error_of(fitted(case, model), case, np.random.default_rng(fresh))
            for model in ('auto', '4', '7', '10')}


def of_wiring(job: Job) -> bool:
    """Return whether a fault of the wiring is reported, or none if there is none."""
    fault, seed = job
    rng = np.random.default_rng([seed, len(fault)])
    case = misplaced(rng, 12, float(rng.choice([0.0, 2.0])))
    axes = rng.permutation(3)[:2]
    reading = case.poses.reading.copy()
    if fault == 'sign':
        reading[:, axes[0]] *= -1.0
        words = f'the {"xyz"[axes[0]]} axis has the wrong sign'
    elif fault == 'swap':
        reading[:, axes] = reading[:, axes[::-1]]
        words = f'{"xyz"[min(axes)]} and {"xyz"[max(axes)]} are swapped'
    elif fault == 'units':
        try:
            fit_poses(case.poses.with_columns(reading=9.80665 * reading), G)
        except AccelCalibError as error:
            return 'm/s2' in error.advice
        return False
    found = fit_poses(case.poses.with_columns(reading=reading), G)
    reported = [each.text for each in found.noted if each.kind == 'wiring']
    return not reported if fault == 'none' else bool(reported) and words in reported[0]


def of_recording(job: Job) -> Floats:
    """Return which parameters are inside their intervals if the samples are correlated."""
    correlation, seed = job
    rng = np.random.default_rng([seed, int(1000 * correlation)])
    sensor = draw_sensor(rng, '10')
    force, _, _ = path(spread(16, rng), RATE, 4.0, 1.0)
    white = 3e-3 * rng.normal(size=force.shape)
    kept = np.exp(-1.0 / (RATE * correlation)) if correlation else 0.0
    noise = lfilter([np.sqrt(1.0 - kept ** 2)], [1.0, -kept], white, axis=0)
    columns = {'time': np.arange(len(force)) / RATE, 'reading': sensor.reading(force) + noise}
    poses = capture(Recording(columns, numbered(columns)), G).poses
    try:
        found = fit_poses(poses, G, model='10')
    except AccelCalibError:
        return np.zeros(0)
    away = found.model.vector - sensor.values('10')
    return (np.abs(away) <= 1.96 * np.sqrt(np.diag(found.covariance))).astype(float)


Run = Callable[[Callable[[Job], Any], Sequence[Job]], list[Any]]


def knocks(run: Run, sets: int, seed: int) -> Iterator[Line]:
    """Measure clean and knocked sets."""
    asked = {(12, 0): 0.27, (36, 0): 0.148, (1000, 0): 0.029, (12, 1): 0.33, (36, 3): 0.165}
    for (count, knocked), most in asked.items():
        for measured in (True, False):
            jobs = [(count, knocked, measured, seed + k) for k in range(sets)]
            error, named, lost, best = map(np.array, zip(*run(of_knocks, jobs)))
            what = f'{count} poses, ' + (f'{knocked} knocked by 50 mg' if knocked else 'clean')
            what += '' if measured else ', noise not given'
            middle = float(np.median(error))
            yield Line(f'{what}: error [mg] (of a fit to the right rows)',
                       f'{middle:.3f} ({np.median(best):.3f})', f'≤ {most}', sets, middle <= most)
            if knocked:
                yield _share(f'{what}: each that shows by {_SHOWS_MG:g} mg rejected, no clean one',
                             named, 0.95)
            else:
                yield _share(f'{what}: no pose rejected', ~lost, 0.98)


def bounds(run: Run, sets: int, seed: int) -> Iterator[Line]:
    """Measure parameters against the Cramér-Rao bound."""
    rows = [(12, False), (36, False), (1000, False), (24, True), (36, True), (100, True)]
    for count, scatters in rows:
        jobs = [(count, scatters, seed + k) for k in range(5 * sets)]
        over, stated = zip(*run(of_bound, jobs))
        ratio = float(np.sqrt(np.mean(np.square(over))))
        what = f'{count} poses' + (f', {_SCATTER}' if scatters else '')
        yield Line(f'{what}: RMS error of the parameters over the Cramér-Rao bound',
                   f'{ratio:.3f}', '≤ 1.05', 5 * sets, ratio <= 1.05)
        ratio = float(np.sqrt(np.mean(np.square(stated))))
        yield Line(f'{what}: the same over the stated deviation', f'{ratio:.3f}', '',
                   5 * sets, None)


def placements(run: Run, sets: int, seed: int) -> Iterator[Line]:
    """Measure badly placed orientations."""
    for count in (12, 18, 36):
        error, reported = map(np.array, zip(*run(of_placement, [(count, 2.0, seed + k)
                                                                for k in range(sets)])))
        middle = float(np.median(error))
        what = f'six faces and {count - 6} more placed'
        yield _share(f'{what} 2° off: reported', reported, 1.0)
        yield Line(f'{what} 2° off: error [mg]', f'{middle:.3f}', '≤ 0.4', sets, middle <= 0.4)
        reported = np.array([each for _, each in run(of_placement, [(count, 0.0, seed + k)
                                                                    for k in range(sets)])])
        yield _share(f'{what} well: the orientations are used', ~reported, 0.99)


def intervals(run: Run, sets: int, seed: int) -> Iterator[Line]:
    """Measure how often 95 % intervals contain the truth."""
    rows = [(kind, model, count, 'measured') for kind, model in
            (('4', '4'), ('7', '7'), ('10', '9'), ('10', '10'), ('12', '12'))
            for count in (12, 36)]
    rows += [('10', '10', count, noise) for count in (12, 36, 100)
             for noise in ('differs', 'not given', 'understated', 'scatter')]
    rows += [('12', '12', count, 'scatter') for count in (12, 36)]
    words = {'measured': '', 'differs': ', noise that differs by pose (e-fold)',
             'not given': ', noise not given',
             'understated': ', a third of the noise stated', 'scatter': f', {_SCATTER}'}
    for kind, model, count, noise in rows:
        jobs = [(kind, model, count, noise, seed + k) for k in range(10 * sets)]
        values, readings = zip(*run(of_intervals, jobs))
        fitted_sets = [part for part in values if len(part)]
        each = 100.0 * np.mean(fitted_sets, axis=0)
        corrected = 100.0 * np.mean([part for part in readings if len(part)])
        met = bool(np.all((each >= 93.0) & (each <= 97.0)) and 93.0 <= corrected <= 97.0)
        yield Line(f'model {model}, {count} poses{words[noise]}: 95 % intervals contain the '
                   'truth', f'parameters {np.min(each):.1f} to {np.max(each):.1f} %, corrected '
                   f'readings {corrected:.1f} %', '93 to 97 %', len(fitted_sets), met)


def wiring(run: Run, sets: int, seed: int) -> Iterator[Line]:
    """Measure how often faults of the wiring are reported."""
    words = {'sign': 'one axis with the wrong sign', 'swap': 'two axes swapped',
             'units': 'm/s² given as g', 'none': 'nothing wrong'}
    for fault, what in words.items():
        right = np.array(run(of_wiring, [(fault, seed + k) for k in range(sets)]))
        yield _share(f'known orientations, {what}: '
                     + ('nothing reported' if fault == 'none' else 'reported'), right,
                     0.99 if fault == 'none' else 1.0)


def recordings(run: Run, sets: int, seed: int) -> Iterator[Line]:
    """Measure intervals from recordings whose samples are correlated."""
    for correlation in (0.0, 0.02, 0.05, 0.2):
        held = [part for part in run(of_recording, [(correlation, seed + k)
                                                    for k in range(2 * sets)]) if len(part)]
        each = 100.0 * np.mean(held, axis=0)
        yield Line(f'recording of 16 rests of 4 s, samples correlated over {correlation:g} s: 95 '
                   '% intervals contain the truth', f'parameters {np.min(each):.1f} to '
                   f'{np.max(each):.1f} %, mean {np.mean(each):.1f} %', '93 to 97 %', len(held),
                   93.0 <= float(np.mean(each)) <= 97.0)


def choices(run: Run, sets: int, seed: int) -> Iterator[Line]:
    """Measure auto against the best fixed model."""
    for kind in ('4', '7', '10'):
        for count in (6, 8, 9, 10, 12, 18, 24, 36, 60):
            found = run(of_choice, [(kind, count, seed + k) for k in range(2 * sets)])
            median = {name: float(np.median([one[name] for one in found])) for name in found[0]}
            best = min(('4', '7', '10'), key=lambda name: median[name])
            ratio = median['auto'] / median[best]
            yield Line(f'a {kind}-parameter sensor, {count} poses: error of auto over that of the '
                       f'best fixed model', f'{ratio:.3f} ({median["auto"]:.3f} mg; model {best})',
                       '≤ 1.05', 2 * sets, ratio <= 1.05)


def _share(what: str, good: Floats, least: float) -> Line:
    part = float(np.mean(good))
    return Line(what, f'{100.0 * part:.1f} %', f'≥ {100.0 * least:g} %', len(good), part >= least)


ROWS = {'knocks': knocks, 'bounds': bounds, 'placements': placements, 'intervals': intervals,
        'recordings': recordings, 'wiring': wiring, 'choices': choices}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, sets=200, seed=1, jobs=2)
    options.add_argument('--only', choices=ROWS, action='append', help='only these; repeatable')
    given = options.parse_args(arguments)
    lines: list[Line] = []
    with multiprocessing.get_context('spawn').Pool(given.jobs) as pool:
        def run(one: Callable[[Job], Any], jobs: Sequence[Job]) -> list[Any]:
            return pool.map(one, jobs, chunksize=10)
        for name in given.only or ROWS:
            lines += ROWS[name](run, given.sets, 100_000 * given.seed)
            print(name, file=sys.stderr, flush=True)
    command = (f'python benchmarks/robustness.py --sets {given.sets} --seed {given.seed}'
               + ''.join(f' --only {name}' for name in given.only or ()))
    text = (f'# Figures of trust\n\n{__doc__.strip()}\n\nMade by `{command} --markdown FILE`.\n\n'
            f'{table(lines)}\n')
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
