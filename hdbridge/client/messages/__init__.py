"""Typed messages between the daemon and its clients. Both ends import this and nothing of each other.

    values.py    numbers, names and enumerations that several messages share
    state.py     state of the machine and its axes
    requests.py  requests of a client
    lease.py     the lease
    live.py      live samples and events
    problem.py   errors (RFC 9457) and their conversion to `hdbridge.errors`

Angles are degrees at the load unless the name says ``motor``; errors and corrections are arcseconds at the
load. A request refuses unknown keys, NaN and infinity; a report ignores keys that a newer daemon adds.
"""

from hdbridge.client.messages.lease import LeaseGrant, LeaseRequest, LeaseState
from hdbridge.client.messages.live import (
    AxisColumns,
    Event,
    EventKind,
    Events,
    LiveOptions,
    Samples,
    StreamAnswer,
    StreamBegin,
    StreamPoints,
)
from hdbridge.client.messages.problem import Problem
from hdbridge.client.messages.requests import (
    ActivateModel,
    Adapt,
    Compensate,
    Coordinated,
    Home,
    Jog,
    Mark,
    Move,
    Queue,
    QueueItem,
    SdoValue,
    SdoWrite,
    StreamPoint,
    SwitchLoadLoop,
)
from hdbridge.client.messages.state import (
    AdaptationState,
    AxisState,
    BusState,
    CycleState,
    Fault,
    Limits,
    LoadLoopState,
    MachineState,
    ModelInUse,
    OuterState,
    RecorderState,
    RefinedResponse,
)
from hdbridge.client.messages.values import (
    AdaptationMode,
    ControlState,
    MotionMode,
    PowerState,
    Scheme,
)

__all__ = [
    "ActivateModel",
    "Adapt",
    "AdaptationMode",
    "AdaptationState",
    "AxisColumns",
    "AxisState",
    "BusState",
    "Compensate",
    "ControlState",
    "Coordinated",
    "CycleState",
    "Event",
    "EventKind",
    "Events",
    "Fault",
    "Home",
    "Jog",
    "LeaseGrant",
    "LeaseRequest",
    "LeaseState",
    "Limits",
    "LiveOptions",
    "LoadLoopState",
    "MachineState",
    "Mark",
    "ModelInUse",
    "MotionMode",
    "Move",
    "OuterState",
    "PowerState",
    "Problem",
    "Queue",
    "QueueItem",
    "RecorderState",
    "RefinedResponse",
    "Samples",
    "Scheme",
    "SdoValue",
    "SdoWrite",
    "StreamAnswer",
    "StreamBegin",
    "StreamPoint",
    "StreamPoints",
    "SwitchLoadLoop",
]
