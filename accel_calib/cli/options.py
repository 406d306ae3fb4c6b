# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Options that several commands have, and the output of results."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
import json
from pathlib import Path
from typing import Any

import numpy as np

from .terminal import Output, progress
from ..calibrate import Calibration, FleetPrior
from ..disk import write_atomically
from ..errors import AccelCalibError, InputError, system_error
from ..intake import Intake, poses_of
from ..logs import LogOptions, NAMES
from ..rating import Rating
from ..stored import OF_FILE, read_calibration
from ..stored.fleet_yaml import read_prior
from ..table import COLUMNS, Poses
from ..units import STANDARD_GRAVITY, UNIT_NAMES


def add_example(made: argparse.ArgumentParser, example: str) -> None:
    """Add an example to the end of the help."""
    made.epilog = f'example:\n  {example}'
    made.formatter_class = argparse.RawDescriptionHelpFormatter


def positive(text: str) -> float:
    """Return a positive number from an argument."""
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text}: expected a positive number')
    return value


def add_units(made: argparse.ArgumentParser, default: str = '') -> None:
    """Add ``--units`` and ``--gravity``; without a default, the file states the unit."""
    made.add_argument('--units', choices=UNIT_NAMES, default=default,
                      help='unit of ax,ay,az; native is counts or volts (default: '
                      f'{default or "the unit in the file, or recognised"})')
    made.add_argument('--gravity', type=positive, default=STANDARD_GRAVITY, metavar='M/S2',
                      help='local gravity [m/s2] (default: %(default)s)')


def add_log(made: argparse.ArgumentParser) -> None:
    """Add the options for reading a log: its format, columns, topics and unit."""
    made.add_argument('--format', choices=NAMES, default='', help='layout of the log (default: it '
                      'is recognised)')
    made.add_argument('--columns', type=_columns, action='append', default=[],
                      metavar='OURS=THEIRS,...', help='columns by their name or number in the '
                      'log, such as time=t_ms,ax=accX,ay=accY,az=accZ')
    made.add_argument('--skip-bad', action='store_true', help='skip lines that cannot be read')
    made.add_argument('--rate', type=positive, metavar='HZ', help='samples per second of a log '
                      'without times')
    made.add_argument('--topic', default='', help='Imu topic of a bag, or message of a flight '
                      'log, if there are several')
    made.add_argument('--sensor', default='', help='name of the sensor: frame_id of its messages, '
                      'or its number in a flight log (default: the name in the log)')
    made.add_argument('--temperature-topic', default='', metavar='TOPIC[:FIELD]', help='topic of '
                      'the temperature, for a bag without sensor_msgs/Temperature or with several')
    made.add_argument('--supply-topic', default='', metavar='TOPIC[:FIELD]', help='topic of the '
                      'supply voltage, for a bag')
    add_units(made)


def add_max_dwell(made: argparse.ArgumentParser) -> None:
    """Add ``--max-dwell``."""
    made.add_argument('--max-dwell', type=positive, metavar='S', help='for a recording: split '
                      'longer rests into poses with the same orientation')


def add_prior(made: argparse.ArgumentParser, group: Any = None) -> None:
    """Add ``--prior``, to a group if there is one, and ``--sensor-model``."""
    (group or made).add_argument(
        '--prior', type=Path, metavar='FLEET', help='typical values of a fleet (fleet.yaml of '
        'accel-calib fleet) for offset, gain and cross-axis, for few poses')
    made.add_argument('--sensor-model', default='', metavar='NAME', help='model of the sensor in '
                      'the file of --prior, if it has several')


def prior(args: argparse.Namespace) -> FleetPrior | None:
    """Return the typical values that `add_prior` asks for."""
    return None if args.prior is None else read_prior(args.prior, args.sensor_model)


def _columns(text: str) -> dict[str, str]:
    """Return the columns that an argument names."""
    pairs = [part.partition('=') for part in text.split(',')]
    names = [name for column in COLUMNS.values() for name in column.names if not column.made]
    for ours, equals, _ in pairs:
        if ours.strip() not in names or not equals:
            raise argparse.ArgumentTypeError(f'{text}: expected NAME=COLUMN with a name of '
                                             f'{", ".join(names)}')
    return {ours.strip(): theirs.strip() for ours, _, theirs in pairs}


def log_options(args: argparse.Namespace) -> LogOptions:
    """Return how to read a log, from the options of `add_log`."""
    columns = {ours: theirs for given in args.columns for ours, theirs in given.items()}
    return LogOptions(columns=columns, format=args.format, skip_bad=args.skip_bad,
                      rate=args.rate, units=args.units, gravity=args.gravity,
                      topic=args.topic, sensor=args.sensor,
                      temperature_topic=args.temperature_topic, supply_topic=args.supply_topic)


def log_options_for(args: argparse.Namespace, calibration: Calibration) -> LogOptions:
    """Return how to read a log for a calibration: in its unit, if the log states none."""
    asked, units = log_options(args), calibration.units
    if units.name == 'native':  # its readings can look like g
        return replace(asked, default_units='native')
    return replace(asked, gravity=units.per_g) if units.name == 'm/s2' else asked


def intake(args: argparse.Namespace, path: Path) -> Intake:
    """Return the poses of a log; a recording is captured."""
    return _intake(args, path, log_options(args))


def intake_for(args: argparse.Namespace, path: Path, calibration: Calibration
               ) -> tuple[Intake, Calibration]:
    """Return the poses of a log, and a calibration in their unit."""
    found = _intake(args, path, log_options_for(args, calibration))
    return found, calibration.in_units(found.units)


def _intake(args: argparse.Namespace, path: Path, asked: LogOptions) -> Intake:
    with progress('samples') as moved:
        return poses_of(path, asked, settings(args), moved)


def settings(args: argparse.Namespace) -> dict[str, float]:
    """Return the settings of the capture, from the options."""
    return {} if args.max_dwell is None else {'max_dwell': args.max_dwell}


def rated(rating: Rating) -> dict[str, str]:
    """Return a rating for JSON."""
    return {'rating': rating.name, 'rating_reason': rating.reason}


def add_json(made: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    made.add_argument('--json', metavar='FILE', help='JSON file to write with the result; - for '
                      'standard output')


def write_json(target: str | None, result: object) -> None:
    """Write a result as JSON to a file, or to standard output for ``-``; None: do nothing."""
    if target is None:
        return
    text = json.dumps(plain(result), indent=2, allow_nan=False)
    if target == '-':
        print(text)
    else:
        write_atomically(Path(target), lambda file: file.write(f'{text}\n'))


@contextmanager
def errors_in_json(target: str | None, **about: object) -> Iterator[None]:
    """Write an error as JSON, beside what it is about, and raise it again."""
    try:
        yield
    except AccelCalibError as err:
        write_json(target, {**about, **_of_error(err)})
        raise


def attempted(work: Callable[[], Mapping[str, Any]], path: Path) -> dict[str, Any]:
    """Return the result of one of several inputs for JSON; an error is a result, too."""
    try:
        found: dict[str, Any] = plain(work())
    except AccelCalibError as err:
        return {'file': str(path), **_of_error(err)}
    except OSError as err:
        return {'file': str(path), **_of_error(system_error(err))}
    return found


def _of_error(error: AccelCalibError) -> dict[str, str]:
    return {'error': error.message, 'advice': error.advice}


def plain(value: object) -> Any:
    """Convert arrays to lists, numbers that are not finite to None, and paths to text."""
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def stored_calibration(path: Path) -> Calibration:
    """Read a stored calibration; report on standard error if it was edited by hand."""
    calibration = read_calibration(path)
    for found in calibration.noted:
        if found.kind in OF_FILE:
            Output(stderr=True).print(f'note: {path}: {found.words}')
    return calibration


def console(args: argparse.Namespace) -> Output:
    """Return the console for text output: standard error if JSON goes to standard output."""
    return Output(stderr=getattr(args, 'json', None) == '-')


def rows_between(poses: Poses, text: str | None) -> Poses:
    """
    Return the rows ``A:B`` of a table, 1-based, inclusive; A and B are optional.

    Raises
    ------
    InputError
        If the text is not of this form, or the rows are not in the table.

    """
    if text is None:
        return poses
    first, colon, last = text.partition(':')
    try:
        start, stop = int(first or 1), int((last if colon else first) or len(poses))
    except ValueError:
        start, stop = 0, 0
    if not 1 <= start <= stop <= len(poses):
        raise InputError(f'--rows is {text}, expected A:B within 1:{len(poses)}',
                         'set A and B to the first and the last row, 1-based')
    return poses.take(slice(start - 1, stop))


def in_parallel(function: Any, items: Sequence[Any], jobs: int) -> list[Any]:
    """Return the results of a function for each item, in order; `jobs` processes are used."""
    if jobs <= 1 or len(items) <= 1:
        return [function(item) for item in items]
    from concurrent.futures import ThreadPoolExecutor
    from queue import SimpleQueue

    from ..session.worker import WorkerProcess

    workers = [WorkerProcess(idle=False) for _ in range(min(jobs, len(items)))]
    free: SimpleQueue[WorkerProcess] = SimpleQueue()
    for worker in workers:
        free.put(worker)

    def one(item: Any) -> Any:
        worker = free.get()
        try:
            return worker.call(function, item)
        finally:
            free.put(worker)

    with ThreadPoolExecutor(len(workers)) as pool:
        try:
            return list(pool.map(one, items))
        finally:
            for worker in workers:
                worker.close()
