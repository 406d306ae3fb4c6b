# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A run over the recordings of a fleet, on Dask.

The program submits a limited number of tasks, and submits the next one when one is done. Its
memory and that of the scheduler therefore do not grow with the number of recordings. The tasks
after the recordings are by sensor: merge and compare, remove the pending rows, digest for the
statistics. The program alone writes what concerns all sensors.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
import signal
from tempfile import TemporaryDirectory
import threading
import time
from typing import Any, TYPE_CHECKING, TypeVar

from .overview import digest_of, overview, priors_of, rating_of, write_fleet_page
from .recording import (
    as_folder, content_hash, Input, key_of, on_disk, Options, Row, row_of, schema, unread_row)
from .sensors import (
    is_damaged, merge_sensor, read_parquet, SENSORS, Store, UNREAD, write_parquet, write_sensors)
from ..calibration import Calibration
from ..disk import write_atomically
from ..effects import OwnEffect
from ..errors import AccelCalibError, InputError, known_error, needing
from ..findings import Rating
from ..logs import Progress
from ..session import WorkerProcess
from ..stored import write_calibration, write_priors
from ..stored.exports import export

if TYPE_CHECKING:
    from distributed import Client

_Item = TypeVar('_Item')
_Result = TypeVar('_Result')

_AHEAD = 4
"""Tasks in the queue per worker thread: enough that none waits for the program."""

_ABSENT_S = 30.0
"""Time without any worker after which a cluster of this machine starts another one [s]."""

_LOOK_S, _FETCH_S = 0.02, 10.0
"""Interval at which tasks and workers are looked for [s], and time to fetch a result [s], which
begins again after it."""

_TASK_S = 0.5
"""Duration of a task [s]: recordings share it if they are quick, because a task costs the program
some milliseconds."""

_MOST_TOGETHER = 20
"""Largest number of recordings per task: they are done again if their worker dies."""

_NEWEST = 0.2
"""Weight of the newest task in the mean duration of a recording."""

STATUS = ('ok', 'error', 'unread', 'skipped')
"""What can happen to a recording; unread: it could not be read, and is tried again."""

PRIOR_FILE = 'fleet.yaml'

LIMIT_S = 900.0
"""Longest time of one recording [s], far above that of a day at 100 Hz."""

_HERE = '127.0.0.1'
"""Address of a cluster on this machine; other machines do not reach it."""

_CONFIG = {'distributed.worker.profile.enabled': False,
           'distributed.scheduler.worker-saturation': 1.0,
           'distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED': 'critical'}
"""
Settings of a cluster on this machine. The profiles of a worker grow to some 300 MB. If a worker
dies, Dask suspects all its tasks: it has only the one that it runs. A worker that notices the end
of the scheduler before its own end would print a traceback.
"""


@dataclass(frozen=True)
class Summary:
    """
    What a run did.

    `counts` are the recordings by status (`STATUS`), and `sensors` the rows of all sensors.
    `damaged` are damaged files of the results, under their new names; their content was made
    again.

    """

    counts: Counter[str]
    sensors: tuple[Row, ...]
    damaged: tuple[str, ...]
    rating: Rating


@contextmanager
def cluster(address: str = '', workers: int | None = None) -> Iterator[Client]:
    """
    Connect to a scheduler, or start a cluster on this machine with one thread per worker.

    Parameters
    ----------
    address : str
        Address of the scheduler; empty: a cluster on this machine.
    workers : int, optional
        Number of workers on this machine; by default one per core.

    Raises
    ------
    InputError
        If Dask is not installed, or the scheduler cannot be reached.

    """
    with needing('dask distributed fsspec pyarrow bokeh', 'the command fleet'):
        import dask
        from distributed import Client, LocalCluster
        from distributed.gc import disable_gc_diagnosis
        import pyarrow  # noqa: F401
    with _ctrl_c_waits(), ExitStack() as stack:
        # Threads and processes inherit the mask; the tracker would lift it when it starts.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            if not address:
                scratch = stack.enter_context(TemporaryDirectory(prefix='accel_calib-'))
                stack.enter_context(dask.config.set({**_CONFIG, 'temporary-directory': scratch}))
                started: Any = stack.enter_context(LocalCluster(
                    n_workers=workers, threads_per_worker=1, host=_HERE,
                    dashboard_address=f'{_HERE}:0', silence_logs='ERROR'))
            client = stack.enter_context(Client(
                address or started, timeout=30.0, set_as_default=False))
        except (OSError, ValueError) as err:
            if not address:
                raise
            raise InputError(f'no scheduler answers at {address}: {err}', 'start dask scheduler, '
                             'or correct --scheduler') from err
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        disable_gc_diagnosis(force=True)  # Ctrl-C in its callback would be printed and lost
        yield client


_ctrl_c = threading.Event()
"""Whether Ctrl-C came."""


@contextmanager
def _ctrl_c_waits() -> Iterator[None]:
    """Let Ctrl-C wait for `mapped` or the end: within Dask it leaves half-done calls."""
    before = signal.getsignal(signal.SIGINT)
    if before != signal.SIG_IGN:
        signal.signal(signal.SIGINT, lambda number, frame: _ctrl_c.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if _ctrl_c.is_set():  # whatever else the interruption has caused
            _ctrl_c.clear()
            raise KeyboardInterrupt


def run(client: Client, found: Sequence[Input], options: Options, store: Store,
        progress: Progress = lambda done, count: None, limit_s: float = LIMIT_S) -> Summary:
    """
    Calibrate recordings, and bring the data set up to date.

    Parameters
    ----------
    client : distributed.Client
        As `cluster` yields it.
    found : sequence of Input
        The recordings.
    options : Options
        How to calibrate them.
    store : Store
        The results.
    progress : function of two int
        Called with the number of recordings done and of all recordings.
    limit_s : float
        Longest time of one recording [s].

    Returns
    -------
    Summary
        What was done.

    Raises
    ------
    InputError
        If another program writes to the store, or the scheduler is gone.
    OSError
        If a result cannot be written.

    """
    from distributed import KilledWorker

    with store.locked():
        files = list(store.files())
        damaged = tuple(str(store.set_aside(path)) for path, is_so in zip(
            files, _in_order(client, is_damaged, files), strict=True) if is_so)
        store.forget_lost()
        _merge(client, store, options.own)  # what an interrupted run left
        counts, unread, done = Counter[str](), list[Row](), set[str]()
        calibrate = partial(calibrate_recording, limit_s=limit_s)
        for item, row in mapped(client, calibrate, found, options, store):
            if isinstance(row, Exception):  # not of the recording, unless workers died
                if not isinstance(row, KilledWorker):
                    raise row
                row = unread_row(item, options, InputError(
                    'the workers that calibrated this recording died, expected them to finish',
                    'give the workers more memory, and run again'))
            key = row.get('key', '')
            counts['skipped' if key in done else row['status']] += 1  # a copy is in no other row
            if key:
                done.add(key)
            else:
                unread.append(row)
            progress(sum(counts.values()), len(found))
        if unread or store.data(UNREAD).exists():
            write_parquet(store.data(UNREAD), unread, schema())
        sensors = tuple(_merge(client, store, options.own))
        known = overview(_in_order(client, digest_of, [*store.sensors(), UNREAD], store))
        priors, path = priors_of(known.typical), store.folder / PRIOR_FILE
        if priors:
            write_priors(path, priors)
        else:
            path.unlink(missing_ok=True)
        write_fleet_page(store, known, sensors, priors)
        return Summary(counts, sensors, damaged, rating_of(known, sensors))


def _merge(client: Client, store: Store, own: tuple[OwnEffect, ...]) -> list[Row]:
    """Merge all pending rows, and compare the calibrations; return the rows of all sensors."""
    names = store.waiting()
    if not (store.folder / SENSORS).exists():
        names = sorted({*names, *store.sensors()})
    if not names:
        return read_parquet(store.folder / SENSORS)
    found = write_sensors(store, list(_in_order(client, merge_sensor, names, store, own)))
    deque(_in_order(client, store.finish, names), 0)
    return found


def _in_order(client: Client, function: Callable[..., _Result], items: Sequence[_Item],
              *others: Any) -> Iterator[_Result]:
    """Yield the result of a function for each item, in their order; raise its exception."""
    due, early = deque(items), dict[_Item, _Result]()
    for item, result in mapped(client, function, items, *others):
        if isinstance(result, Exception):
            raise result
        early[item] = result
        while due and due[0] in early:
            yield early.pop(due.popleft())


def mapped(client: Client, function: Callable[..., Any], items: Iterable[_Item], *others: Any
           ) -> Iterator[tuple[_Item, Any]]:
    """
    Yield each item with the result of a function, or its exception, as they are done.

    A worker that dies takes all of its tasks with it. Which item ended it shows where nothing else
    runs: those of its tasks are suspects, and are tried again one by one.

    """
    from distributed import as_completed, KilledWorker

    rest, suspects = iter(items), list[_Item]()
    size, mean_s = 1, _TASK_S  # number of items per task, and the mean duration of an item [s]
    waiting: dict[Any, list[_Item]] = {}
    done, workers = as_completed(loop=client.loop), _Workers(client.cluster, time.monotonic())
    limit = _AHEAD * max(sum(client.nthreads().values()), 1)
    alone = False
    while True:
        if not waiting:
            alone = bool(suspects)
        most = 1 if alone else 0 if suspects else limit
        while len(waiting) < most and (batch := [suspects.pop()] if alone else
                                       list(islice(rest, size))):
            future = client.submit(_each, function, batch, *others, pure=False)
            waiting[future] = batch
            done.add(future)
        if not waiting:
            return
        while not done.has_ready() and not _ctrl_c.is_set():
            time.sleep(_LOOK_S)
            workers.look()
        if _ctrl_c.is_set():
            raise KeyboardInterrupt
        future = next(done)
        batch = waiting.pop(future)
        try:
            results, seconds = _result_of(client, future, workers)
        except KilledWorker as err:
            if not alone:
                suspects += batch
                continue
            results, seconds = [err], 0.0
        del future  # so that the scheduler forgets it
        mean_s += _NEWEST * (seconds / len(batch) - mean_s)
        size = max(1, min(_MOST_TOGETHER, int(_TASK_S / max(mean_s, 1e-9))))
        yield from zip(batch, results, strict=True)


@dataclass
class _Workers:
    """
    Starts a worker of a cluster of this machine if none has been there for some time.

    Dask starts a worker that died again, but not one that died before it said that it started.

    """

    cluster: Any
    seen: float

    def look(self) -> None:
        now = time.monotonic()
        if self.cluster is None or self.cluster.scheduler.workers:
            self.seen = now
        elif now - self.seen > _ABSENT_S:
            self.seen = now
            self.cluster.scale(len(self.cluster.workers) + 1)


def _result_of(client: Client, future: Any, workers: _Workers) -> tuple[list[Any], float]:
    """Return the result of a task; raise InputError if the scheduler is gone."""
    from concurrent.futures import CancelledError

    from distributed import TimeoutError as NotYet
    from distributed.comm import CommClosedError

    try:
        while True:  # the worker that has the result can die before it is fetched
            try:
                found: tuple[list[Any], float] = future.result(timeout=_FETCH_S)
                return found
            except NotYet:
                workers.look()
    except (CancelledError, CommClosedError) as err:
        raise InputError(f'the scheduler {client.scheduler.addr} is gone; expected it to stay '
                         'until the end', 'start it again, and run the same command: done '
                         'recordings are skipped') from err


def _each(function: Callable[..., Any], batch: Sequence[Any], *others: Any
          ) -> tuple[list[Any], float]:
    """Return the result of a function per item, or its exception, and the seconds of them all."""
    begin, results = time.perf_counter(), list[Any]()
    for item in batch:
        try:
            results.append(function(item, *others))
        except Exception as err:  # the program decides
            results.append(err)
    return results, time.perf_counter() - begin


# ----------------------------------------------------------------------------- one recording

_apart = threading.local()
"""The process of each thread in which recordings are calibrated, so that it can be ended."""


def calibrate_recording(found: Input, options: Options, store: Store, limit_s: float) -> Row:
    """
    Calibrate one recording, add the result to the store, and return its key and its status.

    The whole row is returned, and not stored, if the recording cannot be read, takes longer than
    `limit_s` [s], or ends in any other error. OSError is raised if the result cannot be written.

    """
    begin, row = time.perf_counter(), Row()
    try:
        with on_disk(found.path) as path:
            content = content_hash(path)
            key = key_of(content, found, options)
            if store.mark(key).exists():
                return {'key': key, 'status': 'skipped'}
            if not hasattr(_apart, 'process'):
                _apart.process = WorkerProcess(idle=False)  # ends with this process
            row, calibration = _apart.process.call(row_of, found, path, options, limit_s=limit_s)
        row |= {'key': key, 'content': content, 'seconds': time.perf_counter() - begin}
        if calibration is not None:
            name = f'calibrations/{as_folder(row["sensor"])}/{key}.yaml'
            (store.folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_calibration(store.folder / name, calibration, keep_before=False)
            row['calibration'] = name
            row['warnings'] += _exported(calibration, store.folder / name, options.exports)
        store.add(row)
        return {'key': key, 'status': row['status']}
    except Exception as err:  # one recording must not stop the others
        if row and isinstance(err, OSError):
            raise
        error = known_error(OSError(str(err)) if isinstance(err, EOFError) else err)
        if isinstance(err, TimeoutError):
            error = InputError(f'{found.path} takes longer than {limit_s:g} s, expected less',
                               'raise --time-limit, or leave it out')
        return unread_row(found, options, error)


def _exported(calibration: Calibration, path: Path, formats: Sequence[str]) -> list[str]:
    """Write exports beside a calibration; return what they do not hold, or why there is none."""
    found = []
    for name in formats:
        try:
            made = export(calibration, name)
        except AccelCalibError as err:
            found.append(f'no export to {name}: {err}')
            continue
        end = Path(made.suffix).suffix or made.suffix  # two formats have the same suffix
        write_atomically(path.with_name(f'{path.stem}_{name}{end}'), made.write)
        found += [f'{name}: {line}' for line in made.losses]
    return found
