"""A bench without real time: master and simulated drives in one thread, on one virtual clock.

The master talks through ``LockstepBus`` and sleeps on ``VirtualClock``. Its sending and waiting is what lets
the drives run: a frame it sends is answered before ``send`` returns, and time passes only while it waits,
from one event of a drive to the next. So nothing sleeps, nothing races, and the same run gives the same
frames. The frames themselves are real: python-can messages over python-can ``virtual`` buses.
"""

from __future__ import annotations

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
from hdbridge.errors import InputError
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

LONGEST_WAIT_S: Final = 3600.0
"""Virtual time after which a ``recv`` without a time-out gives up."""


class Node(Protocol):
    """A bus participant that runs when it is polled."""

    def poll(self, now_s: float) -> None:
        """Take in what has come, and do what is due until ``now_s``."""
        ...

    def next_event_s(self) -> float:
        """When it must be polled at the latest."""
        ...


class VirtualClock:
    """A ``hdbridge.clock.Clock`` that moves when somebody waits on it, and lets the nodes run on the way."""

    def __init__(self, start_s: float = 0.0) -> None:
        self.now_s = start_s
        """Virtual seconds."""
        self.nodes: list[Node] = []

    def now(self) -> float:
        """Virtual seconds."""
        return self.now_s

    def sleep_until(self, deadline_s: float) -> None:
        """Advance to ``deadline_s``, through every event of a node that comes before it."""
        while self.step(deadline_s):
            pass

    def step(self, deadline_s: float) -> bool:
        """Advance to the next event of a node or to ``deadline_s``, and let the nodes run.

        False, and nothing happened but the clock's advance, when no event comes before the deadline.
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
    """A queue on which nobody waits: to put something in needs no lock, and wakes nobody."""

    def put(self, item: can.Message, block: bool = True, timeout: float | None = None) -> None:
        self.queue.append(item)


class _PolledBus(VirtualBus):
    """python-can's virtual bus, polled by one thread, with less overhead for each frame.

    The general ``recv`` reads the wall clock and takes two locks, though in lockstep most polls find nothing;
    the general ``send`` makes a deep copy and takes another. Ordinary virtual buses on the same channel work
    with it. It never waits, whatever time-out ``recv`` is given.
    """

    def __init__(self, channel: str) -> None:
        super().__init__(channel)
        with channels_lock:
            place = self.channel.index(self.queue)
            self.channel[place] = self.queue = _PolledQueue()
        self._waiting = self.queue.queue
        self._met: list[Queue[can.Message]] = []
        """The queues on the channel when it was last looked at."""
        self._puts: list[Callable[[can.Message], None]] = []
        """What gives a frame to each of the others there."""

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
        """Somebody has joined or left."""
        self._met = list(self.channel)
        self._puts = [
            # Nobody here changes it: one for all. Others get a copy each.
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
    """The master's end of a virtual channel whose other participants run in ``clock.nodes``.

    ``recv`` is overridden as a whole, because that of the base class measures its time-out by the wall clock.
    """

    def __init__(self, channel: str, clock: VirtualClock, **kwargs: Any) -> None:
        self._inner = _PolledBus(channel)
        self._waiting = self._inner.queue.queue
        self._clock = clock
        super().__init__(channel=channel, **kwargs)
        self.private = False
        """Nobody but the master and the drives of the clock knows the channel."""
        self.channel_info = "the simulated bus"

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send, and let every node take it in and answer."""
        self._inner.send(msg, timeout)
        clock = self._clock
        now_s = clock.now_s
        for node in clock.nodes:
            node.poll(now_s)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame; while there is none, time passes up to ``timeout`` virtual seconds.

        Raises CanOperationError after ``LONGEST_WAIT_S`` without a frame where no time-out is given.
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
            for node in clock.nodes:  # somebody else on the channel may have sent to them
                node.poll(deadline_s)
            message = self._take()
        if message is None and timeout is None:
            raise can.CanOperationError(f"no frame in {LONGEST_WAIT_S:g} s of virtual time")
        return message

    def _take(self) -> can.Message | None:
        """The next frame that has come already."""
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
        """Leave the channel."""
        super().shutdown()
        self._inner.shutdown()


@contextmanager
def _unsearched() -> Iterator[None]:
    """The garbage collector leaves out what has been loaded by now.

    The samples of a long run make it search everything again and again: 160,000 objects of the libraries take
    it as long as 1000 control cycles.
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
) -> Iterator[tuple[LockstepBus, VirtualClock, DriveNode]]:
    """A simulated drive that moves ``machine``, and the master's bus and clock to it.

    The drive has been switched on, and its boot-up message sent, before the master joins the bus.
    ``channel`` names the python-can virtual channel (by default one of its own), so that a test may listen
    or interfere there. ``others`` are further nodes to be polled.
    """
    private = channel is None
    channel = channel or f"hdbridge-{uuid4()}"
    clock = VirtualClock()
    with _unsearched(), _PolledBus(channel) as node_bus:
        node = DriveNode(node_bus, machine, eds_path, node_id, clock, nameplate, behaviour)
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
    """The simulated axis of a truth file on a bench; the same truth and seed give the same frames.

    ``load_object`` is the index and sub-index from which its load encoder is read.
    """
    known = truth if isinstance(truth, Truth) else Truth.load(Path(truth))
    machine = Machine(known, seed, may_compile=True)
    nameplate, behaviour = nameplate_of(known, load_object=load_object), known.firmware
    with lockstep_bench(machine, eds_path, node_id, channel, nameplate, behaviour=behaviour) as bench:
        yield bench


@dataclass(frozen=True)
class SimulatedAxis:
    """One simulated axis of several on a bus."""

    truth: Truth | Path | str
    """What moves, or the truth file that says so."""
    eds_path: Path
    node_id: int
    seed: int = 0
    load_object: tuple[int, int] = LOAD_OBJECT


@contextmanager
def simulated_benches(
    axes: Sequence[SimulatedAxis], channel: str | None = None, clock: VirtualClock | None = None
) -> Iterator[tuple[LockstepBus, VirtualClock, tuple[DriveNode, ...]]]:
    """Several simulated axes on one bus and one clock, and the master's bus to them; as `lockstep_bench`.

    The same axes give the same frames, whatever the others do: each has its own noise. ``clock`` is by
    default one that begins at zero. InputError where two have the same node id.
    """
    node_ids = [axis.node_id for axis in axes]
    twice = next((node_id for node_id in node_ids if node_ids.count(node_id) > 1), None)
    if twice is not None:
        raise InputError(f"two simulated drives are node {twice}; give each a node id of its own")
    private = channel is None
    channel = channel or f"hdbridge-{uuid4()}"
    may_compile = clock is None  # another clock may be tied to real time
    clock = clock if clock is not None else VirtualClock()
    with ExitStack() as stack:
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
    """What a drive that controls this axis says of itself."""
    # The drive knows the ratio that the gear was sold with, not by how little the real one is off.
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
