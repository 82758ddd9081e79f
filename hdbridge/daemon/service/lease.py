"""The lease: one client at a time holds the right to move. Pure: the clock is passed in.

A client takes the lease and gets a token; whatever moves an axis asks for the token. The lease runs out when
its holder has not been heard of for its time-out, so that a client that died does not keep the machine. To
watch, to stop and to quick-stop takes no lease.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass
from hmac import compare_digest

from hdbridge.errors import InputError, LeaseError

TOKEN_BYTES = 16
LONGEST_NAME = 400
"""A client's own name, and its user and process."""


@dataclass(frozen=True, slots=True)
class Holder:
    """Who holds the right to move."""

    client: str
    """Its name, for people."""
    taken_s: float
    """When it was taken, on the lease's clock."""
    expires_s: float
    """When it runs out, unless its holder is heard of before."""


class Lease:
    """The right to move. Not thread-safe: one thread asks.

    ``now`` gives the seconds of a monotonic clock; ``new_token`` is for tests.
    """

    def __init__(
        self,
        timeout_s: float,
        now: Callable[[], float],
        new_token: Callable[[], str] = lambda: secrets.token_urlsafe(TOKEN_BYTES),
    ) -> None:
        self.timeout_s = timeout_s
        self._now = now
        self._new_token = new_token
        self._token: str | None = None
        self._client = ""
        self._taken_s = self._heard_s = 0.0
        self._ended: list[str] = []
        self.doing: Callable[[], str] = lambda: ""
        """Returns what the machine does at present and how to end it, in words, for refusals."""

    @property
    def holder(self) -> Holder | None:
        """Who holds it now; None where nobody does."""
        self._expire()
        if self._token is None:
            return None
        return Holder(self._client, self._taken_s, self._heard_s + self.timeout_s)

    def take(self, client: str, *, force: bool = False) -> str:
        """Take it; the token that shows it. ``force`` takes it from another holder.

        LeaseError where another client holds it; InputError for a client without a name.
        """
        if not client.strip() or len(client) > LONGEST_NAME:
            raise InputError(
                f"a lease for {client[:LONGEST_NAME]!r}; expected the client's name in 1 to {LONGEST_NAME} "
                "characters"
            )
        holder = self.holder
        if holder is not None and not force:
            left_s = holder.expires_s - self._now()
            raise LeaseError(
                f"'{holder.client}' holds the right to move; it runs out in {left_s:.1f} s unless it is "
                f"renewed{self._doing()}; wait, or take it with 'hdbridge ctl lease --force'"
            )
        if holder is not None:
            self._end()
        self._token, self._client = self._new_token(), client
        self._taken_s = self._heard_s = self._now()
        return self._token

    def renew(self, token: str) -> Holder:
        """Its holder is still there: it lasts for another time-out. LeaseError as `check`."""
        self.check(token)
        assert self.holder is not None
        return self.holder

    def release(self, token: str) -> None:
        """Give it back. LeaseError as `check`, so that nobody gives back what another has taken."""
        self.check(token)
        self._end()

    def check(self, token: str) -> None:
        """LeaseError unless ``token`` is the present holder's, who has been heard of by that."""
        holder = self.holder
        if holder is None:
            raise LeaseError("nobody holds the right to move, or it has run out: take the lease first")
        assert self._token is not None
        if not compare_digest(token.encode(), self._token.encode()):
            raise LeaseError(
                f"'{holder.client}' holds the right to move{self._doing()}; take the lease first"
            )
        self._heard_s = self._now()

    def holds(self, token: str) -> bool:
        """Whether ``token`` is the present holder's; it is not heard of by that."""
        return self.holder is not None and token == self._token

    def ended(self) -> tuple[str, ...]:
        """The clients whose lease has ended since this was last asked, in that order: for what follows it.

        Ended means released, run out or taken by force.
        """
        self._expire()
        ended, self._ended = tuple(self._ended), []
        return ended

    def _expire(self) -> None:
        if self._token is not None and self._now() - self._heard_s >= self.timeout_s:
            self._end()

    def _doing(self) -> str:
        doing = self.doing()
        return f"; {doing}" if doing else ""

    def _end(self) -> None:
        self._token = None
        self._ended.append(self._client)
