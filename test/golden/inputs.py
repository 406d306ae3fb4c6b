# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The pose tables and recordings of the golden cases, made by seeds; each function writes one."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from accel_calib.logs import write_table
from generator import Setup, simulate, write_csv
import numpy as np
import ramps
from shared import data, GRAVITY as G
import yaml

READING, REFERENCE = ('ax', 'ay', 'az'), ('ref_x', 'ref_y', 'ref_z')
SIDES = [*np.eye(3), *-np.eye(3), (1, 1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, 1),
         (-1, 1, -1), (1, -1, -1), (-1, -1, -1)]


def poses(path: Path, *, hidden: Mapping[str, float] | None = None, seed: int = 1,
          per_g: float = G, centre: float = 0.0, without: str = '', misplaced: float = -1.0,
          known_g: float = G, axes: Any = np.eye(3), shared: bool = False,
          wrong: Mapping[int, Any] = {}, copies: Mapping[int, int] = {}, cone: float = 180.0,
          sensor: str = '', **setup: Any) -> None:
    """
    Write a pose table of the independent simulator.

    ``hidden`` are the sizes of hidden effects, ``per_g`` and ``centre`` the unit, ``without`` the
    first letters of columns that are left out, ``misplaced`` the error of known orientations [°],
    ``known_g`` and ``axes`` their size and axes, ``shared`` whether repeated orientations are
    stated, ``wrong`` readings of rows or factors on them, ``copies`` rows that repeat others, and
    ``cone`` the largest angle from z [°]. ``sensor`` is the stated name.

    """
    rng = np.random.default_rng(seed)
    made = simulate(rng, hidden, Setup(**setup))
    columns = {name: each.copy() for name, each in made.columns.items()
               if not name.startswith(tuple(without.split()) or '?')}
    for name in columns:
        if name in READING or name.startswith('std'):
            columns[name] = columns[name] * per_g / G + centre * (name in READING)
    up = made.around.force
    if misplaced >= 0.0:
        known = up + np.radians(misplaced) * np.cross(rng.normal(size=up.shape), up)
        known = known / np.linalg.norm(known, axis=1, keepdims=True) @ np.transpose(axes) * known_g
        columns |= dict(zip(REFERENCE, known.T, strict=True))
    if shared:
        columns['orientation'] = np.arange(len(up)) // made.setup.repeats
    for row, each in wrong.items():
        for name, value in zip(READING, np.broadcast_to(each, 3), strict=True):
            columns[name][row - 1] = value if np.ndim(each) else columns[name][row - 1] * value
    for row, of in copies.items():
        for each in columns.values():
            each[row - 1] = each[of - 1]
    kept = up[:, 2] >= np.cos(np.radians(cone))
    write_csv(path, {name: each[kept] for name, each in columns.items()})
    _name(path, sensor)


def _name(path: Path, sensor: str) -> None:
    if sensor:
        path.write_text(f'# sensor: "{sensor}"\n{path.read_text(encoding="utf-8")}',
                        encoding='utf-8')


def fleet(path: Path) -> None:
    """Write the typical values of a fleet."""
    root = np.random.default_rng(1).normal(size=(9, 9)) * 0.003
    names = [f'{effect}.{part}' for effect, parts in (('offset', 'xyz'), ('axis_gain', 'xyz'), (
        'cross_axis', ('xy', 'xz', 'yz'))) for part in parts]
    content = {'format': 1, 'models': [{
        'model': 'm1', 'sensors': 12, 'names': names, 'mean': [0.02] * 3 + [0.01] * 6,
        'covariance': (root @ root.T + np.eye(9) * 1e-5).tolist()}]}
    path.write_text(yaml.safe_dump(content), encoding='utf-8')


def text(path: Path, *, content: str) -> None:
    """Write a text, perhaps in a folder of its own."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(content, encoding='utf-8')


def link(path: Path, *, to: str) -> None:
    """Make a symbolic link."""
    path.symlink_to(to)


def warming(path: Path, *, seed: int = 8, change: Mapping[float, Any] = {}, times: float = 1.0,
            without: Sequence[str] = (), poses: bool = False, sensor: str = '',
            units: str = 'm/s2', **ramp: Any) -> None:
    """
    Write a log of a still board whose temperature changes, or of twelve poses of its sensor.

    ``change`` are shifts of the readings [g] from a time on, and ``times`` a factor on them.

    """
    log = ramps.twelve_poses(seed) if poses else ramps.ramp(seed, **ramp)
    reading = log.reading * times
    for seconds, shift in change.items():
        reading = reading + np.outer(log['time'] > seconds, shift) * G
    columns = {**log.columns, 'reading': reading}
    write_table(path, replace(log, sensor=sensor, units=units, columns={
        key: each for key, each in columns.items() if key not in without}))


def real(path: Path, *, name: str) -> None:
    """Take a real recording; the test is skipped if it is missing."""
    path.symlink_to(data(name))


def samples(parts: Sequence[Mapping[str, Any]], *, seed: int = 1, rate: float = 50.0,
            noise: float = 2e-3, step: float = 0.0, limit: float = np.inf, gyro: float = 2e-3
            ) -> Any:
    """
    Return (n, 7) samples [s, g, rad/s] of a sensor that is turned from rest to rest.

    A part is a rest: ``up`` and ``s`` [s], and optionally ``turn`` [°/s], ``sway`` [g, Hz],
    ``shake`` (factor on the noise), ``knock`` [g], ``ramp`` [g/s], ``spin`` about the vertical
    [rad/s], ``shift`` of the offset [g], and ``gap`` before it [s]. ``step`` and ``limit`` are
    those of the output [g].

    """
    rng, rows, before, time = np.random.default_rng(seed), [], None, 1000.0
    for part in parts:
        up = np.array(part['up'], float) / np.linalg.norm(part['up'])
        if before is not None:
            share = np.linspace(0.0, 1.0, round(0.6 * rate))[1:-1, np.newaxis]
            moving = before * (1.0 - share) + up * share + 0.3 * np.sin(np.pi * share)
            rows.append(np.column_stack([time + np.arange(len(share)) / rate, moving,
                                         np.ones_like(moving)]))
            time += len(share) / rate
        time += part.get('gap', 0.0)
        here = np.arange(round(part.get('s', 3.0) * rate)) / rate
        force, spin = _at_rest(part, up, here[:, np.newaxis])
        force = force + rng.normal(size=force.shape) * noise * (part.get('shake', 1.0) - 1.0)
        rows.append(np.column_stack([time + here, force, np.broadcast_to(spin, force.shape)]))
        time, before = time + len(here) / rate, up
    table = np.concatenate(rows)
    reading = table[:, 1:4] * [1.02, 0.99, 1.01] + [0.03, -0.02, 0.04]
    reading = reading + rng.normal(size=reading.shape) * noise
    table[:, 1:4] = np.clip(np.round(reading / step) * step if step else reading, -limit, limit)
    table[:, 4:] += rng.normal(size=reading.shape) * gyro + [0.01, -0.02, 0.005]
    return table


def _at_rest(part: Mapping[str, Any], up: Any, here: Any) -> tuple[Any, Any]:
    """Return force [g] and rate [rad/s] at the (n, 1) times of a rest."""
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across, speed = across / np.linalg.norm(across), np.radians(part.get('turn', 0.0))
    size, frequency = part.get('sway', (0.0, 1.0))
    middle = np.abs(here - here[-1] / 2.0) < 0.05
    force = (up * np.cos(speed * here) + across * np.sin(speed * here)
             + size * np.sin(2.0 * np.pi * frequency * here) * [1.0, 0.4, 0.0]
             + part.get('ramp', 0.0) * here * [0.6, 0.8, 0.0] + part.get('shift', 0.0)
             + part.get('knock', 0.0) * middle * [0.3, 1.0, 0.2])
    return force, np.cross(up, across) * speed + up * part.get('spin', 0.0)


def recording(path: Path, *, parts: Sequence[Mapping[str, Any]] = (), per_g: float = G,
              vary: Mapping[str, Sequence[Any]] = {}, warming: float | None = None,
              sensor: str = '', **options: Any) -> None:
    """
    Write samples, by default of 14 sides; without a gyro if ``gyro`` is 0.

    ``vary`` are values of the members of a part, one rest each, after three quiet rests;
    ``warming`` is in °C/min.

    """
    varied = [{kind: value} for kind, values in vary.items() for value in values]
    ups = np.cos(np.outer(np.arange(1, len(varied) + 1), [1.0, 2.0, 3.5]))
    sides = SIDES[:3] if varied else SIDES
    table = samples(parts or [*({'up': up} for up in sides), *(
        {'up': up, 's': 4.0, **each} for up, each in zip(ups, varied, strict=True))], **options)
    table[:, 1:4] *= per_g
    names = ('time', *READING, 'gx', 'gy', 'gz')[:7 if options.get('gyro', 1.0) else 4]
    columns = dict(zip(names, table.T, strict=False))
    if warming is not None:
        columns['temperature'] = 20.0 + warming * (table[:, 0] - table[0, 0]) / 60.0
    write_csv(path, columns)
    _name(path, sensor)
