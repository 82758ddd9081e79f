"""PDOs: mapping over SDO, transmission types, SYNC semantics, deadlines, lengths."""

from __future__ import annotations

import struct

import pytest

NOT_MAPPABLE, PDO_LENGTH, STATE, RANGE = 0x06040041, 0x06040042, 0x08000022, 0x06090030


def remap(master, number: int, words: list[int], *, receive: bool = False, kind: int = 1) -> int:
    """The sequence of CiA 301; the first abort code or 0."""
    communication = (0x1400 if receive else 0x1800) + number - 1
    mapping = (0x1600 if receive else 0x1A00) + number - 1
    can_id = (0x101 if receive else 0x081) + 0x100 * number
    steps = [
        (communication, 1, can_id | 1 << 31, 4),
        (mapping, 0, 0, 1),
        *[(mapping, sub, word, 4) for sub, word in enumerate(words, 1)],
        (mapping, 0, len(words), 1),
        (communication, 2, kind, 1),
        (communication, 1, can_id, 4),
    ]
    for step in steps:
        if abort := master.write(*step):
            return abort
    return 0


def sync(master) -> list[tuple[int, bytes]]:
    master.take()
    master.send(0x080)
    return master.take()


def test_the_default_pdos_are_those_of_the_eds(master):
    master.nmt(1)
    frames = sync(master)
    assert [(can_id, len(data)) for can_id, data in frames] == [(0x181, 8), (0x281, 8)]


def test_a_new_mapping_is_what_is_sent(master, motor):
    motor.position = 1000.0
    assert remap(master, 3, [0x60640020, 0x60410010, 0x60610008]) == 0
    master.nmt(1)
    master.cycle(0x06)
    frames = dict(sync(master))
    assert struct.unpack("<iHb", frames[0x381]) == (1000, 0x0250, 0)
    assert struct.unpack("<iHb", dict(sync(master))[0x381])[1] == 0x0231


def test_a_new_receive_mapping_is_what_is_taken(master):
    assert remap(master, 2, [0x60600008, 0x60810020], receive=True) == 0
    master.nmt(1)
    master.send(0x301, struct.pack("<bI", 6, 777))
    master.send(0x080)
    assert (master.read(0x6061), master.read(0x6081)) == (6, 777)


def test_refused_values_in_a_pdo_are_dropped_alone(master):
    assert remap(master, 2, [0x60600008, 0x60810020], receive=True) == 0
    master.nmt(1)
    master.send(0x301, struct.pack("<bI", 3, 777))
    master.send(0x080)
    assert (master.read(0x6060), master.read(0x6081)) == (0, 777)


@pytest.mark.parametrize(
    ("word", "abort"),
    [
        (0x607D0120, NOT_MAPPABLE),  # not mappable at all
        (0x60640010, NOT_MAPPABLE),  # wrong length
        (0x55550020, 0x06020000),
        (0x60E40220, 0x06090011),
        (0x10080020, NOT_MAPPABLE),
    ],
)
def test_what_cannot_be_mapped_is_refused(master, word, abort):
    assert remap(master, 1, [word]) == abort


def test_read_only_objects_cannot_be_received(master):
    assert remap(master, 1, [0x60640020], receive=True) == NOT_MAPPABLE


def test_more_than_64_bits_are_refused(master):
    assert remap(master, 1, [0x60640020, 0x60620020, 0x60410010]) == PDO_LENGTH
    assert remap(master, 1, [0x60610008] * 8) == 0
    master.put(0x1802, 1, 0x80000381, 4)
    assert master.write(0x1A02, 0, 9, 1) == PDO_LENGTH


def test_a_count_that_covers_an_empty_entry_is_refused(master):
    master.put(0x1802, 1, 0x80000381, 4)
    assert master.write(0x1A02, 0, 1, 1) == 0x06020000


def test_a_mapping_is_fixed_while_the_pdo_is_valid_or_counted(master):
    assert master.write(0x1A00, 0, 0, 1) == STATE
    assert master.write(0x1A00, 1, 0x60640020, 4) == STATE
    assert master.write(0x1800, 1, 0x182, 4) == STATE
    assert master.write(0x1800, 3, 10, 2) == STATE
    master.put(0x1800, 1, 0x80000181, 4)
    assert master.write(0x1A00, 1, 0x60640020, 4) == STATE  # sub-index 0 is not 0 yet
    master.put(0x1A00, 0, 0, 1)
    assert master.write(0x1A00, 1, 0x60640020, 4) == 0


@pytest.mark.parametrize("value", [0x20000181, 0x080, 0x701, 0x601])
def test_identifiers_that_are_not_for_pdos_are_refused(master, value):
    master.put(0x1800, 1, 0x80000181, 4)
    assert master.write(0x1800, 1, value, 4) == RANGE


@pytest.mark.parametrize("kind", [241, 251, 252, 253])
def test_transmission_types_that_it_does_not_have_are_refused(master, kind):
    assert master.write(0x1800, 2, kind, 1) == RANGE


def test_an_invalid_pdo_is_silent(master):
    master.put(0x1801, 1, 0x80000281, 4)
    master.nmt(1)
    assert [can_id for can_id, _ in sync(master)] == [0x181]


def test_every_nth_sync(master):
    master.put(0x1800, 2, 3, 1)
    master.nmt(1)
    pattern = [0x181 in dict(sync(master)) for _ in range(9)]
    assert pattern == [False, False, True] * 3


def test_type_0_sends_upon_sync_what_has_changed(master):
    master.put(0x1800, 2, 0, 1)
    master.nmt(1)
    assert [0x181 in dict(sync(master)) for _ in range(3)] == [True, False, False]
    master.control(0x06)
    assert master.take() == []
    assert [0x181 in dict(sync(master)) for _ in range(3)] == [True, False, False]


def test_type_255_sends_when_something_changes(master):
    assert remap(master, 1, [0x60410010], kind=255) == 0
    master.nmt(1)
    assert [can_id for can_id, _ in master.take()] == [0x181]
    master.wait(0.1)
    assert [frame for frame in master.seen if frame[0] == 0x181] == [(0x181, b"\x50\x02")]
    master.control(0x06)
    assert (0x181, b"\x31\x02") in master.take() + master.seen
    assert 0x181 not in dict(sync(master))


def test_type_255_waits_for_its_inhibit_time(master):
    master.put(0x1800, 1, 0x80000181, 4)
    master.put(0x1800, 3, 1000, 2)  # 100 ms
    assert remap(master, 1, [0x60410010], kind=255) == 0
    master.nmt(1)
    master.control(0x06)
    master.control(0x07)
    assert [data for can_id, data in master.take() + master.seen if can_id == 0x181] == [b"\x50\x02"]
    frames = [data for can_id, data in master.wait(0.101) if can_id == 0x181]
    assert frames == [b"\x33\x02"]


def test_the_event_timer_repeats_what_has_not_changed(master):
    master.put(0x1800, 5, 20, 2)
    assert remap(master, 1, [0x60410010], kind=254) == 0
    master.nmt(1)
    assert len([1 for can_id, _ in master.take() + master.wait(0.1001) if can_id == 0x181]) == 6


def test_an_event_driven_rpdo_acts_at_once(master):
    assert remap(master, 1, [0x60400010, 0x607A0020], receive=True, kind=255) == 0
    master.nmt(1)
    master.send(0x201, struct.pack("<Hi", 0x06, 5))
    assert (master.state, master.read(0x607A)) == ("ready", 5)


def test_a_synchronous_rpdo_acts_at_the_next_sync(master):
    master.nmt(1)
    master.send(0x201, struct.pack("<Hi", 0x06, 5))
    assert (master.state, master.read(0x607A)) == ("disabled", 0)
    frames = dict(sync(master))
    assert frames[0x181][:2] == b"\x50\x02"  # the values of the moment of the SYNC, before it acts
    assert (master.state, master.read(0x607A)) == ("ready", 5)


def test_of_several_rpdos_before_a_sync_the_last_counts(master):
    master.nmt(1)
    for target in (1, 2, 3):
        master.send(0x201, struct.pack("<Hi", 0x06, target))
    master.send(0x080)
    assert master.read(0x607A) == 3


def test_a_target_is_reached_one_period_after_the_sync_that_takes_it(master):
    master.enable_csp()
    master.cycle(0x0F, 50)
    positions = [master.cycle(0x0F, 50)[1] for _ in range(3)]
    assert positions == [0, 50, 50]


def test_what_one_sync_sends_belongs_together(master):
    master.enable_csp()
    for k in range(1, 20):
        _, actual, _, load, demand = master.cycle(0x0F, 10 * k)
        assert load == round(actual * 7.2)
        assert demand == actual


def test_a_short_rpdo_is_reported_and_has_no_effect(master):
    master.nmt(1)
    master.send(0x201, b"\x06\x00\x05")
    master.send(0x080)
    assert master.state == "disabled"
    assert master.emergencies() == [0x8210]
    master.send(0x201, struct.pack("<Hi", 0x06, 0))
    assert master.emergencies() == [0x8210, 0x0000]


def test_a_long_rpdo_is_reported_and_its_beginning_counts(master):
    master.nmt(1)
    master.send(0x201, struct.pack("<Hih", 0x06, 5, 9))
    master.send(0x080)
    assert (master.state, master.read(0x607A)) == ("ready", 5)
    assert master.emergencies() == [0x8220]


@pytest.mark.parametrize(("option", "state"), [(0, "enabled"), (1, "fault"), (3, "quick stop")])
def test_a_late_rpdo_stops_an_axis_in_csp(master, option, state):
    master.put(0x1400, 5, 10, 2)
    master.put(0x6007, 0, option, 2)
    master.put(0x605A, 0, 6, 2)
    master.enable_csp()
    master.cruise(40, 20)
    assert master.emergencies() == []
    for _ in range(5):
        master.send(0x080)
        master.wait(0.004)
    assert master.emergencies() == [0x8250]
    assert master.state == state
    assert master.read(0x606C) == 0


def test_a_late_rpdo_matters_to_nobody_else(master):
    master.put(0x1400, 5, 10, 2)
    master.nmt(1)
    master.cycle(0x06)
    master.wait(0.1)
    assert master.emergencies() == []


def test_the_target_stays_when_an_rpdo_is_lost(master):
    master.enable_csp()
    target = master.cruise(10, 5)
    for _ in range(2):
        frames = dict(sync(master))
        master.wait(0.004)
    assert struct.unpack_from("<i", frames[0x181], 2)[0] == target
