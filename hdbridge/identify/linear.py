"""Symmetric systems that may be singular: columns that a record cannot tell apart share what they explain."""

from __future__ import annotations

import numpy as np

from hdbridge.effects import FloatArray


def solve_symmetric(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Least-norm solution of a positive semi-definite system, columns scaled to one."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    keep = values > 1e-11 * values[-1] if len(values) else values > 0
    scaled = right / (scale if right.ndim == 1 else scale[:, np.newaxis])
    inner = vectors[:, keep].T @ scaled
    inner = inner / (values[keep] if right.ndim == 1 else values[keep][:, np.newaxis])
    solved = vectors[:, keep] @ inner
    return np.asarray(solved / (scale if right.ndim == 1 else scale[:, np.newaxis]))


def inverse_symmetric(matrix: FloatArray) -> FloatArray:
    """Inverse of a positive semi-definite matrix by its scaled eigenvalues; huge where it has none."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    inverse = vectors @ ((1.0 / np.maximum(values, 1e-12 * values[-1]))[:, np.newaxis] * vectors.T)
    return np.asarray(inverse / np.outer(scale, scale))
