# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Make the tables of the documentation from the code: ``python docs/tables.py``.

Each stands between ``<!-- NAME -->`` and ``<!-- end -->`` in a page; a test compares them.

"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re

from accel_calib.effects import EFFECTS
from accel_calib.table import COLUMNS

HERE = Path(__file__).parent


def columns() -> Iterator[str]:
    """Give the columns of pose tables and recordings."""
    yield '| columns | unit | meaning |'
    yield '|---|---|---|'
    for column in COLUMNS.values():
        if column.made:
            continue
        names = ', '.join(f'`{name}`' for name in column.names)
        yield f'| {names} | {column.unit} | {column.meaning} |'


def effects() -> Iterator[str]:
    """Give the catalogue of effects."""
    yield '| name | what | term | values | unit | common size | needs |'
    yield '|---|---|---|---|---|---|---|'
    for name, effect in EFFECTS.items():
        needs = ', '.join(part for key in effect.needs for part in COLUMNS[key].names)
        values = ', '.join(effect.values)
        yield (f'| `{name}` | {effect.words} | {effect.term} | {values} | {effect.unit} | '
               f'{effect.typical:g} | {needs} |')


TABLES = {'columns': columns, 'effects': effects}


def with_tables(text: str) -> str:
    """Give the text of a page with its tables as they are now."""
    for name, table in TABLES.items():
        rows = '\n'.join(table()).replace('\\', r'\\')
        text = re.sub(rf'(<!-- {name} -->\n).*?(<!-- end -->)', rf'\1\n{rows}\n\n\2', text,
                      flags=re.DOTALL)
    return text


def main() -> None:
    """Write the tables into all pages."""
    for page in sorted(HERE.glob('*.md')):
        page.write_text(with_tables(page.read_text(encoding='utf-8')), encoding='utf-8')


if __name__ == '__main__':
    main()
