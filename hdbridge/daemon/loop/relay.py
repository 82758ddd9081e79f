"""Filter for the frames relayed between the service and the bus, without I/O.

The service may send SDO and NMT frames to the axes' nodes and nothing else: SYNC, set-points and the
master's heartbeat come from the loop alone. While an axis may move, its nodes can be read but not written
or restarted.
"""

from collections.abc import Iterable
from typing import Final

from hdbridge.daemon.loop.states import MAY_MOVE, AxisState
from hdbridge.drive.objects import COB_EMCY, COB_HEARTBEAT, COB_NMT, COB_SDO_ANSWER, COB_SDO_REQUEST

_NODE: Final = 0x7F
_ABORT, _UPLOAD, _UPLOAD_SEGMENT, _BLOCK_UPLOAD = 4, 2, 3, 5
READING: Final = frozenset({_UPLOAD, _UPLOAD_SEGMENT, _ABORT, _BLOCK_UPLOAD})
"""Command specifiers (CiA 301) of SDO requests that change nothing in the node."""


def incoming_ids(nodes: Iterable[int]) -> frozenset[int]:
    """Returns the identifiers that the service receives: SDO answers, emergencies, all heartbeats."""
    own = {base + node for node in nodes for base in (COB_SDO_ANSWER, COB_EMCY)}
    return frozenset(own | {COB_HEARTBEAT + node for node in range(1, _NODE + 1)})


def refusal_reason(can_id: int, data: bytes, states: dict[int, AxisState]) -> str | None:
    """Returns the reason for not sending a frame of the service; None if it may be sent.

    ``states`` maps each node of the machine to its axis's state.
    """
    if can_id == COB_NMT:
        node = data[1] if len(data) == 2 else -1
        what, writes = f"NMT command {data.hex(' ')}", True
    elif COB_SDO_REQUEST < can_id <= COB_SDO_REQUEST + _NODE:
        node = can_id - COB_SDO_REQUEST
        what, writes = f"SDO request to node {node}", not data or data[0] >> 5 not in READING
    else:
        return f"{can_id:03X}h: the service sends SDO requests and NMT commands only"
    state = states.get(node)
    if state is None:
        return f"{what}: expected one of the machine's nodes ({', '.join(map(str, sorted(states)))})"
    if writes and state in MAY_MOVE:
        return f"{what}: not while the axis is {state.name.lower()}; disable it first"
    return None
