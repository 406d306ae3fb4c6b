# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses that do not determine model 10: whether they are refused, and whether the advice helps.

12 poses of a sensor with offset, gains and cross-axis gains, 0.3 mg of noise per pose mean and
axis, in good directions and in directions that are poor in some way. Each set is fitted. The
tables have the share that is refused; the RMS error of |a| on fresh directions where it is fitted,
and where it is fitted although it is refused; the smaller model that the refusal offers; and the
error with the poses added that the refusal names, each held 5° off. "Held 1° off" means 1° in each
of two axes. Some sets of 12 random directions leave a region of the sphere uncovered.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
import re
import sys

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from accel_calib.calibration import fit_poses  # noqa: E402
from accel_calib.effects import predict, sensor_force, simulate_poses  # noqa: E402
from accel_calib.errors import RefusedFitError  # noqa: E402
from accel_calib.estimate import closed_form, estimate, start_of  # noqa: E402
from accel_calib.geometry import spread_directions  # noqa: E402
from accel_calib.table import Floats, Poses  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from directions import held, joined, length_error_mg, random_directions, sensor  # noqa: E402
from figures import Line, markdown, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402

G = units_of('g')
COUNT = 12
MODELS = ('4', '7', '9', '10', '12')
FAR = 10.0
"""An error of |a| that nobody accepts: twice that of leaving out the cross-axis gains [mg]."""

Draw = Callable[[np.random.Generator], Floats]


@dataclass(frozen=True)
class Outcome:
    """
    The result of a set; errors are RMS errors of |a| [mg], NaN if there is no fit.

    Parameters
    ----------
    refused : bool
        Whether model 10 is refused.
    determined : tuple of bool
        Whether each model of `MODELS` is fitted.
    error : float
        Of model 10, or of the smaller model that the refusal offers.
    forced : float
        Of model 10, fitted even if it is refused; infinite if that fails.
    offered : str
        The smaller model that the refusal offers; empty if there is none.
    added : int
        Number of poses that the refusal names.
    with_added : float
        Of model 10 with these poses.

    """

    refused: bool
    determined: tuple[bool, ...]
    error: float
    forced: float
    offered: str
    added: int
    with_added: float


def some(directions: Floats) -> Floats:
    """Repeat directions up to 12."""
    return directions[np.arange(COUNT) % len(directions)]


def faces(degrees: float) -> Draw:
    """Draw the six faces, each twice."""
    return lambda rng: held(some(np.vstack([np.eye(3), -np.eye(3)])), degrees, rng)


def five(degrees: float) -> Draw:
    """Draw poses about five random directions."""
    return lambda rng: held(some(random_directions(5, rng)), degrees, rng)


def plane(degrees: float) -> Draw:
    """Draw poses about a random plane."""
    def draw(rng: np.random.Generator) -> Floats:
        angle = rng.uniform(0.0, 2.0 * np.pi, COUNT)
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        ring = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle]) @ axes.T
        return held(ring, degrees, rng)
    return draw


def cone(degrees: float) -> Draw:
    """Draw poses evenly in a cone about a random axis."""
    def draw(rng: np.random.Generator) -> Floats:
        z = rng.uniform(np.cos(np.radians(degrees)), 1.0, COUNT)
        angle, radius = rng.uniform(0.0, 2.0 * np.pi, COUNT), np.sqrt(1.0 - z ** 2)
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z]) @ axes.T
    return draw


CASES: dict[str, tuple[Draw, float | None]] = {
    **{f'5 directions, held {off:g}° off': (five(off), 1.0 if off < 1 else None)
       for off in (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0)},
    **{f'in a {angle:g}° cone': (cone(angle), 1.0 if angle <= 45 else None)
       for angle in (30.0, 45.0, 60.0, 75.0)},
    **{f'in a plane, held {off:g}° off': (plane(off), 1.0 if off < 2 else None)
       for off in (0.0, 1.0, 2.0, 5.0, 10.0)},
    **{f'six faces twice, held {off:g}° off': (faces(off), 1.0 if off < 0.5 else None)
       for off in (0.0, 0.5, 1.0, 2.0, 5.0)},
    'random directions': (lambda rng: random_directions(COUNT, rng), 0.0),
    'spread, held 10° off': (lambda rng: held(spread_directions(COUNT), 10.0, rng), 0.0)}
"""How the directions are drawn, and the share of sets to be refused; None: nothing is asked."""


def forced(poses: Poses, reading: Floats) -> float:
    """Return the error of a fit [mg], whatever the geometry; infinite if it fails."""
    if not np.all(np.isfinite(closed_form('10', poses.reading)[0])):
        return np.inf
    try:
        model = estimate(start_of('10', poses.reading), poses).model
        return length_error_mg(sensor_force(model, reading, {}))
    except (RefusedFitError, np.linalg.LinAlgError):
        return np.inf


def fitted(poses: Poses, reading: Floats, model: str) -> float:
    """Return the error of a fit [mg]; NaN if it is refused."""
    try:
        return length_error_mg(fit_poses(poses, G, model=model).correct(reading))
    except RefusedFitError:
        return np.nan


def named(advice: str) -> Floats:
    """Return the directions that words such as (+x -z) name, (n, 3)."""
    found = []
    for part in re.findall(r'\([-+xyz ]+\)', advice):
        signs = {axis: float(f'{sign}1') for sign, axis in re.findall('([+-])([xyz])', part)}
        found.append([signs.get(axis, 0.0) for axis in 'xyz'])
    directions = np.array(found).reshape(-1, 3)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def run(draw: Draw, seed: Sequence[int]) -> Outcome:
    """Draw a set and fit it."""
    rng = np.random.default_rng(seed)
    model = sensor(rng)
    reading = predict(model, random_directions(500, rng), {})
    directions = draw(rng)
    poses = simulate_poses(model, directions, rng)
    error = forced(poses, reading)
    known = poses.with_columns(reference=directions)
    determined = tuple(not np.isnan(fitted(known if name == '12' else poses, reading, name))
                       for name in MODELS)
    try:
        found = length_error_mg(fit_poses(poses, G, model='10').correct(reading))
        return Outcome(False, determined, found, error, '', 0, np.nan)
    except RefusedFitError as refusal:
        more = named(refusal.advice)
        offer = re.search(r'or use model (\d+)', refusal.advice)
        offered = offer.group(1) if offer else ''
        again = joined(poses, simulate_poses(model, held(more, 5.0, rng), rng))
        smaller = fitted(poses, reading, offered) if offered else np.nan
        return Outcome(True, determined, smaller, error, offered, len(more),
                       fitted(again, reading, '10'))


def median(values: Sequence[float]) -> str:
    """Return the median and the largest value as text; empty if there is none."""
    known = [value for value in values if not np.isnan(value)]
    if not known:
        return ''
    return f'{np.median(known):.3g} ({np.max(known):.3g})'


def row(name: str, outcomes: Sequence[Outcome]) -> list[str]:
    """Return a row of the table by case."""
    out = [each for each in outcomes if each.refused]
    kept = [each for each in outcomes if not each.refused]
    offers = [f'{np.mean([each.offered == name for each in out]):.0%} {name}'
              for name in ('7', '4') if any(each.offered == name for each in out)]
    return [name, f'{len(out) / len(outcomes):.1%}', median([each.forced for each in out]),
            median([each.error for each in kept]), ', '.join(offers),
            median([each.error for each in out]),
            median([each.added for each in out]), median([each.with_added for each in out])]


def lines_of(name: str, outcomes: Sequence[Outcome], share: float | None) -> list[Line]:
    """Return the lines of what is asked of a case."""
    if share is None:
        return []
    refused = float(np.mean([each.refused for each in outcomes]))
    asked, met = ('100 %', refused == 1.0) if share else ('0 %', refused == 0.0)
    return [Line(f'{name}: refused for model 10', f'{refused:.1%}', asked, len(outcomes), met)]


def overall(outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines over all sets."""
    far = [each for each in outcomes if each.forced > FAR]
    out = [each for each in outcomes if each.refused]
    kept = [each.error for each in outcomes if not each.refused]
    helped = float(np.mean([each.with_added <= 0.6 for each in out]))
    caught = float(np.mean([each.refused for each in far]))
    return [Line(f'all sets whose fit would be wrong by more than {FAR:g} mg: refused',
                 f'{caught:.2%}', '100 %', len(far), caught == 1.0),
            Line('all sets fitted: error of the norm, median (worst) [mg]', median(kept), '',
                 len(kept), None),
            Line('all sets refused: within 0.6 mg once the poses named are added', f'{helped:.1%}',
                 '', len(out), None)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    given = parser(__doc__, sets=200, seed=1).parse_args(arguments)
    lines, everything, rows, models = [], [], [], []
    heads = ('12 poses', 'model 10 refused', 'error of the refused fit, median (worst) [mg]',
             'error if not refused [mg]', 'offered instead', 'its error [mg]', 'poses to add',
             'error with them [mg]')
    for name, (draw, share) in CASES.items():
        outcomes = [run(draw, [given.seed, k]) for k in range(given.sets)]
        everything += outcomes
        lines += lines_of(name, outcomes, share)
        rows.append(row(name, outcomes))
        shares = 1.0 - np.mean([each.determined for each in outcomes], axis=0)
        models.append((name, *(f'{each:.1%}' for each in shares)))
    text = (f'# Figures of poor geometry\n\n{__doc__.strip()}\n\nMade by `python '
            f'benchmarks/geometry.py --sets {given.sets} --seed {given.seed} --markdown FILE`.'
            f'\n\n{table(lines + overall(everything))}\n\n{markdown(heads, rows)}\n\n'
            f'{markdown(("refused for model", *MODELS), models)}\n')
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
