"""Routes of one axis: state, power, motion, stop, compensation, objects of the drive."""

from fastapi import APIRouter, Request

from hdbridge.client import messages
from hdbridge.commissioning.evaluation.stepping import Scheme
from hdbridge.daemon.api.routes.parts import (
    LOOKING,
    MOVING,
    STOPPING,
    AxisName,
    Holder,
    kept,
    port,
    refusals,
    stopped,
)
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.moves import WayPoint


def axis_routes(bridge: ServiceBridge) -> APIRouter:
    """Returns all routes below ``/axes/{axis}`` except the stream."""
    routes = APIRouter(prefix="/axes/{axis}")
    _add_power(routes, bridge)
    _add_motion(routes, bridge)
    _add_compensation(routes, bridge)
    _add_objects(routes, bridge)
    return routes


def _add_power(routes: APIRouter, bridge: ServiceBridge) -> None:
    @routes.get("", tags=["Look"], responses=refusals(LOOKING))
    async def get_axis(axis: AxisName) -> messages.AxisState:
        """Report the state of an axis in the newest cycle."""
        return port(bridge, axis).state()

    @routes.post("/enable", tags=["Power"], responses=refusals(MOVING))
    async def enable(axis: AxisName, request: Request, holder: Holder = "") -> messages.AxisState:
        """Switch power on at rest; the drive is booted and verified first if that was not done."""
        found = port(bridge, axis)
        await kept(bridge, holder, request, found.enable(holder))
        return found.state()

    @routes.post("/disable", tags=["Power"], responses=refusals(MOVING))
    async def disable(axis: AxisName, request: Request, holder: Holder = "") -> messages.AxisState:
        """Brake to rest, then switch power off. A suspended load needs a brake."""
        found = port(bridge, axis)
        await kept(bridge, holder, request, found.disable(holder))
        return found.state()

    @routes.post("/reset", tags=["Power"], responses=refusals(MOVING))
    async def reset(axis: AxisName, request: Request, holder: Holder = "") -> messages.AxisState:
        """Release a latched stop; the drive is verified again if necessary. It stays disabled."""
        found = port(bridge, axis)
        await kept(bridge, holder, request, found.reset(holder))
        return found.state()

    @routes.post("/quick-stop", tags=["Stop"], responses=refusals(STOPPING))
    async def quick_stop(axis: AxisName) -> messages.AxisState:
        """Stop as fast as the drive can, latched until a reset. Needs no lease."""
        found = port(bridge, axis)
        await found.quick_stop()
        await stopped(found)
        return found.state()

    @routes.post("/stop", tags=["Stop"], responses=refusals(STOPPING))
    async def stop(axis: AxisName) -> messages.AxisState:
        """Brake to rest and stay enabled; ends jog, queue and stream. Needs no lease."""
        found = port(bridge, axis)
        await found.stop()
        return found.state()


def _add_motion(routes: APIRouter, bridge: ServiceBridge) -> None:
    @routes.post("/home", tags=["Move"], responses=refusals(MOVING))
    async def home(
        axis: AxisName, home: messages.Home, request: Request, holder: Holder = ""
    ) -> messages.AxisState:
        """Home by a method of the drive, disabled before and after."""
        found = port(bridge, axis)
        await kept(bridge, holder, request, found.home(holder, home))
        return found.state()

    @routes.post("/move", tags=["Move"], responses=refusals(MOVING))
    async def move(
        axis: AxisName, move: messages.Move, request: Request, holder: Holder = ""
    ) -> messages.AxisState:
        """Move to a load angle, jerk-limited; a present motion is redirected without a stop."""
        found = port(bridge, axis)
        await kept(bridge, holder, request, found.move(holder, **move.model_dump()))
        return found.state()

    @routes.post("/jog", tags=["Move"], responses=refusals(MOVING))
    async def jog(axis: AxisName, jog: messages.Jog, holder: Holder = "") -> messages.AxisState:
        """Turn at a speed; without another jog within its time-out the axis brakes to rest."""
        found = port(bridge, axis)
        await found.jog(holder, jog.velocity_deg_s, jog.timeout_s)
        return found.state()

    @routes.post("/queue", tags=["Move"], responses=refusals(MOVING))
    async def append_queue(axis: AxisName, queue: messages.Queue, holder: Holder = "") -> messages.AxisState:
        """Append way points; each begins when the axis rests at the one before."""
        found = port(bridge, axis)
        await found.queue(holder, [WayPoint(**each.model_dump()) for each in queue.points])
        return found.state()

    @routes.delete("/queue", tags=["Move"], responses=refusals(MOVING))
    async def clear_queue(axis: AxisName, holder: Holder = "") -> messages.AxisState:
        """Discard the waiting way points; the present motion continues."""
        found = port(bridge, axis)
        await found.clear_queue(holder)
        return found.state()


def _add_compensation(routes: APIRouter, bridge: ServiceBridge) -> None:
    @routes.post("/compensate", tags=["Compensate"], responses=refusals(MOVING))
    async def compensate(
        axis: AxisName, compensate: messages.Compensate, holder: Holder = ""
    ) -> messages.AxisState:
        """Select the part of the model that compensates; the change is ramped, also during motion."""
        found = port(bridge, axis)
        await found.compensate(holder, Scheme(compensate.scheme.value))
        return found.state()

    @routes.post("/model", tags=["Compensate"], responses=refusals(MOVING))
    async def activate_model(
        axis: AxisName, model: messages.ActivateModel, holder: Holder = ""
    ) -> messages.AxisState:
        """Activate another model of the axis's history; the change is ramped, also during motion."""
        found = port(bridge, axis)
        await found.activate_model(holder, model.version)
        return found.state()

    @routes.post("/load-loop", tags=["Compensate"], responses=refusals(MOVING))
    async def switch_load_loop(
        axis: AxisName, loop: messages.SwitchLoadLoop, holder: Holder = ""
    ) -> messages.AxisState:
        """Switch the load loop, a slow integral of the measured error, on or off."""
        found = port(bridge, axis)
        await found.switch_load_loop(holder, on=loop.on)
        return found.state()

    @routes.post("/adaptation", tags=["Compensate"], responses=refusals(MOVING))
    async def adapt(axis: AxisName, adapt: messages.Adapt, holder: Holder = "") -> messages.AxisState:
        """Set the adaptation mode: apply changes of parameters, only report them, or neither."""
        found = port(bridge, axis)
        await found.adapt(holder, adapt.mode)
        return found.state()

    @routes.delete("/adaptation", tags=["Compensate"], responses=refusals(MOVING))
    async def take_adaptation_back(axis: AxisName, holder: Holder = "") -> messages.AxisState:
        """Discard the changes by the adaptation since the model was activated."""
        found = port(bridge, axis)
        await found.revert_adaptation(holder)
        return found.state()


def _add_objects(routes: APIRouter, bridge: ServiceBridge) -> None:
    @routes.get("/objects/{name:path}", tags=["Drive"], responses=refusals((*LOOKING, 409, 502, 503)))
    async def read_object(axis: AxisName, name: str) -> messages.SdoValue:
        """Read an object of the drive by SDO, by its number (6064h, 0x1018:4) or its EDS name."""
        found, value = await port(bridge, axis).sdo_read(name)
        return messages.SdoValue(
            index=found.index, subindex=found.sub, name=found.name, type=found.type_name, value=value
        )

    @routes.put("/objects/{name:path}", tags=["Drive"], responses=refusals(MOVING))
    async def write_object(
        axis: AxisName, name: str, write: messages.SdoWrite, holder: Holder = ""
    ) -> messages.SdoValue:
        """Write an object of the drive by SDO and read it back; refused while the axis is enabled."""
        found = port(bridge, axis)
        written = await found.sdo_write(holder, name, write.value)
        value = (await found.sdo_read(name))[1] if written.readable else write.value
        return messages.SdoValue(
            index=written.index, subindex=written.sub, name=written.name, type=written.type_name, value=value
        )
