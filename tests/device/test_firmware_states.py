"""Power states, stops and faults of the drive, by SDO and PDO. Every state and word: test_state_machine."""

import struct

import pytest


def test_a_repeated_controlword_does_not_enable_again(master):
    """A continuing target stream with a stale 'enable' must not undo a stop."""
    master.put(0x6007, 0, 3, 2)
    master.put(0x605A, 0, 6, 2)
    master.put(0x1016, 1, 0x7F0032, 4)
    master.put(0x1029, 1, 1, 1)
    master.enable_csp()
    master.send(0x77F, b"\x05")
    for _ in range(30):
        status = master.cycle(0x0F)[0]
    assert status & 0x6F == 0x07
    for word in (0x00, 0x06, 0x07, 0x0F, 0x0F):
        status = master.cycle(word)[0]
    assert master.cycle()[0] & 0x6F == 0x27


@pytest.mark.parametrize(
    ("option", "decel", "state"),
    [(0, None, "disabled"), *[(k, (20e3, 50e3, 80e3, 80e3)[(k - 1) % 4], None) for k in range(1, 9)]],
)
def test_quick_stop_by_605a(master, motor, option, decel, state):
    """The stop takes the distance v^2 / 2a on the ramp that the option names. After it, options 1 to 4 switch
    power off; 5 to 8 do not.
    """
    for index, value in ((0x6084, 20_000), (0x6085, 50_000), (0x60C6, 80_000)):
        master.put(index, 0, value, 4)
    master.put(0x605A, 0, option, 2)
    master.enable_csp()
    master.cruise(40, 10)
    start = motor.position
    master.control(0x02)
    speed = 40 / 0.004
    if decel is None:
        assert master.state == state
        master.wait(0.5)
        assert motor.powered is False
        return
    assert master.state == "quick stop"
    assert master.statusword & 0x0400 == 0
    stopping_s = speed / decel
    master.wait(0.9 * stopping_s)
    assert motor.velocity_counts_s > 0.0
    assert master.state == "quick stop"
    master.wait(0.1 * stopping_s + 0.02)
    assert motor.position - start == pytest.approx(speed**2 / (2 * decel), abs=1.0)
    stays = option >= 5
    assert master.state == ("quick stop" if stays else "disabled")
    assert motor.powered is stays
    if stays:
        assert master.statusword & 0x0400
        master.control(0x0F)
        assert master.state == "enabled"
        master.wait(0.1)
        assert motor.velocity_counts_s == 0.0


def test_enabling_again_waits_for_rest(master, motor):
    master.put(0x6085, 0, 50_000, 4)
    master.put(0x605A, 0, 6, 2)
    master.enable_csp()
    master.cruise(40, 10)
    master.control(0x02)
    master.control(0x0F)
    assert master.state == "quick stop"
    master.wait(0.25)
    assert master.state == "quick stop"
    master.control(0x0F)
    assert master.state == "enabled"


def test_disabling_on_a_ramp_can_still_be_cut_short(master):
    master.put(0x6084, 0, 20_000, 4)
    master.enable_csp()
    master.cruise(40, 10)
    master.control(0x07)
    assert master.state == "enabled"
    master.control(0x00)
    assert master.state == "disabled"


@pytest.mark.parametrize(("option", "decel"), [(0, None), (1, 20e3), (2, 50e3), (3, 80e3)])
def test_fault_reaction_by_605e(master, motor, option, decel):
    for index, value in ((0x6084, 20_000), (0x6085, 50_000), (0x60C6, 80_000)):
        master.put(index, 0, value, 4)
    master.put(0x605E, 0, option, 2)
    master.enable_csp()
    master.cruise(40, 10)
    start = motor.position
    master.node.faults.raise_error(0x2310, b"\x01\x02")
    master.node.poll(master.clock.now())
    assert master.emergencies() == [0x2310]
    assert (0x081, struct.pack("<HB5s", 0x2310, 0x03, b"\x01\x02")) in master.seen
    assert master.state == ("reaction" if decel else "fault")
    master.wait(1.0)
    assert master.state == "fault"
    assert motor.powered is False
    if decel:
        assert motor.position - start == pytest.approx(10_000**2 / (2 * decel), abs=1.0)
    assert master.read(0x603F) & 0xFFFF == 0x2310
    assert master.read(0x1001) == 0x03
    master.control(0x80)
    assert master.emergencies()[-1] == 0x0000
    assert (master.read(0x603F), master.read(0x1001)) == (0, 0)


def test_the_brake_closes_only_at_rest(master, motor):
    master.enable_csp()
    master.cruise(40, 10)
    master.control(0x00)
    master.wait(0.04)
    assert motor.velocity_counts_s > 0.0
    assert not motor.braked
    master.wait(1.0)
    assert motor.braked


def test_following_error_is_a_fault(master, motor):
    master.put(0x6065, 0, 100, 4)
    master.put(0x6066, 0, 20, 2)
    master.enable_csp()
    motor.stuck = True
    target = 0
    while target < 100:
        target += 20
        master.cycle(0x0F, target)
    for _ in range(3):
        master.cycle(0x0F, target)
    assert master.emergencies() == []  # the following error stays within the window
    for _ in range(5):
        master.cycle(0x0F, 200)
    assert master.emergencies() == []  # the following error does not last longer than its time-out
    for _ in range(4):
        status = master.cycle(0x0F, 200)[0]
    assert master.emergencies() == [0x8611]
    assert status & 0x2000
    assert status & 0x4F in (0x08, 0x0F)
    master.wait(0.5)
    assert master.state == "fault"
    motor.stuck = False
    master.control(0x80)
    assert master.statusword & 0x2000 == 0


def test_following_error_supervision_can_be_disabled(master, motor):
    master.put(0x6065, 0, 0xFFFFFFFF, 4)
    master.enable_csp()
    motor.stuck = True
    master.cruise(100, 50)
    master.cycle(0x0F, 5000)
    assert master.read(0x60F4) == 5000
    assert master.state == "enabled"
    assert master.emergencies() == []
