# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Exports of a calibration to the places where it is used.

`FORMATS` is the list of formats and `export` makes the file of one of them. What a format does not
hold is measured (`made`) and returned with the file.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TextIO

from . import c, flight, tools
from .c import identifier
from .made import difference_mg, Format, Loss, losses_of, Made, Options
from .tools import Noise, read_noise
from ...calibrate import Calibration

__all__ = ['CALIBRATION_ALONE', 'FORMATS', 'Exported', 'Format', 'Loss', 'Noise', 'Options',
           'export', 'identifier', 'read_noise']

FORMATS: Mapping[str, Format] = MappingProxyType({
    **c.FORMATS, **flight.FORMATS, **tools.FORMATS})
"""The formats by name."""

CALIBRATION_ALONE = tuple(name for name, each in FORMATS.items() if each.needs != 'noise')
"""Formats that need nothing but the calibration."""


@dataclass(frozen=True)
class Exported:
    """
    The file of an export, and the end of its name.

    `leaves_mg` is the RMS difference to the full correction over the sphere, without the mounting
    [mg], `details` what the format does not hold, by effect, and `notes` what the user has to do.

    """

    text_or_bytes: str | bytes
    suffix: str
    leaves_mg: float
    details: tuple[Loss, ...] = field(default=(), repr=False)
    notes: tuple[str, ...] = ()

    @property
    def losses(self) -> tuple[str, ...]:
        """Return what the format does not hold, with numbers; one line each."""
        return tuple(loss.words for loss in self.details)

    @property
    def data(self) -> bytes:
        """Return the content as bytes."""
        content = self.text_or_bytes
        return content.encode() if isinstance(content, str) else content

    def write(self, file: TextIO) -> None:
        """Write the content to an open file."""
        file.buffer.write(self.data)


def export(calibration: Calibration, to: str, noise: Noise | None = None,
           options: Options = Options()) -> Exported:
    """
    Return the file of a calibration in another format, and what it does not hold.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    to : str
        One of `FORMATS`.
    noise : mapping, optional
        Noise of the sensor (`read_noise`), for ``kalibr`` and ``vins``.
    options : Options
        Choices that some formats have.

    Raises
    ------
    InputError
        If the format cannot hold the calibration at all, or needs what is not given.
    ValueError
        If there is no such format.

    """
    if to not in FORMATS:
        raise ValueError(f'format is {to!r}, expected one of {", ".join(FORMATS)}')
    chosen = FORMATS[to]
    beside = {'': (), 'options': (options,), 'noise': (noise,)}[chosen.needs]

    def make(of: Calibration) -> Made:
        return chosen.make(of, *beside)

    made = make(calibration)
    return Exported(made.content, chosen.suffix, difference_mg(calibration, made),
                    losses_of(calibration, chosen.label, make, made), made.notes)
