# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The rating of calibrations, refinements, verifications, comparisons, rests and fleets."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

from .expected import directions_in, Expected
from .limits import BAD_ERROR, CHANGED, COVERED, GOOD_ERROR, MATTERS, TILT
from .rules import degrees, findings_of, mg, number, step_after
from ..calibrate import Calibration, Verification
from ..finding import Finding, Level, NextStep, ranked
from ..geometry import coverage
from ..table import Poses
from ..text import counted
from ..units import MG

if TYPE_CHECKING:
    from ..compare import Comparison
    from ..noise import NoiseFigures
    from ..refine import Refinement


@dataclass(frozen=True)
class Rating:
    """
    A verdict about a result.

    Parameters
    ----------
    name : {'GOOD', 'USABLE', 'BAD'}
        The verdict, which is the worst level of the findings.
    reason : str
        Reason, as one sentence without a full stop.
    figures : str
        The figures of the result.
    next : NextStep
        What to do next.
    findings : tuple of Finding
        What is worth knowing, that which decides the verdict first.

    """

    name: Level
    reason: str
    figures: str
    next: NextStep  # noqa: A003, the name in JSON
    findings: tuple[Finding, ...] = ()

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the rating as lines of text: the figures, the reason unless GOOD, and next."""
        width = len('reason') if self.name != 'GOOD' else len('next')
        lines: list[tuple[str, str]] = [(self.name, self.figures)]
        if self.name != 'GOOD':
            lines.append(('reason', self.reason))
        lines.append(('next', self.next.text))
        return tuple(f'{label:<{width}}  {text}' for label, text in lines)


def _rated(findings: Iterable[Finding], good: str, figures: str, after: NextStep) -> Rating:
    """Return the rating with the most informative of the worst findings; `after` a good one."""
    ranks = ranked(findings)
    below = [each for each in ranks if each.level != 'GOOD']
    if not below:
        return Rating('GOOD', good, figures, after, ranks)
    steps = [each.next for each in below if each.advice]
    return Rating(below[0].level, below[0].text, figures, next(iter(steps), after), ranks)


def rate(calibration: Calibration, *, refinement: Refinement | None = None) -> Rating:
    """
    Rate a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    refinement : Refinement, optional
        A refinement of the same poses; its calibration, or the base, is rated.

    Returns
    -------
    Rating
        The verdict.

    """
    expected = Expected(calibration)
    good = (f'corrected readings in new orientations are right to {mg(expected.error_mg)} '
            f'({degrees(expected.error_mg)} of tilt)')
    return _rated(findings_of(expected, refinement), good, _figures(expected),
                  step_after(calibration))


def rate_refinement(result: Refinement) -> Rating:
    """Rate the calibration of a refinement."""
    return rate(result.calibration, refinement=result)


def _figures(expected: Expected) -> str:
    """Return the figures of a calibration in one line."""
    quality = expected.quality
    parts = [f'{number(quality.rms_before_mg)} -> {mg(quality.rms_after_mg)}']
    if quality.held_out_rms_mg is not None and not expected.is_partial:
        parts.append(f'of new poses {mg(quality.held_out_rms_mg)}')
    noise = quality.noise_floor_mg
    parts.append('noise not known' if noise is None else f'noise {mg(noise)}')
    parts += [counted(len(expected.poses), 'pose'),
              f'{100.0 * quality.coverage:.0f} % of the sphere']
    return ', '.join(parts)


def rate_verification(verification: Verification, calibration: Calibration,
                      poses: Poses | None = None) -> Rating:
    """
    Rate a calibration by poses that it was not fitted to.

    Parameters
    ----------
    verification : Verification
        Its residuals on these poses.
    calibration : Calibration
        The calibration.
    poses : Poses, optional
        These poses. If they cover only a part of the sphere, the rating is not better than that
        of the calibration itself.

    Returns
    -------
    Rating
        The verdict.

    """
    expected, floor = Expected(calibration), verification.noise_floor_mg
    own = rate(calibration)
    error = _without_noise(verification.rms_after_mg, floor)
    found = [*_on_new_poses(verification, expected, own, error)]
    covered = 1.0 if poses is None else coverage(directions_in(poses, calibration))
    if expected.is_partial or covered < COVERED.value / 100.0:
        found += own.findings
    noise = 'noise not known' if floor is None else f'noise {mg(floor)}'
    figures = (f'{number(verification.rms_before_mg)} -> {mg(verification.rms_after_mg)}, '
               f'largest {mg(verification.max_after_percent * MG / 100.0)}, {noise}')
    if poses is not None:
        figures += f', {counted(len(poses), "pose")}, {100.0 * covered:.0f} % of the sphere'
    good = f'the error of these poses is {mg(error)} ({degrees(error)} of tilt)'
    return _rated(found, good, figures, step_after(calibration))


def _on_new_poses(verification: Verification, expected: Expected, own: Rating, error: float
                  ) -> Iterator[Finding]:
    """Yield the findings that a verification shows."""
    floor, again = verification.noise_floor_mg, 'fit again with these poses'
    native = expected.calibration.units.is_native
    before = _without_noise(verification.rms_before_mg, floor)
    if error > BAD_ERROR.value:
        yield Finding('error', f'the error of these poses is {mg(error)}, expected at most '
                      f'{mg(BAD_ERROR.value)}', again, 'BAD', step='fit')
    elif not native and error > max(before, floor or 0.0):
        yield Finding('no_gain', f'the error of these poses is {mg(error)}, and {mg(before)} '
                      'without the calibration', again,
                      'BAD' if error > MATTERS.value else 'USABLE', step='fit')
    stated = expected.error_mg
    changed = error > max(CHANGED.value * stated, MATTERS.value)
    if changed and own.name == 'GOOD':
        yield Finding('changed', f'the error of these poses is {mg(error)}, and the fit states '
                      f'{mg(stated)}: the sensor has changed', again, 'USABLE')
    elif error > GOOD_ERROR.value:
        yield Finding('error', f'the error of these poses is {mg(error)}, expected at most '
                      f'{mg(GOOD_ERROR.value)}', again, 'USABLE', step='fit')
    if floor is not None and floor > GOOD_ERROR.value:
        yield Finding('noise', f'the noise of these poses is {mg(floor)}, too large to see an '
                      f'error of {mg(GOOD_ERROR.value)}', 'hold the sensor longer in each pose',
                      'USABLE')


def rate_comparison(comparison: Comparison) -> Rating:
    """
    Rate the agreement of calibrations of one sensor.

    Parameters
    ----------
    comparison : Comparison
        The comparison.

    Returns
    -------
    Rating
        GOOD if they agree, USABLE if the differences are small, otherwise BAD.

    """
    largest = max(comparison.runs, key=lambda run: run.rms_mg)
    figures = (f'{counted(len(comparison.runs), "calibration")}, difference '
               f'{mg(largest.rms_mg)}, up to {mg(max(r.largest_mg for r in comparison.runs))}, '
               f'expected {mg(largest.expected_mg)}, p = {comparison.p_value:.1g}')
    found = []
    which = ('' if comparison.outlier is None
             else f'; run {comparison.outlier + 1} differs from the others')
    if not comparison.agree:
        large = largest.rms_mg > GOOD_ERROR.value
        found.append(Finding(
            'disagreement', f'the calibrations differ by {mg(largest.rms_mg)}, which noise does '
            f'not explain{which}', 'use the latest calibration, or take the poses again'
            if large else 'use the latest calibration', 'BAD' if large else 'USABLE',
            step='poses' if large else 'done'))
    elif largest.expected_mg > GOOD_ERROR.value:
        found.append(Finding('noise', 'the uncertainty of the differences is '
                             f'{mg(largest.expected_mg)}, too large to see a change of '
                             f'{mg(GOOD_ERROR.value)}', 'fit them with more poses', 'USABLE'))
    tilt = comparison.tilt_deg
    if tilt is not None and tilt > TILT.value:
        found.append(Finding('mounting', f'the mountings differ by {tilt:.1f}°',
                             'check that the level ground is level, and that the sensor was not '
                             'mounted again', 'USABLE'))
    return _rated(found, 'the calibrations agree within their uncertainties', figures,
                  NextStep('done', 'use the latest calibration'))


_NOISY = 2.0
"""White noise in units of the largest typical one that is worth a finding."""


def rate_noise(found: NoiseFigures) -> Rating:
    """
    Rate the figures of a rest.

    Returns
    -------
    Rating
        GOOD if it shows white noise and random walk of every axis, USABLE if one of them is not
        seen or the noise is larger than that of common parts, BAD without white noise.

    """
    from ..noise import duration, shown_unit, TYPICAL, WORDS  # a fit alone does not load it

    findings, shown = list[Finding](), [f'rest of {duration(found.seconds)}']
    for kind in found.kinds:
        axes, density = found.of(kind), found.common(kind, 'noise_density')[0]
        unit, scale = shown_unit(kind, 'noise_density', axes[0].unit)
        if math.isfinite(density):
            shown.append(f'{kind} {density * scale:.3g} {unit}')
        unseen = [name for name in ('noise_density', 'random_walk') if (kind, name) in found.needs]
        findings += [Finding(
            'not_seen', f'the rest does not show the {WORDS[name]} of the {kind} on all axes',
            found.needs[kind, name], 'BAD' if name == 'noise_density' else 'USABLE')
            for name in unseen[:1]]
        limits = TYPICAL.get((kind, 'noise_density', axes[0].unit))
        if limits and density > _NOISY * limits[1]:
            findings.append(Finding(
                'noisy', f'the white noise of the {kind} is {density / limits[1]:.1f} times that '
                'of noisy common parts', 'keep vibration and fans away, and record again',
                'USABLE'))
    return _rated(findings, 'the rest shows all figures', ', '.join(shown),
                  NextStep('done', 'use the figures'))


def rate_fleet(counts: Mapping[str, int], sensors: int, changed: int, unnamed: int) -> Rating:
    """
    Rate the calibrations of a fleet.

    Parameters
    ----------
    counts : mapping of str to int
        Recordings by rating, or by status without a rating.
    sensors, changed : int
        Number of sensors, and of those whose calibrations do not agree.
    unnamed : int
        Number of recordings without a name of their sensor.

    Returns
    -------
    Rating
        GOOD if every recording has a usable calibration and no sensor changed, BAD if none has.

    """
    total, usable = sum(counts.values()), counts.get('GOOD', 0) + counts.get('USABLE', 0)
    figures = (f'{counted(total, "recording")} of {counted(sensors, "sensor")}: '
               f'{", ".join(f"{count} {name}" for name, count in sorted(counts.items()))}')
    found = []
    if usable < total:
        found.append(Finding(
            'not_calibrated', f'{total - usable} of {counted(total, "recording")} have no usable '
            'calibration', 'see their errors, and record them again',
            'USABLE' if usable else 'BAD'))
    if changed:
        found.append(Finding('changed', f'{counted(changed, "sensor")} changed',
                             'use the latest calibrations of these', 'USABLE', step='done'))
    if unnamed > 1:
        found.append(Finding(
            'unnamed', f'{unnamed} recordings do not state their sensor, and count as one sensor',
            'take the names of the sensors from the paths with --sensor-from REGEX', 'USABLE'))
    return _rated(found, 'each recording has a usable calibration', figures,
                  NextStep('done', 'use the calibrations'))


def _without_noise(residual_mg: float, noise_mg: float | None) -> float:
    return math.sqrt(max(residual_mg ** 2 - (noise_mg or 0.0) ** 2, 0.0))
