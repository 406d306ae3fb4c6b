# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the directions of poses determine of a model.

**Information.** A pose with force u depends on the values of a model through the rows Φ(u). For a
pose of unknown orientation this is the one row û · basis(u) (see `accel_calib.estimate.equations`,
with A near I). For a pose of known orientation these are the three rows basis(u). With s_i the
noise of a pose relative to that of the median pose, the information of the poses is

    M = Σ Φ_iᵀ Φ_i / s_i²

The standard deviation of the corrected |force| (known orientation: of the force) in a direction d,
relative to the noise of a pose, is

    √(Φ(d) M⁻¹ Φ(d)ᵀ)

The largest value over the sphere is the dilution. It is about 1 for 12 poses that are spread
evenly. The singular vectors of the rows are combinations of parameters, ordered by how well the
poses determine them. The combinations that raise the dilution above the limit for a fit are not
determined. They are described by as few parameters as possible.

"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy

from .calibration import Calibration
from ..effects import Model, MODELS, parameter_names, with_vector
from ..estimate import fit_sphere
from ..geometry import cone_of, distinct, OVER_THE_SPHERE, unit
from ..table import Floats, Poses
from ..text import counted
from ..units import Units

LARGEST_DILUTION = 25.0
"""
Above this dilution a fit is refused.

The dilution is 400 for 12 poses in a 45° cone, 100 for poses in five directions with a spread of
2°, and 25 for the worst 1 % of 12 poses in random directions. With a noise of 0.3 mg per pose, 25
corresponds to an error of 8 mg in some direction. All fits that are wrong by 10 mg over the whole
sphere have a larger dilution; with a limit of 40, some of them would pass
(`benchmarks/poses.py`).

"""

WEAK_DILUTION = 10.0
"""Above this dilution a fit warns: the error of |force| is up to ten times that of a pose."""

NORM_MODELS = tuple(name for name, form in MODELS.items() if form.norm == name and form.gains)
"""Models for poses of unknown orientation; the smallest model is first."""

_SINGULAR, _NOTHING = 1e-6, 1e-14

_MAIN_PART = 0.3
"""Weights above this part of the largest weight are included in the words."""

_SMALL = 1e-3
"""Weights below this are omitted from a combination."""

_CONE = 30.0
"""
Largest angle between poses and their mean direction of a robot that cannot be turned over [°].

Robots with wheels or tracks tilt by 10° to 25°. No number of poses within 30° determines model 10:
the dilution is above 300 for 60 poses. Poses further apart, such as those in a ring or at right
angles, come from a sensor that can be turned.

"""

_OUT_OF_PLANE = 0.1
"""Smallest RMS distance of unit vectors from the nearest plane that is not a plane."""

_WIDE = 75.0
"""Angle above which poses are no longer described as near one direction [°]."""


@cache
def ideal_of(name: str) -> Model:
    """Return the model without errors; model 9 is model 10 in other axes."""
    form = MODELS[name]
    effects = MODELS[form.norm].effects if form.sensing_axes else form.effects
    return with_vector(effects, np.zeros(len(parameter_names(effects))))


def free_parameters(name: str) -> int:
    """Return the number of free parameters of a model: 4, 6 (g is known), 9, 9 or 12."""
    return len(ideal_of(name).vector)


def poses_needed(name: str) -> int:
    """Return the smallest number of poses that can determine a model."""
    return free_parameters(name) // (3 if MODELS[name].known_orientation else 1)


def rows_of(name: str, directions: Floats) -> Floats:
    """Return Φ at (n, 3) unit vectors: (n, 1, p), or (n, 3, p) for model 12."""
    basis = ideal_of(name).basis(directions, {})
    return basis.full if MODELS[name].known_orientation else basis.along(directions)[:, np.newaxis]


@cache
def _over_the_sphere(name: str) -> Floats:
    """Return the (m, 1 or 3, p) rows Φ at directions spread evenly over the sphere."""
    return rows_of(name, OVER_THE_SPHERE)


def _weighted_rows(name: str, directions: Floats, noise: Floats | None) -> Floats:
    """Return the (m, p) rows Φ / s of all poses."""
    rows = rows_of(name, directions)
    if noise is not None and len(rows):
        rows = rows * (np.median(noise) / noise)[:, np.newaxis, np.newaxis]
    return rows.reshape(-1, rows.shape[2])


def information_of(name: str, directions: Floats, noise: Floats | None = None) -> Floats:
    """Return the (p, p) information M; arguments as in `identifiability`."""
    rows = _weighted_rows(name, directions, noise)
    return rows.T @ rows


def dilution(name: str, directions: Floats, noise: Floats | None = None) -> float:
    """
    Return the largest error of |force| over the sphere, relative to that of a pose.

    Infinite if the poses do not determine a parameter. Arguments as in `identifiability`.

    """
    return dilution_of(name, information_of(name, directions, noise))


def dilution_of(name: str, information: Floats) -> float:
    """Return the dilution for the (p, p) information of poses."""
    ridge = _NOTHING * np.trace(information) + 1e-300
    inverse = np.linalg.inv(information + ridge * np.eye(len(information)))
    around = _over_the_sphere(name)
    found = float(np.sqrt(np.max(np.sum((around @ inverse) * around, axis=(1, 2)))))
    return found if found < 1.0 / _SINGULAR else np.inf


@dataclass(frozen=True)
class Combination:
    """
    A combination of parameters that the poses do not determine.

    `weights` has the weight of each parameter, the largest first; the sum of the squares is 1.

    """

    weights: Mapping[str, float]

    @property
    def main(self) -> dict[str, float]:
        """Return the weights that are not small."""
        least = _MAIN_PART * max(map(abs, self.weights.values()))
        return {name: weight for name, weight in self.weights.items() if abs(weight) > least}


@dataclass(frozen=True)
class Identifiability:
    """
    What poses determine of a model.

    Parameters
    ----------
    deviations : mapping of str to float
        Standard deviation of each parameter, relative to the noise of a pose; infinite if not
        determined at all.
    undetermined : tuple of Combination
        Combinations that the poses do not determine. They determine the rest of the model.
    dilution, mean_dilution : float
        Error of |force| relative to that of a pose: largest and RMS over the sphere.

    """

    model: str
    deviations: Mapping[str, float]
    undetermined: tuple[Combination, ...]
    dilution: float
    mean_dilution: float


def identifiability(name: str, directions: Floats, noise: Floats | None = None) -> Identifiability:
    """
    Return what poses determine of a model; it depends only on directions and noise.

    `name` is 4, 7, 9, 10 or 12. `directions` are (n, 3) unit vectors of force in the sensor axes;
    n can be 0. `noise` is (n,), of each pose, in any unit; by default it is equal for all poses.

    """
    names = parameter_names(ideal_of(name).effects)
    triangle = np.linalg.qr(_weighted_rows(name, directions, noise), mode='r')
    square = np.zeros((len(names), len(names)))
    square[:len(triangle)] = triangle
    _, scales, axes = np.linalg.svd(square)  # combinations as rows, the best determined first
    determined = scales > _SINGULAR * max(scales[0], 1.0)
    deviations = np.where(determined, 1.0 / np.where(determined, scales, 1.0), np.inf)
    share = np.vstack([axes.T ** 2, np.sum((_over_the_sphere(name) @ axes.T) ** 2, axis=1)])
    none = share < _NOTHING  # 0 times an infinite deviation is 0
    parts = np.where(none, 0.0, share) * np.where(none, 0.0, deviations ** 2)
    each = np.sqrt(np.sum(parts[:len(names)], axis=1))
    errors = np.cumsum(parts[len(names):], axis=1)  # from all up to this one
    open_, found = axes[np.sqrt(np.max(errors, axis=0)) > LARGEST_DILUTION], []
    if len(open_):  # as sparse combinations with the same span, each with its own pivot
        pivots = scipy.linalg.qr(open_, mode='r', pivoting=True)[1][:len(open_)]
        for row in unit(np.linalg.inv(open_[:, pivots])) @ open_:
            order = [k for k in np.argsort(-np.abs(row), kind='stable') if abs(row[k]) > _SMALL]
            sign = np.sign(row[order[0]])
            found.append(Combination({names[k]: float(sign * row[k]) for k in order}))
    found.sort(key=lambda each: names.index(next(iter(each.weights))))
    return Identifiability(name, dict(zip(names, map(float, each), strict=True)), tuple(found),
                           float(np.sqrt(np.max(errors[:, -1]))),
                           float(np.sqrt(np.mean(errors[:, -1]))))


def determines(name: str, directions: Floats, noise: Floats | None = None) -> bool:
    """Return whether poses determine a model; arguments as in `identifiability`."""
    return (len(directions) >= poses_needed(name)
            and dilution(name, directions, noise) <= LARGEST_DILUTION)


def error_left_in(smaller: str, larger: str, directions: Floats, noise: Floats | None = None
                  ) -> float:
    """
    Return the typical error of |force| if a model omits effects of a larger model [g].

    The omitted effects have their typical size. The fit partly absorbs them, which changes the
    correction over the whole sphere; the error is RMS over it. Both models are for poses of
    unknown orientation; directions and noise as in `identifiability`.

    """
    small, large = ideal_of(smaller), ideal_of(larger)
    more = ~np.isin(parameter_names(large.effects), parameter_names(small.effects))
    sizes = np.array([each.typical for each in large.terms.effects for _ in each.values])[more]
    added = np.linalg.lstsq(_weighted_rows(smaller, directions, noise),
                            _weighted_rows(larger, directions, noise)[:, more], rcond=None)[0]
    wrong = _over_the_sphere(larger)[:, 0, more] - _over_the_sphere(smaller)[:, 0] @ added
    return float(np.sqrt(np.sum(np.mean(wrong ** 2, axis=0) * sizes ** 2)))


def directions_of(poses: Poses, units: Units) -> Floats:
    """
    Return approximate directions of up before a fit, (n, 3) unit vectors in the sensor axes.

    They start from the centre of the readings if the poses determine it, or the unit is native.

    """
    raw = unit(poses.reading)
    if not units.is_native and dilution('4', raw) > WEAK_DILUTION:
        return raw
    return unit(poses.reading - fit_sphere(poses.reading)[1])


def directions_in(poses: Poses, calibration: Calibration) -> Floats:
    """Return the direction of up in each pose, (n, 3) unit vectors in the sensor axes."""
    mat_w, vec_v = calibration.model.linear_part
    return unit(np.linalg.solve(mat_w, (calibration.units.to_g(poses.reading) - vec_v).T).T)


def lies_in_cone(directions: Floats) -> bool:
    """Return whether (n, 3) unit vectors are those of a robot that cannot be turned over."""
    return bool(len(directions) and cone_of(directions)[1] <= _CONE)


def lies_in_plane(directions: Floats) -> bool:
    """Return whether 4 or more (n, 3) unit vectors are those of a robot that turns on one axis."""
    count, centred = len(directions), directions - directions.mean(axis=0)
    return count > 3 and not lies_in_cone(directions) and bool(
        np.linalg.svd(centred, compute_uv=False)[-1] < _OUT_OF_PLANE * np.sqrt(count))


def shape_words(name: str, directions: Floats) -> str:
    """Return a text about what is wrong with these directions."""
    count = len(directions)
    if count < 2:
        return counted(count, 'pose')
    if distinct(directions) == 1:
        return f'the {count} poses all have the same orientation'
    if count < poses_needed(name):
        return f'{count} poses'
    if determines(name, directions):
        return f'some of the {count} poses are too noisy'
    _, degrees = cone_of(directions)
    if degrees < _WIDE:
        return f'the {count} poses lie within {degrees:.0f}° of one direction'
    if lies_in_plane(directions):
        return f'the {count} poses lie in a plane'
    return (f'the {count} poses have {distinct(directions)} directions that leave a region of '
            'the sphere uncovered')
