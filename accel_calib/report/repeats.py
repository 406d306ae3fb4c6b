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

from .charts import (
    ACCENT, add_bar, AFTER, BAND, BEFORE, Drawing, EDGE, FAINT, HEIGHT_INCHES, INK, legend_below,
    Mark, Marks, new_figure, PAPER, styled, THERMAL, THIRD)
from .sheet import (
    figures, heading, HINT, how_to_read, listing, rated_sheet, scroll_table, section, verdict_box,
    write_sheet)
from .. import __version__
from ..compare import Comparison, History, Parameter
from ..findings import change_in_words, CROSS, GAINS, in_words, OFFSETS, rate_comparison, scale_of
from ..table import Floats
from ..text import short, with_minus

if TYPE_CHECKING:
    from ..calibrate import Calibration
    from ..findings import Rating

_COLOURS = (AFTER, ACCENT, THIRD, BEFORE)

_DAY_S = 86400.0
_ONE_COLOUR = 0.5
"""Range of temperatures that is drawn in one colour [°C]."""


def spoken(name: str) -> str:
    """Return the name of a parameter in words, such as ``offset x``."""
    return name.replace('.', ' ')


def _named_words(name: str, value: float, sd: float) -> str:
    """Return a parameter with its name, such as ``offset x +20.3 ± 0.1 mg``."""
    return f'{spoken(name)} {in_words(name, value, sd)}'


def of_parameters(comparison: Comparison, labels: Sequence[str]) -> Iterator[Drawing]:
    """Yield the difference of each parameter of each run, named by `labels`, from the mean."""
    for key, words, names in (('offsets', 'Zero-g offset', OFFSETS),
                              ('gains', 'Gain and cross-axis', (*GAINS, *CROSS))):
        found = [each for each in comparison.parameters if each.name in names]
        with styled():
            figure = new_figure(HEIGHT_INCHES, f'{words} minus the mean of the runs')
            hover = _draw_parameters(figure.subplots(), found, labels)
            if len(labels) <= len(_COLOURS):
                legend_below(figure, 2)
        yield Drawing(key, f'{words}: difference of each run from the mean, with 95 % band',
                      figure, hover)


def _draw_parameters(panel: Any, found: Sequence[Parameter], labels: Sequence[str]
                     ) -> dict[str, Marks]:
    """Draw the differences of all runs, and return the texts of their markers."""
    hover = {}
    panel.grid(visible=True, axis='y')
    panel.axhline(0.0, color=FAINT, linewidth=1.2)
    factor = np.array([scale_of(each.name)[1] for each in found])
    for run, label in enumerate(labels):
        at = np.arange(len(found)) + 0.6 * ((run + 0.5) / len(labels) - 0.5)
        change = np.array([each.values[run] - np.mean(each.values) for each in found])
        band = BAND * np.array([each.stated_sd[run] for each in found])
        colour = _COLOURS[run % len(_COLOURS)]
        panel.vlines(at, (change - band) * factor, (change + band) * factor, color=colour)
        panel.plot(at, change * factor, 'o', color=colour, gid=f'run{run}', label=label, **EDGE)
        hover[f'run{run}'] = tuple(Mark(0, f'{label}, ' + _named_words(
            each.name, each.values[run], each.stated_sd[run])) for each in found)
    panel.set_xticks(range(len(found)), [each.name.partition('.')[2] for each in found])
    panel.set_ylabel(scale_of(found[0].name)[2])
    return hover


def of_history(history: History) -> Iterator[Drawing]:
    """Yield offset, gain and cross-axis over the dates, with bands."""
    for key, words, names in (('history_offset', 'Zero-g offset', OFFSETS),
                              ('history_gain', 'Gain minus 1', GAINS),
                              ('history_cross_axis', 'Cross-axis gain', CROSS)):
        found = [each for each in history.parameters if each.name in names and (
            names is not CROSS or np.any(each.stated_sd))]
        if found:
            yield _over_dates(key, f'{words} over the dates, with 95 % band', history, found)


def _over_dates(key: str, title: str, history: History, found: Sequence[Parameter]) -> Drawing:
    at, dated = places_of([None if moment.when is None else moment.when.timestamp()
                           for moment in history.moments])
    warm, hover = _temperatures(history), {}
    with styled():
        figure = new_figure(0.9 + 1.25 * len(found), title)
        panels = figure.subplots(len(found), 1, sharex=True, squeeze=False)[:, 0]
        for k, (panel, each) in enumerate(zip(panels, found, strict=True)):
            drawn = _draw_line(panel, each, at, warm)
            drawn.set_gid(f'panel{k}')
            hover[f'panel{k}'] = _marks(history, each)
        if warm is not None:
            add_bar(figure, drawn, panels, 'temperature [°C]', pad=0.02)
        label_dates(panels[-1], at, dated=dated)
    return Drawing(key, title, figure, hover)


def places_of(stamps: Sequence[float | None]) -> tuple[Floats, bool]:
    """
    Return the place of each calibration, and whether it is a date.

    The places are days since 1970 if all of the stamps [s since 1970] are known and differ,
    otherwise numbers from 1.

    """
    days = np.array([np.nan if stamp is None else stamp / _DAY_S for stamp in stamps])
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
    values, band = (each.values - zero) * factor, BAND * each.stated_sd * factor
    panel.grid(visible=True)
    panel.fill_between(at, values - band, values + band, color=AFTER, alpha=0.18, linewidth=0.0)
    panel.plot(at, values, color=FAINT, linewidth=1.2)
    panel.vlines(at, values - band, values + band, color=BEFORE, linewidth=1.0)
    panel.set_ylabel(f'{each.name.partition(".")[2]} [{unit}]')
    if warm is None:
        return panel.plot(at, values, 'o', color=AFTER, markeredgecolor=PAPER)[0]
    colours = np.where(np.isfinite(warm), warm, np.nanmean(warm))
    return panel.scatter(at, values, c=colours, cmap=THERMAL, edgecolors=INK, linewidths=0.5,
                         zorder=3, vmin=np.nanmin(warm), vmax=np.nanmax(warm))


def _marks(history: History, each: Parameter) -> Marks:
    """Return date, value and temperature of each calibration."""
    marks = []
    for label, moment, value, sd in zip(history.labels, history.moments, each.values,
                                        each.stated_sd, strict=True):
        words = f'{label}, {_named_words(each.name, value, sd)}'
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
    write_sheet(path, comparison_page(comparison, rating, sources, calibrations))


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
            how_to_read(_HOW_TO_READ)]
    return rated_sheet(title, rating, body)


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
        mean = with_minus(short((each.values.mean() - zero) * factor))
        rows.append((spoken(each.name), f'{mean} {unit}',
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
    write_sheet(path, history_page(history, sources, calibrations))


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
            how_to_read(_HOW_TO_READ)]
    return rated_sheet(title, rating, body)


def _changes(history: History) -> str:
    """Return a table with the verdict of each step."""
    head = ('from', 'to', 'verdict', 'p', 'largest change', 'RMS [mg]')
    rows = [(first, second, change_words(change.comparison.agree, rate_comparison(
        change.comparison)), f'{change.comparison.p_value:.2g}',
             f'{spoken(change.parameter)} ' + change_in_words(
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
            *(spoken(each.name) for each in history.parameters))
    rows = []
    for k, (label, moment) in enumerate(zip(history.labels, history.moments, strict=True)):
        warm = '' if moment.temperature is None else f'{moment.temperature:.1f}'
        values = (in_words(each.name, each.values[k], each.stated_sd[k])
                  for each in history.parameters)
        rows.append((str(k + 1), label, sources[moment.index].name, moment.model, warm,
                     short(moment.residual_mg), *values))
    return scroll_table(head, rows, 'whole-cells', 'Calibrations')
