# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The sets of the refinement benchmark: what is hidden in the poses of each row, and the true form.

A row consists of groups. A group draws the hidden effects and the settings of its sets from a
random generator, so that the sets depend only on the seed, the row and their number.

The true form is fitted to the same poses: offset, symmetric gain, the values of the hidden effects
and the time constant of a warm-up, together, by least squares on |a| = 1 g with the true noise as
weights, beginning at the truth. It searches nothing, so it names nothing wrongly.

"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from accel_calib.statistics import rms
from accel_calib.table import Floats
from accel_calib.units import MG
from generator import basis_of, EFFECTS, ON_OUTPUT, OUTSIDE, Setup, Simulated, STANDARD_GRAVITY
import numpy as np
from scipy.optimize import least_squares

CATALOGUE = tuple(name for name in EFFECTS if name not in (*OUTSIDE, 'creep'))
ALIKE = ({'quadratic', 'gain_asymmetry', 'cross_coupling'}, {'cubic', 'odd_quadratic'},
         {'offset_drift', 'warm_up', 'offset_step'}, {'gain_drift', 'gain_step'})
PAIRED = tuple(name for name in CATALOGUE if name not in (*ON_OUTPUT, 'offset_wander'))
LOST = {'offset_temperature': ('temperature',), 'gain_temperature': ('temperature',),
        'supply_ratio': ('supply_voltage',), 'offset_drift': ('time',), 'warm_up': ('time',),
        'offset_step': ('time',), 'lever_arm': ('gx', 'gy', 'gz'),
        'vibration_rectification': ('std_x', 'std_y', 'std_z', 'count'),
        'temperature_rate': ('temperature',), 'offset_temperature_quadratic': ('temperature',),
        'gain_drift': ('time',), 'gain_step': ('time',)}
"""Columns that are missing, by the hidden effect."""

BIG = tuple(name for name in PAIRED if name not in ('cubic', 'odd_quadratic'))
"""Effects of plausible values at a large size; the base absorbs too much of the others."""

ALONE = {'alone60': (60, 3.0), 'alone200': (200, 2.0), 'alone24': (24, 6.0)}
NOTHING = {'nothing24': 24, 'nothing60': 60, 'nothing200': 200}
SEVERAL = 5
"""Sets per set of a single effect, where no effect or random effects are hidden."""

LAGS = (30.0, 300.0)
"""Smallest and largest lag between sensor and thermometer [s]."""

Kind = tuple[dict[str, float], Setup]


@dataclass(frozen=True)
class Group:
    """Sets of a row that are counted together."""

    what: str
    # Random generator -> hidden effects and settings of one set of each kind.
    draw: Callable[[np.random.Generator], list[Kind]]
    drawn: bool = False  # whether the effects are random, and the kinds counted together
    base: str = '10'  # of the refinement
    # Columns that the catalogue does not know. The first one is the temperature under another
    # name, so that an effect of it is one of a column; the others are noise.
    columns: int = 0


@dataclass(frozen=True)
class Case:
    """The effects to hide, and how to take the poses."""

    row: str
    hidden: Mapping[str, float]  # sizes of the effects, by name
    setup: Setup
    seed: tuple[int, ...]
    index: int = 0  # of its group in the row

    @property
    def group(self) -> Group:
        """Return the group of the row."""
        return GROUPS[self.row][self.index]


def hide_each(title: str, names: tuple[str, ...], size: float, setup: Setup = Setup()) -> Group:
    """Return a group with one set per effect."""
    return Group(f'{title}, {setup.poses} poses, size {size:g}',
                 lambda rng: [({name: size}, setup) for name in names])


def hide_drawn(what: str, sizes: tuple[float, ...], setup: Setup = Setup(),
               among: tuple[str, ...] = PAIRED) -> Group:
    """Return a group with random effects that do not look alike; the first is from `among`."""
    def draw_names(rng: np.random.Generator) -> list[str]:
        while True:
            names: list[str] = rng.choice(PAIRED, len(sizes), replace=False).tolist()
            if names[0] in among and not any(len(family.intersection(names)) > 1
                                             for family in ALIKE):
                return names

    return Group(what, lambda rng: [(dict(zip(draw_names(rng), sizes, strict=True)), setup)
                                    for _ in range(SEVERAL)], drawn=True)


def hide(what: str, hidden: Mapping[str, float], *setups: Setup, base: str = '10') -> Group:
    """Return a group with the same effects in all sets."""
    return Group(what, lambda rng: [(dict(hidden), setup) for setup in setups
                                    for _ in range(SEVERAL)], base=base)


def hide_lag(what: str, sign: float, size: float) -> Group:
    """Return a group with random lags between sensor and thermometer."""
    def draw(rng: np.random.Generator) -> list[Kind]:
        lags = np.exp(rng.uniform(np.log(LAGS[0]), np.log(LAGS[1]), SEVERAL))
        return [({'offset_temperature': size}, Setup(lag=float(sign * lag))) for lag in lags]

    return Group(what, draw)


ONE, OUT, TURNS = 'one effect', 'outside the catalogue', 'what turns leave, size 3'
SCATTER = 'scatter of {:g} times the noise, which differs 30 times, {} poses'

GROUPS: dict[str, tuple[Group, ...]] = {
    **{row: (hide_each(ONE, CATALOGUE, size, Setup(poses=poses)),)
       for row, (poses, size) in ALONE.items()},
    **{row: (hide(f'nothing hidden, {poses} poses', {}, Setup(poses=poses)),)
       for row, poses in NOTHING.items()},
    'two': (hide_drawn('two effects, 60 poses, size 5', (5.0, 5.0)),),
    'outside': (hide_each(OUT, OUTSIDE, 3.0),),
    'rising': (hide_each('temperature rises with time',
                         ('offset_temperature', 'offset_drift', 'warm_up'), 3.0,
                         Setup(temperature='rising')),),
    'missing': (Group('column missing', lambda rng: [({name: 3.0}, Setup(dropped=lost))
                                                     for name, lost in LOST.items()]),),
    'knocked': (Group('three knocked in 60', lambda rng: [({}, Setup(knocked=3))] * 3),),
    'small': (hide_each('too small to be seen',
                        tuple(name for name in CATALOGUE if name not in ON_OUTPUT), 0.3),),
    'faint': tuple(hide_each(ONE, CATALOGUE, size, Setup(poses=24)) for size in (1.5, 2.0)),
    'few': (*(hide_each(ONE, CATALOGUE, size, Setup(poses=16)) for size in (3.0, 5.0)),
            replace(hide_each(ONE, CATALOGUE, 8.0, Setup(poses=12)), base='auto')),
    'three': (hide_drawn('three effects, 60 poses, size 3', (3.0,) * 3),
              hide_drawn('three effects, 60 poses, size 5', (5.0,) * 3),
              hide_drawn('three effects, 100 poses, size 3', (3.0,) * 3, Setup(poses=100))),
    'knocked_and_one': tuple(
        hide_drawn(f'one effect of size 5, {count} knocked of {poses}', (5.0,),
                   Setup(poses=poses, knocked=count))
        for count, poses in ((3, 60), (6, 60), (9, 60), (2, 24))),
    'lag': tuple(hide_lag(f'{behind} lags by 30 to 300 s, size {size:g}', sign, size)
                 for behind, sign in (('the thermometer', 1.0), ('the sensing element', -1.0))
                 for size in (20.0, 5.0)),
    'curved': (hide('offset linear and quadratic in temperature, size 5',
                    {'offset_temperature': 5.0, 'offset_temperature_quadratic': 5.0}, Setup()),),
    'chamber': (hide('offset and gain over temperature, and warm-up, size 5',
                     {'offset_temperature': 5.0, 'gain_temperature': 5.0, 'warm_up': 5.0},
                     Setup()),),
    'sign': (hide('hysteresis by the sign of the motion, size 3', {'hysteresis': 3.0},
                  Setup(hysteresis='sign')),),
    'spoiled': (
        hide('noise understated 2 times', {}, Setup(understated=2.0)),
        hide('noise understated 2 times, 24 poses', {}, Setup(poses=24, understated=2.0)),
        hide('heavy tails', {}, Setup(heavy=True)),
        hide('heavy tails, 24 poses', {}, Setup(poses=24, heavy=True)),
        hide('rows of one orientation in a row', {}, Setup(poses=24, repeats=3),
             Setup(poses=64, repeats=8), Setup(repeats=5), base='auto'),
        *(hide(SCATTER.format(size, poses), {'repeatability': size},
               Setup(poses=poses, shaking=30.0)) for poses in (60, 24) for size in (1.5, 5.0))),
    'flicker': tuple(hide(f'1/f noise of the offset, {poses} poses, size {size:g}',
                          {'wander_1f': size}, Setup(poses=poses))
                     for poses in (60, 200) for size in (3.0, 8.0)),
    'large': (hide_drawn('two effects, 60 poses, sizes 100 and 3', (100.0, 3.0),
                         Setup(noise_mg=1.0), BIG),),
    'outside60': (hide_each(OUT, OUTSIDE, 8.0),),
    'outside200': tuple(hide_each(OUT, OUTSIDE, size, Setup(poses=200)) for size in (3.0, 8.0)),
    'columns': tuple(
        replace(hide_each(f'an unknown column beside {count - 1} of noise',
                          ('offset_temperature', 'gain_temperature'), 3.0), columns=count)
        for count in (1, 10)),
    'noise_columns': (replace(hide('25 columns of noise', {}, Setup()), columns=25),),
    'memory': (hide(f'{TURNS}, hysteresis of two turns', {'hysteresis': 3.0},
                    Setup(hysteresis='memory')), hide(f'{TURNS}, creep', {'creep': 3.0}, Setup())),
}
"""The groups of each row; the seeds depend on the order of the rows."""

ROWS = tuple(GROUPS)


def cases_of(row: str, sets: int, seed: int) -> Iterator[Case]:
    """Yield the cases of a row, with some sets per effect; `SEVERAL` times as many if drawn."""
    for index, group in enumerate(GROUPS[row]):
        place = (seed, ROWS.index(row) + 1000 * index)
        for number in range(sets):
            kinds = group.draw(np.random.default_rng((*place, number)))
            for kind, (hidden, setup) in enumerate(kinds):
                yield Case(row, hidden, setup, (*place, kind, number), index)


SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
SWEEPS = 7
"""Iterations from a reading to the force."""


def true_form_error_mg(made: Simulated, fresh: Simulated) -> float | None:
    """
    Return the residual that the true form leaves in fresh poses, RMS [mg].

    It is fitted to other poses of the same sensor, `made`. None if a hidden effect is not a
    function with a few values.

    """
    if any(name in (*ON_OUTPUT, 'offset_wander') for name in made.values):
        return None
    scales = [float(np.linalg.norm(value)) for value in made.values.values()]
    ends = np.cumsum([len(value) for value in made.values.values()])

    def errors(free: Floats, poses: Simulated) -> Floats:
        """Return |u| - 1 of each pose over its noise; u is found from the reading by iteration."""
        gain = np.zeros((3, 3))
        for value, (i, j) in zip(free[3:9], SYMMETRIC, strict=True):
            gain[i, j] = gain[j, i] = value
        traits = replace(poses.traits, offset=free[:3], gain=gain, tau=poses.traits.tau * free[9])
        parts = np.split(free[10:], ends[:-1])
        reading = np.column_stack([poses.columns[name] for name in ('ax', 'ay', 'az')])
        linear = np.linalg.solve(gain, (reading / STANDARD_GRAVITY - free[:3]).T).T
        inverse, u = np.linalg.inv(gain).T, linear
        for _ in range(SWEEPS):
            around = replace(poses.around, force=u)
            added = sum(basis_of(name, around, traits) @ (part * scale)
                        for name, part, scale in zip(poses.values, parts, scales, strict=True))
            u = linear - added @ inverse
        return (np.linalg.norm(u, axis=1) - 1.0) / poses.noise

    free = np.concatenate([
        made.traits.offset, [made.traits.gain[i, j] for i, j in SYMMETRIC], [1.0],
        *(value / scale for value, scale in zip(made.values.values(), scales, strict=True))])
    found = least_squares(errors, free, x_scale='jac', args=(made,))
    return rms(errors(found.x, fresh) * fresh.noise) * MG
