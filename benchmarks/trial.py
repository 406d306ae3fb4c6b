# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
One measurement in a fresh process, printed as JSON.

``python trial.py WHAT PATH ...``. The time is that of the work, with the imports that it does
itself; the memory is the largest that the process had, with all imports.

"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import islice
import json
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from accel_calib.calibration import fit_poses  # noqa: E402
from accel_calib.logs import open_log, read_poses, read_recording  # noqa: E402
from accel_calib.messages import correct_bag  # noqa: E402
from accel_calib.stillness import capture  # noqa: E402
from accel_calib.stored import read_calibration  # noqa: E402
from accel_calib.units import units_of  # noqa: E402

DESERIALIZED = 400_000
"""Messages that `rosbags` deserializes, at most."""

MS2 = units_of('m/s2')


def trial(what: str, *arguments: object) -> dict[str, Any]:
    """
    Run one measurement in a fresh process.

    Parameters
    ----------
    what : str
        Name of a function of this module that takes paths.
    *arguments
        The paths.

    Returns
    -------
    dict
        ``result`` of the function, ``seconds`` and ``cpu`` [s], ``megabytes``.

    """
    done = subprocess.run([sys.executable, __file__, what, *map(str, arguments)],
                          stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    print(what, arguments[0], found if what != 'table' else '', file=sys.stderr, flush=True)
    return found


class Clock:
    """Wall clock and CPU, from the last start to the first stop after it."""

    begin = end = (0.0, 0.0)
    running = False

    def start(self) -> None:
        """Start."""
        self.begin, self.running = (time.perf_counter(), time.process_time()), True

    def stop(self) -> None:
        """Stop, unless the work has stopped it."""
        if self.running:
            self.end, self.running = (time.perf_counter(), time.process_time()), False


CLOCK = Clock()


def deserialize(bag: Path) -> int:
    """Deserialize messages one by one through `rosbags`; opening the bag is not timed."""
    from rosbags.highlevel import AnyReader

    count = 0
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.topic == '/imu']
        CLOCK.start()
        for connection, _, raw in islice(reader.messages(wanted), DESERIALIZED):
            reader.deserialize(raw, connection.msgtype)
            count += 1
        CLOCK.stop()
    return count


def poses(bag: Path) -> int:
    """Find the poses of a bag."""
    with open_log(bag) as stream:
        found = capture(stream.blocks, MS2)
    if len(found.poses) == 0:
        raise RuntimeError('no poses')
    return found.recorded


def read(bag: Path) -> int:
    """Read the samples of a bag, and nothing else."""
    with open_log(bag) as stream:
        return sum(len(block) for block in stream.blocks)


def apply(bag: Path, out: Path, calibration: Path) -> int:
    """Write a corrected copy of a bag."""
    return correct_bag(bag, read_calibration(calibration), out)


def table(csv: Path) -> dict[str, list[float]]:
    """Time reading, poses and fit of a recording in counts, 11 times; the first is a warm-up."""
    units = units_of('native')
    spent: dict[str, list[float]] = {'read': [], 'poses': [], 'fit': []}
    for _ in range(11):
        recording = timed(spent['read'], partial(read_recording, csv))
        found = timed(spent['poses'], partial(capture, recording, units))
        timed(spent['fit'], partial(fit_poses, found.poses, units, model='10'))
    return spent


def refined(csv: Path) -> str:
    """Refine model 10 of a pose table, and return the verdict; only the refinement is timed."""
    from accel_calib.refinement import refine

    given = read_poses(csv)
    CLOCK.start()
    return refine(given, MS2, base='10').verdict


def timed(into: list[float], work: Callable[[], Any]) -> Any:
    """Do work and append its duration [s]."""
    begin = time.perf_counter()
    result = work()
    into.append(time.perf_counter() - begin)
    return result


def largest_memory() -> float:
    """
    Return the largest resident memory of this process [MB].

    `getrusage` would include that of the parent before exec.

    """
    text = Path('/proc/self/status').read_text(encoding='ascii')
    return int(text.partition('VmHWM:')[2].split()[0]) / 1024


def main() -> None:
    """Do the work that the command line names."""
    work = {each.__name__: each for each in (deserialize, poses, read, apply, table, refined)}
    CLOCK.start()
    result = work[sys.argv[1]](*map(Path, sys.argv[2:]))
    CLOCK.stop()
    seconds, cpu = (last - first for first, last in zip(CLOCK.begin, CLOCK.end, strict=True))
    print(json.dumps({'result': result, 'seconds': seconds, 'cpu': cpu,
                      'megabytes': largest_memory()}))


if __name__ == '__main__':
    main()
