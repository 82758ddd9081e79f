"""No sequence of commands and faults makes the set-point jump: limits hold across interruptions."""

import errno
import math
import struct
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.characters import AWKWARD, FRIENDLY, INTERPOLATED, Character
from support.daemon import PROFILE, SteppedDaemon, article_axes, stepped_daemon

from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind
from hdbridge.device.faults import Faults
from hdbridge.errors import HdbridgeError
from hdbridge.sim.truth import Truth

COUNTS_PER_TURN = 1 << 20
AXIS = article_axes()[0].model_copy(
    update={
        "motor_encoder": article_axes()[0].motor_encoder.model_copy(
            update={"counts_per_turn": COUNTS_PER_TURN}
        )
    }
)
PERIOD_S = AXIS.drive.cycle_s
DEG_PER_COUNT = 360.0 / COUNTS_PER_TURN / AXIS.gear.ratio
ENABLE_OPERATION = 0x0F

STOPPING = (CommandKind.STOP, CommandKind.QUICK_STOP, CommandKind.DISABLE, CommandKind.RESET)

Event = Callable[[SteppedDaemon], object]


def faults(daemon: SteppedDaemon) -> Faults:
    return daemon.nodes[0].faults


def _command(kind: CommandKind, **fields: float) -> Event:
    return lambda daemon: daemon.post(kind, 0, **fields)


def _bring_back(daemon: SteppedDaemon) -> None:
    """Takes a client's steps to continue: verify, reset, enable."""
    daemon.bus.down = None
    try:
        daemon.run(0.6)
        if daemon.states[0] is AxisState.QUICK_STOPPED:
            daemon.run(1.5)
            daemon.done(CommandKind.RESET, 0)
            daemon.run(0.3)
        if daemon.states[0] in (AxisState.UNVERIFIED, AxisState.LATCHED):
            if daemon.states[0] is AxisState.LATCHED:
                daemon.drive(0).boot()
                daemon.done(CommandKind.RESET, 0, i=1)
            daemon.verify(0)
        if daemon.states[0] is AxisState.DISABLED:
            daemon.enable(0)
    except (AssertionError, HdbridgeError):
        daemon.run(0.2)  # a refusal counts as an answer


def _moves(daemon: SteppedDaemon, target_deg: float) -> None:
    daemon.post(CommandKind.MOVE, 0, a=target_deg, b=math.nan, c=math.nan)


def _streams(daemon: SteppedDaemon, velocity_deg_s: float) -> None:
    here = daemon.axes[0].set_point.position_deg
    knots = [
        (0.1 * n, here + velocity_deg_s * 0.1 * (n - 1), velocity_deg_s if n > 1 else 0.0) for n in (1, 2, 3)
    ]
    try:
        daemon.stream({0: knots})
    except AssertionError:
        daemon.turn()


EVENTS: st.SearchStrategy[Event] = st.one_of(
    st.floats(-50, 50).map(lambda deg: lambda daemon: _moves(daemon, deg)),
    st.floats(-15, 15).map(lambda speed: _command(CommandKind.JOG, a=speed, b=0.3)),
    st.floats(-15, 15).map(lambda speed: lambda daemon: _streams(daemon, speed)),
    st.sampled_from(STOPPING).map(_command),
    st.sampled_from((0.003, 0.007, 0.011, 0.03, 0.2)).map(lambda time_s: lambda daemon: daemon.hang(time_s)),
    st.integers(1, 4).map(lambda count: lambda daemon: setattr(faults(daemon), "drop_tpdos", count)),
    st.sampled_from((0x8130, 0x8250)).map(lambda code: lambda daemon: faults(daemon).miss_master(code)),
    st.just(lambda daemon: faults(daemon).lose_master(0x8130)),
    st.just(lambda daemon: faults(daemon).raise_error(0x3210)),
    st.just(lambda daemon: faults(daemon).leave_operational()),
    st.just(lambda daemon: setattr(daemon.bus, "down", errno.ENETDOWN)),
    st.just(lambda daemon: daemon.begin_again()),
    st.just(_bring_back),
    st.just(_bring_back),
)  # fmt: skip


class Watch:
    """Compares each RPDO that enables the drive with the previous ones."""

    def __init__(self, daemon: SteppedDaemon) -> None:
        self.daemon = daemon
        self.velocity = self.acceleration = 0.0
        self.last: int | None = None
        self.seen = 0
        daemon.bus.spy = self.take

    def take(self, can_id: int, data: bytes) -> None:
        if can_id != 0x201:
            return
        word, target = struct.unpack("<Hi", data)
        if word & 0x0F != ENABLE_OPERATION:
            self.last, self.velocity, self.acceleration = None, 0.0, 0.0
            return
        axis = self.daemon.axes[0]
        if self.last is None:
            # The position that the drive reported last; the axis may have moved by some counts since.
            actual = self.daemon.nodes[0].firmware.motion.motor_counts
            assert abs(target - actual) * DEG_PER_COUNT < 0.01, "power begins at the position of the axis"
        else:
            self.compare((target - self.last) * DEG_PER_COUNT / PERIOD_S, axis.set_point.mode.name)
        self.last = target
        self.seen += 1

    def compare(self, velocity: float, mode: str) -> None:
        limits = AXIS.limits
        rounding = DEG_PER_COUNT / PERIOD_S
        acceleration = (velocity - self.velocity) / PERIOD_S
        assert abs(velocity) <= limits.velocity_deg_s + 2 * rounding
        assert abs(acceleration) <= limits.acceleration_deg_s2 * 1.001 + 4 * rounding / PERIOD_S, mode
        if mode != "STREAM":  # the one mode without a jerk limit
            jerk = (acceleration - self.acceleration) / PERIOD_S
            assert abs(jerk) <= limits.jerk_deg_s3 * 1.001 + 8 * rounding / PERIOD_S**2, mode
        self.velocity, self.acceleration = velocity, acceleration


@pytest.mark.parametrize("character", [FRIENDLY, AWKWARD, INTERPOLATED], ids=str)
@settings(max_examples=12)
@given(st.lists(st.tuples(EVENTS, st.integers(1, 60)), min_size=4, max_size=16))
def test_set_point_never_jumps(character: Character, events: list[tuple[Event, int]]) -> None:
    model = TransmissionModel(AXIS.gear.ratio)
    text = (
        (PROFILE / "truth.yaml")
        .read_text()
        .replace("counts_per_turn: 8000", f"counts_per_turn: {COUNTS_PER_TURN}")
    )
    with stepped_daemon([AXIS], model=model, truth=Truth.from_text(text), character=character) as daemon:
        watch = Watch(daemon)
        daemon.verify(0)
        daemon.enable(0)
        for make, turns in events:
            make(daemon)
            daemon.turn(turns)
        assert watch.seen > 0
