# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The skeleton of every page: one self-contained HTML file, and its building blocks.

The folder ``page`` has the style sheet and the script, which each page contains. The colours of a
figure become variables of the style sheet, so that it follows the page in dark mode. A marker
with a name in `Drawing.hover` gets the text that the page shows when the marker is pointed at.

"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from functools import cache
from hashlib import sha256
from html import escape
from importlib.resources import files
import io
from pathlib import Path
import shlex
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from .charts import (
    ACCENT, AFTER, AXIS, BEFORE, DISC, Drawing, FAINT, GRID, INK, Marks, PAPER, RIM, styled, THIRD)
from ..disk import write_atomically
from ..effects import effect_named
from ..table import COLUMNS, Floats
from ..text import table

if TYPE_CHECKING:
    from ..calibrate import Calibration
    from ..findings import Rating

_VARIABLES = {INK: 'ink', AXIS: 'axis', GRID: 'grid', FAINT: 'faint', DISC: 'disc', RIM: 'rim',
              PAPER: 'paper', BEFORE: 'before', AFTER: 'after', ACCENT: 'accent', THIRD: 'third'}
"""CSS variable of each colour of a figure on a page."""

HINT = ('<p class="soft hint">Point at a marker to see its values, or select a figure with the '
        'tab key and move with the arrow keys.</p>\n')


def write_sheet(path: Path, text: str) -> None:
    """Write a page; raise OSError if it fails. An earlier file is then unchanged."""
    write_atomically(path, lambda file: file.write(text))


def sheet(title: str, body: Iterable[str], *, script: bool = True) -> str:
    """Return a page with this title and these parts, as HTML; the title is escaped."""
    live = ('<div id="tip" role="status" aria-live="polite"></div>\n'
            f'<script>{part_of_page("script.js")}</script>\n') if script else ''
    return ('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{policy(script=script)}">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{escape(title)}</title>\n<style>{part_of_page("style.css")}</style>\n</head>'
            f'\n<body>\n<main>\n{"".join(body)}</main>\n{live}</body>\n</html>\n')


@cache
def policy(*, script: bool = True) -> str:
    """Return the Content-Security-Policy of a page: its own script, and nothing from outside."""
    digest = b64encode(sha256(part_of_page('script.js').encode()).digest()).decode()
    own = f"script-src 'sha256-{digest}'; " if script else ''
    return (f"default-src 'none'; {own}style-src 'unsafe-inline'; img-src data:; "
            "base-uri 'none'; form-action 'none'")


def rated_sheet(title: str, rating: Rating, body: Iterable[str], *, script: bool = True) -> str:
    """Return a page whose title in the browser begins with the verdict."""
    return sheet(f'{rating.name.capitalize()}: {title[0].lower()}{title[1:]}', body, script=script)


@cache
def part_of_page(name: str) -> str:
    """Return the style sheet or the script of all pages, without its licence."""
    text = (files(__package__) / 'page' / name).read_text(encoding='utf-8')
    return text.partition('\n\n')[2]


def heading(title: str, about: Iterable[str]) -> str:
    """Return the heading of a page, with a line about its source; empty parts are left out."""
    line = ' · '.join(part for part in about if part)
    return f'<h1>{escape(title)}</h1>\n<p class="about">{escape(line)}</p>\n'


def section(title: str, *parts: str, kind: str = '') -> str:
    """Return a section with its heading; nothing if all parts are empty."""
    body = ''.join(parts)
    opening = f'<section class="{kind}">' if kind else '<section>'
    return f'{opening}\n<h2>{escape(title)}</h2>\n{body}</section>\n' if body else ''


def how_to_read(lines: Iterable[str]) -> str:
    """Return the section that explains the page."""
    return section('How to read this', listing(lines), kind='reading')


def verdict_box(rating: Rating, more: str = '') -> str:
    """Return the verdict: its name and figures, the reason, and what to do next."""
    return (f'<div class="verdict {escape(rating.name)}" role="note">\n'
            f'<p><strong>{escape(rating.name)}</strong> '
            f'{escape(rating.figures.replace("->", "→"))}</p>\n'
            f'{paragraph(_sentence(rating.reason))}{paragraph(more)}'
            f'<p><b>Next:</b> {escape(_sentence(rating.next.text))}</p>\n</div>\n')


def _sentence(text: str) -> str:
    """Return text with a capital letter and a full stop."""
    return text and f'{text[0].upper()}{text[1:].rstrip(".")}.'


def numbers(pairs: Iterable[tuple[str, str]]) -> str:
    """Return names and values as a row of large numbers."""
    parts = [f'<div><dt>{escape(name)}</dt><dd class="whole">{escape(value)}</dd></div>'
             for name, value in pairs]
    return f'<dl class="numbers">{"".join(parts)}</dl>\n'


def scroll_table(head: Iterable[str], rows: Iterable[Iterable[str]], kind: str = '',
                 name: str = 'Table', *, long: bool = False, poses: Sequence[int] = ()) -> str:
    """Return a table that scrolls inside of the page; `poses` are the rows of its poses."""
    return (f'<div class="scroll{" long" if long else ""}" tabindex="0" role="region" '
            f'aria-label="{escape(name)}">{table(head, rows, kind, poses)}</div>\n')


def listing(lines: Iterable[str]) -> str:
    """Return lines as a list; nothing without lines."""
    items = ''.join(f'<li>{escape(line)}</li>\n' for line in lines)
    return f'<ul>\n{items}</ul>\n' if items else ''


def paragraph(text: str, kind: str = '') -> str:
    """Return a paragraph of the CSS class `kind`; the text is escaped."""
    opening = f'<p class="{kind}">' if kind else '<p>'
    return f'{opening}{escape(text)}</p>\n' if text else ''


def code(name: str) -> str:
    """Return a name as code."""
    return f'<code>{escape(name)}</code>'


def block(title: str, text: str) -> str:
    """Return lines of code under a heading."""
    return f'<h3>{escape(title)}</h3>\n<pre tabindex="0"><code>{escape(text)}</code></pre>\n'


# ----------------------------------------------------------------------------- figures

def figures(drawn: Iterable[Drawing], kind: str, *, script: bool = True) -> str:
    """Return figures, in a grid of the CSS class `kind`: ``wide`` or ``pair``."""
    parts = [_figure(drawing, script=script) for drawing in drawn]
    return f'<div class="figures {kind}">\n' + '\n'.join(parts) + '\n</div>\n' if parts else ''


def _figure(drawing: Drawing, *, script: bool) -> str:
    svg = _inline_svg(drawing)
    if not script or not any(drawing.hover.values()):
        return f'<figure>{svg}</figure>'
    label = escape(f'{drawing.title}. Arrow keys move from marker to marker.')
    return f'<figure class="live" tabindex="0" role="group" aria-label="{label}">{svg}</figure>'


def _inline_svg(drawing: Drawing) -> str:
    """Return a figure as SVG, for a page with several."""
    buffer = io.StringIO()
    with styled():
        drawing.figure.savefig(buffer, format='svg', transparent=True,
                               metadata={'Date': None, 'Creator': None})
    root = ElementTree.fromstring(buffer.getvalue())
    for part in root.iter():
        _make_inline(part, drawing.name)
    for name, marks in drawing.hover.items():
        _add_marks(root, f'{drawing.name}-{name}', marks)
    for part in list(root):
        if part.tag == 'metadata':
            root.remove(part)
    root.attrib = {'role': 'img', 'aria-label': drawing.title, 'viewBox': root.attrib['viewBox']}
    return ElementTree.tostring(root, encoding='unicode')


def _make_inline(part: ElementTree.Element, prefix: str) -> None:
    """Remove namespaces and styles for the whole page, and make ids and colours those of it."""
    part.tag = part.tag.rpartition('}')[2]
    if part.tag == 'style':
        part.text = ''
    named = {key.rpartition('}')[2]: value for key, value in part.attrib.items()}
    for key, value in named.items():
        if key == 'id':
            named[key] = f'{prefix}-{value}'
        elif key == 'href' and value.startswith('#'):
            named[key] = f'#{prefix}-{value[1:]}'
        else:
            named[key] = value.replace('url(#', f'url(#{prefix}-')
    if 'style' in named:
        for colour, variable in _VARIABLES.items():
            named['style'] = named['style'].replace(colour, f'var(--{variable})')
    part.attrib = named


def _add_marks(root: ElementTree.Element, name: str, marks: Marks) -> None:
    """Add the texts to a group of markers; raise ValueError unless each marker has one."""
    group = next((part for part in root.iter('g') if part.get('id') == name), None)
    markers = [] if group is None else list(group.iter('use'))
    if len(markers) != len(marks):
        raise ValueError(f'{name} has {len(markers)} markers, expected {len(marks)}')
    for marker, mark in zip(markers, marks, strict=True):
        marker.set('class', 'mark')
        if mark.row:
            marker.set('data-row', str(mark.row))
        ElementTree.SubElement(marker, 'title').text = mark.words


# ----------------------------------------------------------------------------- lines of code

def snippets(calibration: Calibration, stored: str) -> tuple[tuple[str, str], ...]:
    """Return titles and lines of code that use the calibration in the file `stored`."""
    return (('ROS 2', _ros(calibration, stored)),
            ('ROS 2 launch file', _launch(calibration, stored)),
            ('Python', _python(calibration, stored)), ('C', _c(calibration)),
            ('C header, Arduino, PX4, ArduPilot and others',
             f'accel-calib export {shlex.quote(stored)} --to c -o calibration.h'))


def _ros(calibration: Calibration, stored: str) -> str:
    path = shlex.quote(stored) if Path(stored).is_absolute() else f'"$PWD"/{shlex.quote(stored)}'
    return ('ros2 launch accel_calib calibrator.launch.py imu:=imu/data_raw \\\n'
            f'  units:={calibration.units.name} calibration_file:={path}')


def _launch(calibration: Calibration, stored: str) -> str:
    return ("Node(package='accel_calib', executable='calibrator',\n"
            f"     parameters=[{{'calibration_file': {stored!r},\n"
            f"                  'units': {calibration.units.name!r}}}],\n"
            "     remappings=[('imu/data_raw', 'imu/data_raw')])")


def _python(calibration: Calibration, stored: str) -> str:
    known = ''.join(f', {key}={key}' for key in calibration.model.needs if key in COLUMNS
                    and key in ('time', 'temperature', 'supply_voltage', 'rate'))
    unit, force = calibration.units.symbol, calibration.units.symbol
    if calibration.units.is_native:
        unit, force = 'native units', 'g'
    return ('import accel_calib as ac\n\n'
            f'calibration = ac.load({stored!r})\n'
            f'force = calibration.apply(readings{known})  # (n, 3), {unit} -> {force}')


def _c(calibration: Calibration) -> str:
    """Return a C99 function with offset, gain and mounting."""
    mat = calibration.rotation.T @ calibration.matrix
    rows = ',\n'.join(f'  {{{_floats(row)}}}' for row in mat)
    beyond = [name for name in calibration.model.effects if not effect_named(name).linear]
    note = '' if not beyond else (
        f'/* Without {", ".join(beyond)}:\n'
        '   accel-calib export --to c writes the terms that C can hold. */\n')
    return (f'{note}static const float B[3] = {{{_floats(calibration.offset)}}};\n'
            f'static const float M[3][3] = {{\n{rows}}};\n\n'
            'static void accel_correct(const float raw[3], float a[3])\n{\n'
            '  for (int i = 0; i < 3; ++i)\n'
            '    a[i] = M[i][0] * (raw[0] - B[0]) + M[i][1] * (raw[1] - B[1])\n'
            '         + M[i][2] * (raw[2] - B[2]);\n}')


def _floats(numbers: Floats) -> str:
    """Return float constants of C."""
    return ', '.join(f'{value:.8e}f' for value in numbers)
