"""Benches for procedures, on a drive that this process masters or on an axis that another process holds.

Calibration, improvement and the comparison of schemes need only this: the axis file, the identity of the
drive, and benches to run procedures on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from hdbridge.axis import AxisConfig, Identity
from hdbridge.control.bench import Bench
from hdbridge.control.compensation import Compensation
from hdbridge.drive.drive import Drive


class Rig(Protocol):
    """Axis that another process holds, with a booted drive."""

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
    """Returns a bench for a booted drive, or for an axis that another process holds."""
    if isinstance(place, Drive):
        return Bench(place, compensation, interrupted=interrupted)
    return place.bench(compensation, interrupted=interrupted)
