# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Faults of a sensor, its driver and its clock: whether they are named, and never calibrated.

A simulated recording is given a fault, written as a CSV file, and calibrated as a user does it.
It is *named* if a finding, a note or the refusal is about the fault, and *wrong* if a calibration
that is not BAD leaves an error of |a| above 10 mg in orientations that it has not seen. A
recording without a fault must have no finding about the samples::

    python benchmarks/sensor_faults.py --sets 50 --markdown docs/figures/sensor_faults.md

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from accel_calib.effects import Model, model_with, predict, simulate_recording  # noqa: E402
from accel_calib.errors import AccelCalibError  # noqa: E402
from accel_calib.finding import has  # noqa: E402
from accel_calib.geometry import spread_directions, unit  # noqa: E402
from accel_calib.logs import LogOptions  # noqa: E402
from accel_calib.pipeline import calibrated_log, Outcome, poses_of  # noqa: E402
from accel_calib.table import Floats  # noqa: E402
from figures import machine, markdown, parser, publish  # noqa: E402
import numpy as np  # noqa: E402

G = 9.80665
_WRONG_MG = 10.0

_PAGE = """\
# Faults of sensors

Made by `python benchmarks/sensor_faults.py {command}`. Each set is a recording of 14 poses with
other errors of the sensor, noise, rate and orientations, and with one fault. *Named*: a finding, a
note or the refusal is about the fault. *Wrong*: a calibration that is not BAD leaves an error of
|a| above 10 mg in new orientations.

Machine: {machine}.

{rows}
"""


class Log(NamedTuple):
    """Times [s], readings and rates of a recording, and how it is written."""

    time: Floats
    reading: Floats  # [m/s²]
    rate: Floats
    header: str = 'time,ax,ay,az,gx,gy,gz'


@dataclass(frozen=True)
class Fault:
    """
    A fault, and the words of which one is said of it.

    `right` is whether the recording is to be calibrated all the same.

    """

    make: Callable[[Log, np.random.Generator], Log]
    words: tuple[str, ...]
    right: bool = False


def _inserted(log: Log, place: float, rows: int, value: float) -> Log:
    """Return a log with zeros, or the reading of a place times a value, for some rows."""
    at = min(int(place * len(log.time)), len(log.time) - 1)
    period = float(np.median(np.diff(log.time)))
    reading, rate = (np.insert(part, at, np.tile(value * part[at], (rows, 1)), axis=0)
                     for part in (log.reading, log.rate))
    return log._replace(time=np.arange(len(reading)) * period, reading=reading, rate=rate)


def _with_axis(log: Log, axis: int, values: Floats | float) -> Log:
    reading = log.reading.copy()
    reading[:, axis] = values
    return log._replace(reading=reading)


def _fused(log: Log, rng: np.random.Generator) -> Log:
    smooth = np.apply_along_axis(lambda part: np.convolve(part, np.ones(15) / 15.0, 'same'), 0,
                                 log.reading)
    return log._replace(reading=G * unit(smooth))


def _counts(log: Log, rng: np.random.Generator) -> Log:
    bits = int(rng.choice([12, 14, 16]))
    counts = np.round(log.reading / G * 2.0**bits / float(rng.choice([4.0, 8.0])))
    return log._replace(reading=counts % 2.0**bits, header='time,accX,accY,accZ,gx,gy,gz')


FAULTS = {
    'zeros first': Fault(lambda log, rng: _inserted(log, 0.0, 150, 0.0), ('are 0',), True),
    'zeros between': Fault(lambda log, rng: _inserted(log, rng.uniform(), 150, 0.0),
                           ('are 0',), True),
    'zeros last': Fault(lambda log, rng: _inserted(log, 1.0, 300, 0.0), ('are 0',), True),
    'frozen': Fault(lambda log, rng: _inserted(log, rng.uniform(), 300, 1.0),
                    ('is repeated',), True),
    'stuck axis': Fault(lambda log, rng: _with_axis(
        log, int(rng.integers(3)), rng.uniform(-9.0, 9.0)), ('does not measure',)),
    'dead axis': Fault(lambda log, rng: _with_axis(
        log, int(rng.integers(3)), 0.02 * rng.normal(size=len(log.time))), ('does not measure',)),
    'copied axis': Fault(lambda log, rng: _with_axis(log, 2, log.reading[:, rng.integers(2)]),
                         ('is a copy',)),
    'inverted copy': Fault(lambda log, rng: _with_axis(log, 0, -log.reading[:, 1]),
                           ('is a copy',)),
    'clipped': Fault(lambda log, rng: log._replace(
        reading=np.clip(log.reading, *(np.array([-1.0, 1.0]) * rng.uniform(0.7, 0.97) * G))),
        ('the limit of the sensor',)),
    'fused gravity': Fault(_fused, ('are computed',)),
    'lost sign': Fault(_counts, ('lost their sign',), True),
    'whole seconds': Fault(lambda log, rng: log._replace(time=np.floor(log.time)),
                           ('spread over',), True),
    'newest first': Fault(lambda log, rng: Log(log.time[::-1], log.reading[::-1], log.rate[::-1]),
                          ('turned round',), True),
    'offset 0.6 g': Fault(lambda log, rng: log._replace(
        reading=log.reading + 0.6 * G * unit(rng.normal(size=(1, 3)))), (), True),
    'gain 2 on one axis': Fault(lambda log, rng: log._replace(
        reading=log.reading * np.where(np.arange(3) == rng.integers(3), 1.9, 1.0)), (), True),
    'no gravity': Fault(lambda log, rng: log._replace(
        reading=0.02 * rng.normal(size=(len(log.time), 3))), ('gravity removed', 'about 0')),
    'none': Fault(lambda log, rng: log, (), True)}


def recording(rng: np.random.Generator) -> tuple[Log, Model]:
    """Return a recording of a sensor with errors, and its model."""
    model = model_with({'offset': rng.normal(0.0, 0.03, 3), 'axis_gain': rng.normal(0.0, 0.01, 3),
                        'cross_axis': rng.normal(0.0, 0.003, 3)})
    made = simulate_recording(
        model, spread_directions(14)[rng.permutation(14)], rng,
        noise_g=float(rng.choice([5e-4, 2e-3, 4e-3])), rate_hz=float(rng.choice([50.0, 100.0])),
        dwell=float(rng.uniform(2.5, 4.0)))
    return Log(made['time'], G * made.reading, made['rate']), model


def outcome(log: Log, folder: Path) -> tuple[str, Outcome | None]:
    """Return what is said of a recording, and its calibration unless it is refused."""
    path = folder / 'log.csv'
    np.savetxt(path, np.column_stack(log[:3]), fmt='%.7g', delimiter=',', header=log.header,
               comments='')
    try:
        found = poses_of(path, LogOptions())
        made = calibrated_log(path, LogOptions(), found)
    except AccelCalibError as err:
        return str(err), None
    assert isinstance(made, Outcome)
    return ' '.join([*found.lines, *(each.words for each in made.rating.findings)]), made


def meant(name: str, log: Log, clean: Log) -> Log:
    """Return the log whose readings a calibration of it has to correct."""
    if name in ('whole seconds', 'newest first'):
        return clean
    if name == 'lost sign':
        modulus = 2.0**np.ceil(np.log2(np.max(log.reading) + 1.0))
        return log._replace(reading=(log.reading + modulus / 2.0) % modulus - modulus / 2.0)
    return log


def error_mg(made: Outcome, model: Model, log: Log, clean: Log, rng: np.random.Generator) -> float:
    """Return the RMS error of |a| in new orientations, inside the range of the readings [mg]."""
    reading = G * predict(model, unit(rng.normal(size=(500, 3))), {})
    limits = np.max(np.abs(log.reading), axis=0)
    if len(clean.time) == len(log.time) and np.max(np.abs(log.reading - clean.reading)) > 0.0:
        inside = np.all(np.abs(log.reading) < limits, axis=1)  # the fault as a linear change
        columns = np.column_stack([clean.reading, np.ones(len(clean.time))])[inside]
        changed = np.linalg.lstsq(columns, log.reading[inside], rcond=None)[0]
        reading = np.column_stack([reading, np.ones(500)]) @ changed
    reading = reading[np.all(np.abs(reading) < limits, axis=1)]
    own = made.calibration
    if own.units.name == 'g':  # counts of about 1000 to the g are read as mg
        reading = reading * 1e-3
    length = np.linalg.norm(own.correct(reading, own.typical_context(len(reading))), axis=1)
    return float(np.sqrt(np.mean((length / own.force_per_g - 1.0)**2))) * 1e3


def counted(name: str, sets: int, seed: int, folder: Path) -> Counter[str]:
    """Return how many sets of a fault are named, calibrated, and wrong."""
    fault, counts = FAULTS[name], Counter[str]()
    for number in range(sets):
        rng = np.random.default_rng([seed, list(FAULTS).index(name), number])
        clean, model = recording(rng)
        log = fault.make(clean, rng)
        said, made = outcome(log, folder)
        counts['named'] += not fault.words or any(word in said for word in fault.words)
        if made is not None:
            counts['calibrated'] += made.rating.name != 'BAD'
            counts['false'] += has(made.rating.findings, 'missing') or has(
                made.rating.findings, 'not_taken')
            error = error_mg(made, model, meant(name, log, clean), clean, rng)
            counts['wrong'] += made.rating.name != 'BAD' and error > _WRONG_MG
        unnamed = not any(word in said for word in fault.words or ('',))
        if unnamed or (fault.right and made is None):
            print(f'{name}, set {number}: {said}', file=sys.stderr)
    return counts


def main() -> None:
    asked = parser(__doc__, sets=50, seed=2030)
    asked.add_argument('--clean', type=int, default=500, help='sets without a fault')
    asked.add_argument('--only', default='', help='faults, separated by commas')
    given = asked.parse_args()
    rows = []
    with TemporaryDirectory() as folder:
        for name, fault in FAULTS.items():
            if given.only and name not in given.only.split(','):
                continue
            sets = given.clean if name == 'none' else given.sets
            found = counted(name, sets, given.seed, Path(folder))
            rows.append((name, sets, found['named'] if fault.words else '', found['calibrated'],
                         found['wrong'], found['false'] if name == 'none' else ''))
            print(rows[-1], file=sys.stderr)
    command = ' '.join(sys.argv[1:])
    publish(_PAGE.format(command=command, machine=machine(), rows=markdown(
        ('fault', 'sets', 'named', 'calibrated', 'wrong', 'false findings'), rows)),
        given.markdown)


if __name__ == '__main__':
    main()
