# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The skeleton of every page: one self-contained HTML file, and its building blocks.

**Style sheet.** For desktops, phones and paper, light and dark. The figures use its colours.

**Script.** Shows the text of the marker nearest to the pointer, and highlights its pose in all
figures and in the table. A figure with markers takes the keyboard focus, and the arrow keys move
from marker to marker. Without the script, the browser shows the texts itself.

**Snippets.** Lines of code that use a calibration: ROS 2, Python and C.

"""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
import shlex

from .drawings import Drawing
from .style import inline_svg
from ..calibrate import Calibration
from ..effects import effect_named
from ..table import COLUMNS, Floats
from ..text import table

_LIGHT = """
  --paper: #fff; --ink: #222; --soft: #5f5f5f; --shade: #0003; --axis: #666; --grid: #e6e6e6;
  --faint: #d9d9d9; --disc: #fafafa; --rim: #888; --before: #8c8c8c; --after: #0072b2;
  --accent: #d55e00; --third: #009e73; --panel: #f3f3f3; --good: #00795a; --usable: #8a5f00;
  --bad: #c43c00; --good-back: #e9f6f1; --usable-back: #fdf5e3; --bad-back: #fdeee6;
"""
_DARK = """
  --paper: #16181b; --ink: #e8e8e8; --soft: #a9adb2; --shade: #fff4; --axis: #9a9ea3;
  --grid: #33373c; --faint: #50555b; --disc: #1f2226; --rim: #7b8087; --before: #9a9a9a;
  --after: #56b4e9; --accent: #ff8f3f; --third: #35c79b; --panel: #24272b; --good: #4fd6ab;
  --usable: #f0b840; --bad: #ff8a5c; --good-back: #15302a; --usable-back: #33290f;
  --bad-back: #3a2017;
"""
_RULES = """
html { font: 17px/1.5 "DejaVu Sans", Verdana, "Segoe UI", sans-serif; color: var(--ink);
  background: var(--paper); -webkit-text-size-adjust: 100%; }
body { margin: 0; }
main { max-width: 980px; margin: 0 auto; padding: 1.2rem 1rem 3rem; overflow-wrap: anywhere; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: .4rem 0 0; }
h2 { font-size: 1.2rem; line-height: 1.3; margin: 0 0 .4rem; }
h3 { font-size: 1rem; margin: 1rem 0 .2rem; }
p, ul { margin: .5rem 0 .8rem; max-width: 46rem; }
ul { padding-left: 1.2rem; }
li { margin: .25rem 0; }
code { font: .92em "DejaVu Sans Mono", Consolas, monospace; background: var(--panel);
  padding: .05em .25em; border-radius: 3px; }
pre { background: var(--panel); padding: .7rem .9rem; border-radius: 4px; overflow-x: auto;
  font: .82rem/1.45 "DejaVu Sans Mono", Consolas, monospace; margin: .4rem 0 1rem; }
pre code { background: none; padding: 0; font: inherit; overflow-wrap: normal; }
section { border-top: 1px solid var(--faint); margin-top: 1.8rem; padding-top: 1.2rem; }
.about, .soft { color: var(--soft); font-size: .85rem; }
.verdict { border-left: 6px solid var(--after); background: var(--panel); padding: .6rem .9rem;
  margin: 1rem 0; }
.verdict p { margin: .2rem 0; max-width: none; }
.verdict strong { font-size: 1.25rem; }
.verdict.GOOD { border-color: var(--good); background: var(--good-back); }
.verdict.USABLE { border-color: var(--usable); background: var(--usable-back); }
.verdict.BAD { border-color: var(--bad); background: var(--bad-back); }
.GOOD strong { color: var(--good); } .USABLE strong { color: var(--usable); }
.BAD strong { color: var(--bad); }
.numbers { display: flex; flex-wrap: wrap; gap: .6rem 2.2rem; margin: 1rem 0; }
.numbers dt { color: var(--soft); font-size: .8rem; }
.numbers dd { margin: 0; font-size: 1.35rem; }
.figures { display: grid; gap: .8rem 1.2rem; margin: 1rem 0; }
.figures.pair { grid-template-columns: repeat(auto-fill, minmax(min(100%, 400px), 1fr)); }
figure { margin: 0; break-inside: avoid; min-width: 0; }
figure svg { display: block; width: 100%; height: auto; }
figure svg * { stroke-linejoin: round; stroke-linecap: butt; }
figure:focus-visible, .scroll:focus-visible { outline: 2px solid var(--after);
  outline-offset: 2px; }
.wide figure { max-width: 640px; }
.mark.lit { stroke: var(--ink) !important; stroke-width: 3px !important; }
tr.lit td { background: var(--panel); }
#tip { position: fixed; z-index: 9; left: 0; top: 0; max-width: 15rem; padding: .2rem .55rem;
  border-radius: 4px; font-size: .85rem; background: var(--ink); color: var(--paper);
  pointer-events: none; visibility: hidden; }
.whole { white-space: nowrap; }
.scroll { overflow-x: auto; width: fit-content; max-width: 100%; background:
  linear-gradient(to right, var(--paper) 50%, transparent) 0 0 / 2rem 100% no-repeat local,
  linear-gradient(to left, var(--paper) 50%, transparent) 100% 0 / 2rem 100% no-repeat local,
  linear-gradient(to right, var(--shade), transparent) 0 0 / .8rem 100% no-repeat scroll,
  linear-gradient(to left, var(--shade), transparent) 100% 0 / .8rem 100% no-repeat scroll; }
.scroll.long { overflow-y: auto; max-height: 28rem; }
table { border-collapse: collapse; font-size: .88rem; margin: .6rem 0; }
.scroll th, .scroll td { overflow-wrap: normal; }
th { text-align: left; color: var(--soft); font-weight: normal;
  border-bottom: 2px solid var(--faint); }
.long th { position: sticky; top: 0; background: var(--paper); }
td { border-bottom: 1px solid var(--grid); }
th, td { padding: .3rem 1.1rem .3rem 0; vertical-align: top; }
table.whole-cells td, table.whole-but-last td:not(:last-child) { white-space: nowrap;
  font-variant-numeric: tabular-nums; }
.reading { font-size: .9rem; }
@media (max-width: 600px) { html { font-size: 16px; } h1 { font-size: 1.4rem; }
  table.values td:first-child { white-space: normal; }
  table { font-size: .8rem; } th, td { padding-right: .7rem; } .numbers { gap: .5rem 1.4rem; }
  .numbers dd { font-size: 1.15rem; } }
"""
_PRINT = """
@page { margin: 1.5cm; }
html { font-size: 10.5pt; } main { max-width: none; padding: 0; } #tip, .hint { display: none; }
* { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
h2, h3 { break-after: avoid; } tr, pre, .verdict { break-inside: avoid; }
.figures.pair { grid-template-columns: 1fr 1fr; } .wide figure { max-width: 12cm; }
.scroll, .scroll.long, pre { overflow: visible; max-height: none; background: none; }
pre { white-space: pre-wrap; } table { font-size: .78rem; } .long th { position: static; }
table.whole-cells td { white-space: normal; }
"""
STYLE = (f':root {{ color-scheme: light dark; {_LIGHT} }}\n'
         f'@media (prefers-color-scheme: dark) {{ :root {{ {_DARK} }} }}\n{_RULES}'
         f'@media print {{ :root {{ color-scheme: light; {_LIGHT} }}\n{_PRINT} }}\n')

SCRIPT = """
'use strict';
(() => {
  const tip = document.getElementById('tip');
  const text = new Map();
  let lit = [];
  let shown = null;
  const hide = () => {
    shown = null;
    tip.style.visibility = 'hidden';
    lit.forEach(part => part.classList.remove('lit'));
    lit = [];
  };
  const place = () => {
    if (!shown) { return; }
    const box = shown.getBoundingClientRect();
    const left = box.left + box.width / 2 - tip.offsetWidth / 2;
    const top = box.top - tip.offsetHeight - 8;
    tip.style.left = Math.max(4, Math.min(left, innerWidth - tip.offsetWidth - 4)) + 'px';
    tip.style.top = (top < 4 ? box.bottom + 8 : top) + 'px';
  };
  const show = mark => {
    hide();
    shown = mark;
    tip.textContent = text.get(mark);
    place();
    tip.style.visibility = 'visible';
    const row = mark.dataset.row;
    lit = row ? [...document.querySelectorAll('[data-row="' + row + '"]')] : [mark];
    lit.forEach(part => part.classList.add('lit'));
  };
  for (const figure of document.querySelectorAll('figure.live')) {
    const marks = [...figure.querySelectorAll('.mark')];
    for (const mark of marks) {
      const title = mark.querySelector('title');
      text.set(mark, title.textContent);
      title.remove();
    }
    let at = -1;
    const near = event => {
      let best = null, least = 24;
      for (const mark of marks) {
        const box = mark.getBoundingClientRect();
        const away = Math.hypot(box.left + box.width / 2 - event.clientX,
                                box.top + box.height / 2 - event.clientY);
        if (away < least) { least = away; best = mark; }
      }
      if (best) { at = marks.indexOf(best); show(best); } else { hide(); }
    };
    figure.addEventListener('pointermove', near);
    figure.addEventListener('pointerdown', near);
    figure.addEventListener('pointerleave', hide);
    figure.addEventListener('focus', () => {
      if (figure.matches(':focus-visible')) { at = Math.max(at, 0); show(marks[at]); }
    });
    figure.addEventListener('blur', hide);
    figure.addEventListener('keydown', event => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (event.key === 'Escape') { hide(); return; }
      if (!step) { return; }
      event.preventDefault();
      at = (at + step + marks.length) % marks.length;
      show(marks[at]);
    });
  }
  addEventListener('scroll', place, true);
})();
"""

HINT = ('<p class="soft hint">Point at a marker to see its values, or select a figure with the '
        'tab key and move with the arrow keys.</p>\n')


def sheet(title: str, body: Iterable[str], *, script: bool = True) -> str:
    """Return a page with this title and these parts, as HTML; the title is escaped."""
    live = ('<div id="tip" role="status" aria-live="polite"></div>\n'
            f'<script>{SCRIPT}</script>\n') if script else ''
    return ('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n'
            f'<body>\n<main>\n{"".join(body)}</main>\n{live}</body>\n</html>\n')


def heading(title: str, about: Iterable[str]) -> str:
    """Return the heading of a page, with a line about its source; empty parts are left out."""
    line = ' · '.join(part for part in about if part)
    return f'<h1>{escape(title)}</h1>\n<p class="about">{escape(line)}</p>\n'


def section(title: str, *parts: str, kind: str = '') -> str:
    """Return a section with its heading; nothing if all parts are empty."""
    body = ''.join(parts)
    opening = f'<section class="{kind}">' if kind else '<section>'
    return f'{opening}\n<h2>{escape(title)}</h2>\n{body}</section>\n' if body else ''


def numbers(pairs: Iterable[tuple[str, str]]) -> str:
    """Return names and values as a row of large numbers."""
    parts = [f'<div><dt>{escape(name)}</dt><dd class="whole">{escape(value)}</dd></div>'
             for name, value in pairs]
    return f'<dl class="numbers">{"".join(parts)}</dl>\n'


def figures(drawn: Iterable[Drawing], kind: str, *, script: bool = True) -> str:
    """Return figures, in a grid of the CSS class `kind`: ``wide`` or ``pair``."""
    parts = [_figure(drawing, script=script) for drawing in drawn]
    return f'<div class="figures {kind}">\n' + '\n'.join(parts) + '\n</div>\n' if parts else ''


def _figure(drawing: Drawing, *, script: bool) -> str:
    svg = inline_svg(drawing.chart, drawing.name, drawing.title)
    if not script or not any(drawing.chart.hover.values()):
        return f'<figure>{svg}</figure>'
    label = escape(f'{drawing.title}. Arrow keys move from marker to marker.')
    return f'<figure class="live" tabindex="0" role="group" aria-label="{label}">{svg}</figure>'


def scroll_table(head: Iterable[str], rows: Iterable[Iterable[str]], kind: str = '',
                 name: str = 'Table', *, long: bool = False) -> str:
    """Return a table that scrolls inside of the page; the text of the cells is escaped."""
    return (f'<div class="scroll{" long" if long else ""}" tabindex="0" role="region" '
            f'aria-label="{escape(name)}">{table(head, rows, kind)}</div>\n')


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
    return (f'<h3>{escape(title)}</h3>\n<pre tabindex="0"><code>{escape(text)}</code></pre>\n')


def snippets(calibration: Calibration, stored: str) -> tuple[tuple[str, str], ...]:
    """
    Return titles and lines of code that use a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    stored : str
        File of the calibration.

    """
    return (('ROS 2', _ros(calibration, stored)), ('ROS 2 launch file', _launch(calibration,
                                                                                stored)),
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


def _floats(values: Floats) -> str:
    """Return float constants of C."""
    return ', '.join(f'{value:.8e}f' for value in values)
