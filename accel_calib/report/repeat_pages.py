# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The pages of several calibrations of one sensor: their comparison, and their history."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .calibration_sections import verdict_box
from .repeat_charts import in_words, of_history, of_parameters, scale_of
from .sheet import figures, heading, HINT, listing, scroll_table, section, sheet
from .. import __version__
from ..disk import write_atomically
from ..rating import rate_comparison
from ..text import short

if TYPE_CHECKING:
    from ..calibrate import Calibration
    from ..compare import Comparison, History
    from ..rating import Rating

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


def change_in_words(name: str, change: float, sd: float) -> str:
    """Return the change of a parameter as ``+value ± sd unit``."""
    zero, _, _ = scale_of(name)
    return in_words(name, zero + change, sd)


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
