# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Stillness detector on simulated and on real recordings, beside simpler rules.

A pose belongs to the rest that it overlaps most, if that is more than half of the pose; otherwise
it is false. Its error is its mean less the true specific force of that rest; the error of its norm
is |mean| - 1. The normalised error is error / stated noise; its standard deviation is 1 if the
statement is right::

    python benchmarks/stillness.py --sets 60 --markdown docs/figures/stillness.md

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import sys
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from accel_calib.calibration import fit_poses  # noqa: E402
from accel_calib.errors import AccelCalibError  # noqa: E402
from accel_calib.logs import read_recording  # noqa: E402
from accel_calib.stillness import CaptureSettings, StillDetector  # noqa: E402
from accel_calib.table import Floats, numbered, Poses  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, markdown, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402
from scipy.signal import butter, lfilter  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from stillness_case import (  # noqa: E402
    Case, case_of, gyro, KINDS, ours, Pose, Sensor, swinging, variance)

DATA = ROOT.parent / 'shared' / 'data'

RULES: dict[str, Callable[[Case], list[Pose]]] = {
    'ours': lambda case: ours(case, gyro=False),
    'ours, gyro': lambda case: ours(case, gyro=True),
    'variance': variance,
    'gyro': gyro}

RECORDINGS = (('mpu9150_imu0', 'm/s2', 21), ('mpu9150_imu1', 'm/s2', 21),
              ('xsens_mti_counts', 'native', 38))
"""Name, unit, and the number of poses that the person took."""

WHAT = {'plain': 'turned by hand', 'tremor': 'also held in the hand, tremor of 1 to 10 mg',
        'turning': 'also turned at 0.5 to 5 °/s', 'footsteps': 'steps of 2 to 20 mg beside it',
        'motor': 'a motor of 2 to 32 mg beside it'}

ABOUT = """# Figures of the stillness detector

Made by `python benchmarks/stillness.py {command} --markdown FILE`.
Each recording has ten rests of 2.5 to 8 s at 50 to 1000 Hz, noise that is white or has a
correlation time of 20 or 200 ms, and a gyro with 2 mrad/s of noise and a bias. Two rules beside
ours know that the recording begins with a rest: *variance* uses three times the standard deviation
of the first two seconds, as imu_tk and others do; *gyro* requires a mean rate within 0.5 °/s of
that of the first two seconds. In most of a false pose the sensor moves. The normalised error is
the error of a pose mean over its stated noise std/√count, without the largest 1 %, which show
under *largest*; its standard deviation should be 1. For false poses it is the error against the
true force in their middle: a tremor below the noise of the sensor does no harm to a mean. Rests
beside footsteps and a motor count as rests, because their means are right."""

ABOUT_FIRST = """\
Each recording lasts 12 s, at 100, 200 or 1000 Hz, in one orientation, with 2 mg of white noise
unless another noise is named. The sensor has not rested before. The frequency wanders by 5 %, at
most by 0.5 Hz. *captured* is the share of recordings with a pose. A tremor faster than 5 Hz
averages out over a chunk like vibration and counts as rest; its effect on a mean is small.
Vibration within about 5 Hz of a multiple of the sample rate looks like shaking in the samples, and
is refused. This costs rests beside a motor at 50 Hz below."""

FIRST_HZ = (100.0, 200.0, 1000.0)
FIRST_S = 12.0
FIRST_NOISE = 2e-3

LIMITS = """\
Limits: beside a motor the stated noise is too large, because vibration averages out faster than
the noise it resembles. With 50 mg of noise, a turn that lasts longer than the correlation time of
200 ms is not always distinguished from noise. Most rests of a few seconds are refused there
without a gyro, because their samples cannot show that the sensor was not turned. Steps that are
clearly larger than the noise of a quiet sensor cost rests that a threshold learned from the steps
keeps. A tremor below about twice the noise counts as rest; against the true force such poses are
as good as their stated noise."""

ABOUT_REAL = """\
A fit of 10 parameters to all poses. The truth of these recordings is not known. The gyro of the
Xsens recording is in counts, so that a threshold in °/s does not apply."""


class Score(NamedTuple):
    """
    The poses of a rule in one recording, beside the truth.

    Parameters
    ----------
    moving, taken : int
        Samples while moving, and those of them in poses.
    resting, used : int
        Samples at rest, and those of them in poses.
    false : (m, 3) array
        Normalised errors of false poses.
    errors, norms, scores : (m, 3), (m,), (m, 3) arrays
        Errors of pose means, errors of their norms [g], and normalised errors.
    rests, missed : int
        Rests, and those without a pose.

    """

    moving: int
    taken: int
    resting: int
    used: int
    false: Floats
    errors: Floats
    norms: Floats
    scores: Floats
    rests: int
    missed: int


def score(case: Case, poses: Sequence[Pose]) -> Score:
    """Compare poses with the truth."""
    inside = np.zeros(len(case.time), dtype=bool)
    errors, norms, scores, false = [], [], [], []
    hit: set[int] = set()
    for pose in poses:
        first, last = np.searchsorted(case.time, [pose.start - 1e-9, pose.end + 1e-9])
        inside[first:last] = True
        common = np.minimum(case.rests[:, 1], last) - np.maximum(case.rests[:, 0], first)
        best = int(np.argmax(common))
        if common[best] <= 0.5 * (last - first):
            false.append((pose.mean - case.force[(first + last) // 2]) / pose.noise)
            continue
        error = pose.mean - case.force[case.rests[best, 0]]
        hit.add(best)
        errors.append(error)
        norms.append(np.linalg.norm(pose.mean) - 1.0)
        scores.append(error / pose.noise)
    still = ~case.moving
    return Score(int(case.moving.sum()), int((inside & case.moving).sum()), int(still.sum()),
                 int((inside & still).sum()), np.array(false).reshape(-1, 3),
                 np.array(errors).reshape(-1, 3),
                 np.array(norms), np.array(scores).reshape(-1, 3), len(case.rests),
                 len(case.rests) - len(hit))


class Sum(NamedTuple):
    """Scores of many recordings: shares, false poses, errors [mg], normalised errors."""

    taken: float
    used: float
    false: int
    missed: float
    error: float
    worst: float
    norm: float
    normalised: float
    of_false: float


def summed(scores: Sequence[Score]) -> Sum:
    """Return the sum of the scores of many recordings."""
    errors = 1e3 * np.concatenate([each.errors for each in scores])
    norms = 1e3 * np.concatenate([each.norms for each in scores])
    return Sum(sum(x.taken for x in scores) / max(sum(x.moving for x in scores), 1),
               sum(x.used for x in scores) / sum(x.resting for x in scores),
               sum(len(x.false) for x in scores),
               sum(x.missed for x in scores) / sum(x.rests for x in scores),
               float(np.median(np.abs(errors))) if len(errors) else np.nan,
               float(np.max(np.abs(errors), initial=0.0)), _rms(norms, 1.0),
               _rms(np.concatenate([each.scores for each in scores]), 0.99),
               _rms(np.concatenate([each.false for each in scores]), 0.99))


def _rms(values: Floats, share: float) -> float:
    """Return the root mean square of the smallest values, as many as this share."""
    squares = np.sort(np.square(values), axis=None)
    kept = squares[:int(np.ceil(share * len(squares)))]
    return float(np.sqrt(np.mean(kept))) if len(kept) else np.nan


def measured(sets: int, seed: int, noisy: bool) -> dict[tuple[str, str], Sum]:
    """Return the sums of all rules on recordings of all kinds."""
    found: dict[tuple[str, str], list[Score]] = {}
    for kind in KINDS:
        for number in range(sets):
            case = case_of(kind, seed, number, noisy)
            for name, rule in RULES.items():
                found.setdefault((kind, name), []).append(score(case, rule(case)))
        print(f'{kind}: {sets} recordings', file=sys.stderr, flush=True)
    return {key: summed(scores) for key, scores in found.items()}


class Disturbance(NamedTuple):
    """
    A disturbance from the first second on.

    Parameters
    ----------
    what : str
        The disturbance.
    kind : {'swing', 'white', 'filtered'}
        An oscillation, or noise that is white or has passed a low-pass filter.
    band, size : (2,) tuple of float
        Frequencies [Hz] and amplitudes or standard deviations [g].
    rest : bool or None
        Whether it counts as rest; None: nothing is asked.

    """

    what: str
    kind: str
    band: tuple[float, float]
    size: tuple[float, float]
    rest: bool | None


FIRST = (
    Disturbance('shaking at 1 to 5 Hz, 20 to 200 mg', 'swing', (1.0, 5.0), (0.02, 0.2),
                rest=False),
    Disturbance('tremor at 8 to 12 Hz, 5 to 50 mg', 'swing', (8.0, 12.0), (5e-3, 0.05), rest=None),
    Disturbance('vibration at 30 to 80 Hz, 20 mg', 'swing', (30.0, 80.0), (0.02, 0.02), rest=True),
    Disturbance('white noise of 20 to 50 mg', 'white', (0.0, 0.0), (0.02, 0.05), rest=True),
    Disturbance('noise of 5 to 20 mg, low-pass at 5 to 40 Hz', 'filtered', (5.0, 40.0),
                (5e-3, 0.02), rest=True))


def first_lines(sets: int, seed: int) -> list[Line]:
    """Return how often a sensor that never rested before is captured, for each disturbance."""
    lines = []
    for index, each in enumerate(FIRST):
        share = np.mean([_captured(each, np.random.default_rng([seed, index, number]))
                         for number in range(sets)])
        asked = {True: '≥ 95 %', False: '0 %', None: ''}[each.rest]
        met = None if each.rest is None else bool(share >= 0.95 if each.rest else share == 0.0)
        lines.append(Line(f'{each.what}: captured', f'{share:.0%}', asked, sets, met))
    return lines


def _captured(each: Disturbance, rng: np.random.Generator) -> bool:
    rate = float(rng.choice(FIRST_HZ))
    count = int(FIRST_S * rate)
    force = Rotation.random(random_state=rng).apply([0.0, 0.0, 1.0])
    frequency, size = rng.uniform(*each.band), np.exp(rng.uniform(*np.log(each.size)))
    own = rng.normal(size=(2 * count, 3))
    if each.kind == 'filtered':
        own = lfilter(*butter(2, frequency, fs=rate), own, axis=0)
    own = own[count:] * (FIRST_NOISE if each.kind == 'swing' else size) / own[count:].std()
    if each.kind == 'swing':
        own += swinging(rng, count, rate, size, (frequency, frequency),
                        min(0.05 * frequency, 0.5))
    samples = np.full((count, 9), np.nan)
    samples[:, 0], samples[:, 1:4] = np.arange(count) / rate, force + own
    detector = StillDetector(CaptureSettings(), units_of('g'))
    detector.push(samples)
    detector.close()
    return bool(detector.dwells())


def compared(found: dict[tuple[str, str], Sum]) -> str:
    """Return the table of all rules on all kinds, as Markdown."""
    heads = ('recordings', 'rule', 'moving samples in poses', 'rest used', 'rests missed',
             'false poses',
             'median error of a mean, mg', 'largest, mg',
             'RMS error of its norm, mg', 'normalised error', 'the same of false poses')
    return markdown(heads, (
        (WHAT[kind], rule, f'{x.taken:.2%}', f'{x.used:.1%}', f'{x.missed:.1%}', x.false,
         f'{x.error:.3f}', f'{x.worst:.1f}', f'{x.norm:.3f}', f'{x.normalised:.2f}',
         _figure(x.of_false)) for (kind, rule), x in found.items()))


def _figure(value: float) -> str:
    return f'{value:.2f}' if np.isfinite(value) else ''


def lines_of(found: dict[tuple[str, str], Sum], noise: str, sets: int) -> list[Line]:
    """Return what is asked of the detector beside what is measured."""
    lines = []
    for rule in ('ours', 'ours, gyro'):
        turning = found['turning', rule]
        lines.append(Line(f'{noise}, {rule}: poses taken while turning slowly',
                          str(turning.false), '0', sets, turning.false == 0))
        for kind in KINDS:
            x = found[kind, rule]
            lines.append(Line(f'{noise}, {rule}, {WHAT[kind]}: normalised error of pose means',
                              f'{x.normalised:.2f}', '0.85 to 1.15', sets,
                              0.85 <= x.normalised <= 1.15))
    return lines


def real_cases(folder: Path) -> list[tuple[str, Case, int]]:
    """Return the real recordings, in g if their unit is known, and their numbers of poses."""
    found = []
    for name, unit, poses in RECORDINGS:
        recording = read_recording(folder / f'{name}.csv')
        units = units_of(unit)  # type: ignore[arg-type]
        native = units.name == 'native'
        reading = recording.reading if native else units.to_g(recording.reading)
        time = recording['time']
        rate = recording.columns.get('rate', np.full_like(reading, np.nan))
        nothing = np.zeros((0, 2), dtype=np.intp)
        sensor = Sensor(0.0, 1.0 / float(np.median(np.diff(time))), 0.0)
        found.append((name, Case('real', sensor, 0.0, time, reading, rate, reading,
                                 nothing, np.zeros(len(time), dtype=bool),
                                 'native' if native else 'g'), poses))
    return found


def table_of_real(folder: Path) -> str:
    """Return the table of all rules on the real recordings, as Markdown."""
    rows = []
    for name, case, wanted in real_cases(folder):
        for rule, find in RULES.items():
            poses = find(case)
            used = sum((case.time >= each.start) & (case.time <= each.end) for each in poses)
            rows.append((name, rule, len(poses), wanted, f'{np.mean(used):.1%}',
                         *_fitted(poses, case.units)))
    return markdown(('recording', 'rule', 'poses', 'taken by hand', 'samples used',
                     'residual, mg', 'chi² per degree of freedom'), rows)


def _fitted(poses: Sequence[Pose], unit: str) -> tuple[str, str]:
    if not poses:
        return 'no poses', ''
    columns = {'time': np.array([each.start for each in poses]),
               'reading': np.array([each.mean for each in poses]),
               'std': np.array([each.noise for each in poses]), 'count': np.ones(len(poses))}
    try:
        quality = fit_poses(Poses(columns, numbered(columns)), units_of(unit),  # type: ignore
                            model='10', method='algebraic').quality
    except AccelCalibError as error:
        return f'no fit ({type(error).__name__})', ''
    chi2 = quality.chi2_per_dof
    return f'{quality.rms_after_mg:.3f}', '' if chi2 is None else f'{chi2:.1f}'


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, seed=1)
    options.add_argument('--sets', type=int, default=60, help='recordings of each kind')
    options.add_argument('--data', type=Path, default=DATA, help='folder of the real recordings')
    given = options.parse_args(arguments)
    usual = measured(given.sets, given.seed, noisy=False)
    noisy = measured(given.sets, given.seed, noisy=True)
    lines = lines_of(usual, 'noise 0.3 to 5 mg', given.sets)
    lines += lines_of(noisy, 'noise 50 mg', given.sets)
    parts = [ABOUT.format(command=f'--sets {given.sets} --seed {given.seed}'), table(lines),
             LIMITS, '## Disturbed from the first second on',
             f'{ABOUT_FIRST}\n\n{table(first_lines(given.sets, given.seed))}',
             '## Noise 0.3 to 5 mg', compared(usual), '## Noise 50 mg',
             compared(noisy)]
    parts += ['## Real recordings', f'{ABOUT_REAL}\n\n{table_of_real(given.data)}'
              if given.data.is_dir() else f'Not measured: {given.data} is missing.']
    text = '\n\n'.join(parts) + '\n'
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
