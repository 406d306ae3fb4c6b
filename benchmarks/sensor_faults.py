# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Faults of a sensor, its driver and its clock: whether they are named, and never calibrated.

A simulated recording is given a fault, and calibrated as a user does it. A recording without a
fault must have no finding about the samples.

"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

from accel_calib.calibration import Calibration
from accel_calib.effects import Model, model_with, predict, simulate_recording
from accel_calib.errors import AccelCalibError
from accel_calib.finding import Finding, has
from accel_calib.findings import Rating
from accel_calib.geometry import spread_directions, unit
from accel_calib.logs import LogOptions, open_log
from accel_calib.pipeline import calibrated_log, Outcome, poses_of
from accel_calib.session import diagnostics
from accel_calib.statistics import rms
from accel_calib.table import concatenated, Floats
from bag_files import fill, header, IMU, imu, writer_of
from driven import Driver
from figures import Frame, markdown, tell
import numpy as np
from shared import GRAVITY as G, rows_of

WRONG_MG = 10.0

OF_SAMPLES = ('missing', 'not_taken', 'signs', 'clock', 'columns', 'limited')
"""Kinds of findings that a sound recording does not have."""

OF_TEXT = ('whole seconds', 'newest first')
"""Faults of files that are no faults of messages."""

Said = tuple[str, Calibration | None, Rating | None]


# ------------------------------------------------------------------------------------------ faults

class Log(NamedTuple):
    """Times [s], readings and rates of a recording, and how it is written."""

    time: Floats
    reading: Floats  # [m/s²]
    rate: Floats
    header: str = 'time,ax,ay,az,gx,gy,gz'

    @property
    def units(self) -> Literal['', 'native']:
        """Return the unit that a user states who publishes counts."""
        return 'native' if 'accX' in self.header else ''


@dataclass(frozen=True)
class Fault:
    """A fault of a recording."""

    make: Callable[[Log, np.random.Generator], Log]
    words: tuple[str, ...]  # one of them is said of it
    right: bool = False  # whether the recording is to be calibrated all the same


def insert(log: Log, place: float, rows: int, value: float) -> Log:
    """Return a log with zeros, or the reading of a place times a value, for some rows."""
    at = min(int(place * len(log.time)), len(log.time) - 1)
    period = float(np.median(np.diff(log.time)))
    reading, rate = (np.insert(part, at, np.tile(value * part[at], (rows, 1)), axis=0)
                     for part in (log.reading, log.rate))
    return log._replace(time=np.arange(len(reading)) * period, reading=reading, rate=rate)


def begin_with_filter(log: Log, rng: np.random.Generator) -> Log:
    """Return a log that begins with what a filter makes of one reading."""
    made = insert(log, 0.0, 150, 1.0)
    made.reading[:150] += 10.0**rng.uniform(-6.0, -3.7) * rng.normal(size=(150, 3))
    made.rate[:150] += 1e-6 * rng.normal(size=(150, 3))
    return made


def replace_axis(log: Log, axis: int, values: Floats | float) -> Log:
    """Return a log with other readings of an axis."""
    reading = log.reading.copy()
    reading[:, axis] = values
    return log._replace(reading=reading)


def fuse(log: Log, rng: np.random.Generator) -> Log:
    """Return a log with the gravity that a filter computes."""
    smooth = np.apply_along_axis(lambda part: np.convolve(part, np.ones(15) / 15.0, 'same'), 0,
                                 log.reading)
    return log._replace(reading=G * unit(smooth))


def count_unsigned(log: Log, rng: np.random.Generator) -> Log:
    """Return a log of counts without their sign."""
    bits = int(rng.choice([12, 14, 16]))
    counts = np.round(log.reading / G * 2.0**bits / float(rng.choice([4.0, 8.0])))
    return log._replace(reading=counts % 2.0**bits, header='time,accX,accY,accZ,gx,gy,gz')


FAULTS = {
    'zeros first': Fault(lambda log, rng: insert(log, 0.0, 150, 0.0), ('are 0',), True),
    'zeros between': Fault(lambda log, rng: insert(log, rng.uniform(), 150, 0.0),
                           ('are 0',), True),
    'zeros last': Fault(lambda log, rng: insert(log, 1.0, 300, 0.0), ('are 0',), True),
    'frozen': Fault(lambda log, rng: insert(log, rng.uniform(), 300, 1.0),
                    ('is repeated',), True),
    'filter first': Fault(begin_with_filter, (), True),
    'gyro not on': Fault(lambda log, rng: log._replace(rate=np.where(
        np.arange(len(log.time))[:, np.newaxis] < 250, 0.0, log.rate)), (), True),
    'stuck axis': Fault(lambda log, rng: replace_axis(
        log, int(rng.integers(3)), rng.uniform(-9.0, 9.0)), ('does not measure',)),
    'dead axis': Fault(lambda log, rng: replace_axis(
        log, int(rng.integers(3)), 0.02 * rng.normal(size=len(log.time))), ('does not measure',)),
    'copied axis': Fault(lambda log, rng: replace_axis(log, 2, log.reading[:, rng.integers(2)]),
                         ('is a copy',)),
    'inverted copy': Fault(lambda log, rng: replace_axis(log, 0, -log.reading[:, 1]),
                           ('is a copy',)),
    'clipped': Fault(lambda log, rng: log._replace(
        reading=np.clip(log.reading, *(np.array([-1.0, 1.0]) * rng.uniform(0.7, 0.97) * G))),
        ('the limit of the sensor',)),
    'fused gravity': Fault(fuse, ('are computed',)),
    'lost sign': Fault(count_unsigned, ('lost their sign',), True),
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


# ---------------------------------------------------------------------------------------- surfaces

def calibrate_file(path: Path, units: Literal['', 'native']) -> Said:
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


def calibrate_session(log: Log, units: str, found: tuple[Finding, ...]) -> Said:
    """Push the samples of a log into a session, and let it fit."""
    with TemporaryDirectory() as own:
        driver = Driver(units=units or 'm/s2', calibration_file=f'{own}/own.yaml')
        driver.session.change(found=found)
        rows = rows_of(*log[:3])
        for block in np.array_split(rows, max(1, len(rows) // 25)):
            driver.now += 25 * float(np.median(np.diff(log.time)))
            if driver.session.accepts('imu_link'):
                driver.session.push(block, driver.now)
            driver.tick()
        try:
            answer = driver.ask('fit')
        except AccelCalibError as err:
            answer = str(err)
        rating = driver.sensor.rating
        said = ' '.join([answer, *(line.words for line in driver.log),
                         *(each.words for each in (rating.findings if rating else ())),
                         *(str(each) for each in diagnostics(driver.session.state)[1:])])
        return said, driver.calibration, rating


def write_csv(log: Log, folder: Path) -> Path:
    """Write a log as text."""
    path = folder / 'log.csv'
    np.savetxt(path, np.column_stack(log[:3]), fmt='%.7g', delimiter=',', header=log.header,
               comments='')
    return path


def say_of_bag(log: Log, folder: Path) -> Said:
    """Return what is said of a bag."""
    path = folder / 'log.bag'
    path.unlink(missing_ok=True)
    writer, store = writer_of(path, 'bag')
    stamps = 10**18 + np.round(log.time * 1e9).astype(int)
    fill(writer, store, [('/imu', IMU)], (
        (0, 10**18 + 10**7 * k, imu(store, header(store, int(stamp)), reading, rate))
        for k, (stamp, reading, rate) in enumerate(zip(stamps, log.reading, log.rate))))
    return calibrate_file(path, log.units)


def say_of_live(log: Log, folder: Path) -> Said:
    """Return what is said of a recording that the live page plays."""
    try:
        with open_log(write_csv(log, folder), LogOptions()) as opened:
            read = concatenated(list(opened.blocks))
            rate = read['rate'] if 'rate' in read else np.full((len(read), 3), np.nan)
            return calibrate_session(Log(read['time'], read.reading, rate), opened.units.name,
                                     opened.findings)
    except AccelCalibError as err:
        return str(err), None, None


SURFACES: dict[str, Callable[[Log, Path], Said]] = {
    'CSV': lambda log, folder: calibrate_file(write_csv(log, folder), ''), 'bag': say_of_bag,
    'node': lambda log, folder: calibrate_session(log, log.units, ()), 'live': say_of_live}


# --------------------------------------------------------------------------------------- the count

def draw_recording(rng: np.random.Generator) -> tuple[Log, Model]:
    """Return a recording of a sensor with errors, and its model."""
    model = model_with({'offset': rng.normal(0.0, 0.03, 3), 'axis_gain': rng.normal(0.0, 0.01, 3),
                        'cross_axis': rng.normal(0.0, 0.003, 3)})
    made = simulate_recording(
        model, spread_directions(14)[rng.permutation(14)], rng,
        noise_g=float(rng.choice([5e-4, 2e-3, 4e-3])), rate_hz=float(rng.choice([50.0, 100.0])),
        dwell=float(rng.uniform(2.5, 4.0)))
    return Log(made['time'], G * made.reading, made['rate']), model


def meant(name: str, log: Log, clean: Log) -> Log:
    """Return the log whose readings a calibration of it has to correct."""
    if name in OF_TEXT:
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
    return rms(length / own.force_per_g - 1.0) * 1e3


def counted(name: str, surface: str, sets: int, seed: int, folder: Path) -> Counter[str]:
    """Return how many sets of a fault are named, calibrated, and wrong."""
    fault, counts = FAULTS[name], Counter[str]()
    for number in range(sets):
        rng = np.random.default_rng([seed, list(FAULTS).index(name), number])
        clean, model = draw_recording(rng)
        log = fault.make(clean, rng)
        said, made, rating = SURFACES[surface](log, folder)
        named = not fault.words or any(word in said for word in fault.words)
        counts['named'] += named
        if made is not None and rating is not None:
            counts['calibrated'] += rating.name != 'BAD'
            counts['false'] += any(has(rating.findings, kind) for kind in OF_SAMPLES)
            error = error_mg(made, model, meant(name, log, clean), clean, rng)
            counts['wrong'] += rating.name != 'BAD' and error > WRONG_MG
        if not named or (fault.right and made is None):
            tell(f'{name}, {surface}, set {number}: {said[-400:]}')
    return counts


def row_of(name: str, surface: str, sets: int, seed: int) -> tuple[object, ...]:
    with TemporaryDirectory() as folder:
        found = counted(name, surface, sets, seed, Path(folder))
    return (name, surface, sets, found['named'] if FAULTS[name].words else '',
            found['calibrated'], found['wrong'], found['false'] if name == 'none' else '')


def sensor_faults(frame: Frame, sets: int = 50, clean: int = 125, seed: int = 2030,
                  only: tuple[str, ...] = tuple(FAULTS)) -> Iterator[str]:
    """Yield the parts of the page; `clean` is the number of sets without a fault."""
    rows = frame.run(row_of, [
        (name, surface, clean if name == 'none' else sets, seed)
        for name in only for surface in SURFACES
        if not (name in OF_TEXT and surface in ('bag', 'node'))])
    yield markdown(('fault', 'as', 'sets', 'named', 'calibrated', 'wrong', 'false findings'), rows)
