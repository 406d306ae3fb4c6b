# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A process that reads the files of a store again and again.

It prints one line of JSON per second: the number of reads, and what was wrong with files that
could not be read. ``python test/faults/reader.py CALIBRATION``; end it with a signal.

"""

import json
from pathlib import Path
import sys
import time

from accel_calib.logs import read_poses
from accel_calib.stored import read_calibration


def main() -> None:
    """Read the files until the process is ended."""
    calibration = Path(sys.argv[1])
    table = calibration.with_name(f'{calibration.stem}_poses.csv')
    while True:
        reads, bad, ends = 0, [], time.monotonic() + 1.0
        while time.monotonic() < ends:
            for path, read in ((calibration, read_calibration), (table, read_poses)):
                try:
                    read(path)
                except FileNotFoundError:
                    continue
                except Exception as error:  # any: the test shows it
                    bad.append(f'{path.name}: {error}')
                reads += 1
            time.sleep(0.002)
        sys.stdout.write(json.dumps({'reads': reads, 'bad': bad}) + '\n')
        sys.stdout.flush()


if __name__ == '__main__':
    main()
