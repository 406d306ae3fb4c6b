# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Helpers of several tests: recordings, sensors, commands, waits, and tasks of a session."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
import json
import os
from pathlib import Path
import re
import subprocess
import sys
from tempfile import TemporaryFile
import time
import tracemalloc
from typing import Any, TypeVar

from accel_calib import simulate
from accel_calib.calibration import Calibration, fit_poses
from accel_calib.effects import EffectKey, entry_of
from accel_calib.geometry import unit
from accel_calib.session import Step
from accel_calib.table import Floats, numbered, Poses, Recording
from accel_calib.units import units_of
from inside import (
    COMMAND, main, Model, model_with, OVER_THE_SPHERE, predict, rotation_from_rpy,
    spread_directions)
import numpy as np
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / 'shared' / 'data'
LOGS = ROOT / 'test' / 'data' / 'logs'
LOG_CORPUS = ROOT / 'test' / 'corpus' / 'logs'
"""Small logs, by what they show, and the options with which they are read."""

GRAVITY = 9.80665
FACES = np.vstack([np.eye(3), -np.eye(3)])
G, MPS2, NATIVE = map(units_of, ('g', 'm/s2', 'native'))

TableT = TypeVar('TableT', Poses, Recording)
Readings = Callable[..., Any]
Stored = Callable[..., Path]
"""Types of the fixtures of these names."""

SENSOR = {'offset': [0.02, -0.01, 0.03], 'axis_gain': [0.01, -0.02, 0.005],
          'cross_axis': [0.004, 0.002, -0.003]}
"""Effects of a sensor that several tests simulate."""

KNOWN = {'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.012, -0.015, 0.008],
         'cross_axis': [0.006, -0.004, 0.003]}
"""Effects of the sensor of `known`."""

OWN = """
import accel_calib as ac
import numpy as np

dead_band = ac.Effect(
    'dead_band', 'dead band of each axis', typical=0.003, unit='g',
    form=lambda u: np.clip(u / 0.05, -1.0, 1.0), slope=lambda u: (abs(u) < 0.05) / 0.05)
field = ac.Effect('field_of_motor', 'field of the motor', typical=0.001, unit='g/A',
                  variable='motor_current', change=lambda current: abs(current - 25.0))
"""
"""File of effects of a user."""

OPTIONS = [part for name, values in SENSOR.items()
           for part in ('--effect', f'{name}={",".join(map(str, values))}')]
"""Options of ``simulate`` for this sensor."""


def table(name: str) -> Any:
    """Return the rows of a table of the corpus."""
    path = ROOT / 'test' / 'corpus' / 'tables' / f'{name}.yaml'
    return yaml.safe_load(path.read_text(encoding='utf-8'))


def options_of(log: Path) -> list[dict[str, Any]]:
    """Return the options with which a log of the corpus is read, each time."""
    options = yaml.safe_load((LOG_CORPUS / 'options.yaml').read_text(encoding='utf-8'))
    return options.get(f'{log.parent.name}/{log.name}', [{}])


def data(name: str) -> Path:
    """Return the path of a real recording, or skip the test if it is missing."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f'{path} is not here')
    return path


def sensor(rng: np.random.Generator, *effects: str) -> Model:
    """Return a random sensor with these effects; by default offset, gains and cross-axis."""
    sizes = {'offset': 0.05, 'gain': 0.02, 'axis_gain': 0.02, 'cross_axis': 0.01,
             'misalignment': 0.01}
    names = effects or ('offset', 'axis_gain', 'cross_axis')
    widths = {'gain': 1}
    return model_with({name: rng.normal(size=widths.get(name, 3)) * sizes[name] for name in names})


@cache
def known(unit: Any = 'm/s2') -> Calibration:
    """Return a calibration of known effects, from 20 poses."""
    poses = simulate(KNOWN, directions=spread_directions(20), units=unit, noise=0.0005, seed=3)
    return fit_poses(poses, units_of(unit), model='10', date='2026-01-01T00:00:00+00:00')


def with_effects(calibration: Calibration, values: Mapping[Any, Any], variance: float = 1e-12,
                 **columns: Any) -> Calibration:
    """Return a calibration with further effects of this variance, and columns of its poses."""
    model = Model({**calibration.model.values, **model_with(values).values}, calibration.rotation)
    covariance, size = variance * np.eye(len(model.vector)), len(calibration.covariance)
    covariance[:size, :size] = calibration.covariance
    return replace(calibration, model=model, covariance=covariance,
                   poses=calibration.poses.with_columns(**columns))


SHAPES = {'start': 1000.0, 'tau': 900.0, 'instant': 4000.0, 'lag': 200.0, 'of_sensor': 0.0,
          'form': 1.0, 'memory': 0.5, 'low': 10.0, 'high': 3000.0}
"""Values of the shapes of effects, in the context of `context_of`."""


def values_of(key: EffectKey, parts: Any) -> Floats:
    """Return the values of an effect: parts of twice its typical size, and its shape."""
    effect = entry_of(key)
    values = 2.0 * effect.typical * np.asarray(parts)[:len(effect.parameters)]
    return np.array([*values, *(SHAPES[part] for part in effect.shape)])


def context_of(rng: np.random.Generator, count: int) -> dict[str, Floats]:
    """Return random context that every effect accepts."""
    return {'temperature': rng.uniform(-20, 60, count), 'std': rng.uniform(0, 0.2, (count, 3)),
            'time': 1000.0 + np.sort(rng.uniform(0, 7200, count)),
            'supply_voltage': rng.uniform(3, 3.6, count), 'rate': rng.normal(size=(count, 3)),
            'previous': random_directions(count, rng),
            'earlier': random_directions(count, rng), 'since_turn': rng.uniform(0, 900, count),
            'temperature_rate': rng.uniform(-0.1, 0.1, count)}


def attitudes(rng: np.random.Generator, count: int) -> Floats:
    """Return directions that are spread over the sphere, turned at random."""
    return spread_directions(count) @ rotation_from_rpy(*rng.uniform(-3, 3, 3)).T


def random_directions(count: int, rng: np.random.Generator) -> Floats:
    """Return (count, 3) unit vectors, uniformly distributed over the sphere."""
    return unit(rng.normal(size=(count, 3)))


def directions_named(text: str) -> Floats:
    """Return the directions that a text such as ``(+x -z)`` names, (n, 3)."""
    signs = [[(f'+{axis}' in part) - float(f'-{axis}' in part) for axis in 'xyz']
             for part in re.findall(r'\([+-][+xyz -]*\)', text)]
    return unit(np.array(signs).reshape(-1, 3))


def changed(poses: TableT, rows: Any = slice(None), times: Any = 1.0, plus: Any = 0.0) -> TableT:
    """Return poses or samples with the readings of these rows, 0-based, changed."""
    reading = poses.reading.copy()
    reading[rows] = reading[rows] * times + plus
    return poses.with_columns(reading=reading)


def poses_of(reading: Any, units: str = '', **columns: Any) -> Poses:
    """Return poses with these (n, 3) readings, and perhaps other columns."""
    made = {key: np.asarray(each, float) for key, each in {'reading': reading, **columns}.items()}
    return Poses(made, numbered(made), units)


def samples_of(time: Any, reading: Any, units: str = '', **columns: Any) -> Recording:
    """Return a recording of these (n,) times [s] and (n, 3) readings."""
    made = {'time': np.asarray(time, float), 'reading': np.asarray(reading, float), **columns}
    return Recording(made, numbered(made), units)


def rows_of(time: Any, reading: Any, rate: Any = np.nan, temperature: Any = np.nan) -> Floats:
    """Return the (n, 9) samples of a stream: time, reading, rate, temperature, supply."""
    rows = np.full((len(time), 9), np.nan)
    rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7] = time, reading, rate, temperature
    return rows


def rms(values: Any, axis: int | None = None) -> Any:
    """Return the root mean square."""
    return np.sqrt(np.mean(np.square(values), axis=axis))


def error_mg(calibration: Calibration, true: Model) -> float:
    """Return the RMS error of the corrected |a| over the sphere [mg]."""
    units = calibration.units
    force = calibration.correct(units.from_g(predict(true, OVER_THE_SPHERE, {})))
    lengths = np.linalg.norm(force, axis=1) / calibration.force_per_g
    return 1e3 * float(rms(lengths - 1.0))


def run_on_small_disk(folder: Path, size_kb: int, *command: object
                      ) -> tuple[subprocess.CompletedProcess[str], Path]:
    """Run a command while a folder is a disk of this size; return also a copy of the folder."""
    if subprocess.run(['unshare', '-r', '-m', 'true'], check=False).returncode:
        pytest.skip('this user may not mount a file system')
    copy = folder.with_name(f'{folder.name}_copy')
    for each in (folder, copy):
        each.mkdir()
    script = (f'mount -t tmpfs -o size={size_kb}k tmpfs "$0" || exit 99; "$@"; status=$?; '
              f'cp -r "$0/." "{copy}"; exit $status')
    done = subprocess.run(['unshare', '-r', '-m', 'bash', '-c', script, str(folder),
                           sys.executable, *COMMAND, *map(str, command)], check=False,
                          capture_output=True, text=True)
    assert done.returncode != 99, done.stderr
    return done, copy


def python(*arguments: object, folder: Path | None = None, **environment: str
           ) -> subprocess.CompletedProcess[str]:
    """Run Python with the package of this tree in a folder, and return what it did."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=folder, capture_output=True, text=True,
        check=False, timeout=300, env={**os.environ, 'PYTHONPATH': str(ROOT), **environment})


def forked(*arguments: object, folder: Path, terminal: int | None = None,
           closed: Sequence[int] = (), **environment: str) -> subprocess.CompletedProcess[str]:
    """
    Run a command in a copy of this process, whose imports are done, and return what it did.

    Standard input is empty. `terminal` is the descriptor of a terminal for the output and the
    errors, and `closed` are the numbers of closed streams.

    """
    with open(os.devnull) as empty, TemporaryFile('w+') as out, TemporaryFile('w+') as errors:
        streams = [empty.fileno(), *((out.fileno(), errors.fileno()) if terminal is None else
                                     (terminal, terminal))]
        child = os.fork()
        if not child:
            try:
                os.chdir(folder)
                os.environ.update(environment)
                for number, stream in enumerate(streams):
                    os.dup2(stream, number)
                for number in closed:
                    os.close(number)
                sys.stdin, sys.stdout, sys.stderr = (
                    None if number in closed else os.fdopen(number, mode, closefd=False)
                    for number, mode in enumerate('rww'))
                status = _status_of(arguments)
                for stream in (sys.stdout, sys.stderr):
                    if stream is not None:
                        stream.flush()
                os._exit(status)
            finally:
                os._exit(70)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        printed = [(each.seek(0), each.read())[1] for each in (out, errors)]
    return subprocess.CompletedProcess(arguments, status, *printed)


def _status_of(arguments: Sequence[object]) -> int:
    sys.argv = ['accel-calib', *map(str, arguments)]
    try:
        return main()
    except SystemExit as ended:
        return int(ended.code or 0)


def text_of(page: str) -> str:
    """Return the text of a page of this repository."""
    return (ROOT / page).read_text(encoding='utf-8')


def run_snippets(page: str, printed: Callable[[str], bool] = bool) -> dict[str, Any]:
    """
    Run the Python of a page in this folder, and return its names.

    What the page shows below a snippet must be `printed`. A snippet whose first line is the name
    of a file is also written to this file.

    """
    names = dict[str, Any]()
    pattern = r'^```python\n(.*?)^```(?:\n\n```text\n(.*?)^```)?'
    for snippet, shown in re.findall(pattern, text_of(page), re.MULTILINE | re.DOTALL):
        file = re.match(r'# (\w+\.py)\n', snippet)
        if file:
            Path(file[1]).write_text(snippet, encoding='utf-8')
        exec(compile(snippet, page, 'exec'), names)
        assert not shown or printed(shown), shown
    return names


def run(*arguments: object) -> int:
    """Run a command, and return the exit status."""
    return main([str(argument) for argument in arguments])


def run_json(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, Any]:
    """Run a command, and return the exit status and the JSON on standard output."""
    capsys.readouterr()  # what was printed before
    status = run(*arguments, '--json', '-')
    return status, json.loads(capsys.readouterr().out)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that is refused with status 2 and one line, and return this line."""
    capsys.readouterr()  # what was printed before
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert re.fullmatch(rf'accel-calib {arguments[0]}: .*\n', error), error
    assert 'internal error' not in error
    return error


def wait(until: Callable[[], Any], seconds: float = 300.0) -> None:
    """Wait until a condition holds."""
    ends = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < ends, f'not so within {seconds} s'
        time.sleep(0.001)


def result(step: Step) -> Any:
    """Return the result of a step, computed in this process."""
    return step.run(lambda function, *given: function(*given))


@contextmanager
def little_memory(most: float = 150e6) -> Iterator[None]:
    """Check that a block takes no more memory than this [bytes]."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def children(pid: int) -> list[int]:
    """Return the ids of the processes that a process started."""
    tasks = Path(f'/proc/{pid}/task').glob('*/children')
    return [int(child) for task in tasks for child in task.read_text().split()]
