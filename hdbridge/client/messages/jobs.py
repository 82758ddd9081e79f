"""Procedures that run through the daemon while it holds the bus."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Final

from pydantic import Field, StringConstraints

from hdbridge.client.messages.problem import Problem
from hdbridge.client.messages.values import Name, Real, Report, Request

OPTIONS_MAXIMUM: Final = 32

OptionName = Annotated[str, StringConstraints(strict=True, pattern=r"^[a-z][a-z0-9_]{0,39}$")]
_Text = Annotated[str, StringConstraints(strict=True, max_length=200)]
_Integer = Annotated[int, Field(strict=True, ge=-(2**53), le=2**53)]
Option = Annotated[bool, Field(strict=True)] | _Integer | Real | _Text
OptionValue = Option | Annotated[list[Option], Field(max_length=100)]


class JobKind(StrEnum):
    """Kind of a job."""

    STEP = "step"
    CALIBRATE = "calibrate"
    IMPROVE = "improve"


class JobState(StrEnum):
    """State of a job."""

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class JobRequest(Request):
    """Start a job on an axis."""

    kind: JobKind = Field(examples=["step"])
    options: dict[OptionName, OptionValue] = Field(
        default={},
        max_length=OPTIONS_MAXIMUM,
        description="those of the command of the same name, with underscores",
        examples=[{"count": 60, "scheme": "both"}],
    )


class Job(Report):
    """A procedure that runs or ran."""

    id: str = Field(examples=["step-3"])
    kind: JobKind
    axis: Name
    client: str = Field(
        "", description="client that began it", examples=["hdbridge ctl (anna, process 4242)"]
    )
    state: JobState
    share: float = Field(0.0, ge=0, le=1, description="share that is done, 0 to 1", examples=[0.42])
    text: str = Field("", description="present phase", examples=["sweep 2 of 3"])
    started: datetime
    ended: datetime | None = None
    folder: str | None = Field(None, description="folder of its recording, on the daemon's machine")
    result: dict[str, Any] | None = Field(
        None, description="document, as written by the command of the same name"
    )
    problem: Problem | None = Field(None, description="reason for its failure")
