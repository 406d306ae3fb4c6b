# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What all pages have in common: one self-contained HTML file, and its figures.

The folder ``page`` has the templates of the pages, which share the frame ``sheet.html`` and the
parts of ``parts.html``, and the style sheet and the script, which each page contains.

**Figures.** A figure has half the width of the page: a phone shows one column, a desktop two
columns, with the same text size. The colours are from Okabe and Ito's palette and from RdBu, which
people with colour blindness can distinguish. On a page they become variables of the style sheet,
so that a figure follows the page in dark mode. A marker with a name in `Drawing.hover` gets the
text that the page shows when the marker is pointed at. matplotlib is imported only when a figure
is drawn.

"""

from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from html import escape
from importlib.resources import files
import io
from pathlib import Path
import shlex
from typing import Any, TYPE_CHECKING
from xml.etree import ElementTree

from .. import __version__
from ..disk import write_atomically
from ..errors import needing
from ..findings import Rating
from ..statistics import NORMAL_95
from ..table import Floats
from ..text import counted, short, table

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure


def write_page(path: Path, text: str) -> None:
    """Write a page; raise OSError if it fails. An earlier file is then unchanged."""
    write_atomically(path, lambda file: file.write(text))


def page(name: str, title: str, about: Iterable[str], rating: Rating, *, script: bool = True,
         **values: Any) -> str:
    """
    Return a page as HTML, which begins with its heading and its verdict.

    Parameters
    ----------
    name : str
        Template of the page, without suffix.
    title : str
        Title; the browser shows the verdict before it.
    about : iterable of str
        Where the content comes from; empty parts are left out.
    rating : Rating
        The verdict.
    script : bool
        Whether figures show the texts of their markers themselves, not the browser.
    **values
        What the template shows; `heading` is the heading if it is not the title, and `more` a text
        of the verdict, beside its reason.

    """
    about = filter(None, (*about, f'accel_calib {__version__}'))
    return _templates().get_template(f'{name}.html').render({
        'heading': title, 'more': '', 'title': title, 'about': about, 'rating': rating,
        'script': script, 'policy': policy(script=script), **values})


@cache
def _templates() -> 'Environment':
    """Return the templates of all pages, which escape all text."""
    # The import is here because it would slow down commands that write no page.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(loader=PackageLoader('accel_calib.report', 'page'), autoescape=True,
                       undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters |= {'counted': counted, 'escaped': lambda text: escape(str(text)),
                     'quoted': shlex.quote, 'repr': repr, 'short': short,
                     'sentence': lambda text: text and f'{text[0].upper()}{text[1:].rstrip(".")}.',
                     'svg': _inline_svg}
    made.globals |= {'file': _part_of_page, 'table': table}
    return made


@cache
def policy(*, script: bool = True) -> str:
    """Return the Content-Security-Policy of a page: its own script, and nothing from outside."""
    digest = b64encode(sha256(_part_of_page('script.js').encode()).digest()).decode()
    own = f"script-src 'sha256-{digest}'; " if script else ''
    return (f"default-src 'none'; {own}style-src 'unsafe-inline'; img-src data:; "
            "base-uri 'none'; form-action 'none'")


def _part_of_page(name: str) -> str:
    """Return the style sheet or the script of all pages, without its licence."""
    text = (files(__package__) / 'page' / name).read_text(encoding='utf-8')
    return text.partition('\n\n')[2]


# ----------------------------------------------------------------------------- drawing figures

BEFORE = '#8c8c8c'
AFTER = '#0072b2'
ACCENT = '#d55e00'
THIRD = '#009e73'
INK = '#222222'
FAINT = '#d9d9d9'
DISC = '#fafafa'
RIM = '#888888'
PAPER = '#ffffff'
_AXIS = '#666666'
_GRID = '#e6e6e6'
_VARIABLES = {INK: 'ink', _AXIS: 'axis', _GRID: 'grid', FAINT: 'faint', DISC: 'disc', RIM: 'rim',
              PAPER: 'paper', BEFORE: 'before', AFTER: 'after', ACCENT: 'accent', THIRD: 'third'}
"""CSS variable of each colour of a figure on a page."""

DIVERGING = 'RdBu_r'
SEQUENTIAL = 'Blues'
THERMAL = 'coolwarm'
AXIS_COLOURS = (AFTER, ACCENT, THIRD)
"""Colours of what belongs to x, y and z."""

HEIGHT_INCHES = 3.3
WIDTH_INCHES = 4.8

BAND = NORMAL_95
"""Half the width of a band, in standard deviations: 95 %."""

EDGE: Any = {'markeredgecolor': PAPER, 'markeredgewidth': 0.4}
"""Edge of a filled marker."""

_LEGEND_INCHES, _LEGEND_ROW_INCHES = 0.12, 0.18
"""Height of the frame and of a row of a legend."""

_STYLE: Any = {
    'font.family': ['sans-serif'], 'font.sans-serif': ['DejaVu Sans', 'Verdana', 'Arial'],
    'font.size': 10.0, 'axes.titlesize': 10.5, 'axes.labelsize': 10.0,
    'axes.edgecolor': _AXIS, 'axes.labelcolor': INK, 'axes.spines.top': False,
    'axes.spines.right': False, 'axes.axisbelow': True, 'text.color': INK, 'xtick.color': INK,
    'ytick.color': INK, 'xtick.labelsize': 9.0, 'ytick.labelsize': 9.0, 'legend.frameon': False,
    'legend.fontsize': 9.0, 'grid.color': _GRID, 'svg.fonttype': 'none',
    'svg.hashsalt': 'accel_calib', 'axes.unicode_minus': True, 'axes.formatter.limits': (-3, 5),
}


@dataclass(frozen=True)
class Mark:
    """The text that the page shows for a marker, and the row of its pose; 0 if it is none."""

    words: str
    row: int = 0


Marks = tuple[Mark, ...]


@dataclass(frozen=True)
class Drawing:
    """
    A figure of a page.

    `name` is that of the file, without suffix, and unique on the page. `title` is for those who do
    not see the figure. `hover` has one text per marker for each named group of markers, in the
    order in which they are drawn.

    """

    name: str
    title: str
    figure: 'Figure'
    hover: Mapping[str, Marks] = field(default_factory=dict)


def check_matplotlib() -> None:
    """Raise InputError if matplotlib is not installed."""
    with needing('matplotlib', 'a figure'):
        import matplotlib  # noqa: F401


def styled() -> Any:
    """Return the context manager for drawing and saving figures."""
    from matplotlib import rc_context

    return rc_context(_STYLE)


@contextmanager
def drawn(height_inches: float, title: str = '', rows: int = 1, columns: int = 1, *,
          width_inches: float = WIDTH_INCHES, grid: str = 'both', **shared: Any
          ) -> 'Iterator[tuple[Figure, Any]]':
    """
    Yield a new figure and its panels, to be drawn in the style of all figures.

    In the title, $ is no mathematics. `grid` are the axes with a grid. `shared` are those that the
    panels share, as in ``Figure.subplots``.

    """
    from matplotlib.figure import Figure

    with styled():
        figure = Figure(figsize=(width_inches, height_inches), layout='constrained')
        if title:
            figure.suptitle(title, x=0.02, ha='left', fontsize=10.5, parse_math=False)
        panels = figure.subplots(rows, columns, squeeze=False, **shared).ravel()
        for panel in panels if grid else ():
            panel.grid(visible=True, axis=grid)
        yield figure, panels


def legend_below(figure: 'Figure', columns: int, *entries: Any) -> None:
    """Draw a legend below the panels; the location 'outside' needs matplotlib 3.7."""
    legend = figure.legend(*entries, loc='lower center', ncols=columns)
    rows = -(-len(legend.get_texts()) // columns)
    part = (_LEGEND_INCHES + _LEGEND_ROW_INCHES * rows) / figure.get_figheight()
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0.0, part, 1.0, 1.0 - part))


def add_bar(figure: 'Figure', scattered: Any, panels: Iterable[Any], label: str, **options: Any
            ) -> None:
    """Add a bar with the colours of scattered markers."""
    bar: Any = figure.colorbar(scattered, ax=list(panels), aspect=40, **options)
    bar.set_label(label)
    bar.outline.set_visible(False)


def add_band(panel: Any, at: Floats, low: Floats, high: Floats, colour: str, alpha: float = 0.2
             ) -> None:
    """Fill the band between two lines."""
    panel.fill_between(at, low, high, color=colour, alpha=alpha, linewidth=0.0)


# ----------------------------------------------------------------------------- figures on a page

def _inline_svg(drawing: Drawing) -> str:
    """
    Return a figure as SVG, for a page with several, with the texts of its markers.

    Raise ValueError unless each marker has one.

    """
    buffer = io.StringIO()
    with styled():
        drawing.figure.savefig(buffer, format='svg', transparent=True,
                               metadata={'Date': None, 'Creator': None})
    root = ElementTree.fromstring(buffer.getvalue())
    for part in root.iter():
        _make_inline(part, drawing.name)
    for name, marks in drawing.hover.items():
        own = f'{drawing.name}-{name}'
        group = next((part for part in root.iter('g') if part.get('id') == own), None)
        markers = [] if group is None else list(group.iter('use'))
        if len(markers) != len(marks):
            raise ValueError(f'{own} has {len(markers)} markers, expected {len(marks)}')
        for marker, mark in zip(markers, marks, strict=True):
            marker.set('class', 'mark')
            if mark.row:
                marker.set('data-row', str(mark.row))
            ElementTree.SubElement(marker, 'title').text = mark.words
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
