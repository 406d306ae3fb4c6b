# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Seeded damage to files of every kind that is read.

Each case changes a sound file: bytes flipped, removed, repeated or inserted, numbers replaced by
extreme ones, the file cut or joined with another one. The reader must end with a result or with an
error of this package, and within a time limit.

Run many cases by hand: ``python test/faults/fuzz.py --count 100000 --seed 7 csv yaml``.

"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
import signal
import sys
from tempfile import TemporaryDirectory

import accel_calib as ac
from accel_calib.errors import AccelCalibError
from accel_calib.files import read_calibration, read_log, write_calibration, write_table
from accel_calib.intake import poses_of
import numpy as np

LOGS = Path(__file__).parents[1] / 'data' / 'logs'
_EXTREME = (b'1e300', b'-1e308', b'nan', b'inf', b'9' * 400, b'0x_', b'', b'"', b"'", b'\x00',
            b'\x1b[31m', b',', b';', b'\n', b'&a', b'*a', b'1:30', b'2026-01-01', b'\xff\xfe')
_LIMIT_S = 20


class TooSlowError(Exception):
    """A case took longer than the limit."""


def starts(kind: str, folder: Path) -> list[Path]:
    """Return sound files of a kind."""
    if kind == 'yaml':
        poses = ac.simulate({'offset': [0.02, -0.01, 0.03]}, poses=20, seed=1)
        write_calibration(folder / 'c.yaml', ac.fit(poses))
        return [folder / 'c.yaml']
    if kind == 'poses':
        write_table(folder / 'poses.csv', ac.simulate({}, poses=20, temperature=(20, 30), seed=1))
        return [folder / 'poses.csv']
    suffixes = {'csv': ('.csv', '.log', '.txt'), 'ulg': ('.ulg',), 'bin': ('.bin',)}[kind]
    return sorted(path for path in LOGS.rglob('*') if path.suffix in suffixes)


READERS: dict[str, Callable[[Path], object]] = {
    'yaml': read_calibration, 'poses': lambda path: ac.fit(poses_of(path).poses),
    'csv': read_log, 'ulg': read_log, 'bin': read_log}


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return data with one to four changes."""
    for _ in range(int(rng.integers(1, 5))):
        at, length = (int(rng.integers(0, max(len(data), 1))) for _ in range(2))
        span = slice(at, min(len(data), at + 1 + length % 64))
        how = int(rng.integers(0, 7))
        extreme = _EXTREME[int(rng.integers(0, len(_EXTREME)))]
        piece = (rng.bytes(1 + length % 8), extreme, b'', data[span] * 3, extreme,
                 data[span][::-1], data[at:])[how]
        data = data[:at] if how == 6 and length % 2 else (
            data[:span.start] + piece + data[span.stop:])
    return data


def outcomes(kind: str, count: int, seed: int) -> Iterator[tuple[int, str]]:
    """Yield the number of each case, and how it ended: ``read``, ``refused`` or an error."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        sound = [(path.suffix, path.read_bytes()) for path in starts(kind, folder)]
        for case in range(count):
            rng = np.random.default_rng([seed, case])
            suffix, data = sound[int(rng.integers(0, len(sound)))]
            path = folder / f'damaged{suffix}'
            path.write_bytes(damaged(data, rng))
            yield case, _outcome(READERS[kind], path)


def _outcome(read: Callable[[Path], object], path: Path) -> str:
    def stop(number: int, frame: object) -> None:
        raise TooSlowError(f'more than {_LIMIT_S} s')

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(_LIMIT_S)
    try:
        read(path)
    except AccelCalibError as err:
        return 'refused' if '\n' not in str(err) else f'of several lines: {err}'
    except Exception as err:  # any other error is a finding
        return f'{type(err).__name__}: {err}'
    finally:
        signal.alarm(0)
    return 'read'


def main() -> int:
    """Print the number of each outcome, and the first case of each finding."""
    parser = argparse.ArgumentParser(description='Read damaged files.')
    parser.add_argument('kinds', nargs='*', default=list(READERS), choices=list(READERS))
    parser.add_argument('--count', type=int, default=1000)
    parser.add_argument('--seed', type=int, default=1)
    args = parser.parse_args()
    found: Counter[str] = Counter()
    for kind in args.kinds:
        counts: Counter[str] = Counter()
        for case, outcome in outcomes(kind, args.count, args.seed):
            if outcome not in ('read', 'refused') and not found[outcome[:60]]:
                sys.stdout.write(f'{kind}, case {case}: {outcome[:300]}\n')
            found[outcome[:60]] += 1
            counts[outcome if outcome in ('read', 'refused') else 'finding'] += 1
        sys.stdout.write(f'{kind}: {dict(counts)}\n')
    return int(bool(set(found) - {'read', 'refused'}))


if __name__ == '__main__':
    sys.exit(main())
