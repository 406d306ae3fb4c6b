# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The page: the whole story of a refinement as one HTML file, with nothing from outside."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from .drawings import Drawing, ladder, of_remainder, of_step
from .sheet import SHEET
from .style import inline_svg
from .words import base_words, chance, effect_words, short, values_of, verdict_words
from .. import __version__
from ..effects import EFFECTS
from ..files.atomic import write_atomically

if TYPE_CHECKING:
    from ..refine import Refinement, Step

_TITLE = 'What the calibration still lacks'
_HOW_TO_READ = (
    'The gap is the RMS of |corrected| − 1 g over the poses (of the vector error where the '
    'orientation is known or shared). The noise floor is what it would be were the model right.',
    'Held out: each pose judged by a fit of the others. Where it falls with the gap, the effect '
    'is in the sensor and not in the fit.',
    'p is the probability that noise alone makes one of all the candidates this good.',
    'Rivals are effects that these poses cannot tell from the one named.',
    'Maps are equal-area and seen from above each pole; what is drawn is the direction that '
    'points up, in the axes of the sensor. A hollow square is a pose that was left out.',
)


def write_page(path: Path, result: Refinement, source: str) -> None:
    """
    Write the page.

    Raises
    ------
    OSError
        If it cannot be written; a file that was there is then as it was.

    """
    text = page(result, source)
    write_atomically(path, lambda file: file.write(text))


def page(result: Refinement, source: str) -> str:
    """
    Give the page as text.

    Parameters
    ----------
    result : Refinement
        What to tell.
    source : str
        Where the poses come from.

    """
    title = f'{_TITLE}: {Path(source).name}'
    body = ''.join([*_head(result, source), *_steps(result), *_remainder(result), *_notes(result),
                    *_reading()])
    return ('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{escape(title)}</title>\n<style>{SHEET}</style>\n</head>\n'
            f'<body>\n<main>\n{body}</main>\n</body>\n</html>\n')


def _head(result: Refinement, source: str) -> Iterator[str]:
    """Tell the verdict and the ladder."""
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
    yield f'gap at the start ({base_words(result)})', f'{short(result.gap_mg)} mg'
    if result.steps:
        yield 'gap that remains', f'{short(result.remaining_gap_mg)} mg'
    floor = result.noise_floor_mg
    yield 'noise floor', 'not known' if floor is None else f'{short(floor)} mg'
    yield 'poses used', str(len(result.poses_g))
    yield 'left out', str(len(result.disturbed_poses))


def _overview(result: Refinement) -> str:
    """Give the table of steps."""
    head = ('step', 'effect', 'gap [mg]', 'held out [mg]', 'how sure', 'rivals')
    rows = [(str(number), step.effect, _fall(step.gap_before_mg, step.gap_after_mg),
             _fall(step.held_out_before_mg, step.held_out_after_mg), chance(step.p_value),
             ', '.join(step.rivals) or 'none') for number, step in enumerate(result.steps, 1)]
    return _table(head, rows, 'whole')


def _steps(result: Refinement) -> Iterator[str]:
    for number, step in enumerate(result.steps, 1):
        yield f'<section>\n<h2>{number}. {escape(effect_words(step.effect).capitalize())}</h2>\n'
        yield f'<p>{_story(step)}</p>\n'
        values = values_of(step)
        if values:
            yield _table([name for name, _ in values], [[value for _, value in values]],
                         'whole')
        yield _figures(of_step(result, number - 1), 'pair')
        yield '</section>\n'


def _story(step: Step) -> str:
    """Tell where the disagreement was and what the effect did to it."""
    term = f' ({escape(EFFECTS[step.effect].term)})' if step.effect in EFFECTS else ''
    rivals = f' These poses cannot tell it from {", ".join(map(_code, step.rivals))}.' if (
        step.rivals) else ''
    return (f'{_code(step.effect)}{term}. The disagreement sits {escape(step.where)}. With this '
            f'effect the gap goes from {short(step.gap_before_mg)} to '
            f'<strong>{short(step.gap_after_mg)} mg</strong>, and over poses held out from '
            f'{short(step.held_out_before_mg)} to {short(step.held_out_after_mg)} mg; '
            f'<span class="whole">{escape(chance(step.p_value))}</span>.{rivals}')


def _remainder(result: Refinement) -> Iterator[str]:
    yield '<section>\n<h2>What remains</h2>\n'
    yield _figures(of_remainder(result), 'pair')
    yield '</section>\n'


def _notes(result: Refinement) -> Iterator[str]:
    """Give what to do, what was left out and what could not be seen."""
    if result.advice:
        yield '<section>\n<h2>What to do</h2>\n'
        yield _list(result.advice)
        yield '</section>\n'
    if result.disturbed_poses:
        rows = ', '.join(str(row) for row in result.disturbed_poses)
        yield f'<section>\n<h2>Disturbed poses</h2>\n<p>Left out: rows {rows}.</p>\n</section>\n'
    if result.not_testable:
        yield '<section>\n<h2>What these data cannot show</h2>\n'
        yield _table(('effect', 'to see it, record'),
                     [(f'{effect_words(name)} ({name})', needs)
                      for name, needs in result.not_testable])
        yield '</section>\n'


def _reading() -> Iterator[str]:
    yield '<section class="reading">\n<h2>How to read this</h2>\n'
    yield _list(_HOW_TO_READ)
    yield '</section>\n'


def _figures(drawn: Iterable[Drawing], kind: str) -> str:
    parts = [f'<figure>{inline_svg(drawing.figure, drawing.name, escape(drawing.title))}</figure>'
             for drawing in drawn]
    return f'<div class="figures {kind}">\n' + '\n'.join(parts) + '\n</div>\n'


def _table(head: Iterable[str], rows: Iterable[Iterable[str]], kind: str = '') -> str:
    cells = ''.join(f'<th scope="col">{escape(name)}</th>' for name in head)
    lines = ''.join('<tr>' + ''.join(f'<td>{escape(value)}</td>' for value in row) + '</tr>\n'
                    for row in rows)
    return (f'<div class="scroll"><table class="{kind}">\n<thead><tr>{cells}</tr></thead>\n'
            f'<tbody>\n{lines}</tbody>\n</table></div>\n')


def _list(lines: Iterable[str]) -> str:
    return '<ul>\n' + ''.join(f'<li>{escape(line)}</li>\n' for line in lines) + '</ul>\n'


def _code(name: str) -> str:
    return f'<code>{escape(name)}</code>'


def _fall(before: float, after: float) -> str:
    return f'{short(before)} → {short(after)}'
