# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Plans of poses as CSV: the plan in words as ``#`` comments, then one row per pose."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TextIO, TYPE_CHECKING

from ..disk import write_atomically
from ..units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from ..refine import PosePlan

_CONTEXT = {'temperature': 'temperature', 'supply_voltage': 'supply_voltage', 'std': 'vibration',
            'time': 'wait'}
"""Column of the plan by column of the poses: °C, V, m/s², s after the last pose."""

_FIELDS = ('pose', 'up_x', 'up_y', 'up_z', 'attitude', *_CONTEXT.values(), 'separates',
           'expected_probability')

_SCALE = {'std': STANDARD_GRAVITY}


def write_plan(path: Path, plan: PosePlan) -> None:
    """
    Write the poses of a plan; the direction that points up is a unit vector in the sensor axes.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    def write(file: TextIO) -> None:
        file.writelines(f'# {line}\n' for line in plan.lines)
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(_FIELDS)
        for number, pose in enumerate(plan.poses, 1):
            context = [format(pose.context[key] * _SCALE.get(key, 1.0), '.6g')
                       if key in pose.context else '' for key in _CONTEXT]
            writer.writerow([number, *(f'{part:.6f}' for part in pose.up), pose.words, *context,
                             ' / '.join(pose.separates), f'{pose.expected:.4f}'])

    write_atomically(path, write)
