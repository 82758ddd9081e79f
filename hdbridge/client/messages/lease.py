"""The lease: the right to move, held by one client at a time."""

from datetime import datetime

from pydantic import ConfigDict, Field

from hdbridge.client.messages.values import Report, Request, Seconds, Words


class LeaseRequest(Request):
    """Request for the lease."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"client": "cell controller", "force": False}]})

    client: Words = Field("", description="name shown to other clients; by default user and process")
    force: bool = Field(False, strict=True, description="take it from its holder, whose motion is stopped")


class LeaseGrant(Report):
    """The granted lease; its token goes into the header ``X-Lease`` of each request that moves an axis."""

    token: str = Field(description="secret that permits motion", examples=["mZ3sWJx0b0lq"])
    client: str = Field(description="who holds it")
    timeout_s: Seconds = Field(description="time without use after which it ends", examples=[5.0])


class LeaseState(Report):
    """State of the lease, without its token."""

    held: bool = Field(description="True if a client holds it")
    client: str | None = Field(None, description="who holds it", examples=["cell controller"])
    since: datetime | None = Field(None, description="time at which it was taken")
    remaining_s: float | None = Field(
        None, description="time until it expires; each use extends it", examples=[4.2]
    )
    timeout_s: float = Field(description="time without use after which it ends", examples=[5.0])
