"""The present motion of an axis and the client that began it. A new activity replaces the present one."""

from dataclasses import dataclass
from enum import Enum


class Kind(Enum):
    """Kind of an activity."""

    MOVE = "a move"
    JOG = "a jog"
    QUEUE = "a queue of moves"
    STREAM = "a stream"
    COORDINATED = "a coordinated move"


ENDS_WITH_LEASE = frozenset({Kind.JOG, Kind.QUEUE, Kind.STREAM})
"""Activities that are stopped when the lease under which they began ends. Moves end on their own."""


@dataclass(slots=True, eq=False)
class Activity:
    """One activity; it is over when another replaces it or when it has completed."""

    kind: Kind
    holder: str
    """Token of the lease under which it began."""
    command_id: int = 0
    """Id of the command to the control process that began this motion."""
    since: int = 0
    """Number of the newest log entry before it began; later entries report its outcome."""
    over: str = ""
    """Reason for its end; empty while it lasts."""

    def end(self, why: str) -> None:
        """Ends the activity; only the first reason counts."""
        self.over = self.over or why
