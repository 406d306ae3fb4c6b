# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the directions of poses determine of a model, which pose to take next, and when to stop.

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

Poses that do not determine a model are refused. The error contains the reason, the parameters
that are undetermined by themselves, the poses to add, and the largest of the smaller models that
the poses determine.

**Next pose.** It is one of the 26 orientations that a person can set by eye: the 6 faces, 12 edges
and 8 corners of the sensor. It is the orientation that increases the determinant of M plus the
information of one pose spread over the whole sphere most (D-optimal design, Fedorov 1972). The
latter represents the poses to come; without it the first poses would be chosen as if they were the
last. `benchmarks/poses.py` compares this order with others.

With n well spread poses, the error of |force| is the noise of a pose times √(p / n), RMS over the
sphere. Another pose reduces it by the factor 1 / 2n. More poses no longer help if the next pose
reduces the error by less than `_LEAST_GAIN` and the dilution is below `_GOOD_DILUTION`.

"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from .calibration import Calibration, ORIENTED, PRIOR
from ..effects import EFFECTS, MODELS, parameter_names, with_vector
from ..errors import RefusedFitError
from ..estimate import pose_noise
from ..finding import Finding
from ..geometry import (
    ATTITUDES, axes_of_signs, cone_of, distinct, OVER_THE_SPHERE, TAKEN, unit, words_of)
from ..table import Floats, Poses
from ..text import counted
from ..units import MG

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

_OPEN_PART = 0.1
"""Part of a parameter in the open combinations above which it is not determined."""

_MAIN_PART = 0.3
"""Weights above this part of the largest weight are included in the words."""

_SMALL = 1e-3
"""Weights below this are omitted from a combination."""

_LEAST_GAIN = 0.03
"""Smallest useful reduction of the error by a pose; 17 well spread poses reach it."""

_GOOD_DILUTION = 3.0
"""More poses are requested while the dilution is larger."""

_SPARE = 3
"""Poses beyond the fewest that determine a model, so that the fit can be checked."""

_CONE = 30.0
"""
Largest angle between poses and their mean direction of a robot that cannot be turned over [°].

Robots with wheels or tracks tilt by 10° to 25°. No number of poses within 30° determines model 10:
the dilution is above 300 for 60 poses. Poses further apart, such as those in a ring, in a plane or
at right angles, come from a sensor that can be turned.

"""

_WIDE = 75.0
"""Angle above which poses are no longer described as near one direction [°]."""


def effects_of(name: str) -> tuple[str, ...]:
    """Return the effects of a model; model 9 is model 10 in other axes."""
    form = MODELS[name]
    return MODELS[form.norm].effects if form.sensing_axes else form.effects


def free_parameters(name: str) -> int:
    """Return the number of free parameters of a model: 4, 6 (g is known), 9, 9 or 12."""
    return len(parameter_names(effects_of(name)))


def poses_needed(name: str) -> int:
    """Return the smallest number of poses that can determine a model."""
    return free_parameters(name) // (3 if MODELS[name].known_orientation else 1)


def rows_of(name: str, directions: Floats) -> Floats:
    """Return Φ at (n, 3) unit vectors: (n, 1, p), or (n, 3, p) for model 12."""
    ideal = with_vector(effects_of(name), np.zeros(free_parameters(name)))
    basis = ideal.basis(directions, {})
    return basis.full if MODELS[name].known_orientation else basis.along(directions)[:, np.newaxis]


@lru_cache(maxsize=8)
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
    return _largest_error(name, information_of(name, directions, noise))


def _largest_error(name: str, information: Floats) -> float:
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

    @property
    def words(self) -> str:
        """Return the combination in words, such as ``0.71 offset.z - 0.70 axis_gain.z``."""
        if len(self.main) == 1:
            return next(iter(self.main))
        first, *others = (f'{"-" if weight < 0 else "+"} {abs(weight):.2f} {name}'
                          for name, weight in self.main.items())
        return ' '.join([first.removeprefix('+ '), *others])


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

    @property
    def open_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that the poses do not determine."""
        part = {name: sum(open_.weights.get(name, 0.0) ** 2 for open_ in self.undetermined)
                for name in self.deviations}
        return tuple(name for name in self.deviations if part[name] > _OPEN_PART ** 2)


def identifiability(name: str, directions: Floats, noise: Floats | None = None) -> Identifiability:
    """
    Return what poses determine of a model; it depends only on directions and noise.

    `name` is 4, 7, 9, 10 or 12. `directions` are (n, 3) unit vectors of force in the sensor axes;
    n can be 0. `noise` is (n,), of each pose, in any unit; by default it is equal for all poses.

    """
    names = parameter_names(effects_of(name))
    triangle = np.linalg.qr(_weighted_rows(name, directions, noise), mode='r')
    square = np.zeros((len(names), len(names)))
    square[:len(triangle)] = triangle
    _, scales, axes = np.linalg.svd(square)  # combinations as rows, the best determined first
    determined = scales > _SINGULAR * max(scales[0], 1.0)
    deviations = np.where(determined, 1.0 / np.where(determined, scales, 1.0), np.inf)
    each = np.sqrt(np.sum(_times(axes.T ** 2, deviations ** 2), axis=1))
    seen = np.sum((_over_the_sphere(name) @ axes.T) ** 2, axis=1)
    errors = np.cumsum(_times(seen, deviations ** 2), axis=1)  # from all up to this one
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


def _times(share: Floats, deviations: Floats) -> Floats:
    """Return the product; 0 times an infinite deviation is 0."""
    none = np.abs(share) < _NOTHING
    return np.where(none, 0.0, share) * np.where(none, 0.0, deviations)


def error_left_in(smaller: str, larger: str, directions: Floats, noise: Floats | None = None
                  ) -> float:
    """
    Return the typical error of |force| if a model omits effects of a larger model [g].

    The omitted effects have their typical size. The fit partly absorbs them, which changes the
    correction over the whole sphere; the error is RMS over it. Both models are for poses of
    unknown orientation; directions and noise as in `identifiability`.

    """
    effects = [effect for effect in _left_out(smaller, larger) for _ in EFFECTS[effect].values]
    more = [name.partition('.')[0] in effects for name in parameter_names(effects_of(larger))]
    added = np.linalg.lstsq(_weighted_rows(smaller, directions, noise),
                            _weighted_rows(larger, directions, noise)[:, more], rcond=None)[0]
    wrong = _over_the_sphere(larger)[:, 0, more] - _over_the_sphere(smaller)[:, 0] @ added
    sizes = np.array([EFFECTS[effect].typical for effect in effects])
    return float(np.sqrt(np.sum(np.mean(wrong ** 2, axis=0) * sizes ** 2)))


def _left_out(smaller: str, larger: str) -> list[str]:
    """Return the effects that a smaller model omits."""
    return [effect for effect in effects_of(larger) if effect not in effects_of(smaller)]


@dataclass(frozen=True)
class NextPose:
    """
    The pose that improves the fit most, or none.

    Parameters
    ----------
    direction, words : (3,) array or None, and str
        Direction to point up, a unit vector in the sensor axes, and the same as a sentence; None:
        more poses no longer help.
    error : float
        Expected error of |force| after a fit to the poses so far, RMS over the sphere, relative
        to the noise of a pose; infinite if the poses do not determine a parameter.
    total : int
        Number of poses that determine the model well, if each is the one that is asked for.
    fits : bool
        Whether the poses so far determine the model, so that a fit is not refused.

    """

    direction: Floats | None
    words: str
    error: float
    total: int
    fits: bool


@lru_cache(maxsize=8)
def _mean_information(name: str) -> Floats:
    """Return the (p, p) information of one pose spread over the sphere."""
    return information_of(name, OVER_THE_SPHERE) / len(OVER_THE_SPHERE)


def next_pose(directions: Floats, name: str = '10', noise: Floats | None = None, *,
              noise_g: float | None = None) -> NextPose:
    """
    Return the pose that improves the fit most: a face, edge or corner not taken yet, or none.

    Parameters
    ----------
    directions : (n, 3) array
        Unit vectors of force so far, in the sensor axes; n can be 0.
    name : {'4', '7', '9', '10', '12'}
        The model to fit; for model 12 the poses are the six faces.
    noise : (n,) array, optional
        Noise of each pose in any unit; by default equal for all poses.
    noise_g : float, optional
        Median noise of the poses [g], for the sentence.

    """
    count = len(directions)
    information = information_of(name, directions, noise)
    error, fits = _error(name, information, count), determines(name, directions, noise)
    up = _best(name, directions, information)
    helps = up is not None and (  # reduces the error visibly
        _largest_error(name, information) > _GOOD_DILUTION
        or _error(name, information + information_of(name, up[np.newaxis]), count + 1)
        <= (1.0 - _LEAST_GAIN) * error)
    if up is None or not helps:
        certain = (f'{error * noise_g * MG:.2g} mg' if noise_g is not None
                   else f'{error:.2g} times the noise of a pose')
        words = f'more poses no longer help: {count} poses determine |a| to within {certain}'
        return NextPose(None, words, error, count, fits)
    total = count + len(list(_planned(name, directions, information, _SPARE)))
    return NextPose(up, request_for(up), error, total, fits)


def request_for(up: Floats) -> str:
    """Return the request to let a side, an edge or a corner point up."""
    return f'turn the sensor so that {words_of(up)} points up ({axes_of_signs(up)})'


def _planned(name: str, directions: Floats, information: Floats, spare: int) -> Iterator[Floats]:
    """Yield the attitudes to add until the poses determine a model well."""
    while (len(directions) < poses_needed(name) + spare
           or _largest_error(name, information) > _GOOD_DILUTION):
        up = _best(name, directions, information)
        if up is None:
            return
        yield up
        directions = np.vstack([directions, up])
        information = information + information_of(name, up[np.newaxis])


def missing_poses(name: str, directions: Floats, noise: Floats | None = None) -> list[str]:
    """Return the sides, edges and corners to point up next, until a model is determined well."""
    information = information_of(name, directions, noise)
    return [f'{words_of(up)} ({axes_of_signs(up)})'
            for up in _planned(name, directions, information, 0)]


def _best(name: str, directions: Floats, information: Floats) -> Floats | None:
    """Return the untaken attitude that increases det M most, or None if all are taken."""
    up, rows = _attitudes(name)
    free = np.max(up @ directions.T, axis=1, initial=-1.0) < TAKEN
    if not np.any(free):
        return None
    to_come = np.linalg.inv(information + _mean_information(name))
    gains = np.linalg.slogdet(np.eye(rows.shape[1]) + rows @ to_come @ np.swapaxes(rows, 1, 2))[1]
    return up[np.argmax(np.where(free, np.round(gains, 6), -1.0))]  # the first of equals


@lru_cache(maxsize=8)
def _attitudes(name: str) -> tuple[Floats, Floats]:
    """Return the (n, 3) attitudes that a person can set by eye for a model, and their rows."""
    up = ATTITUDES[:6] if name == ORIENTED else ATTITUDES
    return up, rows_of(name, up)


def _error(name: str, information: Floats, count: int) -> float:
    """Return the error of |force|, RMS over the sphere, relative to the noise of a pose."""
    if count < poses_needed(name) or (
            np.linalg.matrix_rank(information, hermitian=True) < len(information)):
        return np.inf
    return float(np.sqrt(np.trace(np.linalg.solve(information, _mean_information(name)))))


@dataclass(frozen=True)
class Outlook:
    """
    What the poses of a calibration determine, and the pose that improves it most.

    `identifiability` and `next_pose` are for the requested model; for the largest model if the
    choice was ``auto``. `uncertainty_mg` is the stated one of the corrected |force| (model 12: of
    the force), RMS over the sphere, with effects in the middle of their range [mg]; None for a
    mounting alone or an offset over temperature alone.

    """

    identifiability: Identifiability
    next_pose: NextPose
    uncertainty_mg: float | None


def directions_in(poses: Poses, calibration: Calibration) -> Floats:
    """Return the direction of up in each pose, (n, 3) unit vectors in the sensor axes."""
    mat_w, vec_v = calibration.model.linear_part
    return unit(np.linalg.solve(mat_w, (calibration.units.to_g(poses.reading) - vec_v).T).T)


def outlook(calibration: Calibration, asked: str = 'auto') -> Outlook:
    """Return what the poses of a calibration determine, and the next pose for a model."""
    poses = calibration.used_poses
    directions = directions_in(poses, calibration)
    noise = pose_noise(poses.noise, directions)
    uncertainty = stated_uncertainty(calibration)
    planned = asked
    if asked in ('auto', ORIENTED):  # with wrong orientations model 12 became 10
        planned = ORIENTED if calibration.form.known_orientation else NORM_MODELS[-1]
    noise_g = None
    if uncertainty is not None and calibration.form.effects and determines(
            calibration.name, directions, noise):
        noise_g = uncertainty / identifiability(calibration.name, directions, noise).mean_dilution
    return Outlook(identifiability(planned, directions, noise),
                   next_pose(directions, planned, noise, noise_g=noise_g),
                   None if uncertainty is None else uncertainty * MG)


def stated_uncertainty(calibration: Calibration) -> float | None:
    """Return the stated uncertainty of the corrected force, RMS over the sphere [g]."""
    up, alone = OVER_THE_SPHERE, calibration.method == PRIOR and not calibration.form.effects
    per_g, known = calibration.force_per_g, calibration.typical_context(len(up))
    if alone or not calibration.model.effects or not known.keys() >= {*calibration.model.needs}:
        return None
    covariance = calibration.force_covariance(up * per_g, known) / per_g ** 2
    errors = (np.trace(covariance, axis1=1, axis2=2) if calibration.form.known_orientation
              else np.einsum('ni,nij,nj->n', up, covariance, up))
    return float(np.sqrt(np.mean(errors)))


def lies_in_cone(directions: Floats) -> bool:
    """Return whether (n, 3) unit vectors are those of a robot that cannot be turned over."""
    return bool(len(directions) and cone_of(directions).degrees <= _CONE)


def determines(name: str, directions: Floats, noise: Floats | None = None) -> bool:
    """Return whether poses determine a model; parameters as in `refuse_if_unfit`."""
    return (len(directions) >= poses_needed(name)
            and dilution(name, directions, noise) <= LARGEST_DILUTION)


def refuse_if_unfit(name: str, directions: Floats, noise: Floats | None = None) -> None:
    """Raise RefusedFitError if poses do not determine a model; parameters as in `next_pose`."""
    if determines(name, directions, noise):
        return
    smaller = [other for other in NORM_MODELS if poses_needed(other) < poses_needed(name)
               and len(directions) >= poses_needed(other)
               and dilution(other, directions, noise) <= WEAK_DILUTION]
    offer = (f', or use model {smaller[-1]}, which these poses determine: '
             f'{_omitted(smaller[-1], name, directions, noise)}') if smaller else ''
    few = len(directions) < poses_needed(NORM_MODELS[0])
    # Several that are open together say less than the poses that are missing.
    alone = [] if few else [each.words for each in identifiability(
        name, directions, noise).undetermined if len(each.main) == 1]
    raise RefusedFitError(
        f'{shape_words(name, directions)}, expected at least {poses_needed(name)} poses spread '
        f'over the sphere for model {name}'
        f'{f"; not determined: {enumerated(alone)}" if alone else ""}',
        f'{turn_words(missing_poses(name, directions, noise))}, hold it still and continue{offer}')


def unseen(chosen: str, directions: Floats, noise: Floats | None = None) -> Iterator[Finding]:
    """Yield a finding if the poses determine only `chosen`, and not the largest model."""
    largest = NORM_MODELS[-1]
    if chosen in NORM_MODELS[:-1]:
        yield Finding(
            'undetermined', f'model {chosen} is the largest that these poses determine: '
            f'{_omitted(chosen, largest, directions, noise)}',
            f'to fit model {largest}, {turn_words(missing_poses(largest, directions, noise))}')


def _omitted(smaller: str, larger: str, directions: Floats, noise: Floats | None) -> str:
    """Return a text about the effects that a smaller model omits, and the typical error."""
    words = f'it omits {enumerated(_left_out(smaller, larger))}'
    if larger == ORIENTED:
        return words
    error = error_left_in(smaller, larger, directions, noise) * MG
    return f'{words}, which causes an error of |a| of {error:.0f} mg in a common sensor'


def turn_words(missing: Sequence[str]) -> str:
    """Return how to turn the sensor for the missing poses."""
    if len(missing) <= 1:
        return f'turn the sensor so that {"".join(missing) or "another side"} points up'
    return f'turn the sensor so that in turn {enumerated(missing)} point up'


def enumerated(words: Sequence[str]) -> str:
    """Join words by commas and 'and'."""
    return ' and '.join(filter(None, [', '.join(words[:-1]), words[-1]]))


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
    cone = cone_of(directions)
    if cone.degrees < _WIDE:
        return f'the {count} poses lie within {cone.degrees:.0f}° of one direction'
    centred = directions - directions.mean(axis=0)
    if np.linalg.svd(centred, compute_uv=False)[-1] < 0.1 * np.sqrt(count):
        return f'the {count} poses lie in a plane'
    return (f'the {count} poses have {distinct(directions)} directions that leave a region of '
            'the sphere uncovered')
