"""What moves an axis at present, on whose behalf. A newer one takes the place of an older one."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Kind(Enum):
    """What a client may have an axis do."""

    MOVE = "a move"
    JOG = "a jog"
    QUEUE = "a queue of moves"
    STREAM = "a stream"
    COORDINATED = "a coordinated move"
    JOB = "a job"


ENDS_WITH_LEASE = frozenset({Kind.JOG, Kind.QUEUE, Kind.STREAM})
"""What is stopped when the lease ends under which it began. A move has an end of its own, a job as well."""


@dataclass(slots=True, eq=False)
class Activity:
    """One of them; it is over when something else has taken its place or it came to its end."""

    kind: Kind
    holder: str
    """Token of the lease under which it began."""
    command_id: int = 0
    """Of the command to the control process whose motion this is."""
    since: int = 0
    """Number of the newest log entry before it began: what became of it is told after that."""
    over: str = ""
    """Why it is over, in words; empty while it goes on."""

    def end(self, why: str) -> None:
        """It is over; the first reason counts."""
        self.over = self.over or why
