# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A fleet of simulated sensors, calibrated on a local cluster.

The pose tables are made first, in a folder below TMPDIR. Every sensor has values of its own; some
sensors drift or change for good, some are far from the others, and some files are damaged.

"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
import functools
import os
from pathlib import Path
from tempfile import TemporaryDirectory
import time
from typing import Any

import accel_calib as ac
from accel_calib.fleet import changes_of, cluster, Input, Options, recordings, run, Store, Summary
from accel_calib.geometry import unit
from accel_calib.logs import write_table
from accel_calib.table import Floats
from figures import check, Frame, Line, table, tell
import numpy as np

Row = Mapping[str, Any]
"""A sensor in the results."""

MOST_AFTER = 3.0
"""Largest processor time of the program after the recordings, of the whole run [%]."""

POSES = 14
DAMAGED = 0.03
"""Share of the files that are damaged: as many without a table, with four poses, and empty."""

KINDS = {'odd': 0.01, 'drifts': 0.02, 'changes': 0.03}
"""Share of the sensors by what is special about them, cumulative from 0."""

KIND_WORDS = {'': 'constant', 'odd': 'constant, with an odd offset', 'drifts': 'drifting',
              'changes': 'changed for good once'}

LIMIT_SD = 3.0
"""Largest error of a stated drift that counts as right, relative to its standard deviation."""

OFFSET_G, GAIN, CROSS = 0.020, 0.008, 0.002
"""Standard deviations over the sensors."""

ODD_G, DRIFT_G, CHANGE_G = 0.200, 0.0005, 0.015
"""Offset of an odd sensor, drift per recording, and change for good."""

TCO = 0.0006
"""Change of the offset with temperature of model B [g/°C]."""

FIRST = datetime(2026, 1, 1, tzinfo=timezone.utc)
EVERY = timedelta(days=18)
YEAR = timedelta(days=365.25)

LEAST_RATIO = 1.8
MOST_RISE = 10.0
"""Largest rise of the memory between two parts of the run that counts as flat [%]."""

PARTS = (0.1, 0.5, 1.0)
SAMPLED = 100
"""Memory is sampled so often per run."""

TIMED = {True: 200, False: 1200}
"""Recordings for the speed with one and two workers, with and without the search for effects."""

TURNS = 3
"""Number of times that both are timed, in turns."""


# ----------------------------------------------------------------------------------------- sensors

@dataclass(frozen=True)
class Sensor:
    """A simulated sensor."""

    name: str
    kind: str  # of `KINDS`, or empty
    values: dict[str, Any]  # by effect, of the first recording
    away: Any  # (3,) direction of a drift or change of the offset
    from_: int  # first recording after a change for good

    def at(self, k: int) -> dict[str, Any]:
        """Return the values by effect at recording k."""
        moved = {'drifts': DRIFT_G * k, 'changes': CHANGE_G * (k >= self.from_)}
        offset = self.values['offset'] + moved.get(self.kind, 0.0) * self.away
        return {**self.values, 'offset': offset}


def draw_sensor(number: int, calibrations: int, seed: int) -> Sensor:
    """Return a sensor; the same number and seed give the same one."""
    rng = np.random.default_rng([seed, number])
    drawn, model = rng.uniform(), 'AB'[number % 2]
    kind = next((name for name, share in KINDS.items() if drawn < share), '')
    away = unit(rng.normal(size=3))
    offset = np.array([0.01, -0.02, 0.03]) + rng.normal(0.0, OFFSET_G, 3)
    values = {'offset': offset + (ODD_G * away if kind == 'odd' else 0.0),
              'axis_gain': rng.normal(0.0, GAIN, 3), 'cross_axis': rng.normal(0.0, CROSS, 3)}
    if model == 'B':
        values['offset_temperature'] = rng.normal(TCO, TCO / 10.0, 3)
    changed = int(rng.integers(2, max(calibrations - 1, 3)))
    return Sensor(f'{model}-{number:07d}', kind, values, away, changed)


def write_sensor(folder: Path, number: int, calibrations: int, seed: int) -> None:
    """Write the pose tables of a sensor, some of them damaged."""
    made, rng = draw_sensor(number, calibrations, seed), np.random.default_rng([seed, number, 1])
    (folder / made.name).mkdir(parents=True)
    for k in range(calibrations):
        begin = FIRST + k * EVERY
        poses = ac.simulate(
            made.at(k), poses=POSES, seed=int(rng.integers(2 ** 32)),
            time=begin.timestamp() + 10.0 * np.arange(POSES),
            temperature=np.sort(rng.uniform(20.0, 35.0, POSES)) if 'B' in made.name else ())
        path = folder / made.name / f'{begin:%Y-%m-%d}.csv'
        write_table(path, replace(poses, sensor=''))
        if rng.uniform() < DAMAGED:
            lines = path.read_text(encoding='utf-8').splitlines(keepends=True)
            damaged = (['the logger was off\n'], lines[:6], [])[int(rng.integers(3))]
            path.write_text(''.join(damaged), encoding='utf-8')


def is_change_right(made: Sensor, row: Row) -> bool:
    """Return whether the only lasting change is the right one; its recording may be damaged."""
    numbers = [round((datetime.fromisoformat(change['date']) - FIRST) / EVERY)
               for change in row['changes'] if change['for_good']]
    return len(numbers) == 1 and numbers[0] in (made.from_, made.from_ + 1)


def is_drift_right(made: Sensor, row: Row) -> bool:
    """Return whether the stated drift is that of the sensor."""
    drift = row['drift']
    if not drift or not drift['parameter'].startswith('offset.'):
        return False
    per_year = DRIFT_G * made.away['xyz'.index(drift['parameter'][-1])] * (YEAR / EVERY)
    return bool(abs(drift['per_year'] - per_year) < LIMIT_SD * drift['sd'])


RIGHT = {'drifts': (f'the right drift within {LIMIT_SD:g} standard deviations', is_drift_right),
         'changes': ('this change alone for good', is_change_right)}


def lines_of_changes(made: Sequence[Sensor], summary: Summary) -> Iterator[Line]:
    """Yield how many sensors of each kind are listed as changed, and whether rightly so."""
    changed = {sensor for sensor, *_ in changes_of(summary.sensors)}
    listed = {row['sensor']: row for row in summary.sensors if row['sensor'] in changed}
    kinds: dict[tuple[str, str], list[Sensor]] = defaultdict(list)
    for each in made:
        kinds[each.name[0], each.kind].append(each)
    for (model, kind), own in sorted(kinds.items()):
        found = [(each, listed[each.name]) for each in own if each.name in listed]
        what = f'model {model}, {KIND_WORDS[kind]}'
        yield Line(f'{what}: listed as changed', f'{len(found)} of {len(own)}', len(own))
        if kind in RIGHT and found:
            words, is_right = RIGHT[kind]
            yield Line(f'{what}: of them, with {words}',
                       f'{sum(is_right(*each) for each in found)} of {len(found)}', len(found))


# -------------------------------------------------------------------------------- speed and memory

@dataclass(frozen=True)
class Run:
    """What was done, and what is seen of it from outside."""

    summary: Summary
    # (n + 2, 2) clock and processor time of the program with the scheduler, since the beginning
    # [s]: at the beginning, after each recording, and at the end.
    clocks: Floats
    memory: Mapping[float, tuple[float, float]]  # of `memory_mb`, by share of the recordings

    @property
    def per_s(self) -> float:
        """Return recordings per second without the ends: the slope, as some arrive together."""
        tenth = len(self.clocks) // 10
        middle = self.clocks[1 + tenth:-1 - tenth, 0]
        return 1.0 / float(np.polyfit(np.arange(len(middle)), middle, 1)[0])


def memory_mb(client: Any) -> tuple[float, float]:
    """Return the resident memory of the largest worker, and of the program [MB]."""
    def own() -> float:
        pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 1e6

    return max(client.run(own).values()), own()


def watch_run(found: Sequence[Input], options: Options, workers: int, folder: Path) -> Run:
    """Calibrate recordings on a cluster of this machine."""
    clocks, memory = [], {}

    def look() -> None:
        clocks.append((time.perf_counter(), time.process_time()))

    def on_progress(done: int, count: int) -> None:
        look()
        if done == count or done % max(count // SAMPLED, 1) == 0:
            memory[done / count] = memory_mb(client)

    with cluster(workers=workers) as client:
        client.wait_for_workers(workers)
        look()
        summary = run(client, found, options, Store(folder), on_progress)
        look()
        memory[np.inf] = memory_mb(client)
    return Run(summary, np.array(clocks) - clocks[0], memory)


def time_workers(found: Sequence[Input], options: Options, folder: Path, refined: bool) -> Floats:
    """Return the speed of one and of two workers, by turn, with or without the search [1/s]."""
    def speed(workers: int) -> float:
        with TemporaryDirectory(dir=folder) as out:
            return watch_run(found[:TIMED[refined]], replace(options, refined=refined), workers,
                             Path(out)).per_s

    return np.array([[speed(workers) for workers in (1, 2)] for _ in range(TURNS)])


def lines_of_workers(speeds: Mapping[bool, Floats], most: int) -> Iterator[Line]:
    """Yield the speed with one and two workers, on so many recordings at most."""
    for refined, turns in speeds.items():
        (one, two), kind = np.median(turns, axis=0), 'with' if refined else 'without'
        for name, each in (('1 worker', one), ('2 workers', two)):
            yield Line(f'recordings per second {kind} the search, {name}', f'{each:.1f}',
                       min(TIMED[refined], most))
        yield check(f'2 workers against 1, {kind} the search (by turn '
                    + ', '.join(f'{after / before:.2f}' for before, after in turns) + ')',
                    f'{two / one:.2f}', two / one, least=LEAST_RATIO, sets=TURNS)


def lines_of_run(done: Run, workers: int) -> Iterator[Line]:
    """Yield the memory and the times of the run over all recordings."""
    for who, of in enumerate((f'largest of {workers} workers', 'program')):
        at = [next(mb[who] for share, mb in done.memory.items() if share >= part)
              for part in PARTS]
        yield Line(f'{of} after {PARTS[0]:.0%} of the recordings, MB', f'{at[0]:.0f}')
        for part, each in zip(PARTS[1:], at[1:]):
            yield check(f'{of} after {part:.0%} of the recordings, MB (rise [%])',
                        f'{each:.0f} ({100.0 * (each / at[0] - 1.0):.0f})',
                        100.0 * (each / at[0] - 1.0), most=MOST_RISE, unit=' %')
    counts, (seconds, program_s) = done.summary.counts, done.clocks[-1]
    words = ', '.join(f'{count:,} {name}' for name, count in sorted(counts.items()))
    total, (after_s, alone_s) = sum(counts.values()), done.clocks[-1] - done.clocks[-2]
    yield Line(f'whole run, minutes ({words})', f'{seconds / 60.0:.1f}', total)
    yield Line(f'all recordings, per second with {workers} workers', f'{done.per_s:.1f}', total)
    yield Line('program with the scheduler, ms of processor per recording',
               f'{1e3 * program_s / total:.2f}', total)
    yield Line('program at the end, with the libraries of the page, MB',
               f'{done.memory[np.inf][1]:.0f}')
    yield Line('comparison, typical values and page after the recordings, seconds',
               f'{after_s:.1f}', total)
    yield check('processor time of the program after the recordings, of the whole run [%]',
                f'{100.0 * alone_s / seconds:.1f}', 100.0 * alone_s / seconds, most=MOST_AFTER,
                unit=' %')


def lines_of_costs(speeds: Mapping[bool, Floats], done: Run, calibrations: int, workers: int, *,
                   refined: bool) -> Iterator[Line]:
    """Yield what a recording costs, and what a million robots need."""
    after_s = done.clocks[-1, 0] - done.clocks[-2, 0]
    end_s = after_s * workers / sum(done.summary.counts.values())
    each_s, alone_s = workers / done.per_s, {
        key: 1.0 / float(np.median(turns[:, 0])) for key, turns in speeds.items()}
    yield Line('a recording of the whole run on a worker, ms', f'{1e3 * each_s:.1f}')
    yield Line('its comparison with others of the sensor, on a worker, ms', f'{1e3 * end_s:.1f}')
    for kind, search in (('the search', True), ('no search', False)):
        more_s = alone_s[search] - alone_s[refined]
        hours = 1e6 * calibrations * (each_s + end_s + more_s) / 3600.0
        yield Line(f'a million robots with {calibrations} recordings each and {kind}, core hours',
                   f'{hours:,.0f}')


def fleet(frame: Frame, sensors: int = 10_000, calibrations: int = 20, workers: int = 2,
          seed: int = 1, no_refine: bool = False) -> Iterator[str]:
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with ProcessPoolExecutor(workers) as pool:
            list(pool.map(functools.partial(
                write_sensor, folder / 'in', calibrations=calibrations, seed=seed),
                range(sensors), chunksize=20))
        tell(f'{sensors:,} sensors written')
        options = Options(model_from='^([AB])-', refined=not no_refine)
        found = list(recordings([str(folder / 'in')]))
        mixed = np.random.default_rng(seed).permutation(len(found)).tolist()
        some = [found[k] for k in mixed[:max(TIMED.values())]]
        speeds = {refined: time_workers(some, options, folder, refined) for refined in TIMED}
        done = watch_run(found, options, workers, folder / 'results')
        made = [draw_sensor(k, calibrations, seed) for k in range(sensors)]
        yield table([
            *lines_of_workers(speeds, len(found)), *lines_of_run(done, workers),
            *lines_of_changes(made, done.summary),
            *lines_of_costs(speeds, done, calibrations, workers, refined=not no_refine)])
    yield f'{sensors:,} simulated sensors with {calibrations} pose tables of {POSES} poses each'
    yield f'million robots with {calibrations} recordings each need the core hours'
