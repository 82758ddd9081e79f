"""The master drives a node built on another CANopen stack: the responder stack `durand`.

durand brings its own SDO server, NMT, heartbeat, SYNC and PDO handling; only the CiA-402 behaviour is added
here. Its notifier thread is replaced by a poll, so that the test is in lockstep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest
from durand.datatypes import DatatypeEnum as DT
from durand.network import NetworkABC
from durand.node import MinimalNode
from durand.object_dictionary import Array, Record, Variable
from durand.scheduler import VirtualScheduler, get_scheduler, set_scheduler

from hdbridge.axis import AxisConfig
from hdbridge.drive import Drive, Mode, State, load_eds
from hdbridge.errors import IdentityError, SdoError

NODE_ID = 5


class PolledNetwork(NetworkABC):
    """durand's network over a python-can bus, without a thread."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus
        self.subscriptions: dict[int, Callable[[int, bytes], None]] = {}

    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        self.subscriptions[cob_id] = callback

    def remove_subscription(self, cob_id: int) -> None:
        self.subscriptions.pop(cob_id)

    def send(self, cob_id: int, msg: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=cob_id, data=msg, is_extended_id=False))

    def poll(self) -> None:
        while (message := self.bus.recv(0)) is not None:
            callback = self.subscriptions.get(message.arbitration_id)
            if callback is not None:
                callback(message.arbitration_id, bytes(message.data))


class DurandDrive:
    """A durand node with the objects of CiA 402 and a state machine of a few lines."""

    def __init__(self, bus: can.BusABC, clock: Any) -> None:
        self.clock, self.last_s = clock, clock.now()
        self.scheduler = VirtualScheduler()
        set_scheduler(self.scheduler)
        self.network = PolledNetwork(bus)
        self.node = MinimalNode(self.network, NODE_ID)
        self.od = self.node.object_dictionary
        self.state = 0x40
        self._objects()
        self.od.download_callbacks[0x6040, 0].add(self._control)
        self.od.download_callbacks[0x607A, 0].add(self._target)

    def _objects(self) -> None:
        od = self.od
        for index, datatype, access, value in (
            (0x6007, DT.INTEGER16, "rw", 1),
            (0x6040, DT.UNSIGNED16, "rw", 0),
            (0x6041, DT.UNSIGNED16, "ro", 0x40),
            (0x605A, DT.INTEGER16, "rw", 2),
            (0x605D, DT.INTEGER16, "rw", 1),
            (0x6060, DT.INTEGER8, "rw", 0),
            (0x6062, DT.INTEGER32, "ro", 0),
            (0x6064, DT.INTEGER32, "ro", 1234),
            (0x6065, DT.UNSIGNED32, "rw", 0),
            (0x6066, DT.UNSIGNED16, "rw", 0),
            (0x6072, DT.UNSIGNED16, "rw", 0),
            (0x6077, DT.INTEGER16, "ro", 0),
            (0x607A, DT.INTEGER32, "rw", 0),
            (0x6080, DT.UNSIGNED32, "rw", 0),
            (0x6502, DT.UNSIGNED32, "ro", 0x81),
        ):
            od[index] = Variable(datatype, access, value, name=f"Object {index:04X}")
        od[0x6061] = Variable(DT.INTEGER8, "ro", 0, name="Modes of operation display")
        od.set_read_callback(0x6061, 0, lambda: od.read(0x6060, 0))
        limits, cycle = Record(name="Software position limit"), Record(name="Interpolation time period")
        for sub in (1, 2):
            limits[sub] = Variable(DT.INTEGER32, "rw", 0, name=f"Limit {sub}")
        cycle[1] = Variable(DT.UNSIGNED8, "rw", 1, name="Value")
        cycle[2] = Variable(DT.INTEGER8, "rw", -3, name="Index")
        od[0x607D], od[0x60C2] = limits, cycle
        od[0x60E4] = Array(Variable(DT.INTEGER32, "ro", 0, name="Additional position"), length=1)
        od.write(0x1000, 0, 0x0002_0192)
        for sub, value in ((1, 0x4844), (2, 0x402), (3, 0x10000)):
            od.write(0x1018, sub, value)
        od.write(0x60E4, 1, 1234 * 36 // 5)

    def poll(self) -> None:
        now_s = self.clock.now()
        self.scheduler.run(now_s - self.last_s)
        self.last_s = now_s
        self.network.poll()

    def _control(self, word: int) -> None:
        if not word & 0x02:
            self.state = 0x40
        elif not word & 0x04:
            self.state = 0x07 if self.state in (0x27, 0x07) else 0x40
        else:
            steps = {(0x40, 0x06): 0x21, (0x21, 0x07): 0x23, (0x23, 0x0F): 0x27, (0x27, 0x07): 0x23}
            self.state = steps.get((self.state, word & 0x0F), self.state)
        self.od.write(0x6041, 0, self.state)

    def _target(self, counts: int) -> None:
        if self.state == 0x27:
            self.od.write(0x6062, 0, counts)
            self.od.write(0x6064, 0, counts)
            self.od.write(0x60E4, 1, counts * 36 // 5)


@pytest.fixture
def peer(bus: Any, peer_bus: can.BusABC, clock: Any) -> Iterator[DurandDrive]:
    before = get_scheduler()
    peer = DurandDrive(peer_bus, clock)
    bus.peers.append(peer.poll)
    yield peer
    set_scheduler(before)


@pytest.fixture
def drive(
    bus: Any, clock: Any, peer: DurandDrive, tmp_path: Any, build_axis: Callable[..., AxisConfig]
) -> Iterator[Drive]:
    eds = tmp_path / "durand.eds"
    eds.write_text(peer.node.eds.content)
    axis = build_axis(drive__node_id=NODE_ID)
    with Drive(bus, axis, clock, load_eds(eds, NODE_ID)) as drive:
        yield drive


def cycle(drive: Drive, clock: Any, target_counts: int | None) -> None:
    """One SYNC, its TPDOs, and the next set-point; None is the actual position."""
    image, link = drive.image, drive.link
    clock.sleep_until(clock.now() + drive.axis.drive.cycle_s)
    link.send(image.sync_id, b"")
    waited = set(image.tpdo_ids)
    deadline_s = clock.now() + 0.002
    while waited and (frame := link.recv(deadline_s)) is not None:
        if image.accept(frame.can_id, frame.data):
            waited.discard(frame.can_id)
        else:
            drive.monitor.dispatch(frame)
    assert not waited
    for frame in image.pack_rpdo_idle() if target_counts is None else image.pack_rpdo(target_counts):
        link.send(*frame)


def test_boot_enable_and_follow(drive: Drive, peer: DurandDrive, clock: Any) -> None:
    report = drive.boot()
    assert report.state is State.SWITCH_ON_DISABLED
    assert report.modes == (Mode.PP, Mode.CSP)
    assert peer.od.read(0x60C2, 1) == 4
    assert peer.od.read(0x607D, 2) == drive.image.limits_counts[1]

    drive.enable()
    image = drive.image
    for _ in range(8):
        cycle(drive, clock, None)
    assert peer.state == 0x27
    assert image.power.state is State.OPERATION_ENABLED
    assert image.motor_counts == 1234

    for target in range(1234, 1334, 10):
        cycle(drive, clock, target)
    for _ in range(2):
        cycle(drive, clock, 1324)
    assert image.motor_counts == image.demand_counts == 1324
    assert image.load_counts == 1324 * 36 // 5
    assert drive.read_positions().motor_counts == 1324
    assert drive.monitor.nodes[NODE_ID].heartbeat_age_s(clock.now()) < 0.1

    image.power.quick_stop()
    for _ in range(3):
        cycle(drive, clock, 1324)
    assert peer.state == 0x07


def test_leaving_disables_it(drive: Drive, peer: DurandDrive) -> None:
    drive.boot()
    drive.enable(Mode.PP)
    assert peer.state == 0x27
    assert drive.close() == []
    assert peer.state == 0x40
    assert peer.node.nmt.state == 127


def test_a_refusal_by_another_stack_is_understood(drive: Drive, peer: DurandDrive) -> None:
    with pytest.raises(SdoError, match=r"6041h:00.*read-only"):
        drive.sdo.write(0x6041, 0, 1)
    with pytest.raises(SdoError, match="does not have the object"):
        drive.sdo.write(0x6091, 1, 1)
    peer.od.write(0x1018, 1, 7)
    with pytest.raises(IdentityError, match="vendor_id"):
        drive.boot()


def test_long_texts_come_in_segments(drive: Drive, peer: DurandDrive) -> None:
    peer.od.write(0x1008, 0, b"a durand node with a long name")
    assert drive.boot().names["device"] == "a durand node with a long name"
