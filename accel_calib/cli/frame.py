# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The frame of every command: its inputs and outputs, JSON, page, rating and exit status.

The command NAME is the function ``run_NAME`` of its module, from the arguments for one input to
what is `Done`. If it takes several POSES, it runs once for each of them, and ``several_NAME``
yields what is printed for all their results.

All files that a command is to write are checked before any work. The folder of each file must
exist, no file is written onto an input or onto another output, and an existing file is replaced
only by one of its own kind, unless ``--force`` is set.

**Text.** Lines break at words, at the width of the terminal or of ``COLUMNS``. A word that is
longer, such as the name of a file, stays whole. An output whose encoding lacks a character gets a
plain replacement, such as ``+-`` for ±, and control characters from files never reach the
terminal. Progress is shown on standard error if it is a terminal.

"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, ExitStack
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
import json
import os
from pathlib import Path
import re
import sys
from textwrap import wrap
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .commands import COMMANDS, next_command
from .options import BAD_INPUT, plain_character, plain_handler, STANDARD_INPUT
from ..calibration import Calibration, FleetPrior
from ..disk import BEFORE, replaceable, STANDARD_OUTPUT, write_atomically
from ..effects import effects_of_file, OwnEffect
from ..errors import AccelCalibError, InputError, known_error, RefusedFitError, saying
from ..findings import Rating, rating_json
from ..logs import LogOptions, named_topics, OpenLog, Progress
from ..pipeline import Intake, options_for, poses_of
from ..stillness import CaptureSettings
from ..stored import calibration_from, OF_FILE, read_calibration, read_prior
from ..table import Poses
from ..text import counted, plain, short

FAILED = 1
"""Exit status for a result that is BAD, or if a check that was asked for fails."""

_OUTPUTS = {'json': 'result', 'report': 'page', 'plan': 'table', 'figures': ''}
"""Kind of the file that each option writes, besides ``-o``."""

_WITH_PAGE = ('calibrate', 'thermal')
"""Commands that write a page beside the calibration."""

_SUFFIXES = {'calibration': '.yaml', 'page': '.html', 'table': '.csv'}
_KINDS = {'calibration': BEFORE + rb'format: accel_calib', 'page': rb'<!DOCTYPE html',
          'result': rb'\s*[{\[]', 'table': rb'(#[^\n]*\n)*[^\n]*\bax\b[^\n]*',
          'export': rb'(?s).*(written by accel-calib|accel_calib) export'}
"""Beginning of a file of each kind."""

_PIPED = Path(STANDARD_OUTPUT)

_MOST_NOTES = 5
"""Largest number of notes without ``--verbose``."""


@dataclass(frozen=True)
class Done:
    """
    What a command has done for one input.

    `result` is the JSON. On the terminal, the rating is followed by its findings and by `notes`,
    the most important first, of which a few are shown without ``--verbose``, and then by `shown`,
    texts and tables, which are made when they are printed. `stored` are the files written. `page`
    returns the page, if one is asked for. `refusal` is why the file of ``-o`` is not written, and
    what to do. `error` is why nothing was done; `result` then states it.

    """

    result: Mapping[str, Any] = field(default_factory=dict)
    shown: Iterable[Any] = ()
    rating: Rating | None = None
    status: int = 0
    stored: Sequence[Path] = ()
    page: Callable[[], str] | None = None
    refusal: tuple[str, ...] = ()
    notes: Sequence[str] = ()
    error: AccelCalibError | OSError | None = None


class Target(NamedTuple):
    """A file to write: its argument and option, and its kind, empty for any."""

    name: str
    path: Path
    kind: str
    option: str


def run(args: argparse.Namespace) -> int:
    """
    Run a command, and return the exit status.

    AccelCalibError is raised if the input is not valid, and OSError if a file cannot be read or
    written; ``--json`` then has the error, too.

    """
    sources, outputs, each = getattr(args, 'poses', None), _outputs(args), [args]
    if isinstance(sources, list):  # of several POSES, outputs are folders
        folders = [target for target in outputs if len(sources) > 1 and target.kind in _SUFFIXES]
        each = [argparse.Namespace(**{**vars(args), 'poses': source, **{
            target.name: target.path / f'{Path(source).stem}{_SUFFIXES[target.kind]}'
            for target in folders}}) for source in sources]
    _check_targets(args, outputs, each)
    if args.command not in _WITH_PAGE and any(target.kind == 'page' for target in outputs):
        from ..report import check_matplotlib

        check_matplotlib()
    if len(each) == 1:
        return _run_one(each[0])
    if args.jobs <= 1:
        outcomes = [*map(_attempt, each)]
    else:
        from concurrent.futures import ThreadPoolExecutor
        from threading import local

        from ..session import WorkerProcess

        own, workers = local(), ExitStack()

        def begin() -> None:
            own.worker = workers.enter_context(closing(WorkerProcess(idle=False)))

        with ThreadPoolExecutor(min(args.jobs, len(each)), initializer=begin) as pool, workers:
            outcomes = list(pool.map(lambda one: own.worker.call(_attempt, one), each))
    results = [result for _, result in outcomes]
    write_json(args.json, results)
    output = console(args)
    for result in results:
        if 'error' in result:
            output.print(f'{result["file"]}: {result["error"]}; {result["advice"]}')
    for line in _function('several', args.command)(
            [result for result in results if 'error' not in result]):
        output.print(line)
    return max(status for status, _ in outcomes)


def _function(kind: str, command: str) -> Callable[[Any], Any]:
    module = import_module(f'.{COMMANDS[command].module}', __package__)
    return getattr(module, f'{kind}_{command}')


def _carry_out(args: argparse.Namespace) -> Done:
    """Run the command for one input, with the own effects of the user, and draw its page."""
    also = getattr(args, 'also', None)
    page = next((target.path for target in _outputs(args) if target.kind == 'page'), None)
    try:
        args.own = () if also is None else effects_of_file(also)
        done: Done = _function('run', args.command)(args)
        if page is not None and done.page is not None:
            from ..report import check_matplotlib, write_page

            try:
                check_matplotlib()
                with progress('drawing the page'):
                    write_page(page, done.page())
                done = replace(done, stored=[*done.stored, page])
            except (InputError, OSError) as err:  # beside a calibration, this is only noted
                if not (args.command in _WITH_PAGE or done.stored):
                    raise
                done = replace(done, shown=[*done.shown, f'no page {page}: {known_error(err)}'])
    except (AccelCalibError, OSError) as err:
        known, about = known_error(err), COMMANDS[args.command].about
        return Done({**({'file': getattr(args, about)} if about else {}),
                     'error': known.message, 'advice': known.advice,
                     **({'read_as': known.read_as} if known.read_as else {})}, error=err)
    if done.rating is not None:
        step = done.rating.next
        judged = rating_json(done.rating, step, next_command(step, args))
        done = replace(done, result={**done.result, **judged},
                       status=FAILED if done.rating.name == 'BAD' else done.status)
    return done


def _run_one(args: argparse.Namespace) -> int:
    """Run the command, and print the rating, then its findings and the notes, then the rest."""
    output, target, done = console(args), getattr(args, 'json', None), _carry_out(args)
    write_json(target, done.result)
    if done.error is not None:
        if 'read_as' in done.result and target != STANDARD_OUTPUT:
            output.print(f'read as: {done.result["read_as"]}')
        raise done.error
    rating, verbose, lines = done.rating, getattr(args, 'verbose', True), list[Any]()
    if rating is not None:
        command = done.result['next']['command']
        first, *others = rating.lines
        lines = [Verdict(first, rating.name), *others, *([f'      {command}'] if command else [])]
    findings = () if rating is None else rating.findings[rating.name != 'GOOD':]
    notes = [*(f'note: {each.words if verbose else each.text}' for each in findings), *done.notes]
    if not verbose and len(notes) > _MOST_NOTES:
        more = len(notes) - _MOST_NOTES + 1
        notes[_MOST_NOTES - 1:] = [f'{more} more lines with --verbose']
    for each in (*lines, *notes, *done.shown,
                 *(f'stored in {path}' for path in done.stored if path != _PIPED)):
        output.print(each)
    if done.refusal:
        raise RefusedFitError(f'{args.output} is not written: {done.refusal[0]}', done.refusal[1])
    return done.status


def _attempt(args: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Return exit status and JSON for one of several inputs; an error is a result, too."""
    done = _carry_out(args)
    if done.error is not None:
        return BAD_INPUT, {'file': str(args.poses), **plain(done.result)}
    refused = dict(zip(('error', 'advice'), done.refusal))
    return BAD_INPUT if refused else done.status, {**plain(done.result), **refused}


def write_json(target: str | None, result: object) -> None:
    """Write a result as JSON to a file, or to standard output for ``-``; None: do nothing."""
    if target is not None:
        text = json.dumps(plain(result), indent=2, allow_nan=False)
        write_atomically(Path(target), lambda file: file.write(f'{text}\n'))


def console(args: argparse.Namespace) -> 'Output':
    """Return the console for text output: standard error if a result goes to standard output."""
    return Output(stderr=any(target.path == _PIPED for target in _outputs(args)))


# ----------------------------------------------------------------------------- files to write

def _outputs(args: argparse.Namespace) -> list[Target]:
    """Return the outputs that are asked for, and the page beside a calibration."""
    kinds = {'output': COMMANDS[args.command].writes, **_OUTPUTS}
    given = {name: getattr(args, name, None) for name in kinds}
    found = [Target(name, Path(path), kinds[name], '-o' if name == 'output' else f'--{name}')
             for name, path in given.items() if path is not None]
    if args.command in _WITH_PAGE and found[0].path != _PIPED:
        page = Target('page', args.output.parent / f'{args.output.stem}.html', 'page',
                      'the page of -o')
        found.insert(1, page)
    return found


def _check_targets(args: argparse.Namespace, outputs: Sequence[Target],
                   each: Sequence[argparse.Namespace]) -> None:
    """Check that one result at most goes to standard output, and each file that is written."""
    piped = [target.option for target in outputs if target.path == _PIPED]
    if len(piped) > 1:
        raise InputError(f'{" and ".join(piped)} are both -, expected one of them on standard '
                         'output', 'give one of them the name of a file')
    if piped and piped != ['--json'] and (len(each) > 1 or not COMMANDS[args.command].writes):
        raise InputError(f'{piped[0]} is -, expected a folder here',
                         'use a folder; results of several files do not fit into one')
    read = [value for name, value in vars(args).items() if name not in ('output', *_OUTPUTS)]
    inputs = [path for value in read for path in (value if isinstance(value, list) else [value])
              if isinstance(path, Path)]
    inputs += [Path(text.removeprefix('@')) for text in getattr(args, 'recordings', ())]
    seen: dict[Path, str] = {}
    for target in outputs:
        files = [] if target.path == _PIPED else [target]
        if files and len(each) > 1 and target.kind in _SUFFIXES:
            if not target.path.is_dir():
                raise InputError(f'{target.option} {target.path} is not a folder, expected a '
                                 f'folder for {counted(len(each), "table")}',
                                 'use an existing folder')
            files = [target._replace(path=getattr(one, target.name),
                                     option=f'{target.option} for {one.poses}') for one in each]
        for file in files:
            if file.kind or file.path.exists():
                check_target(file, inputs, force=args.force)
            whole = Path(os.path.realpath(file.path))
            if whole in seen:
                raise InputError(f'{seen[whole]} and {file.option} both name {file.path}, '
                                 'expected different files', 'choose another name')
            seen[whole] = file.option


def check_target(target: Target, inputs: Iterable[Path], *, force: bool) -> None:
    """
    Check a file that is to be written; with `force` it may replace one of another kind.

    InputError is raised if its folder is missing, or it is one of the files that are read, cannot
    be replaced, or holds something else.

    """
    option, path = target.option, target.path
    if not path.parent.is_dir():
        raise InputError(f'{option} {path}: {path.parent} is not a folder, expected a folder',
                         'choose a file in an existing folder')
    whole = os.path.realpath(path)
    if any(whole == os.path.realpath(each) for each in inputs):
        raise InputError(f'{option} {path} is an input, expected another file',
                         'choose another name')
    if target.kind:
        replaceable(Path(whole))
    if force or not target.kind or not path.is_file():
        return
    with path.open('rb') as file:
        head = file.read(4096)
    # Text in an array of NumPy has three zero bytes beside each letter.
    if head.strip() and not re.match(_KINDS[target.kind], head.replace(b'\0', b'')):
        raise InputError(f'{option} {path} exists and is no {target.kind} of accel_calib, '
                         'expected a new file', 'choose another name, or replace it with --force')


# ----------------------------------------------------------------------------- inputs

def given(record: Any, args: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of a record that have an option; None stands for the default."""
    found = {each.name: getattr(args, each.name, None) for each in fields(record)}
    return {name: value for name, value in found.items() if value is not None}


def log_options(args: argparse.Namespace, calibration: Calibration | None = None) -> LogOptions:
    """Return how to read a log; in the unit of a calibration if the log states none."""
    columns = {ours: theirs for each in args.columns for ours, theirs in each.items()}
    return options_for(calibration, LogOptions(**{
        **given(LogOptions, args), 'columns': columns, 'context': named_topics(args.context)}))


def fleet_prior(args: argparse.Namespace) -> FleetPrior | None:
    """Return the typical values of ``--prior``, if they are given."""
    if args.sensor_model and not args.prior:
        raise InputError('--sensor-model is given without --prior, expected both',
                         'add --prior, or leave out --sensor-model')
    return args.prior and read_prior(args.prior, args.sensor_model)


@contextmanager
def intake(args: argparse.Namespace, path: Path, calibration: Calibration | None = None
           ) -> Iterator[Intake]:
    """Yield the poses of a log, captured from a recording; later errors say how it was read."""
    with progress('samples') as moved:
        found = poses_of(path, log_options(args, calibration), given(CaptureSettings, args), moved)
    with saying(found.said):
        yield found


def read_lines(log: OpenLog) -> list[str]:
    """Return how a log was read."""
    said = [f'read as: {log.read_as}'] if log.read_as else []
    return said + [f'note: {line}' for line in log.notes]


def stored_calibration(path: Path, own: tuple[OwnEffect, ...]) -> Calibration:
    """Read a stored calibration or standard input; report if it was edited by hand."""
    piped = str(path) == STANDARD_INPUT
    calibration = (calibration_from(sys.stdin.buffer.read(), 'standard input', own) if piped else
                   read_calibration(path, own))
    for found in calibration.noted:
        if found.kind in OF_FILE:
            Output(stderr=True).print(f'note: {path}: {found.words}')
    return calibration


def rows_between(poses: Poses, text: str | None) -> slice:
    """Return the rows ``A:B`` of a table, 1-based, inclusive; A and B are optional."""
    first, colon, last = (text or ':').partition(':')
    try:
        start, stop = int(first or 1), int((last if colon else first) or len(poses))
    except ValueError:
        start, stop = 0, 0
    if not 1 <= start <= stop <= len(poses):
        raise InputError(f'--rows is {text}, expected A:B within 1:{len(poses)}',
                         'set A and B to the first and the last row, 1-based')
    return slice(start - 1, stop)


# ----------------------------------------------------------------------------- text

_NO_BREAK = '\N{NO-BREAK SPACE}'

_COLOURS = {'GOOD': 'bold green', 'USABLE': 'bold yellow', 'BAD': 'bold red'}

_TIED = r'(?<=±) | (?=±)|(?<==) | (?==)|(?<=\d) (?=(mg|g|s|h|Hz|%|°|°C|m/s²|poses?)\b)'
"""Spaces at which a line does not break: ``value ± sd``, ``p = 0.1``, ``3 mg``."""


class Verdict(NamedTuple):
    """A line of text with a rating from a character on, which a terminal shows in colour."""

    line: str
    rating: str
    start: int = 0


class Output(Console):
    """A console that breaks lines at words, and takes text as it is, without markup."""

    def __init__(self, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, highlight=False, markup=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return text with the replacements, so that tables have the right width."""
        return super().render_str(shown(text, self.encoding), **options)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: A003
        """Print; lines of text break at words, and the rest of a line is indented."""
        if len(objects) != 1 or not isinstance(given := objects[0], str | Verdict):
            super().print(*objects, **options)
            return
        line, rating, start = given if isinstance(given, Verdict) else (given, '', 0)
        text = self._break_lines(line)
        if rating:
            end = len(self._break_lines(line[:start + len(rating)]))
            text.stylize(_COLOURS[rating], end - len(rating), end)
        super().print(text, soft_wrap=True, **options)

    def _break_lines(self, text: str) -> Text:
        lines = []
        for line in text.split('\n'):
            parts = wrap(re.sub(_TIED, _NO_BREAK, line), self.width, subsequent_indent='  ',
                         break_long_words=False, break_on_hyphens=False)
            lines.append('\n'.join(parts).replace(_NO_BREAK, ' ') or line)
        return self.render_str('\n'.join(lines))


def shown(text: str, encoding: str) -> str:
    """Return text in the characters of an encoding, without control characters."""
    safe = ''.join(each if each.isprintable() or each == '\n' else plain_character(each)
                   for each in text)
    return safe.encode(encoding, plain_handler()).decode(encoding)


NARROW: Any = {'box': box.SIMPLE_HEAD, 'padding': (0, 1, 0, 0), 'pad_edge': False}
"""Style of a table whose cells are long."""


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], **style: Any
          ) -> Table:
    """Return a table whose first column holds names, and the others numbers."""
    made = Table(title=title, **style)
    made.add_column(columns[0], overflow='fold')
    for name in columns[1:]:
        made.add_column(name, justify='right')
    for row in rows:
        made.add_row(*row)
    return made


def short_if_known(value: float | None) -> str:
    """Return a number in three digits, or that it is not known."""
    return 'not known' if value is None else short(value)


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """Show a progress bar for things or an activity; yield the function that updates it."""
    if not sys.stderr.isatty():
        yield lambda done, count: None
        return
    from rich.progress import BarColumn, Progress as Bar, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), TextColumn('{task.description}'), TimeRemainingColumn())
    with Bar(*columns, console=Output(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)  # the bar moves to and fro until a number is known
        yield lambda done, count: bar.update(task, completed=done, total=count,
                                             description=f'{done:,} of {count:,} {what}')
