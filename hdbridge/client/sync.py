"""The synchronous client: runs the asyncio client in an event loop in its own thread.

    from hdbridge import Client

    with Client() as client, client.lease():
        axis = client.axis("joint-3")
        axis.enable()
        for target_deg in (10, 20, 30):
            print(axis.move(target_deg).error_arcsec)

Each method does the same as in `hdbridge.client.aio`, returns on completion, and may be called from any
thread.
"""

from __future__ import annotations

import asyncio
import threading
import weakref
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, AsyncExitStack, contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

from hdbridge.client.address import Address
from hdbridge.client.aio import JOG_S, AsyncAxis, AsyncClient, AsyncStream
from hdbridge.client.messages import LeaseGrant, Samples

P = ParamSpec("P")
T = TypeVar("T")


class _Thread:
    """Thread that runs coroutines until `end`, and then closes the client."""

    def __init__(self, client: AsyncClient) -> None:
        begun: Future[asyncio.AbstractEventLoop] = Future()
        self._ended = ended = asyncio.Event()

        async def serve() -> None:
            begun.set_result(asyncio.get_running_loop())
            async with client:
                await ended.wait()

        self._thread = threading.Thread(target=lambda: asyncio.run(serve()), name="hdbridge", daemon=True)
        self._thread.start()
        self._loop = begun.result()

    def end(self) -> None:
        """Requests the end of the thread without waiting for it, because the garbage collector may call this
        method in this thread.
        """
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ended.set)

    def join(self) -> None:
        """Ends the thread and waits for it."""
        self.end()
        self._thread.join()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Returns the result of a coroutine; cancels it if the wait is interrupted (Ctrl-C)."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    @contextmanager
    def within(self, context: AbstractAsyncContextManager[T]) -> Iterator[T]:
        """Enters an asynchronous context for the block."""
        stack = AsyncExitStack()
        value = self.run(stack.enter_async_context(context))
        try:
            yield value
        except BaseException as error:
            self.run(stack.__aexit__(type(error), error, error.__traceback__))
            raise
        self.run(stack.aclose())


def _waits(method: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]) -> Callable[Concatenate[Any, P], T]:
    """Returns the synchronous form of a method of the asyncio client."""

    @wraps(method)
    def call(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:
        thread: _Thread = self._thread
        return thread.run(method(self._own, *args, **kwargs))

    return call


class Stream:
    """Open stream of set-points."""

    def __init__(self, thread: _Thread, own: AsyncStream) -> None:
        self._thread, self._own = thread, own

    put = _waits(AsyncStream.put)
    end = _waits(AsyncStream.end)


class Axis:
    """Axis of a daemon. Methods that move it return when it is at rest again, unless ``wait`` is False."""

    def __init__(self, client: Client, name: str) -> None:
        self.client, self.name = client, name
        self._thread, self._own = client._thread, AsyncAxis(client._own, name)

    state = _waits(AsyncAxis.state)
    enable = _waits(AsyncAxis.enable)
    disable = _waits(AsyncAxis.disable)
    reset = _waits(AsyncAxis.reset)
    stop = _waits(AsyncAxis.stop)
    quick_stop = _waits(AsyncAxis.quick_stop)
    home = _waits(AsyncAxis.home)
    move = _waits(AsyncAxis.move)
    jog = _waits(AsyncAxis.jog)
    queue = _waits(AsyncAxis.queue)
    clear_queue = _waits(AsyncAxis.clear_queue)
    rest = _waits(AsyncAxis.rest)
    compensate = _waits(AsyncAxis.compensate)
    activate_model = _waits(AsyncAxis.activate_model)
    load_loop = _waits(AsyncAxis.load_loop)
    adapt = _waits(AsyncAxis.adapt)
    revert_adaptation = _waits(AsyncAxis.revert_adaptation)
    read = _waits(AsyncAxis.read)
    write = _waits(AsyncAxis.write)

    @contextmanager
    def stream(self, timeout_s: float = JOG_S) -> Iterator[Stream]:
        """Follows set-points that are put within the block, like `AsyncAxis.stream`."""
        with self._thread.within(self._own.stream(timeout_s)) as stream:
            yield Stream(self._thread, stream)


class Client:
    """Client of a daemon, with the arguments of `AsyncClient`; to be closed or used as a context manager."""

    def __init__(
        self,
        address: str | Path | None = None,
        *,
        token: str | None = None,
        name: str = "",
        timeout_s: float = 10.0,
    ) -> None:
        self._own = AsyncClient(address, token=token, name=name, timeout_s=timeout_s)
        self._thread = _Thread(self._own)
        weakref.finalize(self, self._thread.end)  # for a client that is not closed, such as a temporary one

    @property
    def address(self) -> Address:
        return self._own.address

    @property
    def name(self) -> str:
        """Name that other clients see while this one holds the lease."""
        return self._own.name

    @property
    def holds_lease(self) -> bool:
        """True if this client holds the lease."""
        return self._own.holds_lease

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections."""
        self._thread.join()

    state = _waits(AsyncClient.state)
    events = _waits(AsyncClient.events)
    mark = _waits(AsyncClient.mark)
    stop = _waits(AsyncClient.stop)
    quick_stop = _waits(AsyncClient.quick_stop)
    lend_bus = _waits(AsyncClient.lend_bus)
    coordinated = _waits(AsyncClient.coordinated)
    lease_state = _waits(AsyncClient.lease_state)

    def axis(self, name: str) -> Axis:
        """Returns an axis. Its name is checked by the first request."""
        return Axis(self, name)

    @property
    def axes(self) -> dict[str, Axis]:
        """All axes of the machine by name."""
        return {each.name: Axis(self, each.name) for each in self.state().axes}

    @contextmanager
    def lease(self, *, force: bool = False) -> Iterator[LeaseGrant]:
        """Holds and renews the lease within the block.

        A nested block reuses the lease. Raises LeaseError if another client holds it.
        """
        with self._thread.within(self._own.lease(force=force)) as grant:
            yield grant

    def live(self, *, every: int = 1, axes: Sequence[str] | None = None) -> Iterator[Samples]:
        """Yields batches of samples of every ``every``-th cycle, with the number lost by a slow reader."""
        batches = self._own.live(every=every, axes=axes)

        async def following() -> Samples:
            return await anext(batches)

        try:
            while True:
                yield self._thread.run(following())
        finally:
            self._thread.run(batches.aclose())
