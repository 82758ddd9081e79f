"""Shared by the tests of the master: an axis description, and a bus whose peers answer in lockstep."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import can
import pytest


def encoder(counts_per_turn: int, direction: int = 1, **extra: Any) -> SimpleNamespace:
    per_deg = direction * counts_per_turn / 360.0
    return SimpleNamespace(
        counts_per_turn=counts_per_turn,
        direction=direction,
        counts=lambda deg: deg * per_deg,
        degrees=lambda counts: counts / per_deg,
        **extra,
    )


def make_axis(**changes: Any) -> SimpleNamespace:
    """An axis like that of profiles/article; ``changes`` are dotted names with __ for the dot."""
    axis = SimpleNamespace(
        name="test",
        path="axis.yaml",
        eds_path=None,
        bus=SimpleNamespace(interface="virtual", channel="test", bitrate_bps=None),
        drive=SimpleNamespace(
            node_id=1,
            identity=SimpleNamespace(vendor_id=0x4844, product_code=0x402, revision=0x10000, serial=None),
            cycle_ms=4.0,
            cycle_s=0.004,
            heartbeat_ms=50,
            master_node_id=127,
            following_error_deg=5.0,
            following_error_time_ms=20,
            quick_stop_option=6,
            halt_option=1,
            rated_torque_nm=0.32,
        ),
        motor_encoder=encoder(8000),
        load_encoder=encoder(
            2_880_000,
            source=SimpleNamespace(index=0x60E4, subindex=1, type="int32", via="tpdo", node=None),
        ),
        gear=SimpleNamespace(ratio=50.0, teeth=None),
        limits=SimpleNamespace(
            position_min_deg=-400.0,
            position_max_deg=400.0,
            velocity_deg_s=20.0,
            acceleration_deg_s2=200.0,
            jerk_deg_s3=4000.0,
            torque_percent=100.0,
        ),
        compensation=SimpleNamespace(maximum_arcsec=300.0, slew_arcsec_s=20000.0, ramp_s=0.5),
    )
    for name, value in changes.items():
        *parents, last = name.split("__")
        target = axis
        for parent in parents:
            target = getattr(target, parent)
        setattr(target, last, value)
    return axis


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
def axis() -> SimpleNamespace:
    return make_axis()


@pytest.fixture
def build_axis() -> Callable[..., SimpleNamespace]:
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
