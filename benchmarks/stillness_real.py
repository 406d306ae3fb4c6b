# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The rules on real recordings: poses found, samples used, and what a fit leaves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from accel_calib.calibrate import fit_poses
from accel_calib.errors import AccelCalibError
from accel_calib.files import read_recording
from accel_calib.table import numbered, Poses
from accel_calib.units import units_of
import numpy as np
from stillness_case import Case, Sensor
from stillness_rules import Pose

RECORDINGS = (('mpu9150_imu0', 'm/s2', 21), ('mpu9150_imu1', 'm/s2', 21),
              ('xsens_mti_counts', 'native', 38))
"""Name, unit, and the poses that the person took."""


def real_cases(folder: Path) -> list[tuple[str, Case, int]]:
    """Read the recordings, in g where their unit is known."""
    found = []
    for name, unit, poses in RECORDINGS:
        recording = read_recording(folder / f'{name}.csv').recording
        units = units_of(unit)  # type: ignore[arg-type]
        native = units.name == 'native'
        reading = recording.reading if native else units.to_g(recording.reading)
        time = recording['time']
        nothing = np.zeros((0, 2), dtype=np.intp)
        sensor = Sensor(0.0, 1.0 / float(np.median(np.diff(time))), 0.0)
        found.append((name, Case('real', sensor, 0.0, time, reading, recording['rate'], reading,
                                 nothing, np.zeros(len(time), dtype=bool),
                                 'native' if native else 'g'), poses))
    return found


def table_of_real(folder: Path, rules: Mapping[str, Callable[[Case], Sequence[Pose]]]) -> str:
    """Give the table of all rules on all recordings, as Markdown."""
    rows = ['| recording | rule | poses | taken by hand | samples used | gap, mg '
            '| chi² per degree of freedom |', '|---|---|---|---|---|---|---|']
    for name, case, wanted in real_cases(folder):
        for rule, find in rules.items():
            poses = find(case)
            used = sum((case.time >= each.start) & (case.time <= each.end) for each in poses)
            rows.append(f'| {name} | {rule} | {len(poses)} | {wanted} | {np.mean(used):.1%} '
                        f'| {_fitted(poses, case.units)} |')
    return '\n'.join(rows)


def _fitted(poses: Sequence[Pose], unit: str) -> str:
    columns = {'time': np.array([each.start for each in poses]),
               'reading': np.array([each.mean for each in poses]),
               'std': np.array([each.noise for each in poses]), 'count': np.ones(len(poses))}
    try:
        quality = fit_poses(Poses(columns, numbered(columns)), units_of(unit),  # type: ignore
                            model='10', method='algebraic').quality
    except (AccelCalibError, ValueError) as error:
        return f'no fit ({type(error).__name__}) | '
    chi2 = quality.chi2_per_dof
    return f'{quality.rms_after_mg:.3f} | {"" if chi2 is None else f"{chi2:.1f}"}'
