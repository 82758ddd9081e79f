"""Lease: only one client at a time may move axes. There is no I/O; the clock is passed in.

A client takes the lease and receives a token, which is required in every request that moves an axis. The
lease expires when its holder has made no request during the time-out, so that a dead client does not block
the machine. Reading, stopping and quick-stopping require no lease.
"""

import math
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from hmac import compare_digest

from hdbridge.errors import InputError, LeaseError

TOKEN_BYTES = 16
LONGEST_NAME = 400
"""Maximum length of a client's name, which includes its user and process."""


@dataclass(frozen=True, slots=True)
class Holder:
    """Holder of the lease."""

    client: str
    taken_s: float
    """Time at which the lease was taken, on the lease's clock."""
    expires_s: float
    """Time at which the lease expires without a further request; infinite for the gateway."""
    token: str = field(repr=False)


class Lease:
    """Lease of a machine. Not thread-safe: to be used from one thread."""

    def __init__(self, timeout_s: float, now: Callable[[], float]) -> None:
        """``now`` returns the time of a monotonic clock, seconds."""
        self.timeout_s = timeout_s
        self._now = now
        self._holder: Holder | None = None
        self.doing: Callable[[], str] = lambda: ""
        """Returns a description of the current motions, for refusals; empty at rest."""

    @property
    def holder(self) -> Holder | None:
        """Current holder; None if the lease is free."""
        if self._holder is not None and self._now() >= self._holder.expires_s:
            self._holder = None
        return self._holder

    def take(self, client: str, *, force: bool = False, lasts: bool = False) -> str:
        """Takes the lease and returns its token.

        With ``force``, it is taken even from another holder. With ``lasts``, it does not expire.

        Raises LeaseError if the lease is held and ``force`` is False, and InputError if the client's name is
        empty or too long.
        """
        if not client.strip() or len(client) > LONGEST_NAME:
            raise InputError(
                f"lease: invalid client name {client[:LONGEST_NAME]!r}; expected 1 to {LONGEST_NAME} "
                "characters"
            )
        holder, now_s = self.holder, self._now()
        if holder is not None and not force:
            left_s = holder.expires_s - now_s
            until, advice = f"; it runs out in {left_s:.1f} s unless it is renewed", "wait, or repeat"
            if math.isinf(left_s):
                until, advice = " as long as the gateway runs", "to stop its axes and take it, repeat"
            raise LeaseError(
                f"'{holder.client}' holds the lease{until}{self._doing()}; {advice} the command with --force"
            )
        expires_s = math.inf if lasts else now_s + self.timeout_s
        self._holder = Holder(client, now_s, expires_s, secrets.token_urlsafe(TOKEN_BYTES))
        return self._holder.token

    def release(self, token: str) -> None:
        """Releases the lease. Raises LeaseError like `check`, so only its holder can release it."""
        self.check(token)
        self._holder = None

    def check(self, token: str, *, renew: bool = True) -> None:
        """Raises LeaseError unless ``token`` is the current holder's.

        Extends the lease by its time-out unless ``renew`` is False.
        """
        holder = self.holder
        if holder is None:
            raise LeaseError("the lease is free or has expired: take it first")
        if not compare_digest(token.encode(), holder.token.encode()):
            raise LeaseError(f"'{holder.client}' holds the lease{self._doing()}; take it first")
        if renew and math.isfinite(holder.expires_s):
            self._holder = replace(holder, expires_s=self._now() + self.timeout_s)

    def holds(self, token: str) -> bool:
        """Returns True if ``token`` is the current holder's; does not extend the lease."""
        return (holder := self.holder) is not None and token == holder.token

    def _doing(self) -> str:
        doing = self.doing()
        return f"; {doing}" if doing else ""
