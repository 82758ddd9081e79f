"""The asyncio client.

    from hdbridge import AsyncClient

    async with AsyncClient() as client, client.lease():
        axis = client.axis("joint-3")
        await axis.enable()
        for target_deg in (10, 20, 30):
            print((await axis.move(target_deg)).error_arcsec)

Motion requires the lease. A method that moves an axis takes it while it runs, unless `AsyncClient.lease`
holds it already. Every error is one of `hdbridge.errors`.
"""

from __future__ import annotations

import asyncio  # async only

# sync: import threading
# sync: import weakref
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any, Self

import httpx
from pydantic import BaseModel
from websockets.asyncio.client import ClientConnection, connect, unix_connect

from hdbridge.client import sockets, transport
from hdbridge.client.address import Address, find
from hdbridge.client.aioaxis import AsyncAxis
from hdbridge.client.calls import RENEWALS, A, Call, M, MachineCalls
from hdbridge.client.messages import (
    Event,
    Events,
    LeaseGrant,
    LeaseState,
    LiveOptions,
    MachineState,
    Samples,
)
from hdbridge.errors import DaemonError, LeaseError


class AsyncClient:
    """Client of a daemon. Close it, or use it as a context manager.

    ``address`` is a Unix socket, a URL or a machine's name; `hdbridge.client.address.find` finds the daemon
    without it. ``token`` is required over TCP; others see ``name`` while the client holds the lease. Safe
    for concurrent use.
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
        self._tls = transport.tls_context(self.address)
        self._timeout_s = timeout_s
        self._lock = asyncio.Lock()
        self._holding = 0
        self._grant: LeaseGrant | None = None
        under = httpx.AsyncHTTPTransport(**transport.under(self.address, self._tls))
        self._http = httpx.AsyncClient(transport=under, **transport.settings(self.address))
        # sync: weakref.finalize(self, self._http.close)  # of a client that lives for one line only

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

    # sync: @property
    async def axes(self) -> dict[str, AsyncAxis]:
        """Returns all axes of the machine by name."""
        return {each.name: AsyncAxis(self, each.name) for each in (await self.state()).axes}

    async def state(self) -> MachineState:
        """Returns the state of the machine and its axes."""
        return await self.do(MachineCalls.state())

    async def events(self, since: int = 0) -> Events:
        """Returns the events after number ``since``."""
        return await self.do(MachineCalls.events(since))

    async def mark(self, text: str) -> list[Event]:
        """Adds a remark to the event log and the flight recorder."""
        return (await self.do(MachineCalls.mark(text))).events

    async def stop(self) -> MachineState:
        """Brakes all axes to rest. Requires no lease."""
        return await self.do(MachineCalls.stop_all())

    async def quick_stop(self) -> MachineState:
        """Quick-stops all axes and latches the stops until a reset. Requires no lease."""
        return await self.do(MachineCalls.quick_stop_all())

    async def lend_bus(self) -> MachineState:
        """Stops all axes and makes the daemon release its bus to another program of its computer.

        That program has ten seconds to open the bus. The daemon takes the bus back when it is closed.
        """
        return await self.do(MachineCalls.lend_bus())

    async def coordinated(
        self, targets_deg: Mapping[str, float], *, speed: float = 1.0, wait: bool = True
    ) -> MachineState:
        """Moves axes so that all begin and end together; ``speed`` is a share of their limits."""
        return await self.do(MachineCalls.coordinated(targets_deg, speed, wait))

    async def lease_state(self) -> LeaseState:
        """Returns the state of the lease."""
        return await self.do(MachineCalls.lease())

    @asynccontextmanager
    async def lease(self, *, force: bool = False) -> AsyncIterator[LeaseGrant]:
        """Holds the lease within the block; it is renewed meanwhile.

        A nested block reuses the lease. Raises LeaseError if another client holds it.
        """
        async with self._held(force) as grant:
            ended = asyncio.Event()
            renewing = asyncio.ensure_future(self._renew(grant, ended))  # async only
            # sync: renewing = threading.Thread(target=self._renew, args=(grant, ended), daemon=True)
            # sync: renewing.start()
            try:
                yield grant
            finally:
                ended.set()
                await asyncio.wait([renewing])  # async only
                # sync: renewing.join()

    @property
    def holds_lease(self) -> bool:
        """True if this client holds the lease."""
        return self._grant is not None

    async def live(self, *, every: int = 1, axes: Sequence[str] | None = None) -> AsyncIterator[Samples]:
        """Yields batches of samples of one cycle in ``every``; each has the number lost by a slow reader."""
        wanted = LiveOptions(every=every, axes=None if axes is None else list(axes))
        async with self.connected("/live") as link:
            await link.send(wanted)
            while True:
                yield await link.receive(Samples)

    @asynccontextmanager
    async def connected(self, path: str) -> AsyncIterator[AsyncLink]:
        """Opens a WebSocket of the API."""
        url, options = sockets.url(self.address, path), sockets.options(self.address, self._tls)
        uds = transport.socket_of(self.address)
        async with AsyncExitStack() as stack:
            transport.check(self.address)
            try:
                opened = connect(url, **options) if uds is None else unix_connect(uds, url, **options)
                connection: Any = await stack.enter_async_context(opened)
            except sockets.FAILURES as problem:
                raise sockets.error_of(problem, self.address) from None
            yield AsyncLink(connection, self.address)

    async def do(self, call: Call[A]) -> A:
        """Sends a request, with the lease if it requires one."""
        if not call.moving:
            return await self._send(call)
        async with self._held():
            return await self._send(call)

    @asynccontextmanager
    async def _held(self, force: bool = False) -> AsyncIterator[LeaseGrant]:
        """Holds the lease, taken by the first user and released by the last."""
        async with self._lock:
            if self._grant is None:
                self._grant = await self._send(MachineCalls.take_lease(self.name, force))
            self._holding += 1
            grant = self._grant
        try:
            yield grant
        finally:
            async with self._lock:
                self._holding -= 1
                if self._holding == 0:
                    with suppress(DaemonError):  # lost, or the daemon is: it is not held any more
                        await self._send(MachineCalls.release_lease())
                    self._grant = None

    async def _send(self, call: Call[A]) -> A:
        wanted = transport.request(call, self._grant, self._timeout_s)
        transport.check(self.address)
        try:
            response = await self._http.request(**wanted)
        except httpx.TransportError as problem:
            raise transport.unreachable(self.address, problem) from None
        return transport.answer(call, response)

    async def _renew(self, grant: LeaseGrant, ended: asyncio.Event) -> None:
        while not await transport.waited(ended, grant.timeout_s / RENEWALS):
            try:
                await self._send(MachineCalls.renew_lease())
            except LeaseError:
                return
            except DaemonError:
                continue


class AsyncLink:
    """A WebSocket that raises errors of hdbridge."""

    def __init__(self, connection: ClientConnection, address: Address) -> None:
        self._connection = connection
        self._address = address

    async def send(self, message: BaseModel) -> None:
        """Sends a message."""
        try:
            await self._connection.send(message.model_dump_json())
        except sockets.FAILURES as problem:
            raise sockets.error_of(problem, self._address) from None

    async def receive(self, kind: type[M]) -> M:
        """Receives the next message."""
        try:
            text = await self._connection.recv()
        except sockets.FAILURES as problem:
            raise sockets.error_of(problem, self._address) from None
        return sockets.read(kind, text)
