"""Policy of one listener: which requests it accepts. Pure: no socket, no clock.

A web page from elsewhere can send requests to a server on the user's own machine. So a request is refused if
its ``Host`` is not a name of this machine (DNS rebinding), or its ``Origin`` is not the address of the
request (a foreign page). A token alone does not prevent either.
"""

import ipaddress
import re
from dataclasses import dataclass
from hmac import compare_digest
from typing import Final

from hdbridge.errors import InputError

BODY_MAXIMUM: Final = 256 << 10
"""Maximum size of a request's body and of a WebSocket message, bytes."""
DEPTH_MAXIMUM: Final = 16
"""Maximum nesting of lists and objects."""
TOKEN_MINIMUM: Final = 16
SUBPROTOCOL: Final = "hdbridge.v1"
TOKEN_SUBPROTOCOL: Final = "bearer."
"""Prefix of the subprotocol that carries the token, because a browser cannot set headers on a WebSocket."""
OWN_NAMES: Final = frozenset({"localhost", "hdbridge"})
_HOST: Final = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^:/@?#\s\[\]]+)(?::(\d{1,5}))?")
_BRACKETS: Final = re.compile(rb'"(?:[^"\\]|\\.)*"?|[\[{]|[\]}]', re.DOTALL)


@dataclass(frozen=True, slots=True)
class Policy:
    """Requirements of a listener."""

    token: str | None = None
    """Token required for the API; None on a Unix socket, where the file mode decides."""
    names: frozenset[str] = frozenset()
    """Host names of a reverse proxy, lower case."""

    def __post_init__(self) -> None:
        token = self.token
        if token is not None and not re.fullmatch(rf"[A-Za-z0-9._~-]{{{TOKEN_MINIMUM},200}}", token):
            raise InputError(
                f"the token of the API: expected {TOKEN_MINIMUM} to 200 letters, digits, '-', '.', '_' or "
                "'~'; make one with: python -c 'import secrets; print(secrets.token_urlsafe(32))'"
            )

    def knows_host(self, host: str | None) -> bool:
        """Returns True if a ``Host`` header is an address or a name of this machine."""
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
        """Returns True if a request comes from no web page, or from one loaded from here.

        A page loaded through a reverse proxy has one of the names, over HTTPS.
        """
        if origin is None or origin.lower() == f"{scheme}://{host}".lower():
            return True
        kind, _, place = origin.lower().partition("://")
        match = _HOST.fullmatch(place)
        return kind == "https" and match is not None and match[1] in self.names

    def needs_token(self, path: str) -> bool:
        """Returns True if a path returns data or has an effect; static pages need no token."""
        return self.token is not None and (path == "/metrics" or path.startswith("/api/"))

    def admits(self, authorization: str | None, subprotocols: str | None) -> bool:
        """Returns True if the token was given; compares in constant time."""
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
    """Returns True if JSON nests deeper than any valid request; a parser would recurse into it."""
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
