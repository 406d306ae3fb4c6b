# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Faults of a sensor, its driver and its clock: whether they are named, and never calibrated.

A simulated recording is given a fault, and calibrated as a user does it: from a CSV file, from a
bag, by the session of a node, and by the session of the live page. It is *named* if a finding, a
note, a line of the log or the refusal is about the fault, and *wrong* if a calibration that is not
BAD leaves an error of |a| above 10 mg in orientations that it has not seen. A recording without a
fault must have no finding about the samples. Faults of the text and of the order of rows are no
faults of messages::

    python benchmarks/sensor_faults.py --sets 50 --markdown docs/figures/sensor_faults.md

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
import multiprocessing
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from accel_calib.calibration import Calibration  # noqa: E402
from accel_calib.effects import Model, model_with, predict, simulate_recording  # noqa: E402
from accel_calib.errors import AccelCalibError  # noqa: E402
from accel_calib.finding import Finding, has  # noqa: E402
from accel_calib.findings import Rating  # noqa: E402
from accel_calib.geometry import spread_directions, unit  # noqa: E402
from accel_calib.logs import LogOptions, open_log  # noqa: E402
from accel_calib.pipeline import calibrated_log, Outcome, poses_of  # noqa: E402
from accel_calib.session import checks, columns_of  # noqa: E402
from accel_calib.table import concatenated, Floats  # noqa: E402
from bag_files import fill, header, IMU, imu, writer_of  # noqa: E402
from driven import Driver  # noqa: E402
from figures import machine, markdown, parser, publish  # noqa: E402
import numpy as np  # noqa: E402

G = 9.80665
_WRONG_MG = 10.0

OF_SAMPLES = ('missing', 'not_taken', 'signs', 'clock', 'columns', 'limited')
"""Kinds of findings that a sound recording does not have."""

Said = tuple[str, Calibration | None, Rating | None]

_PAGE = """\
# Faults of sensors

Made by `python benchmarks/sensor_faults.py {command}`. Each set is a
recording of 14 poses with other errors of the sensor, noise, rate and orientations, and with one
fault. It comes as a CSV file, as a bag, as messages to the session of a node, and as a recording
that the live page plays. *Named*: a finding, a note, a line of the log or the refusal is about the
fault. *Wrong*: a calibration that is not BAD leaves an error of |a| above 10 mg in new
orientations.

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


def _starting(log: Log, rng: np.random.Generator) -> Log:
    """Return a log that begins with what a filter makes of one reading."""
    made = _inserted(log, 0.0, 150, 1.0)
    made.reading[:150] += 10.0**rng.uniform(-6.0, -3.7) * rng.normal(size=(150, 3))
    made.rate[:150] += 1e-6 * rng.normal(size=(150, 3))
    return made


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
    'filter first': Fault(_starting, (), True),
    'gyro not on': Fault(lambda log, rng: log._replace(rate=np.where(
        np.arange(len(log.time))[:, np.newaxis] < 250, 0.0, log.rate)), (), True),
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


def of_file(path: Path, units: Literal['', 'native']) -> Said:
    """Return what ``calibrate`` says of a file."""
    options = LogOptions(units=units)
    try:
        found = poses_of(path, options)
        made = calibrated_log(path, options, found)
    except AccelCalibError as err:
        return str(err), None, None
    assert isinstance(made, Outcome)
    return (' '.join([*found.lines, *(each.words for each in made.rating.findings)]),
            made.calibration, made.rating)


def of_csv(log: Log, folder: Path) -> Said:
    path = folder / 'log.csv'
    np.savetxt(path, np.column_stack(log[:3]), fmt='%.7g', delimiter=',', header=log.header,
               comments='')
    return of_file(path, '')


def of_bag(log: Log, folder: Path) -> Said:
    path = folder / 'log.bag'
    path.unlink(missing_ok=True)
    writer, store = writer_of(path, 'bag')
    stamps = 10**18 + np.round(log.time * 1e9).astype(int)
    fill(writer, store, [('/imu', IMU)], (
        (0, 10**18 + 10**7 * k, imu(store, header(store, int(stamp)), reading, rate))
        for k, (stamp, reading, rate) in enumerate(zip(stamps, log.reading, log.rate))))
    return of_file(path, _units(log))


def of_node(log: Log, _: Path) -> Said:
    return _of_session(log, _units(log), ())


def of_live(log: Log, folder: Path) -> Said:
    path = folder / 'log.csv'
    np.savetxt(path, np.column_stack(log[:3]), fmt='%.7g', delimiter=',', header=log.header,
               comments='')
    try:
        with open_log(path, LogOptions()) as opened:
            read = concatenated(list(opened.blocks))
            return _of_session(Log(read['time'], read.reading, read['rate'] if 'rate' in read
                                   else np.full((len(read), 3), np.nan)), opened.units.name,
                               opened.findings)
    except AccelCalibError as err:
        return str(err), None, None


def _of_session(log: Log, units: str, found: tuple[Finding, ...]) -> Said:
    """Push the samples of a log into a session, and let it fit."""
    with TemporaryDirectory() as own:
        return _pushed(log, Driver(units=units or 'm/s2', calibration_file=f'{own}/own.yaml'),
                       found)


def _pushed(log: Log, driver: Driver, found: tuple[Finding, ...]) -> Said:
    driver.session.change(found=found)
    context = np.full((len(log.time), len(columns_of(driver.session.state.settings))), np.nan)
    rows = np.column_stack([*log[:3], context])
    for block in np.array_split(rows, max(1, len(rows) // 25)):
        driver.now += 25 * float(np.median(np.diff(log.time)))
        if driver.session.accepts('imu_link'):
            driver.session.push(block, driver.now)
        driver.tick()
    answer = ''
    try:
        answer = driver.ask('fit')
    except AccelCalibError as err:
        answer = str(err)
    rating = driver.sensor.rating
    findings = () if rating is None else rating.findings
    said = ' '.join([answer, *(line.words for line in driver.log), *(
        each.words for each in findings), *(str(each) for each in checks(driver.session.state))])
    return said, driver.calibration, rating


SURFACES = {'CSV': of_csv, 'bag': of_bag, 'node': of_node, 'live': of_live}
OF_TEXT = ('whole seconds', 'newest first')


def _units(log: Log) -> Literal['', 'native']:
    """Return the unit that a user states who publishes counts."""
    return 'native' if 'accX' in log.header else ''


def meant(name: str, log: Log, clean: Log) -> Log:
    """Return the log whose readings a calibration of it has to correct."""
    if name in ('whole seconds', 'newest first'):
        return clean
    if name == 'lost sign':
        modulus = 2.0**np.ceil(np.log2(np.max(log.reading) + 1.0))
        return log._replace(reading=(log.reading + modulus / 2.0) % modulus - modulus / 2.0)
    return log


def error_mg(own: Calibration, model: Model, log: Log, clean: Log, rng: np.random.Generator
             ) -> float:
    """Return the RMS error of |a| in new orientations, inside the range of the readings [mg]."""
    reading = G * predict(model, unit(rng.normal(size=(500, 3))), {})
    limits = np.max(np.abs(log.reading), axis=0)
    if len(clean.time) == len(log.time) and np.max(np.abs(log.reading - clean.reading)) > 0.0:
        inside = np.all(np.abs(log.reading) < limits, axis=1)  # the fault as a linear change
        columns = np.column_stack([clean.reading, np.ones(len(clean.time))])[inside]
        changed = np.linalg.lstsq(columns, log.reading[inside], rcond=None)[0]
        reading = np.column_stack([reading, np.ones(500)]) @ changed
    reading = reading[np.all(np.abs(reading) < limits, axis=1)]
    if own.units.name == 'g':  # counts of about 1000 to the g are read as mg
        reading = reading * 1e-3
    length = np.linalg.norm(own.correct(reading, own.typical_context(len(reading))), axis=1)
    return float(np.sqrt(np.mean((length / own.force_per_g - 1.0)**2))) * 1e3


def counted(name: str, surface: str, sets: int, seed: int, folder: Path) -> Counter[str]:
    """Return how many sets of a fault are named, calibrated, and wrong."""
    fault, counts = FAULTS[name], Counter[str]()
    for number in range(sets):
        rng = np.random.default_rng([seed, list(FAULTS).index(name), number])
        clean, model = recording(rng)
        log = fault.make(clean, rng)
        said, made, rating = SURFACES[surface](log, folder)
        named = not fault.words or any(word in said for word in fault.words)
        counts['named'] += named
        if made is not None and rating is not None:
            counts['calibrated'] += rating.name != 'BAD'
            counts['false'] += any(has(rating.findings, kind) for kind in OF_SAMPLES)
            error = error_mg(made, model, meant(name, log, clean), clean, rng)
            counts['wrong'] += rating.name != 'BAD' and error > _WRONG_MG
        if not named or (fault.right and made is None):
            print(f'{name}, {surface}, set {number}: {said[-400:]}', file=sys.stderr)
    return counts


def row(name: str, surface: str, sets: int, seed: int) -> tuple[object, ...]:
    """Return a row of the table."""
    with TemporaryDirectory() as folder:
        found = counted(name, surface, sets, seed, Path(folder))
    made = (name, surface, sets, found['named'] if FAULTS[name].words else '', found['calibrated'],
            found['wrong'], found['false'] if name == 'none' else '')
    print(made, file=sys.stderr, flush=True)
    return made


def main() -> None:
    asked = parser(__doc__, sets=50, seed=2030, jobs=2)
    asked.add_argument('--clean', type=int, default=125, help='sets without a fault')
    asked.add_argument('--only', default='', help='faults, separated by commas')
    given, about = asked.parse_args(), machine()
    tasks = [(name, surface, given.clean if name == 'none' else given.sets, given.seed)
             for name in FAULTS for surface in SURFACES
             if (not given.only or name in given.only.split(','))
             and not (name in OF_TEXT and surface in ('bag', 'node'))]
    with multiprocessing.get_context('spawn').Pool(given.jobs) as pool:
        rows = pool.starmap(row, tasks, chunksize=1)
    publish(_PAGE.format(command=' '.join(sys.argv[1:]), machine=about, rows=markdown(
        ('fault', 'as', 'sets', 'named', 'calibrated', 'wrong', 'false findings'), rows)),
        given.markdown)


if __name__ == '__main__':
    main()
