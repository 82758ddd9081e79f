"""Requests that the relay accepts, alone and on the bus."""

import pytest
from support.daemon import SteppedDaemon

from hdbridge.daemon.loop.relay import incoming_ids, refusal_reason
from hdbridge.daemon.loop.states import MAY_MOVE, AxisState

UPLOAD, DOWNLOAD = bytes([0x40, 0x64, 0x60, 0, 0, 0, 0, 0]), bytes([0x2B, 0x40, 0x60, 0, 0x0F, 0, 0, 0])
READS = [UPLOAD, bytes([0x60, *bytes(7)]), bytes([0x80, *bytes(7)]), bytes([0xA0, *bytes(7)])]
WRITES = [DOWNLOAD, bytes(8), bytes([0xC0, *bytes(7)]), bytes([0xE0, *bytes(7)]), b""]


@pytest.mark.parametrize("state", list(AxisState))
def test_reads_are_always_allowed_and_writes_only_without_motion(state: AxisState) -> None:
    for data in READS:
        assert refusal_reason(0x601, data, {1: state}) is None
    for data in WRITES:
        refused = refusal_reason(0x601, data, {1: state})
        assert (refused is not None) == (state in MAY_MOVE)
    assert (refusal_reason(0x000, b"\x82\x01", {1: state}) is not None) == (state in MAY_MOVE)


@pytest.mark.parametrize(
    ("can_id", "data"),
    [
        (0x080, b""),
        (0x201, bytes(6)),
        (0x77F, b"\x05"),
        (0x600, UPLOAD),
        (0x603, UPLOAD),
        (0x581, UPLOAD),
        (0x000, b"\x81\x00"),
        (0x000, b"\x81\x03"),
        (0x000, b"\x81"),
        (0x000, b""),
        (0x7E5, bytes(8)),
    ],
)
def test_other_requests_of_the_service_are_refused(can_id: int, data: bytes) -> None:
    states = {1: AxisState.UNVERIFIED, 2: AxisState.DISABLED}
    assert refusal_reason(can_id, data, states) is not None


def test_a_moving_axis_does_not_block_writes_to_others() -> None:
    states = {1: AxisState.ENABLED, 2: AxisState.DISABLED}
    assert refusal_reason(0x602, DOWNLOAD, states) is None
    assert refusal_reason(0x601, DOWNLOAD, states) == (
        "SDO request to node 1: not while the axis is enabled; disable it first"
    )


def test_answers_emergencies_and_heartbeats_are_forwarded() -> None:
    wanted = incoming_ids([1, 5])
    assert {0x581, 0x585, 0x081, 0x085, 0x701, 0x705, 0x742} <= wanted
    assert not {0x080, 0x181, 0x201, 0x582, 0x000, 0x700, 0x780} & wanted


def test_objects_can_be_read_in_motion_and_cost_no_cycle(enabled: SteppedDaemon) -> None:
    id_ = enabled.move(20.0)
    enabled.run(0.2)
    reader = enabled.memory.reader()
    drive = enabled.drive(0)
    assert drive.sdo.read(0x1000) & 0xFFFF == 402
    samples, _ = reader.read()
    assert len(samples) > 1
    assert (samples["axes"]["flags"] & 1).all()
    assert not enabled.ended(id_)
