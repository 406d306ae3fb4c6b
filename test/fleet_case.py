# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Recordings of a simulated fleet, and its results, for the tests of fleets."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from accel_calib import simulate
from accel_calib.fleet import Input, Options, recordings
from accel_calib.logs import write_table
import numpy as np

OFFSET = np.array([0.01, -0.02, 0.03])
QUICK = Options(refined=False)


def write_poses(path: Path, offset: Any = OFFSET, *, seed: int = 0, sensor: str = 'imu_link',
                **options: Any) -> Path:
    """Write the pose table of a simulated sensor, and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    poses = simulate({'offset': offset, 'axis_gain': (0.004, -0.006, 0.002)}, poses=14, seed=seed,
                     units='g', **options)
    write_table(path, replace(poses, sensor=sensor))
    return path


def write_fleet(folder: Path, robots: int, dates: int) -> Path:
    """Write recordings of robots whose offset differs by 1 mg in x from one to the next."""
    for robot in range(robots):
        for month in range(1, dates + 1):
            write_poses(folder / f'robot_{robot}' / f'2026-{month:02d}-03.csv',
                        OFFSET + np.eye(3)[0] * 0.001 * robot, seed=100 * robot + month)
    return folder


def rows_of(results: Path) -> list[dict[str, Any]]:
    """Return the rows of the data set, as any reader of Parquet sees them."""
    import pyarrow.parquet as pq

    found: list[dict[str, Any]] = pq.read_table(results / 'recordings').to_pylist()
    return found


def page_of(results: Path) -> str:
    return (results / 'fleet.html').read_text(encoding='utf-8')


def found_in(*names: Path | str) -> list[Input]:
    return list(recordings(map(str, names)))


def state_of(results: Path) -> dict[str, Any]:
    """Return all that must be equal after runs that were disturbed in different ways."""
    import pyarrow.parquet as pq

    rows = sorted(({**row, 'seconds': None} for row in rows_of(results)),
                  key=lambda row: str(row['recording']))
    # A worker that is killed while it writes leaves a hidden file.
    folders = {name: sorted(str(path.relative_to(results)) for path in (results / name).rglob('*')
                            if path.is_file() and not path.name.startswith('.'))
               for name in ('calibrations', 'done', 'pending', 'places')}
    return {'rows': rows, **folders,
            'sensors': pq.read_table(results / 'sensors.parquet').to_pylist(),
            'texts': [(results / name).read_text() for name in folders['calibrations']],
            'prior': (results / 'fleet.yaml').read_text()}
