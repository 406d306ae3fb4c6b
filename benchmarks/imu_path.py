# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The Imu path: the cost of the node beside bare relays, in one run on one machine."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from operator import attrgetter, methodcaller
import os
from pathlib import Path
import tempfile
import time

import accel_calib as ac
from accel_calib.calibration import Calibration, fit_poses, level
from accel_calib.logs import write_table
from accel_calib.stored import write_calibration
from accel_calib.units import units_of
from figures import check, Frame, Line, markdown, ROOT, table, tell
import nodes
from nodes import CALIBRATED, Caller, client, node_command, run_trial, Trial
import numpy as np
from shared import KNOWN, with_effects

UNITS = units_of('m/s2')
SEED = 2030
MORE = {**nodes.MORE, 'gain_temperature': [3e-4, 2e-4, -1e-4]}
"""Effects of the refined calibration beside those of `KNOWN`."""

PACES = {'five times a second': 0.2, 'back to back': 0.0}
"""Pauses between calls [s]."""

OFTEN = ROOT / 'config' / 'fast_dds.xml'
"""Profile that makes DDS announce a process more often than every 3 s."""

Trials = dict[str, list[Trial]]
Phases = dict[str, tuple[int, int, int]]
"""Begin and end of parts of a trial [ns], and the number of calls answered in each."""


@contextmanager
def store_calibrations() -> Iterator[tuple[Path, Path]]:
    """Yield the files of a levelled calibration, with its poses, and of one with their effects."""
    warm = 25.0 + 10.0 * np.random.default_rng(SEED).uniform(-1.0, 1.0, 36)
    poses = ac.simulate({**KNOWN, **MORE}, poses=36, noise=0.0005, temperature=warm, seed=SEED)
    fitted = fit_poses(poses, UNITS, model='10')
    flat = np.array([[0.2, -0.4, 0.8]]) / np.sqrt(0.84) * UNITS.per_g
    linear: Calibration = level(fitted, fitted.predict(flat)[0], 'ros')
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / 'linear.yaml', Path(folder) / 'refined.yaml'
        write_calibration(paths[0], linear)
        write_calibration(paths[1], with_effects(linear, MORE, 1e-9))
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
    return run_trial({CALIBRATED: command}, rate, during if callable(during) else
                     lambda pid: time.sleep(during), listened=listened, lead=lead)


def ratio(trials: Trials, of: Callable[[Trial], float], one: str, other: str) -> float:
    """Return the median ratio of two programs that ran in the same turn."""
    return float(np.median([of(a) / of(b) for a, b in zip(trials[one], trials[other])]))


def lines_at_1_khz(trials: Trials) -> Iterator[Line]:
    turns, cpu_us, p99_us = len(trials['node']), attrgetter('cpu_us'), methodcaller(
        'latency_us', 99)
    heard, unheard = (np.median([each.cpu_us for each in trials[name]])
                      for name in ('node', 'unheard'))
    added = float(np.median([a.latency_us(50) - b.latency_us(50) for a, b in zip(
        trials['node'], trials['serialized'])]))
    for what, of, one, other, most in (
            ('CPU per message at 1 kHz, over the bare serialized relay', cpu_us, 'node',
             'serialized', 1.5),
            ('the same, over the bare typed relay under the default executor', cpu_us, 'node',
             'typed', 0.5),
            ('latency p99, over that of the serialized relay', p99_us, 'node', 'serialized', 1.3),
            ('CPU per message with temperature and non-linear effects, over the linear '
             'calibration', cpu_us, 'refined', 'node', 1.3)):
        over = ratio(trials, of, one, other)
        yield check(what, f'{over:.2f}', over, most=most, sets=turns)
    yield check('latency p50, added to that of the serialized relay', f'{added:.0f} µs', added,
                most=50.0, unit=' µs', sets=turns)
    yield Line('CPU per message without a listener, over a bare subscriber that drops them',
               f'{ratio(trials, cpu_us, "unheard", "sink"):.2f} ({heard - unheard:.0f} µs less '
               'than with a listener)', turns, 'publishers cost nothing')


def lines_of_starts(starts: dict[str, list[float]]) -> Iterator[Line]:
    """Yield the lines of the times to the first corrected message [s]."""
    words = {name: f'{np.median(each):.2f} s ({min(each):.2f} to {max(each):.2f})'
             for name, each in starts.items()}
    what = 'start of the node to the first corrected message'
    for more, name, beside in (('', 'node', f'; bare relay {words["serialized"]}'),
                               (f', all processes with `config/{OFTEN.name}`', 'often', '')):
        yield check(what + more, words[name] + beside, float(np.median(starts[name])), most=1.5,
                    unit=' s', sets=len(starts[name]))


def lines_under_load(flood: Trials, many: Trials, seconds: float) -> Iterator[Line]:
    """Yield the lines of the trials without a pause, and of those at 8 kHz."""
    part = ratio(flood, attrgetter('rate'), 'node', 'serialized')
    ours, bare = (np.median([each.rate for each in flood[name]])
                  for name in ('node', 'serialized'))
    yield check('flooded: messages/s received, over the bare serialized relay',
                f'{part:.2f} ({ours:,.0f} of {bare:,.0f})', part, least=0.85,
                sets=len(flood['node']))
    lost, bare_lost = (many[name][0].lost() for name in ('node', 'serialized'))
    yield check(f'8 kHz for {seconds:.0f} s: messages lost', f'{lost} of '
                f'{len(many["node"][0].sent):,} (bare relay: {bare_lost})', lost, least=0, most=0)


def lines_of_calls(runs: list[tuple[Trial, Phases]]) -> Iterator[Line]:
    """Yield the lines of the trials in which services compute."""
    for name in list(runs[0][1])[1:]:
        parts = [(each.between(*phases[name][:2]), each.between(*phases['idle'][:2]))
                 for each, phases in runs]
        middle = float(np.median([a.latency_us(99) / b.latency_us(99) for a, b in parts]))
        lost = sum(part.lost() for part, _ in parts)
        count = sum(phases[name][2] for _, phases in runs)
        yield Line(f'during {name}: latency p99 over idle; messages lost', f'{middle:.2f}; {lost} '
                   f'({count} calls)', len(runs), '≤ 2; 0', middle <= 2.0 and lost == 0)


def imu_path(frame: Frame, turns: int = 5, quick: bool = False) -> Iterator[str]:
    """Yield the parts of the page; quick: one short turn."""
    turns, seconds, long = (1, 2.0, 5.0) if quick else (turns, 6.0, 60.0)
    rng = np.random.default_rng(SEED)
    with store_calibrations() as (linear, more):
        def node(path: Path, *parameters: str) -> list[str]:
            return [*node_command(f'calibration_file:={path}', *parameters), '--log-level',
                    'error']

        commands = {'serialized': client('relay', 'serialized', CALIBRATED), 'node': node(linear),
                    'refined': node(more), 'typed': client('relay', 'typed', CALIBRATED)}
        unheard = {'sink': client('relay', 'sink', CALIBRATED), 'unheard': commands['node']}
        steady: Trials = {name: [] for name in (*commands, *unheard)}
        flood: Trials = {'serialized': [], 'node': []}
        starts: dict[str, list[float]] = {'serialized': [], 'node': [], 'often': []}
        runs = []
        for turn in range(turns):
            for name, command in commands.items():
                steady[name].append(between(command, 1000.0, seconds))
            for name, command in unheard.items():
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
    rows = []  # plain figures, which show the noise of the machine
    for name, each in steady.items():
        used = [one.cpu_us for one in each]
        rows.append((name, f'{np.median(used):.0f} ({min(used):.0f} to {max(used):.0f})', *(
            f'{np.median([one.latency_us(percent) for one in each]):.0f}' if each[0].heard else ''
            for percent in (50, 99))))
    yield markdown(('at 1 kHz', 'CPU per message, µs: median (least to most)', 'p50, µs',
                    'p99, µs'), rows)
