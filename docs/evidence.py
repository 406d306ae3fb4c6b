# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Make the table and the picture of ``evidence.md``: ``python docs/evidence.py FOLDER``.

The commands are those of the page. They run on the recordings in FOLDER, which are no part of the
repository. A test runs them again and compares the table.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
import json
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import accel_calib as ac  # noqa: E402
from accel_calib.findings import chance_words, effect_figures  # noqa: E402
from accel_calib.report.sheet import AFTER, BEFORE, drawn, EDGE  # noqa: E402
from accel_calib.table import Floats  # noqa: E402
from accel_calib.text import short, with_minus, with_sd  # noqa: E402
import numpy as np  # noqa: E402
from tables import with_tables  # noqa: E402

PAGE = HERE / 'evidence.md'
PICTURE = HERE / 'figures' / 'evidence.svg'

_SHOWN = ('z', 'lag', 'instant')
"""Values of effects in the table; z is near the vertical where the board does not turn."""


@dataclass(frozen=True)
class Case:
    """The file of a command, its JSON, and the calibration that it stores."""

    file: str
    result: Mapping[str, Any]
    calibration: ac.Calibration

    @property
    def is_still(self) -> bool:
        """Return whether the board did not turn."""
        return 'thermal' in self.result


def cases_of(recordings: Path) -> list[Case]:
    """Run the commands of the page in a folder with links to recordings; return their cases."""
    blocks = re.findall(r'^```sh\n(.*?)^```', PAGE.read_text(encoding='utf-8'), re.M | re.S)
    program = shlex.join([sys.executable, '-m', 'accel_calib.cli.main'])
    environment, cases = {**os.environ, 'PYTHONPATH': str(HERE.parent)}, []
    with TemporaryDirectory() as name:
        folder = Path(name)
        for path in recordings.resolve().rglob('*.csv'):
            (folder / path.name).symlink_to(path)
        for command in ''.join(blocks).splitlines():
            words = shlex.split(command)
            own = words[0] == 'accel-calib'
            done = subprocess.run(
                command.replace('accel-calib', program, 1) + ' --json -' * own, shell=True,
                cwd=folder, env=environment, capture_output=True, encoding='utf-8', check=False)
            if done.returncode:
                raise SystemExit(f'{command}: exit status {done.returncode}\n{done.stderr}')
            if own:
                cases.append(Case(words[2], json.loads(done.stdout),
                                  ac.load(folder / words[words.index('-o') + 1])))
    return cases


def table(cases: Iterable[Case]) -> Iterator[str]:
    """Yield the table: what each command finds, and the residuals before and after [mg]."""
    yield '| file | found | residual [mg] | held out [mg] | noise [mg] |'
    yield '|---|---|---|---|---|'
    for case in cases:
        found, quality = case.result, case.calibration.quality
        steps = found.get('steps', ())
        before, held_out = found.get('gap_mg'), quality.held_out_rms_mg
        if case.is_still:
            before, held_out = found['rms_before_mg'], found['thermal']['held_out_mg']['']
        elif steps:
            held_out = steps[0]['held_out_before_mg']
        noise = found['noise_floor_mg']
        yield '| ' + ' | '.join((
            f'`{case.file}`', '; '.join((*_effects(case), *map(_odds, steps))) or 'nothing',
            _change(before, quality.rms_after_mg), _change(held_out, quality.held_out_rms_mg),
            short(noise) if noise else '')) + ' |'


def _change(*values: Any) -> str:
    """Return a residual before and after, once if both are the same."""
    return ' → '.join(dict.fromkeys(map(short, values)))


def _effects(case: Case) -> Iterator[str]:
    """Yield each effect with some of its values."""
    shown: dict[str, list[str]] = {}
    for each in effect_figures(case.calibration):
        effect, _, name = each.key.rpartition('.')
        if name in _SHOWN:
            shown.setdefault(effect, []).append(
                f'{name} {with_minus(with_sd(each.value, each.sd))} {each.unit}')
    return (f'`{effect}` {", ".join(values)}' for effect, values in shown.items())


def _odds(step: Mapping[str, Any]) -> str:
    return ' or '.join((chance_words(step['p_value']), *(f'`{name}`' for name in step['rivals'])))


def errors(case: Case) -> tuple[Floats, Floats]:
    """
    Return the error of each pose of a calibration, without and with its effects [mg].

    For a still board this is the change of z from its mean, otherwise the error of |force|.

    """
    found, poses = case.calibration, case.calibration.poses

    def error(forces: Floats) -> Floats:
        forces_mg = 1e3 * forces / found.force_per_g
        if case.is_still:
            return forces_mg[:, 2] - np.mean(forces_mg[:, 2])
        return np.linalg.norm(forces_mg, axis=1) - 1e3

    known = {key: poses[key] for key in ('time', 'temperature') if key in poses}
    without = poses.reading if case.is_still else ac.fit(poses).apply(poses.reading)
    return error(without), error(found.apply(poses.reading, **known))


def draw(cases: Sequence[Case]) -> None:
    """Draw the errors of each case before and after, one panel per case."""
    rows = -(-len(cases) // 2)
    with drawn(2.2 * rows, rows=rows, columns=2, width_inches=9.6) as (figure, panels):
        for panel, case in zip(panels, cases, strict=True):
            poses = case.calibration.poses
            at = (poses['time'] - poses['time'][0]) / 60.0 if case.is_still else poses.row
            for values, colour, label in zip(errors(case), (BEFORE, AFTER), ('before', 'after'),
                                             strict=True):
                panel.plot(at, values, 'o', color=colour, label=label, markersize=4.5, **EDGE)
            panel.set(title=case.file, xlabel='time [min]' if case.is_still else 'row',
                      ylabel='change of z [mg]' if case.is_still else '|force| − 1 g [mg]')
        panels[0].legend()
        figure.savefig(PICTURE, metadata={'Date': None})


def with_table(cases: Sequence[Case]) -> str:
    """Return the text of the page with the table of these cases."""
    return with_tables(PAGE.read_text(encoding='utf-8'), {'evidence': lambda: table(cases)})


def main() -> None:
    """Write the table and the picture."""
    cases = cases_of(Path(sys.argv[1]))
    PAGE.write_text(with_table(cases), encoding='utf-8')
    draw(cases)


if __name__ == '__main__':
    main()
