"""`hdbridge.testing.simulated_drive`: the drive on its buses, its time and its history."""

import math
import threading
import time

import can
import pytest
from support.patience import until

from hdbridge.drive.interfacelock import InterfaceLock
from hdbridge.errors import BusError, BusInUseError, HdbridgeError, InputError
from hdbridge.testing import simulated_drive


def frames_of_a_move(seed: int) -> list[str]:
    from tests.testing.conftest import Program

    with simulated_drive("demo", bus="lockstep", seed=seed) as drive:
        program = Program(drive)
        program.start()
        return [str(message.data) for answers in program.move(40) for message in answers]


def test_the_same_seed_gives_the_same_frames():
    assert frames_of_a_move(1) == frames_of_a_move(1)
    assert frames_of_a_move(1) != frames_of_a_move(2)


@pytest.mark.parametrize(
    ("choice", "complaint"),
    [
        ({"profile": "articel"}, "nor a bundled profile.*did you mean 'article'"),
        ({"profile": "no/such"}, "no/such.*no such file"),
        ({"bus": "lockstp"}, "the bus 'lockstp'; expected virtual, .*did you mean 'lockstep'"),
        ({"bus": "virtual:x"}, "the bus 'virtual:x'; expected"),
        ({"bus": "socketcan"}, "did you mean 'socketcan:vcan0'"),
        ({"bus": "sockecan:vcan9"}, "python-can has no interface 'sockecan'"),
        ({"bus": "socketcan:vcan9"}, "socketcan:vcan9: cannot open it"),
        ({"seed": "one"}, "the seed is 'one'; expected an integer"),
        ({"truth": "none.yaml"}, "none.yaml"),
        ({"profile": None}, "profile is None; expected"),
        ({"bus": None}, "bus is None; expected"),
        ({"truth": 5}, "truth is 5; expected"),
        ({"folder": 5}, "folder is 5; expected"),
        ({"beside": "demo"}, "beside is 'demo'; expected another simulated drive"),
        ({"firmware": "level"}, "firmware is 'level'; expected a mapping"),
        ({"firmware": {"contrlword": "level"}}, "firmware: contrlword: unknown key; keys are controlword, "),
        ({"firmware": {"controlword": 5}}, "firmware: controlword: found 5; expected"),
    ],
)
def test_impossible_options_are_refused_in_one_line(choice, complaint):
    with pytest.raises(HdbridgeError, match=complaint) as refused, simulated_drive(**choice):
        pass
    assert "\n" not in str(refused.value)


def test_times_and_conditions_that_are_none_are_refused(drive):
    for wrong in ("1", None, -1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="expected a number of at least 0"):
            drive.sleep(wrong)
        with pytest.raises(InputError, match="expected a number of at least 0"):
            drive.wait_until(lambda: False, wrong)
    with pytest.raises(InputError, match="expected a function"):
        drive.wait_until(True)
    with pytest.raises(InputError, match="expected text"):
        drive.note(5)


def test_true_angles_and_their_trace(drive, program):
    state = drive.truth
    assert state.load_deg == pytest.approx(state.motor_deg / 50, abs=0.05)
    assert state.error_arcsec == pytest.approx(3600 * (state.load_deg - state.motor_deg / 50))
    trace = drive.trace
    assert trace[-1].load_deg == state.load_deg
    assert [b.time_s - a.time_s for a, b in zip(trace[-20:], trace[-19:], strict=False)] == pytest.approx(
        [0.004] * 19
    )
    assert trace[-1].load_deg - trace[-11].load_deg == pytest.approx(10 * 40 * 360 / 400_000, rel=0.05)


def test_true_angles_ignore_encoder_faults(drive, program):
    before = drive.truth.load_deg
    drive.fault("encoder_jump", counts=800_000)
    program.move(3)
    assert drive.truth.load_deg - before < 0.5


def test_the_log_is_in_order(drive, program):
    drive.fault("drive_fault")
    program.move(30)
    drive.note("seen")
    kinds = [(each.kind, each.text) for each in drive.log]
    assert kinds == [
        ("nmt", "boot-up message"),
        ("nmt", "pre operational"),
        ("bus", "the program opens its bus"),
        ("nmt", "operational"),
        ("state", "ready to switch on"),
        ("state", "switched on"),
        ("state", "operation enabled"),
        ("fault", "drive_fault code=0x3210"),
        ("emcy", "3210h (DC link over-voltage)"),
        ("state", "fault reaction active"),
        ("state", "fault"),
        ("note", "seen"),
    ]
    times = [each.time_s for each in drive.log]
    assert times == sorted(times)


def test_drive_time_replaces_the_time_module(drive):
    begin = drive.time.monotonic(), drive.time.time(), drive.time.perf_counter(), drive.time.monotonic_ns()
    drive.time.sleep(2.0)
    end = drive.time.monotonic(), drive.time.time(), drive.time.perf_counter(), drive.time.monotonic_ns()
    assert [b - a for a, b in zip(begin, end, strict=True)] == pytest.approx([2.0, 2.0, 2.0, 2e9])
    assert drive.time.gmtime is time.gmtime
    assert drive.now == pytest.approx(2.0)


def test_a_vain_wait_ends_with_the_log(drive):
    drive.note("here")
    with pytest.raises(TimeoutError, match=r"rest did not occur in 2 s\n(.*\n)*.*here"):
        drive.wait_until(lambda: False, timeout_s=2.0, what="rest")
    assert drive.now == pytest.approx(2.0, abs=0.01)


def test_a_second_thread_in_lockstep_is_refused_with_the_remedy(drive):
    bus = drive.open_bus()
    bus.recv(0)
    complaints = []

    def listen() -> None:
        try:
            bus.recv(0)
        except can.CanOperationError as error:
            complaints.append(str(error))

    thread = threading.Thread(target=listen)
    thread.start()
    thread.join()
    assert "choose the bus 'virtual'" in complaints[0]
    with pytest.raises(can.CanOperationError, match="one thread"):
        bus.send(can.Message(arbitration_id=0x080, is_extended_id=False))


def test_a_bus_exists_only_with_its_drive():
    with simulated_drive("article", bus="virtual") as drive:
        interface, channel = drive.interface, drive.channel
    with pytest.raises(can.CanInitializationError, match="no simulated drive has this channel"):
        can.Bus(interface=interface, channel=channel, ignore_config=True)


def test_in_real_time_the_drive_runs_on_its_own():
    """Faults take effect and filters apply while the program blocks in `recv`."""
    with simulated_drive("article", bus="virtual") as drive, drive.open_bus() as bus:
        bus.set_filters([{"can_id": 0x081, "can_mask": 0x7FF}])
        drive.fault("drive_fault", after_s=0.05, code=0x4310)
        message = bus.recv(10.0)
        assert message is not None
        assert bytes(message.data[:2]) == b"\x10\x43"
        assert drive.state == "fault"
        with drive.fault("bus_down"), pytest.raises(can.CanOperationError, match="Network is down"):
            bus.recv(10.0)
        assert bus.recv(0.02) is None


@pytest.mark.parametrize("bus", ["lockstep", "virtual"])
def test_two_drives_on_one_bus(bus, second_axis):
    """Each has its own faults, history and axis; the bus is the program's one bus."""
    with (
        simulated_drive("article", bus=bus) as one,
        simulated_drive(str(second_axis), beside=one) as two,
        one.open_bus() as program,
    ):
        assert (one.node_id, two.node_id) == (1, 2)
        assert (one.interface, one.channel) == (two.interface, two.channel)
        two.fault("drive_fault")
        two.wait_until(lambda: two.state == "fault")
        one.sleep(0.05)
        assert one.state == "switch on disabled"
        received = []
        while (message := program.recv(0.05)) is not None:
            received.append(message.arbitration_id)
        assert 0x082 in received
        assert one.emergencies == ()
        assert two.emergencies == (0x3210,)
        with pytest.raises(InputError, match="another simulated drive on this bus is node 2"):
            simulated_drive(str(second_axis), beside=one).__enter__()


def test_a_second_drive_on_a_real_bus_is_refused_with_advice():
    bus = "udp_multicast:239.74.163.10"
    with (
        simulated_drive("article", bus=bus),
        pytest.raises(InputError, match="beside=drive"),
        simulated_drive("demo", bus=bus),
    ):
        pass


def test_a_failed_bus_of_a_drive_is_reported(monkeypatch):
    """The drive's thread has ended, so the test must not continue."""
    monkeypatch.setattr("hdbridge.device.run.PATIENCE_S", 0.0)

    def use() -> None:
        with simulated_drive("article", bus="virtual") as drive:

            def recv(timeout: float | None = None) -> None:
                raise can.CanOperationError("Network is down")

            drive._node.bus.recv = recv
            until(lambda: "simulated drive 1" not in {each.name for each in threading.enumerate()})

    with pytest.raises(BusError, match="cannot be read"):
        use()


def test_a_real_interface_is_not_taken_down():
    with (
        simulated_drive("article", bus="udp_multicast:239.74.163.8") as drive,
        pytest.raises(InputError, match="cannot take down the interface of"),
    ):
        drive.fault("bus_down")


def test_drives_take_turns_on_a_real_bus(monkeypatch):
    """Workers of pytest-xdist share vcan0 in this way: the second drive waits for the first to end."""
    bus = "udp_multicast:239.74.163.9"
    order = []
    refused = threading.Event()

    class Lock(InterfaceLock):
        def acquire(self) -> None:
            try:
                super().acquire()
            except BusInUseError:
                refused.set()
                raise

    monkeypatch.setattr("hdbridge.testing.line.InterfaceLock", Lock)

    def second() -> None:
        with simulated_drive("article", bus=bus):
            order.append("second")

    with simulated_drive("article", bus=bus):
        thread = threading.Thread(target=second)
        thread.start()
        until(lambda: refused.is_set() or order)
        order.append("first")
    thread.join()
    assert order == ["first", "second"]
