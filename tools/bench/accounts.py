"""An account of the cycles: each number is that of a sample, was told as skipped, or was lost by a reader."""

from __future__ import annotations

from typing import Any


class Accounts:
    """What a reader of the sample ring has seen of the numbers of the cycles."""

    def __init__(self) -> None:
        self.samples = 0
        self.lost = 0
        """By this reader, which was too slow."""
        self.missing = 0
        """Numbers between two samples that have none."""
        self.skipped = 0
        """What the samples say was skipped."""
        self._cycle: int | None = None
        self._skipped = 0

    def take(self, samples: Any, lost: int) -> None:
        """What the reader gave."""
        self.lost += lost
        for cycle, skipped in zip(samples["cycle"].tolist(), samples["skipped"].tolist(), strict=True):
            if self._cycle is not None:
                self.missing += cycle - self._cycle - 1
                self.skipped += skipped - self._skipped
            self._cycle, self._skipped = cycle, skipped
            self.samples += 1

    @property
    def balanced(self) -> bool:
        """Whether every number that is missing was told as skipped, or was lost by the reader."""
        return self.missing == self.skipped + self.lost

    def report(self) -> dict[str, int | bool]:
        """As JSON."""
        return {
            "samples": self.samples, "lost": self.lost, "missing": self.missing, "skipped": self.skipped,
            "balanced": self.balanced,
        }  # fmt: skip
