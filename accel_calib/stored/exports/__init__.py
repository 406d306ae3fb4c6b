# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Exports of a calibration to the places where it is used.

`FORMATS` is the list of formats and `export` makes the file of one of them. What a format does not
hold is measured (`made`) and returned with the file.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TextIO

from .c import identifier, make_arduino, make_c
from .flight import (
    ARDUPILOT_URL,
    BETAFLIGHT_URL,
    make_ardupilot,
    make_betaflight,
    make_px4,
    PX4_URL,
)
from .made import difference_mg, Loss, losses_of, Made, Options
from .tools import (
    IMU_CALIB_URL,
    IMUCAL_URL,
    KALIBR_URL,
    make_imu_calib,
    make_imucal,
    make_json,
    make_kalibr,
    make_npz,
    make_vins,
    Noise,
    read_noise,
    VINS_URL,
)
from ...calibrate import Calibration

__all__ = ['CALIBRATION_ALONE', 'FORMATS', 'Export', 'Exported', 'Loss', 'Noise', 'Options',
           'export', 'identifier', 'read_noise']


@dataclass(frozen=True)
class Export:
    """
    A format that a calibration can be exported to.

    Parameters
    ----------
    label : str
        Name of what reads the file.
    suffix : str
        End of the name of the file, after the name of the calibration.
    what : str
        Content in a few words.
    source : str
        Definition of the format; empty for formats of this package.
    make : callable
        Calibration, options -> file; with the noise if `needs_noise`.
    needs_noise : bool
        Whether the file contains the noise of the sensor, and no correction.

    """

    label: str
    suffix: str
    what: str
    source: str
    make: Callable[..., Made]
    needs_noise: bool = False


@dataclass(frozen=True)
class Exported:
    """
    The file of an export.

    Parameters
    ----------
    text_or_bytes : str or bytes
        Its content.
    suffix : str
        End of its name.
    losses : tuple of str
        What the format does not hold, with numbers; one line each.
    leaves_mg : float
        RMS difference to the full correction over the sphere, without the mounting [mg].
    details : tuple of Loss
        The losses by effect.
    notes : tuple of str
        What the user has to do.

    """

    text_or_bytes: str | bytes
    suffix: str
    losses: tuple[str, ...]
    leaves_mg: float
    details: tuple[Loss, ...] = field(default=(), repr=False)
    notes: tuple[str, ...] = ()

    @property
    def data(self) -> bytes:
        """Return the content as bytes."""
        content = self.text_or_bytes
        return content.encode() if isinstance(content, str) else content

    def write(self, file: TextIO) -> None:
        """Write the content to an open file."""
        file.buffer.write(self.data)


FORMATS: Mapping[str, Export] = MappingProxyType({
    'c': Export('C header', '.h', 'header in C99 and C++, single precision', '', make_c),
    'arduino': Export('Arduino header', '.h', 'header for an Arduino sketch', '',
                      make_arduino),
    'px4': Export('PX4', '_px4.params', 'parameter file of QGroundControl', PX4_URL, make_px4),
    'ardupilot': Export('ArduPilot', '_ardupilot.param',
                        'parameter file of Mission Planner and MAVProxy', ARDUPILOT_URL,
                        make_ardupilot),
    'betaflight': Export('Betaflight', '_betaflight.txt', 'commands for its command line',
                         BETAFLIGHT_URL, make_betaflight),
    'imu_calib': Export('imu_calib', '_imu_calib.yaml', 'YAML file of the ROS package',
                        IMU_CALIB_URL, make_imu_calib),
    'imucal': Export('imucal', '_imucal.json', 'FerrarisCalibrationInfo as JSON', IMUCAL_URL,
                     make_imucal),
    'kalibr': Export('Kalibr', '_imu.yaml', 'imu.yaml with the noise', KALIBR_URL, make_kalibr,
                     needs_noise=True),
    'vins': Export('VINS', '_vins.yaml', 'lines of the noise for its configuration', VINS_URL,
                   make_vins, needs_noise=True),
    'json': Export('JSON', '.json', 'all values', '', make_json),
    'npz': Export('NumPy', '.npz', 'all values as arrays', '', make_npz),
})
"""The formats by name."""

CALIBRATION_ALONE = tuple(name for name, each in FORMATS.items() if not each.needs_noise)
"""Formats that need nothing but the calibration."""


def export(calibration: Calibration, to: str, noise: Noise | None = None,
           options: Options = Options()) -> Exported:
    """
    Return the file of a calibration in another format.

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

    Returns
    -------
    Exported
        The file, and what it does not hold.

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

    def make(of: Calibration) -> Made:
        return chosen.make(of, options, *([noise] if chosen.needs_noise else []))

    made = make(calibration)
    losses = losses_of(calibration, chosen.label, make, made)
    return Exported(made.content, chosen.suffix, tuple(loss.words for loss in losses),
                    difference_mg(calibration, made), losses, made.notes)
