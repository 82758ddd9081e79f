"""Rows of the fault table that need the daemon: client errors, ended processes, a returning bus."""

import errno
import math
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from support.flight import about
from support.reliability import further
from support.reliability_daemon import ENABLE_OPERATION, RPDO, DaemonBench, daemon_bench
from support.service import play, until

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, EventKind, Knot, MailboxFullError, RelayedFrame
from hdbridge.daemon.recorder.recorder import FlightRecorder
from hdbridge.device.node import DriveNode
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault
from hdbridge.errors import DriveError, IdentityError

S, K, E = AxisState, CommandKind, EventKind
INT32 = 1 << 31


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[DaemonBench]:
    """Two axes, at rest and not verified."""
    with daemon_bench(tmp_path) as made:
        yield made


def faults(bench: DaemonBench, axis: int = 0) -> set[Fault]:
    return {event.fault for event in bench.daemon.axes[axis].supervision.events}


def powered(node: DriveNode) -> bool:
    """True if the drive would follow a set-point."""
    return node.firmware.state.name == State.OPERATION_ENABLED.name


def turns_until(bench: DaemonBench, state: AxisState, most: int = 1000) -> int:
    """Runs cycles until the first axis is in a state; returns their number."""
    for turns in range(1, most + 1):
        bench.daemon.turn()
        if bench.states[0] is state:
            return turns
    raise AssertionError(f"{state.name} not within {most} turns: {bench.states}")


# ---------------------------------------------------------------- the bus and the drive


def test_tpdo_order_has_no_effect(moving: DaemonBench) -> None:
    moving.node.faults.reverse_tpdos = 50
    assert moving.moves_on(0)
    assert not faults(moving)
    further("TPDOs come in another order").show(0)


def test_a_wrapping_position_has_no_effect(bench: DaemonBench) -> None:
    end = bench.node.firmware.motion.machine.load_counts + 150_000  # in 19 degrees

    def wrapped(counts: int) -> int:
        return (counts - end) % (2 * INT32) - INT32

    bench.node.faults.load_reading = wrapped
    daemon = bench.daemon
    daemon.run(0.1)
    bench.set_off()
    before = wrapped(bench.node.firmware.motion.machine.load_counts)
    daemon.run(2.0)
    after = wrapped(bench.node.firmware.motion.machine.load_counts)
    assert before > 0 > after, "the counts must pass the end of their range"
    assert not faults(bench)
    assert bench.moves_on(0)
    further("the load encoder's counts pass the end of their 32 bits").show(0)


def test_a_motor_that_does_not_follow(bench: DaemonBench) -> None:
    bench.set_off()
    daemon, axis = bench.daemon, bench.daemon.axes[0]
    limit = axis.config.motor_encoder.counts(axis.config.drive.following_error_deg)
    bench.node.firmware.motion.machine.torque_limit_permille = 0.0
    beyond = 0
    while axis.state is S.ENABLED:
        daemon.turn()
        feedback = axis.cycle.feedback
        beyond += abs(feedback.demand_counts - feedback.motor_counts) > limit
    stop = axis.supervision.stop
    assert stop is not None
    assert stop.fault is Fault.FOLLOWING_ERROR
    assert axis.state is S.QUICK_STOPPED
    bench.stay_stopped(0)
    assert bench.moves_on(1)
    further("the motor does not follow").show(beyond)


def test_a_different_drive_gets_no_set_points(bench: DaemonBench) -> None:
    daemon = bench.daemon
    sent = daemon.sent()
    dictionary = bench.node.dictionary
    others = (((0x1018, 1), 1), ((0x1018, 2), 0x403), ((0x608F, 1), 8001), ((0x6091, 1), 100))
    for (index, sub), wrong in others:
        entry = dictionary[index, sub]
        right, entry.value = entry.value, wrong
        with pytest.raises((IdentityError, DriveError)):
            daemon.drive(0).boot(reset=False)
        entry.value = right
        refused = daemon.order(K.ENABLE, 0, i=0, j=0, k=0x0040)
        assert "verified first" in refused.text
    daemon.run(0.2)
    assert daemon.states == [S.UNVERIFIED] * 2
    assert RPDO + 1 not in {can_id for _, can_id, _ in sent}
    further("another drive identity, encoder or gear").show(0)


def test_the_service_verifies_drives_when_the_bus_returns(bench: DaemonBench) -> None:
    bench.set_off()
    daemon = bench.daemon
    daemon.bus.down = errno.ENODEV
    assert turns_until(bench, S.LATCHED) == 1
    daemon.run(1.3)
    daemon.bus.down = None
    turns = 0
    while not daemon.reported(E.BUS_UP):
        daemon.turn()
        turns += 1
    bench.stay_stopped(0)
    (down,) = daemon.reported(E.BUS_DOWN)
    assert "No such device" in down.text
    bench.leads_back()  # the service verifies, and it stays disabled until it is enabled
    further("the interface comes back").show(turns)


# ---------------------------------------------------------------- targets and commands


def test_a_step_beyond_the_limits_is_not_sent(moving: DaemonBench) -> None:
    axis = moving.daemon.axes[0]
    sent = moving.daemon.sent()
    wrong = axis.image.target_counts + 20_000
    moving.bad_target(wrong)
    turns = turns_until(moving, S.QUICK_STOPPED)
    assert axis.supervision.stop is not None
    assert axis.supervision.stop.fault is Fault.BAD_TARGET
    targets = [struct.unpack("<Hi", data)[1] for _, can_id, data in sent if can_id == RPDO + 1]
    assert targets
    assert all(abs(each - wrong) > 5_000 for each in targets)
    moving.stay_stopped(0)
    assert moving.moves_on(1)
    further("a model asks for a step beyond the limits of speed and slew").show(turns)
    moving.leads_back()


def test_invalid_targets_are_refused(moving: DaemonBench) -> None:
    daemon = moving.daemon
    for bad in (math.nan, math.inf, -math.inf, 400.1, -1e300):
        before = daemon.axes[0].set_point.velocity_deg_s
        # A jog at any finite speed is accepted, up to the speed limit of the axis.
        for kind in (K.MOVE,) if math.isfinite(bad) else (K.MOVE, K.JOG):
            id_ = daemon.post(kind, 0, a=bad, b=math.nan if kind is K.MOVE else 1.0, c=math.nan)
            daemon.turn()
            (answer,) = [each for each in daemon.events if each.id == id_]
            assert answer.kind is E.REFUSED, (kind, bad)
            assert daemon.axes[0].set_point.velocity_deg_s == before
    assert moving.moves_on(0)
    further("a client's target is not a number, infinite or outside the limits").show(1)


def test_nan_in_a_stream_brakes(bench: DaemonBench) -> None:
    daemon = bench.daemon
    daemon.verify()
    daemon.enable()
    here = daemon.axes[0].set_point.position_deg
    assert daemon.stream({0: [(0.1, here + 0.05, 1.0), (0.2, here + 0.15, 1.0)]}).kind is E.DONE
    daemon.run(0.1)
    daemon.memory.knots[0].put([Knot(1, 0.3, math.nan, 0.0)])
    daemon.turn()
    assert daemon.reported(E.STREAM_REFUSED)
    daemon.run(0.5)
    assert daemon.axes[0].set_point.at_rest
    assert abs(daemon.axes[0].set_point.position_deg - here) < 0.3
    assert daemon.states[0] is S.ENABLED
    further("a client streams a set-point that is not a number").show(1)


def test_a_mailbox_full_of_nonsense_is_refused(moving: DaemonBench) -> None:
    daemon = moving.daemon
    posted = 0
    with suppress(MailboxFullError):
        while posted < 10_000:
            kind = (K.MOVE, K.VERIFIED, K.CHANGE, K.HOMED, K.STREAM_BEGIN)[posted % 5]
            daemon.memory.commands.post(kind, (7, -1, 0, 99, 1)[posted % 5], i=1 << 40, j=-1, a=math.nan)
            posted += 1
    assert 100 < posted < 10_000
    turns = 0
    while len(daemon.reported(E.REFUSED)) < posted:
        daemon.turn()
        turns += 1
    assert not daemon.reported(E.DONE)
    assert moving.moves_on(0)
    assert moving.moves_on(1)
    further("a mailbox full of invalid commands").show(turns)


def test_the_service_cannot_write_restart_or_command_a_moving_drive(moving: DaemonBench) -> None:
    daemon = moving.daemon
    frames = [(0x601, b"\x2b\x40\x60\x00\x06\x00\0\0"), (0x000, b"\x81\x01"), (0x201, bytes(6)), (0x080, b"")]
    sent = daemon.sent()
    for can_id, data in frames:
        daemon.memory.outgoing.add(RelayedFrame(0, can_id, data))
    daemon.run(0.1)
    passed = set(frames[:3]) & {frame[1:] for frame in sent}
    assert not passed
    assert sum(1 for _, can_id, _ in sent if can_id == 0x080) == 25  # exactly one SYNC per cycle
    assert daemon.reported(E.REFUSED)
    assert moving.moves_on(0)
    further("an SDO write, an NMT reset, a set-point from the service in motion").show(len(passed))


def test_a_stale_position_at_enable_moves_nothing(bench: DaemonBench) -> None:
    daemon = bench.daemon
    daemon.verify()
    seeds = daemon.prepare()
    before = bench.daemon.motor_counts()
    sent = daemon.sent()
    answer = daemon.order(K.ENABLE, 0, **{**seeds, "i": seeds["i"] + 3_000})
    daemon.run(0.5)
    assert "an encoder moved faster than the axis can" in answer.text
    words = [struct.unpack_from("<H", data)[0] for _, can_id, data in sent if can_id == RPDO + 1]
    assert words
    assert ENABLE_OPERATION not in [word & 0x0F for word in words]
    assert bench.daemon.motor_counts() == before
    further("the position in the enable command is stale").show(0)


# ---------------------------------------------------------------- processes


def cycles_until_own_stop(bench: DaemonBench, most: float) -> int:
    """Stalls the control process until every drive has left *operation enabled*; returns the cycles taken."""
    nodes = bench.daemon.nodes
    assert all(powered(each) for each in nodes)
    cycles = 0
    while any(powered(each) for each in nodes):
        assert cycles < most, f"still powered after {most:g} cycles"
        bench.daemon.hang(bench.period_s)
        cycles += 1
    return cycles


def test_drives_stop_when_the_control_process_is_killed(bench: DaemonBench) -> None:
    bench.set_off()
    daemon = bench.daemon
    row = further("the control process is killed in motion")
    row.show(cycles_until_own_stop(bench, row.allowed))
    daemon.hang(1.0)
    places = [bench.daemon.motor_counts(axis) for axis in range(2)]
    sent = daemon.sent()
    daemon.begin_again()
    daemon.turn()
    assert daemon.states == [S.UNVERIFIED] * 2
    further("the control process restarts").show(1)
    daemon.run(0.5)
    assert not {RPDO + 1, RPDO + 2} & {can_id for _, can_id, _ in sent}
    for axis in range(2):
        daemon.verify(axis)
    daemon.run(0.5)
    assert daemon.states == [S.DISABLED] * 2
    assert [bench.daemon.motor_counts(axis) for axis in range(2)] == pytest.approx(places, abs=2)


@pytest.mark.parametrize("ignores", ["lost masters", "missing heartbeats and set-points"])
def test_drives_that_ignore_a_killed_control_process_fail_the_row(bench: DaemonBench, ignores: str) -> None:
    bench.set_off()
    for node in bench.daemon.nodes:
        if ignores == "lost masters":
            node.dictionary[0x6007, 0].value = 0
        node.faults.ignore_lost_heartbeat = ignores != "lost masters"
        node.faults.ignore_missing_set_points = ignores != "lost masters"
    with pytest.raises(AssertionError, match="still powered after 25 cycles"):
        cycles_until_own_stop(bench, 25)


def test_a_jog_runs_out_when_the_service_dies(moving: DaemonBench) -> None:
    daemon = moving.daemon
    axis = daemon.axes[0]
    direction = math.copysign(1.0, axis.set_point.velocity_deg_s)
    daemon.done(K.JOG, 0, a=10.0 * direction, b=0.5)
    turns = 0
    while not axis.set_point.at_rest:
        daemon.controller.turn()  # no events are read, no commands posted
        turns += 1
    daemon.run(0.5)
    assert daemon.states[0] is S.ENABLED
    further("the service dies during a jog").show(turns)


def test_a_full_disk_does_not_disturb_the_loop(moving: DaemonBench, tmp_path: Path) -> None:
    reported: list[str] = []
    recorder = FlightRecorder(tmp_path / "flights", about(2), notify=reported.append, free=lambda _: 0)

    async def story() -> None:
        async with moving.service.bridge() as bridge:
            bridge.core.add_sink(recorder)
            await bridge.core.timing.sleep(1.0)
            await until(bridge, lambda: bridge.core.newest is not None)

    play(story())
    recorder.close()
    assert any("nothing is recorded" in each for each in reported)
    assert recorder.flight.refused >= 200
    assert moving.moves_on(0)
    samples, lost = moving.daemon.samples.read()
    assert lost == 0
    further("the disk is full").show(int(samples["skipped"][-1]))
