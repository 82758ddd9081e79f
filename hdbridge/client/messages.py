"""Typed messages between the daemon and its clients, imported by both.

Angles are degrees at the load unless the name says ``motor``; errors and corrections are arcseconds at the
load. A request refuses unknown keys, NaN and infinity; a report ignores keys that a newer daemon adds.
"""

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from hdbridge import errors
from hdbridge.enums import AdaptationMode, PowerState, Scheme
from hdbridge.errors import HdbridgeError, InputError
from hdbridge.strictness import complaint

WORDS_MAXIMUM: Final = 400
"""Maximum length of a client's text."""

_PRINTABLE: Final = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]*$"
"""Text without characters that move a terminal's cursor, start a log line or reverse the writing
direction."""
Real = Annotated[float, Field(strict=True, allow_inf_nan=False)]
"""Number (a string is refused); NaN and infinity are refused."""
Angle = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e7, le=1e7)]
"""Degrees at the load, multi-turn; the axis's own limits are narrower."""
Speed = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=1e5)]
"""Degrees per second at the load, without a sign."""
Velocity = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e5, le=1e5)]
"""Degrees per second at the load, with a sign."""
Acceleration = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=1e7)]
"""Degrees per second squared at the load."""
Seconds = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=86_400)]
Name = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
"""Name of an axis or a machine, as in its file."""
Words = Annotated[str, StringConstraints(strict=True, max_length=WORDS_MAXIMUM, pattern=_PRINTABLE)]
"""One line of text."""


class Request(BaseModel):
    """Message of a client; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def given(cls, **values: Any) -> Self:
        """Builds a request; raises InputError for an invalid value before anything is sent."""
        try:
            return cls.model_validate(values)
        except ValidationError as problem:
            raise InputError(complaint(problem.errors()[0])) from None


class Report(BaseModel):
    """Message of the daemon; keys that a newer daemon adds are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", ser_json_inf_nan="null")


class ControlState(StrEnum):
    """State of an axis in the control loop, in the order of the loop's numbers."""

    UNVERIFIED = "unverified"
    """The drive was not verified against its axis file; nothing is sent to it."""
    DISABLED = "disabled"
    ENABLING = "enabling"
    ENABLED = "enabled"
    STOPPING = "stopping"
    """Braking to rest, then switching power off."""
    LENT = "lent"
    """The service controls the drive, for homing; the loop sends it no targets."""
    QUICK_STOPPED = "quick-stopped"
    """Latched until a reset."""
    LATCHED = "latched"
    """Latched until the drive is verified again."""


class MotionMode(StrEnum):
    """Source of an axis's targets, in the order of the loop's numbers."""

    HOLD = "hold"
    GOTO = "goto"
    JOG = "jog"
    STREAM = "stream"
    STOP = "stop"
    FOLLOW = "follow"
    """Following the set-points of another master, through the gateway."""


# ---------------------------------------- errors


CONTENT_TYPE: Final = "application/problem+json"
TYPE_PREFIX: Final = "urn:hdbridge:problem:"

STATUS: Final[dict[type[HdbridgeError], tuple[int, str]]] = {
    errors.LeaseError: (423, "The right to move is not yours"),
    errors.RefusedError: (409, "Not in this state"),
    errors.DaemonError: (403, "Refused"),
    errors.InputError: (422, "The request cannot be met"),
    errors.BusInUseError: (409, "Another master is on the bus"),
    errors.BusError: (503, "The bus is not there"),
    errors.IdentityError: (409, "Not the drive of the axis file"),
    errors.TransitionError: (409, "Not in this state"),
    errors.SdoError: (502, "The drive refused access to the object"),
    errors.DriveError: (502, "The drive refused"),
    errors.SafetyStop: (409, "Stopped by the supervision"),
    errors.OutputError: (507, "A result could not be written"),
    HdbridgeError: (500, "An error in hdbridge"),
}
"""Status and title of each hdbridge error; the first matching row applies."""


class Problem(Report):
    """Problem document: the reason for the failure of a request."""

    type: str = Field(description="kind of error, as a URN", examples=[f"{TYPE_PREFIX}LeaseError"])
    title: str = Field(description="the kind in words", examples=["The right to move is not yours"])
    status: int = Field(ge=400, le=599, description="HTTP status", examples=[423])
    detail: str = Field(
        description="error, expectation and remedy in one line",
        examples=["'cell controller' holds the lease for another 4.2 s; wait, or take it with force"],
    )
    axis: str | None = Field(None, description="the axis concerned", examples=["joint-3"])
    hint: str | None = Field(None, description="advice to the user")
    errors: list[str] = Field(
        default=[],
        description="complaints about an invalid request, each with its key",
        examples=[["target_deg: expected a finite number"]],
    )

    @classmethod
    def of(cls, error: HdbridgeError, axis: str | None = None) -> Self:
        """Returns the problem for an error."""
        kind, (status, title) = next(row for row in STATUS.items() if isinstance(error, row[0]))
        detail = str(error)
        said, _, hint = detail.rpartition("; ")
        return cls(
            type=f"{TYPE_PREFIX}{kind.__name__}",
            title=title,
            status=status,
            detail=detail,
            axis=axis,
            hint=hint if said else None,
        )

    def error(self) -> HdbridgeError:
        """Returns the error for the client; DaemonError for an unknown kind."""
        name = self.type.removeprefix(TYPE_PREFIX)
        kind = next((each for each in STATUS if each.__name__ == name), errors.DaemonError)
        return kind("; ".join((self.detail, *self.errors)))


# ---------------------------------------- the lease


class LeaseRequest(Request):
    """Request for the lease."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"client": "cell controller", "force": False}]})

    client: Words = Field("", description="name shown to other clients; by default user and process")
    force: bool = Field(False, strict=True, description="take the lease; the holder's motion is stopped")


class LeaseGrant(Report):
    """Granted lease, whose token goes into the header ``X-Lease`` of each request that moves an axis."""

    token: str = Field(description="secret that permits motion", examples=["mZ3sWJx0b0lq"])
    client: str = Field(description="name of the holder")
    timeout_s: Seconds = Field(description="time without use after which the lease ends", examples=[5.0])


class LeaseState(Report):
    """State of the lease, without its token."""

    held: bool = Field(description="True if a client holds the lease")
    client: str | None = Field(None, description="name of the holder", examples=["cell controller"])
    since: datetime | None = Field(None, description="time at which the lease was taken")
    remaining_s: float | None = Field(
        None, description="time until the lease expires; each use extends it", examples=[4.2]
    )
    timeout_s: float = Field(description="time without use after which the lease ends", examples=[5.0])


# ---------------------------------------- requests


QUEUE_MAXIMUM: Final = 1000
"""Maximum number of way points in a request."""
AXES_MAXIMUM: Final = 32


class Move(Request):
    """Move to a load angle, jerk-limited; a present motion is redirected without a stop."""

    target_deg: Angle = Field(description="load angle to go to, degrees", examples=[30.0])
    velocity_deg_s: Speed | None = Field(
        None, description="highest speed, deg/s; else the axis's limit", examples=[20.0]
    )
    acceleration_deg_s2: Acceleration | None = Field(
        None, description="highest acceleration, deg/s2; else the axis's limit", examples=[100.0]
    )
    wait: bool = Field(True, strict=True, description="answer when the axis rests there; else at once")


class Coordinated(Request):
    """Move several axes to their targets, so that all begin and end together."""

    targets_deg: dict[Name, Angle] = Field(
        min_length=1,
        max_length=AXES_MAXIMUM,
        description="load angle of each axis, degrees",
        examples=[{"joint-1": 30.0, "joint-2": -12.5}],
    )
    speed: Annotated[Real, Field(gt=0, le=1)] = Field(
        1.0, description="fraction of each axis's limits of speed and acceleration", examples=[0.5]
    )
    wait: bool = Field(True, strict=True, description="answer when all rest; else at once")


class Jog(Request):
    """Turn at a speed while the request is repeated, as with a dead man's switch."""

    velocity_deg_s: Velocity = Field(description="speed with its sign, deg/s; 0 stops", examples=[-5.0])
    timeout_s: Annotated[Real, Field(gt=0, le=5)] = Field(
        0.5, description="without another jog by then the axis stops within its limits", examples=[0.5]
    )


class QueueItem(Request):
    """Way point: a move, a rest, and the continuation."""

    target_deg: Angle = Field(description="load angle, degrees", examples=[45.0])
    velocity_deg_s: Speed | None = Field(None, description="highest speed, deg/s; else the axis's limit")
    acceleration_deg_s2: Acceleration | None = Field(
        None, description="highest acceleration, deg/s2; else the axis's limit"
    )
    dwell_s: Seconds = Field(0.0, description="rest there before the next, seconds", examples=[0.5])


class Queue(Request):
    """Way points to append to the queue."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"points": [{"target_deg": 10.0}, {"target_deg": 20.0}]}]}
    )

    points: list[QueueItem] = Field(min_length=1, max_length=QUEUE_MAXIMUM)


class StreamPoint(Request):
    """Knot of a streamed path; the daemon interpolates between knots (cubic Hermite)."""

    time_s: Annotated[Real, Field(ge=0, le=1e7)] = Field(
        description="since the stream began, seconds; later than the knot before", examples=[0.02]
    )
    position_deg: Angle = Field(description="load angle then, degrees", examples=[10.002])
    velocity_deg_s: Velocity | None = Field(
        None, description="speed at this point, deg/s; else the slope between its neighbours", examples=[0.2]
    )


class Compensate(Request):
    """Select the parts of the model that compensate; the change is ramped."""

    scheme: Scheme = Field(description="`none` switches the compensation off", examples=["both"])


class SwitchLoadLoop(Request):
    """Switch the load loop (integral of the measured error) on or off, if the machine file has one."""

    on: bool = Field(strict=True, description="on, or off", examples=[True])


class ActivateModel(Request):
    """Activate a model of the axis's history, also during motion; the change is ramped."""

    version: Annotated[int, Field(strict=True, ge=1, le=10**9)] | Literal["pending", "active"] = Field(
        description="number in `hdbridge model log`; `pending` commits the pending one, `active` "
        "reads the active one again",
        examples=[4],
    )


class Home(Request):
    """Home by a method of the drive (CiA 402, mode HM)."""

    method: Annotated[int, Field(strict=True, ge=-128, le=127)] = Field(
        description="homing method, 6098h: see the drive's manual", examples=[37]
    )
    switch_velocity_deg_s: Speed | None = Field(
        None, description="speed towards the switch, deg/s at the load; else chosen by the daemon"
    )
    zero_velocity_deg_s: Speed | None = Field(
        None, description="speed towards the zero, deg/s at the load; else chosen by the daemon"
    )
    acceleration_deg_s2: Acceleration | None = Field(
        None, description="acceleration, deg/s2 at the load; else the axis's limit"
    )
    offset_deg: Angle = Field(0.0, description="load angle of the home position (607Ch)")
    timeout_s: Annotated[Real, Field(ge=0.1, le=3600)] = Field(60.0, description="time-out, seconds")


class SdoWrite(Request):
    """Value for an object of the drive, of the type given by its EDS."""

    value: Annotated[str, StringConstraints(strict=True, min_length=1, max_length=2000)] = Field(
        description="decimal or 0x...; text, or bytes in hexadecimal", examples=["0x10"]
    )


class SdoValue(Report):
    """Value read from an object of the drive."""

    index: int = Field(ge=0, le=0xFFFF, description="number of the object", examples=[0x6064])
    subindex: int = Field(ge=0, le=0xFF, examples=[0])
    name: str = Field(description="its name in the EDS", examples=["Position actual value"])
    type: str = Field(description="its type", examples=["int32"])
    value: int | float | bool | str | None = Field(
        description="bytes are hexadecimal; None for a float that is not a number", examples=[123456]
    )


class Mark(Request):
    """Remark for the flight recorder, at the present cycle."""

    text: Words = Field(min_length=1, examples=["coupling tightened"])


class Adapt(Request):
    """Mode in which the model's parameters follow the load encoder."""

    mode: AdaptationMode = Field(examples=["observe"])


# ---------------------------------------- live samples, events and the WebSockets


POINTS_MAXIMUM: Final = 1000
"""Maximum number of stream points in a message."""
_Column = list[float | None]


class EventKind(StrEnum):
    """Kind of an event of the loop or the service."""

    DONE = "done"
    REFUSED = "refused"
    STATE = "state"
    FAULT = "fault"
    STOPPED = "stopped"
    MOTION_ENDED = "motion-ended"
    UNDERRUN = "underrun"
    BUS_DOWN = "bus-down"
    BUS_UP = "bus-up"
    CHANGED = "changed"
    STREAM_REFUSED = "stream-refused"
    ENDING = "ending"
    LOAD_LOOP = "load-loop"
    NOTE = "note"
    """Note of the service: about a lease, the recorder, the watch or the adaptation."""


class Event(Report):
    """Event of the loop or the service."""

    sequence: int = Field(ge=0, description="counts from the start of the service", examples=[17])
    kind: EventKind
    date: datetime = Field(description="by the machine's clock")
    cycle: int | None = Field(None, description="cycle of the loop")
    axis: Name | None = Field(None, description="None for the machine")
    text: str = Field("", description="in words", examples=["cycle 120: a TPDO is missing (282h): freeze"])
    hint: str | None = Field(None, description="advice to the user")


class Events(Report):
    """Events after the requested number."""

    events: list[Event]
    lost: int = Field(0, ge=0, description="older events that are no longer kept")
    newest: int = Field(0, ge=0, description="number to pass in the next request")


class AxisColumns(Report):
    """Samples of one axis: one value per sample in each column, None if not available."""

    state: list[str]
    load_target_deg: _Column
    load_position_deg: _Column
    motor_position_deg: _Column
    motor_torque_nm: _Column
    velocity_deg_s: _Column
    error_arcsec: _Column
    correction_arcsec: _Column
    predicted_arcsec: _Column
    loop_arcsec: _Column
    weight: _Column
    reading0: _Column
    reading1: _Column


class Samples(Report):
    """Batch of cycles in columns, oldest first."""

    type: Literal["samples"] = "samples"
    time_s: list[float] = Field(description="time of SYNC, by the machine's monotonic clock")
    cycle: list[int]
    late_us: list[float]
    busy_us: list[float]
    bus_load: _Column = Field(description="fraction of the bus in use; None without a bit rate")
    skipped: list[int] = Field(description="periods left out since the loop began")
    axes: dict[Name, AxisColumns]
    events: list[Event] = Field(default=[], description="events since the last batch")
    lost: int = Field(
        0, ge=0, description="cycles lost since the last batch because this client was too slow"
    )


class LiveOptions(Request):
    """Options of the live feed, sent as the first message and again to change them."""

    every: Annotated[int, Field(strict=True, ge=1, le=10_000)] = Field(
        1, description="decimation: only cycles whose number is a multiple of this", examples=[10]
    )
    axes: list[Name] | None = Field(
        None, max_length=AXES_MAXIMUM, description="selected axes; by default all"
    )


class StreamBegin(Request):
    """First message of a stream."""

    lease: str = Field(max_length=200, description="the token of the lease")
    timeout_s: Annotated[Real, Field(gt=0, le=5)] = Field(
        0.5, description="time without a point after which the axis stops within its limits"
    )


class StreamPoints(Request):
    """Knots to append; the stream ends if the last one has speed 0 and ``end`` is set."""

    points: list[StreamPoint] = Field(max_length=POINTS_MAXIMUM)
    end: bool = Field(False, strict=True, description="no more points follow")


class StreamAnswer(Report):
    """Answer to each message of a stream."""

    accepted: int = Field(ge=0, description="number of points accepted")
    problem: Problem | None = Field(
        None, description="reason for ending the stream; the axis then stops within its limits"
    )


# ---------------------------------------- state of the machine and its axes


class Fault(Report):
    """Cause of a stop, latched until a reset."""

    name: str = Field(description="row of the fault table", examples=["LOST_TPDO"])
    text: str = Field(description="what happened, in words", examples=["a TPDO is missing, twice in a row"])
    hint: str = Field(description="advice to the user", examples=["check the cable"])
    cycle: int | None = Field(None, description="cycle in which the fault was detected")
    date: datetime | None = Field(None, description="time of detection, by the machine's clock")
    needs_verification: bool = Field(
        False, description="the reset boots and verifies the drive again before it releases the latch"
    )

    def __str__(self) -> str:
        return f"{self.text}; {self.hint}"


class Limits(Report):
    """Limits of an axis, at the load."""

    position_min_deg: float = Field(examples=[-180.0])
    position_max_deg: float = Field(examples=[180.0])
    velocity_deg_s: float = Field(examples=[60.0])
    acceleration_deg_s2: float = Field(examples=[300.0])
    jerk_deg_s3: float = Field(examples=[3000.0])


class ModelInUse(Report):
    """Model that compensates an axis."""

    version: int | None = Field(None, description="number in the history; None if not in it", examples=[4])
    file: str = Field(description="model file on the daemon's machine")
    date: datetime | None = Field(None, description="time of its creation")
    age_s: float | None = Field(None, ge=0, description="age, seconds")
    reason: str = Field("", description="reason for its creation", examples=["calibration"])
    effects: list[str] = Field(default=[], examples=[["synchronous", "hysteresis"]])


class LoadLoopState(Report):
    """State of the load loop, a slow integral of the measured error."""

    configured: bool = Field(description="True if the machine file has a load loop for this axis")
    on: bool = False
    correction_arcsec: float = Field(0.0, description="present correction")
    doubt: str | None = Field(
        None,
        description="reason for not acting: the load encoder is in doubt, or the error exceeds its bound",
        examples=["the mean error at rest is 46.3 arcsec without the loop, which adds at most 20"],
    )


class RefinedResponse(Report):
    """Response in motion that replaces that of the model."""

    date: datetime | None = Field(None, description="last refinement; None: before the daemon began")
    low_hz: float = Field(description="lowest frequency at which the response differs by 1 % or more")
    high_hz: float = Field(description="highest such frequency", examples=[62.0])
    percent: float = Field(description="largest difference", examples=[12.0])
    at_hz: float = Field(description="frequency of the largest difference")

    def __str__(self) -> str:
        when = "" if self.date is None else f" at {self.date:%Y-%m-%d %H:%M}"
        return (
            f"response in motion refined{when}: {self.low_hz:.0f} to {self.high_hz:.0f} Hz, by at most "
            f"{self.percent:.0f} % (at {self.at_hz:.0f} Hz)"
        )


class AdaptationState(Report):
    """State of the adaptation of the model's parameters to the load encoder."""

    mode: AdaptationMode = AdaptationMode.OFF
    frozen: str | None = Field(
        None, description="reason why no parameter changes at present; None while they do"
    )
    updated: datetime | None = Field(None, description="time of the last change of a parameter")
    parameters: dict[str, float] = Field(
        default={},
        description="estimated change of each parameter since the model was activated, in its own unit",
        examples=[{"hysteresis.offset_arcsec": 1.3}],
    )
    response: RefinedResponse | None = Field(None, description="None while the model's own response is used")


class OuterState(Report):
    """Axis as a drive of another master, through the gateway."""

    node_id: int = Field(ge=1, le=255, description="node id on the other master's bus; 255: removed by LSS")
    alive: bool = Field(description="True if the gateway process runs")
    nmt: int = Field(description="NMT state of the node as in a heartbeat", examples=[5])
    statusword: int = Field(description="6041h as read by the other master", examples=[0x1237])
    error_code: int = Field(0, description="603Fh as read by the other master; 0: none", examples=[0x8700])
    error: str | None = Field(None, description="error with its cause", examples=["8700h: SYNC is late"])
    period_s: float | None = Field(None, description="period of the other master's SYNC", examples=[0.004])
    jitter_s: float | None = Field(
        None, description="mean deviation of the SYNC from its regular time", examples=[2e-5]
    )
    latency_s: float | None = Field(
        None,
        description="median time from a SYNC to the drive's first frame with its target; None at rest or "
        "without targets",
        examples=[0.0061],
    )
    latency_99_s: float | None = Field(None, description="99th percentile of the same time", examples=[0.008])


class AxisState(Report):
    """State of one axis in the newest cycle."""

    name: Name
    profile: str = Field(description="folder of the axis's files on the daemon's machine")
    node_id: int = Field(ge=1, le=127)
    ratio: float = Field(description="turns of the motor for one of the load, with its sign", examples=[50.0])
    state: ControlState
    power: PowerState
    mode: MotionMode
    at_rest: bool = Field(description="the set-point is at rest")

    load_target_deg: float | None = Field(None, description="target of the load, degrees", examples=[30.0])
    velocity_deg_s: float | None = Field(None, description="velocity of the load target", examples=[0.0])
    motor_target_deg: float | None = Field(None, description="the drive's demand (6062h), motor degrees")
    motor_position_deg: float | None = Field(None, description="motor encoder, motor degrees")
    load_position_deg: float | None = Field(None, description="load encoder, degrees", examples=[30.0001])
    error_arcsec: float | None = Field(
        None, description="load encoder less load target; None without a load encoder", examples=[0.4]
    )
    motor_torque_nm: float | None = None
    readings: dict[str, float | None] = Field(
        default={}, description="measured channels by their column", examples=[{"temperature_c": 31.5}]
    )

    scheme: Scheme = Field(description="parts of the model that compensate")
    compensating: bool = Field(description="True if the present target contains a correction")
    correction_arcsec: float | None = Field(None, description="correction in the present target")
    predicted_arcsec: float | None = Field(None, description="present transmission error by the model")
    weight: float | None = Field(None, description="fraction of the correction in effect, 0 to 1")
    limited: bool = Field(False, description="the correction or its rate is at its limit")
    changing: bool = Field(False, description="a change of model or scheme is being ramped")
    memory_known: bool = Field(
        description="True if the state of the hysteresis is known: the axis has turned past its width both "
        "ways"
    )
    underrun: bool = Field(False, description="the last stream ran out of points in motion")

    limits: Limits
    fault: Fault | None = Field(None, description="cause of a stop, until a reset")
    model: ModelInUse | None = Field(None, description="None: not compensated")
    load_loop: LoadLoopState
    adaptation: AdaptationState
    outer: OuterState | None = Field(None, description="None: the axis is not in a gateway")
    advice: list[str] = Field(
        default=[],
        description="verdict of the load-encoder watch",
        examples=[["recalibrate: the residual exceeds the model's intervals"]],
    )
    queued: int = Field(0, ge=0, description="waiting way points")


class BusState(Report):
    """CAN bus of the machine."""

    interface: str = Field(examples=["socketcan"])
    channel: str = Field(examples=["can0"])
    up: bool
    lent_to: str | None = Field(None, description="program that has borrowed the bus; the axes are disabled")
    lent_s: float | None = Field(
        None, ge=0, description="time since the loan began, seconds", examples=[63.0]
    )
    load: float | None = Field(None, description="fraction of the time that the bus is busy", examples=[0.31])


class CycleState(Report):
    """Control loop of the machine."""

    period_s: float = Field(gt=0, examples=[0.004])
    cycle: int = Field(description="number of the newest cycle")
    alive: bool = Field(description="True if the loop has completed a cycle recently")
    pid: int = Field(0, ge=0, description="process id of the control process; 0 if there is none")
    skipped: int = Field(0, ge=0, description="periods left out because the loop was late")
    late_us: float | None = Field(None, description="lateness of the newest cycle")
    busy_us: float | None = Field(None, description="duration of the newest cycle")


class RecorderState(Report):
    """Flight recorder of the machine."""

    on: bool
    folder: str | None = None
    dropped: int = Field(0, ge=0, description="samples not written, for example because of a full disk")
    note: str | None = Field(None, description="remarks for the user", examples=["the disk is full"])


class MachineState(Report):
    """State of the machine in the newest cycle."""

    name: Name
    version: str = Field(description="version of hdbridge")
    started: datetime = Field(description="time at which the service began")
    simulated: bool = False
    axes: list[AxisState]
    bus: BusState
    cycle: CycleState
    lease: LeaseState
    recorder: RecorderState
    warnings: list[str] = Field(default=[], description="warnings for the user")
