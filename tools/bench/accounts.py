"""Account of the cycles: each number has a sample, was reported as skipped, or was lost by a reader."""

from __future__ import annotations

from typing import Any


class Accounts:
    """Counts the cycle numbers that a reader of the sample ring has seen."""

    def __init__(self) -> None:
        self.samples = 0
        self.lost = 0
        """Samples lost because this reader was too slow."""
        self.missing = 0
        """Cycle numbers without a sample."""
        self.skipped = 0
        """Cycles that the samples report as skipped."""
        self._cycle: int | None = None
        self._skipped = 0

    def take(self, samples: Any, lost: int) -> None:
        """Counts the samples of one read."""
        self.lost += lost
        for cycle, skipped in zip(samples["cycle"].tolist(), samples["skipped"].tolist(), strict=True):
            if self._cycle is not None:
                self.missing += cycle - self._cycle - 1
                self.skipped += skipped - self._skipped
            self._cycle, self._skipped = cycle, skipped
            self.samples += 1

    @property
    def balanced(self) -> bool:
        """True if every missing number was reported as skipped, or was lost by the reader."""
        return self.missing == self.skipped + self.lost

    def report(self) -> dict[str, int | bool]:
        """Returns the JSON object."""
        return {
            "samples": self.samples, "lost": self.lost, "missing": self.missing, "skipped": self.skipped,
            "balanced": self.balanced,
        }  # fmt: skip
