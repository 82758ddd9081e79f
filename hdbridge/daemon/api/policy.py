"""Who may ask what on one listener. Pure: no socket, no clock.

A page that the user opens elsewhere can send requests to a server on the user's own machine. So a request
is refused whose ``Host`` is a name that this machine does not have (DNS rebinding) or whose ``Origin`` is not
the very address that was asked (a foreign page). Neither is a matter of the token alone.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from hmac import compare_digest
from typing import Final

from hdbridge.errors import InputError

BODY_MAXIMUM: Final = 256 << 10
"""Bytes of a request's body, and of a WebSocket message."""
DEPTH_MAXIMUM: Final = 16
"""Lists and objects within each other."""
TOKEN_MINIMUM: Final = 16
SUBPROTOCOL: Final = "hdbridge.v1"
TOKEN_SUBPROTOCOL: Final = "bearer."
"""A browser cannot set a header on a WebSocket: it offers a subprotocol of this name with the token."""
OWN_NAMES: Final = frozenset({"localhost", "hdbridge"})
_HOST: Final = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^:/@?#\s\[\]]+)(?::(\d{1,5}))?")
_BRACKETS: Final = re.compile(rb'"(?:[^"\\]|\\.)*"?|[\[{]|[\]}]', re.DOTALL)


@dataclass(frozen=True, slots=True)
class Policy:
    """What a listener asks of each request."""

    token: str | None = None
    """To be shown by every request for the API; None on a Unix socket, whose file mode decides."""
    names: frozenset[str] = frozenset()
    """Names by which a reverse proxy is reached, lower case."""

    def __post_init__(self) -> None:
        token = self.token
        if token is not None and not re.fullmatch(rf"[A-Za-z0-9._~-]{{{TOKEN_MINIMUM},200}}", token):
            raise InputError(
                f"the token of the API: expected {TOKEN_MINIMUM} to 200 letters, digits, '-', '.', '_' or "
                "'~'; make one with: python -c 'import secrets; print(secrets.token_urlsafe(32))'"
            )

    def knows_host(self, host: str | None) -> bool:
        """Whether a ``Host`` header is an address, or a name of this machine."""
        match = _HOST.fullmatch(host or "")
        if match is None:
            return False
        name = match[1].strip("[]").lower()
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in OWN_NAMES or name in self.names
        return True

    def knows_origin(self, origin: str | None, host: str, scheme: str) -> bool:
        """Whether a request comes from no web page, or from one that was loaded from here.

        A page that was loaded through a reverse proxy has one of the names, over HTTPS.
        """
        if origin is None or origin.lower() == f"{scheme}://{host}".lower():
            return True
        kind, _, place = origin.lower().partition("://")
        match = _HOST.fullmatch(place)
        return kind == "https" and match is not None and match[1] in self.names

    def needs_token(self, path: str) -> bool:
        """Whether a path shows or does anything; pages without data do not."""
        return self.token is not None and (path == "/metrics" or path.startswith("/api/"))

    def admits(self, authorization: str | None, subprotocols: str | None) -> bool:
        """Whether the token was shown, in constant time."""
        if self.token is None:
            return True
        kind, _, shown = (authorization or "").partition(" ")
        candidates = [shown.strip()] if kind.lower() == "bearer" else []
        for each in (subprotocols or "").split(","):
            offered = each.strip()
            if offered.startswith(TOKEN_SUBPROTOCOL):
                candidates.append(offered.removeprefix(TOKEN_SUBPROTOCOL))
        expected = self.token.encode()
        return any(compare_digest(each.encode("utf-8", "replace"), expected) for each in candidates)


def too_deep(body: bytes) -> bool:
    """Whether JSON nests deeper than any request does; a parser would recurse into it."""
    depth = 0
    for match in _BRACKETS.finditer(body):
        first = match[0][:1]
        if first in b"[{":
            depth += 1
            if depth > DEPTH_MAXIMUM:
                return True
        elif first in b"]}":
            depth -= 1
    return False
