"""Errors as ``application/problem+json`` (RFC 9457), and their conversion to `hdbridge.errors`."""

from typing import Final, Self

from pydantic import Field

from hdbridge import errors
from hdbridge.client.messages.values import Report
from hdbridge.errors import HdbridgeError

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
    errors.SdoError: (502, "The drive did not take or give the object"),
    errors.DriveError: (502, "The drive refused"),
    errors.SafetyStop: (409, "Stopped by the supervision"),
    errors.OutputError: (507, "A result could not be written"),
    HdbridgeError: (500, "An error in hdbridge"),
}
"""Status and title of each hdbridge error; the first matching row applies."""


class Problem(Report):
    """Problem document: the reason why a request failed."""

    type: str = Field(description="kind of error, as a URN", examples=[f"{TYPE_PREFIX}LeaseError"])
    title: str = Field(description="the kind in words", examples=["The right to move is not yours"])
    status: int = Field(ge=400, le=599, description="HTTP status", examples=[423])
    detail: str = Field(
        description="error, expectation and remedy in one line",
        examples=["'cell controller' holds the lease for another 4.2 s; wait, or take it with force"],
    )
    axis: str | None = Field(None, description="the axis concerned", examples=["joint-3"])
    hint: str | None = Field(None, description="what a person does about it")
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
        """Returns the error to raise in the client; DaemonError for an unknown kind."""
        name = self.type.removeprefix(TYPE_PREFIX)
        kind = next((each for each in STATUS if each.__name__ == name), errors.DaemonError)
        return kind("; ".join((self.detail, *self.errors)))
