"""The asyncio client.

    from hdbridge import AsyncClient

    async with AsyncClient() as client, client.lease():
        axis = client.axis("joint-3")
        await axis.enable()
        for target_deg in (10, 20, 30):
            print((await axis.move(target_deg)).error_arcsec)

Motion requires the lease. A method that moves an axis takes the lease for its duration, unless
`AsyncClient.lease` already holds it. All errors are those of `hdbridge.errors`.
"""

from __future__ import annotations

import asyncio
import ssl
import time
from collections.abc import AsyncGenerator, AsyncIterator, Iterable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, Final, Self, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, ValidationError
from websockets.asyncio.client import ClientConnection, connect, unix_connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from hdbridge.client import messages
from hdbridge.client.address import Address, find
from hdbridge.client.messages import (
    CONTENT_TYPE,
    AxisState,
    LeaseGrant,
    LeaseState,
    MachineState,
    Problem,
    SdoValue,
)
from hdbridge.enums import AdaptationMode, Scheme
from hdbridge.errors import DaemonError, HdbridgeError, LeaseError, SafetyStop
from hdbridge.strictness import complaint

M = TypeVar("M", bound=BaseModel)
PREFIX: Final = "/api/v1"
FAILURES: Final = (OSError, EOFError, ConnectionClosed, InvalidHandshake)
"""Exceptions of a WebSocket."""
POLL_S: Final = 0.1
STOPS_SENT: Final = 5
"""Number of times that a stop is sent if the connection is lost. A daemon that is flooded with connections
closes the oldest ones on which no request has arrived yet."""
JOG_S: Final = 0.5
"""Time after the client's last request at which a jog ends; s."""
RENEWALS: Final = 3
"""Lease renewals per time-out."""
MESSAGE_MAXIMUM: Final = 32 << 20
"""Maximum size of a WebSocket message in bytes, enough for the largest batch of samples of many axes."""
CLOSE_S: Final = 1.0
POINTS_PER_MESSAGE: Final = 200
Point = messages.StreamPoint | tuple[float, float] | tuple[float, float, float]
"""Time in seconds, load angle in degrees, and optionally speed in deg/s."""


class AsyncClient:
    """Client of a daemon, which must be closed or used as a context manager.

    ``address`` is a Unix socket, a URL or a machine's name; without it, `hdbridge.client.address.find` finds
    the daemon. ``token`` is required over TCP; other clients see ``name`` while this client holds the lease.
    Safe for concurrent use.
    """

    def __init__(
        self,
        address: str | Path | None = None,
        *,
        token: str | None = None,
        name: str = "",
        timeout_s: float = 10.0,
    ) -> None:
        self.address: Address = find(address, token)
        self.name = name
        self._timeout_s = timeout_s
        self._lock = asyncio.Lock()
        self._holding = 0
        self._grant: LeaseGrant | None = None
        self._uds = None if self.address.socket is None else str(self.address.socket)
        self._tls = ssl.create_default_context() if self.address.url.startswith("https") else None
        # Without TLS, the transport need not load certificates.
        under = httpx.AsyncHTTPTransport(uds=self._uds, verify=False if self._tls is None else self._tls)
        self._http = httpx.AsyncClient(
            transport=under, base_url=self.address.url + PREFIX, headers=self.address.headers, trust_env=False
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connections."""
        await self._http.aclose()

    def axis(self, name: str) -> AsyncAxis:
        """Returns an axis. Its name is checked by the first request."""
        return AsyncAxis(self, name)

    async def axes(self) -> dict[str, AsyncAxis]:
        """Returns all axes of the machine by name."""
        return {each.name: AsyncAxis(self, each.name) for each in (await self.state()).axes}

    async def state(self) -> MachineState:
        """Returns the state of the machine and its axes."""
        return await self.ask("GET", "/state", MachineState)

    async def events(self, since: int = 0) -> messages.Events:
        """Returns the events after number ``since``."""
        return await self.ask("GET", "/events", messages.Events, query={"since": since})

    async def mark(self, text: str) -> list[messages.Event]:
        """Adds a remark to the event log and the flight recorder."""
        return (await self.ask("POST", "/mark", messages.Events, messages.Mark.given(text=text))).events

    async def stop(self) -> MachineState:
        """Brakes all axes to rest. Requires no lease."""
        return await self.ask("POST", "/stop", MachineState, attempts=STOPS_SENT)

    async def quick_stop(self) -> MachineState:
        """Quick-stops all axes and latches the stops until a reset. Requires no lease."""
        return await self.ask("POST", "/quick-stop", MachineState, attempts=STOPS_SENT)

    async def lend_bus(self) -> MachineState:
        """Stops all axes and makes the daemon release its bus to another program of its computer.

        That program has ten seconds to open the bus. The daemon takes the bus back when the program closes
        it.
        """
        return await self.ask("POST", "/bus/lend", MachineState, moving=True, waits=True)

    async def coordinated(
        self, targets_deg: Mapping[str, float], *, speed: float = 1.0, wait: bool = True
    ) -> MachineState:
        """Moves axes so that all begin and end together; ``speed`` is a fraction of their limits."""
        body = messages.Coordinated.given(targets_deg=dict(targets_deg), speed=speed, wait=wait)
        return await self.ask("POST", "/coordinated", MachineState, body, moving=True, waits=True)

    async def lease_state(self) -> LeaseState:
        """Returns the state of the lease."""
        return await self.ask("GET", "/lease", LeaseState)

    @asynccontextmanager
    async def lease(self, *, force: bool = False) -> AsyncIterator[LeaseGrant]:
        """Holds and renews the lease within the block.

        A nested block reuses the lease. Raises LeaseError if another client holds it.
        """
        async with self._held(force) as grant:
            renewing = asyncio.ensure_future(self._renew(grant))
            try:
                yield grant
            finally:
                renewing.cancel()
                await asyncio.wait([renewing])

    @property
    def holds_lease(self) -> bool:
        """True if this client holds the lease."""
        return self._grant is not None

    async def live(
        self, *, every: int = 1, axes: Sequence[str] | None = None
    ) -> AsyncGenerator[messages.Samples]:
        """Yields batches of samples of every ``every``-th cycle, with the number lost by a slow reader."""
        wanted = messages.LiveOptions(every=every, axes=None if axes is None else list(axes))
        async with self.connected("/live") as link:
            await link.send(wanted)
            while True:
                yield await link.receive(messages.Samples)

    @asynccontextmanager
    async def connected(self, path: str) -> AsyncIterator[AsyncLink]:
        """Opens a WebSocket of the API for the block."""
        address = self.address
        options: dict[str, Any] = {
            "additional_headers": address.headers,
            "max_size": MESSAGE_MAXIMUM,
            "close_timeout": CLOSE_S,
            "compression": None,
        }
        url = f"{address.websocket_url}{PREFIX}{path}"
        async with AsyncExitStack() as stack:
            try:
                connection: ClientConnection = await stack.enter_async_context(
                    connect(url, **options, ssl=self._tls, proxy=None)
                    if self._uds is None
                    else unix_connect(self._uds, url, **options)
                )
            except FAILURES as problem:
                raise _failure(address, problem) from None
            yield AsyncLink(connection, address)

    async def ask(
        self,
        method: str,
        path: str,
        answer: type[M],
        body: BaseModel | None = None,
        *,
        moving: bool = False,
        waits: bool = False,
        query: Mapping[str, int] | None = None,
        attempts: int = 1,
    ) -> M:
        """Sends a request and returns its answer. Takes the lease if the request moves an axis.

        A request is sent up to ``attempts`` times if the connection is lost.

        A request that ``waits`` is answered at the end of a motion, so it has no time-out; it is limited by
        the daemon's supervision.
        """
        headers = {} if body is None else {"Content-Type": "application/json"}
        content = None if body is None else body.model_dump_json(exclude_none=True)
        timeout = httpx.Timeout(self._timeout_s, read=None if waits else self._timeout_s)
        async with self._held() if moving else nullcontext():
            if self._grant is not None:
                headers["X-Lease"] = self._grant.token
            for left in reversed(range(attempts)):
                try:
                    response = await self._http.request(
                        method, path, content=content, headers=headers, params=query, timeout=timeout
                    )
                    break
                except httpx.TransportError as problem:
                    if not left or isinstance(problem, httpx.TimeoutException):
                        raise _failure(self.address, problem) from None
        if response.is_error:
            kind = response.headers.get("content-type", "")
            raise _refused(response.status_code, kind, response.content)
        return _read(answer, response.content, f"{method} {path}")

    @asynccontextmanager
    async def _held(self, force: bool = False) -> AsyncIterator[LeaseGrant]:
        """Holds the lease, taken by the first user and released by the last."""
        async with self._lock:
            if self._grant is None:
                wanted = messages.LeaseRequest.given(client=self.name, force=force)
                self._grant = await self.ask("POST", "/lease", LeaseGrant, wanted)
            self._holding += 1
            grant = self._grant
        try:
            yield grant
        finally:
            async with self._lock:
                self._holding -= 1
                if self._holding == 0:
                    with suppress(DaemonError):  # lease or daemon no longer exists: nothing to release
                        await self.ask("DELETE", "/lease", LeaseState)
                    self._grant = None

    async def _renew(self, grant: LeaseGrant) -> None:
        while True:
            await asyncio.sleep(grant.timeout_s / RENEWALS)
            try:
                await self.ask("PUT", "/lease", LeaseState)
            except LeaseError:
                return
            except DaemonError:
                continue


class AsyncAxis:
    """Axis of a daemon. Methods that move it return when it is at rest again, unless ``wait`` is False."""

    def __init__(self, client: AsyncClient, name: str) -> None:
        self.client = client
        self.name = name
        self._path = f"/axes/{quote(name, safe='')}"

    async def _post(
        self, what: str, body: BaseModel | None = None, *, waits: bool = False, stops: bool = False
    ) -> AxisState:
        path, attempts = f"{self._path}/{what}", STOPS_SENT if stops else 1
        return await self.client.ask(
            "POST", path, AxisState, body, moving=not stops, waits=waits, attempts=attempts
        )

    async def _delete(self, what: str) -> AxisState:
        return await self.client.ask("DELETE", f"{self._path}/{what}", AxisState, moving=True)

    async def state(self) -> AxisState:
        """Returns the state of the axis."""
        return await self.client.ask("GET", self._path, AxisState)

    async def enable(self) -> AxisState:
        """Switches power on at rest; boots and verifies the drive first if necessary."""
        return await self._post("enable", waits=True)

    async def disable(self) -> AxisState:
        """Brakes to rest, then switches power off."""
        return await self._post("disable", waits=True)

    async def reset(self) -> AxisState:
        """Releases a latched stop; the axis stays disabled."""
        return await self._post("reset", waits=True)

    async def stop(self) -> AxisState:
        """Brakes to rest and stays enabled. Requires no lease."""
        return await self._post("stop", stops=True)

    async def quick_stop(self) -> AxisState:
        """Quick-stops the axis and latches the stop until a reset. Requires no lease."""
        return await self._post("quick-stop", stops=True)

    async def home(self, /, method: int, **values: float | None) -> AxisState:
        """Homes by a method of the drive; ``values`` are the other fields of `messages.Home`."""
        return await self._post("home", messages.Home.given(method=method, **values), waits=True)

    async def move(
        self,
        target_deg: float,
        *,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        wait: bool = True,
    ) -> AxisState:
        """Moves to a load angle in degrees; a motion under way is redirected without a stop."""
        body = messages.Move.given(
            target_deg=target_deg,
            velocity_deg_s=velocity_deg_s,
            acceleration_deg_s2=acceleration_deg_s2,
            wait=wait,
        )
        return await self._post("move", body, waits=True)

    async def jog(self, velocity_deg_s: float, duration_s: float | None = None) -> AxisState:
        """Turns at a speed for a duration, then brakes; without a duration, must be called again within
        `JOG_S`.

        Without a duration, raises LeaseError unless the lease is held, because the lease, and with it the
        jog, would end with this call.
        """
        body = messages.Jog.given(velocity_deg_s=velocity_deg_s, timeout_s=JOG_S)
        if duration_s is None:
            self._need_lease("jog without a duration")
            return await self._post("jog", body)
        until = time.monotonic() + duration_s
        async with self.client.lease():
            while (left_s := until - time.monotonic()) > 0:
                await self._post("jog", body)
                await asyncio.sleep(min(left_s, JOG_S / 3))
            return await self.stop()

    async def queue(self, points: Sequence[messages.QueueItem | float], *, wait: bool = True) -> AxisState:
        """Appends way points (load angles, or items with their own limits) and waits until the last one is
        reached.
        """
        items = [
            each.model_dump() if isinstance(each, messages.QueueItem) else {"target_deg": each}
            for each in points
        ]
        body = messages.Queue.given(points=items)
        if not wait:
            self._need_lease("a queue that is not waited for")
            return await self._post("queue", body)
        async with self.client.lease():
            await self._post("queue", body)
            return await self.rest()

    async def clear_queue(self) -> AxisState:
        """Discards the waiting way points."""
        return await self._delete("queue")

    async def rest(self) -> AxisState:
        """Waits until the axis is at rest and its queue is empty; raises SafetyStop if it was stopped."""
        while True:
            found = await self.state()
            if found.fault is not None:
                raise SafetyStop(f"axis '{self.name}': {found.fault}")
            if found.at_rest and found.queued == 0 and found.mode == "hold":
                return found
            await asyncio.sleep(POLL_S)

    @asynccontextmanager
    async def stream(self, timeout_s: float = JOG_S) -> AsyncIterator[AsyncStream]:
        """Follows the set-points that are put within the block; at the end of the block, the axis rests at
        the last one.

        The first set-point must be the axis's position. The axis brakes if no point is left for
        ``timeout_s``, or if the block raises an error.
        """
        begin = messages.StreamBegin.given(lease="", timeout_s=timeout_s)
        async with self.client.lease() as grant, self.client.connected(f"{self._path}/stream") as link:
            stream = AsyncStream(link)
            await stream.exchange(begin.model_copy(update={"lease": grant.token}))
            yield stream
            await stream.end()

    async def compensate(self, scheme: Scheme | str) -> AxisState:
        """Selects the part of the model that compensates; ``none`` switches compensation off."""
        return await self._post("compensate", messages.Compensate.given(scheme=scheme))

    async def activate_model(self, version: int | str) -> AxisState:
        """Activates a model, given by its number in the history, or by ``pending`` or ``active``."""
        return await self._post("model", messages.ActivateModel.given(version=version), waits=True)

    async def load_loop(self, on: bool) -> AxisState:
        """Switches the load loop (integral of the measured error) on or off."""
        return await self._post("load-loop", messages.SwitchLoadLoop.given(on=on))

    async def adapt(self, mode: AdaptationMode | str) -> AxisState:
        """Sets the adaptation mode: ``off``, ``observe`` or ``on``."""
        return await self._post("adaptation", messages.Adapt.given(mode=mode))

    async def revert_adaptation(self) -> AxisState:
        """Discards the changes by the adaptation, which only observes from then on."""
        return await self._delete("adaptation")

    async def read(self, object_: str) -> SdoValue:
        """Reads an object of the drive by its number (6064h, 0x1018:4) or EDS name."""
        return await self.client.ask("GET", f"{self._path}/objects/{quote(object_, safe='')}", SdoValue)

    async def write(self, object_: str, value: int | float | str) -> SdoValue:
        """Writes an object of the drive; refused while the axis is enabled."""
        path = f"{self._path}/objects/{quote(object_, safe='')}"
        body = messages.SdoWrite.given(value=str(value))
        return await self.client.ask("PUT", path, SdoValue, body, moving=True)

    def _need_lease(self, what: str) -> None:
        if not self.client.holds_lease:
            raise LeaseError(f"{what} ends with the lease: use it within 'with client.lease():'")


class AsyncStream:
    """Open stream of set-points."""

    def __init__(self, link: AsyncLink) -> None:
        self._link = link
        self._ended = False

    async def put(self, points: Iterable[Point]) -> None:
        """Sends points (time s, load angle deg) or (time, angle, speed deg/s); time is since the start.

        Waits while the daemon's buffer is full. Raises InputError if a point is refused; the axis then
        brakes.
        """
        names = ("time_s", "position_deg", "velocity_deg_s")
        items = [
            each
            if isinstance(each, messages.StreamPoint)
            else messages.StreamPoint.given(**dict(zip(names, each, strict=False)))
            for each in points
        ]
        for first in range(0, len(items), POINTS_PER_MESSAGE):
            await self.exchange(messages.StreamPoints(points=items[first : first + POINTS_PER_MESSAGE]))

    async def end(self) -> None:
        """Ends the stream; returns when the axis is at rest at the last point."""
        if not self._ended:
            self._ended = True
            await self.exchange(messages.StreamPoints(points=[], end=True))

    async def exchange(self, message: BaseModel) -> None:
        """Sends a message and receives its answer."""
        await self._link.send(message)
        answer = await self._link.receive(messages.StreamAnswer)
        if answer.problem is not None:
            self._ended = True
            raise answer.problem.error()


class AsyncLink:
    """WebSocket that sends and receives messages, and raises errors of hdbridge."""

    def __init__(self, connection: ClientConnection, address: Address) -> None:
        self._connection = connection
        self._address = address

    async def send(self, message: BaseModel) -> None:
        try:
            await self._connection.send(message.model_dump_json())
        except FAILURES as problem:
            raise _failure(self._address, problem) from None

    async def receive(self, kind: type[M]) -> M:
        """Receives the next message."""
        try:
            text = await self._connection.recv()
        except FAILURES as problem:
            raise _failure(self._address, problem) from None
        return _read(kind, text, kind.__name__)


def _read(kind: type[M], content: str | bytes, what: str) -> M:
    """Parses an answer to ``what``; raises DaemonError for a different message."""
    try:
        return kind.model_validate_json(content)
    except ValidationError as problem:
        first = complaint(problem.errors(include_input=False)[0], "the message")
        raise DaemonError(
            f"{what}: the answer is not what this version of hdbridge expects "
            f"({first}); use the same version at both ends"
        ) from None


def _refused(status: int, kind: str, content: bytes) -> HdbridgeError:
    """Returns the daemon's error from an answer of status 400 or above."""
    if kind.startswith(CONTENT_TYPE):
        try:
            return Problem.model_validate_json(content).error()
        except ValidationError:
            pass
    return DaemonError(
        f"HTTP {status}, which is not an answer of hdbridge: is another server at this address?"
    )


def _failure(address: Address, problem: Exception) -> HdbridgeError:
    """Returns the error for a daemon that cannot be reached, refuses a WebSocket or has disconnected."""
    if isinstance(problem, InvalidStatus):
        response = problem.response
        kind = response.headers.get("Content-Type", "")
        return _refused(response.status_code, kind, bytes(response.body or b""))
    if isinstance(problem, ConnectionClosed) and problem.rcvd is not None and problem.rcvd.reason:
        return DaemonError(problem.rcvd.reason)
    if isinstance(problem, httpx.ConnectError | FileNotFoundError | ConnectionRefusedError):
        return DaemonError(f"{address}: no daemon answers ({problem}); start it with 'hdbridge run'")
    what = "did not answer in time" if isinstance(problem, httpx.TimeoutException) else "disconnected"
    return DaemonError(
        f"{address}: the daemon {what} ({str(problem) or type(problem).__name__}); the outcome is unknown: "
        f"check the state first"
    )
