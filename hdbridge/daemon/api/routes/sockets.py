"""WebSockets for live samples and for streamed set-points.

A slow client does not slow down the daemon. It receives the newest samples and the number of lost ones. Its
set-points are accepted only as fast as the buffer empties.
"""

import asyncio
from collections.abc import Sequence
from typing import Any, Final, TypeVar

import numpy as np
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from hdbridge.client.messages import (
    AxisColumns,
    Event,
    LiveOptions,
    Problem,
    Samples,
    StreamAnswer,
    StreamBegin,
    StreamPoints,
)
from hdbridge.daemon.api.guard import SUBPROTOCOL
from hdbridge.daemon.api.routes.parts import Bridge, port
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.eventlog import STATES
from hdbridge.errors import HdbridgeError, InputError
from hdbridge.strictness import complaint
from hdbridge.units import ARCSEC_PER_DEG

M = TypeVar("M", bound=BaseModel)
BATCH_S: Final = 0.05
BATCH_MAXIMUM: Final = 512
"""Maximum number of cycles in a message; older ones count as lost."""
SEND_S: Final = 30.0
"""Time-out for sending to a client."""
BEGIN_S: Final = 10.0
"""Time-out for the first message of a stream."""
_REASON_MAXIMUM: Final = 120
"""Maximum length in bytes of a WebSocket's close reason; RFC 6455 permits 123."""
_POLICY_VIOLATION: Final = 1008
_NEWEST: Final = 2**62
"""Number greater than that of any event."""
_NORMAL_CLOSURE: Final = 1000
_ABNORMAL_CLOSURE: Final = 1006


routes = APIRouter()
_COPIED_FIELDS: Final = AxisColumns.model_fields.keys() - {"state", "error_arcsec"}


@routes.websocket("/live")
async def live(bridge: Bridge, websocket: WebSocket) -> None:
    """Sends samples in batches; the client may change its `LiveOptions` at any time."""
    await _accept(websocket)
    options = LiveOptions()

    async def listen() -> None:
        """Receives the client's options until it disconnects; raises InputError for invalid options."""
        nonlocal options
        while True:
            wanted = await _receive(websocket, LiveOptions)
            for each in wanted.axes or ():
                port(bridge, each)
            options = wanted

    async def send() -> None:
        """Sends batches; a client that was slow to take one receives only the newest samples after it."""
        reader = bridge.reader()
        lost, known = 0, bridge.events(_NEWEST).newest
        while True:
            await asyncio.sleep(BATCH_S)  # collects samples, so that messages are fewer and larger
            samples, overwritten = reader.read()
            lost += overwritten + max(len(samples) - BATCH_MAXIMUM, 0)
            happened = bridge.events(known)
            known = max(known, happened.newest)
            names = list(bridge.axes)
            data = columns(samples[-BATCH_MAXIMUM:], names, options, happened.events, lost)
            if data.time_s or data.events:
                await _send(websocket, data)
                lost = 0

    sides = asyncio.ensure_future(listen()), asyncio.ensure_future(send())
    await asyncio.wait(sides, return_when=asyncio.FIRST_COMPLETED)
    for each in sides:
        each.cancel()
    # Close only after both sides have ended.
    for ended in await asyncio.gather(*sides, return_exceptions=True):
        if isinstance(ended, InputError):
            await _close(websocket, str(ended))
        elif isinstance(ended, Exception):
            raise ended


@routes.websocket("/axes/{axis}/stream")
async def stream(bridge: Bridge, websocket: WebSocket, axis: str) -> None:
    """Receives set-points: `StreamBegin`, then `StreamPoints`; each is answered by a `StreamAnswer`."""
    await _accept(websocket)
    try:
        await _stream(bridge, websocket, axis)
    except HdbridgeError as error:
        await _send(websocket, StreamAnswer(accepted=0, problem=Problem.of(error, axis)))
        await _close(websocket, str(error))


async def _stream(bridge: ServiceBridge, websocket: WebSocket, axis: str) -> None:
    try:
        async with asyncio.timeout(BEGIN_S):
            begin = await _receive(websocket, StreamBegin)
    except TimeoutError:
        raise InputError(f"nothing came within {BEGIN_S:g} s; expected StreamBegin") from None
    stream = await port(bridge, axis).motion.stream(begin.lease, begin.timeout_s)
    async with stream:
        await _send(websocket, StreamAnswer(accepted=0))
        while True:
            given = await _receive(websocket, StreamPoints)
            bridge.lease.check(begin.lease)
            if given.points:
                await stream.put(given.points)
            if given.end:
                await stream.end()
            await _send(websocket, StreamAnswer(accepted=len(given.points)))
            if given.end:
                await websocket.close(_NORMAL_CLOSURE)
                return


async def _accept(websocket: WebSocket) -> None:
    offered = websocket.scope.get("subprotocols", [])
    await websocket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)


async def _receive(websocket: WebSocket, kind: type[M]) -> M:
    """Returns the next message; raises InputError if it is of another kind."""
    try:
        text = await websocket.receive_text()
    except KeyError:
        raise InputError(f"found bytes; expected {kind.__name__} as JSON text") from None
    try:
        return kind.model_validate_json(text)
    except ValidationError as problem:
        first = complaint(problem.errors(include_input=False)[0], "the message")
        raise InputError(f"{kind.__name__}: {first}") from None


async def _send(websocket: WebSocket, message: BaseModel) -> None:
    try:
        async with asyncio.timeout(SEND_S):
            await websocket.send_text(message.model_dump_json())
    except TimeoutError:
        raise WebSocketDisconnect(_ABNORMAL_CLOSURE) from None


async def _close(websocket: WebSocket, reason: str) -> None:
    await websocket.close(_POLICY_VIOLATION, reason.encode()[:_REASON_MAXIMUM].decode(errors="ignore"))


def columns(
    samples: NDArray[np.void], names: Sequence[str], options: LiveOptions, events: Sequence[Event], lost: int
) -> Samples:
    """Returns a batch as columns, with the cycles and axes of the options.

    ``names`` are the axes in the order of the samples. NaN stays NaN here and becomes ``null`` in JSON.
    """
    if options.every > 1:
        samples = samples[samples["cycle"] % options.every == 0]
    # Not validated, because these are the daemon's own values, thousands per second.
    return Samples.model_construct(
        time_s=(samples["time_ns"] / 1e9).tolist(),
        cycle=samples["cycle"].tolist(),
        late_us=samples["late_us"].tolist(),
        busy_us=samples["busy_us"].tolist(),
        bus_load=samples["bus_load"].tolist(),
        skipped=samples["skipped"].tolist(),
        axes={
            name: _axis(samples["axes"][:, place])
            for place, name in enumerate(names)
            if options.axes is None or name in options.axes
        },
        events=list(events),
        lost=lost,
    )


def _axis(rows: NDArray[Any]) -> AxisColumns:
    found: dict[str, Any] = {name: rows[name].tolist() for name in _COPIED_FIELDS}
    error_arcsec = ARCSEC_PER_DEG * (rows["load_position_deg"] - rows["load_target_deg"])
    return AxisColumns.model_construct(
        state=[STATES[each].value for each in rows["state"].tolist()],
        error_arcsec=error_arcsec.tolist(),
        **found,
    )
