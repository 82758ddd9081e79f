"""Faults and bad manners of a drive at any moment: they neither power nor move the axis, and a stop lasts.

`tests/daemon/test_disorder.py` draws sequences of them.
"""

import errno
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

import can
import pytest
from can.interfaces.virtual import VirtualBus
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from support.characters import RUDE
from support.daemon import SteppedDaemon, article_axis, stepped_daemon
from support.rude import ENABLED, OFF, STOPPED, RudeDrive, Ways
from support.spoilt import SpoiltBus

from hdbridge.axis import Source
from hdbridge.control.bench import Bench
from hdbridge.daemon.loop.faultlog import FAULT_INDEX
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, EventKind
from hdbridge.drive import Drive
from hdbridge.drive.supervision import Fault
from hdbridge.motion.procedures.stepping import Stepping

AFTER_TURNS = st.integers(0, 8)
"""Cycles from the command to enable until a drive is enabled, and some more."""
PLAUSIBLE_COUNTS = 400
"""Largest error of a position that the supervision accepts: vibration, and the highest speed in a cycle."""

CYCLE_COUNTS = 100
"""Motion in one cycle at the highest speed, counts."""
STOPS = (AxisState.QUICK_STOPPED, AxisState.LATCHED)
DROPPED_OUT = FAULT_INDEX[Fault.DROPPED_OUT]


@contextmanager
def verified() -> Iterator[tuple[SteppedDaemon, RudeDrive]]:
    with stepped_daemon(1, character=RUDE) as daemon:
        daemon.verify()
        (node,) = daemon.nodes
        assert isinstance(node, RudeDrive)
        yield daemon, node


@contextmanager
def moving() -> Iterator[tuple[SteppedDaemon, RudeDrive]]:
    with verified() as (daemon, node):
        daemon.enable()
        daemon.move(300.0)
        daemon.run(0.5)
        yield daemon, node


def stop(daemon: SteppedDaemon, *, by_command: bool) -> None:
    """Quick-stops the axis by command, or by a fault of the bus."""
    if by_command:
        daemon.post(CommandKind.QUICK_STOP)
    else:
        daemon.interfere(0x080)


@pytest.mark.parametrize("coasts", [False, True])
@pytest.mark.parametrize("by_command", [False, True])
def test_a_drive_that_ignores_a_quick_stop_loses_its_voltage(coasts: bool, by_command: bool) -> None:
    with moving() as (daemon, node):
        node.ways.ignores_quick_stop, node.ways.coasts = True, coasts
        stop(daemon, by_command=by_command)
        daemon.run(0.4)
        assert node.state == OFF
        daemon.until(lambda: bool(daemon.reported(EventKind.STOPPED)))
        (stopped,) = daemon.reported(EventKind.STOPPED)
        assert "did not obey it" in stopped.text
        assert daemon.states == [AxisState.QUICK_STOPPED]


@pytest.mark.parametrize("by_command", [False, True])
def test_a_quick_stop_that_a_drive_never_reports_is_not_confirmed(by_command: bool) -> None:
    with moving() as (daemon, node):
        node.ways.words.extend([0x1237] * 1000)
        stop(daemon, by_command=by_command)
        daemon.until(lambda: bool(daemon.reported(EventKind.STOPPED)))
        (stopped,) = daemon.reported(EventKind.STOPPED)
        assert "did not confirm it" in stopped.text
        assert node.state == OFF


@pytest.mark.parametrize("by_command", [False, True])
def test_the_noise_of_a_fine_encoder_is_not_motion(by_command: bool) -> None:
    axis = article_axis(1)
    fine = axis.motor_encoder.model_copy(update={"counts_per_turn": 1 << 24})
    with stepped_daemon([axis.model_copy(update={"motor_encoder": fine})], character=RUDE) as daemon:
        (node,) = daemon.nodes
        assert isinstance(node, RudeDrive)
        daemon.verify()
        daemon.enable()
        node.ways.jumps.extend([0, 8] * 1000)
        stop(daemon, by_command=by_command)
        daemon.run(0.2)
        (stopped,) = daemon.reported(EventKind.STOPPED)
        assert "did not" not in stopped.text


@pytest.mark.parametrize("stopped", [False, True])
def test_a_drive_that_powers_itself_is_stopped_and_reported(stopped: bool) -> None:
    with verified() as (daemon, node):
        if stopped:
            stop(daemon, by_command=False)
            daemon.until(lambda: bool(daemon.reported(EventKind.STOPPED)))
        node.ways.powers_itself = True
        daemon.turn(3)
        node.ways.powers_itself = False
        daemon.turn(2)
        assert node.state == STOPPED
        assert daemon.states == [AxisState.QUICK_STOPPED]
        texts = [each.text for each in daemon.reported(EventKind.FAULT) if each.code == DROPPED_OUT]
        assert texts == ["it went to 'operation enabled'"]


Disturbance = Callable[[SteppedDaemon, RudeDrive], object]


def emergencies(daemon: SteppedDaemon, number: int) -> None:
    for code in range(0x2300, 0x2300 + number):
        daemon.interfere(0x081, struct.pack("<HB5x", code, 1))


def error_frames(daemon: SteppedDaemon, number: int) -> None:
    for _ in range(number):
        frame = can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False)
        daemon.intruder.send(frame)


def restarts(node: RudeDrive) -> None:
    """Restarts only the communication, and still acts on the last RPDO."""
    node.ways.starts_itself = node.ways.keeps_power = node.ways.resumes = True
    node.restart(everything=False)


HARMLESS: dict[str, Disturbance] = {
    "error frames": lambda daemon, _: error_frames(daemon, 50),
    "emergency storm": lambda daemon, _: emergencies(daemon, 200),
    "end of all errors": lambda daemon, _: daemon.interfere(0x081, bytes(8)),
    "each TPDO twice": lambda _, node: setattr(node, "duplicate_tpdos", 200),
    "TPDOs at twice the rate": lambda _, node: setattr(node.ways, "tpdo_again_s", 0.002),
    "a late TPDO": lambda _, node: setattr(node, "hold_tpdos", 1),
    "a lost TPDO": lambda _, node: setattr(node, "drop_tpdos", 1),
    "jumps by the range of 6064h": lambda _, node: node.ways.jumps.extend([1 << 32, 0, -(1 << 32)]),
}
STOPPING: dict[str, Disturbance] = {
    "interface down": lambda daemon, _: setattr(daemon.bus, "down", errno.ENETDOWN),
    "pre-operational heartbeat": lambda daemon, _: daemon.interfere(0x701, b"\x7f"),
    "stopped heartbeat": lambda daemon, _: daemon.interfere(0x701, b"\x04"),
    "false boot-up message": lambda daemon, _: daemon.interfere(0x701, b"\0"),
    "pre-operational": lambda _, node: node.leave_operational(),
    "restart": lambda _, node: node.restart(),
    "restart with power": lambda _, node: restarts(node),
    "another mode": lambda _, node: node.swap_mode(1),
    "another mode for a while": lambda daemon, node: (
        node.swap_mode(1),
        daemon.run(0.1),
        node.swap_mode(8),
    ),
    "no TPDO any more": lambda _, node: setattr(node, "drop_tpdos", 10**6),
    "late TPDOs": lambda _, node: setattr(node, "hold_tpdos", 3),
    "jump by half the range of 6064h": lambda _, node: node.ways.jumps.append(1 << 31),
    **{
        f"one statusword {word:02X}h": lambda _, node, word=word: node.ways.words.append(word)  # type: ignore[misc]
        for word in (0x00, 0x40, 0x21, 0x23, 0x07, 0x0F, 0x08, 0xFFFF)
    },
}


@pytest.mark.parametrize("name", HARMLESS)
def test_what_is_harmless_does_not_stop_a_move(name: str) -> None:
    with moving() as (daemon, node):
        HARMLESS[name](daemon, node)
        daemon.run(0.5)
        moved = daemon.move(0.0)
        daemon.until(lambda: daemon.ended(moved), 30.0)
        assert daemon.states == [AxisState.ENABLED]


@pytest.mark.parametrize("name", STOPPING)
def test_what_stops_a_move_stops_it_for_good(name: str) -> None:
    with moving() as (daemon, node):
        powered, before = node.powered, node.motor_counts
        STOPPING[name](daemon, node)
        daemon.run(0.1)
        stopped = node.motor_counts
        daemon.run(1.0)
        daemon.bus.down = None
        daemon.run(1.0)
        assert node.powered == powered
        assert node.motor_counts == stopped
        assert abs(stopped - before) <= 2 * CYCLE_COUNTS
        assert daemon.states[0] in STOPS
        assert node.state != ENABLED or node.nmt != 5
        (event,) = daemon.reported(EventKind.STOPPED)
        assert event.text


def test_a_drive_that_runs_on_in_another_mode_is_stopped() -> None:
    with moving() as (daemon, node):
        node.ways.runs_on = True
        node.swap_mode(3)
        daemon.post(CommandKind.STOP)
        daemon.run(0.5)
        stopped = node.motor_counts
        daemon.run(0.5)
        assert node.motor_counts == stopped
        assert daemon.states == [AxisState.QUICK_STOPPED]


@pytest.mark.parametrize("frames", [300, 600])
def test_a_flood_of_emergencies_stops_a_move(frames: int) -> None:
    with moving() as (daemon, node):
        for _ in range(3):
            emergencies(daemon, frames)
            daemon.turn()
        daemon.run(0.2)
        assert daemon.states == [AxisState.QUICK_STOPPED]
        assert node.state != ENABLED


WAYS: dict[str, Ways] = {
    "polite": Ways(),
    "resumes": Ways(resumes=True),
    "restarts on its own": Ways(keeps_power=True, starts_itself=True, resumes=True),
    "coasts": Ways(ignores_quick_stop=True, coasts=True),
    "sends twice": Ways(tpdo_again_s=0.002, boots_again_s=0.05),
    "is late": Ways(sdo_delay_s=0.05, mode_delay_s=0.1, status_delay=3),
    "loses a turn": Ways(loses_turns=1),
}


@pytest.mark.parametrize("recovers_s", [0.0, 0.3])
@pytest.mark.parametrize("frame", [0x080, 0x201, 0x77F])
@pytest.mark.parametrize("ways", WAYS.values(), ids=WAYS)
def test_bus_off_stops_a_move_for_good(ways: Ways, frame: int, recovers_s: float) -> None:
    """Its only sign is an error frame of SocketCAN. The queued frames are sent when it ends."""
    with stepped_daemon(1, character=RUDE) as daemon:
        daemon.bus.channel_info = "socketcan channel 'vcan0'"
        daemon.begin_again()
        (node,) = daemon.nodes
        assert isinstance(node, RudeDrive)
        node.ways = replace(ways)
        daemon.verify()
        daemon.enable()
        daemon.move(300.0)
        daemon.run(0.5)
        daemon.bus.bus_off_at = frame
        daemon.until(lambda: daemon.bus.unsent is not None)
        before = node.motor_counts
        daemon.run(0.02 + recovers_s)
        daemon.bus.recover()
        stopped = node.motor_counts
        daemon.run(1.0)
        kinds = [each.kind for each in daemon.events if each.kind in (EventKind.BUS_DOWN, EventKind.BUS_UP)]
        assert kinds == [EventKind.BUS_DOWN, EventKind.BUS_UP]
        assert abs(stopped - before) <= 2 * CYCLE_COUNTS
        assert node.motor_counts == stopped
        assert node.powered == 1
        assert daemon.states == [AxisState.LATCHED]


class KilledError(BaseException):
    """End of a process that sends nothing any more."""


def borrow(daemon: SteppedDaemon, frames: int) -> None:
    """Steps the axis with another program, which dies after this number of frames."""
    with SpoiltBus(daemon.bus._inner.channel_id, daemon.clock) as bus:
        left = iter(range(frames))

        def spy(_can_id: int, _data: bytes) -> None:
            if next(left, None) is None:
                bus.unsent = []
                raise KilledError

        bus.spy = spy
        drive = Drive(bus, daemon.axes[0].config, daemon.clock)
        with suppress(KilledError):
            drive.boot()
            Bench(drive).run(Stepping(count=4, step_deg=40.0, start_deg=10.0))


@pytest.mark.parametrize("ways", WAYS.values(), ids=WAYS)
@settings(max_examples=8, phases=[Phase.generate])
@given(frames=st.integers(0, 900))
def test_a_killed_borrower_of_the_bus_leaves_no_motion(ways: Ways, frames: int) -> None:
    with stepped_daemon(1, character=RUDE) as daemon:
        (node,) = daemon.nodes
        assert isinstance(node, RudeDrive)
        daemon.turn()
        node.ways = replace(ways, boots_again_s=0.0)
        borrow(daemon, frames)
        node.ways = replace(ways)
        daemon.hang(0.5)
        powered, stopped = node.powered, node.motor_counts
        daemon.begin_again()
        daemon.run(0.5)
        daemon.verify()
        daemon.run(0.1)
        assert node.powered == powered
        assert node.motor_counts == stopped
        assert node.state == OFF


@pytest.mark.parametrize("resumes", [False, True])
@pytest.mark.parametrize("dead_s", [0.0, 0.02, 1.0])
def test_an_axis_does_not_move_after_the_death_of_its_master(dead_s: float, resumes: bool) -> None:
    with moving() as (daemon, node):
        node.ways.resumes = resumes
        before = node.motor_counts
        daemon.hang(dead_s)
        daemon.begin_again()
        daemon.run(0.5)
        assert node.motor_counts == before
        assert node.powered == 1
        daemon.drives.clear()
        daemon.verify()
        assert node.state == OFF
        assert node.motor_counts == before


@settings(max_examples=12, phases=[Phase.generate])
@given(AFTER_TURNS, st.integers(1, 3), st.integers(-3000, 3000))
def test_a_wrong_position_while_enabling_moves_nothing(turns: int, times: int, error: int) -> None:
    with verified() as (daemon, node):
        daemon.post(CommandKind.ENABLE, **daemon.prepare())
        daemon.turn(turns)
        node.ways.jumps.extend([error] * times)
        for _ in range(40):
            daemon.turn()
            assert abs(node.motor_counts) <= PLAUSIBLE_COUNTS


@settings(max_examples=12, phases=[Phase.generate])
@given(AFTER_TURNS, st.booleans())
def test_a_fault_while_enabling_is_left_only_by_a_reset(turns: int, heals: bool) -> None:
    with verified() as (daemon, node):
        node.ways.heals = heals
        daemon.post(CommandKind.ENABLE, **daemon.prepare())
        daemon.turn(turns)
        node.raise_error(0x3210)
        powered = node.powered
        daemon.run(0.5)
        assert node.powered == powered
        assert daemon.states == [AxisState.QUICK_STOPPED]
        fault = daemon.axes[0].supervision.stop
        assert fault is not None
        assert fault.fault is Fault.DRIVE_FAULT


@settings(max_examples=12, phases=[Phase.generate])
@given(AFTER_TURNS, st.sampled_from([CommandKind.STOP, CommandKind.QUICK_STOP, CommandKind.DISABLE]))
def test_no_axis_is_enabled_after_a_stop(turns: int, kind: CommandKind) -> None:
    with verified() as (daemon, node):
        daemon.post(CommandKind.ENABLE, **daemon.prepare())
        daemon.turn(turns)
        was_enabled = daemon.states == [AxisState.ENABLED]
        powered = node.powered
        daemon.post(kind)
        daemon.run(0.3)
        assert node.powered <= powered + was_enabled or node.state == OFF
        if not (was_enabled and kind is CommandKind.STOP):
            assert node.state != ENABLED


@pytest.mark.parametrize("kind", [CommandKind.VERIFIED, CommandKind.ENABLE, CommandKind.HOMED])
@settings(max_examples=8, phases=[Phase.generate])
@given(
    waits_s=st.sampled_from([0.0, 0.001, 0.003, 0.004, 0.05]), taken_s=st.sampled_from([0.0, 0.001, 0.004])
)
def test_a_drive_that_restarted_after_its_verification_gets_no_power(
    kind: CommandKind, waits_s: float, taken_s: float
) -> None:
    with stepped_daemon(1, character=RUDE) as daemon:
        (node,) = daemon.nodes
        assert isinstance(node, RudeDrive)
        node.ways.starts_itself = True
        commissioning = daemon.commissioning(0)
        arguments = commissioning.verify()
        if kind is not CommandKind.VERIFIED:
            daemon.done(CommandKind.VERIFIED, **arguments)
        if kind is CommandKind.HOMED:
            daemon.done(CommandKind.HOME)
        elif kind is CommandKind.ENABLE:
            arguments = daemon.prepare()
        node.restart()
        daemon.clock.sleep_until(daemon.clock.now() + waits_s)
        daemon.post(kind, **arguments)
        daemon.clock.sleep_until(daemon.clock.now() + taken_s)
        daemon.run(0.05)
        daemon.post(CommandKind.ENABLE, i=node.motor_counts, j=0, k=0x0250)
        daemon.run(0.5)
        assert node.powered == 0
        assert daemon.states[0] in {AxisState.UNVERIFIED, AxisState.LATCHED, AxisState.LENT}


class Encoder:
    """Node 5, an encoder at rest that answers each SYNC."""

    def __init__(self, bus: VirtualBus) -> None:
        self._bus = bus

    def next_event_s(self) -> float:
        return float("inf")

    def poll(self, now_s: float) -> None:
        while (message := self._bus.recv(0)) is not None:
            if message.arbitration_id == 0x080:
                self._bus.send(can.Message(arbitration_id=0x185, data=bytes(4), is_extended_id=False))


def test_a_restarted_encoder_node_leaves_no_power_on_the_drive() -> None:
    axis = article_axis(1)
    source = Source(index=0x6004, subindex=0, type="uint32", via="tpdo", node=5)
    encoder = axis.load_encoder.model_copy(update={"source": source})
    with (
        stepped_daemon([axis.model_copy(update={"load_encoder": encoder})], character=RUDE) as daemon,
        VirtualBus(daemon.bus._inner.channel_id) as bus,
    ):
        daemon.clock.nodes.append(Encoder(bus))
        (node,) = daemon.nodes
        assert isinstance(node, RudeDrive)
        daemon.turn(2)
        node.configure(daemon.axes[0].image.tpdos[:2])
        daemon.axes[0].cycle.monitor.started(1)
        daemon.turn(2)
        daemon.done(CommandKind.VERIFIED, i=0, j=0, k=0x0250)
        daemon.done(CommandKind.ENABLE, i=0, j=0, k=0x0250)
        daemon.move(300.0)
        daemon.turn(5)
        assert node.state == ENABLED
        sent = daemon.sent()
        daemon.interfere(0x705, b"\0")
        daemon.turn(20)
        assert daemon.states == [AxisState.LATCHED]
        assert node.state != ENABLED
        words = [struct.unpack_from("<H", data)[0] for _, can_id, data in sent if can_id == 0x201]
        assert set(words) == {0x0002}
