# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Style of the figures, and their output as SVG and PNG.

A figure has half the width of the page: a phone shows one column, a desktop two columns, with the
same text size. The colours are from Okabe and Ito's palette and from RdBu, which people with
colour blindness can distinguish. matplotlib is imported only when a figure is drawn.

**Figures on a page.** The colours of the style become CSS variables, so that a figure follows the
page in dark mode. A marker with a name in `Chart.hover` gets the text that the page shows when
the marker is pointed at.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
import io
from pathlib import Path
from typing import Any, TYPE_CHECKING
from xml.etree import ElementTree

from ..errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BEFORE = '#8c8c8c'
AFTER = '#0072b2'
ACCENT = '#d55e00'
INK = '#222222'
FAINT = '#d9d9d9'
DIVERGING = 'RdBu_r'
SEQUENTIAL = 'Blues'
THERMAL = 'coolwarm'
DISC = '#fafafa'
RIM = '#888888'
AXIS = '#666666'
GRID = '#e6e6e6'
PAPER = '#ffffff'
THIRD = '#009e73'
WIDTH_INCHES = 4.8

ON_PAGE = {INK: 'ink', AXIS: 'axis', GRID: 'grid', FAINT: 'faint', DISC: 'disc', RIM: 'rim',
           PAPER: 'paper', BEFORE: 'before', AFTER: 'after', ACCENT: 'accent', THIRD: 'third'}
"""CSS variable of each colour of a figure on a page."""

_PNG_DPI = 160
_LEGEND_INCHES, _LEGEND_ROW_INCHES = 0.12, 0.18
"""Height of the frame and of a row of a legend."""

_STYLE: Any = {
    'font.family': ['sans-serif'], 'font.sans-serif': ['DejaVu Sans', 'Verdana', 'Arial'],
    'font.size': 10.0, 'axes.titlesize': 10.5, 'axes.labelsize': 10.0,
    'axes.edgecolor': AXIS, 'axes.labelcolor': INK, 'axes.spines.top': False,
    'axes.spines.right': False, 'axes.axisbelow': True, 'text.color': INK, 'xtick.color': INK,
    'ytick.color': INK, 'xtick.labelsize': 9.0, 'ytick.labelsize': 9.0, 'legend.frameon': False,
    'legend.fontsize': 9.0, 'grid.color': GRID, 'svg.fonttype': 'none',
    'svg.hashsalt': 'accel_calib', 'axes.unicode_minus': True,
}


@dataclass(frozen=True)
class Mark:
    """The row of a pose, or 0, and the text that the page shows for its marker."""

    row: int
    words: str


@dataclass(frozen=True)
class Chart:
    """
    A figure, and the texts of its markers.

    Parameters
    ----------
    figure : Figure
        The figure.
    hover : mapping of str to tuple of Mark
        For each named group of markers, one text per marker, in the order in which they are
        drawn.

    """

    figure: Figure
    hover: Mapping[str, tuple[Mark, ...]] = field(default_factory=dict)


def has_matplotlib() -> bool:
    """Return whether figures can be drawn."""
    return find_spec('matplotlib') is not None


def check_matplotlib() -> None:
    """
    Check that figures can be drawn.

    Raises
    ------
    InputError
        If matplotlib is not installed.

    """
    if not has_matplotlib():
        raise InputError('matplotlib is not installed, but figures need it',
                         'run pip install matplotlib')


def styled() -> Any:
    """Return the context manager for drawing and saving figures."""
    from matplotlib import rc_context

    return rc_context(_STYLE)


def new_figure(height_inches: float, width_inches: float = WIDTH_INCHES) -> Figure:
    """Return an empty figure."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_inches, height_inches), layout='constrained')


def legend_below(figure: Figure, columns: int, *entries: Any) -> None:
    """Draw a legend below the panels; the location 'outside' needs matplotlib 3.7."""
    legend = figure.legend(*entries, loc='lower center', ncols=columns)
    rows = -(-len(legend.get_texts()) // columns)
    part = (_LEGEND_INCHES + _LEGEND_ROW_INCHES * rows) / figure.get_figheight()
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0.0, part, 1.0, 1.0 - part))


def residual_label(*, signed: bool) -> str:
    """Return the label of the axis of residuals."""
    return '|force| − 1 g [mg]' if signed else 'size of the vector error [mg]'


def inline_svg(chart: Chart, prefix: str, title: str) -> str:
    """
    Return a figure as SVG, for a page with several.

    Parameters
    ----------
    chart : Chart
        The figure and the texts of its markers.
    prefix : str
        Prefix of the ids, which must be unique on the page.
    title : str
        Description for screen readers.

    """
    buffer = io.StringIO()
    with styled():
        chart.figure.savefig(buffer, format='svg', transparent=True,
                             metadata={'Date': None, 'Creator': None})
    root = ElementTree.fromstring(buffer.getvalue())
    for part in root.iter():
        _make_inline(part, prefix)
    for name, marks in chart.hover.items():
        _add_marks(root, f'{prefix}-{name}', marks)
    for part in list(root):
        if part.tag == 'metadata':
            root.remove(part)
    root.attrib = {'role': 'img', 'aria-label': title, 'viewBox': root.attrib['viewBox']}
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
        for colour, variable in ON_PAGE.items():
            named['style'] = named['style'].replace(colour, f'var(--{variable})')
    part.attrib = named


def _add_marks(root: ElementTree.Element, name: str, marks: tuple[Mark, ...]) -> None:
    """
    Add the texts to a group of markers.

    Raises
    ------
    ValueError
        If the group does not have one marker per text, so that texts would be misplaced.

    """
    group = next((part for part in root.iter('g') if part.get('id') == name), None)
    markers = [] if group is None else list(group.iter('use'))
    if len(markers) != len(marks):
        raise ValueError(f'{name} has {len(markers)} markers, expected {len(marks)}')
    for marker, mark in zip(markers, marks, strict=True):
        marker.set('class', 'mark')
        if mark.row:
            marker.set('data-row', str(mark.row))
        ElementTree.SubElement(marker, 'title').text = mark.words


def save(figure: Figure, path: Path) -> None:
    """Write a figure to a file; the suffix sets the format."""
    with styled():
        figure.savefig(path, dpi=_PNG_DPI, facecolor='white')
