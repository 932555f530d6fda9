"""Sparse least squares: blocks of equations, their normal matrix, and what is derived from its factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular
from scipy.sparse.linalg import SuperLU, splu

from speckle3d.core.arrays import FloatArray, IntArray

DAMPING = 1e-9
"""Added to the normal matrix, whose entries are inverse squares of millimetres and radians."""


@dataclass(frozen=True)
class Block:
    """Equations of one kind, over their standard deviations.

    Attributes
    ----------
    residual : ndarray, shape (m, k)
        m groups of k equations.
    parts : tuple of (ndarray, ndarray)
        Columns, shape (m, c), and derivatives of the residual by them, shape (m, k, c). A column below zero
        is of a variable that is fixed.
    """

    residual: FloatArray
    parts: tuple[tuple[IntArray, FloatArray], ...]

    def weighted(self, weight: FloatArray) -> Block:
        """The same equations with a weight for each group, shape (m,)."""
        root = np.sqrt(weight)
        parts = tuple((columns, slope * root[:, None, None]) for columns, slope in self.parts)
        return Block(self.residual * root[:, None], parts)

    def entries(self, first_row: int = 0) -> tuple[IntArray, IntArray, FloatArray]:
        """Rows, columns and values of the derivatives."""
        m, k = self.residual.shape
        row = first_row + np.arange(m * k).reshape(m, k, 1)
        rows, columns, values = [], [], []
        for column, slope in self.parts:
            there = np.broadcast_to(column[:, None, :] >= 0, slope.shape)
            rows.append(np.broadcast_to(row, slope.shape)[there])
            columns.append(np.broadcast_to(column[:, None, :], slope.shape)[there])
            values.append(slope[there])
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)

    def jacobian(self, size: int) -> sparse.csr_matrix:
        """Derivatives by all variables, shape (m k, size)."""
        return stacked([self], size)

    @property
    def own_log_determinant(self) -> float:
        """Of equations that have one variable each beside earlier ones', which the first part is of."""
        return float(np.log(np.abs(np.diagonal(self.parts[0][1], axis1=1, axis2=2))).sum())


def stacked(blocks: Sequence[Block], size: int) -> sparse.csr_matrix:
    """Derivatives of the equations of all blocks, in order."""
    starts = np.cumsum([0, *(block.residual.size for block in blocks)])
    entries = [block.entries(int(start)) for block, start in zip(blocks, starts[:-1], strict=True)]
    rows, columns, values = (np.concatenate(each) for each in zip(*entries, strict=True))
    return sparse.csr_matrix((values, (rows, columns)), shape=(int(starts[-1]), size))


@dataclass(frozen=True)
class Normal:
    """Normal equations of some blocks, linearised at one point."""

    matrix: sparse.csc_matrix
    gradient: FloatArray
    cost: float

    @classmethod
    def of(cls, blocks: Sequence[Block], size: int) -> Normal:
        """Normal equations of all of `blocks`."""
        jacobian = stacked(blocks, size)
        residual = np.concatenate([block.residual.ravel() for block in blocks])
        matrix = (jacobian.T @ jacobian + DAMPING * sparse.identity(size)).tocsc()
        return cls(matrix, np.asarray(jacobian.T @ residual), float(residual @ residual))

    def factor(self) -> SuperLU:
        """Factors of the matrix, which is symmetric and positive definite."""
        return splu(
            self.matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def reduced(self, kept: int) -> tuple[FloatArray, FloatArray]:
        """Matrix and gradient of the last `kept` variables alone, the others being at their best."""
        rest = self.matrix.shape[0] - kept
        coupling = self.matrix[:rest, rest:]
        inner = Normal(self.matrix[:rest, :rest].tocsc(), self.gradient[:rest], 0.0).factor()
        solved = inner.solve(np.column_stack([coupling.toarray(), self.gradient[:rest]]))
        across = coupling.T @ solved
        matrix = self.matrix[rest:, rest:].toarray() - across[:, :-1]
        return (matrix + matrix.T) / 2, self.gradient[rest:] - across[:, -1]


def evidence(matrix: FloatArray, gradient: FloatArray, prior: Sequence[Block], first: int) -> float:
    """Logarithm of the restricted likelihood of the sizes in Gaussian priors, up to what all sizes share.

    Parameters
    ----------
    matrix, gradient : ndarray, shape (p, p) and (p,)
        Normal equations of the last p variables without the priors.
    prior : sequence of Block
        With as many equations as there are variables in them; see `Block.own_log_determinant`.
    first : int
        Column of the first of the p variables.
    """
    full, pull, cost, of_prior = matrix.copy(), gradient.copy(), 0.0, 0.0
    for block in prior:
        rows, columns, values = block.entries()
        own, place = np.unique(columns, return_inverse=True)
        jacobian = np.zeros((block.residual.size, own.size))
        np.add.at(jacobian, (rows, place), values)
        residual = block.residual.ravel()
        full[np.ix_(own - first, own - first)] += jacobian.T @ jacobian
        pull[own - first] += jacobian.T @ residual
        cost += float(residual @ residual)
        of_prior += block.own_log_determinant
    root = np.linalg.cholesky(full)
    pulled = solve_triangular(root, pull, lower=True, check_finite=False)
    return float(0.5 * (pulled @ pulled - cost) - np.log(np.diag(root)).sum() + of_prior)
