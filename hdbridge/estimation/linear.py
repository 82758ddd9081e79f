"""Symmetric systems that may be singular: columns that a record cannot tell apart share what they explain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg.lapack import dposv

from hdbridge.effects import BoolArray, FloatArray

NOTHING = 1e-20
"""Information below this is none."""
SEEN = 1e-9
"""Share of the largest eigenvalue of scaled columns below which a direction is not in the data."""
SUSPECT = 1e-6
"""Square of a Cholesky factor's diagonal below which the smallest eigenvalue is looked at."""


def solve_symmetric(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of a positive semi-definite system, columns scaled to one; what is not seen stays at zero."""
    if not len(matrix):
        return np.zeros_like(right)
    seen = np.diag(matrix) > 0.0
    if not np.all(seen):  # rounding on the scale of nothing could be anything
        result = np.zeros_like(right)
        result[seen] = solve_symmetric(matrix[np.ix_(seen, seen)], right[seen])
        return result
    scale = np.sqrt(np.diag(matrix))
    spread = scale if right.ndim == 1 else scale[:, np.newaxis]
    scaled = matrix / np.outer(scale, scale)
    factor, solved, failed = dposv(scaled, right / spread, lower=1)
    if failed or np.min(np.diag(factor)) ** 2 < SUSPECT:
        directions = seen_directions(scaled)
        solved = directions @ (directions.T @ (right / spread))
    return np.asarray(solved / spread).reshape(right.shape)


def inverse_symmetric(matrix: FloatArray) -> FloatArray:
    """Inverse of a positive semi-definite matrix by its scaled eigenvalues; huge where it has none."""
    scale = np.sqrt(np.maximum(np.diag(matrix), NOTHING))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    inverse = vectors @ ((1.0 / np.maximum(values, 1e-12 * values[-1]))[:, np.newaxis] * vectors.T)
    return np.asarray(inverse / np.outer(scale, scale))


def seen_directions(gram: FloatArray) -> FloatArray:
    """Factor R, shape (p, r), with R' gram R = 1 over the directions that the data see.

    R R' is the pseudo-inverse of columns scaled to one, and ``columns @ R`` an orthonormal basis of theirs.
    """
    if not len(gram):
        return np.empty((0, 0))
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > SEEN * max(float(values[-1]), 1e-300)
    factor = vectors[:, kept] / scale[:, np.newaxis] / np.sqrt(values[kept])
    return np.where((np.diag(gram) > 0.0)[:, np.newaxis], factor, 0.0)


def side_by_side(parts: Sequence[FloatArray | BoolArray], rows: int) -> FloatArray:
    """Columns of some parts in one matrix, shape (rows, p), each column in one piece of memory.

    A long column that is spread over all rows takes as long to write, and to read, as the whole matrix.
    """
    result = np.empty((sum(each.shape[1] for each in parts), rows)).T
    at = 0
    for each in parts:
        result[:, at : at + each.shape[1]] = each
        at += each.shape[1]
    return result


def orthonormal(columns: FloatArray) -> FloatArray:
    """An orthonormal basis of what the columns span, shape (m, r)."""
    return np.asarray(columns @ seen_directions(columns.T @ columns))
