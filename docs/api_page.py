# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Make the API reference from the docstrings of the public functions and records."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import cached_property
import inspect
import re
from typing import Any

import accel_calib as ac
from accel_calib.calibration import GyroBias, Quality, Rejected, SampleNoise, Verification
from accel_calib.comparison import Comparison, Parameter
from accel_calib.comparison.comparison import Run
import accel_calib.errors as errors
from accel_calib.refinement import PlannedPose, PosePlan, Stage, Step
from accel_calib.stillness import CaptureSettings
from accel_calib.units import Units

FUNCTIONS = ('calibrate', 'capture', 'read_poses', 'read_recording', 'fit', 'refine', 'verify',
             'compare', 'simulate', 'load')
RECORDS = ('Poses', 'Recording', 'Calibration', 'Refinement', 'Effect')
"""The names of ``accel_calib.__all__``, in the order of the page."""

OTHER_RECORDS = (Quality, Rejected, Units, GyroBias, SampleNoise, Verification, Step, Stage,
                 PosePlan, PlannedPose,
                 Comparison, Run, Parameter, CaptureSettings)
ERRORS = (errors.AccelCalibError, errors.InputError, errors.RefusedFitError,
          errors.StoredCalibrationError, errors.DamagedCalibrationError)

_OPENING = """\
# API reference

<!-- Made by `python docs/tables.py` from the docstrings; do not edit. -->

The functions are those of `import accel_calib as ac`. A path is a `str` or a `Path`. Poses are
`Poses`, the path of a [pose table](files.md#pose-table), a DataFrame with the columns of
[any log](logs.md), or an (n, 3) array of readings. Recordings are captured.

## Functions"""

_RECORDS = """
## Records

Records are frozen: no function changes them. Two are equal if all their values are. `Poses` and
`Recording` are tables: they support `len(poses)`, `'temperature' in poses` and
`poses['temperature']`. The first column of [this table](files.md#pose-table) lists the names."""

_OTHERS = """
## Records in results and settings

Functions return these records, or the records above contain them."""

_ERRORS = """
## Errors

The errors are in `accel_calib.errors`. Each has `message` (what was found and what was expected)
and `advice` (what to do).
"""

_FIELDS = ('Parameters', 'Attributes')
_TITLE = re.compile(r'^(\w+)\n-{3,}$', re.MULTILINE)


def page() -> str:
    """Return the page."""
    return '\n'.join(_lines()) + '\n'


def _lines() -> Iterator[str]:
    yield _OPENING
    for name in FUNCTIONS:
        yield from _function(f'ac.{name}', getattr(ac, name), '###')
    yield _RECORDS
    for name in RECORDS:
        yield from _record(f'ac.{name}', getattr(ac, name))
    yield _OTHERS
    for record in OTHER_RECORDS:
        yield from _record(record.__name__, record)
    yield _ERRORS
    for error in ERRORS:
        yield f'- `{error.__name__}({error.__bases__[0].__name__})`: {_summary(error)}'


def _function(name: str, function: Callable[..., Any], level: str) -> Iterator[str]:
    """Yield the section of a function."""
    yield from ('', f'{level} {name}', '', '```python', *_call(name, function), '```')
    summary, sections = parsed(function)
    yield from ('', summary)
    for title, entries in sections.items():
        yield from ('', f'**{title}**', '', *(_item(*entry) for entry in entries))


def _record(name: str, record: type) -> Iterator[str]:
    """Yield the section of a record: what it is, its attributes and its methods."""
    summary = parsed(record)[0]
    yield from ('', f'### {name}', '', summary)
    attributes = list(_attributes(record))
    if attributes:
        yield from ('', '**Attributes**', '', *(_item(*entry) for entry in attributes))
    for method, function in _methods(record):
        yield from _function(f'{name.removeprefix("ac.")}.{method}', function, '####')


def _attributes(record: type) -> Iterator[tuple[str, str]]:
    """Yield heads and descriptions: of the docstrings, other fields, then properties."""
    listed: set[str] = set()
    for base in _bases(record):
        sections = parsed(base)[1]
        for head, text in (entry for title in _FIELDS for entry in sections.get(title, ())):
            names = names_in(head)
            if not listed.issuperset(names):
                listed |= set(names)
                yield head, text
    others = fields(record) if is_dataclass(record) else ()
    yield from ((each.name, '') for each in others if each.name not in listed)
    for base in _bases(record):
        for name, member in vars(base).items():
            known = isinstance(member, property | cached_property)
            if known and not name.startswith('_') and name not in listed:
                listed.add(name)
                yield name, _capital(_summary(member).removeprefix('Return '))


def _methods(record: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield the public methods, those of the record itself first."""
    seen = set()
    for base in _bases(record):
        for name, member in vars(base).items():
            if inspect.isfunction(member) and not name.startswith('_') and name not in seen:
                seen.add(name)
                yield name, member


def _bases(record: type) -> list[type]:
    return [base for base in record.__mro__ if base.__module__.startswith('accel_calib')]


def _call(name: str, function: Callable[..., Any]) -> Iterator[str]:
    """Yield the signature without types, in lines of at most 99 columns."""
    given = inspect.signature(function)
    parameters = [each.replace(annotation=inspect.Parameter.empty)
                  for each in given.parameters.values() if each.name != 'self']
    call = str(given.replace(parameters=parameters, return_annotation=inspect.Signature.empty))
    line = name
    for k, part in enumerate(re.split(r'(?<=, )(?=[\w*])', call)):
        if k and len(line) + len(part.rstrip()) > 99:
            yield line.rstrip()
            line = ' ' * (len(name) + 1)
        line += part
    yield line


def parsed(documented: Any) -> tuple[str, dict[str, list[tuple[str, str]]]]:
    """Return the text before the sections of a numpydoc docstring, and the sections."""
    text = inspect.getdoc(documented) or ''
    before, *rest = _TITLE.split(text)
    sections = {title: list(_entries(body)) for title, body in zip(rest[::2], rest[1::2])}
    return _plain(before), sections


def _entries(body: str) -> Iterator[tuple[str, str]]:
    """Yield head and description of each entry of a section."""
    head, text = '', []
    for line in filter(str.strip, body.splitlines()):
        if line.startswith(' '):
            text.append(line.strip())
            continue
        if head:
            yield head, _plain(' '.join(text))
        head, text = line.strip(), []
    if head:
        yield head, _plain(' '.join(text))


def _item(head: str, text: str) -> str:
    """Return an entry as an item of a list."""
    kind = head.partition(' : ')[2]
    names = ', '.join(f'`{name}`' for name in names_in(head))
    about = f' ({_plain(kind)})' if kind else ''
    return f'- {names}{about}: {text}' if text else f'- {names}{about}'


def names_in(head: str) -> list[str]:
    """Return the names in the head of an entry, such as ``topic, sensor : str``."""
    names = head.partition(' : ')[0]
    return [names] if '(' in names else [name.strip() for name in names.split(',')]


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _summary(documented: Any) -> str:
    """Return the text of a docstring before its sections, in one line."""
    return ' '.join(parsed(documented)[0].split())


def _plain(text: str) -> str:
    """Return reStructuredText as Markdown: paragraphs in one line each, code in backticks."""
    paragraphs = (' '.join(part.split()) for part in text.split('\n\n'))
    return re.sub(r'``(.+?)``', r'`\1`', '\n\n'.join(filter(None, paragraphs)))
