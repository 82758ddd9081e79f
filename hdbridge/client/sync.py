# Made by tools/synchronous_client.py from aio.py: edit that file.
"""The synchronous client.

    from hdbridge import Client

    with Client() as client, client.lease():
        axis = client.axis("joint-3")
        axis.enable()
        for target_deg in (10, 20, 30):
            print(axis.move(target_deg).error_arcsec)

Motion requires the lease. A method that moves an axis takes it while it runs, unless `Client.lease`
holds it already. Every error is one of `hdbridge.errors`.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import httpx
from pydantic import BaseModel
from websockets.sync.client import ClientConnection, connect, unix_connect

from hdbridge.client import sockets, transport
from hdbridge.client.address import Address, find
from hdbridge.client.axis import Axis
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


class Client:
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
        self._lock = threading.Lock()
        self._holding = 0
        self._grant: LeaseGrant | None = None
        under = httpx.HTTPTransport(**transport.under(self.address, self._tls))
        self._http = httpx.Client(transport=under, **transport.settings(self.address))
        weakref.finalize(self, self._http.close)  # of a client that lives for one line only

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections."""
        self._http.close()

    def axis(self, name: str) -> Axis:
        """Returns an axis. Its name is checked by the first request."""
        return Axis(self, name)

    @property
    def axes(self) -> dict[str, Axis]:
        """Returns all axes of the machine by name."""
        return {each.name: Axis(self, each.name) for each in self.state().axes}

    def state(self) -> MachineState:
        """Returns the state of the machine and its axes."""
        return self.do(MachineCalls.state())

    def events(self, since: int = 0) -> Events:
        """Returns the events after number ``since``."""
        return self.do(MachineCalls.events(since))

    def mark(self, text: str) -> list[Event]:
        """Adds a remark to the event log and the flight recorder."""
        return self.do(MachineCalls.mark(text)).events

    def stop(self) -> MachineState:
        """Brakes all axes to rest. Requires no lease."""
        return self.do(MachineCalls.stop_all())

    def quick_stop(self) -> MachineState:
        """Quick-stops all axes and latches the stops until a reset. Requires no lease."""
        return self.do(MachineCalls.quick_stop_all())

    def lend_bus(self) -> MachineState:
        """Stops all axes and makes the daemon release its bus to another program of its computer.

        That program has ten seconds to open the bus. The daemon takes the bus back when it is closed.
        """
        return self.do(MachineCalls.lend_bus())

    def coordinated(
        self, targets_deg: Mapping[str, float], *, speed: float = 1.0, wait: bool = True
    ) -> MachineState:
        """Moves axes so that all begin and end together; ``speed`` is a share of their limits."""
        return self.do(MachineCalls.coordinated(targets_deg, speed, wait))

    def lease_state(self) -> LeaseState:
        """Returns the state of the lease."""
        return self.do(MachineCalls.lease())

    @contextmanager
    def lease(self, *, force: bool = False) -> Iterator[LeaseGrant]:
        """Holds the lease within the block; it is renewed meanwhile.

        A nested block reuses the lease. Raises LeaseError if another client holds it.
        """
        with self._held(force) as grant:
            ended = threading.Event()
            renewing = threading.Thread(target=self._renew, args=(grant, ended), daemon=True)
            renewing.start()
            try:
                yield grant
            finally:
                ended.set()
                renewing.join()

    @property
    def holds_lease(self) -> bool:
        """True if this client holds the lease."""
        return self._grant is not None

    def live(self, *, every: int = 1, axes: Sequence[str] | None = None) -> Iterator[Samples]:
        """Yields batches of samples of one cycle in ``every``; each has the number lost by a slow reader."""
        wanted = LiveOptions(every=every, axes=None if axes is None else list(axes))
        with self.connected("/live") as link:
            link.send(wanted)
            while True:
                yield link.receive(Samples)

    @contextmanager
    def connected(self, path: str) -> Iterator[Link]:
        """Opens a WebSocket of the API."""
        url, options = sockets.url(self.address, path), sockets.options(self.address, self._tls)
        uds = transport.socket_of(self.address)
        with ExitStack() as stack:
            transport.check(self.address)
            try:
                opened = connect(url, **options) if uds is None else unix_connect(uds, url, **options)
                connection: Any = stack.enter_context(opened)
            except sockets.FAILURES as problem:
                raise sockets.error_of(problem, self.address) from None
            yield Link(connection, self.address)

    def do(self, call: Call[A]) -> A:
        """Sends a request, with the lease if it requires one."""
        if not call.moving:
            return self._send(call)
        with self._held():
            return self._send(call)

    @contextmanager
    def _held(self, force: bool = False) -> Iterator[LeaseGrant]:
        """Holds the lease, taken by the first user and released by the last."""
        with self._lock:
            if self._grant is None:
                self._grant = self._send(MachineCalls.take_lease(self.name, force))
            self._holding += 1
            grant = self._grant
        try:
            yield grant
        finally:
            with self._lock:
                self._holding -= 1
                if self._holding == 0:
                    with suppress(DaemonError):  # lost, or the daemon is: it is not held any more
                        self._send(MachineCalls.release_lease())
                    self._grant = None

    def _send(self, call: Call[A]) -> A:
        wanted = transport.request(call, self._grant, self._timeout_s)
        transport.check(self.address)
        try:
            response = self._http.request(**wanted)
        except httpx.TransportError as problem:
            raise transport.unreachable(self.address, problem) from None
        return transport.answer(call, response)

    def _renew(self, grant: LeaseGrant, ended: threading.Event) -> None:
        while not ended.wait(grant.timeout_s / RENEWALS):
            try:
                self._send(MachineCalls.renew_lease())
            except LeaseError:
                return
            except DaemonError:
                continue


class Link:
    """A WebSocket that raises errors of hdbridge."""

    def __init__(self, connection: ClientConnection, address: Address) -> None:
        self._connection = connection
        self._address = address

    def send(self, message: BaseModel) -> None:
        """Sends a message."""
        try:
            self._connection.send(message.model_dump_json())
        except sockets.FAILURES as problem:
            raise sockets.error_of(problem, self._address) from None

    def receive(self, kind: type[M]) -> M:
        """Receives the next message."""
        try:
            text = self._connection.recv()
        except sockets.FAILURES as problem:
            raise sockets.error_of(problem, self._address) from None
        return sockets.read(kind, text)
