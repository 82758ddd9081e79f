"""Address of a daemon, and discovery of the only daemon on this computer."""

import os
import re
import socket
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hdbridge.errors import DaemonError, InputError

SYSTEM_FOLDER = Path("/run/hdbridge")
"""Folder of the sockets of daemons started by the service manager, one subfolder each."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class Address:
    """Address of a daemon: a Unix socket, or a URL with its token."""

    socket: Path | None = None
    url: str = "http://hdbridge"
    """``http://`` or ``https://``, without a path."""
    token: str | None = None

    def __str__(self) -> str:
        return str(self.socket) if self.socket is not None else self.url

    @property
    def websocket_url(self) -> str:
        """URL for WebSockets."""
        return "ws" + self.url.removeprefix("http")

    @property
    def headers(self) -> dict[str, str]:
        """Headers of every request."""
        return {} if self.token is None else {"Authorization": f"Bearer {self.token}"}


def find(
    text: str | Path | None = None, token: str | None = None, environment: Mapping[str, str] = os.environ
) -> Address:
    """Returns the address of the daemon whose socket path, URL or machine name is ``text``.

    Without ``text``, ``$HDBRIDGE_SOCKET`` is used, then ``$HDBRIDGE_URL``, then the only running daemon of
    this user or of the service manager. The default of ``token`` is ``$HDBRIDGE_TOKEN``. Raises DaemonError
    unless exactly one daemon is found, and InputError for an invalid address.
    """
    given = str(text or environment.get("HDBRIDGE_SOCKET") or environment.get("HDBRIDGE_URL") or "")
    token = token or environment.get("HDBRIDGE_TOKEN") or None
    if given.startswith(("http://", "https://")):
        return _url(given, token)
    if "/" in given or given.endswith(".sock"):
        return Address(socket=Path(given))
    if given and not _NAME.fullmatch(given):
        raise InputError(
            f"{given!a}: expected a socket (/run/hdbridge/cell/cell.sock), a URL, or a machine's name"
        )
    there = [each for each in _sockets(environment) if not given or each.stem == given]
    if len(there) == 1:
        return Address(socket=there[0])
    if there:
        raise DaemonError(
            f"{len(there)} daemons run: {', '.join(map(str, there))}; name one, or set HDBRIDGE_SOCKET"
        )
    what = f"no daemon of the name {given!r} runs" if given else "no daemon runs"
    raise DaemonError(
        f"{what} on this computer that this user can access; start one with 'hdbridge run', or set "
        "HDBRIDGE_SOCKET or HDBRIDGE_URL"
    )


def running(environment: Mapping[str, str] = os.environ) -> list[Address]:
    """Returns the addresses of all daemons of this computer that are accessible to this user."""
    return [Address(socket=each) for each in _sockets(environment)]


def session_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Returns the folder of this user's daemon sockets; it need not exist."""
    session = environment.get("XDG_RUNTIME_DIR")
    if session and Path(session).is_dir():
        return Path(session) / "hdbridge"
    return Path(f"/tmp/hdbridge-{os.geteuid()}")


def _url(given: str, token: str | None) -> Address:
    match = re.fullmatch(r"(https?://(?:\[[0-9a-fA-F:.]+\]|[^/?#@:\s\[\]]+)(?::\d{1,5})?)/?", given)
    if match is None:
        raise InputError(
            f"{given!a}: expected http://HOST:PORT or https://HOST:PORT, without a path or a user"
        )
    return Address(url=match[1], token=token)


def _sockets(environment: Mapping[str, str]) -> list[Path]:
    """Returns the sockets in trusted folders on which a process listens."""
    found: list[Path] = []
    for folder in (session_folder(environment), SYSTEM_FOLDER):
        if _is_trusted(folder):
            for place, inside, names in os.walk(folder, followlinks=True):  # files may vanish meanwhile
                if Path(place) != folder:
                    inside.clear()  # searches only one level of subfolders
                found += [Path(place, name) for name in names if name.endswith(".sock")]
    return [path for path in sorted(found) if _listens(path)]


def _is_trusted(folder: Path) -> bool:
    """Returns True for a folder of this user or the system; anyone can create folders below /tmp."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    own = found.st_uid in {os.geteuid(), 0}
    return stat.S_ISDIR(found.st_mode) and own and not found.st_mode & stat.S_IWOTH


def _listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(os.fspath(path))
        except OSError:
            return False
    return True
