# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Tables in HTML, for the report and for notebooks."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape


def table(head: Iterable[str], rows: Iterable[Iterable[str]], kind: str = '') -> str:
    """Return a table of the CSS class `kind`; the text of the cells is escaped."""
    cells = ''.join(f'<th scope="col">{escape(name)}</th>' for name in head)
    lines = ''.join('<tr>' + ''.join(f'<td>{escape(value)}</td>' for value in row) + '</tr>\n'
                    for row in rows)
    opening = f'<table class="{kind}">' if kind else '<table>'
    return (f'{opening}\n<thead><tr>{cells}</tr></thead>\n'
            f'<tbody>\n{lines}</tbody>\n</table>\n')
