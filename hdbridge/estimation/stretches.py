"""Stretches of a record, numbered point by point, and what is summed over them."""

from __future__ import annotations

import numpy as np

from hdbridge.effects import FloatArray, IntArray


def of_length(time_s: FloatArray, length_s: float) -> IntArray:
    """A number per point that changes after every so many seconds; empty stretches are not counted."""
    return counted(np.floor((time_s - time_s[0]) / length_s).astype(np.intp))


def of_number(time_s: FloatArray, number: int) -> IntArray:
    """In which of so many equally long stretches of time each point lies, shape (n,)."""
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.asarray(np.minimum((time_s - time_s[0]) / span * number, number - 1), dtype=np.intp)


def counted(number: IntArray) -> IntArray:
    """The same stretches, numbered without gaps."""
    return np.asarray(np.unique(number, return_inverse=True)[1])


def sums(rows: FloatArray, number: IntArray) -> FloatArray:
    """Sums of rows (n, p) by their number, shape (numbers, p)."""
    return np.stack([np.bincount(number, each) for each in rows.T], axis=1)


def sandwich(influence: FloatArray, number: IntArray) -> FloatArray:
    """Covariance (p, p) of what is the sum of the influences of all points, (n, p), where those of one number
    may hang together (Liang and Zeger 1986).
    """
    summed, count = sums(influence, number), int(number[-1]) + 1
    return np.asarray(summed.T @ summed * (count / max(count - 1, 1)))


def about_zeros(left_arcsec: FloatArray, zero: IntArray, weight: FloatArray) -> FloatArray:
    """What is left (n,) about the weighted mean of each absolute zero; as it is where that weighs nothing."""
    total, weights = np.bincount(zero, weight * left_arcsec), np.bincount(zero, weight)
    return np.asarray(left_arcsec - (total / np.maximum(weights, 1e-300))[zero])
