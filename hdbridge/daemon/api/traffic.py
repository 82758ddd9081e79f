"""Counts of what goes over the API, for `/metrics`; one object for all listeners."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(slots=True)
class Traffic:
    """Requests that were answered, and connections that are open."""

    answered: Counter[tuple[str, int]] = field(default_factory=Counter)
    """By method and status."""
    open: Counter[str] = field(default_factory=Counter)
    """Requests under way (``http``), and WebSockets (``websocket``)."""

    @contextmanager
    def under_way(self, kind: str) -> Iterator[None]:
        """Counted as open within the block."""
        self.open[kind] += 1
        try:
            yield
        finally:
            self.open[kind] -= 1

    def count(self, method: str, status: int) -> None:
        """One more answer. Methods that are not HTTP's own count as OTHER: the counts are bounded."""
        known = method in {"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"}
        self.answered[method if known else "OTHER", status] += 1
