# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Which poses a fit and a refinement need: poor geometry, the next pose, and plans.

The plan of a refinement separates an effect from its twin. More poses of the same sensor are taken
by the plan: its first pose, and then the first pose of the next plan; or at random. A set ends
when one twin is certain, or after `LONGEST` poses.

"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import re

from accel_calib.calibration import directions_of, fit_poses, next_pose as next_asked, PlannedPose
from accel_calib.effects import Model, model_with, predict, sensor_force, simulate_poses
from accel_calib.errors import RefusedFitError
from accel_calib.estimate import closed_form, estimate, pose_noise, start_of
from accel_calib.geometry import ATTITUDES, spread_directions
from accel_calib.refinement import refine, Refinement, Step
from accel_calib.table import concatenated, Floats, Poses
from figures import check, Frame, Line, markdown, share, table
from generator import Around, measure, Setup, simulate, Simulated
import numpy as np
from sensors import length_error_mg, simulated_poses, tilt
from shared import directions_named, FACES, G, MPS2, poses_of, random_directions

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


@dataclass(frozen=True)
class Outcome:
    """The result of a set; errors are RMS errors of |a| [mg], NaN if there is no fit."""

    refused: bool  # for model 10
    error: float  # of model 10, or of the smaller model that the refusal offers
    forced: float  # of model 10, fitted even if it is refused; infinite if that fails
    offered: str = ''  # the smaller model that the refusal offers, if any
    added: int = 0  # number of poses that the refusal names
    with_added: float = np.nan  # of model 10 with these poses


def repeat_five(degrees: float, rng: np.random.Generator) -> Floats:
    """Repeat five random directions up to 12, each held some degrees off."""
    return tilt(random_directions(5, rng)[np.arange(COUNT) % 5], degrees, rng)


def draw_around(z: Floats, rng: np.random.Generator) -> Floats:
    """Draw directions with these components along a random axis."""
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, COUNT), np.sqrt(1.0 - z ** 2)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z]) @ axes.T


CASES: dict[str, tuple[Callable[..., Floats], float, float | None]] = {
    **{f'5 directions, held {off:g}° off': (repeat_five, off, 100.0 if off < 1 else None)
       for off in (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0)},
    **{f'in a {angle:g}° cone': (
        lambda angle, rng: draw_around(rng.uniform(np.cos(np.radians(angle)), 1.0, COUNT), rng),
        angle, 100.0 if angle <= 45 else None) for angle in (30.0, 45.0, 60.0, 75.0)},
    **{f'in a plane, held {off:g}° off': (
        lambda off, rng: tilt(draw_around(np.zeros(COUNT), rng), off, rng), off,
        100.0 if off < 2 else None) for off in (0.0, 1.0, 2.0, 5.0, 10.0)},
    **{f'six faces twice, held {off:g}° off': (
        lambda off, rng: tilt(np.vstack([FACES, FACES]), off, rng), off,
        100.0 if off < 0.5 else None) for off in (0.0, 0.5, 1.0, 2.0, 5.0)},
    'random directions': (lambda off, rng: random_directions(COUNT, rng), 0.0, 0.0),
    'spread, held 10° off': (lambda off, rng: tilt(spread_directions(COUNT), off, rng), 10.0, 0.0)}
"""How the directions are drawn, with an angle [°]; the share to be refused [%], if it is asked."""


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
    (draw, degrees, _), rng = CASES[name], np.random.default_rng([seed, number])
    model = draw_model(rng)
    reading = predict(model, random_directions(500, rng), {})
    poses = add_poses(None, model, draw(degrees, rng), rng)
    forced = force_fit(poses, reading)
    try:
        found = length_error_mg(fit_poses(poses, G, model='10').correct(reading))
        return Outcome(False, found, forced)
    except RefusedFitError as refusal:
        more = directions_named(refusal.advice)
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
        asked = CASES[name][2]
        if asked is not None:
            yield share(f'{name}: refused for model 10', (each.refused for each in outcomes),
                        least=asked, most=asked)
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
    Take the poses of a set, and return its errors and when the node asks for no more poses.

    The RMS errors of |a| on fresh directions are those from `FEWEST` poses on [mg]; NaN if the fit
    is refused. A node that always asks stops at infinitely many poses.

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


# ------------------------------------------------------------------------------------------ plans

TWINS = (('quadratic', 'gain_asymmetry', 3.0, 'wandering'),
         ('cubic', 'odd_quadratic', 3.0, 'wandering'),
         ('offset_temperature', 'offset_drift', 2.0, 'rising'))
"""Twins, the size of the hidden one, and the course of the temperature."""

CERTAIN = 0.95
LONGEST, TRIES = 40, 400
"""Most further poses of a set, and most sets that are tried: in many, the twins are no rivals."""

INTERVAL, SUPPLY = 35.0, 3.3
"""Usual time between poses [s], and supply [V]."""


@dataclass(frozen=True)
class Named:
    """The result of one set."""

    planned: float  # poses until a name is certain; infinite: more than `LONGEST`
    planned_right: bool  # whether that name is the hidden effect
    random: float  # the same with poses at random
    random_right: bool
    before: float  # probability of the hidden effect before the plan,
    expected: float  # that of the right one that the plan states,
    after: float  # and that of the hidden effect with all poses of the plan
    length: int  # poses of the first plan


def extend_set(made: Simulated, up: Floats, temperature: float, wait: float,
               rng: np.random.Generator) -> Simulated:
    """Return a pose table with one more pose, so many seconds after the last one."""
    setup = replace(made.setup, poses=1)
    sigma = setup.noise_mg * 1e-3 * setup.shaking ** rng.uniform(size=(1, 3))
    shaking = rng.normal(size=(1, 3, setup.samples)) * sigma[:, :, np.newaxis]
    elapsed, warm = made.columns['time'][-1:] + wait, np.array([temperature])
    around = Around(up[np.newaxis], elapsed, warm, warm, np.zeros(1), np.array([SUPPLY]),
                    rng.normal(size=(1, 3)) * 0.002, shaking, sigma)
    one = measure(rng, setup, around, made.traits, made.values)
    return replace(made, columns={name: np.append(values, one.columns[name])
                                  for name, values in made.columns.items()})


def follow_plan(made: Simulated, pose: PlannedPose, wait: float, rng: np.random.Generator
                ) -> Simulated:
    """Add a planned pose; what the plan leaves open is as usual."""
    temperature = pose.context.get('temperature', float(made.columns['temperature'][-1]))
    return extend_set(made, np.array(pose.up), temperature, max(wait, INTERVAL), rng)


def refine_set(made: Simulated, twins: Sequence[str]) -> tuple[Refinement, Step | None]:
    """Return the refinement of the poses, and its step that names one of the twins."""
    found = refine(simulated_poses(made), MPS2, base='10')
    return found, next((step for step in found.steps if step.effect in twins), None)


def take_until_certain(made: Simulated, twins: Sequence[str], rng: np.random.Generator, *,
                       by_plan: bool) -> tuple[float, bool]:
    """Return the number of poses until one of the twins is certain, and whether it is right."""
    known = made.columns['temperature']
    for count in range(LONGEST + 1):
        found, step = refine_set(made, twins)
        if step is not None and step.data_probabilities[step.effect] >= CERTAIN:
            return count, step.effect in made.truth
        up, warm = random_directions(1, rng)[0], float(rng.uniform(np.min(known), np.max(known)))
        if by_plan and found.plan.poses:
            first = found.plan.poses[0]
            made = follow_plan(made, first, first.context.get('time', 0.0), rng)
        else:
            made = extend_set(made, up, warm, INTERVAL, rng)
    return np.inf, False


def name_twin(index: int, seed: int, number: int) -> Named | None:
    """Return the outcome of one set, or None if the twins are no rivals in it."""
    first, second, size, course = TWINS[index]
    hidden, twins = (first, second)[number % 2], (first, second)
    made = simulate(np.random.default_rng((seed, index, number)), {hidden: size},
                    Setup(poses=24, rates='small', temperature=course))
    found, step = refine_set(made, twins)
    if step is None or not {*twins} <= {step.effect, *step.rivals} or (
            max(step.data_probabilities.values()) >= CERTAIN or not found.plan.poses):
        return None
    rngs = [np.random.default_rng((seed, index, number, k)) for k in (1, 2, 3)]
    planned = take_until_certain(made, twins, rngs[0], by_plan=True)
    random = take_until_certain(made, twins, rngs[1], by_plan=False)
    waited = 0.0
    for pose in found.plan.poses:
        wait = max(pose.context.get('time', 0.0) - waited, INTERVAL)
        waited += wait
        made = follow_plan(made, pose, wait, rngs[2])
    after = refine_set(made, twins)[1]
    return Named(*planned, *random, step.data_probabilities[hidden],
                 found.plan.poses[-1].expected,
                 after.data_probabilities.get(hidden, 0.0) if after else 0.0,
                 len(found.plan.poses))


def lines_of_twins(name: str, outcomes: Sequence[Named]) -> Iterator[Line]:
    sets = len(outcomes)
    planned, random = (float(np.median(each)) for each in zip(*(
        (o.planned, o.random) for o in outcomes)))
    words = [f'{each:.3g}' if np.isfinite(each) else f'over {LONGEST}'
             for each in (planned, random)]
    yield Line(f'{name}: poses until one is certain, planned instead of random (median)',
               ' instead of '.join(words), sets, 'fewer', planned < random)
    yield Line(f'{name}: the certain one is the hidden one, planned; random', '; '.join(
        f'{sum(getattr(o, f"{way}_right") for o in outcomes)}/'
        f'{sum(np.isfinite(getattr(o, way)) for o in outcomes)}' for way in ('planned', 'random')),
        sets)
    before, expected, after, length = np.mean([
        (o.before, o.expected, o.after, o.length) for o in outcomes], axis=0)
    error = np.std([o.after for o in outcomes]) / np.sqrt(sets)
    yield Line(f'{name}: mean probability of the hidden one, before the first plan ({length:.1f} '
               'poses); expected after it; found after it',
               f'{before:.2f}; {expected:.2f}; {after:.2f} ± {error:.2f}', sets)


def plans(frame: Frame, sets: int = 12, seed: int = 1) -> Iterator[str]:
    """Yield the table; `sets` is the number for each pair of twins."""
    lines: list[Line] = []
    for index, (first, second, *_) in enumerate(TWINS):
        outcomes: list[Named] = []
        for start in range(0, TRIES, sets):
            outcomes += filter(None, frame.run_sets(name_twin, sets, index, seed, first=start))
            if len(outcomes) >= sets:
                break
        lines += lines_of_twins(f'{first} and {second}', outcomes[:sets]) if outcomes else []
    yield table(lines)
