"""How strict every part of a file that people write is, and every part of a model."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """Nothing unknown, nothing infinite, and not to be changed.

    What pydantic checks it with is made when it is first needed: a process reads few kinds of files, and few
    of the effects, which alone take a tenth of a second.
    """

    model_config = ConfigDict(defer_build=True, frozen=True, extra="forbid", allow_inf_nan=False)
