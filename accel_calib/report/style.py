# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Style of the figures, and their output as SVG and PNG.

A figure has half the width of the page: a phone shows one column, a desktop two columns, with the
same text size. The colours are from Okabe and Ito's palette and from RdBu, which people with
colour blindness can distinguish. matplotlib is imported only when a figure is drawn.

"""

from __future__ import annotations

from importlib.util import find_spec
import io
from pathlib import Path
import re
from typing import Any, TYPE_CHECKING

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
WIDTH_INCHES = 4.8

_PNG_DPI = 160
_STYLE: Any = {
    'font.family': ['sans-serif'], 'font.sans-serif': ['DejaVu Sans', 'Verdana', 'Arial'],
    'font.size': 10.0, 'axes.titlesize': 10.5, 'axes.labelsize': 10.0,
    'axes.edgecolor': '#666666', 'axes.labelcolor': INK, 'axes.spines.top': False,
    'axes.spines.right': False, 'axes.axisbelow': True, 'text.color': INK, 'xtick.color': INK,
    'ytick.color': INK, 'xtick.labelsize': 9.0, 'ytick.labelsize': 9.0, 'legend.frameon': False,
    'legend.fontsize': 9.0, 'grid.color': '#e6e6e6', 'svg.fonttype': 'none',
    'svg.hashsalt': 'accel_calib', 'axes.unicode_minus': True,
}


def check_matplotlib() -> None:
    """
    Check that figures can be drawn.

    Raises
    ------
    InputError
        If matplotlib is not installed.

    """
    if find_spec('matplotlib') is None:
        raise InputError('matplotlib is not installed, but figures need it',
                         "run pip install 'accel_calib[report]'")


def styled() -> Any:
    """Return the context manager for drawing and saving figures."""
    from matplotlib import rc_context

    return rc_context(_STYLE)


def new_figure(height_inches: float, width_inches: float = WIDTH_INCHES) -> Figure:
    """Return an empty figure."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_inches, height_inches), layout='constrained')


def residual_label(*, signed: bool) -> str:
    """Return the label of the axis of residuals."""
    return '|force| − 1 g [mg]' if signed else 'size of the vector error [mg]'


def inline_svg(figure: Figure, prefix: str, title: str) -> str:
    """
    Return a figure as SVG, for a page with several.

    Parameters
    ----------
    figure : Figure
        The figure.
    prefix : str
        Prefix of the ids, which must be unique on the page.
    title : str
        Description for screen readers, already escaped.

    """
    buffer = io.StringIO()
    with styled():
        figure.savefig(buffer, format='svg', transparent=True,
                       metadata={'Date': None, 'Creator': None})
    text = buffer.getvalue()
    text = text[text.index('<svg'):]
    text = re.sub(r'<metadata>.*?</metadata>', '', text, flags=re.S)
    text = re.sub(r' (?:xmlns(?::\w+)?|width|height|version)="[^"]*"', '', text[:400]) + text[400:]
    text = re.sub(r'\bid="', f'id="{prefix}-', text)
    text = text.replace('url(#', f'url(#{prefix}-').replace('xlink:href="#', f'href="#{prefix}-')
    return text.replace('<svg', f'<svg role="img" aria-label="{title}"', 1).strip()


def save(figure: Figure, path: Path) -> None:
    """Write a figure to a file; the suffix sets the format."""
    with styled():
        figure.savefig(path, dpi=_PNG_DPI, facecolor='white')
