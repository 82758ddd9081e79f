"""Assignment of scanned nodes to an axis file, and suggested lines for an axis file. Pure."""

from fractions import Fraction

from hdbridge.axis import AxisConfig
from hdbridge.commissioning.bringup.scan import ENCODER_UNITS_PER_TURN, Node, Scan
from hdbridge.drive import objects


def identity_matches(axis: AxisConfig, node: Node) -> bool:
    """Returns True if the node's identity is the one that the axis file demands."""
    wanted = axis.drive.identity.model_dump(exclude_none=True)
    return all(node.identity.get(name) == value for name, value in wanted.items())


def compare(axis: AxisConfig, scan: Scan) -> tuple[bool, list[str]]:
    """Returns True if the axis file's drive was found; else False and one line for each thing to change."""
    there = scan.node(axis.drive.node_id)
    if there is not None and there.answers and there.usable and identity_matches(axis, there):
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
        if node is not there and node.usable and identity_matches(axis, node):
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
            said = "does not say" if found is None else f"says {found:#x}"
            key = axis.where(f"drive.identity.{name}")
            lines.append(f"{key}: found {wanted:#x}; node {node.node_id} {said}")
    return lines


def axis_lines(node: Node) -> list[str]:
    """Returns lines for an axis file, from the node's own objects."""
    if node.profile == 406:
        return _encoder_lines(node)
    identity = ", ".join(f"{name}: {value:#x}" for name, value in node.identity.items())
    lines = [
        "drive:",
        f"  node_id: {node.node_id}",
        "  eds: FILE.eds                 # the EDS file of this drive, next to the axis file",
        f"  identity: {{{identity}}}",
    ]
    if node.cyclic == "ip":
        lines.append("  mode: ip                      # 6502h: it has interpolated position, and not csp")
    torque = node.values.get(objects.RATED_TORQUE)
    if torque:
        lines.append(f"  rated_torque_nm: {torque / 1000.0:g}        # 6076h")
    counts = _ratio(node, objects.ENCODER_INCREMENTS, objects.ENCODER_REVOLUTIONS)
    if counts is not None:
        lines += ["motor_encoder:", f"  counts_per_turn: {_number(counts)}         # 608Fh"]
    counts = _ratio(node, *objects.additional_resolution(1))
    if counts is not None:
        lines += [
            "load_encoder:",
            f"  counts_per_turn: {_number(counts)}         # 60E6h:01 over 60EBh:01; is it per load turn?",
            "  source: {index: 0x60E4, subindex: 1, type: int32}",
        ]
    ratio = _ratio(node, objects.GEAR_MOTOR, objects.GEAR_SHAFT)
    if ratio is not None and ratio != 1:
        lines += ["gear:", f"  ratio: {_number(ratio)}                     # 6091h"]
    return lines


def _encoder_lines(node: Node) -> list[str]:
    counts = node.values.get(ENCODER_UNITS_PER_TURN)
    return [
        "load_encoder:",
        *([f"  counts_per_turn: {counts}         # 6001h"] if counts else []),
        f"  source: {{index: 0x6004, subindex: 0, type: uint32, node: {node.node_id}}}",
    ]


def _ratio(node: Node, above: objects.Address, below: objects.Address) -> Fraction | None:
    numerator, denominator = node.values.get(above), node.values.get(below, 1)
    return Fraction(numerator, denominator) if numerator and denominator else None


def _number(value: Fraction) -> str:
    return str(value.numerator) if value.denominator == 1 else f"{float(value):.10g}"
