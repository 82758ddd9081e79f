"""State of the machine and its axes."""

from datetime import datetime

from pydantic import Field

from hdbridge.client.messages.lease import LeaseState
from hdbridge.client.messages.values import (
    AdaptationMode,
    ControlState,
    MotionMode,
    Name,
    PowerState,
    Report,
    Scheme,
)


class Fault(Report):
    """Cause of a stop, latched until a reset."""

    name: str = Field(description="the row of the fault table", examples=["LOST_TPDO"])
    text: str = Field(description="what happened, in words", examples=["a TPDO is missing, twice in a row"])
    hint: str = Field(description="what a person does about it", examples=["check the cable"])
    cycle: int | None = Field(None, description="cycle of the loop in which it was seen")
    date: datetime | None = Field(None, description="when it was seen, by the machine's clock")
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
    """The model that compensates an axis."""

    version: int | None = Field(None, description="number in the history; None without one", examples=[4])
    file: str = Field(description="its file on the daemon's machine")
    date: datetime | None = Field(None, description="when it was made")
    age_s: float | None = Field(None, ge=0, description="since it was made, seconds")
    reason: str = Field("", description="why it was made", examples=["calibration"])
    effects: list[str] = Field(default=[], examples=[["synchronous", "hysteresis"]])


class LoadLoopState(Report):
    """State of the load loop, a slow integral of the measured error."""

    configured: bool = Field(description="whether the machine file has one for this axis")
    on: bool = False
    correction_arcsec: float = Field(0.0, description="present correction")
    doubt: str | None = Field(
        None,
        description="why it does not act: the load encoder is in doubt, or the error is beyond its bound",
        examples=["the mean error at rest is 46.3 arcsec without the loop, which adds at most 20"],
    )


class RefinedResponse(Report):
    """Response in motion that is used in place of the model's."""

    date: datetime | None = Field(None, description="when it was refined last; None: before the daemon began")
    low_hz: float = Field(description="lowest frequency at which it differs by 1 % or more")
    high_hz: float = Field(description="highest one", examples=[62.0])
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
        None, description="reason why the parameters do not change now; None while they do"
    )
    updated: datetime | None = Field(None, description="when a parameter was changed last")
    parameters: dict[str, float] = Field(
        default={},
        description="estimated change of each parameter since the model was activated, in its own unit",
        examples=[{"hysteresis.offset_arcsec": 1.3}],
    )
    response: RefinedResponse | None = Field(None, description="None while the model's is used")


class OuterState(Report):
    """The axis as a drive of another master, through the gateway."""

    node_id: int = Field(ge=1, le=255, description="on the bus of that master; 255: LSS took it away")
    alive: bool = Field(description="whether the gateway process runs")
    nmt: int = Field(description="NMT state of the node as in a heartbeat", examples=[5])
    statusword: int = Field(description="6041h as that master sees it", examples=[0x1237])
    error_code: int = Field(0, description="603Fh as that master sees it; 0: no error", examples=[0x8700])
    period_s: float | None = Field(None, description="period of that master's SYNC", examples=[0.004])
    jitter_s: float | None = Field(
        None, description="mean deviation of that SYNC from its regular time", examples=[2e-5]
    )
    latency_s: float | None = Field(
        None,
        description="median time from a SYNC to the drive's first frame with its target; None at rest or "
        "without targets",
        examples=[0.0061],
    )
    latency_99_s: float | None = Field(None, description="99 % of them are not longer", examples=[0.008])


class AxisState(Report):
    """State of one axis in the newest cycle."""

    name: Name
    profile: str = Field(description="folder of its files on the daemon's machine")
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

    scheme: Scheme = Field(description="which parts of the model compensate")
    compensating: bool = Field(description="whether the correction is in the target now")
    correction_arcsec: float | None = Field(None, description="in the target now")
    predicted_arcsec: float | None = Field(None, description="transmission error by the model, now")
    weight: float | None = Field(None, description="share of the correction that is ramped in, 0 to 1")
    limited: bool = Field(False, description="the correction is at its limit or changes as fast as it may")
    changing: bool = Field(False, description="a change of model or scheme is being ramped")
    memory_known: bool = Field(
        description="whether the state of the hysteresis is known: the axis turned past its width both ways"
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
        description="what the load-encoder watch says",
        examples=[["recalibrate: the residual left what the model's intervals allow"]],
    )
    queued: int = Field(0, ge=0, description="way points that wait")


class BusState(Report):
    """The CAN bus of the machine."""

    interface: str = Field(examples=["socketcan"])
    channel: str = Field(examples=["can0"])
    up: bool
    lent_to: str | None = Field(None, description="program that has borrowed the bus; the axes are disabled")
    lent_s: float | None = Field(None, ge=0, description="since it was lent, seconds", examples=[63.0])
    load: float | None = Field(None, description="share of the bus's time that is in use", examples=[0.31])


class CycleState(Report):
    """The control loop."""

    period_s: float = Field(gt=0, examples=[0.004])
    cycle: int = Field(description="number of the newest cycle")
    alive: bool = Field(description="whether the loop turned lately")
    pid: int = Field(0, ge=0, description="process id of the control process; 0 if there is none")
    skipped: int = Field(0, ge=0, description="periods left out because the loop was late")
    late_us: float | None = Field(None, description="how late the newest cycle began")
    busy_us: float | None = Field(None, description="how long the newest cycle took")


class RecorderState(Report):
    """The flight recorder."""

    on: bool
    folder: str | None = None
    dropped: int = Field(0, ge=0, description="samples that were not written, a full disk for example")
    note: str | None = Field(None, description="what a person should know", examples=["the disk is full"])


class MachineState(Report):
    """State of the machine in the newest cycle."""

    name: Name
    version: str = Field(description="of hdbridge")
    started: datetime = Field(description="when the service began")
    simulated: bool = False
    axes: list[AxisState]
    bus: BusState
    cycle: CycleState
    lease: LeaseState
    recorder: RecorderState
    warnings: list[str] = Field(default=[], description="what a person should look at")
