# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The result of a golden case: the table of the cases is ``cases.yaml``."""

from contextlib import redirect_stderr, redirect_stdout
import csv
from html import unescape
import io
import json
import os
from pathlib import Path
import re
import shlex
from typing import Any

from accel_calib.errors import AccelCalibError
from accel_calib.logs import LogOptions
from golden import inputs
from golden.driven import session
from golden.figures import attempt, LOOKS
from golden.record import parted, plain
from golden.sweeps import SWEEPS
from inside import main, meaning, poses_of, read_log
import numpy as np
import pytest
from shared import LOG_CORPUS, options_of
import yaml

CASES: dict[str, Any] = yaml.safe_load(
    Path(__file__).with_name('cases.yaml').read_text(encoding='utf-8'))
_WITHOUT_JSON = ('apply', 'report', 'simulate')
_SETTINGS = ('run', 'look', 'units', 'session')


def result_of(name: str, folder: Path) -> Any:
    """Return the result of a case, computed in an empty folder."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        return parted(plain(SWEEPS[name]() if name in SWEEPS else _of_case(CASES[name])))
    finally:
        os.chdir(before)


def _of_case(case: dict[str, Any]) -> Any:
    if 'names' in case:
        return {name: attempt(meaning, name) for name in case['names']}
    if 'read' in case:
        for library in case.get('needs', ()):
            pytest.importorskip(library)
        return _read(case['read'])
    files = {file: made for file, made in case.items() if file not in _SETTINGS}
    for file, made in files.items():
        (kind, options), = made.items()
        getattr(inputs, kind)(Path(file), **options)
    found = {command: _ran(command) for command in case.get('run', ())}
    if 'look' in case:
        intake = poses_of(Path(next(iter(files))), LogOptions(units=case.get('units', '')))
        found['intake'] = intake
        for look in case['look']:
            kind, *given = look.split()
            found[look] = plain(attempt(LOOKS[kind], intake.poses, intake.units, *given))
    return {**found, 'session': session(case['session'])} if 'session' in case else found


def _read(folder: str) -> Any:
    """Return what each log of a folder of the corpus holds, with its findings, or its refusal."""
    Path(folder).symlink_to(LOG_CORPUS / folder)
    found = {}
    for path in sorted(Path(folder).iterdir()):
        for options in options_of(path):
            log = attempt(read_log, path, LogOptions(**options))
            found[f'{path.stem} {options or ""}'.strip()] = (
                [log, log.read_as] if isinstance(log, AccelCalibError) else
                [type(log.table).__name__, log.table.row, log, *log.table.findings])
    return found


def _ran(command: str) -> Any:
    """Return what a command writes."""
    arguments = shlex.split(command)
    if arguments[0] not in _WITHOUT_JSON and '--json' not in arguments:
        arguments += ['--json', 'result.json']
    before = {path: path.lstat().st_mtime_ns for path in Path().rglob('*')}
    errors = io.StringIO()
    with redirect_stdout(io.StringIO()), redirect_stderr(errors):
        try:
            status = main(arguments)
        except SystemExit as ended:
            status = ended.code
    assert 'internal error' not in errors.getvalue(), errors.getvalue()
    written = sorted(path for path in Path().rglob('*') if not path.is_dir()
                     and before.get(path) != path.lstat().st_mtime_ns)
    return {'status': status, 'errors': errors.getvalue() if status == 2 else '',
            **{str(path): _content(path) for path in written}}


def _content(path: Path) -> Any:
    """Return what a file holds; of a page its text, of a calibration not its poses."""
    text = path.read_text(encoding='utf-8')
    if path.suffix == '.csv':
        head, *rows = csv.reader(line for line in text.splitlines() if line[:1] != '#')
        return {name: _column(each) for name, each in zip(head, zip(*rows), strict=True)}
    if path.suffix == '.json':
        return json.loads(text)
    if '.yaml' in path.suffixes:
        return _of_yaml(yaml.safe_load(text))
    if path.suffix == '.html':
        text = re.sub(r'(?s)<section>\n<h2>What these data cannot show.*?</section>', '', text)
        text = unescape(re.sub(r'(?s)<(svg|script|style).*?</\1>|<[^>]*>', '\n', text))
    return [line.strip() for line in text.splitlines() if line.strip()]


def _of_yaml(stored: dict[str, Any]) -> dict[str, Any]:
    """Return what a file states, with the covariance in the order of the names of its values."""
    found = {key: each for key, each in stored.items()
             if key not in ('date', 'package_version', 'checksum', 'poses')}
    if 'covariance' in found and 'effects' in found:
        order = np.argsort([f'{effect}.{name}' for effect, parts in found['effects'].items()
                            for name in parts if name not in ('what', 'unit', 'own_rms')])
        found['covariance'] = np.array(found['covariance'])[np.ix_(order, order)]
    return found


def _column(values: tuple[str, ...]) -> Any:
    try:
        return np.array(values, float)
    except ValueError:
        return list(values)
