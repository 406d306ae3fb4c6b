# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The frame that runs every command: for one input or several, with JSON, lines and exit status.

The command NAME is the function ``run_NAME`` of its module, from the arguments for one input to
what is `Done`. If it takes several POSES, it runs once for each of them, and ``several_NAME``
yields what is printed for all their results.

All files that a command is to write are checked before any work. The folder of each file must
exist, no file is written onto an input or onto another output, and an existing file is replaced
only by one of its own kind, unless ``--force`` is set.

Lines of text break at words, at the width of the terminal or of ``COLUMNS``. A word that is
longer, such as the name of a file, stays whole. Progress is shown on standard error if it is a
terminal.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
import json
import os
from pathlib import Path
import re
import sys
from textwrap import wrap
from typing import Any, NamedTuple, TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from .commands import COMMANDS, next_command
from .options import BAD_INPUT
from .terminal import plain_character
from ..disk import replaceable, STANDARD_OUTPUT, write_atomically
from ..errors import AccelCalibError, InputError, RefusedFitError, system_error
from ..text import counted, plain

if TYPE_CHECKING:
    from ..findings import Rating
    from ..logs import Progress

_INPUTS = ('poses', 'recording', 'log', 'calibration', 'calibrations', 'noise')
_OUTPUTS = {'json': 'result', 'report': 'page', 'plan': 'table', 'figures': ''}
"""Kind of the file that each option writes, besides ``-o``."""

_SUFFIXES = {'calibration': '.yaml', 'page': '.html', 'table': '.csv'}
_KINDS = {'calibration': rb'format: accel_calib', 'page': rb'<!DOCTYPE html',
          'result': rb'\s*[{\[]', 'table': rb'(#[^\n]*\n)*[^\n]*\bax\b[^\n]*',
          'export': rb'(?s)PK|\{|.*accel[-_]calib'}
"""Beginning of a file of each kind."""

_HEAD = 4096
_NO_BREAK = '\N{NO-BREAK SPACE}'
_MARK = '\ue000'
"""Stands for a letter of the rating while a line is broken."""

_COLOURS = {'GOOD': 'bold green', 'USABLE': 'bold yellow', 'BAD': 'bold red'}

_TIED = r'(?<=±) | (?=±)|(?<==) | (?==)|(?<=\d) (?=(mg|g|s|h|Hz|%|°|°C|m/s²|poses?)\b)'
"""Spaces at which a line does not break: ``value ± sd``, ``p = 0.1``, ``3 mg``."""


@dataclass(frozen=True)
class Done:
    """
    What a command has done for one input.

    Parameters
    ----------
    result : mapping
        The result for JSON.
    shown : iterable
        Texts and tables for the terminal; they are made when they are printed.
    status : int
        Exit status.
    refusal : tuple of str
        Why the file of ``-o`` is not written, and what to do; empty if it is written.

    """

    result: Mapping[str, Any] = field(default_factory=dict)
    shown: Iterable[Any] = ()
    status: int = 0
    refusal: tuple[str, ...] = ()


class Target(NamedTuple):
    """A file to write: the option that names it, and its kind, empty for any."""

    option: str
    path: Path
    kind: str


def run(args: argparse.Namespace) -> int:
    """
    Run a command.

    Parameters
    ----------
    args : Namespace
        The arguments, and the name of the command.

    Returns
    -------
    int
        Exit status.

    Raises
    ------
    AccelCalibError
        If the input is not valid; ``--json`` then has the error, too.
    OSError
        If a file cannot be read or written.

    """
    _check_targets(args)
    if getattr(args, 'report', None) or COMMANDS[args.command].writes == 'page':
        from ..report import check_matplotlib

        check_matplotlib()
    each = _for_each(args)
    return _run_one(each[0]) if len(each) == 1 else _run_several(args, each)


def _function(kind: str, command: str) -> Callable[[Any], Any]:
    module = import_module(f'.{COMMANDS[command].module}', __package__)
    function: Callable[[Any], Any] = getattr(module, f'{kind}_{command}')
    return function


def _run_one(args: argparse.Namespace) -> int:
    target, command = getattr(args, 'json', None), COMMANDS[args.command]
    try:
        done = _done(args)
    except (AccelCalibError, OSError) as err:
        about = {'file': getattr(args, command.about)} if command.about else {}
        error = _of_error(err)
        write_json(target, {**about, **error})
        if 'read_as' in error and target != STANDARD_OUTPUT:
            console(args).print(f'read as: {error["read_as"]}')
        raise
    write_json(target, done.result)
    output = console(args)
    for each in done.shown:
        output.print(each)
    if done.refusal:
        raise RefusedFitError(f'{args.output} is not written: {done.refusal[0]}', done.refusal[1])
    return done.status


def _run_several(args: argparse.Namespace, each: Sequence[argparse.Namespace]) -> int:
    outcomes = _in_parallel(_attempt, each, args.jobs)
    results = [result for _, result in outcomes]
    write_json(args.json, results)
    output = console(args)
    for line in _function('several', args.command)(results):
        output.print(line)
    return max(status for status, _ in outcomes)


def _done(args: argparse.Namespace) -> Done:
    """Run the command for one input, with the own effects of the user, ``args.own``."""
    from ..effects import know_file

    path = getattr(args, 'also', None)
    args.own = () if path is None else know_file(path)
    done: Done = _function('run', args.command)(args)
    return done


def _attempt(args: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Return exit status and JSON for one of several inputs; an error is a result, too."""
    try:
        done = _done(args)
    except (AccelCalibError, OSError) as err:
        return BAD_INPUT, {'file': str(args.poses), **_of_error(err)}
    refused = dict(zip(('error', 'advice'), done.refusal))
    return BAD_INPUT if refused else done.status, {**plain(done.result), **refused}


def rated(rating: Rating, args: argparse.Namespace) -> dict[str, Any]:
    """Return a rating for JSON."""
    from ..findings import rating_json

    step = rating.next
    return rating_json(rating, step.kind, step.text, next_command(step, args))


class Verdict(str):
    """A line of text with a rating from a character on, which a terminal shows in colour."""

    rating: str
    start: int

    def __new__(cls, line: str, rating: str, start: int = 0) -> Verdict:
        """Return the line with these attributes."""
        made = super().__new__(cls, line)
        made.rating, made.start = rating, start
        return made


def rating_lines(rating: Rating, args: argparse.Namespace) -> list[str]:
    """Return a rating as lines of text, the last one the next command if there is one."""
    command = next_command(rating.next, args)
    first, *others = rating.lines
    return [Verdict(first, rating.name), *others, *([f'      {command}'] if command else [])]


def _of_error(error: AccelCalibError | OSError) -> dict[str, str]:
    known = system_error(error) if isinstance(error, OSError) else error
    read_as = {'read_as': known.read_as} if known.read_as else {}
    return {'error': known.message, 'advice': known.advice, **read_as}


def _in_parallel(function: Any, items: Sequence[Any], jobs: int) -> list[Any]:
    """Return the results of a function for each item, in order; `jobs` processes are used."""
    if jobs <= 1:
        return [function(item) for item in items]
    from concurrent.futures import ThreadPoolExecutor
    from queue import SimpleQueue

    from ..session import WorkerProcess

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


def write_json(target: str | None, result: object) -> None:
    """Write a result as JSON to a file, or to standard output for ``-``; None: do nothing."""
    if target is not None:
        text = json.dumps(plain(result), indent=2, allow_nan=False)
        write_atomically(Path(target), lambda file: file.write(f'{text}\n'))


def _for_each(args: argparse.Namespace) -> list[argparse.Namespace]:
    """Return the arguments for each of one or several POSES; of several, outputs are folders."""
    sources = getattr(args, 'poses', None)
    if not isinstance(sources, list):
        return [args]
    folders = [(name, target) for name, target in _outputs(args)
               if len(sources) > 1 and target.kind in _SUFFIXES]
    return [argparse.Namespace(**{**vars(args), 'poses': source, **{
        name: _in_folder(target, Path(source)).path for name, target in folders}})
        for source in sources]


def _outputs(args: argparse.Namespace) -> Iterator[tuple[str, Target]]:
    """Yield the argument and the file of each output that is asked for."""
    for name, kind in {'output': COMMANDS[args.command].writes, **_OUTPUTS}.items():
        given = getattr(args, name, None)
        if given is not None and str(given) != STANDARD_OUTPUT:
            yield name, Target('-o' if name == 'output' else f'--{name}', Path(given), kind)


def _in_folder(folder: Target, source: Path) -> Target:
    """Return the file in a folder for one of several inputs."""
    return Target(f'{folder.option} for {source}',
                  folder.path / f'{source.stem}{_SUFFIXES[folder.kind]}', folder.kind)


def _targets(args: argparse.Namespace) -> Iterator[Target]:
    """Yield the files that a command is to write."""
    sources = _paths(getattr(args, 'poses', None))
    for name, target in _outputs(args):
        if len(sources) < 2 or target.kind not in _SUFFIXES:
            yield target._replace(kind='' if target.path.is_dir() else target.kind)
        elif target.path.is_dir():
            yield from (_in_folder(target, source) for source in sources)
        else:
            raise InputError(f'{target.option} {target.path} is not a folder, expected a folder '
                             f'for {counted(len(sources), "table")}', 'use an existing folder')
        if args.command == 'calibrate' and name == 'output':
            yield Target('the page of -o', target.path.with_suffix('.html'), 'page')


def _check_piped(args: argparse.Namespace) -> None:
    """Check that at most one result goes to standard output."""
    piped = _piped(args)
    if len(piped) > 1:
        raise InputError(f'{" and ".join(piped)} are both -, expected one of them on standard '
                         'output', 'give one of them the name of a file')
    several = isinstance(getattr(args, 'poses', None), list) and len(args.poses) > 1
    if piped and piped != ['--json'] and (several or not COMMANDS[args.command].writes):
        raise InputError(f'{piped[0]} is -, expected a folder here',
                         'use a folder; results of several files do not fit into one')


def _check_targets(args: argparse.Namespace) -> None:
    _check_piped(args)
    inputs = [path for name in _INPUTS for path in _paths(getattr(args, name, None))]
    seen: dict[Path, str] = {}
    for target in _targets(args):
        if not target.kind and not target.path.exists():
            continue
        check_target(target, inputs, force=args.force)
        whole = Path(os.path.realpath(target.path))
        if whole in seen:
            raise InputError(f'{seen[whole]} and {target.option} both name {target.path}, '
                             'expected different files', 'choose another name')
        seen[whole] = target.option


def check_target(target: Target, inputs: Iterable[Path], *, force: bool) -> None:
    """
    Check a file that is to be written.

    Parameters
    ----------
    target : Target
        The file.
    inputs : iterable of Path
        Files that are read.
    force : bool
        Whether a file of another kind may be replaced.

    Raises
    ------
    InputError
        If its folder is missing, or it is an input, cannot be replaced or holds something else.

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
        head = file.read(_HEAD)
    if head.strip() and not re.match(_KINDS[target.kind], head):
        raise InputError(f'{option} {path} exists and is no {target.kind} of accel_calib, '
                         'expected a new file', 'choose another name, or replace it with --force')


def _paths(value: object) -> list[Path]:
    values = value if isinstance(value, list) else [value]
    return [each for each in values if isinstance(each, Path)]


class Output(Console):
    """A console that breaks lines at words, and takes text as it is, without markup."""

    def __init__(self, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, highlight=False, markup=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return text with the replacements, so that tables have the right width."""
        return super().render_str(shown(text, self.encoding), **options)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: A003
        """Print; lines of text break at words, and the rest of a line is indented."""
        if len(objects) == 1 and isinstance(objects[0], str):
            super().print(self._line(objects[0]), soft_wrap=True, **options)
        else:
            super().print(*objects, **options)

    def _line(self, line: str) -> Text:
        if not isinstance(line, Verdict):
            return self.render_str('\n'.join(map(self._broken, line.split('\n'))))
        end, mark = line.start + len(line.rating), _MARK * len(line.rating)
        before, _, after = self._broken(f'{line[:line.start]}{mark}{line[end:]}').partition(mark)
        return Text.assemble(self.render_str(before), (line.rating, _COLOURS[line.rating]),
                             self.render_str(after))

    def _broken(self, line: str) -> str:
        tied = re.sub(_TIED, _NO_BREAK, line)
        parts = wrap(tied, self.width, subsequent_indent='  ', break_long_words=False,
                     break_on_hyphens=False)
        return '\n'.join(parts).replace(_NO_BREAK, ' ') or line


def shown(text: str, encoding: str) -> str:
    """Return text in the characters of an encoding, without control characters."""
    safe = ''.join(each if each.isprintable() or each == '\n' else plain_character(each)
                   for each in text)
    try:
        safe.encode(encoding)
    except UnicodeEncodeError:
        return ''.join(each if _has(encoding, each) else plain_character(each) for each in safe)
    return safe


def _has(encoding: str, character: str) -> bool:
    try:
        character.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table whose first column holds names, and the others numbers."""
    made = Table(title=title)
    made.add_column(columns[0], overflow='fold')
    for name in columns[1:]:
        made.add_column(name, justify='right')
    for row in rows:
        made.add_row(*row)
    return made


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """Show a progress bar, and yield the function that updates it."""
    if not sys.stderr.isatty():
        yield lambda done, count: None
        return
    from rich.progress import BarColumn, Progress as Bar, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), TextColumn('{task.description}'), TimeRemainingColumn())
    with Bar(*columns, console=Output(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)  # the bar moves to and fro until a number is known
        yield lambda done, count: bar.update(task, completed=done, total=count,
                                             description=f'{done:,} of {count:,} {what}')


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show that work of unknown length goes on."""
    if not sys.stderr.isatty():
        yield
        return
    with Output(stderr=True).status(what):
        yield


def console(args: argparse.Namespace) -> Output:
    """Return the console for text output: standard error if a result goes to standard output."""
    return Output(stderr=bool(_piped(args)))


def _piped(args: argparse.Namespace) -> list[str]:
    """Return the options whose result goes to standard output."""
    named = {'-o': 'output', **{f'--{name}': name for name in _OUTPUTS}}
    return [option for option, name in named.items()
            if str(getattr(args, name, None)) == STANDARD_OUTPUT]
