"""Benches for procedures, on a drive whose master is this process, or on an axis held by another process.

Calibration, improvement and the comparison of schemes require only the axis file, the identity of the drive,
and benches for procedures.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from hdbridge.axis import AxisConfig, Identity
from hdbridge.control.bench import Bench
from hdbridge.control.compensation import Compensation
from hdbridge.drive.drive import Drive


class Rig(Protocol):
    """Axis with a booted drive that another process holds."""

    @property
    def axis(self) -> AxisConfig: ...

    @property
    def identity(self) -> Identity:
        """Identity of the connected drive."""
        ...

    def bench(
        self, compensation: Compensation | None = None, *, interrupted: Callable[[], bool] = ...
    ) -> Bench:
        """Returns a bench; ``interrupted`` is called in each cycle of a run, as in `Bench`."""
        ...


def bench_on(
    place: Drive | Rig,
    compensation: Compensation | None = None,
    *,
    interrupted: Callable[[], bool] = lambda: False,
) -> Bench:
    """Returns a bench for a booted drive, or for an axis held by another process."""
    if isinstance(place, Drive):
        return Bench(place, compensation, interrupted=interrupted)
    return place.bench(compensation, interrupted=interrupted)
