# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib fleet``: calibrate the recordings of many sensors, on Dask."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from .frame import console, Done, progress, working
from .inputs import given, log_options, settings
from ..fleet import cluster, Options, recordings, run, STATUS, Store, Summary
from ..text import counted


def run_fleet(args: argparse.Namespace) -> Done:
    """Calibrate the recordings."""
    with working('looking for recordings'):
        found = list({each.path: each for each in recordings(args.recordings)}.values())
    asked = Options(**{**given(Options, args), 'log': log_options(args),
                       'settings': settings(args), 'exports': tuple(dict.fromkeys(args.export))})
    with cluster(args.scheduler, args.workers) as client:
        console(args).print(f'{counted(len(found), "recording")}; dashboard: '
                            f'{client.dashboard_link}')
        with progress('recordings') as moved:
            summary = run(client, found, asked, Store(args.output.absolute()), moved)
    return Done({'recordings': len(found), **{name: summary.counts[name] for name in STATUS},
                 'sensors': summary.sensors}, _lines(summary, args.output))


def _lines(summary: Summary, output: Path) -> Iterator[str]:
    """Yield the summary as lines of text."""
    counts = summary.counts
    yield (f'{counts["ok"]} calibrated, {counts["error"]} with an error, {counts["unread"]} '
           f'could not be read, {counts["skipped"]} skipped because they are done')
    for row in summary.sensors:
        for change in row['changes']:
            if change['for_good']:
                yield (f'{row["sensor"]} changed for good at {change["date"]}: '
                       f'{change["parameter"]} (p = {change["p_value"]:.2g})')
    yield f'{counted(len(summary.sensors), "sensor")}, stored in {output}'
