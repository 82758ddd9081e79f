"""Scan of a CAN bus: listens first, then queries each node id, and writes nothing.

Only SDO read requests are sent (and an SDO abort after an unanswered request). A node that is busy with
another SDO client is skipped, because a second client on the same channel would disrupt its transfer.
"""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.cia301 import NmtState
from hdbridge.commissioning.bringup import ASK_TIMEOUT_S, LISTEN_S
from hdbridge.drive import objects
from hdbridge.drive.bootup import read_names
from hdbridge.drive.link import Frame, Link
from hdbridge.drive.masterdetection import MasterDetector, listening_s
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.nameplate import IDENTITY
from hdbridge.drive.objects import CYCLIC, Address, IntegerType
from hdbridge.drive.sdo import SdoAbortError, SdoClient
from hdbridge.errors import SdoError

DETAIL_TIMEOUT_S: Final = 0.3
NODE_IDS: Final = range(1, 128)

PROFILES: Final[dict[int, str]] = {
    401: "input/output module",
    402: "drive",
    404: "measuring device or controller",
    406: "encoder",
    408: "hydraulic drive",
    410: "inclinometer",
    418: "battery",
    419: "battery charger",
}
"""Device profiles of CiA, by the low half of object 1000h."""
MODES: Final[dict[int, str]] = {
    0: "PP", 1: "VL", 2: "PV", 3: "TQ", 5: "HM", 6: "IP", 7: "CSP", 8: "CSV", 9: "CST",
}  # fmt: skip
"""Modes of operation by their bit in 6502h."""
_SCALING: Final = (
    objects.ENCODER_INCREMENTS,
    objects.ENCODER_REVOLUTIONS,
    objects.GEAR_MOTOR,
    objects.GEAR_SHAFT,
    objects.RATED_TORQUE,
    *objects.additional_resolution(1),
)
ENCODER_UNITS_PER_TURN: Final = Address(0x6001, 0, IntegerType.UINT32, "measuring units per revolution")
"""Object of CiA 406."""


@dataclass(slots=True)
class Node:
    """Data of one node, as far as known."""

    node_id: int
    nmt_state: int | None = None
    """State byte of the node's last heartbeat; None without a heartbeat."""
    answers: bool = False
    """True if the node answered an SDO request."""
    busy: bool = False
    """True if the node was not queried because another SDO client was using it."""
    device_type: int | None = None
    identity: dict[str, int] = field(default_factory=dict)
    """Identity by the keys of ``drive.identity``; objects that the node lacks are missing."""
    names: dict[str, str] = field(default_factory=dict)
    """Device name, hardware and software version."""
    modes: int | None = None
    """Object 6502h of a drive."""
    values: dict[Address, int] = field(default_factory=dict)
    """Objects that help to write an axis file: resolutions, gear ratio, rated torque."""

    @property
    def profile(self) -> int | None:
        """Device profile, 402 for a drive; None if unknown."""
        return None if self.device_type is None else self.device_type & 0xFFFF

    @property
    def kind(self) -> str:
        """Kind of device, as text."""
        if self.profile is None:
            return "not queried: another SDO client is using it" if self.busy else "unknown"
        return (
            f"{PROFILES.get(self.profile, 'device')} (CiA {self.profile})" if self.profile else "no profile"
        )

    @property
    def state(self) -> str:
        """NMT state, as text."""
        if self.nmt_state is None:
            return "no heartbeat; it answers, so it is not stopped" if self.answers else "no heartbeat"
        try:
            return NmtState(self.nmt_state).name.lower().replace("_", "-")
        except ValueError:
            return f"unknown state {self.nmt_state:02X}h"

    @property
    def mode_names(self) -> list[str]:
        """Abbreviations of the drive's supported modes of operation."""
        return [name for bit, name in MODES.items() if (self.modes or 0) >> bit & 1]

    @property
    def usable(self) -> bool:
        """True for a CiA-402 drive with a cyclic position mode, or with unknown modes."""
        return self.profile == objects.DEVICE_PROFILE_402 and (self.modes is None or self.cyclic is not None)

    @property
    def cyclic(self) -> str | None:
        """Value of ``drive.mode`` for this drive; None if it has neither mode or does not report them."""
        has = [name for name, each in CYCLIC.items() if (self.modes or 0) & each.mode.supported_bit]
        return has[0] if has else None


@dataclass(frozen=True, slots=True)
class Scan:
    """Result of a scan."""

    nodes: tuple[Node, ...]
    remarks: tuple[str, ...] = ()
    """Other relevant observations: other masters, other SDO clients."""

    def node(self, node_id: int) -> Node | None:
        """Returns the node with that id, or None."""
        return next((each for each in self.nodes if each.node_id == node_id), None)


class _BusObserver:
    """Observes all frames: records the nodes that send, SDO traffic, and signs of another master."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.monitor = NetworkMonitor(*NODE_IDS)
        self.spoken: set[int] = set()
        """Nodes that have sent a frame."""
        self.busy: set[int] = set()
        self.detector = MasterDetector(NODE_IDS)

    def take(self, frame: Frame) -> None:
        self.detector.take(frame)
        node_id = frame.can_id & 0x7F
        function = frame.can_id - node_id
        if self.monitor.dispatch(frame):
            self.spoken.add(node_id)
        elif function in (objects.COB_SDO_REQUEST, objects.COB_SDO_ANSWER) and node_id:
            self.busy.add(node_id)

    def listen(self, duration_s: float) -> None:
        end_s = self.link.now() + duration_s
        while (frame := self.link.recv(end_s)) is not None:
            self.take(frame)
            if frame.time_s >= end_s:
                return

    def remarks(self) -> list[str]:
        remarks = []
        counts = self.detector.counts
        if syncs := counts[objects.COB_SYNC]:
            remarks.append(
                f"{syncs} SYNC messages were heard: another master runs on this bus; stop it before you "
                "control an axis here"
            )
        if commands := counts[objects.COB_NMT]:
            remarks.append(f"{commands} NMT commands of another master were heard")
        if self.busy:
            who = ", ".join(map(str, sorted(self.busy)))
            remarks.append(
                f"another SDO client is using node {who}; it was not queried: stop that client, scan again"
            )
        return remarks


def scan_bus(
    link: Link,
    *,
    listen_s: float = LISTEN_S,
    timeout_s: float = ASK_TIMEOUT_S,
    progress: Callable[[float], None] = lambda _: None,
    force: bool = False,
) -> Scan:
    """Listens for ``listen_s``, then queries the device type of every node id, and further objects of those
    that answer.

    ``progress`` receives the completed fraction. Raises `BusInUseError` before anything is sent if another
    master is heard, because a request may stop the axis that this master moves; the time of listening is
    extended if the detection requires it. ``force`` skips the detection. Raises `BusError` if the interface
    fails.
    """
    force = force or link.private
    observer = _BusObserver(link)
    duration_s = listen_s if force else max(listen_s, listening_s())
    observer.listen(duration_s)
    if not force:
        observer.detector.raise_if_heard(link.name, duration_s)
    nodes: dict[int, Node] = {}
    for place, node_id in enumerate(NODE_IDS):
        if node_id in observer.busy:
            nodes[node_id] = Node(node_id, busy=True)
        else:
            node = _ask(observer, node_id, timeout_s)
            if node.answers:
                nodes[node_id] = node
        progress((place + 1) / len(NODE_IDS))
    for node_id, status in observer.monitor.nodes.items():
        if status.heartbeat_s is not None or status.emergency_count:
            nodes.setdefault(node_id, Node(node_id)).nmt_state = status.nmt_state
    return Scan(tuple(nodes[each] for each in sorted(nodes)), tuple(observer.remarks()))


def _ask(observer: _BusObserver, node_id: int, timeout_s: float) -> Node:
    node = Node(node_id)
    sdo = SdoClient(observer.link, observer.monitor, node_id, None, timeout_s, attempts=1)
    try:
        node.device_type = sdo.fetch(objects.DEVICE_TYPE)
    except SdoAbortError:
        pass  # the node is present, but refuses the one object that every node must have
    except SdoError:
        return node
    node.answers = True
    sdo = SdoClient(observer.link, observer.monitor, node_id, None, DETAIL_TIMEOUT_S, attempts=2)
    found = _fetched(sdo, dict(IDENTITY))
    node.identity = {name: found[address] for address, name in IDENTITY if address in found}
    node.names = read_names(sdo)
    wanted: tuple[Address, ...] = ()
    if node.profile == objects.DEVICE_PROFILE_402:
        node.modes = _fetched(sdo, (objects.SUPPORTED_MODES,)).get(objects.SUPPORTED_MODES)
        wanted = _SCALING
    elif node.profile == 406:
        wanted = (ENCODER_UNITS_PER_TURN,)
    node.values = _fetched(sdo, wanted)
    return node


def _fetched(sdo: SdoClient, addresses: Iterable[Address]) -> dict[Address, int]:
    """Reads optional objects; omits those that the node lacks."""
    found = {}
    for address in addresses:
        with suppress(SdoError):
            found[address] = sdo.read(address.index, address.sub, address.type)
    return found


def compare(axis: AxisConfig, scan: Scan) -> tuple[bool, list[str]]:
    """Returns True if the axis file's drive was found, else False and one line for each necessary change."""
    there = scan.node(axis.drive.node_id)
    if there is not None and there.answers and there.usable and not _identity_lines(axis, there):
        return True, []
    lines = []
    if there is None:
        lines.append(f"{axis.where('drive.node_id')}: nothing answers as node {axis.drive.node_id}")
    elif there.busy:
        lines.append(f"node {there.node_id} is in use by another SDO client: stop that one, scan again")
    elif not there.answers:
        lines.append(
            f"node {there.node_id} sends heartbeats ({there.state}) but answers no SDO: a stopped node does "
            "not; switch it off and on"
        )
    elif not there.usable:
        lines.append(
            f"{axis.where('drive.node_id')}: node {there.node_id} is: {there.kind}; expected a "
            "CiA-402 drive with cyclic synchronous (CSP) or interpolated position (IP)"
        )
    else:
        lines += _identity_lines(axis, there)
    for node in scan.nodes:
        if node is not there and node.usable and not _identity_lines(axis, node):
            lines.append(
                f"{axis.where('drive.node_id')}: found {axis.drive.node_id}; the drive with this identity "
                f"is node {node.node_id}"
            )
    return False, lines


def _identity_lines(axis: AxisConfig, node: Node) -> list[str]:
    lines = []
    for name, wanted in axis.drive.identity.model_dump(exclude_none=True).items():
        found = node.identity.get(name)
        if found != wanted:
            said = "does not report it" if found is None else f"reports {found:#x}"
            key = axis.where(f"drive.identity.{name}")
            lines.append(f"{key}: found {wanted:#x}; node {node.node_id} {said}")
    return lines


def axis_lines(node: Node) -> list[str]:
    """Returns the lines of `axis_sections`."""
    return [line for name, own in axis_sections(node).items() for line in (f"{name}:", *own)]


def axis_sections(node: Node) -> dict[str, list[str]]:
    """Returns the lines of an axis file that state a node's data, by section; none for an unusable node."""
    if node.profile == 406:
        units = node.values.get(ENCODER_UNITS_PER_TURN)
        return {
            "load_encoder": [
                *([f"  counts_per_turn: {units}         # 6001h"] if units else []),
                f"  source: {{index: 0x6004, subindex: 0, type: uint32, node: {node.node_id}}}",
            ]
        }
    if not node.usable:
        return {}
    identity = ", ".join(f"{name}: {value:#x}" for name, value in node.identity.items())
    drive = [
        f"  node_id: {node.node_id}",
        "  eds: FILE.eds                 # the EDS file of this drive, next to the axis file",
        f"  identity: {{{identity}}}",
    ]
    if node.cyclic == "ip":
        drive.append("  mode: ip                      # 6502h: it has interpolated position, and not csp")
    if torque := node.values.get(objects.RATED_TORQUE):
        drive.append(f"  rated_torque_nm: {torque / 1000.0:g}        # 6076h")
    sections = {"drive": drive}
    if counts := _ratio(node, objects.ENCODER_INCREMENTS, objects.ENCODER_REVOLUTIONS):
        sections["motor_encoder"] = [f"  counts_per_turn: {_number(counts)}         # 608Fh"]
    if counts := _ratio(node, *objects.additional_resolution(1)):
        sections["load_encoder"] = [
            f"  counts_per_turn: {_number(counts)}         # 60E6h:01 over 60EBh:01; is it per load turn?",
            "  source: {index: 0x60E4, subindex: 1, type: int32}",
        ]
    ratio = _ratio(node, objects.GEAR_MOTOR, objects.GEAR_SHAFT)
    if ratio is not None and ratio != 1:
        sections["gear"] = [f"  ratio: {_number(ratio)}                     # 6091h"]
    return sections


def _ratio(node: Node, above: objects.Address, below: objects.Address) -> Fraction | None:
    numerator, denominator = node.values.get(above), node.values.get(below, 1)
    return Fraction(numerator, denominator) if numerator and denominator else None


def _number(value: Fraction) -> str:
    return str(value.numerator) if value.denominator == 1 else f"{float(value):.10g}"
