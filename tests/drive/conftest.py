"""Fixtures for the tests of the master: an axis description, and a drive with a motor without physics."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import can
import pytest
import yaml
from support.ideal_motor import IdealMotor
from support.keys import with_keys
from support.spoilt import SpoiltBus

from hdbridge.axis import AxisConfig
from hdbridge.canframe import DataFrame
from hdbridge.device.node import DriveNode
from hdbridge.drive import State, load_eds
from hdbridge.drive.states import decode
from hdbridge.sim.lockstep import VirtualClock, lockstep_bench

EDS = Path(__file__).parents[2] / "eds" / "hdbridge-402.eds"

AXIS: dict[str, Any] = {
    "schema": "hdbridge.axis/1",
    "name": "test",
    "bus": {"interface": "virtual", "channel": "test"},
    "drive": {
        "node_id": 1,
        "eds": "hdbridge-402.eds",
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
    return AxisConfig.from_text(yaml.safe_dump(with_keys(AXIS, changes)), EDS.parent / "axis.yaml")


Answers = Callable[[bytes], list[bytes] | None]
"""Answers to an SDO request in place of the drive, or None to leave it to the drive."""


class Values:
    """Values of the drive's objects."""

    def __init__(self, node: DriveNode) -> None:
        self._dictionary = node.dictionary

    def __getitem__(self, key: tuple[int, int]) -> int:
        return self._dictionary.value(*key)

    def __setitem__(self, key: tuple[int, int], value: int | bytes) -> None:
        entry = self._dictionary[key]
        entry.bound = None
        entry.value = entry.default = value  # a reset of the drive restores the default


class Slave:
    """Simulated drive; a test may ignore commands and answer SDO requests in its place.

    It is the bus of the drive's node. `scripts` has the answers to the requests of one object.
    """

    def __init__(self, node: DriveNode, motor: IdealMotor) -> None:
        self.node, self.motor, self.od = node, motor, load_eds(EDS, node.node_id)
        self.values = Values(node)
        self.scripts: dict[tuple[int, int], Answers] = {}
        self.sdo: Answers = self.scripted
        self.obeys: Callable[[int], bool] = lambda command: True
        """Returns False for an NMT command that the drive does not receive."""
        self.sends: Callable[[DataFrame], bool] = lambda message: True
        """Returns False for a frame of the drive that is lost."""
        self.sdo_order: list[tuple[int, int, int]] = []
        """Index, sub-index and value of the expedited downloads."""
        self.controlwords: list[int] = []
        self._bus, node.bus = node.bus, self  # type: ignore[assignment]

    def send(self, message: DataFrame) -> None:
        if self.sends(message):
            self._bus.send(message)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        while (message := self._bus.recv(timeout)) is not None:
            data = bytes(message.data)
            if message.arbitration_id == 0x600 + self.node.node_id:
                answers = self.sdo(data)
                if answers is None:
                    return message
                for each in answers:
                    self.say(0x580, each)
            elif message.arbitration_id != 0 or self.obeys(data[0]):
                return message
        return None

    def say(self, function: int, data: bytes) -> None:
        """Sends a frame with an identifier of the drive, whatever the drive itself does."""
        self._bus.send(DataFrame(function + self.node.node_id, data))

    def scripted(self, request: bytes) -> list[bytes] | None:
        """Answers a request by `scripts`."""
        key, command = (int.from_bytes(request[1:3], "little"), request[3]), request[0] >> 5
        if command == 1 and request[0] & 2:
            value = int.from_bytes(request[4 : 8 - (request[0] >> 2 & 3)], "little")
            self.sdo_order.append((*key, value))
            if key == (0x6040, 0):
                self.controlwords.append(value)
        return self.scripts[key](request) if key in self.scripts and command in (1, 2) else None

    @property
    def state(self) -> State:
        return decode(self.node.firmware.statusword())

    @property
    def position(self) -> int:
        return self.node.firmware.motion.actual_position()

    @property
    def nmt_state(self) -> int:
        return int(self.node.nmt)

    def enable(self) -> None:
        """Switches power on, as another master may have done."""
        for word in (0x06, 0x07, 0x0F):
            self.node.firmware.control(word)

    def fail(self, code: int = 0x8611) -> None:
        """Puts the drive into fault, with an EMCY."""
        self.node.faults.raise_error(code)
        self.node.poll(self.node.now_s)


def holding(value: int) -> Answers:
    """Returns a script of an object that keeps this value but accepts any other."""

    def answer(request: bytes) -> list[bytes]:
        if request[0] >> 5 == 2:
            return [b"\x43" + request[1:4] + value.to_bytes(4, "little", signed=value < 0)]
        return [b"\x60" + request[1:4] + bytes(4)]

    return answer


class Later:
    """Acts once, at a time of the clock."""

    def __init__(self, clock: VirtualClock, at_s: float, act: Callable[[], object]) -> None:
        self._at_s, self._act = at_s, act
        clock.nodes.append(self)

    def next_event_s(self) -> float:
        return self._at_s

    def poll(self, now_s: float) -> None:
        if now_s >= self._at_s:
            self._at_s = float("inf")
            self._act()


@pytest.fixture
def axis() -> AxisConfig:
    return make_axis()


@pytest.fixture(scope="session")
def build_axis() -> Callable[..., AxisConfig]:
    return make_axis


@pytest.fixture
def channel() -> str:
    return f"test-{uuid4()}"


@pytest.fixture
def bench(channel: str) -> Iterator[tuple[SpoiltBus, VirtualClock, Slave]]:
    motor = IdealMotor(1000)
    with lockstep_bench(motor, EDS, channel=channel) as (own, clock, node):
        own.shutdown()
        with SpoiltBus(channel, clock) as bus:
            bus.channel_info = f"virtual:{channel}"
            yield bus, clock, Slave(node, motor)


@pytest.fixture
def bus(bench: tuple[SpoiltBus, VirtualClock, Slave]) -> SpoiltBus:
    """The master's end of the bus."""
    return bench[0]


@pytest.fixture
def clock(bench: tuple[SpoiltBus, VirtualClock, Slave]) -> VirtualClock:
    return bench[1]


@pytest.fixture
def slave(bench: tuple[SpoiltBus, VirtualClock, Slave]) -> Slave:
    return bench[2]


@pytest.fixture
def sent(bus: SpoiltBus) -> list[tuple[int, bytes]]:
    """Identifier and data of the frames that the master sends."""
    frames: list[tuple[int, bytes]] = []
    bus.spy = lambda can_id, data: frames.append((can_id, data))
    return frames
