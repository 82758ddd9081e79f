"""Faults that occurred in a run, with counts. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

from pydantic import Field

from hdbridge.drive.supervision import Fault, Supervision
from hdbridge.strictness import Strict

PERIODS_SKIPPED = "a period was skipped"


class FaultCount(Strict):
    """A kind of fault, with the number of cycles in which it occurred."""

    what: str = Field(description="the fault, in the words of the fault table")
    cycles: int = Field(ge=1, description="number of cycles in which it occurred")
    first: str = Field("", description="details of the first one")

    def __str__(self) -> str:
        """Formats as ``a TPDO is missing, in 3 cycles (first: 282h)``."""
        return f"{self.what}, in {self.cycles} cycle{'s' * (self.cycles > 1)}" + (
            f" (first: {self.first})" if self.first else ""
        )


class FaultCounter:
    """Counts faults and skipped periods since its creation."""

    def __init__(self, supervision: Supervision, skipped: int) -> None:
        """``skipped`` is the number of periods skipped before its creation."""
        self._supervision = supervision
        self._before = dict(supervision.counts)
        self._skipped = skipped

    def fault_counts(self, skipped: int) -> tuple[FaultCount, ...]:
        """Returns the faults since creation in fault-table order, followed by the skipped periods."""
        counts = {
            fault: count - self._before[fault]
            for fault, count in self._supervision.counts.items()
            if count > self._before[fault]
        }
        first: dict[Fault, str] = {}
        for event in islice(reversed(self._supervision.events), sum(counts.values())):
            first[event.fault] = event.detail
        found = [
            FaultCount(what=fault.value, cycles=count, first=first.get(fault, ""))
            for fault, count in counts.items()
        ]
        if skipped > self._skipped:
            found.append(FaultCount(what=PERIODS_SKIPPED, cycles=skipped - self._skipped))
        return tuple(found)


def fault_notes(runs: Iterable[tuple[str, Sequence[FaultCount]]]) -> Iterator[str]:
    """Yields one line for each run with tolerated faults, beginning with the run's name."""
    for name, fault_counts in runs:
        if fault_counts:
            yield f"{name} continued despite: {'; '.join(map(str, fault_counts))}"
