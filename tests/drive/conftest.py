"""Shared by the tests of the master: an axis description, and a bus whose peers answer in lockstep."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any
from uuid import uuid4

import can
import pytest

from hdbridge.axis import AxisConfig

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
    """The axis above; ``changes`` are dotted names, with two underscores for the dot."""
    content = deepcopy(AXIS)
    for name, value in changes.items():
        *parents, last = name.split("__")
        target = content
        for parent in parents:
            target = target.setdefault(parent, {})
        target[last] = value
    return AxisConfig.model_validate(content)


class SteppedClock:
    """A clock that only moves when it is told to."""

    def __init__(self) -> None:
        self.time_s = 0.0

    def now(self) -> float:
        return self.time_s

    def sleep_until(self, deadline_s: float) -> None:
        self.time_s = max(self.time_s, deadline_s)


class PeerBus(can.BusABC):
    """The master's end of a virtual channel: peers answer whenever the master sends or waits.

    Single-threaded. A peer is called with nothing and reads and writes a virtual bus of its own. Waiting
    advances the clock, in steps of ``step_s``, until something has come.
    """

    step_s = 0.001

    def __init__(self, clock: SteppedClock, channel: str) -> None:
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


@pytest.fixture
def build_axis() -> Callable[..., AxisConfig]:
    return make_axis


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def channel() -> str:
    return f"test-{uuid4()}"


@pytest.fixture
def bus(clock: SteppedClock, channel: str) -> Iterator[PeerBus]:
    with PeerBus(clock, channel) as bus:
        yield bus


@pytest.fixture
def peer_bus(bus: PeerBus, channel: str) -> Iterator[can.BusABC]:
    """The other end of the master's channel."""
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as peer:
        yield peer
