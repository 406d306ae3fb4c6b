# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Seeded damage to files of every kind that is read, and random files.

Most cases change a sound file: bytes flipped, removed, repeated or inserted, numbers replaced by
others, the file cut or joined with another one. Others are made at random: tables (``table``),
calibrations with values of wrong types (``tree``), bags of damaged messages (``messages``), tables
and figures of the noise with hostile text (``text``, ``noise``), and DataFrames (``frame``). The
reader must end with a result or with an error of this package in one line, print nothing, and keep
within a time limit. Bags are also corrected, and calibrations that are read are used. A
calibration of a table with hostile text is stored, read and exported, and no line of that text
leaves a comment. ``command`` runs the command line on files of all kinds. It must end with exit
status 0 or 1, or with 2 and one line.

Run many cases of some kinds: ``ACCEL_CALIB_TRIALS=1000 pytest test/faults/test_fuzz.py -k yaml``.

"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
import io
import os
from pathlib import Path
import re
import shutil
import signal
from tempfile import TemporaryDirectory, TemporaryFile
import warnings

import accel_calib as ac
from accel_calib.errors import AccelCalibError, InputError, StoredCalibrationError
from accel_calib.logs import LogOptions, write_table
from accel_calib.messages import correct_bag
from accel_calib.stored import read_calibration, write_calibration
from faults import inputs
from faults.inputs import BAGS, EXTREME, Files, one
from inside import (
    Calibration, CALIBRATION_ALONE, export, ExportOptions, format_calibration,
    main as command_line, parse_calibration, poses_of, read_log, read_noise)
import numpy as np
import pandas
from shared import known
import yaml

Rng = np.random.Generator
Make = Callable[[Rng], Files]
Read = Callable[[Path, Rng], object]

_NUMBER = re.compile(rb'-?\d+\.?\d*')
_REFUSAL = re.compile(r'(read as: [^\n]*\n|note: [^\n]*\n(  [^\n]*\n)*)*accel-calib [^\n]*\n')
"""What a refused command prints: one line, after notes about a calibration edited by hand."""

LONGEST_LINE = 700
"""Longest error message about a calibration [characters]."""

_LIMIT_S = 60
_SHOWN = 500
_MEMORY = Path('/dev/shm')
_NOT_SHOWN = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
"""Warnings that Python does not show to users."""


class TooSlowError(BaseException):
    """A case took longer than the limit; not an Exception, which a reader can catch."""


class NotAllowedError(Exception):
    """A command ended in another way than the rules allow."""


# -------------------------------------------------------------------------------------- damage

def damaged(data: bytes, rng: Rng) -> bytes:
    """Return data with one to four changes."""
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        at, length = (int(rng.integers(0, max(len(data), 1))) for _ in range(2))
        span = slice(at, min(len(data), at + 1 + length % int(rng.choice([1, 8, 64]))))
        how = int(rng.integers(0, 9))
        extreme = EXTREME[int(rng.integers(0, len(EXTREME)))]
        number = _NUMBER.search(data, at)
        if how > 6 and number:
            other = b'%.9g' % (rng.normal() * 10.0 ** int(rng.integers(-3, 5)))
            span, piece = slice(*number.span()), (other, extreme)[how - 7]
        else:
            flipped = bytes(each ^ 1 << length % 8 for each in data[span])
            piece = (rng.bytes(1 + length % 8), extreme, b'', data[span] * 3, flipped,
                     data[span][::-1], data[at:])[how % 7]
        data = data[:at] if how == 6 and length % 2 else (
            data[:span.start] + piece + data[span.stop:])
    return data


def damage(kind: str) -> Make:
    """Return the maker of damaged files of a kind."""
    sound = inputs.sound(kind)

    def make(rng: Rng) -> Files:
        files = sound[int(rng.integers(0, len(sound)))]
        name = sorted(files.content)[int(rng.integers(0, len(files.content)))]
        return Files(files.name, {**files.content, name: damaged(files.content[name], rng)})
    return make


# ------------------------------------------------------------------------------------- readers

def _log(path: Path, rng: Rng) -> object:
    """Read a log, at times with options."""
    if rng.random() < 0.7:
        return read_log(path)
    units = ('', 'g', 'm/s2', 'native')[int(rng.integers(4))]
    return read_log(path, LogOptions(skip_bad=bool(rng.integers(2)), units=units,  # type: ignore
                                     rate=(None, 50.0)[int(rng.integers(2))]))


def read_bag(path: Path, rng: Rng) -> object:
    """Correct a bag, and read it; each error names the bag, and leaves no copy."""
    out = path.parents[1] / ('copy.bag' if path.suffix == '.bag' else 'copy')
    _remove(out)
    refused = None
    try:
        correct_bag(path, known(), out)
    except InputError as err:
        refused = err
    if out.exists() is (refused is not None) or list(out.parent.glob('.*')):
        raise NotAllowedError(f'after {refused}, there are {sorted(out.parent.iterdir())}')
    try:
        read = _log(path, rng)
    except InputError as err:
        refused = err
    if refused is None:
        return read
    if str(path) not in str(refused):
        raise NotAllowedError(f'the bag is not named: {refused}')
    raise refused


def _remove(path: Path) -> None:
    """Remove a file or folder, if it exists."""
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _used(path: Path, rng: Rng) -> object:
    """Read a calibration, correct a reading with it, and store it again."""
    try:
        found = read_calibration(path)
    except StoredCalibrationError as err:
        if not str(err).isprintable() or len(str(err)) > LONGEST_LINE:
            raise NotAllowedError(f'not one short line: {str(err)!r}') from err
        raise
    context = {key: np.ones((1, 3) if key in ('std', 'rate', 'previous') else 1)
               for key in found.model.needs}
    force = found.correct(np.array([[0.3, -0.4, 0.8]]) * found.units.per_g, context)
    for values in (force, found.offset, found.offset_sd, found.gain, found.gain_sd):
        np.testing.assert_array_equal(np.isfinite(values), True)
    again = parse_calibration(format_calibration(found), 'again.yaml')
    np.testing.assert_array_equal(again.model.vector, found.model.vector)
    return found


def _fitted(path: Path, rng: Rng) -> object:
    """Fit the poses of a table, as captured if it holds samples."""
    return ac.fit(poses_of(path).poses)


def _told(path: Path, rng: Rng) -> object:
    """Fit the poses of a table with hostile text, store and export the calibration."""
    fitted, stored = ac.fit(path), path.parents[1] / 'told.yaml'
    write_calibration(stored, fitted)
    found, place = read_calibration(stored), fitted.poses.autopilot
    plain = replace(found, sensor='', poses=replace(
        found.poses, autopilot=place and replace(place, corrected='')))
    to = one(rng, CALIBRATION_ALONE[:-2])
    if found.sensor != fitted.sensor or _lines_of(found, to) != _lines_of(plain, to):
        raise NotAllowedError(f'{to} has lines of {found.sensor!r} or {place}')
    write_table(stored, found.poses)
    return _log(stored, rng)


def _lines_of(calibration: Calibration, to: str) -> list[str]:
    """Return the lines of an export that are no comments."""
    text = str(export(calibration, to, options=ExportOptions(name='imu')).text_or_bytes)
    return [line for line in text.split('\n') if not re.match(r'#? |# | \*|//|  "comment"', line)]


def _noise(path: Path, rng: Rng) -> object:
    """Export figures of the noise."""
    found = yaml.safe_load(str(export(known(), 'vins', read_noise(path)).text_or_bytes))
    if len(found) != 5 or not all(isinstance(each, float) for each in found.values()):
        raise NotAllowedError(f'the file has {found}')
    return found


def _frame(path: Path, rng: Rng) -> object:
    """Fit the poses of a DataFrame, at times with repeated names and hostile attributes."""
    try:
        frame = pandas.read_csv(path, comment='#', encoding_errors='replace', nrows=100)
    except ValueError as err:  # as of an empty file, and not a finding
        raise InputError(str(err), '') from err
    if rng.random() < 0.3:
        frame.columns = rng.choice(list(frame.columns), len(frame.columns))
    frame.attrs = {name: one(rng, (inputs.hostile(rng), *inputs.VALUES))
                   for name in ('sensor', 'autopilot', 'units') if rng.random() < 0.3}
    return ac.fit(frame)


def _run(path: Path, rng: Rng) -> object:
    """Run a random command on a file, and check how it ends."""
    table, calibration, out = (path.parents[1] / name for name in ('poses.csv', 'c.yaml', 'out'))
    file, good, made, poses = map(str, (path, calibration, out, table))
    of_yaml = [['verify', poses, '-c', file], ['apply', poses, '-c', file, '-o', made],
               ['compare', file, good], ['history', file, good],
               ['export', file, '--to', 'json', '-o', made], ['export', file, '--to', 'px4']]
    of_log = [['capture', file, '-o', made], ['fit', file, '-o', made, '--json', '-'],
              ['verify', file, '-c', good], ['apply', file, '-c', good, '-o', made],
              ['calibrate', file, '-o', made, '--no-refine', '--json', '-'], ['noise', file],
              ['thermal', file, '-o', made, '--json', '-']]
    commands = of_yaml if path.suffix == '.yaml' else of_log
    return checked([*commands[int(rng.integers(len(commands)))]], out)


def checked(arguments: list[str], out: Path) -> int:
    """Run a command, and check its exit status, what it prints and what it leaves."""
    for each in (out, out.with_suffix('.html')):
        _remove(each)
    before = set(out.parent.iterdir())
    with redirect_stderr(io.StringIO()) as errors, redirect_stdout(io.StringIO()) as printed:
        status = command_line(arguments)
    text, left = errors.getvalue(), set(out.parent.iterdir()) - before
    refused = status == 2 and not left and _REFUSAL.fullmatch(text)
    if '\x1b' in text + printed.getvalue() or 'internal error' in text or not (
            refused or status in (0, 1)):
        raise NotAllowedError(f'{arguments[0]} ends with status {status}, prints {text!r} and '
                              f'{printed.getvalue()!r}, and leaves {sorted(left)}')
    if refused:
        raise InputError(text.splitlines()[-1], '')
    return status


def _of_all() -> Make:
    """Return the maker of files of all kinds, for the command line."""
    makes = [KINDS[kind][0]() for kind in KINDS if kind != 'command']
    return lambda rng: makes[int(rng.integers(len(makes)))](rng)


KINDS: dict[str, tuple[Callable[[], Make], Read]] = {
    'yaml': (lambda: damage('yaml'), _used),
    'poses': (lambda: damage('poses'), _fitted),
    **{kind: (lambda kind=kind: damage(kind), read_bag if kind in BAGS else _log)  # type: ignore
       for kind in ('csv', 'ulg', 'bin', 'container', *BAGS)},
    'table': (lambda: inputs.random_table, _log),
    'tree': (inputs.random_trees, _used),
    'messages': (inputs.random_messages, read_bag),
    'text': (lambda: inputs.hostile_table, _told),
    'noise': (lambda: inputs.hostile_noise, _noise),
    'frame': (lambda: lambda rng: one(rng, (inputs.random_table, inputs.hostile_table))(rng),
              _frame),
    'command': (_of_all, _run)}
"""Maker and reader of each kind."""


# --------------------------------------------------------------------------------------- cases

def outcomes(kind: str, count: int, seed: int) -> Iterator[tuple[int, str]]:
    """Yield the number of each case, and how it ended: ``read``, ``refused`` or a finding."""
    make, read = KINDS[kind][0](), KINDS[kind][1]
    with TemporaryDirectory(dir=_MEMORY if _MEMORY.is_dir() else None) as name:
        folder = Path(name)
        inputs.sound('yaml')[0].write(folder)
        write_table(folder / 'poses.csv', ac.simulate({}, poses=12, seed=1))
        with _heard() as heard:
            for case in range(count):
                rng = np.random.default_rng([seed, case])
                path = make(rng).write(folder / 'case')
                outcome = ended(read, path, rng)
                printed = heard()
                yield case, f'prints {printed}' if printed else outcome


def ended(read: Read, path: Path, rng: Rng) -> str:
    """Read a file; return ``read``, ``refused``, or what no reader should do."""
    def stop(number: int, frame: object) -> None:
        raise TooSlowError(f'more than {_LIMIT_S} s')

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(_LIMIT_S)
    try:
        read(path, rng)
    except AccelCalibError as err:
        return 'refused' if '\n' not in str(err) else f'of several lines: {err}'
    except (Exception, TooSlowError) as err:  # any other error is a finding
        return f'{type(err).__name__}: {err}'
    finally:
        signal.alarm(0)
    return 'read'


@contextmanager
def _heard() -> Iterator[Callable[[], str]]:
    """Yield a function that returns what was printed or warned of since the last call."""
    kept = os.dup(2)
    with (TemporaryFile() as file, os.fdopen(os.dup(file.fileno()), 'w') as errors,
          warnings.catch_warnings(record=True) as warned):
        warnings.simplefilter('always')
        for kind in _NOT_SHOWN:
            warnings.simplefilter('ignore', kind)

        def heard() -> str:
            errors.flush()
            words = [f'{each.category.__name__}: {each.message} ({each.filename}, line '
                     f'{each.lineno})' for each in warned]
            warned.clear()
            if os.fstat(file.fileno()).st_size:
                words.append(os.pread(file.fileno(), _SHOWN, 0).decode(errors='replace'))
                os.ftruncate(file.fileno(), 0)
                os.lseek(file.fileno(), 0, os.SEEK_SET)
            return '; '.join(words)

        os.dup2(file.fileno(), 2)
        try:
            with redirect_stderr(errors):
                yield heard
        finally:
            os.dup2(kept, 2)
            os.close(kept)
