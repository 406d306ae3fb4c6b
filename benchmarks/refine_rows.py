# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The rows of the refinement benchmark: what is hidden in their sets.

A row consists of groups. A group draws the hidden effects and the settings of its sets from a
random generator, so that the sets depend only on the seed, the row and their number.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from generator import EFFECTS, ON_OUTPUT, OUTSIDE, Setup
import numpy as np
from refine_case import Case

CATALOGUE = tuple(name for name in EFFECTS if name not in OUTSIDE)
LOOK_ALIKE = ({'quadratic', 'gain_asymmetry', 'cross_coupling'}, {'cubic', 'odd_quadratic'},
              {'offset_drift', 'warm_up', 'offset_step'}, {'gain_drift', 'gain_step'})
PAIRED = tuple(name for name in CATALOGUE if name not in (*ON_OUTPUT, 'offset_wander'))
RISING = ('offset_temperature', 'offset_drift', 'warm_up')
LOST = {'offset_temperature': ('temperature',), 'gain_temperature': ('temperature',),
        'supply_ratio': ('supply_voltage',), 'offset_drift': ('time',), 'warm_up': ('time',),
        'offset_step': ('time',), 'lever_arm': ('gx', 'gy', 'gz'),
        'vibration_rectification': ('std_x', 'std_y', 'std_z', 'count'),
        'temperature_rate': ('temperature',), 'offset_temperature_quadratic': ('temperature',),
        'gain_drift': ('time',), 'gain_step': ('time',)}
BIG = tuple(name for name in PAIRED if name not in ('cubic', 'odd_quadratic'))
"""Effects of plausible values at a large size; the base absorbs too much of the others."""

ALONE = {'alone60': (60, 3.0), 'alone200': (200, 2.0), 'alone24': (24, 6.0)}
NOTHING = {'nothing24': 24, 'nothing60': 60, 'nothing200': 200}
SMALL = 0.3
SEVERAL = 5
"""Sets per set of a single effect, where no effect or random effects are hidden."""

LAGS = (30.0, 300.0)
"""Smallest and largest lag between sensor and thermometer [s]."""

Kind = tuple[dict[str, float], Setup]


@dataclass(frozen=True)
class Group:
    """
    Sets of a row that are counted together.

    Parameters
    ----------
    what : str
        Description; empty if the row has only one group.
    draw : callable
        Random generator -> hidden effects and settings of one set of each kind.
    drawn : bool
        Whether the hidden effects are random, and the kinds are therefore counted together.
    base : str
        Base of the refinement.
    columns : int
        As in `Case`.

    """

    what: str
    draw: Callable[[np.random.Generator], list[Kind]]
    drawn: bool = False
    base: str = '10'
    columns: int = 0


def _each(names: tuple[str, ...], size: float, setup: Setup = Setup()) -> Group:
    """Return a group with one set per effect."""
    return Group(f'{setup.poses} poses, size {size:g}',
                 lambda rng: [({name: size}, setup) for name in names])


def _drawn(what: str, sizes: tuple[float, ...], setup: Setup = Setup(),
           among: tuple[str, ...] = PAIRED) -> Group:
    """Return a group with random effects of these sizes; the first is from `among`."""
    def draw(rng: np.random.Generator) -> list[Kind]:
        return [(dict(zip(_unlike(rng, len(sizes), among), sizes, strict=True)), setup)
                for _ in range(SEVERAL)]

    return Group(what, draw, drawn=True)


def _unlike(rng: np.random.Generator, count: int, among: tuple[str, ...]) -> list[str]:
    """Draw effects that do not look alike; the first is from `among`."""
    while True:
        names: list[str] = rng.choice(PAIRED, count, replace=False).tolist()
        if names[0] in among and not any(len(family.intersection(names)) > 1
                                         for family in LOOK_ALIKE):
            return names


def _fixed(what: str, hidden: Mapping[str, float], *setups: Setup, base: str = '10') -> Group:
    """Return a group with the same effects in all sets."""
    return Group(what, lambda rng: [(dict(hidden), setup) for setup in setups
                                    for _ in range(SEVERAL)], base=base)


def _lagging(what: str, sign: float, size: float) -> Group:
    """Return a group with random lags between sensor and thermometer."""
    def draw(rng: np.random.Generator) -> list[Kind]:
        lags = np.exp(rng.uniform(np.log(LAGS[0]), np.log(LAGS[1]), SEVERAL))
        return [({'offset_temperature': size}, Setup(lag=float(sign * lag))) for lag in lags]

    return Group(what, draw)


_CHAMBER = {'offset_temperature': 5.0, 'gain_temperature': 5.0, 'warm_up': 5.0}

GROUPS: dict[str, tuple[Group, ...]] = {
    **{row: (_each(CATALOGUE, size, Setup(poses=poses)),)
       for row, (poses, size) in ALONE.items()},
    **{row: (_fixed(f'{poses} poses', {}, Setup(poses=poses)),)
       for row, poses in NOTHING.items()},
    'two': (_drawn('60 poses, size 5', (5.0, 5.0)),),
    'outside': (_each(OUTSIDE, 3.0),),
    'rising': (_each(RISING, 3.0, Setup(temperature='rising')),),
    'missing': (Group('', lambda rng: [({name: 3.0}, Setup(dropped=lost))
                                       for name, lost in LOST.items()]),),
    'knocked': (Group('', lambda rng: [({}, Setup(knocked=3))] * 3),),
    'small': (_each(tuple(name for name in CATALOGUE if name not in ON_OUTPUT), SMALL),),
    'faint': tuple(_each(CATALOGUE, size, Setup(poses=24)) for size in (1.5, 2.0)),
    'few': (*(_each(CATALOGUE, size, Setup(poses=16)) for size in (3.0, 5.0)),
            replace(_each(CATALOGUE, 8.0, Setup(poses=12)), base='auto')),
    'three': (_drawn('60 poses, size 3', (3.0,) * 3), _drawn('60 poses, size 5', (5.0,) * 3),
              _drawn('100 poses, size 3', (3.0,) * 3, Setup(poses=100))),
    'knocked_and_one': (
        *(_drawn(f'{count} knocked of 60', (5.0,), Setup(knocked=count)) for count in (3, 6, 9)),
        _drawn('2 knocked of 24', (5.0,), Setup(poses=24, knocked=2))),
    'lag': tuple(_lagging(f'{behind} lags, size {size:g}', sign, size)
                 for behind, sign in (('the thermometer', 1.0), ('the sensing element', -1.0))
                 for size in (20.0, 5.0)),
    'curved': (_fixed('', {'offset_temperature': 5.0, 'offset_temperature_quadratic': 5.0},
                      Setup()),),
    'chamber': (_fixed('', _CHAMBER, Setup()),),
    'sign': (_fixed('', {'hysteresis': 3.0}, Setup(hysteresis='sign')),),
    'spoiled': (
        _fixed('noise understated 2 times', {}, Setup(understated=2.0)),
        _fixed('noise understated 2 times, 24 poses', {}, Setup(poses=24, understated=2.0)),
        _fixed('heavy tails', {}, Setup(heavy=True)),
        _fixed('heavy tails, 24 poses', {}, Setup(poses=24, heavy=True)),
        _fixed('rows of one orientation in a row', {}, Setup(poses=24, repeats=3),
               Setup(poses=64, repeats=8), Setup(repeats=5), base='auto'),
        *(_fixed(f'scatter of {size:g} times the noise, which differs 30 times, {poses} poses',
                 {'repeatability': size}, Setup(poses=poses, shaking=30.0))
          for poses in (60, 24) for size in (1.5, 5.0))),
    'flicker': tuple(_fixed(f'{poses} poses, size {size:g}', {'wander_1f': size},
                            Setup(poses=poses)) for poses in (60, 200) for size in (3.0, 8.0)),
    'large': (_drawn('60 poses, sizes 100 and 3', (100.0, 3.0), Setup(noise_mg=1.0), BIG),),
    'outside60': (_each(OUTSIDE, 8.0),),
    'outside200': tuple(_each(OUTSIDE, size, Setup(poses=200)) for size in (3.0, 8.0)),
    'columns': tuple(
        replace(_each(('offset_temperature', 'gain_temperature'), 3.0), columns=count,
                what=f'size 3, beside {count - 1} of noise') for count in (1, 10)),
    'noise_columns': (replace(_fixed('25 columns of noise', {}, Setup()), columns=25),),
}
"""The groups of each row; the seeds depend on the order of the rows."""

ROWS = tuple(GROUPS)

_APART = 1000
"""Difference between the seeds of the groups of a row."""


def cases_of(row: str, sets: int, seed: int) -> Iterator[Case]:
    """
    Yield the cases of a row.

    Parameters
    ----------
    row : str
        Of `ROWS`.
    sets : int
        Number of sets per effect; `SEVERAL` times as many if no effect or random ones are hidden.
    seed : int
        Seed of the random numbers.

    """
    for index, group in enumerate(GROUPS[row]):
        place = (seed, ROWS.index(row) + _APART * index)
        for number in range(sets):
            kinds = group.draw(np.random.default_rng((*place, number)))
            for kind, (hidden, setup) in enumerate(kinds):
                yield Case(row, hidden, setup, (*place, kind, number), row in ALONE,
                           group.what, group.drawn, group.base, group.columns)
