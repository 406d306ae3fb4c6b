# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Plans of poses as CSV: the plan in words as ``#`` comments, then one row per pose."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import TextIO

from ..disk import check_regular, write_atomically
from ..errors import InputError
from ..refine import PlannedPose, PosePlan
from ..units import STANDARD_GRAVITY

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


def read_plan(path: Path) -> tuple[PlannedPose, ...]:
    """
    Return the poses of a plan.

    Raises
    ------
    InputError
        If a column is missing, or a value is not a finite number.
    OSError
        If the file cannot be read.

    """
    check_regular(path)
    lines = [line for line in path.read_text(encoding='utf-8').splitlines()
             if line.strip() and not line.startswith('#')]
    reader = csv.DictReader(lines)
    missing = [name for name in _FIELDS if name not in (reader.fieldnames or ())]
    if missing:
        raise InputError(f'{path} lacks the columns {", ".join(missing)}, expected a plan',
                         'use a file that accel-calib refine --plan has written')
    return tuple(_pose(path, row) for row in reader)


def _pose(path: Path, row: dict[str, str]) -> PlannedPose:
    """Return the pose of one row."""
    def number(name: str) -> float:
        try:
            value = float(row[name])
        except (TypeError, ValueError):
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f'{path}: pose {row["pose"]} has {name} {row[name]!r}, expected a '
                             'finite number', 'correct the value, or write the plan again')
        return value

    context = {key: number(name) / _SCALE.get(key, 1.0) for key, name in _CONTEXT.items()
               if row[name]}
    return PlannedPose((number('up_x'), number('up_y'), number('up_z')), row['attitude'], context,
                       tuple(row['separates'].split(' / ')), number('expected_probability'))
