"""PDOs: mapping over SDO, transmission types, SYNC semantics, deadlines, lengths."""

import struct

import pytest

RANGE = 0x06090030


def test_only_the_refused_values_of_a_pdo_are_dropped(master):
    master.map(0x1400, 2, 0x301, 0x60600008, 0x60810020)
    master.nmt(1)
    master.send(0x301, struct.pack("<bI", 3, 777))
    master.send(0x080)
    assert (master.read(0x6060), master.read(0x6081)) == (0, 777)


@pytest.mark.parametrize("value", [0x20000181, 0x080, 0x701, 0x601])
def test_identifiers_that_are_not_for_pdos_are_refused(master, value):
    master.put(0x1800, 1, 0x80000181, 4)
    assert master.write(0x1800, 1, value, 4) == RANGE


def test_tpdos_of_one_sync_are_consistent(master):
    master.enable_csp()
    for k in range(1, 20):
        _, actual, _, load, demand = master.cycle(0x0F, 10 * k)
        assert load == round(actual * 7.2)
        assert demand == actual


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


def test_a_late_rpdo_is_harmless_without_power(master):
    master.put(0x1400, 5, 10, 2)
    master.nmt(1)
    master.cycle(0x06)
    master.wait(0.1)
    assert master.emergencies() == []
