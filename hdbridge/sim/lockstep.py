"""Simulated bench without real time: master and simulated drives in one thread, on one virtual clock.

The master uses ``LockstepBus`` and sleeps on ``VirtualClock``. The drives run whenever the master sends or
waits: every frame is answered before ``send`` returns, and time passes only while the master waits, from one
drive event to the next. Nothing really sleeps, there are no races, and the same run always has the same
frames. The frames are real python-can messages over python-can ``virtual`` buses.
"""

import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from queue import Queue
from typing import Any, Final, Protocol
from uuid import uuid4

import can
from can.interfaces.virtual import VirtualBus, channels_lock

from hdbridge.canframe import DataFrame
from hdbridge.device.behaviour import Behaviour
from hdbridge.device.motion import Machine as AnyMachine
from hdbridge.device.nameplate import LOAD_OBJECT, Nameplate
from hdbridge.device.node import DriveNode
from hdbridge.device.powerstate import PowerStage
from hdbridge.errors import InputError
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

LONGEST_WAIT_S: Final = 3600.0
"""Virtual time after which a ``recv`` without a time-out raises an error; s."""


class Node(Protocol):
    """Bus participant that runs when polled."""

    def poll(self, now_s: float) -> None:
        """Processes received frames and everything that is due until ``now_s``."""
        ...

    def next_event_s(self) -> float:
        """Returns the time by which the next poll must take place."""
        ...


class VirtualClock:
    """``hdbridge.clock.Clock`` that advances only during a wait, and runs the nodes meanwhile."""

    def __init__(self, start_s: float = 0.0) -> None:
        self.now_s = start_s
        """Virtual time in seconds."""
        self.nodes: list[Node] = []

    def now(self) -> float:
        """Returns the virtual time in seconds."""
        return self.now_s

    def sleep_until(self, deadline_s: float) -> None:
        """Advances to ``deadline_s``, processing every earlier event of a node."""
        while self.step(deadline_s):
            pass

    def step(self, deadline_s: float) -> bool:
        """Advances to the next event of a node or to ``deadline_s``, and polls the nodes.

        Returns False if no event comes before the deadline; then only the clock advances.
        """
        until_s, happens = deadline_s, False
        for node in self.nodes:
            due_s = node.next_event_s()
            if due_s <= until_s:
                until_s, happens = due_s, True
        if until_s > self.now_s:  # noqa: PLR1730 - max() costs three times as much, twice a cycle
            self.now_s = until_s
        if happens:
            for node in self.nodes:
                node.poll(self.now_s)
        return happens


class _PolledQueue(Queue[can.Message]):
    """Queue without waiting readers, so that adding an item needs no lock or wake-up."""

    def put(self, item: can.Message, block: bool = True, timeout: float | None = None) -> None:
        self.queue.append(item)


class _PolledBus(VirtualBus):
    """Virtual bus of python-can, polled by one thread, with less overhead per frame.

    The inherited ``recv`` reads the wall clock and takes two locks, although in lockstep most polls find
    nothing; the inherited ``send`` makes a deep copy and takes another lock. This bus works together with
    ordinary virtual buses on the same channel. It never waits, whatever the time-out of ``recv``.
    """

    def __init__(self, channel: str) -> None:
        super().__init__(channel)
        with channels_lock:
            place = self.channel.index(self.queue)
            self.channel[place] = self.queue = _PolledQueue()
        self._waiting = self.queue.queue
        self._met: list[Queue[can.Message]] = []
        """Queues on the channel at the last `_meet`."""
        self._puts: list[Callable[[can.Message], None]] = []
        """Functions that deliver a frame to each of the other queues."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if type(msg) is not DataFrame:
            if not _is_plain(msg):
                super().send(msg, timeout)
                return
            msg = DataFrame(msg.arbitration_id, msg.data, self.channel_id)
        if self.channel != self._met:
            self._meet()
        for put in self._puts:
            put(msg)

    def _meet(self) -> None:
        """Updates the receivers after a bus has joined or left."""
        self._met = list(self.channel)
        self._puts = [
            # Polled queues never modify a message and share it; others get a copy each.
            each.queue.append if type(each) is _PolledQueue else partial(self._put_copy, each)
            for each in self._met
            if each is not self.queue
        ]

    def _put_copy(self, queue: Queue[can.Message], msg: can.Message) -> None:
        queue.put(DataFrame(msg.arbitration_id, msg.data, self.channel_id))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        waiting = self._waiting
        while waiting:
            message: can.Message = waiting.popleft()
            if self._filters is None or self._matches_filters(message):
                return message
        return None


class LockstepBus(can.BusABC):
    """Master's end of a virtual channel; its other participants are run by the clock (``clock.nodes``).

    ``recv`` is overridden as a whole, because that of the base class measures its time-out by the wall clock.
    """

    def __init__(self, channel: str, clock: VirtualClock, **kwargs: Any) -> None:
        self._inner = _PolledBus(channel)
        self._waiting = self._inner.queue.queue
        self._clock = clock
        super().__init__(channel=channel, **kwargs)
        self.private = False
        """True if only the master and the clock's nodes know the channel."""
        self.channel_info = "the simulated bus"

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Sends a frame; every node receives and answers it before this returns."""
        self._inner.send(msg, timeout)
        clock = self._clock
        now_s = clock.now_s
        for node in clock.nodes:
            node.poll(now_s)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Returns the next frame; waits up to ``timeout`` virtual seconds for it.

        Raises CanOperationError after ``LONGEST_WAIT_S`` without a frame if no time-out is given.
        """
        clock = self._clock
        if self._waiting and (message := self._take()) is not None:
            return message
        deadline_s = clock.now_s + (LONGEST_WAIT_S if timeout is None else timeout)
        while clock.step(deadline_s):
            if self._waiting and (message := self._take()) is not None:
                return message
        message = None
        if not (self.private and len(clock.nodes) == 1):
            for node in clock.nodes:  # another bus on the channel may have sent to them
                node.poll(deadline_s)
            message = self._take()
        if message is None and timeout is None:
            raise can.CanOperationError(f"no frame in {LONGEST_WAIT_S:g} s of virtual time")
        return message

    def _take(self) -> can.Message | None:
        """Returns the next frame that has already arrived."""
        waiting = self._waiting
        while waiting:
            message: can.Message = waiting.popleft()
            if self._filters is None or self._matches_filters(message):
                message.timestamp = self._clock.now_s
                return message
        return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True

    def shutdown(self) -> None:
        """Leaves the channel."""
        super().shutdown()
        self._inner.shutdown()


@contextmanager
def _unsearched() -> Iterator[None]:
    """Excludes everything loaded so far from garbage collection.

    The samples of a long run trigger repeated collections, and a search of the libraries' 160,000 objects
    takes as long as 1000 control cycles.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _is_plain(msg: can.Message) -> bool:
    return not (msg.is_extended_id or msg.is_remote_frame or msg.is_error_frame or msg.is_fd)


@contextmanager
def lockstep_bench(
    machine: AnyMachine,
    eds_path: Path,
    node_id: int = 1,
    channel: str | None = None,
    nameplate: Nameplate | None = None,
    others: Sequence[Node] = (),
    behaviour: Behaviour | None = None,
    stage: PowerStage | None = None,
) -> Iterator[tuple[LockstepBus, VirtualClock, DriveNode]]:
    """Provides a simulated drive that moves ``machine``, with the master's bus and clock.

    The drive is switched on, and its boot-up message sent, before the master joins the bus. ``channel``
    names the python-can virtual channel (a private one by default), so that a test may listen or interfere
    there. ``others`` are further nodes to poll.
    """
    private = channel is None
    channel = channel or f"hdbridge-{uuid4()}"
    clock = VirtualClock()
    with _unsearched(), _PolledBus(channel) as node_bus:
        node = DriveNode(node_bus, machine, eds_path, node_id, clock, nameplate, behaviour, stage)
        node.poll(clock.now())
        clock.nodes += [node, *others]
        with LockstepBus(channel, clock) as bus:
            bus.private = private
            yield bus, clock, node


@contextmanager
def simulated_bench(
    truth: Truth | Path | str,
    eds_path: Path,
    node_id: int = 1,
    seed: int = 0,
    channel: str | None = None,
    load_object: tuple[int, int] = LOAD_OBJECT,
) -> Iterator[tuple[LockstepBus, VirtualClock, DriveNode]]:
    """Provides the simulated axis of a truth file; the same truth and seed yield the same frames.

    ``load_object`` is the index and sub-index of the load encoder.
    """
    axis = SimulatedAxis(truth, eds_path, node_id, seed, load_object)
    with simulated_benches([axis], channel) as (bus, clock, (node,)):
        yield bus, clock, node


@dataclass(frozen=True)
class SimulatedAxis:
    """One of several simulated axes on a bus."""

    truth: Truth | Path | str
    """Truth, or the path of its file."""
    eds_path: Path
    node_id: int
    seed: int = 0
    load_object: tuple[int, int] = LOAD_OBJECT


@contextmanager
def simulated_benches(
    axes: Sequence[SimulatedAxis], channel: str | None = None, clock: VirtualClock | None = None
) -> Iterator[tuple[LockstepBus, VirtualClock, tuple[DriveNode, ...]]]:
    """Provides several simulated axes on one bus and one clock, with the master's bus; see `lockstep_bench`.

    Each axis has its own noise, so the same axis yields the same frames, whatever the other axes do.
    ``clock`` starts at zero by default. Raises InputError if two axes have the same node id.
    """
    node_ids = [axis.node_id for axis in axes]
    twice = next((node_id for node_id in node_ids if node_ids.count(node_id) > 1), None)
    if twice is not None:
        raise InputError(f"two simulated drives are node {twice}; give each a node id of its own")
    private = channel is None
    channel = channel or f"hdbridge-{uuid4()}"
    may_compile = clock is None  # a clock of the caller may be tied to real time
    clock = clock if clock is not None else VirtualClock()
    with ExitStack() as stack:
        if may_compile:
            stack.enter_context(_unsearched())
        for serial, axis in enumerate(axes, start=1):
            known = axis.truth if isinstance(axis.truth, Truth) else Truth.load(Path(axis.truth))
            node_bus = stack.enter_context(_PolledBus(channel))
            node = DriveNode(
                node_bus,
                Machine(known, axis.seed, may_compile=may_compile),
                axis.eds_path,
                axis.node_id,
                clock,
                nameplate_of(known, serial, axis.load_object),
                known.firmware,
            )
            node.poll(clock.now())
            clock.nodes.append(node)
        bus = stack.enter_context(LockstepBus(channel, clock))
        bus.private = private
        yield bus, clock, tuple(node for node in clock.nodes if isinstance(node, DriveNode))


def nameplate_of(truth: Truth, serial: int = 1, load_object: tuple[int, int] = LOAD_OBJECT) -> Nameplate:
    """Returns the nameplate of a drive that controls this axis."""
    # The drive knows the nominal ratio of the gear, not the small deviation of the real one.
    ratio = Fraction(truth.gear.ratio).limit_denominator(100)
    return Nameplate(
        serial=serial,
        motor_counts_per_turn=truth.motor.encoder.counts_per_turn,
        load_counts_per_turn=truth.load_.encoder.counts_per_turn,
        gear_motor_turns=ratio.numerator,
        gear_load_turns=ratio.denominator,
        rated_torque_mnm=round(1000.0 * truth.motor.rated_torque_nm),
        load_object=load_object,
    )
