# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The ladder: the residual of each step of a refinement, from the base to the noise floor."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

import numpy as np

from .style import ACCENT, AFTER, Chart, FAINT, new_figure, PAPER, styled
from ..refine.words import base_words
from ..text import short

if TYPE_CHECKING:
    from ..refine import Refinement

_WIDTH_INCHES = 4.9
_LEVEL_INCHES = 0.52


def draw_ladder(result: Refinement) -> Chart:
    """Draw the residual and the held-out residual of the base and after each step."""
    levels = _levels(result)
    with styled():
        figure = new_figure(1.25 + _LEVEL_INCHES * len(levels), _WIDTH_INCHES)
        axes = figure.subplots()
        _draw_levels(axes, levels)
        if result.noise_floor_mg:
            axes.axvline(result.noise_floor_mg, color=ACCENT, linewidth=1.6, linestyle=(0, (5, 3)),
                         label=f'noise floor {short(result.noise_floor_mg)} mg', zorder=1)
        _scale(axes, *_limits(result, levels))
        axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=3, handletextpad=0.2,
                    columnspacing=0.9, handlelength=1.6, borderaxespad=0.0)
    return Chart(figure)


def _scale(axes: Any, least: float, largest: float) -> None:
    """Set a logarithmic axis of residuals with legible ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    few = largest / least > 300.0
    axes.set_xscale('log')
    axes.set_xlim(least, largest)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if few else (1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel('residual: RMS over the poses [mg], logarithmic')
    axes.grid(visible=True, axis='x')


def _levels(result: Refinement) -> list[tuple[str, float, float | None]]:
    """Return name, residual and held-out residual [mg] of the base and after each step."""
    held_out = (result.steps[0].held_out_before_mg if result.steps
                else result.calibration.quality.held_out_rms_mg)
    levels = [(base_words(result), result.gap_mg, held_out)]
    levels += [(f'+ {step.effect}', step.gap_after_mg, step.held_out_after_mg)
               for step in result.steps]
    return levels


def _draw_levels(axes: Any, levels: list[tuple[str, float, float | None]]) -> None:
    height = np.arange(len(levels))
    residuals = np.array([residual for _, residual, _ in levels])
    axes.step(residuals, height, where='post', color=FAINT, linewidth=2.0, zorder=1)
    axes.plot(residuals, height, 'o', color=AFTER, markersize=9, label='all poses used', zorder=3)
    held_out = np.array([np.nan if out is None else out for _, _, out in levels])
    if np.any(np.isfinite(held_out)):
        axes.plot(held_out, height, 'o', color=AFTER, markersize=9, fillstyle='none',
                  markeredgewidth=1.6, label='held out', zorder=3)
    white = {'facecolor': PAPER, 'edgecolor': 'none', 'pad': 1.0}
    for at, residual, out in zip(height, residuals, held_out, strict=True):
        words = short(residual) + ('' if np.isnan(out) else f', held out {short(out)}')
        axes.annotate(words, (np.nanmax([residual, out]), at), (9, 0), va='center',
                      textcoords='offset points', fontsize=9.0,
                      bbox=white)
    for at, (name, _, _) in zip(height, levels, strict=True):
        axes.text(0.005, at - 0.36, name, transform=axes.get_yaxis_transform(), va='center',
                  fontweight='bold', fontsize=9.5, bbox=white)
    axes.set_ylim(len(levels) - 0.55, -0.65)
    axes.yaxis.set_visible(False)
    axes.spines['left'].set_visible(False)


def _limits(result: Refinement, levels: list[tuple[str, float, float | None]]
            ) -> tuple[float, float]:
    """Return the limits of the axis, with space for the numbers."""
    values = [value for level in levels for value in level[1:] if value]
    values += [result.noise_floor_mg] if result.noise_floor_mg else []
    least, largest = min(values, default=1.0), max(values, default=1.0)
    room = max(float(np.log10(largest / least)), 0.5)
    return least / 10.0 ** (0.08 * room), largest * 10.0 ** (0.5 * room)
