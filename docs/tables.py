# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Make the tables of the documentation, and the parameters of the calibrator, from the code.

A line of a page that begins with ``<!-- NAME -->`` stands for the table ``NAME``: the site has the
table in its place (`conf.py`), and ``python docs/tables.py NAME`` prints it. Measured tables stand
in their page, between such a line and ``<!-- end -->``. ``python docs/tables.py`` writes
``config/calibrator.yaml``; a test compares it with the code. The package need not be installed.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
import re
import sys
from textwrap import wrap
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent)]

from accel_calib.effects import EFFECTS  # noqa: E402
from accel_calib.finding import KINDS, STEPS  # noqa: E402
from accel_calib.findings import LIMITS  # noqa: E402
from accel_calib.logs import FORMATS  # noqa: E402
from accel_calib.logs.names import UNITS, WORDS  # noqa: E402
from accel_calib.session import CalibratorSettings  # noqa: E402
from accel_calib.session.settings import expected  # noqa: E402
from accel_calib.stored.exports import FORMATS as EXPORTS  # noqa: E402
from accel_calib.table import COLUMNS  # noqa: E402


def columns() -> Iterator[str]:
    """Yield the columns of pose tables and recordings."""
    yield '| in Python | in a file | unit | meaning |'
    yield '|---|---|---|---|'
    for key, column in COLUMNS.items():
        if column.made:
            continue
        names = ', '.join(f'`{name}`' for name in column.names)
        yield f'| `{key}` | {names} | {column.unit} | {column.meaning} |'


def effects() -> Iterator[str]:
    """Yield the catalogue of effects."""
    yield '| name | what | term | values | unit | common size | needs |'
    yield '|---|---|---|---|---|---|---|'
    for name, effect in EFFECTS.items():
        needs = ', '.join(part for key in effect.needs for part in COLUMNS[key].names)
        values = ', '.join(effect.values)
        unit = effect.unit.replace('/', '/\N{WORD JOINER}')  # a narrow column does not break it
        yield (f'| `{name}` | {effect.words} | {effect.term} | {values} | {unit} | '
               f'{effect.typical:g} | {needs} |')


def exports() -> Iterator[str]:
    """Yield the formats of exports."""
    yield '| `--to` | file | equation | holds |'
    yield '|---|---|---|---|'
    for name, each in EXPORTS.items():
        yield f'| `{name}` | `NAME{each.suffix}` | {each.equation} | {each.holds} |'


def rating() -> Iterator[str]:
    """Yield the limits of the rating."""
    yield '| limit | value | meaning |'
    yield '|---|---|---|'
    for limit in LIMITS:
        yield f'| {limit.name} | {limit.value:g} {limit.unit} | {limit.meaning} |'


def kinds(meanings: Mapping[str, str]) -> Iterator[str]:
    """Yield kinds with their meanings."""
    yield '| kind | meaning |'
    yield '|---|---|'
    for kind, meaning in meanings.items():
        yield f'| `{kind}` | {meaning} |'


def names() -> Iterator[str]:
    """Yield the words and units of the names of columns in logs."""
    yield '| quantity | words in a name | units in a name |'
    yield '|---|---|---|'
    for key, words in WORDS.items():
        ours = ', '.join(f'`{name}`' for name in COLUMNS[key].names)
        units: dict[tuple[str, float], list[str]] = {}
        for text, unit in UNITS[key].items():
            units.setdefault(unit, []).append(text)
        texts = '; '.join(' '.join(each) for each in units.values())
        yield f'| {ours} | {" ".join(words)} | {texts} |'


def short(name: str) -> str:
    """Return a name without its article."""
    return name.removeprefix('a ').removeprefix('an ')


def formats() -> Iterator[str]:
    """Yield the formats of logs."""
    yield '| format | suffixes | needs |'
    yield '|---|---|---|'
    for each in FORMATS:
        if not each.advice:
            suffixes = ' '.join(f'`{suffix}`' for suffix in each.suffixes)
            yield f'| {short(each.name)} | {suffixes} | {each.needs and f"`{each.needs}`"} |'
    refused = ', '.join(short(each.name) for each in FORMATS if each.advice)
    yield f'| refused with what converts it | {refused} | |'


def stated(value: Any) -> str:
    """Return a value as YAML has it."""
    return str(value).lower() if isinstance(value, bool) else repr(value)


def settings() -> Iterator[str]:
    """Yield the parameters of the calibrator."""
    yield '| parameter | default | meaning | live |'
    yield '|---|---|---|---|'
    for each in fields(CalibratorSettings):
        words = re.sub(r'([|<*])', r'\\\1', f"{each.metadata['words']} ({expected(each)})")
        live = 'yes' if each.metadata['live'] else ''
        yield f'| `{each.name}` | `{stated(each.metadata["default"])}` | {words} | {live} |'


Tables = Mapping[str, Callable[[], Iterator[str]]]

TABLES: Tables = {
    'columns': columns, 'effects': effects, 'exports': exports,
    'findings': partial(kinds, KINDS), 'formats': formats, 'names': names, 'rating': rating,
    'settings': settings, 'steps': partial(kinds, STEPS)}
PARAMETERS = HERE.parent / 'config' / 'calibrator.yaml'
COMMENT = '    # '


def parameters() -> Iterator[str]:
    """Yield the lines of a parameter file with all defaults, for any node name."""
    yield '# Parameters of the calibrator with their defaults; generated from'
    yield '# accel_calib/session/settings.py. Parameters with * can be set while the node runs.'
    yield '/**:'
    yield '  ros__parameters:'
    for each in fields(CalibratorSettings):
        live = ' *' if each.metadata['live'] else ''
        words = f"{each.metadata['words']} ({expected(each)}){live}"
        yield from wrap(words, 99, initial_indent=COMMENT, subsequent_indent=COMMENT)
        yield f'    {each.name}: {stated(each.metadata["default"])}'


def with_tables(text: str, made: Tables = TABLES) -> str:
    """Return the text of a page with tables, by default those of the code, in their places."""
    for name, table in made.items():
        rows = '\n'.join(table()).replace('\\', r'\\')
        text = re.sub(rf'^<!-- {name} -->(?:\n.*?<!-- end -->|[^\n]+)',
                      f'<!-- {name} -->\n\n{rows}\n\n<!-- end -->', text,
                      flags=re.MULTILINE | re.DOTALL)
    return text


def main() -> None:
    """Print the tables that are named, or write the parameters."""
    for name in sys.argv[1:]:
        sys.stdout.writelines(f'{line}\n' for line in TABLES[name]())
    if not sys.argv[1:]:
        PARAMETERS.write_text('\n'.join([*parameters(), '']), encoding='utf-8')


if __name__ == '__main__':
    main()
