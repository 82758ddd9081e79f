"""Where procedures run: on a drive that this process masters, or on an axis that another process holds.

A calibration, an improvement, a comparison of schemes need no more of it than this: whose axis it is, which
drive answers, and benches to run procedures on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

from hdbridge.axis import AxisConfig, Identity
from hdbridge.control.bench import Bench, Run
from hdbridge.control.compensation import Compensation
from hdbridge.control.survived import Survived
from hdbridge.drive.drive import Drive
from hdbridge.procedures.moves import Procedure
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment

Outcome = TypeVar("Outcome")


class ProcedureBench(Protocol):
    """What runs procedures; `Bench` is one, and says what each of these does."""

    @property
    def legs(self) -> tuple[Segment, ...]: ...

    @property
    def survived(self) -> tuple[Survived, ...]: ...

    def record(self) -> Record: ...

    def run(
        self, procedure: Procedure[Outcome], progress: Callable[[float], None] = ..., /
    ) -> Run[Outcome]: ...


class Rig(Protocol):
    """An axis that is held elsewhere, with a booted drive."""

    @property
    def axis(self) -> AxisConfig: ...

    @property
    def identity(self) -> Identity:
        """Which drive answers."""
        ...

    def bench(
        self, compensation: Compensation | None = None, *, interrupted: Callable[[], bool] = ...
    ) -> ProcedureBench:
        """As `Bench` of a drive: ``interrupted`` is asked in each cycle of a run."""
        ...


def bench_on(
    place: Drive | Rig,
    compensation: Compensation | None = None,
    *,
    interrupted: Callable[[], bool] = lambda: False,
) -> ProcedureBench:
    """A bench for a booted drive, or for an axis that is held elsewhere."""
    if isinstance(place, Drive):
        return Bench(place, compensation, interrupted=interrupted)
    return place.bench(compensation, interrupted=interrupted)
