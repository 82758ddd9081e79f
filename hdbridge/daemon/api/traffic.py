"""Counts of API requests for `/metrics`; one object for all listeners."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(slots=True)
class Traffic:
    """Answered requests and open connections."""

    answered: Counter[tuple[str, int]] = field(default_factory=Counter)
    """Number of answers by method and status."""
    open: Counter[str] = field(default_factory=Counter)
    """Number of requests under way (``http``) and of WebSockets (``websocket``)."""

    @contextmanager
    def under_way(self, kind: str) -> Iterator[None]:
        """Counts a request or WebSocket as open within the block."""
        self.open[kind] += 1
        try:
            yield
        finally:
            self.open[kind] -= 1

    def count(self, method: str, status: int) -> None:
        """Counts an answer. Unknown methods count as OTHER, which bounds the number of counters."""
        known = method in {"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"}
        self.answered[method if known else "OTHER", status] += 1
