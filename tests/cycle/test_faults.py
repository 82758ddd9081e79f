"""Each row of the fault table by real frames: reaction, delay, and standstill of the axis."""

from __future__ import annotations

import math
import struct

import pytest

from hdbridge.drive.supervision import Fault, Reaction
from hdbridge.errors import SafetyStop

FREEZE, STOP, LATCH = Reaction.FREEZE, Reaction.QUICK_STOP, Reaction.LATCH


# ------------------------------------------------------------------ TPDOs


def test_the_newest_frame_of_an_identifier_counts(moving) -> None:
    place = moving.move().motor_counts
    moving.node.faults.silent = True
    first, second = (struct.pack("<Hih", 0x1237, place + counts, 0) for counts in (10, 20))
    moving.answers_sync((0x181, first), (0x181, second), (0x281, struct.pack("<ii", 0, place)))
    moving.cycle.tick(moving.target)
    assert moving.drive.image.motor_counts == place + 20


def test_a_stale_tpdo_before_sync_is_discarded(moving) -> None:
    before = moving.move()
    moving.interfere(0x181, struct.pack("<Hih", 0x1637, 999_999, 0))
    after = moving.move()
    assert after.fresh
    assert abs(after.motor_counts - before.motor_counts) < 200
    assert moving.events(Fault.DUPLICATE_TPDO) == [Reaction.GO]


def test_a_tpdo_of_the_wrong_length_next_to_a_good_one_is_only_counted(moving) -> None:
    moving.answers_sync((0x181, b"short"))
    assert moving.move().fresh
    assert moving.events(Fault.DISCARDED_FRAME) == [Reaction.GO]


def test_frames_of_other_nodes_are_ignored(moving) -> None:
    for can_id in (0x182, 0x382, 0x702, 0x082, 0x585, 0x7E5):
        moving.interfere(can_id, b"\x05")
    assert moving.move().fresh
    assert len(moving.supervision.events) == 0


# ------------------------------------------------------------------ the drive


def test_error_reset_and_short_emergencies_are_harmless(moving) -> None:
    moving.interfere(0x081, bytes(8))
    moving.interfere(0x081, b"\x10")
    assert moving.move(3).fresh


def test_a_drive_fault_stops_the_axis_and_is_named(moving) -> None:
    moving.node.faults.raise_error(0x3210)
    text = moving.stopped_within(2, Fault.DRIVE_FAULT)
    assert "the drive sent EMCY 3210h (DC link over-voltage)" in text
    assert "remove that cause" in text
    assert moving.supervision.counts[Fault.EMERGENCY] >= 1
    moving.stands_still()


@pytest.mark.parametrize("stays", [False, True], ids=["leaves operational", "stays operational"])
def test_a_stall_of_the_control_process_is_reported_as_such(moving, stays: bool) -> None:
    """Meanwhile the drive's time-out for its master has expired; neither an NMT master nor an enable input is
    the cause of its stop.
    """
    moving.node.faults.stay_operational = stays
    moving.move()
    moving.clock.sleep_until(moving.clock.now() + 0.4)
    text = moving.stopped_within(1, Fault.HANG)
    assert (
        "the control process stalled for longer than the drive waits (400 ms; the drive waits 16 ms)" in text
    )
    assert "EMCY 8250h (set-points (RPDOs) were missing)" in text
    assert "NMT master" not in text
    assert "enable input" not in text
    moving.stands_still()


def test_a_stall_stops_the_axis_even_if_the_drive_ignores_it(moving) -> None:
    moving.node.faults.ignore_missing_set_points = True
    moving.move()
    moving.clock.sleep_until(moving.clock.now() + 0.03)
    moving.stopped_within(1, Fault.HANG)
    assert moving.events(Fault.HANG) == [STOP]
    moving.stands_still()


def test_a_stall_without_power_does_not_latch_a_stop(idle) -> None:
    idle.cycle.tick()
    idle.clock.sleep_until(idle.clock.now() + 0.03)
    idle.cycle.tick()
    assert idle.supervision.stop is None


def test_leaving_operational_is_reported_with_its_cause(moving) -> None:
    moving.interfere(0x081, struct.pack("<HB5x", 0x8130, 0x11))
    moving.interfere(0x701, b"\x7f")
    text = moving.stopped_within(1, Fault.MASTER_LOST)
    assert "then a node is not operational" in text
    assert "EMCY 8130h (a heartbeat that the drive watches was missing)" in text
    assert "NMT master" not in text


# ------------------------------------------------------------------ plausibility


def test_a_single_encoder_jump_is_ignored(moving) -> None:
    before = moving.move()
    moving.node.faults.load_jump_counts = 100_000
    moving.move()  # the jump is in the sample after the next SYNC
    moving.node.faults.load_jump_counts = 0
    spoilt = moving.move()
    assert not spoilt.fresh
    assert abs(spoilt.load_counts - before.load_counts) < 1000
    after = moving.move()
    assert after.fresh
    assert abs(after.load_counts - before.load_counts) < 2000
    assert moving.supervision.stop is None


# ------------------------------------------------------------------ targets


@pytest.mark.parametrize(
    "bad", [math.nan, math.inf, -math.inf, 1e300, 12.0, 2**31, -(2**31) - 1, 8000 * 50 * 2, "12"]
)
def test_a_bad_target_never_reaches_the_bus(moving, bad: object) -> None:
    moving.move()
    good = moving.target
    with pytest.raises(SafetyStop, match="target"):
        moving.cycle.tick(lambda feedback: bad)  # type: ignore[arg-type, return-value]
    assert moving.supervision.stop is not None
    assert moving.supervision.stop.fault is Fault.BAD_TARGET
    words = [struct.unpack("<Hi", data) for _, data in moving.frames(0x201)]
    first_stop = next(place for place, (word, _) in enumerate(words) if word == 0x02)
    assert words[first_stop - 1] == (0x0F, good)
    assert all(abs(target - good) < 4000 for _, target in words)
    moving.stands_still()


def test_a_target_in_degrees_that_is_not_finite_stops_in_the_same_cycle(moving) -> None:
    syncs = len(moving.frames(0x080))
    with pytest.raises(SafetyStop, match="finite"):
        moving.cycle.tick(lambda feedback: moving.drive.image.target_counts_for(math.nan))
    words = [struct.unpack("<Hi", data)[0] for _, data in moving.frames(0x201)]
    assert words[syncs] == 0x02


# ------------------------------------------------------------------ the interface


def test_a_full_transmit_queue_stops_without_a_retry(moving) -> None:
    moving.bus.full = True
    sent = len(moving.sent)
    moving.stopped_within(1, Fault.TRANSMIT_FULL)
    assert len(moving.sent) == sent
    moving.bus.full = False
    moving.stands_still()
