# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
One case of the refinement benchmark: poses with hidden effects, refined and judged.

A name is right if it is that of the hidden effect. It is right as a rival if it is another one
that states the hidden effect among its rivals. The effects of the base (offset, gains) and the
empirical term do not count as names. The empirical term is located if its words contain the
carrier and the variable of the hidden effect.

The reference is the true form, fitted to the same poses: offset, symmetric gain, the values of the
hidden effects and the time constant of a warm-up, together, by least squares on |a| = 1 g with the
true noise as weights, beginning at the truth. It searches nothing, so it names nothing wrongly.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import re
import time
import traceback
from typing import Any

from accel_calib.calibration import fit_poses, verify
from accel_calib.refinement import refine
from accel_calib.table import COLUMNS, Floats, Poses
from accel_calib.units import units_of
from generator import again, Setup, simulate, Simulated
from generator_effects import basis_of, ON_OUTPUT, OUTSIDE, STANDARD_GRAVITY
import numpy as np
from scipy.optimize import least_squares

BASE = ('offset', 'gain', 'axis_gain', 'cross_axis', 'misalignment')

SHOWS = 5.0
"""Change of |a| by a knock that must be detected, in units of the noise of a pose mean."""

WITHOUT_FORM = (*ON_OUTPUT, *OUTSIDE, 'offset_wander')
"""Effects that are not functions with a few values."""

EMPIRICAL = 'empirical'

CARRIERS = (('cross_axis', r'\bcross-axis'), ('gain', r'\bgain\b'), ('offset', r'\boffset\b'),
            ('force', r'\bsize of the force\b|\|force\||\|a\|'))
VARIABLES = (('temperature_rate', r'\brate\b'), ('temperature', r'\btemperature\b'),
             ('supply', r'\bsupply\b'), ('vibration', r'\bvibration\b'), ('time', r'\btime\b'),
             ('force', r'\bforce along\b'), ('direction', r'\bdirection\b'))
"""Words of carriers and variables, more specific ones first."""

Carried = tuple[tuple[str, str], ...]


def _all(effects: tuple[str, ...], *carried: tuple[str, str]) -> dict[str, Carried]:
    return dict.fromkeys(effects, carried)


CARRIER: dict[str, Carried] = {
    **_all(('quadratic', 'cubic', 'odd_quadratic', 'gain_asymmetry', 'ripple', 'quartic',
            'quintic', 'dead_zone'), ('offset', 'force'), ('gain', 'force'), ('force', 'force')),
    **_all(('cross_coupling',), ('cross_axis', 'force')),
    **_all(('oblique_cubic', 'oblique_hinge'), ('force', 'direction')),
    **_all(('offset_temperature', 'offset_temperature_quadratic', 'offset_temperature_cubic',
            'offset_temperature_knee'), ('offset', 'temperature')),
    **_all(('temperature_rate',), ('offset', 'temperature_rate')),
    **_all(('gain_temperature', 'gain_temperature_quadratic', 'gain_temperature_steep'),
           ('gain', 'temperature')),
    **_all(('cross_axis_temperature',), ('cross_axis', 'temperature')),
    **_all(('supply_ratio',), ('offset', 'supply'), ('gain', 'supply')),
    **_all(('offset_supply_quadratic',), ('offset', 'supply')),
    **_all(('offset_drift', 'warm_up', 'offset_wander', 'offset_step', 'periodic_offset',
            'wander_1f'), ('offset', 'time')),
    **_all(('gain_drift', 'gain_step', 'gain_periodic'), ('gain', 'time')),
    **_all(('vibration_rectification',), ('offset', 'vibration')),
    **_all(('hysteresis', 'creep', 'lever_arm', 'saturation', 'quantisation', 'repeatability')),
}
"""
What each effect changes, and with what: pairs of carrier and variable.

The carriers are offset, gain, cross_axis and force, the size of the force. The variables are time,
temperature, temperature_rate, force (along an axis), direction (of the force), supply and
vibration. Any one of the pairs is right. A function of the force along an axis has three: on the
unit sphere, the same change of |a| is that of an offset, of a gain or of the size of the force.
Effects without a pair have no such form.
"""

LAG_WITHIN = 0.1
"""Largest relative error of the lag of a thermometer."""

NOT_COMPARED = ('instant', 'limit', 'step')
"""Values that are not estimated with a standard deviation."""

_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_SWEEPS = 7


@dataclass(frozen=True)
class Case:
    """
    The effects to hide, and how to take the poses.

    Parameters
    ----------
    row : str
        Row of the table.
    hidden : mapping of str to float
        Sizes of the effects, by name.
    setup : Setup
        How to take the poses.
    seed : tuple of int
        Seed of the random numbers.
    against_truth : bool
        Whether to fit the true form too.
    group : str
        Group of the row.
    drawn : bool
        Whether the hidden effects are random.
    base : str
        Base of the refinement.
    columns : int
        Number of columns that the catalogue does not know. The first one is the temperature under
        another name, so that an effect of it is one of a column; the others are noise.

    """

    row: str
    hidden: Mapping[str, float]
    setup: Setup
    seed: tuple[int, ...]
    against_truth: bool = False
    group: str = ''
    drawn: bool = False
    base: str = '10'
    columns: int = 0


@dataclass(frozen=True)
class Fresh:
    """
    Residuals of fresh poses.

    Parameters
    ----------
    base_mg, refined_mg : float
        RMS with the base and with the refined calibration [mg].
    noise_mg : float
        RMS of the noise of the poses [mg].

    """

    base_mg: float
    refined_mg: float
    noise_mg: float


@dataclass(frozen=True)
class Outcome:
    """
    The result of a case.

    Parameters
    ----------
    case : Case
        The case.
    verdict : str
        Of the refinement; ``error`` if it raised an exception.
    named : tuple of (str, tuple of str)
        Each named effect with its rivals.
    disturbed : frozenset of int
        Rows that were left out.
    knocked : mapping of int to float
        Rows that were knocked, and the change of |a| over the noise.
    deviations : tuple of float
        Errors of the values of the hidden effects over their standard deviations; empty if the
        refinement is refused.
    held_out : tuple of float or None
        Residual of fresh poses: of the refined calibration, and of the true form [mg].
    fresh : Fresh or None
        Residuals of fresh poses; None after an exception.
    where : tuple of str
        Words of each empirical term.
    lag : float or None
        The lag of `offset_temperature` [s]; None if it has none.
    seconds : float
        Duration of the refinement [s].
    said : tuple of (bool, bool, bool)
        Of each step: whether the named effect is the most probable of its list, whether the
        held-out residual falls, and whether the instant in its words is that of its values.
    error : str
        The traceback of the exception.

    """

    case: Case
    verdict: str
    named: tuple[tuple[str, tuple[str, ...]], ...]
    disturbed: frozenset[int]
    knocked: Mapping[int, float]
    deviations: tuple[float, ...]
    held_out: tuple[float, float] | None
    fresh: Fresh | None
    where: tuple[str, ...]
    lag: float | None
    seconds: float
    said: tuple[tuple[bool, bool, bool], ...] = ()
    error: str = ''

    @property
    def names(self) -> tuple[str, ...]:
        """Return the named effects."""
        return tuple(name for name, _ in self.named)

    @property
    def judgement(self) -> str:
        """Return ``exact``, ``rival``, ``wrong``, ``missed`` or ``error``."""
        if self.verdict == 'error':
            return 'error'
        found, wrong = set(), False
        for name, rivals in sorted(self.named, key=lambda step: step[0] not in self.case.hidden):
            meant = [truth for truth in self.case.hidden
                     if truth not in found and truth in (name, *rivals)]
            found |= set(meant[:1]) if name not in meant else {name}
            wrong = wrong or not meant
        if wrong:
            return 'wrong'
        if found != set(self.case.hidden):
            return 'missed'
        return 'exact' if set(self.names) == found else 'rival'

    @property
    def located(self) -> bool:
        """Return whether an empirical term has the carrier and the variable of a hidden effect."""
        truths = {pair for name in self.case.hidden for pair in CARRIER[name]}
        return any(carrier_of(words) in truths for words in self.where)

    @property
    def lag_found(self) -> bool:
        """Return whether the lag is right; its sign is a convention."""
        truth = abs(self.case.setup.lag)
        return self.lag is not None and abs(abs(self.lag) - truth) <= LAG_WITHIN * truth


def carrier_of(where: str) -> tuple[str, str]:
    """Return carrier and variable in the words of an empirical term; '' if there is none."""
    first = where.split(';')[0]
    found = [next((name for name, words in table if re.search(words, first)), '')
             for table in (CARRIERS, VARIABLES)]
    return found[0], found[1]


def run(case: Case) -> Outcome:
    """Simulate the poses of a case, refine them and judge the result."""
    made = simulate(np.random.default_rng(case.seed), case.hidden, case.setup)
    knocked = {row: abs(shown) / made.noise[row - 1] for row, shown in made.knocked.items()}
    poses = _with_columns(poses_of(made), case, 2)
    started = time.process_time()
    try:
        refined = refine(poses, units_of('m/s2'), base=case.base)
        seconds = time.process_time() - started
        named = tuple((_of_temperature(str(step.name)), tuple(map(_of_temperature, step.rivals)))
                      for step in refined.steps if step.effect not in (*BASE, EMPIRICAL))
        other = again(np.random.default_rng((*case.seed, 1)), made)
        fresh = _fresh(case, poses, refined, other)
        return Outcome(case, refined.verdict, named, frozenset(refined.disturbed_poses), knocked,
                       () if refined.refusal else _deviations(refined.calibration, made),
                       _held_out(case, fresh, made, other), fresh,
                       tuple(step.where for step in refined.steps if step.effect == EMPIRICAL),
                       _lag(refined), seconds, tuple(map(_said, refined.steps)))
    except Exception:
        return Outcome(case, 'error', (), frozenset(), knocked, (), None, None, (), None,
                       time.process_time() - started, error=traceback.format_exc())


def _said(step: Any) -> tuple[bool, bool, bool]:
    """Return whether a step says what was found, as `Outcome.said`."""
    instant = step.parameters.get('instant')
    words = re.search(r'between (\S+) and (\S+) s', step.where)
    on_output = step.effect in ON_OUTPUT
    return (next(iter(step.probabilities)) == step.effect,
            on_output or step.held_out_after_mg < step.held_out_before_mg,
            instant is None or (words is not None
                                and float(words[1]) <= instant <= float(words[2])))


def _with_columns(poses: Poses, case: Case, salt: int) -> Poses:
    """Return poses with the columns of a case in place of the temperature."""
    if not case.columns:
        return poses
    rng, columns = np.random.default_rng((*case.seed, salt)), dict(poses.columns)
    columns['column_0'] = columns.pop('temperature')
    for k in range(1, case.columns):
        noise = rng.normal(size=len(poses))
        columns[f'column_{k}'] = np.cumsum(noise) if k % 2 else noise
    return replace(poses, columns=columns)


def _of_temperature(name: str) -> str:
    """Return the name of an effect; those of the renamed temperature have their usual name."""
    kind, _, variable = name.partition('-')
    known = _COVARIATES.get(kind)
    return known if known and variable in ('column_0', 'column_0-2') else name


_COVARIATES = {'offset_covariate': 'offset_temperature', 'gain_covariate': 'gain_temperature'}


def _lag(refined: Any) -> float | None:
    """Return the lag of `offset_temperature`, or None."""
    for step in refined.steps:
        if step.effect == 'offset_temperature' and 'lag' in step.parameters:
            return float(step.parameters['lag'])
    return None


def _fresh(case: Case, poses: Poses, refined: Any, other: Simulated) -> Fresh:
    """Return what the base, and the refinement unless it is refused, leave in fresh poses."""
    base = fit_poses(poses, units_of('m/s2'), model=case.base)
    fresh = _with_columns(poses_of(other), case, 3)
    used = base if refined.refusal else refined.calibration
    return Fresh(verify(base, fresh).rms_after_mg, verify(used, fresh).rms_after_mg,
                 float(np.sqrt(np.mean(other.noise ** 2)) * 1e3))


def poses_of(made: Simulated) -> Poses:
    """Return simulated poses as the reader of pose tables does."""
    columns = {}
    for key, column in COLUMNS.items():
        parts = [made.columns[name] for name in column.names if name in made.columns]
        if len(parts) == len(column.names):
            columns[key] = np.column_stack(parts) if len(parts) > 1 else parts[0]
    return Poses(columns, np.arange(1, made.setup.poses + 1))


def _deviations(calibration: Any, made: Simulated) -> tuple[float, ...]:
    """Return the errors of the fitted values over their standard deviations."""
    fitted = dict(zip(calibration.parameters,
                      zip(calibration.model.vector, np.sqrt(np.diag(calibration.covariance))),
                      strict=True))
    found = []
    for effect, values in made.truth.items():
        for part, value in values.items():
            estimate, deviation = fitted.get(f'{effect}.{part}', (0.0, 0.0))
            if deviation > 0.0 and part not in NOT_COMPARED:
                found.append(float((estimate - value) / deviation))
    return tuple(found)


def _held_out(case: Case, fresh: Fresh, made: Simulated, other: Simulated
              ) -> tuple[float, float] | None:
    """Return the residuals of fresh poses: refined calibration and true form [mg]."""
    reference = true_form_residual_mg(made, other) if case.against_truth and case.hidden else None
    return None if reference is None else (fresh.refined_mg, reference)


@dataclass(frozen=True)
class _Form:
    """The hidden effects: names, sizes and numbers of their values."""

    names: tuple[str, ...]
    scales: tuple[float, ...]
    widths: tuple[int, ...]


def reading_of(made: Simulated) -> Floats:
    """Return the (n, 3) readings in g."""
    return np.column_stack([made.columns[name] for name in ('ax', 'ay', 'az')]) / STANDARD_GRAVITY


def true_form_residual_mg(made: Simulated, fresh: Simulated) -> float | None:
    """
    Return the residual that the true form leaves in fresh poses, RMS [mg].

    Parameters
    ----------
    made : Simulated
        The poses that it is fitted to.
    fresh : Simulated
        Other poses of the same sensor.

    Returns
    -------
    float or None
        None if a hidden effect has no form that can be fitted.

    """
    if any(name in WITHOUT_FORM for name in made.values):
        return None
    form = _Form(tuple(made.values),
                 tuple(float(np.linalg.norm(value)) for value in made.values.values()),
                 tuple(len(value) for value in made.values.values()))
    free = np.concatenate([
        made.traits.offset, [made.traits.gain[i, j] for i, j in _SYMMETRIC], [1.0],
        *(value / scale for value, scale in zip(made.values.values(), form.scales, strict=True))])

    def weighted(x: Floats) -> Floats:
        return _errors(x, form, made) / made.noise

    found = least_squares(weighted, free, x_scale='jac')
    left = _errors(found.x, form, fresh)
    return float(np.sqrt(np.mean(left ** 2)) * 1e3)


def _errors(free: Floats, form: _Form, made: Simulated) -> Floats:
    """Return |u| - 1 of each pose, with u found from the reading by iteration."""
    gain = np.zeros((3, 3))
    for value, (i, j) in zip(free[3:9], _SYMMETRIC, strict=True):
        gain[i, j] = gain[j, i] = value
    traits = replace(made.traits, offset=free[:3], gain=gain, tau=made.traits.tau * free[9])
    parts = np.split(free[10:], np.cumsum(form.widths)[:-1])
    linear = np.linalg.solve(gain, (reading_of(made) - free[:3]).T).T
    inverse, u = np.linalg.inv(gain).T, linear
    for _ in range(_SWEEPS if form.names else 0):
        around = replace(made.around, force=u)
        added = sum(basis_of(name, around, traits) @ (part * scale)
                    for name, part, scale in zip(form.names, parts, form.scales, strict=True))
        u = linear - added @ inverse
    return np.linalg.norm(u, axis=1) - 1.0
