# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The report of a refinement: one self-contained HTML page.

**Style sheet.** The style sheet of the report, for desktops, phones and paper.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from .drawings import Drawing, ladder, of_curve, of_remainder, of_step
from .style import inline_svg
from .. import __version__
from ..effects import effect_named
from ..errors import listed
from ..files.atomic import write_atomically
from ..html_table import table
from ..refine.plan_words import percent
from ..words import base_words, chance, short, values_of, verdict_words

if TYPE_CHECKING:
    from ..refine import Refinement, Step

SHEET = """
html { font: 17px/1.5 "DejaVu Sans", Verdana, "Segoe UI", sans-serif; color: #222;
  background: #fff; }
body { margin: 0; }
main { max-width: 980px; margin: 0 auto; padding: 1.2rem 1rem 3rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: .4rem 0 0; }
h2 { font-size: 1.2rem; line-height: 1.3; margin: 0 0 .4rem; }
p, ul { margin: .5rem 0 .8rem; max-width: 46rem; }
ul { padding-left: 1.2rem; }
li { margin: .25rem 0; }
code { font: .92em "DejaVu Sans Mono", Consolas, monospace; background: #f2f2f2;
  padding: .05em .25em; border-radius: 3px; overflow-wrap: anywhere; }
section { border-top: 1px solid #ddd; margin-top: 1.8rem; padding-top: 1.2rem; }
.about { color: #666; font-size: .85rem; overflow-wrap: anywhere; }
.verdict { font-size: 1.1rem; font-weight: bold; border-left: 6px solid #0072b2;
  background: #eef5fa; padding: .6rem .9rem; max-width: none; }
.verdict.unexplained { border-color: #d55e00; background: #fdf2ea; }
.verdict.described { border-color: #e69f00; background: #fdf6e8; }
.verdict.no_gap { border-color: #009e73; background: #ebf7f3; }
.numbers { display: flex; flex-wrap: wrap; gap: .6rem 2.2rem; margin: 1rem 0; }
.numbers dt { color: #666; font-size: .8rem; }
.numbers dd { margin: 0; font-size: 1.35rem; }
.figures { display: grid; gap: .8rem 1.2rem; margin: 1rem 0; }
.figures.pair { grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); }
figure { margin: 0; break-inside: avoid; }
figure svg { display: block; width: 100%; height: auto; }
.wide figure { max-width: 640px; }
.whole { white-space: nowrap; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; margin: .6rem 0; }
th { text-align: left; color: #666; font-weight: normal; border-bottom: 2px solid #ddd; }
td { border-bottom: 1px solid #eee; }
th, td { padding: .3rem 1.1rem .3rem 0; vertical-align: top; }
.reading { color: #444; font-size: .9rem; }
@media (max-width: 600px) { html { font-size: 16px; } h1 { font-size: 1.4rem; }
  table { font-size: .8rem; } th, td { padding-right: .7rem; } }
@media print { html { font-size: 11pt; } main { max-width: none; padding: 0; }
  section { break-inside: avoid-page; } .figures.pair { grid-template-columns: 1fr 1fr; } }
"""


_TITLE = 'What the calibration lacks'
_HOW_TO_READ = (
    'The residual is the RMS of |corrected| − 1 g over the poses, or of the vector error if the '
    'orientation is known or shared. The noise floor is the expected residual of a correct model.',
    'Held out: each pose is predicted from a fit of the others. If the held-out residual '
    'decreases, too, the effect is in the sensor and not an artefact of the fit.',
    'p is the probability that noise alone makes one of all candidates this good.',
    'Rivals are effects that these poses cannot distinguish from the named effect.',
    'Maps have equal areas and show each hemisphere from above its pole: the direction of up in '
    'the sensor axes. A hollow square is a pose that was left out.',
)


def write_page(path: Path, result: Refinement, source: str) -> None:
    """
    Write the report.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    text = page(result, source)
    write_atomically(path, lambda file: file.write(text))


def page(result: Refinement, source: str) -> str:
    """
    Return the report as HTML.

    Parameters
    ----------
    result : Refinement
        The refinement.
    source : str
        Name of the file of the poses.

    """
    title = f'{_TITLE}: {Path(source).name}'
    body = ''.join([*_head(result, source), *_steps(result), *_remainder(result), *_notes(result),
                    *_how_to_read()])
    return ('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{escape(title)}</title>\n<style>{SHEET}</style>\n</head>\n'
            f'<body>\n<main>\n{body}</main>\n</body>\n</html>\n')


def _head(result: Refinement, source: str) -> Iterator[str]:
    """Yield title, verdict and the figure of all steps."""
    calibration = result.calibration
    about = [source, f'sensor {calibration.sensor}' if calibration.sensor else '',
             calibration.date, f'accel_calib {__version__}']
    yield f'<h1>{_TITLE}</h1>\n'
    yield f'<p class="about">{escape(" · ".join(part for part in about if part))}</p>\n'
    yield f'<p class="verdict {result.verdict}">{escape(verdict_words(result))}</p>\n'
    yield '<dl class="numbers">'
    for name, value in _numbers(result):
        yield f'<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>'
    yield '</dl>\n'
    yield _figures([ladder(result)], 'wide')
    if result.steps:
        yield _overview(result)


def _numbers(result: Refinement) -> Iterator[tuple[str, str]]:
    yield f'residual of the base ({base_words(result)})', f'{short(result.gap_mg)} mg'
    if result.steps:
        yield 'remaining residual', f'{short(result.remaining_gap_mg)} mg'
    floor = result.noise_floor_mg
    yield 'noise floor', 'not known' if floor is None else f'{short(floor)} mg'
    yield 'poses used', str(len(result.poses_g))
    yield 'poses left out', str(len(result.disturbed_poses))


def _overview(result: Refinement) -> str:
    """Return the table of steps."""
    head = ('step', 'effect', 'residual [mg]', 'held out [mg]', 'chance', 'rivals')
    rows = [(str(number), step.effect, _fall(step.gap_before_mg, step.gap_after_mg),
             _fall(step.held_out_before_mg, step.held_out_after_mg), chance(step.p_value),
             ', '.join(step.likely_rivals) or 'none')
            for number, step in enumerate(result.steps, 1)]
    return _table(head, rows, 'whole')


def _steps(result: Refinement) -> Iterator[str]:
    for number, step in enumerate(result.steps, 1):
        title = escape(effect_named(step.name).words.capitalize())
        yield f'<section>\n<h2>{number}. {title}</h2>\n'
        yield f'<p>{_story(step)}</p>\n'
        values = values_of(step)
        if values:
            yield _table([name for name, _ in values], [[value for _, value in values]],
                         'whole')
        yield _figures(of_step(result, number - 1), 'pair')
        if step.curve:
            yield _figures([of_curve(result, number - 1)], 'wide')
        yield '</section>\n'


def _story(step: Step) -> str:
    """Return a text about the location of the disagreement, and the effect on the residual."""
    rivals = f' These poses cannot distinguish it from {_rivals(step)}.' if (
        step.rivals) else ''
    return (f'{_code(step.effect)} ({escape(effect_named(step.name).term)}). Found '
            f'{escape(step.where)}. With this effect the residual decreases from '
            f'{short(step.gap_before_mg)} to <strong>{short(step.gap_after_mg)} mg</strong>, '
            f'and the held-out residual from {short(step.held_out_before_mg)} to '
            f'{short(step.held_out_after_mg)} mg; '
            f'<span class="whole">{escape(chance(step.p_value))}</span>.{rivals}')


def _rivals(step: Step) -> str:
    """Return the rivals of a step with their probabilities."""
    return ', '.join(f'{_code(name)} ({percent(step.probabilities[name])})'
                     for name in step.rivals)


def _remainder(result: Refinement) -> Iterator[str]:
    yield '<section>\n<h2>What remains</h2>\n'
    yield _figures(of_remainder(result), 'pair')
    yield '</section>\n'


def _notes(result: Refinement) -> Iterator[str]:
    """Yield warnings, advice, the poses left out and the effects that could not be tested."""
    if result.refusal or result.calibration.warnings:
        yield '<section>\n<h2>Warnings</h2>\n'
        yield _list([*_refusal(result), *result.calibration.warnings])
        yield '</section>\n'
    if result.advice:
        yield '<section>\n<h2>What to do</h2>\n'
        yield _list(result.advice)
        yield '</section>\n'
    if result.disturbed_poses:
        rows = listed('row', result.disturbed_poses)
        yield f'<section>\n<h2>Poses left out</h2>\n<p>Left out: {rows}.</p>\n</section>\n'
    if result.not_testable:
        yield '<section>\n<h2>What these data cannot show</h2>\n'
        yield _table(('effect', 'to see it, record'),
                     [(f'{effect_named(name).words} ({name})', needs)
                      for name, needs in result.not_testable])
        yield '</section>\n'


def _refusal(result: Refinement) -> list[str]:
    """Return the reason why the calibration must not be used, if there is one."""
    if not result.refusal:
        return []
    found, advice = result.refusal
    return [f'the refined calibration must not be used: {found}; {advice}']


def _how_to_read() -> Iterator[str]:
    yield '<section class="reading">\n<h2>How to read this</h2>\n'
    yield _list(_HOW_TO_READ)
    yield '</section>\n'


def _figures(drawn: Iterable[Drawing], kind: str) -> str:
    parts = [f'<figure>{inline_svg(drawing.figure, drawing.name, escape(drawing.title))}</figure>'
             for drawing in drawn]
    return f'<div class="figures {kind}">\n' + '\n'.join(parts) + '\n</div>\n'


def _table(head: Iterable[str], rows: Iterable[Iterable[str]], kind: str = '') -> str:
    return f'<div class="scroll">{table(head, rows, kind)}</div>\n'


def _list(lines: Iterable[str]) -> str:
    return '<ul>\n' + ''.join(f'<li>{escape(line)}</li>\n' for line in lines) + '</ul>\n'


def _code(name: str) -> str:
    return f'<code>{escape(name)}</code>'


def _fall(before: float, after: float) -> str:
    return f'{short(before)} → {short(after)}'
