# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Golden results of functions over grids of their arguments, where recordings show only points."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import accel_calib as ac
from accel_calib.calibration import (
    Calibration, dilution, error_left_in, fit_poses, FleetPrior, gated, gyro_bias_of,
    identifiability, level, lies_in_cone, next_pose, Rejected, set_heading, with_given_mounting)
from accel_calib.comparison import compare
from accel_calib.effects import CHANGES, effect_named, EFFECTS, entry_of, MONOMIALS, PROCESSES
from accel_calib.estimate import estimate, Prior, variance_factor
from accel_calib.finding import Finding, LEVELS
from accel_calib.findings import Expected, LIMITS, rate
from accel_calib.geometry import coverage, StaticTransforms
from accel_calib.table import check_units
from accel_calib.units import FRAMES, units_of
from golden.driven import messages
from golden.figures import attempt, of_expected, of_fit, of_next_pose, those
from golden.screens import screens
from inside import (
    axes_of, believable, change, distinct, doubts_about_flat, equations, fault_of,
    find_undetermined, is_over, measured, missing_poses, Model, mounting, mounting_figures,
    on_one_scale, originals, outlier, p_values, posterior, refuse_if_unfit, Repeatability,
    rounding_left, Runs, sampled, shape_words, sound_rows, spread_directions, unit, with_heading,
    without_knocked)
import numpy as np
from shared import G, MPS2 as MS2, NATIVE, poses_of

SIDES = unit(np.array([each for each in product((1, 0, -1), repeat=3) if any(each)], float))
SENSOR = {'offset': (0.03, -0.02, 0.04), 'axis_gain': (0.01, -0.02, 0.015),
          'cross_axis': (0.006, -0.004, 0.005)}
K = np.arange(24.0)
CONTEXT: dict[str, Any] = {
    'time': 60.0 * K, 'temperature': 25.0 + 12.0 * np.sin(K / 3.0), 'new': K % 2,
    'supply_voltage': 3.3 + 0.1 * np.cos(K), 'temperature_rate': np.cos(K) / 60.0,
    'rate': np.column_stack([np.sin(K), np.cos(K), 0.1 * K]),
    'std': 2e-3 * (1.0 + np.column_stack([K % 3, K % 4, K % 5])),
    'since_turn': 40.0 * (K % 4),
    'previous': unit(np.column_stack([np.sin(K), np.cos(2 * K), np.sin(3 * K)]))}


def _fitted(seed: int = 1, *, model: str = '10', units: Any = 'g', effects: Any = SENSOR,
            poses: int = 16, **options: Any) -> Calibration:
    made = ac.simulate(effects, poses=poses, seed=seed, units=units, **options)
    return fit_poses(made, units_of(units), model=model, sensor='one')


def _grid(function: Callable[..., Any], *values: Any) -> dict[str, Any]:
    """Return the results of a function for all combinations of these arguments."""
    return {' '.join(map(str, each)): attempt(function, *each) for each in product(*values)}


def directions() -> Any:
    """Return what sets of directions determine, and what they lack."""
    rng, turn = np.random.default_rng(1), np.linspace(0.0, 5.5, 8)
    ring = np.column_stack([np.cos(turn), np.sin(turn), 0.3 * np.sin(2.0 * turn)])
    uneven = unit(SIDES + 0.05 * rng.normal(size=SIDES.shape))
    near, wide = rng.normal(size=(8, 3)), rng.normal(size=(14, 3))
    faces = SIDES[np.max(np.abs(SIDES), axis=1) == 1.0]
    sets = {'none': SIDES[:0], 'one': SIDES[:1], 'same': uneven[[3] * 5], 'faces': faces,
            'plane': ring * [1, 1, 0], 'thin': unit(ring * [1, 1, 0.5]), 'ring': unit(ring),
            'half': uneven[SIDES[:, 2] > 0.1],
            'near': unit(0.25 * near + SIDES[12]), 'nine': spread_directions(9),
            'random': unit(rng.normal(size=(11, 3))), 'wide': unit(wide + 0.9 * SIDES[12]),
            'all': uneven}

    def of(name: str, model: str) -> Any:
        up = sets[name]
        noise = 1e-4 * (1.0 + np.arange(len(up)) % 3)
        open_ = identifiability(model, up, noise)
        return [dilution(model, up, noise), dilution(model, up), shape_words(model, up),
                open_ if name != 'same' else open_.dilution, missing_poses(model, up),
                attempt(refuse_if_unfit, model, up) if name != 'same' else '',
                of_next_pose(next_pose(up, model, noise, noise_g=1e-4))]

    def whole(name: str) -> Any:
        up = sets[name]
        open_ = identifiability('10', up).undetermined
        return [coverage(up), distinct(up), lies_in_cone(up),
                find_undetermined('4', up) if open_ else '',
                [error_left_in('4', larger, up) for larger in ('7', '10')]]

    return {**_grid(of, sets, ('4', '7', '10')), **_grid(of, ('faces', 'wide'), ('12',)),
            **_grid(whole, [name for name in sets if name not in ('none', 'same')])}


def plans() -> Any:
    """Return the next poses from the first one to the last."""
    def of(model: str) -> Any:
        up, asked = np.zeros((0, 3)), []
        while len(up) < 30 and (not asked or asked[-1].direction is not None):
            asked.append(next_pose(up, model))
            if asked[-1].direction is not None:
                up = unit(np.vstack([up, asked[-1].direction + 0.02 * np.cos(len(up) + K[:3])]))
        return [those(each, 'direction error total fits') for each in asked]

    return _grid(of, ('4', '7', '10', '12'))


def noise() -> Any:
    """Return what is believed of the noise, of copies, and of a fit with little to check it."""
    std = np.full((6, 3), 2e-3)
    steps = np.array([0.0, 0.02, 0.049, 0.051, 0.08, 0.099, 0.101, 0.15, 0.3])

    def factor(dof: int, known: bool) -> Any:
        return [variance_factor(ratio * max(dof, 1), dof, known) for ratio in (
            1e-3, 0.05, 0.3, 0.7, 1.0, 1.3, 2.0, 5.0, 40.0, 700.0, 999.0, 1001.0, 2e3)]

    def copies(deviation: float) -> Any:
        near = np.array([0.123456789, 0.2, 0.9]) + steps[:, np.newaxis] * (
            1e-4 if deviation else 1e-7)
        return originals(poses_of(
            np.vstack([near, SIDES[:12]]), std=np.full((21, 3), deviation), count=np.ones(21),
            temperature=np.where(np.arange(21) == 4, 20.000002, 20.0)))

    def sample(count: int, together: int) -> Any:
        known = {'orientation': np.arange(count) // together} if together else {}
        return sampled(poses_of(np.ones((count, 3)), **known)).row

    return [
        _grid(factor, (-1, 0, 1, 2, 3, 5, 9, 30, 200), (True, False)),
        _grid(copies, (1e-3, 0.0)), rounding_left(np.linspace(0.0, 0.6, 25)),
        [believable(poses_of(SIDES[:6], std=each, count=np.full(6, 16.0)).noise) for each in (
            std, std * [[1], [1], [1], [0.05], [0.2], [7]], std * 1e-8, std * 0.0)],
        _grid(sample, (1999, 2001, 6001, 9000), (0, 1, 3, 700, 2500))]


def wiring() -> Any:
    """Return what is said about axes and units."""
    skew = np.linalg.qr(np.array([[1.0, 0.3, 0.1], [0.2, 1.0, -0.4], [-0.1, 0.4, 1.0]]))[0]

    def turned(degrees: float, axis: int) -> Any:
        cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return fault_of(np.roll([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], (axis, axis), (0, 1)))

    def permuted(order: Any, signs: Any) -> Any:
        matrix = np.diag(signs) @ np.eye(3)[list(order)]
        return [fault_of(matrix), fault_of(matrix @ skew)]

    def lengths(length: float) -> Any:
        made = poses_of(SIDES * length, reference=SIDES)
        return [attempt(check_units, *each) for each in (
            (made, G), (made, MS2), (poses_of(SIDES * 1e4, reference=SIDES * length), NATIVE))]

    return [_grid(permuted, ((0, 1, 2), (1, 0, 2), (2, 0, 1), (0, 2, 1)), product(
        (1.0, -1.0), repeat=3)), _grid(turned, (20.0, 24.9, 25.1, 60.0, 150.0, 179.5), (0, 1, 2)),
        _grid(lengths, (0.0, 0.3, 0.49, 0.51, 0.76, 0.78, 1.29, 1.31, 1.99, 2.01, 4.9, 7.4, 9.8,
                        12.7, 12.8, 19.7, 25.0, 32.0, 400.0, 980.0, 1e3, 8e3, 1.2e6)),
        [axes_of(each @ skew.T + 0.1, each) for each in (
            SIDES[:3], SIDES[SIDES[:, 2] == 0.0], SIDES * [1, 1, 0.05], SIDES * [1, 1, 0.2])]]


def mountings() -> Any:
    """Return mountings by flat poses and headings, in all frames."""
    made, ups = _fitted(), unit(np.array([
        *np.eye(3), *-np.eye(3), [0.1, -0.2, 1.0], [-0.3, 0.5, -0.8], [0.999, 0.02, 0.01],
        [0.98, 0.0, 0.17], [0.98, 0.0, 0.19], [0.0, 0.98, 0.17], [0.7, 0, 0.69], [0.72, 0, 0.69]]))
    turn = mounting(ups[6])

    def flat(frame: Any, k: int) -> Any:
        found = level(made, made.predict(ups[k:k + 1])[0], frame)
        nose = made.predict(unit(ups[k:k + 1] + np.array([0.3, -0.4, 0.5])))[0]
        doubts = [*doubts_about_flat(found.rotation, frame)]
        return [mounting(ups[k], frame), found.noted, doubts,
                attempt(lambda: set_heading(found, nose).rotation)]

    def near(degrees: float) -> Any:
        here = np.radians(degrees)
        tilted = ups[6] * np.cos(here) + turn[:, 0] * np.sin(here)
        levelled = replace(made, model=Model(made.model.values, turn))
        return [attempt(with_heading, turn, tilted),
                with_given_mounting(levelled, mounting(tilted)).rotation,
                level(levelled, made.predict(tilted[np.newaxis])[0], 'ros').rotation]

    return [_grid(flat, FRAMES, range(len(ups))), mounting_figures(turn, 'imu', 'base'),
            _grid(near, (4.0, 9.0, 11.0, 60.0, 84.0, 169.0, 171.0))]


def transforms() -> Any:
    """Return rotations between frames, after each of some static transforms."""
    tree = StaticTransforms()

    def add(parent: str, child: str, *quaternion: float) -> Any:
        changed = attempt(tree.add, parent, child, quaternion)
        return [changed, [tree.rotation(*each) for each in (
            ('base', 'imu'), ('/imu', '/lidar'), ('lidar', 'map'), ('imu', 'imu'))]]

    half, nan, inf = np.sqrt(0.5), np.nan, np.inf
    return [add(*each) for each in (
        ('mast', 'imu', 0.1, -0.2, 0.3, 0.927), ('/base', 'lidar', 0.0, 0.0, half, half),
        ('base', '/mast', half, 0.0, 0.0, half), ('map', 'dock', 0.0, 0.0, 0.0, 1.0),
        ('base', 'mast', half, 0.0, 0.0, half), ('base', 'mast', 0.0, half, 0.0, half),
        ('lidar', 'imu', 0.5, 0.5, 0.5, 0.5), ('', 'imu', 0.0, 0.0, 0.0, 1.0),
        ('mast', '/', 0.0, 0.0, 0.0, 1.0), ('imu', 'base', 0.0, 0.0, 0.0, 1.0),
        ('imu', 'imu', 0.0, 0.0, 0.0, 1.0), *(('mast', 'imu', *each) for each in (
            (0.0, 0.0, 0.0, 0.0), (0.0, nan, 0.0, 1.0), (0.0, 0.0, inf, 1.0), (1.0,) * 4)))]


def catalogue() -> Any:
    """Return the effects, their shapes, and what each adds to readings."""
    force = spread_directions(24) * np.linspace(0.4, 1.4, 24)[:, np.newaxis]
    curves = [f'empirical-{each}' for each in (
        'offset-time-1-3', 'gain.z-temperature-2', 'cross_axis-std-1-2', 'force-supply_voltage-1',
        'offset.y-force-1-4', 'offset-force-2', 'gain-temperature_rate-1-2', 'offset-time',
        'gain.x-time-25', 'gain.x-time-24', 'gain-force-1', 'offset.w-time-1', 'offset-time-2-1',
        'offset-time-0')]

    def is_effect(name: str) -> bool:
        try:
            effect_named(name)
        except KeyError:
            return False
        return True

    known = {name: is_effect(name) for name in curves}
    names = filter(known.get, curves)

    def of(name: str) -> Any:
        effect = entry_of(effect_named(name))
        shapes = [] if effect.shapes is None else list(effect.shapes(CONTEXT))
        few = [] if effect.shapes is None else [len(list(effect.shapes({
            key: each[:count] for key, each in CONTEXT.items()}))) for count in (1, 2, 3, 4, 7)]
        found = [those(effect, 'words term parameters unit typical plausible_g needs shape usual '
                       'over lagged family repeatable_g linear bends terms'), few, shapes,
                 [] if effect.output is None else effect.output(force[:5], np.array([0.33]))]
        for shape in [*shapes[1:-1:9], *shapes[-1:]] if shapes else [np.zeros(0)]:
            values = np.concatenate([1e-3 * (1.0 + K[:len(effect.parameters)]), shape])
            model = Model({} if not effect.terms else {effect_named(name): values})
            found.append([(model.at(CONTEXT).reading(force) - force)[::6], model.lags, np.sum(
                np.abs(model.basis(force, CONTEXT).full), axis=(0, 1)),
                model.at(CONTEXT).slope(force)[::9].sum(axis=2)])
        return found

    values = [[(float(each.value(x, 0.5, -0.2)), *map(float, each.gradient(x, 0.5, -0.2)))
               for x in (-1.2, -1.0, -0.3, 0.0, 0.7, 1.3)] for each in MONOMIALS[:25]]
    bare = ac.refine(ac.simulate(SENSOR, poses=24, units='g')).not_testable
    return [_grid(of, (*EFFECTS, *PROCESSES, *CHANGES, *names)), values, known,
            [f'{effect}: {needs}' for effect, needs in bare]]


def gyro() -> Any:
    """Return the bias of a gyro from rests of many kinds."""
    def of(count: int, kind: str) -> Any:
        rng, k = np.random.default_rng(count), np.arange(float(count))
        rate = np.array([0.01, -0.02, 0.005]) + rng.normal(size=(count, 3)) * 3e-4
        rate += np.outer(k % 6 == 5, [0.004] * 3) * (kind == 'turning')
        rate += np.outer(k, [2e-4, -1e-4, 2e-5]) * (kind == 'warm') + np.outer(
            k, [3e-5] * 3) * (kind == 'drift')
        more = {} if kind == 'bare' else {'count': np.full(count, 100.0), 'rate_std': np.full(
            (count, 3), 2e-3), 'time': 30.0 * k[::-1] if kind == 'turning' else 30.0 * k}
        return gyro_bias_of(poses_of(rate, rate=rate, **more, **(
            {'temperature': 20.0 + k} if kind == 'warm' else {})))

    def sized(size: float) -> Any:
        rate = np.outer(np.cos(np.arange(9.0)) * size / 5.0 + size, [1.0, 0.5, -0.2])
        return gyro_bias_of(poses_of(SIDES[:9], rate=rate))

    bias = of(14, 'warm')
    kinds = ('plain', 'turning', 'warm', 'drift', 'bare')
    return [_grid(of, (1, 2, 3, 5, 7, 8, 9, 10, 40), kinds), _grid(
            sized, (0.0, 0.03, 0.049, 0.06, 0.3, 0.99, 1.01, 5.0)),
            [bias.at(each) for each in (10.0, 20.0, 26.0, 33.0, 40.0, np.nan)]]


def changes() -> Any:
    """Return lasting changes of the errors of rests, by their kind, number and size."""
    ups = {'parked': unit(SIDES[[3] * 6] + 0.03 * np.cos(K[:18]).reshape(6, 3)),
           'turned': SIDES[3:9]}

    def of(name: str, rests: int, kind: str, size: float) -> Any:
        up = ups[name]
        error = (np.arange(6) >= 6 - rests) * size * (
            up @ [0.5, 0.3, 0.8] if kind == 'offset' else 1.0) + 2e-4 * np.cos(np.arange(6))
        error += 0.04 * (np.arange(6) == 1) * (size > 0.05)
        covariance = np.eye(6) * 3e-4 ** 2 + 2e-4 ** 2 * (up @ up.T)
        known = change(error, covariance, up)
        return None if known is None else [
            those(known, 'rests kind clear shift error'), np.sqrt(np.diag(known.covariance)),
            [is_over(known, part * error, covariance, up) for part in (0.0, 0.3, 0.7)]]

    return _grid(of, ups, (2, 3, 4, 6), ('offset', 'gain'), (
        0.001, 0.0015, 0.002, 0.003, 0.006, 0.02, 0.08, 0.3))


def gates() -> Any:
    """Return where the gate and the rating change their mind about a calibration."""
    made = _fitted(poses=20, units='m/s2', temperature=(20.0, 22.0))
    quality, values = made.quality, made.model.values

    def told(calibration: Calibration) -> Any:
        passed = attempt(gated, calibration)
        given = passed if isinstance(passed, Calibration) else calibration
        expected, verdict = Expected(given), rate(given)
        return [passed if isinstance(passed, Exception) else passed.noted, verdict.name,
                verdict.reason, verdict.next, expected.error_mg, expected.few, expected.dof]

    def valued(name: str, size: float) -> Any:
        model = Model({**values, name: size * np.array([0.0, 0.6, 0.8])})
        return told(replace(made, model=model))

    def measured(key: str, value: Any, hidden: bool) -> Any:
        known = replace(quality, rms_after_mg=3.0, chi2_per_dof=30.0) if hidden else quality
        return told(replace(made, quality=replace(known, **{key: value})))

    def rejected(count: int) -> Any:
        return told(replace(made, rejected=tuple(
            Rejected(k + 1, 'outlier: far', 'outlier') for k in range(count))))

    return [
        _grid(valued, ('offset', 'axis_gain'), (-1.5, -0.7, -0.6, 0.3, 0.99, 1.01, 1.2, 1.3)),
        _grid(lambda size: told(replace(made, covariance=made.covariance * size ** 2)), (
            0.5, 3.0, 8.0, 20.0, 60.0, 120.0)),
        [attempt(gated, replace(made, covariance=each)).__class__.__name__ for each in (
            np.triu(made.covariance), made.covariance * np.nan, -made.covariance,
            made.covariance * 0.0, made.covariance - 1e-6 * np.eye(9))],
        _grid(measured, ('rms_after_mg',), (
            0.5, 1.0, 1.4, 2.2, 4.0, 8.0, 20.0, 35.0, 49.0, 51.0), (False,)),
        _grid(measured, ('noise_floor_mg',), (0.05, 0.2, 0.5, 1.0, 1.5, 2.9, None), (True, False)),
        _grid(measured, ('chi2_per_dof',), (0.2, 0.9, 1.4, 1.9, 9.0, None), (True,)),
        _grid(measured, ('coverage',), (0.5, 0.84, 0.86), (False,)),
        _grid(measured, ('rms_before_mg',), (0.1, 0.5, 2.0), (True, False)),
        _grid(rejected, (1, 2, 4, 5, 9, 11)), LIMITS,
        [told(replace(made, noted=(Finding(kind, 'what', 'advice', level),)))
         for level in LEVELS for kind in ('edited', 'flat_pose', 'hardly_checked')],
        told(replace(made, poses=made.poses.with_columns(doubtful=(K[:20] % 7 == 3) * 1.0))),
        [attempt(gated, replace(made, model=Model(values, turn))).__class__.__name__ for turn in (
            np.diag([1.0, 1.0, -1.0]), np.eye(3) * 1.00001, np.eye(3) * (1.0 + 1e-8))]]


def rated_effects() -> Any:
    """Return ratings of effects that single samples are not corrected for, and wild rows."""
    made = _fitted(poses=24, **{key: CONTEXT[key] for key in (
        'time', 'temperature', 'supply_voltage')})
    poses = made.poses.with_columns(std=CONTEXT['std'])

    def of(name: str, values: Any) -> Any:
        model = Model({**made.model.values, effect_named(name): np.array(values)})
        covariance = np.eye(len(model.vector)) * 1e-8
        covariance[:9, :9] = made.covariance
        whole = replace(made, model=model, covariance=covariance, poses=poses)
        return [attempt(lambda: gated(whole).noted), attempt(
            lambda: [rate(whole), of_expected(Expected(whole)), whole.ranges])]

    def wild(units: Any, scale: float, zero: float) -> Any:
        reading = SIDES * scale + zero
        reading[1:9] *= np.array([[0.0, 2.9, 3.1, 6.0, 15.0, 22.0, 1e6, 1e12]]).T
        std = np.outer(10.0 ** np.linspace(-3, 2, 26), [0.3, 1.0, 0.5]) * scale
        sound, rejected = sound_rows(poses_of(reading, std=std, count=np.full(26, 4.0)), units)
        return [sound.row, rejected]

    return [[of(*each) for each in (
        ('offset_drift', (0.02, 0.0, 0.0, 600.0)), ('hysteresis', (0.003, 0.001, 0.004)),
        ('vibration_rectification', (30.0, 20.0, 10.0)), ('quadratic', (0.01, 0.02, 0.01)),
        ('offset_temperature', (1e-3, 1e-3, 2e-3)), ('warm_up', (0.01, 0.02, 0.01, 0.0, 400.0)),
        ('offset_step', (0.004, 0.001, 0.002, 700.0)), ('supply_ratio', (1.0, 0.1, 0.2, 0.1)),
        ('quadratic', (0.6, 0.1, 0.1)), ('empirical-offset-std-1', (1e-3,) * 3 + (0.0, 0.01)),
        ('empirical-gain.x-time-1-2', (2e-3, 1e-3, 0.0, 1400.0)))],
        [wild(G, 1.0, 0.0), wild(MS2, 9.8, 0.0), wild(NATIVE, 4096.0, 2000.0)]]


def comparisons() -> Any:
    """Return comparisons of calibrations of one sensor, and the statistics behind them."""
    one, two, three = (_fitted(k, poses=12 + 4 * k, temperature=(20.0, 20.0 + k))
                       for k in (1, 2, 3))
    other = _fitted(4, effects={**SENSOR, 'offset': (0.033, -0.02, 0.04)})
    warm, native = _fitted(5, temperature=(31.0, 33.0)), _fitted(7, units='native', noise=1e-3)
    known, poor = _fitted(11, model='12', reference=True), _fitted(9, poses=11, noise=0.1)
    flat = [level(each, each.predict(unit(np.array([[0.1, y, 1.0]])))[0], frame)
            for each, y, frame in ((one, 0.0, 'ros'), (two, 0.01, 'ned'))]
    half = fit_poses(one.poses.take(slice(2, None)), G, model='10')
    rng = np.random.default_rng(5)
    root = rng.normal(size=(4, 5, 5)) * 1e-3
    spread = root @ np.swapaxes(root, 1, 2)
    spread[2, 3], spread[2, :, 3] = 0.0, 0.0

    def runs(size: float, count: int, dof: float) -> Any:
        values = np.cos(np.arange(20.0) ** 2).reshape(4, 5) * 1e-3
        values[2, 3], values[1, 2] = 0.0, values[1, 2] + size * 3e-3
        made = Runs(values[:count], spread[:count], dof)
        return [made.squared, made.least, made.p_value, p_values(made), outlier(made)]

    def scaled(chi2s: Any, dofs: Any, beliefs: Any) -> Any:
        found = on_one_scale([Repeatability(np.eye(1), *each) for each in zip(
            chi2s, dofs, (1.2, 0.8, 0.0), beliefs, strict=True)])
        return [np.ravel(found.covariances), found.dof, found.noisier]

    return [[attempt(compare, each) for each in (
        (one, two), (one, two, three), (one, other, three), (one, warm),
        (one, _fitted(6, units='m/s2')), (native, native), (one, native), (one, poor, two, three),
        (_fitted(8, model='4'), one, _fitted(10, model='7')), (known, one), (*flat, three), (one,),
        (one, replace(two, sensor='two')), (one, one, two), (one, half),
        (one, replace(two, covariance=two.covariance * np.nan)))],
        _grid(runs, (0.0, 1.0, 2.0, 4.0, 9.0), (2, 3, 4), (3.0, 20.0, np.inf)),
        _grid(scaled, (
            (9.0, 12.0, 8.0), (9.0, 90.0, 8.0), (2.0, 0.0, 400.0), (30.0, 25.0, 28.0)), (
            (9, 10, 8), (1, 0, 3)), ((8.0, 8.0, 8.0), (8.0, 0.0, 0.0))),
        [those(Runs(each, np.zeros((2, 3, 3)), 5.0), 'squared p_value') for each in (
            np.zeros((2, 3)), np.eye(2, 3) * 1e-3, np.eye(2, 3))]]


def priors() -> Any:
    """Return fits with priors, from few poses to many, and without knocked poses."""
    prior = Prior(np.array([0.02] * 3 + [0.005] * 6), np.diag([1e-4] * 3 + [1e-5] * 6))
    start = Model({name: np.zeros(3) for name in SENSOR})

    def fit(count: int, factor: float) -> Any:
        made = ac.simulate(SENSOR, poses=count, units='g', seed=count)
        found = estimate(start, made, prior, factor)
        return [found.model.vector, np.sqrt(np.diag(found.covariance)), found.dof, found.chi2,
                found.undetermined]

    def knocked(*rows: int) -> Any:
        made = ac.simulate(SENSOR, directions=unit(spread_directions(12) * 0.3 + [0, 0, 1]),
                           units='g', seed=1)
        size = 1.0 + 0.02 * np.isin(np.arange(12), rows)[:, np.newaxis]
        found = without_knocked(made.with_columns(reading=made.reading * size), np.arange(12),
                                prior, 0.1, 0.25)
        return [found.kept, found.log_evidence, found.fit.factor, found.fit.model.vector]

    def moved(size: float) -> Any:
        values, covariance, words = posterior(prior.mean + size * 0.01 * np.cos(K[:9]), np.diag(
            1e-6 * (1.0 + K[:9])), FleetPrior('m', 5, prior))
        return [values, np.sqrt(np.diag(covariance)), words]

    return [_grid(fit, (1, 2, 3, 5, 9, 12), (1.0, 9.0)), [knocked(), knocked(3), knocked(3, 5)],
            _grid(moved, (0.0, 1.0, 3.0, 6.0, 20.0))]


def near_models() -> Any:
    """Return the equations of readings near models with bending effects and orientations."""
    up = spread_directions(24)
    model = Model({**{key: np.array(each) for key, each in SENSOR.items()},
                   'quadratic': np.array([0.02, -0.01, 0.03]),
                   'offset_temperature': np.array([1e-3, 2e-3, -1e-3, 120.0, 0.0])})
    added = 2e-3 * np.cos(np.arange(72.0)).reshape(24, 3)
    made = poses_of(model.at(CONTEXT).reading(up) + added, **CONTEXT, count=np.full(24, 9.0))
    found = {}
    for name, columns in {'alone': {}, 'known': {'reference': up}, 'shared': {
            'orientation': K // 2}, 'mixed': {'orientation': np.maximum(K // 2, 5) + (
                K > 20) * K}}.items():
        poses = made.with_columns(**columns)
        near = equations(model, measured(poses))
        found[name] = [near.residual, near.pose, near.scale, near.count, near.force, near.columns(
            model), near.of_poses(near.residual), attempt(lambda poses=poses: of_fit(
                estimate(model, poses)))]
    return found


SWEEPS: dict[str, Callable[[], Any]] = {
    each.__name__: each for each in (
        directions, plans, noise, wiring, mountings, transforms, catalogue, gyro, changes, gates,
        rated_effects, comparisons, priors, near_models, messages, screens)}
