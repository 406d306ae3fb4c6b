# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The page of the noise of a sensor: Allan deviation by axis, and its figures.

The curves have bands, which are 95 % intervals from the equivalent degrees of freedom. The thin
line is the sum of the components that were found.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .charts import ACCENT, AFTER, Drawing, Mark, Marks, new_figure, styled, THIRD
from .sheet import (
    figures, heading, how_to_read, listing, numbers, paragraph, rated_sheet, scroll_table, section,
    verdict_box, write_sheet)
from .. import __version__
from ..findings import rate_noise
from ..noise import AxisNoise, duration, FIGURES, Kind, NoiseFigures, shown_unit, TYPICAL, WORDS
from ..text import power_of_ten, with_sd
from ..units import is_native

_COLOURS = {'x': AFTER, 'y': ACCENT, 'z': THIRD}
_HEIGHT_INCHES = 4.0
_SHAPES = {'x': 'o', 'y': 's', 'z': '^'}
_NAMES = {'accelerometer': 'Accelerometer', 'gyroscope': 'Gyroscope'}
_KALIBR: dict[tuple[Kind, str], str] = {
    ('accelerometer', 'noise_density'): 'm/s²/√Hz', ('accelerometer', 'random_walk'): 'm/s³/√Hz',
    ('gyroscope', 'noise_density'): 'rad/s/√Hz', ('gyroscope', 'random_walk'): 'rad/s²/√Hz'}
"""Units of Kalibr's imu.yaml."""

_HOW_TO_READ = (
    'The Allan deviation at τ is the typical change between two successive averages over τ, '
    'divided by √2.',
    'White noise falls with slope −1/2; its density N is the value of that line at τ = 1 s. The '
    'flat part is 0.664 times the bias instability B. A random walk K rises with slope +1/2, '
    'and is K/√3 on that line at τ = 1 s (IEEE Std 952 and 1293).',
    'Data sheets state the noise density for positive frequencies alone, which is √2 N. Kalibr '
    'and VINS use N.',
    'Bands are 95 % intervals. At long τ few averages remain, and the bands are wide.',
)


def write_noise_page(path: Path, found: NoiseFigures, source: str) -> None:
    """
    Write the page of the noise of a recording.

    Parameters
    ----------
    path : Path
        File of the page.
    found : NoiseFigures
        The figures.
    source : str
        Name of the recording.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    write_sheet(path, _page(found, source))


def _page(found: NoiseFigures, source: str) -> str:
    title = f'Noise of {Path(source).name or source}'
    about = [source, f'accel_calib {__version__}']
    drawn = (_allan(found.of(kind)) for kind in found.kinds)
    rating = rate_noise(found)
    body = [heading(title, about), verdict_box(rating), _rest(found), figures(drawn, 'pair'),
            *(_table(found, kind) for kind in found.kinds),
            section('Notes', listing(found.notes)),
            section('Not seen', listing(need_lines(found))),
            section('For Kalibr and VINS', listing(kalibr_lines(found))),
            how_to_read(_HOW_TO_READ)]
    return rated_sheet(title, rating, body)


def _allan(axes: Sequence[AxisNoise]) -> Drawing:
    """Draw the Allan deviation of the axes of one sensor over τ, with their 95 % bands."""
    kind, hover = axes[0].kind, {}
    unit, scale = shown_unit(kind, 'bias_instability', axes[0].unit)
    with styled():
        figure = new_figure(_HEIGHT_INCHES, f'{_NAMES[kind]}: Allan deviation')
        panel: Any = figure.subplots()
        panel.set(xscale='log', yscale='log', xlabel='averaging time τ [s]',
                  ylabel=f'Allan deviation [{unit}]')
        panel.grid(visible=True)
        for axis in axes:
            hover[f'curve_{axis.axis}'] = _draw_axis(panel, axis, unit, scale)
        # Wide bands at long τ must not compress the curves.
        every = np.concatenate([axis.deviation for axis in axes]) * scale
        panel.set_ylim(0.5 * float(np.min(every)), 2.0 * float(np.max(every)))
        panel.legend(ncols=len(axes))
    ends = [f'{axis.axis} from {axis.deviation[0] * scale:.3g} to '
            f'{np.min(axis.deviation) * scale:.3g} {unit} at '
            f'{duration(float(axis.tau[np.argmin(axis.deviation)]))}' for axis in axes]
    return Drawing(f'allan_{kind}', f'Allan deviation of the {kind} over τ: {", ".join(ends)}',
                   figure, hover)


def _draw_axis(panel: Any, axis: AxisNoise, unit: str, scale: float) -> Marks:
    """Draw one axis, and return the texts of its markers."""
    colour = _COLOURS[axis.axis]
    panel.fill_between(axis.tau, axis.low * scale, axis.high * scale, color=colour, alpha=0.2,
                       linewidth=0.0)
    used = (axis.tau >= axis.used[0]) & (axis.tau <= axis.used[1])
    panel.plot(axis.tau[used], axis.model[used] * scale, color=colour, linewidth=1.0)
    panel.plot(axis.tau, axis.deviation * scale, linestyle='none', marker=_SHAPES[axis.axis],
               color=colour, markersize=4.0, label=axis.axis, gid=f'curve_{axis.axis}')
    return tuple(Mark(0, f'{axis.axis}, τ = {duration(float(tau))}: {value * scale:.3g} {unit}')
                 for tau, value in zip(axis.tau, axis.deviation, strict=True))


def _rest(found: NoiseFigures) -> str:
    pairs = [('rest', duration(found.seconds)), ('samples', f'{found.samples:,}'),
             ('rate', f'{found.rate:.5g} Hz')]
    if found.temperature is not None:
        low, high = found.temperature
        pairs.append(('temperature', f'{low:.1f} to {high:.1f} °C'))
    return numbers(pairs)


def _table(found: NoiseFigures, kind: Kind) -> str:
    """Return the table of the figures of one sensor."""
    axes = found.of(kind)
    rows = [[f'{label} [{unit}]', *cells] for label, unit, cells in figure_rows(axes)]
    rows.append(['from τ', *(f'{duration(axis.used[0])} to {duration(axis.used[1])}'
                             for axis in axes), ''])
    head = ['', *(axis.axis for axis in axes), 'typical']
    return section(_NAMES[kind], scroll_table(head, rows, 'whole-cells', f'Noise of the {kind}'),
                   paragraph('± is one standard deviation; < is the upper limit with 95 % '
                             'probability of a figure that the curve does not show. Typical: '
                             'common parts, from the data sheets of ICM-42688-P and MPU-6050, '
                             'divided by √2; data sheets do not state the other figures.', 'soft'))


def figure_rows(axes: Sequence[AxisNoise]) -> Iterator[tuple[str, str, list[str]]]:
    """Yield words, unit, and a cell for each axis and for typical values of each figure."""
    for figure in FIGURES:
        unit, scale = shown_unit(axes[0].kind, figure, axes[0].unit)
        found = [axis.figures[figure] for axis in axes]
        yield WORDS[figure], unit, [
            *(with_sd(each.value * scale, each.sd * scale) if each.seen
              else f'< {float(f"{each.upper * scale:.2g}"):g}' for each in found),
            ' to '.join(f'{float(f"{limit * scale:.2g}"):g}' for limit in TYPICAL.get(
                (axes[0].kind, figure, axes[0].unit), ()))]


def need_lines(found: NoiseFigures) -> list[str]:
    """Return a line for each figure that is not seen."""
    return [f'{WORDS[figure]} of the {kind}: {_axes_without(found, kind, figure)}{need}'
            for (kind, figure), need in found.needs.items()]


def _axes_without(found: NoiseFigures, kind: Kind, figure: str) -> str:
    """Return the axes on which a figure is not seen, if it is seen on others."""
    axes = found.of(kind)
    without = [axis.axis for axis in axes if not axis.figures[figure].seen]
    return '' if len(without) == len(axes) else f'not seen on {", ".join(without)}: '


def kalibr_lines(found: NoiseFigures) -> list[str]:
    """Return the figures of all axes together with the names and units of Kalibr."""
    lines = []
    for (kind, figure), unit in _KALIBR.items():
        value, sd = found.common(kind, figure)
        if np.isfinite(value) and not is_native(found.of(kind)[0].unit):
            lines.append(f'{kind}_{figure}: {power_of_ten(value, sd)} {unit}')
    return [*lines, f'update_rate: {found.rate:.6g} Hz'] if lines else []
