"""Job order: the options of a job, what its process receives, and how it reports progress.

Separate from `jobwork`, so that the service accepts and refuses jobs without importing their code.
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
from hdbridge.commissioning.evaluation.stepping import Scheme
from hdbridge.errors import InputError
from hdbridge.files.profile import Profile

_Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
"""Name of a plan or a folder, never a path, because it comes from a client."""


class _Options(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StepOptions(_Options):
    """Options of ``hdbridge step``."""

    scheme: tuple[Scheme, ...] | Scheme | None = None
    count: int = Field(240, ge=2, le=100_000)
    step_deg: float = 43.56
    start_deg: float = 0.0
    model: int | None = Field(None, ge=1)
    """Model version; None for the active model."""


class CalibrateOptions(_Options):
    """Options of ``hdbridge calibrate``."""

    plan: _Name = "quick"
    """A bundled plan, or the file of that name (with ``.yaml``) next to the axis file."""
    resume: _Name | None = None
    """Folder of the recording to continue, within the axis's recordings."""


class ImproveOptions(CalibrateOptions):
    """Options of ``hdbridge improve``."""

    auto: bool = False
    rounds: int = Field(3, ge=1, le=20)


OPTIONS: Final[Mapping[JobKind, type[_Options]]] = {
    JobKind.STEP: StepOptions,
    JobKind.CALIBRATE: CalibrateOptions,
    JobKind.IMPROVE: ImproveOptions,
}


def options_of(kind: JobKind, given: Mapping[str, Any]) -> _Options:
    """Returns the validated options of a job; InputError names the invalid one."""
    try:
        return OPTIONS[kind].model_validate(dict(given))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"][:1])) or "options"
        known = ", ".join(OPTIONS[kind].model_fields)
        raise InputError(f"{kind.value}: {where}: {first['msg']}; the options are {known}") from None


@dataclass(frozen=True)
class Work:
    """A job, as its process receives it."""

    kind: JobKind
    options: _Options
    profile: Profile
    axis: AxisConfig
    recordings: Path
    """Folder for recordings of this axis."""
    date: datetime


@dataclass(frozen=True)
class Told:
    """Callbacks by which a job reports its progress."""

    phase: Callable[[str, float, float], None]
    """Called with the name of the phase, its elapsed time and its total time in seconds."""
    line: Callable[[str], None]
    folder: Callable[[Path], None]
    """Called with the folder of the measurements."""
    interrupted: Callable[[], bool]
    """Called in each cycle; if it returns True, the axis stops."""
