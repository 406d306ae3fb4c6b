# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The Imu path: the cost of the node beside bare relays, in one run on one machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
import os
from pathlib import Path
import tempfile
import time

from accel_calib.calibration import Calibration, fit_poses, level
from accel_calib.effects import EffectKey, Model, model_with, simulate_poses
from accel_calib.geometry import spread_directions
from accel_calib.logs import write_table
from accel_calib.stored import write_calibration
from accel_calib.table import Floats
from accel_calib.units import units_of
from figures import Frame, Line, markdown, ROOT, table, tell
from nodes import Caller, node_command, relay_command, run_trial, Trial
import numpy as np

UNITS = units_of('m/s2')
SEED = 2030
EFFECTS = {'offset': np.array([0.03, -0.02, 0.04]), 'axis_gain': np.array([0.012, -0.015, 0.008]),
           'cross_axis': np.array([0.006, -0.004, 0.003])}
MORE: dict[EffectKey, Floats] = {
    'offset_temperature': np.array([1e-3, -5e-4, 8e-4]),
    'gain_temperature': np.array([3e-4, 2e-4, -1e-4]), 'quadratic': np.array([2e-3, -1e-3, 1e-3])}

PACES = {'five times a second': 0.2, 'back to back': 0.0}
"""Pauses between calls [s]."""

OFTEN = ROOT / 'config' / 'fast_dds.xml'
"""Profile that makes DDS announce a process more often than every 3 s."""

Trials = dict[str, list[Trial]]
Phases = dict[str, tuple[int, int, int]]
"""Begin and end of parts of a trial [ns], and the number of calls answered in each."""


@contextmanager
def store_calibrations() -> Iterator[tuple[Path, Path]]:
    """
    Yield the files of a levelled 10-parameter calibration, with its poses, and of a refined one.

    The poses have further effects, those of the refined calibration.

    """
    rng, directions = np.random.default_rng(SEED), spread_directions(36)
    context = {'temperature': 25.0 + 10.0 * rng.uniform(-1.0, 1.0, len(directions))}
    poses = simulate_poses(model_with({**EFFECTS, **MORE}), directions, rng, noise_g=0.0005,
                           context=context)
    poses = poses.with_columns(reading=UNITS.from_g(poses.reading),
                               std=UNITS.from_g(poses['std']))
    fitted = fit_poses(poses, UNITS, model='10')
    flat = np.array([[0.2, -0.4, 0.8]]) / np.sqrt(0.84) * UNITS.per_g
    linear: Calibration = level(fitted, fitted.predict(flat)[0], 'ros')
    model = Model({**linear.model.values, **MORE}, linear.model.rotation)
    covariance = np.eye(len(model.vector)) * 1e-9
    size = len(linear.covariance)
    covariance[:size, :size] = linear.covariance
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / 'linear.yaml', Path(folder) / 'refined.yaml'
        write_calibration(paths[0], linear)
        write_calibration(paths[1], replace(linear, model=model, covariance=covariance))
        write_table(paths[0].with_name('linear_poses.csv'), linear.poses)
        yield paths


def run_calls(command: list[str], seconds: float) -> tuple[Trial, Phases]:
    """Run the node while nobody calls a service, and while ``~/fit`` and ``~/refine`` compute."""
    phases: Phases = {}

    def during(pid: int) -> None:
        caller = Caller()
        time.sleep(3.0)
        began = time.monotonic_ns()
        time.sleep(seconds)
        phases['idle'] = began, time.monotonic_ns(), 0
        for name in ('fit', 'refine'):
            for pace, pause in PACES.items():
                began, until, calls = time.monotonic_ns(), time.monotonic() + seconds, 0
                while time.monotonic() < until:
                    answer = caller.call(name)
                    if not answer.success:
                        raise RuntimeError(answer.message)
                    calls += 1
                    time.sleep(pause)
                phases[f'`~/{name}`, {pace}'] = began, time.monotonic_ns(), calls
        caller.close()

    return between(command, 1000.0, during), phases


def between(command: list[str], rate: float, during: Callable[[int], object] | float, *,
            listened: bool = True, lead: float = 0.0) -> Trial:
    """Run a program between driver and user, for some seconds or while something is done."""
    return run_trial({'imu/data_calibrated': command}, rate, during if callable(during) else
                     lambda pid: time.sleep(during), listened=listened, lead=lead)


def ratio(trials: Trials, of: Callable[[Trial], float], one: str, other: str) -> float:
    """Return the median ratio of two programs that ran in the same turn."""
    return float(np.median([of(a) / of(b) for a, b in zip(trials[one], trials[other])]))


def cpu_us(each: Trial) -> float:
    """Return the CPU time per message [µs]."""
    return each.cpu_us


def lines_at_1_khz(trials: Trials) -> Iterator[Line]:
    turns, medians = len(trials['node']), {
        name: np.median([each.cpu_us for each in found]) for name, found in trials.items()}
    saved = medians['node'] - medians['unheard']
    for what, other, most in (
            ('CPU per message at 1 kHz, over the bare serialized relay', 'serialized', 1.5),
            ('the same, over the bare typed relay under the default executor', 'typed', 0.5)):
        over = ratio(trials, cpu_us, 'node', other)
        yield Line(what, f'{over:.2f}', turns, f'≤ {most}', over <= most)
    added = float(np.median([a.latency_us(50) - b.latency_us(50) for a, b in zip(
        trials['node'], trials['serialized'])]))
    yield Line('latency p50, added to that of the serialized relay', f'{added:.0f} µs', turns,
               '≤ 50 µs', added <= 50.0)
    p99 = ratio(trials, lambda each: each.latency_us(99), 'node', 'serialized')
    yield Line('latency p99, over that of the serialized relay', f'{p99:.2f}', turns, '≤ 1.3',
               p99 <= 1.3)
    more = ratio(trials, cpu_us, 'refined', 'node')
    yield Line('CPU per message with temperature and non-linear effects, over the linear '
               'calibration', f'{more:.2f}', turns, '≤ 1.3', more <= 1.3)
    yield Line('CPU per message without a listener, over a bare subscriber that drops them',
               f'{ratio(trials, cpu_us, "unheard", "sink"):.2f} ({saved:.0f} µs less than with a '
               'listener)', turns, 'publishers cost nothing')


def lines_of_starts(starts: dict[str, list[float]]) -> Iterator[Line]:
    """Yield the lines of the times to the first corrected message [s]."""
    words = {name: f'{np.median(each):.2f} s ({min(each):.2f} to {max(each):.2f})'
             for name, each in starts.items()}
    what = 'start of the node to the first corrected message'
    for more, name, beside in (('', 'node', f'; bare relay {words["serialized"]}'),
                               (f', all processes with `config/{OFTEN.name}`', 'often', '')):
        yield Line(what + more, words[name] + beside, len(starts[name]), '≤ 1.5 s',
                   float(np.median(starts[name])) <= 1.5)


def lines_under_load(flood: Trials, many: Trials, seconds: float) -> Iterator[Line]:
    """Yield the lines of the trials without a pause, and of those at 8 kHz."""
    share = ratio(flood, lambda each: each.rate, 'node', 'serialized')
    ours, bare = (np.median([each.rate for each in flood[name]])
                  for name in ('node', 'serialized'))
    yield Line('flooded: messages/s received, over the bare serialized relay',
               f'{share:.2f} ({ours:,.0f} of {bare:,.0f})', len(flood['node']), '≥ 0.85',
               share >= 0.85)
    node = many['node'][0]
    yield Line(f'8 kHz for {seconds:.0f} s: messages lost', f'{node.lost} of '
               f'{len(node.sent):,} (bare relay: {many["serialized"][0].lost})', 1, '0',
               node.lost == 0)


def lines_of_calls(runs: list[tuple[Trial, Phases]]) -> Iterator[Line]:
    """Yield the lines of the trials in which services compute."""
    for name in list(runs[0][1])[1:]:
        parts = [(each.between(*phases[name][:2]), each.between(*phases['idle'][:2]))
                 for each, phases in runs]
        middle = float(np.median([a.latency_us(99) / b.latency_us(99) for a, b in parts]))
        lost = sum(part.lost for part, _ in parts)
        count = sum(phases[name][2] for _, phases in runs)
        yield Line(f'during {name}: latency p99 over idle; messages lost', f'{middle:.2f}; {lost} '
                   f'({count} calls)', len(runs), '≤ 2; 0', middle <= 2.0 and lost == 0)


def plain_figures(trials: Trials) -> str:
    """Return the plain figures as Markdown; they show the noise of the machine."""
    rows = []
    for name, each in trials.items():
        used = [one.cpu_us for one in each]
        rows.append((name, f'{np.median(used):.0f} ({min(used):.0f} to {max(used):.0f})', *(
            f'{np.median([one.latency_us(percent) for one in each]):.0f}' if each[0].heard else ''
            for percent in (50, 99))))
    return markdown(('at 1 kHz', 'CPU per message, µs: median (least to most)', 'p50, µs',
                     'p99, µs'), rows)


def imu_path(frame: Frame, turns: int = 5, quick: bool = False) -> Iterator[str]:
    """Yield the parts of the page; quick: one short turn."""
    turns, seconds, long = (1, 2.0, 5.0) if quick else (turns, 6.0, 60.0)
    rng = np.random.default_rng(SEED)
    with store_calibrations() as (linear, more):
        def node(path: Path, *parameters: str) -> list[str]:
            return [*node_command(f'calibration_file:={path}', *parameters), '--log-level',
                    'error']

        commands = {'serialized': relay_command('serialized'), 'node': node(linear),
                    'refined': node(more), 'typed': relay_command('typed')}
        steady: Trials = {name: [] for name in (*commands, 'sink', 'unheard')}
        flood: Trials = {'serialized': [], 'node': []}
        starts: dict[str, list[float]] = {'serialized': [], 'node': [], 'often': []}
        runs = []
        for turn in range(turns):
            for name, command in commands.items():
                steady[name].append(between(command, 1000.0, seconds))
            for name, command in (('sink', relay_command('sink')), ('unheard', commands['node'])):
                steady[name].append(between(command, 1000.0, seconds, listened=False))
            for name, each in flood.items():
                each.append(between(commands[name], 0.0, seconds))
            for name in list(starts) * 4:
                if name == 'often':
                    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(OFTEN)
                starts[name].append(between(commands.get(name, commands['node']), 1000.0, 0.0,
                                            lead=rng.uniform(1.0, 4.0)).start)
                os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
            with store_calibrations() as (own, _):  # the services store their results
                runs.append(run_calls(node(own, 'auto_capture:=false'), seconds))
            tell(f'turn {turn + 1} of {turns}')
        many = {name: [between(commands[name], 8000.0, long)] for name in flood}
    yield table([*lines_at_1_khz(steady), *lines_of_starts(starts),
                 *lines_under_load(flood, many, long), *lines_of_calls(runs)])
    yield plain_figures(steady)
