"""Machine without drives, for tests of the API: it records requests and moves nothing.

The lease is the real one, so that permission to move is decided as in the daemon; targets are checked against
the limits of the axis.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

import numpy as np

from hdbridge.client import messages
from hdbridge.daemon.memory import sample_dtype
from hdbridge.daemon.service.lease import Lease
from hdbridge.drive import load_eds
from hdbridge.drive.values import Object, Value, find_object
from hdbridge.enums import Scheme
from hdbridge.errors import InputError, RefusedError
from hdbridge.files.profile import bundled_folder

BEGAN = datetime(2025, 1, 31, 12, 0, tzinfo=UTC)
LIMITS = messages.Limits(
    position_min_deg=-180, position_max_deg=180, velocity_deg_s=60, acceleration_deg_s2=300, jerk_deg_s3=3000
)
STATUSWORD = find_object("6041h", load_eds(bundled_folder("eds") / "hdbridge-402.eds", 1))


class FakeAxis:
    """Axis that is always at its latest target."""

    def __init__(self, bridge: FakeBridge, name: str) -> None:
        self._bridge = bridge
        self.name = name
        self.motion = self
        self.at = messages.ControlState.DISABLED
        self.target_deg = 0.0
        self.scheme = messages.Scheme.NONE
        self.model: messages.ModelInUse | None = None
        self.load_loop = messages.LoadLoopState(configured=True)
        self.outer: messages.OuterState | None = None
        self.queued: list[messages.QueueItem] = []
        self.moving_s = 0.0
        """Duration of a move, s."""

    def state(self) -> messages.AxisState:
        fault = None
        if self.at is messages.ControlState.QUICK_STOPPED:
            fault = messages.Fault(name="LOST_TPDO", text="a TPDO is missing", hint="check the cable")
        on = self.at is messages.ControlState.ENABLED
        return messages.AxisState(
            name=self.name, profile=f"profiles/{self.name}", node_id=1, ratio=50.0, state=self.at,
            power=messages.PowerState.OPERATION_ENABLED if on else messages.PowerState.SWITCH_ON_DISABLED,
            mode=messages.MotionMode.HOLD, at_rest=True, load_target_deg=self.target_deg,
            velocity_deg_s=0.0, motor_position_deg=50 * self.target_deg,
            load_position_deg=self.target_deg + 1 / 3600, error_arcsec=1.0, scheme=self.scheme,
            compensating=self.scheme is not messages.Scheme.NONE, memory_known=True, limits=LIMITS,
            fault=fault, model=self.model, load_loop=self.load_loop,
            adaptation=messages.AdaptationState(), queued=len(self.queued), outer=self.outer,
        )  # fmt: skip

    def _moved(self, holder: str, what: str, *given: Any) -> None:
        self._bridge.lease.check(holder)
        self._bridge.moved.append((self.name, what, *given))

    def check(self, holder: str, *targets_deg: float) -> None:
        """Refuses motion without the lease or power, or to targets outside the limits."""
        self._bridge.lease.check(holder)
        if self.at is not messages.ControlState.ENABLED:
            raise RefusedError(f"axis '{self.name}' is {self.at.value}; enable it first")
        for each in targets_deg:
            self.check_within(each)

    def check_within(self, target_deg: float) -> None:
        if not -180 <= target_deg <= 180:
            raise InputError(f"found {target_deg:g} deg; expected from -180 to 180 deg")

    def following_for(self, holder: str) -> FakeAxis:
        self._bridge.lease.check(holder)
        return self

    async def switch_load_loop(self, holder: str, *, on: bool) -> None:
        self._moved(holder, "load loop", on)

    async def set_mode(self, mode: messages.AdaptationMode) -> None:
        self._bridge.moved.append((self.name, "adapt", mode.value))

    async def revert(self) -> None:
        self._bridge.moved.append((self.name, "adaptation back"))

    async def enable(self, holder: str) -> None:
        self._moved(holder, "enable")
        self.at = messages.ControlState.ENABLED

    async def disable(self, holder: str) -> None:
        self._moved(holder, "disable")
        self.at = messages.ControlState.DISABLED

    async def quick_stop(self) -> None:
        self._bridge.stopped.append((self.name, "quick-stop"))
        self.at = messages.ControlState.QUICK_STOPPED

    async def stop(self) -> None:
        self._bridge.stopped.append((self.name, "stop"))

    async def reset(self, holder: str) -> None:
        self._moved(holder, "reset")
        self.at = messages.ControlState.DISABLED

    async def home(self, holder: str, run: messages.Home) -> None:
        self._moved(holder, "home", run.method)

    async def move(
        self,
        holder: str,
        target_deg: float,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        wait: bool = True,
    ) -> None:
        self.check(holder, target_deg)
        self._moved(holder, "move", target_deg, velocity_deg_s)
        if wait:
            await asyncio.sleep(self.moving_s)
        self.target_deg = target_deg

    async def jog(self, holder: str, velocity_deg_s: float, timeout_s: float = 0.5) -> None:
        self.check(holder)
        self._moved(holder, "jog", velocity_deg_s, timeout_s)

    async def queue(self, holder: str, points: Sequence[messages.QueueItem]) -> None:
        self.check(holder, *(each.target_deg for each in points))
        self._moved(holder, "queue", len(points))
        self.queued += points

    async def clear_queue(self, holder: str) -> None:
        self._moved(holder, "clear queue")
        self.queued.clear()

    async def stream(self, holder: str, timeout_s: float = 0.5) -> FakeStream:
        self.check(holder)
        self._moved(holder, "stream", timeout_s)
        return FakeStream(self)

    async def compensate(self, holder: str, scheme: Scheme) -> None:
        self._moved(holder, "compensate", scheme.value)
        self.scheme = messages.Scheme(scheme.value)

    async def activate_model(self, holder: str, version: int | str) -> None:
        self._moved(holder, "model", version)
        self.model = messages.ModelInUse(version=4, file="history/0004.yaml", date=BEGAN, age_s=3600.0)

    async def sdo_read(self, object_: str) -> tuple[Object, Value]:
        if object_ not in {"6041h", "Statusword"}:
            raise InputError(f"{object_}: no such object in the EDS; expected a number or a name")
        return STATUSWORD, 0x1237

    async def sdo_write(self, holder: str, object_: str, value: str) -> Object:
        self._bridge.lease.check(holder)
        found, _ = await self.sdo_read(object_)
        self._moved(holder, "write", object_, value)
        return found


class FakeStream:
    """Records the points of a stream; refuses a point outside the limits."""

    def __init__(self, axis: FakeAxis) -> None:
        self._axis = axis
        self.points: list[messages.StreamPoint] = []
        self.ended = False
        axis._bridge.streams.append(self)

    async def __aenter__(self) -> FakeStream:
        return self

    async def __aexit__(self, *error: object) -> None:
        self.ended = True

    async def put(self, points: Sequence[messages.StreamPoint]) -> None:
        for each in points:
            self._axis.check_within(each.position_deg)
            self.points.append(each)

    async def end(self) -> None:
        self._axis.target_deg = self.points[-1].position_deg


class FakeReader:
    """Reads `FakeBridge.rows` cycles for each `FakeBridge.batch_s` since its creation."""

    def __init__(self, bridge: FakeBridge) -> None:
        self._bridge, self._begun_s, self._cycle = bridge, time.monotonic(), 0

    def read(self) -> tuple[Any, int]:
        batches = (time.monotonic() - self._begun_s) / self._bridge.batch_s
        before, self._cycle = self._cycle, int(batches * self._bridge.rows)
        return self._bridge.samples(range(before + 1, self._cycle + 1)), 0


class FakeBridge:
    """Machine with several axes; ``moved`` lists the requests for motion, ``stopped`` the stops."""

    def __init__(self, *names: str) -> None:
        self.now_s: float | None = None
        """Time of the lease if the test sets it; None for the computer's clock."""
        self.lease = Lease(10.0, lambda: time.monotonic() if self.now_s is None else self.now_s)
        self.axes = {name: FakeAxis(self, name) for name in names or ("joint-1", "joint-2")}
        self.moved: list[tuple[Any, ...]] = []
        self.stopped: list[tuple[str, str]] = []
        self.streams: list[FakeStream] = []
        self.logged: list[messages.Event] = []
        self.core = SimpleNamespace(lost=0)
        self.alive = True
        self.batch_s = 0.005
        self.rows = 5

    def state(self) -> messages.MachineState:
        holder = self.lease.holder
        return messages.MachineState(
            name="cell", version="0.1.0", started=BEGAN, simulated=True,
            axes=[each.state() for each in self.axes.values()],
            bus=messages.BusState(interface="virtual", channel="hdbridge", up=True, load=0.31),
            cycle=messages.CycleState(period_s=0.004, cycle=1234, alive=self.alive, late_us=12.0),
            lease=messages.LeaseState(
                held=holder is not None, client=holder and holder.client, timeout_s=self.lease.timeout_s
            ),
            recorder=messages.RecorderState(on=False),
        )  # fmt: skip

    def events(self, since: int = 0) -> messages.Events:
        newest = self.logged[-1].sequence if self.logged else 0
        return messages.Events(events=[each for each in self.logged if each.sequence > since], newest=newest)

    async def lend_bus(self, holder: str) -> None:
        self.lease.check(holder)
        raise RefusedError("the bus cannot be lent: its axes are simulated")

    async def quick_stop(self) -> None:
        for each in self.axes.values():
            await each.quick_stop()

    async def coordinated(
        self, holder: str, moves: Mapping[str, float], speed: float = 1.0, wait: bool = True
    ) -> None:
        for name, target_deg in moves.items():
            self.axes[name].check(holder, target_deg)
        for name, target_deg in moves.items():
            await self.axes[name].move(holder, target_deg, wait=wait)

    def reader(self) -> FakeReader:
        return FakeReader(self)

    def samples(self, cycles: Sequence[int]) -> Any:
        found = np.zeros(len(cycles), sample_dtype(len(self.axes)))
        found["cycle"] = cycles
        found["time_ns"] = found["cycle"] * 4_000_000
        found["axes"]["load_position_deg"] = 1 / 3600
        found["axes"]["reading0"] = np.nan
        found["axes"]["state"] = 3
        return found

    def mark(self, text: str) -> None:
        number = len(self.logged) + 1
        self.logged.append(
            messages.Event(sequence=number, kind=messages.EventKind.NOTE, date=BEGAN, cycle=1234, text=text)
        )
