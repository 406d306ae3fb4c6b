# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Findings: what is worth knowing about a result, and how much it matters.

A finding is made where it is found, carried by the calibration, and stored with it. Its kind, its
level and its rows are data. Its text is for people, and no code reads it.

"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import get_args, Literal

Level = Literal['GOOD', 'USABLE', 'BAD']
LEVELS: tuple[Level, ...] = get_args(Level)
"""Levels, the best first: a note, less accurate than it could be, not fit for use."""

KINDS = (
    'refused', 'wiring', 'flat_pose', 'error', 'no_gain', 'disagreement', 'changed', 'mounting',
    'edited', 'mounting_alone', 'partial', 'outlier_not_certain', 'no_check', 'few_checks',
    'outliers', 'not_covered', 'doubtful', 'beyond_noise', 'settling', 'not_corrected', 'omitted',
    'new_orientations', 'far_from_poses', 'left_out', 'hardly_checked', 'noise', 'placement',
    'heading', 'uncovered', 'noise_not_known', 'residuals', 'uncertainty', 'undetermined',
    'copies', 'unlike_fleet', 'open', 'correction_in_file', 'note')
"""Kinds of findings, the most informative reason for a rating first."""


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

    """

    kind: str
    text: str
    advice: str = ''
    level: Level = 'GOOD'
    rows: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS or self.level not in LEVELS:
            raise ValueError(f'finding is {self.kind!r} and {self.level!r}, expected one of '
                             f'{KINDS} and one of {LEVELS}')

    @property
    def words(self) -> str:
        """Return text and advice in one line."""
        return '; '.join(filter(None, (self.text, self.advice)))


def without(findings: Iterable[Finding], *kinds: str) -> tuple[Finding, ...]:
    """Return the findings of other kinds."""
    return tuple(each for each in findings if each.kind not in kinds)


def has(findings: Iterable[Finding], kind: str) -> bool:
    """Return whether there is a finding of a kind."""
    return any(each.kind == kind for each in findings)


def ranked(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings of the worst level first, and within a level in the order of `KINDS`."""
    return tuple(sorted(findings, key=lambda each: (-LEVELS.index(each.level),
                                                    KINDS.index(each.kind))))
