# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Two Imus at 1 kHz for ten minutes, each with its own node in its own namespace.

The figures are messages lost, memory and latency::

    python benchmarks/two_imus.py --markdown docs/figures/two_imus.md

"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import time

from figures import Line, machine, parser, publish, table
from imu_path import quantile, stored
from imu_trial import node, Trial, trial

DOMAIN = 61
NAMESPACES = '/left', '/right'

_ABOUT = """\
Made by `python benchmarks/two_imus.py {command} --markdown FILE`. Two drivers, two nodes with a
levelled 10-parameter calibration, and two users share the cores and a DDS domain.

Machine: {machine}."""


def run(seconds: float) -> list[Trial]:
    """Run both nodes at the same time."""
    def one(namespace: str) -> Trial:
        with stored() as (linear, _):
            command = [*node(linear), '-r', f'__ns:={namespace}']
            return trial(command, 1000.0, lambda: time.sleep(seconds), domain=DOMAIN,
                         namespace=namespace)

    with ThreadPoolExecutor(len(NAMESPACES)) as pool:
        return list(pool.map(one, NAMESPACES))


def lines(trials: list[Trial], seconds: float) -> list[Line]:
    """Return the lines of the table."""
    found = []
    for namespace, each in zip(NAMESPACES, trials, strict=True):
        before, after = each.memory
        found += [
            Line(f'{namespace}: messages lost in {seconds:.0f} s',
                 f'{each.lost} of {len(each.sent):,}', '0', 1, each.lost == 0),
            Line(f'{namespace}: memory at the begin and the end', f'{before:.1f} and '
                 f'{after:.1f} MB', 'constant', 1, after - before < 5.0),
            Line(f'{namespace}: latency p50 and p99', f'{quantile(50)(each):.0f} and '
                 f'{quantile(99)(each):.0f} µs', '', 1, None)]
    return found


def main() -> None:
    """Print the table, or write it to a file."""
    given = parser(__doc__, seconds=600.0).parse_args()
    command = '' if given.seconds == 600.0 else f'--seconds {given.seconds:g}'
    about = _ABOUT.format(command=command, machine=machine())
    made = table(lines(run(given.seconds), given.seconds))
    publish(f'# Figures of two Imus\n\n{about}\n\n{made}\n', given.markdown)


if __name__ == '__main__':
    main()
