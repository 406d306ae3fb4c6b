# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of results that the JSON of the commands rounds or leaves out."""

from collections.abc import Callable
from typing import Any

from accel_calib.calibration import (
    Calibration, fit_partial, fit_poses, in_g, mounting_only, NextPose, outside, verify)
from accel_calib.comparison import Drift
from accel_calib.effects import add_history
from accel_calib.errors import AccelCalibError
from accel_calib.estimate import estimate, Fit, judge
from accel_calib.findings import Expected, Outlook, outlook, plan_lines, rate, request_words
from accel_calib.geometry import attitude_words
from accel_calib.refinement import refine
from accel_calib.table import Poses
from accel_calib.units import Units
from inside import (
    kinds, Linear, Model, probabilities, repeatability_of, rotation_free, search_effects, Set,
    spread_directions, unseen_mistakes)
import numpy as np

UP = spread_directions(4)

_OF_A_STEP = ('effect rivals probabilities data_probabilities parameters parameters_sd '
              'gap_before_mg gap_after_mg held_out_before_mg held_out_after_mg p_value name '
              'formula variable')


def attempt(function: Callable[..., Any], *given: Any, **options: Any) -> Any:
    """Return a result, or the refusal in its place; any other error is a defect of the test."""
    try:
        return function(*given, **options)
    except AccelCalibError as error:
        return error


def those(of: Any, names: str) -> dict[str, Any]:
    """Return some of the members of an object."""
    return {name: getattr(of, name) for name in names.split()}


def by_effect(model: Model, covariance: Any) -> dict[str, Any]:
    """Return values and standard deviations by effect, and the correlation of all values."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size, found, start = np.where(deviation > 0.0, deviation, 1.0), {}, 0
    for name, values in model.values.items():
        found[name] = values, deviation[start:start + len(values)]
        start += len(values)
    return {**found, 'correlation': covariance / np.outer(size, size)}


def spread(covariances: Any) -> Any:
    """Return the standard deviations of (n, 3) vectors along the axes and along (1, 1, 1)."""
    return np.sqrt(np.column_stack([np.diagonal(covariances, axis1=1, axis2=2),
                                    np.sum(covariances, axis=(1, 2))]))


def of_calibration(calibration: Calibration) -> dict[str, Any]:
    """Return the figures of a calibration, and of what follows from it."""
    units, effects = calibration.units, calibration.model.effects
    known = calibration.typical_context(len(UP))
    one = {key: each[:1] for key, each in known.items()}
    force = UP * calibration.force_per_g * [[0.3], [0.8], [1.1], [1.6]]
    wide = {key: (each.T * [0.4, 0.9, 1.1, 1.8]).T for key, each in known.items()}
    free = attempt(rotation_free, calibration, one, units.per_g)
    return {
        **those(calibration, 'name method units sensor frame rotation offset gain offset_sd '
                'gain_sd ranges quality rejected reason warnings gyro noise'),
        'values': by_effect(calibration.model, calibration.covariance),
        'rating': rate(calibration), 'outlook': _ahead(outlook(calibration)),
        'expected': of_expected(Expected(calibration)),
        'reading': attempt(calibration.predict, force, known),
        'force': attempt(calibration.correct, units.from_g(UP), wide),
        'spread': attempt(lambda: spread(calibration.force_covariance(force, known))),
        'free': free if isinstance(free, Exception) else {
            **those(free, 'values axes'), 'slope': np.linalg.norm(free.slope, axis=1)},
        'repeatability': (those(repeatability_of(calibration), 'chi2 dof stated belief')
                          if effects else ''),
        'repeats': Drift(calibration).repeats ** 0.5, 'outside': outside(calibration, wide)}


def _ahead(ahead: Outlook) -> dict[str, Any]:
    """Return what the poses of a calibration determine, and the next pose in words."""
    return {**those(ahead, 'identifiability uncertainty_mg'),
            'next_pose': of_next_pose(ahead.next_pose)}


def of_next_pose(asked: NextPose) -> dict[str, Any]:
    """Return the next pose, and what is asked for."""
    return {**those(asked, 'direction error total fits'), 'words': request_words(asked)}


def of_expected(expected: Expected) -> dict[str, Any]:
    """Return the parts of the expected error."""
    return those(expected, 'dof stated_mg worst_mg omitted_mg noise_mg few hidden_mg '
                 'not_corrected inexact_mg error_mg own_mg before_mg')


def of_fit(fit: Fit) -> dict[str, Any]:
    """Return the figures of a fit."""
    return {'values': by_effect(fit.model, fit.covariance), 'residual': fit.residual,
            'columns': fit.columns, 'unseen': unseen_mistakes(fit),
            'of poses': fit.equations.of_poses(fit.residual),
            **those(fit.equations, 'count scale force pose'),
            **those(fit, 'dof chi2 variance variance_dof variance_factor undetermined at_bound')}


def fits(poses: Poses, units: Units, *asked: str) -> dict[str, Any]:
    """Return calibrations by model, ``model/algebraic``, ``prior`` or ``mounting``."""
    def fitted(name: str) -> Any:
        if name in ('prior', 'mounting'):
            made = (fit_partial if name == 'prior' else mounting_only)(poses, units)
            return of_calibration(made)
        model, _, method = name.partition('/')
        made = fit_poses(poses, units, model=model, method='algebraic' if method else 'ml')
        return {**of_calibration(made), 'verified': verify(made, poses)}

    return {name: attempt(fitted, name) for name in asked}


def refined(poses: Poses, units: Units, base: str) -> dict[str, Any]:
    """Return the figures of a refinement."""
    found = refine(poses, units, base=base)
    return {**those(found, 'verdict gap_mg remaining_gap_mg advice refusal stages force'),
            'steps': [{**those(step, _OF_A_STEP), 'where': step.where} for step in found.steps],
            'plan': {'lines': plan_lines(found.plan), 'poses': [
                {**those(each, 'up context separates expected'),
                 'words': attitude_words(np.array(each.up))} for each in found.plan.poses]},
            'calibration': of_calibration(found.calibration)}


def searched(poses: Poses, units: Units, base: str) -> dict[str, Any]:
    """Return what a search found near its final model, with the table of candidates."""
    calibration = fit_poses(poses, units, model=base)
    model = Model(calibration.model.values)
    found = search_effects(add_history(in_g(poses, calibration.units), model), model)
    near, linear, chosen = found.near, found.near.chosen.linear, found.near.chosen
    gain, rank = chosen.gains()
    walk = linear.choice * (linear.penalty > 0.0)
    price = linear.choice * len(chosen.blocks)
    best: dict[str, tuple[float, ...]] = {}
    for k, block in enumerate(linear.blocks):
        each = (float(gain[k]), float(rank[k]), block.tried, float(linear.score(
            chosen.rss - gain[k], chosen.parameters + rank[k] + block.searched,
            chosen.charge - price - walk + 2.0 * np.log(block.tried))))
        best[block.effect] = max(each, best.get(block.effect, each))
    return {
        **those(found, 'added outliers taken_back grid_g clipped curve'), 'candidates': best,
        'walk': found.walk and those(found.walk, 'ratio score likelihood_ratio'),
        'states': [those(each, 'rss dof floor_mg is_noise residual held_out')
                   for each in (found.base, found.final)],
        'chosen': {**those(chosen, 'out rss parameters'), 'charge': chosen.charge - price,
                   'score': chosen.score + price + walk, 'names': near.names,
                   'ranks': _ranks(chosen),
                   'shapes': [linear.blocks[k].shape for k in chosen.blocks]},
        'linear': {**those(linear, 'worth dof base_rss poses'), 'visible': _visible(linear),
                   'penalty': linear.penalty - walk,
                   'choice': linear.choice - 2.0 * np.log(1.0 + linear.kinds)},
        'probabilities': {name: probabilities(name, near) for name in near.names}}


def _ranks(chosen: Set) -> tuple[float, ...]:
    """Return the number of values that each block of a set determines beside those before it."""
    sizes = [len(chosen.instead(chosen.blocks[:count]).across)
             for count in range(len(chosen.blocks) + 1)]
    return tuple(np.diff(sizes).astype(float).tolist())


def _visible(linear: Linear) -> dict[str, float]:
    """Return the effect on the residuals of each candidate of typical size that shows."""
    found: dict[str, float] = {}
    for number, block in enumerate(linear.blocks):
        (own,), sizes = linear.products_with((number,)), linear.sizes[block.columns]
        own = own[:, block.columns]
        if np.linalg.eigvalsh(own)[-1] > 0.02 ** 2:
            square = np.linalg.eigvalsh(own * np.outer(sizes, sizes))[-1]
            found[block.effect] = max(float(np.sqrt(square)) * block.entry.typical,
                                      found.get(block.effect, 0.0))
    return found


def solved(poses: Poses, units: Units, *effects: str) -> dict[str, Any]:
    """Return the fit of any effects to the poses, and their equations before it."""
    poses_g = add_history(in_g(poses, units), Model({}))
    start = Model({name: np.zeros(1 if name == 'gain' else 3) for name in effects})
    return {'kinds': kinds(poses_g), 'start': of_fit(judge(start, poses_g)),
            'fit': of_fit(estimate(start, poses_g))}


LOOKS: dict[str, Callable[..., Any]] = {
    'fits': fits, 'refine': refined, 'search': searched, 'solve': solved}
"""Looks at poses, by name."""
