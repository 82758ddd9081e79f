"""Detection of another master on the bus, by listening before this master sends its first frame.

A reset, and on some drives even an SDO request, stops an axis that another master is moving. A master
therefore listens first, for as long as the slowest other master may be silent. The relevant frames are those
that would stop the axis while this master runs: SYNC, NMT commands, a master's heartbeat and set-points.
"""

from collections import Counter
from collections.abc import Callable, Container, Sequence
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.drive import objects
from hdbridge.drive.link import Frame, Link
from hdbridge.errors import BusInUseError

LONGEST_CYCLE_S: Final = 0.255
"""Longest SYNC period that a drive accepts: 255 ms in 60C2h; s."""
PERIODS: Final = 2
"""Listening time in periods of the slowest cycle or of the heartbeat, whichever is longer. There are two,
because the last frame may have been sent just before listening started."""
DEFAULT_MASTER_ID: Final = 127
"""Default node id of a master's heartbeat (77Fh), unless its axis file sets another."""
_RPDOS: Final = (objects.COB_RPDO1, 0x300, 0x400, 0x500)
_FUNCTION: Final = 0x780
_NODE: Final = 0x7F


def listening_s(heartbeat_ms: float = 0.0) -> float:
    """Returns the time to listen, s, for a heartbeat period in ms."""
    return PERIODS * max(heartbeat_ms / 1000.0, LONGEST_CYCLE_S)


def heartbeat_of(frame: Frame) -> int | None:
    """Returns the node of a heartbeat or boot-up message, or None."""
    node_id = frame.can_id - objects.COB_HEARTBEAT
    return node_id if 0 < node_id <= _NODE else None


def refuse_other_masters(
    link: Link, axes: Sequence[AxisConfig], then: Callable[[Frame], object] = lambda _: None
) -> set[int]:
    """Listens for another master of these axes before the first frame; returns the nodes that were heard.

    ``then`` also receives every frame. Raises `BusInUseError` if there is another master.
    """
    detector = MasterDetector(
        {axis.drive.node_id for axis in axes},
        {axis.drive.master_node_id for axis in axes} | {DEFAULT_MASTER_ID},
        {node for axis in axes for node in axis.nodes},
    )
    duration_s = listening_s(max(axis.drive.heartbeat_ms for axis in axes))
    detector.listen(link, duration_s, then)
    detector.raise_if_heard(link.name, duration_s)
    return detector.nodes


class MasterDetector:
    """Counts the frames that only another master sends.

    ``drives`` are the nodes whose set-points count, ``masters`` the node ids whose heartbeat is a master's,
    ``sdo_servers`` the nodes whose SDO requests count.
    """

    def __init__(
        self,
        drives: Container[int],
        masters: Container[int] = (DEFAULT_MASTER_ID,),
        sdo_servers: Container[int] = (),
    ) -> None:
        self._drives, self._masters, self._sdo_servers = drives, masters, sdo_servers
        self.counts: Counter[int] = Counter()
        """Number of frames of another master by identifier."""
        self.nodes: set[int] = set()
        """Nodes whose heartbeat was heard."""

    def take(self, frame: Frame) -> bool:
        """Takes a frame; returns True if it came from another master."""
        can_id = frame.can_id
        self._note(frame)
        if self._name(can_id) is None:
            return False
        self.counts[can_id] += 1
        return True

    def listen(self, link: Link, duration_s: float, then: Callable[[Frame], object] = lambda _: None) -> None:
        """Listens for a duration; ``then`` also receives every frame.

        Frames that were already queued do not count, because their master may have left the bus.
        """
        for old in link.drain():
            self._note(old)
            then(old)
        end_s = link.now() + duration_s
        while (frame := link.recv(end_s)) is not None:
            self.take(frame)
            then(frame)
            if frame.time_s >= end_s:
                return

    def _note(self, frame: Frame) -> None:
        if (node_id := heartbeat_of(frame)) is not None:
            self.nodes.add(node_id)

    def __str__(self) -> str:
        """For example ``26 SYNC (080h), 26 set-points of node 1 (201h)``; empty if nothing was heard."""
        return ", ".join(f"{count} {self._name(can_id)} ({can_id:03X}h)" for can_id, count in
                         sorted(self.counts.items()))  # fmt: skip

    def raise_if_heard(self, bus: str, duration_s: float) -> None:
        """Raises `BusInUseError` if another master was heard."""
        if self.counts:
            raise BusInUseError(
                f"{bus}: another master is on this bus: {self} in {duration_s:.2g} s; nothing was sent; "
                "stop that master first (--force, in the library force=True, sends anyway)"
            )

    def _name(self, can_id: int) -> str | None:
        if can_id == objects.COB_NMT:
            return "NMT commands"
        if can_id == objects.COB_SYNC:
            return "SYNC"
        node, function = can_id & _NODE, can_id & _FUNCTION
        if function in _RPDOS and node in self._drives:
            return f"set-points of node {node}"
        if function == objects.COB_HEARTBEAT and node in self._masters:
            return f"heartbeats of master {node}"
        if function == objects.COB_SDO_REQUEST and node in self._sdo_servers:
            return f"SDO requests to node {node}"
        return None
