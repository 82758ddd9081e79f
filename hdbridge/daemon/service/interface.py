"""What the service offers to those above it: the API, the jobs, the command line of the daemon.

Angles are of the load, in degrees; speeds in deg/s. ``holder`` is the token of the lease. All coroutines
raise an `HdbridgeError` whose text is one line that a person can act on:

    InputError      a value is wrong: outside the limits, not finite, no such model or object
    RefusedError    not in this state: not enabled, in motion, a job runs, a fault is latched
    LeaseError      ``holder`` is not the token of the present lease
    DriveError      the drive refuses, or answers no more
    SafetyStop      the supervision stopped the axis while it was waited for
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
    """Else the axis's limit."""
    acceleration_deg_s2: float | None = None
    """Else the axis's limit."""
    dwell_s: float = 0.0
    """To rest there before the next one."""


class StreamPoint(NamedTuple):
    """One set-point of a stream."""

    time_s: float
    """Since the stream began; each later than the one before."""
    position_deg: float
    velocity_deg_s: float | None = None
    """Of the path there; else the slope between its neighbours, and rest at the last."""


class Batch(NamedTuple):
    """What a subscriber gets at a time."""

    samples: SampleArray
    """One row per cycle, as `hdbridge.daemon.memory.sample_dtype` has it."""
    events: Sequence[messages.Event]
    lost: int
    """Cycles that this subscriber was too slow for."""


class Feed(Protocol):
    """Batches as they come; `close` it when no more are wanted."""

    def __aiter__(self) -> AsyncIterator[Batch]: ...
    async def __anext__(self) -> Batch: ...
    def close(self) -> None: ...


class StreamPort(Protocol):
    """A stream of set-points that is under way. An asynchronous context manager: it ends with the block."""

    async def __aenter__(self) -> Self: ...
    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    async def put(self, points: Sequence[StreamPoint]) -> None:
        """Hand over set-points; waits while the buffer is full. Raises where the stream has ended."""
        ...

    async def end(self) -> None:
        """No more set-points come: follow what was handed over, come to rest there, and return then."""
        ...

    @property
    def buffered_s(self) -> float:
        """Time for which set-points are there."""
        ...


class AxisPort(Protocol):
    """One axis. Whatever moves it asks for the lease; to stop and to look takes none."""

    @property
    def name(self) -> str: ...

    def state(self) -> messages.AxisState:
        """Everything about it at the newest cycle."""
        ...

    async def enable(self, holder: str) -> None:
        """Power on, standing still; the drive is booted and verified first where it is not."""
        ...

    async def disable(self, holder: str) -> None:
        """Brake to rest, then power off. Cancels the axis's job."""
        ...

    async def quick_stop(self) -> None:
        """Stop at once, latched until `reset`. Everybody may, without a lease."""
        ...

    async def stop(self) -> None:
        """Brake to rest within the limits and stay enabled. Cancels queue, stream and job. No lease."""
        ...

    async def reset(self, holder: str) -> None:
        """Release a latched stop: reset the drive's fault, verify it again where that is due; disabled."""
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
        """Home by a method of 6098h, from disabled; ends disabled. The load angle where the axis then is."""
        ...

    async def move(
        self,
        holder: str,
        target_deg: float,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        wait: bool = True,
    ) -> None:
        """Move, or send a motion under way to ``target_deg``; with ``wait`` until it stands there.

        RefusedError where another command has taken the place of this one before it came to its end.
        """
        ...

    async def jog(self, holder: str, velocity_deg_s: float, timeout_s: float = 0.5) -> None:
        """Turn at a speed; brakes to rest unless it is called again within ``timeout_s``."""
        ...

    async def queue(self, holder: str, points: Sequence[WayPoint]) -> int:
        """Append moves, each begun when the one before stands; how many wait now."""
        ...

    async def clear_queue(self, holder: str) -> int:
        """Forget the moves that have not begun; how many those were. The present one goes to its end."""
        ...

    async def stream(self, holder: str, timeout_s: float = 0.5) -> StreamPort:
        """Follow set-points. It begins where the axis stands, with the first ones that are put.

        When none come for ``timeout_s`` and the last ones are used up, the axis brakes to rest.
        """
        ...

    async def compensate(self, holder: str, scheme: Scheme) -> None:
        """Compensate by this part of the model in use; faded over, also in motion."""
        ...

    async def activate_model(self, holder: str, version: int | Literal["pending", "active"]) -> None:
        """Make another model of the profile the active one and use it: a version, ``pending`` or ``active``.

        ``pending`` commits it; ``active`` reads the profile's model again. Faded over, also in motion.
        """
        ...

    async def sdo_read(self, object_: str) -> tuple[Object, Value]:
        """An object of the drive, by its number (``6064h``, ``0x1018:4``) or its name in the EDS."""
        ...

    async def sdo_write(self, holder: str, object_: str, value: str) -> Object:
        """Write an object of the drive, the value as text; refused while the axis is enabled."""
        ...

    async def job(
        self, holder: str, kind: messages.JobKind, options: Mapping[str, Any] | None = None
    ) -> messages.Job:
        """Begin a job; `Bridge.jobs` tells how far it is. ``options``: of the command of that name."""
        ...


class Bridge(Protocol):
    """The machine, as the API sees it."""

    @property
    def axes(self) -> Mapping[str, AxisPort]: ...
    @property
    def lease(self) -> Lease: ...

    def state(self) -> messages.MachineState:
        """Everything about the machine at the newest cycle."""
        ...

    def events(self, since: int = 0) -> messages.Events:
        """Events with a higher sequence number than ``since``, oldest first."""
        ...

    def jobs(self) -> list[messages.Job]:
        """The jobs that run and the last ones that ran, newest last."""
        ...

    async def quick_stop(self) -> None:
        """Every axis at once."""
        ...

    async def coordinated(
        self, holder: str, moves: Mapping[str, float], speed: float = 1.0, wait: bool = True
    ) -> None:
        """Move several axes so that all begin and end together; ``speed`` is a share of the limits."""
        ...

    def subscribe(self, most: int = 512) -> Feed:
        """Samples and events as they come; of what is not fetched the newest ``most`` samples are kept."""
        ...

    async def cancel_job(self, holder: str, job_id: str) -> None:
        """Stop a job's axis in order; what it has measured is kept."""
        ...

    def mark(self, text: str) -> None:
        """A remark for the event log and the flight recorder, at the present cycle."""
        ...

    async def load_loop(self, holder: str, axis: str, on: bool) -> None:
        """Switch an axis's slow integral of the measured error on or off; InputError where it has none."""
        ...

    async def adapt(self, holder: str, axis: str, mode: messages.AdaptationMode) -> None:
        """How an axis's parameters follow the load encoder from now on."""
        ...

    async def adaptation_back(self, holder: str, axis: str) -> None:
        """Forget what the adaptation of an axis has changed: the model as it was activated."""
        ...
