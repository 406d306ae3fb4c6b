# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib fleet``: calibrate the recordings of many sensors, on Dask."""

from __future__ import annotations

import argparse
from pathlib import Path
import re

from . import options
from .terminal import progress, working
from ..fleet import cluster, Options, recordings, STATUS, Store, Summary
from ..fleet import run as run_fleet
from ..stored.exports import CALIBRATION_ALONE
from ..text import counted

_EXAMPLE = ('accel-calib fleet recordings/ -o results/\n'
            "  accel-calib fleet 's3://fleet/*.mcap' -o results/ --scheduler tcp://10.0.0.1:8786")


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('recordings', nargs='+', metavar='RECORDINGS', help='recordings, pose '
                      'tables, folders, globs in quotes, lists (@list.txt), or addresses such as '
                      's3://bucket/folder')
    made.add_argument('-o', '--output', type=Path, required=True, metavar='FOLDER',
                      help='folder of the results; all workers must see it')
    made.add_argument('--scheduler', default='', metavar='ADDRESS', help='address of a Dask '
                      'scheduler (default: a cluster on this machine)')
    made.add_argument('--workers', type=int, metavar='N', help='workers on this machine (default: '
                      'one per core)')
    made.add_argument('--sensor-from', type=_regex, default='', metavar='REGEX', help='take the '
                      'name of the sensor from the path: the groups, or the whole match (default: '
                      'the folder and the name in the file)')
    made.add_argument('--model-from', type=_regex, default='', metavar='REGEX', help='take the '
                      'model of the sensor from its name')
    made.add_argument('--no-refine', action='store_true',
                      help='do not look for effects beyond offset, gain and cross-axis')
    made.add_argument('--export', action='append', default=[], choices=CALIBRATION_ALONE,
                      metavar='FORMAT', help='write each calibration in this format, too; can be '
                      f'repeated: {", ".join(CALIBRATION_ALONE)}')
    options.add_log(made)
    options.add_max_dwell(made)
    options.add_json(made)
    made.set_defaults(run=run)


def _regex(text: str) -> str:
    """Return a regular expression from an argument."""
    try:
        re.compile(text)
    except re.error as err:
        raise argparse.ArgumentTypeError(f'{text}: {err}, expected a regular expression') from None
    return text


def run(args: argparse.Namespace) -> int:
    """Calibrate the recordings, and print a summary."""
    console = options.console(args)
    with options.errors_in_json(args.json):
        with working('looking for recordings'):
            found = list({each.path: each for each in recordings(args.recordings)}.values())
        asked = Options(args.sensor_from, args.model_from, options.log_options(args),
                        options.settings(args), not args.no_refine,
                        tuple(dict.fromkeys(args.export)))
        with cluster(args.scheduler, args.workers) as client:
            console.print(f'{counted(len(found), "recording")}; dashboard: '
                          f'{client.dashboard_link}')
            with progress('recordings') as moved:
                summary = run_fleet(client, found, asked, Store(args.output.absolute()), moved)
    options.write_json(args.json, {
        'recordings': len(found), **{name: summary.counts[name] for name in STATUS},
        'sensors': summary.sensors})
    for line in _lines(summary, args.output):
        console.print(line)
    return 0


def _lines(summary: Summary, output: Path) -> list[str]:
    """Return the summary as lines of text."""
    counts = summary.counts
    lines = [f'{counts["ok"]} calibrated, {counts["error"]} with an error, {counts["unread"]} '
             f'could not be read, {counts["skipped"]} skipped because they are done']
    for row in summary.sensors:
        for change in row['changes']:
            if change['for_good']:
                lines.append(f'{row["sensor"]} changed for good at {change["date"]}: '
                             f'{change["parameter"]} (p = {change["p_value"]:.2g})')
    return [*lines, f'{counted(len(summary.sensors), "sensor")}, stored in {output}']
