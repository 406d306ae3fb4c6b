# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Which poses a fit needs: poor geometry, and the order in which poses are asked for."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import re

from accel_calib.calibration import directions_of, fit_poses, next_pose as next_asked
from accel_calib.effects import Model, model_with, predict, sensor_force, simulate_poses
from accel_calib.errors import RefusedFitError
from accel_calib.estimate import closed_form, estimate, pose_noise, start_of
from accel_calib.geometry import ATTITUDES, spread_directions, unit
from accel_calib.table import concatenated, Floats, Poses
from accel_calib.units import units_of
from figures import check, Frame, Line, markdown, share, table
import numpy as np
from sensors import length_error_mg, tilt
from shared import FACES, poses_of, random_directions

G = units_of('g')
COUNT = 12
FAR = 10.0
"""An error of |a| that nobody accepts: twice that of leaving out the cross-axis gains [mg]."""

AIM = 0.3
FEWEST, MOST = 9, 26
OFF = 10.0
"""How far a person holds an attitude off, in each of two axes [°]."""

SHOWN = (9, 10, 11, 12, 14, 16, 18, 20, 24)

HEADS = ('12 poses', 'model 10 refused', 'error of the refused fit, median (worst) [mg]',
         'error if not refused [mg]', 'offered instead', 'its error [mg]', 'poses to add',
         'error with them [mg]')

Draw = Callable[[np.random.Generator], Floats]


@dataclass(frozen=True)
class Outcome:
    """The result of a set; errors are RMS errors of |a| [mg], NaN if there is no fit."""

    refused: bool  # for model 10
    error: float  # of model 10, or of the smaller model that the refusal offers
    forced: float  # of model 10, fitted even if it is refused; infinite if that fails
    offered: str = ''  # the smaller model that the refusal offers, if any
    added: int = 0  # number of poses that the refusal names
    with_added: float = np.nan  # of model 10 with these poses


def draw_few(degrees: float, directions: Floats | None = None) -> Draw:
    """Return a function that repeats few directions up to 12; by default five random ones."""
    def draw(rng: np.random.Generator) -> Floats:
        few = random_directions(5, rng) if directions is None else directions
        return tilt(few[np.arange(COUNT) % len(few)], degrees, rng)
    return draw


def draw_plane(degrees: float) -> Draw:
    """Return a function that draws poses about a random plane."""
    def draw(rng: np.random.Generator) -> Floats:
        angle = rng.uniform(0.0, 2.0 * np.pi, COUNT)
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        ring = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle]) @ axes.T
        return tilt(ring, degrees, rng)
    return draw


def draw_cone(degrees: float) -> Draw:
    """Return a function that draws poses evenly in a cone about a random axis."""
    def draw(rng: np.random.Generator) -> Floats:
        z = rng.uniform(np.cos(np.radians(degrees)), 1.0, COUNT)
        angle, radius = rng.uniform(0.0, 2.0 * np.pi, COUNT), np.sqrt(1.0 - z ** 2)
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z]) @ axes.T
    return draw


CASES: dict[str, tuple[Draw, float | None]] = {
    **{f'5 directions, held {off:g}° off': (draw_few(off), 1.0 if off < 1 else None)
       for off in (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0)},
    **{f'in a {angle:g}° cone': (draw_cone(angle), 1.0 if angle <= 45 else None)
       for angle in (30.0, 45.0, 60.0, 75.0)},
    **{f'in a plane, held {off:g}° off': (draw_plane(off), 1.0 if off < 2 else None)
       for off in (0.0, 1.0, 2.0, 5.0, 10.0)},
    **{f'six faces twice, held {off:g}° off': (draw_few(off, FACES), 1.0 if off < 0.5 else None)
       for off in (0.0, 0.5, 1.0, 2.0, 5.0)},
    'random directions': (lambda rng: random_directions(COUNT, rng), 0.0),
    'spread, held 10° off': (lambda rng: tilt(spread_directions(COUNT), 10.0, rng), 0.0)}
"""How the directions are drawn, and the share of sets to be refused; None: nothing is asked."""


def force_fit(poses: Poses, reading: Floats) -> float:
    """Return the error of a fit [mg], whatever the geometry; infinite if it fails."""
    if not np.all(np.isfinite(closed_form('10', poses.reading)[0])):
        return np.inf
    try:
        model = estimate(start_of('10', poses.reading), poses).model
        return length_error_mg(sensor_force(model, reading, {}))
    except (RefusedFitError, np.linalg.LinAlgError):
        return np.inf


def fit(poses: Poses, reading: Floats, model: str) -> float:
    """Return the error of a fit [mg]; NaN if it is refused."""
    try:
        return length_error_mg(fit_poses(poses, G, model=model).correct(reading))
    except RefusedFitError:
        return np.nan


def named_directions(advice: str) -> Floats:
    """Return the directions that words such as (+x -z) name, (n, 3)."""
    found = []
    for part in re.findall(r'\([-+xyz ]+\)', advice):
        signs = {axis: float(f'{sign}1') for sign, axis in re.findall('([+-])([xyz])', part)}
        found.append([signs.get(axis, 0.0) for axis in 'xyz'])
    return unit(np.array(found).reshape(-1, 3))


def draw_model(rng: np.random.Generator) -> Model:
    """Draw a sensor with offset, gains and cross-axis gains."""
    sizes = {'offset': 0.03, 'axis_gain': 0.02, 'cross_axis': 0.01}
    return model_with({name: rng.normal(size=3) * size for name, size in sizes.items()})


def add_poses(poses: Poses | None, model: Model, directions: Floats, rng: np.random.Generator
              ) -> Poses:
    """Return poses with more of the same sensor."""
    more = simulate_poses(model, directions, rng)
    return more if poses is None else poses_of(**concatenated([poses, more]).columns)


def fit_set(name: str, seed: int, number: int) -> Outcome:
    """Draw a set and fit it."""
    rng = np.random.default_rng([seed, number])
    model = draw_model(rng)
    reading = predict(model, random_directions(500, rng), {})
    poses = add_poses(None, model, CASES[name][0](rng), rng)
    forced = force_fit(poses, reading)
    try:
        found = length_error_mg(fit_poses(poses, G, model='10').correct(reading))
        return Outcome(False, found, forced)
    except RefusedFitError as refusal:
        more = named_directions(refusal.advice)
        offer = re.search(r'or use model (\d+)', refusal.advice)
        offered = offer.group(1) if offer else ''
        again = add_poses(poses, model, tilt(more, 5.0, rng), rng)
        return Outcome(True, fit(poses, reading, offered) if offered else np.nan, forced, offered,
                       len(more), fit(again, reading, '10'))


def median(values: Sequence[float]) -> str:
    """Return the median and the largest value as text; empty if there is none."""
    known = [value for value in values if not np.isnan(value)]
    return f'{np.median(known):.3g} ({np.max(known):.3g})' if known else ''


def row_of(name: str, outcomes: Sequence[Outcome]) -> list[str]:
    out = [each for each in outcomes if each.refused]
    offers = [f'{np.mean([each.offered == model for each in out]):.0%} {model}'
              for model in ('7', '4') if any(each.offered == model for each in out)]
    return [name, f'{len(out) / len(outcomes):.1%}', median([each.forced for each in out]),
            median([each.error for each in outcomes if not each.refused]), ', '.join(offers),
            median([each.error for each in out]),
            median([each.added for each in out]), median([each.with_added for each in out])]


def lines_of(found: dict[str, list[Outcome]]) -> Iterator[Line]:
    """Yield what is asked of each case, and of all sets."""
    for name, outcomes in found.items():
        asked = CASES[name][1]
        if asked is not None:
            yield share(f'{name}: refused for model 10', (each.refused for each in outcomes),
                        least=100.0 * asked, most=100.0 * asked)
    everything = [each for outcomes in found.values() for each in outcomes]
    kept = [each.error for each in everything if not each.refused]
    yield share(f'all sets whose fit would be wrong by more than {FAR:g} mg: refused',
                (each.refused for each in everything if each.forced > FAR), least=100.0)
    yield Line('all sets fitted: error of the norm, median (worst) [mg]', median(kept), len(kept))
    yield share('all sets refused: within 0.6 mg once the poses named are added',
                (each.with_added <= 0.6 for each in everything if each.refused))


def geometry(frame: Frame, sets: int = 200, seed: int = 1) -> Iterator[str]:
    outcomes = frame.run(fit_set, [(name, seed, number) for name in CASES
                                   for number in range(sets)])
    found = {name: outcomes[k * sets:(k + 1) * sets] for k, name in enumerate(CASES)}
    yield table(lines_of(found))
    yield markdown(HEADS, [row_of(*each) for each in found.items()])


Order = Callable[[Poses | None, int, np.random.Generator], Floats]


def as_asked(poses: Poses | None, count: int, rng: np.random.Generator) -> Floats:
    """Return the direction that the node asks for; a random attitude once it asks for none."""
    if poses is None:
        found = next_asked(np.zeros((0, 3)))
    else:
        directions = directions_of(poses, G)
        found = next_asked(directions, '10', pose_noise(poses.noise, directions))
    return ATTITUDES[rng.integers(26)] if found.direction is None else found.direction


ORDERS: dict[str, tuple[Order, bool]] = {
    'as asked, held 10° off': (as_asked, True),
    'as asked, held exactly': (as_asked, False),
    'faces, edges, corners, held 10° off': (lambda poses, count, rng: ATTITUDES[count % 26], True),
    'faces, edges, corners, held exactly': (
        lambda poses, count, rng: ATTITUDES[count % 26], False),
    'random among the 26, held 10° off': (
        lambda poses, count, rng: ATTITUDES[rng.integers(26)], True),
    'random directions': (lambda poses, count, rng: random_directions(1, rng)[0], False)}
"""The direction of the next pose, and whether a person holds it."""


def take(name: str, seed: int, number: int) -> tuple[list[float], float]:
    """
    Take the poses of a set.

    Returns
    -------
    list of float
        RMS error of |a| on fresh directions from `FEWEST` poses on [mg]; NaN if the fit is
        refused.
    float
        Number of poses at which the node asks for no more; infinite if it always asks.

    """
    (order, by_hand), rng = ORDERS[name], np.random.default_rng([seed, number])
    model, fresh = draw_model(rng), random_directions(500, rng)
    poses: Poses | None = None
    errors, enough = [], np.inf
    for count in range(MOST):
        direction = order(poses, count, rng)[np.newaxis]
        direction = tilt(direction, OFF, rng) if by_hand else direction
        poses = add_poses(poses, model, direction, rng)
        if count + 1 >= FEWEST:
            errors.append(fit(poses, predict(model, fresh, {}), '10'))
            if next_asked(directions_of(poses, G), '10').direction is None:
                enough = min(enough, count + 1)
    return errors, enough


def next_pose(frame: Frame, sets: int = 200, seed: int = 1) -> Iterator[str]:
    lines, needed, rows = [], {}, []
    for name, (order, _) in ORDERS.items():
        found = frame.run_sets(take, sets, name, seed)
        medians = np.median(np.nan_to_num([errors for errors, _ in found], nan=np.inf), axis=0)
        above = FEWEST + np.flatnonzero(~(medians <= AIM))
        needed[name] = FEWEST if len(above) == 0 else int(above[-1]) + 1
        rows.append((name, *(f'{medians[count - FEWEST]:.3f}' for count in SHOWN)))
        words = f'over {MOST}' if needed[name] > MOST else str(needed[name])
        lines.append(check(
            f'poses to {AIM} mg, {name}', words, needed[name], sets=sets,
            least=-np.inf if order is as_asked else needed['as asked, held 10° off'] + 1))
        if order is as_asked:
            enough = np.array([count for _, count in found])
            there = [errors[int(min(count, MOST)) - FEWEST] for errors, count in found]
            lines.append(Line(f'poses when the node asks for no more, {name}',
                              f'{np.median(enough):.0f} ({np.min(enough):.0f} to '
                              f'{np.max(enough):.0f}), {np.median(there):.3f} mg', sets))
    yield table(lines)
    yield markdown(('poses', *SHOWN), rows)
