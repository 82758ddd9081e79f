"""Frames that are not PDOs of the cycle: node status, and signs of another master on the bus."""

from collections.abc import Iterator
from typing import Final

from hdbridge.cia301 import NmtState
from hdbridge.drive.emergencies import HEARTBEAT_LOST, RPDO_TIMEOUT
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Frame
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.objects import COB_EMCY, COB_HEARTBEAT, COB_NMT, COB_SDO_REQUEST, COB_SYNC
from hdbridge.drive.supervision import Fault

_NODE_MASK: Final = 0x7F
_MASTER_LOST: Final = (HEARTBEAT_LOST, RPDO_TIMEOUT)
"""Emergency codes of a drive that stopped for lack of its master."""
_STATES: Final[dict[int, str]] = {
    NmtState.STOPPED: " (stopped)",
    NmtState.PRE_OPERATIONAL: " (pre-operational)",
}


def bus_faults(heartbeat_id: int) -> dict[int, tuple[Fault, str]]:
    """Returns, by identifier, the fault of each frame that only the single master of a bus may send.

    ``heartbeat_id`` is the identifier of the master's heartbeat.
    """
    return {
        COB_SYNC: (Fault.FOREIGN_SYNC, ""),
        heartbeat_id: (Fault.OWN_ID_ELSEWHERE, f"{heartbeat_id:03X}h, the master's heartbeat"),
        COB_NMT: (Fault.OWN_ID_ELSEWHERE, f"{COB_NMT:03X}h, an NMT command"),
    }


class Traffic:
    """Judges the frames of one axis's nodes that the control cycle does not wait for."""

    def __init__(self, image: ProcessImage, monitor: NetworkMonitor, now_s: float) -> None:
        self._monitor = monitor
        self._node_id = image.node_id
        self._nodes = {layout.node_id for layout in image.tpdos}
        for node_id in self._nodes:
            monitor.watch(node_id)
        self._own = {
            **dict.fromkeys((layout.can_id for layout in image.rpdos), "the RPDO"),
            COB_SDO_REQUEST + image.node_id: "an SDO request",
        }
        self.identifiers: frozenset[int] = frozenset(
            (*self._own, *(base + node_id for node_id in self._nodes for base in (COB_EMCY, COB_HEARTBEAT)))
        )
        """Identifiers of the frames that concern this axis."""
        self.heard_s = now_s
        """Time of the drive's last heartbeat; s."""

    def faults(self, frame: Frame, *, commanded: bool) -> Iterator[tuple[Fault, str]]:
        """Yields the faults that a frame reports, each with its detail for a message.

        ``commanded`` states that this master has enabled the drive and sends it set-points.
        """
        can_id, data, time_s = frame
        if self._monitor.dispatch(frame):
            node_id = can_id & _NODE_MASK
            if node_id not in self._nodes or not data:
                return
            if can_id < COB_HEARTBEAT:
                code = int.from_bytes(data[:2], "little")
                if code:
                    lost = commanded and code in _MASTER_LOST and node_id == self._node_id
                    yield (
                        Fault.MASTER_LOST if lost else Fault.EMERGENCY,
                        str(self._monitor.nodes[node_id].last_error),
                    )
                return
            if node_id == self._node_id:
                self.heard_s = time_s
            state = data[0] & _NODE_MASK
            if state == NmtState.BOOT_UP:
                yield Fault.BOOT_UP, f"node {node_id}"
            elif state != NmtState.OPERATIONAL:
                yield Fault.NMT_CHANGE, f"node {node_id}, NMT state {state:02X}h{_STATES.get(state, '')}"
        elif can_id in self._own:
            yield Fault.OWN_ID_ELSEWHERE, f"{can_id:03X}h, {self._own[can_id]}"
