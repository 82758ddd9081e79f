"""Routes of the machine: state, events, lease, motion of all axes, loan of the bus, remarks."""

from typing import Annotated

from fastapi import APIRouter, Query, Request

from hdbridge.client import messages
from hdbridge.daemon.api.routes.parts import (
    MOVING,
    STOPPING,
    Bridge,
    Holder,
    KeptHolder,
    port,
    refusals,
)
from hdbridge.drive.interfacelock import user_name

routes = APIRouter()


@routes.get("/state", tags=["Look"])
async def get_state(bridge: Bridge) -> messages.MachineState:
    """Report the state of the machine and its axes in the newest cycle."""
    return bridge.state()


@routes.get("/events", tags=["Look"], responses=refusals((422,)))
async def get_events(
    bridge: Bridge,
    since: Annotated[
        int, Query(ge=0, le=2**53, description="number of the newest event that is known already")
    ] = 0,
) -> messages.Events:
    """Report the events after the event number ``since``; 0 for all events that are kept."""
    return bridge.events(since)


@routes.post("/mark", tags=["Look"], responses=refusals((400, 422)))
async def mark(bridge: Bridge, mark: messages.Mark) -> messages.Events:
    """Add a remark to the flight recorder at the present cycle. Needs no lease."""
    before = bridge.events(0).newest
    bridge.mark(mark.text)
    return bridge.events(before)


@routes.get("/lease", tags=["Lease"])
async def get_lease(bridge: Bridge) -> messages.LeaseState:
    """Report the state of the lease."""
    return bridge.state().lease


@routes.post("/lease", tags=["Lease"], status_code=201, responses=refusals((400, 422, 423)))
async def take_lease(bridge: Bridge, wanted: messages.LeaseRequest, request: Request) -> messages.LeaseGrant:
    """Take the lease. It lasts while it is used or renewed; 423 names its present holder."""
    client = _who(request, wanted.client.strip())
    token = bridge.lease.take(client, force=wanted.force)
    return messages.LeaseGrant(token=token, client=client, timeout_s=bridge.lease.timeout_s)


@routes.put("/lease", tags=["Lease"], responses=refusals((422, 423)))
async def renew_lease(bridge: Bridge, holder: Holder = "") -> messages.LeaseState:
    """Renew the lease without a motion."""
    bridge.lease.check(holder)
    return bridge.state().lease


@routes.delete("/lease", tags=["Lease"], responses=refusals((422, 423)))
async def release_lease(bridge: Bridge, holder: Holder = "") -> messages.LeaseState:
    """Release the lease. Jog, stream and queue are stopped; a move is completed."""
    bridge.lease.release(holder)
    return bridge.state().lease


@routes.post("/quick-stop", tags=["Stop"], responses=refusals((409, 502, 503)))
async def quick_stop_all(bridge: Bridge) -> messages.MachineState:
    """Stop every axis as fast as its drive can, latched until a reset. Needs no lease."""
    await bridge.quick_stop()
    return bridge.state()


@routes.post("/stop", tags=["Stop"], responses=refusals(tuple(each for each in STOPPING if each != 404)))
async def stop_all(bridge: Bridge) -> messages.MachineState:
    """Brake every axis to rest within its limits; they stay enabled. Needs no lease."""
    for each in bridge.axes.values():
        await each.stop()
    return bridge.state()


@routes.post("/coordinated", tags=["Move"], responses=refusals(MOVING))
async def coordinated(
    bridge: Bridge, moves: messages.Coordinated, holder: KeptHolder
) -> messages.MachineState:
    """Move several axes so that all begin and end together."""
    for name in moves.targets_deg:
        port(bridge, name)
    await bridge.coordinated(holder, moves.targets_deg, moves.speed, moves.wait)
    return bridge.state()


@routes.post("/bus/lend", tags=["Move"], responses=refusals(MOVING))
async def lend_bus(bridge: Bridge, holder: KeptHolder) -> messages.MachineState:
    """Stop all axes, switch them off, and release the bus to another program of the daemon's computer.

    Answers when the interface is free. The program has ten seconds to open it, and the daemon takes the
    bus back when the program has closed it or ended. The axes come back disabled.
    """
    await bridge.lend_bus(holder)
    return bridge.state()


def _who(request: Request, name: str) -> str:
    """Returns the client's name with its user and process, which the kernel reports on a Unix socket."""
    peer, number = request.client or ("a client", 0)
    if not peer.startswith("uid="):
        return name or f"{peer}:{number}"
    process = f"{user_name(int(peer.removeprefix('uid=')))}, process {number}"
    return f"{name} ({process})" if name else process
