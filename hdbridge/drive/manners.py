"""Listening before speaking: does somebody else master this bus?

A reset, and on some drives a mere SDO request, stops an axis that another master is moving. So before its
first frame a master hears what is on the bus, for as long as the slowest other master may be silent. What
counts is what would stop the axis if it came while this master ran: SYNC, NMT commands, the heartbeat of a
master, set-points.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container
from typing import Final

from hdbridge.drive import objects
from hdbridge.drive.link import Frame, Link
from hdbridge.errors import BusInUseError

LONGEST_CYCLE_S: Final = 0.255
"""The slowest SYNC that a drive can be set to: 255 ms in 60C2h."""
PERIODS: Final = 2
"""Of the slowest cycle, and of the heartbeat: one may just have been sent."""
USUAL_MASTER: Final = 127
"""Node id under which masters send their heartbeat (77Fh), unless their axis file says otherwise."""
_RPDOS: Final = (objects.COB_RPDO1, 0x300, 0x400, 0x500)
_FUNCTION: Final = 0x780
_NODE: Final = 0x7F


def listening_s(heartbeat_ms: float = 0.0) -> float:
    """How long to listen where heartbeats come every ``heartbeat_ms``, s."""
    return PERIODS * max(heartbeat_ms / 1000.0, LONGEST_CYCLE_S)


def heartbeat_of(frame: Frame) -> int | None:
    """The node whose heartbeat or boot-up message this is, or None."""
    node_id = frame.can_id - objects.COB_HEARTBEAT
    return node_id if 0 < node_id <= _NODE else None


class Ear:
    """Counts the frames that only another master sends.

    ``drives`` are the nodes whose set-points count, ``masters`` the node ids whose heartbeat is a master's,
    ``asked`` the nodes whose SDO channel nobody else may use.
    """

    def __init__(
        self, drives: Container[int], masters: Container[int] = (USUAL_MASTER,), asked: Container[int] = ()
    ) -> None:
        self._drives, self._masters, self._asked = drives, masters, asked
        self._heard: Counter[int] = Counter()
        self.nodes: set[int] = set()
        """Whose heartbeat was heard."""

    def take(self, frame: Frame) -> bool:
        """Take a frame; whether it was another master's."""
        can_id = frame.can_id
        self._note(frame)
        if self._name(can_id) is None:
            return False
        self._heard[can_id] += 1
        return True

    def listen(self, link: Link, duration_s: float, then: Callable[[Frame], object] = lambda _: None) -> None:
        """Hear everything that comes; ``then`` receives it as well. A master that was there before is not."""
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
        """``26 SYNC (080h), 26 set-points of node 1 (201h)``; empty where nothing was heard."""
        return ", ".join(f"{count} {self._name(can_id)} ({can_id:03X}h)" for can_id, count in
                         sorted(self._heard.items()))  # fmt: skip

    def refuse(self, bus: str, duration_s: float) -> None:
        """`BusInUseError` where another master was heard."""
        if self._heard:
            raise BusInUseError(
                f"{bus}: somebody else masters this bus: {self} in {duration_s:.2g} s, and nothing was sent; "
                "stop that master first (--force, in the library force=True, speaks all the same)"
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
        if function == objects.COB_SDO_REQUEST and node in self._asked:
            return f"SDO requests to node {node}"
        return None
