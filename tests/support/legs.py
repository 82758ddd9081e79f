"""Synthetic legs, joined into a measurement for identification."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.analysis import identify
from hdbridge.analysis.identification import FitOptions, FitResult
from hdbridge.analysis.prepared import Measured
from hdbridge.records.record import Record


@dataclass(frozen=True)
class Leg:
    """Samples of one leg; arrays of equal length, multi-turn degrees."""

    time_s: np.ndarray
    motor_deg: np.ndarray
    """Commanded motor angle, or the measured one if ``commanded`` is false."""
    load_deg: np.ndarray
    kind: str = "unknown"
    position_deg: np.ndarray | None = None
    """Measured motor angle, if it is given in addition to the command."""
    commanded: bool = True
    zero: int = 0

    def __len__(self) -> int:
        return len(self.time_s)


def measured(legs: Sequence[Leg], name: str = "") -> Measured:
    """Joins legs; motion is continuous between two legs unless their zeros differ."""
    columns = {
        "time_s": [each.time_s for each in legs],
        "motor_position_deg": [
            each.motor_deg if each.position_deg is None else each.position_deg for each in legs
        ],
        "load_position_deg": [each.load_deg for each in legs],
    }
    if all(each.commanded for each in legs):
        columns["motor_target_deg"] = [each.motor_deg for each in legs]
    kinds = tuple(dict.fromkeys(each.kind for each in legs))
    kind, zero = (
        np.repeat(each, [len(leg) for leg in legs])
        for each in ([kinds.index(leg.kind) for leg in legs], [leg.zero for leg in legs])
    )
    starts = (0, *(np.flatnonzero(np.diff(zero)) + 1).tolist())
    record = Record({key: np.concatenate(each) for key, each in columns.items()}, name, starts)
    return Measured(record, kinds, kind, zero)


def fit(legs: Sequence[Leg], ratio: float, options: FitOptions | None = None, name: str = "") -> FitResult:
    """Identifies an axis from legs."""
    return identify.fit(measured(legs, name), ratio, options)
