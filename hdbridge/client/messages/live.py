"""Live samples and events, and the messages of the two WebSockets."""

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Final, Literal

from pydantic import Field

from hdbridge.client.messages.problem import Problem
from hdbridge.client.messages.requests import AXES_MAXIMUM, StreamPoint
from hdbridge.client.messages.values import Name, Real, Report, Request

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
    """An event."""

    sequence: int = Field(ge=0, description="counts from the start of the service", examples=[17])
    kind: EventKind
    date: datetime = Field(description="by the machine's clock")
    cycle: int | None = Field(None, description="cycle of the loop")
    axis: Name | None = Field(None, description="None for the machine")
    text: str = Field("", description="in words", examples=["cycle 120: a TPDO is missing (282h): freeze"])
    hint: str | None = Field(None, description="what a person does about it")


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
    """A batch of cycles in columns, oldest first."""

    type: Literal["samples"] = "samples"
    time_s: list[float] = Field(description="time of SYNC, by the machine's monotonic clock")
    cycle: list[int]
    late_us: list[float]
    busy_us: list[float]
    bus_load: _Column = Field(description="share of the bus in use; None without a bit rate")
    skipped: list[int] = Field(description="periods left out since the loop began")
    axes: dict[Name, AxisColumns]
    events: list[Event] = Field(default=[], description="events since the last batch")
    lost: int = Field(
        0, ge=0, description="cycles lost since the last batch because this client was too slow"
    )


class LiveOptions(Request):
    """Options of the live feed, sent as the first message and again to change them."""

    every: Annotated[int, Field(strict=True, ge=1, le=10_000)] = Field(
        1, description="decimation: only cycles whose number it divides", examples=[10]
    )
    axes: list[Name] | None = Field(
        None, max_length=AXES_MAXIMUM, description="selected axes; by default all"
    )


class StreamBegin(Request):
    """The first message of a stream."""

    lease: str = Field(max_length=200, description="the token of the lease")
    timeout_s: Annotated[Real, Field(gt=0, le=5)] = Field(
        0.5, description="time without a point after which the axis stops within its limits"
    )


class StreamPoints(Request):
    """Knots to append; the stream ends where the last one has speed 0 and ``end`` is set."""

    points: list[StreamPoint] = Field(max_length=POINTS_MAXIMUM)
    end: bool = Field(False, strict=True, description="no more points follow")


class StreamAnswer(Report):
    """The answer to each message of a stream."""

    accepted: int = Field(ge=0, description="number of points accepted")
    problem: Problem | None = Field(
        None, description="reason for ending the stream; the axis then stops within its limits"
    )
