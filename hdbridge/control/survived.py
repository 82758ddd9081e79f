"""What a run went on in spite of: faults that the supervision let pass, counted. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

from pydantic import BaseModel, ConfigDict, Field

from hdbridge.drive.supervision import Fault, Supervision

PERIODS_SKIPPED = "a period was skipped"


class Survived(BaseModel):
    """A kind of fault, and how often it was seen."""

    model_config = ConfigDict(defer_build=True, frozen=True, extra="forbid")

    what: str = Field(description="what was seen, in the words of the fault table")
    cycles: int = Field(ge=1, description="in how many cycles")
    first: str = Field("", description="more about the first of them")

    def __str__(self) -> str:
        """``a TPDO is missing, in 3 cycles (first: 282h)``."""
        return f"{self.what}, in {self.cycles} cycle{'s' * (self.cycles > 1)}" + (
            f" (first: {self.first})" if self.first else ""
        )


class Watch:
    """Counts from where the supervision and the cycle stood when it was made."""

    __slots__ = ("_before", "_skipped", "_supervision")

    def __init__(self, supervision: Supervision, skipped: int) -> None:
        """``skipped`` is how many periods had been given up by then."""
        self._supervision = supervision
        self._before = dict(supervision.counts)
        self._skipped = skipped

    def survived(self, skipped: int) -> tuple[Survived, ...]:
        """What was seen since then, in the order of the fault table; the last is periods skipped."""
        counts = {
            fault: count - self._before[fault]
            for fault, count in self._supervision.counts.items()
            if count > self._before[fault]
        }
        first: dict[Fault, str] = {}
        for event in islice(reversed(self._supervision.events), sum(counts.values())):
            first[event.fault] = event.detail
        found = [
            Survived(what=fault.value, cycles=count, first=first.get(fault, ""))
            for fault, count in counts.items()
        ]
        if skipped > self._skipped:
            found.append(Survived(what=PERIODS_SKIPPED, cycles=skipped - self._skipped))
        return tuple(found)


def lines(runs: Iterable[tuple[str, Sequence[Survived]]]) -> Iterator[str]:
    """A line for each run that went on in spite of something; of each the name comes first."""
    for name, survived in runs:
        if survived:
            yield f"{name} went on in spite of: {'; '.join(map(str, survived))}"
