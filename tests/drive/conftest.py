"""Fixtures for the tests of the master: an axis description, and a bus whose peers answer in lockstep."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import can
import pytest
from support.keys import with_keys

from hdbridge.axis import AxisConfig
from hdbridge.drive import load_eds
from hdbridge.sim.lockstep import VirtualClock

AXIS: dict[str, Any] = {
    "schema": "hdbridge.axis/1",
    "name": "test",
    "bus": {"interface": "virtual", "channel": "test"},
    "drive": {
        "node_id": 1,
        "eds": "none.eds",
        "identity": {"vendor_id": 0x4844, "product_code": 0x402, "revision": 0x10000},
        "cycle_ms": 4,
        "heartbeat_ms": 50,
        "following_error_deg": 5.0,
        "rated_torque_nm": 0.32,
    },
    "motor_encoder": {"counts_per_turn": 8000},
    "load_encoder": {"counts_per_turn": 2_880_000},
    "gear": {"ratio": 50},
    "limits": {
        "position_min_deg": -400,
        "position_max_deg": 400,
        "velocity_deg_s": 20,
        "acceleration_deg_s2": 200,
        "jerk_deg_s3": 4000,
        "torque_percent": 100,
    },
}


def make_axis(**changes: Any) -> AxisConfig:
    """Returns the axis above with changes: keys are dotted names with two underscores for each dot."""
    return AxisConfig.model_validate(with_keys(AXIS, changes))


class PeerBus(can.BusABC):
    """The master's end of a virtual channel: peers answer whenever the master sends or waits.

    Single-threaded. A peer is called without arguments and reads and writes a virtual bus of its own. Waiting
    advances the clock, in steps of ``step_s``, until something has come.
    """

    step_s = 0.001

    def __init__(self, clock: VirtualClock, channel: str) -> None:
        self._inner = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        self._clock = clock
        self.peers: list[Callable[[], None]] = []
        self.sent: list[can.Message] = []
        self.refuse: Exception | None = None
        super().__init__(channel=channel)
        self.channel_info = f"virtual:{channel}"

    def _poll(self) -> None:
        for peer in self.peers:
            peer()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.refuse is not None:
            raise self.refuse
        self.sent.append(msg)
        self._inner.send(msg)
        self._poll()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.refuse is not None:
            raise self.refuse
        assert timeout is not None, "the master never waits for ever"
        deadline_s = self._clock.now() + timeout
        while True:
            self._poll()
            message = self._inner.recv(0)
            if message is not None:
                return message, False
            if self._clock.now() >= deadline_s:
                return None, False
            self._clock.sleep_until(min(self._clock.now() + self.step_s, deadline_s))

    def shutdown(self) -> None:
        super().shutdown()
        self._inner.shutdown()


@pytest.fixture
def axis() -> AxisConfig:
    return make_axis()


@pytest.fixture(scope="session")
def build_axis() -> Callable[..., AxisConfig]:
    return make_axis


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def channel() -> str:
    return f"test-{uuid4()}"


@pytest.fixture
def bus(clock: VirtualClock, channel: str) -> Iterator[PeerBus]:
    with PeerBus(clock, channel) as bus:
        yield bus


@pytest.fixture
def peer_bus(bus: PeerBus, channel: str) -> Iterator[can.BusABC]:
    """The other end of the master's channel."""
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as peer:
        yield peer


class TinyDrive:
    """A minimal CiA-402 node: SDO server, NMT, heartbeat, states, PP and HM. No PDOs.

    Its objects are those of the EDS. `scripts` replaces the answer to one object: a function from the request
    to the frames that are sent back. `stuck` objects take no value; `silent` answers nothing at all.
    """

    def __init__(self, bus: can.BusABC, clock: VirtualClock, node_id: int = 1) -> None:
        self.bus, self.clock, self.node_id = bus, clock, node_id
        self.od = load_eds(EDS, node_id)
        self.values: dict[tuple[int, int], int | bytes] = {}
        for entry in self.od.values():
            for variable in [entry] if hasattr(entry, "data_type") else entry.subindices.values():
                default = variable.default
                self.values[variable.index, variable.subindex] = (
                    default.encode() if isinstance(default, str) else default or 0
                )
        self.scripts: dict[tuple[int, int], Callable[[bytes], list[bytes]]] = {}
        self.stuck: set[tuple[int, int]] = set()
        self.silent = False
        self.nmt_state = 127
        self.heartbeat_due_s = 0.0
        self.state = 0x40
        self.bits = 0
        self.controlword = 0
        self.controlwords: list[int] = []
        self.position = 1000.0
        self.goal: float | None = None
        self.blocked = False
        self.fault_persists = False
        self.sdo_order: list[tuple[int, int, int]] = []
        self.moved_s = 0.0
        self.heartbeats_heard = 0

    def __call__(self) -> None:
        self._move()
        while (message := self.bus.recv(0)) is not None:
            if self.silent:
                continue
            data = bytes(message.data)
            if message.arbitration_id == 0 and data[1] == self.node_id:
                self.nmt(data[0])
            elif message.arbitration_id == 0x600 + self.node_id:
                self.sdo(data)
            elif message.arbitration_id == 0x77F:
                self.heartbeats_heard += 1
        period_s = int(self.values[0x1017, 0]) / 1000
        if period_s and not self.silent and self.clock.now() >= self.heartbeat_due_s:
            self.heartbeat_due_s = self.clock.now() + period_s
            self.send(0x700, bytes((self.nmt_state,)))

    def send(self, function: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=function + self.node_id, data=data, is_extended_id=False))

    def fail(self, code: int = 0x8611) -> None:
        self.state = 0x08
        self.values[0x603F, 0] = code
        self.send(0x080, code.to_bytes(2, "little") + b"\x21\0\0\0\0\0")

    def nmt(self, command: int) -> None:
        if command == 0x82:
            self.send(0x700, b"\x00")
        self.nmt_state = {0x01: 5, 0x02: 4}.get(command, 127)
        if self.values[0x1017, 0]:
            self.send(0x700, bytes((self.nmt_state,)))

    def _move(self) -> None:
        dt_s, self.moved_s = self.clock.now() - self.moved_s, self.clock.now()
        if self.goal is None or self.blocked or self.state != 0x27:
            return
        step = int(self.values[0x6081, 0]) * dt_s
        left = self.goal - self.position
        if abs(left) > step:
            self.position += step if left > 0 else -step
            return
        self.position, self.goal = self.goal, None
        self.bits |= 0x0400

    def control(self, word: int) -> None:
        self.controlwords.append(word)
        rising, self.controlword = word & ~self.controlword, word
        if self.state == 0x08:
            if rising & 0x80 and not self.fault_persists:
                self.state = 0x40
            return
        if not word & 0x02:
            self.state = 0x40
        elif not word & 0x04:
            self.state = 0x07 if self.state in (0x27, 0x07) else 0x40
        elif self.state == 0x07:
            pass
        elif word & 0x0F == 0x06:
            self.state = 0x21
        elif word & 0x0F == 0x07 and self.state in (0x21, 0x27):
            self.state = 0x23
        elif word & 0x0F == 0x0F and self.state == 0x23:
            self.state = 0x27
        mode = self.values[0x6060, 0]
        if self.state != 0x27:
            self.bits, self.goal = 0, None
        elif mode == 1:
            if rising & 0x10:
                self.goal = float(int(self.values[0x607A, 0]))
                self.bits = 0x1000
            elif not word & 0x10:
                self.bits &= ~0x1000
            if word & 0x0100:
                self.goal = None
        elif mode == 6 and rising & 0x10:
            self.position = float(int(self.values[0x607C, 0]))
            self.bits = 0x1400 if not self.blocked else 0x2000

    def value(self, key: tuple[int, int]) -> int | bytes:
        if key == (0x6041, 0):
            return self.state | self.bits
        if key in ((0x6064, 0), (0x6062, 0)):
            return round(self.position)
        if key == (0x60E4, 1):
            return round(self.position) * 36 // 5
        if key == (0x6061, 0):
            return self.values[0x6060, 0]
        return self.values[key]

    def sdo(self, request: bytes) -> None:
        index, sub = int.from_bytes(request[1:3], "little"), request[3]
        command = request[0] >> 5
        if (index, sub) in self.scripts and command in (1, 2):
            for answer in self.scripts[index, sub](request):
                self.send(0x580, answer)
        elif command == 4:
            return
        elif command in (1, 2) and (index, sub) not in self.values:
            self.send(0x580, bytes((0x80, *request[1:4])) + (0x06020000).to_bytes(4, "little"))
        elif command == 2:
            self._upload(request[1:4], self.value((index, sub)), (index, sub))
        elif command == 3:
            self._segment(request[0] & 0x10)
        else:
            size = 4 - (request[0] >> 2 & 3)
            signed = self.od.get_variable(index, sub).data_type in (2, 3, 4)
            value = int.from_bytes(request[4 : 4 + size], "little", signed=signed)
            self.sdo_order.append((index, sub, value))
            if (index, sub) == (0x6040, 0):
                self.control(value)
            elif (index, sub) not in self.stuck:
                self.values[index, sub] = value
            self.send(0x580, b"\x60" + request[1:4] + bytes(4))

    def _upload(self, address: bytes, value: int | bytes, key: tuple[int, int]) -> None:
        if isinstance(value, bytes):
            self.rest = value
            self.send(0x580, b"\x41" + address + len(value).to_bytes(4, "little"))
            return
        variable = self.od.get_variable(*key)
        size = len(variable) // 8
        data = (value % (1 << 8 * size)).to_bytes(4, "little")
        self.send(0x580, bytes((0x43 | (4 - size) << 2,)) + address + data)

    def _segment(self, toggle: int) -> None:
        chunk, self.rest = self.rest[:7], self.rest[7:]
        self.send(0x580, bytes((toggle | (7 - len(chunk)) << 1 | (not self.rest),)) + chunk.ljust(7, b"\0"))


EDS = Path(__file__).parents[2] / "eds" / "hdbridge-402.eds"


@pytest.fixture
def tiny(bus: PeerBus, peer_bus: can.BusABC, clock: VirtualClock) -> TinyDrive:
    """A scripted drive at the other end of ``bus``."""
    drive = TinyDrive(peer_bus, clock)
    bus.peers.append(drive)
    return drive
