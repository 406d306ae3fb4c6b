# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The Imu path: the cost of the node beside bare relays, in one run on one machine.

A driver, a relay or the node, and a user are separate processes. The relays and the node take
turns, and figures are medians over the turns. Ratios come first, because they depend least on the
machine::

    python benchmarks/imu_path.py --markdown docs/figures/imu_path.md

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
import os
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from accel_calib.calibration import Calibration, fit_poses, level  # noqa: E402
from accel_calib.effects import EffectKey, Model, model_with, simulate_poses  # noqa: E402
from accel_calib.geometry import spread_directions  # noqa: E402
from accel_calib.logs import write_table  # noqa: E402
from accel_calib.stored import write_calibration  # noqa: E402
from accel_calib.table import Floats  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, machine, markdown, parser, publish, table  # noqa: E402
from imu_trial import node, relay, Trial, trial  # noqa: E402
import numpy as np  # noqa: E402

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

_ABOUT = """\
Made by `python benchmarks/imu_path.py {command} --markdown FILE`. The node has a
levelled 10-parameter calibration, and the messages have covariances, which makes the most work.
Driver and user are rclpy processes too and share the cores with the node. A set is a turn of all
trials. The CPU time of the node excludes its worker process, which fits and refines. A start waits
until DDS finds the other processes, sometimes for an announcement that comes every 3 s. The caller
of `~/fit` and `~/refine` is an rclpy process too, and calls that are back to back load it much.

Machine: {machine}."""

Trials = dict[str, list[Trial]]


def calibration() -> Calibration:
    """Return a levelled 10-parameter calibration; its poses have further effects."""
    rng = np.random.default_rng(SEED)
    directions = spread_directions(36)
    context = {'temperature': 25.0 + 10.0 * rng.uniform(-1.0, 1.0, len(directions))}
    poses = simulate_poses(model_with({**EFFECTS, **MORE}), directions, rng, noise_g=0.0005,
                           context=context)
    poses = poses.with_columns(reading=UNITS.from_g(poses.reading),
                               std=UNITS.from_g(poses['std']))
    fitted = fit_poses(poses, UNITS, model='10')
    flat = np.array([[0.2, -0.4, 0.8]]) / np.sqrt(0.84) * UNITS.per_g
    return level(fitted, fitted.predict(flat)[0], 'ros')


def refined(linear: Calibration) -> Calibration:
    """Return the calibration with effects of temperature and a non-linear one."""
    model = Model({**linear.model.values, **MORE}, linear.model.rotation)
    covariance = np.eye(len(model.vector)) * 1e-9
    size = len(linear.covariance)
    covariance[:size, :size] = linear.covariance
    return replace(linear, model=model, covariance=covariance)


@contextmanager
def stored() -> Iterator[tuple[Path, Path]]:
    """Store both calibrations, with poses beside the linear one."""
    with tempfile.TemporaryDirectory() as folder:
        linear, more = Path(folder) / 'linear.yaml', Path(folder) / 'refined.yaml'
        made = calibration()
        write_calibration(linear, made)
        write_calibration(more, refined(made))
        write_table(linear.with_name('linear_poses.csv'), made.poses)
        yield linear, more


@dataclass(frozen=True)
class Phase:
    """A part of a trial: begin and end [ns], and the number of calls answered in it."""

    began: int
    ended: int
    calls: int


class Calls:
    """Calls of services, in phases of a trial one after the other."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.phases: dict[str, Phase] = {}

    def __call__(self) -> None:
        """Wait for an idle phase, then call ``~/fit`` and ``~/refine``."""
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from std_srvs.srv import Trigger
        context = rclpy.Context()
        rclpy.init(args=[], context=context)
        user = rclpy.create_node('caller', context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(user)
        time.sleep(3.0)
        began = time.monotonic_ns()
        time.sleep(self._seconds)
        self.phases['idle'] = Phase(began, time.monotonic_ns(), 0)
        for name in ('fit', 'refine'):
            client = user.create_client(Trigger, f'calibrator/{name}')
            client.wait_for_service(10.0)
            for pace, pause in PACES.items():
                began, until, calls = time.monotonic_ns(), time.monotonic() + self._seconds, 0
                while time.monotonic() < until:
                    future = client.call_async(Trigger.Request())
                    executor.spin_until_future_complete(future, timeout_sec=120.0)
                    if not future.result().success:
                        raise RuntimeError(future.result().message)
                    calls += 1
                    time.sleep(pause)
                self.phases[f'`~/{name}`, {pace}'] = Phase(began, time.monotonic_ns(), calls)
        executor.shutdown()
        user.destroy_node()
        context.try_shutdown()


def median(trials: list[Trial], of: Callable[[Trial], float]) -> float:
    """Return the median of a figure over trials."""
    return float(np.median([of(each) for each in trials]))


def ratio(trials: Trials, of: Callable[[Trial], float], one: str, other: str) -> float:
    """Return the median ratio of two programs that ran in the same turn."""
    return float(np.median([of(a) / of(b) for a, b in zip(trials[one], trials[other])]))


def quantile(percent: float) -> Callable[[Trial], float]:
    """Return the function that returns this percentile of the latency [µs]."""
    return lambda each: float(np.percentile(each.latency_us, percent))


def cpu(each: Trial) -> float:
    """Return the CPU time per message [µs]."""
    return each.cpu_us


def at_1_khz(trials: Trials) -> list[Line]:
    """Return the lines of the trials at 1 kHz."""
    turns = len(trials['node'])
    over_raw = ratio(trials, cpu, 'node', 'serialized')
    over_typed = ratio(trials, cpu, 'node', 'typed')
    added = float(np.median([quantile(50)(a) - quantile(50)(b)
                             for a, b in zip(trials['node'], trials['serialized'])]))
    p99 = ratio(trials, quantile(99), 'node', 'serialized')
    more = ratio(trials, cpu, 'refined', 'node')
    unheard = ratio(trials, cpu, 'unheard', 'sink')
    saved = median(trials['node'], cpu) - median(trials['unheard'], cpu)
    return [
        Line('CPU per message at 1 kHz, over the bare serialized relay', f'{over_raw:.2f}',
             '≤ 1.5', turns, over_raw <= 1.5),
        Line('the same, over the bare typed relay under the default executor', f'{over_typed:.2f}',
             '≤ 0.5', turns, over_typed <= 0.5),
        Line('latency p50, added to that of the serialized relay', f'{added:.0f} µs', '≤ 50 µs',
             turns, added <= 50.0),
        Line('latency p99, over that of the serialized relay', f'{p99:.2f}', '≤ 1.3', turns,
             p99 <= 1.3),
        Line('CPU per message with temperature and non-linear effects, over the linear '
             'calibration', f'{more:.2f}', '≤ 1.3', turns, more <= 1.3),
        Line('CPU per message without a listener, over a bare subscriber that drops them',
             f'{unheard:.2f} ({saved:.0f} µs less than with a listener)',
             'publishers cost nothing', turns, None)]


def starts(relay_s: list[float], node_s: list[float], often_s: list[float]) -> list[Line]:
    """Return the lines of the times to the first corrected message [s]."""
    def words(seconds: list[float]) -> str:
        return f'{np.median(seconds):.2f} s ({min(seconds):.2f} to {max(seconds):.2f})'

    what = 'start of the node to the first corrected message'
    return [Line(what, f'{words(node_s)}; bare relay {words(relay_s)}', '≤ 1.5 s', len(node_s),
                 float(np.median(node_s)) <= 1.5),
            Line(f'{what}, all processes with `config/{OFTEN.name}`', words(often_s), '≤ 1.5 s',
                 len(often_s), float(np.median(often_s)) <= 1.5)]


def flooded(trials: Trials) -> Line:
    """Return the line of the trials without a pause."""
    share = ratio(trials, lambda each: each.rate, 'node', 'serialized')
    rates = [median(trials[name], lambda each: each.rate) for name in ('node', 'serialized')]
    return Line('flooded: messages/s received, over the bare serialized relay',
                f'{share:.2f} ({rates[0]:,.0f} of {rates[1]:,.0f})', '≥ 0.85',
                len(trials['node']), share >= 0.85)


def lossless(trials: Trials, seconds: float) -> Line:
    """Return the line of the trial at 8 kHz."""
    ours, bare = trials['node'][0], trials['serialized'][0]
    return Line(f'8 kHz for {seconds:.0f} s, depth 100: messages lost',
                f'{ours.lost} of {len(ours.sent):,} (bare relay: {bare.lost})', '0', 1,
                ours.lost == 0)


def while_computing(runs: list[tuple[Trial, Calls]]) -> list[Line]:
    """Return the lines of the trials in which services compute."""
    lines = []
    for name in list(runs[0][1].phases)[1:]:
        ratios, lost, count = [], 0, 0
        for each, called in runs:
            idle, phase = called.phases['idle'], called.phases[name]
            part = each.between(phase.began, phase.ended)
            ratios.append(float(np.percentile(part.latency_us, 99) / np.percentile(
                each.between(idle.began, idle.ended).latency_us, 99)))
            lost += part.lost
            count += phase.calls
        middle = float(np.median(ratios))
        lines.append(Line(f'during {name}: latency p99 over idle; messages lost',
                          f'{middle:.2f}; {lost} ({count} calls)', '≤ 2; 0', len(runs),
                          middle <= 2.0 and lost == 0))
    return lines


def figures_of(trials: Trials) -> str:
    """Return the plain figures as Markdown; they show the noise of the machine."""
    rows = []
    for name, each in trials.items():
        used = [one.cpu_us for one in each]
        heard = len(each[0].heard) > 0
        p50, p99 = ((f'{median(each, quantile(q)):.0f}' for q in (50, 99)) if heard else ('', ''))
        rows.append((name, f'{np.median(used):.0f} ({min(used):.0f} to {max(used):.0f})', p50,
                     p99))
    return markdown(('at 1 kHz', 'CPU per message, µs: median (least to most)', 'p50, µs',
                     'p99, µs'), rows)


def run(turns: int, seconds: float, long: float) -> Iterator[Any]:
    """Run all trials; yield the lines of the table, then the plain figures."""
    with stored() as (linear, more):
        commands = {'serialized': relay('serialized'), 'node': node(linear),
                    'refined': node(more), 'typed': relay('typed')}

        def pause() -> None:
            time.sleep(seconds)

        def start(command: list[str]) -> float:
            return trial(command, 1000.0, lambda: None, lead=rng.uniform(1.0, 4.0)).start

        rng = np.random.default_rng(SEED)
        steady: Trials = {name: [] for name in (*commands, 'sink', 'unheard')}
        flood: Trials = {'serialized': [], 'node': []}
        runs = []
        relay_s, node_s, often_s = [], [], []
        for turn in range(turns):
            for name, command in commands.items():
                steady[name].append(trial(command, 1000.0, pause))
            steady['sink'].append(trial(relay('sink'), 1000.0, pause, listened=False))
            steady['unheard'].append(trial(commands['node'], 1000.0, pause, listened=False))
            for name, each in flood.items():
                each.append(trial(commands[name], 0.0, pause))
            for _ in range(4):
                relay_s.append(start(commands['serialized']))
                node_s.append(start(commands['node']))
                os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(OFTEN)
                often_s.append(start(commands['node']))
                del os.environ['FASTRTPS_DEFAULT_PROFILES_FILE']
            calls = Calls(seconds)
            with stored() as (own, _):  # the services store their results
                runs.append((trial(node(own, 'auto_capture:=false'), 1000.0, calls), calls))
            print(f'turn {turn + 1} of {turns}', file=sys.stderr, flush=True)
        many = {name: [trial(commands[name], 8000.0, lambda: time.sleep(long))]
                for name in flood}
    yield [*at_1_khz(steady), *starts(relay_s, node_s, often_s), flooded(flood),
           lossless(many, long), *while_computing(runs)]
    yield figures_of(steady)


def main() -> int:
    """Run the benchmark."""
    options = parser(__doc__, turns=5)
    options.add_argument('--quick', action='store_true', help='one short turn')
    given = options.parse_args()
    before = machine()
    lines, plain = run(*((1, 2.0, 5.0) if given.quick else (given.turns, 6.0, 60.0)))
    command = '--quick' if given.quick else f'--turns {given.turns}'
    text = (f'# Figures of the Imu path\n\n{_ABOUT.format(command=command, machine=before)}\n\n'
            f'{table(lines)}\n\n{plain}\n')
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
