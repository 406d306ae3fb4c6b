# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Linear least squares with columns that come and go.

`Fitted` holds the equations with the columns in the model projected out. The gain of further
columns is then one small regression: the joint refit of all values, to first order, at the cost of
the candidate alone.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..table import Floats

_SEEN = 0.02
"""A column of which less than this part is left beside the model cannot be told from it."""


@dataclass(frozen=True)
class Fitted:
    """
    Equations with columns projected out.

    Parameters
    ----------
    onto : (m, r) array
        Orthonormal columns that span the model.
    residual : (m,) array
        What it leaves.

    """

    onto: Floats
    residual: Floats

    @property
    def rss(self) -> float:
        """Residual sum of squares."""
        return float(self.residual @ self.residual)

    def without_model(self, columns: Floats) -> Floats:
        """Give the part of (m, q) columns that the model does not span, orthonormal (m, r)."""
        left = columns - self.onto @ (self.onto.T @ columns)
        sizes = np.linalg.norm(columns, axis=0)
        kept = np.linalg.norm(left, axis=0) > _SEEN * np.maximum(sizes, 1e-300)
        if not np.any(kept):
            return columns[:, :0]
        scaled = left[:, kept] / sizes[kept]
        left_vectors, scales, _ = np.linalg.svd(scaled, full_matrices=False)
        return left_vectors[:, scales > _SEEN * max(scales[0], _SEEN)]

    def plus(self, orthonormal: Floats) -> Fitted:
        """Take up columns that `without_model` gave."""
        return Fitted(np.hstack([self.onto, orthonormal]),
                      self.residual - orthonormal @ (orthonormal.T @ self.residual))

    def with_columns(self, columns: Floats) -> Fitted:
        """Take up (m, q) columns."""
        return self.plus(self.without_model(columns))

    @property
    def left_out(self) -> Floats:
        """Give each residual as it is when its own equation is left out, (m,) (PRESS)."""
        own = 1.0 - np.sum(self.onto ** 2, axis=1)
        return self.residual / np.maximum(own, 0.02)


def fitted(residual: Floats, columns: Floats) -> Fitted:
    """Project (m, q) columns out of the (m,) residual."""
    start = Fitted(np.zeros((len(residual), 0)), residual)
    return start.with_columns(columns) if columns.shape[1] else start
