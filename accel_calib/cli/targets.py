# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Checks of all files that a command is to write, before any work.

The folder of each file must exist, no file is written onto an input or onto another output, and an
existing file is replaced only by one of its own kind, unless ``--force`` is set.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
import re

from ..errors import InputError
from ..text import counted

_INPUTS = ('poses', 'recording', 'log', 'calibration', 'calibrations', 'noise')
_OUTPUTS = {'json': 'result', 'report': 'page', 'plan': 'table', 'figures': ''}
_OWN_OUTPUT = {'fit': 'calibration', 'refine': 'calibration', 'calibrate': 'calibration',
               'capture': 'table', 'simulate': 'table', 'report': 'page', 'export': 'export',
               'apply': 'table', 'live': 'calibration'}
"""Kind of the file that ``-o`` writes, by command."""

_SUFFIXES = {'calibration': '.yaml', 'page': '.html', 'table': '.csv'}
_KINDS = {'calibration': rb'format: accel_calib', 'page': rb'<!DOCTYPE html',
          'result': rb'\s*[{\[]', 'table': rb'(#[^\n]*\n)*[^\n]*\bax\b[^\n]*',
          'export': rb'(?s)PK|\{|.*accel[-_]calib'}
"""Beginning of a file of each kind."""

_HEAD = 4096
_STANDARD_OUTPUT = '-'


@dataclass(frozen=True)
class Target:
    """A file to write: the option that names it, and its kind, empty for any."""

    option: str
    path: Path
    kind: str


def add_force(made: argparse.ArgumentParser) -> None:
    """Add ``--force`` to a command that writes files."""
    known = {action.dest for action in made._actions}
    if known & {'output', *_OUTPUTS}:
        made.add_argument('--force', action='store_true',
                          help='replace files of other kinds, too')


def check(args: argparse.Namespace) -> None:
    """
    Check the files that a command is to write.

    Raises
    ------
    InputError
        If a folder is missing, a file is an input or is named twice, or holds something else.

    """
    inputs = [each for name in _INPUTS for each in _paths(getattr(args, name, None))]
    targets = [each for each in _targets(args) if each.kind or each.path.exists()]
    seen: dict[Path, str] = {}
    for each in targets:
        check_one(each, inputs, force=args.force)
        whole = each.path.resolve()
        if whole in seen:
            raise InputError(f'{seen[whole]} and {each.option} both name {each.path}, expected '
                             'different files', 'choose another name')
        seen[whole] = each.option


def check_one(target: Target, inputs: Iterable[Path], *, force: bool) -> None:
    """Check one file; parameters and errors as in `check`."""
    option, path = target.option, target.path
    if not path.parent.is_dir():
        raise InputError(f'{option} {path}: {path.parent} is not a folder, expected a folder',
                         'choose a file in an existing folder')
    if any(path.resolve() == each.resolve() for each in inputs):
        raise InputError(f'{option} {path} is an input, expected another file',
                         'choose another name')
    if force or not target.kind or not path.is_file():
        return
    head = _head(path)
    if head.strip() and not re.match(_KINDS[target.kind], head):
        raise InputError(f'{option} {path} exists and is no {target.kind} of accel_calib, '
                         'expected a new file', 'choose another name, or replace it with --force')


def _head(path: Path) -> bytes:
    with path.open('rb') as file:
        return file.read(_HEAD)


def _paths(value: object) -> list[Path]:
    """Return the paths of an argument."""
    values = value if isinstance(value, list) else [value]
    return [each for each in values if isinstance(each, Path)]


def _targets(args: argparse.Namespace) -> Iterator[Target]:
    """Yield the files that a command is to write."""
    count = len(_paths(getattr(args, 'poses', None)))
    for name, kind in {'output': _OWN_OUTPUT.get(args.command, ''), **_OUTPUTS}.items():
        given = getattr(args, name, None)
        if given is None or str(given) == _STANDARD_OUTPUT:
            continue
        option, path = '-o' if name == 'output' else f'--{name}', Path(given)
        if count > 1 and kind in _SUFFIXES:
            yield from _in_folder(args, Target(option, path, kind))
        else:
            yield Target(option, path, '' if path.is_dir() else kind)
        if args.command == 'calibrate' and name == 'output':
            yield Target('the page of -o', path.with_suffix('.html'), 'page')


def _in_folder(args: argparse.Namespace, folder: Target) -> Iterator[Target]:
    """Yield one file for each of several inputs."""
    if not folder.path.is_dir():
        raise InputError(f'{folder.option} {folder.path} is not a folder, expected a folder for '
                         f'{counted(len(args.poses), "table")}', 'use an existing folder')
    for each in args.poses:
        yield Target(f'{folder.option} for {each}',
                     folder.path / f'{each.stem}{_SUFFIXES[folder.kind]}', folder.kind)
