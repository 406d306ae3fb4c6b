# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The style of all figures, and the figures of the residuals of poses.

**Style.** A figure has half the width of the page: a phone shows one column, a desktop two
columns, with the same text size. The colours are from Okabe and Ito's palette and from RdBu, which
people with colour blindness can distinguish. matplotlib is imported only when a figure is drawn.

**Sphere map.** Two hemispheres in Lambert's equal-area projection. A direction u is at the radius
√(1 - |u_z|) from the pole. Equal areas of the sphere have equal areas on the map.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from .residuals import recorded, Residuals, residuals_of, Variable, variables_of
from ..calibrate import Calibration
from ..errors import InputError
from ..geometry import uncovered
from ..table import Floats
from ..text import milli, percentage, short, with_minus

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

HEIGHT_INCHES = 3.3
WIDTH_INCHES = 4.8

BAND = 1.96
"""Half the width of a band, in standard deviations: 95 %."""

EDGE: Any = {'markeredgecolor': PAPER, 'markeredgewidth': 0.4}
"""Edge of a filled marker."""

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


Marks = tuple[Mark, ...]


@dataclass(frozen=True)
class Drawing:
    """
    A figure of a page.

    Parameters
    ----------
    name : str
        Name of the file, without suffix; unique on the page.
    title : str
        Description for those who do not see the figure.
    figure : Figure
        The figure.
    hover : mapping of str to tuple of Mark
        For each named group of markers, one text per marker, in the order in which they are
        drawn.

    """

    name: str
    title: str
    figure: Figure
    hover: Mapping[str, Marks] = field(default_factory=dict)


def has_matplotlib() -> bool:
    """Return whether figures can be drawn."""
    return find_spec('matplotlib') is not None


def check_matplotlib() -> None:
    """Raise InputError if matplotlib is not installed."""
    if not has_matplotlib():
        raise InputError('matplotlib is not installed, but figures need it',
                         'run pip install matplotlib')


def styled() -> Any:
    """Return the context manager for drawing and saving figures."""
    from matplotlib import rc_context

    return rc_context(_STYLE)


def new_figure(height_inches: float, title: str = '', width_inches: float = WIDTH_INCHES
               ) -> Figure:
    """Return an empty figure with a title, in which $ is no mathematics."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inches, height_inches), layout='constrained')
    if title:
        figure.suptitle(title, x=0.02, ha='left', fontsize=10.5, parse_math=False)
    return figure


def legend_below(figure: Figure, columns: int, *entries: Any) -> None:
    """Draw a legend below the panels; the location 'outside' needs matplotlib 3.7."""
    legend = figure.legend(*entries, loc='lower center', ncols=columns)
    rows = -(-len(legend.get_texts()) // columns)
    part = (_LEGEND_INCHES + _LEGEND_ROW_INCHES * rows) / figure.get_figheight()
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0.0, part, 1.0, 1.0 - part))


def add_bar(figure: Figure, drawn: Any, panels: Iterable[Any], label: str, **options: Any) -> None:
    """Add a bar with the colours of what is drawn."""
    bar: Any = figure.colorbar(drawn, ax=list(panels), aspect=40, **options)
    bar.set_label(label)
    bar.outline.set_visible(False)


def save(figure: Figure, path: Path) -> None:
    """Write a figure to a file; the suffix sets the format."""
    with styled():
        figure.savefig(path, dpi=_PNG_DPI, facecolor='white')


# ----------------------------------------------------------------------------- residuals

_INK_PER_POSE = 3500.0
"""Total area of the markers [points²]; markers are larger for fewer poses."""

_HALVES = ('down', 'up')
"""Names of the markers of the hemispheres -z and +z."""

_LEAST_MG = 1e-3
"""Smallest residual of a logarithmic axis [mg]."""

_ROOM = 1.08
_FEW_DIRECTIONS = 6
_LEAST_LIMIT_MG = 1e-9


def limit_mg(*residuals: Residuals) -> float:
    """Return the end of a scale for residuals [mg]."""
    largest = max(float(np.max(np.abs(found.after_mg))) for found in residuals)
    return max(largest, _LEAST_LIMIT_MG) * _ROOM


def are_spread(force: Floats) -> bool:
    """Return whether the poses have enough different directions for a map."""
    return len(np.unique(np.round(force, 1), axis=0)) >= _FEW_DIRECTIONS


def of_remainder(residuals: Residuals, prefix: str = 'remaining') -> Iterator[Drawing]:
    """Yield figures of the final residuals, over the sphere and against the context."""
    limit = limit_mg(residuals)
    title = f'Remaining residual: {short(residuals.rms_mg)} mg RMS'
    if are_spread(residuals.force):
        yield sphere_map(residuals, f'{prefix}_sphere', title, limit, more=', by direction')
    poses_g = residuals.poses_g
    variables = (recorded(poses_g) or variables_of('quadratic', poses_g, residuals.force))[:3]
    yield against(residuals, variables, f'{prefix}_variables', title, limit, AFTER)


def sphere_map(residuals: Residuals, name: str, title: str, limit: float, *, more: str = ''
               ) -> Drawing:
    """Draw residuals over the sphere; `limit` is the end of the colour scale [mg]."""
    force, values, signed = residuals.force, residuals.after_mg, residuals.signed
    marks, hover = _marks(residuals, values), dict[str, Marks]()
    with styled():
        figure, discs = _two_discs(title)
        for disc, up in zip(discs, (True, False), strict=True):
            here = np.flatnonzero((force[:, 2] >= 0.0) == up)
            here = here[np.argsort(np.abs(values[here]))]
            drawn = disc.scatter(*_equal_area(force[here]).T, c=values[here],
                                 s=min(_INK_PER_POSE / max(len(force), 12), 130.0),
                                 cmap=DIVERGING if signed else SEQUENTIAL,
                                 vmin=-limit if signed else 0.0, vmax=limit,
                                 edgecolors=INK, linewidths=0.5, zorder=3)
            drawn.set_gid(_HALVES[up])
            hover[_HALVES[up]] = tuple(marks[k] for k in here)
            hover |= _draw_left_out(disc, residuals, up=up)
        add_bar(figure, drawn, discs, _label(signed=signed), orientation='horizontal',
                shrink=0.8, pad=0.03)
    return Drawing(name, f'{title}{more}', figure, hover)


def _two_discs(title: str) -> tuple[Figure, Any]:
    """Return a new figure, and its discs of the hemispheres +z and -z."""
    figure = new_figure(HEIGHT_INCHES, title)
    discs = figure.subplots(1, 2)
    for disc, up in zip(discs, (True, False), strict=True):
        _draw_disc(disc, up=up)
    return figure, discs


def _draw_disc(disc: Any, *, up: bool) -> None:
    """Draw the map of the hemisphere +z or -z with the sensor axes."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    disc.fill(np.cos(angle), np.sin(angle), facecolor=DISC, edgecolor=RIM, zorder=0)
    middle = np.sqrt(1.0 - np.sqrt(0.5))
    disc.plot(middle * np.cos(angle), middle * np.sin(angle), color=FAINT, linewidth=0.8, zorder=1)
    disc.plot([-1, 1], [0, 0], [0, 0], [-1, 1], color=FAINT, linewidth=0.8, zorder=1)
    for name, x, y in (('+x', 1, 0), ('-x', -1, 0), ('+y', 0, 1), ('-y', 0, -1)):
        disc.text(1.13 * x, 1.12 * y, with_minus(name), ha='center', va='center', fontsize=8.5)
    disc.text(-1.22, 1.08, '+z up' if up else '−z up', fontsize=9.5)
    disc.set(xlim=(-1.24, 1.24), ylim=(-1.22, 1.22), aspect='equal')
    disc.axis('off')


def _equal_area(force: Floats) -> Floats:
    """Return the (n, 2) positions of (n, 3) directions on the maps, which are unit discs."""
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    flat = unit[:, :2]
    across = np.linalg.norm(flat, axis=1, keepdims=True)
    radius = np.sqrt(1.0 - np.abs(unit[:, 2:]))
    return flat / np.where(across > 0.0, across, 1.0) * radius


def _draw_left_out(disc: Any, residuals: Residuals, *, up: bool) -> dict[str, Marks]:
    """Draw the poses left out as hollow squares with their rows, and return their texts."""
    here = (residuals.left_out_force[:, 2] >= 0.0) == up
    places, rows = _equal_area(residuals.left_out_force[here]), residuals.left_out.row[here]
    name = f'out_{_HALVES[up]}'
    disc.plot(*places.T, linestyle='none', marker='s', markersize=8, fillstyle='none',
              color=ACCENT, zorder=4, gid=name)
    for place, row in zip(places, rows, strict=True):
        disc.annotate(str(row), place, (5, 4), textcoords='offset points', fontsize=8.5,
                      color=ACCENT, zorder=4)
    return {name: tuple(Mark(int(row), f'row {row}, left out') for row in rows)}


def against(residuals: Residuals, variables: Sequence[Variable], name: str, title: str,
            limit: float, colour: str) -> Drawing:
    """Draw residuals against variables, one panel per variable; `limit` is of the axis [mg]."""
    values, signed, marks = residuals.after_mg, residuals.signed, _marks(residuals)
    with styled():
        figure = new_figure(
            1.0 + 1.45 * len(variables) + (0.8 if len(variables) == 1 else 0.0), title)
        panels = figure.subplots(len(variables), 1, sharey=True, squeeze=False)[:, 0]
        size = float(np.clip(5.5 - len(values) / 80.0, 2.5, 5.5))
        for k, (panel, variable) in enumerate(zip(panels, variables, strict=True)):
            panel.grid(visible=True)
            panel.axhline(0.0, color=ACCENT, linewidth=1.0)
            panel.plot(variable.values, values, 'o', color=colour, markersize=size,
                       gid=f'panel{k}', **EDGE)
            panel.set_xlabel(variable.label)
            if variable.unit_range:
                panel.set(xlim=(-1.06, 1.06), xticks=(-1.0, -0.5, 0.0, 0.5, 1.0))
            panel.set_ylim(-limit if signed else -0.04 * limit, limit)
        figure.supylabel(_label(signed=signed), fontsize=10.0)
    along = ' and '.join(variable.label for variable in variables)
    return Drawing(name, f'{title}, against {along}', figure,
                   {f'panel{k}': marks for k in range(len(variables))})


def of_coverage(residuals: Residuals, share: float, next_pose: Floats | None) -> Drawing:
    """Draw the poses over the sphere, the directions that they do not cover, and the next pose."""
    title = f'{percentage(share)} of the sphere is within 45° of a pose'
    force, marks, hover = residuals.force, _marks(residuals), dict[str, Marks]()
    open_ = uncovered(force)
    with styled():
        figure, discs = _two_discs(title)
        for disc, up in zip(discs, (True, False), strict=True):
            disc.plot(*_equal_area(open_[(open_[:, 2] >= 0.0) == up]).T, 'x', color=ACCENT,
                      markersize=3.5, label='not covered', zorder=2)
            here = np.flatnonzero((force[:, 2] >= 0.0) == up)
            disc.plot(*_equal_area(force[here]).T, 'o', color=AFTER, markeredgecolor=PAPER,
                      markersize=7, label='pose', zorder=3, gid=_HALVES[up])
            hover[_HALVES[up]] = tuple(marks[k] for k in here)
            if next_pose is not None:
                there = next_pose[np.newaxis][[(next_pose[2] >= 0.0) == up]]
                disc.plot(*_equal_area(there).T, '*', color=ACCENT, markersize=14,
                          label='next pose', zorder=4)
        legend_below(figure, 3, *discs[0].get_legend_handles_labels())
    return Drawing('coverage', title, figure, hover)


def of_before_after(residuals: Residuals, floor_mg: float | None) -> Drawing:
    """Draw the size of the residual of each pose without and with the calibration."""
    title = _before_after_title(residuals)
    with styled():
        figure = new_figure(HEIGHT_INCHES, title)
        panel = figure.subplots()
        _draw_before_after(panel, residuals, floor_mg)
        legend_below(figure, 3)
    return Drawing('before_after', title, figure, {
        'before': _marks(residuals, residuals.before_mg), 'after': _marks(residuals)})


def _before_after_title(residuals: Residuals) -> str:
    before = float(np.sqrt(np.mean(residuals.before_mg ** 2)))
    return f'Each pose before and after: {short(before)} and {short(residuals.rms_mg)} mg RMS'


def _draw_before_after(panel: Any, residuals: Residuals, floor_mg: float | None) -> None:
    panel.grid(visible=True, axis='y')
    for name, values, colour in (('before', residuals.before_mg, BEFORE),
                                 ('after', residuals.after_mg, AFTER)):
        panel.plot(residuals.poses_g.row, np.maximum(np.abs(values), _LEAST_MG), 'o',
                   color=colour, gid=name, label=name, **EDGE,
                   markersize=float(np.clip(7.0 - len(values) / 60.0, 3.0, 7.0)))
    if floor_mg:
        panel.axhline(floor_mg, color=ACCENT, linestyle=(0, (5, 3)), label='noise floor')
    panel.set_yscale('log')
    panel.yaxis.set_major_formatter(lambda value, _: f'{value:g}')
    panel.locator_params(axis='x', integer=True)
    panel.margins(y=0.1)
    panel.set(xlabel='row of the pose', ylabel=(
        'size of |force| − 1 g [mg]' if residuals.signed else _label(signed=False)))


def plot_residuals(calibration: Calibration, axes: Any = None) -> Any:
    """Draw the poses before and after into axes of matplotlib, by default new ones of pyplot."""
    check_matplotlib()
    from matplotlib import pyplot

    residuals = residuals_of(calibration)
    panel = pyplot.subplots()[1] if axes is None else axes
    _draw_before_after(panel, residuals, calibration.quality.noise_floor_mg)
    panel.set_title(_before_after_title(residuals))
    panel.legend()
    return panel


def _label(*, signed: bool) -> str:
    """Return the label of the axis of residuals."""
    return '|force| − 1 g [mg]' if signed else 'size of the vector error [mg]'


def _marks(residuals: Residuals, values: Floats | None = None) -> Marks:
    """Return row, residual and temperature of each pose, such as ``row 11, +0.4 mg, 31 °C``."""
    poses = residuals.poses_g
    warm, marks = poses.columns.get('temperature'), []
    values = residuals.after_mg if values is None else values
    for k, (row, value) in enumerate(zip(poses.row, values, strict=True)):
        words = f'row {row}, {milli(value, signed=residuals.signed)} mg'
        if warm is not None and np.isfinite(warm[k]):
            words += with_minus(f', {warm[k]:.0f} °C')
        marks.append(Mark(int(row), words))
    return tuple(marks)
