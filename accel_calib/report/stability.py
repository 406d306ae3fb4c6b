# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The pages of the stability of a sensor: of `noise`, `compare` and `history`.

**Noise.** Allan deviation by axis over the averaging time. The bands are 95 % intervals from the
equivalent degrees of freedom. The thin line is the sum of the components that were found.

**Several calibrations.** Offsets are in mg and gains in %. For native units, 1 g is the mean of
the sensitivities.

"""

from collections.abc import Iterator, Sequence
import math
from pathlib import Path
from typing import Any

import numpy as np

from .sheet import (
    ACCENT, add_band, add_bar, AFTER, AXIS_COLOURS, BAND, BEFORE, Drawing, drawn, EDGE, FAINT,
    HEIGHT_INCHES, INK, legend_below, Mark, Marks, page, PAPER, THERMAL, THIRD)
from ..calibration import Calibration
from ..comparison import Comparison, History
from ..findings import (
    change_words, CROSS, GAINS, in_words, OFFSETS, rate_comparison, rate_noise, Rating, scale_of)
from ..noise import AxisNoise, duration, FIGURES, Kind, NoiseFigures, shown_unit, TYPICAL, WORDS
from ..statistics import rms
from ..table import Floats
from ..text import short, with_minus, with_sd
from ..units import is_native

_LOOKS = dict(zip('xyz', zip(AXIS_COLOURS, 'os^')))
"""Colour and marker of each axis."""

_KALIBR: dict[tuple[Kind, str], str] = {
    ('accelerometer', 'noise_density'): 'm/s²/√Hz', ('accelerometer', 'random_walk'): 'm/s³/√Hz',
    ('gyroscope', 'noise_density'): 'rad/s/√Hz', ('gyroscope', 'random_walk'): 'rad/s²/√Hz'}
"""Units of Kalibr's imu.yaml."""


def noise_page(found: NoiseFigures, source: str) -> str:
    """Return the page of the noise of the recording in the file `source`, as HTML."""
    tables = []
    for kind in found.kinds:
        axes = found.of(kind)
        rows = [(f'{label} [{unit}]', *cells) for label, unit, cells in figure_rows(axes)]
        times = (f'{duration(axis.used[0])} to {duration(axis.used[1])}' for axis in axes)
        tables.append((kind, [axis.axis for axis in axes], [*rows, ('from τ', *times, '')]))
    return page('noise', f'Noise of {Path(source).name or source}', [source], rate_noise(found),
                found=found, rest=duration(found.seconds), tables=tables, needs=need_lines(found),
                drawings=(_draw_allan(found.of(kind)) for kind in found.kinds),
                kalibr=kalibr_lines(found))


def _draw_allan(axes: Sequence[AxisNoise]) -> Drawing:
    """Draw the Allan deviation of the axes of one sensor over τ, with their 95 % bands."""
    kind, hover = axes[0].kind, {}
    unit, scale = shown_unit(kind, 'bias_instability', axes[0].unit)
    with drawn(4.0, f'{kind.capitalize()}: Allan deviation') as (figure, (panel,)):
        panel.set(xscale='log', yscale='log', xlabel='averaging time τ [s]',
                  ylabel=f'Allan deviation [{unit}]')
        for axis in axes:
            (colour, marker), name = _LOOKS[axis.axis], f'curve_{axis.axis}'
            add_band(panel, axis.tau, axis.low * scale, axis.high * scale, colour)
            used = (axis.tau >= axis.used[0]) & (axis.tau <= axis.used[1])
            panel.plot(axis.tau[used], axis.model[used] * scale, color=colour, linewidth=1.0)
            panel.plot(axis.tau, axis.deviation * scale, linestyle='none', marker=marker,
                       color=colour, markersize=4.0, label=axis.axis, gid=name)
            hover[name] = tuple(
                Mark(f'{axis.axis}, τ = {duration(float(tau))}: {value * scale:.3g} {unit}')
                for tau, value in zip(axis.tau, axis.deviation, strict=True))
        # Wide bands at long τ must not compress the curves.
        every = np.concatenate([axis.deviation for axis in axes]) * scale
        panel.set_ylim(0.5 * float(np.min(every)), 2.0 * float(np.max(every)))
        panel.legend(ncols=len(axes))
    ends = [f'{axis.axis} from {axis.deviation[0] * scale:.3g} to '
            f'{np.min(axis.deviation) * scale:.3g} {unit} at '
            f'{duration(float(axis.tau[np.argmin(axis.deviation)]))}' for axis in axes]
    return Drawing(f'allan_{kind}', f'Allan deviation of the {kind} over τ: {", ".join(ends)}',
                   figure, hover)


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
    lines = []
    for (kind, figure), need in found.needs.items():
        axes = found.of(kind)
        without = [axis.axis for axis in axes if not axis.figures[figure].seen]
        where = '' if len(without) == len(axes) else f'not seen on {", ".join(without)}: '
        lines.append(f'{WORDS[figure]} of the {kind}: {where}{need}')
    return lines


def kalibr_lines(found: NoiseFigures) -> list[str]:
    """Return the figures of all axes together with the names and units of Kalibr."""
    lines = []
    for (kind, figure), unit in _KALIBR.items():
        value, sd = found.common(kind, figure)
        if np.isfinite(value) and not is_native(found.of(kind)[0].unit):
            power = math.floor(math.log10(value))
            words = (with_sd(value, sd) if -3 <= power <= 3 else
                     f'({with_sd(value / 10.0 ** power, sd / 10.0 ** power)})e{power}')
            lines.append(f'{kind}_{figure}: {words} {unit}')
    return [*lines, f'update_rate: {found.rate:.6g} Hz'] if lines else []


# ----------------------------------------------------------------------------- calibrations

GROUPS = (('offset', 'Zero-g offset', OFFSETS), ('gain', 'Gain minus 1', GAINS),
          ('cross_axis', 'Cross-axis gain', CROSS))
"""Key, words and names of the parameters that are drawn together."""

_COLOURS = (AFTER, ACCENT, THIRD, BEFORE)


def named_words(name: str, value: float, sd: float) -> str:
    """Return a parameter with its name, such as ``offset x +20.3 ± 0.1 mg``."""
    return f'{name.replace(".", " ")} {in_words(name, value, sd)}'


def of_parameters(comparison: Comparison, labels: Sequence[str]) -> Iterator[Drawing]:
    """Yield the difference of each parameter of each run, named by `labels`, from the mean."""
    for key, words, names in (('offsets', 'Zero-g offset', OFFSETS),
                              ('gains', 'Gain and cross-axis', (*GAINS, *CROSS))):
        found = [each for each in comparison.parameters if each.name in names]
        with drawn(HEIGHT_INCHES, f'{words} minus the mean of the runs', grid='y'
                   ) as (figure, (panel,)):
            hover = {}
            panel.axhline(0.0, color=FAINT, linewidth=1.2)
            factor = np.array([scale_of(each.name)[1] for each in found])
            for run, label in enumerate(labels):
                at = np.arange(len(found)) + 0.6 * ((run + 0.5) / len(labels) - 0.5)
                change = np.array([each.values[run] - np.mean(each.values) for each in found])
                band = BAND * np.array([each.stated_sd[run] for each in found])
                colour, name = _COLOURS[run % len(_COLOURS)], f'run{run}'
                panel.vlines(at, (change - band) * factor, (change + band) * factor, color=colour)
                panel.plot(at, change * factor, 'o', color=colour, gid=name, label=label, **EDGE)
                hover[name] = tuple(Mark(f'{label}, ' + named_words(
                    each.name, each.values[run], each.stated_sd[run])) for each in found)
            panel.set_xticks(range(len(found)), [each.name.partition('.')[2] for each in found])
            panel.set_ylabel(scale_of(found[0].name)[2])
            if len(labels) <= len(_COLOURS):
                legend_below(figure, 2)
        yield Drawing(key, f'{words}: difference of each run from the mean, with 95 % band',
                      figure, hover)


def of_history(history: History) -> Iterator[Drawing]:
    """Yield offset, gain and cross-axis over the dates, with bands."""
    at, dated = places_of([None if moment.when is None else moment.when.timestamp()
                           for moment in history.moments])
    warm = np.array([np.nan if moment.temperature is None else moment.temperature
                     for moment in history.moments])
    known = warm[np.isfinite(warm)]
    varied = len(known) > 1 and bool(np.ptp(known) > 0.5)  # °C; otherwise in one colour
    for key, words, names in GROUPS:
        found = [each for each in history.parameters if each.name in names and (
            names is not CROSS or np.any(each.stated_sd))]
        if not found:
            continue
        title, hover = f'{words} over the dates, with 95 % band', dict[str, Marks]()
        with drawn(0.9 + 1.25 * len(found), title, len(found), sharex=True) as (figure, panels):
            for k, (panel, each) in enumerate(zip(panels, found, strict=True)):
                zero, factor, unit = scale_of(each.name)
                values, band = (each.values - zero) * factor, BAND * each.stated_sd * factor
                add_band(panel, at, values - band, values + band, AFTER)
                panel.plot(at, values, color=FAINT, linewidth=1.2)
                panel.vlines(at, values - band, values + band, color=BEFORE, linewidth=1.0)
                panel.set_ylabel(f'{each.name.partition(".")[2]} [{unit}]')
                if varied:
                    markers = panel.scatter(
                        at, values, c=np.where(np.isfinite(warm), warm, np.mean(known)),
                        cmap=THERMAL, edgecolors=INK, linewidths=0.5, zorder=3,
                        vmin=np.min(known), vmax=np.max(known))
                else:
                    markers, = panel.plot(at, values, 'o', color=AFTER, markeredgecolor=PAPER)
                markers.set_gid(f'panel{k}')
                hover[f'panel{k}'] = tuple(Mark(
                    f'{label}, {named_words(each.name, value, sd)}'
                    + ('' if moment.temperature is None else f', {moment.temperature:.0f} °C'))
                    for label, moment, value, sd in zip(history.labels, history.moments,
                                                        each.values, each.stated_sd, strict=True))
            if varied:
                add_bar(figure, markers, panels, 'temperature [°C]', pad=0.02)
            label_dates(panels[-1], at, 'date of the fit', dated=dated)
        yield Drawing(f'history_{key}', title, figure, hover)


def places_of(stamps: Sequence[float | None]) -> tuple[Floats, bool]:
    """
    Return the place of each calibration, and whether it is a date.

    The places are days since 1970 if all of the stamps [s since 1970] are known and differ,
    otherwise numbers from 1.

    """
    days = np.array([np.nan if stamp is None else stamp / 86400.0 for stamp in stamps])
    dated = bool(np.all(np.isfinite(days))) and float(np.ptp(days)) > 0.0
    return (days if dated else np.arange(1.0, len(days) + 1.0)), dated


def label_dates(panel: Any, at: Floats, label: str, *, dated: bool) -> None:
    """Label the axis with dates of `label`, or with numbers of calibrations."""
    if not dated:
        panel.set_xticks(at, [f'{number:.0f}' for number in at])
        panel.set_xlabel('calibration')
        return
    from matplotlib import dates

    locator: Any = dates.AutoDateLocator(maxticks=6)  # type: ignore[no-untyped-call]
    panel.xaxis.set_major_locator(locator)
    panel.xaxis.set_major_formatter(
        dates.ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    panel.set_xlabel(label)


def comparison_page(comparison: Comparison, rating: Rating, sources: Sequence[Path],
                    calibrations: Sequence[Calibration]) -> str:
    """Return the page of a comparison of the calibrations in the files `sources`, as HTML."""
    labels = [f'{k} {source.name}' for k, source in enumerate(sources, 1)]
    sensor = next((f' of {each.sensor}' for each in calibrations if each.sensor), '')
    runs = [(label, each.date[:10], each.name, short(run.rms_mg), short(run.expected_mg),
             short(run.largest_mg), f'{run.p_value:.2g}')
            for label, each, run in zip(labels, calibrations, comparison.runs, strict=True)]
    return page('comparison', f'Comparison of {len(calibrations)} calibrations{sensor}',
                map(str, sources), rating, history=False, runs=runs,
                drawings=of_parameters(comparison, labels),
                parameters=list(parameter_rows(comparison)),
                notes=filter(None, (*comparison.notes, comparison.tilt_words)))


def parameter_rows(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """Yield name, mean, spread, stated deviation and their ratio of each fitted parameter."""
    for each in (one for one in comparison.parameters if np.any(one.stated_sd)):
        zero, factor, unit = scale_of(each.name)
        mean = with_minus(short((each.values.mean() - zero) * factor))
        yield (each.name.replace('.', ' '), f'{mean} {unit}', short(each.spread * factor),
               short(rms(each.stated_sd) * factor),
               '' if each.ratio is None else f'{each.ratio:.2f}')


def history_page(history: History, sources: Sequence[Path],
                 calibrations: Sequence[Calibration]) -> str:
    """Return the page of a history of the calibrations in the files `sources`, as HTML."""
    changes = [(first, second, f'{"agree" if change.comparison.agree else "differ"}, '
                f'{rate_comparison(change.comparison).name}', f'{change.comparison.p_value:.2g}',
                change_words(change.parameter, change.change, change.sd),
                short(change.comparison.runs[1].rms_mg))
               for first, second, change in zip(history.labels, history.labels[1:],
                                                history.changes, strict=False)]
    moments = []
    for k, (label, moment) in enumerate(zip(history.labels, history.moments, strict=True)):
        warm = '' if moment.temperature is None else f'{moment.temperature:.1f}'
        moments.append((str(k + 1), label, sources[moment.index].name, moment.model, warm,
                        short(moment.residual_mg), *(
                            in_words(each.name, each.values[k], each.stated_sd[k])
                            for each in history.parameters)))
    sensor = next((f' of {each.sensor}' for each in calibrations if each.sensor), '')
    names = [each.name.replace('.', ' ') for each in history.parameters]
    return page('comparison', f'History of {len(calibrations)} calibrations{sensor}',
                [f'{history.labels[0]} to {history.labels[-1]}'], rate_comparison(history.whole),
                history=True, drawings=of_history(history), changes=changes, runs=moments,
                names=names, notes=history.notes)
