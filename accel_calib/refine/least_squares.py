# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Linear least squares with columns that are added and removed.

`Projected` contains the residual of the equations with the columns of the model projected out. The
gain of further columns is then one small regression. It is, to first order, the joint fit of all
values at the cost of the candidate alone.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..table import Floats

_SEEN = 0.02
"""Smallest part of a column outside of the model; otherwise it cannot be distinguished."""


@dataclass(frozen=True)
class Projected:
    """
    Equations with columns projected out.

    Parameters
    ----------
    onto : (m, r) array
        Orthonormal columns that span the model.
    residual : (m,) array
        Residual of the model.

    """

    onto: Floats
    residual: Floats

    @property
    def rss(self) -> float:
        """Residual sum of squares."""
        return float(self.residual @ self.residual)

    def outside(self, columns: Floats) -> Floats:
        """Return the part of (m, q) columns outside of the model, orthonormal (m, r)."""
        left = columns - self.onto @ (self.onto.T @ columns)
        sizes = np.linalg.norm(columns, axis=0)
        kept = np.linalg.norm(left, axis=0) > _SEEN * np.maximum(sizes, 1e-300)
        if not np.any(kept):
            return columns[:, :0]
        scaled = left[:, kept] / sizes[kept]
        left_vectors, scales, _ = np.linalg.svd(scaled, full_matrices=False)
        return left_vectors[:, scales > _SEEN * max(scales[0], _SEEN)]

    def plus(self, orthonormal: Floats) -> Projected:
        """Return the equations with columns from `outside` projected out, too."""
        return Projected(np.hstack([self.onto, orthonormal]),
                         self.residual - orthonormal @ (orthonormal.T @ self.residual))

    def with_columns(self, columns: Floats) -> Projected:
        """Return the equations with (m, q) columns projected out, too."""
        return self.plus(self.outside(columns))

    @property
    def held_out(self) -> Floats:
        """(m,) array, each residual if its own equation is left out of the fit (PRESS)."""
        own = 1.0 - np.sum(self.onto ** 2, axis=1)
        return self.residual / np.maximum(own, 0.02)


def projected(residual: Floats, columns: Floats) -> Projected:
    """Return the (m,) residual with (m, q) columns projected out."""
    start = Projected(np.zeros((len(residual), 0)), residual)
    return start.with_columns(columns) if columns.shape[1] else start
