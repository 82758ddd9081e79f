# Made by tools/synchronous_client.py from aioaxis.py: edit that file.
"""An axis of the synchronous client."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pydantic import BaseModel

from hdbridge.client import sockets
from hdbridge.client.calls import JOG_S, POLL_S, AxisCalls, given
from hdbridge.client.messages import (
    AdaptationMode,
    AxisState,
    QueueItem,
    Scheme,
    SdoValue,
    StreamAnswer,
    StreamBegin,
)
from hdbridge.errors import LeaseError, SafetyStop

if TYPE_CHECKING:
    from hdbridge.client.sync import Client, Link


class Axis:
    """An axis. Methods that move it return when it is at rest again, unless ``wait`` is False."""

    def __init__(self, client: Client, name: str) -> None:
        self.client = client
        self.name = name
        self._calls = AxisCalls(name)

    def state(self) -> AxisState:
        """Returns the state of the axis."""
        return self.client.do(self._calls.state())

    def enable(self) -> AxisState:
        """Switches power on at rest; boots and verifies the drive first if that was not done."""
        return self.client.do(self._calls.enable())

    def disable(self) -> AxisState:
        """Brakes to rest, then switches power off."""
        return self.client.do(self._calls.disable())

    def reset(self) -> AxisState:
        """Releases a latched stop; the axis stays disabled."""
        return self.client.do(self._calls.reset())

    def stop(self) -> AxisState:
        """Brakes to rest and stays enabled. Requires no lease."""
        return self.client.do(self._calls.stop())

    def quick_stop(self) -> AxisState:
        """Quick-stops the axis and latches the stop until a reset. Requires no lease."""
        return self.client.do(self._calls.quick_stop())

    def home(self, method: int, **values: float | None) -> AxisState:
        """Homes by a method of the drive; ``values`` are the other fields of `messages.Home`."""
        return self.client.do(self._calls.home(method, **values))

    def move(
        self,
        target_deg: float,
        *,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        wait: bool = True,
    ) -> AxisState:
        """Moves to a load angle in degrees; a present motion is redirected without a stop."""
        return self.client.do(self._calls.move(target_deg, velocity_deg_s, acceleration_deg_s2, wait))

    def jog(self, velocity_deg_s: float, duration_s: float | None = None) -> AxisState:
        """Turns at a speed for a time, then brakes; without a time, call it again within `JOG_S`.

        Raises LeaseError without a time if the lease is not held, because it would end with this call.
        """
        call = self._calls.jog(velocity_deg_s, JOG_S)
        if duration_s is None:
            self._need_lease("jog without a duration")
            return self.client.do(call)
        until = time.monotonic() + duration_s
        with self.client.lease():
            while (left_s := until - time.monotonic()) > 0:
                self.client.do(call)
                time.sleep(min(left_s, JOG_S / 3))
            return self.stop()

    def queue(self, points: Sequence[QueueItem | float], *, wait: bool = True) -> AxisState:
        """Appends way points (load angles, or with their own limits) and waits until the last is reached."""
        call = self._calls.queue(points)
        if not wait:
            self._need_lease("a queue that is not waited for")
            return self.client.do(call)
        with self.client.lease():
            self.client.do(call)
            return self.rest()

    def clear_queue(self) -> AxisState:
        """Discards the waiting way points."""
        return self.client.do(self._calls.clear_queue())

    def rest(self) -> AxisState:
        """Waits until the axis is at rest and no way points wait; raises SafetyStop if it was stopped."""
        while True:
            found = self.state()
            if found.fault is not None:
                raise SafetyStop(f"axis '{self.name}': {found.fault}")
            if found.at_rest and found.queued == 0 and found.mode == "hold":
                return found
            time.sleep(POLL_S)

    @contextmanager
    def stream(self, timeout_s: float = JOG_S) -> Iterator[Stream]:
        """Follows set-points that are put within the block; the axis rests at the last one when it ends.

        The first set-point is the axis's position. The axis brakes if no point is left for ``timeout_s``, or
        if an error leaves the block.
        """
        begin = given(StreamBegin, lease="", timeout_s=timeout_s)
        with self.client.lease() as grant, self.client.connected(f"{self._calls.path}/stream") as link:
            stream = Stream(link)
            stream.exchange(begin.model_copy(update={"lease": grant.token}))
            yield stream
            stream.end()

    def compensate(self, scheme: Scheme | str) -> AxisState:
        """Selects the part of the model that compensates; ``none`` switches compensation off."""
        return self.client.do(self._calls.compensate(scheme))

    def activate_model(self, version: int | str) -> AxisState:
        """Activates a model: its number in the history, ``pending`` or ``active``."""
        return self.client.do(self._calls.activate_model(version))

    def load_loop(self, on: bool) -> AxisState:
        """Switches the load loop (integral of the measured error) on or off."""
        return self.client.do(self._calls.load_loop(on))

    def adapt(self, mode: AdaptationMode | str) -> AxisState:
        """Sets the adaptation mode: ``off``, ``observe`` or ``on``."""
        return self.client.do(self._calls.adapt(mode))

    def adaptation_back(self) -> AxisState:
        """Discards the changes by the adaptation."""
        return self.client.do(self._calls.adaptation_back())

    def read(self, object_: str) -> SdoValue:
        """Reads an object of the drive by its number (6064h, 0x1018:4) or EDS name."""
        return self.client.do(self._calls.read(object_))

    def write(self, object_: str, value: int | float | str) -> SdoValue:
        """Writes an object of the drive; refused while the axis is enabled."""
        return self.client.do(self._calls.write(object_, str(value)))

    def _need_lease(self, what: str) -> None:
        if not self.client.holds_lease:
            raise LeaseError(f"{what} ends with the lease: use it within 'with client.lease():'")


class Stream:
    """An open stream of set-points."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._ended = False

    def put(self, points: Iterable[sockets.Point]) -> None:
        """Sends points: (time s, load angle deg) or (time, angle, speed deg/s), time since the start.

        Waits while the daemon's buffer is full. Raises InputError if a point is refused; the axis then
        brakes.
        """
        for each in sockets.parts(points, end=False):
            self.exchange(each)

    def end(self) -> None:
        """Ends the stream; returns when the axis is at rest at the last point."""
        if not self._ended:
            self._ended = True
            (last,) = sockets.parts((), end=True)
            self.exchange(last)

    def exchange(self, message: BaseModel) -> None:
        """Sends a message and receives its answer."""
        self._link.send(message)
        answer = self._link.receive(StreamAnswer)
        if answer.problem is not None:
            self._ended = True
            raise answer.problem.error()
