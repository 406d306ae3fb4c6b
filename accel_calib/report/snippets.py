# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Lines of code that use a calibration: ROS 2, Python and C."""

from __future__ import annotations

from pathlib import Path
import shlex

from ..calibrate import Calibration
from ..effects import effect_named
from ..table import COLUMNS, Floats


def snippets(calibration: Calibration, stored: str) -> tuple[tuple[str, str], ...]:
    """
    Return titles and lines of code that use a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    stored : str
        File of the calibration.

    """
    return (('ROS 2', _ros(calibration, stored)), ('ROS 2 launch file', _launch(calibration,
                                                                                stored)),
            ('Python', _python(calibration, stored)), ('C', _c(calibration)),
            ('C header, Arduino, PX4, ArduPilot and others',
             f'accel-calib export {shlex.quote(stored)} --to c -o calibration.h'))


def _ros(calibration: Calibration, stored: str) -> str:
    path = shlex.quote(stored) if Path(stored).is_absolute() else f'"$PWD"/{shlex.quote(stored)}'
    return ('ros2 launch accel_calib calibrator.launch.py imu:=imu/data_raw \\\n'
            f'  units:={calibration.units.name} calibration_file:={path}')


def _launch(calibration: Calibration, stored: str) -> str:
    return ("Node(package='accel_calib', executable='calibrator',\n"
            f"     parameters=[{{'calibration_file': {stored!r},\n"
            f"                  'units': {calibration.units.name!r}}}],\n"
            "     remappings=[('imu/data_raw', 'imu/data_raw')])")


def _python(calibration: Calibration, stored: str) -> str:
    known = ''.join(f', {key}={key}' for key in calibration.model.needs if key in COLUMNS
                    and key in ('time', 'temperature', 'supply_voltage', 'rate'))
    unit = {'m/s2': 'm/s²', 'g': 'g', 'native': 'native units'}[calibration.units.name]
    force = 'g' if calibration.units.name == 'native' else unit
    return ('import accel_calib as ac\n\n'
            f'calibration = ac.load({stored!r})\n'
            f'force = calibration.apply(readings{known})  # (n, 3), {unit} -> {force}')


def _c(calibration: Calibration) -> str:
    """Return a C99 function with offset, gain and mounting."""
    mat = calibration.rotation.T @ calibration.matrix
    rows = ',\n'.join(f'  {{{_floats(row)}}}' for row in mat)
    beyond = [name for name in calibration.model.effects if not effect_named(name).linear]
    note = '' if not beyond else (
        f'/* Without {", ".join(beyond)}:\n'
        '   accel-calib export --to c writes the terms that C can hold. */\n')
    return (f'{note}static const float B[3] = {{{_floats(calibration.offset)}}};\n'
            f'static const float M[3][3] = {{\n{rows}}};\n\n'
            'static void accel_correct(const float raw[3], float a[3])\n{\n'
            '  for (int i = 0; i < 3; ++i)\n'
            '    a[i] = M[i][0] * (raw[0] - B[0]) + M[i][1] * (raw[1] - B[1])\n'
            '         + M[i][2] * (raw[2] - B[2]);\n}')


def _floats(values: Floats) -> str:
    """Return float constants of C."""
    return ', '.join(f'{value:.8e}f' for value in values)
