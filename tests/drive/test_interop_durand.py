"""The master drives a node built on another CANopen stack: the responder stack `durand`.

durand brings its own SDO server, NMT, heartbeat, SYNC and PDO handling; only the CiA-402 behaviour is added
here. Its notifier thread is replaced by a poll, so that the test is in lockstep.
"""

from collections.abc import Iterator
from typing import Any

import pytest
from support.foreign_slaves import NODE_ID, DurandDrive, durand_drive

from hdbridge.drive import Drive, Mode, State, load_eds, objects


@pytest.fixture
def peer() -> Iterator[DurandDrive]:
    with durand_drive() as (bus, made):
        made.master = bus
        yield made


@pytest.fixture
def clock(peer: DurandDrive) -> Any:
    return peer.clock


@pytest.fixture
def drive(peer, clock, tmp_path, build_axis):
    eds = tmp_path / "durand.eds"
    eds.write_text(peer.node.eds.content)
    axis = build_axis(drive__node_id=NODE_ID)
    with Drive(peer.master, axis, clock, load_eds(eds, NODE_ID)) as drive:
        yield drive


def cycle(drive: Drive, clock: Any, target_counts: int | None) -> None:
    """Runs SYNC and its TPDOs, and sends the next set-point; None stands for the actual position."""
    image, link = drive.image, drive.link
    clock.sleep_until(clock.now() + drive.axis.drive.cycle_s)
    link.send(objects.COB_SYNC, b"")
    waited = set(image.tpdo_ids)
    deadline_s = clock.now() + 0.002
    while waited and (frame := link.recv(deadline_s)) is not None:
        if image.accept(frame.can_id, frame.data):
            waited.discard(frame.can_id)
        else:
            drive.monitor.dispatch(frame)
    assert not waited
    for frame in (
        image.pack_rpdo_idle(image.motor_counts) if target_counts is None else image.pack_rpdo(target_counts)
    ):
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
    heard_s = drive.monitor.nodes[NODE_ID].heartbeat_s
    assert heard_s is not None
    assert clock.now() - heard_s < 0.1

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
