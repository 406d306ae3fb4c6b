# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Findings: what is worth knowing about a result, and how much it matters; and the rating of it.

A finding is made where it is found, carried by the calibration, and stored with it. Its kind, its
level and its rows are data. Its text is for people, and no code reads it. What to do next is one
step of a known kind, which every surface shows with its own command. The rating is the worst level
of the findings.

"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, get_args, Literal

from .errors import RefusedFitError

Level = Literal['GOOD', 'USABLE', 'BAD']
LEVELS: tuple[Level, ...] = get_args(Level)
"""Levels, the best first: a note, less accurate than it could be, not fit for use."""

KINDS: Mapping[str, str] = MappingProxyType({
    'refused': 'the refined calibration must not be used',
    'wiring': 'known orientations show swapped axes, wrong signs or a rotation',
    'flat_pose': 'the flat pose is not near the expected axis',
    'error': 'the error is larger than a limit',
    'no_gain': 'the readings are as good without the calibration',
    'disagreement': 'calibrations of one sensor do not agree',
    'changed': 'the sensor has changed since the fit',
    'mounting': 'the mountings of calibrations differ',
    'edited': 'the file was edited by hand',
    'mounting_alone': 'offset and gain are not calibrated',
    'thermal_alone': 'the offset over temperature is known, but not the offset and the gain',
    'partial': 'the poses lie near one direction or in a plane',
    'outlier_not_certain': 'other poses may be wrong instead of those left out',
    'no_check': 'there are only as many poses as values',
    'held_out': 'orientations that the fit has not seen are wrong',
    'far_off': 'the model does not hold beside what it calls outliers',
    'too_exact': 'the readings are computed, not measured',
    'few_checks': 'few poses check the fit, and the noise is not known',
    'outliers': 'few poses check the fit without the outliers',
    'not_covered': 'a part of the sphere is far from all poses',
    'doubtful': 'the sensor may have moved during poses that are used',
    'beyond_noise': 'the residuals are larger than the noise explains',
    'below_noise': 'the residuals are far smaller than the noise that is stated',
    'settling': 'the readings changed with time, and may change again',
    'thermal_step': 'the readings of a still board jump',
    'not_corrected': 'an effect cannot be corrected in single samples',
    'omitted': 'a smaller model omits what the poses do not determine',
    'limited': 'readings end at the limit of the sensor',
    'not_taken': 'most rests of the recording are no poses',
    'new_orientations': 'the error in new orientations is larger than a limit',
    'far_from_poses': 'the error is large where there is no pose',
    'left_out': 'many poses were left out',
    'hardly_checked': 'a mistake in these poses would not show',
    'noise': 'the noise is too large to see an error of the size of the limit',
    'placement': 'the known orientations are less accurate than the readings',
    'heading': 'the heading of the mounting is arbitrary',
    'noise_not_known': 'the poses have no std and count',
    'uncertainty': 'the stated uncertainty is large in some directions',
    'undetermined': 'the poses do not determine the largest model',
    'missing': 'samples of the recording are missing',
    'signs': 'numbers of the log lost their sign',
    'clock': 'the order or the times of the rows are not those of the samples',
    'columns': 'what columns hold is decided by their values',
    'not_used': 'a column is not used, because of its cells or its values',
    'coarse': 'the steps of the thermometer leave a part of the residual',
    'copies': 'equal rows count as one pose',
    'unlike_fleet': 'the sensor is unlike the fleet',
    'unnamed': 'recordings of a fleet do not say of which sensor they are',
    'not_calibrated': 'recordings of a fleet have no usable calibration',
    'noisy': 'the white noise at rest is larger than that of common parts',
    'not_seen': 'a rest does not show all figures of the noise',
    'open': 'what poses near one direction or in a plane leave open',
    'correction_in_file': 'an edited file states another correction than its effects',
    'unusable': 'the stored calibration, or its files, cannot be used',
    'read_only': 'the files of the sensor cannot be written',
    'unsaved': 'the calibration in use is not stored',
    'switched_off': 'the correction is switched off',
    'outside': 'a quantity is outside of the range of the calibration',
    'mismatches': 'publishers and subscribers have another quality of service',
    'silence': 'a publisher sends no messages',
    'no_publisher': 'nobody publishes messages',
    'publishers': 'several publishers are on one topic',
    'stamps': 'the stamps of the messages are wrong',
    'unit': 'the readings are in another unit, or without gravity',
    'not_finite': 'messages with impossible readings are dropped',
    'foreign': 'messages of another sensor are dropped',
    'implausible': 'corrected messages with impossible values are dropped',
    'vibration': 'the sensor stays in one direction without a rest',
    'no_value': 'a column of the context does not arrive',
    'axes': 'the axes of the readings are probably swapped or inverted',
    'step': 'the next step of a calibration that is not done',
    'note': 'a note'})
"""Kinds of findings and their meaning, the most informative reason for a rating first."""

CAUSES = ('not_used', 'coarse')
"""Kinds that may be the cause of a residual that no effect explains."""

STEPS: Mapping[str, str] = MappingProxyType({
    'connect': 'no samples arrive: check the driver, its topic and the cable',
    'unit': 'the readings are in another unit than the stated one',
    'still': 'the sensor moves: hold it still',
    'poses': 'take poses, or take some of them again',
    'fit': 'fit the poses',
    'refine': 'look for the effect that the model lacks',
    'level': 'level the mounting by a pose with the robot level',
    'accept': 'use the offered calibration, or discard it',
    'save': 'store the calibration',
    'restart': 'start the node in another way, as the words say',
    'enable': 'switch the correction on',
    'verify': 'check the calibration with new poses',
    'record': 'record again, as the words say',
    'done': 'nothing more needs to be done'})
"""Kinds of next steps and their meaning, in the order of a calibration."""

_STEP_OF = {'flat_pose': 'level', 'mounting': 'level', 'changed': 'fit', 'edited': 'verify',
            **dict.fromkeys(('not_calibrated', 'unnamed', 'noisy', 'not_seen',
                             'thermal_step'), 'record'),
            'unusable': 'restart', 'read_only': 'save', 'unsaved': 'save',
            'switched_off': 'enable', 'unit': 'unit', 'vibration': 'still', 'step': '',
            **dict.fromkeys(('mismatches', 'silence', 'no_publisher', 'publishers', 'stamps',
                             'not_finite', 'foreign', 'implausible', 'no_value'), 'connect')}
"""Step by kind of finding; for other kinds, poses are to be taken."""

_RANKS = {kind: rank for rank, kind in enumerate(KINDS)}


@dataclass(frozen=True)
class NextStep:
    """
    What to do next.

    `kind` is one of `STEPS`, or empty while it is not known. `text` has no full stop, and `rows`
    may have the row of the suggested flat pose, 1-based. While messages arrive, `command` is the
    service that does it, and `direction` the one to point up, a unit vector in the sensor axes;
    empty: none.

    """

    kind: str
    text: str
    rows: tuple[int, ...] = ()
    command: str = ''
    direction: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.kind and self.kind not in STEPS:
            raise ValueError(f'step is {self.kind!r}, expected one of {", ".join(STEPS)}')


@dataclass(frozen=True)
class Finding:
    """
    What is worth knowing about a result.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    text : str
        What was found, without a full stop.
    advice : str
        What to do; may be empty.
    level : {'GOOD', 'USABLE', 'BAD'}
        The best rating that a result with this finding can have.
    rows : tuple of int
        Rows of the poses that it is about, 1-based.
    step : str
        Kind of the step that the advice is, one of `STEPS`; empty: that of the kind.
    about : str
        What it is about, such as a column, where several findings can have one kind.
    command, direction : str, tuple of float
        As in `NextStep`.

    """

    kind: str
    text: str
    advice: str = ''
    level: Level = 'GOOD'
    rows: tuple[int, ...] = ()
    step: str = ''
    about: str = ''
    command: str = ''
    direction: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS or self.level not in LEVELS:
            raise ValueError(f'finding is {self.kind!r} and {self.level!r}, expected one of '
                             f'{", ".join(KINDS)} and one of {", ".join(LEVELS)}')

    @property
    def next(self) -> NextStep:  # noqa: A003, the name in JSON
        return NextStep(self.step or _STEP_OF.get(self.kind, 'poses'), self.advice or self.text,
                        command=self.command, direction=self.direction)

    @property
    def stated(self) -> dict[str, Any]:
        """Return the finding as it is stored, and as it stands in JSON."""
        return {'kind': self.kind, 'text': self.text, 'advice': self.advice, 'level': self.level,
                'rows': list(self.rows)}

    @property
    def words(self) -> str:
        return '; '.join(filter(None, (self.text, self.advice)))


def without(findings: Iterable[Finding], *kinds: str) -> tuple[Finding, ...]:
    return tuple(each for each in findings if each.kind not in kinds)


def has(findings: Iterable[Finding], kind: str) -> bool:
    return any(each.kind == kind for each in findings)


@contextmanager
def explained_by(findings: Iterable[Finding]) -> Iterator[None]:
    """Let a refusal inside state the first finding that asks for another recording."""
    try:
        yield
    except RefusedFitError as err:
        found = next((each for each in findings if each.next.kind == 'record'), None)
        if found is None:
            raise
        raise RefusedFitError(f'{err.message}; {found.text}', found.advice) from None


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

    def __str__(self) -> str:
        return '\n'.join(self.lines)

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the rating as lines of text: the figures, the reason unless GOOD, and next."""
        reason = [] if self.name == 'GOOD' else [('reason', self.reason)]
        lines = [(self.name, self.figures), *reason, ('next', self.next.text)]
        width = max(len(label) for label, _ in lines)
        return tuple(f'{label:<{width}}  {text}' for label, text in lines)


def rated(findings: Iterable[Finding], good: str, figures: str, after: NextStep) -> Rating:
    """Return the rating with the most informative of the worst findings; `after` a good one."""
    ranks = tuple(sorted(findings, key=lambda each: (-LEVELS.index(each.level),
                                                     _RANKS[each.kind])))
    below = [each for each in ranks if each.level != 'GOOD']
    if not below:
        return Rating('GOOD', good, figures, after, ranks)
    step = next((each.next for each in below if each.advice), after)
    return Rating(below[0].level, below[0].text, figures, step, ranks)
