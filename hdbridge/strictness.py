"""Base class of all pydantic models of files and their parts."""

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """Immutable model that rejects unknown keys and numbers that are not finite.

    pydantic's validator is built on first use, because a process uses few of the models, and building the
    validators of the effects alone takes a tenth of a second.
    """

    model_config = ConfigDict(defer_build=True, frozen=True, extra="forbid", allow_inf_nan=False)
