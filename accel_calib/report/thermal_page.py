# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The page of a calibration of the offset over temperature: the curve by axis, and what it leaves.

The markers are the stretches of the ramps. The bands are 95 % intervals of the curve, relative to
its value at the reference temperature.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .page import snippets, STORED, values_section
from .sheet import (
    ACCENT, add_band, AFTER, BAND, block, Drawing, drawn, EDGE, figures, HEIGHT_INCHES, HINT,
    how_to_read, INK, legend_below, listing, Mark, Marks, numbers, paragraph, rated_sheet,
    scroll_table, section)
from ..calibrate import Curve
from ..effects import AXES
from ..text import short, signed
from ..units import MG

if TYPE_CHECKING:
    from ..pipeline import ThermalOutcome

_GRID = 100
_HOW_TO_READ = (
    'Each marker is the mean of a short stretch of the log, minus that of the board at the '
    'reference temperature. One orientation shows only this change, not the offset itself.',
    'The degree is the lowest one at which no higher one predicts parts of the log better that '
    'were held out.',
    'Deviations come from fits without one part of the log after the other, so that they include '
    'noise that is correlated. Bands are 95 % intervals.',
    'Hysteresis is the difference between warming and cooling at the same temperature. A lag of '
    'the thermometer causes it; a slower ramp reduces it.')


def thermal_page(outcome: ThermalOutcome, source: str, *, stored: str = STORED,
                 notes: Sequence[str] = ()) -> str:
    """
    Return the page of a calibration of the offset over temperature as HTML.

    Parameters
    ----------
    outcome : ThermalOutcome
        The calibration with its curve.
    source : str
        Names of the logs.
    stored : str
        File of the calibration, for the lines that use it.
    notes : sequence of str
        How the logs were read.

    """
    calibration, curve = outcome.calibration, outcome.curve
    title = f'Offset over temperature of {calibration.sensor or Path(source).name or source}'
    body = [_key_numbers(curve),
            section('Offset over temperature', figures(
                _of_axis(curve, axis) for axis in range(3)), HINT),
            _coefficients(curve), values_section(calibration),
            section('Held out', scroll_table(
                'Error of held-out parts by degree',
                ('degree', 'error of parts that were held out [mg]'),
                [(str(degree), short(error)) for degree, error in enumerate(curve.held_out_mg)],
                'whole-cells')),
            section('Warnings', listing(calibration.warnings)),
            section('Use it', *(block(name, text) for name, text in snippets(
                calibration, stored))),
            section('How the log was read', listing(notes)), how_to_read(*_HOW_TO_READ)]
    return rated_sheet(title, [source, f'fitted {calibration.date}' if calibration.date else ''],
                       outcome.rating, body)


def _key_numbers(curve: Curve) -> str:
    low, high = curve.range_c
    hysteresis = ('not known' if curve.hysteresis_mg is None
                  else f'{short(curve.hysteresis_mg)} mg')
    return numbers([('range', f'{low:.1f} to {high:.1f} °C'), ('degree', str(curve.degree)),
                    ('change', f'{short(curve.change_mg)} mg'),
                    ('residual', f'{short(curve.residual_mg)} mg'),
                    ('uncertainty up to', f'{short(curve.band_mg)} mg'),
                    ('hysteresis', hysteresis)])


def _of_axis(curve: Curve, axis: int) -> Drawing:
    """Draw the change of the reading of one axis over the temperature, with the curve."""
    grid = np.linspace(*curve.range_c, _GRID)
    line = curve.at(grid)[:, axis] * MG
    band = BAND * curve.deviation_at(grid)[:, axis] * MG
    hover: dict[str, Marks] = {}
    with drawn(HEIGHT_INCHES, f'{AXES[axis]}: change of the offset') as (figure, (panel,)):
        panel.set(xlabel='temperature [°C]', ylabel='change [mg]')
        add_band(panel, grid, line - band, line + band, INK)
        for label, which, colour in (('warming', curve.warming, ACCENT),
                                     ('cooling', ~curve.warming, AFTER)):
            if np.any(which):
                hover[label] = tuple(_marks(curve, axis, which))
                panel.plot(curve.stretches['temperature'][which], curve.change[which, axis] * MG,
                           'o', color=colour, markersize=3.0, label=label, gid=label, **EDGE)
        panel.plot(grid, line, color=INK, linewidth=1.2, label='curve', zorder=3.0)
        legend_below(figure, 3)
    ends = f'{short(float(line[0]))} to {short(float(line[-1]))} mg'
    return Drawing(f'thermal_{AXES[axis]}', f'Change of the offset {AXES[axis]} over the '
                   f'temperature: {ends}', figure, hover)


def _marks(curve: Curve, axis: int, which: NDArray[np.bool_]) -> Iterator[Mark]:
    for warm, change in zip(curve.stretches['temperature'][which], curve.change[which, axis]):
        yield Mark(f'{warm:.2f} °C: {change * MG:+.2f} mg', 0)


def _coefficients(curve: Curve) -> str:
    """Return the table of the coefficients by axis."""
    rows = [(f'(T − {curve.reference_c:.1f} °C)' + ('', '', '²', '³')[k], *(
        signed(value * MG, sd * MG, f'mg/°C{("", "", "²", "³")[k]}')
        for value, sd in zip(values, deviations)))
        for k, (values, deviations) in enumerate(zip(curve.values, curve.deviations), 1)]
    return section('Coefficients', scroll_table(
        'Coefficients by axis', ('', *AXES), rows, 'whole-cells values'), paragraph(
        'The sum over the powers is added to the reading.', 'soft')) if rows else ''
