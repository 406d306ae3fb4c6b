# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
One measurement for `recordings`, in a process of its own, printed as JSON.

``python recordings_trial.py WHAT PATH [OUT]``; the seconds are those of the work without imports,
the memory is the largest that the process had.

"""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
import json
from pathlib import Path
import sys
import time

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from accel_calib.calibrate import fit_poses  # noqa: E402
from accel_calib.capture import capture  # noqa: E402
from accel_calib.files import (  # noqa: E402
    correct_bag,
    open_recording,
    read_calibration,
    read_samples,
)
from accel_calib.units import units_of  # noqa: E402

DESERIALIZED = 400_000


class Clock:
    """Wall clock and CPU, from the last start to the first stop after it."""

    def start(self) -> None:
        """Begin."""
        self.begin = time.perf_counter(), time.process_time()
        self.end: tuple[float, float] | None = None

    def stop(self) -> None:
        """End, unless the work has ended it."""
        self.end = self.end or (time.perf_counter(), time.process_time())


CLOCK = Clock()


def deserialize(path: Path) -> int:
    """Deserialize messages one by one through `rosbags`; opening the bag is not timed."""
    from rosbags.highlevel import AnyReader

    count = 0
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic == '/imu']
        CLOCK.start()
        for connection, _, raw in islice(reader.messages(wanted), DESERIALIZED):
            reader.deserialize(raw, connection.msgtype)
            count += 1
        CLOCK.stop()
    return count


def poses(path: Path) -> int:
    """Find the poses of a bag."""
    with open_recording(path) as stream:
        found = capture(stream.blocks, units_of('m/s2'))
    if len(found.poses) == 0:
        raise RuntimeError('no poses')
    return found.recorded


def read(path: Path) -> int:
    """Read the samples of a bag, and nothing else."""
    with open_recording(path) as stream:
        return sum(len(block) for block in stream.blocks)


def apply(path: Path) -> int:
    """Write a corrected copy of a bag."""
    return correct_bag(path, read_calibration(Path(sys.argv[4])), Path(sys.argv[3]))


def table(path: Path) -> dict[str, list[float]]:
    """Time reading, poses and fit of a table in counts, over and over; the first is warming up."""
    units = units_of('native')
    spent: dict[str, list[float]] = {'read': [], 'poses': [], 'fit': []}
    for _ in range(11):
        recording = timed(spent['read'], lambda: read_samples(path))
        found = timed(spent['poses'], lambda recording=recording: capture(recording, units))
        timed(spent['fit'], lambda found=found: fit_poses(found.poses, units, model='10'))
    return spent


def timed(into: list[float], work: Callable[[], object]) -> object:
    """Do work and note how long it took."""
    begin = time.perf_counter()
    result = work()
    into.append(time.perf_counter() - begin)
    return result


def largest_memory() -> float:
    """Give the largest resident memory [MB]; getrusage would count the parent's, before exec."""
    text = Path('/proc/self/status').read_text(encoding='ascii')
    return int(text.partition('VmHWM:')[2].split()[0]) / 1024


def main() -> None:
    """Do what the command line says."""
    work = {each.__name__: each for each in (deserialize, poses, read, apply, table)}
    CLOCK.start()
    result = work[sys.argv[1]](Path(sys.argv[2]))
    CLOCK.stop()
    seconds, cpu = (last - first for first, last in zip(CLOCK.begin, CLOCK.end, strict=True))
    print(json.dumps({'result': result, 'seconds': seconds, 'cpu': cpu,
                      'megabytes': largest_memory()}))


if __name__ == '__main__':
    main()
