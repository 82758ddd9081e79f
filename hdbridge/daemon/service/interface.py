"""Interface of the service for the API, the jobs and the daemon's command line.

Angles are load angles in degrees, speeds in deg/s. ``holder`` is the lease token. All coroutines raise an
`HdbridgeError` whose text is one line with the cause and the remedy:

    InputError      a value is invalid: outside the limits, not finite, no such model or object
    RefusedError    not possible in this state: not enabled, in motion, a job runs, a fault is latched
    LeaseError      ``holder`` is not the token of the present lease
    DriveError      the drive refuses the request or does not answer
    SafetyStop      the supervision stopped the axis during the call
    BusError        the CAN interface is gone
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, Self

from hdbridge.client import messages
from hdbridge.evaluation.stepping import Scheme

if TYPE_CHECKING:
    from hdbridge.daemon.memory import SampleArray
    from hdbridge.daemon.service.lease import Lease
    from hdbridge.drive.values import Object, Value


class WayPoint(NamedTuple):
    """One move of a queue."""

    target_deg: float
    velocity_deg_s: float | None = None
    """Maximum velocity; None for the axis's limit."""
    acceleration_deg_s2: float | None = None
    """Maximum acceleration; None for the axis's limit."""
    dwell_s: float = 0.0
    """Rest before the next move."""


class StreamPoint(NamedTuple):
    """One set-point of a stream."""

    time_s: float
    """Time since the stream began; later than that of the point before."""
    position_deg: float
    velocity_deg_s: float | None = None
    """Velocity of the path at this point; None for the slope between its neighbours, or rest at the last."""


class Batch(NamedTuple):
    """Samples and events delivered to a subscriber at once."""

    samples: SampleArray
    """One row per cycle, with the fields of `hdbridge.daemon.memory.sample_dtype`."""
    events: Sequence[messages.Event]
    lost: int
    """Cycles lost because the subscriber was too slow."""


class Feed(Protocol):
    """Asynchronous iterator over batches; `close` it to end the subscription."""

    def __aiter__(self) -> AsyncIterator[Batch]: ...
    async def __anext__(self) -> Batch: ...
    def close(self) -> None: ...


class StreamPort(Protocol):
    """An open stream of set-points. An asynchronous context manager: the stream ends with the block."""

    async def __aenter__(self) -> Self: ...
    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    async def put(self, points: Sequence[StreamPoint]) -> None:
        """Hands over set-points; waits while the buffer is full. Raises if the stream has ended."""
        ...

    async def end(self) -> None:
        """Ends the stream; returns when the axis has followed all set-points and is at rest."""
        ...

    @property
    def buffered_s(self) -> float:
        """Duration of the buffered set-points."""
        ...


class AxisPort(Protocol):
    """One axis. Every method that moves it requires the lease; stopping and reading do not."""

    @property
    def name(self) -> str: ...

    def state(self) -> messages.AxisState:
        """Returns the state of the axis in the newest cycle."""
        ...

    async def enable(self, holder: str) -> None:
        """Switches power on at rest; boots and verifies the drive first if that was not done."""
        ...

    async def disable(self, holder: str) -> None:
        """Brakes to rest, then switches power off. Cancels the axis's job."""
        ...

    async def quick_stop(self) -> None:
        """Quick-stops the axis and latches the stop until `reset`. Requires no lease."""
        ...

    async def stop(self) -> None:
        """Brakes to rest and stays enabled. Cancels queue, stream and job. Requires no lease."""
        ...

    async def reset(self, holder: str) -> None:
        """Releases a latched stop: resets the drive's fault, verifies the drive if needed; disabled."""
        ...

    async def home(
        self,
        holder: str,
        method: int,
        switch_velocity_deg_s: float | None = None,
        zero_velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        offset_deg: float = 0.0,
        timeout_s: float = 60.0,
    ) -> float:
        """Homes by a method of 6098h, disabled before and after. Returns the load angle afterwards."""
        ...

    async def move(
        self,
        holder: str,
        target_deg: float,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        wait: bool = True,
    ) -> None:
        """Moves to ``target_deg``, or redirects a present motion there; with ``wait`` returns at rest there.

        Raises RefusedError if another command replaced this one before its end.
        """
        ...

    async def jog(self, holder: str, velocity_deg_s: float, timeout_s: float = 0.5) -> None:
        """Turns at a speed; brakes to rest unless called again within ``timeout_s``."""
        ...

    async def queue(self, holder: str, points: Sequence[WayPoint]) -> int:
        """Appends moves, each begun when the one before has ended; returns the number of waiting moves."""
        ...

    async def clear_queue(self, holder: str) -> int:
        """Discards the waiting moves and returns their number. The present move continues."""
        ...

    async def stream(self, holder: str, timeout_s: float = 0.5) -> StreamPort:
        """Opens a stream of set-points. It begins at rest, with the first set-points that are put.

        If none come for ``timeout_s`` and all are used up, the axis brakes to rest.
        """
        ...

    async def compensate(self, holder: str, scheme: Scheme) -> None:
        """Selects the part of the model that compensates; fades it in, also during motion."""
        ...

    async def activate_model(self, holder: str, version: int | Literal["pending", "active"]) -> None:
        """Activates a model of the profile and uses it: a version, ``pending`` or ``active``.

        ``pending`` commits it; ``active`` reads the profile's model again. Fades it in, also during motion.
        """
        ...

    async def sdo_read(self, object_: str) -> tuple[Object, Value]:
        """Reads an object of the drive by its number (``6064h``, ``0x1018:4``) or EDS name."""
        ...

    async def sdo_write(self, holder: str, object_: str, value: str) -> Object:
        """Writes an object of the drive, given as text; refused while the axis is enabled."""
        ...

    async def job(
        self, holder: str, kind: messages.JobKind, options: Mapping[str, Any] | None = None
    ) -> messages.Job:
        """Begins a job with the options of the command of that name; `Bridge.jobs` reports progress."""
        ...


class Bridge(Protocol):
    """The machine, as the API sees it."""

    @property
    def axes(self) -> Mapping[str, AxisPort]: ...
    @property
    def lease(self) -> Lease: ...

    def state(self) -> messages.MachineState:
        """Returns the state of the machine in the newest cycle."""
        ...

    def events(self, since: int = 0) -> messages.Events:
        """Returns the events after sequence number ``since``, oldest first."""
        ...

    def jobs(self) -> list[messages.Job]:
        """Returns the running jobs and the last finished ones, newest last."""
        ...

    async def quick_stop(self) -> None:
        """Quick-stops all axes. Requires no lease."""
        ...

    async def coordinated(
        self, holder: str, moves: Mapping[str, float], speed: float = 1.0, wait: bool = True
    ) -> None:
        """Moves several axes so that all begin and end together; ``speed`` is a share of the limits."""
        ...

    def subscribe(self, most: int = 512) -> Feed:
        """Subscribes to samples and events; at most the newest ``most`` samples wait to be fetched."""
        ...

    async def cancel_job(self, holder: str, job_id: str) -> None:
        """Cancels a job and brakes its axis to rest; its measurements are kept."""
        ...

    def mark(self, text: str) -> None:
        """Adds a remark to the event log and the flight recorder, at the present cycle."""
        ...

    async def load_loop(self, holder: str, axis: str, on: bool) -> None:
        """Switches an axis's load loop on or off; raises InputError if it has none."""
        ...

    async def adapt(self, holder: str, axis: str, mode: messages.AdaptationMode) -> None:
        """Sets how an axis's model parameters follow the load encoder."""
        ...

    async def adaptation_back(self, holder: str, axis: str) -> None:
        """Discards the adapted parameters of an axis and restores its model as it was activated."""
        ...
