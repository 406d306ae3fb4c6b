# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Refinement beside common ways to choose terms, on the same sets.

All ways get the same columns: each effect of the catalogue with each shape, near the fit of model
10, in units of the noise. They differ only in what they choose. The Gaussian process and the
oracle need no columns: the first one predicts the residual from all that is recorded, the second
one fits the true form. The sets are those of `refine_sets`, which nothing was tuned with for seeds
from 2028 on. ``pip install scikit-learn pysindy`` installs what they need.

"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
import warnings

from accel_calib.calibration import fit_poses, in_g
from accel_calib.effects import add_history, EFFECTS, factors_of
from accel_calib.estimate import judge
from accel_calib.refinement.linear import SEEN
from accel_calib.refinement.state import candidates, orthonormal
from accel_calib.statistics import rms
from accel_calib.table import Floats, Poses
from accel_calib.units import MG
from figures import Frame, markdown
from generator import again, simulate
import numpy as np
from pysindy.optimizers import STLSQ
from refine import BASE, run_case
from refine_sets import Case, cases_of, PAIRED, true_form_error_mg
import scipy
from sensors import simulated_poses
from shared import MPS2
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, RBF, WhiteKernel
from sklearn.linear_model import LassoCV
from sklearn.model_selection import KFold

ROWS: dict[str, tuple[str, ...]] = {
    'one effect': ('alone60',), 'two or three': ('two', 'three'),
    'outside, size 3': ('outside',), 'outside, size 8': ('outside60',)}
"""Rows of `refine_sets` by the columns of the table."""

NOT_PREDICTED = 'repeatability'
"""Scatter of the poses, which nothing predicts: left out."""

MOST = 8
"""Largest number of effects that are added one by one."""

CATALOGUE = [name for name in EFFECTS if name not in BASE]


@dataclass(frozen=True)
class Side:
    """Equations of n poses near the base, per noise."""

    residual: Floats  # (n,) errors of |force|
    scale: Floats  # (n,) noise [g]
    base: Floats  # (n, b) derivatives by the values of the base,
    columns: Floats  # (n, c) and by those of every effect with each shape
    recorded: Floats  # (n, k) all that is recorded, with mean 0 and variance 1

    def error(self, explained: Floats | float = 0.0) -> float:
        """Return the RMS of the error that is left beside what was explained [g]."""
        return rms((self.residual - explained) * self.scale)


@dataclass(frozen=True)
class Library:
    """The poses of a fit, other poses, and blocks of columns: one for each effect and shape."""

    taken: Side
    fresh: Side
    effects: tuple[str, ...]
    blocks: tuple[slice, ...]

    @cached_property
    def outside(self) -> tuple[Floats, Floats, Floats]:
        """Return residual and columns with the base projected out, of norm 1; and their sizes."""
        onto = orthonormal(self.taken.base)
        every = np.column_stack([self.taken.residual, self.taken.columns])
        whole = np.linalg.norm(every, axis=0)
        every -= onto @ (onto.T @ every)
        sizes = np.linalg.norm(every, axis=0)
        sizes[sizes <= SEEN * whole] = np.inf
        return every[:, 0], every[:, 1:] / sizes[1:], sizes[1:]

    def left_by(self, chosen: Sequence[int]) -> tuple[float, int]:
        """Return the sum of squares that blocks leave, and the number of their values."""
        residual, columns, _ = self.outside
        onto = orthonormal(np.hstack([columns[:, :0], *(columns[:, self.blocks[k]]
                                                        for k in chosen)]))
        return float(residual @ residual - np.sum((onto.T @ residual) ** 2)), onto.shape[1]

    def chance(self, chosen: Sequence[int], block: int) -> float:
        """Return the probability that noise alone makes a block as good beside the others."""
        (before, fewer), (after, more) = self.left_by(chosen), self.left_by([*chosen, block])
        dof = len(self.taken.residual) - self.taken.base.shape[1] - more
        if more == fewer or dof <= 0:
            return 1.0
        ratio = (before - after) / (more - fewer) / (after / dof)
        return float(scipy.special.fdtrc(more - fewer, dof, ratio))

    def values(self, chosen: Sequence[int]) -> Floats:
        """Return the least squares values of all columns, 0 for those not chosen."""
        residual, columns, _ = self.outside
        found = np.zeros(columns.shape[1])
        index = [column for k in chosen for column in range(*self.blocks[k].indices(len(found)))]
        found[index] = np.linalg.lstsq(columns[:, index], residual, rcond=1e-9)[0]
        return found

    def error(self, values: Floats) -> float:
        """Return the error of the other poses with values of the columns of norm 1 [g]."""
        given = values / self.outside[2]
        base = np.linalg.lstsq(self.taken.base, self.taken.residual - self.taken.columns @ given,
                               rcond=None)[0]
        return self.fresh.error(self.fresh.base @ base + self.fresh.columns @ given)


def library_of(poses: Poses, fresh: Poses) -> Library:
    """Return the equations of poses and of others near model 10 of the first ones."""
    model = fit_poses(poses, MPS2, model='10').model
    tables = [add_history(in_g(each, MPS2), model) for each in (poses, fresh)]
    tried = [*candidates(CATALOGUE, tables[0])]
    sides = []
    for table in tables:
        near = judge(model, table).equations
        columns = [near.columns_of(each.effect, factors_of(
            each.effect, each.shapes, table.columns)) for each in tried]
        recorded = np.column_stack([near.force, *(values for key, values in table.columns.items()
                                                  if key not in ('reading', 'count', 'label'))])
        sides.append(Side(near.residual, near.scale, near.columns(model), np.hstack(columns),
                          (recorded - recorded.mean(axis=0)) / (recorded.std(axis=0) + 1e-12)))
    effects = [(str(each.effect), len(each.entry.parameters))
               for each in tried for _ in each.shapes]
    ends = np.cumsum([width for _, width in effects]).tolist()
    return Library(sides[0], sides[1], tuple(name for name, _ in effects), tuple(
        slice(end - width, end) for (_, width), end in zip(effects, ends, strict=True)))


# --------------------------------------------------------------------------------- ways to choose

def grow(each: Library, cost: Callable[[Sequence[int], int], float], limit: float,
         removed: float = np.inf) -> Floats:
    """
    Return the values of effects that are added while the cost of the best one is below a limit.

    After each one, those are removed whose cost beside the others is above `removed`.

    """
    chosen: list[int] = []
    while len(chosen) < MOST:
        named = {each.effects[k] for k in chosen}
        more = [k for k, effect in enumerate(each.effects) if effect not in named]
        costs = [cost(chosen, block) for block in more]
        if not more or min(costs) >= limit:
            break
        chosen.append(more[int(np.argmin(costs))])
        for block in chosen[:-1]:
            others = [other for other in chosen if other != block]
            if cost(others, block) > removed:
                chosen = others
    return each.values(chosen)


def choose_by_bic(each: Library) -> Floats:
    """Add the effect that lowers the criterion of Schwarz most, while it does."""
    count = len(each.taken.residual)

    def change(chosen: Sequence[int], block: int) -> float:
        (before, fewer), (after, more) = each.left_by(chosen), each.left_by([*chosen, block])
        return float(count * np.log(after / before) + (more - fewer) * np.log(count))

    return grow(each, change, 0.0)


def choose_by_stlsq(each: Library) -> Floats:
    """STLSQ of pysindy with the threshold of the best cross-validation, in units of the noise."""
    residual, columns, _ = each.outside

    def fit(rows: Any, threshold: float) -> Floats:
        found = STLSQ(threshold=threshold, alpha=0.05, max_iter=20).fit(
            columns[rows], residual[rows, np.newaxis])
        return np.asarray(found.coef_).ravel()

    def error(threshold: float) -> float:
        return sum(float(np.sum((residual[test] - columns[test] @ fit(rows, threshold)) ** 2))
                   for rows, test in KFold(5).split(columns))

    return fit(np.arange(len(residual)), min(np.geomspace(2.0, 50.0, 8).tolist(), key=error))


CHOOSERS: dict[str, Callable[[Library], Floats]] = {
    # The most significant effect while it is, at 1 % for all blocks together; at 5 %, without
    # what is not significant at 10 %; and Lasso with the penalty of the best cross-validation.
    'forward F': lambda each: grow(each, each.chance, 0.01 / len(each.blocks)),
    'BIC': choose_by_bic,
    'stepwise': lambda each: grow(each, each.chance, 0.05, 0.10),
    'Lasso': lambda each: np.asarray(LassoCV(
        cv=5, fit_intercept=False, max_iter=5000, tol=1e-3).fit(
            each.outside[1], each.outside[0]).coef_),
    'STLSQ': choose_by_stlsq}


Judged = Mapping[str, tuple[bool | None, float]]
"""By way: whether it names exactly the hidden effects, None if it cannot, and error over base."""


def judge_ways(case: Case) -> Judged:
    """Return how each way does on a set."""
    warnings.simplefilter('ignore')  # of sklearn and pysindy: no convergence, nothing chosen
    made = simulate(np.random.default_rng(case.seed), case.hidden, case.setup)
    other = again(np.random.default_rng((*case.seed, 1)), made)
    each, outcome = library_of(simulated_poses(made), simulated_poses(other)), run_case(case)
    assert outcome.fresh, outcome.error
    found: dict[str, tuple[bool | None, float]] = {
        'refine': (outcome.judgement == 'exact', outcome.fresh[1] / outcome.fresh[0])}
    base = each.fresh.error()
    for name, choose in CHOOSERS.items():
        values = choose(each)
        named = {effect for effect, block in zip(each.effects, each.blocks, strict=True)
                 if np.any(values[block])}
        found[name] = named == set(case.hidden), each.error(values) / base
    kernel = ConstantKernel(1.0) * RBF(np.full(each.taken.recorded.shape[1], 2.0), (0.2, 1e4))
    process = GaussianProcessRegressor(kernel + WhiteKernel(1.0, 'fixed')).fit(
        each.taken.recorded, each.taken.residual)  # of all that is recorded
    found['Gaussian process'] = None, each.fresh.error(
        process.predict(each.fresh.recorded)) / base
    found['oracle'] = None, (true_form_error_mg(made, other) or np.nan) / MG / base
    return found


def rivals(frame: Frame, sets: int = 1, seed: int = 1) -> Iterator[str]:
    """Yield the table: how often each way is exact, and its errors of other poses."""
    heads, rows = [''], dict[str, list[str]]()
    for name, chosen in ROWS.items():
        cases = [(case,) for row in chosen for case in cases_of(row, sets, seed)
                 if NOT_PREDICTED not in case.hidden
                 and ({*case.hidden} <= {*PAIRED} or 'outside' in row)]
        results: list[Judged] = frame.run(judge_ways, cases)
        outside = name.startswith('outside')
        heads += [f'{name}: error', 'worst'] if outside else [
            f'{name}: exact of {len(cases)}', 'error']
        for way in results[0]:
            exact, errors = zip(*(each[way] for each in results), strict=True)
            error = f'{rms(np.array(errors)):.2f}'
            rows.setdefault(way, [way]).extend([error, f'{max(errors):.2f}'] if outside else [
                '' if None in exact else str(sum(exact)), error])
    yield markdown(heads, rows.values())
