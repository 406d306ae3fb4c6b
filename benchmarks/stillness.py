# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Stillness detector on simulated and on real recordings, beside simpler rules.

A simulated recording is a sequence of stretches: the sensor rests, is carried by hand to the next
orientation, and so on. By its kind it is also held in the hand, turned slowly, beside a person who
walks by, or beside a motor. Forces are in g, all else is SI.

A rule takes a recording and returns poses. A pose belongs to the rest that it overlaps most, if
that is more than half of the pose; otherwise it is false. Its error is its mean less the true
specific force of that rest; the error of its norm is |mean| - 1. The normalised error is error /
stated noise; its standard deviation is 1 if the statement is right.

"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
import itertools
from typing import Any, Literal, NamedTuple

from accel_calib.calibration import fit_poses
from accel_calib.errors import AccelCalibError
from accel_calib.geometry import unit
from accel_calib.logs import read_recording
from accel_calib.stillness import capture, CaptureSettings, StillDetector
from accel_calib.table import Floats
from accel_calib.units import UnitName, units_of
from figures import check, DATA, Frame, Line, markdown, share, table
import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation
from shared import G, poses_of, rows_of, samples_of

KINDS = {'plain': 'turned by hand', 'tremor': 'also held in the hand, tremor of 1 to 10 mg',
         'turning': 'also turned at 0.5 to 5 °/s', 'footsteps': 'steps of 2 to 20 mg beside it',
         'motor': 'a motor of 2 to 32 mg beside it'}
NOISES_MG = (0.3, 1.0, 3.0, 5.0)
NOISY_MG = 50.0
RATES_HZ = (50.0, 100.0, 200.0, 1000.0)
CORRELATION_S = (0.0, 0.0, 0.02, 0.2)

REST, CARRY, OTHER = 0, 1, 2
"""Phases of a recording."""

GYRO_NOISE, GYRO_BIAS = 2e-3, 1.5e-2
"""Standard deviations of the gyro, of a sample and of its bias by axis [rad/s]."""

RECORDINGS: tuple[tuple[str, UnitName, int], ...] = (
    ('mpu9150_imu0', 'm/s2', 21), ('mpu9150_imu1', 'm/s2', 21),
    ('xsens_mti_counts', 'native', 38))
"""Name, unit, and the number of poses that the person took."""


# --------------------------------------------------------------------------- simulated recordings

@dataclass(frozen=True)
class Case:
    """A recording of n samples with its truth."""

    rate_hz: float
    time: Floats  # (n,) stamps [s]
    reading: Floats  # (n, 3)
    rate: Floats  # (n, 3) angular rates [rad/s]
    force: Floats  # (n, 3) true specific force without vibration
    rests: NDArray[Any]  # (m, 2) first sample of each rest, and the one after its last
    moving: NDArray[np.bool_]  # (n,) whether the sensor is carried, held or turned
    units: Literal['g', 'native'] = 'g'


def draw_case(kind: str, seed: int, noisy: bool, number: int) -> Case:
    """Draw a recording of a kind."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), number, noisy])
    noise = 1e-3 * float(NOISY_MG if noisy else rng.choice(NOISES_MG))
    rate_hz, correlation = float(rng.choice(RATES_HZ)), float(rng.choice(CORRELATION_S))
    # Tremor, steps and vibration in g, turning in °/s.
    size = {'plain': 0.0, 'tremor': 1e-3 * 10.0**rng.uniform(0.0, 1.0),
            'turning': 0.5 * 10.0**rng.uniform(0.0, 1.0),
            'footsteps': 1e-3 * 10.0**rng.uniform(0.3, 1.3),
            'motor': 1e-3 * 10.0**rng.uniform(0.3, 1.5)}[kind]
    turn, phase = draw_motion(rng, kind, size, rate_hz)
    force = turn.inv().apply([0.0, 0.0, 1.0])
    reading = force + draw_shaking(rng, kind, size, phase, rate_hz)
    reading = reading + noise * draw_noise(rng, len(force), rate_hz, correlation)
    # rotvec of R(k)⁻¹ R(k+1) is the body's own rate.
    steps = (turn[:-1].inv() * turn[1:]).as_rotvec() * rate_hz
    rate = np.vstack([steps[:1], steps]) + rng.normal(size=3) * GYRO_BIAS
    rate += GYRO_NOISE * rng.normal(size=rate.shape)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(phase)) + 1, [len(phase)]])
    rests = [(a, b) for a, b in itertools.pairwise(edges) if phase[a] == REST]
    return Case(rate_hz, np.arange(len(force)) / rate_hz, reading, rate, force, np.array(rests),
                phase != REST)


def draw_motion(rng: np.random.Generator, kind: str, size: float, rate_hz: float
                ) -> tuple[Rotation, NDArray[np.intp]]:
    """Return the attitude and the phase of each sample."""
    stretches: list[tuple[int, float]] = []  # phase and duration [s]
    for _ in range(10):
        stretches += [(REST, rng.uniform(2.5, 8.0)), (CARRY, rng.uniform(0.8, 2.0))]
        if kind == 'tremor':
            stretches += [(OTHER, rng.uniform(3.0, 8.0)), (CARRY, rng.uniform(0.8, 2.0))]
        elif kind == 'turning':  # in half of them the rest turns into a slow turn
            place = len(stretches) - (rng.random() >= 0.5)
            stretches.insert(place, (OTHER, rng.uniform(3.0, 12.0)))
    now, turns, phases = Rotation.random(random_state=rng), [], []
    for phase, seconds in stretches:
        share = (np.arange(round(seconds * rate_hz)) + 1.0) / round(seconds * rate_hz)
        if phase == CARRY:
            by = rng.normal(size=3)
            by *= rng.uniform(0.6, 2.6) / np.linalg.norm(by)
            share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        else:  # about a level axis, so that it tilts
            level = unit(np.cross(now.inv().apply([0.0, 0.0, 1.0]), rng.normal(size=3)))
            by = level * np.radians(size) * seconds * (kind == 'turning' and phase == OTHER)
        turn = now * Rotation.from_rotvec(share[:, np.newaxis] * by)
        now = turn[-1]
        turns.append(turn.as_quat())
        phases.append(np.full(len(share), phase))
    return Rotation.from_quat(np.concatenate(turns)), np.concatenate(phases)


def draw_shaking(rng: np.random.Generator, kind: str, size: float, phase: NDArray[np.intp],
                 rate_hz: float) -> Floats:
    """Return (n, 3) accelerations without gravity [g]."""
    count = len(phase)
    carried = 0.08 * draw_noise(rng, count, rate_hz, 0.05) * (phase == CARRY)[:, np.newaxis]
    if kind == 'tremor':
        return carried + (phase == OTHER)[:, np.newaxis] * draw_swing(
            rng, count, rate_hz, size, rng.uniform(5.0, 12.0), 0.6)
    if kind == 'motor':
        return carried + draw_swing(rng, count, rate_hz, size, rng.uniform(20.0, 80.0), 2.0)
    return carried + (draw_steps(rng, count, rate_hz, size) if kind == 'footsteps' else 0.0)


def draw_noise(rng: np.random.Generator, count: int, rate_hz: float, correlation: float
               ) -> Floats:
    """Return (count, 3) noise of variance 1 with this correlation time [s]."""
    keep = np.exp(-1.0 / (rate_hz * correlation)) if correlation > 0.0 else 0.0
    start = int(10.0 * correlation * rate_hz)
    white = rng.normal(size=(count + start, 3))
    return np.asarray(lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)[start:])


def draw_swing(rng: np.random.Generator, count: int, rate_hz: float, size: float,
               frequency: float, jitter: float) -> Floats:
    """Return an oscillation in a fixed direction; its frequency [Hz] wanders by `jitter`."""
    wander = frequency + jitter * draw_noise(rng, count, rate_hz, 1.0)[:, 0]
    phase = 2.0 * np.pi * np.cumsum(wander) / rate_hz
    direction = unit(rng.normal(size=(2, 3)))
    swing = np.sin(phase)[:, np.newaxis] * direction[0]
    return np.asarray(size * (swing + 0.4 * np.cos(phase)[:, np.newaxis] * direction[1]))


def draw_steps(rng: np.random.Generator, count: int, rate_hz: float, size: float) -> Floats:
    """Return the steps of a person who walks by: shocks that ring and decay."""
    time = np.arange(0.0, 0.6, 1.0 / rate_hz)
    ringing = np.exp(-time / 0.08) * np.sin(2.0 * np.pi * rng.uniform(12.0, 30.0) * time)
    struck = np.zeros((count, 3))
    at = np.cumsum(rng.normal(0.55, 0.04, int(count / rate_hz)))
    loud = size * np.abs(np.sin(2.0 * np.pi * at / 9.0))
    index = (at * rate_hz).astype(int)
    kept = index < count
    direction = rng.normal(size=(int(kept.sum()), 3)) * 0.3 + [0.0, 0.0, 1.0]
    struck[index[kept]] += loud[kept, np.newaxis] * direction
    return np.asarray(lfilter(ringing, [1.0], struck, axis=0))


# ------------------------------------------------------------------------------------------ rules

class Pose(NamedTuple):
    """A still stretch: first and last stamp [s], mean and noise of the mean [g]."""

    start: float
    end: float
    mean: Floats
    noise: Floats


def by_detector(case: Case, rate: Floats) -> list[Pose]:
    """Return the dwells that the stillness detector finds with these angular rates."""
    detector = StillDetector(CaptureSettings(), units_of(case.units))
    detector.push(rows_of(case.time, case.reading, rate))
    detector.close()
    return [Pose(each.start, each.end, each.mean, each.std / np.sqrt(each.count))
            for each in detector.dwells()]


def by_variance(case: Case) -> list[Pose]:
    """Return the poses by a fixed threshold of the variance."""
    width = round(case.rate_hz)
    first = case.reading[:round(2.0 * case.rate_hz)].std(axis=0)
    mean = sliding_mean(case.reading, width)
    spread = np.sqrt(np.maximum(sliding_mean(np.square(case.reading), width) - mean**2, 0.0))
    least = 3.3e-4 if case.units == 'g' else 0.0
    return still_stretches(case, np.all(spread < np.maximum(3.0 * first, least), axis=1))


def by_gyro(case: Case) -> list[Pose]:
    """Return the poses by a threshold of the mean rate."""
    bias = case.rate[:round(2.0 * case.rate_hz)].mean(axis=0)
    mean = sliding_mean(case.rate - bias, round(0.5 * case.rate_hz))
    return still_stretches(case, np.linalg.norm(mean, axis=1) < np.radians(0.5))


def sliding_mean(values: Floats, width: int) -> Floats:
    """Return means over windows centred on each sample; they are shorter at the ends."""
    sums = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    index = np.arange(len(values))
    low = np.maximum(index - width // 2, 0)
    high = np.minimum(index + (width + 1) // 2, len(values))
    return np.asarray((sums[high] - sums[low]) / (high - low)[:, np.newaxis])


def still_stretches(case: Case, still: NDArray[np.bool_]) -> list[Pose]:
    """Return the poses of stretches of 1 s or more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    found = []
    for start, stop in edges.reshape(-1, 2):
        part = case.reading[start:stop]
        if len(part) >= case.rate_hz:
            found.append(Pose(float(case.time[start]), float(case.time[stop - 1]),
                              part.mean(axis=0), part.std(axis=0, ddof=1) / np.sqrt(len(part))))
    return found


RULES: dict[str, Callable[[Case], list[Pose]]] = {
    'ours': lambda case: by_detector(case, np.full_like(case.rate, np.nan)),
    'ours, gyro': lambda case: by_detector(case, case.rate),
    'variance': by_variance, 'gyro': by_gyro}


# ------------------------------------------------------------------------------- poses and truth

@dataclass
class Score:
    """The poses of a rule in some recordings, beside the truth."""

    moving: int = 0  # samples while moving,
    taken: int = 0  # and those of them in poses
    resting: int = 0  # samples at rest,
    used: int = 0  # and those of them in poses
    rests: int = 0
    missed: int = 0  # rests without a pose
    false: list[Floats] = field(default_factory=list)  # (3,) normalised errors of false poses
    errors: list[Floats] = field(default_factory=list)  # (3,) errors of pose means [mg]
    norms: list[float] = field(default_factory=list)  # errors of their norms [mg]
    normalised: list[Floats] = field(default_factory=list)  # (3,) normalised errors

    def __add__(self, other: 'Score') -> 'Score':
        return Score(*(getattr(self, each.name) + getattr(other, each.name)
                       for each in fields(self)))


def score_rules(kind: str, seed: int, noisy: bool, number: int) -> list[Score]:
    """Draw a recording and compare the poses of each rule with the truth."""
    case, scores = draw_case(kind, seed, noisy, number), []
    for rule in RULES.values():
        found = Score(moving=int(case.moving.sum()), resting=int((~case.moving).sum()),
                      rests=len(case.rests))
        inside = np.zeros(len(case.time), dtype=bool)
        hit: set[int] = set()
        for pose in rule(case):
            first, last = np.searchsorted(case.time, [pose.start - 1e-9, pose.end + 1e-9])
            inside[first:last] = True
            common = np.minimum(case.rests[:, 1], last) - np.maximum(case.rests[:, 0], first)
            best = int(np.argmax(common))
            if common[best] <= 0.5 * (last - first):
                found.false.append((pose.mean - case.force[(first + last) // 2]) / pose.noise)
                continue
            hit.add(best)
            error = pose.mean - case.force[case.rests[best, 0]]
            found.errors.append(1e3 * error)
            found.norms.append(1e3 * (float(np.linalg.norm(pose.mean)) - 1.0))
            found.normalised.append(error / pose.noise)
        found.taken, found.used = int((inside & case.moving).sum()), int(
            (inside & ~case.moving).sum())
        found.missed = found.rests - len(hit)
        scores.append(found)
    return scores


def rms_of_smallest(values: Sequence[Any], share: float) -> float:
    """Return the root mean square of the smallest values, as many as this share."""
    squares = np.sort(np.square(values), axis=None)
    kept = squares[:int(np.ceil(share * len(squares)))]
    return float(np.sqrt(np.mean(kept))) if len(kept) else np.nan


Scores = dict[tuple[str, str], Score]
"""By kind and rule."""


def measure(frame: Frame, sets: int, seed: int, noisy: bool) -> Scores:
    """Return the scores of all rules on recordings of all kinds."""
    found: Scores = {}
    for kind in KINDS:
        scores = frame.run_sets(score_rules, sets, kind, seed, noisy)
        for rule, each in zip(RULES, zip(*scores)):
            found[kind, rule] = sum(each, Score())
    return found


def row_of(score: Score) -> Iterator[str]:
    """Yield the figures of a rule in words."""
    yield f'{score.taken / max(score.moving, 1):.2%}'
    yield f'{score.used / score.resting:.1%}'
    yield f'{score.missed / score.rests:.1%}'
    yield str(len(score.false))
    errors = np.abs(score.errors)
    yield f'{np.median(errors):.3f}' if len(errors) else ''
    yield f'{np.max(errors, initial=0.0):.1f}'
    yield f'{rms_of_smallest(score.norms, 1.0):.3f}'
    yield f'{rms_of_smallest(score.normalised, 0.99):.2f}'
    yield f'{rms_of_smallest(score.false, 0.99):.2f}' if score.false else ''


def compare_rules(found: Scores) -> str:
    heads = ('recordings', 'rule', 'moving samples in poses', 'rest used', 'rests missed',
             'false poses', 'median error of a mean, mg', 'largest, mg',
             'RMS error of its norm, mg', 'normalised error', 'the same of false poses')
    return markdown(heads, ((KINDS[kind], rule, *row_of(score))
                            for (kind, rule), score in found.items()))


def lines_of(found: Scores, noise: str, sets: int) -> Iterator[Line]:
    """Yield what is asked of the detector beside what is measured."""
    for rule in ('ours', 'ours, gyro'):
        false = len(found['turning', rule].false)
        yield check(f'{noise}, {rule}: poses taken while turning slowly', str(false), false,
                    most=0, least=0, sets=sets)
        for kind, words in KINDS.items():
            x = rms_of_smallest(found[kind, rule].normalised, 0.99)
            yield check(f'{noise}, {rule}, {words}: normalised error of pose means', f'{x:.2f}', x,
                        least=0.85, most=1.15, sets=sets)


# --------------------------------------------------------------- disturbed from the first second

FIRST: dict[str, tuple[str, tuple[float, float], tuple[float, float], dict[str, float]]] = {
    'shaking at 1 to 5 Hz, 20 to 200 mg': ('swing', (1.0, 5.0), (0.02, 0.2), {'most': 0.0}),
    'tremor at 8 to 12 Hz, 5 to 50 mg': ('swing', (8.0, 12.0), (5e-3, 0.05), {}),
    'vibration at 30 to 80 Hz, 20 mg': ('swing', (30.0, 80.0), (0.02, 0.02), {'least': 95.0}),
    'white noise of 20 to 50 mg': ('white', (0.0, 0.0), (0.02, 0.05), {'least': 95.0}),
    'noise of 5 to 20 mg, low-pass at 5 to 40 Hz': (
        'filtered', (5.0, 40.0), (5e-3, 0.02), {'least': 95.0})}
"""What a sensor reads from the first second on: the kind, frequencies [Hz], sizes [g], and the
limits of the share of recordings with a pose [%]."""


def is_captured(what: str, seed: int, number: int) -> bool:
    """Return whether a sensor that never rested before has a pose."""
    kind, band, sizes, _ = FIRST[what]
    rng = np.random.default_rng([seed, list(FIRST).index(what), number])
    rate_hz = float(rng.choice((100.0, 200.0, 1000.0)))
    count = int(12.0 * rate_hz)
    force = Rotation.random(random_state=rng).apply([0.0, 0.0, 1.0])
    frequency, size = rng.uniform(*band), np.exp(rng.uniform(*np.log(sizes)))
    own = rng.normal(size=(2 * count, 3))
    if kind == 'filtered':
        own = lfilter(*butter(2, frequency, fs=rate_hz), own, axis=0)
    own = own[count:] * (2e-3 if kind == 'swing' else size) / own[count:].std()
    if kind == 'swing':
        own += draw_swing(rng, count, rate_hz, size, frequency, min(0.05 * frequency, 0.5))
    return len(capture(samples_of(np.arange(count) / rate_hz, force + own), G).poses) > 0


# -------------------------------------------------------------------------------- real recordings

def rows_of_real() -> Iterator[tuple[object, ...]]:
    for name, unit_name, wanted in RECORDINGS:
        recording = read_recording(DATA / f'{name}.csv')
        units = units_of(unit_name)
        native = units.name == 'native'
        reading = recording.reading if native else units.to_g(recording.reading)
        time = recording['time']
        rate = recording.columns.get('rate', np.full_like(reading, np.nan))
        case = Case(1.0 / float(np.median(np.diff(time))), time, reading, rate, reading,
                    np.zeros((0, 2)), np.zeros(len(time), bool), 'native' if native else 'g')
        for rule, find in RULES.items():
            poses = find(case)
            used = sum((time >= each.start) & (time <= each.end) for each in poses)
            row = [name, rule, len(poses), wanted, f'{np.mean(used):.1%}']
            if not poses:
                yield *row, 'no poses', ''
                continue
            start, _, mean, noise = map(np.array, zip(*poses))
            try:
                quality = fit_poses(
                    poses_of(mean, time=start, std=noise, count=np.ones(len(poses))),
                    units_of(case.units), model='10', method='algebraic').quality
                chi2 = quality.chi2_per_dof
                yield *row, f'{quality.rms_after_mg:.3f}', '' if chi2 is None else f'{chi2:.1f}'
            except AccelCalibError as error:
                yield *row, f'no fit ({type(error).__name__})', ''


def stillness(frame: Frame, sets: int = 60, seed: int = 1) -> Iterator[str]:
    usual, noisy = (measure(frame, sets, seed, each) for each in (False, True))
    yield table([*lines_of(usual, 'noise 0.3 to 5 mg', sets),
                 *lines_of(noisy, 'noise 50 mg', sets)])
    yield table(share(f'{what}: captured', frame.run_sets(is_captured, sets, what, seed), **limits)
                for what, (*_, limits) in FIRST.items())
    yield compare_rules(usual)
    yield compare_rules(noisy)
    yield markdown(('recording', 'rule', 'poses', 'taken by hand', 'samples used', 'residual, mg',
                    'chi² per degree of freedom'), rows_of_real())
