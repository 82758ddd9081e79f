"""Common strictness of all models of files and their parts."""

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """Immutable model that rejects unknown keys and numbers that are not finite.

    pydantic's validator is built on first use, because a process reads few kinds of files and few of the
    effects, which alone take a tenth of a second.
    """

    model_config = ConfigDict(defer_build=True, frozen=True, extra="forbid", allow_inf_nan=False)
