"""Control loop of the daemon with simulated drives, in one thread on virtual time: `SteppedDaemon`.

While the service waits, the loop runs: `SteppedClock.sleep_until` and `SteppedTiming.sleep` run as many
cycles as fit. The service therefore runs unchanged, as fast as the processor allows.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import ParamSpec, TypeVar
from uuid import uuid4

import can
from can.interfaces.virtual import VirtualBus

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.clock import Clock
from hdbridge.control.buscycle import BusCycle
from hdbridge.daemon.loop.axisloop import AxisLoop
from hdbridge.daemon.loop.controller import Controller
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.machinefile import LoadLoopSettings
from hdbridge.daemon.memory import CommandKind, Event, EventKind, Knot, Memory
from hdbridge.daemon.service.commissioning import Commissioning
from hdbridge.daemon.service.core import Arguments, Core
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.device.node import DriveNode
from hdbridge.drive.drive import Drive
from hdbridge.drive.link import Link
from hdbridge.enums import Scheme
from hdbridge.sim.lockstep import SimulatedAxis, VirtualClock, simulated_benches
from hdbridge.sim.truth import Truth
from support.characters import FRIENDLY, Character
from support.rude import RudeDrive
from support.spoilt import SpoiltBus

Params = ParamSpec("Params")
Result = TypeVar("Result")

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


class SteppedTiming:
    """Timing in which waiting runs cycles of the loop, and blocking calls run in the same thread."""

    def __init__(self, daemon: SteppedDaemon) -> None:
        self._daemon = daemon
        self.clock: Clock = SteppedClock(daemon)

    async def sleep(self, duration_s: float) -> None:
        end_s = self.clock.now() + duration_s
        await asyncio.sleep(0)
        while self.clock.now() < end_s:
            self._daemon.turn()
            await asyncio.sleep(0)

    async def work(
        self, function: Callable[Params, Result], *args: Params.args, **kwargs: Params.kwargs
    ) -> Result:
        return function(*args, **kwargs)


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
        self.timing = SteppedTiming(self)
        self.samples = memory.reader()
        self._events = memory.event_reader()
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        """Newest events of the loop."""
        self.drives: list[Commissioning] = []
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

    # ---------------------------------------------------------------- state

    @property
    def states(self) -> list[AxisState]:
        return [axis.state for axis in self.axes]

    def motor_counts(self, axis: int = 0) -> int:
        """Returns the true motor position."""
        return self.nodes[axis].firmware.motion.machine.motor_counts

    def sent(self) -> list[tuple[float, int, bytes]]:
        """Returns a list of time, identifier and data of all frames that the loop sends from now on."""
        frames: list[tuple[float, int, bytes]] = []
        self.bus.spy = lambda can_id, data: frames.append((self.clock.now(), can_id, data))
        return frames

    def reported(self, kind: EventKind, axis: int | None = None) -> list[Event]:
        return [each for each in self.events if each.kind is kind and axis in (None, each.axis)]

    # ---------------------------------------------------------------- actions of a service

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

    def use(self, setting: CompensationSetting) -> None:
        """Makes the first axis compensate by a setting."""
        self.done(CommandKind.CHANGE, i=self.memory.settings[0].put(setting.to_json()))

    def commissioning(self, axis: int) -> Commissioning:
        """Returns the service's access to the drive of an axis, over the relay."""
        while len(self.drives) <= axis:
            core = Core(self.memory, self.timing, lease_s=10.0)  # type: ignore[arg-type]
            self.drives.append(Commissioning(self.axes[len(self.drives)].config, core))
        return self.drives[axis]

    def drive(self, axis: int) -> Drive:
        """Returns the service's drive object of an axis."""
        return self.commissioning(axis).drive

    def verify(self, axis: int = 0) -> None:
        """Boots the drive by SDO over the relay, and reports it as verified."""
        self.done(CommandKind.VERIFIED, axis, **self.commissioning(axis).verify())

    def prepare(self, axis: int = 0) -> Arguments:
        """Prepares the drive by SDO for ENABLE; returns the command's fields."""
        return self.commissioning(axis).prepare()

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

    # ---------------------------------------------------------------- disturbances

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


def article_axis(node_id: int, **drive: object) -> AxisConfig:
    """Returns the article's axis with another node id, named ``axis1``, ...; ``drive`` has other changes."""
    axis = AxisConfig.load(PROFILE)
    changed = axis.drive.model_copy(update={"node_id": node_id, **drive})
    return axis.model_copy(update={"drive": changed, "name": f"axis{node_id}"})


def article_axes(count: int = 1) -> list[AxisConfig]:
    """Returns ``count`` axes of one kind on one bus: nodes 1, 2, ..."""
    return [article_axis(node_id) for node_id in range(1, count + 1)]


def compensated(axis: AxisLoop, model: TransmissionModel) -> None:
    """Compensates an axis at rest by a model, with the load loop on."""
    setting = CompensationSetting(model.bound_to(axis.config), Scheme.EXTENDED, load_loop=True)
    axis.follower.use(setting, moving=False)


@contextmanager
def stepped_daemon(
    axes: int | Sequence[AxisConfig] = 1,
    model: TransmissionModel | None = None,
    setup: Callable[[AxisLoop], None] = lambda _: None,
    load_loop: LoadLoopSettings | None = None,
    truth: Path | Truth = PROFILE / "truth.yaml",
    character: Character = FRIENDLY,
    bitrate_bps: int | None = 1_000_000,
) -> Iterator[SteppedDaemon]:
    """Provides a control loop with simulated axes, none verified yet; with the article's model by default.
    ``setup`` changes an axis of each control process before its first cycle.
    """
    configs = [character.of_axis(each) for each in (article_axes(axes) if isinstance(axes, int) else axes)]
    plant = character.of_truth(truth if isinstance(truth, Truth) else Truth.load(truth))
    known = model if model is not None else TransmissionModel.load(PROFILE / "model.yaml")
    channel = f"daemon-{uuid4()}"
    simulated = [
        SimulatedAxis(plant, each.eds_path, each.drive.node_id, seed) for seed, each in enumerate(configs)
    ]
    with ExitStack() as stack:
        if character.rude:
            clock = VirtualClock()
            nodes = [RudeDrive(channel, each, clock) for each in configs]
            for node in nodes:
                stack.callback(node.close)
            clock.nodes += nodes
        else:
            bus, clock, nodes = stack.enter_context(simulated_benches(simulated, channel))
            bus.shutdown()
        intruder = stack.enter_context(VirtualBus(channel))
        spoilt = stack.enter_context(SpoiltBus(channel, clock))
        memory = stack.enter_context(Memory.create(len(configs), configs[0].drive.cycle_s))

        def reopen() -> Link | None:
            return None if spoilt.down is not None else Link(spoilt, clock)

        def begin() -> Controller:
            cycle = BusCycle(Link(spoilt, clock), clock, memory.period_s, bitrate_bps=bitrate_bps)
            controller = Controller(cycle, [(each, load_loop) for each in configs], memory, reopen)
            for axis in controller.axes:
                compensated(axis, known)
                setup(axis)
            return controller

        daemon = SteppedDaemon(begin, memory, clock, spoilt, nodes, intruder)
        yield daemon
        for each in daemon.drives:
            each.close()
