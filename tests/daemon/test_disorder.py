"""Random commands, faults and failing services in any order.

The invariants (`support.daemonlaws`) are checked on every frame that leaves the loop: no target outside the
limits, stale at enable, or farther from the previous target than the limits of velocity and slew allow; no
set-point beyond the limits of speed, acceleration and jerk, not even across interruptions; no power without
an ENABLE command since power was last removed; no RPDO to an axis that is not verified; each command answered
once.
"""

import errno
import math
import struct
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import update_wrapper
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule
from support.characters import AWKWARD, FRIENDLY, INTERPOLATED, RUDE, Character
from support.daemon import PROFILE, SteppedDaemon, article_axes, stepped_daemon
from support.daemonlaws import Laws
from support.keys import changed
from support.rude import RudeDrive, Ways

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, Knot, MailboxFullError, RelayedFrame
from hdbridge.drive.objects import Mode
from hdbridge.enums import Scheme
from hdbridge.errors import HdbridgeError
from hdbridge.sim.truth import Truth

K = CommandKind
COUNTS_PER_TURN = 1 << 20
"""Resolution of the motor encoder. It is high, because coarse counts would hide small jumps."""
TRAVEL_DEG = 3.0
"""Short, so that the limits are reached often."""
WORDS = ((0,), (0x27, 0), (0xFFFF,), (0x08,), (0x0F, 0x08, 0x27), (0x07, 0x27), (0x27, 0x27), (0x40, 0x21))
"""Statuswords that a drive may show for some cycles."""
KINDS = list(K)
axes = st.integers(0, 1)
angles = st.one_of(
    st.floats(-1.2 * TRAVEL_DEG, 1.2 * TRAVEL_DEG), st.sampled_from([math.nan, math.inf, -math.inf, 1e300])
)
speeds = st.one_of(st.floats(-30.0, 30.0), st.sampled_from([math.nan, math.inf, 0.0]))
counts = st.integers(-(1 << 40), 1 << 40)
turns = st.integers(0, 12)


def machine_axes():
    """Two axes with little travel."""
    made = []
    for axis in article_axes(2):
        limits = axis.limits.model_copy(
            update={"position_min_deg": -TRAVEL_DEG, "position_max_deg": TRAVEL_DEG}
        )
        encoder = axis.motor_encoder.model_copy(update={"counts_per_turn": COUNTS_PER_TURN})
        made.append(axis.model_copy(update={"limits": limits, "motor_encoder": encoder}))
    return made


def event(number: st.SearchStrategy[int] = turns, **drawn: st.SearchStrategy[Any]) -> Callable[..., Any]:
    """Returns a rule whose action is followed by this number of cycles."""

    def rule_of(act: Callable[..., None]) -> Any:
        def happen(self: "Disorder", number: int, **values: Any) -> None:
            act(self, **values)
            self.go(number)

        return rule(number=number, **drawn)(update_wrapper(happen, act))

    return rule_of


class Disorder(RuleBasedStateMachine):
    """Two axes, a service with random commands, and a bus with random events."""

    events = 0
    """Rules applied, of all examples."""
    enabled = 0
    """RPDOs that enabled a drive, of all examples."""

    def __init__(self) -> None:
        super().__init__()
        self.stack = ExitStack()

    @initialize(character=st.sampled_from([FRIENDLY, AWKWARD, INTERPOLATED, RUDE, RUDE]))
    def boot(self, character: Character) -> None:
        truth = changed(Truth.load(PROFILE), motor__encoder__counts_per_turn=COUNTS_PER_TURN)
        self.daemon: SteppedDaemon = self.stack.enter_context(
            stepped_daemon(machine_axes(), truth=truth, character=character)
        )
        self.laws = Laws(self.daemon)
        self.stream = 0
        self.booted = [False, False]
        self.models = [
            self.daemon.setting(axis, scheme).to_json()
            for axis in range(2)
            for scheme in (Scheme.EXTENDED, Scheme.SYNCHRONOUS, Scheme.NONE)
        ]
        for axis in range(2):
            self._boot(axis)

    def teardown(self) -> None:
        Disorder.enabled += sum(laws.enabled for laws in self.laws.axes.values())
        self.stack.close()

    def post(self, kind: CommandKind | int, axis: int = 0, **fields: float) -> None:
        with suppress(MailboxFullError):
            # The invariants must see the command before a cycle takes it.
            self.laws.post(kind, axis, self.daemon.post(kind, axis, **fields))  # type: ignore[arg-type]

    def go(self, number: int = 1) -> None:
        Disorder.events += 1
        for _ in range(number):
            self.laws.turn()
            self.laws.take(list(self.daemon.events))
            self.daemon.events.clear()
        self.laws.samples()

    # ---------------------------------------------------------------- commands of a correct service

    def _boot(self, axis: int) -> None:
        """Boots the drive over the relay if necessary, as far as the bus permits, then verifies it."""
        daemon = self.daemon
        if not daemon.axes[axis].cycle.feedback.fresh or not self.booted[axis]:
            with suppress(HdbridgeError):
                drive = daemon.drive(axis)
                drive.boot()
                daemon.run(0.02)
                drive.enable(Mode.CSP)
                self.booted[axis] = True
        self.laws.take(list(daemon.events))
        daemon.events.clear()
        self.post(K.RESET, axis, i=1)
        image = daemon.axes[axis].image
        actual = daemon.nodes[axis].firmware.motion.machine.motor_counts
        self.post(K.VERIFIED, axis, i=actual, j=image.load_counts, k=0x0250)
        self.go(3)

    def stopped(self) -> bool:
        daemon = self.daemon
        return any(state is not AxisState.ENABLED for state in daemon.states) and not daemon.bus.down

    @precondition(stopped)
    @rule()
    def start(self) -> None:
        """Performs every step by which the user and the service restart a stopped machine."""
        for node in self.daemon.nodes:
            node.faults.silent = node.faults.mute_heartbeat = False
        self.go(5)
        for axis in range(2):
            if self.daemon.states[axis] is AxisState.QUICK_STOPPED:
                self.go(10)
                self.post(K.RESET, axis)
                self.go(10)
                self.post(K.DRIVE_FAULT_RESET, axis)
                self.go(5)
            if self.daemon.states[axis] is AxisState.LENT:
                self.post(K.RELEASE, axis)
                self.go()
            if self.daemon.states[axis] in (AxisState.LATCHED, AxisState.UNVERIFIED):
                self._boot(axis)
            if self.daemon.states[axis] is AxisState.DISABLED:
                self._enable(axis)
                self.go(12)

    @precondition(stopped)
    @rule()
    def start_again(self) -> None:
        """Duplicates the rule `start`, so that a restart is drawn more often."""
        self.start()

    def _enable(self, axis: int) -> None:
        image = self.daemon.axes[axis].image
        self.post(K.ENABLE, axis, i=image.motor_counts, j=image.load_counts, k=image.statusword or 0)

    @event(axis=axes)
    def enable(self, axis: int) -> None:
        self._enable(axis)

    @event(st.integers(10, 30), axis=axes)
    def enable_and_wait(self, axis: int) -> None:
        self._enable(axis)

    @event(axis=st.integers(-1, 2), kind=st.sampled_from(
        [K.DISABLE, K.QUICK_STOP, K.STOP, K.HOME, K.RELEASE, K.STREAM_END, K.DRIVE_FAULT_RESET]))  # fmt: skip
    def order(self, axis: int, kind: CommandKind) -> None:
        self.post(kind, axis)

    @event(axis=axes, verified=st.integers(0, 1))
    def reset(self, axis: int, verified: int) -> None:
        self.post(K.RESET, axis, i=verified)

    @event(axis=axes, goal=angles, velocity=speeds, acceleration=st.sampled_from([math.nan, 50.0, 1e9, -1.0]))
    def move(self, axis: int, goal: float, velocity: float, acceleration: float) -> None:
        self.post(K.MOVE, axis, a=goal, b=velocity, c=acceleration)

    @event(st.integers(1, 40), axis=axes, goal=st.floats(-TRAVEL_DEG, TRAVEL_DEG))
    def move_far(self, axis: int, goal: float) -> None:
        self.post(K.MOVE, axis, a=goal, b=math.nan, c=math.nan)

    @event(axis=axes, velocity=speeds, timeout=st.sampled_from([0.02, 0.2, 1.0, -1.0, math.nan, 1e9]))
    def jog(self, axis: int, velocity: float, timeout: float) -> None:
        self.post(K.JOG, axis, a=velocity, b=timeout)

    @event(
        mask=st.integers(0, 4), travel=st.floats(-2.0, 2.0), knots=st.integers(1, 26), before=st.booleans()
    )
    def stream_smoothly(self, mask: int, travel: float, knots: int, before: bool) -> None:
        """Streams a path from the current positions, complete or cut short, with knots queued before or after
        the stream begins.
        """
        self.stream += 1
        if not before:
            self.post(K.STREAM_BEGIN, 0, a=0.1, i=mask, j=self.stream)
        for axis in self.daemon.axes:
            begin = axis.set_point.position_deg
            path = []
            for place in range(knots):
                s = place / 25
                path.append(Knot(
                    self.stream, 0.5 * s, begin + travel * (10 * s**3 - 15 * s**4 + 6 * s**5),
                    travel / 0.5 * (30 * s**2 - 60 * s**3 + 30 * s**4),
                ))  # fmt: skip
            self.daemon.memory.knots[axis.index].put(path)
        if before:
            self.post(K.STREAM_BEGIN, 1, a=0.1, i=mask, j=self.stream)

    @event(axis=axes, which=st.integers(0, 5))
    def change_model(self, axis: int, which: int) -> None:
        self.post(K.CHANGE, axis, i=self.daemon.memory.settings[axis].put(self.models[which]))

    # ---------------------------------------------------------------- commands of a faulty service

    @event(
        kind=st.one_of(st.sampled_from(KINDS), st.integers(-5, 300)),
        axis=st.integers(-3, 5), a=angles, b=speeds, c=speeds, i=counts, j=counts,
        k=st.one_of(counts, st.sampled_from([0x0250, 0x1237, 0x0008, 0x0007])),
    )  # fmt: skip
    def nonsense(self, kind, axis, a, b, c, i, j, k) -> None:
        if kind in (K.VERIFIED, K.HOMED, K.ENABLE):
            # Only the service can know how often the position has wrapped around 2**32 counts.
            i = max(min(i, (1 << 31) - 1), -(1 << 31))
        self.post(kind, axis, a=a, b=b, c=c, i=i, j=j, k=k)

    @event(data=st.binary(max_size=50))
    def nonsense_model(self, data: bytes) -> None:
        self.post(K.CHANGE, 0, i=self.daemon.memory.settings[0].put(data))

    @event(axis=axes, knots=st.lists(st.tuples(st.integers(-1, 3), angles, angles, speeds), max_size=20))
    def nonsense_knots(self, axis: int, knots: list[tuple[int, float, float, float]]) -> None:
        self.daemon.memory.knots[axis].put([Knot(self.stream + s, t, p, v) for s, t, p, v in knots])

    @event(st.just(3), count=st.integers(0, 300))
    def flood(self, count: int) -> None:
        for place in range(count):
            self.post(K.MOVE if place % 2 else K.STOP, place % 2, a=float(place % 5), b=math.nan, c=math.nan)

    @event(
        can_id=st.one_of(st.integers(0, 0x7FF), st.sampled_from([0, 0x601, 0x602])),
        data=st.binary(max_size=8),
    )
    def outgoing(self, can_id, data):
        # The invariants do not cover a node that the service has reconfigured; they cover restarts and reads.
        if 0x600 <= can_id < 0x680 and data and data[0] >> 5 not in (2, 3, 4):
            data = b"\x40" + data[1:]
        self.daemon.memory.outgoing.add(RelayedFrame(0, can_id, data))

    # ---------------------------------------------------------------- events on the bus

    @event(axis=axes, what=st.sampled_from(["drop_tpdos", "shorten_tpdos", "duplicate_tpdos", "hold_tpdos"]),
           how_many=st.integers(1, 4))  # fmt: skip
    def spoil_tpdos(self, axis: int, what: str, how_many: int) -> None:
        setattr(self.daemon.nodes[axis].faults, what, how_many)

    @event(axis=axes)
    def restart_node(self, axis: int) -> None:
        self.booted[axis] = False
        self.daemon.nodes[axis].faults.boot_up()

    @event(axis=axes, code=st.sampled_from([0x3210, 0x8611, 0x8130]))
    def drive_fault(self, axis: int, code: int) -> None:
        self.daemon.nodes[axis].faults.raise_error(code)

    @event(axis=axes, code=st.sampled_from([0x8130, 0x8250]), says=st.booleans())
    def lose_master(self, axis: int, code: int, says: bool) -> None:
        faults = self.daemon.nodes[axis].faults
        (faults.miss_master if says else faults.lose_master)(code)

    @event(axis=axes)
    def leave_operational(self, axis: int) -> None:
        self.daemon.nodes[axis].faults.leave_operational()

    @event(axis=axes, jump=st.integers(-200_000, 200_000))
    def jump(self, axis: int, jump: int) -> None:
        self.daemon.nodes[axis].faults.load_jump_counts = jump

    @event(axis=axes, what=st.sampled_from(["silent", "mute_heartbeat"]), on=st.booleans())
    def unplug(self, axis: int, what: str, on: bool) -> None:
        setattr(self.daemon.nodes[axis].faults, what, on)

    @event(can_id=st.one_of(
        st.integers(0x081, 0x7FF).filter(lambda n: not 0x201 <= n <= 0x202 and not 0x600 <= n <= 0x67F),
        st.sampled_from([0x080, 0x081, 0x701, 0x702, 0x77F])),
        data=st.binary(max_size=8))  # fmt: skip
    def foreign(self, can_id: int, data: bytes) -> None:
        if can_id == 0x701 or can_id == 0x702:
            data = data[:1]
        if not (0x181 <= can_id <= 0x182 or 0x281 <= can_id <= 0x282):  # a false position: see `lying_tpdo`
            self.daemon.interfere(can_id, data)

    @event(node=st.integers(1, 2), length=st.integers(0, 7))
    def lying_tpdo(self, node: int, length: int) -> None:
        self.daemon.interfere(0x180 + node, struct.pack("<Hih", 0x1237, 999_999, 0)[:length])

    @event(axis=axes, way=st.sampled_from(sorted(vars(Ways()))), on=st.booleans(), which=st.integers(0, 200))
    def misbehave(self, axis: int, way: str, on: bool, which: int) -> None:
        node = self.daemon.nodes[axis]
        if not isinstance(node, RudeDrive):
            return
        usual = getattr(Ways(), way)
        if isinstance(usual, bool):
            setattr(node.ways, way, on)
        elif isinstance(usual, float):
            setattr(node.ways, way, 0.1 * on)
        elif way == "words":
            node.ways.words.extend(WORDS[which % len(WORDS)])
        elif way == "jumps":
            node.ways.jumps.extend([500 * (which - 100)] * (1 + which % 3))
        elif isinstance(usual, int):
            setattr(node.ways, way, which % 6 if on else 0)

    @event(can_id=st.sampled_from([0x080, 0x201, 0x202, 0x77F, 0x601]))
    def no_room(self, can_id: int) -> None:
        self.daemon.bus.no_room_for = can_id

    @event(down=st.booleans())
    def interface(self, down: bool) -> None:
        self.daemon.bus.down = errno.ENETDOWN if down else None

    @event(duration=st.sampled_from([0.001, 0.003, 0.006, 0.02, 0.3]))
    def hang(self, duration: float) -> None:
        self.daemon.hang(duration)

    @event()
    def restart_loop(self) -> None:
        self.laws.begin_again()

    @event(st.integers(1, 60))
    def pass_time(self) -> None:
        """Lets only time pass."""


SMALL = settings(
    max_examples=6, stateful_step_count=40, deadline=None, suppress_health_check=list(HealthCheck)
)
LARGE = settings(SMALL, max_examples=1000, stateful_step_count=120)


def run(size: settings) -> None:
    from hypothesis.stateful import run_state_machine_as_test

    Disorder.events = Disorder.enabled = 0
    run_state_machine_as_test(Disorder, settings=size)


def test_no_order_of_events_breaks_a_law() -> None:
    run(SMALL)
    assert Disorder.events > 100
    assert Disorder.enabled > 100, "the drives were hardly ever enabled: nothing was tested"


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_no_law_is_broken_in_a_hundred_thousand_events() -> None:
    run(LARGE)
    print(f"{Disorder.events} events, {Disorder.enabled} targets to enabled drives")
    assert Disorder.events >= 100_000
