# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What is said of logs of other makers, and of faults of sensors in their logs."""

from __future__ import annotations

from collections.abc import Iterator
import gzip
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from accel_calib.errors import AccelCalibError, saying
from accel_calib.logs import LogOptions
from accel_calib.pipeline import calibrated_log, poses_of
from figures import DATA, Frame, markdown

OPTIONS: dict[str, dict[str, Any]] = {
    'mimu_zero_padded.csv': {'rate': 100.0},
    'newest_first.csv': {'columns': {'ax': '1', 'ay': '2', 'az': '3'}},
    'held_out_117mg_poses.csv': {'units': 'g'}}
"""Options of files that need some."""


def logs(frame: Frame) -> Iterator[str]:
    """Yield the table of all files in the folders of logs."""
    files = [path for name in ('logs', 'real_logs') for path in sorted((DATA / name).iterdir())
             if path.suffix not in ('.py', '.tsv', '.md')]
    yield markdown(('file', 'verdict', 'read as', 'what is said'),
                   frame.run(row_of, [(path,) for path in files]))


def row_of(given: Path) -> tuple[str, ...]:
    """Return the row of a file; packed binary files are unpacked."""
    with TemporaryDirectory() as place:
        path = given
        if given.suffix == '.gz' and given.suffixes[-2] in ('.bag', '.mat', '.zip', '.bbl'):
            path = Path(place) / given.stem
            path.write_bytes(gzip.decompress(given.read_bytes()))
        said = ask(path, LogOptions(**OPTIONS.get(path.name, {})))
    words = (path.name.replace('_', '\\_'), *said)
    return tuple(each.replace(f'{path.parent}/', '').replace('|', '\\|') for each in words)


def ask(path: Path, options: LogOptions) -> tuple[str, str, str]:
    """Return the verdict on a file, how it is read, and what is said of it."""
    try:
        found = poses_of(path, options)
        with saying(found.said):
            made = calibrated_log(path, options, found)
    except AccelCalibError as err:
        return 'refused', err.read_as, str(err)
    findings = [each.text for each in made.rating.findings
                if each.level != 'GOOD' or each in found.poses.findings]
    return made.rating.name, found.read_as, '; '.join([*found.captured, *findings, *found.notes])
