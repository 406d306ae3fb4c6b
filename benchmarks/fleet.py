# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A fleet of simulated sensors, calibrated on a local cluster.

The pose tables are made first. Every sensor has values of its own; some sensors drift or change
for good, some are far from the others, and some files are damaged. A second call with the same
folder continues the first one::

    python benchmarks/figures.py fleet --folder /tmp/fleet --markdown docs/figures/fleet.md

"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
import functools
from importlib import import_module
import json
import os
from pathlib import Path
import shutil
from tempfile import TemporaryDirectory
import time
from typing import Any
from unittest import mock

import accel_calib as ac
from accel_calib.fleet import cluster, Input, Options, recordings, run, Store, Summary
from accel_calib.fleet.overview import not_agreeing
from accel_calib.fleet.recording import Row
from accel_calib.geometry import unit
from accel_calib.logs import write_table
import accel_calib.pipeline as pipeline
from figures import Frame, Line, table, tell
import numpy as np

RUN, SENSORS, ROWS = (import_module(f'accel_calib.fleet.{name}')
                      for name in ('run', 'sensors', 'recording'))

MERGED, DIGESTED = 'merge and compare on the workers', 'digests on the workers'
ALONE = {'rows of the sensors': 'write_sensors', 'typical values': 'priors_of',
         'page': 'write_fleet_page'}
"""What the program does alone at the end, and its functions; the first is a part of `MERGED`."""

MOST_ALONE = 0.03
"""Largest share of the time in which the program works alone."""

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
MOST_RISE = 0.1
"""Largest relative rise of the memory between two parts of the run that counts as flat."""

PARTS = (0.1, 0.5, 1.0)
SAMPLED = 100
"""Memory is sampled so often per run."""

TIMED = {True: 200, False: 1200}
"""Recordings for the speed with one and two workers, with and without the search for effects."""

TURNS = 3
"""Number of times that both are timed, in turns."""

STAGED = 10
"""Sensors for the cost by stage, in one process."""

MILLION = 1_000_000
HOUR_S = 3600.0


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
    """Write the pose tables of a sensor, some of them damaged, unless they are there."""
    made = draw_sensor(number, calibrations, seed)
    if (folder / made.name).exists():
        return
    rng = np.random.default_rng([seed, number, 1])
    new = folder / f'.{made.name}'
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    for k in range(calibrations):
        begin = FIRST + k * EVERY
        poses = ac.simulate(
            made.at(k), poses=POSES, seed=int(rng.integers(2 ** 32)),
            time=begin.timestamp() + 10.0 * np.arange(POSES),
            temperature=np.sort(rng.uniform(20.0, 35.0, POSES)) if 'B' in made.name else ())
        path = new / f'{begin:%Y-%m-%d}.csv'
        write_table(path, replace(poses, sensor=''))
        if rng.uniform() < DAMAGED:
            lines = path.read_text(encoding='utf-8').splitlines(keepends=True)
            damaged = (['the logger was off\n'], lines[:6], [])[int(rng.integers(3))]
            path.write_text(''.join(damaged), encoding='utf-8')
    new.rename(folder / made.name)


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


def lines_of_changes(made: Sequence[Sensor], rows: Sequence[Row]) -> Iterator[Line]:
    """Yield how many sensors of each kind the page lists as changed, and whether rightly so."""
    listed = {row['sensor']: row for row in not_agreeing(rows)}
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

def memory_mb() -> float:
    """Return the resident memory of this process [MB]."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


class Watch:
    """Moments and memory of a run, and the progress function that records them."""

    def __init__(self, client: Any, log: Path | None = None) -> None:
        self.client, self.log = client, log
        self.moments: list[float] = []

    def __call__(self, done: int, count: int) -> None:
        """Record a moment; sample the memory at parts of the run."""
        self.moments.append(time.perf_counter())
        if self.log and (done == count or done % max(count // SAMPLED, 1) == 0):
            line = {'done': done, 'count': count, 'program': memory_mb(),
                    'worker': max(self.client.run(memory_mb).values()),
                    'seconds': self.moments[-1] - self.moments[0]}
            with self.log.open('a', encoding='utf-8') as file:
                print(json.dumps(line), file=file)

    def per_s(self) -> float:
        """Return recordings per second without the ends: the slope, since some arrive together."""
        tenth = len(self.moments) // 10
        middle = np.array(self.moments[tenth:len(self.moments) - tenth])
        return 1.0 / float(np.polyfit(np.arange(len(middle)), middle, 1)[0])


def lines_of_workers(found: Sequence[Input], options: Options, folder: Path) -> Iterator[Line]:
    """Yield the speed with one and two workers, in turns, with and without the search."""
    def speed(some: Sequence[Input], options: Options, workers: int) -> float:
        with TemporaryDirectory(dir=folder) as out, cluster(workers=workers) as client:
            client.wait_for_workers(workers)
            watch = Watch(client)
            run(client, some, options, Store(Path(out)), watch)
        return watch.per_s()

    for refined, count in TIMED.items():
        some, kind = found[:count], 'with' if refined else 'without'
        turns = np.array([[speed(some, replace(options, refined=refined), workers)
                           for workers in (1, 2)] for _ in range(TURNS)])
        one, two = np.median(turns, axis=0)
        for name, each in (('1 worker', one), ('2 workers', two)):
            yield Line(f'recordings per second {kind} the search, {name}', f'{each:.1f}',
                       len(some))
        yield Line(f'2 workers against 1, {kind} the search (by turn '
                   + ', '.join(f'{after / before:.2f}' for before, after in turns) + ')',
                   f'{two / one:.2f}', TURNS, f'>= {LEAST_RATIO}', bool(two / one >= LEAST_RATIO))


def lines_of_memory(log: Path, workers: int) -> Iterator[Line]:
    """Yield the memory at parts of the run, which several calls may have made."""
    samples = [json.loads(line) for line in log.read_text(encoding='utf-8').splitlines()]
    for who, of in (('worker', f'largest of {workers} workers'), ('program', 'program')):
        first = None
        for part in PARTS:
            sample = next((each for each in samples if each['done'] >= part * each['count']), None)
            if sample is None:
                continue
            first = first or sample[who]
            rise, later = sample[who] / first - 1.0, part > PARTS[0]
            yield Line(f'{of} after {part:.0%} of the recordings, MB', f'{sample[who]:.0f}', 1,
                       f'<= {MOST_RISE:+.0%}' if later else '',
                       rise <= MOST_RISE if later else None)


@contextmanager
def time_stages(spent: dict[str, float], stages: Mapping[str, tuple[Any, str]],
                clock: Callable[[], float] = time.perf_counter) -> Iterator[None]:
    """Add up the time of functions, by stage; a function is an object and a name in it."""
    def with_timer(stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def run_timed(*given: Any, **options: Any) -> Any:
            begin = clock()
            try:
                return function(*given, **options)
            finally:
                spent[stage] += clock() - begin
        return run_timed

    with ExitStack() as stack:
        for stage, (owner, name) in stages.items():
            stack.enter_context(
                mock.patch.object(owner, name, with_timer(stage, getattr(owner, name))))
        yield


def costs_by_stage(found: Sequence[Input], options: Options, folder: Path) -> dict[str, float]:
    """Return the cost by stage in one process [ms of processor per recording]."""
    spent: dict[str, float] = defaultdict(float)
    here = mock.patch.object(RUN.WorkerProcess, 'call_within',
                             lambda self, limit_s, function, *given: function(*given))
    with TemporaryDirectory(dir=folder) as out, here:
        store = Store(Path(out))
        first = Store(store.folder / 'first')
        RUN.calibrate_recording(found[0], options, first, RUN.LIMIT_S)  # imports
        with time_stages(spent, {
                'all': (RUN, 'calibrate_recording'), 'hash': (RUN, 'content_hash'),
                'read and capture': (ROWS, 'poses_of'), 'fit': (pipeline, 'fit_poses'),
                'refine': (pipeline, '_refinement'), 'rate': (pipeline, 'rate'),
                'fit for the prior': (ROWS, 'fit_poses'),
                'write the calibration': (RUN, 'write_calibration'),
                'write the row': (Store, 'add')}, time.process_time):
            for each in found:
                RUN.calibrate_recording(each, options, store, RUN.LIMIT_S)
        spent['other'] = 2.0 * spent['all'] - sum(spent.values())
        with time_stages(spent, {
                'merge': (Store, 'merge'), 'compare': (SENSORS, '_compared'),
                'read the calibrations': (SENSORS, 'read_calibration'),
                'finish': (Store, 'finish'), 'digest': (RUN, 'digest_of')}, time.process_time):
            names = store.waiting()
            for name in names:
                SENSORS.merge_sensor(name, store)
            for name in names:
                store.finish(name)
                RUN.digest_of(name, store)
    return {stage: 1e3 * seconds / len(found) for stage, seconds in spent.items()}


@dataclass(frozen=True)
class Whole:
    """The run over all recordings, or those that are left."""

    summary: Summary  # what was done
    per_s: float  # recordings per second
    seconds: float  # duration [s]
    program_s: float  # processor time of the program with the scheduler [s]
    memory: float  # resident memory of the program at the end [MB]
    after: Mapping[str, float]  # seconds of the stages after the recordings


def run_whole(found: Sequence[Input], options: Options, workers: int, folder: Path) -> Whole:
    """Calibrate all recordings, or those that are left."""
    spent: dict[str, float] = defaultdict(float)
    with cluster(workers=workers) as client:
        client.wait_for_workers(workers)
        begin, program_s = time.perf_counter(), time.process_time()
        watch = Watch(client, folder / 'memory.jsonl')
        with time_stages(spent, {MERGED: (RUN, '_merge'), DIGESTED: (RUN, 'overview'),
                                 **{stage: (RUN, name) for stage, name in ALONE.items()}}):
            summary = run(client, found, options, Store(folder / 'results'), watch)
        return Whole(summary, watch.per_s(), time.perf_counter() - begin,
                     time.process_time() - program_s, memory_mb(), spent)


def lines_of_run(done: Whole, workers: int) -> Iterator[Line]:
    """Yield the figures of the run over all recordings."""
    counts = done.summary.counts
    total = sum(counts.values())
    words = ', '.join(f'{count:,} {name}' for name, count in sorted(counts.items()))
    yield Line(f'whole run, minutes ({words})', f'{done.seconds / 60.0:.1f}', total)
    yield Line(f'all recordings, per second with {workers} workers', f'{done.per_s:.1f}', total)
    yield Line('program with the scheduler, ms of processor per recording',
               f'{1e3 * done.program_s / total:.2f}', total)
    yield Line('program at the end, with the libraries of the page, MB', f'{done.memory:.0f}')
    for stage, seconds in done.after.items():
        yield Line(f'after the recordings: {stage}, seconds', f'{seconds:.1f}', total)
    alone = sum(done.after.get(stage, 0.0) for stage in ALONE) / done.seconds
    yield Line('what the program does alone, of the whole run', f'{alone:.1%}', 1,
               f'<= {MOST_ALONE:.0%}', alone <= MOST_ALONE)


def lines_of_costs(costs: Mapping[str, float], done: Whole, calibrations: int, workers: int, *,
                   refined: bool) -> Iterator[Line]:
    """Yield the cost by stage, and what a million robots need."""
    for stage, cost in costs.items():
        if stage != 'all':
            yield Line(f'{stage}, ms of processor per recording', f'{cost:.2f}',
                       STAGED * calibrations)
    each_s = workers / done.per_s
    yield Line('a recording of the whole run on a worker, ms', f'{1e3 * each_s:.1f}')
    count = sum(done.summary.counts.values())
    end_s = sum(done.after.get(stage, 0.0) for stage in (MERGED, DIGESTED)) * workers / count
    for kind, search in (('the search', costs['refine']), ('no search', 0.0)):
        more_s = (search - (costs['refine'] if refined else 0.0)) / 1e3
        hours = MILLION * calibrations * (each_s + end_s + more_s) / HOUR_S
        yield Line(f'a million robots with {calibrations} recordings each and {kind}, core hours',
                   f'{hours:,.0f}')


def fleet(frame: Frame, sensors: int = 10_000, calibrations: int = 20, workers: int = 2,
          seed: int = 1, no_refine: bool = False, folder: Path | None = None) -> Iterator[str]:
    """
    Yield the parts of the page.

    The recordings and the results are in `folder`, where a second call continues; by default in a
    temporary one.

    """
    with TemporaryDirectory() as temporary:
        folder = (folder or Path(temporary)).absolute()
        with ProcessPoolExecutor(workers) as pool:
            list(pool.map(functools.partial(
                write_sensor, folder / 'in', calibrations=calibrations, seed=seed),
                range(sensors), chunksize=20))
        tell(f'{sensors:,} sensors written')
        options = Options(model_from='^([AB])-', refined=not no_refine)
        found = list(recordings([str(folder / 'in')]))
        mixed = np.random.default_rng(seed).permutation(len(found)).tolist()
        some = [found[k] for k in mixed[:max(TIMED.values())]]
        lines = list(lines_of_workers(some, options, folder))
        firsts = dict.fromkeys(k - k % calibrations for k in mixed[:STAGED])
        staged = [found[first + k] for first in firsts for k in range(calibrations)]
        costs = costs_by_stage(staged, replace(options, refined=True), folder)
        done = run_whole(found, options, workers, folder)
        lines += [*lines_of_memory(folder / 'memory.jsonl', workers),
                  *lines_of_run(done, workers), *lines_of_changes(
                      [draw_sensor(k, calibrations, seed) for k in range(sensors)],
                      done.summary.sensors),
                  *lines_of_costs(costs, done, calibrations, workers, refined=not no_refine)]
    yield table(lines)
    yield f'{sensors:,} simulated sensors with {calibrations} pose tables of {POSES} poses each'
    yield f'in one process on {len(staged)} recordings of whole sensors'
    yield f'million robots with {calibrations} recordings each need the core hours'
