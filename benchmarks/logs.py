# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What is said of logs of other makers, and of faults of sensors in their logs.

Each file beside the project is calibrated, as ``accel-calib calibrate FILE`` does it::

    python benchmarks/logs.py --markdown docs/figures/logs.md

"""

from __future__ import annotations

import gzip
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from accel_calib.errors import AccelCalibError, saying  # noqa: E402
from accel_calib.logs import LogOptions  # noqa: E402
from accel_calib.pipeline import calibrated_log, poses_of  # noqa: E402
from figures import markdown, parser, publish  # noqa: E402

DATA = ROOT.parent / 'shared' / 'data'

OPTIONS: dict[str, dict[str, Any]] = {
    'mimu_zero_padded.csv': {'rate': 100.0},
    'newest_first.csv': {'columns': {'ax': '1', 'ay': '2', 'az': '3'}},
    'held_out_117mg_poses.csv': {'units': 'g'}}
"""Options of files that need some."""

_PAGE = """\
# What is said of logs

Made by `python benchmarks/logs.py {command}`:
each file in the folders `logs` (faults of sensors, drivers and clocks, real and simulated) and
`real_logs` (71 logs of other makers, most of which were not recorded to calibrate a sensor) of the
data beside the project, as `accel-calib calibrate FILE`. Packed binary files are
unpacked first. *Refused* is a result, too: the words say whether it is for the right reason.

{rows}
"""


def said(path: Path, options: LogOptions) -> tuple[str, str, str]:
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


def rows_of(folder: Path, place: Path) -> list[tuple[str, str, str, str]]:
    """Return a row for each file of a folder."""
    rows = []
    for given in sorted(folder.iterdir()):
        path, name = given, given.name
        if given.suffix in ('.py', '.tsv', '.md'):
            continue
        if given.suffixes[-1] == '.gz' and given.suffixes[-2] in ('.bag', '.mat', '.zip', '.bbl'):
            path, name = place / given.stem, given.stem
            path.write_bytes(gzip.decompress(given.read_bytes()))
        verdict, read_as, words = said(path, LogOptions(**OPTIONS.get(name, {})))
        words = words.replace(f'{path.parent}/', '').replace('|', '\\|')
        rows.append((name.replace('_', '\\_'), verdict, read_as.replace('|', '\\|'), words))
        print(name, verdict, file=sys.stderr)
    return rows


def main() -> None:
    """Run the benchmark."""
    given = parser(__doc__).parse_args()
    with TemporaryDirectory() as place:
        rows = [row for name in ('logs', 'real_logs') for row in rows_of(DATA / name, Path(place))]
    publish(_PAGE.format(command=' '.join(sys.argv[1:]), rows=markdown(
        ('file', 'verdict', 'read as', 'what is said'), rows)), given.markdown)


if __name__ == '__main__':
    main()
