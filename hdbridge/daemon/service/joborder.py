"""What a job is: its options, what it is handed, and how it tells how far it is.

Apart from `jobwork`, so that the service takes and refuses jobs without loading what they do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from hdbridge.axis import AxisConfig
from hdbridge.client.messages import JobKind
from hdbridge.errors import InputError
from hdbridge.evaluation.stepping import Scheme
from hdbridge.files.profile import Profile

_Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
"""Of a plan or a folder: a name and no path, for it comes from a client."""


class _Options(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StepOptions(_Options):
    """Of ``hdbridge step``."""

    scheme: tuple[Scheme, ...] | Scheme | None = None
    count: int = Field(240, ge=2, le=100_000)
    step_deg: float = 43.56
    start_deg: float = 0.0
    model: int | None = Field(None, ge=1)
    """Number of a version; else the active one."""


class CalibrateOptions(_Options):
    """Of ``hdbridge calibrate``."""

    plan: _Name = "quick"
    """A bundled one, or the file of that name (and ``.yaml``) beside the axis file."""
    resume: _Name | None = None
    """Folder, within the axis's recordings, of one that goes on."""


class ImproveOptions(CalibrateOptions):
    """Of ``hdbridge improve``."""

    auto: bool = False
    rounds: int = Field(3, ge=1, le=20)


OPTIONS: Final[Mapping[JobKind, type[_Options]]] = {
    JobKind.STEP: StepOptions,
    JobKind.CALIBRATE: CalibrateOptions,
    JobKind.IMPROVE: ImproveOptions,
}


def options_of(kind: JobKind, given: Mapping[str, Any]) -> _Options:
    """The options of a job, checked; InputError names the wrong one."""
    try:
        return OPTIONS[kind].model_validate(dict(given))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"][:1])) or "options"
        known = ", ".join(OPTIONS[kind].model_fields)
        raise InputError(f"{kind.value}: {where}: {first['msg']}; the options are {known}") from None


@dataclass(frozen=True)
class Work:
    """A job as it is handed to its process."""

    kind: JobKind
    options: _Options
    profile: Profile
    axis: AxisConfig
    recordings: Path
    """Where recordings of this axis go."""
    date: datetime


@dataclass(frozen=True)
class Told:
    """How a job tells how far it is."""

    phase: Callable[[str, float, float], None]
    """What is going on, seconds done of its phase, seconds of the phase in all."""
    line: Callable[[str], None]
    folder: Callable[[Path], None]
    """Where what is measured goes."""
    interrupted: Callable[[], bool]
    """Asked in each cycle; a yes stops the axis."""
