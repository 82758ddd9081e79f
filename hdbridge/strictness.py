"""Base class of all pydantic models of files and their parts; pydantic's errors in words."""

from collections.abc import Mapping
from typing import Any, Final

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """Immutable model that rejects unknown keys and numbers that are not finite.

    pydantic's validator is built on first use, because a process uses few of the models, and building the
    validators of the effects alone takes a tenth of a second.
    """

    model_config = ConfigDict(defer_build=True, frozen=True, extra="forbid", allow_inf_nan=False)


_KEY_ERRORS: Final = {"extra_forbidden": "unknown key", "missing": "is missing"}
"""Descriptions of errors that concern a key rather than its value, by pydantic's type of the error."""


def complaint(error: Mapping[str, Any], root: str = "") -> str:
    """Returns one of a `ValidationError`'s ``errors()`` as a line: its place, the value and the expectation.

    ``root`` is the place of an error that concerns no single key. Without an ``input``, or if it is not a
    plain value, the line does not contain it.
    """
    place = ".".join(map(str, error["loc"])) or root
    if error["type"] in _KEY_ERRORS:
        return f"{place}: {_KEY_ERRORS[error['type']]}"
    value = error.get("input")
    found = f"found {value!r}; " if isinstance(value, str | int | float) else ""
    expected = error["msg"].replace("Input should be", "expected").removeprefix("Value error, ")
    return f"{place}: {found}{expected}"
