"""The fault table: each row, and invariants that hold for any sequence of cycles."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.drive.supervision import EVENTS_KEPT, ROWS, TABLE, Fault, Reaction, Row, Supervision
from hdbridge.errors import SafetyStop

GO, FREEZE, STOP, LATCH = Reaction.GO, Reaction.FREEZE, Reaction.QUICK_STOP, Reaction.LATCH
EXPECTED = {
    # Fault, and its reactions in the first, second and third consecutive cycle.
    Fault.LOST_TPDO: (FREEZE, STOP, STOP),
    Fault.OVERRUN: (GO, STOP, STOP),
    Fault.DUPLICATE_TPDO: (GO, GO, GO),
    Fault.DISCARDED_FRAME: (GO, GO, GO),
    Fault.WRONG_LENGTH: (FREEZE, STOP, STOP),
    Fault.HANG: (STOP, STOP, STOP),
    Fault.MASTER_LOST: (STOP, STOP, STOP),
    Fault.FLOOD: (FREEZE, STOP, STOP),
    Fault.EMERGENCY: (GO, GO, GO),
    Fault.DRIVE_FAULT: (STOP, STOP, STOP),
    Fault.DROPPED_OUT: (STOP, STOP, STOP),
    Fault.BOOT_UP: (LATCH, LATCH, LATCH),
    Fault.NMT_CHANGE: (LATCH, LATCH, LATCH),
    Fault.HEARTBEAT_LOST: (STOP, STOP, STOP),
    Fault.OWN_ID_ELSEWHERE: (STOP, STOP, STOP),
    Fault.FOREIGN_SYNC: (STOP, STOP, STOP),
    Fault.ENCODER_JUMP: (FREEZE, STOP, STOP),
    Fault.FOLLOWING_ERROR: (GO, STOP, STOP),
    Fault.BAD_TARGET: (STOP, STOP, STOP),
    Fault.BUS_DOWN: (LATCH, LATCH, LATCH),
    Fault.TRANSMIT_FULL: (STOP, STOP, STOP),
    Fault.CHANNEL_HELD: (GO, GO, GO),
    Fault.CHANNEL_LOST: (GO, GO, GO),
}
cycles = st.lists(st.sets(st.sampled_from(Fault), max_size=3), max_size=40)
harmless = st.sampled_from([fault for fault, reactions in EXPECTED.items() if reactions == (GO, GO, GO)])


def run(supervision: Supervision, sequence: list[set[Fault]]) -> list[Reaction]:
    return [
        supervision.judge(cycle, [(fault, "") for fault in sorted(faults, key=lambda each: each.name)])
        for cycle, faults in enumerate(sequence)
    ]


def test_every_fault_has_exactly_one_row_and_a_hint() -> None:
    assert sorted(row.fault.name for row in TABLE) == sorted(fault.name for fault in Fault)
    assert set(EXPECTED) == set(Fault)
    assert all(row.hint and row.first <= row.then for row in TABLE)


@pytest.mark.parametrize("fault", Fault, ids=lambda fault: fault.name.lower())
def test_reactions_to_cycles_in_a_row(fault: Fault) -> None:
    assert tuple(run(Supervision(), [{fault}] * 3)) == EXPECTED[fault]


@pytest.mark.parametrize(
    "row", [row for row in TABLE if row.first < row.then], ids=lambda row: row.fault.name
)
def test_a_good_cycle_resets_the_count(row: Row) -> None:
    reactions = run(Supervision(), [{row.fault}, set()] * 10)
    assert reactions == [row.first, GO] * 10


def test_two_cycles_without_feedback_stop_for_any_cause() -> None:
    assert run(Supervision(), [{Fault.ENCODER_JUMP}, {Fault.LOST_TPDO}]) == [FREEZE, STOP]


def test_a_fault_named_twice_in_a_cycle_counts_once() -> None:
    supervision = Supervision()
    assert supervision.judge(0, [(Fault.OVERRUN, "a"), (Fault.OVERRUN, "b")]) is GO
    assert supervision.counts[Fault.OVERRUN] == 1


def test_a_latch_outranks_a_quick_stop_but_the_first_cause_is_named() -> None:
    supervision = Supervision()
    run(supervision, [{Fault.HEARTBEAT_LOST}, {Fault.BOOT_UP}, {Fault.FOREIGN_SYNC}])
    assert supervision.reaction is LATCH
    with pytest.raises(
        SafetyStop, match=r"cycle 0: the drive's heartbeat.*then a node restarted.*stopped, latched"
    ):
        raise supervision.error()


def test_a_later_equal_stop_does_not_hide_the_first() -> None:
    supervision = Supervision()
    run(supervision, [{Fault.DRIVE_FAULT}, {Fault.HEARTBEAT_LOST}])
    assert supervision.stop is not None
    assert supervision.stop.fault is Fault.DRIVE_FAULT


def test_a_latch_is_reset_only_after_verification() -> None:
    supervision = Supervision()
    run(supervision, [{Fault.BOOT_UP}])
    with pytest.raises(SafetyStop, match="boot and verify"):
        supervision.reset()
    assert supervision.reaction is LATCH
    supervision.reset(verified=True)
    assert run(supervision, [set()]) == [GO]


def test_a_fault_while_answering_counts_in_the_same_cycle() -> None:
    supervision = Supervision()
    supervision.judge(7, [(Fault.DUPLICATE_TPDO, "")])
    assert supervision.add_fault(7, Fault.TRANSMIT_FULL, "RPDO") is STOP
    assert [event.cycle for event in supervision.events] == [7, 7]


def test_events_since_a_count_are_the_newer_ones() -> None:
    supervision = Supervision()
    run(supervision, [{Fault.LOST_TPDO}])
    noted = supervision.noted
    assert supervision.since(0) == list(supervision.events)
    assert supervision.since(noted) == []
    run(supervision, [{Fault.OWN_ID_ELSEWHERE}])
    assert [event.fault for event in supervision.since(noted)] == [Fault.OWN_ID_ELSEWHERE]


def test_a_bounded_number_of_events_is_kept_with_cycle_numbers() -> None:
    supervision = Supervision()
    run(supervision, [{Fault.DUPLICATE_TPDO}] * (EVENTS_KEPT + 5))
    assert len(supervision.events) == EVENTS_KEPT
    assert supervision.events[0].cycle == 5
    assert supervision.counts[Fault.DUPLICATE_TPDO] == EVENTS_KEPT + 5


def test_error_states_cycle_fault_and_remedy() -> None:
    supervision = Supervision()
    supervision.judge(119, [(Fault.LOST_TPDO, "281h")])
    supervision.judge(120, [(Fault.LOST_TPDO, "281h")])
    text = str(supervision.error())
    assert "\n" not in text
    for part in ("cycle 120", "281h", "quick stop", "latched", ROWS[Fault.LOST_TPDO].hint):
        assert part in text


@given(cycles, cycles)
def test_only_a_reset_ends_a_stop(before: list[set[Fault]], after: list[set[Fault]]) -> None:
    supervision = Supervision()
    run(supervision, [*before, {Fault.DRIVE_FAULT}])
    assert all(reaction >= STOP for reaction in run(supervision, after))
    assert not supervision.quiet
    supervision.reset(verified=True)
    assert supervision.quiet
    assert run(supervision, [set()]) == [GO]


@given(st.lists(st.sets(harmless), max_size=10), st.lists(st.sets(harmless), min_size=1, max_size=10))
def test_a_single_lost_tpdo_never_stops(before: list[set[Fault]], after: list[set[Fault]]) -> None:
    reactions = run(Supervision(), [*before, {Fault.LOST_TPDO}, *after])
    assert max(reactions) is FREEZE
    assert reactions.count(FREEZE) == 1


@given(cycles)
def test_two_lost_tpdos_in_a_row_always_stop(before: list[set[Fault]]) -> None:
    assert run(Supervision(), [*before, {Fault.LOST_TPDO}, {Fault.LOST_TPDO}])[-1] >= STOP


@given(cycles)
def test_the_fast_path_equals_the_full_judgement(sequence: list[set[Fault]]) -> None:
    asked, spared = Supervision(), Supervision()
    for cycle, faults in enumerate(sequence):
        named = [(fault, "") for fault in sorted(faults, key=lambda each: each.name)]
        expected = asked.judge(cycle, named)
        assert (GO if not named and spared.quiet else spared.judge(cycle, named)) is expected
    assert asked.events == spared.events
