# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Trust in a fit: outliers, bad placement, stated uncertainty, choice of the model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from accel_calib.calibration import Calibration, fit_poses
from accel_calib.effects.simulate import path
from accel_calib.errors import AccelCalibError
from accel_calib.statistics import rms
from accel_calib.stillness import capture
from accel_calib.table import Floats, numbered, Recording
from accel_calib.units import units_of
from figures import Frame, Line, table
import numpy as np
from sensors import (
    Case, draw_case, draw_noise, draw_sensor, knock, length_error_mg, misplace, NOISE,
    random_directions, spread)

G = units_of('g')
SHOWS_MG = 2.0
"""Change of |force| from which a knock must be detected [mg]."""

QUIET = 5.0
"""Ratio of the scatter of poses to the noise that their samples show."""

RATE = 100.0
"""Samples per second of a recording."""

NOISES = {'measured': '', 'differs': ', noise that differs by pose (e-fold)',
          'not given': ', noise not given', 'understated': ', a third of the noise stated',
          'scatter': f', scatter of {QUIET:g} times the noise, which differs (e-fold)'}
"""What the poses state of their noise, in words."""

FAULTS = {'sign': 'one axis with the wrong sign', 'swap': 'two axes swapped',
          'units': 'm/s² given as g', 'none': 'nothing wrong'}


def fit(case: Case, model: str = 'auto') -> Calibration | None:
    """Fit a set; None if the fit is refused."""
    try:
        return fit_poses(case.poses, G, model=model)
    except AccelCalibError:
        return None


def error_mg(found: Calibration | None, case: Case, rng: np.random.Generator) -> float:
    """Return the RMS error of |a| on fresh directions [mg]; infinite if the fit was refused."""
    if found is None:
        return np.inf
    return length_error_mg(found.correct(case.sensor.reading(random_directions(300, rng))))


def without_noise(case: Case) -> Case:
    """Return the case with poses that state no noise."""
    return replace(case, poses=case.poses.without_columns('std', 'count'))


def draw(rng: np.random.Generator, count: int, kind: str, noise: str) -> Case:
    """Draw a set of a kind of sensor with one of `NOISES`."""
    if noise == 'differs':
        return draw_case(rng, count, kind, noise=NOISE * np.exp(rng.normal(size=count)))
    if noise == 'scatter':
        quiet = NOISE / QUIET * np.exp(rng.normal(size=count))
        return draw_case(rng, count, kind, noise=quiet, scatter=NOISE)
    return draw_case(rng, count, kind, stated=1.0 / 3.0 if noise == 'understated' else 1.0)


def knocks_of(count: int, knocked: int, measured: bool, seed: int
              ) -> tuple[float, bool, bool, float]:
    """
    Fit a set with knocked poses.

    Returns
    -------
    float, bool, bool, float
        Error [mg]; whether exactly the knocked poses are rejected, those that show little aside;
        whether a clean pose is rejected; error of a fit to the clean poses [mg].

    """
    rng = np.random.default_rng([seed, count, knocked])
    clean = draw_case(rng, count)
    case = knock(clean, rng, knocked) if knocked else clean
    kept = np.flatnonzero(case.shows_mg == 0.0)
    best = fit(replace(case, poses=case.poses.take(kept)), '10')
    case = case if measured else without_noise(case)
    found = fit(case, '10')
    named = set() if found is None else {rejected.row - 1 for rejected in found.rejected}
    plain = set(np.flatnonzero(case.shows_mg >= SHOWS_MG))
    lost = bool(named & set(kept))
    return (error_mg(found, case, rng), plain <= named and not lost and found is not None, lost,
            error_mg(best, case, rng))


def knocks(frame: Frame, sets: int, seed: int) -> Iterator[Line]:
    """Yield the lines of clean and knocked sets."""
    asked = {(12, 0): 0.27, (36, 0): 0.148, (1000, 0): 0.029, (12, 1): 0.33, (36, 3): 0.165}
    for (count, knocked), most in asked.items():
        for measured in (True, False):
            error, named, lost, best = map(np.array, zip(*frame.run_sets(
                knocks_of, sets, count, knocked, measured, first=seed)))
            what = f'{count} poses, ' + (f'{knocked} knocked by 50 mg' if knocked else 'clean')
            what += '' if measured else ', noise not given'
            middle = float(np.median(error))
            yield Line(f'{what}: error [mg] (of a fit to the right rows)',
                       f'{middle:.3f} ({np.median(best):.3f})', sets, f'≤ {most}',
                       middle <= most)
            if knocked:
                yield share(f'{what}: each that shows by {SHOWS_MG:g} mg rejected, no clean one',
                            named, 0.95)
            else:
                yield share(f'{what}: no pose rejected', ~lost, 0.98)


def share(what: str, good: Sequence[bool] | Floats, least: float) -> Line:
    part = float(np.mean(good))
    return Line(what, f'{100.0 * part:.1f} %', len(good), f'≥ {100.0 * least:g} %', part >= least)


def bound_of(count: int, noise: str, seed: int) -> tuple[Floats, Floats]:
    """Return the errors of model 10 over their Cramér-Rao bounds and over their stated sizes."""
    rng = np.random.default_rng([seed, count])
    case = draw(rng, count, '10', noise)
    found = fit(case, '10')
    assert found is not None
    jacobian = case.sensor.length_slopes(case.force) / case.noise[:, np.newaxis]
    bound = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    away = found.model.vector - case.sensor.values('10')
    return away / bound, away / np.sqrt(np.diag(found.covariance))


def bounds(frame: Frame, sets: int, seed: int) -> Iterator[Line]:
    """Yield the lines of parameters against the Cramér-Rao bound."""
    sets = 5 * sets
    for noise, counts in (('measured', (12, 36, 1000)), ('scatter', (24, 36, 100))):
        for count in counts:
            over, stated = zip(*frame.run_sets(bound_of, sets, count, noise, first=seed))
            what, ratio = f'{count} poses{NOISES[noise]}', rms(np.array(over))
            yield Line(f'{what}: RMS error of the parameters over the Cramér-Rao bound',
                       f'{ratio:.3f}', sets, '≤ 1.05', ratio <= 1.05)
            yield Line(f'{what}: the same over the stated deviation',
                       f'{rms(np.array(stated)):.3f}', sets)


def placement_of(count: int, degrees: float, seed: int) -> tuple[float, bool]:
    """Fit badly placed orientations; return the error [mg] and whether the fit reports them."""
    rng = np.random.default_rng([seed, count])
    case = misplace(rng, count, degrees)
    found = fit(case)
    return error_mg(found, case, rng), (found is not None and found.name != '12'
                                        and 'only |force| = 1 g' in found.reason)


def placements(frame: Frame, sets: int, seed: int) -> Iterator[Line]:
    """Yield the lines of badly placed orientations."""
    for count in (12, 18, 36):
        what = f'six faces and {count - 6} more placed'
        (error, reported), (_, wrongly) = (map(np.array, zip(*frame.run_sets(
            placement_of, sets, count, degrees, first=seed))) for degrees in (2.0, 0.0))
        middle = float(np.median(error))
        yield share(f'{what} 2° off: reported', reported, 1.0)
        yield Line(f'{what} 2° off: error [mg]', f'{middle:.3f}', sets, '≤ 0.4',
                   middle <= 0.4)
        yield share(f'{what} well: the orientations are used', ~wrongly, 0.99)


def interval_of(kind: str, model: str, count: int, noise: str, seed: int
                ) -> tuple[Floats, Floats]:
    """Return which parameters and corrected readings are inside their 95 % intervals."""
    rng = np.random.default_rng([seed, count, int(model)])
    case = draw(rng, count, kind, noise)
    if model == '12':
        case = replace(case, poses=case.poses.with_columns(reference=case.force))
    found = fit(without_noise(case) if noise == 'not given' else case, model)
    if found is None or found.name != model:  # refused, or the orientations are not used
        return np.zeros(0), np.zeros(0)
    force = random_directions(20, rng)
    got = found.correct(case.sensor.reading(force))
    gain = case.sensor.gain
    if model == '9':
        gain = np.linalg.cholesky(gain @ gain.T)
    true = force @ np.linalg.solve(gain, case.sensor.gain).T
    deviation = np.sqrt(np.diagonal(found.force_covariance(got), axis1=1, axis2=2))
    inside = (np.abs(found.model.vector - case.sensor.values(model))
              <= 1.96 * np.sqrt(np.diag(found.covariance)) + 1e-12)
    return inside.astype(float), (np.abs(got - true) <= 1.96 * deviation).ravel().astype(float)


def intervals(frame: Frame, sets: int, seed: int) -> Iterator[Line]:
    """Yield the lines of how often 95 % intervals contain the truth."""
    rows = [(kind, model, count, 'measured') for kind, model in
            (('4', '4'), ('7', '7'), ('10', '9'), ('10', '10'), ('12', '12'))
            for count in (12, 36)]
    rows += [('10', '10', count, noise) for count in (12, 36, 100)
             for noise in ('differs', 'not given', 'understated', 'scatter')]
    rows += [('12', '12', count, 'scatter') for count in (12, 36)]
    for row in rows:
        values, readings = zip(*frame.run_sets(interval_of, 10 * sets, *row, first=seed))
        fitted = [part for part in values if len(part)]
        each = 100.0 * np.mean(fitted, axis=0)
        corrected = 100.0 * np.mean([part for part in readings if len(part)])
        _, model, count, noise = row
        met = bool(np.all((each >= 93.0) & (each <= 97.0)) and 93.0 <= corrected <= 97.0)
        yield Line(f'model {model}, {count} poses{NOISES[noise]}: 95 % intervals contain the '
                   'truth', f'parameters {np.min(each):.1f} to {np.max(each):.1f} %, corrected '
                   f'readings {corrected:.1f} %', len(fitted), '93 to 97 %', met)


def recording_of(correlation: float, seed: int) -> Floats:
    """Return which parameters are inside their intervals if the samples are correlated [s]."""
    rng = np.random.default_rng([seed, int(1000 * correlation)])
    sensor = draw_sensor(rng)
    force, _, _ = path(spread(16, rng), RATE, 4.0, 1.0)
    noise = 3e-3 * draw_noise(rng, len(force), RATE, correlation)
    columns = {'time': np.arange(len(force)) / RATE, 'reading': sensor.reading(force) + noise}
    try:
        found = fit_poses(capture(Recording(columns, numbered(columns)), G).poses, G, model='10')
    except AccelCalibError:
        return np.zeros(0)
    away = found.model.vector - sensor.values('10')
    return (np.abs(away) <= 1.96 * np.sqrt(np.diag(found.covariance))).astype(float)


def recordings(frame: Frame, sets: int, seed: int) -> Iterator[Line]:
    """Yield the lines of intervals from recordings whose samples are correlated."""
    for correlation in (0.0, 0.02, 0.05, 0.2):
        inside = [part for part in frame.run_sets(
            recording_of, 2 * sets, correlation, first=seed) if len(part)]
        each = 100.0 * np.mean(inside, axis=0)
        yield Line(f'recording of 16 rests of 4 s, samples correlated over {correlation:g} s: 95 '
                   '% intervals contain the truth', f'parameters {np.min(each):.1f} to '
                   f'{np.max(each):.1f} %, mean {np.mean(each):.1f} %', len(inside), '93 to 97 %',
                   93.0 <= float(np.mean(each)) <= 97.0)


def wiring_of(fault: str, seed: int) -> bool:
    """Return whether a fault of the wiring is reported, or none if there is none."""
    rng = np.random.default_rng([seed, len(fault)])
    case = misplace(rng, 12, float(rng.choice([0.0, 2.0])))
    axes = rng.permutation(3)[:2]
    reading, words = case.poses.reading.copy(), ''
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


def wiring(frame: Frame, sets: int, seed: int) -> Iterator[Line]:
    """Yield the lines of how often faults of the wiring are reported."""
    for fault, what in FAULTS.items():
        right = frame.run_sets(wiring_of, sets, fault, first=seed)
        sound = fault == 'none'
        yield share(f'known orientations, {what}: {"nothing reported" if sound else "reported"}',
                    right, 0.99 if sound else 1.0)


def choice_of(kind: str, count: int, seed: int) -> dict[str, float]:
    """Return the errors of auto and of each fixed model [mg]."""
    rng = np.random.default_rng([seed, count, int(kind)])
    case = draw_case(rng, count, kind)
    fresh = rng.integers(2 ** 32)
    return {model: error_mg(fit(case, model), case, np.random.default_rng(fresh))
            for model in ('auto', '4', '7', '10')}


def choices(frame: Frame, sets: int, seed: int) -> Iterator[Line]:
    """Yield the lines of auto against the best fixed model."""
    for kind in ('4', '7', '10'):
        for count in (6, 8, 9, 10, 12, 18, 24, 36, 60):
            found = frame.run_sets(choice_of, 2 * sets, kind, count, first=seed)
            median = {name: float(np.median([one[name] for one in found])) for name in found[0]}
            best = min(('4', '7', '10'), key=lambda name: median[name])
            ratio = median['auto'] / median[best]
            yield Line(f'a {kind}-parameter sensor, {count} poses: error of auto over that of the '
                       f'best fixed model', f'{ratio:.3f} ({median["auto"]:.3f} mg; model {best})',
                       2 * sets, '≤ 1.05', ratio <= 1.05)


ROWS = {'knocks': knocks, 'bounds': bounds, 'placements': placements, 'intervals': intervals,
        'recordings': recordings, 'wiring': wiring, 'choices': choices}


def robustness(frame: Frame, sets: int = 200, seed: int = 1, only: tuple[str, ...] = tuple(ROWS)
               ) -> Iterator[str]:
    yield table(line for name in only for line in ROWS[name](frame, sets, 100_000 * seed))
