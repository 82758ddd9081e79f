"""A scan finds the nodes of a bus and changes nothing."""

from collections.abc import Iterator
from contextlib import contextmanager
from uuid import uuid4

import can
import pytest
from support.chatter import Chatter

from hdbridge.axis import AxisConfig
from hdbridge.commissioning.bringup.scan import Node, Scan, axis_lines, compare, scan_bus
from hdbridge.device.node import DriveNode
from hdbridge.drive import objects
from hdbridge.drive.link import Link
from hdbridge.errors import BusInUseError
from hdbridge.files.profile import bundled_folder, bundled_profile
from hdbridge.sim.lockstep import LockstepBus, lockstep_bench
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

AXIS = AxisConfig.load(bundled_profile("article"))
EDS = bundled_folder("eds") / "hdbridge-402.eds"


class Encoder:
    """A CiA-406 encoder that answers a few expedited SDO reads, and refuses the rest."""

    def __init__(self, bus: can.BusABC, node_id: int) -> None:
        self.bus, self.node_id = bus, node_id
        self.values = {(0x1000, 0): 0x0002_0196, (0x1018, 1): 0x55, (0x6001, 0): 1 << 20}
        self.heard: list[bytes] = []

    def next_event_s(self) -> float:
        return float("inf")

    def poll(self, now_s: float) -> None:
        while (message := self.bus.recv(0)) is not None:
            if message.arbitration_id != 0x600 + self.node_id:
                continue
            data = bytes(message.data)
            self.heard.append(data)
            value = self.values.get((int.from_bytes(data[1:3], "little"), data[3]))
            if data[0] == 0x40:
                answer = (
                    b"\x80" + data[1:4] + (0x0602_0000).to_bytes(4, "little")
                    if value is None
                    else b"\x43" + data[1:4] + value.to_bytes(4, "little")
                )
                self.bus.send(
                    can.Message(arbitration_id=0x580 + self.node_id, data=answer, is_extended_id=False)
                )


@contextmanager
def bench(*chatter: tuple[int, bytes], encoder: int | None = None) -> Iterator[tuple[Link, DriveNode, list]]:
    channel = f"scan-{uuid4()}"
    truth = Truth.load(bundled_profile("article"))
    with (
        can.Bus(interface="virtual", channel=channel, ignore_config=True) as one,
        can.Bus(interface="virtual", channel=channel, ignore_config=True) as two,
        can.Bus(interface="virtual", channel=channel, ignore_config=True) as witness,
    ):
        others: list = [Chatter(one, *chatter)] if chatter else []
        if encoder is not None:
            others.append(Encoder(two, encoder))
        with lockstep_bench(Machine(truth, 0), EDS, 1, channel, others=others) as (bus, clock, node):
            assert isinstance(bus, LockstepBus)
            seen: list[can.Message] = []
            yield Link(bus, clock), node, seen
            while (message := witness.recv(0)) is not None:
                seen.append(message)


def test_a_drive_and_an_encoder_are_found_and_described() -> None:
    shares: list[float] = []
    with bench(encoder=9) as (link, _, _):
        found = scan_bus(link, progress=shares.append)
    assert [node.node_id for node in found.nodes] == [1, 9]
    drive, encoder = found.nodes
    assert (drive.kind, encoder.kind) == ("drive (CiA 402)", "encoder (CiA 406)")
    assert drive.identity == {"vendor_id": 0x4844, "product_code": 0x402, "revision": 0x10000, "serial": 1}
    assert drive.names["device"]
    assert drive.mode_names == ["PP", "HM", "IP", "CSP"]
    assert drive.usable
    assert not encoder.usable
    assert encoder.identity == {"vendor_id": 0x55}
    assert found.remarks == ()
    assert shares[-1] == 1.0
    assert shares == sorted(shares)


def test_a_scan_writes_no_object_and_commands_nothing() -> None:
    with bench(encoder=9) as (link, node, seen):
        before = {(each.index, each.sub): each.value for each in node.dictionary}
        scan_bus(link)
        assert {(each.index, each.sub): each.value for each in node.dictionary} == before
    requests = [each for each in seen if 0x600 < each.arbitration_id < 0x680]
    # 40h reads, 60h and 70h fetch the segments of a name, 80h aborts
    assert {each.data[0] & 0xEF for each in requests} <= {0x40, 0x60, 0x80}
    assert not [each for each in seen if each.arbitration_id in (0x000, 0x080)]
    assert {each.arbitration_id - 0x600 for each in requests} == set(range(1, 128))


def test_a_node_that_another_client_talks_to_is_left_alone() -> None:
    with bench((0x601, b"\x40\x00\x10\x00\0\0\0\0")) as (link, _, seen):
        found = scan_bus(link)
    node = found.node(1)
    assert node is not None
    assert node.busy
    assert node.device_type is None
    assert "another SDO client is using node 1" in "".join(found.remarks)
    matches, lines = compare(AXIS, found)
    assert not matches
    assert "in use by another SDO client" in lines[0]
    assert not [each for each in seen if each.arbitration_id == 0x601 and each.data[0] == 0x80]


def test_another_master_and_silent_nodes_are_reported() -> None:
    with bench((0x080, b""), (0x000, b"\x01\x00"), (0x714, b"\x04")) as (link, _, _):
        found = scan_bus(link, force=True)
    stopped = found.node(0x14)
    assert stopped is not None
    assert (stopped.answers, stopped.state) == (False, "stopped")
    assert "SYNC" in found.remarks[0]
    assert "NMT" in found.remarks[1]


@pytest.mark.parametrize("can_id", [0x080, 0x000, 0x77F, 0x201, 0x405], ids=hex)
def test_scan_sends_nothing_while_another_master_runs(can_id: int) -> None:
    with (
        bench((can_id, b"\x05\x00")) as (link, _, seen),
        pytest.raises(BusInUseError, match=rf"another master is on this bus.*\({can_id:03X}h\)"),
    ):
        scan_bus(link, listen_s=0.0)
    assert not [each for each in seen if 0x600 < each.arbitration_id < 0x680]


def drive_node(node_id: int = 1, **identity: int) -> Node:
    node = Node(node_id, 127, answers=True, device_type=0x0002_0192, modes=0xA1)
    node.identity = {"vendor_id": 0x4844, "product_code": 0x402, "revision": 0x10000, "serial": 7, **identity}
    return node


def test_the_drive_of_the_axis_file_is_recognised() -> None:
    assert compare(AXIS, Scan((drive_node(),))) == (True, [])


@pytest.mark.parametrize(
    ("nodes", "text"),
    [
        ((), "drive.node_id: nothing answers as node 1"),
        ((drive_node(4),), "drive.node_id: found 1; the drive with this identity is node 4"),
        ((drive_node(revision=2),), "drive.identity.revision: found 0x10000; node 1 reports 0x2"),
        ((Node(1, 4),), "a stopped node"),
        ((Node(1, answers=True, device_type=401),), "input/output module"),
    ],
)
def test_differences_from_the_axis_file_are_listed(nodes: tuple[Node, ...], text: str) -> None:
    matches, lines = compare(AXIS, Scan(nodes))
    assert not matches
    assert text in "\n".join(lines)
    assert all(str(AXIS.path) in each for each in lines if ".yaml" in each)


def test_the_lines_to_copy_make_an_axis_file(tmp_path) -> None:
    node = drive_node(12)
    node.values = {
        objects.ENCODER_INCREMENTS: 16000,
        objects.ENCODER_REVOLUTIONS: 2,
        objects.GEAR_MOTOR: 100,
        objects.GEAR_SHAFT: 1,
        objects.RATED_TORQUE: 640,
        objects.additional_resolution(1)[0]: 1 << 20,
    }
    lines = axis_lines(node)
    text = "\n".join(lines).replace("FILE.eds", "hdbridge-402.eds")
    for part in (
        "schema: hdbridge.axis/1\nname: copied\nbus: {interface: virtual, channel: x}",
        "limits: {position_min_deg: -1, position_max_deg: 1, velocity_deg_s: 1, acceleration_deg_s2: 1, "
        "jerk_deg_s3: 1, torque_percent: 1}",
    ):
        text += "\n" + part
    text = text.replace("drive:\n", "drive:\n  cycle_ms: 4\n  following_error_deg: 1\n", 1)
    axis = AxisConfig.from_text(text, tmp_path / "axis.yaml")
    assert (axis.drive.node_id, axis.drive.identity.serial, axis.drive.rated_torque_nm) == (12, 7, 0.64)
    assert (axis.motor_encoder.counts_per_turn, axis.load_encoder.counts_per_turn) == (8000, 1 << 20)
    assert axis.gear.ratio == 100


def test_the_lines_of_an_encoder_node() -> None:
    node = Node(9, answers=True, device_type=0x0002_0196)
    node.values = {
        objects.Address(0x6001, 0, objects.IntegerType.UINT32, "measuring units per revolution"): 4096
    }
    assert axis_lines(node) == [
        "load_encoder:",
        "  counts_per_turn: 4096         # 6001h",
        "  source: {index: 0x6004, subindex: 0, type: uint32, node: 9}",
    ]
