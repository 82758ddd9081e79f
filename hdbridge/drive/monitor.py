"""Unsolicited messages of the nodes: heartbeats, boot-up messages and emergencies.

This module only records and makes no decisions. Every receiver passes its frames on to the monitor, so that a
heartbeat during an SDO transfer is not lost.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from hdbridge.cia301 import NmtState
from hdbridge.drive.emergencies import error_name
from hdbridge.drive.link import Frame
from hdbridge.drive.objects import COB_EMCY, COB_HEARTBEAT

EMERGENCIES_KEPT: Final = 64


class Emergency(NamedTuple):
    """One EMCY message; ``vendor`` has fewer than five bytes if the message is too short."""

    time_s: float
    code: int
    register: int
    vendor: bytes

    def __str__(self) -> str:
        """For example ``EMCY 8611h (following error), register 21h, 00 00 00 00 00``."""
        return f"EMCY {self.code:04X}h ({error_name(self.code)}), register {self.register:02X}h" + (
            f", {self.vendor.hex(' ')}" if self.vendor else ""
        )


@dataclass(slots=True)
class NodeStatus:
    """State of a node according to its own messages."""

    node_id: int
    nmt_state: int | None = None
    """Last `NmtState` byte; None before the first heartbeat."""
    heartbeat_s: float | None = None
    """Time of the last heartbeat or boot-up message, on the link's clock; s."""
    boot_ups: int = 0
    heartbeats: int = 0
    restarted: bool = False
    """True if the node has sent a boot-up message since `NetworkMonitor.started`."""
    boot_up_s: float | None = None
    """Time of the last boot-up message, on the link's clock; s."""
    emergency_count: int = 0
    """Number of all emergencies, including those dropped from the ring buffer."""
    emergencies: deque[Emergency] = field(default_factory=lambda: deque(maxlen=EMERGENCIES_KEPT))

    @property
    def counts(self) -> tuple[int, int, int]:
        """Number of boot-up messages, heartbeats and emergencies so far."""
        return self.boot_ups, self.heartbeats, self.emergency_count

    def heard_since(self, counts: tuple[int, int, int]) -> str:
        """Describes the messages of the node since these counts; empty if nothing was received."""
        boot_ups, heartbeats, emergencies = counts
        said = []
        if self.boot_ups > boot_ups:
            said.append("its boot-up message")
        if self.heartbeats > heartbeats:
            said.append(f"a heartbeat ({self.nmt_state or 0:02X}h)")
        if self.emergency_count > emergencies:
            said.append(str(self.emergencies[-1]))
        return " and ".join(said)

    @property
    def last_error(self) -> Emergency | None:
        """Newest emergency that reports an error rather than its end (code 00xxh), or None."""
        return next((entry for entry in reversed(self.emergencies) if entry.code >> 8), None)


class NetworkMonitor:
    """Keeps a `NodeStatus` for each watched node."""

    def __init__(self, *node_ids: int) -> None:
        self.nodes: dict[int, NodeStatus] = {}
        self._heartbeat: dict[int, NodeStatus] = {}
        self._emergency: dict[int, NodeStatus] = {}
        for node_id in node_ids:
            self.watch(node_id)

    def watch(self, node_id: int) -> NodeStatus:
        """Returns the status of a node; starts to watch the node if necessary."""
        status = self.nodes.get(node_id)
        if status is None:
            status = NodeStatus(node_id)
            self.nodes[node_id] = status
            self._heartbeat[COB_HEARTBEAT + node_id] = status
            self._emergency[COB_EMCY + node_id] = status
        return status

    def started(self, node_id: int) -> None:
        """Records that a configured node is being started (NMT); a later boot-up message undoes that."""
        status = self.watch(node_id)
        status.restarted, status.nmt_state = False, None

    @property
    def restarted(self) -> int | None:
        """Id of a watched node that has restarted since it was started; None without one."""
        return next((each.node_id for each in self.nodes.values() if each.restarted), None)

    def dispatch(self, frame: Frame) -> bool:
        """Takes a frame; returns True for a heartbeat, boot-up message or emergency of a watched node."""
        can_id, data, time_s = frame
        status = self._heartbeat.get(can_id)
        if status is not None:
            if not data:
                return True
            # Bit 7 is the toggle bit of the obsolete node guarding.
            nmt_state = data[0] & 0x7F
            status.nmt_state = nmt_state
            status.heartbeat_s = time_s
            if nmt_state == NmtState.BOOT_UP:
                status.boot_ups += 1
                status.restarted = True
                status.boot_up_s = time_s
            else:
                status.heartbeats += 1
            return True
        status = self._emergency.get(can_id)
        if status is None:
            return False
        status.emergency_count += 1
        code = int.from_bytes(data[:2], "little")
        status.emergencies.append(Emergency(time_s, code, data[2] if len(data) > 2 else 0, bytes(data[3:8])))
        return True
