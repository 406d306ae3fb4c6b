# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The pages of one calibration: of `fit`, `calibrate`, `verify` and `refine`.

All begin with the verdict and the calibration. Sections about effects follow where some were
sections.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import sections
from .residuals import Residuals, residuals_of
from .sheet import heading, listing, section, sheet
from .. import __version__
from ..disk import write_atomically
from ..findings import rate_refinement
from ..refine.words import verdict_words

if TYPE_CHECKING:
    from ..calibrate import Calibration, Verification
    from ..findings import Rating
    from ..refine import Refinement
    from ..table import Poses

STORED = 'calibration.yaml'
"""Name of the file of the calibration in the lines that use it, if it is not known."""

_HOW_TO_READ = (
    'The residual is the RMS of |corrected| − 1 g over the poses, or of the vector error if the '
    'orientation is known or shared. The noise floor is the expected residual of a correct model.',
    'Of new poses (held out): each pose is predicted from a fit of the others.',
    'Maps have equal areas and show each hemisphere from above its pole: the direction of up in '
    'the sensor axes. A hollow square is a pose that was left out.',
)
_HOW_TO_READ_STEPS = (
    'If the held-out residual decreases together with the residual, the effect is in the sensor '
    'and not an artefact of the fit.',
    'p is the probability that noise alone makes one of all candidates this good.',
    'Rivals are effects that these poses cannot distinguish from the named effect.',
)


def write_page(path: Path, result: Refinement, source: str) -> None:
    """
    Write the page of a refinement.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    text = page(result, source)
    write_atomically(path, lambda file: file.write(text))


def page(result: Refinement, source: str) -> str:
    """
    Return the page of a refinement as HTML.

    Parameters
    ----------
    result : Refinement
        The refinement.
    source : str
        Name of the file of the poses.

    """
    return calibration_page(result.calibration, rate_refinement(result), source,
                            refinement=result)


def write_calibration_page(path: Path, calibration: Calibration, rating: Rating, source: str, *,
                           refinement: Refinement | None = None,
                           verification: tuple[Verification, Poses] | None = None,
                           stored: str = STORED, notes: Sequence[str] = ()) -> None:
    """
    Write the page of a calibration; the parameters are those of `calibration_page`.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    text = calibration_page(calibration, rating, source, refinement=refinement,
                            verification=verification, stored=stored, notes=notes)
    write_atomically(path, lambda file: file.write(text))


def calibration_page(calibration: Calibration, rating: Rating, source: str, *,
                     refinement: Refinement | None = None,
                     verification: tuple[Verification, Poses] | None = None,
                     stored: str = STORED, notes: Sequence[str] = ()) -> str:
    """
    Return the page of a calibration as HTML.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    rating : Rating
        The verdict.
    source : str
        Name of the file of the poses.
    refinement : Refinement, optional
        Search for effects on the same poses.
    verification : (Verification, Poses), optional
        Residuals on other poses, and these poses in the unit of the calibration.
    stored : str
        File of the calibration, for the lines that use it.
    notes : sequence of str
        How the log was read.

    """
    poses = None if verification is None else verification[1]
    used = refinement if _is_refined(calibration, refinement) else None
    residuals = residuals_of(calibration, poses)
    what = 'Calibration' if verification is None else 'Check of the calibration'
    name = calibration.sensor or Path(source).name
    title = f'{what} of {name}' if name else what
    about = [source, f'sensor {calibration.sensor}' if calibration.sensor else '',
             f'fitted {calibration.date}' if calibration.date else '',
             f'accel_calib {__version__}']
    more = '' if used is None else verdict_words(used)
    body = [heading(title, about), sections.verdict_box(rating, more),
            *_body(calibration, residuals, refinement, verification, stored),
            section('How the log was read', listing(notes)),
            _how_to_read(steps=refinement is not None)]
    return sheet(f'{rating.name.capitalize()}: {title[0].lower()}{title[1:]}', body)


def _is_refined(calibration: Calibration, refinement: Refinement | None) -> bool:
    """Return whether a calibration is that of a refinement, perhaps levelled since."""
    if refinement is None:
        return False
    own, refined = calibration.model.values, refinement.calibration.model.values
    return own.keys() == refined.keys() and all(
        np.array_equal(own[name], refined[name]) for name in own)


def _body(calibration: Calibration, residuals: Residuals, refinement: Refinement | None,
          verification: tuple[Verification, Poses] | None, stored: str) -> Iterator[str]:
    """Yield the sections after the verdict."""
    checked = None if verification is None else verification[0]
    floor_mg = (calibration.quality if checked is None else checked).noise_floor_mg
    refined = _is_refined(calibration, refinement)
    refusal = sections.refusal(refinement) if refinement is not None and refined else ()
    advice = refinement.advice if refinement is not None and refined else ()
    yield sections.key_numbers(calibration, residuals, checked)
    yield sections.values(calibration)
    yield sections.covered(calibration, residuals, plan=refinement is None and checked is None)
    yield sections.before_after(residuals, floor_mg)
    yield sections.warnings((*refusal, *calibration.warnings), residuals, advice)
    yield sections.remainder(residuals)
    if refinement is not None:
        yield from sections.steps(refinement, used=refined)
        yield sections.refined_remainder(refinement, residuals)
        yield sections.not_testable(refinement)
    yield sections.poses(residuals, calibration)
    if not refusal:
        yield sections.use(calibration, stored)


def _how_to_read(*, steps: bool) -> str:
    lines = (*_HOW_TO_READ, *(_HOW_TO_READ_STEPS if steps else ()))
    return section('How to read this', listing(lines), kind='reading')
