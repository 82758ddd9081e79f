"""Routes of one axis: state, power, motion, stop, compensation, objects of the drive."""

from fastapi import APIRouter

from hdbridge.client import messages
from hdbridge.daemon.api.routes.parts import (
    LOOKING,
    MOVING,
    STOPPING,
    AxisName,
    Bridge,
    FoundAxis,
    Holder,
    KeptHolder,
    port,
    refusals,
)
from hdbridge.drive.values import Object, Value

routes = APIRouter(prefix="/axes/{axis}")


@routes.get("", tags=["Look"], responses=refusals(LOOKING))
async def get_axis(axis: FoundAxis) -> messages.AxisState:
    """Report the state of an axis in the newest cycle."""
    return axis.state()


@routes.post("/enable", tags=["Power"], responses=refusals(MOVING))
async def enable(axis: FoundAxis, holder: KeptHolder) -> messages.AxisState:
    """Switch power on at rest; the drive is booted and verified first if that was not done."""
    await axis.enable(holder)
    return axis.state()


@routes.post("/disable", tags=["Power"], responses=refusals(MOVING))
async def disable(axis: FoundAxis, holder: KeptHolder) -> messages.AxisState:
    """Brake to rest, then switch power off. A suspended load needs a brake."""
    await axis.disable(holder)
    return axis.state()


@routes.post("/reset", tags=["Power"], responses=refusals(MOVING))
async def reset(axis: FoundAxis, holder: KeptHolder) -> messages.AxisState:
    """Release a latched stop; the drive is verified again if necessary. It stays disabled."""
    await axis.reset(holder)
    return axis.state()


@routes.post("/quick-stop", tags=["Stop"], responses=refusals(STOPPING))
async def quick_stop(axis: FoundAxis) -> messages.AxisState:
    """Stop as fast as the drive can, latched until a reset. Needs no lease."""
    await axis.quick_stop()
    return axis.state()


@routes.post("/stop", tags=["Stop"], responses=refusals(STOPPING))
async def stop(axis: FoundAxis) -> messages.AxisState:
    """Brake to rest and stay enabled; ends jog, queue and stream. Needs no lease."""
    await axis.stop()
    return axis.state()


@routes.post("/home", tags=["Move"], responses=refusals(MOVING))
async def home(axis: FoundAxis, home: messages.Home, holder: KeptHolder) -> messages.AxisState:
    """Home by a method of the drive, disabled before and after."""
    await axis.home(holder, home)
    return axis.state()


@routes.post("/move", tags=["Move"], responses=refusals(MOVING))
async def move(axis: FoundAxis, move: messages.Move, holder: KeptHolder) -> messages.AxisState:
    """Move to a load angle, jerk-limited; a present motion is redirected without a stop."""
    await axis.motion.move(holder, **move.model_dump())
    return axis.state()


@routes.post("/jog", tags=["Move"], responses=refusals(MOVING))
async def jog(axis: FoundAxis, jog: messages.Jog, holder: Holder = "") -> messages.AxisState:
    """Turn at a speed; without another jog within its time-out the axis brakes to rest."""
    await axis.motion.jog(holder, jog.velocity_deg_s, jog.timeout_s)
    return axis.state()


@routes.post("/queue", tags=["Move"], responses=refusals(MOVING))
async def append_queue(axis: FoundAxis, queue: messages.Queue, holder: Holder = "") -> messages.AxisState:
    """Append way points; each begins when the axis rests at the one before."""
    await axis.motion.queue(holder, queue.points)
    return axis.state()


@routes.delete("/queue", tags=["Move"], responses=refusals(MOVING))
async def clear_queue(axis: FoundAxis, holder: Holder = "") -> messages.AxisState:
    """Discard the waiting way points; the present motion continues."""
    await axis.motion.clear_queue(holder)
    return axis.state()


@routes.post("/compensate", tags=["Compensate"], responses=refusals(MOVING))
async def compensate(
    axis: FoundAxis, compensate: messages.Compensate, holder: Holder = ""
) -> messages.AxisState:
    """Select the part of the model that compensates; the change is ramped, also during motion."""
    await axis.compensate(holder, compensate.scheme)
    return axis.state()


@routes.post("/model", tags=["Compensate"], responses=refusals(MOVING))
async def activate_model(
    axis: FoundAxis, model: messages.ActivateModel, holder: Holder = ""
) -> messages.AxisState:
    """Activate another model of the axis's history; the change is ramped, also during motion."""
    await axis.activate_model(holder, model.version)
    return axis.state()


@routes.post("/load-loop", tags=["Compensate"], responses=refusals(MOVING))
async def switch_load_loop(
    axis: FoundAxis, loop: messages.SwitchLoadLoop, holder: Holder = ""
) -> messages.AxisState:
    """Switch the load loop, a slow integral of the measured error, on or off."""
    await axis.switch_load_loop(holder, on=loop.on)
    return axis.state()


@routes.post("/adaptation", tags=["Compensate"], responses=refusals(MOVING))
async def adapt(axis: FoundAxis, adapt: messages.Adapt, holder: Holder = "") -> messages.AxisState:
    """Set the adaptation mode: apply changes of parameters, only report them, or neither."""
    await axis.following_for(holder).set_mode(adapt.mode)
    return axis.state()


@routes.delete("/adaptation", tags=["Compensate"], responses=refusals(MOVING))
async def take_adaptation_back(axis: FoundAxis, holder: Holder = "") -> messages.AxisState:
    """Discard the changes by the adaptation since the model was activated."""
    await axis.following_for(holder).revert()
    return axis.state()


@routes.get("/objects/{name:path}", tags=["Drive"], responses=refusals((*LOOKING, 409, 502, 503)))
async def read_object(bridge: Bridge, axis: AxisName, name: str) -> messages.SdoValue:
    """Read an object of the drive by SDO, by its number (6064h, 0x1018:4) or its EDS name."""
    return _value(*await port(bridge, axis).sdo_read(name))


@routes.put("/objects/{name:path}", tags=["Drive"], responses=refusals(MOVING))
async def write_object(
    bridge: Bridge, axis: AxisName, name: str, write: messages.SdoWrite, holder: Holder = ""
) -> messages.SdoValue:
    """Write an object of the drive by SDO and read it back; refused while the axis is enabled."""
    found = port(bridge, axis)
    written = await found.sdo_write(holder, name, write.value)
    return _value(written, (await found.sdo_read(name))[1] if written.readable else write.value)


def _value(found: Object, value: Value) -> messages.SdoValue:
    return messages.SdoValue(
        index=found.index, subindex=found.sub, name=found.name, type=found.type_name, value=value
    )
