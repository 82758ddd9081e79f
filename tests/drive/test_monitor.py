"""Heartbeats, boot-up messages and emergencies."""

from hdbridge.drive import Frame, NetworkMonitor, NmtState
from hdbridge.drive.monitor import EMERGENCIES_KEPT


def test_heartbeats_give_state_and_age() -> None:
    monitor = NetworkMonitor(1)
    status = monitor.nodes[1]
    assert monitor.dispatch(Frame(0x701, b"\x00", 1.0))
    assert monitor.dispatch(Frame(0x701, b"\x85", 2.0))
    assert status.boot_ups == 1
    assert status.nmt_state == NmtState.OPERATIONAL
    assert status.heartbeat_s == 2.0
    assert monitor.dispatch(Frame(0x701, b"", 3.0))
    assert status.heartbeat_s == 2.0


def test_frames_of_other_nodes_are_not_consumed() -> None:
    monitor = NetworkMonitor(1)
    for can_id in (0x702, 0x080, 0x181, 0x581, 0x082):
        assert not monitor.dispatch(Frame(can_id, b"\x05", 0.0))
    assert monitor.nodes[1].nmt_state is None


def test_a_burst_of_emergencies_is_counted_and_kept_bounded() -> None:
    monitor = NetworkMonitor(1)
    for count in range(1000):
        monitor.dispatch(Frame(0x081, bytes((count & 0xFF, 0x86, 0x21, 1, 2, 3, 4, 5)), count * 0.001))
    status = monitor.nodes[1]
    assert status.emergency_count == 1000
    assert len(status.emergencies) == EMERGENCIES_KEPT
    assert str(status.emergencies[-1]) == "EMCY 86E7h (positioning), register 21h, 01 02 03 04 05"


def test_a_short_emergency_is_not_lost() -> None:
    monitor = NetworkMonitor(1)
    monitor.dispatch(Frame(0x081, b"\x11\x86", 1.0))
    monitor.dispatch(Frame(0x081, b"\x00\x00\x00", 2.0))
    status = monitor.nodes[1]
    assert status.emergency_count == 2
    assert status.last_error is not None
    assert (status.last_error.code, status.last_error.time_s) == (0x8611, 1.0)
