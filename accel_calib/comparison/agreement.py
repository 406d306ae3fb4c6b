# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrations prepared for comparisons, and the test whether they agree.

**Parameters.** |force| depends on W only through W Wᵀ: a rotation of the axes of the force,
W -> W Q, does not change it. Calibrations with different axes (model 9 in the sensing axes, 10
symmetric, 12 and levelled ones rotated) are therefore compared in V and in S = (W Wᵀ)^(1/2), the
symmetric factor of the polar decomposition W = S Q. The derivative of S solves
S dS + dS S = dW Wᵀ + W dWᵀ. Effects that depend on the context are evaluated at one context, as
parts of V and W. Effects with bending terms add their own parameters.

**Common scale.** A fit with few degrees of freedom estimates its noise badly. With three, a test
based on its stated variance would raise a false alarm in a third of all pairs. The shape of the
covariance, (JᵀJ)⁻¹ of the poses, does not depend on the noise. The scale is therefore estimated
from all runs together,

    s² = (b + Σ chi²) / (b + Σ dof)

where the measured noise of the runs counts as b degrees of freedom (for each run as in
`accel_calib.estimate.fit.Fit.variance`), unless the residuals contradict it. A run whose poses
repeat significantly worse than those of the others keeps its own scale, and so does one whose
covariance was estimated beside a scatter (`accel_calib.estimate.outliers`).

A smaller model assumes that the omitted effects are exactly zero, but `auto` omits effects that
are hidden in the noise. The uncertainty of such a run is therefore that of the largest model of
the runs, fitted to its poses, if they determine it.

**Agreement.** Runs of one sensor have parameters x_i with covariances C_i. The squared differences
from their mean m, weighted by C_i⁻¹,

    T² = Σ (x_i - m)ᵀ C_i⁻¹ (x_i - m)

divided by the rank of T² have an F distribution with the degrees of freedom of the noise. T² tests
all directions at once. The square of `SAME_G` is added to the variances, so that C_i has an
inverse also if a model omits a parameter. A difference between values that no model fits is
exactly zero and adds nothing to the rank.

In addition, each parameter of each run is compared with the mean of the other runs (Student's t),
to detect a change of a single parameter. The smaller of the two probabilities is used, corrected
for two tests and for the number of parameters (Bonferroni). The differing run is the run whose
removal reduces T² most.

"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy

from ..calibration import Calibration, fit_unknown, in_g, NORM_MODELS, PRIOR
from ..effects import add_history, Context, Model, predict
from ..errors import InputError, RefusedFitError
from ..estimate import judge, scatter_of
from ..text import counted
from ..units import Floats, STANDARD_GRAVITY

NAMES = ('offset.x', 'offset.y', 'offset.z', 'gain.x', 'gain.y', 'gain.z', 'gain.xy', 'gain.xz',
         'gain.yz')
"""V, and the diagonal and the upper triangle of S."""

ENTRIES = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])


@dataclass(frozen=True)
class RotationFree:
    """
    The parameters of a calibration that do not depend on its axes.

    `names` are `NAMES` and the parameters of effects with bending terms, `values` are (t,) [g].
    `slope` is (t, p), their derivative by ``calibration.model.vector``. `axes` is Q ΔR, the (3, 3)
    rotation from the levelled frame to the axes of S. The scales are factors from readings and
    forces in the local g of the calibration to the common unit.

    """

    names: tuple[str, ...]
    values: Floats
    slope: Floats
    axes: Floats
    reading_scale: float
    force_scale: float


def rotation_free(calibration: Calibration, context: Context, per_g: float) -> RotationFree:
    """
    Return the parameters of a calibration that do not depend on its axes, in a context of one row.

    `per_g` is the native reading that counts as 1 g.

    """
    model = calibration.model
    origin = np.zeros((1, 3))
    vec_v = predict(model, origin, context)[0]
    mat_w = model.at(context).slope(origin)[0]
    slope_v = model.basis(origin, context).full[0]
    here = {key: np.repeat(column, 3, 0) for key, column in context.items()}
    slope_w = model.basis(np.zeros((3, 3)), here, np.eye(3)).full  # (column, row, p)
    # S and its (3, 3, p) derivative, from the eigenvectors of W Wᵀ.
    squared, vectors = np.linalg.eigh(mat_w @ mat_w.T)
    roots = np.sqrt(squared)
    half = np.einsum('ijp,kj->ikp', np.swapaxes(slope_w, 0, 1), mat_w)
    turned = np.einsum('ia,ijp,jb->abp', vectors, half + np.swapaxes(half, 0, 1), vectors)
    turned = turned / np.add.outer(roots, roots)[:, :, np.newaxis]
    mat_s = (vectors * roots) @ vectors.T
    slope_s = np.einsum('ia,abp,jb->ijp', vectors, turned, vectors)
    units = calibration.units  # the common unit is the standard g, or native
    reading_scale = force_scale = (units.per_g / STANDARD_GRAVITY if units.is_si else units.per_g)
    if units.is_native:
        reading_scale, force_scale = units.per_g / per_g, 1.0
    gain_scale = reading_scale / force_scale
    own = [k for effect, part in zip(model.terms.effects, model.terms.parts, strict=True)
           if effect.bends for k in range(part.start, part.stop)]
    size = len(model.vector)
    return RotationFree(
        (*NAMES, *(calibration.parameters[k] for k in own)),
        np.concatenate([vec_v * reading_scale, mat_s[ENTRIES] * gain_scale, model.vector[own]]),
        np.concatenate([slope_v * reading_scale, slope_s[ENTRIES] * gain_scale,
                        np.eye(size)[own]]),
        axes=np.linalg.solve(mat_s, mat_w) @ model.rotation, reading_scale=reading_scale,
        force_scale=force_scale)


_WORSE = 0.001
"""A run is noisier than the others if the probability of its chi² is lower."""

_CONTRADICTED = 0.1
"""Measured noise is ignored if the probability of the chi² of all runs is lower."""


@dataclass(frozen=True)
class CommonScale:
    """
    (p, p) covariances of several calibrations on one scale [g²], and its degrees of freedom.

    The poses of the calibrations `noisier` repeat significantly worse than the others.

    """

    covariances: tuple[Floats, ...]
    dof: float
    noisier: tuple[int, ...]


@dataclass(frozen=True)
class Repeatability:
    """
    How well the poses of a calibration repeat.

    `covariance` is (p, p), as stated for ``model.vector`` [g²], and `stated` is its factor on that
    of the measured noise; 0 if it is no factor, but the covariance beside a scatter. `chi2` is the
    sum of the squared residuals over their variances. The measured noise counts as `belief`
    degrees of freedom; 0 if it is not known.

    """

    covariance: Floats
    chi2: float
    dof: int
    stated: float
    belief: float


def on_one_scale(runs: Sequence[Repeatability]) -> CommonScale:
    """Return the covariances of calibrations of one sensor on a common scale."""
    factors, noisier, dofs = np.ones(len(runs)), [], []
    for measured in (True, False):  # without measured noise, chi² has no unit
        group = [k for k, run in enumerate(runs) if (run.belief > 0.0) is measured]
        pool, worse = [runs[k] for k in group if runs[k].dof == 0], []
        own = {k: runs[k].chi2 / runs[k].dof for k in group if runs[k].dof > 0}
        for k in sorted(own, key=own.__getitem__):
            scale, dof = _scale_of(pool)
            chance = scipy.special.fdtrc(runs[k].dof, max(dof, 1.0), own[k] / max(scale, 1e-300))
            if dof > 0.0 and chance < _WORSE:
                worse.append(k)
            else:
                pool.append(runs[k])
        scale, dof = _scale_of(pool)
        for k in group:
            if runs[k].stated > 0.0 and dof > 0.0:
                factors[k] = (own[k] if k in worse else scale) / runs[k].stated
        noisier += worse
        dofs += [dof] if dof > 0.0 else []
    scaled = tuple(run.covariance * factor for run, factor in zip(runs, factors, strict=True))
    return CommonScale(scaled, min(dofs, default=np.inf), tuple(sorted(noisier)))


def _scale_of(pool: Sequence[Repeatability]) -> tuple[float, float]:
    """Return the scale of these runs and its degrees of freedom; 1 and 0 if there are none."""
    chi2, dof = sum(run.chi2 for run in pool), sum(run.dof for run in pool)
    belief = sum(run.belief for run in pool)
    if dof > 0 and scipy.special.chdtrc(dof, chi2) < _CONTRADICTED:
        belief = 0.0
    return ((belief + chi2) / (belief + dof) if belief + dof > 0 else 1.0), belief + dof


def repeatability_of(calibration: Calibration) -> Repeatability:
    """Return how well the poses of a calibration repeat."""
    model = Model(calibration.model.values)
    poses_g = add_history(in_g(calibration.poses, calibration.units), model)
    poses_g = poses_g.take(np.isin(poses_g.row, calibration.used_poses.row))
    if not calibration.form.known_orientation:
        poses_g = poses_g.without_columns('reference')
    fit = judge(model, poses_g, np.eye(len(model.vector)))
    free = int(np.linalg.matrix_rank(fit.columns))
    # Over its own poses, the variances of a fit sum to the number of free parameters.
    total = float(np.einsum('mp,pq,mq->', fit.columns, calibration.covariance, fit.columns))
    belief = fit.variance_dof - fit.dof if fit.noise_known else 0.0
    return Repeatability(calibration.covariance, fit.chi2, fit.equations.count - free,
                         0.0 if not free or scatter_of(fit).shows else total / free, belief)


@dataclass(frozen=True)
class Comparable:
    """
    A calibration prepared for comparisons with others of its sensor.

    `sure` is the fit of the largest model of the sensor to the same poses, or the calibration
    itself, and `repeatability` that of the poses of `sure`.

    """

    calibration: Calibration
    sure: Calibration
    repeatability: Repeatability


def comparable(calibrations: Sequence[Calibration]) -> tuple[Comparable, ...]:
    """Prepare two or more calibrations of one sensor for any number of comparisons among them."""
    if len(calibrations) < 2:
        raise InputError(f'found {counted(len(calibrations), "calibration")}, expected at least 2',
                         'select two or more calibrations of the same sensor')
    sensors = list(dict.fromkeys(run.sensor for run in calibrations if run.sensor))
    if len(sensors) > 1:
        raise InputError(f'the calibrations are of the sensors {" and ".join(sensors)}, expected '
                         'one sensor', 'select calibrations of one sensor; if it was only '
                         'renamed, set sensor: in the files to one name')
    native = [run.units.is_native for run in calibrations]
    if any(native) and not all(native):
        other = next(run.units.name for run in calibrations if not run.units.is_native)
        raise InputError(f'run {native.index(True) + 1} is in native units and another run in '
                         f'{other}, expected the same unit, because the conversion is not known',
                         'fit all runs from readings in one unit')
    for k, run in enumerate(calibrations, 1):
        if run.method == PRIOR and not run.form.effects:
            what = 'an offset over temperature' if run.model.effects else 'a mounting'
            raise InputError(f'run {k} is {what} alone, expected a fit of offset and gain',
                             'leave it out, or fit it with poses in many directions')
        if not np.all(np.isfinite(run.covariance)):
            raise InputError(f'run {k} has no uncertainty, expected a finite covariance',
                             'fit it again with more poses')
    names = {run.form.norm for run in calibrations}
    largest = max(names.intersection(NORM_MODELS), key=NORM_MODELS.index, default=NORM_MODELS[0])
    found = []
    for run in calibrations:
        sure = run
        larger = NORM_MODELS[NORM_MODELS.index(run.name) + 1:] if run.name in NORM_MODELS else ()
        if largest in larger and run.model.effects == run.form.effects:
            with suppress(RefusedFitError):  # its poses do not determine the larger model
                sure = fit_unknown(run.used_poses, run.units, largest, 'ml')[0]
        found.append(Comparable(run, sure, repeatability_of(sure)))
    return tuple(found)


LEVEL = 0.03
"""Probability that runs of an unchanged sensor are reported to differ."""

SAME_G = 1e-7
"""Differences below this count as zero [g]."""

_NO_SPREAD = 1e-10
"""A variance below this part of the largest counts as zero."""


@dataclass(frozen=True)
class Runs:
    """Runs in common parameters: (n, t) values, (n, t, t) covariances, and dof of the noise."""

    values: Floats
    covariances: Floats
    dof: float

    def without(self, run: int) -> Runs:
        """Return the runs without one run."""
        return Runs(np.delete(self.values, run, 0), np.delete(self.covariances, run, 0), self.dof)

    @property
    def squared(self) -> tuple[float, int]:
        """T² and its rank: squared differences in all directions over their variances."""
        variances, vectors = np.linalg.eigh(self.covariances)
        exact = variances <= _NO_SPREAD * np.max(variances, initial=1e-300)
        weights = (vectors / (np.maximum(variances, 0.0) + SAME_G ** 2)[:, np.newaxis]
                   ) @ np.swapaxes(vectors, 1, 2)
        mean = np.linalg.solve(np.sum(weights, axis=0),
                               np.einsum('nts,ns->t', weights, self.values))
        away = self.values - mean
        # Exact values of several runs in one direction: their differences have no variance.
        known = np.einsum('ntk,nk,nsk->ts', vectors, exact, vectors)
        rank = (len(away) - 1) * len(mean) - np.sum(exact) + np.linalg.matrix_rank(
            known, _NO_SPREAD, hermitian=True)
        return float(np.einsum('nt,nts,ns->', away, weights, away)), int(rank)

    @property
    def least(self) -> Floats:
        """(n,) array, the probability of the most deviating parameter of each run."""
        variance = np.maximum(np.diagonal(self.covariances, axis1=1, axis2=2), 0.0) + SAME_G ** 2
        weight = 1.0 / variance
        others = np.sum(weight, axis=0) - weight
        mean = (np.sum(weight * self.values, axis=0) - weight * self.values) / others
        sizes = np.abs(self.values - mean) / np.sqrt(variance + 1.0 / others)
        number = np.sum(np.any(variance > 4.0 * SAME_G ** 2, axis=0))
        tail: Floats = scipy.special.stdtr(self.dof, -np.max(sizes, axis=1))
        return 2.0 * tail * max(number, 1)

    @property
    def p_value(self) -> float:
        """Probability of differences at least this large, if the runs agree."""
        count = len(self.values)
        tests = 1 if count == 2 else count
        return min(1.0, 2.0 * min(_beyond(*self.squared, self.dof),
                                  float(np.min(self.least)) * tests))


def _beyond(chi2: float, rank: int, dof: float) -> float:
    """Return the probability of a T² of this rank that is at least this large."""
    if rank == 0:  # T² is in units of SAME_G²
        return float(chi2 <= 1.0)
    return float(scipy.special.chdtrc(rank, chi2) if np.isinf(dof)
                 else scipy.special.fdtrc(rank, dof, chi2 / rank))


def p_values(runs: Runs) -> Floats:
    """Return the probability of the differences between each run and the others."""
    if len(runs.values) == 2:
        return np.full(2, runs.p_value)
    chi2, rank = runs.squared
    found = []
    for k, least in enumerate(runs.least):
        others, others_rank = runs.without(k).squared
        chance = _beyond(max(chi2 - others, 0.0), rank - others_rank, runs.dof)
        found.append(min(1.0, 2.0 * min(chance, float(least))))
    return np.array(found)


def outlier(runs: Runs) -> int | None:
    """Return the index of the run without which the others agree, or None."""
    if len(runs.values) == 2:
        return None
    left = [runs.without(k) for k in range(len(runs.values))]
    best = int(np.argmin([others.squared[0] for others in left]))
    return best if left[best].p_value >= LEVEL else None
