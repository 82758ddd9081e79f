"""Control loop of the daemon with simulated drives, in one thread on virtual time: `SteppedDaemon`.

Waiting on the service's side runs the loop: `SteppedClock.sleep_until` and `SteppedRelay.recv` run as many
cycles as the waiting time allows. The service is therefore unchanged, and as fast as the processor permits.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from uuid import uuid4

import can
from can.interfaces.virtual import VirtualBus

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.evaluation.stepping import Scheme
from hdbridge.control.bench import compensation_for
from hdbridge.control.buscycle import BusCycle
from hdbridge.daemon.loop.controller import Controller
from hdbridge.daemon.loop.follower import AxisSetup
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, Event, EventKind, Knot, Memory, RelayedFrame
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.device.node import DriveNode
from hdbridge.drive.drive import Drive
from hdbridge.drive.link import Link
from hdbridge.sim.lockstep import SimulatedAxis, VirtualClock, simulated_benches
from hdbridge.sim.truth import Truth
from support.characters import FRIENDLY, Character
from support.spoilt import SpoiltBus

PROFILE = Path(__file__).resolve().parents[2] / "profiles" / "article"
EVENTS_KEPT = 1000


class SteppedClock:
    """Clock of the service; waiting on it runs cycles of the loop."""

    def __init__(self, daemon: SteppedDaemon) -> None:
        self._daemon = daemon

    def now(self) -> float:
        return self._daemon.clock.now()

    def sleep_until(self, deadline_s: float) -> None:
        while self._daemon.clock.now() < deadline_s:
            self._daemon.turn()


class SteppedRelay(can.BusABC):
    """Service's end of the relay: the loop sends its frames, and runs while the service waits."""

    def __init__(self, daemon: SteppedDaemon) -> None:
        super().__init__(channel=None)
        self.channel_info = "the relay"
        self.private = True
        self._daemon = daemon
        self._reader = daemon.memory.incoming_reader()
        self._waiting: deque[can.Message] = deque()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id >= 0x700:
            return  # the loop sends the master's heartbeat
        self._daemon.memory.outgoing.add(RelayedFrame(0, msg.arbitration_id, bytes(msg.data)))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        clock = self._daemon.clock
        deadline_s = clock.now() + (math.inf if timeout is None else timeout)
        while True:
            for frame in self._reader.read()[0]:
                self._waiting.append(
                    can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
                )
            if self._waiting:
                return self._waiting.popleft()
            if clock.now() >= deadline_s:
                return None
            self._daemon.turn()


class SteppedDaemon:
    """Control loop with its simulated drives, and the actions that a service performs."""

    def __init__(
        self,
        begin: Callable[[], Controller],
        memory: Memory,
        clock: VirtualClock,
        bus: SpoiltBus,
        nodes: Sequence[DriveNode],
        intruder: VirtualBus,
    ) -> None:
        self._begin, self.memory, self.clock = begin, memory, clock
        self.bus, self.nodes, self.intruder = bus, nodes, intruder
        self.controller = begin()
        self.axes = self.controller.axes
        self.period_s = self.controller.cycle.period_s
        self.service_clock = SteppedClock(self)
        self.samples = memory.reader()
        self._events = memory.event_reader()
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        """Newest events of the loop."""
        self.drives: list[Drive] = []
        self._relay = SteppedRelay(self)
        self._streams = 0

    # ---------------------------------------------------------------- time

    def turn(self, turns: int = 1) -> None:
        for _ in range(turns):
            self.controller.turn()
        self.intruder.queue.queue.clear()  # nobody reads this queue, so it would grow
        events, lost = self._events.read()
        assert lost == 0
        self.events.extend(events)

    def run(self, duration_s: float) -> None:
        self.turn(round(duration_s / self.period_s))

    def until(self, done: Callable[[], bool], timeout_s: float = 5.0) -> None:
        for _ in range(round(timeout_s / self.period_s)):
            if done():
                return
            self.turn()
        raise AssertionError(f"not within {timeout_s} s; {self.states}, events {list(self.events)[-5:]}")

    # ---------------------------------------------------------------- what is

    @property
    def states(self) -> list[AxisState]:
        return [axis.state for axis in self.axes]

    def reported(self, kind: EventKind, axis: int | None = None) -> list[Event]:
        return [each for each in self.events if each.kind is kind and axis in (None, each.axis)]

    # ---------------------------------------------------------------- what a service does

    def post(self, kind: CommandKind, axis: int = 0, **fields: float) -> int:
        return self.memory.commands.post(kind, axis, **fields)  # type: ignore[arg-type]

    def order(self, kind: CommandKind, axis: int = 0, timeout_s: float = 5.0, **fields: float) -> Event:
        """Posts a command and runs cycles until it is answered; returns the answer."""
        id_ = self.post(kind, axis, **fields)
        answers = (EventKind.DONE, EventKind.REFUSED)
        found: list[Event] = []

        def answered() -> bool:
            found[:] = [each for each in self.events if each.id == id_ and each.kind in answers]
            return bool(found)

        self.until(answered, timeout_s)
        return found[0]

    def done(self, kind: CommandKind, axis: int = 0, **fields: float) -> None:
        """Runs `order`; AssertionError if the command is refused."""
        answer = self.order(kind, axis, **fields)
        assert answer.kind is EventKind.DONE, answer.text

    def setting(
        self, axis: int = 0, scheme: Scheme = Scheme.EXTENDED, model: TransmissionModel | None = None,
        *, load_loop: bool = False,
    ) -> CompensationSetting:  # fmt: skip
        """Returns a compensation setting of an axis; with the article's model by default."""
        config = self.axes[axis].config
        model = model or TransmissionModel.load(PROFILE / "model.yaml").bound_to(config)
        return CompensationSetting(model, scheme, load_loop=load_loop)

    def use(self, setting: CompensationSetting, axis: int = 0) -> None:
        """Makes the loop use a compensation setting."""
        self.done(CommandKind.CHANGE, axis, i=self.memory.settings[axis].put(setting.to_json()))

    def drive(self, axis: int) -> Drive:
        """Returns the service's drive object of an axis, over the relay."""
        while len(self.drives) <= axis:
            config = self.axes[len(self.drives)].config
            self.drives.append(Drive(self._relay, config, self.service_clock, force=True))
        return self.drives[axis]

    def seeds(self, axis: int) -> dict[str, int]:
        """Returns both encoders' counts and the statusword, by SDO: the fields of VERIFIED and ENABLE."""
        drive = self.drive(axis)
        positions = drive.read_positions()
        drive.state()
        return {"i": positions.motor_counts, "j": positions.load_counts, "k": drive.image.statusword or 0}

    def verify(self, axis: int = 0) -> None:
        """Boots the drive by SDO over the relay, and reports it as verified."""
        self.drive(axis).boot()
        self.done(CommandKind.VERIFIED, axis, **self.seeds(axis))

    def prepare(self, axis: int = 0) -> dict[str, int]:
        """Prepares the drive by SDO for ENABLE; returns the command's fields."""
        drive = self.drive(axis)
        drive.enable()
        image = drive.image
        return {"i": image.motor_counts, "j": image.load_counts, "k": image.statusword or 0}

    def enable(self, axis: int = 0) -> None:
        self.done(CommandKind.ENABLE, axis, **self.prepare(axis))

    def move(self, target_deg: float, axis: int = 0, velocity_deg_s: float = math.nan) -> int:
        """Begins a move; returns the command's id."""
        answer = self.order(CommandKind.MOVE, axis, a=target_deg, b=velocity_deg_s, c=math.nan)
        assert answer.kind is EventKind.DONE, answer.text
        return answer.id

    def ended(self, id_: int) -> bool:
        return any(each.kind is EventKind.MOTION_ENDED and each.id == id_ for each in self.events)

    def stream(self, knots: dict[int, Sequence[tuple[float, float, float]]], timeout_s: float = 0.5) -> Event:
        """Queues knots (time, position, velocity) of one or several axes and begins their stream."""
        self._streams += 1
        for axis, points in knots.items():
            wanted = [Knot(self._streams, *point) for point in points]
            assert self.memory.knots[axis].put(wanted) == len(wanted)
        mask = sum(1 << axis for axis in knots)
        return self.order(CommandKind.STREAM_BEGIN, min(knots), a=timeout_s, i=mask, j=self._streams)

    # ---------------------------------------------------------------- what goes wrong

    def interfere(self, can_id: int, data: bytes = b"", **kind: bool) -> None:
        """Sends a frame from another node, before the next cycle."""
        kind = {"is_extended_id": False, **kind}
        self.intruder.send(can.Message(arbitration_id=can_id, data=data, **kind))

    def begin_again(self) -> None:
        """Restarts the control process on the same memory, as the keeper does after a kill."""
        self.controller = self._begin()
        self.axes = self.controller.axes

    def hang(self, duration_s: float) -> None:
        """Stalls the control process for ``duration_s`` while the drives continue."""
        self.clock.sleep_until(self.clock.now() + duration_s)


def article_axes(count: int = 1, profile: Path = PROFILE) -> list[AxisConfig]:
    """Returns ``count`` equal axes on one bus: nodes 1, 2, ..."""
    first = AxisConfig.load(profile)
    return [
        first.model_copy(
            update={"name": f"axis{node}", "drive": first.drive.model_copy(update={"node_id": node})}
        )
        for node in range(1, count + 1)
    ]


@contextmanager
def stepped_daemon(
    axes: int | Sequence[AxisConfig] = 1,
    model: TransmissionModel | None = None,
    setup: Callable[[AxisConfig, AxisSetup], AxisSetup] = lambda _, made: made,
    truth: Path | Truth = PROFILE / "truth.yaml",
    character: Character = FRIENDLY,
    bitrate_bps: int | None = 1_000_000,
) -> Iterator[SteppedDaemon]:
    """Provides a control loop with simulated axes, none verified yet; with the article's model by default."""
    configs = [character.of_axis(each) for each in (article_axes(axes) if isinstance(axes, int) else axes)]
    plant = character.of_truth(truth if isinstance(truth, Truth) else Truth.load(truth))
    known = model if model is not None else TransmissionModel.load(PROFILE / "model.yaml")
    channel = f"daemon-{uuid4()}"
    simulated = [
        SimulatedAxis(plant, each.eds_path, each.drive.node_id, seed) for seed, each in enumerate(configs)
    ]
    with ExitStack() as stack:
        bus, clock, nodes = stack.enter_context(simulated_benches(simulated, channel))
        bus.shutdown()
        intruder = stack.enter_context(VirtualBus(channel))
        spoilt = stack.enter_context(SpoiltBus(channel, clock))
        memory = stack.enter_context(Memory.create(len(configs), configs[0].drive.cycle_s))

        def reopen() -> Link | None:
            return None if spoilt.down is not None else Link(spoilt, clock)

        def begin() -> Controller:
            cycle = BusCycle(Link(spoilt, clock), clock, memory.period_s, bitrate_bps=bitrate_bps)
            setups = [
                setup(each, AxisSetup(each, compensation_for(each, known.bound_to(each)))) for each in configs
            ]
            return Controller(cycle, setups, memory, reopen)

        daemon = SteppedDaemon(begin, memory, clock, spoilt, nodes, intruder)
        stack.callback(daemon._relay.shutdown)
        yield daemon
