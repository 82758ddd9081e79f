"""Slaves built on third-party CANopen stacks, in simulated time: `durand` and canopen's `LocalNode`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import can
import canopen
from durand.datatypes import DatatypeEnum as DT
from durand.network import NetworkABC
from durand.node import MinimalNode
from durand.object_dictionary import Array, Record, Variable
from durand.scheduler import VirtualScheduler, get_scheduler, set_scheduler

from hdbridge.sim.lockstep import LockstepBus, VirtualClock

NODE_ID = 5


class PolledNetwork(NetworkABC):
    """durand's network over a python-can bus, without a thread."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus
        self.subscriptions: dict[int, Callable[[int, bytes], None]] = {}

    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        self.subscriptions[cob_id] = callback

    def remove_subscription(self, cob_id: int) -> None:
        self.subscriptions.pop(cob_id)

    def send(self, cob_id: int, msg: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=cob_id, data=msg, is_extended_id=False))

    def poll(self) -> None:
        while (message := self.bus.recv(0)) is not None:
            if message.is_remote_frame:
                continue
            callback = self.subscriptions.get(message.arbitration_id)
            if callback is not None:
                callback(message.arbitration_id, bytes(message.data))


class DurandDrive:
    """durand node with the objects of CiA 402 and a minimal state machine."""

    def __init__(self, bus: can.BusABC, clock: Any) -> None:
        self.clock, self.last_s = clock, clock.now()
        self.scheduler = VirtualScheduler()
        set_scheduler(self.scheduler)
        self.network = PolledNetwork(bus)
        self.node = MinimalNode(self.network, NODE_ID)
        self.od = self.node.object_dictionary
        self.state = 0x40
        self._objects()
        self.od.download_callbacks[0x6040, 0].add(self._control)
        self.od.download_callbacks[0x607A, 0].add(self._target)

    def _objects(self) -> None:
        od = self.od
        for index, datatype, access, value in (
            (0x6007, DT.INTEGER16, "rw", 1),
            (0x6040, DT.UNSIGNED16, "rw", 0),
            (0x6041, DT.UNSIGNED16, "ro", 0x40),
            (0x605A, DT.INTEGER16, "rw", 2),
            (0x605D, DT.INTEGER16, "rw", 1),
            (0x6060, DT.INTEGER8, "rw", 0),
            (0x6062, DT.INTEGER32, "ro", 0),
            (0x6064, DT.INTEGER32, "ro", 1234),
            (0x6065, DT.UNSIGNED32, "rw", 0),
            (0x6066, DT.UNSIGNED16, "rw", 0),
            (0x6072, DT.UNSIGNED16, "rw", 0),
            (0x6077, DT.INTEGER16, "ro", 0),
            (0x607A, DT.INTEGER32, "rw", 0),
            (0x6080, DT.UNSIGNED32, "rw", 0),
            (0x6502, DT.UNSIGNED32, "ro", 0x81),
        ):
            od[index] = Variable(datatype, access, value, name=f"Object {index:04X}")
        od[0x6061] = Variable(DT.INTEGER8, "ro", 0, name="Modes of operation display")
        od.set_read_callback(0x6061, 0, lambda: od.read(0x6060, 0))
        limits, cycle = Record(name="Software position limit"), Record(name="Interpolation time period")
        for sub in (1, 2):
            limits[sub] = Variable(DT.INTEGER32, "rw", 0, name=f"Limit {sub}")
        cycle[1] = Variable(DT.UNSIGNED8, "rw", 1, name="Value")
        cycle[2] = Variable(DT.INTEGER8, "rw", -3, name="Index")
        od[0x607D], od[0x60C2] = limits, cycle
        od[0x60E4] = Array(Variable(DT.INTEGER32, "ro", 0, name="Additional position"), length=1)
        od.write(0x1000, 0, 0x0002_0192)
        for sub, value in ((1, 0x4844), (2, 0x402), (3, 0x10000)):
            od.write(0x1018, sub, value)
        od.write(0x60E4, 1, 1234 * 36 // 5)

    def poll(self, _: float = 0.0) -> None:
        now_s = self.clock.now()
        self.scheduler.run(now_s - self.last_s)
        self.last_s = now_s
        self.network.poll()

    def next_event_s(self) -> float:
        return self.last_s + 0.001

    def _control(self, word: int) -> None:
        if not word & 0x02:
            self.state = 0x40
        elif not word & 0x04:
            self.state = 0x07 if self.state in (0x27, 0x07) else 0x40
        else:
            steps = {(0x40, 0x06): 0x21, (0x21, 0x07): 0x23, (0x23, 0x0F): 0x27, (0x27, 0x07): 0x23}
            self.state = steps.get((self.state, word & 0x0F), self.state)
        self.od.write(0x6041, 0, self.state)

    def _target(self, counts: int) -> None:
        if self.state == 0x27:
            self.od.write(0x6062, 0, counts)
            self.od.write(0x6064, 0, counts)
            self.od.write(0x60E4, 1, counts * 36 // 5)


class _Periodic:
    """Periodic message of python-can, timed by the virtual clock."""

    def __init__(self, bus: _PeriodicBus, message: can.Message, period_s: float) -> None:
        self.bus, self.message, self.period_s = bus, message, period_s
        self.due_s = bus.clock.now() + period_s
        bus.tasks.append(self)

    def stop(self) -> None:
        if self in self.bus.tasks:
            self.bus.tasks.remove(self)

    def modify_data(self, message: can.Message) -> None:
        self.message = message


class _PeriodicBus(can.interfaces.virtual.VirtualBus):
    """python-can's virtual bus without threads."""

    def __init__(self, channel: str, clock: VirtualClock) -> None:
        super().__init__(channel)
        self.clock = clock
        self.tasks: list[_Periodic] = []

    def send_periodic(self, msgs: Any, period: float, *args: Any, **options: Any) -> Any:
        return _Periodic(self, msgs, period)


class LocalNodeSlave:
    """Unmodified `LocalNode` of canopen with the EDS of the simulated drive; polling replaces its threads."""

    def __init__(self, channel: str, clock: VirtualClock, eds: Path) -> None:
        self.bus = _PeriodicBus(channel, clock)
        self.network = canopen.Network(self.bus)
        self.node = canopen.LocalNode(NODE_ID, str(eds))
        self.network.add_node(self.node)
        self.node.nmt.state = "PRE-OPERATIONAL"

    def poll(self, now_s: float) -> None:
        listener = self.network.listeners[0]
        while (message := self.bus.recv(0)) is not None:
            listener.on_message_received(message)
        for task in [*self.bus.tasks]:
            if task.due_s <= now_s:
                task.due_s += task.period_s
                self.bus.send(task.message)

    def next_event_s(self) -> float:
        return min((task.due_s for task in self.bus.tasks), default=float("inf"))


@contextmanager
def local_node(eds: Path) -> Iterator[LockstepBus]:
    """Provides the master's bus with canopen's `LocalNode` on it."""
    channel, clock = f"foreign-{uuid4()}", VirtualClock()
    slave = LocalNodeSlave(channel, clock, eds)
    clock.nodes.append(slave)
    with slave.bus, LockstepBus(channel, clock) as bus:
        yield bus


@contextmanager
def durand_drive() -> Iterator[tuple[LockstepBus, DurandDrive]]:
    """Provides the master's bus with the durand drive on it, and that drive."""
    channel, clock, before = f"foreign-{uuid4()}", VirtualClock(), get_scheduler()
    with (
        can.Bus(interface="virtual", channel=channel, ignore_config=True) as own,
        LockstepBus(channel, clock) as bus,
    ):
        drive = DurandDrive(own, clock)
        clock.nodes.append(drive)
        yield bus, drive
    set_scheduler(before)
