# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The rows of the refinement benchmark: what hides in which poses."""

from __future__ import annotations

from collections.abc import Iterator

from generator import EFFECTS, ON_OUTPUT, OUTSIDE, Setup
import numpy as np
from refine_case import Case

CATALOGUE = tuple(name for name in EFFECTS if name not in OUTSIDE)
LOOK_ALIKE = ({'quadratic', 'gain_asymmetry', 'cross_coupling'}, {'cubic', 'odd_quadratic'},
              {'offset_drift', 'warm_up', 'offset_step'})
PAIRED = tuple(name for name in CATALOGUE if name not in (*ON_OUTPUT, 'offset_wander'))
IN_TIME = ('temperature_rate', 'periodic_offset')
RISING = ('offset_temperature', 'offset_drift', 'warm_up')
LOST = {'offset_temperature': ('temperature',), 'gain_temperature': ('temperature',),
        'supply_ratio': ('supply_voltage',), 'offset_drift': ('time',), 'warm_up': ('time',),
        'offset_step': ('time',), 'lever_arm': ('gx', 'gy', 'gz'),
        'vibration_rectification': ('std_x', 'std_y', 'std_z', 'count')}
ALONE = {'alone60': (60, 3.0), 'alone200': (200, 2.0), 'alone24': (24, 6.0)}
SMALL = 0.3
NOTHING = {'nothing24': 24, 'nothing60': 60, 'nothing200': 200}
ROWS = (*ALONE, *NOTHING, 'two', 'outside', 'rising', 'missing', 'knocked', 'small')

Kind = tuple[dict[str, float], Setup]


def cases_of(row: str, sets: int, seed: int) -> Iterator[Case]:
    """
    Give the cases of a row.

    Parameters
    ----------
    row : str
        Of `ROWS`.
    sets : int
        How many of each effect; five times as many where nothing hides or two do.
    seed : int
        Another seed gives other sets.

    """
    place = (seed, ROWS.index(row))
    for number in range(sets):
        kinds = _kinds(row, np.random.default_rng((*place, number)))
        for kind, (hidden, setup) in enumerate(kinds):
            yield Case(row, hidden, setup, (*place, kind, number), row in ALONE)


def _kinds(row: str, rng: np.random.Generator) -> list[Kind]:
    """Give what hides in the sets of a row."""
    if row in ALONE:
        poses, size = ALONE[row]
        return [({name: size}, Setup(poses=poses)) for name in CATALOGUE]
    if row in NOTHING:
        return [({}, Setup(poses=NOTHING[row]))] * 5
    if row == 'two':
        return [({one: 5.0, two: 5.0}, Setup()) for one, two in _pairs(rng, 5)]
    one_by_one: dict[str, list[Kind]] = {
        'outside': [({name: 3.0}, Setup()) for name in OUTSIDE],
        'rising': [({name: 3.0}, Setup(temperature='rising')) for name in RISING],
        'missing': [({name: 3.0}, Setup(dropped=lost)) for name, lost in LOST.items()],
        'knocked': [({}, Setup(knocked=3))] * 3,
        'small': [({name: SMALL}, Setup()) for name in CATALOGUE if name not in ON_OUTPUT]}
    return one_by_one[row]


def _pairs(rng: np.random.Generator, count: int) -> list[tuple[str, str]]:
    """Draw pairs of effects that do not look alike."""
    pairs: list[tuple[str, str]] = []
    while len(pairs) < count:
        one, two = rng.choice(PAIRED, 2, replace=False).tolist()
        if not any({one, two} <= family for family in LOOK_ALIKE):
            pairs.append((one, two))
    return pairs
