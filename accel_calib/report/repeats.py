# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The pages of several calibrations of one sensor: their comparison and their history.

In the figures, offsets are in mg and gains in %. For native units, 1 g is the mean of the
sensitivities.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from .drawings import Drawing
from .sections import verdict_box
from .sheet import figures, heading, HINT, listing, scroll_table, section, sheet
from .style import (
    ACCENT,
    AFTER,
    BEFORE,
    Chart,
    FAINT,
    INK,
    legend_below,
    Mark,
    new_figure,
    PAPER,
    styled,
    THERMAL,
    THIRD,
)
from .. import __version__
from ..compare import Comparison, History, Parameter
from ..disk import write_atomically
from ..findings import (
    change_in_words,
    CROSS,
    GAINS,
    in_words,
    OFFSETS,
    rate_comparison,
    scale_of,
)
from ..table import Floats
from ..text import short

if TYPE_CHECKING:
    from ..calibrate import Calibration
    from ..findings import Rating

_COLOURS = (AFTER, ACCENT, THIRD, BEFORE)
_BAND = 1.96
"""Half the width of a band, in standard deviations: 95 %."""

_DAY_S = 86400.0
_ONE_COLOUR = 0.5
"""Range of temperatures that is drawn in one colour [°C]."""


def named_words(name: str, value: float, sd: float) -> str:
    """Return a parameter with its name, such as ``offset x +20.3 ± 0.1 mg``."""
    return f'{name.replace(".", " ")} {in_words(name, value, sd)}'


def of_parameters(comparison: Comparison, labels: Sequence[str]) -> tuple[Drawing, ...]:
    """
    Draw the difference of each parameter of each run from the mean of all runs.

    Parameters
    ----------
    comparison : Comparison
        The comparison.
    labels : sequence of str
        Name of each run.

    """
    groups = (('offsets', 'Zero-g offset', OFFSETS), ('gains', 'Gain and cross-axis',
                                                      (*GAINS, *CROSS)))
    drawn = []
    for key, words, names in groups:
        found = [each for each in comparison.parameters if each.name in names]
        title = f'{words}: difference of each run from the mean, with 95 % band'
        drawn.append(Drawing(key, title, _draw_parameters(title, found, labels)))
    return tuple(drawn)


def _draw_parameters(title: str, found: Sequence[Parameter], labels: Sequence[str]) -> Chart:
    hover = {}
    with styled():
        figure = new_figure(3.3)
        figure.suptitle(title.partition(':')[0] + ' minus the mean of the runs', x=0.02, ha='left',
                        fontsize=10.5)
        panel = figure.subplots()
        panel.grid(visible=True, axis='y')
        panel.axhline(0.0, color=FAINT, linewidth=1.2)
        for run, label in enumerate(labels):
            at = np.arange(len(found)) + 0.6 * ((run + 0.5) / len(labels) - 0.5)
            factor = np.array([scale_of(each.name)[1] for each in found])
            change = np.array([each.values[run] - np.mean(each.values) for each in found])
            band = _BAND * np.array([each.stated_sd[run] for each in found])
            colour = _COLOURS[run % len(_COLOURS)]
            panel.vlines(at, (change - band) * factor, (change + band) * factor, color=colour)
            panel.plot(at, change * factor, 'o', color=colour, gid=f'run{run}', label=label,
                       markeredgecolor=PAPER, markeredgewidth=0.4)
            hover[f'run{run}'] = tuple(Mark(0, f'{label}, ' + named_words(
                each.name, each.values[run], each.stated_sd[run])) for each in found)
        panel.set_xticks(range(len(found)), [each.name.partition('.')[2] for each in found])
        panel.set_ylabel(scale_of(found[0].name)[2])
        if len(labels) <= len(_COLOURS):
            legend_below(figure, 2)
    return Chart(figure, hover)


def of_history(history: History) -> tuple[Drawing, ...]:
    """Draw offset, gain and cross-axis over the dates, with bands."""
    groups = (('history_offset', 'Zero-g offset', OFFSETS),
              ('history_gain', 'Gain minus 1', GAINS),
              ('history_cross_axis', 'Cross-axis gain', CROSS))
    drawn = []
    for key, words, names in groups:
        found = [each for each in history.parameters if each.name in names and (
            key != 'history_cross_axis' or np.any(each.stated_sd))]
        if found:
            title = f'{words} over the dates, with 95 % band'
            drawn.append(Drawing(key, title, _draw_history(title, history, found)))
    return tuple(drawn)


def _draw_history(title: str, history: History, found: Sequence[Parameter]) -> Chart:
    at, dated = _positions(history)
    warm = _temperatures(history)
    hover = {}
    with styled():
        figure = new_figure(0.9 + 1.25 * len(found))
        figure.suptitle(title, x=0.02, ha='left', fontsize=10.5)
        panels = figure.subplots(len(found), 1, sharex=True, squeeze=False)[:, 0]
        for k, (panel, each) in enumerate(zip(panels, found, strict=True)):
            drawn = _draw_line(panel, each, at, warm)
            drawn.set_gid(f'panel{k}')
            hover[f'panel{k}'] = _marks(history, each)
        if warm is not None:
            bar = figure.colorbar(drawn, ax=list(panels), aspect=40, pad=0.02)
            bar.set_label('temperature [°C]')
            bar.outline.set_visible(False)
        label_dates(panels[-1], at, dated=dated)
    return Chart(figure, hover)


def _positions(history: History) -> tuple[Floats, bool]:
    """Return the place of each calibration, and whether it is a date."""
    days = np.array([np.nan if moment.when is None else moment.when.timestamp() / _DAY_S
                     for moment in history.moments])
    dated = bool(np.all(np.isfinite(days))) and float(np.ptp(days)) > 0.0
    return (days if dated else np.arange(1.0, len(days) + 1.0)), dated


def _temperatures(history: History) -> Floats | None:
    """Return the temperature of each calibration, NaN if not known; None if it hardly changes."""
    warm = np.array([np.nan if moment.temperature is None else moment.temperature
                     for moment in history.moments])
    known = warm[np.isfinite(warm)]
    return warm if len(known) > 1 and np.ptp(known) > _ONE_COLOUR else None


def _draw_line(panel: Any, each: Parameter, at: Floats, warm: Floats | None) -> Any:
    zero, factor, unit = scale_of(each.name)
    values, band = (each.values - zero) * factor, _BAND * each.stated_sd * factor
    panel.grid(visible=True)
    panel.fill_between(at, values - band, values + band, color=AFTER, alpha=0.18, linewidth=0.0)
    panel.plot(at, values, color=FAINT, linewidth=1.2)
    panel.vlines(at, values - band, values + band, color=BEFORE, linewidth=1.0)
    panel.set_ylabel(f'{each.name.partition(".")[2]} [{unit}]')
    if warm is None:
        return panel.plot(at, values, 'o', color=AFTER, markeredgecolor=PAPER)[0]
    limits = {'vmin': np.nanmin(warm), 'vmax': np.nanmax(warm)}
    colours = np.where(np.isfinite(warm), warm, np.nanmean(warm))
    return panel.scatter(at, values, c=colours, cmap=THERMAL, edgecolors=INK, linewidths=0.5,
                         zorder=3, **limits)


def _marks(history: History, each: Parameter) -> tuple[Mark, ...]:
    """Return date, value and temperature of each calibration."""
    marks = []
    for label, moment, value, sd in zip(history.labels, history.moments, each.values,
                                        each.stated_sd, strict=True):
        words = f'{label}, {named_words(each.name, value, sd)}'
        if moment.temperature is not None:
            words += f', {moment.temperature:.0f} °C'
        marks.append(Mark(0, words))
    return tuple(marks)


def label_dates(panel: Any, at: Floats, *, dated: bool) -> None:
    """Label the axis with dates, or with numbers of runs."""
    if not dated:
        panel.set_xticks(at, [f'{number:.0f}' for number in at])
        panel.set_xlabel('calibration')
        return
    from matplotlib import dates

    locator: Any = dates.AutoDateLocator(maxticks=6)  # type: ignore[no-untyped-call]
    panel.xaxis.set_major_locator(locator)
    panel.xaxis.set_major_formatter(
        dates.ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    panel.set_xlabel('date of the fit')


_HOW_TO_READ = (
    'The parameters do not depend on the axes of the model, and are at the same temperature for '
    'all calibrations, if their models contain its effect.',
    'The test uses all parameters at once and each one alone. p is the probability of differences '
    'at least this large, if the sensor has not changed.',
    'RMS and largest: difference of |force| from the mean of the other calibrations, over all '
    'directions.',
)


def write_comparison_page(path: Path, comparison: Comparison, rating: Rating,
                          sources: Sequence[Path], calibrations: Sequence[Calibration]) -> None:
    """
    Write the page of a comparison.

    Parameters
    ----------
    path : Path
        File of the page.
    comparison : Comparison
        The comparison.
    rating : Rating
        The verdict.
    sources : sequence of Path
        Files of the calibrations.
    calibrations : sequence of Calibration
        The calibrations that were compared.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    text = comparison_page(comparison, rating, sources, calibrations)
    write_atomically(path, lambda file: file.write(text))


def comparison_page(comparison: Comparison, rating: Rating, sources: Sequence[Path],
                    calibrations: Sequence[Calibration]) -> str:
    """Return the page of a comparison as HTML; the parameters are those of its writer."""
    labels = [f'{k} {source.name}' for k, source in enumerate(sources, 1)]
    title = f'Comparison of {len(calibrations)} calibrations{_of_sensor(calibrations)}'
    body = [heading(title, (*map(str, sources), f'accel_calib {__version__}')),
            verdict_box(rating),
            section('Calibrations', _runs(comparison, calibrations, labels)),
            section('Parameters', figures(of_parameters(comparison, labels),
                                          'pair'), HINT, _parameters(comparison)),
            section('Notes', listing(_notes(comparison))),
            section('How to read this', listing(_HOW_TO_READ), kind='reading')]
    return sheet(f'{rating.name.capitalize()}: {title[0].lower()}{title[1:]}', body)


def _of_sensor(calibrations: Sequence[Calibration]) -> str:
    name = next((each.sensor for each in calibrations if each.sensor), '')
    return f' of {name}' if name else ''


def _runs(comparison: Comparison, calibrations: Sequence[Calibration], labels: Sequence[str]
          ) -> str:
    """Return a table that compares each run with the others."""
    head = ('run', 'date', 'model', 'RMS [mg]', 'expected [mg]', 'largest [mg]', 'p')
    rows = [(label, each.date[:10], each.name, short(run.rms_mg), short(run.expected_mg),
             short(run.largest_mg), f'{run.p_value:.2g}')
            for label, each, run in zip(labels, calibrations, comparison.runs, strict=True)]
    return scroll_table(head, rows, 'whole-cells', 'Calibrations')


def _parameters(comparison: Comparison) -> str:
    """Return a table of the spread of each parameter."""
    rows = []
    for each in comparison.parameters:
        zero, factor, unit = scale_of(each.name)
        stated = float(np.sqrt(np.mean(each.stated_sd ** 2)))
        mean = short((each.values.mean() - zero) * factor).replace('-', '−')
        rows.append((each.name.replace('.', ' '), f'{mean} {unit}',
                     short(each.spread * factor), short(stated * factor),
                     '' if each.ratio is None else f'{each.ratio:.2f}'))
    return scroll_table(('', 'mean', 'spread', 'stated', 'ratio'), rows, 'whole-cells',
                        'Parameters')


def _notes(comparison: Comparison) -> Iterator[str]:
    yield from comparison.notes
    if comparison.tilt_deg is not None:
        yield ('the directions of up of levelled calibrations differ by up to '
               f'{comparison.tilt_deg:.3g}°; the test does not use them')


def write_history_page(path: Path, history: History, sources: Sequence[Path],
                       calibrations: Sequence[Calibration]) -> None:
    """
    Write the page of a history.

    Parameters
    ----------
    path : Path
        File of the page.
    history : History
        The history.
    sources : sequence of Path
        Files of the calibrations.
    calibrations : sequence of Calibration
        The calibrations, as given to `accel_calib.compare.history_of`.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    text = history_page(history, sources, calibrations)
    write_atomically(path, lambda file: file.write(text))


def history_page(history: History, sources: Sequence[Path],
                 calibrations: Sequence[Calibration]) -> str:
    """Return the page of a history as HTML; the parameters are those of its writer."""
    rating = rate_comparison(history.whole)
    title = f'History of {len(calibrations)} calibrations{_of_sensor(calibrations)}'
    span = f'{history.labels[0]} to {history.labels[-1]}'
    body = [heading(title, (span, f'accel_calib {__version__}')), verdict_box(rating),
            section('Over the dates', figures(of_history(history), 'pair'), HINT),
            section('Changes', _changes(history)),
            section('Calibrations', _moments(history, sources)),
            section('Notes', listing(history.notes)),
            section('How to read this', listing(_HOW_TO_READ), kind='reading')]
    return sheet(f'{rating.name.capitalize()}: {title[0].lower()}{title[1:]}', body)


def _changes(history: History) -> str:
    """Return a table with the verdict of each step."""
    head = ('from', 'to', 'verdict', 'p', 'largest change', 'RMS [mg]')
    rows = [(first, second, change_words(change.comparison.agree, rate_comparison(
        change.comparison)), f'{change.comparison.p_value:.2g}',
             f'{change.parameter.replace(".", " ")} ' + change_in_words(
                 change.parameter, change.change, change.sd),
             short(change.comparison.runs[1].rms_mg))
            for first, second, change in zip(history.labels, history.labels[1:], history.changes,
                                             strict=False)]
    return scroll_table(head, rows, 'whole-cells', 'Changes')


def change_words(agree: bool, rating: Rating) -> str:
    """Return whether two calibrations agree, with the rating, such as ``agree, GOOD``."""
    return f'{"agree" if agree else "differ"}, {rating.name}'


def _moments(history: History, sources: Sequence[Path]) -> str:
    """Return a table of the calibrations with their parameters."""
    head = ('', 'date', 'file', 'model', '°C', 'residual [mg]',
            *(each.name.replace('.', ' ') for each in history.parameters))
    rows = []
    for k, (label, moment) in enumerate(zip(history.labels, history.moments, strict=True)):
        warm = '' if moment.temperature is None else f'{moment.temperature:.1f}'
        values = (in_words(each.name, each.values[k], each.stated_sd[k])
                  for each in history.parameters)
        rows.append((str(k + 1), label, sources[moment.index].name, moment.model, warm,
                     short(moment.residual_mg), *values))
    return scroll_table(head, rows, 'whole-cells', 'Calibrations')
