"""Status of a page, and the next commands."""

from hdbridge.commissioning.calibration.result import Offer
from hdbridge.report.page import Command, Status


def of_offer(offer: Offer) -> tuple[Status, tuple[Command, ...]]:
    """Returns status and commands for a model that was measured for commit."""
    if not offer.made:
        return Status.REFUSED, ()
    if offer.pending is None:
        return Status.OFFERED, (
            Command("hdbridge model log PROFILE", "says whether this model waits, or was committed since"),
        )
    profile = offer.pending.parent
    return Status.PENDING, (
        Command(f"hdbridge model diff {profile}", "shows what would change"),
        Command(f"hdbridge model commit {profile}", "makes it the active model"),
    )
